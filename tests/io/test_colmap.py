"""COLMAP's sparse models: round trips, an independent reading, and broken files."""

import dataclasses
import struct
import sys

import numpy as np
import pytest
from exchange_cases import POINTS, assert_same, network
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from jaxbundle.cameras import get_model
from jaxbundle.cameras.convert_fit import images_of
from jaxbundle.errors import InputError
from jaxbundle.io.networks.assemble import all_parameters
from jaxbundle.io.networks.colmap import (
    is_colmap,
    read_colmap,
    read_colmap_cameras,
    write_colmap,
)
from jaxbundle.io.networks.colmap_model import find_rows
from jaxbundle.io.networks.colmap_models import MODELS, from_colmap, to_colmap
from jaxbundle.io.text import rows
from jaxbundle.network import Camera
from jaxbundle.network.tables import Observations

FILES = {
    "cameras.txt": "# Camera list\n1 SIMPLE_RADIAL 640 480 500 320 240 -0.1\n"
    "7 OPENCV_FISHEYE 640 480 300 301 320 240 0.1 0.01 0 0\n",
    "images.txt": "# Image list\n"
    "1 1 0 0 0 0.5 -0.25 4 1 left.jpg\n345.5 214.5 58396 100 100 -1 420.5 240.5 59027\n"
    "2 0 1 0 0 0 0 4 7 right.jpg\n\n",
    "points3D.txt": "58396 0 0 0 115 121 122 1.3 1 0\n59027 1 0.25 0 115 121 122 1.3 1 2\n",
}


@pytest.fixture
def folder(tmp_path):
    made = tmp_path / "sparse"
    made.mkdir()
    for name, text in FILES.items():
        (made / name).write_text(text)
    return made


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("model", ["opencv", "kannala-brandt"])
def test_round_trip(tmp_path, model, text):
    before = network(model, ("a.jpg", "b.jpg", "c.jpg"))
    lost = write_colmap(before, tmp_path, text)
    assert lost == ("pixel sizes of cameras (1)",) * (model == "opencv")
    assert is_colmap(tmp_path)
    assert {p.suffix for p in tmp_path.iterdir()} - {""} == {".txt" if text else ".bin"}
    after = read_colmap(tmp_path)
    assert_same(before, after)
    assert after.cameras[0].image_size == (1280, 720)
    write_colmap(after, tmp_path, not text)
    assert {p.suffix for p in tmp_path.iterdir()} - {""} == {".bin" if text else ".txt"}
    assert_same(before, read_colmap(tmp_path))


def test_the_text_says_what_colmap_means(tmp_path):
    """The pinhole formula of COLMAP's documentation, applied to the numbers of the files."""
    before = network("opencv")
    write_colmap(before, tmp_path, text=True)
    lines = lambda name: [
        line.split() for line in (tmp_path / name).read_text().splitlines() if line[:1] != "#"
    ]
    ((_, model, width, height, *values),) = lines("cameras.txt")
    assert (model, width, height) == ("OPENCV", "1280", "720")
    fx, fy, cx, cy, k1, k2, p1, p2 = map(float, values)
    assert (cx, cy) == (641.5, 359.0)
    points = {row[0]: np.array(row[1:4], float) for row in lines("points3D.txt")}
    images = lines("images.txt")
    for head, observed in zip(images[::2], images[1::2]):
        qw, qx, qy, qz, *t = map(float, head[1:8])
        R = Rotation.from_quat([qx, qy, qz, qw]).as_matrix()
        for u, v, point in zip(observed[::3], observed[1::3], observed[2::3]):
            X, Y, Z = R @ points[point] + t
            assert Z > 0
            x, y = X / Z, Y / Z
            r2 = x * x + y * y
            radial = 1 + k1 * r2 + k2 * r2**2
            xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
            yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
            assert_allclose((fx * xd + cx, fy * yd + cy), (float(u), float(v)), atol=1e-9)


def test_tracks_point_at_image_points(tmp_path):
    write_colmap(network("opencv"), tmp_path)
    data = (tmp_path / "points3D.bin").read_bytes()
    (count,), position = struct.unpack_from("<Q", data), 8
    assert count == len(POINTS)
    rays = 0
    for _ in range(count):
        id, *_, n = struct.unpack_from("<Q3d3BdQ", data, position)
        position += struct.calcsize("<Q3d3BdQ")
        track = struct.unpack_from(f"<{2 * n}I", data, position)
        position += 8 * n
        assert list(track[::2]) == [i for i in (1, 2, 3) if (i, id) not in ((1, 4), (3, 8))]
        rays += n
    assert rays == 34 and position == len(data)


def test_a_written_example(folder):
    net = read_colmap(folder)
    assert net.images.id == ("left.jpg", "right.jpg") and net.points.id == ("58396", "59027")
    radial, fisheye = net.cameras
    assert radial.parameters == dict(fx=500, fy=500, cx=319.5, cy=239.5, k1=-0.1)
    assert fisheye.model == "kannala-brandt" and fisheye.parameters["k2"] == 0.01
    assert len(net.observations) == 2
    assert_allclose(net.observations.xy[0], (345, 214))
    assert_allclose(net.images.position[0], (-0.5, 0.25, -4))
    assert_allclose(net.images.position[1], (0, 0, 4), atol=1e-15)
    assert_allclose(net.images.angles[1], 0, atol=1e-15)  # turned by 180° about x: looks down
    assert read_colmap_cameras(folder / "cameras.txt") == net.cameras


@pytest.mark.parametrize("model", MODELS)
def test_every_model_we_have_comes_back(model):
    _, _, names = MODELS[model]
    if model == "EQUIRECTANGULAR":
        return  # below
    sizes = {"f": 500.0, "fx": 500.0, "fy": 510.0, "cx": 320.5, "cy": 240.5}
    values = [sizes.get(name, 0.01 * (k + 1)) for k, name in enumerate(names)]
    camera = from_colmap("1", model, (640, 480), values)
    assert to_colmap(camera) == (model, pytest.approx(values, rel=1e-15))


def test_what_colmap_cannot_express():
    size = dict(image_size=(640, 480))
    with pytest.raises(InputError, match="no model 'brown'.*--model opencv"):
        to_colmap(Camera("c", "brown", {"c": 5.0}, **size))
    with pytest.raises(InputError, match="needs the image size"):
        to_colmap(Camera("c", "opencv", {"fx": 5.0, "fy": 5.0}))
    with pytest.raises(InputError, match="no thin prism"):
        to_colmap(Camera("c", "opencv", {"fx": 5.0, "fy": 5.0, "s1": 1e-3}, **size))


def test_names_with_blanks(tmp_path):
    before = network("opencv", ("a 1", "b", "c"))
    write_colmap(before, tmp_path / "binary")
    assert_same(before, read_colmap(tmp_path / "binary"))
    with pytest.raises(InputError, match="image 'a 1': names in COLMAP's text files have no"):
        write_colmap(before, tmp_path / "text", text=True)
    assert not (tmp_path / "text").exists()


def test_what_is_lost_is_told(tmp_path):
    before = network("opencv", ("a", "b", "c"))
    points = before.points
    changed = before.replace(points=type(points)(
        ("x", *points.id[1:]), ("fixed", *points.role[1:]), points.position, points.sigma
    ))  # fmt: skip
    lost = write_colmap(changed, tmp_path)
    assert {"names of points (1)", "roles of points (1)"} <= {*lost}


def of_fov(x, y, w):
    r = np.hypot(x, y)
    return [v * np.arctan(2 * r * np.tan(w / 2)) / w / r for v in (x, y)]


def of_eucm(x, y, alpha, beta):
    d = alpha * np.sqrt(beta * (x**2 + y**2) + 1) + 1 - alpha
    return x / d, y / d


def of_division(x, y, k):
    """The distorted point whose undistorted one, x_d/(1 + k·r_d²), is given (Fitzgibbon 2001)."""
    r = np.hypot(x, y)
    rd = np.array([min(np.roots([k * a, -1, a]), key=abs) for a in r]).real
    return x * rd / r, y * rd / r


def of_aria(x, y, k0, k1, k2, k3, k4, k5, p0, p1, s0, s1, s2, s3):
    t = np.arctan(np.hypot(x, y))
    t = t * (1 + k0 * t**2 + k1 * t**4 + k2 * t**6 + k3 * t**8 + k4 * t**10 + k5 * t**12)
    x, y = t * x / np.hypot(x, y), t * y / np.hypot(x, y)
    r2, p = x**2 + y**2, np.array([p0, p1])
    along = 2 * (p[0] * x + p[1] * y)
    return (x + along * x + p0 * r2 + s0 * r2 + s1 * r2**2,
            y + along * y + p1 * r2 + s2 * r2 + s3 * r2**2)  # fmt: skip


OURS = {
    "FOV": ((500, 505, 320, 240, 0.9), of_fov, "fov"),
    "SIMPLE_DIVISION": ((500, 320, 240, -0.2), of_division, "division"),
    "EUCM": ((400, 402, 321, 239, 0.6, 1.1), of_eucm, "eucm"),
    "RAD_TAN_THIN_PRISM_FISHEYE": ((300, 301, 320, 240, 0.1, 0.01, -0.02, 0, 1e-3, 0, 1e-3, -5e-4,
                                    2e-4, 0, -3e-4, 1e-4), of_aria, "rad-tan-thin-prism-fisheye"),
}  # fmt: skip


@pytest.mark.parametrize("model", OURS)
def test_models_are_those_of_their_papers(folder, model):
    """Rays over the image, by formulas of the papers."""
    values, formula, ours = OURS[model]
    line = f"{model} 640 480 {' '.join(map(str, values))}"
    text = FILES["cameras.txt"].replace("SIMPLE_RADIAL 640 480 500 320 240 -0.1", line)
    (folder / "cameras.txt").write_text(text)
    camera = next(c for c in read_colmap(folder).cameras if c.id == "1")
    assert camera.model == ours
    n = 1 if model == "SIMPLE_DIVISION" else 2
    f, c, own = values[:n], values[n : n + 2], values[n + 2 :]
    x, y = (g.ravel() for g in np.meshgrid(np.linspace(-1.4, 1.4, 60), np.linspace(-1, 1, 60)))
    xd, yd = formula(x, y, *own)
    uv = np.stack([xd * f[0] + c[0], yd * f[-1] + c[1]], 1) - 0.5
    rays = np.stack([x, -y, -np.ones_like(x)], 1)
    found = images_of(get_model(camera.model), all_parameters(camera), rays)
    np.testing.assert_allclose(found, uv, atol=1e-8)


def test_a_panorama(tmp_path):
    """x = (λ/2π + ½)·w, y = (½ − φ/π)·h from the corner, φ upwards (COLMAP)."""
    (tmp_path / "cameras.txt").write_text("1 EQUIRECTANGULAR 1000 500 1000 500\n")
    (camera,) = read_colmap_cameras(tmp_path / "cameras.txt")
    longitude, latitude = 0.7, 0.3
    ray = [np.cos(latitude) * np.sin(longitude), np.sin(latitude),
           -np.cos(latitude) * np.cos(longitude)]  # fmt: skip
    found = images_of(get_model(camera.model), camera.parameters, np.array([ray]))
    expected = [(longitude / (2 * np.pi) + 0.5) * 1000, (0.5 - latitude / np.pi) * 500]
    np.testing.assert_allclose(found[0] + 0.5, expected)
    assert to_colmap(camera) == ("EQUIRECTANGULAR", [1000.0, 500.0])
    with pytest.raises(InputError, match="whole panoramas only"):
        to_colmap(dataclasses.replace(camera, image_size=(900, 500)))


def test_a_field_of_view_of_0_is_perspective(tmp_path):
    (tmp_path / "cameras.txt").write_text("1 FOV 640 480 500 505 320 240 0\n")
    (camera,) = read_colmap_cameras(tmp_path / "cameras.txt")
    assert camera.model == "opencv"
    assert camera.parameters == dict(fx=500, fy=505, cx=319.5, cy=239.5)


BROKEN = {
    "unknown model": ("cameras.txt", "SIMPLE_RADIAL", "FISHY", "line 2: the camera model FISHY is"),
    "too few parameters": ("cameras.txt", " -0.1\n", "\n", "3 values where 4 are expected"),
    "too many": ("cameras.txt", "-0.1\n", "-0.1 7\n", "5 values where 4"),
    "focal": ("cameras.txt", " 500 ", " -500 ", "fx must be positive"),
    "size": ("cameras.txt", "1 SIMPLE_RADIAL 640", "1 SIMPLE_RADIAL 0", "WIDTH is '0'"),
    "twice": ("cameras.txt", "\n7 ", "\n1 ", "camera 1 occurs twice"),
    "NaN pose": ("images.txt", "0.5 -0.25", "nan -0.25", "line 2: TX is 'nan'"),
    "zero quaternion": ("images.txt", "1 1 0 0 0 ", "1 0 0 0 0 ", "quaternion is 0"),
    "unknown camera": ("images.txt", "4 1 left", "4 5 left", "the camera 5, which is not in"),
    "unknown point": ("images.txt", "59027", "59028", "the object point 59028 is not in points3D"),
    "cut line": ("images.txt", " 420.5 240.5 59027", " 420.5 240.5", "8 numbers; expected X, Y, "),
    "cut head": ("images.txt", " 4 7 right.jpg", "", "image is expected: IMAGE_ID"),
    "same image": ("images.txt", "\n2 0 1", "\n1 0 1", "image 1 occurs twice"),
    "same name": ("images.txt", "right", "left", "two images are called 'left.jpg'"),
    "text": ("points3D.txt", "0.25", "O.25", "line 2: Y is 'O.25'"),
    "unknown image": ("points3D.txt", "1.3 1 2", "1.3 9 2", "the image 9 of the track"),
    "half track": ("points3D.txt", "1.3 1 2", "1.3 1", "without its POINT2D_IDX"),
    "same point": ("points3D.txt", "58396", "59027", "point 59027 occurs twice"),
    "binary": ("images.txt", "left", "\udcff", "not UTF-8"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_text(folder, name):
    file, old, new, message = BROKEN[name]
    text = (folder / file).read_text()
    assert old in text
    changed = text.replace(old, new, 1)
    (folder / file).write_bytes(changed.encode("utf-8", "surrogateescape"))
    with pytest.raises(InputError, match=message) as caught:
        read_colmap(folder)
    assert str(folder) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("part", ["cameras", "images", "points3D"])
def test_a_binary_file_cut_anywhere(tmp_path, part):
    write_colmap(network("opencv"), tmp_path)
    path = tmp_path / f"{part}.bin"
    data = path.read_bytes()
    for size in [0, 7, 8, 20, *np.linspace(30, len(data) - 1, 12).astype(int)]:
        path.write_bytes(data[:size])
        with pytest.raises(InputError, match=f"{part}.bin, .*(truncated|bytes follow)"):
            read_colmap(tmp_path)
    path.write_bytes(data + b"x")
    with pytest.raises(InputError, match="1 bytes follow the last entry"):
        read_colmap(tmp_path)


@pytest.mark.parametrize(
    "part, position, bytes_, message",
    [
        ("points3D", 0, struct.pack("<Q", 10**18), f"{10**18} points are announced"),
        ("images", 0, struct.pack("<Q", 2**63), "images are announced"),
        ("images", 8 + 64 + 2, struct.pack("<Q", 10**18), f"image 1: {10**18} image points"),
        ("images", 12, struct.pack("<d", np.nan), "image 1: pose: nan"),
        ("images", 8 + 64, b"\xff", "not UTF-8"),
        ("cameras", 12, struct.pack("<i", 99), "number 99 is unknown"),
        ("cameras", 16, struct.pack("<Q", 2**60), "image size"),
        ("points3D", 8, struct.pack("<Q", 2**64 - 5), "point 1: its number"),
    ],
)
def test_hostile_bytes(tmp_path, part, position, bytes_, message):
    write_colmap(network("opencv"), tmp_path)
    path = tmp_path / f"{part}.bin"
    data = bytearray(path.read_bytes())
    data[position : position + len(bytes_)] = bytes_
    path.write_bytes(data)
    with pytest.raises(InputError, match=message):
        read_colmap(tmp_path)


def test_missing_files(tmp_path, folder):
    (folder / "points3D.txt").unlink()
    with pytest.raises(InputError, match="points3D.txt: no such file"):
        read_colmap(folder)
    with pytest.raises(InputError, match="no cameras.bin or cameras.txt"):
        read_colmap(tmp_path)


RIGS = "# Rig list\n4 3 CAMERA 1 CAMERA 7 1 1 0 0 0 0.1 0 0 IMU 2 0\n"
FRAMES = "# Frame list\n9 4 1 0 0 0 0.5 -0.25 4 3 CAMERA 1 1 CAMERA 7 2 IMU 2 5\n"


def binary_rigs(folder):
    """The same by the layout of COLMAP's writer."""
    pose = struct.pack("<7d", 1, 0, 0, 0, 0.1, 0, 0)
    rigs = struct.pack("<QIIiI", 1, 4, 3, 0, 1) + struct.pack("<iIB", 0, 7, 1) + pose
    (folder / "rigs.bin").write_bytes(rigs + struct.pack("<iIB", 1, 2, 0))
    frames = struct.pack("<QII7dI", 1, 9, 4, 1, 0, 0, 0, 0.5, -0.25, 4, 3)
    data = [(0, 1, 1), (0, 7, 2), (1, 2, 5)]
    (folder / "frames.bin").write_bytes(frames + b"".join(struct.pack("<iIQ", *d) for d in data))


@pytest.mark.parametrize("binary", [False, True])
def test_frames_are_epochs_of_a_rig(folder, tmp_path, binary):
    if binary:
        write_colmap(read_colmap(folder), tmp_path / "binary")
        folder = tmp_path / "binary"
        binary_rigs(folder)
    else:
        (folder / "rigs.txt").write_text(RIGS)
        (folder / "frames.txt").write_text(FRAMES)
    net = read_colmap(folder)
    (rigs,) = net.further
    assert (rigs.rig, rigs.epoch) == (("4", "4"), ("9", "9"))
    assert set(rigs.image) == {"left.jpg", "right.jpg"}


@pytest.mark.parametrize("name, old, new, message", [
    ("frames.txt", "9 4", "9 5", "frames.txt, line 2: rig 5 is not in rigs.txt"),
    ("frames.txt", "CAMERA 7 2", "CAMERA 7 1", "line 2: image 1 is in frame 9 as well"),
    ("frames.txt", "4 3 CAMERA", "4 4 CAMERA", "line 2: the line ends; expected SENSOR_TYPE"),
    ("frames.txt", "IMU 2 5", "IMU 2 5 1", "line 2: 1 values after the last"),
    ("rigs.txt", "IMU 2 0", "IMU 2 1", "rigs.txt, line 2: "),
    ("rigs.txt", "4 3", "4 x", "line 2: NUM_SENSORS is 'x'"),
])  # fmt: skip
def test_broken_rigs(folder, name, old, new, message):
    (folder / "rigs.txt").write_text(RIGS)
    with pytest.raises(InputError, match="frames.txt: no such file"):
        read_colmap(folder)
    (folder / "frames.txt").write_text(FRAMES)
    text = (folder / name).read_text()
    assert old in text
    (folder / name).write_text(text.replace(old, new))
    with pytest.raises(InputError, match=message):
        read_colmap(folder)


@pytest.mark.parametrize("name", ["rigs.bin", "frames.bin"])
def test_cut_rigs(folder, tmp_path, name):
    write_colmap(read_colmap(folder), tmp_path / "binary")
    binary_rigs(tmp_path / "binary")
    path = tmp_path / "binary" / name
    content = path.read_bytes()
    for cut in (content[:-1], content[:9], content + b"0", b"\xff" * 8 + content[8:]):
        path.write_bytes(cut)
        with pytest.raises(InputError, match=name):
            read_colmap(tmp_path / "binary")


def test_points_in_any_order(tmp_path):
    """COLMAP writes them by number, older versions in no order; with gaps between their numbers."""
    for name in ("sorted", "shuffled"):
        write_colmap(network("opencv"), tmp_path / name)
    path = tmp_path / "shuffled" / "points3D.bin"
    data, position, rows = path.read_bytes(), 8, []
    while position < len(data):
        size = struct.calcsize("<Q3d3BdQ")
        end = position + size + 8 * struct.unpack_from("<Q", data, position + size - 8)[0]
        rows.append(data[position:end])
        position = end
    path.write_bytes(data[:8] + b"".join(rows[k] for k in [5, 0, 11, *range(1, 5), *range(6, 11)]))
    first, other = (read_colmap(tmp_path / name) for name in ("sorted", "shuffled"))
    assert other.points.id[:3] == ("6", "1", "12")
    row = [other.points.id.index(id) for id in first.points.id]
    np.testing.assert_array_equal(other.points.position[row], first.points.position)
    names = lambda net: sorted(
        (net.images.id[i], net.points.id[p], *xy)
        for i, p, xy in zip(net.observations.image, net.observations.point, net.observations.xy)
    )
    assert names(first) == names(other)


@pytest.mark.parametrize("ids", [[4, 2, 9, 0], [10**12, 7, 8, 3], []])
def test_rows_of_numbers(ids):
    wanted = np.array([2, 9, -5, 10**15, 7, 10**12, 0])
    expected = [ids.index(k) if k in ids else -1 for k in wanted.tolist()]
    assert find_rows(np.array(ids, np.int64), wanted).tolist() == expected


@pytest.mark.parametrize("arrow", [True, False])
def test_numbers_of_a_long_text(monkeypatch, arrow):
    """pyarrow, where it is installed, and NumPy read the same bits, and refuse the same."""
    if not arrow:
        monkeypatch.setitem(sys.modules, "pyarrow", None)
    monkeypatch.setattr(rows, "LONG_TEXT", 0)
    values = np.random.default_rng(3).normal(size=500) * 10.0 ** np.arange(-250, 250)
    words = [*map(repr, values.tolist()), "5.", ".5", "-1E+3", "+7", "5e-324"]
    text = "".join(word + blank for word, blank in zip(words, [" ", "\n", "\t", "  \n\n "] * 200))
    assert (rows.parse_numbers(text) == [float(word) for word in words]).all()
    lines = [" ".join(words[:7]), "", words[9]]
    parsed = rows.parse_lines(lines)
    assert [len(row) for row in parsed] == [7, 0, 1] and parsed[2][0] == values[9]
    for wrong in ("1_0", "3x", "1,5", "0x10", "1-2", "1.5.2", "1d3", "--1", "1e5e", "ä"):
        with pytest.raises(ValueError):
            rows.parse_numbers(f"1 {wrong} 2")
        assert rows.parse_lines(["1", f"2 {wrong}"]) is None
    for unlike in ("nan", "inf"):
        assert rows.parse_lines(["1", f"2 {unlike}"]) is None


@pytest.mark.parametrize("gaps", [False, True])
def test_points_without_image_points(tmp_path, gaps):
    """Where a point of points3D.bin begins follows from the images, or from the points before."""
    before = network("opencv")
    if gaps:
        ids = tuple(str(100 + 7 * k) for k in range(len(before.points)))
        before = before.replace(points=dataclasses.replace(before.points, id=ids))
    rays = before.observations
    seen = ~np.isin(rays.point, [2, len(before.points) - 1])
    fewer = {name: getattr(rays, name)[seen] for name in ("image", "point", "xy", "sigma")}
    before = before.replace(observations=Observations(**fewer))
    write_colmap(before, tmp_path)
    after = read_colmap(tmp_path)
    assert after.points.id == before.points.id and len(after.observations) == seen.sum()
    np.testing.assert_array_equal(after.points.position, before.points.position)
    np.testing.assert_array_equal(after.observations.point, fewer["point"])
