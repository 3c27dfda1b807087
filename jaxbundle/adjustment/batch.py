"""`calibrate_batch`: many cameras, each calibrated by itself from views of known points.

Cameras are solved in portions of one compiled shape: views and points are padded to the next size
of a short list (`bucket`), padding being points that are not seen.

On a CPU a portion is a loop over its cameras (`lax.map`), and as many portions as there are cores
run at the same time, each in a thread. That was measured against `vmap` over 8 or 32 cameras: all
of them wait for the slowest, and their arrays leave the cache (see benchmarks/calibration.py). On
an accelerator a portion is a `vmap` over many cameras.
"""

import dataclasses
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from jaxbundle.adjustment.batch_camera import CONVERGED, STATUS, Solved, solve_camera
from jaxbundle.adjustment.batch_normal import Calibration, Sightings
from jaxbundle.adjustment.batch_start import start_values
from jaxbundle.adjustment.problem import require_x64
from jaxbundle.cameras import CameraModel, default_parameters, get_model
from jaxbundle.errors import InputError
from jaxbundle.geometry import matrix_from_quaternion, omega_phi_kappa_from_matrix
from jaxbundle.geometry import matrix_from_rotation_vector

FREE = {"opencv": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")}
"""What is free if nothing is said; of other models everything."""

FLAT = 0.02
"""A smaller extent across than this fraction of the second largest: the object starts as flat."""

CAMERAS_A_PORTION = {"cpu": 32}
CAMERAS_ON_ACCELERATOR = 512


@dataclasses.dataclass(frozen=True)
class BatchCalibration:
    """The cameras of a batch; everything of a camera that did not converge is NaN.

    **Fields:**

    - `model`, `parameters`: the camera model and its k free parameters.
    - `status`: "converged", "iteration limit", "singular", "not finite" or "too few points".
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
        return self.status == STATUS[CONVERGED]

    def __len__(self) -> int:
        return len(self.status)

    def __str__(self) -> str:
        names, counts = np.unique(self.status, return_counts=True)
        states = ", ".join(f"{count} {name}" for name, count in zip(names, counts))
        rms = f"median RMS {np.nanmedian(self.rms):.4g} px" if self.converged.any() else "no result"
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
    max_iterations: int = 50,
    threads: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> BatchCalibration:
    """Calibrate many cameras, each by itself, from views of points with known coordinates.

    **Arguments:**

    - `object_points`: [points, 3] for all cameras, or [cameras, points, 3]; flat or solid.
    - `image_points`: pixels in the axes of the model.
    - `image_size`: width and height in pixels: the principal point starts in the middle.
    - `model`: a camera model in pixels: "opencv", "kannala-brandt", "snavely".
    - `visible`: which points were measured where; all, if not given. What is not visible may have
      any coordinates, NaN as well.
    - `free`: the parameters to estimate; if not given, for "opencv" those of OpenCV's model of 5
      coefficients, otherwise all.
    - `start`: start values of parameters, for all cameras or [cameras]; without focal lengths these
      are found by themselves. What is neither free nor given is 0, or the middle of the image.
    - `threads`: portions solved at the same time on a CPU; the number of cores if not given.
    - `progress(done, total)`: called after every portion.

    **Returns:** a `BatchCalibration`; look at `status` before anything else.

    **Raises:** `InputError` for shapes and names that do not fit; `RuntimeError` without 64-bit
    floats. What is wrong with the numbers of one camera stands in its status.
    """
    require_x64()
    batch = _Batch.of(object_points, image_points, image_size, model, visible, free, start)
    camera_model = get_model(model)
    on_cpu = jax.default_backend() == "cpu"
    results = [None] * len(batch)
    portions = list(batch.portions(on_cpu))
    run = lambda portion: _solve_portion(
        camera_model, batch.free, batch.known, max_iterations, max(image_size), on_cpu, portion
    )
    done = 0
    with ThreadPoolExecutor((threads or _cores()) if on_cpu else 1) as pool:
        for portion, solved in zip(portions, pool.map(run, portions)):
            for i, camera in enumerate(portion.cameras):
                results[camera] = {name: rows[i] for name, rows in solved.items()}
            done += len(portion.cameras)
            if progress is not None:
                progress(done, len(batch))
    return batch.result(model, results)


def bucket(n: int) -> int:
    """The next size to pad to: 4, 5, 6, 7, 8, 10, 12, 14, 16, 20, 24, 28, 32, …"""
    step = 2 ** max(0, math.ceil(math.log2(max(n, 4))) - 3)
    return max(4, math.ceil(n / step) * step)


@dataclasses.dataclass(frozen=True)
class _Portion:
    """Padded arrays of some cameras, for one call of the compiled program."""

    cameras: np.ndarray
    flat: bool
    seen: Sightings
    interior: np.ndarray
    axes: np.ndarray
    middle: np.ndarray


@dataclasses.dataclass(frozen=True)
class _Batch:
    """The checked input. Object points are turned into their principal axes, about their mean."""

    point: np.ndarray
    middle: np.ndarray
    axes: np.ndarray
    flat: np.ndarray
    xy: np.ndarray
    visible: np.ndarray
    interior: np.ndarray
    free: tuple[int, ...]
    known: bool

    def __len__(self) -> int:
        return len(self.xy)

    @classmethod
    def of(cls, object_points, image_points, image_size, model, visible, free, start):
        model = _pixel_model(model)
        xy = np.asarray(image_points, float)
        if xy.ndim != 4 or xy.shape[3] != 2:
            raise InputError(
                f"image_points must have the shape [cameras, views, points, 2], but has {xy.shape}"
            )
        cameras, views, points, _ = xy.shape
        X = np.asarray(object_points, float)
        if X.shape not in ((points, 3), (cameras, points, 3)):
            raise InputError(
                f"object_points must have the shape [{points}, 3] or [{cameras}, {points}, 3], as "
                f"image_points has {points} points a view, but has {X.shape}"
            )
        visible = np.ones(xy.shape[:3], bool) if visible is None else np.asarray(visible)
        if visible.shape != xy.shape[:3]:
            raise InputError(
                f"visible must have the shape {xy.shape[:3]} of image_points, "
                f"but has {visible.shape}"
            )
        size = np.asarray(image_size, float)
        if size.shape != (2,) or not (np.isfinite(size) & (size > 0)).all():
            raise InputError(
                f"image_size must be width and height in pixels, but is {image_size!r}"
            )
        free = _free(model, free)
        interior, known = _interior(model, free, start, size, cameras)
        return cls(
            *_principal_axes(np.broadcast_to(X, (cameras, points, 3))),
            xy=xy, visible=visible.astype(bool), interior=interior,
            free=tuple(model.parameters.index(name) for name in free), known=known,
        )  # fmt: skip

    def portions(self, on_cpu: bool) -> Iterator[_Portion]:
        """Cameras in portions, flat and solid objects apart."""
        _, views, points, _ = self.xy.shape
        shape = (bucket(views), bucket(points) if points > 128 else -(-points // 8) * 8)
        size = 32 if on_cpu else min(512, 2 ** math.ceil(math.log2(max(len(self), 1))))
        for flat in (True, False):
            cameras = np.flatnonzero(self.flat == flat)
            for first in range(0, len(cameras), size):
                yield self._portion(cameras[first : first + size], flat, size, shape)

    def _portion(self, cameras, flat, size, shape) -> _Portion:
        wide = lambda rows, *axes: np.pad(
            rows, [(0, n - old) for n, old in zip(axes, rows.shape)] + [(0, 0)] * (rows.ndim - len(axes))
        )
        visible = self.visible[cameras]
        seen = Sightings(
            point=wide(self.point[cameras], size, shape[1]),
            xy=wide(np.where(visible[..., None], self.xy[cameras], 0.0), size, *shape),
            weight=wide(visible.astype(float), size, *shape),
        )
        interior = np.pad(self.interior[cameras], [(0, size - len(cameras)), (0, 0)], mode="edge")
        return _Portion(
            cameras, flat, seen, interior,
            wide(self.axes[cameras], size), wide(self.middle[cameras], size),
        )  # fmt: skip

    def result(self, model: str, results: list[dict]) -> BatchCalibration:
        views = self.xy.shape[1]
        names = tuple(get_model(model).parameters[column] for column in self.free)
        if not results:
            raise InputError("image_points has no camera")
        of = {name: np.stack([row[name] for row in results]) for name in results[0]}
        good = of["status"] == CONVERGED
        for name, rows in of.items():
            if np.issubdtype(rows.dtype, np.floating):
                rows[~good] = np.nan
        for name in ("views", "position", "angles", "sigma_position", "sigma_angles", "rotation"):
            of[name] = of[name][:, :views]
        for name in ("position", "angles", "sigma_position", "sigma_angles", "rotation"):
            of[name][~of["views"]] = np.nan
        status = np.array(STATUS, dtype=object)[of.pop("status")].astype(str)
        return BatchCalibration(model=model, parameters=names, status=status, **of)


def _pixel_model(name: str) -> CameraModel:
    model = get_model(name)
    if model.unit != "px":
        raise InputError(f"model {name!r} is in {model.unit}; a batch needs a camera in pixels")
    return model


def _free(model: CameraModel, free) -> tuple[str, ...]:
    if free is None:
        free = FREE.get(model.name) or model.parameters
    for name in free:
        if name not in model.parameters or name in model.never_free:
            raise InputError(
                f"free: camera model {model.name!r} has no free parameter {name!r}; "
                f"its parameters are {', '.join(model.parameters)}"
            )
    if not free or len({*free}) < len(free):
        raise InputError("free: name at least one parameter, and each once")
    return tuple(free)


def _interior(model: CameraModel, free, start, size, cameras):
    """Start values [cameras, parameters]; are the focal lengths among them?"""
    values = {name: 1.0 for name in model.principal_distance} | default_parameters(model)
    values |= {name: (n - 1) / 2 for name, n in zip(("cx", "cy"), size) if name in values}
    start = dict(start or {})
    for name in start:
        if name not in values:
            raise InputError(
                f"start: camera model {model.name!r} has no parameter {name!r}; "
                f"its parameters are {', '.join(model.parameters)}"
            )
    given = [name for name in model.principal_distance if name in start]
    missing = [name for name in model.principal_distance if name not in start]
    held = [name for name in missing if name not in free]
    if (given and missing) or held:
        raise InputError(f"start: give {', '.join(missing)} as well")
    try:
        columns = [
            np.broadcast_to(np.asarray((values | start)[name], float), (cameras,))
            for name in model.parameters
        ]
    except (ValueError, TypeError) as error:
        raise InputError(f"start: a number, or one for each of {cameras} cameras") from error
    return np.stack(columns, 1), bool(given)


def _principal_axes(X):
    """Points [cameras, points, 3] about their mean and along their principal axes; mean; axes
    (rows) [cameras, 3, 3]; is the object flat?"""
    middle = X.mean(1)
    centred = X - middle[:, None]
    moments = np.einsum("cpi,cpj->cij", centred, centred)
    usable = np.isfinite(moments).all((1, 2))
    values, vectors = np.linalg.eigh(np.where(usable[:, None, None], moments, np.eye(3)))
    axes = vectors[:, :, ::-1].swapaxes(1, 2)
    axes = axes * np.linalg.det(axes)[:, None, None]
    flat = values[:, 0] < FLAT**2 * values[:, 1]
    return centred @ axes.swapaxes(1, 2), middle, axes, flat | ~usable


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()


def _solve_portion(model, free, known, max_steps, size, on_cpu, portion: _Portion) -> dict:
    """The rows of a `BatchCalibration`, with the status as its number."""
    result = _portion_program(
        model, free, known, portion.flat, max_steps, float(size), on_cpu,
        portion.seen, portion.interior, portion.axes, portion.middle,
    )  # fmt: skip
    return jax.tree.map(np.array, result)


@partial(jax.jit, static_argnums=range(7))
def _portion_program(
    model, free, known, flat, max_steps, size, on_cpu, seen, interior, axes, middle
):
    def one(arguments):
        seen, interior = arguments
        usable, start = start_values(model, flat, known, seen, interior, size)
        return solve_camera(model, free, max_steps, size, usable, start)

    every = partial(jax.lax.map, one) if on_cpu else jax.vmap(one)
    solved: Solved = every((seen, interior))
    variance = 2 * solved.cost / solved.redundancy
    covariance = variance[:, None, None] * solved.interior_cofactors
    points = 0.5 * (solved.redundancy + len(free) + 6 * solved.views.sum(1))
    rotation, position, angles, pose_sigma = jax.vmap(
        jax.vmap(_exterior_orientation, (0, 0, 0, None, None))
    )(solved.at.rotation, solved.at.shift, solved.pose_cofactors, axes, middle)
    pose_sigma = jnp.sqrt(variance)[:, None, None] * pose_sigma
    return dict(
        status=solved.status,
        values=solved.at.interior[:, jnp.array(free)],
        sigma=jnp.sqrt(jnp.diagonal(covariance, axis1=1, axis2=2)),
        covariance=covariance,
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
