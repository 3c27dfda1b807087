"""Conditions of a design: allowed camera positions, and visibility of targets.

A condition of a *ray* decides whether a station measures a target: field of view, length of the
ray, depth of focus, angle of incidence, no obstacle. A condition of a *station* restricts its
position: in the room, outside of obstacles, apart from the others.
"""

import dataclasses
import math

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from jaxbundle.arguments import at_least_zero, number, numeric_array, show
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError
from jaxbundle.types import Numbers

Box = tuple[tuple[float, float, float], tuple[float, float, float]]


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class Conditions:
    """Conditions of stations and rays; lengths in the object unit, angles in radians.

    **Arguments:**

    - `room`: lowest and highest X, Y, Z of projection centres. Default: within three times the
      largest distance of a start station from the centroid of the targets.
    - `distance`: shortest and longest ray, from the projection centre to a target.
    - `focus`: smallest and largest depth along the optical axis that is in focus.
    - `edge`: unused fraction of the format on each side.
    - `incidence`: largest angle between the normal of a target and the ray; needs `normals`, [P, 3]
      in the order of the points or one [3] for all.
    - `apart`: smallest distance between stations.
    - `obstacles`: opaque boxes with edges along X, Y, Z, (lowest corner, highest corner), without
      cameras inside; a wall or table is a thin box.
    - `targets`: box for free targets.

    **Raises:** `InputError` for empty boxes and invalid numbers.
    """

    room: Box | None = None
    distance: tuple[float, float] | None = None
    focus: tuple[float, float] | None = None
    edge: float = 0.0
    incidence: float | None = None
    normals: Float[np.ndarray, "points 3"] | Numbers | None = None
    apart: float = 0.0
    obstacles: tuple[Box, ...] = ()
    targets: Box | None = None

    def __post_init__(self) -> None:
        # Frozen: what is given is normalised once here, so that all else reads tuples of floats.
        set_field = lambda name, value: object.__setattr__(self, name, value)
        for name in ("room", "targets"):
            if getattr(self, name) is not None:
                set_field(name, box(name, getattr(self, name)))
        set_field("obstacles", tuple(box("obstacles", obstacle) for obstacle in self.obstacles))
        for name in ("distance", "focus"):
            if getattr(self, name) is not None:
                set_field(name, interval(name, getattr(self, name)))
        number("edge", self.edge, "a part of the format from 0, below 0.5", lambda x: 0 <= x < 0.5)
        at_least_zero("apart", self.apart)
        if self.incidence is not None:
            right_angle = "an angle above 0, in radians, up to π/2"
            number("incidence", self.incidence, right_angle, lambda x: 0 < x <= math.pi / 2)
            if self.normals is None:
                raise InputError(
                    "incidence needs the normals of the targets: give normals, [P, 3] or one [3]"
                )
        if self.normals is not None:
            set_field("normals", unit_vectors(self.normals))

    def of_points(self, points: int) -> Float[np.ndarray, "points 3"] | None:
        """The normal of every target, None if none are given.

        **Raises:** `InputError` if their number differs from that of the points."""
        if self.normals is None:
            return None
        normals = np.asarray(self.normals)
        if normals.ndim == 2 and len(normals) != points:
            raise InputError(
                f"normals: {len(normals)} directions for {points} points; give one for each "
                "in the order of the points, or one for all"
            )
        return np.broadcast_to(normals, (points, 3))


def box(name: str, corners_given: ArrayLike) -> Box:
    """Lowest and highest corner of a box.

    **Raises:** `InputError`."""
    corners = numeric_array(name, corners_given, "two corners X, Y, Z").astype(float)
    if corners.shape != (2, 3) or not np.isfinite(corners).all():
        raise InputError(f"{name}: expected two corners X, Y, Z, got {show(corners_given)}")
    if not (corners[0] < corners[1]).all():
        raise InputError(
            f"{name}: the box from {corners[0].tolist()} to {corners[1].tolist()} is empty; the "
            "first corner must be below the second in X, Y and Z"
        )
    low, high = corners.tolist()
    return tuple(low), tuple(high)


def interval(name: str, ends_given: ArrayLike) -> tuple[float, float]:
    """A smallest and a largest length; the largest may be infinite.

    **Raises:** `InputError`."""
    ends = numeric_array(name, ends_given, "a smallest and a largest length").astype(float)
    if ends.shape != (2,) or not (0 <= ends[0] < ends[1]):
        raise InputError(
            f"{name}: expected a smallest and a larger largest length, got {show(ends_given)}"
        )
    return float(ends[0]), float(ends[1])


def unit_vectors(directions: ArrayLike) -> Float[np.ndarray, "*points 3"]:
    """Directions of length 1.

    **Raises:** `InputError`."""
    normals = numeric_array("normals", directions, "directions X, Y, Z").astype(float)
    if normals.ndim not in (1, 2) or normals.shape[-1] != 3:
        raise InputError(f"normals must have the shape [3] or [points, 3], not {normals.shape}")
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    if not (np.isfinite(length) & (length > 0)).all():
        raise InputError("normals must be finite directions, none of them 0, 0, 0")
    return normals / length
