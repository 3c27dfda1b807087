"""Pictures and trajectories of a flight in the explorer, against geometry written here.

A camera over a plane at the height H: the pixel u of a level line at Y looks at X = X₀ + H·tan β;
a roll of ρ adds to β, right side down, which turns the view to the left. Scenes that are linear in
X and Y are interpolated exactly by every kernel, so that the pictures are as good as the geometry.
"""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from jaxbundle.errors import InputError
from jaxbundle.explorer.attitudes import attitude_forms, choose_angles
from jaxbundle.explorer.pictures import scene_of_raster, take_pictures
from jaxbundle.explorer.scanner import FlightView
from jaxbundle.explorer.tracks import ORBIT, PLACES, STRAIGHT, choose_track
from jaxbundle.geometry.ellipsoid import WGS84, earth_fixed, geodetic
from jaxbundle.io.rasters.scenes import SceneRaster
from jaxbundle.io.scanner.flight import read_flight
from jaxbundle.pushbroom.flight import arc_between, measured_image, true_image
from jaxbundle.pushbroom.image import pose_at
from jaxbundle.pushbroom.signals import signal
from jaxbundle.pushbroom.surfaces import Plane

H, START, SPEED = 800.0, (300.0, 200.0), (0.0, 60.0)
LINES, PIXELS, PERIOD = 60, 40, 0.02
FLIGHT = f"""
[scanner]
name = "level"
lines = {LINES}
pixels = {PIXELS}
earth = "local"

[times]
period = {PERIOD}

[optics]
c = 60.0
pitch = 0.1

[track]
start = [{START[0]}, {START[1]}, {H}]
velocity = [{SPEED[0]}, {SPEED[1]}, 0.0]

[instruments]
position_rate = 20.0
attitude_rate = 20.0
"""
SLOPES = (np.arange(PIXELS) - (PIXELS - 1) / 2) * 0.1 / 60.0
Y = START[1] + SPEED[1] * PERIOD * np.arange(LINES)
RAMP = np.array([0.31, -0.17])
"""Grey values a metre along X and Y."""


def view_of(text, folder, **options):
    path = folder / "flight.toml"
    path.write_text(text)
    read = read_flight(path)
    return FlightView("level", read.flight, read.earth, **options)


@pytest.fixture(scope="module")
def view(tmp_path_factory):
    return view_of(FLIGHT, tmp_path_factory.mktemp("level"))


def ramp_over(view):
    """The frame of the scene of a view, with grey values linear in X and Y."""
    chosen = view.choose(view.values({}))
    frame, _ = view._scene(view.values({})["track"], chosen)
    X, top = (frame.left, frame.top)
    columns = X + (np.arange(frame.columns) + 0.5) * frame.size + frame.origin[0]
    rows = top - (np.arange(frame.rows) + 0.5) * frame.size + frame.origin[1]
    return frame, (RAMP[0] * columns + RAMP[1] * rows[:, None])[None]


def pictures(view, given, kernel="bilinear"):
    frame, scene = ramp_over(view)
    chosen = view.choose(view.values(given))
    return frame, take_pictures(
        scene, frame, chosen.truth, chosen.image, chosen.surface, kernel
    )  # fmt: skip


def inner(taken, reference=None):
    """Map − scene away from the borders of the image, beyond whose centres values are constant."""
    off = taken.map[0] - (taken.scene if reference is None else reference)[0]
    around = [np.roll(off, (i, j), (0, 1)) for i in (-2, 0, 2) for j in (-2, 0, 2)]
    return off[np.isfinite(around).all(0)]


@pytest.mark.parametrize("kernel", ["bilinear", "cubic"])
def test_a_level_flight_is_imaged_without_distortion(view, kernel):
    _, taken = pictures(view, {}, kernel)
    expected = RAMP[0] * (START[0] + H * SLOPES) + RAMP[1] * Y[:, None]
    np.testing.assert_allclose(taken.image[0], expected, atol=1e-6)
    # the map is the scene where the image has been: linear grey values survive both resamplings
    assert 0.3 < np.isfinite(taken.map[0]).mean() < 0.9
    assert np.abs(inner(taken)).max() < 1e-3


def test_the_image_follows_the_amplitude_of_roll(view):
    given = {"roll_amplitude": 1.5, "roll_period": 1.0}
    frame, taken = pictures(view, given)
    roll = np.radians(1.5) * np.sin(2 * np.pi * PERIOD * np.arange(LINES))
    # R = Ry(roll): [ξ, 0, −1] turns to [ξ cos − sin, 0, −ξ sin − cos]
    seen = (SLOPES * np.cos(roll)[:, None] - np.sin(roll)[:, None]) / (
        SLOPES * np.sin(roll)[:, None] + np.cos(roll)[:, None]
    )
    expected = RAMP[0] * (START[0] + H * seen) + RAMP[1] * Y[:, None]
    there = np.isfinite(taken.image[0])
    assert there.mean() > 0.9
    # but for the outer half of the outer pixels of the scene, in which values are constant
    reach = (np.arange(2) * (frame.columns - 1) + 0.5) * frame.size + frame.left + frame.origin[0]
    there &= (START[0] + H * seen > reach[0]) & (START[0] + H * seen < reach[1])
    np.testing.assert_allclose(taken.image[0][there], expected[there], atol=1e-6)
    # the map is corrected: what is left of 21 m of swing is the spline between the records, and
    # the bend of roll between two lines: 21 m·(2π·0.02)²/8 = 4 cm, 1 cm of grey
    assert np.sqrt(np.mean(inner(taken) ** 2)) < 0.02


def test_the_map_follows_an_error_of_roll(view):
    """An error of the recorded roll moves the map by H·(tan(β + ε) − tan β), and not the image."""
    right = pictures(view, {})[1]
    frame, wrong = pictures(view, {"roll": 0.1})
    np.testing.assert_array_equal(right.image, wrong.image)
    moved = inner(wrong, right.map)
    # the recorded camera looks to the left of where it did look, by ε·(1 + ξ²)·H: the map is there
    shift = H * np.radians(0.1)
    mean = shift * (1 + np.mean(SLOPES**2)) * RAMP[0]
    np.testing.assert_allclose(np.abs(moved).mean(), mean, rtol=2e-3)
    assert frame.size > 0 and wrong.rms > right.rms


def test_pictures_are_on_the_page_and_follow_the_sliders(view):
    first = view.answer({})
    image = r'alt="(\w+)" src="data:image/png;base64,([^"]+)"'
    found = re.findall(image, first["parts"]["pictures"])
    assert [name for name, _ in found] == ["scene", "distorted", "corrected"]
    json.dumps(first)
    rolled = view.answer({"roll": 0.1})
    later = re.findall(r"base64,([^\"]+)", rolled["parts"]["pictures"])
    assert later[0] == found[0][1] and later[1] == found[1][1] and later[2] != found[2][1]
    assert rolled["difference"] > first["difference"]
    swung = view.answer({"yaw_amplitude": 2.0, "resampling": "cubic"})
    assert re.findall(r"base64,([^\"]+)", swung["parts"]["pictures"])[1] != found[1][1]
    assert "cubic" in swung["parts"]["pictures"]


def test_start_and_end_are_those_of_the_lines(view):
    values = view.values({})
    assert values["track"] == STRAIGHT and values["start_Z"] == H
    last = START[1] + SPEED[1] * PERIOD * (LINES - 1)
    np.testing.assert_allclose([values["end_X"], values["end_Y"]], [START[0], last])
    given = {"start_X": 310.0, "end_X": 250.0, "end_Y": 400.0, "end_Z": 700.0}
    track = choose_track(view.tracks, view.values(given))
    image = view.choose(view.values(given)).truth
    at = lambda line: np.asarray(pose_at(image, image.times.time(line)).P)
    np.testing.assert_allclose(at(0.0), track["start"], atol=1e-9)
    np.testing.assert_allclose(at(LINES - 1.0), [250.0, 400.0, 700.0], atol=1e-9)
    np.testing.assert_allclose(at((LINES - 1) / 2), [280.0, 300.0, 750.0], atol=1e-9)
    told = view.answer(given)["parts"]["flight"]
    assert "400.000" in told and "<svg" in told


def test_an_arc_leads_from_start_to_end():
    """Constant angular rate about the centre, its velocity the derivative of the position."""
    places = np.radians([[10.0, 50.0], [12.0, 47.0]])
    start, end = (np.array([float(v) for v in earth_fixed(WGS84, (*p, h))])
                  for p, h in zip(places, (9000.0, 12000.0)))  # fmt: skip
    t, step = np.linspace(-5.0, 65.0, 141), 1e-3
    of = lambda t: arc_between(np.atleast_1d(t), start, end, 60.0, np.zeros(3))
    np.testing.assert_allclose(of(0.0)[0][0], start, atol=1e-6)
    np.testing.assert_allclose(of(60.0)[0][0], end, atol=1e-6)
    P, V = of(t)
    difference = (of(t + step)[0] - of(t - step)[0]) / (2 * step)
    np.testing.assert_allclose(V, difference, atol=1e-4)
    unit = P / np.linalg.norm(P, axis=1)[:, None]
    between = np.arccos(np.clip((unit[1:] * unit[:-1]).sum(1), -1, 1))
    np.testing.assert_allclose(between, between[0], rtol=1e-5)
    for other, words in ((-start, "opposite"), (1.01 * start, "above one place")):
        with pytest.raises(InputError, match=words):
            arc_between(t, start, other, 60.0, np.zeros(3))


def test_a_flight_file_has_start_and_end(tmp_path):
    path = tmp_path / "flight.toml"
    track = 'start = [10.0, 50.0, 9000.0]\nend = [10.02, 50.0, 9000.0]'
    text = FLIGHT.replace('earth = "local"\n', "")
    first, rest = text.split("[track]")
    path.write_text(f"{first}[track]\n{track}\n\n[instruments]{rest.split('[instruments]')[1]}")
    read = read_flight(path)
    image = true_image(read.flight)
    for line, place in ((0.0, [10.0, 50.0]), (LINES - 1.0, [10.02, 50.0])):
        P = tuple(np.asarray(pose_at(image, image.times.time(line)).P))
        longitude, latitude, height = (float(v) for v in geodetic(WGS84, P))
        np.testing.assert_allclose(np.degrees([longitude, latitude]), place, atol=1e-9)
        assert abs(height - 9000.0) < 1e-3
    for wrong, words in (
        ("start = [10.0, 95.0, 9000.0]\nend = [10.0, 50.0, 9000.0]", "latitude of 95"),
        ("start = [nan, 50.0, 9000.0]\nend = [10.0, 50.0, 9000.0]", "start is .*finite numbers"),
        ("start = [10.0, 50.0, 9000.0]", "end"),
        ("start = [10.0, 50.0, 9000.0]\nend = [10.0, 50.0, 9000.0]", "same place"),
        (f"{track}\nheight = 5e5", "height"),
    ):
        path.write_text(f"{first}[track]\n{wrong}\n\n[instruments]{rest.split('[instruments]')[1]}")
        with pytest.raises(InputError, match=words):
            measured_image(read_flight(path).flight)


def test_the_form_of_an_angle_changes_its_own_signals_only():
    given = {"roll": [{"kind": "sine", "amplitude": 0.02, "period": 3.0, "phase": 0.5}, 0.01]}
    forms = attitude_forms(given, 1.2)
    unchanged = {f"{n}_{k}": v for n, of in forms.known.items() for k, v in of.items()}
    assert choose_angles(forms, unchanged) is given
    assert unchanged["roll_period"] == 3.0 and unchanged["pitch_amplitude"] == 0.0
    t = np.linspace(0.0, 1.2, 50)
    total = lambda parts: sum(
        signal(part, t, 0.0, np.random.default_rng([0, k]))
        for k, part in enumerate(parts if isinstance(parts, list) else [parts])
    )
    changed = choose_angles(forms, unchanged | {"roll_amplitude": 2.0, "yaw_amplitude": 1.0})
    expected = 0.01 + np.radians(2.0) * np.sin(2 * np.pi * t / 3.0 + 0.5)
    np.testing.assert_allclose(total(changed["roll"]), expected, atol=1e-12)
    np.testing.assert_allclose(
        total(changed["yaw"]), np.radians(1.0) * np.sin(2 * np.pi * t / 1.2), atol=1e-12
    )
    assert "pitch" not in changed and given["roll"][0]["amplitude"] == 0.02


def test_a_walk_grows_with_the_root_of_time_and_does_not_depend_on_the_times_asked_for():
    walk = lambda seed, t: signal(
        {"kind": "walk", "sigma": 0.3, "step": 0.5}, t, 0.0, np.random.default_rng(seed)
    )
    ends = np.array([walk(seed, np.array([0.0, 4.0])) for seed in range(800)])
    assert not ends[:, 0].any()
    # σ of an RMS of 800 draws: 2.5 %
    np.testing.assert_allclose(ends[:, 1].std(), 0.3 * np.sqrt(4.0), rtol=0.1)
    t = np.linspace(-2.0, 9.0, 100)
    with pytest.raises(InputError, match="step is 1e-08 s, .* give a longer one"):
        signal({"kind": "walk", "step": 1e-8}, t, 0.0, np.random.default_rng(0))
    longer = np.concatenate([t, np.linspace(9.1, 80.0, 50)])
    np.testing.assert_allclose(walk(7, longer)[:100], walk(7, t), atol=1e-9)


@pytest.mark.parametrize("given, words", [
    ({"roll_period": 0.0}, "roll_period is 0; expected a number above 0"),
    ({"roll_walk": -1}, "at least 0"),
    ({"end_latitude": 91.0, "track": PLACES}, "from -90 to 90"),
    ({"resampling": "spline"}, "resampling is 'spline'"), ({"start_x": 1.0}, "start_X"),
    ({"end_X": 300.0, "end_Y": 200.0}, "same place"),
])  # fmt: skip
def test_forms_that_mean_nothing_are_refused(view, given, words):
    with pytest.raises(InputError, match=words):
        view.answer(given)


def test_nothing_of_the_scene_in_the_image_is_said(view):
    found = view.answer({"start_X": 9e3, "end_X": 9e3})
    assert "nothing of the scene is on the map" in found["parts"]["pictures"]
    assert found["difference"] != found["difference"]


def test_a_raster_is_shown_where_it_is(view):
    """A raster finer than the scene: means of its pixels, at their places."""
    frame, _ = ramp_over(view)
    fine = frame.size / 4
    x = np.arange(-80.0, 80.0, fine)
    grey = (RAMP[0] * x + RAMP[1] * x[::-1, None])[None]
    place = lambda X: ((x[-1] + frame.origin[1] - X[1]) / fine,
                       (X[0] - frame.origin[0] - x[0]) / fine)  # fmt: skip
    found = scene_of_raster(SceneRaster(grey, "float64", place), frame, Plane())
    east, south = np.diff(found[0], axis=1), np.diff(found[0], axis=0)
    # one scale of grey values for both directions
    scale = np.nanmedian(east) / (RAMP[0] * frame.size)
    inner = np.isfinite(east)
    np.testing.assert_allclose(east[inner], scale * RAMP[0] * frame.size, rtol=1e-6)
    np.testing.assert_allclose(
        south[np.isfinite(south)], -scale * RAMP[1] * frame.size, rtol=1e-6
    )  # fmt: skip
    away = SceneRaster(grey, "float64", lambda X: (X[0] * 0 - 1e6, X[1]))
    with pytest.raises(InputError, match="not where the image looks"):
        scene_of_raster(away, frame, Plane())


@pytest.mark.further
def test_over_the_earth_the_map_is_the_scene():
    """An orbit with roll, pitch and yaw that swing: the map without errors is the pattern, but for
    two bilinear interpolations at its edges."""
    root = Path(__file__).parents[2]
    read = read_flight(root / "examples/line_scanner/flight.toml")
    view = FlightView("orbit", read.flight, read.earth)
    exact = {"attitude_white": 0.0, "pitch_amplitude": 0.5, "pitch_period": 20.0}
    clean = view.take_pictures(exact)
    noisy = view.take_pictures(exact | {"attitude_white": 0.05})
    assert clean.rms < 5.0 and noisy.rms > 1.3 * clean.rms
    # with kernels that lose less between the pixels
    assert view.take_pictures(exact | {"resampling": "cubic"}).rms < 0.7 * clean.rms
    frame, (scene,) = view._scene(view.values({})["track"], view.choose(view.values({})))
    assert scene.shape == (frame.rows, frame.columns) and scene.max() == 255.0
    # one of its corners is told from the others
    assert scene[: frame.rows // 3, : frame.columns // 3].max() == 255.0
    assert scene[frame.rows // 2 :].max() < 255.0
    # from place to place: the same places at first
    told = view.answer(exact | {"track": PLACES})
    assert told["difference"] is not None and told["rms"] < 100.0


@pytest.mark.further
def test_a_track_in_other_coordinates_than_the_scene_shows_a_pattern(view):
    frame, _ = ramp_over(view)
    place = lambda X: (frame.origin[1] - X[1] + 100.0, X[0] - frame.origin[0] + 100.0)
    raster = SceneRaster(np.add(*np.indices((200, 200), float))[None], "float64", place)
    with_raster = FlightView("r", view.flight, view.earth, scene=raster)
    for kind, said in ((STRAIGHT, False), (ORBIT, True)):
        chosen = with_raster.choose(values := with_raster.values({"track": kind}))
        drawn, _ = with_raster._draw_pictures(chosen, values)
        assert ("a pattern is in its place" in drawn) == said
