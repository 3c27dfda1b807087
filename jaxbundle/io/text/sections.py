"""TOML files of named sections: checks of keys and types, with common messages."""

import dataclasses
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxbundle.arguments import show
from jaxbundle.errors import InputError
from jaxbundle.io.text.csv_tables import read_csv, read_toml
from jaxbundle.io.text.toml_text import assignments
from jaxbundle.network.columns import Columns, did_you_mean, refuse_unknown
from jaxbundle.network.units import ANGLE_UNITS


@dataclasses.dataclass(frozen=True)
class TomlFile:
    """A TOML file as sections of keys."""

    path: Path
    document: dict[str, Any]

    def section(self, name: str) -> "TomlSection":
        """A section, empty if it is missing."""
        return TomlSection(self, f"{self.path}, [{name}]: ", self.document.get(name, {}))

    def require(self, names: Sequence[str], otherwise: str = "") -> None:
        """Refuse a file that lacks one of these sections; `otherwise`: what may be there instead,
        for the message."""
        for name in names:
            if name not in self.document:
                raise InputError(f"{self.path}: the section [{name}] is missing{otherwise}")

    @property
    def radians(self) -> float:
        """Radians in one unit of the file's angles."""
        unit = self.section("scanner").text("angle_unit", "deg")
        if unit not in ANGLE_UNITS:
            raise InputError(f"{self.path}: angle_unit {unit!r}{did_you_mean(unit, ANGLE_UNITS)}")
        return ANGLE_UNITS[unit]


def read_sections(
    path: Path, sections: Mapping[str, Sequence[str]], required: Sequence[str]
) -> TomlFile:
    """A TOML file with known sections and keys (an empty list: any key).

    **Raises:** `InputError` for unknown or missing entries.
    """
    document = read_toml(path)
    for key, value in document.items():
        refuse_unknown(key, sections, f"{path}: ", "section")
        if not isinstance(value, dict):
            raise InputError(f"{path}: {key} must be a section, [{key}]")
        if sections[key]:
            TomlSection(None, f"{path}, [{key}]: ", value).check_keys(sections[key])
    file = TomlFile(path, document)
    file.require(required)
    return file


@dataclasses.dataclass(frozen=True)
class TomlSection:
    """One section; every getter refuses missing entries and other types."""

    file: TomlFile | None
    where: str
    values: dict[str, Any]

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def _get(self, key: str, default: Any, expected: str, kinds: tuple[type, ...]) -> Any:
        value = self.values.get(key, default)
        if value is None:
            raise InputError(f"{self.where}{key} is missing; expected {expected}")
        # True and False are whole numbers in Python, but not where a file needs a number
        if not isinstance(value, kinds) or isinstance(value, bool) and bool not in kinds:
            raise InputError(f"{self.where}{key} is {show(value)}; expected {expected}")
        return value

    def check_keys(self, allowed_keys: Sequence[str]) -> None:
        """Refuse other keys."""
        for key in self.values:
            refuse_unknown(key, allowed_keys, self.where)

    def number(self, key: str, default: float | None = None) -> float:
        """A finite number."""
        value = float(self._get(key, default, "a number", (int, float)))
        if not np.isfinite(value):
            raise InputError(f"{self.where}{key} is {value}; expected a finite number")
        return value

    def integer(self, key: str, default: int | None = None, at_least: int = 2) -> int:
        """A whole number, 2 or more, or another least one."""
        value = self._get(key, default, f"a whole number, {at_least} or more,", (int,))
        if value < at_least:
            raise InputError(f"{self.where}{key} is {value}; expected {at_least} or more")
        return value

    def text(self, key: str, default: str | None = None) -> str:
        """Text."""
        return self._get(key, default, "text in quotes", (str,))

    def switch(self, key: str) -> bool:
        """True or false; false if it is missing."""
        return self._get(key, False, "true or false", (bool,))

    def numbers(self, key: str, count: int | None = None) -> np.ndarray:
        """A list of finite numbers, of a given length."""
        expected = f"a list of {count or 'some'} numbers"
        values = self._get(key, None, expected, (list,))
        are_numbers = all(isinstance(v, int | float) and not isinstance(v, bool) for v in values)
        if not are_numbers or not values or count not in (None, len(values)):
            raise InputError(f"{self.where}{key} is {show(values)}; expected {expected}")
        array = np.array(values, float)
        if not np.isfinite(array).all():
            raise InputError(f"{self.where}{key} is {show(values)}; expected finite numbers")
        return array

    def path(self, key: str, expected: str, folder: bool = False) -> Path:
        """The file that a key names, beside the file of the section; also a folder, if it may be
        one."""
        name = self.text(key)
        path = self.beside(name)
        if not name or not os.path.exists(path):
            problem = f"no such file {path}" if name else "the name of a file is missing"
        elif not folder and os.path.isdir(path):
            problem = f"{path} is a folder"
        else:
            return path
        raise InputError(f"{self.where}{key} = {show(name)}: {problem}; expected {expected}")

    def paths(self, key: str, expected: str) -> list[Path]:
        """The files that a key names, one or a list of them."""
        names = self.values.get(key)
        if not isinstance(names, list):
            return [self.path(key, expected)]
        if not names:
            raise InputError(f"{self.where}{key} is an empty list; expected {expected}")
        section_of = lambda name: TomlSection(self.file, self.where, {key: name})
        return [section_of(name).path(key, expected) for name in names]

    def beside(self, name: str) -> Path:
        """The path of a name beside the file of the section."""
        if self.file is None:
            raise InputError(f"{self.where}{show(name)}: not in a file")
        return self.file.path.parent / name

    def table(self, key: str = "table") -> Columns:
        """The CSV table of a name, beside the file."""
        return read_csv(self.path(key, "a CSV table"))


def toml_text(document: Mapping[str, Mapping[str, Any]]) -> str:
    """Sections as text for `read_sections`."""
    parts = []
    for name, section in document.items():
        parts.append("\n".join([f"[{name}]", *assignments(section)]))
    return "\n\n".join(parts) + "\n"
