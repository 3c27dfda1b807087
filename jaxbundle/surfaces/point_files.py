"""Clouds as PLY, LAS or LAZ, and DXF; in and out.

PLY: binary, coordinates in double precision, colours, σ and rays. LAS 1.4 by laspy: coordinates to
1/1000 of the median σ or better, σ as extra dimensions, the coordinate system. DXF by ezdxf: POINT
entities on the layer POINTS.
"""

import io
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int, UInt8

from jaxbundle.choices import CLOUD_FILES
from jaxbundle.errors import InputError
from jaxbundle.io.text.csv_tables import write_bytes, write_text
from jaxbundle.surfaces.cloud import Cloud
from jaxbundle.surfaces.files import read_cloud_csv, write_cloud_csv
from jaxbundle.system.file_content import missing

if TYPE_CHECKING:
    import laspy

SIGMAS = ("sX", "sY", "sZ")
VERTEX = np.dtype([
    ("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("red", "u1"), ("green", "u1"), ("blue", "u1"),
    *((name, "<f4") for name in SIGMAS), ("rays", "<i4"),
])  # fmt: skip
PLY_TYPES = {"<f8": "double", "|u1": "uchar", "<f4": "float", "<i4": "int"}
PLY_READ = {"double": "<f8", "float64": "<f8", "float": "<f4", "float32": "<f4", "uchar": "u1",
            "uint8": "u1", "char": "i1", "int8": "i1", "int": "<i4", "int32": "<i4",
            "uint": "<u4", "uint32": "<u4", "short": "<i2", "int16": "<i2", "ushort": "<u2",
            "uint16": "<u2"}  # fmt: skip
LAS_HEAD = 375
"""Bytes of the header of LAS 1.4 (specification R15, table 3); shorter in earlier versions."""


def write_cloud(cloud: Cloud, path: str | Path) -> None:
    """Write a cloud by its suffix: .csv, .ply, .las, .laz or .dxf.

    **Raises:** `InputError` for another suffix, or if a package is missing."""
    path = Path(path)
    match path.suffix.lower():
        case ".csv":
            write_cloud_csv(cloud, path)
        case ".ply":
            _write_ply(cloud, path)
        case ".las" | ".laz":
            _write_las(cloud, path)
        case ".dxf":
            _write_dxf(cloud, path)
        case suffix:
            raise InputError(
                f"{path}: suffix {suffix!r}; one of {', '.join(CLOUD_FILES)} is expected"
            )


def read_cloud(path: str | Path) -> Cloud:
    """A cloud from .csv (columns X, Y, Z), .ply, .las or .laz.

    **Raises:** `InputError` if it cannot be read."""
    path = Path(path)
    if not path.is_file():
        raise missing(path, "a cloud, .csv, .ply, .las or .laz")
    readers = {".csv": read_cloud_csv, ".txt": read_cloud_csv, ".xyz": read_cloud_csv,
               ".ply": _read_ply, ".las": _read_las, ".laz": _read_las}  # fmt: skip
    suffix = path.suffix.lower()
    if suffix not in readers:
        raise InputError(f"{path}: suffix {suffix!r}; .csv, .ply, .las or .laz is expected")
    cloud = readers[suffix](path)
    bad = ~np.isfinite(cloud.X).all(axis=1)
    if bad.any():
        raise InputError(
            f"{path}: {bad.sum()} of {len(bad)} points have coordinates that are not finite, the "
            f"first is point {bad.argmax() + 1}"
        )
    return cloud


def _write_ply(cloud: Cloud, path: Path) -> None:
    rows = np.zeros(len(cloud), VERTEX)
    for k, axis in enumerate("xyz"):
        rows[axis] = cloud.X[:, k]
    colour = cloud.colour if cloud.colour is not None else np.full((len(cloud), 3), 160, np.uint8)
    for k, name in enumerate(("red", "green", "blue")):
        rows[name] = colour[:, k]
    for k, name in enumerate(SIGMAS):
        rows[name] = cloud.sigma[:, k]
    rows["rays"] = cloud.rays
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    head += [f"property {PLY_TYPES[VERTEX[n].str]} {n}" for n in VERTEX.names or ()]
    write_bytes(path, ["\n".join([*head, "end_header\n"]).encode(), rows.tobytes()])


def _read_ply(path: Path) -> Cloud:
    content = path.read_bytes()
    head, mark, body = content.partition(b"end_header\n")
    lines = head.decode("ascii", "replace").splitlines()
    if not mark or not lines or lines[0].strip() != "ply":
        raise InputError(f"{path}: not a PLY file")
    form, number, fields = _ply_head(path, lines)
    names = [n for n, _ in fields]
    if not {"x", "y", "z"} <= {*names}:
        raise InputError(f"{path}: vertices without x, y, z")
    try:
        if form == "ascii":
            table = np.array(
                [
                    line.split()[: len(fields)]
                    for line in body.decode("ascii").splitlines()[:number]
                ],
                float,
            )
            column = lambda name: table.reshape(number, -1)[:, names.index(name)]
        else:
            order = ">" if "big" in form else "<"
            kinds = [(n, t.replace("<", order)) for n, t in fields]
            rows = np.frombuffer(body, np.dtype(kinds), number)
            column = lambda name: rows[name]
        return _cloud_of_columns(column, names, number)
    except (ValueError, IndexError) as error:
        raise InputError(f"{path}: {error}") from None


def _ply_head(path: Path, lines: Sequence[str]) -> tuple[str, int, list[tuple[str, str]]]:
    """The format, the number of vertices, and names and types of their fields."""
    form, number, fields, current = "", 0, [], ""
    for place, line in enumerate(lines, 1):
        match line.split():
            case ["format", form, *_]:
                pass
            case ["element", current, text] if current != "vertex" or text.isdecimal():
                number = int(text) if current == "vertex" else number
            case ["property", kind, name] if current == "vertex":
                if kind not in PLY_READ:
                    raise InputError(f"{path}: property of type {kind} of a vertex is not read")
                fields.append((name, PLY_READ[kind]))
            case ["element" | "format", *_]:
                raise InputError(f"{path}, line {place}: {line!r} in the head of a PLY file")
            case ["property", *_] if current == "vertex":
                raise InputError(f"{path}, line {place}: {line!r} of a vertex is not read")
    return form, number, fields


def _cloud_of_columns(column: Callable[[str], np.ndarray], names: Sequence[str], n: int) -> Cloud:
    X = np.stack([column(axis).astype(float) for axis in "xyz"], 1)
    sigma = np.stack(
        [column(s).astype(float) if s in names else np.full(n, np.nan) for s in SIGMAS], 1
    )
    colours = ("red", "green", "blue")
    colour = (
        np.stack([column(c) for c in colours], 1).astype(np.uint8)
        if ({*colours} <= {*names})
        else None
    )
    rays = np.asarray(column("rays")).astype(int) if "rays" in names else np.zeros(n, int)
    return _plain_cloud(X, sigma, rays, colour)


def _plain_cloud(
    X: Float[np.ndarray, "n 3"],
    sigma: Float[np.ndarray, "n 3"],
    rays: Int[np.ndarray, " n"],
    colour: UInt8[np.ndarray, "n 3"] | None,
    system: str | None = None,
) -> Cloud:
    n = len(X)
    covariance = np.zeros((n, 3, 3))
    covariance[:, [0, 1, 2], [0, 1, 2]] = sigma**2
    return Cloud(
        X, covariance, rays, np.zeros(n, int), np.full((n, 2), np.nan), ("",), colour, system
    )


def _laspy() -> ModuleType:
    try:
        import laspy
    except ImportError:
        raise InputError("LAS and LAZ need laspy: pip install 'jaxbundle[files]'") from None
    return laspy


def _write_las(cloud: Cloud, path: Path) -> None:
    laspy = _laspy()
    if path.suffix.lower() == ".laz" and not laspy.LazBackend.detect_available():
        raise InputError("LAZ needs lazrs: pip install 'jaxbundle[files]'")
    header = laspy.LasHeader(point_format=7, version="1.4")
    span = np.ptp(cloud.X, axis=0).max() if len(cloud) else 1.0
    s = cloud.sigma[np.isfinite(cloud.sigma)]
    fine = 1e-3 * float(np.median(s)) if len(s) else 1e-4
    # coordinates are whole numbers of 32 bits: 2³¹ steps hold the extent; a power of ten above 1e-9
    # otherwise, so that decimal coordinates stay what they are
    scale = max(10.0 ** np.floor(np.log10(max(fine, 1e-9))), span / 2**30)
    header.scales = np.full(3, scale)
    header.offsets = np.floor(cloud.X.min(0)) if len(cloud) else np.zeros(3)
    header.add_extra_dims([laspy.ExtraBytesParams(name, np.float32) for name in SIGMAS])
    header.add_extra_dim(laspy.ExtraBytesParams("rays", np.uint8))
    if cloud.system is not None:
        import pyproj

        header.add_crs(pyproj.CRS.from_user_input(cloud.system))
    las = laspy.LasData(header)
    las.x, las.y, las.z = cloud.X.T
    if cloud.colour is not None:
        # LAS has colours of 16 bits: 255 becomes 65535
        las.red, las.green, las.blue = (257 * c.astype(np.uint16) for c in cloud.colour.T)
    for k, name in enumerate(SIGMAS):
        las[name] = cloud.sigma[:, k].astype(np.float32)
    las["rays"] = np.minimum(cloud.rays, 255).astype(np.uint8)
    # in memory, a fraction of the cloud: lazrs hides why the system refuses to write
    file = io.BytesIO()
    las.write(file, do_compress=path.suffix.lower() == ".laz")
    write_bytes(path, file.getvalue())


def _read_las(path: Path) -> Cloud:
    laspy = _laspy()
    _check_las_counts(path)
    try:
        return _las_cloud(laspy.read(path))
    except Exception as error:  # laspy and its backends raise any exception
        why = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: damaged, or not LAS as expected: {why}") from None


def _check_las_counts(path: Path) -> None:
    """Refuse counts in a header that the file has no room for: laspy would read records for hours,
    lazrs allocate for all chunks and abort the process (LAS 1.4 R15, table 3; LAZ 1.4)."""
    size = path.stat().st_size
    with path.open("rb") as file:
        # offsets of the fields: 25 minor version, 96 first point, 100 records, 104 point format
        # (bit 7: compressed), 235 and 243 first and number of the extended records
        head = file.read(LAS_HEAD)
        unpack = lambda form, offset: (
            struct.unpack_from(form, head, offset)[0] if len(head) >= offset + 8 else 0
        )
        begin = unpack("<I", 96)
        # a variable length record has 54 bytes at least, an extended one 60
        room = {"records": (54 * unpack("<I", 100), size)}
        if unpack("<B", 25) >= 4 and unpack("<I", 243):
            room["extended records"] = 60 * unpack("<I", 243), size - unpack("<Q", 235)
        if unpack("<B", 104) & 128:  # compressed: points begin with the offset of the chunk table
            file.seek(begin)
            (table,) = struct.unpack("<q", file.read(8).rjust(8, b"\0"))
            if table == -1:  # written at the end, by a program that could not go back
                file.seek(max(size - 8, 0))
                (table,) = struct.unpack("<q", file.read(8).rjust(8, b"\0"))
            file.seek(max(table, 0))
            room["chunks"] = struct.unpack("<II", file.read(8).ljust(8, b"\0"))[1], size
    for what, (needed, present) in room.items():
        if needed > present:
            raise InputError(f"{path}: damaged: its header counts more {what} than it has room for")


def _las_cloud(las: "laspy.LasData") -> Cloud:
    names = {*las.point_format.dimension_names}
    n = len(las.points)
    X = np.stack([np.asarray(a, float) for a in (las.x, las.y, las.z)], 1)
    sigma = np.stack(
        [np.asarray(las[s], float) if s in names else np.full(n, np.nan) for s in SIGMAS], 1
    )
    colour = None
    if "red" in names:
        colour = np.stack([np.asarray(las[c]) // 257 for c in ("red", "green", "blue")], 1)
        colour = colour.astype(np.uint8)
    rays = np.asarray(las["rays"]).astype(int) if "rays" in names else np.zeros(n, int)
    crs = las.header.parse_crs() if n else None
    system = None if crs is None else (crs.to_string() if crs.to_epsg() else crs.to_wkt())
    return _plain_cloud(X, sigma, rays, colour, system)


def _write_dxf(cloud: Cloud, path: Path) -> None:
    try:
        import ezdxf.filemanagement
    except ImportError:
        raise InputError("DXF needs ezdxf: pip install 'jaxbundle[files]'") from None
    # the drawing of 5 million points takes some GB of memory, and no CAD program reads it
    if len(cloud) > 5_000_000:
        raise InputError(f"{path}: {len(cloud)} points are too many for a drawing; thin the cloud")
    drawing = ezdxf.filemanagement.new("R2010")
    drawing.layers.add("POINTS", color=7)
    space = drawing.modelspace()
    for place in cloud.X.tolist():
        space.add_point(tuple(place), dxfattribs={"layer": "POINTS"})
    text = io.StringIO()
    drawing.write(text)
    write_text(path, text.getvalue())
