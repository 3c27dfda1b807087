"""Rigs of any boards: truth within σ, by overlaps and by motion; what is no rig; the command."""

import json

import cv2
import numpy as np
import pytest
import render
import rig_scenes as scenes
from rig_scenes import BACK, CHAIN, REAR

import jaxbundle
from jaxbundle.calibration.rig.report import rig_dict, rig_text
from jaxbundle.io import read_boards, read_network
from jaxbundle.measure import Board

OPTIONS = {"cross_validation": False, "correlated": False, "free": scenes.FREE}


def error_of(mounting, truth):
    """Base and rotation vector minus the truth, over their σ."""
    R, base = truth[:3, :3], -truth[:3, :3].T @ truth[:3, 3]
    D = mounting.rotation @ R.T
    turn = np.degrees([D[2, 1] - D[1, 2], D[0, 2] - D[2, 0], D[1, 0] - D[0, 1]]) / 2
    # of angles near 0 or a half turn, ω, φ, κ are the rotation vector up to their signs
    return np.concatenate([(mounting.base - base) / mounting.sigma[:3], turn / mounting.sigma[3:]])


@pytest.fixture(scope="module")
def chain():
    return jaxbundle.calibrate_rig(scenes.chain(epochs=6), **OPTIONS)


@pytest.fixture(scope="module")
def back_to_back():
    return jaxbundle.calibrate_rig(scenes.back_to_back(), fixed=True, **OPTIONS)


@pytest.mark.further
def test_a_chain_of_overlaps_is_one_rig(chain):
    assert chain.converged and len(chain.epochs) == 18 and not chain.ties and not chain.left_out
    for name, truth in list(CHAIN.items())[1:]:
        assert np.abs(error_of(chain.mountings[name], truth)).max() < 3.5
    # the farther in the chain, the weaker
    lengths = [m.length_sigma for m in chain.mountings.values()]
    assert lengths == sorted(lengths)
    assert chain.advice[-1].startswith("next: the position of 'c3' is the weakest")
    # neighbours see the board there at the same time
    assert "'c2'" in chain.advice[-1] and "see it: σ would be 0." in chain.advice[-1]


@pytest.mark.further
def test_cameras_back_to_back_are_tied_by_motion(back_to_back):
    found = back_to_back
    assert found.converged and found.bodies == [("front", "rear")] and len(found.epochs) == 16
    assert np.abs(error_of(found.mountings["b"], BACK)).max() < 3.5
    place = found.placements["rear"]
    assert np.abs((place.base - REAR[:3, 3]) / place.sigma[:3]).max() < 3.5
    np.testing.assert_allclose(place.rotation, REAR[:3, :3].T, atol=5e-3)
    np.testing.assert_allclose(np.diag(place.correlation), 1)
    assert found.rms["a"] == pytest.approx(0.05 * np.sqrt(2), rel=0.1)
    text, numbers = rig_text(found), rig_dict(found, brief=True)
    for said in ("Tied by motion", "a (front) and b (rear), 14 epochs", "Fixed to each other",
                 "Board rear in the frame of board front", "Correlations"):  # fmt: skip
        assert said in text
    assert numbers["ties_by_motion"][0]["epochs"] == 14
    assert numbers["boards"]["places"]["rear"]["base"] == place.base.tolist()
    assert len(numbers["mountings"]["b"]["correlation"]) == 6
    assert "rotate the rig about an axis across this direction" in numbers["advice"][-1]
    assert found.board.shape == (2 * 42, 3) and 0.4 < found.distance < 0.65


@pytest.mark.further
def test_epochs_that_contradict_the_motion_are_left_out():
    """The rear board was moved at two epochs."""
    found = jaxbundle.calibrate_rig(scenes.back_to_back(moved=(3, 10)), fixed=True, **OPTIONS)
    assert {epoch for epoch, _ in found.left_out} == {"3", "10"} and len(found.epochs) == 14
    assert np.abs(error_of(found.mountings["b"], BACK)).max() < 3.5


@pytest.mark.further
@pytest.mark.parametrize("together", [True, False])
def test_several_boards_in_a_photograph(together):
    """Two boards fixed to each other and moved; or each with poses of its own."""
    bodies = {"book": ["first", "second"]} if together else None
    found = jaxbundle.calibrate_rig(scenes.book(), bodies=bodies, **OPTIONS)
    assert len(found.epochs) == 14 and len(found.rig.epochs) == (14 if together else 28)
    assert np.abs(error_of(found.mountings["b"], scenes.PAIR["b"])).max() < 3.5
    assert list(found.placements) == ["second"] * together
    for place in found.placements.values():
        assert np.abs((place.base - scenes.PAGE[:3, 3]) / place.sigma[:3]).max() < 3.5
        np.testing.assert_allclose(place.rotation, scenes.PAGE[:3, :3].T, atol=1e-3)
    assert "Board second  charuco" in found.cameras["a"].report()
    with pytest.raises(jaxbundle.InputError, match="points of 2 boards cannot be free"):
        jaxbundle.calibrate_rig(found.cameras, board_free=True)


@pytest.mark.further
def test_what_is_known_closes_what_a_motion_leaves_open():
    """The rig turns about one axis only, as on a floor: the height of the other camera is given."""
    views = scenes.back_to_back(kind="axis")
    with pytest.raises(jaxbundle.NotSolvedError, match="rotations of the rig are about one axis"):
        jaxbundle.calibrate_rig(views, fixed=True, **OPTIONS)
    known = {"b": {"position": [0, 0.031, 0], "sigma_position": [np.inf, 0.001, np.inf]}}
    found = jaxbundle.calibrate_rig(views, fixed=True, mountings=known, **OPTIONS)
    assert found.ties[0].open == 1
    mounting = found.mountings["b"]
    assert np.abs((mounting.base - [0.02, 0.03, 0.12]) / mounting.sigma[:3]).max() < 3.5
    # σ of the height is that given, times σ0; the others follow from the motion
    assert mounting.sigma[1] == pytest.approx(0.001 * found.sigma0, rel=0.1)
    # of a σ that says nothing the position stays unknown, which the verdict says
    known["b"]["sigma_position"] = 2.0
    vague = jaxbundle.calibrate_rig(found.cameras, fixed=True, mountings=known)
    both = jaxbundle.calibration.Calibrations(vague.cameras, vague)
    assert "positions not determined: b" in both.report()[:1000]
    assert "the position of 'b' is not determined along (0.00, 1.00, 0.00)" in vague.advice[0]
    # held
    known["b"] = {"position": [0.02, 0.03, 0.12]}
    held = jaxbundle.calibrate_rig(found.cameras, fixed=True, mountings=known).mountings["b"]
    assert not held.sigma[:3].any() and (held.base == [0.02, 0.03, 0.12]).all()


@pytest.mark.further
def test_a_given_base(chain):
    bases = [{"cameras": ["c0", "c3"], "length": 0.842, "sigma": 1e-6}]
    found = jaxbundle.calibrate_rig(chain.cameras, bases=bases)
    assert found.mountings["c3"].length == pytest.approx(0.842, abs=1e-5)
    assert found.mountings["c3"].length_sigma < 1e-6 < found.mountings["c2"].length_sigma


BOARDS = """
[board.front]
columns = 9
rows = 6
square = 0.03
cameras = ["left"]

[board.rear]
columns = 7
rows = 6
square = 0.03
cameras = ["right"]
"""
FRONT, BEHIND = Board(9, 6, 0.03), Board(7, 6, 0.03)
LENS = render.Lens.of(fx=330.0, fy=330.0, cx=240.0, cy=179.0, k1=-0.05)
PHOTOGRAPHS = 7


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Photographs of two cameras back to back between two chessboards, and the file of these."""
    folder = tmp_path_factory.mktemp("rig")
    (folder / "boards.toml").write_text(BOARDS)
    for name in ("left", "right"):
        (folder / name).mkdir()
    rng = np.random.default_rng(5)
    for e in range(PHOTOGRAPHS):
        angles = [*rng.uniform(-20, 20, 2), (0, 90, 180, 270)[e % 4] + rng.uniform(-9, 9)]
        R = scenes.rotation(*angles)
        at = FRONT.points.mean(0) + [*rng.uniform(-0.03, 0.03, 2), 0.5]
        front = scenes.matrix(R, -R @ at)
        middle = scenes.matrix(np.eye(3), FRONT.points.mean(0) - BEHIND.points.mean(0))
        rear = BACK @ front @ REAR @ middle
        for name, T, board in (("left", front, FRONT), ("right", rear, BEHIND)):
            M = T[:3, :3]
            pattern = render.chessboard(board.columns, board.rows, board.square)
            grey = render.photograph(LENS, M, -M.T @ T[:3, 3], pattern, seed=e)
            cv2.imwrite(str(folder / name / f"{name}_{e:02d}.png"), grey)
    return folder


@pytest.fixture
def calibrate_rig(command):
    return lambda *arguments: command("calibrate-rig", *arguments)


@pytest.mark.further
def test_photographs_to_a_rig(calibrate_rig, folders, tmp_path):
    """By the command: two chessboards on walls, and what it writes for other programs."""
    code, told, error = calibrate_rig(
        folders / "left", folders / "right", "--board", folders / "boards.toml", "--fixed",
        "--no-cross-validation", "--no-correlated", "--free", "fx,fy,cx,cy,k1", "--no-plots",
        "--json", tmp_path / "rig.json", "--out", tmp_path / "out",
    )  # fmt: skip
    assert (code, error) == (0, "")
    assert "Tied by motion" in told and "left (front) and right (rear)" in told
    written = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"rig", "rig_left.toml", "left", "right", "report.txt", "result.json"} <= written
    files = {path.name for path in (tmp_path / "out" / "rig").iterdir()}
    assert {"camchain.yaml", "calibration.toml", "stereo.yaml", "mrcal"} <= files
    result = json.loads((tmp_path / "rig.json").read_text())
    rig = result["rig"]
    assert result["converged"] and rig["boards"]["bodies"] == [["front", "rear"]]
    off = np.array(rig["mountings"]["right"]["base"]) - [0.02, 0.03, 0.12]
    assert np.abs(off / rig["mountings"]["right"]["sigma_base"]).max() < 4
    assert result["calibrations"]["left"]["calibration"]["boards"]["front"]["columns"] == 9
    network = read_network(tmp_path / "rig.json")
    assert [camera.id for camera in network.cameras] == ["left", "right"]


@pytest.mark.further
def test_folders_that_cannot_be_a_rig(calibrate_rig, folders, tmp_path):
    """Status 2 and one line: what is wrong, where, and what to do; nothing is written."""
    for name in ("empty", "grey", "mixed", "left", "right"):
        (tmp_path / name).mkdir()
    left, right, boards = tmp_path / "left", tmp_path / "right", folders / "boards.toml"
    for e in range(3):
        cv2.imwrite(str(tmp_path / "grey" / f"{e}.png"), np.full((90, 120), 99, np.uint8))
        for side in (left, right):
            picture = cv2.imread(str(folders / side.name / f"{side.name}_{e:02d}.png"))
            cv2.imwrite(str(side / f"{side.name}_{e:02d}.png"), picture)
            whole = None if e < 2 else -8
            if side is left:
                cv2.imwrite(str(tmp_path / "mixed" / f"{e}.png"), picture[:whole])
    one = ("--board", "9x6", "--square", 0.03)
    for arguments, said in (
        ((left, *one), "a rig has at least two cameras: give a folder of photographs for each"),
        ((left, left, *one), "camera 'left' is given twice"),
        ((left, f"b={left}", *one), "left_00.png is given for camera 'left' and for camera 'b'"),
        ((left, tmp_path / "empty", *one), "empty: no photographs in this folder"),
        ((left, folders / "none", *one), "none: no such folder; expected a folder of photographs"),
        ((left, tmp_path / "grey", *one), "camera grey: no photograph of 3 shows the board"),
        ((tmp_path / "mixed", left, *one), "camera mixed: photographs have different sizes: 2 photo"
         "graphs of 480 × 360 pixels (0.png), 1 photograph of 480 × 352 pixels (2.png); expected"),
        ((f"left={right}", f"right={left}", "--board", boards), "But they show board 'rear', which "
         "other cameras are to see: are the folders swapped?"),
        ((left, right, "--board", boards, "--square", 1), "--square: "),
        ((left, f"b={right}", "--board", boards), "board 'rear' is to be seen by a camera 'right', "
         "which is not given"),
    ):  # fmt: skip
        code, told, error = calibrate_rig(*arguments, "--json", tmp_path / "result.json")
        assert code == 2 and not told, said
        assert said in error and error.count("\n") == 1
    assert not (tmp_path / "result.json").exists()


def test_files_of_boards(tmp_path):
    file = tmp_path / "boards.toml"
    file.write_text(BOARDS.replace("square", 'body = "room"\nsquare'))
    boards, bodies, seen_by = read_boards(file)
    assert boards == {"front": FRONT, "rear": BEHIND} and bodies == {"room": ["front", "rear"]}
    assert seen_by == {"front": ["left"], "rear": ["right"]}
    for text, said in (
        ("", "no boards; expected a section for each"),
        ("[board.a]\ncolumns = 9\nrows = 6", r"\[board.a\]: square is missing"),
        ("[board.a]\ncolumn = 9", r"\[board.a\]: unknown key 'column'; did you mean 'columns'"),
        ("[board.a]\ncolumns = 1\nrows = 6\nsquare = 1", r"\[board.a\]: board 1x6: a chessboard"),
        ("[board.a]\ntarget = 'x.yaml'\nrows = 6", "target gives the whole board; omit rows"),
        ("[board.a]\ncolumns = 9\nrows = 6\nsquare = 1\ncameras = 'x'", "cameras is 'x'; expected"),
        ("[boards.a]\ncolumns = 9", "unknown section"),
    ):
        file.write_text(text)
        with pytest.raises(jaxbundle.InputError, match=said):
            read_boards(file)
