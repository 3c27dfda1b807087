"""Points that lie on figures (`figures`), and groups of points whose shape is known (`shapes`).

A figure is a frame whose z axis is the normal of a plane or a circle, the axis of a line or a
cylinder, and a radius; residuals are signed distances (Luhmann et al. 2014, 2.3):

| figure | residuals of a point (x, y, z) of its frame | unknowns |
|---|---|---|
| plane | z | a shift along z, rotations about x and y |
| line | x, y | shifts along and rotations about x and y |
| circle | √(x² + y²) − R, z | three shifts, rotations about x and y, R |
| sphere | √(x² + y² + z²) − R | three shifts, R |
| cylinder | √(x² + y²) − R | shifts along and rotations about x and y, R |

Table `figures`, one row per point: `figure` (its name), `type`, `point`; `sigma` of the distance of
the point, "exact" or empty: a thousandth of the σ of one ray; `radius` if known, in one or all rows
of a figure.

Table `shapes`, one row per point: `shape` (the name of one placement), `point`, its coordinates
`x`, `y`, `z` in the frame of the shape, and `sigma` likewise: a board, a scale cross, with one name
per placement.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxbundle.arguments import show
from jaxbundle.cameras import get_model
from jaxbundle.errors import InputError
from jaxbundle.geometry import quaternion_from_matrix
from jaxbundle.leastsquares.datum.motions import move_pose, scale_length
from jaxbundle.leastsquares.declarations import Kind, ObservationSet, Table
from jaxbundle.leastsquares.spaces import Frame, Posed, PoseValue, Triple
from jaxbundle.network.columns import Columns, did_you_mean
from jaxbundle.network.kinds.base import (
    Contribution,
    ObservationTable,
    positive_sigma,
    rows_of,
    sigma_or_exact,
)
from jaxbundle.network.kinds.fit_figures import FEWEST, TYPES, fit
from jaxbundle.network.tables import Network
from jaxbundle.types import Scalar

# The σ of exact conditions, relative to the σ of a point across a ray: the error decreases with its
# square (points move by 1e-5 of their σ, by 1e-3 with 1e-2); the normal equations stay well
# conditioned.
EXACT_SIGMA = 1e-3
# The set of observations of shapes.
KNOWN_SHAPES = "known shapes"
# The `DIRECTIONS` in which a figure changes; along the others it moves in itself: they would be
# undetermined.
MOVES = {
    "plane": (2, 3, 4),
    "line": (0, 1, 3, 4),
    "circle": (0, 1, 2, 3, 4),
    "sphere": (0, 1, 2),
    "cylinder": (0, 1, 3, 4),
}
DIRECTIONS = ("shift x", "shift y", "shift z", "turn x", "turn y", "turn z")
ROUND = ("circle", "sphere", "cylinder")


def on_plane(frame: Posed, point: Triple, measured: Scalar) -> Scalar:
    return frame.ray(point)[2] - measured


def on_line(frame: Posed, point: Triple, measured: Float[Array, "2"]) -> Float[Array, "2"]:
    return jnp.stack(frame.ray(point)[:2]) - measured


def on_circle(
    frame: Posed, radius: Scalar, point: Triple, measured: Float[Array, "2"]
) -> Float[Array, "2"]:
    x, y, z = frame.ray(point)
    return jnp.stack([jnp.sqrt(x * x + y * y) - radius, z]) - measured


def on_sphere(frame: Posed, radius: Scalar, point: Triple, measured: Scalar) -> Scalar:
    return jnp.sqrt(sum(x * x for x in frame.ray(point))) - radius - measured


def on_cylinder(frame: Posed, radius: Scalar, point: Triple, measured: Scalar) -> Scalar:
    x, y, _ = frame.ray(point)
    return jnp.sqrt(x * x + y * y) - radius - measured


def in_shape(frame: Posed, point: Triple, measured: Float[Array, "3"]) -> Float[Array, "3"]:
    """A point in the frame of a shape of known coordinates."""
    return jnp.stack(frame.ray(point)) - measured


RESIDUALS = {
    "plane": (on_plane, ("distance",)),
    "line": (on_line, ("x", "y")),
    "circle": (on_circle, ("radial", "z")),
    "sphere": (on_sphere, ("distance",)),
    "cylinder": (on_cylinder, ("distance",)),
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Figures(ObservationTable):
    """Points of planes, lines, circles, spheres, cylinders; σ 0: exact; `radius` NaN: unknown."""

    figure: tuple[str, ...]
    type: tuple[str, ...]
    point: tuple[str, ...]
    sigma: Float[np.ndarray, " n"]
    radius: Float[np.ndarray, " n"]

    TABLE, POINTS = "figures", ("point",)
    GIVES_SCALE = True

    @classmethod
    def from_columns(cls, table: Columns, settings: Mapping[str, Any], radians: float) -> "Figures":
        table.check_names(("figure", "type", "point"), ("sigma", "radius"))
        figures = cls(
            figure=table.ids("figure"),
            type=table.ids("type"),
            point=table.ids("point"),
            sigma=sigma_or_exact(table),
            radius=positive_sigma(table, "radius", required=False),
            source=table.source,
        )
        for row, word in enumerate(figures.type):
            if word not in TYPES:
                raise InputError(
                    f"{table.source(row)}: type is {show(word)}{did_you_mean(word, TYPES)}"
                )
        first_rows: dict[str, int] = {}
        first_radius: dict[str, int] = {}
        for row, name in enumerate(figures.figure):
            first_row = first_rows.setdefault(name, row)
            if figures.type[row] != figures.type[first_row]:
                raise InputError(
                    f"{table.source(row)}: {name!r} is a {figures.type[row]} here, but a "
                    f"{figures.type[first_row]} in {table.source(first_row)}"
                )
            if figures.type[row] not in ROUND and not np.isnan(figures.radius[row]):
                raise InputError(f"{table.source(row)}: a {figures.type[row]} has no radius")
            if not np.isnan(figures.radius[row]):
                first_row = first_radius.setdefault(name, row)
                if figures.radius[row] != figures.radius[first_row]:
                    raise InputError(
                        f"{table.source(row)}: {name!r} has a radius of {figures.radius[row]:g} "
                        f"here, but of {figures.radius[first_row]:g} in {table.source(first_row)}"
                    )
        return figures

    @property
    def needs_scale(self) -> bool:
        return bool((self.sigma > 0).any())

    def columns(self, radians: float) -> dict:
        sigma = ["exact" if s == 0 else s for s in self.sigma.tolist()]
        return {
            "figure": self.figure,
            "type": self.type,
            "point": self.point,
            "sigma": sigma,
            "radius": self.radius,
        }

    def declare(self, network: Network, origin: Float[np.ndarray, "3"]) -> Contribution:
        point = rows_of(self.point, network.points)
        place = network.points.position - origin
        exact = EXACT_SIGMA * sigma_across_rays(network)
        declared = [self._of_type(type, point, place, exact) for type in TYPES if type in self.type]
        return Contribution(*(sum(parts, ()) for parts in zip(*declared)))

    def _of_type(
        self,
        type: str,
        point: Int[np.ndarray, " rows"],
        place: Float[np.ndarray, "points 3"],
        exact: float,
    ) -> Contribution:
        rows = np.flatnonzero(np.array(self.type, dtype=object) == type)
        names, figure = np.unique(np.array(self.figure, dtype=object)[rows], return_inverse=True)
        members = [rows[figure == k] for k in range(len(names))]
        for name, figure_rows in zip(names, members):
            usable = len(np.unique(point[figure_rows]))
            if usable < FEWEST[type]:
                raise InputError(
                    f"{self.source(figure_rows[0])}: {type} {name!r} has {usable} "
                    f"usable points; at least {FEWEST[type]} are needed"
                )
        centre, M, radius = (
            np.array(x)
            for x in zip(*(fit(type, place[point[figure_rows]]) for figure_rows in members))
        )
        q = np.array([np.asarray(quaternion_from_matrix(m)) for m in M])
        columns = MOVES[type]
        frame = Table(
            type,
            PoseValue(centre, q),
            Frame(columns),
            labels=list(names),
            parameters=tuple(DIRECTIONS[c] for c in columns),
        )
        sigma = np.where(self.sigma[rows] > 0, self.sigma[rows], exact)
        # Figures of a known and of an unknown radius are two sets: with a radius their scale is
        # known, without one a figure only has the shape of its points.
        if type not in ROUND:
            observations = self._observe_points(type, (type,), (figure,), point[rows], sigma)
            return Contribution((frame,), (observations,), ((type, move_pose),))
        known_radius = np.array(
            [np.nanmax([*self.radius[figure_rows], -1.0]) for figure_rows in members]
        )
        size = Table(
            f"radius of {type}",
            np.where(known_radius > 0, known_radius, radius),
            free=known_radius <= 0,
            labels=list(names),
            parameters=("R",),
        )
        observations = []
        for has_radius in (False, True):
            selected = np.flatnonzero((known_radius > 0)[figure] == has_radius)
            if len(selected):
                tables, rows_of_tables = (type, size.name), (figure[selected],) * 2
                point_rows, own_sigma = point[rows[selected]], sigma[selected]
                observations.append(
                    self._observe_points(
                        type, tables, rows_of_tables, point_rows, own_sigma, not has_radius
                    )
                )
        actions = (type, move_pose), (size.name, scale_length)
        return Contribution((frame, size), tuple(observations), actions)

    @staticmethod
    def _observe_points(
        type: str,
        tables: tuple[str, ...],
        figure: tuple[Int[np.ndarray, " rows"], ...],
        point: Int[np.ndarray, " rows"],
        sigma: Float[np.ndarray, " rows"],
        invariant: bool = True,
    ) -> ObservationSet:
        """The conditions of points on figures. A figure of unknown size moves with its points;
        residuals of points not yet on it must not count as observations of scale or rotation
        (`invariant`)."""
        residual, axes = RESIDUALS[type]
        kind = Kind(f"{type}s", residual, (*tables, "point"), axes, "length", invariant=invariant)
        zero = np.zeros((len(point), len(axes))[: len(axes)])
        return kind((*figure, point), zero, sigma=sigma)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Shapes(ObservationTable):
    """Points of known shapes, each in its placement; σ 0: exact."""

    shape: tuple[str, ...]
    point: tuple[str, ...]
    place: Float[np.ndarray, "n 3"]
    sigma: Float[np.ndarray, " n"]

    TABLE, POINTS = "shapes", ("point",)
    GIVES_SCALE = True

    @classmethod
    def from_columns(cls, table: Columns, settings: Mapping[str, Any], radians: float) -> "Shapes":
        table.check_names(("shape", "point", "x", "y", "z"), ("sigma",))
        place = np.stack([table.numbers(a, required=True) for a in "xyz"], 1)
        return cls(
            shape=table.ids("shape"),
            point=table.ids("point"),
            place=place,
            sigma=sigma_or_exact(table),
            source=table.source,
        )

    def columns(self, radians: float) -> dict:
        columns = {"shape": self.shape, "point": self.point}
        columns |= {a: self.place[:, k] for k, a in enumerate("xyz")}
        return columns | {"sigma": ["exact" if s == 0 else s for s in self.sigma.tolist()]}

    def number_of_equations(self) -> int:
        return 3

    def declare(self, network: Network, origin: Float[np.ndarray, "3"]) -> Contribution:
        point = rows_of(self.point, network.points)
        names, shape = np.unique(np.array(self.shape, dtype=object), return_inverse=True)
        places = network.points.position - origin
        centre, rotation = [], []
        for k, name in enumerate(names):
            shape_rows = np.flatnonzero(shape == k)
            if len(shape_rows) < 3:
                raise InputError(
                    f"{self.source(shape_rows[0])}: shape {name!r}: {len(shape_rows)} points, "
                    "at least 3 are needed"
                )
            X0, M = _fit_frame(self.place[shape_rows], places[point[shape_rows]])
            centre.append(X0)
            rotation.append(np.asarray(quaternion_from_matrix(M)))
        frame = Table(
            "shape",
            PoseValue(np.array(centre), np.array(rotation)),
            Frame(),
            labels=list(names),
            parameters=DIRECTIONS,
        )
        sigma = np.where(self.sigma > 0, self.sigma, EXACT_SIGMA * sigma_across_rays(network))
        kind = Kind(KNOWN_SHAPES, in_shape, ("shape", "point"), ("x", "y", "z"), "length")
        observations = kind((shape, point), self.place, sigma=sigma)
        return Contribution((frame,), (observations,), (("shape", move_pose),))


def _fit_frame(
    x: Float[np.ndarray, "n 3"], X: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """X0 and M of x = M·(X − X0), by Kabsch (1976)."""
    # The determinant keeps a mirrored fit, which plane shapes have, from being a rotation.
    a, b = x.mean(0), X.mean(0)
    U, _, Vt = np.linalg.svd((x - a).T @ (X - b))
    M = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
    return b - M.T @ a, M


def sigma_across_rays(network: Network) -> float:
    """The σ of a point across a ray, σ·s/c, median of all rays."""
    rays, images = network.observations, network.images
    shortest = []
    for camera in network.cameras:
        model = get_model(camera.model)
        shortest.append(min(abs(camera.parameters.get(p, 0.0)) for p in model.principal_distance))
    # σ·s/c: an image point's σ projected to the distance of the object point.
    ray_vectors = network.points.position[rays.point] - images.position[rays.image]
    c = np.array(shortest)[images.camera[rays.image]]
    return float(np.median(np.linalg.norm(ray_vectors, axis=1) * rays.sigma.min(1) / c))
