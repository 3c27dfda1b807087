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

import numpy as np
from jaxtyping import Array, Float

from jaxbundle.arguments import show
from jaxbundle.errors import InputError
from jaxbundle.geometry.surfaces import (
    distance_to_nearest_triangle,
    distance_to_plane,
    height_above_grid,
)
from jaxbundle.leastsquares.declarations import Kind, ObservationSet
from jaxbundle.network.columns import Columns, did_you_mean
from jaxbundle.network.kinds.base import (
    Contribution,
    ObservationTable,
    check_settings,
    numbers,
    rows_of,
    sigma_or_exact,
)
from jaxbundle.network.kinds.figures import EXACT_SIGMA, sigma_across_rays
from jaxbundle.network.surface_models import have_common_point, surface_near
from jaxbundle.network.tables import Network

SECTION = "surfaces"


def on_plane(X: Float[Array, "3"], measured: tuple[Array, Array, Array]) -> Float[Array, ""]:
    """The distance of a point from a plane, minus the observed one."""
    observed, *plane = measured
    return distance_to_plane(X, *plane) - observed


def on_mesh(X: Float[Array, "3"], measured: tuple[Array, Array]) -> Float[Array, ""]:
    """The distance of a point from the plane of the nearest triangle, minus the observed one."""
    observed, corners = measured
    return distance_to_nearest_triangle(X, corners) - observed


def above_grid(
    X: Float[Array, "3"], measured: tuple[Array, Array, Array, Array]
) -> Float[Array, ""]:
    """The height of a point above a grid, minus the observed one."""
    observed, *grid = measured
    return height_above_grid(X, *grid) - observed


KINDS = {
    "plane": Kind("points on known planes", on_plane, ("point",), ("distance",), "length"),
    "mesh": Kind("points on known meshes", on_mesh, ("point",), ("distance",), "length"),
    "dem": Kind("points on known terrain", above_grid, ("point",), ("height",), "length"),
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class SurfacePoints(ObservationTable):
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
        for name, definition in settings.items():
            _check_surface(f"{SECTION}.{name}", definition)
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
        surfaces = [self.settings[name] for name in dict.fromkeys(self.surface)]
        scale_from_tables = any(
            table.GIVES_SCALE for table in network.further if table.TABLE != self.TABLE
        )
        scale_from_control = network.points.has_role("control", "fixed").sum() > 1
        scale_from_control |= bool(np.isfinite(network.images.sigma).any())
        if (
            scale_from_tables
            or scale_from_control
            or len(network.distances)
            or any("plane" not in surface for surface in surfaces)
        ):
            return
        if have_common_point(
            [surface["plane"] for surface in surfaces], [surface["normal"] for surface in surfaces]
        ):
            raise InputError(
                f"{self.source.name}: planes with a common point give no scale, and nothing else "
                "does: expected a distance or control points as well"
            )

    def declare(self, network: Network, origin: Float[np.ndarray, "3"]) -> Contribution:
        self._check_scale(network)
        point = rows_of(self.point, network.points)
        X = network.points.position[point]
        sigma = np.where(self.sigma > 0, self.sigma, EXACT_SIGMA * sigma_across_rays(network))
        sets: list[ObservationSet] = []
        for name in dict.fromkeys(self.surface):
            rows = np.flatnonzero([surface == name for surface in self.surface])
            surface_parts, is_outside = surface_near(self.settings[name], X[rows], origin)
            for row in rows[is_outside][:1]:
                raise InputError(
                    f"{self.source(row)}: point {self.point[row]!r} is outside of the surface "
                    f"{name!r}, or over a void of it, at X {X[row, 0]:g}, Y {X[row, 1]:g}"
                )
            kind = KINDS[next(form for form in KINDS if form in self.settings[name])]
            # The distance is what is observed: 0, for points on the surface.
            measured = (np.zeros(len(rows)), *surface_parts)
            label = f"{kind.name}, {name}"
            sets.append(kind((point[rows],), measured, sigma=sigma[rows], name=label))
        return Contribution((), sets)


def _check_surface(where: str, definition: Any) -> None:
    """Refuse what is no surface."""
    check_settings(where, definition, (*KINDS, "normal"))
    forms = [form for form in KINDS if form in definition]
    if len(forms) != 1 or ("normal" in definition) != (forms == ["plane"]):
        raise InputError(
            f"[{where}]: {show(dict(definition))}; expected plane and normal, or mesh, or dem"
        )
    if forms == ["plane"]:
        numbers(where, "plane", definition["plane"], 3)
        if not numbers(where, "normal", definition["normal"], 3).any():
            raise InputError(f"[{where}]: normal is 0; expected a direction")
    elif not isinstance(definition[forms[0]], str | tuple | list):
        raise InputError(f"[{where}]: {forms[0]} is {show(definition[forms[0]])}; expected a file")
