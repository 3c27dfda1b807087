"""Cameras on one mounting that are not synchronised: clocks, mountings and the motion together.

Start values of the offsets come from speeds (`start_offsets`), those of the mountings from
photographs that are then nearly simultaneous. Targets move along splines whose knots are as close
as the photographs of the single cameras ask for. An offset that the motion does not determine is
held at its start value, and that is said.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import jax
import numpy as np
from jaxtyping import Float, Int

from jaxbundle.calibration.result import Calibration
from jaxbundle.calibration.rig.clocks import Clock
from jaxbundle.calibration.rig.connections import BoardView, Connections
from jaxbundle.calibration.rig.declare import Rig, adjust_rig
from jaxbundle.calibration.rig.known_mountings import KnownMountings
from jaxbundle.calibration.rig.start import (
    board_views,
    collect_boards,
    epochs_of,
    keys_of_photographs,
    sort_views,
    start_rig,
)
from jaxbundle.calibration.rig.start_offsets import (
    OffsetSettings,
    speeds_of_cameras,
    start_offsets,
)
from jaxbundle.calibration.rig.trajectory import (
    CONTROLS,
    Clocks,
    TargetMotion,
    control_poses,
    plan_runs,
)
from jaxbundle.errors import InputError
from jaxbundle.leastsquares import PoseValue, Result
from jaxbundle.leastsquares.solution import Solution
from jaxbundle.network.kinds.continuous_time import (
    CLOCK,
    CLOCK_PARAMETERS,
    OFFSET,
    RATE,
    TRAJECTORY,
)
from jaxbundle.network.kinds.mountings import MOUNTING
from jaxbundle.types import not_none

Times = Mapping[str, Mapping[str, float]]


@dataclasses.dataclass(frozen=True)
class SynchronizationSettings:
    """How cameras are synchronised.

    **Fields:**

    - `rate_sigma`: what is known of rates beforehand. Frame rates are stated to a thousandth (29.97
      as 30), quartz clocks agree to 1e-4.
    - `least_frames`: between knots, at least. With fewer the spline could follow the errors of
      single photographs.
    - `undersmoothing`: how many times closer the knots are than the photographs of single cameras
      require by Akaike's criterion, where errors of the spline are as large as those of a pose:
      they decrease with the fourth power, and are then small beside σ.
    - `max_move`: in parts of the distance of knots, by which the clocks may move instants between
      knots until they are assigned to them anew; the cubic beyond its knot is off by a third power
      of it.
    - `max_rounds` of this.
    - `min_frames_known`: an offset for which 3σ is more than this number of frames is not
      determined: photographs could as well be paired with the next ones.
    - `offsets`: see `OffsetSettings`.
    """

    rate_sigma: float = 0.01
    least_frames: float = 2.0
    undersmoothing: float = 2.0
    max_move: float = 0.05
    max_rounds: int = 6
    min_frames_known: float = 1.0
    offsets: OffsetSettings = OffsetSettings()


SYNCHRONIZATION = SynchronizationSettings()


def start_unsynchronized(
    calibrations: Mapping[str, Calibration],
    bodies: Mapping[str, Sequence[str]] | None,
    fixed: bool,
    known_mountings: KnownMountings,
    times: Times,
    estimated: Sequence[str],
    settings: SynchronizationSettings = SYNCHRONIZATION,
) -> tuple[Rig, Connections]:
    """The rig with start values of all, also of clocks and motion.

    **Raises:** as `start_rig`; `InputError` if no body is photographed often enough in a row."""
    boards = collect_boards(calibrations, bodies, fixed)
    cameras = sort_views(calibrations, boards, keys_of_photographs(calibrations))
    epochs = epochs_of(cameras)
    views = board_views(cameras, boards, epochs)
    time, frame = _time_of_epochs(calibrations, times)
    bodies_of = list(dict.fromkeys(boards.body.values()))
    body = [bodies_of.index(name) for name in boards.body.values()]
    speeds = speeds_of_cameras(views, time, body, frame, settings.offsets)
    # Without a significant correlation from zero: `_undetermined` says what remains open.
    offset = np.nan_to_num(start_offsets(speeds, frame, settings.offsets))
    clocks = _start_clocks(calibrations, times, offset, frame, estimated, settings)
    rig, connections = start_rig(
        calibrations,
        bodies,
        fixed,
        known_mountings,
        _nearly_simultaneous(calibrations, times, clocks, frame),
    )
    number = {name: k for k, name in enumerate(epochs)}
    row_time = time[[number[name] for name in rig.epoch_of_rows]]
    camera_of = {name: k for k, camera in enumerate(cameras) for name in camera.epoch}
    camera = np.array([camera_of[name] for name in rig.epoch_of_rows])
    points_of_boards = [board.points for board in boards.boards.values()]
    spacing = max(
        _knots(views, points_of_boards, time, float(np.median(frame))) / settings.undersmoothing,
        settings.least_frames * float(np.median(frame)),
    )
    sigma0 = float(
        np.median([calibration.adjustment.sigma0 for calibration in calibrations.values()])
    )
    empty = TargetMotion(
        clocks,
        camera,
        row_time,
        np.full(len(camera), -1),
        (),
        rig.pose,
        float(np.median(frame)),
        sigma0,
    )
    return with_trajectory(rig, empty, rig.pose, spacing), connections


def with_trajectory(rig: Rig, trajectory: TargetMotion, pose: PoseValue, spacing: float) -> Rig:
    """The rig with knots by the start values of clocks, and control poses by those of photographs.

    **Raises:** `InputError` if there is no run of photographs."""
    clocks = trajectory.clocks
    common = clocks.common(trajectory.camera, trajectory.time)
    body = _body_of_rows(rig)
    # An interval without photographs leaves control poses open.
    runs, run = plan_runs(body, common, spacing, spacing)
    if not runs:
        raise InputError(
            f"no board is photographed at {2 * CONTROLS} times in a row, with less than "
            f"{spacing:.3g} s from one to the next: unknown offsets of time need video, or all of "
            "its frames (jaxbundle frames --every 1)"
        )
    poses = control_poses(runs, run, common, pose)
    return dataclasses.replace(
        rig,
        trajectory=dataclasses.replace(
            trajectory, run=run, runs=runs, poses=poses, spacing=spacing
        ),
    )


def without_run(rig: Rig) -> list[tuple[str, str]]:
    """The epochs that are in no run of photographs, and why they are not used."""
    why = "too few photographs before and after it for a motion"
    return [(rig.epochs[row], why) for row in np.flatnonzero(not_none(rig.trajectory).run < 0)]


def _body_of_rows(rig: Rig) -> Int[np.ndarray, " rows"]:
    """The body of every row of photographs."""
    body = np.zeros(len(rig.epochs), int)
    body[rig.epoch] = np.array(rig.body)[rig.board_of_points[rig.point]]
    return body


def _time_of_epochs(
    calibrations: Mapping[str, Calibration], times: Times
) -> tuple[Float[np.ndarray, " epochs"], Float[np.ndarray, " cameras"]]:
    """The time of every photograph by its own clock, and the median from one to the next, by
    camera."""
    all_times, frame = [], []
    for name, calibration in calibrations.items():
        times_of_camera = [
            times[name][photograph] for photograph in dict.fromkeys(calibration.views.photographs)
        ]
        step = np.diff(np.unique(times_of_camera))
        if not len(step):
            raise InputError(f"camera {name}: all photographs have the same time")
        frame.append(float(np.median(step)))
        all_times += times_of_camera
    return np.array(all_times), np.array(frame)


def _start_clocks(
    calibrations: Mapping[str, Calibration],
    times: Times,
    offset: Float[np.ndarray, " cameras"],
    frame: Float[np.ndarray, " cameras"],
    estimated: Sequence[str],
    settings: SynchronizationSettings,
) -> Clocks:
    times_of_cameras = [np.array([*times[name].values()]) for name in calibrations]
    # About the first photograph, offset and rate would correlate by √3/2.
    middle = np.array([(t.min() + t.max()) / 2 for t in times_of_cameras])
    free = np.array([[name in estimated for name in CLOCK_PARAMETERS]] * len(times_of_cameras))
    # The clock of the reference is the common one, but it may have a rolling shutter, too.
    free[0, [CLOCK_PARAMETERS.index(OFFSET), CLOCK_PARAMETERS.index(RATE)]] = False
    # An offset is within the recording, a frame is read out before the next one.
    duration = max(float(np.ptp(t)) for t in times_of_cameras)
    ones = np.ones(len(times_of_cameras))
    prior = np.stack([duration * ones, settings.rate_sigma * ones, frame], 1)
    value = np.zeros((len(times_of_cameras), 3))
    value[:, 0] = offset
    return Clocks(value, free, prior, middle)


def _nearly_simultaneous(
    calibrations: Mapping[str, Calibration],
    times: Times,
    clocks: Clocks,
    frame: Float[np.ndarray, " cameras"],
) -> dict[str, dict[str, str]]:
    """Photographs of all cameras by the frame of the reference that is nearest."""
    first_time = min(times[next(iter(calibrations))].values())
    keys = {}
    for k, (name, calibration) in enumerate(calibrations.items()):
        photographs = list(dict.fromkeys(calibration.views.photographs))
        t = np.array([times[name][p] for p in photographs])
        common = clocks.common(np.full(len(t), k), t)
        frames = np.round((common - first_time) / frame[0]).astype(int)
        keys[name] = dict(zip(photographs, map(str, frames)))
    return keys


def _knots(
    views: Sequence[BoardView],
    boards: Sequence[Float[np.ndarray, "points 3"]],
    time: Float[np.ndarray, " epochs"],
    frame: float,
) -> float:
    """The distance of knots at which splines of the motions in the single cameras have the least
    AIC, corrected for small samples (Hurvich and Tsai, 1989), seconds.

    A motion is that of three corners of a board in the frame of a camera: coordinates, of which a
    spline is linear in its controls, where rotations would need iterations."""
    tracks: dict[tuple[int, int], list[BoardView]] = {}
    for view in views:
        tracks.setdefault((view.camera, view.board), []).append(view)
    parts = []
    for (_, board), views_of_track in tracks.items():
        views_of_track = sorted(views_of_track, key=lambda view: time[view.epoch])
        t, T = (
            time[[view.epoch for view in views_of_track]],
            np.array([view.pose for view in views_of_track]),
        )
        X = boards[board] - boards[board].mean(0)
        corners = X[[0, int(np.argmax(X @ [1, -1, 0])), len(X) - 1]]
        places = np.einsum("nij,pj->npi", T[:, :3, :3], corners) + T[:, None, :3, 3]
        # A part ends where a frame is missing. With fewer than ten photographs a spline of the
        # closest knots has no AIC, and one such part would rule these out for all.
        ends = np.flatnonzero(np.diff(t) > 1.5 * frame) + 1
        parts_of_track = zip(np.split(t, ends), np.split(places.reshape(len(t), 9), ends))
        parts += [(a, b) for a, b in parts_of_track if len(a) >= 4 * CONTROLS]
    # Half steps of the logarithm, from two frames to a second.
    spacings = frame * 2 ** np.arange(1, np.log2(max(1 / frame, 4)) + 0.5, 0.5)
    score = [sum(_aic(t, x, spacing) for t, x in parts) for spacing in spacings]
    return float(spacings[int(np.argmin(score))]) if parts else float(spacings[0])


def _aic(t: Float[np.ndarray, " n"], x: Float[np.ndarray, "n 9"], spacing: float) -> float:
    """The corrected AIC of splines of one spacing."""
    from scipy.interpolate import BSpline

    intervals = max(round((t[-1] - t[0]) / spacing), 1)
    step = (t[-1] - t[0]) / intervals
    knots = t[0] + step * np.arange(-3, intervals + 4)
    # Rounding may put the last photograph beyond the last knot, where the basis ends.
    inner = np.clip(t, knots[3], knots[-4] - 1e-9 * step)
    A = BSpline.design_matrix(inner, knots, 3).toarray()
    n, p = A.shape
    if n < p + 3:
        return np.inf
    residuals = x - A @ np.linalg.lstsq(A, x, rcond=None)[0]
    # Coordinates without any error have no logarithm.
    variance = np.maximum((residuals**2).mean(0), 1e-300)
    return float((n * np.log(variance) + 2 * p * n / (n - p - 1)).sum())


def adjust_unsynchronized(
    rig: Rig, max_iterations: int = 50, settings: SynchronizationSettings = SYNCHRONIZATION
) -> tuple[Rig, Result, dict[str, dict[str, str]]]:
    """Adjust a rig with its clocks; by camera and unknown of its clock why it was held.

    First with the clocks held: iterations would walk along a valley if the motion left them open.
    The rig is that with knots by its final clocks."""
    start = not_none(rig.trajectory).clocks
    held_clocks = dataclasses.replace(start, free=np.zeros_like(start.free))
    rig, result = _adjust_until_assigned(_with_clocks(rig, held_clocks), settings, max_iterations)
    if not result.converged:
        return rig, result, {}
    rig = _with_clocks(_started_at(rig, result), start)
    # One iteration for its normal equations alone: its values are not used.
    probe = adjust_rig(rig, 1)
    start_solution = Solution(probe.problem, probe.problem.data.start)
    held_unknowns = _undetermined(
        rig, start_solution, not_none(rig.trajectory).sigma0 ** 2, settings
    )
    while True:
        rig = _hold(rig, held_unknowns, start)
        rig, result = _adjust_until_assigned(rig, settings, max_iterations)
        if not result.converged:
            return rig, result, held_unknowns
        newly_held = _undetermined(rig, result.solution, result.sigma0**2, settings)
        if not newly_held:
            return rig, result, held_unknowns
        held_unknowns = {
            name: held_unknowns.get(name, {}) | newly_held.get(name, {})
            for name in held_unknowns | newly_held
        }


def _with_clocks(rig: Rig, clocks: Clocks) -> Rig:
    return dataclasses.replace(
        rig, trajectory=dataclasses.replace(not_none(rig.trajectory), clocks=clocks)
    )


def _started_at(rig: Rig, result: Result) -> Rig:
    """The rig with the poses and mountings of a solution as start values."""
    values = result.minimum.values
    trajectory = dataclasses.replace(
        not_none(rig.trajectory), poses=jax.tree.map(np.asarray, values[TRAJECTORY])
    )
    return dataclasses.replace(
        rig,
        pose=rig.poses(values),
        mounting=jax.tree.map(np.asarray, values[MOUNTING]),
        trajectory=trajectory,
    )


def _hold(rig: Rig, held_unknowns: Mapping[str, Mapping[str, str]], start: Clocks) -> Rig:
    """The rig with these unknowns of clocks held at their start values."""
    clocks = not_none(rig.trajectory).clocks
    free, value = clocks.free.copy(), clocks.value.copy()
    for k, camera in enumerate(rig.cameras):
        for unknown in held_unknowns.get(camera.id, {}):
            j = CLOCK_PARAMETERS.index(unknown)
            free[k, j], value[k, j] = False, start.value[k, j]
    clocks = dataclasses.replace(clocks, free=free, value=value)
    return _planned_again(rig, dataclasses.replace(not_none(rig.trajectory), clocks=clocks))


def _adjust_until_assigned(
    rig: Rig, settings: SynchronizationSettings, max_iterations: int
) -> tuple[Rig, Result]:
    """Adjusted until every instant is in its interval of knots."""
    for rounds_left in reversed(range(settings.max_rounds)):
        result = adjust_rig(rig, max_iterations)
        trajectory = not_none(rig.trajectory)
        values = result.minimum.values
        adjusted = trajectory.with_clocks(np.asarray(values[CLOCK]))
        common = [
            motion.clocks.common(motion.camera, motion.time) for motion in (adjusted, trajectory)
        ]
        spacing = min(run.spacing for run in trajectory.runs)
        if np.abs(common[0] - common[1]).max() < settings.max_move * spacing:
            break
        # Control poses belong to the knots they were found with: the last rig keeps these.
        if rounds_left == 0 or not np.isfinite(common[0]).all():
            break
        rig = _planned_again(dataclasses.replace(rig, pose=rig.poses(values)), adjusted)
    return rig, result


def _planned_again(rig: Rig, trajectory: TargetMotion) -> Rig:
    """The rig with knots by other clocks."""
    # Not that of the runs: one of few photographs has wider knots, which are no rule for others.
    return with_trajectory(rig, trajectory, rig.pose, trajectory.spacing)


def _undetermined(
    rig: Rig, solution: Solution, variance: float, settings: SynchronizationSettings
) -> dict[str, dict[str, str]]:
    """By camera and unknown of its clock, why the motion does not determine it; `variance` of unit
    weight."""
    trajectory, reasons = not_none(rig.trajectory), {}
    clocks = trajectory.clocks
    for k, camera in enumerate(rig.cameras):
        is_of_camera = trajectory.camera == k
        if not is_of_camera.any():
            continue
        half_span = float(np.ptp(trajectory.time[is_of_camera])) / 2
        frame = float(np.median(np.diff(np.unique(trajectory.time[is_of_camera]))))
        # The effect of each unknown on the time of a photograph, at most.
        effect = np.array([1.0, half_span, 0.5])
        C = variance * _clock_and_mounting(solution, k)
        sigma = np.sqrt(np.clip(np.diagonal(C)[:3], 0, None)) * effect
        for j, name in enumerate(CLOCK_PARAMETERS):
            if not clocks.free[k, j] or 3 * sigma[j] < settings.min_frames_known * frame:
                continue
            # σ with the mounting held, C_jj − cᵀ·M⁻¹·c: if that is small, the two are exchangeable
            M, c = C[3:, 3:], C[3:, j]
            conditional_effect = np.sqrt(max(C[j, j] - c @ np.linalg.pinv(M) @ c, 0.0)) * effect[j]
            why = (
                "the target moves evenly while it is seen: another mounting does the same"
                if k and 3 * conditional_effect < settings.min_frames_known * frame
                else "the target hardly moves while this camera and others see it"
            )
            reasons.setdefault(camera.id, {})[name] = (
                f"not determined (σ of times {sigma[j]:.2g} s, a frame is {frame:.2g} s): {why}"
            )
    return reasons


def _clock_and_mounting(solution: Solution, k: int) -> Float[np.ndarray, "9 9"]:
    """The joint cofactors of the clock and the mounting of a camera."""
    rows = {t.name: np.zeros((9, t.rows, t.space.width)) for t in solution.problem.tables}
    rows[CLOCK][:3, k], rows[MOUNTING][3:, k] = np.eye(3), np.eye(6)
    return np.asarray(solution.propagate_rows(rows))


def clocks_of(
    rig: Rig,
    value: Float[np.ndarray, "cameras 3"],
    covariance: Float[np.ndarray, "cameras 3 3"],
    held_unknowns: Mapping[str, Mapping[str, str]],
) -> dict[str, Clock]:
    """The clocks of all cameras, by their names."""
    trajectory, clocks_found = not_none(rig.trajectory), {}
    for k, camera in enumerate(rig.cameras):
        step = np.diff(np.unique(trajectory.time[trajectory.camera == k]))
        offset, rate, read_out = value[k].tolist()
        clocks_found[camera.id] = Clock(
            offset,
            rate,
            read_out,
            np.sqrt(np.clip(np.diagonal(covariance[k]), 0, None)),
            float(trajectory.clocks.middle[k]),
            float(np.median(step)),
            tuple(np.array(CLOCK_PARAMETERS)[trajectory.clocks.free[k]].tolist()),
            dict(held_unknowns.get(camera.id, {})),
        )
    return clocks_found
