"""A wand and boards in one rig: cameras that see boards, and cameras that see only the wand."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import test_wand as room
import wand_scenes as scenes

import jaxbundle
from jaxbundle.calibration import Wand
from jaxbundle.calibration.rig.declare import ROLLS
from jaxbundle.calibration.rig.wand_body import _ends, _stick_to_rig, add_wand
from jaxbundle.errors import InputError
from jaxbundle.geometry import matrix_from_rotation_vector, quaternion_from_matrix
from jaxbundle.leastsquares import Pose, PoseValue

FREE = ("fx", "fy", "cx", "cy")
LENGTHS = {("A", "B"): 0.15, ("B", "C"): 0.35}


def rig_of(boards, given=room.waved, seed=0, views=None):
    """The rig of all four cameras; `boards`: those that see the board, `views` of some of them."""
    others = {name: room.CAMERAS[name] for name in room.NAMES if name not in boards}
    wand = Wand(given(30, seed), LENGTHS, 1e-4, others)
    views = {name: scenes.views_of_board(room, name, seed) for name in boards} | (views or {})
    return jaxbundle.calibrate_rig(
        views, wand=wand, free=FREE, cross_validation=False, correlated=False
    )


def test_the_ends_of_a_wand():
    """The two markers farthest apart: of a given length, or of the sum of two with both errors."""
    assert _ends({("A", "B"): 0.5}, 1e-4) == (("A", "B"), 0.5, 1e-4)
    ends, length, sigma = _ends(LENGTHS, 1e-4)
    assert set(ends) == {"A", "C"} and length == 0.5 and np.isclose(sigma, 1e-4 * 2**0.5)
    assert _ends({**LENGTHS, ("C", "A"): 0.499}, 1e-4) == (("C", "A"), 0.499, 1e-4)


def test_the_roll_of_a_stick():
    """A stick's frame has its axis along x, and its roll is pinned: zero at the start, sine of a
    rotation about the stick."""
    rng, space = np.random.default_rng(0), Pose()
    a, b = rng.normal(size=(2, 3))
    T = _stick_to_rig(a, b)
    half = np.linalg.norm(b - a) / 2
    ends = np.array([[-half, 0, 0], [half, 0, 0]]) @ T[:3, :3].T + T[:3, 3]
    assert np.allclose(ends, [a, b]) and np.isclose(np.linalg.det(T[:3, :3]), 1)
    for roll in (0.0, 0.3):
        M = T[:3, :3] @ np.asarray(matrix_from_rotation_vector(np.array([roll, 0, 0])))
        value = PoseValue(np.zeros(3), quaternion_from_matrix(M))
        found = float(ROLLS.residual(space.prepare(value), T[:3, 2]))
        assert np.isclose(abs(found), np.sin(roll), atol=1e-12)


def test_what_is_refused(tmp_path):
    views = {"c0": scenes.views_of_board(room, "c0"), "c1": scenes.views_of_board(room, "c1")}
    marks = room.waved(3)
    with pytest.raises(InputError, match="two cameras at least"):
        Wand({"c0": marks["c0"]}, 0.5, 1e-4)
    wand = Wand(marks, LENGTHS, 1e-4)
    for options in ({"synchronize": "offset", "times": 30.0}, {"board_free": True}):
        with pytest.raises(InputError, match="wand: expected cameras that are synchronised"):
            # Before the photographs are searched.
            jaxbundle.calibrate_rig(dict.fromkeys(views, tmp_path / "none"), wand=wand, **options)
    markers = SimpleNamespace(markers={})
    seen = SimpleNamespace(ends=("A", "C"), points=lambda _: {}, calibration=markers)
    with pytest.raises(InputError, match="no frame shows both ends of it, 'A' and 'C', to two"):
        add_wand(SimpleNamespace(cameras=()), seen, SimpleNamespace(mountings=[]), {})
    from jaxbundle.cli.calibrate_rig import wand_given

    one = (["c0=a.csv"], ["0.5"], None, None, {"c0": ""}, "m", None)
    for change, words in (
        ({0: None}, "--wand-length: is of a wand"),
        ({1: None}, "--wand-length: the length of the wand is missing"),
        ({0: ["c0=a.csv", "c0=b.csv"]}, "two sources are given"),
        ({0: ["c0=a.csv", "c9=b.csv"]}, "no folder of camera 'c9'"),
        ({5: "inch"}, "--wand-sigma"),
    ):
        with pytest.raises(InputError, match=words):
            wand_given(*(change.get(k, value) for k, value in enumerate(one)))


@pytest.mark.further
def test_boards_and_a_wand(tmp_path):
    """Two cameras see a board, two only the wand: truth within σ, one scale; also of a single
    camera with a board. What is known of the length adds to that of the boards."""
    found = rig_of(("c0", "c1"))
    assert found.converged and 0.85 < found.sigma0 < 1.15
    assert found.names == list(room.NAMES) and set(found.cameras) == {"c0", "c1"}
    over, turns = room.errors(found)
    assert np.abs(over).max() < 4 and turns.max() < 2e-3
    value, sigma = found.wand_length
    assert abs(value - 0.5) < 4 * sigma and sigma < 1.5e-4
    assert set(found.rms) == set(room.NAMES) and "Wand" in found.report()
    rows = found.residuals
    assert {"c3 wand 0", "c0 f_000 board"} <= {*rows["image"]}
    both = jaxbundle.calibration.Calibrations(found.cameras, found)
    for _ in range(2):  # its own folder is written again
        jaxbundle.calibration.write_calibrations(both, tmp_path / "out", plots=False)
    assert (tmp_path / "out" / "rig_c3.toml").is_file()

    alone = rig_of(("c0",))
    assert alone.converged and np.abs(room.errors(alone)[0]).max() < 4
    written = tmp_path / "alone"
    one = jaxbundle.calibration.Calibrations(alone.cameras, alone)
    jaxbundle.calibration.write_calibrations(one, written, plots=False)
    assert (written / "rig_c3.toml").is_file() and "c3" in (written / "report.txt").read_text()


@pytest.mark.further
def test_cameras_that_see_no_board_together():
    """Cameras that see the board at different epochs are tied by the wand; without it they are
    refused. A length of the wand that contradicts the boards is removed, and said."""
    late = scenes.views_of_board(room, "c1")
    names = tuple(f"f_{100 + k}.png" for k in range(len(late.names)))
    late = dataclasses.replace(late, names=names, photographs=names)
    options = {"free": FREE, "cross_validation": False, "correlated": False}
    with pytest.raises(InputError, match="paired by their names"):
        jaxbundle.calibrate_rig({"c0": scenes.views_of_board(room, "c0"), "c1": late}, **options)
    tied = rig_of(("c0", "c1"), views={"c1": late})
    assert np.abs(room.errors(tied)[0]).max() < 4
    assert "no board is seen by two cameras at the same time" in " ".join(tied.report().split())
    long = {"A": 0.0, "B": 0.1515, "C": 0.505}
    wrong = rig_of(("c0", "c1"), lambda n, seed: room.waved(n, seed, markers=long))
    assert [item.name for item in wrong.removed] == ["the length of the wand"]
    assert "contradicts the boards" in wrong.report()
    assert abs(wrong.wand_length[0] - 0.505) < 4 * wrong.wand_length[1]
    assert np.abs(room.errors(wrong)[0]).max() < 4
