"""Images with rational polynomials, given by their raster or by the file of the coefficients.

| given | coefficients | size of the image |
|---|---|---|
| raster (`.tif`, `.ntf`, `.vrt`, …) | `NAME_RPC.TXT`, `NAME.RPB`, `NAME.geom`, `NAME.xml` beside it, else its tags | of the raster |
| `_RPC.TXT`, `.RPB`, `.geom`, XML of DIMAP (`RPC_….XML`) or of DigitalGlobe without a rigorous model | the file | of a raster of the same name beside it, else as far as the coefficients hold |
"""  # noqa: E501 a table

import dataclasses
from pathlib import Path

import numpy as np

from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import WGS84, Ellipsoid
from jaxbundle.io.scanner.rpc import RASTERS, read_rpc
from jaxbundle.io.text.known_keys import UnknownKeys
from jaxbundle.io.text.xml_fields import read_xml
from jaxbundle.pushbroom.rpc.image import RpcImage
from jaxbundle.pushbroom.rpc.polynomials import Rpc
from jaxbundle.system.file_content import no_such_file
from jaxbundle.system.rasters import check_raw, open_raster

IMAGES = (*RASTERS, ".jp2", ".png", ".jpg")
COEFFICIENTS = (".txt", ".rpb", ".geom")
COMPANION_ENDINGS = ("_RPC.TXT", "_rpc.txt", "_RPC.txt", ".RPB", ".rpb", ".geom", ".xml", ".XML")
ENDINGS = ("_rpc", "_RPC")


@dataclasses.dataclass(frozen=True)
class RpcInput:
    """An image with rational polynomials as the scanner commands have it; see `ScannerInput`."""

    name: str
    image: RpcImage
    earth: Ellipsoid = WGS84
    warnings: tuple[str, ...] = ()


def has_rpc_only(path: Path) -> bool:
    """Whether a file is of rational polynomials, by its suffix or the root of its XML."""
    suffix = path.suffix.lower()
    if suffix != ".xml":
        return suffix in (*IMAGES, *COEFFICIENTS)
    root = read_xml(path)
    has_element = lambda key: root.find(f".//{key}") is not None
    rigorous = (
        has_element("EPH") and has_element("ATT")
        if has_element("RPB")
        else has_element("Refined_Model")
    )
    return not rigorous and (has_element("RPB") or has_element("Rational_Function_Model"))


def read_rpc_image(path: Path, raster: Path | None = None) -> RpcInput:
    """The image of a raster or of a file of coefficients.

    **Arguments:** `raster`: the image of the coefficients, where it has another name.

    **Raises:** `InputError`, also for a raster that is a map.
    """
    source, raster_path = find_coefficients(path), raster or find_raster(path)
    unknown = UnknownKeys()
    rpc = read_rpc(source, unknown)
    if raster_path is None:
        lines, pixels = _domain_size(rpc)
        image = RpcImage(rpc, lines, pixels, sized=False)
        return RpcInput(path.stem, image, warnings=unknown.messages())
    with open_raster(raster_path) as bands:
        # Tags belong to the pixels of their raster, also of a map or of a part; a file of
        # coefficients to the whole image.
        if source != raster_path and bands.crs is None:
            check_raw(raster_path, bands)
        size = bands.height, bands.width
    size_warnings = () if source == raster_path else _size_warnings(source, raster_path, rpc, size)
    return RpcInput(path.stem, RpcImage(rpc, *size), warnings=(*unknown.messages(), *size_warnings))


def find_coefficients(path: Path) -> Path:
    """The file of the coefficients of an image: beside its raster, or the given one.

    **Raises:** `InputError`, if there is no such file, or nothing beside a raster that has no
    tags.
    """
    if not path.is_file():
        raise no_such_file(path, "a raster with RPC, or a file of coefficients")
    if path.suffix.lower() not in IMAGES:
        return path
    companions = (path.with_name(path.stem + end) for end in COMPANION_ENDINGS)
    coefficients_file = next((p for p in companions if p.is_file()), path)
    if coefficients_file is path and path.suffix.lower() not in RASTERS:
        raise InputError(f"{path}: no coefficients beside it: expected {path.stem}_RPC.TXT")
    return coefficients_file


def find_raster(path: Path, *folders: Path) -> Path | None:
    """The raster of a file of coefficients, or of a scanner file: of the same name beside it, or in
    one of the folders; None if there is none."""
    if path.suffix.lower() in IMAGES:
        return path
    stem = path.stem
    for end in ENDINGS:
        stem = stem.removesuffix(end)
    names = [stem + suffix for suffix in (*IMAGES, *(s.upper() for s in IMAGES))]
    candidates = (folder / name for folder in (path.parent, *folders) for name in names)
    return next((p for p in candidates if p.is_file()), None)


def _size_warnings(source: Path, raster: Path, rpc: Rpc, size: tuple[int, int]) -> tuple[str, ...]:
    """Whether coefficients may belong to another raster, such as the whole image of a tile."""
    domain_size = _domain_size(rpc)
    # Vendors' domains end within a tenth of the image; a tile is half of it or less.
    if all(abs(a - b) <= 0.25 * b for a, b in zip(domain_size, size)):
        return ()
    return (
        f"{source} holds for {domain_size[0]} lines of {domain_size[1]} pixels, {raster} has "
        f"{size[0]} of {size[1]}: is it a tile or a part of a larger image? Coefficients refer to "
        "the whole",
    )


def _domain_size(rpc: Rpc) -> tuple[int, int]:
    """Lines and pixels from (0, 0) to the ends of the domain."""
    ends = (
        float(rpc.line_offset) + abs(float(rpc.line_scale)),
        float(rpc.sample_offset) + abs(float(rpc.sample_scale)),
    )
    lines, pixels = (max(int(np.ceil(end)) + 1, 2) for end in ends)
    return lines, pixels
