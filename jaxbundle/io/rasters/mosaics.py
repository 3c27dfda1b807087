"""A folder of terrain tiles as one raster: a virtual raster (VRT) of GDAL over all of them.

Tiles have one coordinate system and pixel size and lie on one lattice, to a hundredth of a pixel.
Where two overlap, the later one in the order of their names is on top; without a tile there is no
height.
"""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING
from xml.sax.saxutils import escape

from jaxbundle.errors import InputError
from jaxbundle.system.rasters import check_georeference, open_raster
from jaxbundle.system.temporaries import temporary

if TYPE_CHECKING:
    from rasterio.io import DatasetReader

TILES = (".tif", ".tiff", ".hgt", ".dt0", ".dt1", ".dt2", ".img", ".asc", ".bil", ".vrt")


def tiles_in(folder: Path) -> list[Path]:
    """The terrain tiles in a folder, in the order of their names."""
    return sorted(file for file in folder.iterdir() if file.suffix.lower() in TILES)


@contextmanager
def as_one_raster(path: str | Path) -> Iterator[Path]:
    """The raster itself, or a virtual one of all tiles in a folder.

    **Raises:** `InputError` if the folder has no tiles, or they do not make one raster.
    """
    path = Path(path)
    if not path.is_dir():
        yield path
        return
    tiles = tiles_in(path)
    if not tiles:
        raise InputError(f"{path}: no terrain tiles in this folder: {', '.join(TILES)}")
    text = _virtual_raster(tiles)
    with temporary(tempfile.mkdtemp(prefix="jaxbundle-")) as folder:
        file = folder / "tiles.vrt"
        file.write_text(text, encoding="utf-8")
        yield file


def _virtual_raster(tiles: list[Path]) -> str:
    """The XML of the virtual raster."""
    parts, bounds = [], []
    first_tile, crs, step = tiles[0], None, (0.0, 0.0)
    for tile in tiles:
        with open_raster(tile) as source:
            check_georeference(tile, source)
            transform = source.transform
            if tile is first_tile:
                crs, step, origin = (
                    source.crs,
                    (transform.a, transform.e),
                    (transform.c, transform.f),
                )
            lattice_offset = [
                (o - q) / s for o, q, s in zip((transform.c, transform.f), origin, step)
            ]
            _check_lattice(tile, first_tile, source, (crs, step), lattice_offset)
            rows, columns = source.shape
            left, top = round(lattice_offset[0]), round(lattice_offset[1])
            bounds.append((left, top, left + columns, top + rows))
            nodata = "" if source.nodata is None else f"<NODATA>{source.nodata!r}</NODATA>"
            scale, offset = source.scales[0], source.offsets[0]
            parts.append(
                "<ComplexSource><SourceFilename relativeToVRT='0'>"
                f"{escape(str(tile.absolute()))}</SourceFilename><SourceBand>1</SourceBand>"
                f"<SrcRect xOff='0' yOff='0' xSize='{columns}' ySize='{rows}'/>{{}}"
                f"<ScaleOffset>{offset!r}</ScaleOffset><ScaleRatio>{scale!r}</ScaleRatio>"
                f"{nodata}</ComplexSource>"
            )
    lefts, tops, rights, bottoms = zip(*bounds)
    left, top = min(lefts), min(tops)
    placed = "".join(
        part.format(
            f"<DstRect xOff='{b[0] - left}' yOff='{b[1] - top}' xSize='{b[2] - b[0]}' "
            f"ySize='{b[3] - b[1]}'/>"
        )
        for part, b in zip(parts, bounds)
    )
    system = "" if crs is None else f"<SRS>{escape(crs.to_wkt())}</SRS>"
    corner = origin[0] + left * step[0], origin[1] + top * step[1]
    return (
        f"<VRTDataset rasterXSize='{max(rights) - left}' rasterYSize='{max(bottoms) - top}'>"
        f"{system}<GeoTransform>{corner[0]!r}, {step[0]!r}, 0, {corner[1]!r}, 0, {step[1]!r}"
        "</GeoTransform><VRTRasterBand dataType='Float64' band='1'>"
        f"<NoDataValue>nan</NoDataValue>{placed}</VRTRasterBand></VRTDataset>"
    )


def _check_lattice(
    tile: Path,
    first_tile: Path,
    source: "DatasetReader",
    lattice: tuple[object, tuple[float, float]],
    lattice_offset: list[float],
) -> None:
    """Refuse a tile that is not on the lattice of the first."""
    crs, step = lattice
    transform = source.transform
    remedy = "; make one raster of the tiles, such as with gdalwarp, and give that"
    if source.crs != crs:
        raise InputError(f"{tile}: its coordinate system is not that of {first_tile.name}{remedy}")
    # A hundredth of a pixel over the length of a tile.
    length = max(source.shape)
    deviation = max(abs(a / s - 1) * length for a, s in zip((transform.a, transform.e), step))
    if (
        transform.b
        or transform.d
        or deviation > 0.01
        or max(abs(v - round(v)) for v in lattice_offset) > 0.01
    ):
        raise InputError(
            f"{tile}: its pixels of {transform.a:g} × {abs(transform.e):g} are not on the lattice "
            f"of {first_tile.name}, {step[0]:g} × {abs(step[1]):g}{remedy}"
        )
