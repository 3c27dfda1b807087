"""The content of files: only regular files, text without zero bytes, and documents (TOML, JSON)
with limited nesting and numbers."""

import json
import os
import re
import stat
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from jaxbundle.errors import InputError

# System folders with pseudo-files, which may be endless or block.
SYSTEM = ("/proc/", "/sys/")
# Folders of the open files of the process.
DESCRIPTORS = (Path("/dev"), Path("/dev/fd"), Path("/proc/self/fd"))
# Maximum nesting of a document; those of the package have a few levels. Python's readers of TOML
# and JSON call themselves for every level, and end at about a thousand with a `RecursionError`.
DEEPEST_NESTING = 64
# The largest power of two that is a float of double precision (IEEE 754).
LARGEST_INTEGER = 2**1023
TOO_LARGE = "too large a number; expected finite numbers"
# Said of a file that ends where more is expected.
ENDS_EARLY = "; the file ends there: is it cut off, or not completely copied?"
QUOTED = re.compile(r'"(?:\\.|[^"\\])*"|\'[^\']*\'')
DIGITS = re.compile(r"(?<![\w.])[-+]?\d[\d_]{307,}(?![\w.])")
DOTTED = re.compile(rf"(?:[\w-]+\s*\.\s*){{{DEEPEST_NESTING - 1}}}")


def check_plain(path: str | Path) -> None:
    """Refuse devices, sockets, pipes, and system pseudo-files.

    An already open pipe (`/dev/stdin`, `<(…)` of a shell) is accepted.
    """
    path = Path(path)
    try:
        mode = os.stat(path).st_mode
        real_path = os.path.realpath(path)
    except (OSError, ValueError):
        return  # reported when it is opened
    is_open_pipe = path.parent in DESCRIPTORS and stat.S_ISFIFO(mode)
    system = stat.S_ISREG(mode) and real_path.startswith(SYSTEM)
    if system or not (stat.S_ISREG(mode) or stat.S_ISDIR(mode) or is_open_pipe):
        raise InputError(f"{path}: a file of the system, a device or a pipe; give a plain file")


@contextmanager
def naming_file(path: str | Path) -> Iterator[None]:
    """The context of code that does not know from which file its values are: its errors get the
    name."""
    try:
        yield
    except InputError as error:
        if str(path) in str(error):
            raise
        raise InputError(f"{path}: {error}") from None


def is_plain(path: str | Path) -> bool:
    """Whether a path is a file that can be read to its end."""
    try:
        check_plain(path)
    except InputError:
        return False
    return os.path.isfile(path)


def no_such_file(path: str | Path, expected: str = "a file") -> InputError:
    """That no file has this name, or that it is a folder."""
    if os.path.isdir(path):
        return InputError(f"{path}: is a folder; expected {expected}")
    return InputError(f"{path}: no such file")


def beginning(path: str | Path, length: int) -> bytes:
    """The first bytes of a regular file; empty for other or unreadable files."""
    if not is_plain(path):
        return b""
    try:
        with open(path, "rb") as file:
            return file.read(length)
    except OSError:
        return b""


def read_content(path: str | Path, text: bool = True) -> bytes:
    """The bytes of a file; with `text` a zero byte is an error.

    **Raises:** `InputError` if it is missing, unreadable, or not a regular file.
    """
    check_plain(path)
    # A megabyte at a time: a binary file of gigabytes is refused at its first zero byte.
    size, chunks, lines = 2**20, [], 1
    try:
        with open(path, "rb") as file:
            while chunk := file.read(size):
                if text and (zero := chunk.find(0)) >= 0:
                    line = lines + chunk.count(b"\n", 0, zero)
                    raise InputError(
                        f"{path}, line {line}: a zero byte: not UTF-8 text, or damaged; save the "
                        "file as UTF-8"
                    )
                lines += chunk.count(b"\n") if text else 0
                chunks.append(chunk)
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        if os.path.isdir(path):  # Windows calls it a denied permission
            raise InputError(f"{path}: is a folder; expected a file") from None
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from None
    except ValueError as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: no such file") from None  # a zero byte in its name
    return b"".join(chunks)


def parse_toml(path: str | Path, text: str) -> dict[str, Any]:
    """The document of a text in TOML.

    **Raises:** `InputError` naming the line of too deep nesting or too large a number.
    """
    return _parse(path, text, tomllib.loads, "TOML")


def parse_json(path: str | Path, text: str) -> Any:
    """The document of a text in JSON; raises as `parse_toml`."""
    return _parse(path, text, json.loads, "JSON")


def _parse(path: str | Path, text: str, parse: Callable[[str], Any], kind: str) -> Any:
    try:
        document = parse(text)
        problem = _describe_violations(document)
    except RecursionError:
        problem = "nested too deeply"
    except ValueError as error:
        problem = f"{error}"
        if isinstance(error, json.JSONDecodeError) and error.pos >= len(text.rstrip()):
            problem += ENDS_EARLY
        if "digits" not in problem:  # Python reads no whole number of more than 4300
            raise InputError(f"{path}: not valid {kind}: {problem}") from None
        problem = TOO_LARGE
    if problem:
        line = _violating_line(text)
        raise InputError(f"{path}{line and f', line {line}'}: not valid {kind}: {problem}")
    return document


def _describe_violations(document: Any) -> str:
    """Violations of the limits in a document, in words; empty if there are none."""
    level = [document]
    for _ in range(DEEPEST_NESTING):
        if any(isinstance(v, int) and abs(v) > LARGEST_INTEGER for v in level):
            return TOO_LARGE
        level = [
            part
            for value in level
            if isinstance(value, dict | list)
            for part in (value.values() if isinstance(value, dict) else value)
        ]
        if not level:
            return ""
    return f"nested too deeply: more than {DEEPEST_NESTING} levels"


def _violating_line(text: str) -> int | str:
    """The first line with too long a number, too many dots in a key, or too many open brackets."""
    depth = 0
    for number, line in enumerate(text.split("\n"), 1):
        unquoted = QUOTED.sub("s", line).partition("#")[0]
        if DIGITS.search(unquoted) or DOTTED.search(unquoted):
            return number
        for bracket in re.findall(r"[][{}]", unquoted):
            depth += 1 if bracket in "[{" else -1
            if depth > DEEPEST_NESTING:
                return number
    return ""
