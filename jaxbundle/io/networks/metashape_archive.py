"""Projects of Agisoft Metashape: `NAME.psx` with the archives of `NAME.files`.

    NAME.psx                          document path="{projectname}.files/project.zip"
    NAME.files/project.zip            document/chunks active_id, chunk id path="0/chunk.zip"
    NAME.files/0/chunk.zip            the chunk as in "Export Cameras" (`metashape.py`), and
                                      frames/frame id path="0/frame.zip"
    NAME.files/0/0/frame.zip          frame/markers/marker marker_id, location camera_id x y
    NAME.files/0/0/point_cloud/point_cloud.zip
        doc.xml                       points path, projections camera_id path, tracks path
        points0.ply, points.ply       x y z id of the tie points, frame of the chunk
        p0.ply, …                     x y size id of their image points, pixels from the corner
        tracks.ply                    red green blue of track `id`

Each archive has a `doc.xml`. Of several chunks the active one is read, of several frames the first.

Source: Agisoft Metashape user manual, "Project files"; projects of versions 1.2 to 2.1.
"""

import copy
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbundle.errors import InputError
from jaxbundle.io.text.vertex_table import read_vertices
from jaxbundle.io.text.xml_fields import read_xml
from jaxbundle.io.text.zip_members import document_of, read_zip
from jaxbundle.network.columns import list_some
from jaxbundle.system.file_content import beginning

SUFFIX = ".psx"
PROJECT = "a project of Metashape"


class TieTable(NamedTuple):
    """Tie points of a chunk: `id` and `position` in the frame of the chunk or of a `component`,
    `colour`, NaN where there is none; image points: `track`, `camera` (id), `xy` in pixels from the
    corner of the image."""

    id: np.ndarray
    component: np.ndarray
    position: Float[np.ndarray, "points 3"]
    colour: Float[np.ndarray, "points 3"]
    track: np.ndarray
    camera: np.ndarray
    xy: Float[np.ndarray, "rays 2"]


class ChunkArchive(NamedTuple):
    """The chunk of a project, as an element of "Export Cameras"; its tie points; messages."""

    chunk: ET.Element
    ties: TieTable | None = None
    messages: tuple[str, ...] = ()


def is_metashape_archive(path: Path) -> bool:
    """Whether a file is a `.psx` with a document."""
    return path.suffix.lower() == SUFFIX and b"<document" in beginning(path, 4000)


def read_archive(path: Path) -> ChunkArchive:
    """The active chunk of a project.

    **Raises:** `InputError` naming the file: an archive is missing or damaged, there is no
    chunk."""
    root = read_xml(path)
    # The name of the project is that of the file, however it was renamed.
    relative_path = root.get("path") or "{projectname}.files/project.zip"
    project = path.parent / relative_path.replace("{projectname}", path.stem)
    document = document_of(project, _members(project, path), PROJECT)
    chunks = {chunk.get("id"): chunk.get("path") for chunk in document.iterfind("chunks/chunk")}
    chunks_element = document.find("chunks")
    active = None if chunks_element is None else chunks_element.get("active_id")
    chunk_id = active if active in chunks else next(iter(chunks), None)
    if not chunks.get(chunk_id):
        raise InputError(f"{project}: {PROJECT} without a chunk")
    messages = []
    if len(chunks) > 1:
        other_ids = [id or "?" for id in chunks if id != chunk_id]
        messages.append(
            f"chunk {chunk_id}, the active one, is read; not read: "
            f"{list_some(other_ids, as_text=str)}"
        )
    archive = project.parent / str(chunks[chunk_id])
    # Its frames are changed below.
    chunk = copy.deepcopy(document_of(archive, _members(archive, path), PROJECT))
    if chunk.tag != "chunk":
        raise InputError(f"{archive}: expected <chunk> in its doc.xml, got <{chunk.tag}>")
    frames = chunk.findall("frames/frame")
    if len(frames) > 1:
        messages.append(f"the first of {len(frames)} frames is read")
    ties = None
    frames_element = chunk.find("frames")
    for frame in frames[1:]:
        if frames_element is not None:
            frames_element.remove(frame)
    if frames and frames[0].get("path"):
        frame_archive = archive.parent / str(frames[0].get("path"))
        frame_document = document_of(frame_archive, _members(frame_archive, path), PROJECT)
        # As an export has it: the markers with their image points.
        frames[0].extend(frame_document.findall("markers"))
        ties = _ties(frame_archive.parent / "point_cloud" / "point_cloud.zip", path)
    return ChunkArchive(chunk, ties, tuple(messages))


def _members(archive: Path, project: Path) -> Mapping[str, bytes]:
    if not archive.is_file():
        raise InputError(
            f"{project}: {archive} is missing; the folder NAME.files belongs to a project of "
            "Metashape, beside its .psx"
        )
    return read_zip(archive, PROJECT)


def _ties(archive: Path, project: Path) -> TieTable | None:
    """The tie points, if the photographs are aligned."""
    if not archive.is_file():
        return None
    members = _members(archive, project)
    document = document_of(archive, members, PROJECT)
    id, component, position = [], [], []
    for entry in document.findall("points"):
        table = _vertices(archive, members, entry, ("x", "y", "z", "id"))
        position.append(np.stack([table[axis].astype(float) for axis in "xyz"], 1))
        id.append(table["id"].astype(np.int64))
        component.append(np.full(len(table), entry.get("component_id"), dtype=object))
    track, camera, xy = [], [], []
    for entry in document.findall("projections"):
        table = _vertices(archive, members, entry, ("x", "y", "id"))
        xy.append(np.stack([table[axis].astype(float) for axis in "xy"], 1))
        track.append(table["id"].astype(np.int64))
        camera.append(np.full(len(table), entry.get("camera_id"), dtype=object))
    if not id or not track:
        return None
    # The id of a point is the row of its track, where the colours are.
    ids = np.concatenate(id)
    colour = np.full((len(ids), 3), np.nan)
    entry = document.find("tracks")
    if entry is not None and entry.get("path") in members:
        table = _vertices(archive, members, entry, ("red", "green", "blue"))
        has_track = (ids >= 0) & (ids < len(table))
        for axis, name in enumerate(("red", "green", "blue")):
            colour[has_track, axis] = table[name][ids[has_track]]
    return TieTable(
        ids,
        np.concatenate(component),
        np.concatenate(position),
        colour,
        np.concatenate(track),
        np.concatenate(camera),
        np.concatenate(xy),
    )


def _vertices(
    archive: Path, members: Mapping[str, bytes], entry: ET.Element, names: tuple[str, ...]
) -> np.ndarray:
    name = entry.get("path") or ""
    where = f"{archive}, {name or '?'}"
    if name not in members:
        raise InputError(f"{where}: is missing in the archive")
    return read_vertices(where, members[name], names)
