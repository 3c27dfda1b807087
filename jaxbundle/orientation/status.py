"""Status of a configuration of points and rays: an enumeration that works under jit and vmap."""

from enum import IntEnum

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Int


class Status(IntEnum):
    """The status of a configuration; `advice` is the explanation and remedy."""

    SOUND = 0
    NO_SOLUTION = 1
    COLLINEAR_POINTS = 2
    COPLANAR_POINTS = 3
    DANGER_CYLINDER = 4
    NO_BASE = 5
    PARALLEL_RAYS = 6
    PARALLEL_PLANES = 7
    BEHIND_THE_CAMERA = 8
    UNDETERMINED = 9

    @property
    def advice(self) -> str:
        return _ADVICE[self]


_ADVICE = {
    Status.SOUND: "The configuration determines the unknowns.",
    Status.NO_SOLUTION: "No real solution fits the measurements: look for wrong point numbers.",
    Status.COLLINEAR_POINTS: "The points lie on one line: add a point beside it.",
    Status.COPLANAR_POINTS: "The points lie in one plane: add a point outside it, or use a method "
    "for planes (homography, resection, five points).",
    Status.DANGER_CYLINDER: "Points and projection centre lie on one right cylinder (danger "
    "cylinder): add a point off it.",
    Status.NO_BASE: "The two images differ by a rotation only: take one from another place.",
    Status.PARALLEL_RAYS: "The rays are parallel: add an image from another direction.",
    Status.PARALLEL_PLANES: "The views of the plane are parallel, or too few, or contradict one "
    "another: tilt the camera, or fix the interior orientation.",
    Status.BEHIND_THE_CAMERA: "Points are behind the camera: look for a mirrored image (y down "
    "for y up) or wrong point numbers.",
    Status.UNDETERMINED: "The measurements do not determine all unknowns: add points.",
}


def first_of(*cases: tuple[Bool[Array, ""], Status]) -> Int[Array, ""]:
    """The status of the first case that holds, `SOUND` if none does."""
    status = jnp.asarray(int(Status.SOUND))
    for holds, name in reversed(cases):
        status = jnp.where(holds, int(name), status)
    return status
