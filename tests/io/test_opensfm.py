"""OpenSfM's reconstructions: its own formulas for one point, files by hand, there and back."""

import copy
import dataclasses
import json

import numpy as np
import pytest
from exchange_cases import ANGLES, POINTS, POSITION, assert_same, matrix, network
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import jaxbundle
from jaxbundle.cameras import get_model
from jaxbundle.cameras.convert_fit import images_of
from jaxbundle.errors import InputError
from jaxbundle.io import convert, read_cameras, read_network
from jaxbundle.io.networks.assemble import all_parameters
from jaxbundle.io.networks.losses import describe_losses
from jaxbundle.io.networks.opensfm_writing import OPENSFM_LOSSES
from jaxbundle.network.kinds import Antennas

W, H = 1280, 720
SIZE = {"width": W, "height": H}
TWO = {"focal_x": 0.78, "focal_y": 0.79, "c_x": 0.002, "c_y": -0.003}
CAMERAS = {
    "perspective": {"focal": 0.8, "k1": -0.1, "k2": 0.02},
    "simple_radial": TWO | {"k1": -0.1},
    "radial": TWO | {"k1": -0.1, "k2": 0.02},
    "brown": TWO | {"k1": -0.1, "k2": 0.02, "k3": 0.003, "p1": 1e-3, "p2": -5e-4},
    "fisheye": {"focal": 0.5, "k1": 0.05, "k2": -0.01},
    "fisheye_opencv": TWO | {"k1": 0.05, "k2": -0.01, "k3": 2e-3, "k4": -1e-3},
    "fisheye62": TWO | {"k1": 0.05, "k2": -0.01, "k5": 1e-4, "p1": 1e-3, "p2": -5e-4},
    "fisheye624": TWO | {"k1": 0.05, "k2": -0.01, "k4": 1e-4, "p1": 1e-3, "p2": -5e-4,
                         "s0": 2e-3, "s2": -1e-3},
    "spherical": {},
    "dual": {"focal": 0.8, "k1": -0.05, "k2": 0.01, "transition": 0.5},
}


def published(kind, X, Y, Z):
    """Normalised image coordinates, as the documentation has them (with 2x², 2y²)."""
    p = dict.fromkeys(("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2"), 0) | CAMERAS[kind]
    off, theta = np.hypot(X, Y), np.arctan2(np.hypot(X, Y), Z)
    x, y = X / Z, Y / Z
    if kind == "spherical":
        return np.arctan2(X, Z) / (2 * np.pi), np.arctan2(Y, np.hypot(X, Z)) / (2 * np.pi)
    if "fisheye" in kind:
        x, y = theta * X / off, theta * Y / off
    if kind == "dual":
        x, y = ((x + theta * X / off) / 2, (y + theta * Y / off) / 2)
    r2 = x * x + y * y
    d = 1 + sum(p[f"k{i}"] * r2**i for i in range(1, 7))
    xd = d * x + 2 * p["p1"] * x * y + p["p2"] * (r2 + 2 * x * x)
    yd = d * y + 2 * p["p2"] * x * y + p["p1"] * (r2 + 2 * y * y)
    xd, yd = xd + p.get("s0", 0) * r2, yd + p.get("s2", 0) * r2
    f = p.get("focal")
    return (p.get("focal_x", f) * xd + p.get("c_x", 0), p.get("focal_y", f) * yd + p.get("c_y", 0))


def in_pixels(x, y):
    return np.array([W * x + (W - 1) / 2, W * y + (H - 1) / 2])


def files(kind="brown", gps=False) -> tuple[list, str]:
    """The images and points of `exchange_cases` with another, smaller reconstruction; tracks."""
    shots, tracks = {}, ["OPENSFM_TRACKS_VERSION_v2"]
    for i, name in enumerate(("a b.jpg", "b.jpg", "c.jpg")):
        R = matrix(ANGLES[i]) * np.array([[1], [-1], [-1]])
        turn = Rotation.from_matrix(R).as_rotvec().tolist()
        shots[name] = {"camera": "v2 cam 1.5", "rotation": turn,
                       "translation": (-R @ POSITION[i]).tolist()}  # fmt: skip
        if gps:
            shots[name] |= {"gps_position": POSITION[i].tolist(), "gps_dop": 0.5}
        for k, X in enumerate(POINTS):
            x, y = published(kind, *(R @ (X - POSITION[i])))
            tracks.append(f"{name}\t{k}\t7\t{float(x)!r}\t{float(y)!r}\t0.1\t1\t2\t3\t-1\t-1")
    tracks.append("b.jpg\t99\t7\t0.0\t0.0\t0.1\t1\t2\t3\t-1\t-1")
    tracks.append("not oriented.jpg\t1\t7\t0.0\t0.0\t0.1\t1\t2\t3\t-1\t-1")
    scene = {
        "cameras": {"v2 cam 1.5": {"projection_type": kind, **SIZE, **CAMERAS[kind]}},
        "shots": shots, "points": {str(k): {"coordinates": X.tolist(), "color": [0, 0, 0]}
                                   for k, X in enumerate(POINTS)},
    }  # fmt: skip
    other = {"cameras": scene["cameras"], "shots": {"d.jpg": shots["b.jpg"]}, "points": {}}
    return [other, scene], "\n".join(tracks) + "\n"


def write(folder, scenes, tracks):
    (folder / "reconstruction.json").write_text(json.dumps(scenes))
    (folder / "tracks.csv").write_text(tracks)


@pytest.mark.parametrize("kind", CAMERAS)
def test_the_published_formula_is_the_camera(tmp_path, kind):
    camera = {"cam": {"projection_type": kind, **SIZE, **CAMERAS[kind]}}
    (tmp_path / "camera_models.json").write_text(json.dumps(camera))
    (camera,) = read_cameras(tmp_path / "camera_models.json")
    ray = np.array([0.2, -0.3, -1.1])
    found = images_of(get_model(camera.model), all_parameters(camera), ray[None])[0]
    fitted = getattr(camera, "message", "")
    limit = float(fitted.partition("difference ")[2].split()[0]) if fitted else 1e-9
    assert bool(fitted) == (kind in ("fisheye62", "dual")) and limit < 1
    assert_allclose(found, in_pixels(*published(kind, ray[0], -ray[1], -ray[2])), atol=limit)


def test_a_reconstruction(tmp_path):
    write(tmp_path, *files(gps=True))
    reference = {"latitude": 52.5, "longitude": 13.4, "altitude": 34.0}
    (tmp_path / "reference_lla.json").write_text(json.dumps(reference))
    net = read_network(tmp_path)
    assert net.images.id == ("a b.jpg", "b.jpg", "c.jpg") and net.datum == "control"
    assert_allclose(net.images.position, POSITION, atol=1e-12)
    assert_allclose([matrix(a) for a in net.images.angles], [matrix(a) for a in ANGLES], atol=1e-12)
    assert_allclose(net.points.position, POINTS, atol=1e-15)
    assert len(net.observations) == 36
    (gps,) = net.further
    assert isinstance(gps, Antennas) and np.allclose(gps.covariance, 0.25 * np.eye(3))
    told = " ".join(net.warnings)
    assert "largest of 2 reconstructions" in told and "1 image point" in told and "52.5" in told
    result = jaxbundle.adjust(net)
    assert result.converged and result.sigma0 < 1e-6


def test_positions_that_are_too_few_for_a_datum_are_told(tmp_path):
    reconstructions, tracks = files(gps=True)
    document = json.loads(json.dumps(reconstructions))
    shots = max((r["shots"] for r in document), key=len)
    del next(iter(shots.values()))["gps_position"]
    write(tmp_path, document, tracks)
    net = read_network(tmp_path)
    assert not net.further and net.datum == "inner"
    assert any("gps_position of 2 shots is not read" in told for told in net.warnings)


def test_there_and_back(tmp_path):
    net = network("opencv", ("a.jpg", "b.jpg", "c.jpg"))
    made = convert_to(net, tmp_path / "opensfm")
    assert made.lost == ("pixel sizes of cameras (1)",)
    back = read_network(tmp_path / "opensfm")
    assert_same(net, back)
    (camera,) = read_cameras(tmp_path / "opensfm" / "camera_models.json")
    assert all_parameters(camera) == pytest.approx(all_parameters(net.cameras[0]), rel=1e-13)
    write(tmp_path, *files(gps=True))
    convert(tmp_path / "reconstruction.json", tmp_path / "opensfm2")
    again = read_network(tmp_path / "opensfm2" / "reconstruction.json")
    assert_same(read_network(tmp_path), again)
    assert_allclose(again.further[0].position, POSITION, atol=1e-12)


def test_one_dop_for_axes_of_different_sigma_is_told(tmp_path):
    write(tmp_path, *files(gps=True))
    net = read_network(tmp_path)
    (gps,) = net.further
    assert not any("antennas" in told for told in describe_losses(net, OPENSFM_LOSSES))
    covariance = gps.covariance.copy()
    covariance[1] = np.diag([0.02, 0.02, 0.5]) ** 2
    net = net.replace(further=(dataclasses.replace(gps, covariance=covariance),))
    assert "antennas (1)" in describe_losses(net, OPENSFM_LOSSES)


def convert_to(net, folder):
    from jaxbundle.io import write_project

    write_project(net, folder.parent / "project")
    return convert(folder.parent / "project", folder)


def test_shots_of_a_camera_that_none_comes_near_are_left_out(tmp_path):
    scenes, tracks = files()
    folded = {"projection_type": "dual", **SIZE, "focal": 0.5, "k1": -9.0, "k2": 0.0}
    scenes[1]["cameras"]["ball"] = folded
    scenes[1]["shots"]["b.jpg"]["camera"] = "ball"
    write(tmp_path, scenes, tracks)
    net = read_network(tmp_path)
    assert net.images.id == ("a b.jpg", "c.jpg") and [c.id for c in net.cameras] == ["v2 cam 1.5"]
    assert any("turns back" in told and "'b.jpg'" in told for told in net.warnings)


BROKEN = {
    "object": (lambda s: s[1].update(shots=[1] * 9), "shots is .*; expected an object"),
    "camera": (lambda s: s[1]["shots"]["b.jpg"].update(camera="x"), "camera 'x' is not among"),
    "kind": (lambda s: s[1]["cameras"]["v2 cam 1.5"].update(projection_type="x"), "_type is x"),
    "focal": (lambda s: s[1]["cameras"]["v2 cam 1.5"].pop("focal_x"), "1.5'?, focal_x is missing|"
              "focal_x is missing"),
    "aspect": (lambda s: s[1]["cameras"]["v2 cam 1.5"].update(aspect_ratio=1.5), "_ratio 1.5 is"),
    "width": (lambda s: s[1]["cameras"]["v2 cam 1.5"].update(width=0), "width is 0; expected a"),
    "rotation": (lambda s: s[1]["shots"]["b.jpg"].update(rotation=[1, 2]), "b.jpg'?: rotation is"),
    "NaN": (lambda s: s[1]["points"]["3"].update(coordinates=[0, 1, None]), "points '3': coord"),
    "empty": (lambda s: s.clear(), "no reconstruction"),
}  # fmt: skip


@pytest.mark.parametrize("name", BROKEN)
def test_broken_reconstructions(tmp_path, name):
    change, message = BROKEN[name]
    scenes, tracks = copy.deepcopy(files())
    change(scenes)
    write(tmp_path, scenes, tracks)
    with pytest.raises(InputError, match=message) as caught:
        read_network(tmp_path)
    assert "reconstruction.json" in str(caught.value)


@pytest.mark.parametrize("old, new, message", [
    ("_v2", "_v7", "line 1: tracks of version 7"), ("\t0\t7\t", "\t0\t7\tx", "line 2: x is 'x"),
    ("\t-1\t-1\n", "\n", None), ("a b.jpg\t0\t7\t", "a b.jpg\n", "line 2: 1 columns"),
])  # fmt: skip
def test_tracks(tmp_path, old, new, message):
    scenes, tracks = files()
    write(tmp_path, scenes, tracks.replace(old, new, 1))
    if message is None:
        assert len(read_network(tmp_path).observations) == 36
        return
    with pytest.raises(InputError, match=f"tracks.csv, {message}"):
        read_network(tmp_path)


def test_ground_control_points(tmp_path):
    """Latitude and longitude by pyproj's topocentric conversion, an independent one."""
    from pyproj import Transformer

    reference = {"latitude": 47.3, "longitude": 8.5, "altitude": 400.0}
    pipeline = (
        "+proj=pipeline +step +proj=cart +ellps=WGS84 +step +proj=topocentric +ellps=WGS84 "
        f"+lon_0={reference['longitude']} +lat_0={reference['latitude']} "
        f"+h_0={reference['altitude']}"
    )
    to_local = Transformer.from_pipeline(pipeline)
    scenes, tracks = files()
    write(tmp_path, scenes, tracks)
    (tmp_path / "reference_lla.json").write_text(json.dumps(reference))
    rows = []
    for k, X in enumerate(POINTS[:4]):
        lon, lat, h = to_local.transform(*X, direction="INVERSE", radians=False)
        seen = []
        for i, name in enumerate(("a b.jpg", "b.jpg", "c.jpg", "elsewhere.jpg")):
            R = matrix(ANGLES[i % 3]) * np.array([[1], [-1], [-1]])
            projection = [*map(float, published("brown", *(R @ (X - POSITION[i % 3]))))]
            seen.append({"shot_id": name, "projection": projection})
        position = {"latitude": lat, "longitude": lon, "altitude": h}
        rows.append({"id": f"gcp{k}", "position": position, "observations": seen})
    del rows[3]["position"]
    file = tmp_path / "ground_control_points.json"
    file.write_text(json.dumps({"points": rows}))
    net = read_network(tmp_path)
    index = [net.points.id.index(f"gcp{k}") for k in range(4)]
    assert [net.points.role[k] for k in index] == ["control"] * 3 + ["tie"]
    assert_allclose(net.points.position[index[:3]], POINTS[:3], atol=1e-6)
    assert_allclose(net.points.sigma[index[0]], [0.01, 0.01, 0.1])
    assert np.isin(net.observations.point, index).sum() == 12 and net.datum == "control"
    for change, message in [
        (lambda: rows[0].update(id="gcp1"), "points.1.: the point 'gcp1' occurs twice"),
        (lambda: rows[0]["position"].update(offset=1), "unknown key 'offset'"),
        (lambda: rows[0]["position"].pop("latitude"), "position: latitude is missing"),
    ]:
        before = copy.deepcopy(rows)
        change()
        file.write_text(json.dumps({"points": rows}))
        with pytest.raises(InputError, match=f"ground_control_points.json.*{message}"):
            read_network(tmp_path)
        rows[:] = before
    # tracks and control points are numbered apart
    file.write_text(json.dumps({"points": [{**rows[0], "id": "3"}, *rows[1:]]}))
    assert "control 3" in read_network(tmp_path).points.id
    file.write_text(json.dumps({"points": rows}))
    (tmp_path / "reference_lla.json").unlink()
    net = read_network(tmp_path)
    assert any("left out" in told and "need reference_lla.json" in told for told in net.warnings)
    assert "control" not in net.points.role
