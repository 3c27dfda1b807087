"""Damaged files: cut, garbled, with unexpected numbers."""

import shutil
import tempfile
from pathlib import Path

from hypothesis import given, settings
from hypothesis import strategies as st

from jaxbundle.errors import InputError

ODD = ["nan", "-1", "1e400", "999999999999999999", "1000000000000000000000", "0", "-0.5", "", "x",
       "1_0", "inf", "'", '"', "[", "<a>", "\x00", "é", "\n", ",", "-99"]  # fmt: skip
HOW = ("cut", "without a part", "a part twice", "bytes", "a word", "a word", "zeros", "ones")

what_is_done = given(
    which=st.integers(0, 9), how=st.sampled_from(HOW), odd=st.sampled_from(ODD),
    a=st.floats(0, 1), b=st.floats(0, 1),
)  # fmt: skip
"""Arguments of `read_or_refused` after the first two."""


def often(number: int):
    """This number of examples, always the same."""
    return settings(max_examples=number, deadline=None, derandomize=True, database=None)


def read_or_refused(read, valid: Path, which: int, how: str, odd: str, a: float, b: float):
    """One file of a valid folder garbled: `read(folder)` gives something or a line of complaint."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shutil.copytree(valid, folder, dirs_exist_ok=True)
        files = sorted(folder.iterdir())
        file = files[which % len(files)]
        file.write_bytes(garbled(file.read_bytes(), how, a, b, odd))
        try:
            read(folder)
        except InputError as error:
            assert "\n" not in str(error) and len(str(error)) < 1000


def garbled(data: bytes, how: str, a: float, b: float, odd: str) -> bytes:
    """The damaged contents of a file; a, b in [0, 1] give the place."""
    i, j = sorted((int(a * len(data)), int(b * len(data))))
    match how:
        case "cut":
            return data[:i]
        case "without a part":
            return data[:i] + data[j:]
        case "a part twice":
            return data[:j] + data[i:]
        case "bytes":
            return data[:i] + bytes((255 - x) for x in data[i : i + 9]) + data[i + 9 :]
        case "a word":
            begin = max(data.rfind(c, 0, i) for c in (b" ", b"\n", b",", b">")) + 1
            ends = [e for e in (data.find(c, i) for c in (b" ", b"\n", b",", b"<")) if e >= 0]
            return data[:begin] + odd.encode() + data[min(ends, default=len(data)) :]
        case "zeros":
            return data[:i] + bytes(8) + data[i + 8 :]
        case "ones":
            return data[:i] + b"\xff" * 8 + data[i + 8 :]
