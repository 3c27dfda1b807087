"""Heights of a surface above the ellipsoid or above a geoid, H = h − N(λ, φ).

Scanner and RPC images give heights above the ellipsoid. Those of photographs are what the heights
of their control were: above the geoid of the vertical part of `--crs`, else above the ellipsoid.
"""

import dataclasses
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxbundle.arguments import one_of
from jaxbundle.choices import ELLIPSOID, GEOID, HEIGHTS
from jaxbundle.errors import InputError
from jaxbundle.io.rasters.geoid import undulations_at
from jaxbundle.io.rasters.vertical import (
    GRIDS,
    split_system,
    unit_of,
    usual_grid,
    with_heights_above,
)
from jaxbundle.surfaces.cloud import Cloud
from jaxbundle.surfaces.scanner_inputs import to_degrees


@dataclasses.dataclass(frozen=True)
class HeightReference:
    """What the heights of a surface are above. `system`: of its coordinates, with that of the
    heights where it is stated, `horizontal`: without; `words`: what is said of the heights, empty
    if nothing is known; `geoid`: the grid that was applied, None if heights are as computed, and
    `sign`: −1 from the ellipsoid to it, 1 back."""

    system: str | None = None
    horizontal: str | None = None
    words: str = ""
    geoid: Path | None = None
    sign: int = 0

    def correction(
        self, x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, " n"]:
        """What is added to computed heights at map coordinates, metres.

        **Raises:** `InputError` where the grid has no value."""
        if self.geoid is None or self.horizontal is None or not len(x):
            return np.zeros(len(x))
        longitude, latitude = to_degrees(x, y, self.horizontal)
        N = undulations_at(self.geoid, longitude, latitude)
        # Never 0: heights that are tens of metres off would look like an answer.
        if (is_missing := np.isnan(N)).any():
            k = int(is_missing.argmax())
            raise InputError(
                f"--geoid {self.geoid}: no height of the geoid at longitude {longitude[k]:.6g}°, "
                f"latitude {latitude[k]:.6g}°; give a geoid that covers the images"
            )
        return self.sign * N

    def apply(self, cloud: Cloud) -> Cloud:
        """A cloud in the map system, with heights as computed, with heights as they are wanted."""
        X = cloud.X
        if self.geoid is not None:
            X = X.copy()
            X[:, 2] += self.correction(X[:, 0], X[:, 1])
        return dataclasses.replace(cloud, X=X, system=self.system)

    def as_computed(
        self, heights: tuple[float, float], x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"]
    ) -> tuple[float, float]:
        """The range of computed heights that contains a range of wanted ones at all of some
        places."""
        # Computed = wanted − added, and added differs over the area.
        corrections = self.correction(x, y)
        low, high = heights
        return float(low - corrections.max(initial=-np.inf)), float(
            high - corrections.min(initial=np.inf)
        )


def heights_of_ground_images(
    crs: str, geoid: str | Path | None, heights: str | None
) -> HeightReference:
    """The heights of a surface of scanner or RPC images, computed above the ellipsoid.

    **Arguments:** `crs` of the surface; `geoid`: raster, or name of a grid of PROJ; `heights`:
    `"ellipsoid"`, `"geoid"`, or None: above the geoid if a grid, or a system of such heights, is
    given.

    **Raises:** `InputError` for contradictions, and heights above a geoid without its grid."""
    one_of("--heights", heights, HEIGHTS, allow_none=True)
    parts = split_system(crs)
    if heights == ELLIPSOID or (heights is None and geoid is None and parts.vertical is None):
        if parts.vertical is not None:
            raise InputError(
                f"--crs {crs}: has heights above a geoid ({parts.vertical.name}), --heights says "
                f"{ELLIPSOID}; give one of them: --crs {parts.horizontal}"
            )
        if geoid is not None:
            raise InputError(
                "--geoid: heights of scanner and RPC images are above the ellipsoid already; omit "
                f"it, or --heights {ELLIPSOID}"
            )
        return HeightReference(crs, parts.horizontal, "above the ellipsoid")
    return _above_geoid(crs, geoid, "")


def heights_of_photographs(
    crs: str | None, geoid: str | Path | None, heights: str | None
) -> HeightReference:
    """The heights of a surface of photographs, whose coordinates are in `crs`: with a vertical part
    above its geoid, else above the ellipsoid, which is said only where it is stated.

    **Arguments:** as of `heights_of_ground_images`; `heights` None: as they are, above the geoid if
    a grid is given.

    **Raises:** `InputError` for contradictions, and without a grid or a system that it needs."""
    one_of("--heights", heights, HEIGHTS, allow_none=True)
    if crs is None:
        for name, value in (("--geoid", geoid), ("--heights", heights)):
            if value is not None:
                raise InputError(f"{name}: needs the map system of the block; give --crs EPSG:…")
        return HeightReference()
    parts = split_system(crs)
    computed = GEOID if parts.vertical is not None else ELLIPSOID
    if parts.vertical is None:
        if heights == GEOID and geoid is None:
            raise InputError(
                f"--heights {GEOID}: --crs {crs} has no geoid: give the grid of one, --geoid "
                f"{usual_grid(None)}; or, if the heights of the block are above it already, its "
                f"vertical system, such as --crs {parts.horizontal}+5773 (EGM96)"
            )
        if geoid is not None and heights != ELLIPSOID:
            return _above_geoid(crs, geoid, "of the block above the ellipsoid; ")
    elif heights == ELLIPSOID:
        if geoid is None:
            grid = usual_grid(parts.vertical.to_epsg())
            raise InputError(
                f"--heights {ELLIPSOID}: those of the block are {parts.vertical.name!r}, by its "
                f"--crs; give the geoid: --geoid {grid} (a grid of PROJ: projsync --file {grid})"
            )
        words = f"above the ellipsoid: {parts.vertical.name} and the geoid {geoid}"
        return HeightReference(parts.horizontal, parts.horizontal, words, Path(geoid), 1)
    if geoid is not None:
        raise InputError(
            f"--geoid: the heights of the block are above the {computed} already, by --crs {crs}; "
            f"omit it, or say --heights {GEOID if computed == ELLIPSOID else ELLIPSOID}"
        )
    if parts.vertical is not None:
        words = f"above the geoid: {parts.vertical.name}, of the block"
    else:
        is_stated = heights is not None or parts.above_ellipsoid
        words = "above the ellipsoid, of the block" if is_stated else ""
    return HeightReference(crs, parts.horizontal, words)


def check_cells(reference: HeightReference, metres: bool) -> None:
    """Refuse a system in which a model cannot have square cells in the unit of its heights.

    **Arguments:** `metres`: heights are in metres.

    **Raises:** `InputError`."""
    if reference.horizontal is None:
        return
    unit, factor = unit_of(reference.horizontal)
    if factor is None:
        raise InputError(
            f"--dsm: --crs {reference.horizontal} is in {unit}, in which cells are not square; "
            "give a projected system"
        )
    if metres and factor != 1:
        raise InputError(
            f"--dsm: --crs {reference.horizontal} is in {unit}, heights are in metres; give a "
            "system in metres"
        )


def no_height_reference(geoid: str | Path | None, heights: str | None) -> HeightReference:
    """The heights of a surface in a local frame.

    **Raises:** `InputError` for a geoid, or heights above one or an ellipsoid."""
    for name, value in (("--geoid", geoid), ("--heights", heights)):
        if value is not None:
            raise InputError(f"{name}: a local frame has no ellipsoid and no geoid; omit it")
    return HeightReference()


def _above_geoid(crs: str, geoid: str | Path | None, beginning: str) -> HeightReference:
    """Heights above a geoid, from computed ones above the ellipsoid."""
    parts = split_system(crs)
    code = None if parts.vertical is None else parts.vertical.to_epsg()
    if geoid is None:
        grid = usual_grid(code)
        requested_by = f"--heights {GEOID}"
        if parts.vertical is not None:
            requested_by = f"--crs {crs}: its heights are those of {parts.vertical.name!r}"
        raise InputError(
            f"{requested_by}: heights of scanner and RPC images are computed above the ellipsoid; "
            f"give the geoid: --geoid {grid} (a grid of PROJ: projsync --file {grid})"
        )
    if parts.vertical is None:
        system = with_heights_above(parts.horizontal, geoid)
    else:
        # Depths, and heights in feet, would need a conversion that nobody has asked for.
        (axis,) = parts.vertical.axis_info
        if axis.direction != "up" or axis.unit_conversion_factor != 1:
            raise InputError(
                f"--crs {crs}: its heights, {parts.vertical.name}, are in {axis.unit_name}, "
                f"{axis.direction}; expected metres upwards"
            )
        # A known grid of another system is a mistake; an unknown file may be a copy of the right
        # one.
        grid_of_system, grid = GRIDS.get(code or 0), Path(geoid).name
        if grid_of_system is not None and grid in GRIDS.values() and grid != grid_of_system:
            raise InputError(
                f"--geoid {geoid}: is not that of --crs {crs}, {parts.vertical.name}, which has "
                f"the grid {grid_of_system}; give that one, or another system"
            )
        system = crs
    vertical = split_system(system).vertical
    name = "" if vertical is None or vertical.to_epsg() is None else f" ({vertical.name})"
    return HeightReference(
        system, parts.horizontal, f"{beginning}above the geoid {geoid}{name}", Path(geoid), -1
    )
