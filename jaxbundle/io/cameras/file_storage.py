"""OpenCV's FileStorage as XML: the entries as of its YAML and JSON.

    <opencv_storage>
      <image_width>640</image_width>
      <camera_matrix type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt>
        <data> … </data></camera_matrix>
      <names><_>"a"</_><_>"b"</_></names>
    </opencv_storage>

Elements `_` are those of a list, several words the numbers of one.

Source: OpenCV 4 documentation, XML/YAML/JSON file storages.
"""

import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

from jaxbundle.errors import InputError
from jaxbundle.io.text.xml_fields import read_xml

ROOT = "opencv_storage"


def storage_entries(path: Path) -> dict[str, Any]:
    """The entries of a file.

    **Raises:** `InputError` for another document, and an entry that occurs twice.
    """
    root = read_xml(path)
    if root.tag != ROOT:
        raise InputError(f"{path}: the document is <{root.tag}>; expected <{ROOT}> of OpenCV")
    value = _value(path, root)
    if not isinstance(value, dict):
        raise InputError(f"{path}: there are no entries in <{ROOT}>")
    return value


def _value(path: Path, element: ET.Element) -> Any:
    children = [child for child in element if isinstance(child.tag, str)]
    if not children:
        words = _words(element.text or "")
        return words[0] if len(words) == 1 else words or None
    if all(child.tag == "_" for child in children):
        return [_value(path, child) for child in children]
    entries: dict[str, Any] = {}
    for child in children:
        if child.tag in entries:
            raise InputError(f"{path}: <{child.tag}> occurs twice in <{element.tag}>")
        entries[child.tag] = _value(path, child)
    if {"rows", "cols", "data"} <= entries.keys() and not isinstance(entries["data"], list):
        entries["data"] = [entries["data"]]  # a matrix of one number
    return entries


def _words(text: str) -> list[Any]:
    text = text.strip()
    if text.startswith('"'):
        return [text.strip('"')]
    try:
        return [_number(word) for word in text.split()]
    except ValueError:
        return [text]


def _number(word: str) -> float | int:
    digits = word.lstrip("+-")
    # Whole numbers of up to 15 digits are below 2⁵³, where floats hold every one.
    is_integer = digits.isascii() and digits.isdigit() and len(digits) < 16
    return int(word) if is_integer else float(word.replace(".Nan", "nan").replace(".Inf", "inf"))
