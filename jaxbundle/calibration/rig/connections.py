"""What ties the cameras of a rig together, and start values of mountings and boards from it.

A view is one board in one photograph; of a calibrated camera it has a pose,

    board → camera:   T = C_k·P_e·B_j

with C_k the mounting of the camera (rig → camera), P_e the pose of the body of the board at the
epoch (body → rig), and B_j the place of the board on its body (board → body). Boards that are fixed
to each other, to walls for instance, are one body; a board that moves by itself is a body of its
own.

Views of one board by two cameras at the same epoch give their relative mounting, views of two
boards of a body at the same epoch the relation of these. Cameras and boards that hang together so
are groups. They are joined along the relation with most epochs first (a maximal spanning tree), by
the medoid over its epochs; a camera may so come in through other cameras. Where two groups of
cameras see different boards of one body at the same epochs, the motion of the rig ties them
(`motion`).
"""

import dataclasses
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbundle.batches.epochs import MIN_SHARED_EPOCHS
from jaxbundle.calibration.rig.motion import (
    MIN_MOTION_EPOCHS,
    Motion,
    medoid,
    tie_by_motion,
)
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.network.columns import count, list_some

Matrix = Float[np.ndarray, "4 4"]


class BoardView(NamedTuple):
    """A board in a photograph.

    `camera`, `board`, `epoch`: their indices; `pose`: board to camera, [4, 4]; `points`: number of
    its measured points.
    """

    camera: int
    board: int
    epoch: int
    pose: Matrix
    points: int


@dataclasses.dataclass(frozen=True)
class MotionTie:
    """Two groups of cameras that only the motion of the rig ties.

    **Fields:** `cameras`: the names in both groups; `boards`: those that each sees; `epochs`:
    number of them; `open`: number of directions along which the motion leaves the position open,
    and only what is given of a mounting determines it.
    """

    cameras: tuple[tuple[str, ...], tuple[str, ...]]
    boards: tuple[tuple[str, ...], tuple[str, ...]]
    epochs: int
    open: int = 0


@dataclasses.dataclass(frozen=True)
class Connections:
    """Start values of a rig.

    **Fields:** `mountings`: by camera, from the frame of the first camera to its own; `bodies`:
    the boards, by index, that hang together, the first is the reference of each; `places`: by board
    its transformation to the frame of that; `ties`: by motion; `separate`: names of boards of one
    body that nothing relates.
    """

    mountings: list[Matrix]
    bodies: list[list[int]]
    places: list[Matrix]
    ties: tuple[MotionTie, ...] = ()
    separate: tuple[tuple[str, ...], ...] = ()


class _Groups:
    """Cameras or boards in groups that hang together. `group_of`: the group of every member;
    `place`: of a camera from the frame of its group to its own, of a board from its own to that of
    its group."""

    def __init__(self, number: int):
        self.group_of = np.arange(number)
        self.place = [np.eye(4) for _ in range(number)]

    def members(self, group: int) -> list[int]:
        return np.flatnonzero(self.group_of == group).tolist()

    def groups(self) -> list[list[int]]:
        return [self.members(g) for g in dict.fromkeys(self.group_of.tolist())]


# By group of cameras and group of boards, by epoch: boards' frame → cameras' frame.
Poses = dict[tuple[int, int], dict[int, Matrix]]


def connect(
    cameras: Sequence[str],
    boards: Sequence[str],
    bodies: Sequence[int],
    views: Iterable[BoardView],
    given_positions: Mapping[int, Float[np.ndarray, "3"]] | None = None,
) -> Connections:
    """The mountings of the cameras and the places of the boards.

    **Arguments:** names of cameras and boards; `bodies`: of each board the number of its body;
    `given_positions`: positions of cameras in the frame of the first, by index, for what a motion
    leaves open.

    **Raises:** `InputError` if the cameras do not hang together: which ones do, and what would join
    them; `NotSolvedError` if the motion of the rig, which alone could tie them, does not.
    """
    views, body_of_board = list(views), np.asarray(bodies)
    camera_groups, board_groups, motion_ties, open_motions = (
        _Groups(len(cameras)),
        _Groups(len(boards)),
        [],
        [],
    )
    while True:
        poses = _poses(views, camera_groups, board_groups)
        if _join_cameras(poses, views, camera_groups) or _join_boards(
            poses, board_groups, body_of_board
        ):
            continue
        tying_motion, open_motions = _find_motion(
            poses, body_of_board, camera_groups, given_positions or {}
        )
        if tying_motion is None:
            break
        (g1, h1), (g2, h2), motion, number = tying_motion
        names_of = lambda names, rows: tuple(names[i] for i in rows)
        motion_ties.append(
            MotionTie(
                (
                    names_of(cameras, camera_groups.members(g1)),
                    names_of(cameras, camera_groups.members(g2)),
                ),
                (
                    names_of(boards, board_groups.members(h1)),
                    names_of(boards, board_groups.members(h2)),
                ),
                number,
                motion.open_directions.shape[1],
            )
        )
        _merge_cameras(camera_groups, g1, g2, np.linalg.inv(motion.X))
        _merge_boards(board_groups, h1, h2, np.linalg.inv(motion.Z))
    if len(camera_groups.groups()) > 1:
        raise _separate_error(cameras, boards, body_of_board, views, camera_groups, open_motions)
    groups = board_groups.groups()
    separate = [
        tuple(boards[group[0]] for group in groups if body_of_board[group[0]] == body_number)
        for body_number in dict.fromkeys(body_of_board.tolist())
    ]
    to_first_camera = np.linalg.inv(camera_groups.place[0])
    references = [board_groups.members(int(group))[0] for group in board_groups.group_of]
    return Connections(
        [place @ to_first_camera for place in camera_groups.place],
        groups,
        [
            np.linalg.inv(board_groups.place[r]) @ place
            for r, place in zip(references, board_groups.place)
        ],
        tuple(motion_ties),
        tuple(names for names in separate if len(names) > 1),
    )


def body_pose(view: BoardView, connections: Connections) -> Matrix:
    """The pose of a body (frame of its first board → frame of the first camera) that a view of one
    of its boards gives."""
    board_to_rig = np.linalg.inv(connections.mountings[view.camera]) @ view.pose
    return board_to_rig @ np.linalg.inv(connections.places[view.board])


def _poses(views: Iterable[BoardView], camera_groups: _Groups, board_groups: _Groups) -> Poses:
    """Of each pair of groups the pose at every epoch: by the view with most points."""
    best: dict[tuple[int, int, int], BoardView] = {}
    for view in views:
        key = (
            int(camera_groups.group_of[view.camera]),
            int(board_groups.group_of[view.board]),
            view.epoch,
        )
        if key not in best or view.points > best[key].points:
            best[key] = view
    poses: Poses = defaultdict(dict)
    for (g, h, epoch), view in best.items():
        pose = np.linalg.inv(camera_groups.place[view.camera]) @ view.pose
        poses[g, h][epoch] = pose @ np.linalg.inv(board_groups.place[view.board])
    return poses


def _join_cameras(poses: Poses, views: Sequence[BoardView], camera_groups: _Groups) -> bool:
    """Join the two groups of cameras that share most epochs; False if none share enough."""
    shared: dict[tuple[int, int], dict[int, Matrix]] = defaultdict(dict)
    for ((g1, h1), poses_a), ((g2, h2), poses_b) in combinations(sorted(poses.items()), 2):
        if h1 == h2:
            for e in poses_a.keys() & poses_b.keys():
                shared[g1, g2][e] = poses_b[e] @ np.linalg.inv(poses_a[e])
    epochs = defaultdict(set)
    for view in views:
        epochs[int(camera_groups.group_of[view.camera])].add(view.epoch)
    # A group with fewer epochs in all can share no more: then all of them suffice.
    sufficient = {
        pair: relations
        for pair, relations in shared.items()
        if len(relations) >= min(MIN_SHARED_EPOCHS, *(len(epochs[g]) for g in pair))
    }
    if not sufficient:
        return False
    pair = max(sufficient, key=lambda pair: len(sufficient[pair]))
    _merge_cameras(camera_groups, *pair, medoid([*sufficient[pair].values()]))
    return True


def _join_boards(poses: Poses, board_groups: _Groups, body_of_board: np.ndarray) -> bool:
    """Join the two groups of boards of one body that are seen together at most epochs."""
    shared: dict[tuple[int, int], dict[int, Matrix]] = defaultdict(dict)
    for ((g1, h1), poses_a), ((g2, h2), poses_b) in combinations(sorted(poses.items()), 2):
        if g1 == g2 and h1 != h2 and body_of_board[h1] == body_of_board[h2]:
            for e in poses_a.keys() & poses_b.keys():
                shared[h1, h2][e] = np.linalg.inv(poses_a[e]) @ poses_b[e]
    if not shared:
        return False
    # One epoch is enough, unlike of cameras: two boards are mostly in one photograph, which cannot
    # be paired wrongly.
    pair = max(shared, key=lambda pair: len(shared[pair]))
    _merge_boards(board_groups, *pair, medoid([*shared[pair].values()]))
    return True


def _merge_cameras(camera_groups: _Groups, group: int, joined_group: int, change: Matrix) -> None:
    """Give the cameras of a group the frame of another; `change`: from that to theirs."""
    for k in camera_groups.members(joined_group):
        camera_groups.place[k], camera_groups.group_of[k] = camera_groups.place[k] @ change, group


def _merge_boards(board_groups: _Groups, group: int, joined_group: int, change: Matrix) -> None:
    """Give the boards of a group the frame of another; `change`: from theirs to that."""
    for j in board_groups.members(joined_group):
        board_groups.place[j], board_groups.group_of[j] = change @ board_groups.place[j], group


class _OpenMotion(NamedTuple):
    """Two pairs of groups, the motion that does not tie them (None: too few epochs), and its
    epochs."""

    pair_a: tuple[int, int]
    pair_b: tuple[int, int]
    motion: Motion | None
    epochs: int


def _find_motion(
    poses: Poses,
    body_of_board: np.ndarray,
    camera_groups: _Groups,
    given_positions: Mapping[int, Float[np.ndarray, "3"]],
) -> tuple[tuple | None, list[_OpenMotion]]:
    """The motion over most epochs that ties two groups of cameras, alone or with a given position,
    None without one; and the motions tried that do not."""
    candidates = []
    for pair_a, pair_b in combinations(sorted(poses), 2):
        if (
            pair_a[0] == pair_b[0]
            or pair_a[1] == pair_b[1]
            or body_of_board[pair_a[1]] != body_of_board[pair_b[1]]
        ):
            continue
        epochs = sorted(poses[pair_a].keys() & poses[pair_b].keys())
        if epochs:
            candidates.append((pair_a, pair_b, epochs))
    open_motions = []
    for pair_a, pair_b, epochs in sorted(candidates, key=lambda candidate: -len(candidate[2])):
        motion = None
        if len(epochs) >= MIN_MOTION_EPOCHS:
            motion = tie_by_motion(
                *(np.array([poses[p][e] for e in epochs]) for p in (pair_a, pair_b))
            )
            known_cameras = [
                k
                for k in camera_groups.members(pair_b[0])
                if k in given_positions and camera_groups.group_of[0] == pair_a[0]
            ]
            if known_cameras and not motion.determined:
                motion = _shift_to(
                    motion, camera_groups, known_cameras[0], given_positions[known_cameras[0]]
                )
            if known_cameras or motion.determined:
                return (pair_a, pair_b, motion, len(epochs)), open_motions
        open_motions.append(_OpenMotion(pair_a, pair_b, motion, len(epochs)))
    return None, open_motions


def _shift_to(
    motion: Motion, camera_groups: _Groups, camera: int, position: Float[np.ndarray, "3"]
) -> Motion:
    """A motion with its open part such that a camera is at a position in the frame of the first."""
    place = np.linalg.inv(camera_groups.place[camera])  # its centre in the frame of its group
    present_position = camera_groups.place[0] @ motion.X @ place[:, 3]
    return motion.shifted(camera_groups.place[0][:3, :3].T @ (position - present_position[:3]))


def _separate_error(
    cameras: Sequence[str],
    boards: Sequence[str],
    body_of_board: np.ndarray,
    views: Sequence[BoardView],
    camera_groups: _Groups,
    open_motions: Sequence[_OpenMotion],
) -> InputError | NotSolvedError:
    """Which cameras hang together, and what would join them."""
    groups = camera_groups.groups()
    boards_seen = [{v.board for v in views if v.camera in group} for group in groups]
    names_of_groups = [list_some([cameras[k] for k in group], 6) for group in groups]
    parts = "; ".join(
        f"{names}, which {'sees' if len(group) == 1 else 'see'} "
        f"{_boards_in_words(boards, boards_of_group)}"
        for names, group, boards_of_group in zip(names_of_groups, groups, boards_seen)
    )
    message = f"the cameras are in {len(groups)} groups that nothing ties together: {parts}"
    row_of_group = {int(camera_groups.group_of[group[0]]): i for i, group in enumerate(groups)}
    for open_motion in open_motions:
        if open_motion.motion is not None:
            names_a, names_b = (
                names_of_groups[row_of_group[pair[0]]]
                for pair in (open_motion.pair_a, open_motion.pair_b)
            )
            reference = cameras[camera_groups.members(open_motion.pair_a[0])[0]]
            why = _why_open(open_motion.motion, open_motion.epochs, names_a, names_b, reference)
            return NotSolvedError(f"not solved: {message}. {why}")
    group_a, group_b = _pair_with_common_boards(groups, boards_seen)
    shared = _common_epochs(views, groups[group_a], groups[group_b])
    if shared:
        why = f"; they see one board at the same time at {count(shared, 'epoch')} only"
    else:
        why = ""
    common_boards = boards_seen[group_a] & boards_seen[group_b]
    target = boards[min(common_boards or boards_seen[group_a])]
    pair = cameras[groups[group_a][0]], cameras[groups[group_b][0]]
    board = "the board" if len(boards) == 1 else f"board {target!r}"
    advice = (
        f"photograph {board} with {pair[0]!r} and {pair[1]!r} at the same time, at "
        f"{MIN_SHARED_EPOCHS} epochs or more"
    )
    common_bodies = {int(body_of_board[j]) for j in boards_seen[group_a]} & {
        int(body_of_board[j]) for j in boards_seen[group_b]
    }
    if len(boards) > 1 and not common_boards:
        advice += (
            "; or move the rig so that both see their boards at the same time, with rotations "
            "about two axes"
            if common_bodies
            else "; or, if their boards are fixed to each other, say so (body of the boards, "
            "--fixed)"
        )
    return InputError(f"{message}{why}; {advice}")


def _boards_in_words(names: Sequence[str], seen_boards: Iterable[int]) -> str:
    if len(names) == 1:
        return "the board"
    sorted_boards = sorted(seen_boards)
    listed = list_some([names[j] for j in sorted_boards], 6)
    return f"board {listed}" if len(sorted_boards) == 1 else f"boards {listed}"


def _why_open(motion: Motion, epochs: int, names_a: str, names_b: str, reference: str) -> str:
    """What a motion leaves open, and which would not."""
    common = f"Over the {epochs} epochs that {names_a} and {names_b} have in common"
    if motion.open_directions.shape[1] > 1:
        return (
            f"{common} the rig is only shifted, not rotated: the position of {names_b} is not "
            "determined; rotate the rig about two axes as well, or give what is known of the "
            "position (--mountings)"
        )
    axis = ", ".join(f"{x + 0.0:.2f}" for x in motion.open_directions[:, 0].round(2))
    return (
        f"{common} all rotations of the rig are about one axis, ({axis}) in the frame of "
        f"{reference!r}: the position of {names_b} along it is not determined; rotate the rig "
        "about a second axis as well, or give what is known of the position (--mountings)"
    )


def _pair_with_common_boards(
    groups: Sequence[Sequence[int]], boards_seen: Sequence[set[int]]
) -> tuple[int, int]:
    """The two groups that most boards have in common."""
    pairs = combinations(range(len(groups)), 2)
    return max(pairs, key=lambda pair: len(boards_seen[pair[0]] & boards_seen[pair[1]]))


def _common_epochs(
    views: Sequence[BoardView], group_a: Sequence[int], group_b: Sequence[int]
) -> int:
    """Number of epochs at which both groups see the same board."""
    boards_and_epochs = [
        {(v.board, v.epoch) for v in views if v.camera in group} for group in (group_a, group_b)
    ]
    return len({epoch for _, epoch in boards_and_epochs[0] & boards_and_epochs[1]})
