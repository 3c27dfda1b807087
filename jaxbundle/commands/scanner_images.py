"""`simulate` and `refine` of line scanners: from files to files."""

import dataclasses
from pathlib import Path
from typing import cast

import jax.numpy as jnp
import numpy as np

from jaxbundle.arguments import one_of
from jaxbundle.choices import RESAMPLINGS, Resampling
from jaxbundle.commands.scanner_inputs import (
    surface_of,
)
from jaxbundle.io.rasters.scenes import read_scene, write_scene_image
from jaxbundle.io.scanner.flight import read_flight
from jaxbundle.io.scanner.refinement import RefineFile, read_refinement
from jaxbundle.io.scanner.writing import names_of, write_scanner_image
from jaxbundle.io.writing.fingerprints import files_read
from jaxbundle.io.writing.folders import check_folder, replace_folder
from jaxbundle.pushbroom.flight import measured_image, true_image
from jaxbundle.refinement import Refinement
from jaxbundle.refinement import refine as refine_images
from jaxbundle.types import Progress

# The command that an output folder belongs to, and the names in it.
SIMULATE, NAME, IMAGE, TRUTH = "pushbroom simulate", "scanner", "image.tif", "truth"


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
    flight_file, folder = read_flight(Path(flight)), Path(out)
    names = [IMAGE, *(f"{place}{n}" for place in ("", f"{TRUTH}/") for n in names_of(NAME, ""))]
    inputs = [path for path in (scene, dem, geoid) if path is not None]
    check_folder(folder, SIMULATE, names, [*files_read(Path(flight)), *inputs], force)
    truth, measured = true_image(flight_file.flight), measured_image(flight_file.flight)
    surface = surface_of(flight_file.earth, height, dem, truth, geoid)
    picture = None if scene is None else read_scene(Path(scene), flight_file.earth)
    unit = flight_file.file.section("scanner").text("angle_unit", "deg")
    write = lambda folder, image: write_scanner_image(
        folder, NAME, image, flight_file.earth, prefix="", angle_unit=unit
    )
    with replace_folder(folder, SIMULATE, names, force) as new:
        path = write(new, measured)
        write(new / TRUTH, truth)
        if picture is not None:
            write_scene_image(
                new / IMAGE,
                truth,
                surface,
                jnp.asarray(picture.bands),
                picture.place,
                np.dtype(picture.dtype),
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
