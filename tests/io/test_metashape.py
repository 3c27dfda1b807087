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
from jaxbundle.io.networks.assemble import all_parameters
from jaxbundle.io.networks.metashape import is_metashape, read_metashape

P = dict(f=1000.0, cx=3.5, cy=-2.25, k1=-0.1, k2=0.02, k3=0.001, p1=1e-3, p2=-5e-4, b1=1.5)
SCALE, SHIFT = 2.5, np.array([100.0, 200.0, 300.0])
TURN = Rotation.from_euler("xyz", [0.3, -0.2, 0.7]).as_matrix()


def published(X, Y, Z, **more):
    """u, v from the corner of the first pixel, as the manual has it."""
    p = dict(k4=0, p3=0, p4=0, b2=0) | P | more
    x, y = X / Z, Y / Z
    r2 = x * x + y * y
    radial = 1 + p["k1"] * r2 + p["k2"] * r2**2 + p["k3"] * r2**3 + p["k4"] * r2**4
    more = 1 + p["p3"] * r2 + p["p4"] * r2**2
    xd = x * radial + (p["p1"] * (r2 + 2 * x * x) + 2 * p["p2"] * x * y) * more
    yd = y * radial + (p["p2"] * (r2 + 2 * y * y) + 2 * p["p1"] * x * y) * more
    return 640 + p["cx"] + xd * (p["f"] + p["b1"]) + yd * p["b2"], 360 + p["cy"] + yd * p["f"]


def xml(transform=False, more="", sensor='type="frame"', extra_calibration="") -> str:
    """The three images of `exchange_cases`, as a chunk with or without a transform."""
    text = lambda values: " ".join(repr(float(v)) for v in np.ravel(values))
    own = {k: v for k, v in P.items() if f"<{k}>" not in extra_calibration}
    calibration = "".join(f"<{k}>{v!r}</{k}>" for k, v in own.items()) + extra_calibration
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


def over_the_image(**more):
    """Rays (right, down, forward) whose images fill the image, and these, by the formula above."""
    x, y = np.meshgrid(np.linspace(-0.9, 0.9, 61), np.linspace(-0.6, 0.6, 41))
    rays = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], 1)
    uv = np.stack(published(*rays.T, **more), 1) - 0.5
    inside = ((uv >= -0.5) & (uv <= [1279.5, 719.5])).all(1)
    assert np.ptp(uv[inside], axis=0).min() > 700
    return rays[inside], uv[inside]


def largest_difference(camera, **more):
    rays, uv = over_the_image(**more)
    xy = images_of(get_model(camera.model), all_parameters(camera), rays * [1, -1, -1])
    if camera.model == "brown-projected":
        xy = np.stack([xy[:, 0] / 0.005 + 639.5, 359.5 - xy[:, 1] / 0.005], 1)
    return np.linalg.norm(xy - uv, axis=1).max()


FITS = {
    "skew": (dict(b2=2.5), True, "brown-projected", 0.05),
    "skew without a pixel size": (dict(b2=0.5), False, "opencv", 0.5),
    "k4": (dict(k4=0.05), False, "opencv", 0.05),
    "p3": (dict(p3=0.2), False, "opencv", 0.05),
}


@pytest.mark.parametrize("name", FITS)
def test_what_has_no_place_is_fitted_and_the_difference_told(tmp_path, name):
    more, pixel, model, limit = FITS[name]
    text = xml(extra_calibration="".join(f"<{k}>{v!r}</{k}>" for k, v in more.items()))
    net = read(tmp_path, text.replace("<calibration", PIXEL, 1) if pixel else text)
    (camera,), (key,) = net.cameras, more
    (warning,) = [w for w in net.warnings if "fitted" in w]
    assert camera.model == model and f"sensor 'cam' has {key} {more[key]:g}: fitted as" in warning
    told = float(re.search(r"largest difference (\S+) px", warning)[1])
    assert largest_difference(camera, **more) <= 1.05 * told <= limit


@pytest.mark.parametrize("extra", [
    "<k4>0</k4><p3>0</p3><p4>0.0</p4><b2>0</b2>",
    "<k4>0</k4><p3>0.2</p3><p1>0</p1><p2>0</p2>",
])  # fmt: skip
def test_parameters_that_are_0_have_no_effect(tmp_path, extra):
    """p3 and p4 are factors of p1 and p2."""
    net = read(tmp_path, xml(extra_calibration=extra))
    more = dict(p1=0, p2=0, p3=0.2) if "<p1>" in extra else {}
    assert net.cameras[0].model == "opencv" and not [w for w in net.warnings if "fitted" in w]
    assert largest_difference(net.cameras[0], **more) < 1e-9


@pytest.mark.parametrize("extra, message", [
    ("<k5>0.3</k5><k6>0</k6>", "sensor 'cam': unknown key 'k5'"),
    ("<skew>2</skew>", "sensor 'cam': skew beside f"),
    ("<p5>-1</p5>", "sensor 'cam': unknown key 'p5'"),
])  # fmt: skip
def test_coefficients_that_are_not_known_are_refused(tmp_path, extra, message):
    with pytest.raises(InputError, match=message):
        read(tmp_path, xml(extra_calibration=extra))


def test_coefficients_that_are_0_do_not_count(tmp_path):
    assert read(tmp_path, xml(extra_calibration="<k5>0</k5>")).cameras


def test_a_sphere_is_the_manuals(tmp_path):
    text = xml().replace('"cam" type="frame"', '"cam" type="spherical"')
    (camera,) = read(tmp_path, text).cameras
    X, Y, Z = 0.3, -0.2, -0.7  # right, down, forward; behind the camera
    f = 1280 / (2 * np.pi)
    u = 640 + f * np.arctan2(X, Z) - 0.5
    v = 360 + f * np.arctan2(Y, np.hypot(X, Z)) - 0.5
    found = images_of(get_model(camera.model), all_parameters(camera), np.array([[X, -Y, -Z]]))
    assert_allclose(found[0], [u, v], atol=1e-9)


def test_a_project_before_its_alignment(tmp_path):
    """Marker measurements and references are read, orientations are computed from them."""
    rays = (POINTS[:8] - POSITION[0]) @ matrix(ANGLES[0]).T * [1, -1, -1]
    marks, seen = "", ""
    for k, (X, (u, v)) in enumerate(zip(POINTS, np.stack(published(*rays.T), 1).tolist())):
        reference = " ".join(f'{axis}="{value!r}"' for axis, value in zip("xyz", X.tolist()))
        marks += f'<marker id="{k}" label="M{k}"><reference {reference} enabled="true"/></marker>'
        seen += (f'<marker marker_id="{k}"><location camera_id="0" x="{u!r}" y="{v!r}"/>'
                 "</marker>")  # fmt: skip
    more = (f"<markers>{marks}</markers><frames><frame id='0'><markers>{seen}</markers></frame>"
            "</frames>")  # fmt: skip
    text = re.sub(r"<transform>[^<]*</transform>", "", xml(more=more))
    net = read(tmp_path, text)
    assert net.images.id == ("a",) and np.isnan(net.images.position).all()
    assert net.points.has_role("control").sum() == 8 and net.datum == "control"
    assert any("not aligned: orientations" in told for told in net.warnings)
    import jaxbundle

    found = jaxbundle.orient(net).network.images
    assert_allclose(found.position[0], POSITION[0], atol=1e-5)
    # without an adjusted calibration: the focal length in mm over the pixel size
    focal = '<property name="focal_length" value="5"/>' + PIXEL
    text = re.sub("<calibration.*?</calibration>", "", text, flags=re.S)
    text = text.replace("</sensor>", focal.removesuffix("<calibration") + "</sensor>")
    assert read(tmp_path, text).cameras[0].parameters["fx"] == pytest.approx(1000)
    with pytest.raises(InputError, match="before their alignment: .*none has a measured marker"):
        read(tmp_path, text.replace("<location", "<place"))


def test_a_fisheye_is_exact(tmp_path):
    text = xml(extra_calibration="<p1>0</p1><p2>0</p2><k4>-0.0004</k4>")
    (camera,) = read(tmp_path, text.replace('type="frame"', 'type="fisheye"')).cameras
    assert camera.model == "kannala-brandt"
    theta, around = np.meshgrid([0.01, 0.5, 1.2], np.linspace(0, 6, 7))
    d = theta * (1 + sum(P.get(f"k{i}", -0.0004) * theta ** (2 * i) for i in (1, 2, 3, 4)))
    u = 640 + P["cx"] - 0.5 + d * np.cos(around) * (P["f"] + P["b1"])
    v = 360 + P["cy"] - 0.5 + d * np.sin(around) * P["f"]
    rays = np.stack([np.sin(theta) * np.cos(around), -np.sin(theta) * np.sin(around),
                     -np.cos(theta)], -1).reshape(-1, 3)  # fmt: skip
    found = images_of(get_model(camera.model), all_parameters(camera), rays)
    assert_allclose(found, np.stack([u.ravel(), v.ravel()], 1), atol=1e-9)


def test_an_old_export_is_the_same_camera(tmp_path):
    """fx, fy, skew; cx, cy from the corner; p1 and p2 exchanged."""
    old = dict(fx=1001.5, fy=1000.0, cx=643.5, cy=357.75, p1=P["p2"], p2=P["p1"], skew=0.0)
    text = re.sub(r"<(f|b1|cx|cy|p1|p2)>[^<]*</\1>", "", xml())
    text = text.replace("<k1>", "".join(f"<{k}>{v!r}</{k}>" for k, v in old.items()) + "<k1>")
    (camera,) = read(tmp_path, text).cameras
    assert largest_difference(camera) < 1e-9


def test_photographs_of_a_sensor_that_none_comes_near_are_left_out(tmp_path):
    spherical = """<sensor id="7" label="ball" type="cylindrical"><resolution width="10"
    height="5"/><calibration type="cylindrical"/></sensor>
    <sensor id="8" label="raw" type="frame"/></sensors>"""
    text = xml().replace("</sensors>", spherical)
    text = text.replace('id="1" sensor_id="0"', 'id="1" sensor_id="7"')
    net = read(tmp_path, text)
    assert net.images.id == ("a#0", "a#2") and [c.id for c in net.cameras] == ["cam"]
    (told,) = [w for w in net.warnings if "cylindrical" in w]
    assert "sensor 'ball'" in told and "left out 1 camera: 'b'" in told
    with pytest.raises(InputError, match="sensor 'ball': sensors of type 'cylindrical'"):
        read(tmp_path, text.replace('sensor_id="0"', 'sensor_id="7"'))


UNFIT = {
    "turns back": ((1280, 720), "<f>1000</f><k1>-5</k1><b2>1</b2>", "turns back inside the image"),
    "size": ((0, 720), "<f>1000</f>", "sizes and f must be positive"),
}


@pytest.mark.parametrize("name", UNFIT)
def test_a_sensor_that_cannot_be_fitted_costs_its_photographs_only(tmp_path, name):
    (w, h), calibration, why = UNFIT[name]
    sensor = (f'<sensor id="7" label="bad" type="frame"><resolution width="{w}" height="{h}"/>'
              f"<calibration>{calibration}</calibration></sensor></sensors>")  # fmt: skip
    text = xml().replace("</sensors>", sensor)
    net = read(tmp_path, text.replace('id="1" sensor_id="0"', 'id="1" sensor_id="7"'))
    assert net.images.id == ("a#0", "a#2") and [c.id for c in net.cameras] == ["cam"]
    (told,) = [w for w in net.warnings if "sensor 'bad'" in w]
    assert why in told and told.endswith("left out 1 camera: 'b'")


def with_markers(system="", enabled=("true", "1", "true", "true", "false"), transform=True):
    """Five points of `exchange_cases` as markers with references in the frame of the chunk's
    transform; a location that is not valid has no coordinates."""
    world = POINTS if transform else SCALE * POINTS @ TURN.T + SHIFT
    markers, locations = "", ""
    for k in range(5):
        x, y, z = world[k]
        sigma = 'sx="0.01" sy="0.01" sz="0.02" ' if k == 0 else ""
        markers += (f'<marker id="{k}" label="M{k}"><reference x="{x}" y="{y}" z="{z}" {sigma}'
                    f'enabled="{enabled[k]}"/></marker>')  # fmt: skip
        locations += f'<marker marker_id="{k}"><location camera_id="1" pinned="0" valid="0"/>'
        for i in (0, 2):
            ray = matrix(ANGLES[i]) @ (POINTS[k] - POSITION[i]) * [1, -1, -1]
            u, v = map(float, published(*ray))
            locations += f'<location camera_id="{i}" pinned="true" x="{u!r}" y="{v!r}"/>'
        locations += "</marker>"
    more = (f"{system}<markers>{markers}</markers><frames><frame id='0'><markers>{locations}"
            "</markers></frame></frames>")  # fmt: skip
    return xml(transform, more)


@pytest.mark.parametrize("transform", [True, False])
def test_references_of_markers_are_control(tmp_path, transform):
    """In the frame of the chunk's transform; without one a similarity takes the images there."""
    local = '<reference>LOCAL_CS["Local Coordinates (m)",UNIT["metre",1]]</reference>'
    net = read(tmp_path, with_markers(local, transform=transform))
    world = (lambda X: X) if transform else lambda X: SCALE * X @ TURN.T + SHIFT
    assert net.datum == "control" and net.points.role == ("control",) * 4 + ("check",)
    assert_allclose(net.points.position, world(POINTS[:5]), atol=1e-9)
    assert_allclose(net.points.sigma[:2], [[0.01, 0.01, 0.02], [0.005] * 3])
    assert_allclose(net.images.position, world(POSITION), rtol=1e-7)
    assert len(net.observations) == 10


def test_references_that_are_no_control(tmp_path):
    geographic = '<reference>GEOGCS["WGS 84"]</reference>'
    few = ("true", "true", "false", "false", "false")
    for text in (with_markers(geographic), with_markers(enabled=few)):
        net = read(tmp_path, text)
        assert net.datum == "inner" and set(net.points.role) == {"tie"}
        told = " ".join(net.warnings)
        assert ("not in a local system" in told) == ("GEOGCS" in text)
        assert ("a datum needs three enabled markers" in told) == ("GEOGCS" not in text)


BROKEN = {
    "not XML": (lambda t: t[: len(t) // 2], "not valid XML"),
    "entities": (
        lambda t: t.replace("<document", '<!DOCTYPE x [<!ENTITY a "b">]><document', 1), "entities"
    ),
    "no chunk": (lambda t: "<document></document>", "one <chunk>"),
    "folded": (lambda t: t.replace("<k1>-0.1", "<k4>1</k4><k1>-9"), "turns back inside the image"),
    "spherical": (
        lambda t: t.replace('"cam" type="frame"', '"cam" type="rpc"'), "type 'rpc'"
    ),
    "NaN": (lambda t: t.replace("<k2>0.02", "<k2>nan"), "sensor 'cam', k2 is 'nan'"),
    "digits": (lambda t: t.replace("<f>1000.0", "<f>1_000"), "sensor 'cam', f is '1_000'"),
    "repeated": (lambda t: t.replace("<k1>", "<f>1</f><k1>"), "sensor 'cam': <f> occurs twice"),
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
