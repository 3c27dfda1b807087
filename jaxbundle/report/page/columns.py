"""Tables for the page: columns of numbers and names as compact JSON, which `table.js` decodes.

Numbers are base64 of little-endian arrays, of the smallest type of integers that holds them, of
32-bit floats where these are enough; a column of equal values is one value. Names that repeat are
listed once. The text cannot end a script element or begin a comment.
"""

import base64
import json
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from jaxbundle.report.layout import DIGITS_WITHOUT_SIGMA, digits_of

INTEGERS = ("<u1", "<u2", "<i4")


class Column(NamedTuple):
    """A column: `label` in the header, None where it is only drawn; decimal `places`, or minus the
    number of significant digits; `exact`: 64-bit floats; `digits`: significant ones by row, in
    place of `places`."""

    values: np.ndarray
    label: str | None = None
    places: int = -3
    exact: bool = False
    digits: np.ndarray | None = None


def estimates(values: np.ndarray, sigma: np.ndarray, label: str) -> Column:
    """A column of values of different kinds, each with the digits that its σ gives it."""
    return Column(
        values,
        label,
        -DIGITS_WITHOUT_SIGMA,
        True,
        np.array([digits_of(value, s) for value, s in zip(values, sigma)], int),
    )


def encode_table(columns: Mapping[str, Column]) -> dict[str, Any]:
    """The columns of a table by name, as plain values for JSON."""
    length = max((len(column.values) for column in columns.values()), default=0)
    return {
        "length": length,
        "columns": {
            name: {"label": column.label, "places": column.places}
            | ({} if column.digits is None else {"digits": _pack(column.digits)})
            | encode_values(column.values, column.exact)
            for name, column in columns.items()
        },
    }


def encode_values(values: np.ndarray, exact: bool = False) -> dict[str, Any]:
    """One column: `names` and the codes of the rows, or numbers alone."""
    values = np.asarray(values)
    if values.dtype == bool:
        values = np.where(values, "yes", "no").astype(object)
    if values.dtype.kind in "OU":
        # Ids repeat in every row of an image or a point.
        codes: dict[str, int] = {}
        row_codes = [codes.setdefault(str(value), len(codes)) for value in values]
        return {"names": list(codes)} | _pack(np.array(row_codes, int))
    return _pack(values, exact)


def _pack(values: np.ndarray, exact: bool = False) -> dict[str, Any]:
    if values.dtype.kind in "iu":
        low, high = (int(limit_of(initial=0)) for limit_of in (values.min, values.max))
        ranges = ((k, np.iinfo(k)) for k in INTEGERS)
        kind = next((k for k, limits in ranges if limits.min <= low and high <= limits.max), "<f8")
    else:
        kind = "<f8" if exact else "<f4"
    # The page decodes little-endian bytes, whatever this machine has.
    packed = np.ascontiguousarray(values, kind)
    if len(packed) > 1 and np.isfinite(packed[0]) and (packed == packed[0]).all():
        return {"type": kind[1:], "same": packed[0].item()}
    return {"type": kind[1:], "data": base64.b64encode(packed.tobytes()).decode("ascii")}


def script_text(value: Any) -> str:
    """JSON that is safe in a script element: ASCII without `<`."""
    return json.dumps(value, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")


def numbers(rows: Iterable[Any]) -> np.ndarray:
    """Numbers of which some are None: NaN."""
    return np.array([np.nan if value is None else value for value in rows], float)
