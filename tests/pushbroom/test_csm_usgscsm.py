"""CSM files as usgscsm interpolates them, tables that end early, model states, images of a line."""

import json
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pushbroom_scenes import LINES, PERIOD, PIXELS, locate
from scipy.interpolate import KroghInterpolator
from scipy.spatial.transform import Rotation
from test_csm import PLACES, support_data, write

from jaxbundle import cli
from jaxbundle.errors import InputError
from jaxbundle.io.scanner.csm import read_csm
from jaxbundle.io.scanner.read import read_scanner
from jaxbundle.io.scanner.writing import write_scanner_image
from jaxbundle.pushbroom.ground_to_image import make_search, project_points
from jaxbundle.pushbroom.image import pose_at
from jaxbundle.pushbroom.image_to_ground import locate_points
from jaxbundle.pushbroom.pieces import make_pieces
from jaxbundle.pushbroom.surfaces import Ground

scattered = jax.jit(locate_points)
poses = jax.jit(jax.vmap(pose_at, (None, 0)))
SHARED = Path(__file__).parents[3] / "shared" / "data" / "csm"


@pytest.mark.skipif(not SHARED.exists(), reason="shared/data/csm is not there")
def test_ground_points_of_the_reference():
    """A CTX image whose ground points were made with the interpolation of usgscsm."""
    given = np.genfromtxt(SHARED / "ctx_ground_points.csv", delimiter=",", names=True)
    expected = np.stack([given["X"], given["Y"], given["Z"]])
    far = {}
    for interpolation in ("usgscsm", "lagrange"):
        file = read_csm(SHARED / "ctxLineScan.json", interpolation)
        found = scattered(file.image, Ground(file.earth), given["line"], given["pixel"])
        far[interpolation] = np.linalg.norm(found - expected, axis=0).max()
    assert len(given) == 82 and far["usgscsm"] < 1e-3
    # eight rows up to the ends: another curve there
    assert 0.1 < far["lagrange"] < 0.2


def by_hand(isd, t):
    """Position and rotation camera → body at t, as computed by usgscsm and ALE."""
    centre = isd["center_ephemeris_time"]

    def table(key):
        rows = isd[key]
        first = np.array(rows["quaternions"])[:, [1, 2, 3, 0]]
        return np.array(rows["ephemeris_times"]), Rotation.from_quat(first)

    def turned(times, R, at):
        i = min(max(np.searchsorted(times, at, side="right") - 1, 0), len(times) - 2)
        part = (at - times[i]) / (times[i + 1] - times[i])
        return R[i] * Rotation.from_rotvec(part * (R[i].inv() * R[i + 1]).as_rotvec())

    def lagrange(times, values):
        i = min(max(int((t + centre - times[0]) // (times[1] - times[0])), 0), len(times) - 2)
        half = min(i + 1, len(times) - 1 - i, 4)
        rows = slice(i + 1 - half, i + 1 + half)
        return KroghInterpolator(times[rows] - centre, values[rows])(t)

    body, pointing = table("body_rotation"), table("instrument_pointing")
    fixed = Rotation.from_matrix(
        np.reshape(isd["instrument_pointing"]["constant_rotation"], (3, 3))
    )
    merged = np.array(sorted({*body[0], *pointing[0]}))
    product = Rotation.concatenate([
        turned(*body, at) * (fixed * turned(*pointing, at)).inv() for at in merged
    ])
    even = np.linspace(merged[0], merged[-1], len(merged))
    q = np.array([turned(merged, product, at).as_quat() for at in even])
    q *= np.where(q @ q[0] < 0, -1, 1)[:, None]
    given = isd["instrument_position"]
    rows = np.linspace(given["ephemeris_times"][0], given["ephemeris_times"][-1], 25)
    P = []
    for at in rows:
        times, X, V = (np.array(given[k]) for k in ("ephemeris_times", "positions", "velocities"))
        i = min(max(np.searchsorted(times, at, side="right") - 1, 0), len(times) - 2)
        h = times[i + 1] - times[i]
        s = (at - times[i]) / h
        cubic = [2 * s**3 - 3 * s**2 + 1, s**3 - 2 * s**2 + s, 3 * s**2 - 2 * s**3, s**3 - s**2]
        X = cubic[0] * X[i] + cubic[1] * h * V[i] + cubic[2] * X[i + 1] + cubic[3] * h * V[i + 1]
        P.append(1e3 * turned(*body, at).apply(X))
    return lagrange(rows, np.array(P)), Rotation.from_quat(lagrange(even, q))


@pytest.mark.further
def test_times_are_merged_and_orders_fall(tmp_path):
    """Body and pointing at other times, the image from the first to the last step of both."""
    isd = support_data()
    tables = {"body_rotation": 9, "instrument_pointing": 41}
    for key, n in tables.items():
        rows = isd[key]
        old = np.array(rows["ephemeris_times"])
        new = isd["center_ephemeris_time"] + np.linspace(0.0, LINES * PERIOD, n)
        i = np.clip(np.searchsorted(old, new, side="right") - 1, 0, len(old) - 2)
        part = ((new - old[i]) / (old[i + 1] - old[i]))[:, None]
        R = Rotation.from_quat(np.array(rows["quaternions"])[:, [1, 2, 3, 0]])
        R = R[i] * Rotation.from_rotvec(part * (R[i].inv() * R[i + 1]).as_rotvec())
        rows["ephemeris_times"] = (new + (0.003 if n == 9 else 0)).tolist()
        rows["quaternions"] = np.roll(R.as_quat(), 1, axis=1).tolist()
    file = read_csm(write(tmp_path, isd))
    # the body's table begins 3 ms late
    assert len(file.warnings) == 1 and "body_rotation" in file.warnings[0]
    ours = read_csm(write(tmp_path, isd), "lagrange").image
    times = np.r_[0.0, 0.02, 0.13, 0.31, 1.7, 3.61, 3.93, 3.99]
    expected_P, expected_R = zip(*(by_hand(isd, t) for t in times))
    P, R, _ = poses(file.image, times)
    np.testing.assert_allclose(P, expected_P, atol=2e-3)  # times of 3e8 s have 6e-8 s
    # the camera of the image is that of the ISD, turned for good
    turn = (Rotation.concatenate(expected_R).inv() * Rotation.from_matrix(np.array(R))).as_matrix()
    np.testing.assert_allclose(turn, np.tile(turn[:1], (8, 1, 1)), atol=2e-9)
    assert np.abs(poses(ours, times).R - R).max() > 1e-7  # a decimetre from 505 km


def short(seconds, end="start"):
    """The older form of an ISD whose attitudes begin after the first line, or end before the last
    one, by this number of seconds; steps of 0.1 s."""
    isd = support_data(older=True)
    q = isd["sensor_orientation"]["quaternions"]
    if end == "start":
        isd["sensor_orientation"]["quaternions"] = q[10:]
        isd["t0_quaternion"] = 0.0
        isd["line_scan_rate"][0][1] -= seconds
    else:
        isd["sensor_orientation"]["quaternions"] = q[:46]  # to 3.5 s
        isd["image_lines"] = round((3.5 + seconds) / PERIOD) + 1
    return isd


@pytest.mark.parametrize("end", ["start", "end"])
def test_tables_that_end_early_are_extrapolated(tmp_path, end):
    """By 0.08 s with a warning, at the rate of the last step."""
    file = read_csm(write(tmp_path, short(0.08, end)))
    (warning,) = file.warnings
    assert "sensor_orientation" in warning and "extrapolated by 0.08 s at its" in warning
    assert "12 of" in warning and "up to 0.2 s" in warning
    image = file.image
    lines = np.array([0.0, 5.0, 20.0, image.lines - 6.0, image.lines - 1.0])
    X = locate(image, Ground(file.earth), lines, np.array([0.0, 399.0]))
    assert np.isfinite(X).all()
    at, inside = (-0.08, 0.0) if end == "start" else (3.58, 3.5)
    step = np.sign(inside - at) * 0.1
    _, R, _ = poses(image, np.array([at, inside, inside + step]))
    R = Rotation.from_matrix(np.array(R))
    rate = (R[1].inv() * R[2]).as_rotvec() / step
    expected = R[1] * Rotation.from_rotvec((at - inside) * rate)
    # quaternions on a straight line: the same turn but for its third power
    assert (R[0].inv() * expected).magnitude() < 1e-8
    if end == "end":
        return
    # from the edge of the first line to that of the last, for the way back
    pieces = np.asarray(make_pieces(image, file.earth).ends)
    edges = [float(image.times.time(line)) for line in (-0.5, image.lines - 0.5)]
    np.testing.assert_allclose(pieces[[0, -1]], edges, atol=1e-12)
    again = read_scanner(write_scanner_image(tmp_path, "again", image, file.earth)).image
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(image), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-14)
    assert again.trajectory.attitude.table.extrapolate == pytest.approx(0.2)


def test_tables_that_end_too_early_are_refused(tmp_path):
    for seconds, end in ((0.21, "start"), (0.25, "end")):
        with pytest.raises(InputError) as refused:
            read_csm(write(tmp_path, short(seconds, end)))
        for word in ("sensor_orientation: image line", "outside", "at most 0.2 s are extrapolated"):
            assert word in str(refused.value), refused.value


def test_warnings_are_shown(tmp_path, monkeypatch, capsys):
    path = write(tmp_path, short(0.08))
    monkeypatch.setattr(
        sys, "argv", ["jaxbundle", "pushbroom", "locate", str(path), "--grid", "2x2"]
    )
    with pytest.raises(SystemExit):
        cli.main()
    out, err = capsys.readouterr()
    assert len(out.splitlines()) == 5 and "nan" not in out
    assert len(err.splitlines()) == 1 and "isd.json, sensor_orientation" in err


def model_state(**changes):
    """The image of the older form of an ISD as a model state."""
    isd = support_data(older=True)
    first, start, period = np.transpose(isd["line_scan_rate"]).tolist()
    return {
        "m_modelName": "USGS_ASTRO_LINE_SCANNER_SENSOR_MODEL", "m_sensorName": "test",
        "m_nLines": LINES, "m_nSamples": PIXELS, "m_platformFlag": 1, "m_zDirection": 1,
        "m_intTimeLines": first, "m_intTimeStartTimes": start, "m_intTimes": period,
        "m_focalLength": 700.0, "m_distortionType": 0,
        "m_opticalDistCoeffs": isd["optical_distortion"]["radial"]["coefficients"],
        "m_iTransL": isd["focal2pixel_lines"], "m_iTransS": isd["focal2pixel_samples"],
        "m_detectorLineOrigin": isd["detector_center"]["line"],
        "m_detectorSampleOrigin": isd["detector_center"]["sample"],
        "m_detectorSampleSumming": 1, "m_startingDetectorLine": 0, "m_startingDetectorSample": 0,
        "m_majorAxis": 1e3 * isd["radii"]["semimajor"],
        "m_minorAxis": 1e3 * isd["radii"]["semiminor"],
        "m_t0Ephem": isd["t0_ephemeris"], "m_dtEphem": 1.0, "m_t0Quat": isd["t0_quaternion"],
        "m_dtQuat": 0.1, "m_positions": np.ravel(isd["sensor_position"]["positions"]).tolist(),
        "m_quaternions": np.ravel(isd["sensor_orientation"]["quaternions"]).tolist(),
        "m_currentParameterValue": [0.0] * 16,
    } | changes  # fmt: skip


def write_state(folder, state, name="USGS_ASTRO_LINE_SCANNER_SENSOR_MODEL\n"):
    path = folder / "state.json"
    path.write_text(name + json.dumps(state))
    return path


def test_a_model_state_is_read_as_its_isd(tmp_path):
    expected = read_csm(write(tmp_path, support_data(older=True)))
    for name in ("USGS_ASTRO_LINE_SCANNER_SENSOR_MODEL\n", ""):
        found = read_scanner(write_state(tmp_path, model_state(), name))
        assert found.name == "test"
        np.testing.assert_allclose(found.earth, expected.earth, rtol=1e-15)
        for a, b in zip(jax.tree.leaves(found.image), jax.tree.leaves(expected.image), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-12)
    # a camera that looks to the other side of its lens: the same image with x and y turned round
    turned = model_state(m_zDirection=-1, m_iTransL=[0.0, -20.0, 0.0], m_iTransS=[0.0, 0.0, -20.0])
    found = read_scanner(write_state(tmp_path, turned))
    surface = Ground(expected.earth)
    np.testing.assert_allclose(
        locate(found.image, surface, *PLACES), locate(expected.image, surface, *PLACES), atol=1e-6
    )


def test_adjusted_quaternions_are_normalised(tmp_path):
    """The components of an adjustment are not of length 1; that of the interpolated ones is what
    usgscsm divides by."""
    expected = read_csm(write_state(tmp_path, model_state()))
    q = np.reshape(model_state()["m_quaternions"], (-1, 4))
    length = 1 + np.random.default_rng(3).uniform(-3e-3, 3e-3, (len(q), 1))
    state = lambda q: write_state(tmp_path, model_state(m_quaternions=np.ravel(q).tolist()))
    found = read_csm(state(length * q))
    for a, b in zip(jax.tree.leaves(found.image), jax.tree.leaves(expected.image), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)
    said = [line for line in found.warnings if line not in expected.warnings]
    assert len(said) == 1 and "state.json" in said[0] and "normalised" in said[0]
    assert f"{length.max():.6f}" in said[0]
    # what rounding explains, or a small adjustment, is not worth a word
    found = read_csm(state((1 + 0.3 * (length - 1)) * np.round(q, 5)))
    assert found.warnings == expected.warnings


STATES = {
    "adjusted": ({"m_currentParameterValue": [0.0, 2.5]}, ["Value has 1 adjusted parameters"]),
    "distortion": ({"m_distortionType": 3}, ["'dawnfc' is not supported"]),
    "number": ({"m_distortionType": 12}, ["m_distortionType 12", "0 to 8"]),
    "frame camera": ({"m_modelName": "USGS_ASTRO_FRAME_SENSOR_MODEL"}, ["m_modelName", "FRAME"]),
    "rows": ({"m_quaternions": [0, 0, 0, 1, 0]}, ["m_quaternions has 5", "4 a row"]),
    "no quaternion": ({"m_quaternions": [0, 0, 0.3, 0.4] * 70}, ["row 1", "length 0.5"]),
    "missing": ({"m_positions": None}, ["m_positions is missing"]),
    "rates": ({"m_intTimes": [1.0, 1.0]}, ["m_intTimes have 1, 1, 2"]),
}


@pytest.mark.parametrize("case", STATES)
def test_states_that_are_refused(tmp_path, case):
    changes, words = STATES[case]
    with pytest.raises(InputError) as refused:
        read_csm(write_state(tmp_path, model_state(**changes)))
    for word in ("state.json", *words):
        assert word in str(refused.value), refused.value


def test_states_of_other_models_are_refused(tmp_path):
    path = write_state(tmp_path, {}, "USGS_ASTRO_SAR_SENSOR_MODEL\n")
    with pytest.raises(InputError, match="a model state of 'USGS_ASTRO_SAR_SENSOR_MODEL'"):
        read_csm(path)


@pytest.mark.further
def test_an_image_of_one_line(tmp_path):
    whole = read_csm(write(tmp_path, support_data(older=True)))
    one = read_csm(write(tmp_path, support_data(older=True) | {"image_lines": 1}))
    pixels = np.array([0.0, 150.0, 399.0])
    X = locate(one.image, Ground(one.earth), np.zeros(1), pixels)
    np.testing.assert_allclose(
        X, locate(whole.image, Ground(one.earth), np.zeros(1), pixels), atol=1e-6
    )
    seen = project_points(one.image, make_search(one.image), jnp.asarray(X[:, 0]))
    np.testing.assert_allclose(seen.line[0], 0, atol=1e-5)
    np.testing.assert_allclose(seen.pixel[0], pixels, atol=1e-5)


def test_a_scanner_file_chooses_interpolation_and_corrections(tmp_path):
    path = write(tmp_path, support_data())
    text = '[scanner]\nsource = "isd.json"\ninterpolation = "lagrange"\n'
    (tmp_path / "own.toml").write_text(text + "[corrections]\naberration = true\n")
    found = read_scanner(tmp_path / "own.toml").image
    assert found.corrections._asdict() == {
        "light_time": False, "aberration": True, "refraction": False,
    }  # fmt: skip
    expected = read_csm(path, "lagrange").image
    assert found.trajectory.attitude.table.method == "lagrange"
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(a, b)
    for old, new, words in [
        ('"lagrange"', '"cubic"', ["isd.json", "'cubic'", "usgscsm"]),
        ("interpolation", "lines = 5 #", ["own.toml", "'lines'"]),
        ("[corrections]", "[optics]", ["own.toml", "[optics]", "source"]),
        ("isd.json", "own.toml", ["own.toml", ".json"]),
    ]:
        (tmp_path / "own.toml").write_text(
            (text + "[corrections]\naberration = true\n").replace(old, new)
        )
        with pytest.raises(InputError) as refused:
            read_scanner(tmp_path / "own.toml")
        for word in words:
            assert word in str(refused.value), refused.value
