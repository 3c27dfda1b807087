"""`change`: what has changed between two surfaces, with significance and volumes."""

import dataclasses
from collections.abc import Mapping
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxbundle.choices import CLOUD_FILES, SURFACE_ERRORS
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError
from jaxbundle.io.results.result_json import without_nan
from jaxbundle.network.columns import count, did_you_mean, list_some
from jaxbundle.results import TableMethods
from jaxbundle.surfaces.change import (
    HeightGrid,
    SurfaceChange,
    align,
    find_change,
    stated_modes,
    summary,
)
from jaxbundle.surfaces.dsm import make_dsm
from jaxbundle.surfaces.inputs import read_orientations
from jaxbundle.surfaces.orientation import orientation_modes
from jaxbundle.surfaces.point_files import read_cloud
from jaxbundle.surfaces.views import is_inside
from jaxbundle.system.rasters import read_heights

# Errors by name, such as {"vertical": 0.2}.
Errors = Mapping[str, float]

NOTHING_SHARED = (
    ": those of the orientations are missing (--before-orientation, --before-error), and σ of "
    "volumes and of slow changes are too small"
)


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class ChangeResult(TableMethods):
    """The change between two surfaces: `change` cell by cell."""

    change: SurfaceChange

    @cached_property
    def figures(self) -> Mapping[str, Any]:
        """Counts, shares and volumes."""
        return summary(self.change)

    def to_dict(self) -> dict[str, Any]:
        """Counts, shares and volumes as plain dicts and numbers."""
        return without_nan(dict(self.figures))

    def table(self) -> dict[str, np.ndarray]:
        """The regions with their volumes; first all cells."""
        rows = [self.change.total, *self.change.regions]
        names = [field.name for field in dataclasses.fields(rows[0])]
        return {name: np.array([getattr(row, name) for row in rows]) for name in names}

    def __str__(self) -> str:
        """Shares and volumes in lines."""
        found = self.figures
        lines = [
            f"{found['cells']} cells of both surfaces; at the level {100 * found['level']:g} % "
            f"(|w| > {found['limit']:.3g}) {100 * found['risen']:.3g} % have risen, "
            f"{100 * found['fallen']:.3g} % fallen",
            f"mean σ of a difference {found['mean_sigma']:.4g}; scatter of the cells over their "
            f"own σ {found['sigma_ratio']:.3g} (1 is right)",
            f"errors of neighbours are correlated over {found['cells_that_count_as_one']:.3g} "
            f"cells; {count(found['shared_errors'], 'error')} common to cells"
            + ("" if found["shared_errors"] else NOTHING_SHARED),
        ]
        for region in (self.change.total, *self.change.regions[:20]):
            name = "all cells" if region.label == 0 else f"region {region.label}"
            lines.append(
                f"{name}: {region.cells} cells, mean {region.mean:.4g}, volume "
                f"{region.volume:.6g}, σ {region.sigma:.3g}"
            )
        return "\n".join(lines)


def change(  # noqa: PLR0913 (public: the options of the command, all but two by name)
    before: HeightGrid | str | Path,
    after: HeightGrid | str | Path,
    *,
    before_sigma: str | Path | None = None,
    after_sigma: str | Path | None = None,
    before_orientation: str | Path | None = None,
    after_orientation: str | Path | None = None,
    before_images: str = "*",
    after_images: str = "*",
    same_adjustment: bool = False,
    before_errors: Errors | None = None,
    after_errors: Errors | None = None,
    stable: str | Path | None = None,
    regions: str | Path | None = None,
    level: float = 0.05,
    size: float | None = None,
) -> ChangeResult:
    """Compare two surfaces: differences, their σ and significance, volumes with σ.

    **Arguments:**

    - `before`, `after`: surface models (GeoTIFF), or clouds (.csv, .ply, .las, .laz), made models
      with cells of `size`.
    - `…_sigma`: GeoTIFF of the σ of the cells; default: `NAME_sigma.tif` beside, as `surface`
      writes it.
    - `…_orientation`: project of the photographs with the covariance of their orientations
      (`precision.csv` of `adjust --out`, or σ of images.csv), which all cells share;
      `…_images`: patterns of the ids of those the surface was made of, separated by commas;
      `same_adjustment`: both are of one adjustment, whose errors they share.
    - `…_errors`: stated errors by name, metres: `cell` of every cell alone; `vertical`,
      `horizontal` (for each axis) of the whole surface, `tilt` of it (radians).
    - `stable`: raster of cells known to be unchanged (not 0), from which shared errors are
      estimated; `regions`: raster of whole numbers whose volumes are computed; `level` of
      significance.

    **Raises:** `InputError`.
    """
    first = _open(before, before_sigma, before_errors or {}, size, "before")
    second = _open(after, after_sigma, after_errors or {}, size, "after")
    _check_systems(first, second)
    masks = [_open_mask(path) for path in (stable, regions) if path is not None]
    first, second, *masks = align(first, second, masks)
    if same_adjustment:
        if before_orientation is None or after_orientation is None:
            raise InputError("--same-adjustment: give --before-orientation and --after-orientation")
        if {*(before_errors or ()), *(after_errors or ())} - {"cell"}:
            raise InputError("--same-adjustment: of stated errors only cell can be given")
    first = _with_modes(first, before_orientation, before_images, before_errors or {})
    second = _with_modes(second, after_orientation, after_images, after_errors or {})
    whole = [np.nan_to_num(mask.height).astype(int) for mask in masks]
    chosen = whole.pop(0) != 0 if stable is not None else None
    labels = whole.pop(0) if regions is not None else None
    return ChangeResult(find_change(first, second, level, chosen, labels, same_adjustment))


def _open(
    given: HeightGrid | str | Path,
    sigma: str | Path | None,
    errors: Errors,
    size: float | None,
    name: str,
) -> HeightGrid:
    """A surface with σ of its cells, no shared errors."""
    for key, value in errors.items():
        if key not in SURFACE_ERRORS:
            raise InputError(f"--{name}-error {key}{did_you_mean(key, SURFACE_ERRORS)}")
        if not (np.isfinite(value) and value >= 0):
            raise InputError(f"--{name}-error {key}={value:g}: a number from 0 on is expected")
    if isinstance(given, HeightGrid):
        return given
    path = Path(given)
    if path.suffix.lower() in CLOUD_FILES:
        if size is None:
            raise InputError(f"{path}: is a cloud; give the --size of the cells to compare")
        dsm = make_dsm(read_cloud(path), size)
        found = HeightGrid(dsm.height, dsm.sigma, dsm.x, dsm.y, dsm.size, dsm.system)
    else:
        found = _read_grid(path)
        beside = path.with_name(f"{path.stem}_sigma{path.suffix}")
        file = Path(sigma) if sigma is not None else beside if beside.is_file() else None
        if file is not None:
            _, of_cells = align(found, _read_grid(file))
            if of_cells.height.shape != found.height.shape:
                raise InputError(f"{file}: does not have the cells of {path}")
            found = dataclasses.replace(found, sigma=of_cells.height)
    if "cell" in errors:
        own = np.nan_to_num(found.sigma)
        found = dataclasses.replace(found, sigma=np.hypot(own, errors["cell"]))
    if not np.isfinite(found.sigma).any():
        raise InputError(
            f"{path}: no σ of its cells; give --{name}-sigma FILE, or --{name}-error cell=METRES"
        )
    return found


def _read_grid(path: Path) -> HeightGrid:
    """The first band of a raster, north up; σ unknown."""
    found = read_heights(path)
    (x, y), (east, north) = found.origin, found.step
    if east <= 0 or abs(east + north) > 1e-6 * east:
        raise InputError(
            f"{path}: square cells, north up, are expected; it has {east:g} × {north:g}: "
            "make them with gdalwarp -tr"
        )
    if found.geographic:
        raise InputError(
            f"{path}: cells in degrees have no volume; give a model in a projected system "
            "(gdalwarp -t_srs)"
        )
    unknown, half = np.full(found.heights.shape, np.nan), 0.5 * east
    return HeightGrid(found.heights, unknown, x - half, y + half, east, found.system)


def _open_mask(path: str | Path) -> HeightGrid:
    return _read_grid(Path(path))


def _check_systems(first: HeightGrid, second: HeightGrid) -> None:
    """Refuse surfaces of different coordinate systems."""
    if first.system is None or second.system is None:
        return
    import pyproj

    one, other = (pyproj.CRS.from_user_input(grid.system) for grid in (first, second))
    if not one.equals(other, ignore_axis_order=True):
        raise InputError(
            f"the surfaces are in different coordinate systems, {one.name} and {other.name}; "
            "transform one (gdalwarp -t_srs)"
        )


def _with_modes(
    grid: HeightGrid, orientation: str | Path | None, images: str, errors: Errors
) -> HeightGrid:
    """A surface with its shared errors: those of its orientations first."""
    stated = {key: value for key, value in errors.items() if key != "cell"}
    modes = [grid.modes, stated_modes(grid, **stated)]
    if orientation is not None:
        modes.insert(0, _modes_of(grid, orientation, images))
    return dataclasses.replace(grid, shared=np.concatenate(modes))


def _modes_of(
    grid: HeightGrid, path: str | Path, images: str
) -> Float[np.ndarray, "k rows columns"]:
    """The columns of L from the orientations of photographs: every cell by all that see it."""
    views = read_orientations(path)
    patterns = [pattern.strip() for pattern in images.split(",")]
    chosen = np.array([any(fnmatchcase(v.name, p) for p in patterns) for v in views])
    if chosen.sum() < 2:
        known_ids = list_some([view.name for view in views], 5, str)
        raise InputError(f"{path}: {images} names {chosen.sum()} of its images ({known_ids})")
    known = np.isfinite(grid.height)
    rows, columns = np.nonzero(known)
    x, y = grid.x + (columns + 0.5) * grid.size, grid.y - (rows + 0.5) * grid.size
    X = np.stack([x, y, grid.height[known]], 1)
    used = np.stack([is_inside(view, view.project(X)) for view in views], 1) & chosen
    # a cell of one photograph has no height from it
    used &= used.sum(1, keepdims=True) > 1
    if not used.any():
        raise InputError(
            f"{path}: no cell is in two of the photographs; is it the project of the surface?"
        )
    slopes = grid.slopes()[:, known]
    direction = np.stack([-slopes[0], -slopes[1], np.ones(len(X))], 1)
    seen = used.any(1)
    M = orientation_modes(views, X[seen], used[seen], direction[seen])
    if not M.shape[1]:
        raise InputError(
            f"{path}: no covariance of its orientations; adjust it with --out and give the folder"
        )
    found = np.zeros((M.shape[1], *grid.height.shape))
    found[:, rows[seen], columns[seen]] = M.T
    return found
