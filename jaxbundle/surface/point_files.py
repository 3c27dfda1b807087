"""Clouds as PLY, LAS or LAZ, and DXF; in and out.

PLY: binary, coordinates in double precision, colours, σ and rays. LAS 1.4 by laspy: coordinates to
1/1000 of the median σ or better, σ as extra dimensions, the coordinate system. DXF by ezdxf: POINT
entities on the layer POINTS.
"""

import io
from pathlib import Path

import numpy as np

from jaxbundle.choices import CLOUD_FILES
from jaxbundle.errors import InputError
from jaxbundle.io.text.csv_tables import write_bytes, write_text
from jaxbundle.io.writing.replacing import replace_file
from jaxbundle.surface.cloud import Cloud
from jaxbundle.surface.files import read_cloud_csv, write_cloud_csv

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
LEAST_SCALE = 1e-9
MOST_DXF = 5_000_000


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
        raise InputError(f"{path}: no such file")
    match path.suffix.lower():
        case ".csv" | ".txt" | ".xyz":
            return read_cloud_csv(path)
        case ".ply":
            return _read_ply(path)
        case ".las" | ".laz":
            return _read_las(path)
        case suffix:
            raise InputError(f"{path}: suffix {suffix!r}; .csv, .ply, .las or .laz is expected")


def _write_ply(cloud, path):
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


def _read_ply(path):
    content = path.read_bytes()
    head, mark, body = content.partition(b"end_header\n")
    lines = head.decode("ascii", "replace").splitlines()
    if not mark or not lines or lines[0].strip() != "ply":
        raise InputError(f"{path}: not a PLY file")
    form = next((line.split()[1] for line in lines if line.startswith("format")), "")
    number, fields, current = 0, [], ""
    for line in lines:
        words = line.split()
        if words[:1] == ["element"]:
            current = words[1]
            number = int(words[2]) if current == "vertex" else number
        elif words[:1] == ["property"] and current == "vertex":
            if words[1] not in PLY_READ:
                raise InputError(f"{path}: property of type {words[1]} of a vertex is not read")
            fields.append((words[2], PLY_READ[words[1]]))
    names = [n for n, _ in fields]
    if not {"x", "y", "z"} <= {*names}:
        raise InputError(f"{path}: vertices without x, y, z")
    try:
        if form == "ascii":
            table = np.array([line.split()[: len(fields)] for line in
                              body.decode("ascii").splitlines()[:number]], float)  # fmt: skip
            column = lambda name: table.reshape(number, -1)[:, names.index(name)]
        else:
            order = ">" if "big" in form else "<"
            kinds = [(n, t.replace("<", order)) for n, t in fields]
            rows = np.frombuffer(body, np.dtype(kinds), number)
            column = lambda name: rows[name]
        return _of_columns(column, names, number)
    except (ValueError, IndexError) as error:
        raise InputError(f"{path}: {error}") from None


def _of_columns(column, names, n):
    X = np.stack([column(axis).astype(float) for axis in "xyz"], 1)
    sigma = np.stack([column(s).astype(float) if s in names else np.full(n, np.nan)
                      for s in SIGMAS], 1)  # fmt: skip
    colours = ("red", "green", "blue")
    colour = np.stack([column(c) for c in colours], 1).astype(np.uint8) if (
        {*colours} <= {*names}
    ) else None
    rays = np.asarray(column("rays")).astype(int) if "rays" in names else np.zeros(n, int)
    return _plain_cloud(X, sigma, rays, colour)


def _plain_cloud(X, sigma, rays, colour, system=None):
    n = len(X)
    covariance = np.zeros((n, 3, 3))
    covariance[:, [0, 1, 2], [0, 1, 2]] = sigma**2
    return Cloud(X, covariance, rays, np.zeros(n, int), np.full((n, 2), np.nan), ("",), colour,
                 system)  # fmt: skip


def _laspy():
    try:
        import laspy
    except ImportError:
        raise InputError("LAS and LAZ need laspy: pip install 'jaxbundle[files]'") from None
    return laspy


def _write_las(cloud, path):
    laspy = _laspy()
    if path.suffix.lower() == ".laz" and not laspy.LazBackend.detect_available():
        raise InputError("LAZ needs lazrs: pip install 'jaxbundle[files]'")
    header = laspy.LasHeader(point_format=7, version="1.4")
    span = np.ptp(cloud.X, axis=0).max() if len(cloud) else 1.0
    s = cloud.sigma[np.isfinite(cloud.sigma)]
    fine = 1e-3 * float(np.median(s)) if len(s) else 1e-4
    # 2³¹ steps hold the extent
    scale = max(10.0 ** np.floor(np.log10(max(fine, LEAST_SCALE))), span / 2**30)
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
        las.red, las.green, las.blue = (257 * c.astype(np.uint16) for c in cloud.colour.T)
    for k, name in enumerate(SIGMAS):
        las[name] = cloud.sigma[:, k].astype(np.float32)
    las["rays"] = np.minimum(cloud.rays, 255).astype(np.uint8)
    with replace_file(path) as temporary, open(temporary, "wb") as file:
        las.write(file, do_compress=path.suffix.lower() == ".laz")


def _read_las(path):
    laspy = _laspy()
    try:
        las = laspy.read(path)
    except Exception as error:  # laspy and its backends raise any exception
        raise InputError(f"{path}: {' '.join(str(error).split())[:200]}") from None
    names = {*las.point_format.dimension_names}
    n = len(las.points)
    X = np.stack([np.asarray(a, float) for a in (las.x, las.y, las.z)], 1)
    sigma = np.stack([np.asarray(las[s], float) if s in names else np.full(n, np.nan)
                      for s in SIGMAS], 1)  # fmt: skip
    colour = None
    if "red" in names:
        colour = np.stack([np.asarray(las[c]) // 257 for c in ("red", "green", "blue")], 1)
        colour = colour.astype(np.uint8)
    rays = np.asarray(las["rays"]).astype(int) if "rays" in names else np.zeros(n, int)
    crs = las.header.parse_crs() if n else None
    system = None if crs is None else (crs.to_string() if crs.to_epsg() else crs.to_wkt())
    return _plain_cloud(X, sigma, rays, colour, system)


def _write_dxf(cloud, path):
    try:
        import ezdxf.filemanagement
    except ImportError:
        raise InputError("DXF needs ezdxf: pip install 'jaxbundle[files]'") from None
    if len(cloud) > MOST_DXF:
        raise InputError(f"{path}: {len(cloud)} points are too many for a drawing; thin the cloud")
    drawing = ezdxf.filemanagement.new("R2010")
    drawing.layers.add("POINTS", color=7)
    space = drawing.modelspace()
    for place in cloud.X.tolist():
        space.add_point(tuple(place), dxfattribs={"layer": "POINTS"})
    text = io.StringIO()
    drawing.write(text)
    write_text(path, text.getvalue())
