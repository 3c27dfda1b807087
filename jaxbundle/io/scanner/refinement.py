"""The refine file: scanner images, ground points, measurements and unknowns of a refinement.

```toml
[refine]
points = "points.csv"               # id,role,X,Y,Z[,sX,sY,sZ], or
                                    # id,role,longitude,latitude,height[,sE,sN,sh]
observations = "observations.csv"   # image,point,line,pixel[,sline,spixel]
frames = "photographs"              # a project of photographs that share points
dem = "terrain.tif"                 # a terrain model, whose heights are observations of tie points
dem_sigma = 5.0                     # of these, metres
geoid = "egm96.gtx"                 # as of the commands: for heights above the geoid
rpc_format = "text"                 # text | rpb, of the compensated coefficients in --out
sigma = 0.5                         # of line and pixel, where the table has none; default 1, a unit
angle_unit = "deg"                  # rad | deg | gon, of this file and of longitude, latitude
snooping = "pope"                   # none | baarda | pope
significance = 0.001

[images]                            # scanner files, or images with RPC, by the image's id
A = "a/scanner.toml"
B = "b/scanner.toml"
C = "c.tif"

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

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import Ellipsoid, earth_fixed
from jaxbundle.io.formats import read_network
from jaxbundle.io.rasters.extent import image_extent, joint_extent, rpc_extent
from jaxbundle.io.rasters.geoid import add_geoid
from jaxbundle.io.rasters.reading import read_terrain
from jaxbundle.io.scanner.read import read_scanner
from jaxbundle.io.scanner.rpc import read_stated_errors
from jaxbundle.io.scanner.rpc_images import find_coefficients, has_rpc_only, read_rpc_image
from jaxbundle.io.text.sections import TomlFile, TomlSection, read_sections
from jaxbundle.network.columns import Columns, did_you_mean, show
from jaxbundle.network.tables import STATED, UNIT, Network, Observations
from jaxbundle.network.units import ANGLE_UNITS
from jaxbundle.refinement.freedom import Freedom
from jaxbundle.refinement.refining import TESTS, east_north_up
from jaxbundle.refinement.rpc_points import BIAS_TERMS, prior_of_bias, prior_of_errors
from jaxbundle.refinement.tables import (
    AnyScannerImage,
    GroundPoints,
    RpcScannerImage,
    ScannerImage,
    check_points_table,
    is_same_earth,
)
from jaxbundle.refinement.terrain_heights import HeightModel

SECTIONS = {
    "refine": (
        "points",
        "observations",
        "frames",
        "dem",
        "dem_sigma",
        "geoid",
        "rpc_format",
        "sigma",
        "angle_unit",
        "snooping",
        "significance",
    ),
    "images": (),
    "models": (),
    "sensors": (),
    "unknowns": (),
}
REQUIRED_FIELDS = ("refine", "images")
MODELS = ("rigorous", "rpc")
RPC_ENDINGS = {"text": "_RPC.TXT", "rpb": ".RPB"}
"""Of compensated coefficients, by rpc_format."""
OF_RPC = ("bias_degree", "bias")
"""Unknowns of images with RPC; those of rigorous images are the fields of `Freedom`."""
STATED_BIAS = "stated"
WORDS = {"free": math.inf, "held": 0.0}
ANGULAR_UNKNOWNS = ("attitude", "attitude_rate", "jitter", "mounting")
LISTED_UNKNOWNS = ("look_across", "look_along")


class RefineFile(NamedTuple):
    """The arguments of `jaxbundle.refinement.refine`; `rpc_ending`: of the names of files with
    compensated coefficients."""

    images: list[AnyScannerImage]
    points: GroundPoints
    observations: Observations
    frames: Network | None
    snooping: str
    significance: float
    warnings: tuple[str, ...] = ()
    terrain: HeightModel | None = None
    rpc_ending: str = RPC_ENDINGS["text"]


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
    images, warnings = _read_images(file, radians)
    frames = None
    if "frames" in section:
        frames = read_network(section.path("frames", "a project of photographs", folder=True))
    points = _points(section.table("points"), images[0].earth, radians)
    # checked first: the ids of observations are looked up in it
    check_points_table(points)
    ids = {id: k for k, id in enumerate(points.id)}
    if frames is not None:
        # points that only photographs show follow those of the table
        more = (id for id in frames.points.id if id not in ids)
        ids |= {id: k for k, id in enumerate(more, len(ids))}
    observations = _observations(
        section.table("observations"),
        ids,
        [image.id for image in images],
        section,
        str(path),
    )
    snooping = section.text("snooping", "none")
    if snooping not in TESTS:
        raise InputError(f"{section.where}snooping {snooping!r}{did_you_mean(snooping, TESTS)}")
    significance = section.number("significance", 0.001)
    if not 0 < significance < 1:
        raise InputError(
            f"{section.where}significance is {significance}; a number between 0 and 1 is expected"
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
    )


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
            f"{section.where}dem_sigma is missing; the σ of a height of {path.name} is expected, "
            "metres: the LE90 of its producer, divided by 1.645"
        )
    extents = [
        image_extent(one.image, one.earth) if isinstance(one, ScannerImage) else
        rpc_extent(one.image.rpc)
        for one in images if one.earth is not None
    ]  # fmt: skip
    terrain = read_terrain(path, earth, joint_extent(extents), above_geoid="geoid" in section)
    if "geoid" in section:
        # a file beside this one, or the name of a grid of PROJ
        name = section.text("geoid")
        beside = section.beside(name)
        terrain = add_geoid(terrain, beside if beside.exists() else Path(name))
    return HeightModel(terrain, section.number("dem_sigma"), str(path))


def _read_images(file: TomlFile, radians: float) -> tuple[list[AnyScannerImage], list[str]]:
    """The images with their unknowns, and warnings of their readers."""
    path, scanners = file.path, file.section("images")
    if not scanners.values:
        raise InputError(f'{path}, [images]: no image; give id = "scanner.toml"')
    sensors, unknowns, models = (file.section(n) for n in ("sensors", "unknowns", "models"))
    sensors.check_keys(tuple(scanners.values))
    models.check_keys(tuple(scanners.values))
    own = {k: v for k, v in unknowns.values.items() if isinstance(v, dict)}
    common = {k: v for k, v in unknowns.values.items() if k not in own}
    for id in own:
        if id not in scanners.values:
            raise InputError(
                f"{path}, [unknowns.{id}]: no such image{did_you_mean(id, scanners.values)}"
            )
    images, warnings = [], []
    section = lambda name, values: TomlSection(file, f"{path}, [{name}]: ", values)
    fields = tuple(sorted(f.name for f in dataclasses.fields(Freedom)))
    section("unknowns", common).check_keys((*fields, *OF_RPC))
    for id in scanners.values:
        source = scanners.path(id, "a scanner file, the file of a product, or an image with RPC")
        mine, name = own.get(id, {}), f"unknowns.{id}" if id in own else "unknowns"
        is_rpc = _is_rpc(source, models, id)
        known = OF_RPC if is_rpc else fields
        # what is common to all images is for those that have it
        chosen = {k: v for k, v in common.items() if k in known} | mine
        unknowns_of_image = section(name, chosen)
        _check_own_keys(unknowns_of_image, mine, known, is_rpc)
        if is_rpc:
            image, said = _read_rpc_image(id, source, unknowns_of_image)
            images.append(image)
            warnings += said
            continue
        scanner = read_scanner(source)
        warnings += scanner.warnings
        freedom = _read_freedom(unknowns_of_image, radians)
        # without an entry an image is a sensor of its own
        images.append(ScannerImage(id, scanner.image, scanner.earth, freedom, sensors.text(id, id)))
    if all(isinstance(one, ScannerImage) for one in images):
        file.require(("unknowns",))
    for image in images:
        if not is_same_earth(image.earth, images[0].earth):
            raise InputError(
                f"{path}, [images]: {images[0].id!r} and {image.id!r} have different ellipsoids or "
                "frames; points can be in one only (images with RPC are in WGS84)"
            )
    return images, warnings


def _is_rpc(source: Path, models: TomlSection, id: str) -> bool:
    """Whether an image is taken by its RPC: where it has nothing else, or [models] says so."""
    model = models.text(id, "")
    if model not in ("", *MODELS):
        raise InputError(f"{models.where}{id} = {model!r}{did_you_mean(model, MODELS)}")
    only = has_rpc_only(source)
    if only and model == "rigorous":
        raise InputError(
            f'{models.where}{id} = "rigorous": {source} has rational polynomials (RPC) only; give '
            '"rpc", or a scanner file'
        )
    return only or model == "rpc"


def _check_own_keys(
    section: TomlSection, mine: Mapping[str, Any], known: Sequence[str], is_rpc: bool
) -> None:
    """Refuse unknowns of an image that only images with the other model have."""
    for key in mine:
        if key not in known and (key in OF_RPC) != is_rpc:
            kind = "an image with RPC" if is_rpc else "a rigorous image"
            raise InputError(
                f"{section.where}{key} is no unknown of {kind}, which has {', '.join(known)}"
            )
    section.check_keys(known)


def _read_rpc_image(
    id: str, path: Path, section: TomlSection
) -> tuple[RpcScannerImage, tuple[str, ...]]:
    """An image with RPC, its bias with priors, and warnings."""
    found = read_rpc_image(path)
    degree = section.values.get("bias_degree", 0)
    if degree not in range(len(BIAS_TERMS)) or isinstance(degree, bool):
        raise InputError(f"{section.where}bias_degree is {show(degree)}; 0, 1 or 2 is expected")
    given, warnings = section.values.get("bias"), found.warnings
    if given in (None, STATED_BIAS):
        source = find_coefficients(path)
        errors = read_stated_errors(source)
        if errors.bias > 0 and (errors.random > 0 or degree == 0):
            sigma = prior_of_errors(found.image.rpc, degree, errors.bias, errors.random)
            return RpcScannerImage(id, found.image, sigma), warnings
        lacking = "ERR_BIAS" if errors.bias == 0 else "ERR_RAND"
        said = f"{source} states no error of its coefficients ({lacking})"
        if given is not None:
            raise InputError(
                f'{section.where}bias = "stated", but {said}; give σ in pixels, or "free"'
            )
        warnings += (
            f"{said}: the bias of image {id!r} is free; give bias in [unknowns] a prior σ",
        )
        return RpcScannerImage(id, found.image, prior_of_bias(degree)), warnings
    values = given if isinstance(given, list) else [given, given]
    if len(values) != 2:
        raise InputError(
            f"{section.where}bias is {show(given)}; one σ, or two, of the shift and of the other "
            "terms, is expected, in pixels"
        )
    shift, variation = (_sigma(section, "bias", value) for value in values)
    return RpcScannerImage(id, found.image, prior_of_bias(degree, shift, variation)), warnings


def _read_freedom(section: TomlSection, radians: float) -> Freedom:
    values_read: dict[str, Any] = {}
    for key, value in section.values.items():
        factor = radians if key in ANGULAR_UNKNOWNS else 1.0
        if key == "knot_spacing":
            values_read[key] = section.number(key)
            if values_read[key] <= 0:
                raise InputError(f"{section.where}{key} must be positive, in seconds")
        elif key == "focal_length":
            values_read[key] = _sigma(section, key, value)
        elif key in LISTED_UNKNOWNS:
            values = value if isinstance(value, list) else [value]
            values_read[key] = tuple(_sigma(section, key, v) for v in values)
        else:
            values = value if isinstance(value, list) else [value] * 3
            if len(values) != 3:
                raise InputError(f"{section.where}{key} is {show(value)}; one value or three")
            values_read[key] = tuple(factor * _sigma(section, key, v) for v in values)
    return Freedom(**values_read)


def _sigma(section: TomlSection, key: str, value: Any) -> float:
    if isinstance(value, str) and value in WORDS:
        return WORDS[value]
    if isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value < math.inf:
        return float(value)
    raise InputError(
        f'{section.where}{key} is {show(value)}; "free", "held" or a prior σ is expected'
    )


def _points(table: Columns, earth: Ellipsoid | None, radians: float) -> GroundPoints:
    geographic = "longitude" in table.values
    names = ("longitude", "latitude", "height") if geographic else ("X", "Y", "Z")
    sigmas = ("sE", "sN", "sh") if geographic else ("sX", "sY", "sZ")
    table.check_names(("id", "role", *names), sigmas)
    X = np.stack([table.numbers(n) for n in names], 1)
    words = {"free": math.inf, "held": 0.0}
    sigma = np.stack([table.numbers(n, words=words) for n in sigmas], 1)
    axes = np.tile(np.eye(3), (len(X), 1, 1))
    if geographic:
        if earth is None or earth.a != earth.b:
            raise InputError(
                f"{table.source.name}: longitudes need an ellipsoid of revolution as [scanner] "
                "earth; give X, Y, Z"
            )
        beyond = np.abs(X[:, 1] * radians) > np.pi / 2 + 1e-12  # some thousand eps, as of 100 gon
        if beyond.any():
            row = int(beyond.argmax())
            raise InputError(
                f"{table.source(row)}: latitude {X[row, 1]:g} is beyond the pole; look at the "
                "order of columns and at angle_unit"
            )
        X = np.stack(
            [
                np.asarray(v)
                for v in earth_fixed(earth, (radians * X[:, 0], radians * X[:, 1], X[:, 2]))
            ],
            1,
        )
        known = np.isfinite(X).all(1)
        # an unknown place has no east and north: its σ are of the axes
        axes[known] = east_north_up(earth, X[known])
    return GroundPoints(
        table.ids("id"),
        table.ids("role"),
        X,
        np.nan_to_num(sigma, nan=0.0, posinf=np.inf),
        axes,
        ("east", "north", "up") if geographic else ("X", "Y", "Z"),
        table.source,
    )


def _observations(
    table: Columns, ids: Mapping[str, int], images: Sequence[str], section: TomlSection, where: str
) -> Observations:
    table.check_names(("image", "point", "line", "pixel"), ("sline", "spixel"))
    sigma, stated = section.number("sigma", 1.0), "sigma" in section.values
    if sigma <= 0:
        raise InputError(f"{section.where}sigma is {sigma:g}; positive, in lines and pixels")
    stated_sigma = np.stack([table.numbers(n) for n in ("sline", "spixel")], 1)
    lacking = np.isnan(stated_sigma)
    if not stated and lacking.any() and not lacking.all():
        row = int(lacking.any(1).argmax())
        raise InputError(
            f"{table.source(row)}: sline or spixel is missing, which other rows have; give it, or "
            f"sigma in [refine] for those without"
        )
    return Observations(
        table.indices("image", "image", {id: k for k, id in enumerate(images)}, where),
        table.indices("point", "point", ids, section.text("points")),
        np.stack([table.numbers(n, required=True) for n in ("line", "pixel")], 1),
        np.where(lacking, sigma, stated_sigma),
        table.source,
        STATED if stated or not lacking.any() else UNIT,
    )
