"""Frame cameras of the Community Sensor Model: images of ground points by the formulas of usgscsm,
written here in numpy and scipy alone."""

import copy
import dataclasses
import json

import numpy as np
import pytest
from exchange_cases import matrix
from scipy.spatial.transform import Rotation

from jaxbundle.cameras import default_parameters, get_model
from jaxbundle.cameras.convert_fit import images_of
from jaxbundle.errors import InputError
from jaxbundle.io import read_network
from jaxbundle.io.networks.csm_frame import is_csm_frame, read_csm_frame
from jaxbundle.io.scanner.read import read_scanner

NOW = 1234.5


def support_data(**changes) -> dict:
    """An ISD of a camera in orbit, of every key that is understood."""
    q = lambda v: Rotation.from_rotvec(v).as_quat()[[3, 0, 1, 2]].tolist()
    row = {"ephemeris_times": [NOW], "reference_frame": 1}
    isd = {
        "isis_camera_version": 2, "name_model": "USGS_ASTRO_FRAME_SENSOR_MODEL",
        "name_sensor": "NAC", "name_platform": "Probe", "image_lines": 300, "image_samples": 400,
        "center_ephemeris_time": NOW, "radii": {"semimajor": 10.0, "semiminor": 9.0, "unit": "km"},
        "body_rotation": {**row, "quaternions": [q([0.3, -0.2, 0.7])],
                          "angular_velocities": [[0.0, 0.0, 1e-4]]},
        "instrument_pointing": {
            **row, "quaternions": [q([-0.5, 1.1, 0.2])], "angular_velocities": None,
            "constant_rotation": matrix([0.1, 0.2, -0.3]).ravel().tolist(),
        },
        "instrument_position": {**row, "positions": [[120.0, -340.0, 56.0]],
                                "velocities": [[1.0, 2.0, 3.0]]},
        "detector_sample_summing": 2, "detector_line_summing": 2,
        "focal_length_model": {"focal_length": 150.0},
        "detector_center": {"line": 312.25, "sample": 420.5},
        "starting_detector_line": 8, "starting_detector_sample": 4,
        "focal2pixel_lines": [0.5, 0.0, 40.0], "focal2pixel_samples": [-0.25, 40.0, 0.0],
        "optical_distortion": {"radial": {"coefficients": [0.0, 0.0, 0.0]}},
    }  # fmt: skip
    return isd | changes


def undistort(isd: dict, d):
    """usgscsm's removeDistortion where it is explicit."""
    ((kind, values),) = isd["optical_distortion"].items()
    k = np.r_[values["coefficients"], np.zeros(5)]
    offset = k[3:5] if kind == "cahvor" else 0
    e = d - offset
    r2 = (e * e).sum(-1, keepdims=True)
    return offset + e * (1 - (k[0] + r2 * (k[1] + r2 * k[2])))


def distort(isd: dict, u):
    """usgscsm's applyDistortion."""
    ((kind, values),) = isd["optical_distortion"].items()
    x, y = u.T
    match kind:
        case "transverse":
            terms = np.stack([x**0, x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3])
            return np.stack([np.array(values[axis]) @ terms for axis in "xy"], 1)
        case "dawnfc":
            return u * (1 + values["coefficients"][0] * (x * x + y * y))[:, None]
        case "radtan":
            f = isd["focal_length_model"]["focal_length"]
            x, y = x / f, y / f
            k1, k2, p1, p2, k3 = values["coefficients"]
            r2 = x * x + y * y
            part = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
            return f * np.stack([x * part + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                                 y * part + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], 1)  # fmt: skip
    d = u
    for _ in range(200):
        d = d + u - undistort(isd, d)
    return d


def pose(isd: dict):
    """Projection centre in metres, rotation from the camera into the body."""
    turn = lambda table: (
        Rotation.from_matrix(np.reshape(table.get("constant_rotation", np.eye(3)), (3, 3)))
        * Rotation.from_quat(np.roll(table["quaternions"][0], -1))
    )
    body = turn(isd["body_rotation"])
    X0 = 1000 * body.apply(isd["instrument_position"]["positions"][0])
    return X0, (body * turn(isd["instrument_pointing"]).inv()).as_matrix()


def ground_to_image(isd: dict, X):
    """usgscsm's groundToImage: sample, line."""
    X0, m = pose(isd)
    f = isd["focal_length_model"]["focal_length"]
    x, y, z = ((X - X0) @ m).T
    d = distort(isd, np.stack([f * x / z, f * y / z], 1))
    out = []
    for axis in ("sample", "line"):
        t = np.array(isd[f"focal2pixel_{axis}s"])
        detector = t[0] + d @ t[1:] + isd["detector_center"][axis]
        start = isd[f"starting_detector_{axis}"]
        out.append((detector - start) / isd[f"detector_{axis}_summing"])
    return np.stack(out, 1)


def ground_points(isd: dict):
    """Points whose images are about the image: from its pixels, without distortion."""
    X0, m = pose(isd)
    f = isd["focal_length_model"]["focal_length"]
    u, v = np.meshgrid(np.linspace(0, 400, 9), np.linspace(0, 300, 7))
    A = np.array([isd["focal2pixel_samples"][1:], isd["focal2pixel_lines"][1:]])
    xy = np.stack([u.ravel() * 2 - 416, v.ravel() * 2 - 304], 1) @ np.linalg.inv(A).T
    rays = np.c_[xy, np.full(len(xy), f)] @ m.T
    return X0 + np.linspace(100, 5000, len(rays))[:, None] * rays


def write(folder, isd):
    path = folder / "image_7.json"
    path.write_text(json.dumps(isd))
    return path


def images(network, X):
    """Pixels of points by the network that was read, (½, ½) in the first one."""
    camera = network.cameras[0]
    model = get_model(camera.model)
    values = {**default_parameters(model), **camera.parameters}
    rays = (X - network.images.position[0]) @ matrix(network.images.angles[0]).T
    xy = images_of(model, values, rays)
    if model.unit == "mm":
        (w, h), (pw, ph) = camera.image_size, camera.pixel_size
        xy = xy / [pw, -ph] + [(w - 1) / 2, (h - 1) / 2]
    return xy + 0.5


SWAPPED = {"focal2pixel_lines": [0.5, 40.0, 0.0], "focal2pixel_samples": [0.0, 0.0, -40.0]}
TURNED = {"focal2pixel_lines": [0.5, -0.0, -40.0], "focal2pixel_samples": [0.0, -40.0, 0.0]}
WIDE = {"focal2pixel_lines": [0.0, 0.0, 40.0], "focal2pixel_samples": [0.0, 41.0, 0.0]}
BEHIND = {"focal_length_model": {"focal_length": -150.0},
          "focal2pixel_samples": [0.0, -40.0, 0.0]}  # fmt: skip
of = lambda kind, **values: {"optical_distortion": {kind: values}}
TRANSVERSE = of("transverse", x=[0.0, 1.001, 2e-4, 1e-4, -5e-5, 2e-5, 1e-5, 0, 1e-5, 0],
                y=[0.0, 0.0, 1.0, 9e-5, 0.0, 3e-5, 0, 1e-5, 0, 1e-5])  # fmt: skip
EXACT = {
    "none": ("opencv", {}),
    "swapped": ("opencv", SWAPPED),
    "turned": ("opencv", TURNED),
    "oblong": ("opencv", WIDE),
    "behind": ("opencv", BEHIND),
    "radial": ("brown", of("radial", coefficients=[0.0, -8e-5, 1e-7])),
    "radial, swapped": ("brown", SWAPPED | of("radial", coefficients=[0.0, 8e-5])),
    "radial, linear": ("usgs", of("radial", coefficients=[-2e-3, 1e-5])),
    "radial, behind": ("usgs", BEHIND | of("radial", coefficients=[-2e-3, 1e-5])),
    "cahvor on the axis": ("brown", of("cahvor", coefficients=[0.0, 1e-5, 0, 0, 0])),
    "dawnfc": ("opencv", of("dawnfc", coefficients=[9e-6])),
    "radtan": ("opencv", of("radtan", coefficients=[-0.3, 0.5, 0.01, -0.02, 0.1])),
    "radtan, swapped": ("opencv", SWAPPED | of("radtan", coefficients=[-0.3, 0, 0.01, -0.02, 0])),
    "radtan, behind": ("opencv", BEHIND | of("radtan", coefficients=[-0.3, 0, 0.01, -0.02, 0])),
}


@pytest.mark.parametrize("name", EXACT)
def test_images_of_the_ground(name, tmp_path):
    model, changes = EXACT[name]
    isd = support_data(**changes)
    path = write(tmp_path, isd)
    assert is_csm_frame(path)
    net = read_network(path)
    assert net.cameras[0].model == model and net.warnings == () and net.object_unit == "m"
    assert net.images.id == ("image_7",) and net.cameras[0].id == "NAC"
    X = ground_points(isd)
    expected = ground_to_image(isd, X)
    assert ((expected > -40) & (expected < 440)).all()
    np.testing.assert_allclose(images(net, X), expected, atol=1e-8)


@pytest.mark.parametrize("changes", [
    TRANSVERSE, SWAPPED | TRANSVERSE, of("cahvor", coefficients=[0.0, 1e-5, 0, 1.5, -0.5]),
    of("radial", coefficients=[0.0, 1e-5]) | {"focal2pixel_samples": [0.0, 40.0, 0.2]},
])  # fmt: skip
def test_what_has_no_equal_is_fitted_and_told(changes, tmp_path):
    isd = support_data(**changes)
    net = read_csm_frame(write(tmp_path, isd))
    (told,) = net.warnings
    largest = float(told.split("largest difference ")[1].split()[0])
    assert "has the distortion" in told and largest < 1
    X = ground_points(isd)
    found, expected = images(net, X), ground_to_image(isd, X)
    inside = ((expected > 1) & (expected < [399, 299])).all(1)
    assert inside.sum() > 20
    # printed with two digits, from another grid
    assert abs(found - expected)[inside].max() < 1.2 * largest + 1e-6


def test_older_files_have_the_pose_in_the_frame_of_the_body(tmp_path):
    isd = support_data()
    X0, m = pose(isd)
    for key in ("instrument_position", "instrument_pointing", "body_rotation"):
        del isd[key]
    isd["sensor_position"] = {"positions": [(X0 / 1000).tolist()], "unit": "km"}
    isd["sensor_orientation"] = {"quaternions": [Rotation.from_matrix(m).as_quat().tolist()]}
    net = read_csm_frame(write(tmp_path, isd))
    again = read_csm_frame(write(tmp_path, support_data()))
    np.testing.assert_allclose(net.images.position, again.images.position, rtol=1e-14)
    np.testing.assert_allclose(net.images.angles, again.images.angles, atol=1e-14)


def test_tables_are_read_at_the_centre_time(tmp_path):
    isd = support_data()
    velocity = np.array(isd["instrument_position"]["velocities"][0])
    middle = np.array(isd["instrument_position"]["positions"][0])
    isd["instrument_position"] = {
        "ephemeris_times": [NOW - 2, NOW + 2], "velocities": [velocity.tolist()] * 2,
        "positions": [(middle - 2 * velocity).tolist(), (middle + 2 * velocity).tolist()],
    }  # fmt: skip
    net = read_csm_frame(write(tmp_path, isd))
    again = read_csm_frame(write(tmp_path, support_data()))
    np.testing.assert_allclose(net.images.position, again.images.position, rtol=1e-14)


REFUSED = {
    "legendre": (of("legendre", coefficients=[1.0]), "'legendre' of a frame camera is not"),
    "lunarorbiter": (of("lunarorbiter", coefficients=[1.0]), "'lunarorbiter' of a frame"),
    "mirror": ({"focal2pixel_lines": [0, 0, -40.0]}, "mirror image"),
    "summing": ({"detector_line_summing": 0}, "summing above 0"),
    "focal length": ({"focal_length_model": {}}, "focal_length_model.focal_length is missing"),
    "dependent": ({"focal2pixel_lines": [0, 40.0, 0]}, "are dependent"),
    "jitter": ({"jitter": {"lineJitterCoefficients": [1.0]}}, "jitter"),
    "crop": ({"geotransform": [100.0, 1, 0, 0, 0, 1]}, "whole raw image"),
    "two kinds": ({"optical_distortion": {"radial": {}, "dawnfc": {}}}, "expected one kind"),
    "too many": (of("radial", coefficients=[0, 0, 0, 1e-9]), "at most 3 coefficients"),
    "pointing": ({"instrument_pointing": {}}, "instrument_pointing.ephemeris_times is missing"),
    "key": ({"lens_offset": 1}, "unknown key 'lens_offset'"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_refused_by_name(name, tmp_path):
    changes, message = REFUSED[name]
    with pytest.raises(InputError, match=message) as refused:
        read_csm_frame(write(tmp_path, copy.deepcopy(support_data(**changes))))
    assert "image_7.json" in str(refused.value)


def test_scanners_send_it_here(tmp_path):
    path = write(tmp_path, support_data())
    with pytest.raises(InputError, match="FRAME_SENSOR_MODEL.*as a photograph"):
        read_scanner(path)
    path.write_text(json.dumps(push_frame()))
    with pytest.raises(InputError, match="PUSH_FRAME_SENSOR_MODEL.*one for each framelet"):
        read_scanner(path)


@pytest.mark.parametrize("changes", [{}, EXACT["radtan"][1], BEHIND, TRANSVERSE])
def test_a_model_state_is_what_it_was_made_of(changes, tmp_path):
    """As usgscsm writes it: the pose of the body, the fields of the ISD under other names."""
    isd = support_data(**changes)
    X0, m = pose(isd)
    ((kind, values),) = isd["optical_distortion"].items()
    coefficients = values.get("coefficients") or [*values["x"], *values["y"]]
    state = {
        "m_modelName": "USGS_ASTRO_FRAME_SENSOR_MODEL", "m_sensorName": "NAC", "m_nLines": 300,
        "m_nSamples": 400, "m_focalLength": isd["focal_length_model"]["focal_length"],
        "m_iTransL": isd["focal2pixel_lines"], "m_iTransS": isd["focal2pixel_samples"],
        "m_ccdCenter": [312.25, 420.5], "m_detectorLineSumming": 2, "m_detectorSampleSumming": 2,
        "m_startingDetectorLine": 8, "m_startingDetectorSample": 4,
        "m_distortionType": {"radial": 0, "transverse": 1, "radtan": 7}[kind],
        "m_opticalDistCoeffs": coefficients,
        "m_currentParameterValue": [*X0, *Rotation.from_matrix(m).as_quat()],
    }  # fmt: skip
    path = tmp_path / "state.json"
    write_state = lambda: path.write_text(f"{state['m_modelName']}\n{json.dumps(state)}")
    write_state()
    net, again = read_network(path), read_csm_frame(write(tmp_path, isd))
    np.testing.assert_allclose(net.images.position, again.images.position, rtol=1e-13)
    np.testing.assert_allclose(net.images.angles, again.images.angles, atol=1e-12)
    assert net.cameras[0].model == again.cameras[0].model
    assert net.cameras[0].parameters == pytest.approx(again.cameras[0].parameters, rel=1e-12)
    state["m_lineTimes"] = [0.0, 0.1]
    write_state()
    with pytest.raises(InputError, match="state.json: jitter"):
        read_network(path)
    path.write_text("USGS_ASTRO_PUSH_FRAME_SENSOR_MODEL\n{}")
    with pytest.raises(InputError, match="a model state of 'USGS_ASTRO_PUSH_FRAME"):
        read_network(path)


HEIGHT, DELAY, EXPOSURE = 20, 0.5, 0.04


def push_frame(**changes) -> dict:
    """The ISD of 15 framelets of a camera that moves and turns, with tables of ten rows."""
    t = NOW + np.linspace(-5.0, 5.0, 10)
    rows = {"ephemeris_times": t.tolist(), "reference_frame": 1}
    turn = lambda v, rate: (
        Rotation.from_rotvec(v) * Rotation.from_rotvec(np.outer(t - NOW, rate))
    ).as_quat()[:, [3, 0, 1, 2]].tolist()
    X0, V = np.array([120.0, -340.0, 56.0]), np.array([0.4, 0.9, -0.3])
    base = support_data()
    isd = base | {
        "name_model": "USGS_ASTRO_PUSH_FRAME_SENSOR_MODEL", "framelet_height": HEIGHT,
        "framelets_flipped": False, "framelet_order_reversed": False, "interframe_delay": DELAY,
        "exposure_duration": EXPOSURE, "starting_ephemeris_time": NOW - 3.6,
        "detector_line_summing": 1, "detector_sample_summing": 1, "image_lines": 15 * HEIGHT,
        "starting_detector_line": 300, "starting_detector_sample": 220,
        "body_rotation": {**rows, "quaternions": turn([0.3, -0.2, 0.7], [0.0, 0.0, 1e-3])},
        "instrument_pointing": {
            **rows, "quaternions": turn([-0.5, 1.1, 0.2], [2e-3, -1e-3, 5e-4]),
            "constant_rotation": base["instrument_pointing"]["constant_rotation"],
        },
        "instrument_position": {**rows, "positions": (X0 + np.outer(t - NOW, V)).tolist(),
                                "velocities": np.tile(V, (10, 1)).tolist()},
    }  # fmt: skip
    return isd | changes


def framelet_of(isd, k):
    """The ISD of a photograph with the state of framelet k in time: exact, since positions of the
    tables are linear in time and rotations are about fixed axes at constant rates."""
    t = isd["starting_ephemeris_time"] + EXPOSURE / 2 + k * DELAY
    single = copy.deepcopy(isd) | {"name_model": "USGS_ASTRO_FRAME_SENSOR_MODEL",
                                   "image_lines": HEIGHT}  # fmt: skip
    for name, of, rate in (("body_rotation", [0.3, -0.2, 0.7], [0.0, 0.0, 1e-3]),
                           ("instrument_pointing", [-0.5, 1.1, 0.2], [2e-3, -1e-3, 5e-4])):
        q = Rotation.from_rotvec(of) * Rotation.from_rotvec((t - NOW) * np.array(rate))
        row = q.as_quat()[[3, 0, 1, 2]].tolist()
        single[name] |= {"ephemeris_times": [t], "quaternions": [row]}
    position = single["instrument_position"]
    X = np.array(position["positions"][0]) + (t - position["ephemeris_times"][0]) * np.array(
        position["velocities"][0]
    )
    position |= {"ephemeris_times": [t], "positions": [X.tolist()], "velocities": None}
    return single


@pytest.mark.parametrize("reverse", [False, True])
def test_framelets_are_photographs(reverse, tmp_path):
    isd = push_frame(framelet_order_reversed=reverse, **EXACT["radial"][1])
    net = read_network(write(tmp_path, isd))
    assert net.images.id[:2] == ("image_7-000", "image_7-001") and len(net.images.id) == 15
    assert net.cameras[0].image_size == (400, HEIGHT) and len(net.cameras) == 1
    for k in (0, 4, 14):
        single = framelet_of(isd, 14 - k if reverse else k)
        X0, m = pose(single)
        np.testing.assert_allclose(net.images.position[k], X0, atol=1e-6)
        np.testing.assert_allclose(matrix(net.images.angles[k]).T @ np.diag([1, -1, -1]), m,
                                   atol=1e-9)  # fmt: skip
        # through the camera: points on the rays of pixels of the framelet, by usgscsm's formulas
        X = ground_points(single)
        expected = ground_to_image(single, X)
        chosen = dataclasses.replace(
            net, images=dataclasses.replace(net.images, position=net.images.position[k : k + 1],
                                            angles=net.images.angles[k : k + 1]))  # fmt: skip
        np.testing.assert_allclose(images(chosen, X), expected, atol=2e-6)


def test_positions_alone_hold_for_a_step_beyond_their_ends(tmp_path):
    isd = push_frame(starting_ephemeris_time=NOW - 1.4)  # to 5.6 s, the table to 5 s
    expected, _ = pose(framelet_of(isd, 14))
    isd["instrument_position"].pop("velocities")
    net = read_csm_frame(write(tmp_path, isd))
    np.testing.assert_allclose(net.images.position[14], expected, atol=1e-6)


@pytest.mark.parametrize("changes, message", [
    ({"framelets_flipped": True}, "mirror image"), ({"framelet_height": 0}, "framelet_height"),
    ({"interframe_delay": -1.0}, "interframe_delay is -1"), ({"framelet_height": 999}, "less than"),
    ({"framelet_order_reversed": "yes"}, "true or false"), ({"interframe_delay": 5.0}, "needs"),
    ({"detector_line_summing": 4}, "summing"),
])  # fmt: skip
def test_framelets_that_are_refused(changes, message, tmp_path):
    with pytest.raises(InputError, match=message) as refused:
        read_csm_frame(write(tmp_path, push_frame(**changes)))
    assert "image_7.json" in str(refused.value)
    # lines that fill no framelet are told
    net = read_csm_frame(write(tmp_path, push_frame(image_lines=15 * HEIGHT + 3)))
    assert "3 more lines" in net.warnings[-1]


def test_the_command_converts_it(command, tmp_path):
    path = write(tmp_path, support_data())
    done = command("convert", path, tmp_path / "transforms.json")
    assert done.status == 0 and "transforms" in done.out
