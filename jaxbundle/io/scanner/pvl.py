"""DigitalGlobe's support data as text (PVL): NAME.IMD with NAME.EPH, NAME.ATT, NAME.GEO beside it.

    numRows = 600;
    BEGIN_GROUP = IMAGE_1
        TLCList = ( (0, 0.0), (600, 4.0) );
    END_GROUP = IMAGE_1

They have the names of the XML files in another spelling, numbered groups, and lists in brackets;
they are read as the tree of elements of the XML file.
"""

import re
import xml.etree.ElementTree as ET
from pathlib import Path

from jaxbundle.errors import InputError
from jaxbundle.io.text.csv_tables import read_text

# A text in quotes, or a comment: from /* to */, or from # to the end of its line.
TEXT_OR_COMMENT = re.compile(r'"[^"]*"|/\*.*?\*/|(?:(?<=\s)|^)#[^\n]*', re.DOTALL | re.MULTILINE)
GROUPS = ("IMD", "EPH", "ATT", "GEO")
STATEMENT = re.compile(r"\s*([^=;]+?)\s*=\s*")
ROW = re.compile(r"\(([^()]*)\)")


def read_support_data(path: Path) -> ET.Element:
    """The tree of an IMD file and those beside it.

    **Raises:** `InputError` if one is missing, or is not PVL, naming file and line.
    """
    root = ET.Element("isd")
    beside = {p.suffix.upper(): p for p in path.parent.glob("*") if p.stem == path.stem}
    for name in GROUPS:
        file = beside.get(f".{name}")
        if file is None:
            raise InputError(
                f"{path}: {path.stem}.{name} is not next to it; {', '.join(GROUPS)} belong together"
            )
        _add_file(file, ET.SubElement(root, name))
    return root


def _add_file(path: Path, root: ET.Element) -> None:
    """Add the groups and values of a file to an element."""
    text, begin, groups = without_comments(read_text(path, fallback="latin-1")), 0, [root]
    error_at = lambda message: InputError(
        f"{path}, line {text[:begin].count(chr(10)) + 1}: {message}"
    )
    while (remainder := text[begin:].strip()) and not remainder.upper().startswith("END;"):
        begin = len(text) - len(text[begin:].lstrip())
        match = STATEMENT.match(text, begin)
        if match is None:
            raise error_at("expected NAME = value;")
        name = match[1].upper()
        if name in ("BEGIN_GROUP", "END_GROUP"):
            line = text.find("\n", match.end())
            line = len(text) if line < 0 else line
            # IMAGE_1 → IMAGE: the XML has the name without the number
            tag = re.sub(r"_\d+$", "", text[match.end() : line].strip(" \t\r;").upper())
            if name == "BEGIN_GROUP":
                if not re.fullmatch(r"\w+", tag):
                    raise error_at("expected the name of a group")
                groups.append(ET.SubElement(groups[-1], tag))
            elif len(groups) == 1 or groups.pop().tag != tag:
                raise error_at(f"the group {tag} ends without a beginning")
            begin = line
            continue
        end = text.find(";", match.end())
        if end < 0 or not re.fullmatch(r"\w+", name):
            raise error_at("expected NAME = value;")
        _add_value(groups[-1], name, text[match.end() : end].strip())
        begin = end + 1
    if len(groups) > 1:
        raise InputError(f"{path}: the group {groups[-1].tag} does not end")


def without_comments(text: str) -> str:
    """PVL without its comments; every line keeps its number."""
    blank = lambda match: match[0] if match[0][0] == '"' else "\n" * match[0].count("\n")
    return TEXT_OR_COMMENT.sub(blank, text)


def _add_value(group: ET.Element, name: str, value: str) -> None:
    """A value; a list as NAMEList with NAME for each row."""
    if not value.startswith("("):
        ET.SubElement(group, name).text = value.strip('"')
        return
    rows = ET.SubElement(group, f"{name}List")
    inner = value[1 : value.rfind(")")]
    for row in ROW.findall(inner) if "(" in inner else [inner]:
        ET.SubElement(rows, name).text = row.strip()
