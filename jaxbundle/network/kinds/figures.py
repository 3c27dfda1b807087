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
the point, "exact" or empty: a thousandth of the σ of one ray; `radius` if known.

Table `shapes`, one row per point: `shape` (the name of one placement), `point`, its coordinates
`x`, `y`, `z` in the frame of the shape, and `sigma` likewise: a board, a scale cross, with one name
per placement.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbundle.arguments import show
from jaxbundle.cameras import get_model
from jaxbundle.errors import InputError
from jaxbundle.geometry import quaternion_from_matrix
from jaxbundle.leastsquares.datum.motions import move_pose
from jaxbundle.leastsquares.declarations import Kind, Table
from jaxbundle.leastsquares.spaces import Frame, PoseValue
from jaxbundle.network.columns import Columns, did_you_mean
from jaxbundle.network.kinds.base import Declared, Further, positive_sigma, rows_of
from jaxbundle.network.kinds.fit_figures import FEWEST, TYPES, fit

EXACT_SIGMA = 1e-3
"""The σ of exact conditions, relative to the σ of a point across a ray: the error decreases with
its square (points move by 1e-5 of their σ, by 1e-3 with 1e-2); the normal equations stay well
conditioned."""
SHIFTS, TILTS = (0, 1, 2), (3, 4)
MOVES = {
    "plane": (2, *TILTS),
    "line": (0, 1, *TILTS),
    "circle": (*SHIFTS, *TILTS),
    "sphere": SHIFTS,
    "cylinder": (0, 1, *TILTS),
}
DIRECTIONS = ("shift x", "shift y", "shift z", "turn x", "turn y", "turn z")
ROUND = ("circle", "sphere", "cylinder")


def on_plane(frame, point, given):
    return frame.ray(point)[2] - given


def on_line(frame, point, given):
    return jnp.stack(frame.ray(point)[:2]) - given


def on_circle(frame, radius, point, given):
    x, y, z = frame.ray(point)
    return jnp.stack([jnp.sqrt(x * x + y * y) - radius, z]) - given


def on_sphere(frame, radius, point, given):
    return jnp.sqrt(sum(x * x for x in frame.ray(point))) - radius - given


def on_cylinder(frame, radius, point, given):
    x, y, _ = frame.ray(point)
    return jnp.sqrt(x * x + y * y) - radius - given


def in_shape(frame, point, given):
    """A point in the frame of a shape of known coordinates."""
    return jnp.stack(frame.ray(point)) - given


RESIDUALS = {
    "plane": (on_plane, ("distance",)),
    "line": (on_line, ("x", "y")),
    "circle": (on_circle, ("radial", "z")),
    "sphere": (on_sphere, ("distance",)),
    "cylinder": (on_cylinder, ("distance",)),
}


def _move_radius(motion, radius):
    return jnp.exp(motion[6]) * radius


@dataclasses.dataclass(frozen=True, kw_only=True)
class Figures(Further):
    """Points of planes, lines, circles, spheres, cylinders; σ 0: exact; `radius` NaN: unknown."""

    figure: tuple[str, ...]
    type: tuple[str, ...]
    point: tuple[str, ...]
    sigma: Float[np.ndarray, " n"]
    radius: Float[np.ndarray, " n"]

    TABLE, POINTS = "figures", ("point",)

    @classmethod
    def of(cls, table: Columns, settings: Mapping[str, Any], radians: float) -> "Figures":
        table.check_names(("figure", "type", "point"), ("sigma", "radius"))
        made = cls(
            figure=table.ids("figure"),
            type=table.ids("type"),
            point=table.ids("point"),
            sigma=sigma_or_exact(table),
            radius=positive_sigma(table, "radius", required=False),
            source=table.source,
        )
        for row, word in enumerate(made.type):
            if word not in TYPES:
                raise InputError(
                    f"{table.source(row)}: type is {show(word)}{did_you_mean(word, TYPES)}"
                )
        first: dict[str, int] = {}
        for row, name in enumerate(made.figure):
            other = first.setdefault(name, row)
            if made.type[row] != made.type[other]:
                raise InputError(
                    f"{table.source(row)}: {name!r} is a {made.type[row]} here, but a "
                    f"{made.type[other]} in {table.source(other)}"
                )
            if made.type[row] not in ROUND and not np.isnan(made.radius[row]):
                raise InputError(f"{table.source(row)}: a {made.type[row]} has no radius")
        return made

    @property
    def has_size(self) -> bool:
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

    def declare(self, network, origin) -> Declared:
        point = rows_of(self.point, network.points)
        place = network.points.position - origin
        exact = EXACT_SIGMA * across_rays(network)
        declared = [self._of_type(type, point, place, exact) for type in TYPES if type in self.type]
        return Declared(*(sum(parts, ()) for parts in zip(*declared)))

    def _of_type(self, type, point, place, exact) -> Declared:
        rows = np.flatnonzero(np.array(self.type, dtype=object) == type)
        names, figure = np.unique(np.array(self.figure, dtype=object)[rows], return_inverse=True)
        fitted = []
        for k, name in enumerate(names):
            own = rows[figure == k]
            if len(np.unique(point[own])) < FEWEST[type]:
                raise InputError(
                    f"{self.source(own[0])}: {type} {name!r} has {len(own)} usable points; "
                    f"at least {FEWEST[type]} are needed"
                )
            fitted.append(fit(type, place[point[own]]))
        centre, M, radius = (np.array(x) for x in zip(*fitted))
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
        if type not in ROUND:
            seen = self._observe_points(type, (type,), (figure,), point[rows], sigma)
            return Declared((frame,), (seen,), ((type, move_pose),))
        known = np.array(
            [np.nanmax([*self.radius[rows[figure == k]], -1.0]) for k in range(len(names))]
        )
        size = Table(
            f"radius of {type}",
            np.where(known > 0, known, radius),
            free=known <= 0,
            labels=list(names),
            parameters=("R",),
        )
        seen = []
        for given in (False, True):
            those = np.flatnonzero((known > 0)[figure] == given)
            if len(those):
                touched = (figure[those],) * 2
                seen.append(
                    self._observe_points(
                        type,
                        (type, size.name),
                        touched,
                        point[rows[those]],
                        sigma[those],
                        not given,
                    )
                )
        actions = (type, move_pose), (size.name, _move_radius)
        return Declared((frame, size), tuple(seen), actions)

    @staticmethod
    def _observe_points(type, tables, figure, point, sigma, invariant=True):
        """The conditions of points on figures. A figure of unknown size moves with its points;
        residuals of points not yet on it must not count as observations of scale or rotation
        (`invariant`)."""
        residual, axes = RESIDUALS[type]
        kind = Kind(f"{type}s", residual, (*tables, "point"), axes, invariant=invariant)
        zero = np.zeros((len(point), len(axes))[: len(axes)])
        return kind((*figure, point), zero, sigma=sigma)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Shapes(Further):
    """Points of known shapes, each in its placement; σ 0: exact."""

    shape: tuple[str, ...]
    point: tuple[str, ...]
    place: Float[np.ndarray, "n 3"]
    sigma: Float[np.ndarray, " n"]

    TABLE, POINTS = "shapes", ("point",)

    @classmethod
    def of(cls, table: Columns, settings: Mapping[str, Any], radians: float) -> "Shapes":
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

    def declare(self, network, origin) -> Declared:
        point = rows_of(self.point, network.points)
        names, shape = np.unique(np.array(self.shape, dtype=object), return_inverse=True)
        places = network.points.position - origin
        centre, rotation = [], []
        for k, name in enumerate(names):
            own = np.flatnonzero(shape == k)
            if len(own) < 3:
                raise InputError(
                    f"{self.source(own[0])}: shape {name!r}: {len(own)} points, "
                    "at least 3 are needed"
                )
            X0, M = _place(self.place[own], places[point[own]])
            centre.append(X0)
            rotation.append(np.asarray(quaternion_from_matrix(M)))
        frame = Table(
            "shape",
            PoseValue(np.array(centre), np.array(rotation)),
            Frame(),
            labels=list(names),
            parameters=DIRECTIONS,
        )
        sigma = np.where(self.sigma > 0, self.sigma, EXACT_SIGMA * across_rays(network))
        kind = Kind("known shapes", in_shape, ("shape", "point"), ("x", "y", "z"))
        seen = kind((shape, point), self.place, sigma=sigma)
        return Declared((frame,), (seen,), (("shape", move_pose),))


def _place(x, X):
    """X0 and M of x = M·(X − X0), by Kabsch (1976)."""
    a, b = x.mean(0), X.mean(0)
    U, _, Vt = np.linalg.svd((x - a).T @ (X - b))
    M = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
    return b - M.T @ a, M


def across_rays(network) -> float:
    """The σ of a point across a ray, σ·s/c, median of all rays."""
    rays, images = network.observations, network.images
    shortest = []
    for camera in network.cameras:
        model = get_model(camera.model)
        shortest.append(min(abs(camera.parameters.get(p, 0.0)) for p in model.principal_distance))
    away = network.points.position[rays.point] - images.position[rays.image]
    c = np.array(shortest)[images.camera[rays.image]]
    return float(np.median(np.linalg.norm(away, axis=1) * rays.sigma.min(1) / c))


def sigma_or_exact(table: Columns):
    """σ of distances; 0 if exact."""
    sigma = table.numbers("sigma", words={"exact": 0.0})
    for row in np.flatnonzero(sigma < 0)[:1]:
        raise InputError(f"{table.source(row)}: sigma is {sigma[row]:g}; it must be positive")
    return np.nan_to_num(sigma)
