"""`change`: what has changed between two surfaces, with significance and volumes."""

import dataclasses
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from jaxbundle.choices import CLOUD_FILES, SURFACE_ERRORS
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError
from jaxbundle.io.rasters.vertical import horizontal_system, split_system
from jaxbundle.io.results.result_json import without_nan
from jaxbundle.network.columns import count, did_you_mean
from jaxbundle.results import TableMethods
from jaxbundle.surfaces.change import SurfaceChange, find_change, summary
from jaxbundle.surfaces.dsm import make_dsm
from jaxbundle.surfaces.height_cells import (
    CellSource,
    HeightGrid,
    StatedSurfaceErrors,
    UncertainCells,
    align,
    middle_of,
    place_of,
)
from jaxbundle.surfaces.oriented_errors import OrientedErrors, choose_images, oriented_errors
from jaxbundle.surfaces.point_files import read_cloud
from jaxbundle.surfaces.raster_cells import RasterCells, open_cells

# Errors by name, such as {"vertical": 0.2}.
Errors = Mapping[str, float]

NOTHING_SHARED = (
    ": those of the orientations are missing (--before-orientation, --before-error), and σ of "
    "volumes and of slow changes are too small"
)


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class ChangeResult(TableMethods):
    """The change between two surfaces: `change` cell by cell; `warnings`: what makes its σ
    doubtful."""

    change: SurfaceChange
    warnings: tuple[str, ...] = ()

    @cached_property
    def figures(self) -> Mapping[str, Any]:
        """Counts, shares and volumes."""
        return summary(self.change)

    def to_dict(self) -> dict[str, Any]:
        """Counts, shares, volumes and warnings as plain dicts, lists and numbers."""
        return without_nan({**self.figures, "warnings": list(self.warnings)})

    def table(self) -> dict[str, np.ndarray]:
        """The regions with their volumes; first all cells."""
        rows = [self.change.total, *self.change.regions]
        names = [field.name for field in dataclasses.fields(rows[0])]
        return {name: np.array([getattr(row, name) for row in rows]) for name in names}

    def __str__(self) -> str:
        """Shares and volumes in lines."""
        figures = self.figures
        tail, at_level = figures["tail_ratio"], ""
        if tail != figures["sigma_ratio"]:
            at_level = f"; of single cells at this level {tail:.3g}"
        lines = [
            f"{figures['cells']} cells of both surfaces; at the level {100 * figures['level']:g} % "
            f"(|w| > {figures['limit']:.3g}) {100 * figures['risen']:.3g} % have risen, "
            f"{100 * figures['fallen']:.3g} % fallen",
            f"mean σ of a difference {figures['mean_sigma']:.4g}; scatter of the cells over their "
            f"own σ {figures['sigma_ratio']:.3g} (1 is right{at_level}), which are multiplied by "
            "it if it is above 1",
            f"of neighbouring cells {figures['cells_that_count_as_one']:.3g} count as one; "
            f"{count(figures['shared_errors'], 'error')} common to cells"
            + ("" if figures["shared_errors"] else NOTHING_SHARED),
        ]
        most = 20  # about a screen
        for region in (self.change.total, *self.change.regions[:most]):
            name = "all cells" if region.label == 0 else f"region {region.label}"
            lines.append(
                f"{name}: {region.cells} cells, mean {region.mean:.4g}, volume "
                f"{region.volume:.6g}, σ {region.sigma:.3g}"
            )
        number_of_others = len(self.change.regions) - most
        if number_of_others > 0:
            lines.append(f"… and {count(number_of_others, 'more region')}: all are in the JSON")
        return "\n".join([*lines, *(f"warning: {words}" for words in self.warnings)])


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
      (`precision.csv` of `adjust --out`, or σ of images.csv), or folder of `pushbroom refine --out`
      with that of scanner and RPC images; all cells share these errors;
      `…_images`: patterns of the ids of those the surface was made of, separated by commas;
      `same_adjustment`: both are of one adjustment, whose errors they share.
    - `…_errors`: stated errors by name, metres: `cell` of every cell alone; `vertical`,
      `horizontal` (for each axis) of the whole surface, `tilt` of it (radians).
    - `stable`: raster of cells known to be unchanged (not 0), from which shared errors are
      estimated; `regions`: raster of whole numbers whose volumes are computed; `level` of
      significance.

    **Raises:** `InputError`.
    """
    cells_before = _open_surface(
        before, before_sigma, before_errors or {}, size, "before", before_orientation is not None
    )
    cells_after = _open_surface(
        after, after_sigma, after_errors or {}, size, "after", after_orientation is not None
    )
    _check_systems(cells_before, cells_after)
    _check_heights(cells_before, cells_after)
    cells_before, cells_after = align(cells_before, cells_after)
    if same_adjustment:
        if before_orientation is None or after_orientation is None:
            raise InputError("--same-adjustment: give --before-orientation and --after-orientation")
        if {*(before_errors or ()), *(after_errors or ())} - {"cell"}:
            raise InputError("--same-adjustment: of stated errors only cell can be given")
    oriented, warnings = _orientations(
        (before_orientation, after_orientation),
        (before_images, after_images),
        (cells_before, cells_after),
        same_adjustment,
    )
    for source, cells, errors, name in zip(
        (before, after), (cells_before, cells_after), oriented, ("before", "after")
    ):
        if errors is not None and not isinstance(source, HeightGrid):
            warnings += _doubled_sigma(Path(source), cells, name)
    is_stable = None if stable is None else _read_mask(stable, cells_before) != 0
    labels = None if regions is None else _read_mask(regions, cells_before)
    found_change = find_change(
        _with_errors(cells_before, oriented[0], before_errors or {}),
        _with_errors(cells_after, oriented[1], after_errors or {}),
        level,
        is_stable,
        labels,
        same_adjustment,
    )
    return ChangeResult(found_change, tuple(warnings))


def _doubled_sigma(path: Path, cells: CellSource, name: str) -> list[str]:
    """What is said of σ of cells that may contain the errors of the orientations already."""
    if isinstance(cells, RasterCells):
        if cells.sigma is None or cells.sigma.without_orientation:
            return []
        path = cells.sigma.path
    return [
        f"{path}: has no σ of its own, without the errors of the orientations; where its σ contain "
        f"them they count twice with --{name}-orientation, and changes are missed: give a model of "
        "surface --dsm, whose file of σ has both, or leave the option out"
    ]


def _open_surface(
    source: HeightGrid | str | Path,
    sigma: str | Path | None,
    errors: Errors,
    size: float | None,
    name: str,
    without_orientation: bool,
) -> HeightGrid | RasterCells:
    """A surface with σ of its cells, no shared errors; `without_orientation`: σ without those of
    orientations, if the file has them."""
    for key, value in errors.items():
        if key not in SURFACE_ERRORS:
            raise InputError(f"--{name}-error {key}{did_you_mean(key, SURFACE_ERRORS)}")
        if not (np.isfinite(value) and value >= 0):
            raise InputError(f"--{name}-error {key}={value:g}: a number from 0 on is expected")
    cell = errors.get("cell", 0.0)
    if isinstance(source, HeightGrid):
        return _with_cell_error(source, cell)
    path = Path(source)
    if path.suffix.lower() in CLOUD_FILES:
        if sigma is not None:
            raise InputError(f"{path}: is a cloud, whose points have σ; omit --{name}-sigma")
        if size is None:
            raise InputError(f"{path}: is a cloud; give the --size of the cells to compare")
        dsm = make_dsm(read_cloud(path), size)
        surface = HeightGrid(dsm.height, dsm.sigma, dsm.x, dsm.y, dsm.size, dsm.system)
        surface = _with_cell_error(surface, cell)
        has_sigma = bool(np.isfinite(surface.sigma).any())
    else:
        surface = dataclasses.replace(open_cells(path), more_sigma=cell)
        beside = path.with_name(f"{path.stem}_sigma{path.suffix}")
        file = Path(sigma) if sigma is not None else beside if beside.is_file() else None
        if file is not None:
            surface = surface.with_sigma(file, without_orientation)
        has_sigma = surface.has_sigma
    if not has_sigma:
        raise InputError(
            f"{path}: no σ of its cells; give --{name}-sigma FILE, or --{name}-error cell=METRES"
        )
    return surface


def _with_cell_error(grid: HeightGrid, cell: float) -> HeightGrid:
    """A surface with the stated error of every cell; cells without σ have that alone."""
    if not cell:
        return grid
    return dataclasses.replace(grid, sigma=np.hypot(np.nan_to_num(grid.sigma), cell))


def _read_mask(path: str | Path, cells: CellSource) -> Int[np.ndarray, "rows columns"]:
    """A raster of whole numbers on the lattice of some cells, 0 where there is nothing: it marks
    cells, and need not have all of them."""
    mask = open_cells(path)
    numbers = np.zeros(cells.shape, np.int32)
    try:
        _check_systems(cells, mask)
        row, column = place_of(mask, cells)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    rows, columns = (
        slice(max(offset, 0), min(offset + n, size))
        for offset, n, size in zip((row, column), mask.shape, cells.shape)
    )
    if rows.start >= rows.stop or columns.start >= columns.stop:
        raise InputError(f"{path}: has no cell of the surfaces; check its coordinate system")
    # 512 rows of 10 000 cells are 40 MB
    for start in range(rows.start, rows.stop, 512):
        part = slice(start, min(start + 512, rows.stop))
        mask_rows = slice(part.start - row, part.stop - row)
        mask_columns = slice(columns.start - column, columns.stop - column)
        values = np.nan_to_num(mask.window(mask_rows, mask_columns).height)
        # A fraction would be cut to another region, or a stable cell to none.
        strange = (values != np.rint(values)) | (np.abs(values) >= 2**31)
        if strange.any():
            raise InputError(
                f"{path}: has a cell of {values[strange][0]:g}; whole numbers below 2³¹ are "
                "expected, 0 for none"
            )
        numbers[part, columns] = values
    return numbers


def _check_systems(before: CellSource, after: CellSource) -> None:
    """Refuse surfaces in different map systems."""
    if before.system is None or after.system is None:
        return
    import pyproj

    system_before, system_after = (
        pyproj.CRS.from_user_input(horizontal_system(grid.system)) for grid in (before, after)
    )
    if not system_before.equals(system_after, ignore_axis_order=True):
        raise InputError(
            f"two rasters are in different coordinate systems, {system_before.name} and "
            f"{system_after.name}; transform one (gdalwarp -t_srs)"
        )


def _check_heights(before: CellSource, after: CellSource) -> None:
    """Refuse heights above different surfaces, by the systems of the files."""
    systems = [split_system(grid.system) for grid in (before, after) if grid.system is not None]
    names = ["none" if system.vertical is None else system.vertical.name for system in systems]
    if len({*names}) > 1:
        raise InputError(
            f"the heights of both surfaces are of different systems: before {names[0]}, after "
            f"{names[1]}; none is the ellipsoid. Transform one (surface --geoid, gdalwarp), or, if "
            "both have the same heights, name the same system in both (gdal_edit.py -a_srs)"
        )


def _with_errors(
    cells: CellSource, orientation: OrientedErrors | None, errors: Errors
) -> UncertainCells:
    """A surface with its shared errors: those of its orientations first."""
    systematic = {key: value for key, value in errors.items() if key != "cell"}
    stated_errors = StatedSurfaceErrors(middle_of(cells), **systematic)
    return UncertainCells(cells, (*(() if orientation is None else (orientation,)), stated_errors))


def _orientations(
    paths: tuple[str | Path | None, str | Path | None],
    patterns: tuple[str, str],
    surfaces: tuple[CellSource, CellSource],
    of_one_adjustment: bool,
) -> tuple[tuple[OrientedErrors | None, OrientedErrors | None], list[str]]:
    """The errors of the orientations of both surfaces, and warnings. If both are of one adjustment,
    they are those of all its images that either was made of, in one order."""
    warnings: list[str] = []
    both_errors: list[OrientedErrors | None] = []
    chosen_images = [
        None if p is None else choose_images(p, text) for p, text in zip(paths, patterns)
    ]
    for path, images, cells in zip(paths, chosen_images, surfaces):
        if path is None or images is None:
            both_errors.append(None)
            continue
        names_of_all = (
            [part.names for part in chosen_images if part is not None] if of_one_adjustment else []
        )
        errors = oriented_errors(images, set().union(*names_of_all), cells.system)
        # Of another project all columns of L would be 0, and the errors missing in silence.
        share_seen = errors.share_seen(cells)
        if share_seen == 0:
            raise InputError(
                f"{path}: no cell of the surface is in two of its images; is it the project of "
                "this surface, in its coordinate system?"
            )
        if share_seen < 1:
            warnings.append(
                f"{path}: {100 * (1 - share_seen):.3g} % of the cells with a height are in fewer "
                "than two of its images: their σ have no errors of orientations, and are too "
                "small if they were made of other images"
            )
        both_errors.append(errors)
    before, after = both_errors
    if (
        of_one_adjustment
        and before is not None
        and after is not None
        and not before.are_those_of(after)
    ):
        raise InputError(
            "--same-adjustment: the orientations of both surfaces are not those of one adjustment; "
            "give its folder twice"
        )
    return (before, after), warnings
