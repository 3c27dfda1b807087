"""Several cameras on one rigid mounting, adjusted together from views of boards.

    X' = P_j·(X − c_j)               a point of board j in the frame of its body
    Y = M_e·(X' − X0_e)              at the epoch e in the frame of the reference camera
    ray = R_k·(Y − b_k)              camera k, its projection centre at b_k there
    v = image of the ray − measured  (by the camera's own model)

A body is a board, or several that are fixed to each other. The unknowns are the pose of the
reference camera relative to every body at every epoch, the mounting b_k, R_k of every other camera,
the place c_j, P_j of every board on its body (but the first of a body, which is its frame), the
free parameters of every camera, and the points X unless known: with a σ they are weighted; free
ones, of one board only, carry the datum by inner constraints (7, including scale). Mountings and
places are the same at all epochs. Where cameras are not synchronised, the poses of the epochs are
those of a spline in time, and the clocks of the cameras are unknowns as well
(`network.kinds.continuous_time`). The poses of the epochs are eliminated; the reduced system has a
few tens of unknowns, plus three per unknown point.

Source: Luhmann, Robson, Kyle and Boehm (2014), Close-Range Photogrammetry and 3D Imaging, section
4.4; King (1994), Bundle adjustment of constrained stereo pairs, Geomatics Research Australasia.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxbundle.calibration.rig.known_mountings import NOTHING_KNOWN, KnownMountings
from jaxbundle.calibration.rig.trajectory import CONTROLS, TargetMotion
from jaxbundle.cameras import get_model
from jaxbundle.cameras.pixel_frame import in_pixels
from jaxbundle.leastsquares import Result, adjust
from jaxbundle.leastsquares.datum.motions import scale_position, similarity
from jaxbundle.leastsquares.declarations import Kind, Motions, ObservationSet, Table
from jaxbundle.leastsquares.problem import Problem
from jaxbundle.leastsquares.quality.snooping import RemovedRow, snoop, without
from jaxbundle.leastsquares.solution import Solution, find_minimum
from jaxbundle.leastsquares.spaces import Posed, PoseValue
from jaxbundle.network.declare import CameraTable, camera_tables
from jaxbundle.network.kinds.continuous_time import (
    CLOCK,
    CLOCK_PARAMETERS,
    TRAJECTORY,
    timed_image_points,
)
from jaxbundle.network.kinds.control_points import CONTROL_POINTS
from jaxbundle.network.kinds.distances import DISTANCES
from jaxbundle.network.kinds.image_points import image_points
from jaxbundle.network.kinds.mountings import BASES, MOUNTING, observe_mountings
from jaxbundle.network.tables import EXTERIOR, Camera
from jaxbundle.types import not_none

POSES = ("epoch", "mounting")
# The tables of poses on the way from a point to the camera: of boards that are bodies of their own,
# and of boards on bodies.
ON_BODIES = ("board", *POSES)


_OF_OBJECT = similarity(("point",), ("epoch",))
# What is known of a clock beforehand.
CLOCK_PRIOR = Kind(
    "clocks", lambda clock, given: clock - given, (CLOCK,), CLOCK_PARAMETERS, snooped=""
)


# A similarity of the object that also transforms poses and bases.
FLOATING = Motions(
    _OF_OBJECT.names, (*_OF_OBJECT.actions, ("mounting", scale_position)), _OF_OBJECT.curved
)


def roll_of_stick(stick: Posed, direction: Float[Array, "3"]) -> Array:
    """The axis e_y of a stick, given in the frame of the rig by its rotation, along a given one."""
    return jnp.asarray(direction) @ stick.rotation.matrix()[:, 1]


# Of a stick, which has no rotation about itself: see `wand_body`.
ROLLS = Kind("rolls", roll_of_stick, ("epoch",), ("roll",), "", snooped="")
# The known length of a wand.
WAND_LENGTH = "wand length"


@dataclasses.dataclass(frozen=True)
class RigWand:
    """A wand as the last body of a rig, whose two points are its last.

    **Fields:** `length` of it and `sigma`; `first_row`: that of the pose of its first frame, all
    later ones are its own; `perpendicular_axes`: by frame an axis at right angles to the wand,
    which stops its rotation about itself (z₀ of `wand_body`)."""

    length: float
    sigma: float
    first_row: int
    perpendicular_axes: Float[np.ndarray, "frames 3"]


@dataclasses.dataclass(frozen=True)
class Rig:
    """The input of the rig adjustment, with start values.

    **Fields:**

    - `cameras`, the first is the reference; `mounting`: b_k and R_k, 0 and 1 of the first.
    - `epochs`: their names, of several bodies one for each body at each epoch; `pose`: X0_e and
      M_e; `times`: of every row of these the epoch (empty: they are the same).
    - `ids` and `points` of the boards, relative to the centroid of each; exact, unless they have
      `point_sigma`, or `points_free`.
    - For every image point the rows `epoch`, `camera`, `point` it belongs to, `xy` in the unit of
      the camera's model, and σ.
    - `boards`: their names; `board`: of every point the index of its board; `centroids` of the
      boards, in their own frames; `place`: c_j and P_j of every board, None if every board is a
      body of its own; `body`: of every board the index of the first board of its body.
    - `known`: what is given of the mountings.
    - `trajectory`: of cameras that are not synchronised; every photograph is then an epoch.
    - `wand`: the last of the boards, if there is one.
    """

    cameras: tuple[Camera, ...]
    mounting: PoseValue
    epochs: tuple[str, ...]
    pose: PoseValue
    ids: tuple[str, ...]
    points: Float[np.ndarray, "points 3"]
    epoch: Int[np.ndarray, " n"]
    camera: Int[np.ndarray, " n"]
    point: Int[np.ndarray, " n"]
    xy: Float[np.ndarray, "n 2"]
    sigma: Float[np.ndarray, "n 2"]
    point_sigma: float | None = None
    points_free: bool = False
    times: tuple[str, ...] = ()
    boards: tuple[str, ...] = ("board",)
    board: Int[np.ndarray, " points"] | None = None
    centroids: Float[np.ndarray, "boards 3"] | None = None
    place: PoseValue | None = None
    body: tuple[int, ...] = (0,)
    known: KnownMountings = NOTHING_KNOWN
    trajectory: TargetMotion | None = None
    wand: RigWand | None = None

    @property
    def number_of_board_points(self) -> int:
        """The number of points of boards, which come before those of a wand."""
        return len(self.points) - (0 if self.wand is None else 2)

    @property
    def lines(self) -> Float[np.ndarray, " n"]:
        """Of every image point the row of the image relative to the middle one, heights of the
        image."""
        lines = np.zeros(len(self.xy))
        for k, camera in enumerate(self.cameras):
            is_of_camera, size = self.camera == k, not_none(camera.image_size)
            uv = in_pixels(self.xy[is_of_camera], get_model(camera.model), size, camera.pixel_size)
            lines[is_of_camera] = (uv[:, 1] - (size[1] - 1) / 2) / size[1]
        return lines

    def poses(self, values: Mapping[str, Any]) -> PoseValue:
        """The pose of every epoch, of the values of the tables."""
        if self.trajectory is None:
            return values["epoch"]
        return self.trajectory.view_poses(values[TRAJECTORY], values[CLOCK])

    @property
    def epoch_of_rows(self) -> tuple[str, ...]:
        """The epoch of every pose."""
        return self.times or self.epochs

    @property
    def board_of_points(self) -> Int[np.ndarray, " points"]:
        """The index of the board of every point."""
        return np.zeros(len(self.points), int) if self.board is None else self.board

    @property
    def sets(self) -> list[tuple[CameraTable, Int[np.ndarray, " rows"]]]:
        """The cameras of one model each, and the rows of their image points."""
        tables = camera_tables(self.cameras)
        return [(t, np.flatnonzero(np.isin(self.camera, t.cameras))) for t in tables]

    def row_of(self, k: int) -> tuple[str, int]:
        """The table of a camera and its row there."""
        table = next(t for t in camera_tables(self.cameras) if k in t.cameras)
        return table.name, int(np.flatnonzero(table.cameras == k)[0])

    def in_order(self, by_set: Mapping[str, Any]) -> Float[np.ndarray, "n 2"]:
        """The engine's results by set of image points, in the order of the rig."""
        in_rig_order = np.zeros(self.xy.shape)
        for table, rows in self.sets:
            if len(rows):
                in_rig_order[rows] = by_set[table.image_set]
        return in_rig_order


def declare_rig(rig: Rig) -> tuple[list[Table], list[ObservationSet]]:
    """The tables of unknowns and the observations of a rig."""
    # Free points that no camera sees keep their coordinates.
    is_seen = np.isin(np.arange(len(rig.points)), rig.point)
    free = is_seen if rig.points_free else np.full(len(rig.points), rig.point_sigma is not None)
    free = np.repeat(free[:, None], 3, axis=1)
    if rig.wand is not None:
        # The pose has the other coordinates.
        free[-2:] = [[False, False, False], [True, False, False]]
    names = [camera.id for camera in rig.cameras]
    tables = [
        *_tables_of_poses(rig),
        Table(
            MOUNTING,
            rig.mounting,
            free=_free_mountings(rig),
            labels=names,
            parameters=("bx", "by", "bz", "omega", "phi", "kappa"),
        ),
        *(t.unknowns(rig.cameras) for t, _ in rig.sets),
        Table("point", rig.points, free=free, labels=rig.ids, parameters=("X", "Y", "Z")),
    ]
    if rig.place is not None:
        tables.append(
            Table(
                "board",
                rig.place,
                # The first board of a body is its frame.
                free=np.array(rig.body) != np.arange(len(rig.boards)),
                labels=rig.boards,
                parameters=EXTERIOR,
            )
        )
    observations = _image_points(rig)
    observations += _given_mountings(rig)
    if rig.point_sigma is not None:
        board_points = np.arange(rig.number_of_board_points)
        given_points = rig.points[board_points]
        observations.append(
            CONTROL_POINTS((board_points,), given_points, sigma=rig.point_sigma, name="control")
        )
    if rig.wand is not None:
        observations += _wand(rig, rig.wand)
    return tables, observations


def _wand(rig: Rig, wand: RigWand) -> list[ObservationSet]:
    """The known length of a wand, and its rolls."""
    first_end, second_end = np.array([[len(rig.points) - 2], [len(rig.points) - 1]])
    length, sigma = np.array([wand.length]), np.array([wand.sigma])
    frames = wand.first_row + np.arange(len(wand.perpendicular_axes))
    return [
        DISTANCES((first_end, second_end), length, sigma=sigma, name=WAND_LENGTH),
        ROLLS((frames,), wand.perpendicular_axes, sigma=np.ones(len(frames))),
    ]


def _tables_of_poses(rig: Rig) -> list[Table]:
    """The poses of the epochs; or control poses of a spline, and clocks."""
    if rig.trajectory is None:
        return [Table("epoch", rig.pose, labels=rig.epochs, parameters=EXTERIOR)]
    clocks, names = rig.trajectory.clocks, [camera.id for camera in rig.cameras]
    return [
        Table(TRAJECTORY, rig.trajectory.poses, parameters=EXTERIOR, title="control pose"),
        Table(CLOCK, clocks.value, free=clocks.free, labels=names, parameters=CLOCK_PARAMETERS),
    ]


def _image_points(rig: Rig) -> list[ObservationSet]:
    """The observations of the images, and what is known of the clocks beforehand."""
    if rig.trajectory is not None:
        return _timed_image_points(rig, rig.trajectory)
    observations = []
    for table, rows in rig.sets:
        if not len(rows):
            continue
        k = rig.camera[rows]
        touched_rows = rig.epoch[rows], k, np.searchsorted(table.cameras, k), rig.point[rows]
        if rig.place is not None:
            touched_rows = rig.board_of_points[rig.point[rows]], *touched_rows
        poses = POSES if rig.place is None else ON_BODIES
        kind = image_points(table.model, "measured", table.name, poses)
        observations.append(
            kind(touched_rows, rig.xy[rows], sigma=rig.sigma[rows], name=table.image_set)
        )
    return observations


def _timed_image_points(rig: Rig, trajectory: TargetMotion) -> list[ObservationSet]:
    line, board = rig.lines, None if rig.place is None else "board"
    unused = trajectory.run[rig.epoch] < 0
    observations = []
    for table, rows in rig.sets:
        k, epoch = rig.camera[rows], rig.epoch[rows]
        first_control, instant = trajectory.intervals(epoch, line[rows])
        controls = (first_control + j for j in range(CONTROLS))
        touched_rows = (*controls, k, k, np.searchsorted(table.cameras, k), rig.point[rows])
        if board:
            touched_rows = rig.board_of_points[rig.point[rows]], *touched_rows
        kind = timed_image_points(table.model, "measured", table.name, MOUNTING, board)
        sigma = np.where(unused[rows, None], np.inf, rig.sigma[rows])
        measured = (rig.xy[rows], instant)
        observations.append(kind(touched_rows, measured, sigma=sigma, name=table.image_set))
    clocks = trajectory.clocks
    sigma = np.where(clocks.free, clocks.prior, np.inf)
    weighted = np.flatnonzero(np.isfinite(sigma).any(1))
    if len(weighted):
        clock_priors = CLOCK_PRIOR((weighted,), clocks.value[weighted], sigma=sigma[weighted])
        observations.append(clock_priors)
    return observations


def _free_mountings(rig: Rig) -> Float[np.ndarray, "cameras 6"]:
    """The free columns of the mountings: not of the reference, nor what is held."""
    free = np.ones((len(rig.cameras), 6))
    free[0] = 0
    for k, camera in enumerate(rig.cameras):
        if camera.id in rig.known.mountings:
            free[k] = ~np.repeat(rig.known.mountings[camera.id].is_held, 3)
    return free


def _given_mountings(rig: Rig) -> list[ObservationSet]:
    """The observations of what is given of mountings and bases."""
    row = {camera.id: k for k, camera in enumerate(rig.cameras)}
    known_mountings = rig.known.mountings
    sets = observe_mountings([row[name] for name in known_mountings], [*known_mountings.values()])
    if rig.known.bases:
        ends = np.array([[row[name] for name in base.cameras] for base in rig.known.bases])
        length, sigma = np.array([(base.length, base.sigma) for base in rig.known.bases]).T
        sets.append(BASES(tuple(ends.T), length, sigma=sigma))
    return sets


def adjust_rig(rig: Rig, max_iterations: int = 50, **options: Any) -> Result:
    """Adjust a rig from its start values; `options` are those of the solver.

    **Returns:** the result; not `converged` if undetermined.
    """
    # Only points that are seen carry the datum; the bases scale with them (`FLOATING`).
    free = {"datum": {"point": np.unique(rig.point)}, "motions": FLOATING}
    # The epochs, with six unknowns each and by far the most, are eliminated; of control poses an
    # observation touches four.
    return adjust(
        *declare_rig(rig),
        eliminate="epoch" if rig.trajectory is None else None,
        max_iterations=max_iterations,
        **(free if rig.points_free else {}),
        **options,
    )


def used_rays(rig: Rig, problem: Problem) -> Bool[np.ndarray, " n"]:
    """Which image points carry weight."""
    return np.all(rig.in_order(problem.data.weight), axis=1)


def leave_out(
    rig: Rig, result: Result, rays: Bool[np.ndarray, " n"], max_iterations: int = 50
) -> Result:
    """The rig adjusted again from its start values without some of its image points; epochs left
    with too few are excluded."""
    removed_rows = [
        RemovedRow(table.image_set, row, None, 0.0)
        for table, of_set in rig.sets
        for row in np.flatnonzero(rays[of_set]).tolist()
    ]
    problem = without(result.problem, removed_rows)
    return Result(problem, find_minimum(problem, max_steps=max_iterations + 1))


def snoop_rig(result: Result, test: str, significance: float, max_iterations: int = 50) -> Result:
    """The result without blunders found by a test.

    **Raises:** `NotSolvedError` if the remaining observations do not determine a solution."""
    # Each round from the last solution: a removed blunder moves it little.
    minimum = result.minimum

    def adjust_again(problem: Problem, values: Any) -> Solution:
        nonlocal minimum
        minimum = find_minimum(problem, values, max_steps=max_iterations + 1)
        return Result(problem, minimum).solution

    solution, removed_rows = snoop(
        result.solution, adjust_again, test=test, significance=significance
    )
    return Result(solution.problem, minimum, removed_rows)
