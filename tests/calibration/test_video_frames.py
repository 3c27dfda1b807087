"""Frames of videos: sharp, different, of the same instants."""

import cv2
import numpy as np
import pytest

import jaxbundle
from jaxbundle.errors import InputError

RATE, REST, MOTION, POSES = 20, 11, 10, 6
"""Frames a second, of a rest and of the motion between two, and rests."""


def picture(shift, seed=5):
    """Patches of ten pixels, moved."""
    cells = np.random.default_rng(seed).integers(20, 235, (40, 60)).astype(np.uint8)
    whole = cv2.resize(cells, None, fx=10, fy=10, interpolation=cv2.INTER_NEAREST)
    return whole[:240, int(shift) : int(shift) + 320]


def write(path, delay=0, rate=RATE, blurred=()):
    """A board that rests at six places; between them it moves and is blurred, and at the rests
    of `blurred` too."""
    video = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), rate, (320, 240))
    for _ in range(delay):
        video.write(np.full((240, 320, 3), 90, np.uint8))
    for pose in range(POSES):
        for k in range(REST + MOTION):
            moving = k >= REST
            shift = 45 * pose + max(k - REST, 0) * 45 / MOTION
            frame = picture(shift)
            if moving or pose in blurred:
                frame = cv2.blur(frame, (15, 1))
            video.write(cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR))
    video.release()
    return path


def rest_of(frame):
    """The rest of a frame, −1 in motion."""
    pose, k = divmod(frame, REST + MOTION)
    return pose if k < REST else -1


def test_one_sharp_frame_of_every_rest(tmp_path):
    chosen = jaxbundle.frames(write(tmp_path / "a.avi"), tmp_path / "out")
    assert [rest_of(k) for k in chosen.number[0]] == list(range(POSES))
    assert np.allclose(chosen.time, chosen.number / RATE)
    files = sorted((tmp_path / "out" / "a").iterdir())
    assert [int(f.stem[-6:]) for f in files] == chosen.number[0].tolist()
    # without loss beyond that of the video
    shown = cv2.imread(str(files[2]), 0).astype(float)
    assert np.abs(shown - picture(90)).mean() < 3
    assert jaxbundle.frames(tmp_path / "a.avi", tmp_path / "few", number=3).number.shape == (1, 3)


def test_frames_of_several_videos_are_of_the_same_instants(tmp_path):
    """The second begins 13 frames later; where one is blurred the other is not chosen either."""
    left = write(tmp_path / "left.avi", blurred=(1,))
    right = write(tmp_path / "right.avi", delay=13, blurred=(4,))
    chosen = jaxbundle.frames([left, right], tmp_path / "out", first=[0, 13])
    assert np.array_equal(chosen.number[1], chosen.number[0] + 13)
    rests = {rest_of(k) for k in chosen.number[0]}
    assert {0, 2, 3, 5} <= rests and not rests & {1, 4}
    names = [sorted(f.name for f in folder.iterdir()) for folder in chosen.folders]
    assert names[0] == names[1]


def test_every_frame_of_videos_that_are_not_synchronised(tmp_path):
    """Of different rates; the table has camera, image and time as `calibrate-rig` takes them."""
    from types import SimpleNamespace

    from jaxbundle.calibration.rig.times import times_of_photographs

    a, b = write(tmp_path / "a.avi"), write(tmp_path / "b.avi", rate=25, delay=5)
    made = jaxbundle.frames([a, b], tmp_path / "out", every=7, first=[0, 5])
    files = [sorted(f.name for f in folder.iterdir()) for folder in made.folders]
    assert files[0] == files[1] == list(made.image)
    assert made.number[0].tolist() == list(range(0, POSES * (REST + MOTION), 7))
    found = times_of_photographs(
        {n: SimpleNamespace(views=SimpleNamespace(photographs=made.image)) for n in "ab"},
        tmp_path / "out" / "frames.csv",
    )
    for name, number, rate in zip("ab", made.number, (20, 25)):
        assert np.allclose([found[name][image] for image in made.image], number / rate)
    with pytest.raises(InputError, match="every"):
        jaxbundle.frames(a, tmp_path / "none", every=0)


def test_what_is_no_set_of_simultaneous_videos(tmp_path):
    a, b = write(tmp_path / "a.avi"), write(tmp_path / "b.avi", rate=25)
    text = tmp_path / "text.avi"
    text.write_text("no video")
    out = tmp_path / "out"
    for videos, options, said in [
        ([a, b], {}, "b.avi: 25 frames a second, but .*a.avi has 20"),
        ([text], {}, "not a video"),
        ([tmp_path / "none.mp4"], {}, "no such file"),
        ([a, a], {}, "given twice"),
        ([a], {"first": [500]}, "has 126 frames, the first one is given as 500"),
        ([a], {"first": [0, 1]}, "first: expected 1 frame number"),
        ([a], {"number": 0}, "number"),
    ]:
        with pytest.raises(InputError, match=said):
            jaxbundle.frames(videos, out, **options)
    assert not out.exists()
