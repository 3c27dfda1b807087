"""The kinds of observations of a network: one function for one observation each.

| kind | residuals | touches |
|---|---|---|
| image coordinates | x, y | image, camera, point (collinearity equations, distortion) |
| control points | X, Y, Z | point |
| exterior orientation | X0, Y0, Z0, ω, φ, κ | image |
| interior orientation | the camera's parameters | camera |
| distances | d | two points |

Residuals are computed minus observed. Only this module defines how an image coordinate depends on
the unknowns. A similarity of object space changes no image coordinate: the freedoms left open by
the other kinds are the datum defect.
"""

import dataclasses
from typing import Any

import jax.numpy as jnp

from jaxbundle import cameras
from jaxbundle.leastsquares.any_distance import move_at_any_distance
from jaxbundle.leastsquares.datum.motions import similarity
from jaxbundle.leastsquares.declarations import Kind, Local
from jaxbundle.leastsquares.spaces import Posed, turn_by
from jaxbundle.network.further.base import less
from jaxbundle.network.further.exterior_priors import EXTERIOR_PRIOR
from jaxbundle.network.further.rolling_shutter import READ_OUT, VELOCITIES
from jaxbundle.types import present


@dataclasses.dataclass(frozen=True)
class ImagePoint:
    """The two residuals of an image point, in the unit of the camera model; of poses, cameras and
    points it takes scalars. Each of the poses (one in a network) transforms to the frame of the
    next, the last to that of the camera."""

    model: str | cameras.CameraModel
    domain: str

    def __call__(self, *touched):
        *poses, interior, ray, xy = touched
        for pose in poses:
            ray = pose.ray(ray)
        return cameras.residual(cameras.get_model(self.model), self.domain, interior, ray, xy)


@dataclasses.dataclass(frozen=True)
class ColumnsOfImagePoint:
    """Which parameters of the camera an image point depends on (`CameraModel.local`)."""

    model: str | cameras.CameraModel

    def __call__(self, *touched):
        *poses, p, ray, _ = touched
        model = cameras.get_model(self.model)
        return present(model.local).columns(p, *model.ideal(p, *_transform_ray(poses, ray)))


@dataclasses.dataclass(frozen=True)
class LocalImagePoint:
    """The residuals of an image point as a function of these."""

    model: str | cameras.CameraModel

    def __call__(self, *touched):
        *poses, p, ray, columns, values, xy = touched
        model = cameras.get_model(self.model)
        at = model.ideal(p, *_transform_ray(poses, ray))
        x, y = present(model.local).distort(p, columns, values, *at)
        return x - xy[0], y - xy[1]


def _transform_ray(poses, ray):
    for pose in poses:
        ray = pose.ray(ray)
    return ray


@dataclasses.dataclass(frozen=True)
class MovingImagePoint(ImagePoint):
    """The same for a moving camera with a rolling shutter (`further.rolling_shutter`)."""

    def __call__(self, pose, velocity, read_out, interior, point, measured):
        xy, line = measured
        time = read_out[0] * line
        centre = tuple(c + v * time for c, v in zip(pose.centre, velocity[:3]))
        ray = Posed(pose.rotation, centre).ray(point)
        turned: Any = turn_by(tuple(w * time for w in velocity[3:]), ray)
        return cameras.residual(cameras.get_model(self.model), self.domain, interior, turned, xy)


def image_points(
    model: str | cameras.CameraModel,
    domain: str,
    camera: str,
    poses: tuple[str, ...] = ("image",),
    moving: bool = False,
) -> Kind:
    """Image points of the cameras of one model, whose table is `camera`; `domain`: "corrected" or
    "measured"; `poses`: the tables of poses on the way from the object to the camera; `moving`: for
    cameras with a rolling shutter."""
    between = (VELOCITIES, READ_OUT) if moving else ()
    of = (*poses, *between, camera, "point")
    only = camera == "camera"
    name = "image coordinates" if only else f"image coordinates of {cameras.get_model(model).name}"
    residual = (MovingImagePoint if moving else ImagePoint)(model, domain)
    formula, local = cameras.get_model(model).local, None
    if formula is not None and domain == "measured" and not moving:
        local = Local(
            of.index(camera), formula.number, ColumnsOfImagePoint(model), LocalImagePoint(model)
        )
    return Kind(name, residual, of, ("x", "y"), scalars=True, invariant=True, local=local)


def _distance(a, b, given):
    return jnp.sqrt(jnp.sum((a - b) ** 2)) - given


CONTROL = Kind("control points", less, ("point",), ("X", "Y", "Z"), snooped="single")
EXTERIOR = EXTERIOR_PRIOR
DISTANCES = Kind("distances", _distance, ("point", "point"), ("d",), snooped="single")


def interior_orientation(camera: str, parameters: tuple[str, ...]) -> Kind:
    """Priors of the parameters of the cameras of a table."""
    return Kind("interior orientation", less, (camera,), parameters, snooped="", invariant=True)


SIMILARITY = similarity(("point",), ("image",))
SIMILARITY_AT_ANY_DISTANCE = dataclasses.replace(
    SIMILARITY,
    actions=tuple(
        (name, move_at_any_distance if name == "point" else act) for name, act in SIMILARITY.actions
    ),
)
