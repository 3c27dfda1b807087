"""Corners found in photographs, kept for the next run: an SQLite file.

Corners belong to the content of a photograph, not to its name: a changed one is searched again, a
moved or copied one is not. Size and time of change show whether the content is the same; if they
differ, the file is read.

| table | |
|---|---|
| `photographs` | path, size, time of change [ns], fingerprint of the content |
| `boards` | fingerprint, board; columns and rows of the photograph, image points, or why none |
"""

import hashlib
import os
import sqlite3
from pathlib import Path

import numpy as np

from jaxbundle.errors import InputError
from jaxbundle.measure.boards import Board, require_board
from jaxbundle.measure.views import Look
from jaxbundle.system.file_content import read_content

SqlValue = str | int | bytes | None
TABLES = """
CREATE TABLE IF NOT EXISTS photographs
    (path TEXT PRIMARY KEY, size INTEGER, changed INTEGER, content TEXT);
CREATE TABLE IF NOT EXISTS boards
    (content TEXT, board TEXT, columns INTEGER, rows INTEGER, xy BLOB, why TEXT,
     PRIMARY KEY (content, board));
"""


# The text of an error about a damaged file may quote bytes of it that are no text.
SQLITE_ERRORS = (sqlite3.Error, UnicodeDecodeError)
# Number of the method of measurement, part of the keys in the file: corners by an earlier one are
# searched again. Raise it when `measure` finds other coordinates in the same photograph.
MEASUREMENT_VERSION = 2


def _key(board: Board) -> str:
    return f"{board!r}, measurement {MEASUREMENT_VERSION}"


class KeptCorners:
    """The corners in such a file, and new ones; a context. Only one process at a time.

    **Raises:** `InputError` if the file cannot be read or written, or is of another kind.
    """

    def __init__(self, path: str | Path):
        self.path = path
        try:
            # Autocommit: a search result is on the disk before the next photograph is opened.
            self._file = sqlite3.connect(path, isolation_level=None)
            self._file.executescript(TABLES)
        except SQLITE_ERRORS as error:
            raise self._error(error) from None

    def __enter__(self) -> "KeptCorners":
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def content(self, photograph: Path) -> str:
        """The fingerprint of a photograph's content; empty if it cannot be read."""
        try:
            state = os.stat(photograph)
        except OSError:
            return ""
        # A name of bytes that are not UTF-8 has no text that SQLite would take.
        path = os.fsencode(os.path.abspath(photograph)).decode(errors="backslashreplace")
        size_and_time = state.st_size, state.st_mtime_ns
        stored_row = self._first_row(
            "SELECT size, changed, content FROM photographs WHERE path = ?", path
        )
        # Reading thousands of photographs again would take minutes.
        if stored_row is not None and stored_row[:2] == size_and_time:
            return stored_row[2]
        try:
            photograph_bytes = read_content(photograph, text=False)
        except InputError:
            return ""
        content = hashlib.blake2b(photograph_bytes, digest_size=16).hexdigest()
        self._write(
            "INSERT OR REPLACE INTO photographs VALUES (?, ?, ?, ?)", path, *size_and_time, content
        )
        return content

    def look(self, content: str, board: Board) -> Look | None:
        """The search result of a board in a photograph of this content; None: not searched."""
        result = self._first_row(
            "SELECT columns, rows, xy, why FROM boards WHERE content = ? AND board = ?",
            content,
            _key(board),
        )
        if result is None:
            return None
        columns, rows, xy, reason = result
        if xy is None and isinstance(reason, str):
            return reason
        # Of a damaged file a cell may hold anything: the photograph is searched again.
        if isinstance(xy, bytes) and isinstance(columns, int) and isinstance(rows, int):
            if len(xy) == 16 * len(require_board(board).ids):
                return (columns, rows), np.frombuffer(xy, "<f8").reshape(-1, 2)
        return None

    def keep(self, content: str, board: Board, look: Look) -> None:
        """Add a search result; it is in the file when this returns."""
        columns, rows, points, reason = None, None, None, None
        if isinstance(look, str):
            reason = look
        else:
            (columns, rows), xy = look
            points = np.ascontiguousarray(xy, "<f8").tobytes()
        self._write(
            "INSERT OR REPLACE INTO boards VALUES (?, ?, ?, ?, ?, ?)",
            content,
            _key(board),
            columns,
            rows,
            points,
            reason,
        )

    def _first_row(self, question: str, *values: SqlValue) -> tuple | None:
        try:
            return self._file.execute(question, values).fetchone()
        except SQLITE_ERRORS as error:
            raise self._error(error) from None

    def _write(self, order: str, *values: SqlValue) -> None:
        try:
            self._file.execute(order, values)
        except SQLITE_ERRORS as error:
            raise self._error(error) from None

    def _error(self, error: Exception) -> InputError:
        return InputError(
            f"{self.path}: the corners found before cannot be kept there ({error}); remove it, or "
            "give another file to --json-lines"
        )
