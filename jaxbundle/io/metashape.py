"""Cameras of Agisoft Metashape: the XML of "Export Cameras".

    document/chunk
      sensors/sensor id label type            calibration class="adjusted": f cx cy k1… p1 p2 b1 b2
      cameras/…/camera id sensor_id label     transform: 4 × 4, camera → chunk, by rows
      transform                               rotation, translation, scale: chunk → world
      components/component id/transform       the same, where cameras name a component
      markers/marker id label                 and frames/frame/markers/marker/location camera_id x y

The sensors are in `metashape_camera.py`. Cameras that are disabled or not aligned are left out. A
chunk with a transform gives world coordinates (geocentric where it is georeferenced), one without
its own. Markers become tie points, their positions are not read. The tie points of Metashape are
not in this file.

Source: Agisoft Metashape user manual, sections on formats; exported files.
"""

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxbundle.errors import InputError
from jaxbundle.geometry.pose_conventions import flip_rows
from jaxbundle.io.assemble import assemble, foreign_document, image_columns
from jaxbundle.io.csv_tables import read_text
from jaxbundle.io.metashape_camera import label_of, number_of, numbers_of, sensor_camera
from jaxbundle.network.columns import Columns, count, some
from jaxbundle.network.tables import Network, Source

ROTATION = 1e-6
"""How far a rotation may be from orthogonal."""


def is_metashape(path: Path) -> bool:
    """Whether an XML file begins with a `document` that has a `chunk`."""
    if path.suffix.lower() != ".xml" or not path.is_file():
        return False
    with path.open("rb") as file:
        head = file.read(4000)
    return b"<document" in head and b"<chunk" in head


def read_metashape(path: str | Path, overrides: Sequence[str] = ()) -> Network:
    """The cameras and images of an export, and the image points of markers if there are any.

    Cameras are called by their label, images too; nothing is free, σ is 1 px, the datum inner.

    **Raises:** `InputError` naming file and element.
    """
    path = Path(path)
    chunk = _chunk(path)
    sensors = {
        sensor.get("id"): sensor for sensor in chunk.iterfind("sensors/sensor")
    }
    cameras = [camera for camera in chunk.iterfind("cameras//camera")]
    used = [c for c in cameras if c.get("enabled", "true") not in ("false", "0")
            and c.find("transform") is not None]  # fmt: skip
    left = [label_of(c) for c in cameras if not any(c is u for u in used)]
    if not used:
        raise InputError(f"{path}: no camera is enabled and aligned")
    labels = _unique([label_of(c) for c in used], [c.get("id", "") for c in used])
    entries, poses, fitted = {}, [], ()
    for label, camera in zip(labels, used):
        where = f"{path}, camera {label!r}"
        id = camera.get("sensor_id")
        if id not in sensors:
            raise InputError(f"{where}: sensor {id!r} is not in the file")
        if id not in entries:
            entries[id], more = sensor_camera(path, sensors[id])
            fitted += more
        poses.append(_pose(where, camera, chunk))
    names = _unique([e["id"] for e in entries.values()], list(entries))
    for entry, name in zip(entries.values(), names):
        entry["id"] = name
    M, X0 = (np.stack(part) for part in zip(*poses))
    images = image_columns(
        Source(str(path), None, "camera"), labels,
        [entries[c.get("sensor_id")]["id"] for c in used], M, X0,
    )  # fmt: skip
    by_id = {c.get("id"): label for c, label in zip(used, labels)}
    points, rays = _markers(path, chunk, by_id)
    document = foreign_document(path.stem, entries.values(), object_unit="m")
    if left:
        what = f"left out {count(len(left), 'camera')} that are disabled or not aligned"
        fitted += (f"{what}: {some(left)}",)
    return assemble(path, document, overrides, images, points, rays, fitted)


def _chunk(path: Path) -> ET.Element:
    text = read_text(path)
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise InputError(f"{path}: a document type or entities are not expected in this file")
    try:
        root = ET.fromstring(text)
    except (ET.ParseError, ValueError) as error:
        raise InputError(f"{path}: not valid XML: {error}") from None
    except RecursionError:
        raise InputError(f"{path}: not valid XML: elements are nested too deeply") from None
    chunks = root.findall("chunk")
    if root.tag != "document" or len(chunks) != 1:
        raise InputError(
            f"{path}: one <chunk> in a <document> is expected; there are {len(chunks)}"
        )
    return chunks[0]


def _pose(where: str, camera: ET.Element, chunk: ET.Element):
    """M and X0, in the chunk's frame or, if it has a transform, in that of the world."""
    T = numbers_of(f"{where}, transform", camera.findtext("transform"), 16).reshape(4, 4)
    to_chunk, centre = T[:3, :3], T[:3, 3]
    component = camera.get("component_id")
    holder = next((c for c in chunk.iterfind("components/component")
                   if c.get("id") == component), None)  # fmt: skip
    transform = None if holder is None else holder.find("transform")
    transform = chunk.find("transform") if transform is None else transform
    if transform is not None and (transform.text or "").strip():
        raise InputError(f"{where}: the transform of the chunk has no <rotation>, as old versions")
    if transform is not None and transform.find("rotation") is not None:
        of = f"{where}, transform of the chunk"
        R = numbers_of(f"{of}, rotation", transform.findtext("rotation"), 9).reshape(3, 3)
        t = numbers_of(f"{of}, translation", transform.findtext("translation"), 3)
        scale = number_of(f"{of}, scale", transform.findtext("scale"))
        to_chunk, centre = R @ to_chunk, scale * (R @ centre) + t
    if abs(to_chunk @ to_chunk.T - np.eye(3)).max() > ROTATION or np.linalg.det(to_chunk) < 0:
        raise InputError(f"{where}: the transform is not a rotation and a shift")
    return flip_rows(to_chunk.T), centre


def _markers(path: Path, chunk: ET.Element, images: dict):
    """Tables of points and image points of markers; None where there are none."""
    labels = {m.get("id"): m.get("label", m.get("id")) for m in chunk.iterfind("markers//marker")}
    rows, seen = [], {}
    for marker in chunk.iterfind("frames/frame/markers/marker"):
        id = marker.get("marker_id")
        if id not in labels:
            raise InputError(f"{path}: marker {id!r} of a frame is not among the markers")
        for location in marker.iterfind("location"):
            if location.get("camera_id") in images:
                where = f"{path}, marker {labels[id]!r}, camera {location.get('camera_id')}"
                x, y = (number_of(f"{where}, {k}", location.get(k)) for k in "xy")
                rows.append((images[location.get("camera_id")], id, x - 0.5, y - 0.5))
                seen[id] = None
    if not rows:
        return None, None
    names = dict(zip(seen, _unique([labels[id] for id in seen], list(seen))))
    none = [None] * len(seen)
    image, point, x, y = zip(*rows)
    return (
        Columns({"id": list(names.values()), "role": ["tie"] * len(seen), "X": none, "Y": none,
                 "Z": none}, Source(str(path), None, "marker")),
        Columns({"image": image, "point": [names[id] for id in point], "x": x, "y": y},
                Source(str(path), None, "location")),
    )  # fmt: skip


def _unique(labels: Sequence[str], ids: Sequence[str]) -> list[str]:
    """The labels, those that stand twice with their id."""
    return [f"{label}#{id}" if labels.count(label) > 1 else label
            for label, id in zip(labels, ids)]  # fmt: skip
