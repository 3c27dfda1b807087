"""The rig of calibrated cameras, with start values: which view is which board at which epoch."""

import dataclasses
from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.batches.epochs import epoch_keys
from jaxbundle.calibration import quality
from jaxbundle.calibration.result import Calibration
from jaxbundle.calibration.rig.connections import BoardView, Connections, body_pose, connect
from jaxbundle.calibration.rig.declare import Rig
from jaxbundle.calibration.rig.known_mountings import NOTHING_KNOWN, KnownMountings
from jaxbundle.calibration.rig.motion import transformation
from jaxbundle.errors import InputError
from jaxbundle.geometry import matrix_from_omega_phi_kappa, quaternion_from_matrix
from jaxbundle.leastsquares.spaces import PoseValue
from jaxbundle.measure.boards import Board, BoardSet
from jaxbundle.network.columns import did_you_mean
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray, not_none

if TYPE_CHECKING:
    from jaxbundle.calibration.rig.wand_body import WandBody


@dataclasses.dataclass(frozen=True)
class RigBoards:
    """The boards of a rig.

    **Fields:** `boards` by name; `body`: of each the name of its body, its own name if it is one.
    """

    boards: dict[str, Board]
    body: dict[str, str]

    @property
    def points(self) -> Float[np.ndarray, "points 3"]:
        """The points of all, relative to the centroid of each."""
        return np.concatenate([b.points - b.points.mean(0) for b in self.boards.values()])

    @property
    def ids(self) -> tuple[str, ...]:
        """Their names: "BOARD:row-column", without the board if there is only one."""
        if len(self.boards) == 1:
            return next(iter(self.boards.values())).ids
        return BoardSet(tuple(self.boards), tuple(self.boards.values())).ids

    def rows_of(self, name: str) -> np.ndarray:
        """The rows of the points of a board among all."""
        sizes = [len(board.ids) for board in self.boards.values()]
        first_row = int(np.sum(sizes[: list(self.boards).index(name)], initial=0))
        return first_row + np.arange(len(self.boards[name].ids))


# By the name of a camera, of every photograph its epoch.
Keys = Mapping[str, Mapping[str, str]]


class CameraViews(NamedTuple):
    """The views of one camera.

    `calibration`; `board`: of each view the name; `epoch`: of each view the key; `rows`: of each
    point of its board or boards the row among the points of all.
    """

    calibration: Calibration
    board: list[str]
    epoch: list[str]
    rows: np.ndarray


def collect_boards(
    calibrations: Mapping[str, Calibration],
    bodies: Mapping[str, Sequence[str]] | None,
    fixed: bool,
) -> RigBoards:
    """The boards that the cameras have seen; a board without a name is one with all its equals.

    **Raises:** `InputError` if boards of one name differ, or a body has a board that there is not.
    """
    boards: dict[str, Board] = {}
    for camera, calibration in calibrations.items():
        if isinstance(calibration.views.board, BoardSet):
            for name, board in calibration.views.board.items:
                if boards.setdefault(name, board) != board:
                    raise InputError(
                        f"camera {camera!r}: board {name!r} is {board}, of another camera "
                        f"{boards[name]}; give boards that differ different names"
                    )
    unnamed_boards = [
        calibration.views.board
        for calibration in calibrations.values()
        if isinstance(calibration.views.board, Board)
        and calibration.views.board not in boards.values()
    ]
    distinct_boards = list(dict.fromkeys(unnamed_boards))
    for number, board in enumerate(distinct_boards, 1):
        boards["board" if len(distinct_boards) == 1 and not boards else f"board {number}"] = board
    body = {name: "all boards" if fixed else name for name in boards}
    for name, members in (bodies or {}).items():
        if name in boards and name not in members:
            raise InputError(f"body {name!r}: board {name!r} is not of it; choose another name")
        for board in members:
            if board not in boards:
                raise InputError(
                    f"body {name!r}: no camera has seen a board {board!r}"
                    f"{did_you_mean(board, boards)}"
                )
            if body[board] != board:
                raise InputError(
                    f"board {board!r} is of two bodies, {body[board]!r} and {name!r}; expected one"
                )
            body[board] = name
    return RigBoards(boards, body)


def keys_by_name(calibrations: Mapping[str, Calibration]) -> Keys:
    """The epoch of every photograph of every camera, by their names.

    **Raises:** `InputError` if the photographs cannot be paired by their names.
    """
    photographs = {
        name: tuple(dict.fromkeys(calibration.views.photographs))
        for name, calibration in calibrations.items()
    }
    return {
        name: dict(zip(photographs[name], keys_of_camera))
        for name, keys_of_camera in epoch_keys(photographs, connected=False).items()
    }


def sort_views(
    calibrations: Mapping[str, Calibration], boards: RigBoards, keys: Keys
) -> list[CameraViews]:
    """Board and epoch of every view of every camera."""
    views_of_cameras = []
    for name, calibration in calibrations.items():
        views = calibration.views
        if isinstance(views.board, BoardSet):
            board_names = [views.board.names[b] for b in views.board.seen(views.visible)]
            rows = np.concatenate([boards.rows_of(board) for board in views.board.names])
        else:
            board = next(
                n for n, declared_board in boards.boards.items() if declared_board == views.board
            )
            board_names, rows = [board] * len(views), boards.rows_of(board)
        views_of_cameras.append(
            CameraViews(calibration, board_names, [keys[name][p] for p in views.photographs], rows)
        )
    return views_of_cameras


def start_rig(
    calibrations: Mapping[str, Calibration],
    bodies: Mapping[str, Sequence[str]] | None = None,
    fixed: bool = False,
    known_mountings: KnownMountings = NOTHING_KNOWN,
    nearly: Keys | None = None,
    wand: "WandBody | None" = None,
) -> tuple[Rig, Connections]:
    """The rig with start values, and the image points that the calibration of each camera kept.

    **Arguments:** `bodies`: by name, boards that are fixed to each other; `fixed`: all are;
    `known_mountings`: what is given of the mountings; `nearly`: the epochs of photographs that are
    nearly simultaneous. Start values are by these, and then every photograph is an epoch of its
    own. `wand`: ties its cameras; its frames are not among the epochs (`wand_body.add_wand`), its
    cameras that see no board come last.

    **Raises:** `InputError`, `NotSolvedError` if the cameras do not hang together
    (`connections.connect`).
    """
    boards = collect_boards(calibrations, bodies, fixed)
    keys = nearly or _keys(calibrations, wand)
    cameras = sort_views(calibrations, boards, keys)
    epochs = epochs_of(cameras)
    names, views = list(boards.boards), board_views(cameras, boards, epochs)
    body = list(dict.fromkeys(boards.body.values()))
    numbers = [body.index(boards.body[name]) for name in names]
    wand_cameras = {} if wand is None else wand.cameras
    of_rig = [*calibrations, *wand_cameras]
    given_positions = known_mountings.positions(of_rig)
    if wand is None:
        connections = connect(of_rig, names, numbers, views, given_positions)
    else:
        ties = wand.views(of_rig, len(names), len(epochs))
        all_numbers = [*numbers, len(body)]
        connections = connect(
            of_rig, [*names, "wand"], all_numbers, [*views, *ties], given_positions
        )
    if nearly is not None:
        # Relations are known now; of a motion each photograph has a time and so a pose of its own.
        cameras = sort_views(calibrations, boards, keys_of_photographs(calibrations))
        epochs = epochs_of(cameras)
        views = board_views(cameras, boards, epochs)
    reference = [next(g[0] for g in connections.bodies if j in g) for j in range(len(names))]
    rows = _best_views(views, reference)
    poses = [body_pose(view, connections) for view in rows.values()]
    is_one_body = len(connections.bodies) == 1
    labels = [epochs[e] if is_one_body else f"{epochs[e]} {boards.body[names[j]]}" for e, j in rows]
    row_of = {key: row for row, key in enumerate(rows)}
    rays = [_rays(camera, epochs, boards, reference, row_of) for camera in cameras]
    epoch, point, xy, sigma = (np.concatenate(column) for column in zip(*rays))
    free = {
        name: calibration.adjustment.problem.network.cameras[0].free
        for name, calibration in calibrations.items()
    }
    rig = Rig(
        tuple(
            dataclasses.replace(calibration.camera, id=name, free=free[name])
            for name, calibration in calibrations.items()
        )
        + tuple(wand_cameras.values()),
        _hold(pose_values(connections.mountings), of_rig, known_mountings),
        tuple(labels),
        pose_values(poses),
        boards.ids,
        boards.points,
        epoch,
        np.repeat(np.arange(len(cameras)), [len(ray[0]) for ray in rays]),
        point,
        xy,
        sigma,
        times=tuple(epochs[e] for e, _ in rows),
        boards=tuple(names),
        board=np.repeat(np.arange(len(names)), [len(b.ids) for b in boards.boards.values()]),
        centroids=np.array([board.points.mean(0) for board in boards.boards.values()]),
        place=None
        if len(connections.bodies) == len(connections.places)
        else pose_values(connections.places[: len(names)]),
        body=tuple(reference),
        known=known_mountings,
    )
    return rig, connections


def _keys(calibrations: Mapping[str, Calibration], wand: "WandBody | None") -> Keys:
    """The epochs of photographs by their names; where a wand ties the cameras, they need not have
    any in common."""
    try:
        return keys_by_name(calibrations)
    except InputError:
        if wand is None:
            raise
        return keys_of_photographs(calibrations)


def _best_views(
    views: Sequence[BoardView], reference: Sequence[int]
) -> dict[tuple[int, int], BoardView]:
    """By epoch and body (its first board) the view with most points."""
    best: dict[tuple[int, int], BoardView] = {}
    for view in views:
        key = view.epoch, reference[view.board]
        if key not in best or view.points > best[key].points:
            best[key] = view
    return best


def keys_of_photographs(calibrations: Mapping[str, Calibration]) -> Keys:
    """Every photograph as an epoch of its own, named by camera and photograph."""
    return {
        name: {photograph: f"{name} {photograph}" for photograph in calibration.views.photographs}
        for name, calibration in calibrations.items()
    }


def epochs_of(cameras: Sequence[CameraViews]) -> list[str]:
    """The epochs of all cameras, each once."""
    return list(dict.fromkeys(key for camera in cameras for key in camera.epoch))


def board_views(
    cameras: Sequence[CameraViews], boards: RigBoards, epochs: Sequence[str]
) -> list[BoardView]:
    """The poses of all views, boards relative to their centroids."""
    names, views_found = list(boards.boards), []
    row_of_epoch = {key: e for e, key in enumerate(epochs)}
    for k, camera in enumerate(cameras):
        calibration = camera.calibration
        points_seen = calibration.views.visible.sum(1)
        for i, (board, key) in enumerate(zip(camera.board, camera.epoch)):
            M, X0 = calibration.rotation[i], calibration.position[i]
            pose = transformation(M, M @ (boards.boards[board].points.mean(0) - X0))
            views_found.append(
                BoardView(k, names.index(board), row_of_epoch[key], pose, int(points_seen[i]))
            )
    return views_found


def pose_values(matrices: Sequence[Float[np.ndarray, "4 4"]]) -> PoseValue:
    """Centre and quaternion of poses: R·x + t = R·(x − X0)."""
    stack = np.array(matrices)
    R, t = stack[:, :3, :3], stack[:, :3, 3]
    return PoseValue(-np.einsum("nji,nj->ni", R, t), np.asarray(_quaternions(R)))


def _hold(
    mounting: PoseValue, cameras: Sequence[str], known_mountings: KnownMountings
) -> PoseValue:
    """Mountings with those parts that are held as they are given."""
    position, rotation = np.array(mounting.position), np.array(mounting.rotation)
    for name, known_mounting in known_mountings.mountings.items():
        k = cameras.index(name)
        if known_mounting.is_held[0]:
            position[k] = known_mounting.position
        if known_mounting.is_held[1]:
            M = matrix_from_omega_phi_kappa(not_none(known_mounting.angles))
            rotation[k] = quaternion_from_matrix(M)
    return PoseValue(position, rotation)


@partial(compile_once, static=())
def _quaternions(matrices: Float[AnyArray, "n 3 3"]) -> Float[Array, "n 4"]:
    return jax.vmap(quaternion_from_matrix)(matrices)


def _rays(
    camera: CameraViews,
    epochs: Sequence[str],
    boards: RigBoards,
    reference: Sequence[int],
    row_of: Mapping[tuple[int, int], int],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Epoch row, point, xy and σ of the image points that the calibration of a camera kept.

    Points that it removed as gross stay out: data snooping of the rig finds only what the mounting
    reveals."""
    network, views = camera.calibration.adjustment.problem.network, camera.calibration.views
    rays, is_used = network.observations, quality.used_rays(camera.calibration.adjustment.problem)
    names = list(boards.boards)
    # Of a video every photograph is an epoch: a search of the list for each takes the square.
    row_of_epoch = {key: e for e, key in enumerate(epochs)}
    row_of_image = {
        view: row_of[row_of_epoch[key], reference[names.index(board)]]
        for view, board, key in zip(views.names, camera.board, camera.epoch)
    }
    row_of_point = dict(zip(views.board.ids, camera.rows))
    return (
        np.array([row_of_image[id] for id in network.images.id])[rays.image[is_used]],
        np.array([row_of_point[id] for id in network.points.id])[rays.point[is_used]],
        rays.xy[is_used],
        rays.sigma[is_used],
    )
