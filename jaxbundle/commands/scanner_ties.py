"""`pushbroom tie`: tie points of the images of a refine file."""

from collections.abc import Callable
from pathlib import Path

from jaxbundle.errors import InputError
from jaxbundle.io.scanner.refinement import SECTIONS
from jaxbundle.io.scanner.refinement_images import read_images
from jaxbundle.io.scanner.rpc_images import find_raster
from jaxbundle.io.text.csv_tables import read_toml
from jaxbundle.io.text.sections import TomlFile
from jaxbundle.network.columns import refuse_unknown
from jaxbundle.network.units import ANGLE_UNITS
from jaxbundle.refinement import ScannerImage
from jaxbundle.surfaces.reconstruct import ground_bounds
from jaxbundle.surfaces.scanner_inputs import views_of_images
from jaxbundle.surfaces.tie_points import TiePoints, TiePointSettings, match_tie_points
from jaxbundle.types import Progress

DEFAULT = TiePointSettings()


def tie(
    input: str | Path,
    *,
    spacing: int = 200,
    zmin: float | None = None,
    zmax: float | None = None,
    settings: TiePointSettings = DEFAULT,
    progress: Progress | None = None,
    tell: Callable[[str], object] | None = None,
) -> TiePoints:
    """Tie points of scanner and RPC images, by matching along epipolar curves.

    **Arguments:**

    - `input`: refine file (docs/pushbroom.md), of which the images are used; each has its raster
      beside it.
    - `spacing` of the points, pixels.
    - `zmin`, `zmax`: lowest and highest height of the ground; default: the range of the
      coefficients.
    - `progress(stage, done, total)`; `tell`: called with every message.

    **Raises:** `InputError`; `NotSolvedError` if nothing matches.
    """
    path, say = Path(input), tell or (lambda _: None)
    if spacing < 1:
        raise InputError(f"--spacing {spacing}: expected pixels from 1 on")
    if (zmin is None) != (zmax is None) or (
        zmin is not None and zmax is not None and not zmin < zmax
    ):
        raise InputError("--zmin and --zmax: give both, the lower height first")
    document = read_toml(path)
    for name in document:
        refuse_unknown(name, SECTIONS, f"{path}: ", "section")
    file = TomlFile(path, document)
    file.require(("images",))
    unit = file.section("refine").text("angle_unit", "deg")
    # A unit that nobody knows is said by `refine`: it is of priors, which tie points do not need.
    images, warnings = read_images(file, ANGLE_UNITS.get(unit, 1.0))
    if len(images) < 2:
        raise InputError(f"{path}, [images]: one image; tie points need at least two")
    for warning in warnings:
        say(warning)
    rasters = []
    for image in images:
        source = file.section("images").path(image.id, "an image")
        raster = find_raster(source)
        if raster is None:
            raise InputError(f"{source}: no raster {source.stem}.tif beside it")
        rasters.append(raster)
    orientations = [
        (image.image, image.earth) if isinstance(image, ScannerImage) else image.image.rpc
        for image in images
    ]
    views = views_of_images([image.id for image in images], orientations, rasters)
    heights = None if zmin is None or zmax is None else (zmin, zmax)
    bounds, messages = ground_bounds(views, heights)
    for message in messages:
        say(message)
    return match_tie_points(views, bounds, spacing, settings, progress)
