"""Damaged clouds, tables and archives: an error that names the file, and no other."""

import io
import sqlite3
import struct
import zipfile

import laspy
import numpy as np
import pytest

from jaxbundle.batches.stacks import read_camera_stack
from jaxbundle.errors import InputError
from jaxbundle.io import read_cameras
from jaxbundle.io.boards.kept_corners import KeptCorners
from jaxbundle.io.results.stored_tree import read_tree
from jaxbundle.io.text.archives import read_arrays
from jaxbundle.measure.boards import Board
from jaxbundle.photographs.xmp import parse_xmp
from jaxbundle.reconstruction.control import read_control_measurements
from jaxbundle.surfaces.cloud import Cloud
from jaxbundle.surfaces.dsm import make_dsm
from jaxbundle.surfaces.point_files import read_cloud, write_cloud
from jaxbundle.tiepoints.features import Features, FeatureSettings
from jaxbundle.tiepoints.store import Store

EVLR_COUNT, RECORDS, TABLE = 243, 100, 96
"""Offsets in the header of LAS 1.4."""


def some_points(n=5):
    X = np.arange(3.0 * n).reshape(n, 3)
    return Cloud(X, np.tile(1e-4 * np.eye(3), (n, 1, 1)), np.full(n, 2), np.zeros(n, int),
                 np.zeros((n, 2)), ("a",))  # fmt: skip


def refused(read, path, *words):
    with pytest.raises(InputError) as told:
        read(path)
    for word in (path.name, *words):
        assert word in str(told.value)


def test_a_table_without_the_columns(tmp_path):
    path = tmp_path / "c.csv"
    path.write_text("E,N,H\n1,2,3\n")
    refused(read_cloud, path, "'X' is missing", "E, N, H")


@pytest.mark.parametrize("row", ["P1,1,2,3", "P1,1,2,3,a.jpg,5", "P1,1,2,3,a.jpg,5,6,7"])
def test_a_row_of_another_length_than_the_header(tmp_path, row):
    path = tmp_path / "gcp.csv"
    path.write_text(f"id,X,Y,Z,image,u,v\n{row}\n")
    refused(read_control_measurements, path, "line 2", "the header has 7")


@pytest.mark.parametrize("old, new, word", [
    (b"vertex 5", b"vertex five", "'element vertex five'"),
    (b"vertex 5", b"vertex -5", "'element vertex -5'"),
    (b"vertex 5", b"vertex", "'element vertex'"),
    (b"vertex 5", b"vertex 500000000000", "c.ply"),
    (b"double x", b"double", "'property double'"),
    (b"double x", b"list uchar int x", "'property list uchar int x'"),
    (b"format binary_little_endian 1.0", b"format", "'format'"),
])  # fmt: skip
def test_the_head_of_a_ply_file(tmp_path, old, new, word):
    path = tmp_path / "c.ply"
    write_cloud(some_points(), path)
    content = path.read_bytes()
    assert old in content
    path.write_bytes(content.replace(old, new, 1))
    refused(read_cloud, path, word)


@pytest.mark.parametrize("value", ["inf", "nan"])
def test_coordinates_that_are_not_finite(tmp_path, value):
    path = tmp_path / "c.ply"
    fields = "".join(f"property double {axis}\n" for axis in "xyz")
    path.write_text(f"ply\nformat ascii 1.0\nelement vertex 2\n{fields}end_header\n"
                    f"1 2 3\n1 {value} 3\n")  # fmt: skip
    refused(read_cloud, path, "1 of 2 points", "point 2")


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("offset, what", [(EVLR_COUNT, "extended records"), (RECORDS, "records")])
def test_counts_of_las_records_beyond_the_file(tmp_path, suffix, offset, what):
    path = tmp_path / f"c{suffix}"
    write_cloud(some_points(), path)
    assert len(read_cloud(path)) == 5
    content = bytearray(path.read_bytes())
    struct.pack_into("<I", content, offset, 2**32 - 1)
    path.write_bytes(content)
    refused(read_cloud, path, f"more {what}")


def test_the_count_of_laz_chunks_beyond_the_file(tmp_path):
    path = tmp_path / "c.laz"
    write_cloud(some_points(), path)
    content = bytearray(path.read_bytes())
    (begin,) = struct.unpack_from("<I", content, TABLE)
    (table,) = struct.unpack_from("<q", content, begin)
    assert struct.unpack_from("<II", content, table) == (0, 1)  # version, chunks
    struct.pack_into("<I", content, table + 4, 2**32 - 1)
    path.write_bytes(content)
    refused(read_cloud, path, "4294967295 chunks for 5 points")


def damage(path, offset, form, *values):
    content = bytearray(path.read_bytes())
    struct.pack_into(form, content, offset, *values)
    path.write_bytes(content)


@pytest.mark.parametrize("length", [10, 100, 226, 300, 374, 375, 500])
@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_a_las_file_cut_in_its_header_is_no_cloud_of_no_points(tmp_path, suffix, length):
    path = tmp_path / f"c{suffix}"
    write_cloud(some_points(), path)
    path.write_bytes(path.read_bytes()[:length])
    refused(read_cloud, path)


LAS_FIELDS = {
    "scale NaN": (131, "<d", np.nan), "scale 0": (139, "<d", 0.0),
    "offset inf": (155, "<d", np.inf), "points": (247, "<Q", 2**40),
    "length of a point": (105, "<H", 1), "first point": (96, "<I", 10),
    "extended records": (235, "<QI", 2**63, 1), "version": (25, "<B", 9),
}  # fmt: skip


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("case", LAS_FIELDS)
def test_fields_of_the_header_of_las(tmp_path, suffix, case):
    path = tmp_path / f"c{suffix}"
    write_cloud(some_points(), path)
    damage(path, *LAS_FIELDS[case])
    refused(read_cloud, path)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("offset, form, value, said", [
    (0, "<4s", b"PNG ", "it does not begin with LASF"),
    (105, "<H", 1, "points of format 7 with 1 bytes"),
    (247, "<Q", 2**40, "states"),
])  # fmt: skip
def test_what_is_wrong_with_a_header_of_las_is_said(tmp_path, suffix, offset, form, value, said):
    """The format without the bit of compression; a count of points beyond any compression."""
    path = tmp_path / f"c{suffix}"
    write_cloud(some_points(), path)
    damage(path, offset, form, value)
    refused(read_cloud, path, said, *["more points"] * (said == "states" and suffix == ".laz"))


def test_chunks_of_laz_larger_than_the_memory(tmp_path):
    """lazrs would allocate 175 GB and abort the process."""
    path = tmp_path / "c.laz"
    write_cloud(some_points(), path)
    begin = path.read_bytes().index(b"laszip encoded") - 2 + 54
    assert len(laspy.read(path).points) == 5
    damage(path, begin + 12, "<I", 2_617_295_696)
    refused(read_cloud, path, "chunks of 2617295696 points")


@pytest.mark.parametrize("column, value", [
    ("sX", -1.0), ("sZ", np.inf), ("rays", -1), ("rays", 1e300), ("X", 1e300), ("Y", np.nan),
])  # fmt: skip
@pytest.mark.parametrize("suffix", [".csv", ".ply", ".las"])
def test_values_that_no_point_has(tmp_path, suffix, column, value):
    names = ["X", "Y", "Z", "sX", "sY", "sZ", "rays"]
    rows = np.tile([1.0, 2, 3, 0.1, 0.1, 0.1, 2], (4, 1))
    rows[2, names.index(column)] = value
    path = tmp_path / f"c{suffix}"
    if suffix == ".csv":
        text = "\n".join(",".join(map(repr, row)) for row in rows.tolist())
        path.write_text(f"{','.join(names)}\n{text}\n")
    elif suffix == ".ply":
        fields = "".join(f"property double {n if n in names[3:] else n.lower()}\n" for n in names)
        text = "\n".join(" ".join(map(repr, row)) for row in rows.tolist())
        path.write_text(
            f"ply\nformat ascii 1.0\nelement vertex 4\n{fields}end_header\n{text}\n"
        )
    else:
        if column in "XYZ":
            return  # whole numbers
        header = laspy.LasHeader(point_format=7, version="1.4")
        header.add_extra_dims([laspy.ExtraBytesParams(n, np.float64) for n in names[3:]])
        las = laspy.LasData(header)
        las.x, las.y, las.z = rows[:, :3].T
        for name, values in zip(names[3:], rows[:, 3:].T):
            las[name] = values
        las.write(path)
    refused(read_cloud, path, {".csv": "line 4"}.get(suffix, "3"))


def test_a_dsm_of_points_of_no_sigma():
    """They count as those without a σ: the same heights."""
    X = np.random.default_rng(0).uniform(0, 4, (60, 3))
    C = np.tile(1e-4 * np.eye(3), (60, 1, 1))
    models = []
    for value in (0.0, 1e-320, np.nan):
        C[::7, 2, 2] = value
        cloud = Cloud(X, C.copy(), np.full(60, 2), np.zeros(60, int), np.zeros((60, 2)), ("a",))
        models.append(make_dsm(cloud, 1.0))
    for model in models[:2]:
        np.testing.assert_array_equal(model.height, models[2].height)
        np.testing.assert_array_equal(model.sigma, models[2].sigma)


def test_a_vector_where_las_has_a_number(tmp_path):
    header = laspy.LasHeader(point_format=7, version="1.4")
    header.add_extra_dim(laspy.ExtraBytesParams("sX", "3f4"))
    las = laspy.LasData(header)
    las.x = las.y = las.z = np.arange(4.0)
    las.write(tmp_path / "c.las")
    refused(read_cloud, tmp_path / "c.las")


def test_an_unknown_coordinate_system_of_las(tmp_path):
    header = laspy.LasHeader(point_format=3, version="1.2")
    keys = laspy.vlrs.known.GeoKeyDirectoryVlr()
    keys.parse_record_data(struct.pack("<8H", 1, 1, 0, 1, 3072, 0, 1, 9999))
    header.vlrs.append(keys)
    las = laspy.LasData(header)
    las.x = las.y = las.z = np.arange(4.0)
    las.write(tmp_path / "c.las")
    refused(read_cloud, tmp_path / "c.las", "9999")


def archive(path, **members):
    with zipfile.ZipFile(path, "w") as written:
        for name, content in members.items():
            written.writestr(f"{name}.npy", content)


def array_bytes(array):
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


DAMAGED = {
    "header that is no Python": lambda good: good.replace(b"{'descr'", b"{('descr", 1),
    "shape beyond every integer": lambda good: good.replace(
        b"(2,), }" + 21 * b" ", b"(%d,), }" % (2 * 10**21)),
    "no array at all": lambda good: b"plain text",
}  # fmt: skip


@pytest.mark.parametrize("case", DAMAGED)
def test_a_damaged_member_of_an_archive(tmp_path, case):
    good = array_bytes(np.array([640, 480]))
    bad = DAMAGED[case](good)
    assert bad != good
    path = tmp_path / "c.npz"
    arrays = {name: good for name in ("object_points", "image_points")}
    archive(path, image_size=bad, head=bad, xy=bad, **arrays)
    refused(read_camera_stack, path)
    refused(lambda p: read_tree(p, (), "a result"), path)
    store = Store(tmp_path, FeatureSettings())
    archive(tmp_path / f"{store.name('photograph')}.npz", xy=bad, size=bad, angle=bad,
            descriptor=bad)  # fmt: skip
    assert store.load_features("photograph") is None  # searched again


BOMBS = {
    "unpacks to 6 GB": lambda f: f.writestr("xy.npy", array_bytes(np.zeros(3))[:118].ljust(128)
                                            + bytes(2**26), zipfile.ZIP_DEFLATED),
    "other packing": lambda f: f.writestr("xy.npy", array_bytes(np.zeros(3)), zipfile.ZIP_LZMA),
    "twice": lambda f: [f.writestr(n, array_bytes(np.zeros(3))) for n in ("xy", "xy.npy")],
    "objects": lambda f: f.writestr("xy.npy", object_bytes()),
    "fields": lambda f: f.writestr("xy.npy", array_bytes(np.zeros(2, [("a", int)]))),
    "letters that are none": lambda f: f.writestr("xy.npy", array_bytes(np.array(["ab"])).replace(
        b"a\0\0\0", b"\xff\xff\xff\xff")),
    "more than its shape": lambda f: f.writestr("xy.npy", array_bytes(np.zeros(3)) + bytes(8)),
}  # fmt: skip


def object_bytes():
    stream = io.BytesIO()
    np.save(stream, np.array([{}], object), allow_pickle=True)
    return stream.getvalue()


@pytest.mark.parametrize("case", BOMBS)
def test_archives_of_other_than_plain_arrays(tmp_path, case):
    path = tmp_path / "c.npz"
    with zipfile.ZipFile(path, "w") as file:
        BOMBS[case](file)
    refused(lambda p: read_arrays(p, "an archive"), path)


def test_kept_features_with_a_changed_number_are_computed_again(tmp_path):
    """The archive is whole; what was kept before a version with digests is computed again, too."""
    store, ones = Store(tmp_path, FeatureSettings()), np.ones((3, 2))
    features = Features(ones, np.ones(3), np.zeros(3), np.zeros((3, 128), np.uint8))
    store.save_features("photograph", features)
    assert (store.load_features("photograph").xy == ones).all()
    (path,) = tmp_path.glob("*.npz")
    with np.load(path) as file:
        arrays = dict(file)
    for changed in (arrays | {"xy": 2 * ones}, arrays | {"xy": ones.astype(int)},
                    {n: a for n, a in arrays.items() if n != "digest"}):  # fmt: skip
        np.savez(path, **changed)
        assert store.load_features("photograph") is None


def test_a_cell_of_a_control_table_beyond_the_limit_of_csv(tmp_path):
    path = tmp_path / "gcp.csv"
    path.write_text(f"id,X,Y,Z,image,u,v\nP,1,2,3,{'a' * 200_000},5,6\n")
    refused(read_control_measurements, path, "line 2", "field larger than field limit")


def test_a_packet_with_a_namespace_that_is_not_utf_8():
    packet = (b'<x:xmpmeta xmlns:x="\xe9"><rdf:RDF xmlns:rdf="r"><rdf:Description '
              b'xmlns:c="c" c:Yaw="10" c:Pitch="5" c:Roll="1"/></rdf:RDF></x:xmpmeta>')  # fmt: skip
    attitude = parse_xmp(packet).attitude
    assert attitude is not None and attitude.yaw == 10


@pytest.mark.parametrize("cell", [b"short", bytes(16 * 11), "text", 7, None])
def test_kept_corners_of_another_length_are_searched_again(tmp_path, cell):
    board, xy = Board(4, 3, 1.0), np.arange(24.0).reshape(12, 2)
    path = tmp_path / "kept.sqlite"
    with KeptCorners(path) as kept:
        kept.keep("content", board, ((640, 480), xy))
        assert (kept.look("content", board)[1] == xy).all()
    with sqlite3.connect(path) as file:
        file.execute("UPDATE boards SET xy = ?", (cell,))
    file.close()
    with KeptCorners(path) as kept:
        assert kept.look("content", board) is None


@pytest.mark.parametrize("model", ["[1, 2]", "{ a = 1 }", "7", "true"])
def test_a_camera_model_that_is_no_name(tmp_path, model):
    path = tmp_path / "cameras.toml"
    path.write_text(f'[[camera]]\nid = "c"\nmodel = {model}\nfx = 1.0\n')
    refused(read_cameras, path, "model")


def test_laz_of_laszip_1_is_named(tmp_path):
    """Points that are not in chunks: another form, not damage."""
    header = laspy.LasHeader(point_format=1, version="1.2")
    las = laspy.LasData(header)
    las.x = las.y = las.z = np.arange(9.0)
    path = tmp_path / "c.laz"
    las.write(path)
    data = bytearray(path.read_bytes())
    at = data.index(b"laszip encoded") + 16 + 2 + 2 + 32  # record, length, description
    assert struct.unpack_from("<H", data, at) == (2,)
    data[at : at + 2] = b"\1\0"
    path.write_bytes(data)
    with pytest.raises(InputError, match="LASzip 1, .*decompress it"):
        read_cloud(path)


def test_a_damaged_statement_of_kept_corners(tmp_path):
    """SQLite quotes it, bytes that are no text and all."""
    path = tmp_path / "kept.sqlite"
    with KeptCorners(path):
        pass
    data = path.read_bytes()
    for column in (b"path TEXT", b"size INTEGER"):  # two of one name, which the error quotes
        assert data.count(column) == 1
        data = data.replace(column, b"\xc9\xc9\xc9\xc9" + column[4:])
    path.write_bytes(data)
    with pytest.raises(InputError, match="kept.sqlite: the corners found before"):
        KeptCorners(path)


def test_a_terrain_model_of_one_column_is_named(tmp_path):
    from jaxbundle.geometry.ellipsoid import WGS84
    from jaxbundle.io.rasters.terrain_models import read_terrain

    path = tmp_path / "dem.asc"
    rows = "\n".join(map(str, range(100, 120)))
    path.write_text(
        f"ncols 1\nnrows 20\nxllcorner 13.0\nyllcorner 40.8\ncellsize 0.01\n{rows}\n"
    )
    path.with_suffix(".prj").write_text(
        'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],'
        'PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]]'
    )
    with pytest.raises(InputError, match="dem.asc: terrain: heights of shape .20, 1."):
        read_terrain(path, WGS84)
