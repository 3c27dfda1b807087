"""`calibrate_batch`: many cameras, each calibrated independently from views of known points.

Cameras are solved in portions of one compiled shape: views and points are padded to the next size
of a short list (`bucket`) with invisible points. If many cameras have far fewer views than others,
they get a separate shape.

On a CPU a portion is a loop over its cameras (`lax.map`), and as many portions as there are cores
run at the same time, each in a thread. Milliseconds of one core for a camera of 20 views × 88
points: the loop 1.6, four cameras at a time 2.0, eight 2.4, `vmap` over 32 3.0, because all wait
for the slowest and their arrays exceed the cache. On an accelerator a portion is a `vmap` over many
cameras.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbundle.arguments import integer, one_of
from jaxbundle.batches.camera import (
    CONVERGED,
    LIMIT,
    MISFIT,
    NOT_FINITE,
    SINGULAR,
    STATUS,
    WEAK,
)
from jaxbundle.batches.compiled import ProgramKey, Rows, in_double, solve_portion, tests_of_points
from jaxbundle.batches.error_sizes import BatchPrograms, BatchSums, batch_errors
from jaxbundle.batches.input import Batch, Portion
from jaxbundle.batches.misfit import far_outside, misfits, remarks
from jaxbundle.batches.normal import POSE, CameraUnknowns
from jaxbundle.batches.result import BatchCalibration as BatchCalibration
from jaxbundle.batches.snooping import MAX_ROUNDS, TESTS, Snooping
from jaxbundle.batches.solved_portions import SolvedPortions
from jaxbundle.batches.weakness import is_vague, vanishing, weak_geometry
from jaxbundle.cameras import CameraModel, get_model, key_of
from jaxbundle.float64 import require_x64
from jaxbundle.leastsquares.quality.snooping import check_test
from jaxbundle.system.cores import available_cores
from jaxbundle.system.devices import on_accelerator
from jaxbundle.types import Progress

# Poses in the form of the solver, only for data snooping.
OF_A_START = ("quaternion", "shift")
OF_A_VIEW = (
    "position",
    "angles",
    "sigma_position",
    "sigma_angles",
    "rotation",
    "sigma_position_correlated",
    "sigma_angles_correlated",
)
# Statuses of cameras with residuals that data snooping can test.
TESTED = (CONVERGED, LIMIT, SINGULAR)


def calibrate_batch(  # noqa: PLR0913 keyword arguments of a public function
    object_points: Float[np.ndarray, "*cameras points 3"],
    image_points: Float[np.ndarray, "cameras views points 2"],
    image_size: tuple[int, int],
    *,
    model: str | CameraModel = "opencv",
    visible: Bool[np.ndarray, "cameras views points"] | None = None,
    free: Sequence[str] | None = None,
    start: Mapping[str, float | Float[np.ndarray, " cameras"]] | None = None,
    max_iterations: int = 100,
    snooping: str | None = None,
    significance: float = 0.001,
    correlated: str | None = None,
    threads: int | None = None,
    progress: Progress | None = None,
) -> BatchCalibration:
    """Calibrate many cameras independently from views of points with known coordinates.

    **Arguments:**

    - `object_points`: [points, 3] for all cameras, or [cameras, points, 3]; planar or spatial. They
      may be repeated for every view ([views, points, 3] or [cameras, views, points, 3]).
    - `image_points`: pixels in the axes of the model.
    - `image_size`: width and height in pixels: the principal point starts at the image centre.
    - `model`: a camera model in pixels: "opencv", "kannala-brandt", "snavely", or a `CameraModel`.
    - `visible`: mask of measured points; default: all. Invisible points may have any coordinates. A
      point that is NaN or masked, in an image or in the object, is not visible (`make_network`
      refuses such a row).
    - `free`: the parameters to estimate; if not given, for "opencv" those of OpenCV's model of 5
      coefficients, otherwise all.
    - `start`: start values of parameters, for all cameras or [cameras]; missing focal lengths are
      computed. Parameters neither free nor given are 0, or the image centre. A view is excluded if
      the given camera has rays for too few of its points.
    - `snooping`: `"pope"`: remove, camera by camera, blunders at the level `significance`, the
      probability of removing anything from a camera without blunders; before that, points more than
      one image size outside the image.
    - `correlated`: also σ under errors that image points share, of sizes common to all cameras
      (`"batch"`: cameras of one type and use), from the residuals of up to 64 of them, spread over
      the batch, or of each by itself (`"camera"`), which shows errors by view the less, the fewer
      views it has; eight of them or more.
    - `threads`: portions solved at the same time on a CPU; default: the number of cores.
    - `progress(stage, done, total)`: called after every portion.

    **Returns:** a `BatchCalibration`; check `status` first.

    **Raises:** `InputError` for inconsistent shapes and names, and under `jax.jit`, `jax.vmap`
    or `jax.grad`; `RuntimeError` without 64-bit floats. Bad numbers of one camera are reported
    in its status.
    """
    require_x64()
    max_iterations = integer("max_iterations", max_iterations)
    one_of("snooping", snooping, TESTS, allow_none=True)
    check_test(snooping, significance)
    one_of("correlated", correlated, ("batch", "camera"), allow_none=True)
    threads = available_cores() if threads is None else integer("threads", threads)
    batch = Batch.check(object_points, image_points, image_size, model, visible, free, start)
    camera_model = get_model(model)
    if snooping is not None:
        y_down = camera_model.axes == "down"
        is_far = far_outside(batch.xy, batch.visible, batch.image_size, y_down)
        batch = dataclasses.replace(batch, visible=batch.visible & ~is_far)
    on_cpu = not on_accelerator()
    key = ProgramKey(camera_model, batch.free, batch.has_focal_length, on_cpu)

    def run(portion: Portion) -> Rows:
        solve = partial(solve_portion, key, max_iterations, batch.size)
        rows = solve(portion)
        return (
            rows if snooping is None else _snoop(key, solve, portion, rows, snooping, significance)
        )

    portions, parts, number_done = [], [], 0
    # Threads, not processes: compiled code leaves Python alone, and the programs are shared.
    with ThreadPoolExecutor(threads if on_cpu else 1) as pool:
        # The first are solved while the next are padded.
        solving = [
            (portions.append(portion), pool.submit(run, portion))[1]
            for portion in batch.portions(on_cpu)
        ]
        for portion, future in zip(portions, solving):
            parts.append(future.result())
            number_done += len(portion.cameras)
            if progress is not None:
                progress("calibrating", number_done, len(batch))
    solved_portions = SolvedPortions(key, portions, parts, *batch.xy.shape[:2])
    shape = batch.xy.shape[1:3]
    parts = [_without_padding(portion, shape, rows) for portion, rows in zip(portions, parts)]
    order = np.argsort(np.concatenate([portion.cameras for portion in portions]))
    rows = {name: np.concatenate([p[name] for p in parts])[order] for name in parts[0]}
    if snooping is not None:
        rows["removed"] |= is_far
    if correlated is not None:
        rows |= _under_errors(batch, rows, solved_portions, correlated == "batch")
    return _result(camera_model, batch, rows)


def _without_padding(portion: Portion, shape: tuple[int, int], padded: Rows) -> Rows:
    """The rows of the cameras of a portion, views at their original positions."""
    views, points = shape
    rows = {
        name: values[: len(portion.cameras)]
        for name, values in padded.items()
        if name not in OF_A_START
    }
    camera = np.arange(len(portion.cameras))[:, None]
    # The solver saw only views that show anything, in front; the user's numbers of views come back.
    for name in {"views", "removed", *OF_A_VIEW} & {*rows}:
        values = rows[name] if name != "removed" else rows[name][:, :, :points]
        rows[name] = np.zeros((len(values), views, *values.shape[2:]), values.dtype)
        rows[name][camera, portion.views] = values[:, : portion.views.shape[1]]
    return rows


def _result(model: CameraModel, batch: Batch, rows: Rows) -> BatchCalibration:
    """Rows in the order of the cameras; NaN for no result."""
    status = np.where(batch.finite, rows["status"], NOT_FINITE)
    is_solved = status == CONVERGED
    undetermined = _undetermined(model, batch, status, rows)
    # Singular or at the limit: mostly the geometry of the views, which is then said in words
    # instead of a status that only tells the symptom.
    weak = np.full(len(batch), "", dtype=object)
    for i in np.flatnonzero(np.isin(status, (LIMIT, SINGULAR))):
        points = batch.point if batch.point.ndim == 2 else batch.point[i]
        weak[i] = weak_geometry(points, batch.xy[i].astype(float), batch.visible[i])
    # The last RMS of those at the limit: the residuals may fit perfectly where nothing is
    # determined.
    rms = np.where(status == LIMIT, rows["rms"], np.nan)
    for name in {*OF_A_VIEW} & {*rows}:
        rows[name][~rows["views"]] = np.nan
    for values in rows.values():
        if np.issubdtype(values.dtype, np.floating):
            values[~is_solved] = np.nan
    rows["rms"] = np.where((weak != "") & ~is_solved, rms, rows["rms"])
    status = np.where(weak != "", WEAK, status)
    status = np.where(is_solved & undetermined.any(1), WEAK, status)
    # Last, since it compares the cameras that have values.
    status = np.where(misfits(rows["rms"], rows["mean_length"], is_solved), MISFIT, status)
    del rows["reduced"], rows["mean_length"]
    rows["undetermined"], rows["status"] = undetermined, np.array(STATUS)[status]
    rows["remark"] = remarks(model, batch, rows, is_solved & (status == CONVERGED))
    rows["remark"] = np.where(weak != "", weak, rows["remark"])
    free = tuple(model.parameters[column] for column in batch.free)
    return BatchCalibration(model=key_of(model), parameters=free, **rows)


def _under_errors(
    batch: Batch, rows: Rows, solved_portions: SolvedPortions, common_sizes: bool
) -> Rows:
    """σ under errors that image points share; `common_sizes`: of the same size in all cameras."""
    status = np.where(batch.finite, rows["status"], NOT_FINITE)
    is_sampled = solved_portions.sampled(common_sizes)
    forms = solved_portions.forms(is_sampled)
    # Without residuals everything is zero, as it is classically.
    variance = rows["sigma0"] ** 2
    forms.q[~is_sampled, 0] = (variance * rows["redundancy"])[~is_sampled]
    forms.q[status != CONVERGED] = np.nan
    factor = np.divide(1.0, variance, out=np.zeros_like(variance), where=variance > 0)
    interior = factor[:, None, None] * rows["covariance"]
    sigma = np.concatenate([rows["sigma_position"], rows["sigma_angles"]], -1)
    pose = factor[:, None, None] * sigma**2
    traces = solved_portions.traces(is_sampled)
    sums = BatchSums(forms, traces, is_sampled, rows["redundancy"], interior, pose)
    views = rows["views"].sum(1)
    points = (rows["redundancy"] + len(batch.free) + POSE * views) // 2
    programs = BatchPrograms(solved_portions.scatter, solved_portions.parts)
    errors = batch_errors(sums, views, points, common_sizes, programs)
    diagonal = np.diagonal(errors.covariance, axis1=1, axis2=2)
    return {
        "covariance_correlated": errors.covariance,
        "sigma_correlated": np.sqrt(diagonal),
        "sigma_position_correlated": np.sqrt(errors.pose[..., :3]),
        "sigma_angles_correlated": np.sqrt(errors.pose[..., 3:]),
        "component_sizes": errors.sizes,
    }


def _undetermined(
    model: CameraModel, batch: Batch, status: Int[np.ndarray, " cameras"], rows: Rows
) -> Bool[np.ndarray, "cameras k"]:
    """Undetermined parameters, of cameras for which they can be found."""
    sigma = rows["sigma"]
    null = vanishing(rows["reduced"]) & np.isin(status, (SINGULAR, LIMIT))[:, None]
    # At the limit the last σ say why, if the equations can be solved.
    has_sigma = (status == LIMIT) & ~null.any(1) & np.isfinite(sigma).all(1) | (status == CONVERGED)
    return np.where(has_sigma[:, None], is_vague(model, batch.free, rows["interior"], sigma), null)


def _snoop(
    key: ProgramKey,
    solve: Callable[[Portion], Rows],
    portion: Portion,
    rows: Rows,
    test: str,
    significance: float,
) -> Rows:
    """The rows of a portion without blunders; only cameras with removed points are solved again.

    A camera without a solution is tested where its iterations ended, since blunders may be the
    cause. If it has no solution without them either, it is unchanged.
    """
    weight = np.asarray(portion.sightings.weight)
    cameras = [Snooping(camera_weight > 0, test, significance) for camera_weight in weight]
    open_cameras = np.arange(len(portion.cameras))
    first_rows = {name: values.copy() for name, values in rows.items()}
    failures = np.zeros(len(weight), int)
    for _ in range(MAX_ROUNDS):
        is_used = np.stack([camera.used for camera in cameras]).astype(float)
        unknowns = CameraUnknowns(rows["interior"], rows["quaternion"], rows["shift"])
        tests = np.asarray(
            tests_of_points(key, in_double(portion.sightings), is_used, unknowns, rows["views"])
        )
        tested = np.isin(rows["status"], TESTED) & np.isfinite(rows["sigma0"])
        failures += rows["status"] != CONVERGED
        # A camera without a solution goes on for 60 rounds, in each of which it loses at most a
        # point of every view; larger or smaller: the time until it is given up.
        open_cameras = np.array(
            [
                i
                for i in open_cameras
                if tested[i]
                and failures[i] <= 60
                and cameras[i].next(tests[i], rows["sigma0"][i], rows["redundancy"][i])
            ],
            int,
        )
        if not len(open_cameras):
            break
        # The others get no points: they end at once as "too few points", and keep their rows.
        open_weight = np.zeros_like(weight)
        open_weight[open_cameras] = [cameras[i].used for i in open_cameras]
        sightings = dataclasses.replace(portion.sightings, weight=open_weight)
        solved_again = solve(dataclasses.replace(portion, sightings=sightings))
        for name, values in rows.items():
            values[open_cameras] = solved_again[name][open_cameras]
    # Neither with nor without: nothing says that the removed points are blunders.
    is_unsolved = (first_rows["status"] != CONVERGED) & (rows["status"] != CONVERGED)
    for name, values in rows.items():
        values[is_unsolved] = first_rows[name][is_unsolved]
    for i in np.flatnonzero(is_unsolved):
        cameras[i].used = cameras[i].seen
    rows["removed"] = np.stack([camera.seen & ~camera.used for camera in cameras])
    return rows
