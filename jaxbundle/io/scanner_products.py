"""Scanner images of products: support data of CSM, DIMAP; their form is told by the suffix."""

from pathlib import Path

from jaxbundle.errors import InputError
from jaxbundle.io.csm import read_csm
from jaxbundle.io.dimap import read_dimap
from jaxbundle.io.scanner import Scanner

READERS = {".json": read_csm, ".dim": read_dimap}


def read_product(path: Path, interpolation: str | None = None) -> Scanner:
    """The image of a product; `interpolation` is a choice of CSM files only.

    **Raises:** `InputError` for what no reader knows.
    """
    read = READERS.get(path.suffix.lower())
    if read is None:
        raise InputError(
            f"{path}: the suffix of a scanner file is .toml or {', '.join(READERS)}"
        )
    if interpolation is None:
        return read(path)
    if read is not read_csm:
        raise InputError(f"{path}: interpolation can be chosen for CSM files only; leave it away")
    return read_csm(path, interpolation)
