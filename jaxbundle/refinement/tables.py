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
    theirs, known = frames.points, {id: k for k, id in enumerate(points.id)}
    X = points.X.copy()
    for k, id in enumerate(theirs.id):
        # Coordinates of a network may be approximate: they only fill gaps.
        if id in known and np.isnan(X[known[id]]).any():
            X[known[id]] = theirs.position[k]
    new = [k for k, id in enumerate(theirs.id) if id not in known]
    role = ["control" if theirs.role[k] == "fixed" else theirs.role[k] for k in new]
    fixed = theirs.has_role("fixed")[new, None]
    return GroundPoints(
        (*points.id, *(theirs.id[k] for k in new)),
        (*points.role, *role),
        np.concatenate([X, theirs.position[new]]),
        np.concatenate([points.sigma, np.where(fixed, 0.0, theirs.sigma[new])]),
        np.concatenate([points.axes, np.tile(np.eye(3), (len(new), 1, 1))]),
        points.axis_names,
        points.source,
    )


def check_points_table(points: GroundPoints) -> None:
    """Refuse unknown roles, duplicate ids, control points without coordinates, negative σ."""
    seen = {}
    for row, (id, role) in enumerate(zip(points.id, points.role)):
        if role not in ROLES:
            raise InputError(
                f"{points.source(row)}: role {role!r}; expected one of {', '.join(ROLES)}"
            )
        if id in seen:
            raise InputError(
                f"{points.source(row)}: point {id!r} occurs twice, also at "
                f"{points.source(seen[id])}; keep one"
            )
        seen[id] = row
        if role != "tie" and not np.isfinite(points.X[row]).all():
            raise InputError(f"{points.source(row)}: {role} point {id!r} needs all coordinates")
        if (points.sigma[row] < 0).any():
            raise InputError(f"{points.source(row)}: a σ of point {id!r} is negative; 0 holds it")


def check_images(images: Sequence[AnyScannerImage]) -> None:
    """Refuse images without ids of their own, in different frames, or with invalid unknowns."""
    if not images:
        raise InputError("refine: no scanner image; photographs alone are adjusted by `adjust`")
    if len({one.id for one in images}) < len(images):
        raise InputError("refine: two scanner images have the same id; give each its own")
    for one in images:
        if not is_same_earth(one.earth, images[0].earth):
            raise InputError(
                f"refine: images {images[0].id!r} and {one.id!r} have different ellipsoids or "
                "frames; points can be in one only (images with RPC are in WGS84)"
            )
        if isinstance(one, ScannerImage):
            if one.freedom.knot_spacing <= 0:
                raise InputError(f"image {one.id!r}: knot_spacing must be positive, in seconds")
            continue
        shape = np.shape(one.bias_sigma)
        if len(shape) != 2 or shape[0] != 2 or shape[1] not in BIAS_TERMS:
            raise InputError(
                f"image {one.id!r}: σ of its bias have the shape {list(shape)}; expected [2, 1], "
                "[2, 3] or [2, 6], of lines and of samples"
            )
        if not (np.asarray(one.bias_sigma) >= 0).all():
            raise InputError(
                f"image {one.id!r}: a σ of its bias is negative or NaN; expected pixels, 0 to hold "
                "it, inf to free it"
            )


def is_same_earth(one: Ellipsoid | None, other: Ellipsoid | None) -> bool:
    """Whether two ellipsoids are the same but for digits of their axes in files."""
    if one is None or other is None:
        return one is other
    # A millimetre in the axes is a millimetre in height.
    return all(abs(float(a) - float(b)) < 1e-3 for a, b in zip(one, other))


def _limits(one: AnyScannerImage) -> tuple[tuple[float, float], ...]:
    """The first and last line and pixel that a measurement can have."""
    image = one.image
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
    limits = np.array([_limits(one) for one in images])[observations.image]
    inside = lambda xy: (limits[:, :, 0] <= xy) & (xy <= limits[:, :, 1])
    off = ~inside(observations.xy)
    if not off.any():
        return
    row = int(off.any(1).argmax())
    k, i = int(off[row].argmax()), observations.image[row]
    one, (low, high) = images[i], limits[row, k]
    rows = observations.image == i
    hint = ""
    if len(rows) > 1 and inside(observations.xy[:, ::-1])[rows].all():
        hint = "; exchanged, line and pixel of all its points would be on it: check the columns"
    size = (one.image.lines, one.image.pixels)[k]
    sized = not isinstance(one.image, RpcImage) or one.image.sized
    which = f"which has {size}" if sized else "as far as its coefficients hold"
    raise InputError(
        f"{observations.source(row)}: point {points.id[observations.point[row]]!r} in image "
        f"{one.id!r}: {('line', 'pixel')[k]} {observations.xy[row, k]:g} is off the image, "
        f"{which}; expected {low:g} to {high:g}{hint}"
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
    seen = {}
    for row, at in enumerate(zip(observations.image.tolist(), observations.point.tolist())):
        if at in seen:
            raise InputError(
                f"{where(row)} is measured twice, also at {observations.source(seen[at])}; keep one"
            )
        seen[at] = row
    for i, one in enumerate(images):
        if isinstance(one, ScannerImage):
            _check_times(one, np.flatnonzero(observations.image == i), points, observations)


def _check_times(
    one: ScannerImage,
    rows: Int[np.ndarray, " n"],
    points: GroundPoints,
    observations: Observations,
) -> None:
    """Refuse measurements at times that the ancillary data of their image do not have."""
    t = jnp.asarray(one.image.times.time(observations.xy[rows, 0]))
    trajectory = one.image.trajectory
    tables = {"positions": trajectory.position, "attitude": trajectory.attitude.table}
    for what, table in tables.items():
        out = ~np.asarray(covers(table, interval(table, t), t))
        if out.any():
            row, at = rows[out.argmax()], float(t[out.argmax()])
            first, last = float(table.times[0]), float(table.times[-1])
            wrong = "in a gap of" if first <= at <= last else "outside"
            raise InputError(
                f"{observations.source(row)}: point {points.id[observations.point[row]]!r} in "
                f"image {one.id!r}: its line is at {at:.9g} s, {wrong} the table of {what}, "
                f"{first:.9g} to {last:.9g} s; give ancillary data for the whole image, or "
                "leave the point out"
            )
