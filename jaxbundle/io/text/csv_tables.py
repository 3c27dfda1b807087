"""Text files and tables of comma-separated values: UTF-8, a header line, `#` comments."""

import csv
import io
import itertools
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxbundle.errors import InputError
from jaxbundle.io.writing.replacing import replace_file, replace_files, unwritable
from jaxbundle.network.columns import Columns
from jaxbundle.network.tables import Source
from jaxbundle.system.file_content import DESCRIPTORS, parse_toml, read_content
from jaxbundle.system.terminals import in_utf8
from jaxbundle.types import T


def read_text(path: Path, fallback: str = "") -> str:
    """The text of a file; `fallback` is the encoding if it is not UTF-8.

    **Raises:** `InputError` if it is missing, cannot be read, is not a regular file, has a zero
    byte, or is not UTF-8.
    """
    content = read_content(path)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        if fallback:
            return error.object.decode(fallback)
        line = error.object[: error.start].count(b"\n") + 1
        raise InputError(f"{path}, line {line}: not UTF-8 text; save the file as UTF-8") from None


def read_toml(path: Path) -> dict[str, Any]:
    """The document of a TOML file.

    **Raises:** `InputError` if it cannot be read or is not TOML.
    """
    return parse_toml(path, read_text(path))


def read_csv(path: Path) -> Columns:
    """The columns of a CSV file as text, and the line of each row.

    Blank lines and lines that begin with `#` are skipped.
    """
    return parse_csv(path, read_text(path))


def parse_csv(path: Path, text: str) -> Columns:
    """The columns of the text of a CSV file, as `read_csv`; `path` names it in messages."""
    lines = [
        (number, line)
        for number, line in enumerate(re.split(r"\r\n?|\n", text), 1)
        if (stripped := line.lstrip()) and stripped[0] != "#"
    ]
    try:
        rows = list(csv.reader((line for _, line in lines), skipinitialspace=True, strict=True))
    except csv.Error as error:
        raise InputError(f"{path}: not a CSV table: {error}") from None
    if not rows:
        raise InputError(f"{path}: the file is empty; expected a header line and rows")
    if len(rows) != len(lines):
        raise InputError(f"{path}: a quoted cell runs over several lines; close its quotes")
    header, numbers = [name.strip() for name in rows[0]], [number for number, _ in lines]
    if len(header) == 1 and (";" in header[0] or "\t" in header[0]):
        raise InputError(f"{path}, line {numbers[0]}: separate the columns by commas")
    for name in header:
        if header.count(name) > 1:
            raise InputError(f"{path}, line {numbers[0]}: the column {name!r} occurs twice")
    width = len(header)
    for number, row in zip(numbers, rows):
        if len(row) != width:
            raise InputError(
                f"{path}, line {number}: {len(row)} cells where the header has {width} "
                f"({', '.join(header)}); decimals need a point, empty cells their comma"
            )
    columns = list(zip(*rows[1:])) or [()] * width
    return Columns(dict(zip(header, columns)), Source(str(path), np.array(numbers[1:]), "line"))


def write_csv(path: Path, header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Write a table for `read_csv`; floats in full precision."""
    write_text(
        path, (_csv_text(portion) for portion in take_portions(itertools.chain((header,), rows)))
    )


def _csv_text(rows: Iterable[Sequence[Any]]) -> str:
    text = io.StringIO()
    plain = csv.writer(text, lineterminator="\n")
    quoted = csv.writer(text, lineterminator="\n", quoting=csv.QUOTE_ALL)
    for row in rows:
        # Otherwise it would be read as a comment.
        writer = quoted if str(row[0]).startswith("#") else plain
        writer.writerow(row)
    return text.getvalue()


def table_rows(table: Mapping[str, np.ndarray]) -> Iterator[tuple[Any, ...]]:
    """The rows of a table of columns as plain values, some at a time: `tolist` is faster than cell
    by cell, but of two million rows takes gigabytes."""
    columns = list(table.values())
    for rows in take_portions(range(max(map(len, columns), default=0))):
        yield from zip(*(column[rows[0] : rows[-1] + 1].tolist() for column in columns))


def take_portions(rows: Iterable[T], portion: int = 10_000) -> Iterator[list[T]]:
    """Rows some at a time, for conversion to text: `portion` of them are some megabytes; not
    critical."""
    rows = iter(rows)
    while chunk := list(itertools.islice(rows, portion)):
        yield chunk


def write_text(path: Path, text: str | Iterable[str]) -> None:
    """Write a text, or its pieces, in UTF-8, whole or not at all (`write_bytes`)."""
    pieces = (text,) if isinstance(text, str) else text
    write_bytes(path, (in_utf8(piece).encode() for piece in pieces))


def write_texts(paths: Sequence[Path], texts: Sequence[str]) -> None:
    """Write some texts as `write_text`; none of the files is replaced before all are complete."""
    if len(paths) == 1:
        return write_text(paths[0], texts[0])  # may be a device
    with replace_files(*paths) as temporaries:
        for temporary, text in zip(temporaries, texts):
            temporary.write_bytes(in_utf8(text).encode())


def write_bytes(path: Path, content: bytes | Iterable[bytes]) -> None:
    """Write a file, given whole or in pieces, whole or not at all: under a temporary name, then
    renamed.

    An existing device or pipe is written to directly, and so is an open
    descriptor (/dev/stdout); a link stays a link.
    """
    pieces = (content,) if isinstance(content, bytes) else content
    if path.exists() and (not path.is_file() or path.parent in DESCRIPTORS):
        try:
            with path.open("wb") as file:
                file.writelines(pieces)
        except OSError as error:
            raise unwritable(path, error) from None
        return
    with replace_file(path) as temporary, temporary.open("wb") as file:
        file.writelines(pieces)
