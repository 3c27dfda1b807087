"""Cameras of Agisoft Metashape: the XML of "Export Cameras", and projects (`.psx`).

    document/chunk
      sensors/sensor id label type            calibration class="adjusted": f cx cy k1… p1 p2 b1 b2
      cameras/…/camera id sensor_id label     transform: 4 × 4, camera → chunk, by rows
      transform                               rotation, translation, scale: chunk → world
      components/component id/transform       the same, where cameras name a component
      reference                               the coordinate system of the references
      markers/marker id label                 reference x y z [sx sy sz] enabled
      frames/frame/markers/marker             location camera_id x y [valid]
      settings/property accuracy_markers      default σ of references

The sensors are in `metashape_camera.py`. Cameras that are disabled or not aligned are left out; if
none is aligned, those with measured markers are read without orientation. Cameras of sensors that
no model fits are left out (cylindrical, RPC, of size 0, with a distortion that turns back inside
the image). A chunk with a transform gives world coordinates (geocentric if it is
georeferenced), otherwise chunk coordinates.

Markers are points. If their references are in a local coordinate system, three of them or more
are control points, and disabled ones check points; otherwise they are tie points
without coordinates. The tie points of Metashape are in projects only (`metashape_archive.py`).

Source: Agisoft Metashape user manual, sections on formats; exported files.
"""

import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxbundle.errors import InputError
from jaxbundle.geometry.pose_conventions import flip_rows
from jaxbundle.io.cameras.nearest_camera import NoPlaceError
from jaxbundle.io.networks.assemble import (
    PIXEL_CENTRE,
    assemble,
    colour_columns,
    foreign_document,
    image_columns,
    unique_labels,
)
from jaxbundle.io.networks.control import with_control
from jaxbundle.io.networks.metashape_archive import (
    ChunkArchive,
    TieTable,
    is_metashape_archive,
    read_archive,
)
from jaxbundle.io.networks.metashape_camera import (
    check_sensor,
    label_of,
    numbers_of,
    sensor_camera,
)
from jaxbundle.io.networks.poses import check_rotations
from jaxbundle.io.networks.settings import choose_datum
from jaxbundle.io.text.known_keys import Keys, UnknownKeys
from jaxbundle.io.text.xml_fields import number_in, read_xml
from jaxbundle.network.columns import Columns, count, list_some
from jaxbundle.network.tables import Network, Points, Source
from jaxbundle.system.file_content import beginning

LOCAL = "LOCAL_CS"
UNKNOWN_POSE = np.full((3, 3), np.nan), np.full(3, np.nan)
DOCUMENT_KEYS = Keys(("chunk", "version"), {"meta": "names and dates"})
CHUNK_KEYS = Keys(
    (
        *("sensors", "cameras", "transform", "components", "reference", "markers", "frames"),
        *("settings", "label", "enabled"),
    ),
    {
        **dict.fromkeys(("region", "meta", "images", "version"), "the region of interest, names"),
        **dict.fromkeys(
            ("depth_maps*", "dense_cloud*", "point_cloud*", "model*", "elevation*", "orthomosaic*",
             "tiled_model*", "shapes*", "masks*", "thumbnails*", "camera_tracks*", "frame_*"),
            "products of Metashape in files of their own",
        ),
    },
    {
        "scalebars": "give distances in a project (distances.csv)",
        "euler_angles": "references of cameras are not read",
    },
)  # fmt: skip
CAMERA_KEYS = Keys(
    ("id", "sensor_id", "component_id", "label", "enabled", "transform"),
    {
        **dict.fromkeys(
            ("rotation_covariance", "location_covariance"), "σ that an adjustment gives anew"
        ),
        "orientation": "how the photograph is displayed",
        "master_id": "a rig: every camera has its own transform",
        **dict.fromkeys(("photo", "property", "meta", "layer_index", "key"), "files and names"),
    },
    {
        "reference": "measured positions and angles; give them as antennas and attitudes",
        "rolling_shutter": "one pose a photograph is read",
    },
)
MARKER_KEYS = Keys(
    ("id", "label", "reference", "enabled"),
    {
        **dict.fromkeys(("position", "property", "meta", "key", "type"), "names, and the estimate"),
        "covariance": "σ that an adjustment gives anew",
    },
)


def is_metashape(path: Path) -> bool:
    """Whether an XML file begins with a `document` that has a `chunk`, or a file is a project."""
    if is_metashape_archive(path):
        return True
    head = beginning(path, 4000) if path.suffix.lower() == ".xml" else b""
    return b"<document" in head and b"<chunk" in head


def read_metashape(path: str | Path, overrides: Sequence[str] = ()) -> Network:
    """The cameras and images of an export or a project, the image points of markers if there are
    any, and the tie points of a project.

    Cameras and images are named by their labels; nothing is free, σ is 1 px, the datum inner.

    **Raises:** `InputError` naming file and element.
    """
    path = Path(path)
    unknown = UnknownKeys()
    chunk, ties, archive_messages = _chunk(path, unknown)
    sensors = {sensor.get("id"): sensor for sensor in chunk.iterfind("sensors/sensor")}
    cameras = [camera for camera in chunk.iterfind("cameras//camera")]
    for camera in cameras:
        unknown.check_element(camera, CAMERA_KEYS, f"{path}, camera {label_of(camera)!r}")
    used_cameras = [
        c for c in cameras if _is_true(c.get("enabled")) and c.find("transform") is not None
    ]
    aligned = bool(used_cameras)
    if not aligned:
        marked_ids = {
            e.get("camera_id") for e in chunk.iterfind("frames/frame/markers/marker/location")
        }
        used_cameras = [
            c for c in cameras if _is_true(c.get("enabled")) and c.get("id") in marked_ids
        ]
    if not used_cameras:
        raise InputError(
            f"{path}: cameras of Metashape before their alignment: no camera is enabled and "
            "aligned, and none has a measured marker; expected cameras with a <transform>, or "
            "markers with locations"
        )
    omitted_labels = [label_of(c) for c in cameras if c not in used_cameras]
    for id in dict.fromkeys(camera.get("sensor_id") for camera in used_cameras):
        if id in sensors:
            where = f"{path}, sensor {label_of(sensors[id])!r}"
            check_sensor(unknown, sensors[id], where)
    entries, messages = _entries(path, sensors, used_cameras)
    messages = [*archive_messages, *messages]
    used_cameras = [camera for camera in used_cameras if camera.get("sensor_id") in entries]
    labels = unique_labels(
        [label_of(c) for c in used_cameras], [c.get("id", "") for c in used_cameras]
    )
    poses = [
        _pose(f"{path}, camera {label!r}", camera, chunk) if aligned else UNKNOWN_POSE
        for label, camera in zip(labels, used_cameras)
    ]
    names = unique_labels([e["id"] for e in entries.values()], list(entries))
    for entry, name in zip(entries.values(), names):
        entry["id"] = name
    M, X0 = (np.stack(part) for part in zip(*poses))
    images = image_columns(
        Source(str(path), None, "camera"),
        labels,
        [entries[c.get("sensor_id")]["id"] for c in used_cameras],
        M,
        X0,
    )
    by_id = {c.get("id"): label for c, label in zip(used_cameras, labels)}
    points, rays, control = _markers(path, chunk, by_id)
    if ties is not None:
        points, rays = _with_ties(path, chunk, ties, by_id, points, rays)
    document = foreign_document(path.stem, entries.values(), object_unit="m")
    if omitted_labels:
        reason = "not aligned" if aligned else "without a measured marker"
        omission = f"left out {count(len(omitted_labels), 'camera')} that are disabled or {reason}"
        messages.append(f"{omission}: {list_some(omitted_labels)}")
    network = assemble(path, document, overrides, images, points, rays)
    if control is not None:
        network = with_control(network, control, datum=not choose_datum(overrides))
    if not aligned:
        messages.append("the cameras are not aligned: orientations and coordinates are computed")
    return network.warn(*messages, *_describe_references(chunk, control), *unknown.messages())


def _entries(
    path: Path, sensors: Mapping[str | None, ET.Element], used_cameras: Sequence[ET.Element]
) -> tuple[dict[str | None, dict[str, Any]], list[str]]:
    """The entries of the sensors of the photographs, by id, and messages about them."""
    entries, messages, errors = {}, [], {}
    for camera in used_cameras:
        id = camera.get("sensor_id")
        if id not in sensors:
            raise InputError(
                f"{path}, camera {label_of(camera)!r}: sensor {id!r} is not in the file"
            )
        if id in entries or id in errors:
            continue
        try:
            entries[id], sensor_messages = sensor_camera(path, sensors[id])
            messages += sensor_messages
        except NoPlaceError as error:
            errors[id] = error
    for id, error in errors.items():
        if not entries:
            raise error
        omitted_labels = [label_of(c) for c in used_cameras if c.get("sensor_id") == id]
        reason = str(error).removeprefix(f"{path}, ")
        messages.append(
            f"{reason}; left out {count(len(omitted_labels), 'camera')}: "
            f"{list_some(omitted_labels)}"
        )
    return entries, messages


def _chunk(path: Path, unknown: UnknownKeys) -> ChunkArchive:
    """The chunk; of a project with its tie points, and messages."""
    if is_metashape_archive(path):
        archive = read_archive(path)
    else:
        root = read_xml(path)
        chunks = root.findall("chunk")
        if root.tag != "document" or len(chunks) != 1:
            raise InputError(
                f"{path}: expected one <chunk> in a <document>; there are {len(chunks)}"
            )
        unknown.check_element(root, DOCUMENT_KEYS, path)
        archive = ChunkArchive(chunks[0])
    unknown.check_element(archive.chunk, CHUNK_KEYS, path)
    for marker in archive.chunk.iterfind("markers//marker"):
        unknown.check_element(marker, MARKER_KEYS, f"{path}, marker {label_of(marker)!r}")
    return archive


def _pose(
    where: str, camera: ET.Element, chunk: ET.Element
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """M and X0, in the chunk's frame or, if it has a transform, in that of the world."""
    T = numbers_of(f"{where}, transform", camera.findtext("transform"), 16).reshape(4, 4)
    to_chunk, centre = T[:3, :3], T[:3, 3]
    R, t, scale = _similarity_to_world(where, chunk, camera.get("component_id"))
    to_chunk, centre = R @ to_chunk, scale * (R @ centre) + t
    check_rotations(to_chunk, f"{where}: the transform")
    return flip_rows(to_chunk.T), centre


def _similarity_to_world(
    where: str, chunk: ET.Element, component: str | None
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"], float]:
    """R, t and s of X = s·R·x + t, from the frame of a chunk or of a component of it; the identity
    where there is no transform."""
    component_element = next(
        (c for c in chunk.iterfind("components/component") if c.get("id") == component), None
    )
    transform = None if component_element is None else component_element.find("transform")
    transform = chunk.find("transform") if transform is None else transform
    if transform is not None and (transform.text or "").strip():
        raise InputError(f"{where}: the transform of the chunk has no <rotation>, as old versions")
    if transform is None or transform.find("rotation") is None:
        return np.eye(3), np.zeros(3), 1.0
    location = f"{where}, transform of the chunk"
    R = numbers_of(f"{location}, rotation", transform.findtext("rotation"), 9).reshape(3, 3)
    t = numbers_of(f"{location}, translation", transform.findtext("translation"), 3)
    return R, t, number_in(transform.findtext("scale", ""), f"{location}, scale")


def _with_ties(
    path: Path,
    chunk: ET.Element,
    ties: TieTable,
    images: Mapping[str | None, str],
    points: Columns | None,
    rays: Columns | None,
) -> tuple[Columns, Columns]:
    """The tables of points and image points of the markers, followed by those of tie points (`t`
    and the number of the track); image points of tracks without a point are left out."""
    X = np.empty_like(ties.position)
    for component in dict.fromkeys(ties.component.tolist()):
        rows = np.array([tie_component == component for tie_component in ties.component.tolist()])
        R, t, scale = _similarity_to_world(f"{path}, tie points", chunk, component)
        X[rows] = scale * ties.position[rows] @ R.T + t
    is_used = np.array([camera in images for camera in ties.camera.tolist()], bool)
    is_used &= np.isin(ties.track, ties.id)
    xy = ties.xy[is_used] - PIXEL_CENTRE
    names = [f"t{id}" for id in ties.id.tolist()]
    tie_points = {"id": names, "role": ["tie"] * len(names), **dict(zip("XYZ", X.T))}
    tie_points |= colour_columns(ties.colour)
    tie_rays = {
        "image": [images[camera] for camera in ties.camera[is_used].tolist()],
        "point": [f"t{id}" for id in ties.track[is_used].tolist()],
        "x": xy[:, 0],
        "y": xy[:, 1],
    }
    return _append_rows(points, tie_points, path), _append_rows(rays, tie_rays, path)


def _append_rows(table: Columns | None, appended: Mapping[str, Any], path: Path) -> Columns:
    """The rows of a table, if there is one, followed by others; a column that it does not have is
    empty in its rows."""
    if table is None:
        return Columns(dict(appended), Source(str(path), None, "tie point"))
    return Columns(
        {
            name: [*table.values.get(name, [None] * len(table)), *column]
            for name, column in appended.items()
        },
        Source(str(path), None, "point"),
    )


def _markers(
    path: Path, chunk: ET.Element, images: Mapping[str | None, str]
) -> tuple[Columns | None, Columns | None, Points | None]:
    """Tables of points and image points of markers, and control points; each may be None."""
    markers = {m.get("id"): m for m in chunk.iterfind("markers//marker")}
    rows, marker_ids = [], {}
    for marker in chunk.iterfind("frames/frame/markers/marker"):
        id = marker.get("marker_id")
        if id not in markers:
            raise InputError(f"{path}: marker {id!r} of a frame is not among the markers")
        for location in marker.iterfind("location"):
            if location.get("camera_id") not in images or not _is_true(location.get("valid")):
                continue
            where = f"{path}, marker {label_of(markers[id])!r}, camera {location.get('camera_id')}"
            x, y = (number_in(location.get(k, ""), f"{where}, {k}") for k in "xy")
            image = images[location.get("camera_id")]
            rows.append((image, id, x - PIXEL_CENTRE, y - PIXEL_CENTRE))
            marker_ids[id] = None
    if not rows:
        return None, None, None
    # Labels may repeat, ids may not.
    names = dict(
        zip(
            marker_ids,
            unique_labels([label_of(markers[id]) for id in marker_ids], list(marker_ids)),
        )
    )
    empty_column = [None] * len(marker_ids)
    image, point, x, y = zip(*rows)
    return (
        Columns(
            {
                "id": list(names.values()),
                "role": ["tie"] * len(marker_ids),
                "X": empty_column,
                "Y": empty_column,
                "Z": empty_column,
            },
            Source(str(path), None, "marker"),
        ),
        Columns(
            {"image": image, "point": [names[id] for id in point], "x": x, "y": y},
            Source(str(path), None, "location"),
        ),
        _references(path, chunk, {names[id]: markers[id] for id in marker_ids}),
    )


def _references(path: Path, chunk: ET.Element, markers: Mapping[str, ET.Element]) -> Points | None:
    """Control and check points of the markers with a reference in a local system; None if
    they define no datum."""
    if not _is_local(chunk):
        return None
    ids, roles, position, sigma = [], [], [], []
    for id, marker in markers.items():
        reference = marker.find("reference")
        if reference is None or any(reference.get(k) is None for k in "xyz"):
            continue
        where = f"{path}, reference of marker {id!r}"
        ids.append(id)
        roles.append("control" if _is_true(reference.get("enabled")) else "check")
        position.append([number_in(reference.get(k, ""), f"{where}, {k}") for k in "xyz"])
        sigma.append(
            [
                number_in(reference.get(k, str(_marker_accuracy(chunk))), f"{where}, {k}")
                for k in ("sx", "sy", "sz")
            ]
        )
    # Fewer than three points do not determine the seven parameters of a datum.
    if roles.count("control") < 3:
        return None
    sigma = np.where(np.array(sigma) > 0, sigma, _marker_accuracy(chunk))
    return Points(tuple(ids), tuple(roles), np.array(position), sigma, Source(str(path)))


def _describe_references(chunk: ET.Element, control: Points | None) -> Iterator[str]:
    """Messages about the references of markers."""
    if control is not None:
        yield (
            f"{count(len(control), 'marker')} with reference coordinates: control points with σ "
            f"as the file gives it, else {_marker_accuracy(chunk):g} m; those not enabled are "
            "check points"
        )
    elif not _is_local(chunk) and chunk.find("markers//marker/reference") is not None:
        yield (
            "the reference coordinates of markers are not in a local system and are not read; "
            "the cameras are in geocentric coordinates: --control FILE gives control in a "
            "rectangular frame"
        )
    elif any(m.get("x") is not None for m in chunk.iterfind("markers//marker/reference")):
        yield (
            "the reference coordinates of markers are not read: a datum needs three enabled "
            "markers that have them and are measured in images"
        )


def _is_local(chunk: ET.Element) -> bool:
    # A chunk without a reference is in a local frame.
    return (chunk.findtext("reference") or LOCAL).strip().upper().startswith(LOCAL)


def _marker_accuracy(chunk: ET.Element) -> float:
    for element in chunk.iterfind("settings/property"):
        if element.get("name") == "accuracy_markers":
            try:
                accuracy = number_in((element.get("value") or "").split("/")[0], "accuracy")
            except InputError:
                continue
            if accuracy > 0:
                return accuracy
    return 0.005  # m, the default of Metashape's settings


def _is_true(word: str | None) -> bool:
    """Whether an attribute is not switched off; old versions write 0 and 1."""
    return (word or "true").lower() not in ("false", "0")
