"""Rows of an array in an `.npz`, read on demand: memory does not grow with the file.

An archive of NumPy stores its members uncompressed (`numpy.savez`) or compressed
(`numpy.savez_compressed`). Rows of the former are read in place; the latter are unpacked
into a temporary file without a name, which disappears with the process.
"""

import dataclasses
import shutil
import struct
import tempfile
import weakref
import zipfile
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import IO, BinaryIO

import numpy as np
from jaxtyping import Int

from jaxbundle.errors import InputError
from jaxbundle.io.text.archives import ArchiveMember
from jaxbundle.system.foreign_parsers import foreign_parser

# Signature, length of the name, of the field after it.
LOCAL_HEADER = struct.Struct("<4s22xHH")


@dataclasses.dataclass(frozen=True)
class StoredRows:
    """Rows of an array of numbers in a file, from `offset` on; `unpacked`: the temporary file, if
    any."""

    path: Path
    offset: int
    shape: tuple[int, ...]
    dtype: np.dtype
    unpacked: BinaryIO | None = None

    @property
    def ndim(self) -> int:
        return len(self.shape)

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, rows: int | Sequence[int] | Int[np.ndarray, "..."]) -> np.ndarray:
        """A row, or the rows of a list of numbers."""
        row_numbers = np.atleast_1d(np.asarray(rows, int))
        # One array: a list of rows would be copied once more.
        values = np.empty((len(row_numbers), *self.shape[1:]), self.dtype)
        size = int(np.prod(self.shape[1:]))
        # Consecutive rows are read together.
        ends = [0, *(np.flatnonzero(np.diff(row_numbers) != 1) + 1), len(row_numbers)]
        opened = self.path.open("rb") if self.unpacked is None else nullcontext(self.unpacked)
        with opened as stream:
            for begin, end in zip(ends, ends[1:]):
                stream.seek(self.offset + int(row_numbers[begin]) * size * self.dtype.itemsize)
                run_values = np.fromfile(stream, self.dtype, (end - begin) * size)
                if run_values.size < (end - begin) * size:
                    raise InputError(f"{self.path}: became shorter while it was read")
                values[begin:end] = run_values.reshape(-1, *self.shape[1:])
        return values[0] if np.ndim(rows) == 0 else values


def find_stored_rows(
    path: str | Path,
    expected: str,
    archive: zipfile.ZipFile,
    name: str,
    member: ArchiveMember,
    smallest: int = 2**20,
) -> StoredRows | None:
    """The rows of an array of an open archive, if they can be read singly and the array is large
    enough; its checksum is tested once.

    **Arguments:** `smallest`: bytes of an array that is worth it; a smaller one fits in memory.

    **Raises:** `InputError` if it is damaged."""
    info, shape, dtype = member.info, member.shape, member.dtype
    # Rows that do not lie in one piece, texts.
    if info.file_size < smallest or member.by_columns or dtype.kind not in "biuf" or not shape:
        return None
    with foreign_parser(f"{path}, array {name!r}", expected), archive.open(info) as stream:
        stream.read(member.begin)
        if info.compress_type != zipfile.ZIP_STORED:
            unpacked = _unpack(stream)
            rows = StoredRows(Path(path), 0, shape, dtype, unpacked)
            weakref.finalize(rows, unpacked.close)
            return rows
        while stream.read(2**20):  # to its end, where zipfile compares the checksum
            pass
    with open(path, "rb") as stream:
        stream.seek(info.header_offset)
        _, *lengths = LOCAL_HEADER.unpack(stream.read(LOCAL_HEADER.size))
    offset = info.header_offset + LOCAL_HEADER.size + sum(lengths) + member.begin
    return StoredRows(Path(path), offset, shape, dtype)


def _unpack(stream: IO[bytes]) -> BinaryIO:
    """The rest of a stream in a temporary file."""
    unpacked = tempfile.TemporaryFile()
    try:
        shutil.copyfileobj(stream, unpacked, 2**20)  # a megabyte at a time
        # Fromfile reads by the descriptor, past the buffer of Python.
        unpacked.flush()
    except BaseException:
        unpacked.close()
        raise
    return unpacked
