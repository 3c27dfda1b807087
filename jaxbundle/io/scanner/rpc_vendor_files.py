"""Rational polynomial coefficients in the files of products: DIMAP, DigitalGlobe, OSSIM.

| file | coefficients | centre of the first pixel |
|---|---|---|
| DIMAP of the first products of Pléiades, `.XML` | `Inverse_Model/F_ROW`, `F_COL` | (1, 1) |
| DIMAP 2 and 3, `.XML` | `Inverse_Model`, `GroundtoImage_Values` | by product: `DIMAP_ORIGIN` |
| DigitalGlobe, `.XML` | `RPB/IMAGE`, of RPC00B | (0, 0) |
| OSSIM keyword list, `….geom` | `line_num_coeff_00`, …, of `polynomial_format` B | (0, 0) |

The validity domain of a DIMAP file (FIRST_ROW, FIRST_COL) says where the coefficients hold. It may
begin outside the image, at negative rows and columns, and does not number the pixels.
"""

import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

from jaxbundle.arguments import show
from jaxbundle.errors import InputError
from jaxbundle.io.text.known_keys import Keys, UnknownKeys
from jaxbundle.io.text.xml_fields import XmlFields, number_in, read_xml
from jaxbundle.pushbroom.rpc.polynomials import TERMS
from jaxbundle.types import not_none

AXES = {
    "line": "line",
    "sample": "samp",
    "longitude": "long",
    "latitude": "lat",
    "height": "height",
}
# Names of the four polynomials in the files: line, num.
FIELDS = {
    f"{axis}_{part}": (AXES[axis], part[:3])
    for axis in ("line", "sample")
    for part in ("numerator", "denominator")
}
# Row and column of the centre of the first pixel in DIMAP's RPC, by the beginning of
# METADATA_PROFILE: Pléiades counts from 1 (Pléiades Imagery User Guide, appendix C), SPOT 6 and 7
# from 0 (SPOT 6 & SPOT 7 User Guide, appendix C.2.1; with it Ames Stereo Pipeline finds the
# rigorous model and the RPC of a SPOT product equal to 0.002 pixel, GDAL subtracts 1), Pléiades Neo
# from 0 (support of the vendor, GDAL issue 5716).
DIMAP_ORIGIN = {"PHR": 1.0, "PNEO": 0.0, "S6": 0.0, "S7": 0.0}
# Row and column of the centre of the first pixel for other profiles, by the name that DIMAP 2 and
# DIMAP 3 give the coefficients.
DIMAP_OTHER = {"Inverse_Model": 1.0, "GroundtoImage_Values": 0.0}
# The RPC of the first products of Pléiades, and the names of their axes.
EARLY = "Rational_Sensor_Model/Global_RFM"
EARLY_AXES = {
    "line": "Row",
    "sample": "Col",
    "longitude": "Lon",
    "latitude": "Lat",
    "height": "Alt",
}
LIMITS = "limits of the coefficients: beyond them positions are told to be outside anyway"
DIMAP_KEYS = Keys(
    (
        *(f"{name}_{part}".upper() for name in AXES.values() for part in ("off", "scale")),
        *(
            f"{axis}_{part}_coeff_{k}".upper()
            for axis, part in FIELDS.values()
            for k in range(1, TERMS + 1)
        ),
    ),
    {
        "*_Validity_Domain": LIMITS,
        **{f"{end}_{axis}": LIMITS for end in ("FIRST", "LAST") for axis in ("ROW", "COL")},
        **{f"{end}_{axis}": LIMITS for end in ("FIRST", "LAST") for axis in ("LON", "LAT")},
        "ERR_BIAS*": "a stated error",
        "ERR_RAND*": "a stated error",
    },
)
DIGITALGLOBE_KEYS = {
    "RPB": Keys(("SPECID", "IMAGE"), {"SATID": "the satellite", "BANDID": "the band"}),
    "IMAGE": Keys(
        (
            *(f"{name}{part}".upper() for name in AXES.values() for part in ("offset", "scale")),
            *(f"{axis}{part}coef".upper() + "List" for axis, part in FIELDS.values()),
        ),
        {"ERR*": "a stated error"},
    ),
    **{
        name + "List": Keys((name,))
        for name in (f"{axis}{part}coef".upper() for axis, part in FIELDS.values())
    },
}
DIMAP, DIGITALGLOBE = "an RPC file of DIMAP", "an RPC file of DigitalGlobe"


def from_xml(path: Path, unknown: UnknownKeys) -> dict[str, Any]:
    """The fields of `Rpc` in an XML file of DIMAP or DigitalGlobe; `unknown` notices keys of the
    coefficients that are not understood.

    **Raises:** `InputError` for XML of another kind, naming the kind.
    """
    root = read_xml(path)
    if root.find(f".//{EARLY}") is not None:
        return _from_early_dimap(XmlFields(path, root, DIMAP))
    has_rpc = root.find(".//Rational_Function_Model") is not None
    if root.tag.lower().endswith("dimap_document") or has_rpc:
        if root.find(".//RFM_Validity") is not None:
            return _from_dimap(XmlFields(path, root, DIMAP), root, unknown)
        raise InputError(
            f"{path}: DIMAP without RPC (RFM_Validity); its RPC are in a separate file, "
            "RPC_….XML. `pushbroom` commands read the rigorous model from this file"
        )
    if root.find(".//RPB") is not None:
        unknown.check_tree(not_none(root.find(".//RPB")), DIGITALGLOBE_KEYS, path)
        return _from_digitalglobe(XmlFields(path, root, DIGITALGLOBE))
    raise InputError(
        f"{path}: XML of another kind, <{root.tag[:60]}>: no RPC of DIMAP (RFM_Validity) and none "
        "of DigitalGlobe (RPB) are in it"
    )


def from_geom(path: Path, text: str) -> dict[str, Any]:
    """The fields of `Rpc` in a keyword list of OSSIM.

    **Raises:** `InputError` naming file, line and keyword.
    """
    entries = {}
    for number, line in enumerate(text.splitlines(), 1):
        name, colon, value = line.partition(":")
        if colon:
            # Keywords may be prefixed by the image or the projection.
            entries[name.strip()] = entries[name.strip().rpartition(".")[2]] = value.strip(), number
    kind, line = entries.get("polynomial_format", ("B", 0))
    if kind != "B":
        raise InputError(
            f"{path}, line {line}: polynomial_format is {show(kind)}; only B is read, whose terms "
            "are those of RPC00B"
        )
    adjusted = [
        name
        for name, (value, _) in entries.items()
        if ".adj_param_" in name
        and name.endswith(".parameter")
        and value not in ("0", "0.0")
        and number_of(path, entries, name) != 0
    ]
    if adjusted:
        raise InputError(
            f"{path}, line {entries[adjusted[0]][1]}: the adjustable parameter {adjusted[0]} is "
            "not 0; adjusted models are not read"
        )
    values: dict[str, Any] = {}
    for axis, name in AXES.items():
        values[f"{axis}_offset"] = number_of(path, entries, f"{name}_off")
        values[f"{axis}_scale"] = number_of(path, entries, f"{name}_scale")
    for field, (axis, part) in FIELDS.items():
        names = [f"{axis}_{part}_coeff_{k:02d}" for k in range(TERMS)]
        values[field] = [number_of(path, entries, name) for name in names]
    return values


def number_of(path: Path, entries: dict[str, tuple[str, int]], name: str) -> float:
    """The number of a keyword."""
    if name not in entries:
        raise InputError(f"{path}: {name} is missing; expected a keyword list of an OSSIM RPC")
    value, line = entries[name]
    return number_in(value, f"{path}, line {line}: {name}")


def _from_dimap(file: XmlFields, root: ET.Element, unknown: UnknownKeys) -> dict[str, Any]:
    inverse = next((n for n in DIMAP_OTHER if file.find(n) is not None), None)
    if inverse is None:
        raise file.missing_error("Inverse_Model")
    for name in ("RFM_Validity", inverse):
        unknown.check_element(not_none(root.find(f".//{name}")), DIMAP_KEYS, f"{file.path}: {name}")
    values = {}
    for axis, name in AXES.items():
        for part, suffix in (("offset", "OFF"), ("scale", "SCALE")):
            values[f"{axis}_{part}"] = file.number(f"RFM_Validity/{name.upper()}_{suffix}")
    profile = file.text("Metadata_Identification/METADATA_PROFILE", "").partition("_")[0]
    for axis in ("line", "sample"):
        # The first pixel is (1, 1) or (0, 0) by the profile of the product.
        values[f"{axis}_offset"] -= DIMAP_ORIGIN.get(profile, DIMAP_OTHER[inverse])
    for field, (axis, part) in FIELDS.items():
        names = [f"{axis}_{part}_coeff_{k}".upper() for k in range(1, TERMS + 1)]
        values[field] = [file.number(f"{inverse}/{name}") for name in names]
    return values


def _from_early_dimap(file: XmlFields) -> dict[str, Any]:
    """Scales A and offsets B; of every polynomial numerator and denominator in one list."""
    values = {}
    for axis, name in EARLY_AXES.items():
        values[f"{axis}_scale"] = file.number(f"{EARLY}/RFM_Validity/{name}/A")
        values[f"{axis}_offset"] = file.number(f"{EARLY}/RFM_Validity/{name}/B")
    for axis, name in (("line", "ROW"), ("sample", "COL")):
        values[f"{axis}_offset"] -= 1.0
        coefficients = file.numbers(f"{EARLY}/Inverse_Model/F_{name}", 2 * TERMS).tolist()
        values[f"{axis}_numerator"] = coefficients[:TERMS]
        values[f"{axis}_denominator"] = coefficients[TERMS:]
    return values


def _from_digitalglobe(file: XmlFields) -> dict[str, Any]:
    kind = file.text("RPB/SPECID", "RPC00B")
    if kind != "RPC00B":
        raise InputError(
            f"{file.path}: SPECID is {show(kind)}; only RPC00B is read, whose terms are in "
            "another order"
        )
    values = {}
    for axis, name in AXES.items():
        for part in ("offset", "scale"):
            values[f"{axis}_{part}"] = file.number(f"RPB/IMAGE/{name.upper()}{part.upper()}")
    for field, (axis, part) in FIELDS.items():
        name = f"{axis}{part}COEF".upper()
        values[field] = file.numbers(f"RPB/IMAGE/{name}List/{name}", TERMS).tolist()
    return values
