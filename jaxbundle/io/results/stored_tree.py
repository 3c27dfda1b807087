"""Tables and settings as one file: numbers as the arrays of an .npz, the rest as JSON text in it.

Only dataclasses listed by the reader become objects again, and nothing in a file is executed: files
of unknown origin can be read.
"""

import dataclasses
import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxbundle.errors import InputError
from jaxbundle.io.text.archives import read_arrays
from jaxbundle.io.writing.replacing import replace_file
from jaxbundle.system.file_content import parse_json

# The array of the file that holds the JSON text.
HEAD = "head"


def write_tree(path: str | Path, tree: Any, classes: Sequence[type]) -> None:
    """Write a tree of numbers, texts, arrays, tuples, lists, maps and dataclasses of `classes`.

    **Raises:** `InputError` for anything else, and if the file cannot be written."""
    head, arrays = flatten(tree, classes)
    with replace_file(path) as temporary, temporary.open("wb") as file:
        content: dict[str, Any] = {HEAD: np.frombuffer(head, np.uint8), **arrays}
        np.savez_compressed(file, **content)


def read_tree(path: str | Path, classes: Sequence[type], expected: str) -> Any:
    """Read a tree of `write_tree`; `expected`: its content in words, for messages.

    **Raises:** `InputError` for a missing file, or other content."""
    arrays = read_arrays(path, expected)
    damaged = InputError(f"{path}: is not {expected}, or is damaged")
    if HEAD not in arrays:
        raise damaged
    document = parse_json(path, arrays.pop(HEAD).tobytes().decode(errors="replace"))
    try:
        return _restore(document, arrays, {cls.__name__: cls for cls in classes})
    except (ValueError, TypeError, LookupError, AttributeError):
        # Classes refuse what does not fit their fields by errors of their own.
        raise damaged from None


def fingerprint(tree: Any, classes: Sequence[type], without: Sequence[type] = ()) -> str:
    """16 hex digits of a tree; objects in `without` are ignored."""
    head, arrays = flatten(tree, classes, without)
    digest = hashlib.blake2b(head, digest_size=8)
    for array in arrays.values():
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def flatten(
    tree: Any, classes: Sequence[type], without: Sequence[type] = ()
) -> tuple[bytes, dict[str, np.ndarray]]:
    """JSON text, and the arrays it refers to by name."""
    arrays: dict[str, np.ndarray] = {}
    names = {cls: cls.__name__ for cls in classes}

    def serialise(value: Any) -> Any:
        if value is None or isinstance(value, bool | int | float | str):
            return value
        if isinstance(value, tuple(without)):
            return None
        if isinstance(value, np.generic):
            return serialise(value.item())
        if isinstance(value, np.ndarray | jax.Array):
            array = np.asarray(value)
            if array.dtype.kind in "biuf":
                arrays[f"array{len(arrays)}"] = array
                return {"array": f"array{len(arrays) - 1}"}
        if isinstance(value, tuple):
            return {"tuple": [serialise(element) for element in value]}
        if isinstance(value, list):
            return [serialise(element) for element in value]
        if isinstance(value, Mapping):
            return {"map": [[serialise(key), serialise(element)] for key, element in value.items()]}
        if type(value) in names:
            kind: Any = type(value)
            fields = [f.name for f in dataclasses.fields(kind)]
            return {names[kind]: {name: serialise(getattr(value, name)) for name in fields}}
        raise InputError(f"a {type(value).__name__} cannot be saved")

    return json.dumps(serialise(tree), ensure_ascii=False).encode(), arrays


def _restore(value: Any, arrays: Mapping[str, np.ndarray], classes: Mapping[str, type]) -> Any:
    restore = lambda element: _restore(element, arrays, classes)
    if isinstance(value, list):
        return [restore(element) for element in value]
    if not isinstance(value, dict):
        return value
    ((kind, content),) = value.items()
    if kind == "array":
        return arrays[content]
    if kind == "tuple":
        return tuple(restore(element) for element in content)
    if kind == "map":
        return {restore(key): restore(element) for key, element in content}
    return classes[kind](**{name: restore(element) for name, element in content.items()})
