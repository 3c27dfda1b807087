"""Elements of an XML document by their path; errors name the place."""

import re
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxbundle.arguments import show
from jaxbundle.errors import InputError
from jaxbundle.io.text.csv_tables import read_text
from jaxbundle.system.file_content import ENDS_EARLY

# UTC; digits below a nanosecond are dropped.
TIME = re.compile(r"(\d{4}-\d\d-\d\d)[T ](\d\d:\d\d:\d\d(?:\.\d{1,9})?)\d*Z?")


class XmlFields:
    """An XML document with access to elements by their path, anywhere in it.

    `kind` names the expected document in messages; names are without namespaces.

    **Raises:** `InputError` naming file and element: a missing one, an invalid number or time.
    """

    def __init__(self, path: str | Path, root: ET.Element, kind: str):
        self.path, self.root, self.kind = Path(path), root, kind

    def find(self, key: str) -> ET.Element | None:
        """The first element of a path."""
        return self.root.find(key if self.root.tag == key else f".//{key}")

    def text(self, key: str, default: str | None = None) -> str:
        """The text of an element."""
        element = self.find(key)
        text = default if element is None else (element.text or "")
        if text is None:
            raise self.missing_error(key)
        return text.strip()

    def number(self, key: str, default: float | None = None) -> float:
        """A finite number."""
        text = self.text(key, None if default is None else repr(default))
        return number_in(text, f"{self.path}: {key}")

    def numbers(self, key: str, count: int | None = None) -> Float[np.ndarray, " n"]:
        """The numbers in the text of an element, separated by blanks or commas."""
        words = self.text(key).replace(",", " ").split()
        if count is not None and len(words) != count:
            raise InputError(f"{self.path}: {key} has {len(words)} numbers; expected {count}")
        return np.array([number_in(word, f"{self.path}: {key}") for word in words])

    def time(self, key: str) -> np.datetime64:
        """A date and time, UTC."""
        return time_in(self.text(key), f"{self.path}: {key}")

    def elements(self, key: str) -> list[ET.Element]:
        """Repeated elements, from the first list of them."""
        parent, _, tag = key.rpartition("/")
        list_element = self.find(parent)
        elements = [] if list_element is None else list_element.findall(tag)
        if not elements:
            raise self.missing_error(key)
        return elements

    def columns(self, key: str, names: Sequence[str]) -> Float[np.ndarray, "elements names"]:
        """Numbers [elements, names] of repeated elements."""
        tag = key.rpartition("/")[2]
        return np.array(
            [
                [
                    number_in(e.findtext(name, ""), f"{self.path}: {tag} {k}, {name}")
                    for name in names
                ]
                for k, e in enumerate(self.elements(key), 1)
            ]
        )

    def times(
        self, key: str, epoch: np.datetime64, name: str = "TIME"
    ) -> Float[np.ndarray, " elements"]:
        """Seconds since the epoch of repeated elements."""
        tag = key.rpartition("/")[2]
        times = [
            time_in(e.findtext(name, ""), f"{self.path}: {tag} {k}, {name}")
            for k, e in enumerate(self.elements(key), 1)
        ]
        return np.array([seconds(t, epoch) for t in times])

    def missing_error(self, key: str) -> InputError:
        """The error for a missing element."""
        return InputError(f"{self.path}: {key} is missing; expected {self.kind}")


def read_xml(path: str | Path) -> ET.Element:
    """The root of a document, namespaces removed.

    **Raises:** `InputError` if it cannot be read, is not XML, or defines entities, which unpack to
    gigabytes or name other files.
    """
    return parse_xml(path, read_text(Path(path), fallback="latin-1"))


def parse_xml(path: str | Path, text: str) -> ET.Element:
    """The root of the document in a text; `path` names it in messages. Raises as `read_xml`."""
    from defusedxml.common import DefusedXmlException
    from defusedxml.ElementTree import ParseError, fromstring

    try:
        root = fromstring(text)
        for element in root.iter():
            if isinstance(element.tag, str):
                element.tag = element.tag.rpartition("}")[2]
    except DefusedXmlException:
        raise InputError(f"{path}: entities are not expected in this file") from None
    except (ParseError, ValueError) as error:
        # Expat's errors 3 and 5, no element found and unclosed token, are of an end too early.
        early = ENDS_EARLY if text.strip() and getattr(error, "code", 0) in (3, 5) else ""
        raise InputError(f"{path}: not valid XML: {error}{early}") from None
    except RecursionError:
        raise InputError(f"{path}: not valid XML: elements are nested too deeply") from None
    return root


def number_in(text: str, where: str) -> float:
    """The finite number in a text."""
    try:
        value = float(text)
        is_valid = np.isfinite(value) and "_" not in text
    except ValueError:
        is_valid = False
    if not is_valid:
        raise InputError(f"{where} is {show(text)}; expected a finite number")
    return value


def time_in(text: str, where: str) -> np.datetime64:
    """The time in a text, to the nanosecond."""
    try:
        if match := TIME.fullmatch(text.strip()):
            return np.datetime64("T".join(match.groups()), "ns")
    except ValueError:  # a 13th month
        pass
    raise InputError(f"{where} is {show(text)}; expected a time such as 2008-03-04T12:31:03.081912")


def seconds(time: np.datetime64, epoch: np.datetime64) -> float:
    """The seconds from an epoch to a time."""
    # Through whole nanoseconds: a float of seconds since 1970 has some tenths of a microsecond.
    return float((time - epoch) / np.timedelta64(1, "ns") * 1e-9)
