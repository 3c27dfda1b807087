"""Surface models in files, read window by window."""

import dataclasses
from pathlib import Path

import numpy as np

from jaxbundle.errors import InputError
from jaxbundle.surfaces.dsm import OWN_SIGMA
from jaxbundle.surfaces.height_cells import Grid, HeightGrid, place_of
from jaxbundle.system.rasters import check_georeference, open_raster, read_values


@dataclasses.dataclass(frozen=True)
class RasterCells:
    """A band of a raster, north up, as the heights of square cells; `sigma`: of these, of the same
    cells, and `more_sigma`, of every cell; `first`: row and column of its first cell in the file;
    `without_orientation`: of a file of σ: the band says that it is without the errors of the
    orientations.
    """

    path: Path
    shape: tuple[int, int]
    x: float
    y: float
    size: float
    system: str | None
    band: int = 1
    first: tuple[int, int] = (0, 0)
    sigma: "RasterCells | None" = None
    more_sigma: float = 0.0
    without_orientation: bool = False

    @property
    def shared_errors(self) -> int:
        return 0

    @property
    def has_sigma(self) -> bool:
        """Whether there is a σ of its cells."""
        return self.sigma is not None or self.more_sigma > 0

    def window(self, rows: slice, columns: slice) -> HeightGrid:
        values = self.values(rows, columns)
        sigma = np.full(values.shape, np.nan)
        if self.sigma is not None:
            sigma = self.sigma.values(rows, columns)
        if self.more_sigma > 0:
            # Also of cells without σ of their own, which would else be unknown.
            sigma = np.hypot(np.nan_to_num(sigma), self.more_sigma)
        x, y = self.x + columns.start * self.size, self.y - rows.start * self.size
        return HeightGrid(values, sigma, x, y, self.size, self.system)

    def values(self, rows: slice, columns: slice) -> Grid:
        """The values of a part, NaN for none."""
        (top, left), band = self.first, self.band
        window = (top + rows.start, top + rows.stop), (left + columns.start, left + columns.stop)
        with open_raster(self.path) as source:
            values = read_values(self.path, source, band, window)
            # Whole numbers of decimetres are common: without scale and offset ten times as high.
            return source.scales[band - 1] * values + source.offsets[band - 1]

    def part(self, rows: slice, columns: slice) -> "RasterCells":
        return dataclasses.replace(
            self,
            shape=(rows.stop - rows.start, columns.stop - columns.start),
            x=self.x + columns.start * self.size,
            y=self.y - rows.start * self.size,
            first=(self.first[0] + rows.start, self.first[1] + columns.start),
            sigma=None if self.sigma is None else self.sigma.part(rows, columns),
        )

    def with_sigma(self, path: Path, without_orientation: bool) -> "RasterCells":
        """With the σ of a file; `without_orientation`: without the errors of the orientations, if
        it has them in a band of their own.

        **Raises:** `InputError` if the file does not have all cells.
        """
        sigma_cells = open_cells(path)
        if without_orientation:
            with open_raster(path) as source:
                names = list(source.descriptions)
            # The first band contains the errors that the columns of L carry: they would count twice
            if OWN_SIGMA in names:
                band = names.index(OWN_SIGMA) + 1
                sigma_cells = dataclasses.replace(sigma_cells, band=band, without_orientation=True)
        row, column = place_of(self, sigma_cells)
        is_inside = row >= 0 and column >= 0
        is_inside &= (
            row + self.shape[0] <= sigma_cells.shape[0]
            and column + self.shape[1] <= sigma_cells.shape[1]
        )
        if not is_inside:
            raise InputError(f"{path}: does not have the cells of {self.path}")
        sigma_part = sigma_cells.part(
            slice(row, row + self.shape[0]), slice(column, column + self.shape[1])
        )
        return dataclasses.replace(self, sigma=sigma_part)


def open_cells(path: str | Path) -> RasterCells:
    """The first band of a raster, without σ; nothing but its head is read.

    **Raises:** `InputError` if it cannot be read, is rotated, or has cells in degrees."""
    path = Path(path)
    with open_raster(path) as source:
        check_georeference(path, source)
        place, crs = source.transform, source.crs
        shape = source.height, source.width
    if place.b or place.d:
        raise InputError(
            f"{path}: the raster is rotated; expected rows along X, columns along Y (gdalwarp)"
        )
    # 1e-6: over 10 000 cells a hundredth of a cell, which `place_of` allows
    if place.a <= 0 or abs(place.a + place.e) > 1e-6 * place.a:
        raise InputError(
            f"{path}: expected square cells, north up, got {place.a:g} × {place.e:g}: "
            "make them with gdalwarp -tr"
        )
    if crs is not None and crs.is_geographic:
        raise InputError(
            f"{path}: cells in degrees have no volume; give a model in a projected system "
            "(gdalwarp -t_srs)"
        )
    system = None if crs is None else crs.to_wkt()
    return RasterCells(path, shape, place.c, place.f, place.a, system)
