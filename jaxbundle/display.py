"""Display of results: in one screen, and as gridded data of xarray where it is installed.

Arrays are shown by type and shape, long lists by their first entries; nothing is computed for it.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import numpy as np

from jaxbundle.system.terminals import for_printing

# 24 lines: the height of a terminal where nobody has changed it.
LINES, WIDTH = 24, 100
# Numbers of an array, or entries of a list, that are shown.
SHOWN_ENTRIES = 4
T = TypeVar("T", bound=type)


def print_in_one_screen(cls: T) -> T:
    """A dataclass of results whose `repr` is one screen: what `str` says, else its fields."""
    setattr(cls, "__repr__", describe)  # noqa: B010
    return print_anywhere(cls)


def print_anywhere(cls: T) -> T:
    """A class whose own `str` and `repr` can be printed where standard output is not UTF-8, as in
    a redirect on Windows: "s0" for σ0 (`for_printing`)."""
    for name in {"__str__", "__repr__"} & vars(cls).keys():
        setattr(cls, name, _as_printed(vars(cls)[name]))
    return cls


def _as_printed(say: Callable[[Any], str]) -> Callable[[Any], str]:
    return functools.wraps(say)(lambda self: for_printing(say(self)))


def describe(value: Any) -> str:
    """One screen about a result: what its class says of it, else its fields in short."""
    if type(value).__str__ is not object.__str__:
        lines = [
            line if len(line) <= WIDTH else f"{line[: WIDTH - 1]}…"
            for line in str(value).splitlines()
        ]
    else:
        fields = [f for f in dataclasses.fields(value) if f.repr]
        lines = [f"  {f.name}={abbreviate(getattr(value, f.name))}," for f in fields]
        lines = [f"{type(value).__name__}(", *lines, ")"]
    return "\n".join(lines if len(lines) <= LINES else [*lines[: LINES - 1], "…"])


def abbreviate(value: Any, depth: int = 0) -> str:
    """A value in less than a line."""
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        short = value.size <= SHOWN_ENTRIES and isinstance(value, np.ndarray | np.generic)
        text = " ".join(str(value).split()) if short else f"{value.dtype}{[*value.shape]}"
    elif isinstance(value, Mapping):
        parts = [f"{k!r}: {abbreviate(value[k], depth + 1)}" for k in [*value][:SHOWN_ENTRIES]]
        text = f"{{{', '.join(_with_total(parts, len(value), depth))}}}"
    elif isinstance(value, tuple | list):
        parts = [abbreviate(name, depth + 1) for name in value[:SHOWN_ENTRIES]]
        text = "({})" if isinstance(value, tuple) else "[{}]"
        text = text.format(", ".join(_with_total(parts, len(value), depth)))
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        size = getattr(value, "__len__", None)
        number = "" if size is None else f" of {size()}"
        text = f"<{type(value).__name__}{number}>"
    else:
        text = " ".join(repr(value).split())
    # 24: the indent, the name of a field (20 letters), = and the comma stand on the same line.
    return text if len(text) <= WIDTH - 24 else f"{text[: WIDTH - 25]}…"


def _with_total(parts: list[str], number: int, depth: int) -> list[str]:
    """The parts, and the number of all if some are omitted; at depth only the number."""
    if depth > 1 and number:
        return [f"{number} entries"]
    return parts if number <= SHOWN_ENTRIES else [*parts, f"… {number} in all"]


def data_set(
    arrays: Mapping[str, tuple[tuple[str, ...], np.ndarray, str]],
    coordinates: Mapping[str, tuple[np.ndarray, str]],
    **about: Any,
):
    """Gridded arrays as an `xarray.Dataset`: by name dimensions, values and unit; coordinates with
    theirs; attributes.

    **Raises:** `ImportError` without xarray (extra `grids`)."""
    try:
        import xarray
    except ImportError as error:
        raise ImportError("data sets need xarray: pip install 'jaxbundle[grids]'") from error
    return xarray.Dataset(
        {name: (dims, values, {"units": unit}) for name, (dims, values, unit) in arrays.items()},
        {name: (name, values, {"units": unit}) for name, (values, unit) in coordinates.items()},
        {name: value for name, value in about.items() if value is not None},
    )
