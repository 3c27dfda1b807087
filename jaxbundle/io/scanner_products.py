"""Scanner images of products: what a file is, is told by its suffix and the root of its XML."""

from pathlib import Path

from jaxbundle.errors import InputError
from jaxbundle.io.csm import read_csm
from jaxbundle.io.dimap import read_dimap
from jaxbundle.io.dimap2 import MODEL, read_dimap2
from jaxbundle.io.pvl import read_support_data
from jaxbundle.io.scanner import PRODUCTS, Scanner
from jaxbundle.io.worldview import read_worldview
from jaxbundle.io.xml_fields import XmlFields, read_xml

WORLDVIEW = "support data of DigitalGlobe with IMD, EPH, ATT, GEO"


def read_product(path: Path, interpolation: str | None = None) -> Scanner:
    """The image of a product; `interpolation` is a choice of CSM files only.

    **Raises:** `InputError` for what no reader knows.
    """
    suffix = path.suffix.lower()
    if suffix not in PRODUCTS:
        raise InputError(f"{path}: the suffix of a scanner file is .toml or {', '.join(PRODUCTS)}")
    if suffix == ".json":
        return read_csm(path) if interpolation is None else read_csm(path, interpolation)
    if interpolation is not None:
        raise InputError(f"{path}: interpolation can be chosen for CSM files only; leave it away")
    if suffix == ".imd":
        return read_worldview(XmlFields(path, read_support_data(path), WORLDVIEW))
    return _read_xml(path)


def _read_xml(path):
    root = read_xml(path)
    has = lambda key: root.find(f".//{key}") is not None
    if root.tag == "Dimap_Document":
        if has(MODEL):
            return read_dimap2(XmlFields(path, root, "DIMAP 2 of sensor level"))
        if has("Rational_Function_Model"):
            raise InputError(
                f"{path}: DIMAP of RPC alone; give it to `pushbroom rpc`, or the DIM_….XML here"
            )
        return read_dimap(XmlFields(path, root, "DIMAP of SPOT 5"))
    if has("GEO") and has("EPH") and has("ATT"):
        return read_worldview(XmlFields(path, root, WORLDVIEW))
    raise InputError(
        f"{path}: XML of another kind, <{root.tag[:60]}>; DIMAP of SPOT 5, Pléiades, SPOT 6 or 7, "
        "or DigitalGlobe's with the groups GEO, EPH, ATT is expected"
    )
