"""Projects in the Open Photogrammetry Format: `.opf` of PIX4Dmatic and others, JSON.

    items            type, resources (uri, format)
    camera_list      cameras: id, uri (the file of the photograph)
    input_cameras    sensors: id, name, image_size_px, pixel_size_um
    calibration      calibrated-cameras: sensors: id, internals; cameras: id, sensor_id, position,
                     orientation_deg; tracks: glTF with the image points of every point
    input_control_points, projected_control_points
                     gcps, mtps: id, marks (camera_id, position_px), is_checkpoint; coordinates,
                     sigmas
    scene_reference_frame     base_to_canonical: shift, scale, swap_xy

Positions are in the processing system, canonical coordinates plus the shift; here they are
canonical: X = X_opf − shift. Cameras have x right, y up and look along −z as here, and ω, φ, κ are
those of here (image → object is R_x(ω)·R_y(φ)·R_z(κ)). Pixels count from the corner. With
x = X/Z, y = Y/Z of a frame x right, y down, z forward,

    x' = x·(1 + R1·r² + R2·r⁴ + R3·r⁶) + 2·T1·x·y + T2·(r² + 2x²)
    y' = y·(1 + …) + T1·(r² + 2y²) + 2·T2·x·y

that is `opencv` with fx = fy = f, k1 … k3 = R1 … R3, p1 = T1, p2 = T2. A fisheye has ρ = Σ pᵢ·θⁱ
with θ = (2/π)·atan2(√(X² + Y²), Z), and (u, v) = c + A·ρ·(X, Y)/√(X² + Y²): the nearest camera is
fitted. Spherical sensors are refused. Points of a glTF have y up and the matrix of their node:
[X, Y, Z] = [x, −z, y] of what it gives.

Source: Open Photogrammetry Format Specification 1.0 (Pix4D), github.com/Pix4D/opf-spec; pyopf.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote, urlparse

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxbundle.arguments import show
from jaxbundle.cameras.scalars import Scalar
from jaxbundle.errors import InputError
from jaxbundle.geometry.rotations import matrix_from_omega_phi_kappa
from jaxbundle.io.cameras.nearest_camera import Foreign, nearest_camera, root
from jaxbundle.io.networks.assemble import (
    PIXEL_CENTRE,
    assemble,
    colour_columns,
    foreign_document,
    image_columns,
    unique_labels,
)
from jaxbundle.io.networks.control import with_control
from jaxbundle.io.networks.opf_keys import (
    CALIBRATED,
    CAMERA_LIST,
    FRAME,
    INPUT_CAMERAS,
    INPUT_POINTS,
    KEYS,
    MATCHES,
    PROJECT,
    PROJECTED_POINTS,
    TRACKS,
)
from jaxbundle.io.networks.settings import choose_datum
from jaxbundle.io.text.csv_tables import read_text
from jaxbundle.io.text.json_fields import JsonFields, read_object
from jaxbundle.io.text.known_keys import UnknownKeys
from jaxbundle.network.columns import Columns, list_some
from jaxbundle.network.tables import Network, Points, Source
from jaxbundle.system.file_content import beginning, check_plain

SUFFIX = ".opf"

# GlTF: component types and the numbers of an element.
COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
LENGTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


class Resources(NamedTuple):
    """The files of a project by their format; those of its calibration, if it has one."""

    path: Path
    files: Mapping[str, list[Path]]
    tracks: Path | None
    unknown: UnknownKeys

    def document(self, kind: str) -> JsonFields | None:
        """The only file of a format; None if there is none."""
        paths = self.files.get(kind, [])
        if len(paths) > 1:
            raise InputError(
                f"{self.path}: {len(paths)} resources of format {kind}, "
                f"{list_some(paths, as_text=str)}; expected a project with one calibration"
            )
        return _read_json(paths[0], kind, self.unknown) if paths else None


def is_opf(path: Path) -> bool:
    """Whether a file is a project in this format."""
    return path.suffix.lower() == SUFFIX and b"opf-project" in beginning(path, 100_000)


def read_opf(path: str | Path, overrides: Sequence[str] = ()) -> Network:
    """The calibrated cameras of a project, its tie points, and its control points.

    Sensors are named by their name, photographs by their file, tie points by `t` and their number.
    Nothing is free, σ is 1 px; control has its σ; the datum is inner, or the control.

    **Raises:** `InputError` naming file and field.
    """
    path, unknown = Path(path), UnknownKeys()
    resources = _resources(path, unknown)
    calibrated = resources.document(CALIBRATED)
    if calibrated is None:
        raise InputError(
            f"{path}: a project without calibrated cameras; expected one after its calibration"
        )
    messages: list[str] = []
    cameras = _sensors(calibrated, resources.document(INPUT_CAMERAS), messages)
    shift = _canonical_shift(resources.document(FRAME), messages)
    rows = calibrated.rows("cameras")
    if not rows:
        raise InputError(f"{calibrated.path}: there are no cameras")
    ids = [_id(row, "id") for row in rows]
    files = _files(resources.document(CAMERA_LIST))
    labels = unique_labels([files.get(id, id) for id in ids], ids)
    names = dict(zip(ids, labels))
    sensor_ids = [_id(row, "sensor_id") for row in rows]
    for row, id in zip(rows, sensor_ids):
        if id not in cameras:
            raise InputError(f"{row.path}: sensor {id} is not in the file")
    angles = np.radians([row.array("orientation_deg", (3,)) for row in rows])
    X0 = np.array([row.array("position", (3,)) for row in rows]) - shift
    images = image_columns(
        Source(str(calibrated.path), None, "camera"),
        labels,
        [cameras[id]["id"] for id in sensor_ids],
        np.array([np.asarray(matrix_from_omega_phi_kappa(a)) for a in angles]),
        X0,
    )
    marked_points, marked_rays, control = _control(resources, names, shift, messages)
    tie_points, tie_rays = _tracks(resources, names, shift)
    network = assemble(
        path,
        foreign_document(path.stem, cameras.values(), object_unit="m"),
        overrides,
        images,
        _join_tables(marked_points, tie_points, Source(str(path), None, "point")),
        _join_tables(marked_rays, tie_rays, Source(str(path), None, "image point")),
        (*messages, *unknown.messages()),
    )
    if control is not None:
        network = with_control(network, control, datum=not choose_datum(overrides))
    return network


# --- files ----------------------------------------------------------------------------------


def _read_json(path: Path, kind: str, unknown: UnknownKeys) -> JsonFields:
    document = read_object(path, read_text(path), "OPF")
    unknown.check_objects(document, KEYS[kind], path)
    return JsonFields(path, document)


def _resources(path: Path, unknown: UnknownKeys) -> Resources:
    file = _read_json(path, PROJECT, unknown)
    files: dict[str, list[Path]] = {}
    tracks: list[Path] = []
    for item in file.rows("items"):
        for row in item.rows("resources"):
            resource_path, kind = _resource_path(path, row.text("uri")), row.text("format")
            files.setdefault(kind, [])
            if resource_path not in files[kind]:
                files[kind].append(resource_path)
            if item.text("type") == "calibration" and kind == TRACKS:
                tracks.append(resource_path)
    return Resources(path, files, tracks[0] if tracks else None, unknown)


def _resource_path(path: Path, uri: str) -> Path:
    """The file of a resource, relative to the project."""
    # A project from the network would be read from anywhere.
    parts = urlparse(uri)
    if parts.scheme not in ("", "file"):
        raise InputError(f"{path}: {uri!r}: expected a file beside the project")
    return path.parent / unquote(parts.path)


def _id(row: JsonFields, key: str) -> str:
    """A whole number of 64 bits, as text."""
    # Not `integer`, which a float beyond 2⁵³ would not reach: identifiers have 64 bits.
    value = row.get(key)
    if isinstance(value, bool) or not isinstance(value, int):
        problem = "missing" if value is None else f"{value!r}; expected a whole number"
        raise InputError(f"{row.path}: {key} is {problem}")
    return str(value)


def _files(camera_list: JsonFields | None) -> dict[str, str]:
    """The names of the photographs by id."""
    if camera_list is None:
        return {}
    return {
        _id(row, "id"): unquote(urlparse(row.text("uri")).path).rpartition("/")[2]
        for row in camera_list.rows("cameras")
    }


# --- cameras --------------------------------------------------------------------------------


def _sensors(
    calibrated: JsonFields, input_sensors: JsonFields | None, messages: list[str]
) -> dict[str, dict[str, Any]]:
    """The entries of the sensors by id."""
    input_rows = {
        _id(row, "id"): row
        for row in ([] if input_sensors is None else input_sensors.rows("sensors"))
    }
    rows = {_id(row, "id"): row for row in calibrated.rows("sensors")}
    labels = [str(input_rows[id].get("name") or id) if id in input_rows else id for id in rows]
    entries = {}
    for (id, row), label in zip(rows.items(), unique_labels(labels, list(rows))):
        internals = row.child("internals")
        size = input_rows[id].array("image_size_px", (2,)) if id in input_rows else None
        entry, fit = _camera(internals, size)
        messages += [f"sensor {label!r}: {fit}"] if fit else []
        sizes = {} if size is None else {"image_size": [int(n) for n in size]}
        entries[id] = {"id": label, **sizes, **entry}
    return entries


def _camera(
    internals: JsonFields, size: Float[np.ndarray, "2"] | None
) -> tuple[dict[str, Any], str]:
    """Model and parameters, and a message about a fit."""
    kind = internals.text("type")
    cx, cy = internals.array("principal_point_px", (2,)) - PIXEL_CENTRE
    if kind == "perspective":
        f = internals.number("focal_length_px")
        R = internals.array("radial_distortion", (3,))
        T = internals.array("tangential_distortion", (2,))
        if not f > 0:
            raise InputError(f"{internals.path}: focal_length_px is {f:g}; expected a positive one")
        core = {"fx": f, "fy": f, "cx": float(cx), "cy": float(cy)}
        terms = dict(zip(("k1", "k2", "k3", "p1", "p2"), map(float, (*R, *T))))
        return {"model": "opencv", "tie": [["fx", "fy"]], **core, **terms}, ""
    if kind != "fisheye":
        raise InputError(
            f"{internals.path}: a {kind} sensor is not read; expected perspective or fisheye"
        )
    if size is None:
        raise InputError(f"{internals.path}: a fisheye without image_size_px in input-cameras")
    # p0 and even powers have no place in the models here
    A = internals.array("affine", (4,))
    polynomial = internals.array("polynomial", (None,))
    parameters = {"A": A, "p": polynomial, "cx": cx, "cy": cy}
    # ρ ≈ p1·θ near the axis
    slope = (polynomial[1] if len(polynomial) > 1 else 1.0) * 2 / np.pi
    start = {"fx": float(A[0] * slope), "fy": float(A[3] * slope), "cx": cx, "cy": cy}
    foreign = Foreign(_project_fisheye, parameters, start, size.tolist(), None, True)
    return nearest_camera(foreign, str(internals.path))


def _project_fisheye(p: Mapping[str, Any], X: Scalar, Y: Scalar, Z: Scalar) -> Float[Array, "2"]:
    """The formula of the specification, from the centre of the first pixel."""
    radius = root(X * X + Y * Y)
    # The angle to the axis, 1 at 90°.
    theta = 2 / np.pi * jnp.arctan2(radius, Z)
    rho = sum(p["p"][i] * theta**i for i in range(len(p["p"])))
    x, y = (
        jnp.where(radius > 0, rho * a / jnp.where(radius > 0, radius, 1.0), 0.0) for a in (X, Y)
    )
    A = p["A"]
    return jnp.stack([A[0] * x + A[1] * y + p["cx"], A[2] * x + A[3] * y + p["cy"]])


# --- coordinates ----------------------------------------------------------------------------


def _canonical_shift(frame: JsonFields | None, messages: list[str]) -> Float[np.ndarray, "3"]:
    """What positions have on top of the canonical coordinates."""
    if frame is None:
        return np.zeros(3)
    # Canonical = base·scale, exchanged where it is left-handed; positions have the shift on top.
    base = frame.child("base_to_canonical")
    scale = base.array("scale", (3,))
    if (scale != 1).any() or base.get("swap_xy"):
        messages.append(
            f"{frame.path}: coordinates are canonical (right-handed, one unit): those of the base "
            f"system times {', '.join(f'{s:g}' for s in scale)}"
            f"{', x and y exchanged' if base.get('swap_xy') else ''}"
        )
    return base.array("shift", (3,))


def _control(
    resources: Resources,
    images: Mapping[str, str],
    shift: Float[np.ndarray, "3"],
    messages: list[str],
) -> tuple[dict[str, Any], dict[str, Any], Points | None]:
    """Columns of the points with marks, and of their image points; control and check points."""
    input_points, projected = resources.document(INPUT_POINTS), resources.document(PROJECTED_POINTS)
    # Manual tie points have marks as control points have, but no coordinates.
    rows = [] if input_points is None else [*input_points.rows("gcps"), *input_points.rows("mtps")]
    ids, is_check, marks = [], {}, []
    for row in rows:
        id = row.text("id")
        point_marks = []
        for mark in row.rows("marks"):
            if (image := images.get(_id(mark, "camera_id"))) is not None:
                point_marks.append((image, id, *(mark.array("position_px", (2,)) - PIXEL_CENTRE)))
        if point_marks:
            ids.append(id)
            is_check[id] = bool(row.get("is_checkpoint"))
            marks += point_marks
    empty_column = [None] * len(ids)
    points = {
        "id": ids,
        "role": ["tie"] * len(ids),
        "X": empty_column,
        "Y": empty_column,
        "Z": empty_column,
    }
    image, point, x, y = zip(*marks) if marks else ((), (), (), ())
    rays = {"image": image, "point": point, "x": x, "y": y}
    control_rows = [] if projected is None else projected.rows("projected_gcps")
    control_rows = [row for row in control_rows if row.text("id") in is_check]
    if not control_rows:
        if input_points is not None and input_points.rows("gcps"):
            messages.append(
                f"{input_points.path}: its control points have no projected coordinates; their "
                "marks are read as those of tie points"
            )
        return points, rays, None
    names = [row.text("id") for row in control_rows]
    sigma = np.array([row.array("sigmas", (3,)) for row in control_rows])
    for k in np.flatnonzero(~(sigma > 0).all(1))[:1]:
        raise InputError(
            f"{control_rows[k].path}: sigmas of control point {names[k]!r} are "
            f"{show(sigma[k].tolist())}; expected positive numbers"
        )
    control = Points(
        tuple(names),
        tuple("check" if is_check[name] else "control" for name in names),
        np.array([row.array("coordinates", (3,)) for row in control_rows]) - shift,
        sigma,
        Source(str(resources.path)),
    )
    # Fewer than three points do not determine the seven parameters of a datum.
    if control.role.count("control") < 3:
        messages.append(
            f"{resources.path}: {control.role.count('control')} control points with marks; they "
            "are not used, since three are needed for a datum"
        )
        return points, rays, None
    return points, rays, control


# --- tie points -----------------------------------------------------------------------------


def _tracks(
    resources: Resources, images: Mapping[str, str], shift: Float[np.ndarray, "3"]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Columns of the tie points of a glTF with matches, and of their image points."""
    points: dict[str, Any] = {"id": [], "role": [], "X": [], "Y": [], "Z": []}
    rays: dict[str, Any] = {"image": [], "point": [], "x": [], "y": []}
    if (path := resources.tracks) is None:
        return points, rays
    file = _read_json(path, TRACKS, resources.unknown)
    colours = []
    for node in file.rows("nodes"):
        if node.get("children") and node.get("matrix") is not None:
            raise InputError(f"{node.path}: a matrix for its children; expected one for its mesh")
        if node.get("mesh") is None:
            continue
        # The specification has one primitive a mesh.
        primitive = _object_at(_object_at(file, "meshes", node.integer("mesh")), "primitives", 0)
        if primitive.get("extensions") is None or MATCHES not in primitive.get("extensions"):
            continue
        matches = primitive.child("extensions").child(MATCHES)
        X = _positions(file, node, primitive) - shift
        offset = len(points["id"])
        names = [f"t{offset + k}" for k in range(len(X))]
        points["id"] += names
        points["role"] += ["tie"] * len(X)
        for axis, column in zip("XYZ", X.T.tolist()):
            points[axis] += column
        colours.append(_colours(file, primitive, len(X)))
        begin, number = _ranges(file, matches, len(X))
        uids = matches.get("cameraUids") or ()
        if not isinstance(uids, list | tuple):
            raise InputError(f"{path}: cameraUids of its matches is no list of cameras")
        uids = [str(uid) for uid in uids]
        camera = _accessor(file, matches.integer("cameraIds"), "SCALAR")[:, 0]
        xy = _accessor(file, matches.child("imagePoints").integer("pixelCoordinates"), "VEC2")
        if len(xy) != len(camera) or (camera >= len(uids)).any():
            raise InputError(f"{path}: cameras and image points of its matches do not agree")
        # Before room is made for them: of damaged ranges 2²⁴ matches for every point.
        if (begin + number > len(camera)).any() or number.sum() > len(camera):
            raise InputError(
                f"{path}: ranges of matches extend beyond the last match; the file is damaged"
            )
        # The rows of the matches of the first point, the second, …: ranges may be in any order.
        point = np.repeat(np.arange(len(X)), number)
        match_rows = np.repeat(begin - np.cumsum(number) + number, number) + np.arange(number.sum())
        image_names = [images.get(uid) for uid in uids]
        has_image = np.array([image_names[c] is not None for c in camera[match_rows]], bool)
        match_rows, point = match_rows[has_image], point[has_image]
        rays["image"] += [image_names[c] for c in camera[match_rows]]
        rays["point"] += [names[p] for p in point]
        for name, column in zip("xy", (xy[match_rows].astype(float) - PIXEL_CENTRE).T.tolist()):
            rays[name] += column
    if colours:
        points |= colour_columns(np.concatenate(colours))
    return points, rays


def _positions(
    file: JsonFields, node: JsonFields, primitive: JsonFields
) -> Float[np.ndarray, "n 3"]:
    """The points of a mesh in the processing system."""
    mesh_points = _accessor(file, primitive.child("attributes").integer("POSITION"), "VEC3").astype(
        float
    )
    # By columns, in double precision: it holds the offset of single-precision positions.
    T = node.array("matrix", (16,), np.eye(4).ravel().tolist()).reshape(4, 4).T
    x, y, z = (mesh_points @ T[:3, :3].T + T[:3, 3]).T
    return np.stack([x, -z, y], 1)


def _colours(file: JsonFields, primitive: JsonFields, n: int) -> Float[np.ndarray, "n 3"]:
    accessor_index = primitive.get("attributes.COLOR_0")
    if accessor_index is None:
        return np.full((n, 3), np.nan)
    colours = _accessor(
        file, JsonFields(file.path, {"COLOR_0": accessor_index}).integer("COLOR_0"), None
    )
    return colours[:, :3].astype(float)


def _ranges(file: JsonFields, matches: JsonFields, n: int) -> tuple[np.ndarray, np.ndarray]:
    """First match and number of matches of every point: 40 and 24 bits of a number of 64."""
    pair = _accessor(file, matches.integer("pointIndexRanges"), "VEC2").astype(np.uint64)
    if len(pair) != n:
        raise InputError(f"{file.path}: {len(pair)} ranges of matches of {n} points")
    # Little-endian: the first of the two numbers of 32 bits is the low one.
    packed = pair[:, 0] | (pair[:, 1] << np.uint64(32))
    begin = packed & np.uint64(2**40 - 1)
    return begin.astype(np.int64), (packed >> np.uint64(40)).astype(np.int64)


def _object_at(file: JsonFields, key: str, index: int) -> JsonFields:
    rows = file.rows(key)
    if index >= len(rows):
        raise InputError(f"{file.path}: {key}[{index}] is missing")
    return rows[index]


def _accessor(file: JsonFields, index: int, kind: str | None) -> np.ndarray:
    """The numbers of an accessor, a row an element."""
    accessor = _object_at(file, "accessors", index)
    component, form = accessor.integer("componentType"), accessor.text("type")
    if component not in COMPONENTS or form not in LENGTHS or kind not in (None, form):
        raise InputError(
            f"{accessor.path}: numbers of type {component}, {form}, where {kind or 'VEC4'} is "
            "expected"
        )
    view = _object_at(file, "bufferViews", accessor.integer("bufferView"))
    buffer = _object_at(file, "buffers", view.integer("buffer"))
    dtype = np.dtype(COMPONENTS[component])
    width = dtype.itemsize * LENGTHS[form]
    if accessor.get("sparse") is not None or view.integer("byteStride", width) != width:
        raise InputError(
            f"{accessor.path}: numbers that are interleaved with others, or sparse; expected those "
            "of an accessor one after the other"
        )
    number = accessor.integer("count") * LENGTHS[form]
    buffer_path = _resource_path(Path(file.path), buffer.text("uri"))
    check_plain(buffer_path)
    begin = view.integer("byteOffset", 0) + accessor.integer("byteOffset", 0)
    try:
        # Before anything is allocated for a count in a damaged header.
        byte_count = buffer_path.stat().st_size
        if begin + number * dtype.itemsize > byte_count:
            raise InputError(
                f"{buffer_path}: {byte_count} bytes, where {begin + number * dtype.itemsize} are "
                "expected"
            )
        numbers = np.fromfile(buffer_path, dtype, number, offset=begin)
    except OSError as error:
        raise InputError(f"{buffer_path}: cannot be read: {error.strerror}") from None
    if dtype.kind == "f" and not np.isfinite(numbers).all():
        raise InputError(f"{buffer_path}: a number that is not finite")
    return numbers.reshape(-1, LENGTHS[form])


def _join_tables(
    first_table: Mapping[str, Any], second_table: Mapping[str, Any], source: Source
) -> Columns:
    """The rows of two tables; a column that one lacks is empty there."""
    n, m = (len(next(iter(table.values()))) for table in (first_table, second_table))
    columns = {
        name: [*first_table.get(name, [None] * n), *second_table.get(name, [None] * m)]
        for name in {**first_table, **second_table}
    }
    return Columns(columns, source)
