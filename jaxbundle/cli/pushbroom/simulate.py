"""`jaxbundle pushbroom simulate`: a flight, its ancillary files, and the image it takes."""

from pathlib import Path
from typing import Annotated

import jax.numpy as jnp
import numpy as np
import typer

import jaxbundle
from jaxbundle.cli.app import Quiet
from jaxbundle.cli.progress import counting
from jaxbundle.cli.pushbroom.app import (
    Dem,
    Geoid,
    Level,
    check_resampling,
    pushbroom,
    surface_of,
)
from jaxbundle.io.flight import read_flight
from jaxbundle.io.scanner_writing import write_scanner_image
from jaxbundle.io.scenes import read_scene, write_taken
from jaxbundle.pushbroom.simulate import measured_image, true_image


@pushbroom.command()
def simulate(
    flight: Annotated[Path, typer.Argument(help="flight file, .toml (docs/pushbroom.md)")],
    out: Annotated[Path, typer.Option(help="folder for scanner.toml, tables, truth/, image.tif")],
    scene: Annotated[Path | None, typer.Option(help="raster with map coordinates to see")] = None,
    height: Level = None,
    dem: Dem = None,
    geoid: Geoid = None,
    resampling: Annotated[str, typer.Option(help="nearest, bilinear, cubic")] = "cubic",
    quiet: Quiet = False,
) -> None:
    """Simulate a flight: what its instruments tell, the truth, and the image of a scene."""
    jaxbundle.enable_x64()
    check_resampling(resampling)
    given = read_flight(flight)
    truth, measured = true_image(given.flight), measured_image(given.flight)
    surface = surface_of(given.earth, height, dem, truth, geoid)
    shown = None if scene is None else read_scene(scene, given.earth)
    unit = given.file.section("scanner").text("angle_unit", "deg")
    write = lambda folder, image: write_scanner_image(
        folder, "scanner", image, given.earth, prefix="", angle_unit=unit
    )
    path = write(out, measured)
    write(out / "truth", truth)
    if shown is not None:
        with counting(quiet) as bar:
            task = bar.add_task("lines", total=None)
            write_taken(
                out / "image.tif", truth, surface, jnp.asarray(shown.bands), shown.place,
                np.dtype(shown.dtype), resampling,
                lambda done, total: bar.update(task, completed=done, total=total),
            )  # fmt: skip
    if not quiet:
        print(path)
