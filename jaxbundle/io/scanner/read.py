"""Any scanner image: our file, or a product recognised by its suffix and the root of its XML."""

import dataclasses
from pathlib import Path

from jaxbundle.arguments import show
from jaxbundle.errors import InputError
from jaxbundle.io.scanner.csm import read_csm
from jaxbundle.io.scanner.dimap import read_dimap
from jaxbundle.io.scanner.dimap2 import EARLY_MODEL, MODEL, read_dimap2
from jaxbundle.io.scanner.pvl import read_support_data
from jaxbundle.io.scanner.rpc_check import check_against_rpc
from jaxbundle.io.scanner.scanner import ScannerInput
from jaxbundle.io.scanner.scanner_file import REQUIRED_FIELDS, SECTIONS, scanner_of
from jaxbundle.io.scanner.worldview import read_worldview
from jaxbundle.io.text.csv_tables import read_toml
from jaxbundle.io.text.sections import TomlFile, TomlSection, read_sections
from jaxbundle.io.text.xml_fields import XmlFields, read_xml

# Suffixes of products.
PRODUCTS = (".json", ".dim", ".xml", ".imd")
EXPECTED_PRODUCTS = (
    "a file of the Community Sensor Model (.json), DIMAP of SPOT 5, Pléiades, SPOT 6 or 7 "
    "(.xml, .dim), or support data of DigitalGlobe (.xml, .imd)"
)
# Keys of [scanner] beside a source.
OF_SOURCES = ("interpolation", "extrapolate")
WORLDVIEW = "support data of DigitalGlobe with IMD, EPH, ATT, GEO"


def read_scanner(path: str | Path) -> ScannerInput:
    """The pushbroom image of a scanner file, `.toml`, or of a product; one that has RPC too is
    compared with them (`rpc_check`).

    **Raises:** `InputError` naming file, section and key, or table and line; also for unknown
    formats.
    """
    path = Path(path)
    if path.suffix.lower() in PRODUCTS:
        return check_against_rpc(_read_product(path), path)
    if path.suffix.lower() != ".toml" and path.exists():
        raise InputError(f"{path}: expected a scanner file (.toml), {EXPECTED_PRODUCTS}")
    if path.suffix.lower() == ".toml" and "track" in read_toml(path):
        raise InputError(
            f"{path}: a flight file, of an image still to be simulated; simulate it (jaxbundle "
            "pushbroom simulate), and give the scanner.toml of its folder"
        )
    # A file with a source needs no other section.
    file = read_sections(path, SECTIONS, REQUIRED_FIELDS[:1])
    scanner = file.section("scanner")
    if "source" in scanner:
        return _read_source(file, scanner)
    for name in OF_SOURCES:
        if name in scanner:
            raise InputError(f"{scanner.where}{name}: give it in [position] and [attitude]")
    if "corrections" in scanner:
        raise InputError(
            f"{scanner.where}corrections: chosen by the RPC of a source; here give the section "
            "[corrections]"
        )
    file.require(REQUIRED_FIELDS, f", or source in [scanner], the name of {EXPECTED_PRODUCTS}")
    return scanner_of(file)


def _read_source(file: TomlFile, scanner: TomlSection) -> ScannerInput:
    """The image of the source, with the name, interpolation and corrections of the file."""
    scanner.check_keys(("source", "name", *OF_SOURCES, "corrections"))
    automatic = scanner.text("corrections", "") if "corrections" in scanner else None
    if automatic not in (None, "auto"):
        raise InputError(
            f'{scanner.where}corrections = {show(automatic)}; expected "auto", or the section '
            "[corrections] with light_time, aberration, refraction"
        )
    for name in file.document:
        if name not in ("scanner", "corrections"):
            raise InputError(
                f"{file.path}, [{name}]: this is read from the source; only [scanner] and "
                "[corrections] can be given with it"
            )
    choice = scanner.text("interpolation") if "interpolation" in scanner else None
    source = scanner.path("source", EXPECTED_PRODUCTS)
    if source.suffix.lower() not in PRODUCTS:
        raise InputError(
            f"{scanner.where}source = {show(str(scanner.values['source']))}: expected "
            f"{EXPECTED_PRODUCTS}"
        )
    seconds = scanner.number("extrapolate") if "extrapolate" in scanner else None
    if seconds is not None and seconds < 0:
        raise InputError(f"{scanner.where}extrapolate is {seconds:g}; expected seconds")
    product = _read_product(source, choice, seconds)
    switches = file.section("corrections")
    switched = {name: switches.switch(name) for name in switches.values}
    if automatic and switched:
        raise InputError(
            f'{scanner.where}corrections = "auto", and [corrections] are given; give one of them'
        )
    corrections = product.image.corrections._replace(**switched)
    if corrections.any and product.backwards:
        raise InputError(
            f"{switches.where}the lines of {source.name} were taken in reverse order, for "
            "which there are no corrections; omit them"
        )
    image = dataclasses.replace(product.image, corrections=corrections)
    product = dataclasses.replace(product, image=image, name=scanner.text("name", product.name))
    # What the user switched is compared, but not replaced.
    return check_against_rpc(product, source, not switched, automatic is not None)


def _read_product(
    path: Path, interpolation: str | None = None, extrapolate: float | None = None
) -> ScannerInput:
    """The image of a product; `interpolation` and `extrapolate` apply to CSM files only."""
    suffix = path.suffix.lower()
    if suffix == ".json":
        choice = {} if interpolation is None else {"interpolation": interpolation}
        return read_csm(path, **choice, extrapolate=extrapolate)
    for name, value in zip(OF_SOURCES, (interpolation, extrapolate)):
        if value is not None:
            raise InputError(f"{path}: {name} can be chosen for CSM files only; omit it")
    if suffix == ".imd":
        return read_worldview(XmlFields(path, read_support_data(path), WORLDVIEW))
    return _read_xml(path)


def _read_xml(path: Path) -> ScannerInput:
    """The image of a product in XML, by the name of its root and the groups in it."""
    root = read_xml(path)
    has_element = lambda key: root.find(f".//{key}") is not None
    # Early products of Pléiades have PHR_DIMAP_Document or PHR_Dimap_Document.
    if root.tag.lower().endswith("dimap_document"):
        if has_element(MODEL) or has_element(EARLY_MODEL):
            return read_dimap2(XmlFields(path, root, "DIMAP 2 of sensor level"))
        if has_element("Rational_Function_Model/Global_RFM"):
            raise InputError(
                f"{path}: DIMAP of RPC alone; give it to `pushbroom rpc`, or the DIM_….XML here"
            )
        if not has_element("Sensor_Configuration") and not has_element("Satellite_Attitudes"):
            kind = ", ".join(
                f"{text[:60]}"
                for name in ("METADATA_PROFILE", "PROCESSING_LEVEL", "PRODUCT_TYPE")
                if (text := root.findtext(f".//{name}", "").strip())
            )
            raise InputError(
                f"{path}: DIMAP ({kind or 'without a profile'}) without a model of the camera, "
                f"{MODEL} or Data_Strip/Sensor_Configuration: expected a product of sensor level. "
                "Of other levels give the RPC (RPC_….XML), if it has any, to `pushbroom rpc`"
            )
        return read_dimap(XmlFields(path, root, "DIMAP of SPOT 5"))
    if has_element("GEO") and has_element("EPH") and has_element("ATT"):
        return read_worldview(XmlFields(path, root, WORLDVIEW))
    raise InputError(
        f"{path}: XML of another kind, <{root.tag[:60]}>; expected DIMAP of SPOT 5, Pléiades, "
        "SPOT 6 or 7, or DigitalGlobe's with the groups GEO, EPH, ATT"
    )
