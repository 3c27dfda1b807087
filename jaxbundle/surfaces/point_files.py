"""Clouds as PLY, LAS or LAZ, and DXF; in and out.

PLY: binary, coordinates in double precision, colours, σ, rays, base image and its pixel; the names
of the base images are comments of its head. LAS 1.4 by laspy: coordinates to 1/1000 of the median σ
or better, σ as extra dimensions, the coordinate system. DXF by ezdxf: POINT entities on the layer
POINTS.
"""

import dataclasses
import io
import json
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import ModuleType

import numpy as np
from jaxtyping import Real, UInt8

from jaxbundle.choices import CLOUD_FILES
from jaxbundle.errors import InputError
from jaxbundle.io.text.csv_tables import write_bytes, write_text
from jaxbundle.io.text.rows import TextRow
from jaxbundle.network.tables import Source
from jaxbundle.surfaces.cloud import Cloud
from jaxbundle.surfaces.files import SIGMAS, make_cloud, read_cloud_csv, write_cloud_csv
from jaxbundle.surfaces.las_header import EXPECTED, check_las
from jaxbundle.system.file_content import no_such_file, read_content
from jaxbundle.system.foreign_parsers import foreign_parser

COLOURS = ("red", "green", "blue")
VERTEX = np.dtype([
    ("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("red", "u1"), ("green", "u1"), ("blue", "u1"),
    *((name, "<f4") for name in SIGMAS), ("rays", "<i4"), ("image", "<i4"), ("u", "<f4"),
    ("v", "<f4"),
])  # fmt: skip
PLY_TYPES = {"<f8": "double", "|u1": "uchar", "<f4": "float", "<i4": "int"}
PLY_READ = {"double": "<f8", "float64": "<f8", "float": "<f4", "float32": "<f4", "uchar": "u1",
            "uint8": "u1", "char": "i1", "int8": "i1", "int": "<i4", "int32": "<i4",
            "uint": "<u4", "uint32": "<u4", "short": "<i2", "int16": "<i2", "ushort": "<u2",
            "uint16": "<u2"}  # fmt: skip
# The name of a base image in the head, as a text of JSON: any character, in ASCII.
PLY_IMAGE = "comment image "
PLY_END = re.compile(rb"end_header\r?\n")
BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}


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
            raise InputError(f"{path}: suffix {suffix!r}; expected one of {', '.join(CLOUD_FILES)}")


def read_cloud(path: str | Path) -> Cloud:
    """A cloud from .csv (columns X, Y, Z), .ply, .las or .laz.

    **Raises:** `InputError` if it cannot be read."""
    path = Path(path)
    if not path.is_file():
        raise no_such_file(path, "a cloud, .csv, .ply, .las or .laz")
    readers = {".csv": read_cloud_csv, ".txt": read_cloud_csv, ".xyz": read_cloud_csv,
               ".ply": _read_ply, ".las": _read_las, ".laz": _read_las}  # fmt: skip
    suffix = path.suffix.lower()
    if suffix not in readers:
        raise InputError(f"{path}: suffix {suffix!r}; expected .csv, .ply, .las or .laz")
    return readers[suffix](path)


def _write_ply(cloud: Cloud, path: Path) -> None:
    rows = np.zeros(len(cloud), VERTEX)
    for k, axis in enumerate("xyz"):
        rows[axis] = cloud.X[:, k]
    colour = cloud.colour if cloud.colour is not None else np.full((len(cloud), 3), 160, np.uint8)
    for k, name in enumerate(COLOURS):
        rows[name] = colour[:, k]
    for k, name in enumerate(SIGMAS):
        rows[name] = cloud.sigma[:, k]
    rows["rays"], rows["image"] = cloud.rays, cloud.image
    rows["u"], rows["v"] = cloud.uv.T
    head = ["ply", "format binary_little_endian 1.0"]
    head += [PLY_IMAGE + json.dumps(name) for name in cloud.images]
    head += [f"element vertex {len(rows)}"]
    head += [f"property {PLY_TYPES[VERTEX[n].str]} {n}" for n in VERTEX.names or ()]
    write_bytes(path, ["\n".join([*head, "end_header\n"]).encode(), rows.tobytes()])


def _read_ply(path: Path) -> Cloud:
    head, *after_header = PLY_END.split(read_content(path, text=False), maxsplit=1)
    lines = head.decode("ascii", "replace").splitlines()
    if not after_header or not lines or lines[0].strip() != "ply":
        raise InputError(f"{path}: not a PLY file")
    (body,) = after_header
    form, number, fields = _ply_head(path, lines)
    names = [n for n, _ in fields]
    if not {"x", "y", "z"} <= {*names}:
        raise InputError(f"{path}: vertices without x, y, z")
    if len({*names}) < len(names):
        raise InputError(f"{path}: two properties of a vertex have one name")
    if form == "ascii":
        columns = _ply_numbers(path, body, names, number, len(lines) + 2)
    elif form in BYTE_ORDERS:
        kinds = np.dtype([(n, t.replace("<", BYTE_ORDERS[form])) for n, t in fields])
        _check_ply_count(path, number, len(body) // kinds.itemsize)
        rows = np.frombuffer(body, kinds, number)
        columns = {name: rows[name] for name in names}
    else:
        raise InputError(f"{path}: format {form!r}; expected ascii, {', '.join(BYTE_ORDERS)}")
    with np.errstate(invalid="ignore"):  # signalling NaN, which are refused
        X = np.stack([columns[axis].astype(float) for axis in "xyz"], 1)
        colour = None
        if {*COLOURS} <= {*names}:
            are_real = all(dict(fields)[c] in ("<f4", "<f8") for c in COLOURS)
            colour = np.nan_to_num(np.stack([columns[c] for c in COLOURS], 1))
            colour = _bytes_of_colours(colour, are_real)
    cloud = make_cloud(Source(str(path), None, "point"), X, columns, colour)
    return _add_base_images(cloud, lines, columns)


def _bytes_of_colours(
    colour: Real[np.ndarray, "n 3"], are_real: bool = False
) -> UInt8[np.ndarray, "n 3"]:
    """Colours of 0–255 from those of 0–255, of 16 bits, or, where they `are_real`, of 0–1."""
    largest = colour.max(initial=0)
    if are_real and largest <= 1:
        colour = np.rint(255 * colour)
    elif largest > 255:  # 255 is 65535 in 16 bits
        colour = colour // 257
    return colour.astype(np.uint8)


def _add_base_images(
    cloud: Cloud, lines: Sequence[str], columns: Mapping[str, np.ndarray]
) -> Cloud:
    """The base images and their pixels, if the head names the images: in files of this program."""
    texts = [line.removeprefix(PLY_IMAGE) for line in lines if line.startswith(PLY_IMAGE)]
    if not texts or not columns.keys() >= {"image", "u", "v"}:
        return cloud
    with suppress(ValueError):
        names = tuple(str(json.loads(text)) for text in texts)
        image = np.asarray(columns["image"]).astype(int)
        if not len(image) or (image.min() >= 0 and image.max() < len(names)):
            uv = np.column_stack([columns["u"], columns["v"]]).astype(float)
            return dataclasses.replace(cloud, image=image, images=names, uv=uv)
    return cloud


def _ply_numbers(
    path: Path, body: bytes, names: Sequence[str], number: int, first_line: int
) -> dict[str, np.ndarray]:
    """The columns of an ASCII file, whose first point is in the line `first_line`."""
    lines = body.decode("ascii", "replace").splitlines()
    _check_ply_count(path, number, len(lines))
    lines = lines[:number]
    try:
        table = np.array([line.split()[: len(names)] for line in lines], float)
        table = table.reshape(number, len(names))
    except ValueError:  # which point? the slow way
        rows = [TextRow(path, k, line) for k, line in enumerate(lines, first_line)]
        table = np.array([row.numbers(names, allow_more=True) for row in rows])
    return dict(zip(names, table.T))


def _check_ply_count(path: Path, number_stated: int, number_present: int) -> None:
    if number_stated > number_present:
        raise InputError(
            f"{path}: is cut, or damaged: its header states {number_stated} points, there are "
            f"{number_present}"
        )


def _ply_head(path: Path, lines: Sequence[str]) -> tuple[str, int, list[tuple[str, str]]]:
    """The format, the number of vertices, and names and types of their fields."""
    form, number, fields, current = "", 0, [], ""
    for place, line in enumerate(lines, 1):
        match line.split():
            case ["format", form, *_]:
                pass
            case ["element", "vertex", text] if text.isdecimal() and len(text) < 19:
                current, number = "vertex", int(text)
            case ["element", current, _] if current != "vertex":
                if not fields:
                    raise InputError(f"{path}, line {place}: {line!r} before the vertices")
            case ["property", kind, name] if current == "vertex":
                if kind not in PLY_READ:
                    raise InputError(f"{path}: property of type {kind} of a vertex is not read")
                fields.append((name, PLY_READ[kind]))
            case ["element" | "format", *_]:
                raise InputError(f"{path}, line {place}: {line!r} in the head of a PLY file")
            case ["property", *_] if current == "vertex":
                raise InputError(f"{path}, line {place}: {line!r} of a vertex is not read")
    return form, number, fields


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
    # Coordinates are whole numbers of 32 bits: 2³¹ steps hold the extent; a power of ten above 1e-9
    # otherwise, so that decimal coordinates stay what they are.
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
    # In memory, a fraction of the cloud: lazrs hides why the system refuses to write.
    file = io.BytesIO()
    las.write(file, do_compress=path.suffix.lower() == ".laz")
    write_bytes(path, file.getvalue())


def _read_las(path: Path, points_at_once: int = 1 << 18) -> Cloud:
    """A cloud; **Arguments:** `points_at_once`: points read at once, some megabytes, which stay in
    the cache of the processor for their coordinates and colours."""
    laspy = _laspy()
    check_las(path)
    with foreign_parser(path, EXPECTED), laspy.open(path) as reader:
        header, begin = reader.header, 0
        names = {*header.point_format.dimension_names}
        X = np.empty((header.point_count, 3))
        colour = np.empty(X.shape, np.uint16) if {*COLOURS} <= names else None
        extra_columns = {name: [] for name in (*SIGMAS, "rays") if name in names}
        for points in reader.chunk_iterator(points_at_once):
            part = slice(begin, begin := begin + len(points))
            # As laspy's x, without the arrays between.
            for k, raw in enumerate((points.X, points.Y, points.Z)):
                np.multiply(raw, header.scales[k], out=X[part, k])
                X[part, k] += header.offsets[k]
            if colour is not None:
                for k, name in enumerate(COLOURS):
                    colour[part, k] = points[name]
            for name, columns in extra_columns.items():
                columns.append(np.array(points[name]))
        if begin < len(X):
            raise InputError(
                f"{path}: is cut, or damaged: its header states {len(X)} points, there are {begin}"
            )
        crs = header.parse_crs() if len(X) else None
        system = None if crs is None else (crs.to_string() if crs.to_epsg() else crs.to_wkt())
    columns = {
        name: np.concatenate(parts) if parts else np.zeros(0)
        for name, parts in extra_columns.items()
    }
    if colour is not None:
        colour = _bytes_of_colours(colour)
    return make_cloud(Source(str(path), None, "point"), X, columns, colour, system)


def _write_dxf(cloud: Cloud, path: Path) -> None:
    try:
        import ezdxf.filemanagement
    except ImportError:
        raise InputError("DXF needs ezdxf: pip install 'jaxbundle[files]'") from None
    # The drawing of 5 million points takes some GB of memory, and no CAD program reads it.
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
