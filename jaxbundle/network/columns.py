"""A table as columns of raw values, and their conversion to ids and numbers.

Data frames, dicts of columns, lists of dicts, and text from file readers all pass through
`Columns`, so that a bad cell is always reported in the same words.
"""

import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from operator import index
from typing import Any, SupportsIndex

import numpy as np
from jaxtyping import Float, Int

from jaxbundle.arguments import refuse_traced, show
from jaxbundle.cameras.names import closest_name
from jaxbundle.errors import InputError
from jaxbundle.network.tables import Source
from jaxbundle.types import Column

# Types that Python or NumPy would convert silently: Booleans to 0 and 1, complex numbers to their
# real parts.
NO_NUMBERS = (bool, np.bool_, complex, np.complexfloating, type(np.ma.masked))


class RepeatedIds:
    """A column of millions of ids of which few differ: `labels[codes]`; labels may be an array of
    whole numbers. `are_rows`: the labels are the ids of the table that the column refers to, in
    its order."""

    def __init__(
        self,
        labels: Sequence[Any] | np.ndarray,
        codes: Int[np.ndarray, " rows"],
        are_rows: bool = False,
    ):
        self.labels, self.codes, self.are_rows = labels, codes, are_rows

    def __len__(self) -> int:
        return len(self.codes)

    def __getitem__(self, row: int) -> Any:
        return self.labels[self.codes[row]]

    def __iter__(self) -> Iterator[Any]:
        return map(self.labels.__getitem__, self.codes.tolist())

    def texts(self) -> Iterator[str]:
        """The labels as ids."""
        if isinstance(self.labels, np.ndarray) and self.labels.dtype.kind in "iu":
            return map(str, self.labels.tolist())
        return map(as_id, self.labels)


@dataclasses.dataclass(frozen=True)
class Columns:
    """Columns of equal length: text or numbers; None, NaN and empty text are missing values.

    `may_be_empty`: whether a table without rows is accepted.
    """

    values: Mapping[str, Column]
    source: Source
    may_be_empty: bool = False

    def __len__(self) -> int:
        return min((len(column) for column in self.values.values()), default=0)

    def check_names(self, required: Sequence[str], optional: Sequence[str] = ()) -> None:
        """Refuse missing and unknown columns, and a table without rows."""
        known_names = tuple(dict.fromkeys((*required, *optional)))
        for name in self.values:
            if name not in known_names:
                if name == "sigma" and {"sx", "sy"} <= {*known_names}:
                    raise InputError(
                        f"{self.source.name}: unknown column 'sigma'; σ have the columns sx and sy"
                    )
                raise InputError(
                    f"{self.source.name}: unknown column {name!r}{did_you_mean(name, known_names)}"
                )
        for name in required:
            if name not in self.values:
                raise InputError(
                    f"{self.source.name}: column {name!r} is missing; expected columns: "
                    f"{', '.join(required)}"
                )
        if len(self) == 0 and not self.may_be_empty:
            raise InputError(f"{self.source.name}: the table is empty; give at least one row")

    def column(self, name: str) -> Column:
        """The values of a column.

        **Raises:** `InputError` if the table has none of this name."""
        if name not in self.values:
            raise InputError(
                f"{self.source.name}: the column {name!r} is missing; found columns: "
                f"{', '.join(self.values)}"
            )
        return self.values[name]

    def ids(self, name: str) -> tuple[str, ...]:
        """A column of ids or words; integers become text, surrounding blanks are removed."""
        values = self.column(name)
        if isinstance(values, np.ndarray) and values.dtype.kind in "iu":
            return tuple(map(str, values.tolist()))
        ids = tuple(map(as_id, values))
        if "" in ids:
            raise InputError(f"{self.source(ids.index(''))}: {name} is missing")
        return ids

    def numbers(
        self, name: str, *, required: bool = False, words: Mapping[str, float] | None = None
    ) -> Float[np.ndarray, " rows"]:
        """A column of numbers; `words` are texts with a meaning, a missing value is NaN.

        An absent column is all NaN unless it is required.
        """
        if name not in self.values and not required:
            return np.full(len(self), np.nan)
        values = self.column(name)
        numbers = _plain_numbers(values)
        if numbers is None:
            numbers = np.array(
                [self._number(row, name, value, words or {}) for row, value in enumerate(values)]
            )
        if required and np.isnan(numbers).any():
            raise InputError(f"{self.source(np.isnan(numbers).argmax())}: {name} is missing")
        return numbers

    def _number(self, row: int, name: str, value: Any, words: Mapping[str, float]) -> float:
        if isinstance(value, str):
            value = value.strip()
            if value in words:
                return words[value]
        if is_missing(value):
            return math.nan
        try:
            number = math.nan if isinstance(value, NO_NUMBERS) else float(value)
            good = not isinstance(value, str) or (math.isfinite(number) and "_" not in value)
        except (TypeError, ValueError, OverflowError):
            good = False
        if not good or isinstance(value, NO_NUMBERS):
            or_word = "".join(f" or {word!r}" for word in words)
            raise InputError(
                f"{self.source(row)}: {name} is {show(value)}; expected a number{or_word}"
            )
        return number

    def indices(
        self, name: str, noun: str, row_by_id: Mapping[str, int], where: str
    ) -> Int[np.ndarray, " rows"]:
        """A column of ids as indices into another table (`noun`s in `where`)."""
        # Millions of rows: looked up at once, and searched for the unknown id only if there is one.
        values = self.column(name)
        try:
            if isinstance(values, np.ndarray) and values.dtype.kind in "iu":
                distinct, codes = np.unique(values, return_inverse=True)
                values = RepeatedIds(distinct, codes)
            if isinstance(values, RepeatedIds):
                rows_of_labels = [row_by_id.get(label, -1) for label in values.texts()]
                indices = np.array(rows_of_labels, np.int64)[values.codes]
                if indices.size and indices.min() < 0:
                    raise KeyError
                return indices
            ids = self.ids(name)
            return np.fromiter(map(row_by_id.__getitem__, ids), np.int64, len(ids))
        except KeyError:
            ids = self.ids(name)
            row = next(row for row, id in enumerate(ids) if id not in row_by_id)
            raise InputError(
                f"{self.source(row)}: {name} {ids[row]!r} is unknown: no such {noun} in {where}"
                f"{did_you_mean(ids[row], list(row_by_id), listing=False)}"
            ) from None


def as_columns(table: Any, name: str) -> Columns:
    """Columns of a data frame, a dict of columns, or a sequence of dict rows."""
    if isinstance(table, Columns):
        return table
    source = Source(name)
    if hasattr(table, "columns") and hasattr(table, "notna"):
        return _of_frame(table, source)
    if isinstance(table, Mapping):
        columns = {str(c): _column(values, c, name) for c, values in table.items()}
        lengths = {c: len(values) for c, values in columns.items()}
        if len(set(lengths.values())) > 1:
            raise InputError(f"{name}: the columns differ in length: {lengths}")
        return Columns(columns, source)
    is_scalar = isinstance(table, np.ndarray) and not table.ndim
    rows: list[Any] = list(table) if isinstance(table, Iterable) and not is_scalar else [table]
    if not all(isinstance(row, Mapping) for row in rows):
        raise InputError(
            f"{name}: expected a data frame of pandas, a dict of columns, or a list of dict rows, "
            f"not {show(table)}"
        )
    refuse_traced(name, rows)
    keys = dict.fromkeys(str(key) for row in rows for key in row)
    return Columns({key: [row.get(key) for row in rows] for key in keys}, source)


def _of_frame(table: Any, source: Source) -> Columns:
    names = [str(column) for column in table.columns]
    if len({*names}) < len(names):
        duplicate = next(column for column in names if names.count(column) > 1)
        raise InputError(
            f"{source.name}: two columns are called {duplicate!r}; expected one of each"
        )
    present = table.notna()
    return Columns(
        {
            name: table[c].astype(object).where(present[c], None).to_list()
            for name, c in zip(names, table.columns)
        },
        source,
    )


def _column(values: Any, column: str, name: str) -> Column:
    """Values of a column; None where an array is masked."""
    refuse_traced(f"{name}: column {column!r}", values)
    if isinstance(values, str) or not isinstance(values, Iterable):
        raise InputError(f"{name}: column {column!r} must be a sequence, not {show(values)}")
    shape = tuple(getattr(values, "shape", (0,)))
    if len(shape) != 1:
        raise InputError(
            f"{name}: column {column!r} must have one dimension, a value for each row, but has "
            f"the shape {shape}"
        )
    if isinstance(values, np.ma.MaskedArray):
        return values.tolist()
    return values if isinstance(values, np.ndarray) else list(values)


def is_missing(value: Any) -> bool:
    """None, NaN, empty text, masked values, and the missing values of pandas."""
    if value is None or value is np.ma.masked:
        return True
    if isinstance(value, str):
        return not value.strip()
    number = isinstance(value, float | np.floating)
    return bool(np.isnan(value)) if number else type(value).__name__ in ("NAType", "NaTType")


def did_you_mean(name: str, known_names: Iterable[str], *, listing: bool = True) -> str:
    """The end of a message about an unknown name: the closest known one, or all of them."""
    known_names = list(known_names)
    closest = closest_name(name, known_names)
    if closest is not None:
        return f"; did you mean {closest!r}?"
    return f"; known: {', '.join(known_names)}" if listing and known_names else ""


def refuse_unknown(name: str, known_names: Iterable[str], where: str, noun: str = "key") -> None:
    """Refuse a name that is not in `known_names`, as a probable typing error: a setting that is
    silently ignored would give another result than the user expects.

    **Arguments:** `where` begins the message; `noun`: what the name is of, `section` in brackets.

    **Raises:** `InputError`.
    """
    known_names = tuple(known_names)
    if name not in known_names:
        quoted = f"[{name}]" if noun == "section" else repr(name)
        raise InputError(f"{where}unknown {noun} {quoted}{did_you_mean(name, known_names)}")


def quote(name: Any) -> str:
    """A name in quotes."""
    return repr(str(name))


def list_some(
    names: Iterable[Any], max_names: int = 5, as_text: Callable[[Any], str] = quote
) -> str:
    """The first few names of a list, and the number of others."""
    names = list(names)
    text = ", ".join(map(as_text, names[:max_names]))
    return f"{text} and {len(names) - max_names} more" if len(names) > max_names else text


def count(number: SupportsIndex, noun: str, suffix: str = "") -> str:
    """A count in words: "1 image", "3 images", "3 images held"."""
    return f"{number} {noun}{'' if index(number) == 1 else 's'}{suffix}"


def as_id(value: Any) -> str:
    """An id or word from a cell; empty if it is missing."""
    if isinstance(value, str):
        return value.strip()
    if is_missing(value):
        return ""
    # A column of whole numbers with an empty cell is read as floats: 7.0 is the id "7".
    if isinstance(value, float | np.floating) and float(value).is_integer():
        value = int(value)
    return str(value)


def _plain_numbers(values: Column) -> np.ndarray | None:
    """Fast conversion of columns without missing or unusual cells; else None."""
    if isinstance(values, np.ndarray) and values.dtype.kind in "iuf":
        return values.astype(float)
    if any(isinstance(value, NO_NUMBERS) for value in values):
        return None
    try:
        numbers = np.fromiter(map(float, values), float, len(values))
    except (TypeError, ValueError, OverflowError):
        return None
    # float() takes more than a table means: "nan", "inf", "1_000".
    texts = [value for value in values if isinstance(value, str)]
    is_unusual = texts and (not np.isfinite(numbers).all() or any("_" in text for text in texts))
    return None if is_unusual else numbers
