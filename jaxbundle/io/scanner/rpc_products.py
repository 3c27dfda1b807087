"""Rational polynomial coefficients in the files of products: DIMAP, DigitalGlobe, OSSIM.

| file | coefficients | centre of the first pixel |
|---|---|---|
| DIMAP 2 and 3, `.XML` | `Inverse_Model`, `GroundtoImage_Values` | `FIRST_ROW`, `FIRST_COL` |
| DigitalGlobe, `.XML` | `RPB/IMAGE`, of RPC00B | (0, 0) |
| OSSIM keyword list, `….geom` | `line_num_coeff_00`, …, of `polynomial_format` B | (0, 0) |

The validity domain of a DIMAP file has the indices of the first pixel: 1 for Pléiades, 0 or 1
for SPOT 6 and 7, 0.5 for Pléiades Neo (its coordinates begin at the corner of the pixel). The
default is 1 (Pléiades User Guide, appendix C; GDAL takes FIRST_COL for both).
"""

from pathlib import Path
from typing import Any

from jaxbundle.errors import InputError
from jaxbundle.io.text.xml_fields import XmlFields, number_in, read_xml
from jaxbundle.network.columns import show
from jaxbundle.pushbroom.rpc import TERMS

AXES = {"line": "line", "sample": "samp", "longitude": "long", "latitude": "lat",
        "height": "height"}  # fmt: skip
FIELDS = {f"{axis}_{part}": (AXES[axis], part[:3]) for axis in ("line", "sample")
          for part in ("numerator", "denominator")}  # fmt: skip
"""Names of the four polynomials in the files: line, num."""
VALIDITY = ("ImagetoGround_Validity_Domain", "Direct_Model_Validity_Domain")
DIMAP, DIGITALGLOBE = "an RPC file of DIMAP", "an RPC file of DigitalGlobe"


def from_xml(path: Path) -> dict[str, Any]:
    """The fields of `Rpc` in an XML file of DIMAP or DigitalGlobe.

    **Raises:** `InputError` for XML of another kind, naming the kind.
    """
    root = read_xml(path)
    if root.tag == "Dimap_Document" or root.find(".//Rational_Function_Model") is not None:
        if root.find(".//RFM_Validity") is not None:
            return _from_dimap(XmlFields(path, root, DIMAP))
        raise InputError(
            f"{path}: DIMAP without RPC (RFM_Validity); its RPC are in a separate file, "
            "RPC_….XML. `pushbroom` commands read the rigorous model from this file"
        )
    if root.find(".//RPB") is not None:
        return _from_digitalglobe(XmlFields(path, root, DIGITALGLOBE))
    raise InputError(
        f"{path}: XML of another kind, <{root.tag[:60]}>: no RPC of DIMAP (RFM_Validity) and none "
        "of DigitalGlobe (RPB) are in it"
    )


def from_geom(path: Path, text: str) -> dict[str, Any]:
    """The fields of `Rpc` in a keyword list of OSSIM.

    **Raises:** `InputError` naming file, line and keyword.
    """
    found = {}
    for number, line in enumerate(text.splitlines(), 1):
        name, colon, value = line.partition(":")
        if colon:
            # keywords may be prefixed by the image or the projection
            found[name.strip()] = found[name.strip().rpartition(".")[2]] = value.strip(), number
    kind, line = found.get("polynomial_format", ("B", 0))
    if kind != "B":
        raise InputError(
            f"{path}, line {line}: polynomial_format is {show(kind)}; only B is read, whose terms "
            "are those of RPC00B"
        )
    adjusted = [
        name for name, (value, _) in found.items()
        if ".adj_param_" in name and name.endswith(".parameter") and value not in ("0", "0.0")
        and number_of(path, found, name) != 0
    ]  # fmt: skip
    if adjusted:
        raise InputError(
            f"{path}, line {found[adjusted[0]][1]}: the adjustable parameter {adjusted[0]} is not "
            "0; adjusted models are not read"
        )
    values: dict[str, Any] = {}
    for axis, name in AXES.items():
        values[f"{axis}_offset"] = number_of(path, found, f"{name}_off")
        values[f"{axis}_scale"] = number_of(path, found, f"{name}_scale")
    for field, (axis, part) in FIELDS.items():
        names = [f"{axis}_{part}_coeff_{k:02d}" for k in range(TERMS)]
        values[field] = [number_of(path, found, name) for name in names]
    return values


def number_of(path: Path, found: dict[str, tuple[str, int]], name: str) -> float:
    """The number of a keyword."""
    if name not in found:
        raise InputError(f"{path}: {name} is missing; a keyword list of an OSSIM RPC is expected")
    value, line = found[name]
    return number_in(value, f"{path}, line {line}: {name}")


def _from_dimap(file):
    inverse = next(
        (n for n in ("GroundtoImage_Values", "Inverse_Model") if file.find(n) is not None), None
    )
    if inverse is None:
        raise file.missing("Inverse_Model")
    values = {}
    for axis, name in AXES.items():
        for part, short in (("offset", "OFF"), ("scale", "SCALE")):
            values[f"{axis}_{part}"] = file.number(f"RFM_Validity/{name.upper()}_{short}")
    domain = next((n for n in VALIDITY if file.find(n) is not None), VALIDITY[0])
    for axis, first in (("line", "FIRST_ROW"), ("sample", "FIRST_COL")):
        values[f"{axis}_offset"] -= file.number(f"{domain}/{first}", 1.0)
    for field, (axis, part) in FIELDS.items():
        names = [f"{axis}_{part}_coeff_{k}".upper() for k in range(1, TERMS + 1)]
        values[field] = [file.number(f"{inverse}/{name}") for name in names]
    return values


def _from_digitalglobe(file):
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
