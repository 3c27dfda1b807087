"""Cameras of Agisoft Metashape: the XML of "Export Cameras".

    document/chunk
      sensors/sensor id label type            calibration class="adjusted": f cx cy k1… p1 p2 b1 b2
      cameras/…/camera id sensor_id label     transform: 4 × 4, camera → chunk, by rows
      transform                               rotation, translation, scale: chunk → world
      components/component id/transform       the same, where cameras name a component
      markers/marker id label                 and frames/frame/markers/marker/location camera_id x y

[X, Y, Z] of a camera are right, down, forward. Its image of X, with x = X/Z, y = Y/Z, r² = x² + y²:

    x' = x·(1 + k1·r² + k2·r⁴ + k3·r⁶ + k4·r⁸) + p1·(r² + 2x²) + 2·p2·x·y
    y' = y·(1 + …)                             + p2·(r² + 2y²) + 2·p1·x·y
    u = w/2 + cx + x'·f + x'·b1 + y'·b2        v = h/2 + cy + y'·f

from the corner of the first pixel, hence in `opencv`

    fx = f + b1   fy = f   cx_cv = w/2 + cx − ½   cy_cv = h/2 + cy − ½   p1_cv = p2   p2_cv = p1

A skew b2, k4, p3, p4 and sensors that are no frame cameras have no place in our models and are
refused by name. Cameras that are disabled or not aligned are left out. A chunk with a transform
gives world coordinates (geocentric where it is georeferenced), one without its own. Markers become
tie points, their positions are not read. The tie points of Metashape are not in this file.

Source: Agisoft Metashape user manual, appendix "Camera models".
"""

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxbundle.errors import InputError
from jaxbundle.geometry.pose_conventions import flip_rows
from jaxbundle.io.assemble import assemble, foreign_document, image_columns
from jaxbundle.io.csv_tables import read_text
from jaxbundle.network.columns import Columns, count, shown, some
from jaxbundle.network.tables import Network, Source

COEFFICIENTS = ("f", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4", "b1", "b2")
WITHOUT_PLACE = {"b2": "skew", "k4": "fourth radial term", "p3": "", "p4": ""}
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
    left = [_label(c) for c in cameras if not any(c is u for u in used)]
    if not used:
        raise InputError(f"{path}: no camera is enabled and aligned")
    labels = _unique([_label(c) for c in used], [c.get("id", "") for c in used])
    entries, poses = {}, []
    for label, camera in zip(labels, used):
        where = f"{path}, camera {label!r}"
        id = camera.get("sensor_id")
        if id not in sensors:
            raise InputError(f"{where}: sensor {id!r} is not in the file")
        if id not in entries:
            entries[id] = _camera(path, sensors[id])
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
    warnings = (
        f"left out {count(len(left), 'camera')} that are disabled or not aligned: {some(left)}",
    )
    return assemble(path, document, overrides, images, points, rays, warnings if left else ())


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


def _camera(path: Path, sensor: ET.Element) -> dict:
    """The entry of a sensor: model `opencv`."""
    label = _label(sensor)
    where = f"{path}, sensor {label!r}"
    kinds = [c for c in sensor.iterfind("calibration")]
    if not kinds:
        raise InputError(f"{where}: there is no <calibration>")
    calibration = next((c for c in kinds if c.get("class") == "adjusted"), kinds[0])
    for element in (sensor, calibration):
        if element.get("type", "frame") != "frame":
            raise InputError(
                f"{where}: sensors of type {shown(element.get('type'))} are not offered; frame is"
            )
    size = calibration.find("resolution")
    size = sensor.find("resolution") if size is None else size
    if size is None:
        raise InputError(f"{where}: there is no <resolution>")
    w, h = (_number(f"{where}, resolution, {k}", size.get(k)) for k in ("width", "height"))
    p = dict.fromkeys(COEFFICIENTS, 0.0)
    for element in calibration:
        if element.tag in ("fx", "fy", "skew"):
            raise InputError(f"{where}: <{element.tag}> is of an old version; f, b1, b2 are known")
        if element.tag in p:
            p[element.tag] = _number(f"{where}, {element.tag}", element.text)
    for name, meaning in WITHOUT_PLACE.items():
        if p[name] != 0:
            called = f" ({meaning})" if meaning else ""
            raise InputError(
                f"{where}: {name}{called} is {p[name]:g} and has no place in our models; optimise "
                f"the cameras without {name} and export again"
            )
    return {
        "id": label, "model": "opencv", "image_size": [w, h],
        "fx": p["f"] + p["b1"], "fy": p["f"],
        "cx": w / 2 + p["cx"] - 0.5, "cy": h / 2 + p["cy"] - 0.5,
        "k1": p["k1"], "k2": p["k2"], "k3": p["k3"], "p1": p["p2"], "p2": p["p1"],
    }  # fmt: skip


def _pose(where: str, camera: ET.Element, chunk: ET.Element):
    """M and X0, in the chunk's frame or, if it has a transform, in that of the world."""
    T = _numbers(f"{where}, transform", camera.findtext("transform"), 16).reshape(4, 4)
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
        R = _numbers(f"{of}, rotation", transform.findtext("rotation"), 9).reshape(3, 3)
        t = _numbers(f"{of}, translation", transform.findtext("translation"), 3)
        scale = _number(f"{of}, scale", transform.findtext("scale"))
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
                x, y = (_number(f"{where}, {k}", location.get(k)) for k in "xy")
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


def _label(element: ET.Element) -> str:
    return element.get("label") or element.get("id") or "?"


def _unique(labels: Sequence[str], ids: Sequence[str]) -> list[str]:
    """The labels, those that stand twice with their id."""
    return [f"{label}#{id}" if labels.count(label) > 1 else label
            for label, id in zip(labels, ids)]  # fmt: skip


def _numbers(where: str, text: str | None, n: int) -> np.ndarray:
    words = (text or "").split()
    if len(words) != n:
        raise InputError(f"{where}: {len(words)} numbers where {n} are expected")
    return np.array([_number(where, word) for word in words])


def _number(where: str, text: str | None) -> float:
    try:
        number = float(text or "")
    except ValueError:
        number = np.nan
    if not np.isfinite(number):
        raise InputError(f"{where}: {shown(text)} where a number is expected")
    return number
