"""Fields of a JSON document, or a similar one (YAML, a Python dictionary), by their path; errors
name file and field."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxbundle.arguments import show
from jaxbundle.errors import InputError
from jaxbundle.network.tables import Source
from jaxbundle.system.file_content import parse_json


class JsonFields:
    """A JSON object with access to fields by their path, "a.b".

    **Raises:** `InputError` naming file and field: a missing one, an invalid number or shape.
    """

    def __init__(self, path: str | Path, document: dict[str, Any]):
        self.path, self.document = path, document

    def get(self, key: str, default: Any = None) -> Any:
        """The value of a field, of any kind."""
        value = self.document
        for part in key.split("."):
            if not isinstance(value, dict) or part not in value:
                return default
            value = value[part]
        return value

    def number(self, key: str, default: float | None = None) -> float:
        """A finite number."""
        return float(self.array(key, (), default))

    def array(
        self, key: str, shape: tuple[int | None, ...], default: Any = None
    ) -> Float[np.ndarray, "..."]:
        """Numbers of a shape; None means any length."""
        value = self.get(key, default)
        if value is None:
            raise InputError(f"{self.path}: {key} is missing")
        try:
            array = np.array(value, float)
        except (TypeError, ValueError, OverflowError):
            array = np.array(np.nan)
        fits = array.ndim == len(shape) and all(n in (None, m) for n, m in zip(shape, array.shape))
        if not fits or not np.isfinite(array).all():
            size = " × ".join("n" if n is None else str(n) for n in shape)
            kind = f"an array {size} of finite numbers" if shape else "a finite number"
            raise InputError(f"{self.path}: {key} is {show(value)}; expected {kind}")
        return array

    def integer(self, key: str, default: int | None = None, minimum: int = 0) -> int:
        """A whole number that is not less than `minimum`."""
        value = self.number(key, default)
        # Beyond 2⁵³ floats are all whole: a number there has lost digits.
        if not (value.is_integer() and minimum <= value < 2**53):
            raise InputError(
                f"{self.path}: {key} is {value:g}; expected a whole number from {minimum}"
            )
        return int(value)

    def text(self, key: str, default: str | None = None) -> str:
        """A text; a number is converted to text."""
        value = self.get(key, default)
        if isinstance(value, bool) or not isinstance(value, str | int | float) or value == "":
            problem = "missing" if value in (None, "") else f"{show(value)}; expected a text"
            raise InputError(f"{self.path}: {key} is {problem}")
        return str(value)

    def child(self, key: str) -> "JsonFields":
        """The object in a field."""
        value = self.get(key)
        if not isinstance(value, dict):
            problem = "missing" if value is None else f"{show(value)}; expected an object"
            raise InputError(f"{self.path}: {key} is {problem}")
        return JsonFields(f"{self.path}, {key}", value)

    def objects(self, key: str) -> dict[str, "JsonFields"]:
        """The objects in a field with an object of objects; none if it is missing."""
        fields = self.child(key) if self.get(key) is not None else JsonFields(self.path, {})
        return {
            id: _object(f"{self.path}, {key} {show(id)}", value)
            for id, value in fields.document.items()
        }

    def rows(self, key: str) -> list["JsonFields"]:
        """The objects in a list, counted from 0 in messages; none if it is missing."""
        value = self.get(key, [])
        # The property trees of Boost write an empty list as an empty text.
        value = [] if value == "" else value
        if not isinstance(value, list):
            raise InputError(f"{self.path}: {key} is {show(value)}; expected a list")
        return [_object(f"{self.path}, {key}[{k}]", row) for k, row in enumerate(value)]

    def source(self, key: str) -> Source:
        """Names the rows of a table in messages."""
        return Source(f"{self.path}, {key}")


def _object(where: str, value: Any) -> JsonFields:
    if not isinstance(value, dict):
        raise InputError(f"{where} is {show(value)}; expected an object")
    return JsonFields(where, value)


def stack_rows(
    values: Sequence[Any], size: int, location_of: Callable[[int], tuple[str, str]]
) -> Float[np.ndarray, "n size"]:
    """Many lists of numbers as one array [len(values), size]; of the k-th, `location_of(k)` names
    file and field.

    **Raises:** `InputError` for the first invalid list.
    """
    try:
        array = np.array(values, float).reshape(len(values), size)
    except (TypeError, ValueError, OverflowError):
        array = np.full((1, 1), np.nan)
    if np.isfinite(array).all():
        return array
    # Only for a file with a fault: list by list, up to the faulty one.
    rows = ((*location_of(k), value) for k, value in enumerate(values))
    return np.array([JsonFields(path, {key: v}).array(key, (size,)) for path, key, v in rows])


def read_object(path: str | Path, text: str, kind: str) -> dict[str, Any]:
    """The JSON object in a text; `kind` names the expected content in messages."""
    document = parse_json(path, text)
    if not isinstance(document, dict):
        raise InputError(f"{path}: expected an object with the fields of {kind}")
    return document
