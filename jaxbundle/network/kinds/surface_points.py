"""Points on known surfaces: table `surface_points`, section `[surfaces]`.

    [surfaces]
    wall = { plane = [0, 0, 0], normal = [0, 1, 0] }
    roof = { mesh = "roof.ply" }                        # or .obj
    ground = { dem = "ground.tif" }                     # heights above X, Y

Residuals: the distance of a point from the plane, or from the plane of the triangle that is nearest
to it, of those near its start value (Chen and Medioni 1992); its height above the grid, bilinear.
Surfaces are in the coordinates of object space. In Python, a mesh may be (vertices, triangles), a
grid (heights, origin, step).

Columns: `surface`, `point`, `sigma` of the distance, "exact" or empty: a thousandth of the σ of one
ray.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.arguments import show
from jaxbundle.errors import InputError
from jaxbundle.leastsquares.declarations import Kind, ObservationSet
from jaxbundle.network.columns import Columns, did_you_mean
from jaxbundle.network.kinds.base import Contribution, Further, check_settings, numbers, rows_of
from jaxbundle.network.kinds.figures import EXACT_SIGMA, across_rays, sigma_or_exact
from jaxbundle.network.surface_models import (
    Mesh,
    TerrainGrid,
    heights_near,
    read_grid,
    read_mesh,
    triangles_near,
)
from jaxbundle.network.tables import Network

SECTION = "surfaces"
FORMS = ("plane", "mesh", "dem")


def on_known_plane(X: Float[Array, "3"], given: tuple[Array, Array, Array]) -> Float[Array, ""]:
    """The distance of a point from a plane minus the given one; a point of the plane, and its
    normal of length 1."""
    distance, place, normal = given
    return (X - place) @ normal - distance


def on_mesh(X: Float[Array, "3"], given: tuple[Array, Array]) -> Float[Array, ""]:
    """The distance of a point from the plane of the nearest of some triangles [k, 3, 3] minus the
    given one."""
    distance, triangles = given
    a = triangles[:, 0]
    normal = jnp.cross(triangles[:, 1] - a, triangles[:, 2] - a)
    size = jnp.linalg.norm(normal, axis=1)
    normal = normal / jnp.where(size > 0, size, 1.0)[:, None]
    # Which triangle counts is a choice: it has no derivative.
    nearest = jnp.argmin(jax.lax.stop_gradient(_squares(X, triangles, normal)))
    return (X - a[nearest]) @ normal[nearest] - distance


def _squares(X: Array, triangles: Array, normal: Array) -> Float[Array, " k"]:
    """The squared distances of a point from triangles."""
    p, q = triangles, jnp.roll(triangles, -1, 1)
    side, away = q - p, X - p
    inside = (jnp.cross(side, away) * normal[:, None]).sum(2) >= 0
    length = (side * side).sum(2)
    t = jnp.clip((away * side).sum(2) / jnp.where(length > 0, length, 1.0), 0.0, 1.0)
    edges = ((away - t[..., None] * side) ** 2).sum(2).min(1)
    off = (away[:, 0] * normal).sum(1) ** 2
    return jnp.where(inside.all(1), off, edges)


def above_grid(X: Float[Array, "3"], given: tuple[Array, Array, Array, Array]) -> Float[Array, ""]:
    """The height of a point above a part of a grid minus the given one; its heights, first node and
    steps."""
    height, heights, first, step = given
    place = (X[:2] - first) / step
    cell = jnp.clip(jnp.floor(jax.lax.stop_gradient(place)), 0, heights.shape[0] - 2).astype(int)
    x, y = place - cell
    (a, b), (c, d) = jax.lax.dynamic_slice(heights, (cell[1], cell[0]), (2, 2))
    return X[2] - ((1 - y) * ((1 - x) * a + x * b) + y * ((1 - x) * c + x * d)) - height


@dataclasses.dataclass(frozen=True, kw_only=True)
class SurfacePoints(Further):
    """Points of known surfaces; σ 0: exact."""

    surface: tuple[str, ...]
    point: tuple[str, ...]
    sigma: Float[np.ndarray, " n"]

    TABLE, SECTION, POINTS = "surface_points", SECTION, ("point",)
    FILES = ("mesh", "dem")
    GIVES_SCALE = True

    @classmethod
    def from_columns(
        cls, table: Columns, settings: Mapping[str, Any], radians: float
    ) -> "SurfacePoints":
        table.check_names(("surface", "point"), ("sigma",))
        for name, one in settings.items():
            _check_surface(f"{SECTION}.{name}", one)
        surface = table.ids("surface")
        for row, name in enumerate(surface):
            if name not in settings:
                raise InputError(
                    f"{table.source(row)}: surface {name!r} is not in [{SECTION}]"
                    f"{did_you_mean(name, settings)}"
                )
        sigma = sigma_or_exact(table)
        point, settings = table.ids("point"), dict(settings)
        return cls(
            surface=surface, point=point, sigma=sigma, settings=settings, source=table.source
        )

    @property
    def needs_scale(self) -> bool:
        return bool((self.sigma > 0).any())

    def columns(self, radians: float) -> dict:
        sigma = ["exact" if s == 0 else s for s in self.sigma.tolist()]
        return {"surface": self.surface, "point": self.point, "sigma": sigma}

    def _check_scale(self, network: Network) -> None:
        """Refuse planes with a common point in a network without a scale: it would shrink to that
        point, where all residuals are 0. Off the planes the derivatives do not show it."""
        used = [self.settings[name] for name in dict.fromkeys(self.surface)]
        other = any(one.GIVES_SCALE for one in network.further if one.TABLE != self.TABLE)
        held = network.points.has_role("control", "fixed").sum() > 1
        held |= bool(np.isfinite(network.images.sigma).any())
        if other or held or len(network.distances) or any("plane" not in one for one in used):
            return
        n = np.array([one["normal"] for one in used], float)
        p = np.array([one["plane"] for one in used], float)
        apart = n @ np.linalg.lstsq(n, (n * p).sum(1))[0] - (n * p).sum(1)
        # 1e-9: rounding of printed places
        if np.abs(apart).max() <= 1e-9 * np.linalg.norm(n, axis=1).max() * np.abs(p).max(initial=1):
            raise InputError(
                f"{self.source.name}: planes with a common point give no scale, and nothing else "
                "does: expected a distance or control points as well"
            )

    def declare(self, network: Network, origin: Float[np.ndarray, "3"]) -> Contribution:
        self._check_scale(network)
        point = rows_of(self.point, network.points)
        X = network.points.position[point]
        sigma = np.where(self.sigma > 0, self.sigma, EXACT_SIGMA * across_rays(network))
        sets: list[ObservationSet] = []
        for name in dict.fromkeys(self.surface):
            rows = np.flatnonzero([of == name for of in self.surface])
            kind, measured = self._measured(name, X[rows], origin, rows)
            label = f"{kind.name}, {name}"
            # The distance is what is observed: 0, for points on the surface.
            measured = (np.zeros(len(rows)), *measured)
            sets.append(kind((point[rows],), measured, sigma=sigma[rows], name=label))
        return Contribution((), sets)

    def _measured(
        self, name: str, X: Float[np.ndarray, "n 3"], origin: Float[np.ndarray, "3"], rows: Any
    ) -> tuple[Kind, tuple[np.ndarray, ...]]:
        given, n = self.settings[name], len(X)
        if "plane" in given:
            normal = np.array(given["normal"], float) / np.linalg.norm(given["normal"])
            place = np.array(given["plane"], float) - origin
            return ON_PLANE, (np.tile(place, (n, 1)), np.tile(normal, (n, 1)))
        if "mesh" in given:
            mesh = given["mesh"]
            mesh = read_mesh(mesh) if isinstance(mesh, str) else Mesh(*map(np.asarray, mesh))
            return ON_MESH, (triangles_near(mesh, X) - origin,)
        grid = given["dem"]
        grid = read_grid(grid) if isinstance(grid, str) else TerrainGrid(*grid)
        heights, first = heights_near(grid, X)
        middle = heights.shape[1] // 2
        void = ~np.isfinite(heights[:, middle - 1 : middle + 1, middle - 1 : middle + 1])
        for k in np.flatnonzero(void.any((1, 2)))[:1]:
            raise InputError(
                f"{self.source(rows[k])}: point {self.point[rows[k]]!r} is outside of the surface "
                f"{name!r}, or over a void of it, at X {X[k, 0]:g}, Y {X[k, 1]:g}"
            )
        # beyond a void or an edge the surface goes on level
        near = np.nanmean(heights, (1, 2), keepdims=True)
        heights = np.where(np.isfinite(heights), heights, near) - origin[2]
        return ABOVE, (heights, first - origin[:2], np.tile(np.array(grid.step, float), (n, 1)))


ON_PLANE = Kind("points on known planes", on_known_plane, ("point",), ("distance",), "length")
ON_MESH = Kind("points on known meshes", on_mesh, ("point",), ("distance",), "length")
ABOVE = Kind("points on known terrain", above_grid, ("point",), ("height",), "length")


def _check_surface(where: str, given: Any) -> None:
    """Refuse what is no surface."""
    check_settings(where, given, (*FORMS, "normal"))
    forms = [form for form in FORMS if form in given]
    if len(forms) != 1 or ("normal" in given) != (forms == ["plane"]):
        raise InputError(
            f"[{where}]: {show(dict(given))}; expected plane and normal, or mesh, or dem"
        )
    if forms == ["plane"]:
        numbers(where, "plane", given["plane"], 3)
        if not numbers(where, "normal", given["normal"], 3).any():
            raise InputError(f"[{where}]: normal is 0; expected a direction")
    elif not isinstance(given[forms[0]], str | tuple | list):
        raise InputError(f"[{where}]: {forms[0]} is {show(given[forms[0]])}; expected a file")
