"""Archives of arrays (`.npz`), checked before anything is unpacked: the size that every member
states, against the file's, and against the shape and type in the member's own header."""

import math
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxbundle.errors import InputError
from jaxbundle.system.file_content import check_plain
from jaxbundle.system.foreign_parsers import foreign_parser

SUFFIX = ".npy"
# By the version of the header; NumPy writes others only for names of fields.
HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}
# What `numpy.savez` and `numpy.savez_compressed` write.
METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


class ArchiveMember(NamedTuple):
    """An array of an archive by its header; `begin`: its first byte in the unpacked member."""

    info: zipfile.ZipInfo
    shape: tuple[int, ...]
    dtype: np.dtype
    by_columns: bool
    begin: int


def largest_unpacked_size(size: int, ratio: int = 200, harmless: int = 2**20) -> int:
    """The maximum unpacked size of a compressed file of this size, bytes.

    **Arguments:** `ratio`: bytes unpacked for one packed: measured numbers give 2 to 5, repeated
    ones some tens, blanks a thousand (gzip) or a million (bzip2); `harmless`: bytes that are always
    allowed.
    """
    return harmless + ratio * size


@contextmanager
def open_archive(
    path: str | Path, expected: str, names: Sequence[str] | None = None
) -> Iterator[tuple[zipfile.ZipFile, dict[str, ArchiveMember]]]:
    """An archive and its arrays by name, those of `names` if given.

    **Raises:** `InputError`: it cannot be read, an array has another length than its header
    states or holds Python objects, or all unpack to an implausible size
    (`largest_unpacked_size`)."""
    path = Path(path)
    check_plain(path)
    with foreign_parser(path, expected):
        size = path.stat().st_size
        archive = zipfile.ZipFile(path)
    with archive:
        infos = {info.filename.removesuffix(SUFFIX): info for info in archive.infolist()}
        if len(infos) < len(archive.infolist()):
            raise InputError(f"{path}: damaged: two of its members have one name")
        if names is not None:
            infos = {name: info for name, info in infos.items() if name in names}
        foreign = [name for name, info in infos.items() if not info.filename.endswith(SUFFIX)]
        if foreign:
            raise InputError(
                f"{path}: is not {expected}, or is damaged: {foreign[0]!r} is no array of NumPy"
            )
        if unreadable_names := [
            name for name, info in infos.items() if info.compress_type not in METHODS
        ]:
            raise InputError(
                f"{path}: the array {unreadable_names[0]!r} is packed in a way that numpy.savez "
                "does not use; write it with numpy.savez or numpy.savez_compressed"
            )
        unpacked = sum(info.file_size for info in infos.values())
        if unpacked > largest_unpacked_size(size):
            raise InputError(
                f"{path}: is not {expected}, or is damaged: {size} bytes that claim to unpack to "
                f"{unpacked}"
            )
        yield archive, {n: _member(path, expected, archive, n, i) for n, i in infos.items()}


def read_arrays(path: str | Path, expected: str) -> dict[str, np.ndarray]:
    """All arrays of an archive; raises as `open_archive`."""
    with open_archive(path, expected) as (archive, members):
        return {
            name: read_member(path, expected, archive, name, member)
            for name, member in members.items()
        }


def read_member(
    path: str | Path, expected: str, archive: zipfile.ZipFile, name: str, member: ArchiveMember
) -> np.ndarray:
    """An array of an archive, whose checksum is tested.

    **Raises:** `InputError` if it is damaged."""
    content = bytearray(member.info.file_size)
    with foreign_parser(f"{path}, array {name!r}", expected), archive.open(member.info) as stream:
        # A megabyte at a time: read at once, the array would be in memory twice.
        for begin in range(0, len(content), 2**20):
            content[begin : begin + 2**20] = stream.read(2**20)
        stream.read(1)  # at its end zipfile compares the checksum
        array = np.frombuffer(content, member.dtype, math.prod(member.shape), member.begin)
        if member.dtype.kind == "U":  # NumPy takes any number for a letter
            codes = np.frombuffer(content, f"{member.dtype.byteorder}u4", offset=member.begin)
            if ((codes > 0x10FFFF) | ((codes >= 0xD800) & (codes < 0xE000))).any():
                raise ValueError("its texts have letters that are none in Unicode")
        return array.reshape(member.shape, order="F" if member.by_columns else "C")


def _member(
    path: Path, expected: str, archive: zipfile.ZipFile, name: str, info: zipfile.ZipInfo
) -> ArchiveMember:
    where = f"{path}, array {name!r}"
    with foreign_parser(where, expected), archive.open(info) as stream:
        version = np.lib.format.read_magic(stream)
        read_header: Callable | None = HEADERS.get(version)
        if read_header is None:
            raise ValueError(f"version {version} of its header is not read")
        shape, by_columns, dtype = read_header(stream)
        begin = stream.tell()
    if dtype.hasobject or dtype.names or dtype.subdtype:
        raise InputError(f"{where}: holds {dtype}; expected plain numbers or texts")
    # Of whole numbers of Python, which cannot overflow as NumPy's do.
    if any(n < 0 for n in shape) or begin + math.prod(shape) * dtype.itemsize != info.file_size:
        raise InputError(
            f"{where}: damaged: its header states {shape} of {dtype}, its size is "
            f"{info.file_size - begin} bytes"
        )
    return ArchiveMember(info, tuple(map(int, shape)), dtype, bool(by_columns), begin)
