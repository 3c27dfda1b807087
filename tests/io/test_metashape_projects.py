"""Projects of Metashape: the archives beside a .psx, with markers and tie points."""

import re
import zipfile

import numpy as np
import pytest
from exchange_cases import ANGLES, POINTS, POSITION, matrix
from numpy.testing import assert_allclose
from test_metashape import SCALE, SHIFT, TURN, published, xml

from jaxbundle.errors import InputError
from jaxbundle.io import read_network
from jaxbundle.io.formats import recognise_format
from jaxbundle.network.reprojection import point_errors

MARKERS = '<markers><marker id="0" label="M1"/></markers>'
LOCATIONS = (
    '<frame><markers><marker marker_id="0"><location camera_id="0" x="10" y="20.5"/>'
    '<location camera_id="1" x="30" y="40"/></marker></markers></frame>'
)
COLOURS = np.arange(3 * len(POINTS)).reshape(-1, 3)


def ply(names, *columns, text="float"):
    """A binary PLY; the last column is the whole number `id` if it is named so."""
    kinds = ["uint" if name == "id" else text for name in names]
    types = {"uint": "<u4", "float": "<f4", "double": "<f8", "uchar": "u1"}
    table = np.zeros(len(columns[0]), [(n, types[k]) for n, k in zip(names, kinds)])
    for name, column in zip(names, columns):
        table[name] = column
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    head += [f"property {k} {n}" for n, k in zip(names, kinds)] + ["end_header", ""]
    return "\n".join(head).encode() + table.tobytes()


def pack(path, **members):
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name.replace("_", "."), content)


def write(folder, ties=True, chunks=(0,), active=0):
    """The chunk of `test_metashape.xml` as a project; tie points are `POINTS`, as its images see
    them."""
    path = folder / "block.psx"
    path.write_text('<document version="1.2.0" path="{projectname}.files/project.zip"/>')
    files = folder / "block.files"
    rows = "".join(f'<chunk id="{k}" path="{k}/chunk.zip"/>' for k in chunks)
    pack(files / "project.zip",
         doc_xml=f'<document version="1.2.0"><chunks next_id="9" active_id="{active}">{rows}'
                 "</chunks></document>")  # fmt: skip
    text = xml(True, MARKERS + '<frames next_id="1"><frame id="0" path="0/frame.zip"/></frames>')
    chunk = re.search(r"<chunk.*</chunk>", text, re.DOTALL)[0]
    for k in chunks:
        pack(files / str(k) / "chunk.zip", doc_xml=chunk)
        pack(files / str(k) / "0" / "frame.zip", doc_xml=LOCATIONS)
    if ties:
        own = (POINTS - SHIFT) @ TURN / SCALE
        number = np.arange(len(POINTS))
        images = {}
        for i, (angles, X0) in enumerate(zip(ANGLES, POSITION)):
            X, Y, Z = ((POINTS - X0) @ matrix(angles).T * [1, -1, -1]).T
            u, v = published(X, Y, Z)
            # the last track has no point
            images[f"p{i}_ply"] = ply(("x", "y", "size", "id"), [*u, 5], [*v, 6],
                                      np.ones(len(u) + 1), [*number, 999], text="double")
        entries = "".join(f'<projections camera_id="{i}" path="p{i}.ply"/>' for i in range(3))
        pack(files / str(active) / "0" / "point_cloud" / "point_cloud.zip",
             doc_xml='<point_cloud version="1.2.0"><tracks path="tracks.ply"/>'
                     f'<points path="points0.ply"/>{entries}</point_cloud>',
             points0_ply=ply(("x", "y", "z", "id"), *own.T, number, text="double"),
             tracks_ply=ply(("red", "green", "blue"), *COLOURS.T, text="uchar"),
             **images)  # fmt: skip
    return path


def test_a_project_is_its_export_with_tie_points(tmp_path):
    path = write(tmp_path)
    assert recognise_format(path) == "metashape"
    net = read_network(path)
    assert net.images.id == ("a#0", "b", "a#2")
    assert_allclose(net.images.position, POSITION, atol=1e-11)
    assert net.points.id == ("M1", *(f"t{k}" for k in range(len(POINTS))))
    assert_allclose(net.points.position[1:], POINTS, atol=1e-10)
    assert_allclose(net.points.colour[1:], COLOURS)
    rays = net.observations
    assert len(rays) == 2 + 3 * len(POINTS)
    assert_allclose(rays.xy[:2], [[9.5, 20], [29.5, 39.5]])
    # they are where the cameras, by the published formula, see the points
    error, unit = point_errors(net)
    assert unit == "px" and np.nanmax(error[1:]) < 1e-6


def test_a_project_without_tie_points(tmp_path):
    net = read_network(write(tmp_path, ties=False))
    assert net.points.id == ("M1",) and len(net.observations) == 2


def test_the_active_chunk_is_read(tmp_path):
    net = read_network(write(tmp_path, chunks=(0, 3), active=3))
    assert len(net.points) == 1 + len(POINTS)
    assert any("chunk 3, the active one, is read; not read: 0" in told for told in net.warnings)


def damage(tmp_path, name, content):
    path = write(tmp_path)
    file = tmp_path / "block.files" / name
    if content is None:
        file.unlink()
    else:
        file.write_bytes(content)
    return path


@pytest.mark.parametrize(
    ("name", "content", "why"),
    [
        ("project.zip", None, "is missing; the folder NAME.files"),
        ("0/chunk.zip", b"PK", "is not a project of Metashape, or is damaged"),
        ("0/0/frame.zip", None, "is missing"),
    ],
)
def test_missing_and_damaged_archives(tmp_path, name, content, why):
    with pytest.raises(InputError, match=why):
        read_network(damage(tmp_path, name, content))


@pytest.mark.parametrize(
    ("member", "content", "why"),
    [
        ("points0_ply", b"ply\nformat ascii 1.0\nend_header\n", "expected a binary PLY"),
        ("points0_ply", ply(("x", "y", "id"), [1], [2], [3]), "the property z is missing"),
        ("points0_ply", ply(("x", "y", "z", "id"), [np.nan], [2], [3], [4]), "a finite x"),
        ("points0_ply", ply(("x", "y", "z", "id"), [1], [2], [3], [4])[:-2], "shorter than"),
        ("points0_ply", b"", "a binary PLY"),
        ("doc_xml", b"<point_cloud><points path='q.ply'/></point_cloud>", "is missing in the arch"),
        ("doc_xml", b"<point", "not valid XML"),
    ],
)
def test_damaged_tie_points(tmp_path, member, content, why):
    path = write(tmp_path, ties=False)
    members = {
        "doc_xml": '<point_cloud><points path="points0.ply"/></point_cloud>', member: content
    }  # fmt: skip
    pack(tmp_path / "block.files" / "0" / "0" / "point_cloud" / "point_cloud.zip", **members)
    with pytest.raises(InputError, match=why):
        read_network(path)
