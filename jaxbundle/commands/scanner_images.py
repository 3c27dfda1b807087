"""`correct`, `simulate` and `refine` of line scanners: from files to files."""

import dataclasses
from pathlib import Path
from typing import cast

import jax.numpy as jnp
import numpy as np

from jaxbundle.arguments import one_of
from jaxbundle.choices import RESAMPLINGS, Resampling
from jaxbundle.commands.scanner_inputs import (
    Message,
    ignore,
    open_image,
    open_scanner,
    surface_of,
    surface_under,
)
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError
from jaxbundle.io.rasters.correction import Correction, map_of, write_corrected
from jaxbundle.io.rasters.error_maps import write_error_map
from jaxbundle.io.rasters.maps import MapSystem, describe_distance
from jaxbundle.io.rasters.scenes import read_scene, write_taken
from jaxbundle.io.scanner.flight import read_flight
from jaxbundle.io.scanner.refinement import RefineFile, read_refinement
from jaxbundle.io.scanner.rpc_images import IMAGES, RpcInput
from jaxbundle.io.scanner.scanner import ScannerInput
from jaxbundle.io.scanner.writing import names_of, write_scanner_image
from jaxbundle.io.writing.fingerprints import files_read
from jaxbundle.io.writing.folders import check_folder, replace_folder
from jaxbundle.pushbroom.flight import measured_image, true_image
from jaxbundle.pushbroom.ground_to_image import make_search
from jaxbundle.pushbroom.image import PushbroomImage
from jaxbundle.pushbroom.rpc.image import RpcImage
from jaxbundle.refinement import Refinement
from jaxbundle.refinement import refine as refine_images
from jaxbundle.types import Progress

# The command that an output folder belongs to, and the names in it.
SIMULATE, NAME, IMAGE, TRUTH = "pushbroom simulate", "scanner", "image.tif", "truth"


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class CorrectedImage:
    """A corrected image: its file, its size in pixels and the `spacing` of these in the unit of the
    map; the file of the map errors and their `rms` (metres), if a truth was given."""

    path: Path
    rows: int
    columns: int
    spacing: float
    error_map: Path | None = None
    rms: float | None = None

    def __str__(self) -> str:
        lines = [f"{self.path}: {self.rows} × {self.columns} pixels of {self.spacing:g}"]
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
    truth: str | Path | None = None,
    error_map: str | Path | None = None,
    progress: Progress = lambda *_: None,
    tell: Message = ignore,
) -> CorrectedImage:
    """Correct an image of a scanner file to a map, in blocks.

    **Arguments:**

    - `scanner`: scanner file, product file, or coefficients (RPC); `image`: a raster of all its
      lines and pixels; or `scanner`: a raster with RPC, `image`: None; `out`: GeoTIFF to write.
    - `crs`: EPSG:… of the map, default longitude and latitude; `spacing`: pixel size in its unit,
      default that of the image.
    - `height`, `dem`, `geoid`: as of `locate`; `occlusion`: no data where terrain hides the ground.
    - `resampling`: `"nearest"`, `"bilinear"` or `"cubic"`.
    - `truth`: scanner file of the truth, and `error_map`: GeoTIFF of the map errors east, north,
      length.
    - `progress(stage, done, total)`; `tell`: called with every warning.

    **Raises:** `InputError`.
    """
    one_of("resampling", resampling, RESAMPLINGS)
    if spacing is not None and not spacing > 0:
        raise InputError(f"--spacing {spacing:g}: a positive number is expected")
    if (truth is None) != (error_map is None):
        raise InputError("--truth and --error-map: give both, or none")
    picture, target = _raster_of(scanner, image), Path(out)
    errors = None if error_map is None else Path(error_map)
    _check_target("--out", target, picture)
    if errors is not None:
        _check_target("--error-map", errors, picture)
        if errors.absolute() == target.absolute():
            raise InputError(f"--error-map {errors} is also --out; give another name")
    # an ellipsoid hides nothing of itself where an image looks down
    if occlusion and dem is None:
        raise InputError("--occlusion: needs terrain; give --dem")
    file = open_image(scanner, tell, picture)
    surface = surface_under(file.image, file.earth, height, dem, geoid, tell)
    system = MapSystem(file.earth, crs)
    grid = map_of(file.image, surface, system, spacing, None if dem is None else Path(dem))
    if crs is not None and (place := system.degrees_of(grid)):
        if said := describe_distance(crs, *place):
            tell(said)
    taken = file.image
    search = None if isinstance(taken, RpcImage) else make_search(taken, file.earth)
    true = None if truth is None else _open_truth(Path(truth), file, tell)
    write_corrected(
        picture,
        target,
        file.image,
        search,
        surface,
        system,
        grid,
        Correction(cast(Resampling, resampling), occlusion),
        lambda _, done, total: progress("blocks", done, total),
    )
    rms = None
    if true is not None and errors is not None:
        rms = write_error_map(
            errors,
            file.image,
            search,
            true,
            make_search(true, file.earth),
            surface,
            system,
            grid,
            lambda _, done, total: progress("errors", done, total),
        )
    return CorrectedImage(target, grid.rows, grid.columns, grid.size, errors, rms)


def _raster_of(scanner: str | Path, image: str | Path | None) -> Path:
    """The raster; without one it is the scanner file itself, if that is a raster with RPC."""
    if image is not None:
        return Path(image)
    if Path(scanner).suffix.lower() not in IMAGES:
        raise InputError(f"{scanner}: give the image as well: a raster of all lines and pixels")
    return Path(scanner)


def _check_target(option: str, path: Path, image: Path) -> None:
    """Refuse output that cannot be written, before computing."""
    if not path.absolute().parent.is_dir():
        raise InputError(f"{option} {path}: there is no folder {path.parent}")
    if path.is_dir():
        raise InputError(
            f"{option} {path} is a folder; name a file in it, such as {path / 'map.tif'}"
        )
    if path.exists() and path.samefile(image):
        raise InputError(f"{option} {path} is the image itself; give another name")


def _open_truth(path: Path, file: ScannerInput | RpcInput, tell: Message) -> PushbroomImage:
    """The true image, which must match the scanner file."""
    truth = open_scanner(path, tell)
    if truth.earth != file.earth:
        raise InputError(f"--truth {path}: its earth is not that of the scanner file")
    size, own = ((i.lines, i.pixels) for i in (truth.image, file.image))
    if size != own:
        raise InputError(
            f"--truth {path}: {size[0]} lines of {size[1]} pixels, the scanner file has {own[0]} "
            f"of {own[1]}"
        )
    return truth.image


def simulate(
    flight: str | Path,
    out: str | Path,
    *,
    scene: str | Path | None = None,
    height: float | None = None,
    dem: str | Path | None = None,
    geoid: str | Path | None = None,
    resampling: str = "cubic",
    force: bool = False,
    progress: Progress = lambda *_: None,
) -> Path:
    """Simulate a flight: instrument records, the truth, and the image of a scene.

    **Arguments:**

    - `flight`: flight file; `out`: folder for scanner.toml, tables, truth/, image.tif, which is
      new, empty, or of an earlier call; `force`: replace foreign files in it.
    - `scene`: georeferenced raster to image; `height`, `dem`, `geoid`: as of `locate`;
      `resampling`: `"nearest"`, `"bilinear"` or `"cubic"`; `progress(stage, done, total)`.

    **Returns:** the scanner file.

    **Raises:** `InputError`.
    """
    one_of("resampling", resampling, RESAMPLINGS)
    given, folder = read_flight(Path(flight)), Path(out)
    names = [IMAGE, *(f"{place}{n}" for place in ("", f"{TRUTH}/") for n in names_of(NAME, ""))]
    inputs = [path for path in (scene, dem, geoid) if path is not None]
    check_folder(folder, SIMULATE, names, [*files_read(Path(flight)), *inputs], force)
    truth, measured = true_image(given.flight), measured_image(given.flight)
    surface = surface_of(given.earth, height, dem, truth, geoid)
    shown = None if scene is None else read_scene(Path(scene), given.earth)
    unit = given.file.section("scanner").text("angle_unit", "deg")
    write = lambda folder, image: write_scanner_image(
        folder, NAME, image, given.earth, prefix="", angle_unit=unit
    )
    with replace_folder(folder, SIMULATE, names, force) as new:
        path = write(new, measured)
        write(new / TRUTH, truth)
        if shown is not None:
            write_taken(
                new / IMAGE,
                truth,
                surface,
                jnp.asarray(shown.bands),
                shown.place,
                np.dtype(shown.dtype),
                cast(Resampling, resampling),
                lambda _, done, total: progress("lines", done, total),
            )
    return folder / path.name


def refine(input: str | Path | RefineFile) -> Refinement:
    """Refine scanner images with control and tie points: attitude, position and optics of rigorous
    ones, the bias of those with RPC. Of tables: `jaxbundle.refinement.refine`.

    **Arguments:** `input`: refine file (docs/pushbroom.md).

    **Raises:** `InputError`; `NotSolvedError` if the measurements do not determine the unknowns.
    """
    file = input if isinstance(input, RefineFile) else read_refinement(input)
    found = refine_images(
        file.images,
        file.points,
        file.observations,
        file.frames,
        terrain=file.terrain,
        snooping=file.snooping,
        significance=file.significance,
    )
    return dataclasses.replace(found, warnings=(*file.warnings, *found.warnings))
