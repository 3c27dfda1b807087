"""Members of a ZIP archive of another program, checked before they are unpacked."""

import xml.etree.ElementTree as ET
import zipfile
from collections.abc import Mapping
from pathlib import Path

from jaxbundle.errors import InputError
from jaxbundle.io.text.archives import largest_unpacked_size
from jaxbundle.io.text.xml_fields import parse_xml
from jaxbundle.system.file_content import check_plain
from jaxbundle.system.foreign_parsers import foreign_parser


def read_zip(path: Path, expected: str) -> Mapping[str, bytes]:
    """The contents of all members by name.

    **Raises:** `InputError`: the file is none, it cannot be read, or its members unpack to an
    implausible size (`largest_unpacked_size`)."""
    check_plain(path)
    with foreign_parser(path, expected), zipfile.ZipFile(path) as archive:
        # An archive of some kilobytes may unpack to gigabytes.
        unpacked = sum(info.file_size for info in archive.infolist())
        if unpacked > largest_unpacked_size(path.stat().st_size):
            raise InputError(
                f"{path}: is not {expected}, or is damaged: it claims to unpack to {unpacked} bytes"
            )
        return {info.filename: archive.read(info) for info in archive.infolist()}


def document_of(path: Path, members: Mapping[str, bytes], expected: str) -> ET.Element:
    """The root of `doc.xml` in an archive.

    **Raises:** `InputError` if there is none, or no valid XML."""
    if "doc.xml" not in members:
        raise InputError(f"{path}: is not {expected}: there is no doc.xml in it")
    return parse_xml(f"{path}, doc.xml", members["doc.xml"].decode("utf-8", errors="replace"))
