"""Checks of a LAS or LAZ file before laspy reads it: every count and size in its headers against
the length of the file. On a damaged file laspy would read records for hours, and lazrs allocate
what a header claims and abort the process.

Sources: LAS 1.4 specification, R15 (header table 3, variable length records 2.5, 2.7); LAZ
specification 1.4 (chunk table, laszip record, layered chunks of the point formats 6 to 10).
"""

import math
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

from jaxbundle.errors import InputError
from jaxbundle.io.text.archives import largest_unpacked_size
from jaxbundle.system.foreign_parsers import foreign_parser

EXPECTED = "a LAS or LAZ file"
# Bytes of the header by the minor version.
HEADER_SIZES = {0: 227, 1: 227, 2: 227, 3: 235, 4: 375}
# Bytes of a point by its format, without extra bytes.
POINT_SIZES = (20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67)
# Of a compressed point by their type: bytes (None: any) and layers (None: one a byte).
ITEMS = {6: (20, 0), 7: (8, 0), 8: (6, 0), 9: (29, 0), 0: (None, 0),
         10: (30, 9), 11: (6, 1), 12: (8, 2), 13: (29, 1), 14: (None, None)}  # fmt: skip
# The compressor of LASzip 1, before there were chunks; later ones are 2 and 3.
POINTWISE = 1
# The size of chunks that have as many points each as the chunk table says.
VARIABLE_CHUNKS = 2**32 - 1


def check_las(path: Path) -> None:
    """Refuse a file whose headers claim what it cannot hold.

    **Raises:** `InputError`."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(max(HEADER_SIZES.values()))
        if head[:4] != b"LASF":
            raise InputError(f"{path}: is not {EXPECTED}: it does not begin with LASF")
        minor = head[25] if len(head) > 25 else 0
        if len(head) < HEADER_SIZES.get(minor, 227):
            raise InputError(f"{path}: is cut: {size} bytes are less than the header of LAS")
        field = lambda form, offset: struct.unpack_from("<" + form, head, offset)[0]
        if (head[24], minor) not in {(1, known) for known in HEADER_SIZES}:
            raise InputError(f"{path}: LAS {head[24]}.{minor} is not read; 1.0 to 1.4 are")
        length, begin, records = field("H", 94), field("I", 96), field("I", 100)
        kind, row, points = field("B", 104), field("H", 105), field("I", 107)
        if minor >= 4:
            points = field("Q", 247)
        if not HEADER_SIZES[minor] <= length <= begin <= size:
            raise _beyond(path, "bytes before the points")
        if kind & 63 >= len(POINT_SIZES) or row < POINT_SIZES[kind & 63]:
            raise InputError(f"{path}: damaged: points of format {kind & 63} with {row} bytes")
        for offset, field_name in ((131, "scale"), (155, "offset")):
            for axis, value in zip("XYZ", struct.unpack_from("<3d", head, offset)):
                if not math.isfinite(value) or (field_name == "scale" and value == 0):
                    raise InputError(
                        f"{path}: damaged: the {field_name} of {axis} is {value:g}; expected a "
                        "finite number" + (", not 0" if field_name == "scale" else "")
                    )
        laszip_record = _check_records(path, file, "records", records, length, begin)
        if minor >= 4 and (extended := field("I", 243)):
            _check_records(path, file, "extended records", extended, field("Q", 235), size)
        if kind & 128:
            if points * row > largest_unpacked_size(size):
                raise _beyond(path, "points")
            _check_compression(path, file, laszip_record, begin, size, points, row)
        elif begin + points * row > size:
            raise InputError(
                f"{path}: is cut, or damaged: its header states {points} points, there are "
                f"{(size - begin) // row}"
            )


def _check_records(
    path: Path, file: BinaryIO, kind: str, number: int, place: int, end: int
) -> Mapping[tuple[bytes, int], bytes]:
    """The content of the record of LAZ; refuses records that go beyond `end`."""
    # Reserved H, user 16s, record H, length H or Q, description 32s.
    extended = kind.startswith("extended")
    form = struct.Struct("<2x16sHQ32x" if extended else "<2x16sHH32x")
    records = {}
    for _ in range(number):
        if place + form.size > end:
            raise _beyond(path, kind)
        user, record, length = form.unpack(_read(path, file, place, form.size))
        place += form.size + length
        if place > end:
            raise _beyond(path, kind)
        if user.startswith(b"laszip encoded"):
            records[user.rstrip(b"\0"), record] = file.read(length)
    return records


def _check_compression(
    path: Path,
    file: BinaryIO,
    records: Mapping[tuple[bytes, int], bytes],
    begin: int,
    size: int,
    points: int,
    row: int,
) -> None:
    """Refuse a description of the compression, and chunks, that do not fit the points."""
    laszip = records.get((b"laszip encoded", 22204), b"")
    if len(laszip) < 34:
        raise InputError(f"{path}: damaged: the record that describes its compression is missing")
    (compressor,) = struct.unpack_from("<H", laszip)
    if compressor == POINTWISE:
        raise InputError(
            f"{path}: LAZ of LASzip 1, compressed as a whole and not in chunks, is not read; "
            "decompress it: laszip64 -i FILE.laz -o FILE.las"
        )
    (chunk,) = struct.unpack_from("<I", laszip, 12)
    (number,) = struct.unpack_from("<H", laszip, 32)
    if len(laszip) < 34 + 6 * number:
        raise _beyond(path, "items of a point")
    items = list(struct.iter_unpack("<3H", laszip[34 : 34 + 6 * number]))
    are_known = all(k in ITEMS and ITEMS[k][0] in (None, length) for k, length, _ in items)
    if not are_known or sum(length for _, length, _ in items) != row or not chunk:
        raise InputError(f"{path}: damaged: its compression does not fit points of {row} bytes")
    # Lazrs makes room for a whole chunk, of 50 000 points unless a program was told otherwise.
    room = largest_unpacked_size(size, harmless=2**28)
    if chunk != VARIABLE_CHUNKS and chunk * row > room:
        raise InputError(f"{path}: damaged: chunks of {chunk} points in a file of {size} bytes")
    if not points:
        return
    unpack = lambda form, offset: struct.unpack(
        form, _read(path, file, offset, struct.calcsize(form))
    )
    (table,) = unpack("<q", begin)
    if table == -1:  # written at the end, by a program that could not go back
        (table,) = unpack("<q", size - 8)
    if not begin + 8 <= table <= size - 8:
        raise _beyond(path, "bytes before its chunks")
    _, chunks = unpack("<II", table)
    fixed = chunk != VARIABLE_CHUNKS
    if (fixed and chunks != -(-points // chunk)) or chunks > min(points, size):
        raise InputError(f"{path}: damaged: its header states {chunks} chunks for {points} points")
    file.seek(begin)
    for number_held, length in _read_chunks(path, file, laszip):
        place = begin + 8
        begin += length
        if begin + 8 > table:
            raise _beyond(path, "bytes of chunks")
        layers = [length if ITEMS[kind][1] is None else ITEMS[kind][1] for kind, length, _ in items]
        layers = sum(number or 0 for number in layers)
        if layers:  # a point, the number of points, the sizes of the layers, the layers
            counted, *sizes = unpack(f"<{1 + layers}I", place + row)
            if counted > number_held or row + 4 * (1 + layers) + sum(sizes) > length:
                raise _beyond(path, "bytes of layers")


def _read_chunks(path: Path, file: BinaryIO, laszip: bytes) -> list[tuple[int, int]]:
    """Numbers of points and bytes of the chunks; the file is at the first point."""
    with foreign_parser(path, EXPECTED):
        import lazrs

        table: Any = lazrs.read_chunk_table(file, lazrs.LazVlr(laszip))
        return [(int(points), int(size)) for points, size in table]


def _read(path: Path, file: BinaryIO, place: int, length: int) -> bytes:
    file.seek(max(place, 0))
    content = file.read(length)
    if place < 0 or len(content) < length:
        raise _beyond(path, "bytes")
    return content


def _beyond(path: Path, kind: str) -> InputError:
    return InputError(f"{path}: damaged: its header states more {kind} than the file holds")
