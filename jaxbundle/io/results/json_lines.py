"""Results as JSON lines: one object a line, each with a `key`, appended as they come.

An interrupted run leaves complete lines and at most one partial line at the end. `JsonLines`
resumes: it knows the existing keys, and the inputs of their lines.
"""

import json
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any, BinaryIO

from jaxbundle.errors import InputError
from jaxbundle.io.results.result_json import without_nan
from jaxbundle.io.text.csv_tables import write_bytes
from jaxbundle.io.writing.replacing import unwritable
from jaxbundle.system.temporaries import defer_interrupts

# Fields of a line kept in memory: its status, its inputs, and those that it lacks.
HEAD = ("status", "settings", "data", "photographs_not_searched")


class JsonLines:
    """A file of results, always complete and without repeated keys; to be used under its lock.

    `heads`: for every key the fields `HEAD` of its line, if present.

    **Raises:** `InputError` if the file cannot be read or written, or has other content.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        self._regular = regular = self.path.is_file() or not self.path.exists()
        # A link stays a link; a pipe of a process has no other name.
        self._file = Path(os.path.realpath(path)) if regular else self.path
        self.heads: dict[str, dict[str, Any]] = {}
        self._shared: dict[str, object] = {}
        end, has_repeated_keys, is_complete = 0, False, True
        for number, line in enumerate(self._lines() if regular else (), 1):
            row, is_complete = _row(line), line.endswith(b"\n")
            if row is None:
                # Zero bytes: what a crash of the system may leave at the end of a file.
                if not is_complete and _is_torn(line.rstrip(b"\0")):
                    break
                raise InputError(
                    f"{self.path}, line {number}: not a result of jaxbundle batch; "
                    "give another file to --json-lines"
                )
            end += len(line)
            has_repeated_keys |= row["key"] in self.heads
            self.heads.setdefault(row["key"], self._head(row))
        self._write(lambda _: None)  # refuses a file that cannot be written before any work
        if regular and not is_complete:
            self._mend(end)
        if has_repeated_keys:
            self._rewrite(self.heads)

    def __contains__(self, key: str) -> bool:
        return key in self.heads

    def append(self, rows: Iterable[dict[str, Any]]) -> None:
        """Add rows; they are on the disk when this returns."""
        rows = list(rows)
        # Names that are not UTF-8 are escaped as in JSON.
        text = "".join(_json_text(row) + "\n" for row in rows).encode(errors="backslashreplace")
        self._write(lambda file: file.write(text))
        self.heads.update((row["key"], self._head(row)) for row in rows)

    def rows(self, keys: Iterable[str]) -> Iterator[dict[str, Any]]:
        """The rows of some keys, in the order of the file."""
        requested_keys = set(keys)
        return (
            row
            for row in map(_row, self._lines())
            if row is not None and row["key"] in requested_keys
        )

    def drop(self, keys: Iterable[str]) -> None:
        """Remove the lines of some keys."""
        dropped_keys = set(keys)
        self.heads = {key: head for key, head in self.heads.items() if key not in dropped_keys}
        self._rewrite(self.heads)

    def _rewrite(self, keys: Iterable[str]) -> None:
        """Rewrite the file with only the first line of each of these keys."""
        remaining_keys, first_lines = set(keys), []
        for line in self._lines():
            row = _row(line)
            if row is not None and row["key"] in remaining_keys:
                remaining_keys.discard(row["key"])
                first_lines.append(line)
        write_bytes(self._file, first_lines)

    def _lines(self) -> Iterator[bytes]:
        try:
            with self._file.open("rb") as file:
                yield from file
        except FileNotFoundError:
            return
        except OSError as error:
            raise InputError(f"{self.path}: cannot be read: {error.strerror}") from None

    def _write(self, write: Callable[[BinaryIO], object]) -> None:
        # A pipe may be slow: nothing waits for it.
        uninterrupted = defer_interrupts() if self._regular else nullcontext()
        initial_size = self._file.stat().st_size if self._regular and self._file.exists() else 0
        try:
            with uninterrupted, self._file.open("ab") as file:
                write(file)
                file.flush()
                if self._regular:
                    os.fsync(file.fileno())
        except OSError as error:
            if self._regular:
                with suppress(OSError):  # of a full disk: no part of a line stays
                    os.truncate(self._file, initial_size)
            raise unwritable(self.path, error) from None

    def _head(self, row: dict[str, Any]) -> dict[str, Any]:
        """The fields kept in memory; equal settings share one object, since all lines have some."""
        head = {name: row[name] for name in HEAD if name in row}
        if "settings" in head:
            key = json.dumps(head["settings"], sort_keys=True, default=str)
            head["settings"] = self._shared.setdefault(key, head["settings"])
        return head

    def _mend(self, end: int) -> None:
        """Remove a partial line that begins at `end`, or add the line feed of the last line."""
        if end < self._file.stat().st_size:
            os.truncate(self._file, end)
        else:
            self._write(lambda file: file.write(b"\n"))


def _json_text(row: dict[str, Any]) -> str:
    # First as it is: few rows have a NaN, and the others need no copy without it.
    try:
        return json.dumps(row, ensure_ascii=False, allow_nan=False)
    except ValueError:
        return json.dumps(without_nan(row), ensure_ascii=False)


def _is_torn(line: bytes) -> bool:
    """Whether a line is the beginning of a row, and not other content."""
    begin = b'{"key": "'
    return begin.startswith(line[: len(begin)]) and _parse(line) is None


def _row(line: bytes) -> dict[str, Any] | None:
    row = _parse(line)
    return row if isinstance(row, dict) and isinstance(row.get("key"), str) else None


def _parse(line: bytes) -> Any:
    try:
        return json.loads(line)
    except (ValueError, RecursionError):
        return None
