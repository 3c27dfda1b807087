"""The interface of explorer views, and the checks of their input."""

import math
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple, Protocol

from jaxbundle.arguments import show
from jaxbundle.errors import InputError
from jaxbundle.network.columns import did_you_mean
from jaxbundle.report.page import Page

# Values of the controls, by their keys.
Given = Mapping[str, Any]


class File(NamedTuple):
    """A file to download: its name, its media type, its content."""

    name: str
    type: str
    content: bytes


class ExplorerView(Protocol):
    """An explorer view.

    `given` are the values of the controls sent by the page; methods raise `InputError` or
    `NotSolvedError` for values that they cannot compute.
    """

    def page(self, given: Given, live: bool) -> Page:
        """The page with these values; `live`: its controls call the server, otherwise it is a
        standalone copy."""
        ...

    def answer(self, given: Given) -> dict[str, Any]:
        """The answer to these values: `parts`, HTML by element id, and further data for the scripts
        of the view."""
        ...

    def export(self, name: str, given: Given, /) -> File:
        """The file of this name with these values."""
        ...


def number(given: Given, key: str, default: float, low: float = -math.inf) -> float:
    """The number of a control; `default` if the page does not send it.

    **Raises:** `InputError` if it is not a finite number, or below `low`.
    """
    value = given.get(key, default)
    fits = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    if not fits or value < low:
        minimum_in_words = "" if low == -math.inf else f" of at least {low:g}"
        raise InputError(f"{key} must be a finite number{minimum_in_words}, but is {show(value)}")
    return float(value)


def switch(given: Given, key: str) -> bool:
    """Whether a box is ticked.

    **Raises:** `InputError`."""
    value = given.get(key, False)
    if not isinstance(value, bool):
        raise InputError(f"{key} must be true or false, but is {show(value)}")
    return value


def word(given: Given, key: str, default: str, words: Iterable[str]) -> str:
    """One of some words.

    **Raises:** `InputError`."""
    value, words = given.get(key, default), tuple(words)
    if value not in words:
        raise InputError(f"{key} is {show(value)}{did_you_mean(str(value), words)}")
    return value


def check_keys(given: Given, known_keys: Iterable[str]) -> None:
    """Refuse values of unknown controls.

    **Raises:** `InputError`."""
    known_keys = tuple(known_keys)
    for key in given:
        if key not in known_keys:
            raise InputError(f"there is no value {show(key)}{did_you_mean(str(key), known_keys)}")
