"""The input of a refinement: scanner images, ground points, measurements."""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import WGS84, Ellipsoid
from jaxbundle.network.tables import Network, Observations, Source
from jaxbundle.pushbroom.image import PushbroomImage
from jaxbundle.pushbroom.interpolation import covers, interval
from jaxbundle.pushbroom.rpc.image import RpcImage
from jaxbundle.pushbroom.rpc.polynomials import DOMAIN_MARGIN
from jaxbundle.refinement.freedom import Freedom
from jaxbundle.refinement.rpc_points import BIAS_TERMS

ROLES = ("control", "tie", "check")

UNIT_OF_WEIGHT = "1 line or pixel"
"""The σ of an image point where none is stated."""


@dataclasses.dataclass(frozen=True)
class ScannerImage:
    """A scanner image and its unknowns.

    Images of one `sensor` share focal length, mounting and look angles, and the σ of these are
    those of the first. `earth` is None in a local frame.
    """

    id: str
    image: PushbroomImage
    earth: Ellipsoid | None
    freedom: Freedom
    sensor: str = ""


@dataclasses.dataclass(frozen=True)
class RpcScannerImage:
    """An image with rational polynomials, and the polynomial of its bias as unknowns.

    `bias_sigma`: the prior σ of every term of lines and of samples in pixels, 0 held, infinite free
    (`rpc_points.prior_of_bias`, `prior_of_errors`).
    """

    id: str
    image: RpcImage
    bias_sigma: Float[np.ndarray, "2 terms"]

    @property
    def earth(self) -> Ellipsoid:
        """The ellipsoid that the coefficients hold for."""
        return WGS84


AnyScannerImage = ScannerImage | RpcScannerImage


@dataclasses.dataclass(frozen=True)
class GroundPoints:
    """Points in the frame of the images, metres; NaN for unknown coordinates.

    `sigma` of the coordinates along the `axes` (rows; named by `axis_names`): 0 or NaN held, inf
    not controlled. It applies only to control points.
    """

    id: tuple[str, ...]
    role: tuple[str, ...]
    X: Float[np.ndarray, "points 3"]
    sigma: Float[np.ndarray, "points 3"]
    axes: Float[np.ndarray, "points 3 3"]
    axis_names: tuple[str, str, str] = ("X", "Y", "Z")
    source: Source = Source("points")

    def __len__(self) -> int:
        return len(self.id)

    def axis_names_of(self, row: int) -> tuple[str, str, str]:
        """The names of the axes of a point: X, Y, Z also beside others, of points that were given
        without coordinates or come from photographs."""
        along_coordinates = (self.axes[row] == np.eye(3)).all()
        return ("X", "Y", "Z") if along_coordinates else self.axis_names


def local_points(
    id: Sequence[str],
    role: Sequence[str],
    X: Float[np.ndarray, "points 3"],
    sigma: float | Float[np.ndarray, "#points 3"] | None = None,
) -> GroundPoints:
    """Points with σ along X, Y, Z; without `sigma` control points are held."""
    X = np.asarray(X, float)
    sigma = np.broadcast_to(0.0 if sigma is None else np.asarray(sigma, float), X.shape)
    axes = np.tile(np.eye(3), (len(X), 1, 1))
    return GroundPoints(tuple(id), tuple(role), X, sigma, axes)


def with_frames(points: GroundPoints, frames: Network | None) -> GroundPoints:
    """The points with those of a frame network added; duplicates keep the values given here."""
    if frames is None:
        return points
    frame_points, row_of = frames.points, {id: k for k, id in enumerate(points.id)}
    X = points.X.copy()
    for k, id in enumerate(frame_points.id):
        # Coordinates of a network may be approximate: they only fill gaps.
        if id in row_of and np.isnan(X[row_of[id]]).any():
            X[row_of[id]] = frame_points.position[k]
    new = [k for k, id in enumerate(frame_points.id) if id not in row_of]
    role = ["control" if frame_points.role[k] == "fixed" else frame_points.role[k] for k in new]
    fixed = frame_points.has_role("fixed")[new, None]
    return GroundPoints(
        (*points.id, *(frame_points.id[k] for k in new)),
        (*points.role, *role),
        np.concatenate([X, frame_points.position[new]]),
        np.concatenate([points.sigma, np.where(fixed, 0.0, frame_points.sigma[new])]),
        np.concatenate([points.axes, np.tile(np.eye(3), (len(new), 1, 1))]),
        points.axis_names,
        points.source,
    )


def has_upright_checks(earth: Ellipsoid | None) -> bool:
    """Whether check points are compared along east, north, up: above an ellipsoid of revolution."""
    return earth is not None and bool(earth.a == earth.b)


def check_points_table(points: GroundPoints) -> None:
    """Refuse unknown roles, duplicate ids, control points without coordinates, negative σ."""
    first_row = {}
    for row, (id, role) in enumerate(zip(points.id, points.role)):
        if role not in ROLES:
            raise InputError(
                f"{points.source(row)}: role {role!r}; expected one of {', '.join(ROLES)}"
            )
        if id in first_row:
            raise InputError(
                f"{points.source(row)}: point {id!r} occurs twice, also at "
                f"{points.source(first_row[id])}; keep one"
            )
        first_row[id] = row
        if role != "tie" and not np.isfinite(points.X[row]).all():
            raise InputError(f"{points.source(row)}: {role} point {id!r} needs all coordinates")
        if (points.sigma[row] < 0).any():
            raise InputError(f"{points.source(row)}: a σ of point {id!r} is negative; 0 holds it")


def check_images(images: Sequence[AnyScannerImage]) -> None:
    """Refuse images without ids of their own, in different frames, or with invalid unknowns."""
    if not images:
        raise InputError("refine: no scanner image; photographs alone are adjusted by `adjust`")
    if len({scanner_image.id for scanner_image in images}) < len(images):
        raise InputError("refine: two scanner images have the same id; give each its own")
    for scanner_image in images:
        if not is_same_earth(scanner_image.earth, images[0].earth):
            raise InputError(
                f"refine: images {images[0].id!r} and {scanner_image.id!r} have different "
                "ellipsoids or frames; points can be in one only (images with RPC are in WGS84)"
            )
        if isinstance(scanner_image, ScannerImage):
            if scanner_image.freedom.knot_spacing <= 0:
                raise InputError(
                    f"image {scanner_image.id!r}: knot_spacing must be positive, in seconds"
                )
            continue
        shape = np.shape(scanner_image.bias_sigma)
        if len(shape) != 2 or shape[0] != 2 or shape[1] not in BIAS_TERMS:
            raise InputError(
                f"image {scanner_image.id!r}: σ of its bias have the shape {list(shape)}; expected "
                "[2, 1], [2, 3] or [2, 6], of lines and of samples"
            )
        if not (np.asarray(scanner_image.bias_sigma) >= 0).all():
            raise InputError(
                f"image {scanner_image.id!r}: a σ of its bias is negative or NaN; expected pixels, "
                "0 to hold it, inf to free it"
            )


def is_same_earth(earth_a: Ellipsoid | None, earth_b: Ellipsoid | None) -> bool:
    """Whether two ellipsoids are the same but for digits of their axes in files."""
    if earth_a is None or earth_b is None:
        return earth_a is earth_b
    # A millimetre in the axes is a millimetre in height.
    return all(abs(float(a) - float(b)) < 1e-3 for a, b in zip(earth_a, earth_b))


def _limits(scanner_image: AnyScannerImage) -> tuple[tuple[float, float], ...]:
    """The first and last line and pixel that a measurement can have."""
    image = scanner_image.image
    if isinstance(image, RpcImage) and not image.sized:
        # A size that nobody stated is that of the domain.
        offsets = image.rpc.line_offset, image.rpc.sample_offset
        scales = image.rpc.line_scale, image.rpc.sample_scale
        reach = [(1 + DOMAIN_MARGIN) * abs(float(scale)) for scale in scales]
        return tuple((float(o) - r, float(o) + r) for o, r in zip(offsets, reach))
    # Pixels are areas about integers, so that the image ends half a pixel beyond the last.
    return (-0.5, image.lines - 0.5), (-0.5, image.pixels - 0.5)


def _check_on_image(
    images: Sequence[AnyScannerImage], points: GroundPoints, observations: Observations
) -> None:
    """Refuse measurements outside their images."""
    limits = np.array([_limits(scanner_image) for scanner_image in images])[observations.image]
    is_inside = lambda xy: (limits[:, :, 0] <= xy) & (xy <= limits[:, :, 1])
    is_off = ~is_inside(observations.xy)
    if not is_off.any():
        return
    row = int(is_off.any(1).argmax())
    k, i = int(is_off[row].argmax()), observations.image[row]
    scanner_image, (low, high) = images[i], limits[row, k]
    is_of_image = observations.image == i
    hint = ""
    if is_of_image.sum() > 1 and is_inside(observations.xy[:, ::-1])[is_of_image].all():
        hint = "; exchanged, line and pixel of all its points would be on it: check the columns"
    size = (scanner_image.image.lines, scanner_image.image.pixels)[k]
    sized = not isinstance(scanner_image.image, RpcImage) or scanner_image.image.sized
    which = f"which has {size}" if sized else "as far as its coefficients hold"
    raise InputError(
        f"{observations.source(row)}: point {points.id[observations.point[row]]!r} in image "
        f"{scanner_image.id!r}: {('line', 'pixel')[k]} {observations.xy[row, k]:g} is off the "
        f"image, {which}; expected {low:g} to {high:g}{hint}"
    )


def check_observations(
    images: Sequence[AnyScannerImage], points: GroundPoints, observations: Observations
) -> None:
    """Refuse measurements outside the image or the tables, duplicates, and invalid σ."""
    where = lambda row: (
        f"{observations.source(row)}: point {points.id[observations.point[row]]!r} in image "
        f"{images[int(observations.image[row])].id!r}"
    )
    _check_on_image(images, points, observations)
    wrong = ~(observations.sigma > 0).all(1)
    if wrong.any():
        raise InputError(f"{where(int(wrong.argmax()))}: σ must be positive, in lines and pixels")
    first_row = {}
    for row, image_and_point in enumerate(
        zip(observations.image.tolist(), observations.point.tolist())
    ):
        if image_and_point in first_row:
            raise InputError(
                f"{where(row)} is measured twice, also at "
                f"{observations.source(first_row[image_and_point])}; keep one"
            )
        first_row[image_and_point] = row
    for i, scanner_image in enumerate(images):
        if isinstance(scanner_image, ScannerImage):
            _check_times(
                scanner_image, np.flatnonzero(observations.image == i), points, observations
            )


def _check_times(
    scanner_image: ScannerImage,
    rows: Int[np.ndarray, " n"],
    points: GroundPoints,
    observations: Observations,
) -> None:
    """Refuse measurements at times that the ancillary data of their image do not have."""
    t = jnp.asarray(scanner_image.image.times.time(observations.xy[rows, 0]))
    trajectory = scanner_image.image.trajectory
    tables = {"positions": trajectory.position, "attitude": trajectory.attitude.table}
    for table_name, table in tables.items():
        is_outside = ~np.asarray(covers(table, interval(table, t), t))
        if is_outside.any():
            row, time_outside = rows[is_outside.argmax()], float(t[is_outside.argmax()])
            begin, end = float(table.times[0]), float(table.times[-1])
            where = "in a gap of" if begin <= time_outside <= end else "outside"
            raise InputError(
                f"{observations.source(row)}: point {points.id[observations.point[row]]!r} in "
                f"image {scanner_image.id!r}: its line is at {time_outside:.9g} s, {where} the "
                f"table of {table_name}, {begin:.9g} to {end:.9g} s; give ancillary data for the "
                "whole image, or leave the point out"
            )
