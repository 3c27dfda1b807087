"""From a product's camera frame to ours: x along the detectors, y forward, looking along −z."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxbundle.pushbroom.scanner import AnglePolynomial


class SightFrame(NamedTuple):
    """`rotation` leads from our camera frame into that of the product, `slopes` from its x/z, y/z
    to (ξ, η)."""

    rotation: Rotation
    slopes: Callable[[Float[np.ndarray, " n"], Float[np.ndarray, " n"]], Float[np.ndarray, "2 n"]]


def sight_frame(
    sights: Float[np.ndarray, "2 pixels"],
    down: Float[np.ndarray, "3"],
    forward: Float[np.ndarray, "3"],
) -> SightFrame:
    """The frame of a camera that looks along ±(x, y, 1): the side of the planet.

    **Arguments:** `sights` x and y of all pixels; `down` and `forward`, the directions to the
    planet and of flight, in the frame of the product.
    """
    look = np.array([*sights[:, sights.shape[1] // 2], 1.0])
    # The camera frame here looks along −z: rotated about x, or unchanged and seen from behind.
    looks_along_z = look @ down > 0
    rotation = Rotation.from_matrix(np.diag([1.0, -1, -1]) if looks_along_z else np.eye(3))
    signs = np.array([1.0, -1.0]) if looks_along_z else np.array([-1.0, -1.0])
    line_direction = signs * (sights[:, -1] - sights[:, 0])
    angle = np.arctan2(line_direction[1], line_direction[0])
    rotation_about = lambda angle: rotation * Rotation.from_rotvec([0, 0, angle])
    if rotation_about(angle).inv().apply(forward)[1] < 0:  # y would point backwards
        angle += np.pi
    c, s = np.cos(angle), np.sin(angle)
    slopes = lambda x, y: np.array([[c, s], [-s, c]]) @ (signs[:, None] * [x, y])
    return SightFrame(rotation_about(angle), slopes)


def polynomial_optics(
    frame: SightFrame, x: Float[np.ndarray, " k"], y: Float[np.ndarray, " k"]
) -> AnglePolynomial:
    """The optics of x/z and y/z that are polynomials of the pixel, constants first."""
    across, along = frame.slopes(np.asarray(x, float), np.asarray(y, float))
    return AnglePolynomial(
        jnp.asarray(across), jnp.asarray(along), jnp.asarray(0.0), jnp.asarray(1.0)
    )
