"""The input of a refinement: scanner images, ground points, measurements."""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import Ellipsoid
from jaxbundle.network.tables import Network, Observations, Source
from jaxbundle.pushbroom.image import PushbroomImage
from jaxbundle.pushbroom.interpolation import covers, interval
from jaxbundle.refinement.freedom import Freedom

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
    source: Source = Source("points"),  # noqa: B008
) -> GroundPoints:
    """Points with σ along X, Y, Z; without `sigma` control points are held."""
    X = np.asarray(X, float)
    sigma = np.broadcast_to(0.0 if sigma is None else np.asarray(sigma, float), X.shape)
    axes = np.tile(np.eye(3), (len(X), 1, 1))
    return GroundPoints(tuple(id), tuple(role), X, sigma, axes, source=source)


def with_frames(points: GroundPoints, frames: Network | None) -> GroundPoints:
    """The points with those of a frame network added; duplicates keep the values given here."""
    if frames is None:
        return points
    theirs, known = frames.points, {id: k for k, id in enumerate(points.id)}
    X = points.X.copy()
    for k, id in enumerate(theirs.id):
        # coordinates of a network may be approximate: they only fill gaps
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
                f"{points.source(row)}: role {role!r}; one of {', '.join(ROLES)} is expected"
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


def check_observations(
    images: list[ScannerImage], points: GroundPoints, observations: Observations
) -> None:
    """Refuse measurements outside the image or the tables, duplicates, and invalid σ."""
    seen = {}
    for row, (i, p) in enumerate(zip(observations.image, observations.point)):
        one = images[i]
        where = f"{observations.source(row)}: point {points.id[p]!r} in image {one.id!r}"
        sizes = (one.image.lines, one.image.pixels)
        for name, value, size in zip(("line", "pixel"), observations.xy[row], sizes):
            # pixels are areas about integers, so that the image ends half a pixel beyond the last
            if not -0.5 <= value <= size - 0.5:
                raise InputError(
                    f"{where}: {name} {value:g} is off the image, which has {size}; -0.5 to "
                    f"{size - 0.5:g} is expected"
                )
        if not (observations.sigma[row] > 0).all():
            raise InputError(f"{where}: σ must be positive, in lines and pixels")
        if (i, p) in seen:
            raise InputError(
                f"{where} is measured twice, also at {observations.source(seen[i, p])}; keep one"
            )
        seen[i, p] = row
    for i, one in enumerate(images):
        rows = np.flatnonzero(observations.image == i)
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
