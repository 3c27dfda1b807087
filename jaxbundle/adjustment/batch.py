"""`calibrate_batch`: many cameras, each calibrated by itself from views of known points.

Cameras are solved in portions of one compiled shape: views and points are padded to the next size
of a short list (`bucket`), padding being points that are not seen. Where many cameras have far
fewer views than others, they have a shape of their own.

On a CPU a portion is a loop over its cameras (`lax.map`), and as many portions as there are cores
run at the same time, each in a thread. Milliseconds of one core for a camera of 20 views × 88
points: the loop 1.6, four cameras at a time 2.0, eight 2.4, `vmap` over 32 3.0, for all of them
wait for the slowest and their arrays leave the cache. On an accelerator a portion is a `vmap` over
many cameras.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from jaxbundle.adjustment.batch_camera import (
    CONVERGED,
    LIMIT,
    NOT_FINITE,
    SINGULAR,
    STATUS,
    WEAK,
    Solved,
    solve_camera,
)
from jaxbundle.adjustment.batch_input import Batch, Portion
from jaxbundle.adjustment.batch_normal import POSE
from jaxbundle.adjustment.batch_start import start_values
from jaxbundle.adjustment.batch_weakness import vague, vanishing
from jaxbundle.adjustment.problem import require_x64
from jaxbundle.arguments import whole
from jaxbundle.cameras import CameraModel, get_model
from jaxbundle.configuration import available_cores
from jaxbundle.geometry import (
    matrix_from_quaternion,
    matrix_from_rotation_vector,
    omega_phi_kappa_from_matrix,
)

OF_A_VIEW = ("position", "angles", "sigma_position", "sigma_angles", "rotation")


@dataclasses.dataclass(frozen=True)
class BatchCalibration:
    """The cameras of a batch; everything of a camera that has no solution is NaN.

    **Fields:**

    - `model`, `parameters`: the camera model and its k free parameters.
    - `status`: "converged"; "weak", as that, but the views do not determine the principal distance
      or point, whose σ is above a fiftieth of the principal distance (where `rms` is large, wrong
      points are the reason); without a solution "iteration limit", "singular", "not finite" (an
      infinite number among the measurements, or the start) or "too few points" (no view of use, or
      no redundancy).
    - `undetermined`: the free parameters that the views do not determine, where that is why the
      camera is weak, is singular or came to no end.
    - `values`, `sigma`, `covariance`: of the free parameters; pixels, coefficients without unit.
    - `interior`: all parameters of the model, in its order.
    - `sigma0`: √(vᵀv/redundancy), pixels; all σ and covariances are a posteriori.
    - `rms`: √(Σ(vx² + vy²)/points), pixels, as OpenCV defines it.
    - `redundancy`, `iterations` (evaluations of the normal equations).
    - `views`: the views that took part. One with fewer than 4 points of a flat object (6 of a solid
      one), or with all of them on a line (in a plane), is left out.
    - `position`, `angles`: X0, Y0, Z0 in the unit of the object; ω, φ, κ in radians, with
      `sigma_position`, `sigma_angles`; `rotation`: the matrices M.
    """

    model: str
    parameters: tuple[str, ...]
    status: Shaped[np.ndarray, " cameras"]
    undetermined: Bool[np.ndarray, "cameras k"]
    values: Float[np.ndarray, "cameras k"]
    sigma: Float[np.ndarray, "cameras k"]
    covariance: Float[np.ndarray, "cameras k k"]
    interior: Float[np.ndarray, "cameras parameters"]
    sigma0: Float[np.ndarray, " cameras"]
    rms: Float[np.ndarray, " cameras"]
    redundancy: Int[np.ndarray, " cameras"]
    iterations: Int[np.ndarray, " cameras"]
    views: Bool[np.ndarray, "cameras views"]
    position: Float[np.ndarray, "cameras views 3"]
    angles: Float[np.ndarray, "cameras views 3"]
    sigma_position: Float[np.ndarray, "cameras views 3"]
    sigma_angles: Float[np.ndarray, "cameras views 3"]
    rotation: Float[np.ndarray, "cameras views 3 3"]

    @property
    def converged(self) -> Bool[np.ndarray, " cameras"]:
        """Which have a solution, and everything in it is determined."""
        return self.status == STATUS[CONVERGED]

    @property
    def solved(self) -> Bool[np.ndarray, " cameras"]:
        """Which have values: the weak ones as well."""
        return self.converged | (self.status == STATUS[WEAK])

    def __len__(self) -> int:
        return len(self.status)

    def __str__(self) -> str:
        names, counts = np.unique(self.status, return_counts=True)
        states = ", ".join(f"{count} {name}" for name, count in zip(names, counts))
        rms = f"median RMS {np.nanmedian(self.rms):.4g} px" if self.solved.any() else "no result"
        return f"{len(self)} cameras, model {self.model}: {states}; {rms}"


def calibrate_batch(
    object_points: Float[np.ndarray, "*cameras points 3"],
    image_points: Float[np.ndarray, "cameras views points 2"],
    image_size: tuple[int, int],
    model: str = "opencv",
    visible: Bool[np.ndarray, "cameras views points"] | None = None,
    *,
    free: Sequence[str] | None = None,
    start: Mapping[str, float | Float[np.ndarray, " cameras"]] | None = None,
    max_iterations: int = 100,
    threads: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> BatchCalibration:
    """Calibrate many cameras, each by itself, from views of points with known coordinates.

    **Arguments:**

    - `object_points`: [points, 3] for all cameras, or [cameras, points, 3]; flat or solid. They may
      be repeated for every view ([views, points, 3] or [cameras, views, points, 3]).
    - `image_points`: pixels in the axes of the model.
    - `image_size`: width and height in pixels: the principal point starts in the middle.
    - `model`: a camera model in pixels: "opencv", "kannala-brandt", "snavely".
    - `visible`: which points were measured where; all, if not given. What is not visible may have
      any coordinates. A point that is NaN or masked is not visible: in an image, where it was not
      measured, or in the object.
    - `free`: the parameters to estimate; if not given, for "opencv" those of OpenCV's model of 5
      coefficients, otherwise all.
    - `start`: start values of parameters, for all cameras or [cameras]; without focal lengths these
      are found by themselves. What is neither free nor given is 0, or the middle of the image. A
      view is left out if the given camera turns too few of its points into rays.
    - `threads`: portions solved at the same time on a CPU; the number of cores if not given.
    - `progress(done, total)`: called after every portion.

    **Returns:** a `BatchCalibration`; look at `status` before anything else.

    **Raises:** `InputError` for shapes and names that do not fit, and under `jax.jit`, `jax.vmap`
    or `jax.grad`; `RuntimeError` without 64-bit floats. What is wrong with the numbers of one
    camera stands in its status.
    """
    require_x64()
    max_iterations = whole("max_iterations", max_iterations)
    threads = available_cores() if threads is None else whole("threads", threads)
    batch = Batch.of(object_points, image_points, image_size, model, visible, free, start)
    camera_model = get_model(model)
    on_cpu = jax.default_backend() == "cpu"
    views = batch.xy.shape[1]
    portions = list(batch.portions(on_cpu))
    run = lambda portion: _solve_portion(
        camera_model, batch.free, batch.known, max_iterations, batch.size, on_cpu, portion
    )
    parts, done = [], 0
    with ThreadPoolExecutor(threads if on_cpu else 1) as pool:
        for portion, solved in zip(portions, pool.map(run, portions)):
            parts.append(_without_padding(portion, views, solved))
            done += len(portion.cameras)
            if progress is not None:
                progress(done, len(batch))
    order = np.argsort(np.concatenate([portion.cameras for portion in portions]))
    rows = {name: np.concatenate([p[name] for p in parts])[order] for name in parts[0]}
    return _result(camera_model, batch, rows)


def _without_padding(portion: Portion, views: int, solved: dict) -> dict:
    """The rows of the cameras of a portion, views at their places among all."""
    rows = {name: values[: len(portion.cameras)] for name, values in solved.items()}
    camera = np.arange(len(portion.cameras))[:, None]
    for name in ("views", *OF_A_VIEW):
        values = rows[name]
        rows[name] = np.zeros((len(values), views, *values.shape[2:]), values.dtype)
        rows[name][camera, portion.views] = values[:, : portion.views.shape[1]]
    return rows


def _result(model: CameraModel, batch: Batch, rows: dict) -> BatchCalibration:
    """Rows in the order of the cameras; NaN for no result."""
    ended = np.where(batch.finite, rows["status"], NOT_FINITE)
    solved = ended == CONVERGED
    undetermined = _undetermined(model, batch, ended, rows)
    for name in OF_A_VIEW:
        rows[name][~rows["views"]] = np.nan
    for values in rows.values():
        if np.issubdtype(values.dtype, np.floating):
            values[~solved] = np.nan
    del rows["reduced"]
    rows["undetermined"] = undetermined
    rows["status"] = np.array(STATUS)[np.where(solved & undetermined.any(1), WEAK, ended)]
    free = tuple(model.parameters[column] for column in batch.free)
    return BatchCalibration(model=model.name, parameters=free, **rows)


def _undetermined(model: CameraModel, batch: Batch, ended, rows) -> Bool[np.ndarray, "cameras k"]:
    """What the views do not determine, of cameras for which that can be said."""
    sigma = rows["sigma"]
    null = vanishing(rows["reduced"]) & np.isin(ended, (SINGULAR, LIMIT))[:, None]
    # At the limit the last σ say why, if the equations can be solved.
    told = (ended == LIMIT) & ~null.any(1) & np.isfinite(sigma).all(1) | (ended == CONVERGED)
    return np.where(told[:, None], vague(model, batch.free, rows["interior"], sigma), null)


def _solve_portion(model, free, known, max_steps, size, on_cpu, portion: Portion) -> dict:
    """The rows of a `BatchCalibration`, with the status as its number."""
    result = _portion_program(
        model, free, known, portion.flat, on_cpu, max_steps, size,
        portion.seen, portion.interior, portion.axes, portion.middle,
    )  # fmt: skip
    return jax.tree.map(np.array, result)


@partial(jax.jit, static_argnums=range(5))
def _portion_program(
    model, free, known, flat, on_cpu, max_steps, size, seen, interior, axes, middle
):
    def one(arguments):
        seen, interior = arguments
        usable, start = start_values(model, flat, known, seen, interior, size)
        return solve_camera(model, free, max_steps, size, usable, start)

    every = partial(jax.lax.map, one) if on_cpu else jax.vmap(one)
    solved: Solved = every((seen, interior))
    variance = 2 * solved.cost / solved.redundancy
    covariance = variance[:, None, None] * solved.interior_cofactors
    points = 0.5 * (solved.redundancy + len(free) + POSE * solved.views.sum(1))
    rotation, position, angles, pose_sigma = jax.vmap(
        jax.vmap(_exterior_orientation, (0, 0, 0, None, None))
    )(solved.at.rotation, solved.at.shift, solved.pose_cofactors, axes, middle)
    pose_sigma = jnp.sqrt(variance)[:, None, None] * pose_sigma
    return dict(
        status=solved.status,
        values=solved.at.interior[:, jnp.array(free)],
        sigma=jnp.sqrt(jnp.diagonal(covariance, axis1=1, axis2=2)),
        covariance=covariance,
        reduced=solved.reduced,
        interior=solved.at.interior,
        sigma0=jnp.sqrt(variance),
        rms=jnp.sqrt(2 * solved.cost / points),
        redundancy=solved.redundancy,
        iterations=solved.steps,
        views=solved.views,
        position=position,
        angles=angles,
        sigma_position=pose_sigma[..., :3],
        sigma_angles=pose_sigma[..., 3:],
        rotation=rotation,
    )


def _exterior_orientation(quaternion, shift, Q, axes, middle):
    """M, X0, (ω, φ, κ) and their σ for σ₀ = 1 of one view, from the cofactors Q of (δt, δθ).

    ray = M'·A·(X − X̄) + t, so that M = M'·A and X0 = X̄ − Mᵀ·t; A: the object's principal axes.
    """

    def pose(change):
        M = matrix_from_rotation_vector(change[3:]) @ matrix_from_quaternion(quaternion) @ axes
        X0 = middle - M.T @ (shift + change[:3])
        return jnp.concatenate([X0, omega_phi_kappa_from_matrix(M)]), M

    J, _ = jax.jacfwd(pose, has_aux=True)(jnp.zeros(6))
    orientation, M = pose(jnp.zeros(6))
    return M, orientation[:3], orientation[3:], jnp.sqrt(jnp.diagonal(J @ Q @ J.T))
