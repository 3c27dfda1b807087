"""The motion of targets before a rig whose cameras are not synchronised, as splines in time.

A body that is photographed without a break has a run of knots, at one distance, with its own
control poses. Photographs too few or too far apart for a run are not used.
"""

import dataclasses
from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxbundle.geometry import matrix_from_quaternion, quaternion_from_matrix
from jaxbundle.geometry.quaternions import (
    quaternion_difference,
    retract_quaternion,
)
from jaxbundle.leastsquares import Pose, PoseValue
from jaxbundle.network.kinds.continuous_time import Instant, place_on_spline
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray, Scalar

# The control poses of an interval of a cubic spline.
CONTROLS = 4


@dataclasses.dataclass(frozen=True)
class Clocks:
    """The clocks of the cameras: common time = t + offset + rate·(t − middle) + read-out·line.

    **Fields:** `value` [cameras, 3]: offset (s), rate, read-out (s); `free` and the σ `prior` of
    each about `value`; `middle` of the photographs of every camera, by its own clock, seconds.
    """

    value: Float[np.ndarray, "cameras 3"]
    free: Bool[np.ndarray, "cameras 3"]
    prior: Float[np.ndarray, "cameras 3"]
    middle: Float[np.ndarray, " cameras"]

    def common(
        self,
        camera: Int[np.ndarray, " n"],
        time: Float[np.ndarray, " n"],
        line: Float[np.ndarray, " n"] | float = 0.0,
    ) -> Float[np.ndarray, " n"]:
        """Times by the clock of the reference camera."""
        offset, rate, read_out = self.value[camera].T
        return time + offset + rate * (time - self.middle[camera]) + read_out * line


@dataclasses.dataclass(frozen=True)
class Run:
    """A body in one run of photographs: `first_control`: the row of the first of its control poses;
    `start` and `spacing` of its knots, seconds; number of `intervals`."""

    first_control: int
    start: float
    spacing: float
    intervals: int

    @property
    def controls(self) -> int:
        return self.intervals + CONTROLS - 1


@dataclasses.dataclass(frozen=True)
class TargetMotion:
    """Poses of targets in time, and when they were photographed.

    **Fields:**

    - `clocks`, with start values.
    - Of every row of photographs (a body in a photograph): its `camera`, its `time` by the clock of
      this, seconds, and its `run`, −1 if it has none.
    - `runs`; `poses`: start values of their control poses: a body in the frame of the reference
      camera, rotations from that to the body.
    - `frame`: the median time from a photograph to the next, seconds.
    - `sigma0` of the cameras by themselves, the median: what σ will be before the clocks are right.
    - `spacing` of knots that was asked for, seconds; those of runs differ.
    """

    clocks: Clocks
    camera: Int[np.ndarray, " rows"]
    time: Float[np.ndarray, " rows"]
    run: Int[np.ndarray, " rows"]
    runs: tuple[Run, ...]
    poses: PoseValue
    frame: float
    sigma0: float = 1.0
    spacing: float = 0.0

    def intervals(
        self, row: Int[np.ndarray, " n"], line: Float[np.ndarray, " n"]
    ) -> tuple[Int[np.ndarray, " n"], Instant]:
        """The first control pose, and the instant, of observations in photographs; of those
        without a run those of the first run, for observations without weight."""
        number, camera, time = np.maximum(self.run[row], 0), self.camera[row], self.time[row]
        fields = [(r.first_control, r.start, r.spacing, r.intervals) for r in self.runs]
        first_control, start, spacing, size = np.array(fields).T[:, number]
        common = self.clocks.common(camera, time, line)
        # Before the first knot and behind the last one the cubic of the outer interval goes on.
        k = np.clip(np.floor((common - start) / spacing), 0, size - 1)
        # By its own clock: offset, rate and read-out are added where they are unknowns.
        since = time - (start + k * spacing)
        instant = Instant(since, time - self.clocks.middle[camera], line, 1 / spacing)
        return (first_control + k).astype(int), instant

    def with_clocks(self, value: Float[np.ndarray, "cameras 3"]) -> "TargetMotion":
        """The same with other start values of the clocks."""
        return dataclasses.replace(self, clocks=dataclasses.replace(self.clocks, value=value))

    def view_poses(self, controls: PoseValue, clocks: Float[np.ndarray, "cameras 3"]) -> PoseValue:
        """The pose of the reference camera relative to the body of every row, at its time."""
        motion = self.with_clocks(np.asarray(clocks))
        first_control, instant = motion.intervals(
            np.arange(len(self.time)), np.zeros(len(self.time))
        )
        common = motion.clocks.common(self.camera, self.time)
        u = (instant.since + common - self.time) * instant.frequency
        control_rows = first_control[:, None] + np.arange(CONTROLS)
        return jax.tree.map(
            np.asarray, _view_poses(jax.tree.map(lambda x: x[control_rows], controls), u)
        )


@partial(compile_once, static=())
def _view_poses(controls: PoseValue, u: Float[AnyArray, " n"]) -> PoseValue:
    def view_pose(four: PoseValue, u: Scalar) -> PoseValue:
        posed = [Pose().prepare(jax.tree.map(lambda x, k=k: x[k], four)) for k in range(CONTROLS)]
        place = lambda X: jnp.stack(place_on_spline(posed, u, X))
        # By the function of the observations: a second formula could disagree with it.
        t = place((0.0, 0.0, 0.0))
        axes = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
        M = jnp.stack([place(axis) - t for axis in axes], 1)
        return PoseValue(-M.T @ t, quaternion_from_matrix(M))

    return jax.vmap(view_pose)(controls, u)


def plan_runs(
    body: Int[np.ndarray, " rows"],
    common: Float[np.ndarray, " rows"],
    spacing: float,
    gap: float,
) -> tuple[tuple[Run, ...], Int[np.ndarray, " rows"]]:
    """The runs of every body by the times of its photographs, and the run of every row.

    A run ends where no photograph is within `gap`. It has at most half as many control poses as
    photographs at different times, so that these determine them with as much redundancy."""
    runs: list[Run] = []
    run_of_row, first_control = np.full(len(common), -1), 0
    for body_number in np.unique(body):
        rows = np.flatnonzero(body == body_number)
        rows = rows[np.argsort(common[rows], kind="stable")]
        ends = np.flatnonzero(np.diff(common[rows]) > gap) + 1
        for part in np.split(rows, ends):
            t = common[part]
            # Photographs of two cameras at one time are one pose.
            instants = 1 + int((np.diff(t) > gap / 100).sum())
            if instants < 2 * CONTROLS:
                continue
            # n intervals have n + 3 control poses
            max_intervals = instants // 2 - CONTROLS + 1
            intervals = int(np.clip(np.ceil((t[-1] - t[0]) / spacing), 1, max_intervals))
            run = Run(first_control, t[0], (t[-1] - t[0]) / intervals, intervals)
            run_of_row[part] = len(runs)
            runs.append(run)
            first_control += run.controls
    return tuple(runs), run_of_row


def control_poses(
    runs: Sequence[Run],
    run: Int[np.ndarray, " rows"],
    common: Float[np.ndarray, " rows"],
    pose: PoseValue,
) -> PoseValue:
    """Start values of control poses from those of photographs (reference camera relative to the
    body, as in `Rig.pose`): the pose at the middle of the four intervals that each rules, between
    the photographs before and after, or that of the nearest one beyond them."""
    M, X0 = np.asarray(_matrices(pose.rotation)), np.asarray(pose.position)
    t, inverse = -np.einsum("nij,nj->ni", M, X0), np.asarray(_quaternions(M.swapaxes(1, 2)))
    position, rotation = [], []
    for number, motion_run in enumerate(runs):
        rows = np.flatnonzero(run == number)
        rows = rows[np.argsort(common[rows], kind="stable")]
        # Control j is that of most weight at knot j − 1: 2/3 there, 1/6 for each neighbour.
        control_times = motion_run.start + motion_run.spacing * (np.arange(motion_run.controls) - 1)
        control_times = np.clip(control_times, common[rows[0]], common[rows[-1]])
        k = np.clip(
            np.searchsorted(common[rows], control_times, side="right") - 1, 0, len(rows) - 2
        )
        previous_rows, next_rows = rows[k], rows[k + 1]
        span = np.maximum(common[next_rows] - common[previous_rows], np.finfo(float).tiny)
        part = ((control_times - common[previous_rows]) / span)[:, None]
        position.append(t[previous_rows] + part * (t[next_rows] - t[previous_rows]))
        rotation.append(
            np.asarray(_interpolate_rotations(inverse[previous_rows], inverse[next_rows], part))
        )
    return PoseValue(np.concatenate(position), np.concatenate(rotation))


@partial(compile_once, static=())
def _matrices(q: Float[AnyArray, "n 4"]) -> Float[Array, "n 3 3"]:
    return jax.vmap(matrix_from_quaternion)(q)


@partial(compile_once, static=())
def _quaternions(M: Float[AnyArray, "n 3 3"]) -> Float[Array, "n 4"]:
    return jax.vmap(quaternion_from_matrix)(M)


@partial(compile_once, static=())
def _interpolate_rotations(
    rotation_a: Float[AnyArray, "n 4"],
    rotation_b: Float[AnyArray, "n 4"],
    part: Float[AnyArray, "n 1"],
) -> Float[Array, "n 4"]:
    return jax.vmap(lambda a, b, s: retract_quaternion(a, s * quaternion_difference(b, a)))(
        rotation_a, rotation_b, part
    )
