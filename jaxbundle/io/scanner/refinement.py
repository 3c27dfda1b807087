"""The refine file: scanner images, ground points, measurements and unknowns of a refinement.

```toml
[refine]
points = "points.csv"               # id,role,X,Y,Z[,sX,sY,sZ], or
                                    # id,role,longitude,latitude,height[,sE,sN,sh]
observations = "observations.csv"   # image,point,line,pixel[,sline,spixel]; or a list of such
                                    # files, .match and .gcp of Ames Stereo Pipeline, control
                                    # networks (.pvl, .net) and residuals.csv of ISIS
tie_points = "ties.csv"             # the same columns, of tie points only, which need no row in
                                    # points (`pushbroom tie` writes it); or a list
frames = "photographs"              # a project of photographs that share points
dem = "terrain.tif"                 # a terrain model, whose heights are observations of tie points
dem_sigma = 5.0                     # of these, metres
geoid = "egm96.gtx"                 # as of the commands: for heights above the geoid
rpc_format = "text"                 # text | rpb, of the compensated coefficients in --out
csm_states = true                   # also write rigorous images as model states of usgscsm
sigma = 0.5                         # of line and pixel, where the table has none; default 1, a unit
angle_unit = "deg"                  # rad | deg | gon, of this file and of longitude, latitude
snooping = "pope"                   # none | baarda | pope
significance = 0.001

[images]                            # scanner files, or images with RPC, by the image's id
A = "a/scanner.toml"
B = "b/scanner.toml"
C = "c.tif"

[serial_numbers]                    # by which ISIS knows images, where not by their files
A = "MRO/CTX/0881034911:066"

[models]                            # rigorous | rpc, of products that have both
B = "rigorous"

[sensors]                           # images of one sensor share focal length, mounting, look angles
A = "imager"
B = "imager"

[unknowns]                          # "free", "held", a prior σ, or a list of three of these
attitude = "free"                   # bias of pitch, roll, yaw
attitude_rate = 0.001               # drift, a second
jitter = [0.002, 0.002, "held"]     # σ of the coefficients of the spline
knot_spacing = 0.25                 # seconds
position = [10.0, 10.0, 10.0]       # across, along the track, up; metres
position_rate = "held"              # metres a second
focal_length = 1e-4                 # relative
mounting = "held"
look_across = [0, 1e-6]             # σ of the coefficients of 1, û, û², … (tangents)
look_along = []
bias_degree = 1                     # of images with RPC: 0, 1 or 2
bias = [5.0, 0.5]                   # σ of its shift and of its other terms, pixels; "stated": by
                                    # the errors in the file

[unknowns.B]                        # of one image, in place of the above
attitude_rate = "held"
```
"""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from jaxbundle.arguments import show
from jaxbundle.errors import InputError
from jaxbundle.io.formats import read_network
from jaxbundle.io.rasters.extent import image_extent, joint_extent, rpc_extent
from jaxbundle.io.rasters.geoid import add_geoid
from jaxbundle.io.rasters.terrain_models import read_terrain
from jaxbundle.io.scanner.refinement_images import read_images
from jaxbundle.io.scanner.refinement_points import read_points
from jaxbundle.io.text.sections import TomlSection, read_sections
from jaxbundle.network.columns import did_you_mean
from jaxbundle.network.tables import Network, Observations
from jaxbundle.network.units import ANGLE_UNITS
from jaxbundle.refinement.refining import TESTS
from jaxbundle.refinement.tables import AnyScannerImage, GroundPoints, ScannerImage
from jaxbundle.refinement.terrain_heights import HeightModel

SECTIONS = {
    "refine": (
        "points",
        "observations",
        "tie_points",
        "frames",
        "dem",
        "dem_sigma",
        "geoid",
        "rpc_format",
        "csm_states",
        "sigma",
        "angle_unit",
        "snooping",
        "significance",
    ),
    "images": (),
    "models": (),
    "serial_numbers": (),
    "sensors": (),
    "unknowns": (),
}
REQUIRED_FIELDS = ("refine", "images")
# Of compensated coefficients, by rpc_format.
RPC_ENDINGS = {"text": "_RPC.TXT", "rpb": ".RPB"}


class RefineFile(NamedTuple):
    """The arguments of `jaxbundle.refinement.refine`; `rpc_ending`: of the names of files with
    compensated coefficients; `csm_states`: whether rigorous images are written as model states,
    too; `sources`: the given file of every image."""

    images: list[AnyScannerImage]
    points: GroundPoints
    observations: Observations
    frames: Network | None
    snooping: str
    significance: float
    warnings: tuple[str, ...] = ()
    terrain: HeightModel | None = None
    rpc_ending: str = RPC_ENDINGS["text"]
    csm_states: bool = False
    sources: Mapping[str, Path] = MappingProxyType({})


def read_refinement(path: str | Path) -> RefineFile:
    """The refinement of a file.

    **Raises:** `InputError` naming file, section and key, or table and line.
    """
    path = Path(path)
    file = read_sections(path, SECTIONS, REQUIRED_FIELDS)
    section = file.section("refine")
    unit = section.text("angle_unit", "deg")
    if unit not in ANGLE_UNITS:
        raise InputError(f"{section.where}angle_unit {unit!r}{did_you_mean(unit, ANGLE_UNITS)}")
    radians = ANGLE_UNITS[unit]
    images, warnings = read_images(file, radians)
    frames = None
    if "frames" in section:
        frames = read_network(section.path("frames", "a project of photographs", folder=True))
    # Other programs name an image by its file, without folder and suffix, unless several images
    # have files of that name.
    sources = {image.id: file.section("images").path(image.id, "an image") for image in images}
    stems = {id: re.sub("(?i)_rpc$", "", source.stem) for id, source in sources.items()}
    number_of = Counter(stems.values())
    names = {stem: id for id, stem in stems.items() if number_of[stem] == 1}
    names |= {image.id: image.id for image in images}
    serial = file.section("serial_numbers")
    for id in serial.values:
        if id not in sources:
            raise InputError(f"{serial.where}{id}: no such image{did_you_mean(id, list(sources))}")
        number = serial.text(id)
        if names.get(number, id) != id:
            raise InputError(
                f"{serial.where}{id} = {show(number)}, by which {names[number]} is known already; "
                "every image has a serial number of its own"
            )
        names[number] = id
    points, observations, point_warnings = read_points(section, names, images, frames, radians)
    warnings += point_warnings
    snooping = section.text("snooping", "none")
    if snooping not in TESTS:
        raise InputError(f"{section.where}snooping {snooping!r}{did_you_mean(snooping, TESTS)}")
    significance = section.number("significance", 0.001)
    if not 0 < significance < 1:
        raise InputError(
            f"{section.where}significance is {significance}; expected a number between 0 and 1"
        )
    rpc_format = section.text("rpc_format", "text")
    if rpc_format not in RPC_ENDINGS:
        raise InputError(
            f"{section.where}rpc_format {rpc_format!r}{did_you_mean(rpc_format, RPC_ENDINGS)}"
        )
    return RefineFile(
        images,
        points,
        observations,
        frames,
        snooping,
        significance,
        tuple(warnings),
        _read_terrain(section, images),
        RPC_ENDINGS[rpc_format],
        _wants_states(section, images),
        sources,
    )


def _wants_states(section: TomlSection, images: Sequence[AnyScannerImage]) -> bool:
    """Whether rigorous images are written as model states."""
    wants_states = section.values.get("csm_states", False)
    if not isinstance(wants_states, bool):
        raise InputError(f"{section.where}csm_states is {wants_states!r}; expected true or false")
    local = [
        image.id for image in images if isinstance(image, ScannerImage) and image.earth is None
    ]
    if wants_states and local:
        raise InputError(
            f"{section.where}csm_states: image {local[0]!r} is in a local frame, which model "
            "states do not have; omit it"
        )
    return wants_states


def _read_terrain(section: TomlSection, images: Sequence[AnyScannerImage]) -> HeightModel | None:
    """The terrain model whose heights are observed, where the images look."""
    if "dem" not in section:
        for key in ("dem_sigma", "geoid"):
            if key in section:
                raise InputError(f"{section.where}{key}: needs a terrain model; give dem")
        return None
    path, earth = section.path("dem", "a raster of heights"), images[0].earth
    if earth is not None and earth.a != earth.b:
        raise InputError(
            f"{section.where}dem: heights need an ellipsoid of revolution as [scanner] earth"
        )
    if "dem_sigma" not in section:
        raise InputError(
            f"{section.where}dem_sigma is missing; expected the σ of a height of {path.name}, "
            "metres: the LE90 of its producer, divided by 1.645"
        )
    sigma = section.number("dem_sigma")
    if sigma <= 0:
        raise InputError(f"{section.where}dem_sigma is {sigma:g}; expected metres above 0")
    extents = [
        image_extent(image.image, image.earth) if isinstance(image, ScannerImage) else
        rpc_extent(image.image.rpc)
        for image in images if image.earth is not None
    ]  # fmt: skip
    terrain = read_terrain(path, earth, joint_extent(extents), above_geoid="geoid" in section)
    if "geoid" in section:
        # A file beside this one, or the name of a grid of PROJ.
        name = section.text("geoid")
        local_file = section.beside(name)
        terrain = add_geoid(terrain, local_file if local_file.exists() else Path(name))
    return HeightModel(terrain, sigma, str(path))
