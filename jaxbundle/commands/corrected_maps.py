"""`correct` of line scanners: from an image to maps."""

import dataclasses
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np

import jaxbundle
from jaxbundle.arguments import one_of
from jaxbundle.choices import COMPRESSIONS, MAP_ERRORS, RESAMPLINGS, Compression, Resampling
from jaxbundle.commands.scanner_inputs import (
    Message,
    ignore,
    open_image,
    open_scanner,
    surface_under,
)
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError
from jaxbundle.io.rasters.checkpoints import keep_blocks
from jaxbundle.io.rasters.correction import Correction, map_of, write_corrected
from jaxbundle.io.rasters.error_maps import write_error_map, write_sigma_map
from jaxbundle.io.rasters.map_blocks import MapFormat
from jaxbundle.io.rasters.maps import MapGrid, MapSystem, describe_distance
from jaxbundle.io.rasters.mosaics import tiles_in
from jaxbundle.io.scanner.rpc import read_stated_errors
from jaxbundle.io.scanner.rpc_images import IMAGES, RpcInput, find_coefficients
from jaxbundle.io.scanner.scanner import ScannerInput
from jaxbundle.io.writing.fingerprints import files_read, of_words
from jaxbundle.io.writing.folders import keep_inputs
from jaxbundle.io.writing.replacing import remove_left_behind
from jaxbundle.network.columns import did_you_mean
from jaxbundle.pushbroom.ground_to_image import make_search
from jaxbundle.pushbroom.image import PushbroomImage
from jaxbundle.pushbroom.map_accuracy import MapErrors, covariance_lattice
from jaxbundle.pushbroom.noise import Noise
from jaxbundle.pushbroom.rectification import TOLERANCE
from jaxbundle.pushbroom.rpc.image import RpcImage
from jaxbundle.pushbroom.surfaces import GroundSurface
from jaxbundle.pushbroom.terrain import Terrain
from jaxbundle.types import Progress


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class CorrectedImage:
    """A corrected image: its file, its size in pixels and the `spacing` of these in the unit of the
    map, what its `heights` are; the file of the map errors and their `rms` (metres), if a truth was
    given; the file of the planimetric σ and the `rms_sigma` (metres)."""

    path: Path
    rows: int
    columns: int
    spacing: float
    heights: str = ""
    error_map: Path | None = None
    rms: float | None = None
    sigma: Path | None = None
    rms_sigma: float | None = None

    def __str__(self) -> str:
        lines = [f"{self.path}: {self.rows} × {self.columns} pixels of {self.spacing:g}"]
        if self.heights:
            lines.append(f"heights: {self.heights}")
        if self.sigma is not None:
            lines.append(f"{self.sigma}: planimetric σ, RMS {self.rms_sigma:.6g} m")
        if self.rms is not None:
            lines.append(f"{self.error_map}: RMS {self.rms:.6g} m")
        return "\n".join(lines)


def correct(  # noqa: PLR0913 (public: the options of the command, all but three by name)
    scanner: str | Path,
    image: str | Path | None,
    out: str | Path,
    *,
    crs: str | None = None,
    spacing: float | None = None,
    height: float | None = None,
    dem: str | Path | None = None,
    geoid: str | Path | None = None,
    resampling: str = "bilinear",
    occlusion: bool = False,
    tolerance: float = TOLERANCE,
    nodata: float | None = None,
    compress: str | None = None,
    overviews: bool = False,
    cog: bool = False,
    checkpoint: str | Path | None = None,
    sigma: str | Path | None = None,
    errors: Mapping[str, float] | None = None,
    truth: str | Path | None = None,
    error_map: str | Path | None = None,
    progress: Progress = lambda *_: None,
    tell: Message = ignore,
) -> CorrectedImage:
    """Correct an image to a map, in blocks.

    **Arguments:**

    - `scanner`: scanner file, product file, or coefficients (RPC); `image`: a raster of all its
      lines and pixels; or `scanner`: a raster with RPC, `image`: None; `out`: GeoTIFF to write.
    - `crs`: EPSG:… of the map, default longitude and latitude; `spacing`: pixel size in its unit,
      default that of the image.
    - `height`, `dem` (a raster, a VRT, or a folder of tiles), `geoid`: as of `locate`; `occlusion`:
      no data where terrain hides the ground.
    - `resampling`: `"nearest"`, `"bilinear"`, `"cubic"` or `"lanczos"`; `tolerance` of interpolated
      image positions, pixels; 0: every pixel of the map is projected.
    - `nodata`: its value in the map, default that of the image, else 0 or NaN; `compress`:
      `"none"`, `"deflate"`, `"lzw"` or `"zstd"`, default none, deflate of a COG; `overviews`;
      `cog`: a Cloud Optimized GeoTIFF, with overviews.
    - `checkpoint`: file of finished blocks, from which an interrupted run resumes; removed at the
      end.
    - `sigma`: GeoTIFF of the planimetric σ of every map pixel, from `errors`, σ by name:
      `attitude_…` and `position_…` of `accuracy` (degrees, metres), `image` (pixels), `height` of
      the terrain and `ground` for each horizontal axis (metres); of RPC `ground` is what its file
      states.
    - `truth`: scanner file of the truth, and `error_map`: GeoTIFF of the map errors east, north,
      length.
    - `progress(stage, done, total)`; `tell`: called with every warning.

    **Raises:** `InputError`.
    """
    one_of("resampling", resampling, RESAMPLINGS)
    compress = compress or ("deflate" if cog else "none")
    one_of("compress", compress, COMPRESSIONS)
    if spacing is not None and not spacing > 0:
        raise InputError(f"--spacing {spacing:g}: expected a positive number")
    # A pixel: more is a map of other ground.
    if not 0 <= tolerance <= 1:
        raise InputError(f"--tolerance {tolerance:g}: expected 0 to 1 pixel of the image")
    if (truth is None) != (error_map is None):
        raise InputError("--truth and --error-map: give both, or none")
    if errors and sigma is None:
        raise InputError("--error: these are σ for --sigma; give its file")
    picture = _raster_of(scanner, image)
    targets = {"--out": out, "--error-map": error_map, "--sigma": sigma, "--checkpoint": checkpoint}
    _check_targets(
        {key: Path(path) for key, path in targets.items() if path is not None},
        picture,
        _input_files(scanner, dem, geoid, truth),
    )
    # An ellipsoid hides nothing of itself where an image looks down.
    if occlusion and dem is None:
        raise InputError("--occlusion: needs terrain; give --dem")
    file = open_image(scanner, tell, picture)
    map_errors = None if sigma is None else _errors_of(errors or {}, file, Path(scanner))
    surface = surface_under(file, height, dem, geoid, tell)
    system = MapSystem(file.earth, crs)
    terrain = None if dem is None else Path(dem)
    grid = map_of(file.image, surface, system, spacing, terrain, tell=tell)
    if crs is not None and (place := system.degrees_of(grid)):
        if warning := describe_distance(crs, *place):
            tell(warning)
    search = None if isinstance(file.image, RpcImage) else make_search(file.image, file.earth)
    true = None if truth is None else _open_truth(Path(truth), file, tell)
    correction = Correction(cast(Resampling, resampling), occlusion, tolerance, nodata)
    format = MapFormat(cast(Compression, compress), overviews, cog, resampling == "nearest")
    fingerprint = (
        "" if checkpoint is None else _fingerprint(scanner, picture, dem, geoid, grid, crs)
    )
    stage = lambda name: lambda _, done, total: progress(name, done, total)
    with keep_blocks(
        None if checkpoint is None else Path(checkpoint),
        of_words([fingerprint, repr(correction), repr(height)]),
    ) as resumed:
        if resumed is not None:
            # No other process makes this map: the checkpoint is locked.
            remove_left_behind(out)
        write_corrected(
            picture,
            out,
            file.image,
            search,
            surface,
            system,
            grid,
            correction,
            stage("blocks"),
            (format, resumed),
        )
    result = CorrectedImage(
        Path(out), grid.rows, grid.columns, grid.size, _describe_heights(surface, dem, geoid)
    )
    if sigma is not None and map_errors is not None:
        rms = _write_sigma(sigma, file, (surface, map_errors), system, grid, search, stage("σ"))
        result = dataclasses.replace(result, sigma=Path(sigma), rms_sigma=rms)
    if true is not None and error_map is not None:
        rms = write_error_map(
            error_map,
            file.image,
            search,
            true,
            make_search(true, file.earth),
            surface,
            system,
            grid,
            stage("errors"),
        )
        result = dataclasses.replace(result, error_map=Path(error_map), rms=rms)
    return result


def _write_sigma(
    path: str | Path,
    file: ScannerInput | RpcInput,
    errors_on_surface: tuple[GroundSurface, MapErrors],
    system: MapSystem,
    grid: MapGrid,
    search: Any,
    progress: Progress,
) -> float:
    """Write the σ of a map; returns their RMS."""
    surface, errors = errors_on_surface
    level = float(np.asarray(getattr(surface, "level", 0.0)))
    heights = (level, level)
    if isinstance(surface, Terrain):
        heights = float(surface.lowest), float(surface.highest)
    lattice = covariance_lattice(file.image, file.earth, heights, errors)
    return write_sigma_map(path, file.image, search, lattice, surface, system, grid, progress)


def _errors_of(
    errors: Mapping[str, float], file: ScannerInput | RpcInput, scanner: Path
) -> MapErrors:
    """The σ of `errors`, in radians and metres; of RPC what its file states."""
    for name, value in errors.items():
        if name not in MAP_ERRORS:
            raise InputError(f"--error {name}: unknown{did_you_mean(name, MAP_ERRORS)}")
        if not (np.isfinite(value) and value >= 0):
            raise InputError(f"--error {name}={value:g}: expected a number from 0 on")
    noise = {name: value for name, value in errors.items() if name in Noise._fields}
    systematic = {name: value for name, value in errors.items() if name not in noise}
    if isinstance(file.image, RpcImage):
        if noise:
            raise InputError(
                f"--error {next(iter(noise))}: {scanner} has rational polynomials only; give "
                "ground (metres) or image (pixels)"
            )
        if not {"ground", "image"} & set(systematic):
            stated_errors = read_stated_errors(find_coefficients(scanner))
            if not stated_errors.bias and not stated_errors.random:
                raise InputError(
                    f"--sigma: {scanner} states no error of its coefficients (ERR_BIAS, ERR_RAND); "
                    "give --error ground=METRES, for each horizontal axis"
                )
            systematic["ground"] = float(np.hypot(stated_errors.bias, stated_errors.random))
    elif not errors:
        raise InputError(f"--sigma: give the σ, such as --error {MAP_ERRORS[0]}=0.001")
    scale = lambda name: np.pi / 180 if name.startswith("attitude") else 1.0
    return MapErrors(Noise(**{n: v * scale(n) for n, v in noise.items()}), **systematic)


def _describe_heights(
    surface: GroundSurface, dem: str | Path | None, geoid: str | Path | None
) -> str:
    """What the heights of a map are."""
    if dem is None:
        return ""
    datum = "the plane Z = 0" if surface.earth is None else "the ellipsoid"
    return f"{dem} above {datum if geoid is None else f'the geoid {geoid}'}"


def _fingerprint(
    scanner: str | Path,
    picture: Path,
    dem: str | Path | None,
    geoid: str | Path | None,
    grid: MapGrid,
    crs: str | None,
) -> str:
    """What the blocks of a map depend on, by names, sizes and times of the files: reading an image
    of gigabytes again takes as long as correcting a part of it."""
    words = [repr(grid), str(crs), str(geoid), jaxbundle.__version__]
    for path in [picture, *_input_files(scanner, dem, geoid)]:
        state = os.stat(path)
        words.append(f"{os.path.realpath(path)} {state.st_size} {state.st_mtime_ns}")
    return of_words(words)


def _input_files(scanner: str | Path, *sources: str | Path | None) -> list[Path]:
    """The files of the scanner, and of sources, tiles of folders among them."""
    files = files_read(scanner)
    if Path(scanner).suffix.lower() in IMAGES:
        files.append(find_coefficients(Path(scanner)))
    for source in sources:
        if source is not None and os.path.exists(source):
            path = Path(source)
            files += tiles_in(path) if path.is_dir() else [path]
    return files


def _raster_of(scanner: str | Path, image: str | Path | None) -> Path:
    """The raster; without one it is the scanner file itself, if that is a raster with RPC."""
    if image is not None:
        return Path(image)
    if Path(scanner).suffix.lower() not in IMAGES:
        raise InputError(f"{scanner}: give the image as well: a raster of all lines and pixels")
    return Path(scanner)


def _check_targets(targets: Mapping[str, Path], image: Path, inputs: Sequence[Path]) -> None:
    """Refuse outputs that cannot be written, or would replace an input, before computing."""
    option_of: dict[Path, str] = {}
    for option, path in targets.items():
        if not path.absolute().parent.is_dir():
            raise InputError(f"{option} {path}: there is no folder {path.parent}")
        if path.is_dir():
            raise InputError(
                f"{option} {path} is a folder; name a file in it, such as {path / 'map.tif'}"
            )
        if path.exists() and path.samefile(image):
            raise InputError(f"{option} {path} is the image itself; give another name")
        keep_inputs(f"{option} {path}", path, inputs)
        earlier_option = option_of.setdefault(Path(os.path.realpath(path)), option)
        if earlier_option != option:
            raise InputError(f"{option} {path} is also {earlier_option}; give another name")


def _open_truth(path: Path, file: ScannerInput | RpcInput, tell: Message) -> PushbroomImage:
    """The true image, which must match the scanner file."""
    truth = open_scanner(path, tell)
    if truth.earth != file.earth:
        raise InputError(f"--truth {path}: its earth is not that of the scanner file")
    size, image_size = ((i.lines, i.pixels) for i in (truth.image, file.image))
    if size != image_size:
        raise InputError(
            f"--truth {path}: {size[0]} lines of {size[1]} pixels, the scanner file has "
            f"{image_size[0]} of {image_size[1]}"
        )
    return truth.image
