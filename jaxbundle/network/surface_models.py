"""Known surfaces in object space: meshes of triangles (PLY, OBJ), grids of heights (rasters), and
what of them is near a point."""

import os
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbundle.errors import InputError
from jaxbundle.geometry.surfaces import squared_distances_to_triangles
from jaxbundle.system.file_content import check_plain
from jaxbundle.system.foreign_parsers import foreign_parser
from jaxbundle.system.rasters import read_heights

# Triangles near the start value of a point, of which the nearest counts: one and the 12 that share
# a corner with it in a regular mesh, rounded up.
CANDIDATES = 16
# The exact distance is computed of this many triangles with the smallest bounds: long thin ones
# have small bounds and large distances.
BOUNDED = 128
# Nodes of a grid on either side of the start value of a point.
REACH = 4
PLY_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}


class Mesh(NamedTuple):
    """Vertices and triangles (rows of vertices)."""

    vertices: Float[np.ndarray, "n 3"]
    triangles: Int[np.ndarray, "m 3"]


class TerrainGrid(NamedTuple):
    """Heights [rows, columns], NaN for voids; the place of the first node, and the steps along X of
    columns and along Y of rows."""

    heights: Float[np.ndarray, "rows columns"]
    origin: tuple[float, float]
    step: tuple[float, float]


def read_mesh(path: str | Path) -> Mesh:
    """A mesh of a .ply or .obj file; polygons become fans of triangles.

    **Raises:** `InputError`."""
    check_plain(path)
    if not os.path.isfile(path):
        raise InputError(f"{path}: no such file; expected a mesh, .ply or .obj")
    return _read_mesh(str(path), os.stat(path).st_mtime_ns)


@lru_cache(maxsize=4)
def _read_mesh(path: str, _: int) -> Mesh:
    content = Path(path).read_bytes()
    with foreign_parser(path, "a mesh of triangles, .ply or .obj"):
        mesh = _ply(content) if content[:3] == b"ply" else _obj(content)
    m, n = mesh.triangles, len(mesh.vertices)
    if not len(m) or m.min() < 0 or m.max() >= n or not np.isfinite(mesh.vertices).all():
        raise InputError(
            f"{path}: expected vertices and faces of them, got {n} vertices and {len(m)} triangles"
            + (" that name others" if len(m) else "")
        )
    return mesh


def _obj(content: bytes) -> Mesh:
    vertices, faces = [], []
    for line in content.decode("utf-8", "replace").splitlines():
        key, *words = line.split() or [""]
        if key == "v":
            vertices.append([float(word) for word in words[:3]])
        elif key == "f":
            indices = [int(word.split("/")[0]) for word in words]
            # Counted from 1, or backwards from the last.
            faces.append([k - 1 if k > 0 else len(vertices) + k for k in indices])
    return Mesh(np.array(vertices, float).reshape(-1, 3), _triangulate(faces))


def _triangulate(faces: list) -> Int[np.ndarray, "m 3"]:
    triangles = [(f[0], b, c) for f in faces for b, c in zip(f[1:], f[2:])]
    return np.array(triangles, np.int64).reshape(-1, 3)


def _ply(content: bytes) -> Mesh:
    head, _, body = content.partition(b"end_header\n")
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    form = next(words[1] for words in lines if words[:1] == ["format"])
    elements: list[tuple[str, int, list]] = []
    for words in lines:
        if words[:1] == ["element"]:
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"]:
            elements[-1][2].append(words[1:])
    order = ">" if form == "binary_big_endian" else "<"
    offset, vertices, faces = 0, np.zeros((0, 3)), []
    texts = iter(body.split()) if form == "ascii" else None
    for name, number, properties in elements:
        if not 0 <= number <= len(body) or not properties:
            raise ValueError(f"{number} elements {name!r} are not in a file of this length")
        types = [order + PLY_TYPES[p[0]] for p in properties if p[0] != "list"]
        has_no_list = len(types) == len(properties)
        if texts is not None:
            rows = [[_text_value(texts, p) for p in properties] for _ in range(number)]
        elif has_no_list:
            dtype = np.dtype([(f"f{k}", t) for k, t in enumerate(types)])
            rows = [list(row) for row in np.frombuffer(body, dtype, number, offset).tolist()]
            offset += number * dtype.itemsize
        else:
            rows, offset = _binary_rows(body, offset, number, properties, order)
        names = [p[-1] for p in properties]
        if name == "vertex":
            columns = [names.index(axis) for axis in "xyz"]
            vertices = np.array([[row[c] for c in columns] for row in rows], float)
        elif name == "face":
            k = next(k for k, p in enumerate(properties) if p[-1].startswith("vertex_ind"))
            faces = [row[k] for row in rows]
    return Mesh(vertices, _triangulate(faces))


def _text_value(texts: Iterator[bytes], property: list[str]) -> float | list[int]:
    if property[0] != "list":
        return float(next(texts))
    return [int(next(texts)) for _ in range(int(next(texts)))]


def _binary_rows(
    body: bytes, offset: int, number: int, properties: list, order: str
) -> tuple[list, int]:
    rows = []
    for _ in range(number):
        row: list = []
        for p in properties:
            count = 1
            if p[0] == "list":
                size = np.dtype(order + PLY_TYPES[p[1]])
                count = int(np.frombuffer(body, size, 1, offset)[0])
                offset += size.itemsize
            dtype = np.dtype(order + PLY_TYPES[p[-2]])
            values = np.frombuffer(body, dtype, count, offset).tolist()
            offset += count * dtype.itemsize
            row.append(values if p[0] == "list" else values[0])
        rows.append(row)
    return rows, offset


def read_grid(path: str | Path) -> TerrainGrid:
    """The heights of a raster in the coordinates of its map, north up.

    **Raises:** `InputError`, also without the package rasterio."""
    check_plain(path)
    if not os.path.isfile(path):
        raise InputError(f"{path}: no such file; expected a raster of heights")
    return _read_grid(str(path), os.stat(path).st_mtime_ns)


@lru_cache(maxsize=4)
def _read_grid(path: str, _: int) -> TerrainGrid:
    raster = read_heights(path)
    return TerrainGrid(raster.heights, raster.origin, raster.step)


def surface_near(
    surface: Mapping[str, Any], X: Float[np.ndarray, "points 3"], origin: Float[np.ndarray, "3"]
) -> tuple[tuple[np.ndarray, ...], Bool[np.ndarray, " points"]]:
    """What `jaxbundle.geometry.surfaces` needs of a surface to give the distances of points that
    stay near X, a row for each, in coordinates from an origin; and which of them are outside of it,
    or over a void.

    The surface is `{plane, normal}`, `{mesh}` or `{dem}`: a mesh and a grid as files or arrays."""
    is_outside = np.zeros(len(X), bool)
    if "plane" in surface:
        normal = np.array(surface["normal"], float) / np.linalg.norm(surface["normal"])
        place = np.array(surface["plane"], float) - origin
        return (np.tile(place, (len(X), 1)), np.tile(normal, (len(X), 1))), is_outside
    if "mesh" in surface:
        mesh = surface["mesh"]
        mesh = read_mesh(mesh) if isinstance(mesh, str) else Mesh(*map(np.asarray, mesh))
        return (triangles_near(mesh, X) - origin,), is_outside
    grid = surface["dem"]
    grid = read_grid(grid) if isinstance(grid, str) else TerrainGrid(*grid)
    heights, first_node = heights_near(grid, X)
    middle = heights.shape[1] // 2
    cells = heights[:, middle - 1 : middle + 1, middle - 1 : middle + 1]
    void = np.array([np.isnan(cell).any() for cell in cells], bool)
    # Beyond a void or an edge the surface goes on level. A point over a void has no mean.
    mean_height = np.nanmean(np.where(void[:, None, None], 0.0, heights), (1, 2), keepdims=True)
    heights = np.where(np.isfinite(heights), heights, mean_height) - origin[2]
    return (
        heights,
        first_node - origin[:2],
        np.tile(np.array(grid.step, float), (len(X), 1)),
    ), void


def have_common_point(places: Sequence, normals: Sequence) -> bool:
    """Whether planes, each through a place and with a normal, meet in a point."""
    p, n = np.array(places, float), np.array(normals, float)
    offset = (n * p).sum(1)
    misclosure = n @ np.linalg.lstsq(n, offset)[0] - offset
    # 1e-9: rounding of printed places
    limit = 1e-9 * np.linalg.norm(n, axis=1).max() * np.abs(p).max(initial=1)
    return bool(np.abs(misclosure).max() <= limit)


def triangles_near(
    mesh: Mesh, X: Float[np.ndarray, "points 3"]
) -> Float[np.ndarray, "points candidates 3 3"]:
    """The corners of the triangles nearest to points."""
    corners = mesh.vertices[mesh.triangles]
    middle = corners.mean(1)
    radius = np.linalg.norm(corners - middle[:, None], axis=2).max(1)
    nearest_triangles = []
    for P in X:
        lower_bound = np.linalg.norm(middle - P, axis=1) - radius
        candidates = np.argpartition(lower_bound, min(BOUNDED, len(lower_bound)) - 1)[:BOUNDED]
        nearest = candidates[
            np.argsort(squared_distances_to_triangles(P, corners[candidates], np))[:CANDIDATES]
        ]
        # A small mesh: the last one again.
        nearest_triangles.append(
            np.resize(nearest, CANDIDATES) if len(nearest) < CANDIDATES else nearest
        )
    return corners[np.array(nearest_triangles, int)]


def heights_near(
    grid: TerrainGrid, X: Float[np.ndarray, "points 3"]
) -> tuple[Float[np.ndarray, "points nodes nodes"], Float[np.ndarray, "points 2"]]:
    """A part of a grid around every point, and the place of its first node; NaN beyond edges."""
    padded = np.pad(grid.heights, REACH, constant_values=np.nan)
    cell = np.floor((X[:, :2] - grid.origin) / grid.step).astype(int)
    shape = np.array(grid.heights.shape[::-1])
    clipped_cell = np.clip(cell, -1, shape - 1)
    parts, first_node = [], clipped_cell - REACH + 1
    for column, row in clipped_cell + 1:
        parts.append(padded[row : row + 2 * REACH, column : column + 2 * REACH])
    return np.array(parts), np.array(grid.origin) + first_node * np.array(grid.step)
