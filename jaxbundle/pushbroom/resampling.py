"""Values of a raster between its pixels: nearest, bilinear, cubic.

Cubic is Keys' convolution with a = −½ (Keys, 1981, IEEE Trans. ASSP 29), exact for parabolas.
Integers are pixel centres; up to half a pixel beyond the outer centres the values are extended;
farther out they are NaN, and also if a contributing pixel is NaN.
"""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbundle.choices import RESAMPLINGS, Resampling
from jaxbundle.types import AnyArray, Scalar


def resample(
    bands: Float[AnyArray, "bands rows columns"],
    row: Float[AnyArray, "*shape"],
    column: Float[AnyArray, "*shape"],
    kind: Resampling = "bilinear",
) -> Float[Array, "bands *shape"]:
    """The values of all bands at raster positions."""
    rows, columns = bands.shape[1:]
    inside = (row >= -0.5) & (row <= rows - 0.5) & (column >= -0.5) & (column <= columns - 0.5)
    match kind:
        case "nearest":
            # half to even: on the border of two pixels either serves
            i, j = jnp.round(row).astype(int), jnp.round(column).astype(int)
            value = bands[:, jnp.clip(i, 0, rows - 1), jnp.clip(j, 0, columns - 1)]
        case "bilinear":
            value = _convolve(bands, row, column, lambda x: (1 - x, x), 0)
        case "cubic":
            value = _convolve(bands, row, column, _cubic_weights, 1)
        case _:
            raise ValueError(f"Unknown resampling {kind!r}; known: {RESAMPLINGS}")
    return jnp.where(inside, value, jnp.nan)


def _convolve(
    bands: Float[AnyArray, "bands rows columns"],
    row: Float[AnyArray, "*shape"],
    column: Float[AnyArray, "*shape"],
    weights: Callable[[Scalar], tuple[Scalar, ...]],
    before: int,
) -> Scalar:
    """Products of one-dimensional weights of the pixels starting `before` the position."""
    rows, columns = bands.shape[1:]
    i, j = jnp.floor(row), jnp.floor(column)
    down, right = weights(row - i), weights(column - j)
    # the index of a position that is NaN must be valid; its weights keep the value NaN
    i, j = jnp.nan_to_num(i).astype(int) - before, jnp.nan_to_num(j).astype(int) - before
    across = lambda line: sum(
        w * bands[:, line, jnp.clip(j + k, 0, columns - 1)] for k, w in enumerate(right)
    )
    return sum(w * across(jnp.clip(i + k, 0, rows - 1)) for k, w in enumerate(down))


def _cubic_weights(x: Scalar) -> tuple[Scalar, ...]:
    """Weights of the pixels at −1, 0, 1, 2 for a position x in [0, 1].

    With the distance d, (a + 2)·d³ − (a + 3)·d² + 1 up to 1 and a·d³ − 5a·d² + 8a·d − 4a up to 2,
    a = −½.
    """
    near = lambda d: 1 + d * d * (1.5 * d - 2.5)
    far = lambda d: 2 + d * (-4 + d * (2.5 - 0.5 * d))
    return far(1 + x), near(x), near(1 - x), far(2 - x)
