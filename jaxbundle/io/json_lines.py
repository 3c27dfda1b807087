"""Results as JSON lines: one object a line, each with a `key`, appended as they come.

An interrupted run leaves whole lines and at most one torn one at the end. `JsonLines` takes up
where it stopped: it knows the keys that are there.
"""

import json
import os
from collections.abc import Iterable
from pathlib import Path

from jaxbundle.errors import InputError
from jaxbundle.io.csv_tables import write_text
from jaxbundle.io.result_json import without_nan


class JsonLines:
    """A file of results, kept whole and never with a key twice.

    **Arguments:** `retry`: drop what did not converge, to be computed again.

    **Raises:** `InputError` if the file cannot be read or written, or has other content.
    """

    def __init__(self, path: str | Path, retry: bool = False):
        self.path = Path(path)
        self.keys: set[str] = set()
        text = self._read()
        kept, lines = [], text.removesuffix("\n").split("\n") if text else []
        for number, line in enumerate(lines, 1):
            row = _row(line)
            if row is None:
                if number == len(lines) and not text.endswith("\n") and _is_torn(line):
                    break
                raise InputError(
                    f"{self.path}, line {number}: not a result of jaxbundle batch; "
                    "give another file to --json-lines"
                )
            if row["key"] in self.keys or (retry and row.get("status") != "converged"):
                continue
            self.keys.add(row["key"])
            kept.append(line)
        whole = "".join(line + "\n" for line in kept)
        if whole != text or not self.path.exists():
            write_text(self.path, whole)

    def __contains__(self, key: str) -> bool:
        return key in self.keys

    def append(self, rows: Iterable[dict]) -> None:
        """Add rows; they are on the disk when this returns."""
        rows = list(rows)
        lines = [_text(row) + "\n" for row in rows]
        try:
            with self.path.open("a", encoding="utf-8", newline="\n") as file:
                file.write("".join(lines))
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise InputError(f"{self.path}: cannot be written: {error.strerror}") from None
        self.keys.update(row["key"] for row in rows)

    def _read(self) -> str:
        try:
            # A torn line may end within a character.
            return self.path.read_bytes().decode("utf-8", errors="replace")
        except FileNotFoundError:
            return ""
        except OSError as error:
            raise InputError(f"{self.path}: cannot be read: {error.strerror}") from None


def _text(row: dict) -> str:
    try:
        return json.dumps(row, ensure_ascii=False, allow_nan=False)
    except ValueError:
        return json.dumps(without_nan(row), ensure_ascii=False)


def _is_torn(line: str) -> bool:
    """Whether a line is the beginning of a row."""
    begin = '{"'
    return line.startswith(begin) or begin.startswith(line)


def _row(line: str) -> dict | None:
    try:
        row = json.loads(line)
    except ValueError:
        return None
    return row if isinstance(row, dict) and isinstance(row.get("key"), str) else None
