"""ISDs of line scanners: published ground points of usgscsm, there and back, what is refused."""

import copy
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pushbroom_scenes import LINES, PERIOD, PIXELS, locate, orbit, satellite
from scipy.spatial.transform import Rotation

from jaxbundle.cameras import get_model
from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import WGS84
from jaxbundle.io.scanner.csm import read_csm
from jaxbundle.io.scanner.read import read_scanner
from jaxbundle.pushbroom.earth_frames import EARTH_RATE
from jaxbundle.pushbroom.ground_to_image import make_search, project_points
from jaxbundle.pushbroom.image import pose_at
from jaxbundle.pushbroom.scanner import FocalLine
from jaxbundle.pushbroom.surfaces import Ground

K0, K1 = 1e-4, 2e-6
"""Radial correction of the measurement, as `optical_distortion` has it with the other sign."""


def write(folder, isd):
    path = folder / "isd.json"
    path.write_text(json.dumps(isd))
    return path


def small(times, positions, pointing, body, radius):
    """Sixteen lines and samples behind 50 mm, ten pixels a millimetre."""
    table = {"ephemeris_times": list(times), "reference_frame": 1}
    return {
        "name_model": "USGS_ASTRO_LINE_SCANNER_SENSOR_MODEL", "center_ephemeris_time": 1000.0,
        "line_scan_rate": [[0.5, -0.85, 0.1]], "image_lines": 16, "image_samples": 16,
        "focal2pixel_lines": [0.0, -10.0, 0.0], "focal2pixel_samples": [0.0, 0.0, 10.0],
        "focal_length_model": {"focal_length": 50}, "starting_detector_line": 1,
        "starting_detector_sample": 0, "detector_center": {"line": 0.5, "sample": 8.0},
        "radii": {"semimajor": radius, "semiminor": radius, "unit": "km"},
        "instrument_position": table | {"positions": np.array(positions).tolist()},
        "instrument_pointing": table | {"quaternions": np.array(pointing).tolist()},
        "body_rotation": table | {"quaternions": np.array(body).tolist()},
    }  # fmt: skip


def test_published_ground_points(tmp_path):
    """Figures of the tests of usgscsm: a fly-by of a ball of 10 m, and an orbit at 50 km."""
    t = 999.2 + 0.2 * np.arange(9)
    track = np.stack([0.02 * (t - 1000), 0 * t, -1.0 + 0 * t], 1)
    half = np.sqrt(0.5)
    pointing, body = (np.tile(q, (9, 1)) for q in ([0.0, 0, 0, 1], [0, -half, 0, half]))
    isd = small(t, track, pointing, body, 0.01)
    ball = read_csm(write(tmp_path, isd))
    found = locate(ball.image, Ground(ball.earth), np.array([7.5]), np.array([7.5]))[:, 0, 0]
    np.testing.assert_allclose(found, [9.999995, 0, 0.009999995], atol=1e-9)
    t = 999.2 + 0.1 * np.arange(16)
    angle = 0.1 * np.arange(16) / 1050
    orbit = 1050 * np.stack([np.cos(angle), 0 * angle, -np.sin(angle)], 1)
    turn = np.pi / 4 + angle / 2
    pointing = np.stack([np.cos(turn), 0 * turn, -np.sin(turn), 0 * turn], 1)
    isd = small(t, orbit, pointing, np.tile([1.0, 0, 0, 0], (16, 1)), 1000.0)
    # the velocities there do not belong to the positions, and are used all the same
    V = np.stack([-0.1 * np.arange(16), 0 * angle, -1.05 * np.cos(angle)], 1)
    isd["instrument_position"]["velocities"] = V.tolist()
    moon = read_csm(write(tmp_path, isd))
    found = locate(moon.image, Ground(moon.earth), np.array([8.0]), np.array([7.5]))[:, 0, 0]
    # the quaternions there have eight digits: a centimetre at most
    np.testing.assert_allclose(found, [999999.67004351, 0, -812.35021438], atol=0.01)


def expected_image():
    names = get_model("usgs").parameters
    given = {"c": 700.0, "K0": K0, "K1": K1}
    optics = FocalLine(
        jnp.array([given.get(name, 0.0) for name in names]), jnp.float64(0.05),
        jnp.float64((PIXELS - 1) / 2), jnp.float64(0.3), "usgs",
    )  # fmt: skip
    return satellite(turns="lagrange", optics=optics)


def support_data(older=False):
    """The image of `expected_image`, its detectors along y of a camera that looks along +z."""
    image = expected_image()
    centre = 3.1e8
    # x and y changed, z forward: v_camera here = C·v_camera there
    C = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1.0]])
    rows = np.array(image.trajectory.attitude.table.times)
    R = np.asarray(jax.vmap(lambda t: pose_at(image, t).R)(rows)) @ C
    t = np.array(image.trajectory.position.times)
    isd = {
        "name_sensor": "test", "center_ephemeris_time": centre,
        # the centre of the first line, half a period after its start
        "line_scan_rate": [[0.5, -PERIOD / 2, PERIOD]], "image_lines": LINES,
        "image_samples": PIXELS, "focal2pixel_lines": [0.0, 20.0, 0.0],
        "focal2pixel_samples": [0.0, 0.0, 20.0], "focal_length_model": {"focal_length": 700.0},
        "detector_center": {"line": -6.0, "sample": PIXELS / 2},
        "optical_distortion": {"radial": {"coefficients": [-K0, -K1, 0.0]}},
        "radii": {"semimajor": WGS84.a / 1e3, "semiminor": WGS84.c / 1e3, "unit": "km"},
    }  # fmt: skip
    P = np.array(image.trajectory.position.values)
    if older:
        ours = np.stack(Rotation.from_matrix(R).as_quat())
        return isd | {
            "sensor_position": {"positions": P.tolist(), "unit": "m"}, "t0_ephemeris": t[0],
            "dt_ephemeris": 1.0, "sensor_orientation": {"quaternions": ours.tolist()},
            "t0_quaternion": rows[0], "dt_quaternion": 0.1,
        }  # fmt: skip
    fixed = Rotation.from_euler("xyz", [0.3, -0.2, 0.5])
    turning = lambda at: Rotation.from_rotvec(np.outer(at, [0, 0, -EARTH_RATE])) * fixed
    lens = Rotation.from_euler("z", 0.4)
    pointing = lens.inv() * (Rotation.from_matrix(R).inv() * turning(rows))
    scalar_first = lambda rotation: np.roll(rotation.as_quat(), 1, axis=1).tolist()
    inertial = turning(t).inv().apply(P)
    ends = np.array([t[0], t[-1]])
    step = 1e-2
    before, after = (turning(t + s).inv().apply(orbit(t + s)[0]) for s in (-step, step))
    return isd | {
        "instrument_position": {
            "ephemeris_times": (centre + t).tolist(), "positions": (inertial / 1e3).tolist(),
            "velocities": ((after - before) / (2 * step) / 1e3).tolist(),
        },
        "body_rotation": {
            "ephemeris_times": (centre + ends).tolist(), "quaternions": scalar_first(turning(ends)),
        },
        "instrument_pointing": {
            "ephemeris_times": (centre + rows).tolist(), "quaternions": scalar_first(pointing),
            "constant_rotation": lens.as_matrix().ravel().tolist(),
        },
    }  # fmt: skip


PLACES = np.linspace(0, LINES - 1, 8), np.linspace(0, PIXELS - 1, 5)


@pytest.mark.parametrize("older", [False, pytest.param(True, marks=pytest.mark.further)])
def test_an_image_written_as_support_data_is_read_as_itself(tmp_path, older):
    # merged times of pointing and body would be too far apart for this restless satellite
    scanner = read_csm(write(tmp_path, support_data(older)), "usgscsm" if older else "lagrange")
    assert not scanner.warnings
    assert scanner.name == "test" and scanner.earth.a == WGS84.a
    expected = locate(expected_image(), Ground(), *PLACES)
    found = locate(scanner.image, Ground(), *PLACES)
    # times of 3e8 s are rounded to 6e-8 s: half a millimetre of flight
    np.testing.assert_allclose(found, expected, atol=1e-5 if older else 2e-3)
    names = get_model("usgs").parameters
    assert scanner.image.optics.model == "usgs"
    assert float(scanner.image.optics.parameters[names.index("K1")]) == K1
    X = jnp.asarray(found.reshape(3, -1))
    seen = project_points(scanner.image, make_search(scanner.image), X)
    line, pixel = (a.ravel() for a in np.meshgrid(*PLACES, indexing="ij"))
    np.testing.assert_allclose(seen.line[0], line, atol=1e-5)
    np.testing.assert_allclose(seen.pixel[0], pixel, atol=1e-5)


def slopes(folder, distortion):
    isd = support_data(older=True) | {"optical_distortion": distortion}
    u = np.arange(0, PIXELS, 50)
    optics = read_csm(write(folder, isd)).image.optics
    return np.stack([np.asarray(a) for a in jax.vmap(optics.slopes)(u * 1.0)]), 0.05 * (u - 199.5)


def test_other_distortions(tmp_path):
    """In their own formulas: ξ is y/f there, η is x/f."""
    (xi, eta), y = slopes(tmp_path, {"lrolrocnac": {"coefficients": [1.8e-5]}})
    np.testing.assert_allclose(700 * xi, y / (1 + 1.8e-5 * y * y), atol=1e-9)
    np.testing.assert_allclose(700 * eta, 0.3, atol=1e-9)
    (xi, eta), y = slopes(tmp_path, {"kplo_shadowcam": {"coefficients": [1.8e-5]}})
    np.testing.assert_allclose(700 * xi, y * (1 + 1.8e-5 * y * y), atol=1e-9)
    a = [0.01, 1.0, 1e-3, 1e-5, 2e-5, 1e-5, 0, 0, 1e-6, 0]
    b = [0, 2e-3, 1.0, 0, 0, 3e-5, 0, 0, 0, 1e-6]
    (xi, eta), y = slopes(tmp_path, {"transverse": {"x": a, "y": b}})
    u, v = 700 * eta, 700 * xi
    back = lambda c: (
        c[0] + c[1] * u + c[2] * v + c[3] * u**2 + c[4] * u * v + c[5] * v**2 + c[6] * u**3
        + c[7] * u**2 * v + c[8] * u * v**2 + c[9] * v**3
    )  # fmt: skip
    np.testing.assert_allclose(back(a), 0.3, atol=1e-9)
    np.testing.assert_allclose(back(b), y, atol=1e-9)
    given = {"x": [1e-3, 0, 1e-6, 0], "y": [2e-3, 1e-4, 0, 0], "boresight_x": 0.01}
    (xi, eta), y = slopes(tmp_path, {"kaguyalism": given | {"boresight_y": -0.02}})
    r = np.hypot(0.3, y)
    np.testing.assert_allclose(700 * eta, 0.3 + 0.01 + 1e-3 + 1e-6 * r**2, atol=1e-9)
    np.testing.assert_allclose(700 * xi, y - 0.02 + 2e-3 + 1e-4 * r, atol=1e-9)


def test_lines_of_two_periods(tmp_path):
    rates = [[0.5, -PERIOD / 2, PERIOD], [100.5, 99.5 * PERIOD, PERIOD / 2]]
    image = read_csm(write(tmp_path, support_data(True) | {"line_scan_rate": rates})).image
    times = [float(image.times.time(line)) for line in (0.0, 99.0, 100.0, 110.0)]
    expected = PERIOD * np.array([0, 99, 99.5 + 0.25, 99.5 + 0.25 + 5])
    np.testing.assert_allclose(times, expected, atol=1e-12)


def test_a_single_record_of_the_pointing(tmp_path):
    t = 999.2 + 0.2 * np.arange(9)
    track = np.stack([0.02 * (t - 1000), 0 * t, -1.0 + 0 * t], 1)
    isd = small(t, track, [[0.0, 0, 0, 1]], np.tile([1.0, 0, 0, 0], (9, 1)), 0.01)
    isd["instrument_pointing"]["ephemeris_times"] = [999.5]
    isd["line_scan_rate"] = [[0.5, -0.4, 0.05]]
    R = [np.asarray(pose_at(read_csm(write(tmp_path, isd), how).image, 0.0).R)
         for how in ("usgscsm", "lagrange")]  # fmt: skip
    np.testing.assert_allclose(*R, atol=1e-12)


def changed(path, value):
    def change(isd):
        *parents, last = path.split(".")
        for key in parents:
            isd = isd[key]
        isd[last] = value

    return change


BROKEN = {
    "frame camera": (changed("name_model", "USGS_ASTRO_FRAME_SENSOR_MODEL"), ["name_model"]),
    "no focal length": (
        lambda isd: isd.pop("focal_length_model"), ["focal_length is missing"],
    ),
    "fraction": (changed("image_lines", 15.7), ["image_lines", "15.7", "whole"]),
    "endless": (changed("image_lines", 1e15), ["image_lines", "10000000"]),
    "focal length": (changed("focal_length_model.focal_length", 0), ["focal_length is 0"]),
    "constant": (
        changed("body_rotation.constant_rotation", [0.0] * 9), ["body_rotation", "not a rotation"],
    ),
    "text": (changed("image_lines", "many"), ["image_lines", "'many'", "number"]),
    "shape": (changed("focal2pixel_lines", [0.0, 1.0]), ["focal2pixel_lines", "array 3"]),
    "dependent": (changed("focal2pixel_lines", [0.0, 0.0, 1.0]), ["dependent"]),
    "period": (changed("line_scan_rate", [[0.5, 0.0, 0.0]]), ["line_scan_rate", "positive"]),
    "unit": (changed("radii.unit", "miles"), ["radii.unit", "'miles'"]),
    "distortion": (changed("optical_distortion", {"fisheye": {}}), ["'fisheye'", "radial"]),
    "two distortions": (
        changed("optical_distortion", {"radial": {"coefficients": [0.0]}, "legendre": {}}),
        ["2 kinds", "'legendre'"],
    ),
    "legendre": (changed("optical_distortion", {"legendre": {}}), ["'legendre' is not supported"]),
    "themisir": (changed("optical_distortion", {"themisir": {}}), ["'themisir' is not supported"]),
    "quaternion": (
        changed("body_rotation.quaternions", [[1, 0, 0, 0], [1, 1, 0, 0]]),
        ["body_rotation", "row 2", "length 1.41421"],
    ),
    "rows": (
        changed("body_rotation.quaternions", [[1, 0, 0, 0]]), ["body_rotation", "array 2 × 4"],
    ),
    "times": (
        changed("body_rotation.ephemeris_times", [3.1e8, 3.1e8]), ["body_rotation", "twice"],
    ),
}  # fmt: skip


@pytest.fixture(scope="module")
def isd():
    return support_data()


@pytest.mark.parametrize("case", BROKEN)
def test_what_is_refused(tmp_path, isd, case):
    change, words = BROKEN[case]
    isd = copy.deepcopy(isd)
    change(isd)
    with pytest.raises(InputError) as refused:
        read_csm(write(tmp_path, isd))
    for word in ("isd.json", *words):
        assert word in str(refused.value), refused.value


def test_what_is_no_json(tmp_path):
    with pytest.raises(InputError, match="isd.json: no such file"):
        read_csm(tmp_path / "isd.json")
    deep = 100_000 * '{"a":'
    too_deep = (deep, "isd.json, line 1: .* deeply")
    for text, word in (("{", "not valid JSON"), ("[]", "object"), too_deep):
        (tmp_path / "isd.json").write_text(text)
        with pytest.raises(InputError, match=word):
            read_csm(tmp_path / "isd.json")


@pytest.mark.parametrize("change", [
    {"projection": "+proj=eqc +R=1737400", "geotransform": [-9e5, 5.0, 0, 4e5, 0, -5.0]},
    {"projection": "", "geotransform": [1000.0, 1, 0, 2000, 0, 1]},
    {"geotransform": [0.0, 2, 0, 0, 0, 2]},
])  # fmt: skip
def test_a_map_or_a_crop_is_not_taken_for_the_raw_image(tmp_path, change):
    with pytest.raises(InputError, match="isd.json: .*whole raw image"):
        read_csm(write(tmp_path, support_data(older=True) | change))


def test_the_identity_is_a_raw_image(tmp_path):
    raw = {"projection": "", "geotransform": [0.0, 1, 0, 0, 0, 1]}
    assert read_csm(write(tmp_path, support_data(older=True) | raw)).warnings == ()


@pytest.mark.parametrize("factor, used", [(1000.0, False), (-1.0, False), (0.94, True)])
def test_velocities_that_contradict_their_positions_are_said(tmp_path, factor, used):
    """Of metres instead of kilometres, of another direction, and 6 % off, by which the positions
    between rows of a second are off by less than 100 m."""
    isd = support_data()
    good = read_csm(write(tmp_path, isd))
    table = isd["instrument_position"]
    table["velocities"] = (factor * np.array(table["velocities"])).tolist()
    bad = read_csm(write(tmp_path, isd))
    (said,) = bad.warnings
    assert "velocities, row 2: positions move by 7" in said
    assert ("used all the same" in said) == used and ("not used" in said) != used
    track, known = (image.image.trajectory.position.values for image in (bad, good))
    limit = 100 if used else 1.2  # at the ends a line: 9 m/s²·(1 s)²/8
    np.testing.assert_allclose(track, known, rtol=0, atol=limit)


@pytest.mark.parametrize("rows", [1, pytest.param(2, marks=pytest.mark.further)])
def test_lines_in_reverse_order(tmp_path, rows):
    """With a negative period, in one row or two, line l is the line `LINES` − 1 − l of the same
    scanner read forwards."""
    isd = support_data(older=True)
    forward = read_csm(write(tmp_path, isd))
    ((first, start, period),) = isd["line_scan_rate"]
    end = start + period * (LINES - 1 + 2 * first)
    half = LINES // 2
    isd["line_scan_rate"] = [[first, end, -period],
                             [first + half, end - half * period, -period]][:rows]  # fmt: skip
    backward = read_csm(write(tmp_path, isd))
    lines, pixels = PLACES
    there = locate(backward.image, Ground(WGS84), lines, pixels)
    expected = locate(forward.image, Ground(WGS84), LINES - 1 - lines, pixels)
    np.testing.assert_allclose(there, expected, atol=1e-6)
    search = make_search(backward.image, WGS84)
    found = project_points(backward.image, search, np.asarray(there).reshape(3, -1))
    seen = found.line[0], found.pixel[0]
    for place, wanted in zip(seen, np.meshgrid(lines, pixels, indexing="ij")):
        np.testing.assert_allclose(np.asarray(place).ravel(), wanted.ravel(), atol=1e-5)
    (tmp_path / "scanner.toml").write_text(
        '[scanner]\nsource = "isd.json"\n[corrections]\naberration = true\n'
    )
    with pytest.raises(InputError, match="in reverse order"):
        read_scanner(tmp_path / "scanner.toml")
    isd["line_scan_rate"] = [[0.5, 0.0, period], [9.5, 9 * period, -period]]
    with pytest.raises(InputError, match="all of a negative one"):
        read_csm(write(tmp_path, isd))


@pytest.mark.further
def test_short_tables_with_a_stated_extrapolation(tmp_path):
    """Positions that end a second before the last line, in a file and as `source`."""
    isd = support_data(older=True)
    whole = read_csm(write(tmp_path, isd))
    last = (LINES - 1) * PERIOD
    rows = isd["sensor_position"]["positions"]
    isd["sensor_position"]["positions"] = rows[: int(np.floor(last - 1 - isd["t0_ephemeris"])) + 1]
    path = write(tmp_path, isd)
    with pytest.raises(InputError, match="outside the table"):
        read_csm(path)
    (tmp_path / "scanner.toml").write_text(
        '[scanner]\nsource = "isd.json"\nextrapolate = 2.5\n'
    )
    short = read_scanner(tmp_path / "scanner.toml")
    assert any("does not cover the whole image: extrapolated by" in w for w in short.warnings)
    # straight on: 9 m/s²·t²/2, for at most two seconds
    times = np.linspace(0, last, 9)
    there, known = (
        np.asarray(jax.vmap(lambda t, image=image: pose_at(image.image, t).P)(times))
        for image in (short, whole)
    )
    assert 0.1 < np.linalg.norm(there - known, axis=1).max() < 30
    (tmp_path / "scanner.toml").write_text('[scanner]\nsource = "isd.json"\nextrapolate = -1\n')
    with pytest.raises(InputError, match="extrapolate is -1"):
        read_scanner(tmp_path / "scanner.toml")


def test_a_key_that_is_not_known_is_named_or_refused(tmp_path):
    path = tmp_path / "isd.json"
    path.write_text(json.dumps(support_data(older=True)))
    assert not any("unknown key" in told for told in read_csm(path).warnings)
    path.write_text(json.dumps(support_data(older=True) | {"vendor_remark": 7}))
    assert any("unknown key 'vendor_remark'" in told for told in read_csm(path).warnings)
    path.write_text(json.dumps(support_data(older=True) | {"lens_offset": 7}))
    with pytest.raises(InputError, match="isd.json.*unknown key 'lens_offset'.*geometry"):
        read_csm(path)
