"""`jaxbundle pushbroom simulate`: simulate a flight, its ancillary files and its image."""

from pathlib import Path
from typing import Annotated, cast

import typer

from jaxbundle.choices import RESAMPLINGS, Resampling
from jaxbundle.cli.app import Force, Quiet, choice
from jaxbundle.cli.pushbroom.app import Dem, Geoid, Level, pushbroom

COMMAND, NAME, IMAGE, TRUTH = "pushbroom simulate", "scanner", "image.tif", "truth"


@pushbroom.command(example="examples/line_scanner/flight.toml --out out/flight")
def simulate(
    flight: Annotated[Path, typer.Argument(help="flight file, .toml (docs/pushbroom.md)")],
    out: Annotated[Path, typer.Option(help="folder for scanner.toml, tables, truth/, image.tif")],
    force: Force = False,
    scene: Annotated[Path | None, typer.Option(help="georeferenced raster to image")] = None,
    height: Level = None,
    dem: Dem = None,
    geoid: Geoid = None,
    resampling: Annotated[str, choice(RESAMPLINGS)] = "cubic",
    quiet: Quiet = False,
) -> None:
    """Simulate a flight: instrument records, the truth, and the image of a scene."""
    import jax.numpy as jnp
    import numpy as np

    from jaxbundle.cli.progress import counting
    from jaxbundle.cli.pushbroom.shared import surface_of
    from jaxbundle.io.rasters.scenes import read_scene, write_taken
    from jaxbundle.io.scanner.flight import read_flight
    from jaxbundle.io.scanner.writing import names_of, write_scanner_image
    from jaxbundle.io.writing.fingerprints import files_read
    from jaxbundle.io.writing.folders import check_folder, replace_folder
    from jaxbundle.pushbroom.simulate import measured_image, true_image

    kind = cast(Resampling, resampling)
    given = read_flight(flight)
    names = [IMAGE, *(f"{place}{n}" for place in ("", f"{TRUTH}/") for n in names_of(NAME, ""))]
    inputs = [path for path in (scene, dem, geoid) if path is not None]
    check_folder(out, COMMAND, names, [*files_read(flight), *inputs], force)
    truth, measured = true_image(given.flight), measured_image(given.flight)
    surface = surface_of(given.earth, height, dem, truth, geoid)
    shown = None if scene is None else read_scene(scene, given.earth)
    unit = given.file.section("scanner").text("angle_unit", "deg")
    write = lambda folder, image: write_scanner_image(
        folder, NAME, image, given.earth, prefix="", angle_unit=unit
    )
    with replace_folder(out, COMMAND, names, force) as new:
        path = write(new, measured)
        write(new / TRUTH, truth)
        if shown is not None:
            with counting(quiet) as bar:
                task = bar.add_task("lines", total=None)
                write_taken(
                    new / IMAGE,
                    truth,
                    surface,
                    jnp.asarray(shown.bands),
                    shown.place,
                    np.dtype(shown.dtype),
                    kind,
                    lambda _, done, total: bar.update(task, completed=done, total=total),
                )
    if not quiet:
        print(out / path.name)
