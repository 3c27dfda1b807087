"""The vertices of a binary PLY in memory."""

import re

import numpy as np

from jaxbundle.errors import InputError

TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
ORDER = {b"binary_little_endian": "<", b"binary_big_endian": ">"}


def read_vertices(where: str, content: bytes, names: tuple[str, ...]) -> np.ndarray:
    """The vertices as a structured array with all their scalar properties.

    **Arguments:** `where` names the file in messages; `names`: properties that are expected.

    **Raises:** `InputError` for another file, lists before the end, a wrong length, and
    missing properties."""
    header = re.match(rb"ply\r?\nformat (\S+) 1\.0\r?\n(.*?)end_header\r?\n", content, re.DOTALL)
    if header is None or header[1] not in ORDER:
        raise InputError(f"{where}: expected a binary PLY")
    # Properties belong to the element above them.
    fields, number, current = [], 0, ""
    for line in header[2].decode("ascii", errors="replace").splitlines():
        match line.split():
            case ["element", current, many] if many.isdigit():
                if current == "vertex":
                    number = int(many)
                # Their rows would have to be skipped, and may have lists.
                elif not fields:
                    raise InputError(f"{where}: expected its vertices first")
            case ["property", kind, name] if current == "vertex" and kind in TYPES:
                fields.append((name, ORDER[header[1]] + TYPES[kind]))
            case ["property", *_] if current == "vertex":
                raise InputError(f"{where}: a property of another type is not read: {line}")
    try:
        dtype = np.dtype(fields)
    except ValueError:
        raise InputError(f"{where}: two properties have one name") from None
    missing_names = [name for name in names if name not in (dtype.names or ())]
    if missing_names:
        raise InputError(f"{where}: the property {missing_names[0]} is missing")
    if number * dtype.itemsize > len(content) - header.end():
        raise InputError(f"{where}: is damaged: it is shorter than its header states")
    table = np.frombuffer(content, dtype, number, header.end())
    for name in names:
        if not np.isfinite(table[name]).all():
            raise InputError(f"{where}: expected a finite {name} of every vertex")
    return table
