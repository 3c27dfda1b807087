"""What ties the cameras of a rig: poses of boards only, exact or with noise."""

import numpy as np
import pytest
import rig_scenes as scenes
from rig_scenes import BACK, CHAIN, REAR, matrix, rotation

from jaxbundle.calibration.rig.connections import BoardView, body_pose, connect
from jaxbundle.calibration.rig.motion import medoid, tie_by_motion
from jaxbundle.errors import InputError, NotSolvedError

NAMES = list(CHAIN)


def seen(camera, board, epoch, pose, points=42):
    return BoardView(camera, board, epoch, pose, points)


def moved_boards(number, seed=0):
    """Poses of a board before a rig, board → rig."""
    rng = np.random.default_rng(seed)
    return [
        matrix(rotation(*rng.uniform(-30, 30, 3)), [*rng.uniform(-0.1, 0.1, 2), -0.5])
        for _ in range(number)
    ]


def overlaps(pairs, epochs=4, wrong=()):
    """Views of one moved board by pairs of cameras, each at epochs of its own; at those in `wrong`
    the board moved before the second."""
    views, poses = [], moved_boards(len(pairs) * epochs)
    for e, pose in enumerate(poses):
        for number, k in enumerate(pairs[e // epochs]):
            off = matrix(rotation(5, 0, 0), [0.1, 0, 0]) if number and e in wrong else np.eye(4)
            views.append(seen(k, 0, e, CHAIN[NAMES[k]] @ pose @ off))
    return views


def between_walls(kind="any", noise=0.0, wrong=()):
    """Views of two cameras, each of a board of its own."""
    rng, views = np.random.default_rng(3), []
    for e, pose in enumerate(scenes.motions(kind)):
        rear = BACK @ pose @ REAR
        if e in wrong:
            rear = rear @ matrix(rotation(0, 8, 0), [0.05, 0, 0])
        for k, T in enumerate((pose, rear)):
            R = rotation(*np.degrees(rng.normal(0, noise, 3))) if noise else np.eye(3)
            t = rng.normal(0, 0.5 * noise, 3) if noise else np.zeros(3)
            views.append(seen(k, k, e, matrix(R @ T[:3, :3], T[:3, 3] + t)))
    return views


def test_a_chain_is_followed_from_camera_to_camera():
    """The first and the last camera never see the board at the same time; an epoch is wrong."""
    views = overlaps([(0, 1), (1, 2), (2, 3)], wrong=(1, 6))
    found = connect(NAMES, ["board"], [0], views)
    np.testing.assert_allclose(found.mountings, [*CHAIN.values()], atol=1e-12)
    assert not found.ties and not found.separate and found.bodies == [[0]]
    poses = moved_boards(12)
    for view in views:
        if view.epoch not in (1, 6):
            np.testing.assert_allclose(body_pose(view, found), poses[view.epoch], atol=1e-12)


def test_the_way_with_most_common_epochs_is_taken():
    """Two epochs tie 0 and 2 wrongly, and would suffice if these saw the board at no others."""
    views = overlaps([(0, 1), (1, 2), (0, 2)], wrong=(8, 9, 10))
    kept = [v for v in views if v.epoch < 11]  # three epochs of 0 and 2, all wrong
    found = connect(NAMES[:3], ["board"], [0], kept)
    np.testing.assert_allclose(found.mountings, [*CHAIN.values()][:3], atol=1e-12)


@pytest.mark.parametrize("wrong", [(), (2, 9)])
def test_motion_ties_cameras_that_never_see_the_same_board(wrong):
    found = connect(["a", "b"], ["front", "rear"], [0, 0], between_walls(wrong=wrong))
    np.testing.assert_allclose(found.mountings[1], BACK, atol=1e-6)
    np.testing.assert_allclose(found.places[1], REAR, atol=1e-6)
    (tie,) = found.ties
    assert tie.cameras == (("a",), ("b",)) and tie.boards == (("front",), ("rear",))
    assert (tie.epochs, tie.open) == (16, 0)


def test_a_third_camera_comes_in_through_the_second():
    """b and c see the rear board, a only the front one."""
    third = matrix(rotation(2, 5, 1), [-0.2, 0.01, 0.0]) @ BACK
    views = between_walls()
    views += [seen(2, 1, v.epoch, third @ np.linalg.inv(BACK) @ v.pose)
              for v in views if v.camera == 1]  # fmt: skip
    found = connect(["a", "b", "c"], ["front", "rear"], [0, 0], views)
    np.testing.assert_allclose(found.mountings, [np.eye(4), BACK, third], atol=1e-9)
    assert found.ties[0].cameras == (("a",), ("b", "c"))


@pytest.mark.parametrize("noise", [0.0, 1e-3])
@pytest.mark.parametrize("kind, said, number", [
    ("axis", r"one axis, \(-?0.00, -?1.00, -?0.00\) in the frame of 'a': the position of 'b' along "
     "it is not determined; rotate the rig about a second axis", 1),
    ("shift", "only shifted, not rotated: the position of 'b' is not determined; rotate", 3),
])  # fmt: skip
def test_a_motion_that_does_not_suffice_is_named(kind, said, number, noise):
    views = between_walls(kind, noise)
    with pytest.raises(NotSolvedError, match=said):
        connect(["a", "b"], ["front", "rear"], [0, 0], views)
    # what is known of the position closes the gap; all else follows from the motion
    base = -BACK[:3, :3].T @ BACK[:3, 3]
    found = connect(["a", "b"], ["front", "rear"], [0, 0], views, {1: base})
    assert found.ties[0].open == number
    np.testing.assert_allclose(found.mountings[1], BACK, atol=1e-9 + 10 * noise)
    np.testing.assert_allclose(found.places[1], REAR, atol=1e-9 + 10 * noise)


def test_two_epochs_are_no_motion():
    views = [v for v in between_walls() if v.epoch < 2]
    with pytest.raises(InputError, match="2 groups.*or move the rig so that both see their boards"):
        connect(["a", "b"], ["front", "rear"], [0, 0], views)


def test_cameras_that_do_not_hang_together_are_named():
    views = overlaps([(0, 1), (2, 3)])
    with pytest.raises(InputError) as error:
        connect(NAMES, ["board"], [0], views)
    said = str(error.value)
    assert "2 groups that nothing ties together: 'c0', 'c1', which see the board; 'c2'," in said
    assert "photograph the board with 'c0' and 'c2' at the same time, at 3 epochs or more" in said
    few = [*overlaps([(0, 1)]), *(v._replace(epoch=v.epoch + 2) for v in overlaps([(2, 3)]))]
    with pytest.raises(InputError, match="see one board at the same time at 2 epochs only"):
        connect(NAMES, ["board"], [0], few)


def test_boards_that_may_be_fixed_are_asked_for():
    with pytest.raises(InputError, match="if their boards are fixed to each other, say so"):
        connect(["a", "b"], ["front", "rear"], [0, 1], between_walls())


def test_boards_of_a_body_that_nothing_relates_are_told():
    """Both cameras see one board at some epochs, the other board at others."""
    views = overlaps([(0, 1), (0, 1)])
    views = [v._replace(board=int(v.epoch > 3)) for v in views]
    found = connect(NAMES[:2], ["front", "rear"], [0, 0], views)
    np.testing.assert_allclose(found.mountings[1], CHAIN["c1"], atol=1e-12)
    assert found.separate == (("front", "rear"),) and found.bodies == [[0], [1]]


def test_a_medoid_is_one_of_those_that_agree():
    good = [matrix(rotation(1, 2, 3), [1, 0, 0])] * 3
    np.testing.assert_array_equal(medoid([np.eye(4), *good, 2 * np.eye(4)]), good[0])


def test_the_open_part_of_a_motion_moves_both_boards():
    """Every shift along the axis fits the epochs equally."""
    A = np.array(scenes.motions("axis"))
    B = np.array([BACK @ pose @ REAR for pose in A])
    motion = tie_by_motion(A, B)
    for one in (motion, motion.shifted(np.array([0.3, 0.7, -0.2]))):
        np.testing.assert_allclose(one.X @ B @ one.Z, A, atol=1e-12)
    np.testing.assert_allclose(np.abs(motion.open_directions.T), [[0, 1, 0]], atol=1e-12)
