"""Fields of a JSON document, asked for by their path; what is wrong is said with file and field."""

from pathlib import Path
from typing import Any

import numpy as np

from jaxbundle.errors import InputError
from jaxbundle.network.columns import shown
from jaxbundle.network.tables import Source
from jaxbundle.system.file_content import parse_json


class JsonFields:
    """A JSON object whose fields are asked for by their path, "a.b".

    **Raises:** `InputError` naming file and field: what is missing, no number, of another shape.
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

    def array(self, key: str, shape: tuple[int | None, ...], default: Any = None) -> np.ndarray:
        """Numbers of a shape; None in it is any length."""
        value = self.get(key, default)
        if value is None:
            raise InputError(f"{self.path}: {key} is missing")
        try:
            array = np.array(value, float)
        except (TypeError, ValueError):
            array = np.array(np.nan)
        fits = array.ndim == len(shape) and all(
            n in (None, m) for n, m in zip(shape, array.shape)
        )
        if not fits or not np.isfinite(array).all():
            size = " × ".join("n" if n is None else str(n) for n in shape)
            kind = f"an array {size} of finite numbers" if shape else "a finite number"
            raise InputError(f"{self.path}: {key} is {shown(value)}; {kind} is expected")
        return array

    def source(self, key: str) -> Source:
        """Names the rows of a table in messages."""
        return Source(f"{self.path}, {key}")


def read_object(path: str | Path, text: str, kind: str) -> dict[str, Any]:
    """The object that a text is; `kind` is what it should be, for messages."""
    document = parse_json(path, text)
    if not isinstance(document, dict):
        raise InputError(f"{path}: an object with the fields of {kind} is expected")
    return document
