"""Radial polynomials r·(1 + k1·r² + k2·r⁴ + …), and their valid range.

Beyond the radius where such a polynomial turns back it silently gives a wrong image, and farther
out, where it rises again, another one. `is_increasing` tests whether it rises all the way to a
point.
"""

from collections.abc import Sequence

import jax.numpy as jnp

from jaxbundle.cameras.scalars import Scalar

# Number of radii at which the slope is tested. The slope of a lens's polynomial falls below zero
# once, and stays there for the rest of the image; a dip narrower than an eighth of the radius,
# which needs four coefficients of alternating sign, may be missed. Every sample costs another
# polynomial for every point of the image.
SAMPLES = 8


def radial(k: Sequence[Scalar], square: Scalar) -> Scalar:
    """1 + k1·r² + k2·r⁴ + … of r²."""
    # Horner: of the highest coefficient first.
    value = jnp.zeros_like(square)
    for coefficient in reversed(k):
        value = square * (coefficient + value)
    return 1 + value


def is_increasing(k: Sequence[Scalar], square: Scalar) -> Scalar:
    """Whether the slope 1 + 3·k1·r² + 5·k2·r⁴ + … is positive from the axis to r, sampled."""
    slopes = [(2 * i + 3) * coefficient for i, coefficient in enumerate(k)]
    good = jnp.ones_like(square, bool)
    for i in range(1, SAMPLES + 1):
        good &= radial(slopes, square * (i / SAMPLES)) > 0
    return good
