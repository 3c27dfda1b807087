"""Inputs of the functions of line scanners: scanner files, surfaces, positions, ground points."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import Ellipsoid, earth_fixed
from jaxbundle.io.rasters.extent import image_extent, pole_in_image, rpc_extent
from jaxbundle.io.rasters.geoid import add_geoid
from jaxbundle.io.rasters.terrain_models import read_terrain
from jaxbundle.io.scanner.read import EXPECTED_PRODUCTS, PRODUCTS, read_scanner
from jaxbundle.io.scanner.rpc_images import RpcInput, has_rpc_only, read_rpc_image
from jaxbundle.io.scanner.scanner import ScannerInput
from jaxbundle.io.text.csv_tables import read_csv
from jaxbundle.network.columns import Columns, did_you_mean
from jaxbundle.network.tables import Source
from jaxbundle.pushbroom.image import PushbroomImage
from jaxbundle.pushbroom.rpc.image import RpcImage, heights_of
from jaxbundle.pushbroom.rpc.polynomials import Rpc
from jaxbundle.pushbroom.surfaces import Ground, GroundSurface, Height, Plane
from jaxbundle.pushbroom.terrain import Terrain

# Called with a warning, a line of text.
Message = Callable[[str], object]
OFF_IMAGE = "off the image"
CARTESIAN, GEOGRAPHIC = ("X", "Y", "Z"), ("longitude", "latitude", "height")
LOCATED_COLUMNS = ("id", *CARTESIAN, *GEOGRAPHIC, "count", "status")
# Further columns of the tables of `locate` and `project`, which are accepted as input.
PROJECTED_COLUMNS = ("id", "line", "pixel", "count", "status")


def ignore(_: str) -> None:
    """Discard a warning."""


def surface_of(
    earth: Ellipsoid | None,
    height: float | None,
    dem: str | Path | None,
    image: PushbroomImage | RpcImage | Rpc | None = None,
    geoid: str | Path | None = None,
) -> GroundSurface:
    """The surface selected by the options; default: the ellipsoid (or Z = 0).

    Only the visible part of a terrain model is read.
    """
    if geoid is not None and dem is None:
        raise InputError("--geoid: needs a terrain model; give --dem")
    if height is not None and not np.isfinite(height):
        raise InputError(f"--height {height}: expected a finite number, in metres")
    if dem is not None:
        if height is not None:
            raise InputError("--height and --dem: give one of them")
        check_spheroid(earth)
        extent = None
        if isinstance(image, Rpc | RpcImage):
            extent = rpc_extent(image if isinstance(image, Rpc) else image.rpc)
        elif image is not None and earth is not None:
            extent = image_extent(image, earth)
            pole = pole_in_image(image, earth) if extent is None else None
            if pole is not None:
                raise InputError(
                    f"{dem}: the image shows the {pole}, where the cells of a terrain model in "
                    "longitude and latitude, to which every model is resampled, fall apart; give "
                    "--height instead, or cut the image there"
                )
        terrain = read_terrain(dem, earth, extent, above_geoid=geoid is not None)
        return terrain if geoid is None else add_geoid(terrain, Path(geoid))
    if earth is None:
        return Plane(level=height or 0.0)
    if height is None:
        return Ground(earth)
    check_spheroid(earth)
    return Height(level=height, earth=earth)


def open_scanner(path: str | Path, tell: Message = ignore) -> ScannerInput:
    """A scanner file; `tell` receives its warnings.

    **Raises:** `InputError`."""
    path = Path(path)
    if path.is_file() and has_rpc_only(path):
        raise InputError(
            f"{path}: has rational polynomials (RPC) only, which info, locate, project, correct, "
            f"surface and rpc take; here a rigorous model is needed: a scanner file, or "
            f"{EXPECTED_PRODUCTS}"
        )
    file = read_scanner(path)
    for warning in file.warnings:
        tell(warning)
    return file


def open_image(
    path: str | Path, tell: Message = ignore, raster: str | Path | None = None
) -> ScannerInput | RpcInput:
    """A scanner file, or an image with rational polynomials; `tell` receives its warnings.

    **Arguments:** `raster`: of the image, where the coefficients do not have it beside them.

    **Raises:** `InputError`."""
    path = Path(path)
    if path.is_file() and has_rpc_only(path):
        rpc_input = read_rpc_image(path, None if raster is None else Path(raster))
        for warning in rpc_input.warnings:
            tell(warning)
        return rpc_input
    if path.exists() and path.suffix.lower() not in (".toml", *PRODUCTS):
        raise InputError(
            f"{path}: expected a scanner file (.toml), {EXPECTED_PRODUCTS}; or an image with RPC: "
            "its raster, or _RPC.TXT, .RPB, .geom, RPC_….XML"
        )
    return open_scanner(path, tell)


def surface_under(
    file: ScannerInput | RpcInput,
    height: float | None,
    dem: str | Path | None,
    geoid: str | Path | None,
    tell: Message,
) -> GroundSurface:
    """`surface_of` for an image: without height and terrain the ellipsoid, or, where its
    polynomials or those of its product do not hold there, the middle of their heights; `tell`
    receives that, and a surface for which polynomials do not hold."""
    image, is_rational = file.image, isinstance(file, RpcInput)
    heights = heights_of(file.image.rpc) if isinstance(file, RpcInput) else file.rpc_heights
    if heights is None:
        return surface_of(file.earth, height, dem, image, geoid)
    low, high = heights
    domain = f"the RPC holds for heights from {low:.10g} to {high:.10g} m"
    if height is None and dem is None and not low <= 0 <= high:
        height = (low + high) / 2
        tell(f"{domain}, not for 0: the ground is taken at {height:.6g} m; give --height or --dem")
    surface = surface_of(file.earth, height, dem, image, geoid)
    ground_heights = [height or 0.0]
    if isinstance(surface, Terrain):
        ground_heights = [float(surface.lowest), float(surface.highest)]
    if is_rational and (min(ground_heights) < low or max(ground_heights) > high):
        words = " to ".join(f"{h:.6g}" for h in ground_heights)
        tell(f"{domain}; the ground is at {words} m, where it is extrapolated")
    return surface


def check_spheroid(earth: Ellipsoid | None) -> None:
    """Refuse heights above a triaxial ellipsoid."""
    if earth is not None and earth.a != earth.b:
        raise InputError(
            "heights, longitude and latitude need an ellipsoid of revolution; make the first two "
            "axes of [scanner] earth equal"
        )


def geographic(table: Columns) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Columns longitude, latitude (degrees), height as radians and metres.

    **Raises:** `InputError` with the row of an angle out of range.
    """
    names = "longitude", "latitude", "height"
    longitude, latitude, height = (table.numbers(name, required=True) for name in names)
    for name, values, limit in ((names[0], longitude, 360), (names[1], latitude, 90)):
        if (beyond := ~(np.abs(values) <= limit)).any():
            row = int(beyond.argmax())
            raise InputError(
                f"{table.source(row)}: {name} {values[row]:g} is beyond {limit}°; expected "
                "degrees: check their unit and the order of columns"
            )
    return np.radians(longitude), np.radians(latitude), height


def places(
    image: PushbroomImage | RpcImage, points: str | Path | None, grid: tuple[int, int]
) -> tuple[Sequence[str], np.ndarray, np.ndarray, Source]:
    """Ids, lines, pixels and their source: a table, or a grid over the image.

    **Raises:** `InputError`.
    """
    if points is None:
        rows, columns = grid
        lines = np.repeat(np.linspace(0, image.lines - 1, rows), columns)
        pixels = np.tile(np.linspace(0, image.pixels - 1, columns), rows)
        return (), lines, pixels, Source("grid", None, "place")
    table = read_csv(Path(points))
    table.check_names(("line", "pixel"), LOCATED_COLUMNS)
    line, pixel = (table.numbers(name, required=True) for name in ("line", "pixel"))
    ids = table.ids("id") if "id" in table.values else ()
    return ids, line, pixel, table.source


def off_image(
    image: PushbroomImage | RpcImage,
    line: np.ndarray,
    pixel: np.ndarray,
    source: Source,
    tell: Message,
) -> np.ndarray:
    """Which positions are outside the image; reported, and refused if all are. None, where only the
    domain of its coefficients is known.

    **Raises:** `InputError`.
    """
    is_off = np.zeros(len(line), bool)
    if isinstance(image, RpcImage) and not image.sized:
        return is_off
    message = None
    for name, values, size in (("line", line, image.lines), ("pixel", pixel, image.pixels)):
        is_outside = ~((values >= -0.5) & (values <= size - 0.5))
        if is_outside.any() and message is None:
            row = int(is_outside.argmax())
            message = (
                f"{source(row)}: {name} {values[row]:g} is {OFF_IMAGE}, which has {size}; "
                f"expected -0.5 to {size - 0.5:g}"
            )
        is_off |= is_outside
    if message is not None:
        message += f" ({is_off.sum()} of {len(is_off)} points)"
        if is_off.all():
            raise InputError(message)
        tell(message)
    return is_off


def with_points(table: Columns, tell: Message) -> Columns:
    """The rows that have a point: `locate` leaves the others empty, with a status."""
    if "status" not in table.values:
        return table
    coordinates = [name for name in (*CARTESIAN, *GEOGRAPHIC) if name in table.values]
    empty = np.all([np.isnan(table.numbers(name)) for name in coordinates], axis=0)
    if not np.any(empty):
        return table
    tell(f"{table.source(int(empty.argmax()))}: no point ({empty.sum()} rows are skipped)")
    rows = np.flatnonzero(~empty).tolist()
    values = {name: [column[row] for row in rows] for name, column in table.values.items()}
    return Columns(values, table.source.take(rows))


def points_of(table: Columns, earth: Ellipsoid | None) -> np.ndarray:
    """Points of a table, Earth-fixed or local; X, Y, Z have priority.

    **Raises:** `InputError`.
    """
    cartesian = "X" in table.values
    if not cartesian and not any(name in table.values for name in GEOGRAPHIC[:2]):
        expected = (*CARTESIAN, *GEOGRAPHIC)
        odd = next((name for name in table.values if name not in PROJECTED_COLUMNS), "")
        raise InputError(
            f"{table.source.name}: no columns {', '.join(CARTESIAN)} nor {', '.join(GEOGRAPHIC)}"
            f"{did_you_mean(odd, expected, listing=False)}"
        )
    if cartesian:
        table.check_names(CARTESIAN, (*GEOGRAPHIC, *PROJECTED_COLUMNS))
        return np.stack([table.numbers(n, required=True) for n in CARTESIAN])
    if earth is None:
        raise InputError(f"{table.source.name}: a local frame has no longitudes; give X, Y, Z")
    check_spheroid(earth)
    table.check_names(GEOGRAPHIC, PROJECTED_COLUMNS)
    return np.array(earth_fixed(earth, geographic(table)))
