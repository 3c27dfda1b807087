"""Cameras that are not synchronised: clocks against the truth, what is not determined, times."""

from types import SimpleNamespace

import numpy as np
import pytest
import video_scenes as scenes
from rig_scenes import LENSES
from scipy.spatial.transform import Rotation

import jaxbundle
from jaxbundle.calibration.rig.connections import BoardView
from jaxbundle.calibration.rig.start_offsets import (
    OffsetSettings,
    speeds_of_cameras,
    start_offsets,
)
from jaxbundle.calibration.rig.times import times_of_photographs
from jaxbundle.calibration.rig.trajectory import (
    Clocks,
    TargetMotion,
    control_poses,
    plan_runs,
)
from jaxbundle.cameras import get_model
from jaxbundle.errors import InputError
from jaxbundle.leastsquares import PoseValue

OPTIONS = {
    "times": 30.0, "cross_validation": False, "correlated": False, "free": scenes.FREE,
    "snooping": None, "sigma_image": 0.05,
}  # fmt: skip


def views_of(motion, cameras="abc", frames=90, rate=30.0):
    """Exact poses of the board in every camera, and the time of every photograph."""
    views, time = [], []
    for k, camera in enumerate(cameras):
        t = np.arange(frames) / rate
        offset, drift = scenes.CLOCKS[camera]
        R, place = motion(t + offset + drift * (t - t.mean()))
        T = np.tile(np.eye(4), (frames, 1, 1))
        T[:, :3, :3], T[:, :3, 3] = R, place
        views += [
            BoardView(k, 0, len(time) + i, scenes.MOUNTINGS[camera] @ one, 48)
            for i, one in enumerate(T)
        ]
        time += t.tolist()
    return views, np.array(time)


def found_offsets(motion, cameras="abc", settings=OffsetSettings()):
    views, time = views_of(motion, cameras)
    frame = np.full(len(cameras), 1 / 30)
    speeds = speeds_of_cameras(views, time, [0], frame, settings)
    return start_offsets(speeds, frame, settings)


def test_offsets_start_within_a_part_of_a_frame():
    truth = [scenes.CLOCKS[name][0] for name in "abc"]
    assert np.abs(found_offsets(scenes.by_hand) - truth).max() < 0.1 / 30


def test_no_offset_starts_from_an_even_motion():
    """Speeds that do not change tell nothing."""
    assert np.isnan(found_offsets(scenes.at_rest)[1:]).all()


def test_runs_end_at_gaps_and_need_photographs():
    """Two bodies, a gap, too few photographs; half as many control poses as photographs."""
    t = np.concatenate([np.arange(40), 50 + np.arange(30), 200 + np.arange(5), np.arange(20)]) / 30
    body = np.repeat([0, 1], [75, 20])
    runs, run = plan_runs(body, t, 0.1, 0.1)
    assert [(run == k).sum() for k in (-1, 0, 1, 2)] == [5, 40, 30, 20]
    assert (run[70:75] == -1).all() and len(runs) == 3
    for k, one in enumerate(runs):
        own = t[run == k]
        assert one.start == own.min() and one.spacing > 0.09
        assert np.isclose(one.start + one.intervals * one.spacing, own.max())
        assert one.controls <= len(own) / 2 + 1e-9
    controls = [one.controls for one in runs]
    assert [one.first_control for one in runs] == [0, *np.cumsum(controls)[:2]]
    # photographs of two cameras at one time count once
    assert plan_runs(np.zeros(14, int), np.repeat(np.arange(7) / 30, 2), 0.1, 0.1)[0] == ()


def trajectory_of(motion, frames=60, spacing=0.1):
    """The trajectory of exact poses of two cameras, and these."""
    views, time = views_of(motion, "ab", frames)
    own = np.repeat([0, 1], frames)
    offset = np.array([[*scenes.CLOCKS[name], 0.0] for name in "ab"])
    clocks = Clocks(offset, np.ones((2, 3), bool), np.ones((2, 3)), np.full(2, 29.5 / 30))
    common = clocks.common(own, time)
    R, place = motion(common)
    M = R.swapaxes(1, 2)
    pose = PoseValue(-np.einsum("nji,nj->ni", R, place), np.roll(
        Rotation.from_matrix(R).as_quat(), 1, axis=-1))  # fmt: skip
    runs, run = plan_runs(np.zeros(len(own), int), common, spacing, spacing)
    poses = control_poses(runs, run, common, pose)
    return TargetMotion(clocks, own, time, run, runs, poses, 1 / 30), pose, M


def test_control_poses_start_near_the_motion():
    """The spline of start values is off by a part of the square of the distance of knots."""
    worst = []
    for spacing in (0.2, 0.1):
        trajectory, pose, _ = trajectory_of(scenes.by_hand, spacing=spacing)
        at = trajectory.view_poses(trajectory.poses, trajectory.clocks.value)
        inner = np.abs(trajectory.time - 29.5 / 30) < 0.5
        R = Rotation.from_quat(np.roll(at.rotation, -1, axis=-1))
        S = Rotation.from_quat(np.roll(pose.rotation, -1, axis=-1))
        worst.append((
            np.abs(at.position - pose.position)[inner].max(),
            (R * S.inv()).magnitude()[inner].max(),
        ))  # fmt: skip
    assert worst[1][0] < 2e-3 and worst[1][1] < 5e-3
    assert (np.array(worst[0]) > 3 * np.array(worst[1])).all()


def test_instants_are_in_their_intervals():
    """With the clocks, the place within the interval is between 0 and 1; a change of the clocks
    moves it without a jump."""
    trajectory, _, _ = trajectory_of(scenes.by_hand)
    rows, line = np.arange(len(trajectory.time)), np.zeros(len(trajectory.time))
    first, instant = trajectory.intervals(rows, line)
    clock = trajectory.clocks.value[trajectory.camera].T
    u = instant.place(tuple(clock))
    assert (u > -1e-6).all() and (u < 1 + 1e-6).all()
    assert first.max() + 3 == trajectory.runs[-1].first_control + trajectory.runs[-1].controls - 1
    later = trajectory.with_clocks(trajectory.clocks.value + [0.25, 0, 0])
    moved, instant = later.intervals(rows, line)
    assert (moved >= first).all() and (moved > first).any()


CAMERAS = {"left": SimpleNamespace(views=SimpleNamespace(photographs=("f_07.png", "f_09.png"))),
           "right": SimpleNamespace(views=SimpleNamespace(photographs=("x/f_1.png",)))}  # fmt: skip


def test_times_in_every_form(tmp_path):
    assert times_of_photographs(CAMERAS, 10)["left"] == {"f_07.png": 0.7, "f_09.png": 0.9}
    rates = times_of_photographs(CAMERAS, {"left": 10.0, "right": 4})
    assert rates["right"] == {"x/f_1.png": 0.25}
    table = tmp_path / "frames.csv"
    table.write_text(
        "video,frame,image,time,sharpness\nleft,7,f_07.png,0.5,1\nleft,9,f_09.png,0.6,1\n"
        "right,1,f_1.png,3.25,1\n"
    )
    found = times_of_photographs(CAMERAS, table)
    assert found == {"left": {"f_07.png": 0.5, "f_09.png": 0.6}, "right": {"x/f_1.png": 3.25}}
    table.write_text("camera,image,time\nleft,f_07.png,0.5\nleft,f_07.png,0.6\n")
    with pytest.raises(InputError, match="image 'f_07.png' of camera 'left' is there twice"):
        times_of_photographs(CAMERAS, table)


@pytest.mark.parametrize(("given", "words"), [
    (0, "times of camera 'left'.*frames per second"),
    (True, "times of camera 'left'"),
    ({"left": 30}, "nothing is given of camera 'right'"),
    ({"left": 30, "rihgt": 30}, "no camera 'rihgt'"),
    ({"left": {"f_07.png": 1}, "right": 30}, "none of 'f_09.png'"),
    ({"left": {"f_07.png": 1, "f_09.png": np.nan}, "right": 30}, "'f_09.png' it is nan"),
    ({"left": {"f_07.png": 1, "f_09.png": 1.0}, "right": 30}, "f_07.png and f_09.png both have 1"),
])  # fmt: skip
def test_times_that_cannot_be(given, words):
    with pytest.raises(InputError, match=words):
        times_of_photographs(CAMERAS, given)


def test_times_on_the_command_line(tmp_path):
    """Frames per second, of each camera, a table; by default that which `frames` writes."""
    from jaxbundle.cli.calibrate_rig import times_given

    cameras = {name: str(tmp_path / name) for name in ("left", "right")}
    assert times_given("30", cameras) == 30
    assert times_given("left=30, right=25", cameras) == {"left": 30, "right": 25}
    with pytest.raises(InputError, match=r"there is no .*frames.csv; give --times"):
        times_given("", cameras)
    table = tmp_path / "frames.csv"
    table.write_text("video,image,time\n")
    assert times_given("", cameras) == times_given(str(table), cameras) == table
    for bad in ("fast", "left=30=2", "left=x"):
        with pytest.raises(InputError, match="--times: expected frames per second"):
            times_given(bad, cameras)


@pytest.mark.parametrize(("options", "words"), [
    ({"synchronize": "offset"}, "times of the photographs are missing"),
    ({"synchronize": "ofset", "times": 30}, "synchronize must be one of offset, rate, read-out"),
    ({"times": 30}, "give synchronize"),
    ({"synchronize": True, "times": 30}, "synchronize: got True; expected unknowns"),
    ({"synchronize": "offset", "times": 30, "board_free": True}, "board_free: points"),
])  # fmt: skip
def test_options_that_contradict(options, words):
    with pytest.raises(InputError, match=words):
        jaxbundle.calibrate_rig({"a": ["a"], "b": ["b"]}, scenes.BOARD, **options)


@pytest.fixture(scope="module")
def calibrated():
    """The cameras by themselves, of the motion by hand."""
    from jaxbundle.calibration import calibrate

    own = {k: v for k, v in OPTIONS.items() if k != "times"}
    return {k: calibrate(scenes.video(k, 60), camera=k, **own) for k in "ab"}


@pytest.mark.further
def test_clocks_are_found(calibrated):
    """Offset to 0.1 ms, rate, and mounting, within their σ of the truth; no photograph is left out;
    the report, the JSON and the residuals name them."""
    rig = jaxbundle.calibrate_rig(
        calibrated, synchronize=["offset", "rate"], times=30.0, snooping=None
    )
    clock, (offset, rate) = rig.clocks["b"], scenes.CLOCKS["b"]
    assert not clock.held and clock.estimated == ("offset", "rate")
    assert abs(clock.offset - offset) < min(1e-4, 4 * clock.sigma[0])
    assert abs(clock.rate - rate) < 4 * clock.sigma[1]
    assert rig.clocks["a"].estimated == () and rig.clocks["a"].offset == 0
    T, mounting = scenes.MOUNTINGS["b"], rig.mountings["b"]
    assert (np.abs(mounting.base + T[:3, :3].T @ T[:3, 3]) < 4 * mounting.sigma[:3]).all()
    assert not rig.left_out and not rig.contradicting and 0.9 < rig.sigma0 < 1.1
    said = rig.to_dict(brief=True)["clocks"]["b"]
    assert said["offset"] == {"value": clock.offset, "sigma": clock.sigma[0]}
    assert "Clocks" in rig.report() and "clock of b: offset 432." in str(rig)
    frame = lambda k, i: f"{k} frame_{i:06d}.png"
    assert set(rig.residuals["image"]) == {frame(k, i) for k in "ab" for i in range(60)}
    # the pose of a photograph, of the spline and of the truth
    pose, frames = rig.values("epoch"), [rig.rig.epochs.index(frame("a", i)) for i in (5, 30)]
    R, place = scenes.by_hand(np.array([5, 30]) / 30)
    X0 = -np.einsum("nji,nj->ni", R, place)
    assert np.abs(pose.position[frames] - X0).max() < 1e-3


@pytest.mark.further
def test_an_even_motion_leaves_the_offset_open():
    """A target with constant velocity: said, held, and the rest is adjusted with it."""
    from jaxbundle.calibration import calibrate

    own = {k: v for k, v in OPTIONS.items() if k != "times"} | {"free": ("fx",)}
    names = get_model("opencv").parameters
    # the rest of the interior orientations is known: a board that does not turn does not show it
    given = {
        k: calibrate(
            scenes.video(k, 60, motion=scenes.evenly),
            camera=k,
            given=dict(zip(names, lens.parameters)),
            **own,
        )
        for k, lens in zip("ab", LENSES)
    }
    rig = jaxbundle.calibrate_rig(given, synchronize="offset", times=30.0, snooping=None)
    clock = rig.clocks["b"]
    assert clock.offset == 0 and "offset" in clock.held and "evenly" in clock.held["offset"]
    assert "not determined" in rig.report()


def test_scenes_have_the_whole_board():
    """The simulated videos show it in every frame."""
    for k in "abc":
        assert len(scenes.video(k, 90).names) == 90
