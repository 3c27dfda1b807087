"""Blocks of a map kept in a file, so that an interrupted map resumes.

A header line names what the blocks are of: a fingerprint of inputs and settings. Blocks follow in
the order of the map,

    number of the block (8 bytes)   bytes of its values (8)   CRC-32 of them (4)   values

little-endian; a block without values is empty. A process that ends in any way leaves complete
blocks and at most one incomplete one at the end, which is cut off. A map made from kept blocks and
new ones is that of one run, byte for byte: the map itself is written anew, in the order of blocks.
"""

import os
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

import numpy as np

from jaxbundle.errors import InputError
from jaxbundle.io.writing.locks import hold_lock
from jaxbundle.io.writing.replacing import unwritable

HEADER = "jaxbundle map blocks 1 "
RECORD = struct.Struct("<QQI")
# The fingerprint in the header.
DIGITS = 16


class Checkpoint:
    """The blocks of a file, in their order, and those added."""

    def __init__(self, path: Path, file: BinaryIO):
        self.path, self._file = path, file
        self._next = 0
        self._kept = True

    def take(self, number: int, shape: tuple[int, ...], dtype: np.dtype | str) -> np.ndarray | None:
        """The values of the next block, if it is kept; of shape [0] if the block is empty.

        From the first block that is not kept on, the file is cut off and blocks are added."""
        if not self._kept:
            return None
        begin = self._file.tell()
        head = self._file.read(RECORD.size)
        size = int(np.prod(shape)) * np.dtype(dtype).itemsize
        if len(head) == RECORD.size:
            stored_number, length, checksum = RECORD.unpack(head)
            if stored_number == number and length in (0, size):
                content = self._file.read(length)
                if len(content) == length and zlib.crc32(content) == checksum:
                    values = np.frombuffer(content, dtype)
                    return values.reshape(shape) if length else values
        self._kept = False
        self._file.seek(begin)
        self._file.truncate()
        return None

    def add(self, number: int, values: np.ndarray | None) -> None:
        """Keep a block."""
        content = b"" if values is None else np.ascontiguousarray(values).tobytes()
        try:
            self._file.write(RECORD.pack(number, len(content), zlib.crc32(content)) + content)
            self._file.flush()
        except OSError as error:
            raise unwritable(self.path, error) from None


@contextmanager
def keep_blocks(path: Path | None, fingerprint: str) -> Iterator[Checkpoint | None]:
    """The checkpoint of a map; None without a path. It is removed when the map is complete.

    **Raises:** `InputError` if the file is none of blocks, or of another map, or if another process
    writes it.
    """
    if path is None:
        yield None
        return
    if not path.absolute().parent.is_dir() or path.is_dir():
        raise InputError(f"--checkpoint {path}: name a file in an existing folder")
    with hold_lock(path, f"--checkpoint {path}", needed=False):
        header = f"{HEADER}{fingerprint}\n".encode()
        try:
            with suppress(FileExistsError), path.open("xb") as new:
                new.write(header)
            file = path.open("r+b")
        except OSError as error:
            raise unwritable(path, error) from None
        with file:
            stored_header = file.read(len(header))
            if stored_header and not header.startswith(stored_header):
                is_checkpoint = stored_header.startswith(HEADER.encode())
                raise InputError(
                    f"--checkpoint {path}: "
                    + (
                        "has blocks of another map: other inputs or options; repeat these, remove "
                        "the file, or give another"
                        if is_checkpoint
                        else "is a file of something else; give another name"
                    )
                )
            if stored_header != header:
                file.seek(0)
                file.write(header)
            yield Checkpoint(path, file)
        os.remove(path)
