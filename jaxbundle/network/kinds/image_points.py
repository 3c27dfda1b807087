"""Image points: x and y, which touch image, camera and point (collinearity equations, distortion).

Residuals are computed minus observed. Only this module says what an image coordinate depends on:
the ray of `Posed.ray`, imaged by `cameras.residual`. Measurements in rows of lines exposed one
after the other have the line beside them (`rolling_shutter`); through refracting interfaces the ray
is that of `interfaces`.
"""

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int

from jaxbundle import cameras
from jaxbundle.leastsquares.declarations import Kind, Local, ObservationSet
from jaxbundle.leastsquares.spaces import Change, Posed, Triple, turn_by
from jaxbundle.network.kinds.interfaces import MEDIA, Interfaces, RefractedImagePoint, Refraction
from jaxbundle.network.kinds.rolling_shutter import READ_OUT, VELOCITIES, RollingShutter
from jaxbundle.types import Scalar, not_none

if TYPE_CHECKING:
    from jaxbundle.network.camera_tables import CameraTable
    from jaxbundle.network.tables import Network


@dataclasses.dataclass(frozen=True)
class ImagePoint:
    """The two residuals of an image point, in the unit of the camera model; of poses, cameras and
    points it takes scalars. Each of the poses (one in a network) transforms to the frame of the
    next, the last to that of the camera."""

    model: str | cameras.CameraModel
    domain: str

    def __call__(self, *blocks_and_measured: Any) -> Change:
        *poses, interior, ray, xy = blocks_and_measured
        for pose in poses:
            ray = pose.ray(ray)
        return cameras.residual(cameras.get_model(self.model), self.domain, interior, ray, xy)


@dataclasses.dataclass(frozen=True)
class ColumnsOfImagePoint:
    """Which parameters of the camera an image point depends on (`CameraModel.local`)."""

    model: str | cameras.CameraModel

    def __call__(self, *blocks_and_measured: Any) -> Change:
        *poses, p, ray, _ = blocks_and_measured
        model = cameras.get_model(self.model)
        return not_none(model.local).columns(p, *model.ideal(p, *_transform_ray(poses, ray)))


@dataclasses.dataclass(frozen=True)
class LocalImagePoint:
    """The residuals of an image point as a function of these."""

    model: str | cameras.CameraModel

    def __call__(self, *blocks_and_measured: Any) -> Change:
        *poses, p, ray, columns, values, xy = blocks_and_measured
        model = cameras.get_model(self.model)
        ideal = model.ideal(p, *_transform_ray(poses, ray))
        x, y = not_none(model.local).distort(p, columns, values, *ideal)
        return x - xy[0], y - xy[1]


def _transform_ray(poses: Sequence[Posed], ray: Triple) -> Triple:
    for pose in poses:
        ray = pose.ray(ray)
    return ray


@dataclasses.dataclass(frozen=True)
class MovingImagePoint(ImagePoint):
    """The residuals of an image point of a moving camera with a rolling shutter."""

    def __call__(
        self,
        pose: Posed,
        velocity: Change,
        read_out: Change,
        interior: Change,
        point: Triple,
        measured: tuple[tuple[Scalar, Scalar], Scalar],
    ) -> Change:
        xy, line = measured
        # The pose at the time of the line: the centre moves, and the camera turns by a small
        # rotation after the ray has been turned into its frame, M(t) = exp([w·t]×)·M.
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
    refraction: Refraction | None = None,
) -> Kind:
    """Image points of the cameras of one model, whose table is `camera`; `domain`: "corrected" or
    "measured"; `poses`: the tables of poses on the way from the object to the camera; `moving`: for
    cameras with a rolling shutter; `refraction`: through interfaces."""
    extra_tables = (VELOCITIES, READ_OUT) if moving else ()
    if refraction is not None:
        extra_tables = (refraction.table, MEDIA)
    tables = (*poses, *extra_tables, camera, "point")
    has_one_model = camera == "camera"
    name = (
        "image coordinates"
        if has_one_model
        else f"image coordinates of {cameras.get_model(model).name}"
    )
    residual: Any = (MovingImagePoint if moving else ImagePoint)(model, domain)
    if refraction is not None:
        residual = RefractedImagePoint(model, domain, refraction)
    # A spline of hundreds of parameters: an image point depends on a few of them, and only those
    # get derivatives and blocks (`leastsquares.equations.local`).
    formula, local = cameras.get_model(model).local, None
    if formula is not None and domain == "measured" and not extra_tables:
        local = Local(
            tables.index(camera), formula.number, ColumnsOfImagePoint(model), LocalImagePoint(model)
        )
    return Kind(
        name, residual, tables, ("x", "y"), "image", scalars=True, invariant=True, local=local
    )


def declare_image_points(
    network: "Network", tables: "tuple[CameraTable, ...]"
) -> tuple[list[ObservationSet], dict[str, Int[np.ndarray, " rows"]]]:
    """A set of image points for every table of cameras, and by its name the rows of the network's
    observations that are in it."""
    images, rays = network.images, network.observations
    shutter = next((f for f in network.further if isinstance(f, RollingShutter)), None)
    line = None if shutter is None else shutter.lines(network)
    interfaces = next((f for f in network.further if isinstance(f, Interfaces)), None)
    refraction = None if interfaces is None else interfaces.refraction
    camera = images.camera[rays.image]
    row_of_camera = np.zeros(len(network.cameras), np.int64)
    for table in tables:
        row_of_camera[table.cameras] = np.arange(len(table.cameras))
    sets, rows_of_sets = [], {}
    for table in tables:
        rows = np.flatnonzero(np.isin(camera, table.cameras))
        if not len(rows):
            continue
        kind = image_points(
            table.model,
            network.residuals,
            table.name,
            moving=line is not None,
            refraction=refraction,
        )
        extra_rows = () if line is None else (rays.image, camera)
        if interfaces is not None:
            extra_rows = (interfaces.rows_of_cameras(network)[camera],) * 2
        rows_of_tables = (rays.image, *extra_rows, row_of_camera[camera], rays.point)
        measured = rays.xy[rows] if line is None else (rays.xy[rows], line[rows])
        sets.append(
            kind(
                tuple(index[rows] for index in rows_of_tables),
                measured,
                sigma=rays.sigma[rows],
                name=table.image_set,
            )
        )
        rows_of_sets[table.image_set] = rows
    return sets, rows_of_sets


def image_coordinates(measured: Any) -> Float[np.ndarray, "rows 2"]:
    """x and y of the measurements of a set, without the line of a rolling shutter."""
    return measured[0] if isinstance(measured, tuple) else measured
