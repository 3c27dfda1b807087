"""Metashape's camera XML: the published formula, the chunk's transform, and broken files."""

import re

import numpy as np
import pytest
from exchange_cases import ANGLES, POINTS, POSITION, matrix
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from jaxbundle.cameras import default_parameters, get_model
from jaxbundle.cameras.convert_fit import images_of
from jaxbundle.errors import InputError
from jaxbundle.io.assemble import all_parameters
from jaxbundle.io.metashape import is_metashape, read_metashape

P = dict(f=1000.0, cx=3.5, cy=-2.25, k1=-0.1, k2=0.02, k3=0.001, p1=1e-3, p2=-5e-4, b1=1.5)
SCALE, SHIFT = 2.5, np.array([100.0, 200.0, 300.0])
TURN = Rotation.from_euler("xyz", [0.3, -0.2, 0.7]).as_matrix()


def published(X, Y, Z):
    """u, v from the corner of the first pixel, as the manual has it."""
    x, y = X / Z, Y / Z
    r2 = x * x + y * y
    radial = 1 + P["k1"] * r2 + P["k2"] * r2**2 + P["k3"] * r2**3
    xd = x * radial + P["p1"] * (r2 + 2 * x * x) + 2 * P["p2"] * x * y
    yd = y * radial + P["p2"] * (r2 + 2 * y * y) + 2 * P["p1"] * x * y
    return 640 + P["cx"] + xd * (P["f"] + P["b1"]), 360 + P["cy"] + yd * P["f"]


def xml(transform=False, more="", sensor='type="frame"', extra_calibration="") -> str:
    """The three images of `exchange_cases`, as a chunk with or without a transform."""
    text = lambda values: " ".join(repr(float(v)) for v in np.ravel(values))
    calibration = "".join(f"<{k}>{v!r}</{k}>" for k, v in P.items()) + extra_calibration
    cameras = ""
    for i, label in enumerate(["a", "b", "a"]):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = matrix(ANGLES[i]).T * [1, -1, -1], POSITION[i]
        if transform:
            T[:3, :3], T[:3, 3] = TURN.T @ T[:3, :3], TURN.T @ (T[:3, 3] - SHIFT) / SCALE
        camera = (f'<camera id="{i}" sensor_id="0" label="{label}">'
                  f"<transform>{text(T)}</transform></camera>")  # fmt: skip
        cameras += f"<group>{camera}</group>" if i == 2 else camera
    world = (f"<transform><rotation>{text(TURN)}</rotation><translation>{text(SHIFT)}"
             f"</translation><scale>{SCALE}</scale></transform>")  # fmt: skip
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<document version="2.0.0"><chunk label="c" enabled="true">
<sensors><sensor id="0" label="cam" {sensor}><resolution width="1280" height="720"/>
<calibration type="frame" class="initial"><f>1</f></calibration>
<calibration type="frame" class="adjusted"><resolution width="1280" height="720"/>{calibration}
</calibration></sensor></sensors>
<cameras>{cameras}<camera id="8" sensor_id="0" label="not aligned"/>
<camera id="9" sensor_id="0" label="off" enabled="false"><transform>1</transform></camera></cameras>
{world if transform else ""}{more}</chunk></document>"""


def read(tmp_path, text):
    path = tmp_path / "cameras.xml"
    path.write_text(text)
    return read_metashape(path)


@pytest.mark.parametrize("transform", [False, True])
def test_cameras_and_orientations(tmp_path, transform):
    net = read(tmp_path, xml(transform))
    assert net.images.id == ("a#0", "b", "a#2")
    assert_allclose(net.images.position, POSITION, atol=1e-11)
    for mine, given in zip(net.images.angles, ANGLES):
        assert_allclose(matrix(mine), matrix(given), atol=1e-12)
    (camera,) = net.cameras
    values = {**default_parameters(get_model("opencv")), **camera.parameters}
    assert camera.image_size == (1280, 720) and len(net.points) == 0
    rays = (POINTS - POSITION[0]) @ matrix(ANGLES[0]).T
    theirs = np.stack(published(*(rays * [1, -1, -1]).T), 1) - 0.5
    assert_allclose(images_of(get_model("opencv"), values, rays), theirs, atol=1e-10)
    assert "not aligned" in net.warnings[-1] and "off" in net.warnings[-1]
    assert "no image points" in net.warnings[0]


def test_markers(tmp_path):
    more = """<markers><marker id="0" label="M1"/><marker id="1" label="M2"/></markers>
    <frames><frame id="0"><markers><marker marker_id="0"><location camera_id="0" x="10" y="20.5"/>
    <location camera_id="2" x="30" y="40"/><location camera_id="9" x="1" y="1"/></marker>
    <marker marker_id="1"><location camera_id="1" x="5" y="6"/></marker></markers></frame></frames>
    """
    net = read(tmp_path, xml(more=more))
    assert net.points.id == ("M1", "M2") and np.isnan(net.points.position).all()
    assert_allclose(net.observations.xy, [[9.5, 20], [29.5, 39.5], [4.5, 5.5]])
    assert [net.images.id[i] for i in net.observations.image] == ["a#0", "a#2", "b"]


PIXEL = ('<property name="pixel_width" value="0.005"/><property name="pixel_height" value="0.005"/>'
         "<calibration")  # fmt: skip


def test_a_skew_is_fitted(tmp_path):
    text = xml().replace("<b1>", "<b2>2.5</b2><b1>").replace("<calibration", PIXEL, 1)
    net = read(tmp_path, text)
    (camera,) = net.cameras
    assert camera.model == "brown-projected" and camera.pixel_size == (0.005, 0.005)
    told = float(re.search(r"brown-projected, largest difference (\S+) px", net.warnings[-2])[1])
    assert told <= 0.05
    rays = (POINTS - POSITION[0]) @ matrix(ANGLES[0]).T
    X, Y, Z = (rays * [1, -1, -1]).T
    u, v = published(X, Y, Z)
    u = u + 2.5 * (v - 360 - P["cy"]) / P["f"]
    x, y = images_of(get_model(camera.model), all_parameters(camera), rays).T
    mine = np.stack([x / 0.005 + 640, 360 - y / 0.005], 1)
    assert np.linalg.norm(mine - np.stack([u, v], 1), axis=1).max() <= 1.05 * told


BROKEN = {
    "not XML": (lambda t: t[: len(t) // 2], "not valid XML"),
    "entities": (lambda t: t.replace("<document", "<!DOCTYPE x><document", 1), "document type"),
    "no chunk": (lambda t: "<document></document>", "one <chunk>"),
    "skew": (lambda t: t.replace("<b1>", "<b2>0.1</b2><b1>"), "without the pixel size"),
    "k4": (
        lambda t: t.replace("<b1>", "<k4>-3</k4><b1>").replace("<calibration", PIXEL, 1),
        r"k4 -3 have no place.*brown-projected, differs by \d",
    ),
    "pixel": (
        lambda t: t.replace("<b1>", "<b2>1</b2><b1>").replace(
            "<calibration", PIXEL.replace("0.005", "-1"), 1
        ), "must be positive",
    ),
    "p3": (lambda t: t.replace("<b1>", "<p3>0.1</p3><b1>"), "p3 is 0.1"),
    "old": (lambda t: t.replace("<b1>", "<skew>0.1</skew><b1>"), "<skew> is of an old version"),
    "fisheye": (lambda t: t.replace('"cam" type="frame"', '"cam" type="fisheye"'), "type 'fisheye"),
    "NaN": (lambda t: t.replace("<k2>0.02", "<k2>nan"), "sensor 'cam', k2: 'nan'"),
    "focal": (lambda t: t.replace("<f>1000.0", "<f>-1000.0"), "must be positive"),
    "size": (lambda t: t.replace('width="1280"', ""), "resolution, width"),
    "sensor": (lambda t: t.replace('id="0" label="cam"', 'id="5" label="cam"'), "sensor '0' is no"),
    "short": (lambda t: t.replace("0.0 0.0 0.0 1.0</tr", "0.0 1.0</tr"), "14 numbers where 16"),
    "scaled": (lambda t: t.replace("<transform>", "<transform>9", 1), "not a rotation"),
    "none": (lambda t: t.replace("transform>", "t>"), "no camera is enabled and aligned"),
    "deep": (lambda t: "<document>" * 200_000, "not valid XML"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_files(tmp_path, name):
    change, message = BROKEN[name]
    text = change(xml())
    assert text != xml()
    with pytest.raises(InputError, match=message) as caught:
        read(tmp_path, text)
    assert "cameras.xml" in str(caught.value)


def test_recognised(tmp_path):
    path = tmp_path / "cameras.xml"
    path.write_text(xml())
    assert is_metashape(path)
    path.write_text("<opencv_storage></opencv_storage>")
    assert not is_metashape(path)
