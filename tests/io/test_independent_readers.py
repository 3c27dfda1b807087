"""What writers write, read by the standard library alone and imaged by OpenCV, or by the formula of
the format's documentation: every image point is the image of its point.

The programs that can be installed read their files in `test_conversions`, `test_opencv_file`, …
"""

import ast
import json
import tomllib
import xml.etree.ElementTree as ET
from typing import NamedTuple

import cv2
import numpy as np
import pytest
from conversions import full_network, model_for, write
from exchange_cases import matrix
from scipy.spatial.transform import Rotation


class View(NamedTuple):
    """A photograph as a file has it: x = R·X + t, x right, y down, z forward; matrix and
    coefficients k1, k2, p1, p2, k3 of OpenCV; `origin`: the centre of the first pixel."""

    R: np.ndarray
    t: np.ndarray
    f: float
    c: tuple[float, float]
    D: tuple[float, ...]
    origin: float = 0.0

    def image(self, X):
        """Pixels of points."""
        K = np.array([[self.f, 0, self.c[0]], [0, self.f, self.c[1]], [0, 0, 1.0]])
        turn = Rotation.from_matrix(self.R).as_rotvec()
        uv, _ = cv2.projectPoints(np.asarray(X, float), turn, self.t, K, np.array(self.D))
        return uv[:, 0] - self.origin


def rays(net) -> dict[tuple[str, str], np.ndarray]:
    """Image points by the names of image and point."""
    o = net.observations
    ids = zip(o.image.tolist(), o.point.tolist())
    return {(net.images.id[i], net.points.id[p]): xy for (i, p), xy in zip(ids, o.xy)}


def check(net, views, atol=1e-9):
    """Every image point of a network by the views of a file."""
    assert views.keys() == {*net.images.id}
    row = {id: k for k, id in enumerate(net.points.id)}
    for (image, point), xy in rays(net).items():
        uv = views[image].image(net.points.position[row[point]][None])[0]
        np.testing.assert_allclose(uv, xy, rtol=0, atol=atol)


def openmvg(path):
    scene = json.loads(path.read_text())
    value = lambda name: {row["key"]: row["value"] for row in scene[name]}
    cameras, poses, views = value("intrinsics"), value("extrinsics"), {}
    for view in value("views").values():
        data = view["ptr_wrapper"]["data"]
        camera = cameras[data["id_intrinsic"]]["ptr_wrapper"]["data"]
        pose = poses[data["id_pose"]]
        R, C = np.array(pose["rotation"]), np.array(pose["center"])
        k1, k2, k3, t1, t2 = camera["disto_t2"]
        views[data["filename"]] = View(
            R, -R @ C, camera["focal_length"], camera["principal_point"], (k1, k2, t1, t2, k3)
        )
    return views


def opensfm(path):
    (scene,) = json.loads((path / "reconstruction.json").read_text())
    views = {}
    for name, shot in scene["shots"].items():
        p = scene["cameras"][shot["camera"]]
        s, size = max(p["width"], p["height"]), (p["width"], p["height"])
        # coordinates relative to the centre of the image, in units of its larger side
        c = [s * p[f"c_{a}"] + (n - 1) / 2 for a, n in zip("xy", size)]
        assert p["focal_x"] == p["focal_y"]
        R = Rotation.from_rotvec(shot["rotation"]).as_matrix()
        D = [p[k] for k in ("k1", "k2", "p1", "p2", "k3")]
        views[name] = View(R, np.array(shot["translation"]), s * p["focal_x"], c, D)
    return views


def transforms(path):
    views = {}
    for p in json.loads(path.read_text())["frames"]:
        T = np.array(p["transform_matrix"])
        R = np.diag([1, -1, -1]) @ T[:3, :3].T  # OpenGL: y up, looking along −z
        D = [p[k] for k in ("k1", "k2", "p1", "p2", "k3")]
        assert p["fl_x"] == p["fl_y"]
        views[p["file_path"]] = View(R, -R @ T[:3, 3], p["fl_x"], (p["cx"], p["cy"]), D, 0.5)
    return views


def mrcal(path):
    views = {}
    for file in path.iterdir():
        model = ast.literal_eval(file.read_text())
        assert model["lensmodel"] == "LENSMODEL_OPENCV4"
        fx, fy, cx, cy, *D = model["intrinsics"]
        assert fx == fy
        rt = np.array(model["extrinsics"])
        R = Rotation.from_rotvec(rt[:3]).as_matrix()
        views[file.name.removesuffix(".cameramodel")] = View(R, rt[3:], fx, (cx, cy), D)
    return views


class MicMac(NamedTuple):
    """By MicMac's documentation: the distortion in pixels, about its centre."""

    R: np.ndarray
    C: np.ndarray
    values: dict

    def image(self, X):
        v, x = self.values, (np.asarray(X) - self.C) @ self.R.T
        m = v["PP"] + v["F"] * x[:, :2] / x[:, 2:]
        d = m - v["CDist"]
        r2 = (d * d).sum(1, keepdims=True)
        radial = sum(a * r2 ** (k + 1) for k, a in enumerate(v["CoeffDist"]))
        P = np.array([v["P1"], v["P2"]]).ravel()
        return m + d * radial + P * r2 + 2 * d * (d @ P)[:, None]


def micmac(path):
    views = {}
    numbers = lambda e: np.array([float(x) for x in e.text.split()])
    for file in path.glob("Orientation-*.xml"):
        tree = ET.parse(file).getroot()
        L = np.array([numbers(tree.find(f".//L{k}")) for k in (1, 2, 3)])  # camera → world
        own = ET.parse(path / tree.findtext(".//FileInterne")).getroot()
        names = ("PP", "F", "CDist", "P1", "P2")
        values = {name: numbers(own.find(f".//{name}")) for name in names}
        values["CoeffDist"] = [float(e.text) for e in own.iterfind(".//CoeffDist")]
        name = file.name.removeprefix("Orientation-").removesuffix(".xml")
        views[name] = MicMac(L.T, numbers(tree.find(".//Centre")), values)
    return views


READ = {"openmvg": openmvg, "opensfm": opensfm, "transforms": transforms, "mrcal": mrcal,
        "micmac": micmac}  # fmt: skip


@pytest.mark.parametrize("kind", READ)
def test_image_points_are_images_of_their_points(tmp_path, kind):
    net = full_network("opencv")
    check(net, READ[kind](write(kind, net, tmp_path)[0]))


def test_points_and_image_points_of_openmvg_and_opensfm(tmp_path):
    net = full_network("opencv")
    scene = json.loads(write("openmvg", net, tmp_path)[0].read_text())
    names = {v["key"]: v["value"]["ptr_wrapper"]["data"]["filename"] for v in scene["views"]}
    points = [row["value"] for key in ("structure", "control_points") for row in scene[key]]
    found = {}
    for point in points:
        (p,) = np.flatnonzero((net.points.position == point["X"]).all(1))
        for ray in point["observations"]:
            found[names[ray["key"]], net.points.id[p]] = ray["value"]["x"]
    assert found.keys() == rays(net).keys()
    assert all(list(found[key]) == xy.tolist() for key, xy in rays(net).items())
    folder = write("opensfm", net, tmp_path)[0]
    (scene,) = json.loads((folder / "reconstruction.json").read_text())
    X = {id: point["coordinates"] for id, point in scene["points"].items()}
    assert X == dict(zip(net.points.id, net.points.position.tolist()))
    lines = (folder / "tracks.csv").read_text().splitlines()[1:]
    for image, point, _, x, y, *_ in (line.split("\t") for line in lines):
        uv = 1280 * np.array([float(x), float(y)]) + [1279 / 2, 719 / 2]
        np.testing.assert_allclose(uv, rays(net)[image, point], rtol=1e-14)
    assert len(lines) == len(net.observations)


def test_bundler(tmp_path):
    net = full_network("snavely")
    path = write("bundler", net, tmp_path)[0]
    names = (tmp_path / "list.txt").read_text().split()
    words = iter(path.read_text().split("\n", 1)[1].split())
    take = lambda n: np.array([float(next(words)) for _ in range(n)])
    cameras, points = take(2).astype(int)
    views = [(take(3), take(9).reshape(3, 3), take(3)) for _ in range(cameras)]
    seen = 0
    for p in range(points):
        X, _, (number,) = take(3), take(3), take(1)
        for view, _, x, y in take(4 * int(number)).reshape(-1, 4):
            (f, k1, k2), R, t = views[int(view)]
            P = R @ X + t
            q = -P[:2] / P[2]
            image = f * (1 + k1 * q @ q + k2 * (q @ q) ** 2) * q
            np.testing.assert_allclose(image, (x, y), atol=1e-9)
            assert rays(net)[names[int(view)], net.points.id[p]].tolist() == [x, y]
            seen += 1
    assert seen == len(net.observations) and next(words, None) is None


def test_anipose(tmp_path):
    """The second camera of a moment in the frame of the first."""
    net = full_network("opencv")
    left, right = (tomllib.loads(write("anipose", net, tmp_path)[0].read_text())[f"cam_{k}"]
                   for k in (0, 1))  # fmt: skip
    assert left["rotation"] == left["translation"] == [0, 0, 0]
    R = np.diag([1, -1, -1]) @ matrix(net.images.angles[0])
    x = (net.points.position - net.images.position[0]) @ R.T
    for camera, image in ((left, "l0.jpg"), (right, "r0.jpg")):
        turn, t = (np.array(camera[k]) for k in ("rotation", "translation"))
        K, D = np.array(camera["matrix"]), np.array(camera["distortions"])
        uv, _ = cv2.projectPoints(x, turn, t, K, D)
        expected = [rays(net)[image, id] for id in net.points.id]
        np.testing.assert_allclose(uv[:, 0], expected, rtol=0, atol=1e-9)


def test_aicon(tmp_path):
    """mm from the centre of the image, y up; c with the opposite sign, the distortion of the image
    that the collinearity equations give."""
    net = full_network(model_for("jaicov"))
    path = write("jaicov", net, tmp_path)[0]
    rows = lambda suffix: [
        line.split() for line in path.with_suffix(suffix).read_text().splitlines() if line.strip()
    ]
    interior = rows(".ior")
    cameras = {r[0]: np.array([*r[2:], *sum(interior[k + 1 : k + 4], [])], float)
               for k, r in enumerate(interior) if k % 5 == 0}  # fmt: skip
    points = {r[0]: np.array(r[1:4], float) for r in rows(".obc")}
    images = {r[0]: (cameras[r[1]], np.array(r[2:8], float)) for r in rows(".eor")}
    for image, point, x, y, *_ in rows(".phc"):
        (c, x0, y0, A1, A2, r0, A3, B1, B2, C1, C2), pose = images[image]
        X = matrix(pose[3:]) @ (points[point] - pose[:3])
        p = c * X[:2] / X[2]
        r2 = p @ p
        assert r0 == 0
        d = p * (A1 * r2 + A2 * r2**2 + A3 * r2**3)
        d += np.array([B1, B2]) * r2 + 2 * p * (p @ [B1, B2]) + [C1 * p[0] + C2 * p[1], 0]
        np.testing.assert_allclose(p + d + [x0, y0], [float(x), float(y)], atol=1e-12)
