"""What every result offers, whatever was computed."""

import abc
import json
import math
import os
from collections.abc import Mapping
from html import escape
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol, runtime_checkable

import numpy as np

from jaxbundle.errors import InputError
from jaxbundle.system.temporaries import temporary
from jaxbundle.system.terminals import in_utf8

NO_UNITS: Mapping[str, str] = MappingProxyType({})


@runtime_checkable
class ReportedResult(Protocol):
    """A result of `jaxbundle`: `adjust`, `calibrate`, `reconstruct`, `surface`, and the others.

    Results with a table have `to_pandas()` as well, and those with several tables take its name.
    """

    @property
    def converged(self) -> Any:
        """Whether there is a solution: check it first. Of a batch an array, one a camera."""
        ...

    def __str__(self) -> str:
        """A summary that fits a screen."""
        ...

    def report(self) -> str:
        """The full report as text, as the command prints it."""
        ...

    def to_dict(self) -> Mapping[str, Any]:
        """The result as plain dicts, lists, texts and numbers, as in the JSON of the command."""
        ...

    def save(self, path: str | Path) -> None:
        """Write the result into a file: JSON, or what the class says."""
        ...

    def _repr_html_(self) -> str:
        """The result in a cell of a notebook."""
        ...


class ResultMethods(abc.ABC):
    """Methods of a `ReportedResult` that follow from `__str__` and `to_dict`."""

    @property
    def converged(self) -> Any:
        """Whether there is a solution: always, since without one there is an exception."""
        return True

    def report(self) -> str:
        """The result as text."""
        return str(self)

    @abc.abstractmethod
    def to_dict(self) -> dict[str, Any]:
        """The result as plain dicts and numbers, as in JSON."""

    def save(self, path: str | Path) -> None:
        """Write the result as JSON; what is not finite is null.

        **Raises:** `InputError` if the file cannot be written."""
        text = json.dumps(finite(self.to_dict()), ensure_ascii=False) + "\n"
        try:
            with temporary(f"{os.fspath(path)}.{os.getpid()}.new") as new:
                Path(new).write_text(in_utf8(text), encoding="utf-8")
                os.replace(new, path)
        except OSError as error:
            raise InputError(f"{path}: cannot be written: {error.strerror}") from None

    def _repr_html_(self) -> str:
        return f"<pre>{escape(str(self))}</pre>"


class TableMethods(ResultMethods):
    """A result with one table."""

    @abc.abstractmethod
    def table(self) -> Mapping[str, np.ndarray]:
        """Columns by name."""

    def to_pandas(self) -> Any:
        """`table` as a pandas data frame (extra `tables`)."""
        return data_frame(self.table())


def finite(value: Any) -> Any:
    """A value with None for NaN and infinity, which do not exist in JSON."""
    if isinstance(value, Mapping):
        return {key: finite(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [finite(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def rows_of(table: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The rows of a table of columns (arrays), each by the names of the columns."""
    return finite([dict(zip(table, row)) for row in zip(*(c.tolist() for c in table.values()))])


def data_frame(
    columns: Mapping[str, np.ndarray], units: Mapping[str, str] = NO_UNITS, *, heads: bool = False
) -> Any:
    """Columns as a pandas data frame. The units of columns are in its `attrs["units"]`, so that
    columns keep their names; `heads`: names and units are the two levels of its columns.

    **Raises:** `ImportError` without pandas (extra `tables`)."""
    try:
        import pandas
    except ImportError as error:
        raise ImportError("data frames need pandas: pip install 'jaxbundle[tables]'") from error
    frame = pandas.DataFrame(columns)
    if heads:
        pairs = [(name, units.get(name, "")) for name in columns]
        frame.columns = pandas.MultiIndex.from_tuples(pairs, names=("quantity", "unit"))
    elif units:
        frame.attrs["units"] = dict(units)
    return frame
