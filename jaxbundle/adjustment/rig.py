"""Several cameras on one rigid mounting, adjusted together from views of known points.

    Y = M_e·X + t_e                  the object at the epoch e in the frame of the reference camera
    ray = R_k·(Y − b_k)              camera k, its projection centre at b_k there
    v = image of the ray − measured  (by the camera's own model, weight 1 or 0)

Unknown are the pose of the object at every epoch (δt, δθ about its middle, the origin of X), the
mounting b_k, R_k of every camera but the reference (6 each), and the free parameters of every
camera. The mounting is the same for all epochs; the adjustment of a network, where every image has
a pose of its own, cannot say so: hence this one. Each camera gives for every epoch the augmented
normal matrix of [pose, mounting, interior | v]; the poses are eliminated (Schur),

    S = N_ss − Σ_e N_es ᵀ·N_ee⁻¹·N_es

and S has a few tens of unknowns. Marquardt's damping (1963). Derivatives by automatic
differentiation of the residual of one point.

Source: Luhmann, Robson, Kyle and Boehm (2014), Close-Range Photogrammetry and 3D Imaging, section
4.4; King (1994), Bundle adjustment of constrained stereo pairs, Geomatics Research Australasia.
"""

import dataclasses
from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxbundle import cameras
from jaxbundle.cameras import CameraModel
from jaxbundle.geometry import matrix_from_rotation_vector

POSE = 6
TOLERANCE = 1e-5
"""Converged: no unknown would move by more than this part of its σ."""
FIRST_DAMPING, LARGEST_DAMPING = 1e-4, 1e8
ROUNDING = 1e-14


@dataclasses.dataclass(frozen=True)
class RigCamera:
    """A camera of a rig: model, columns of its free parameters, image points in the unit of the
    model, [epochs, points, 2], and which of them are there."""

    model: CameraModel
    free: tuple[int, ...]
    xy: Float[np.ndarray, "epochs points 2"]
    seen: Bool[np.ndarray, "epochs points"]
    weight: float = 1.0


@dataclasses.dataclass(frozen=True)
class RigValues:
    """The unknowns: interior orientation of every camera; base b_k [cameras, 3] and R_k of the
    mounting, b = 0 and R = 1 of the first camera, the reference; t_e and M_e of the object."""

    interior: tuple[Float[np.ndarray, " parameters"], ...]
    base: Float[np.ndarray, "cameras 3"]
    turn: Float[np.ndarray, "cameras 3 3"]
    shift: Float[np.ndarray, "epochs 3"]
    rotation: Float[np.ndarray, "epochs 3 3"]


@dataclasses.dataclass(frozen=True)
class RigSolution:
    """The end of the iterations.

    **Fields:** `values`; `converged`, `iterations`; `vtpv`, `redundancy`, `sigma0`; `cofactors` of
    the shared unknowns: δb, δθ (6) of every camera but the first, then the free parameters camera
    after camera; `pose_cofactors` of (δt, δθ) of every epoch, marginal; `residuals` by camera, NaN
    where there is no point.
    """

    values: RigValues
    converged: bool
    iterations: int
    vtpv: float
    redundancy: int
    sigma0: float
    cofactors: Float[np.ndarray, "s s"]
    pose_cofactors: Float[np.ndarray, "epochs 6 6"]
    residuals: tuple[Float[np.ndarray, "epochs points 2"], ...]


def _residual(model, free, interior, base, turn, shift, rotation, X, xy, change):
    """v of one image point after changes of pose (6), mounting (6), free parameters."""
    spin = lambda theta, y: y + jnp.cross(theta, y)
    Y = spin(change[3:6], rotation @ X) + shift + change[:3]
    ray = spin(change[9:12], turn @ (Y - base - change[6:9]))
    p = interior.at[jnp.array(free, int)].add(change[12:])
    return jnp.stack(cameras.residual(model, "measured", tuple(p), tuple(ray), (xy[0], xy[1])))


@partial(jax.jit, static_argnums=(0, 1))
def _normal(model, free, interior, base, turn, shift, rotation, X, xy, weight):
    """Augmented normal matrices [epochs, 12 + k + 1, …] and residuals [epochs, points, 2]."""
    zero = jnp.zeros(2 * POSE + len(free))

    def row(shift, rotation, X, xy, w):
        def of(change):
            v = w * _residual(
                model, free, interior, base, turn, shift, rotation, X, xy, change
            )
            return v, v

        J, v = jax.jacfwd(of, has_aux=True)(zero)
        return jnp.concatenate([J, v[:, None]], 1), v

    there = weight > 0
    # what is not seen stands in the middle of the object, whose image always exists
    X = jnp.where(there[..., None], X, 0.0)
    xy = jnp.where(there[..., None], xy, 0.0)
    of_epoch = jax.vmap(row, (None, None, 0, 0, 0))
    A, v = jax.vmap(of_epoch)(shift, rotation, X, xy, weight)
    rows = jnp.where(there[..., None, None], A, 0.0).reshape(A.shape[0], -1, A.shape[-1])
    return jnp.einsum("eri,erj->eij", rows, rows), v


@dataclasses.dataclass
class _System:
    """The normal equations of all cameras, by epoch and shared."""

    poses: np.ndarray
    mixed: np.ndarray
    shared: np.ndarray
    pose_right: np.ndarray
    right: np.ndarray
    vtpv: float
    residuals: tuple


def _system(rig: Sequence[RigCamera], at: RigValues, X) -> _System:
    columns = _columns(rig)
    size = columns[-1].stop if columns else 0
    epochs = len(at.shift)
    poses, mixed = np.zeros((epochs, POSE, POSE)), np.zeros((epochs, POSE, size))
    shared, right, pose_right = np.zeros((size, size)), np.zeros(size), np.zeros((epochs, POSE))
    vtpv, residuals = 0.0, []
    for k, camera in enumerate(rig):
        N, v = map(np.asarray, _normal(
            camera.model, camera.free, at.interior[k], at.base[k], at.turn[k], at.shift,
            at.rotation, X, camera.xy, camera.weight * camera.seen,
        ))  # fmt: skip
        own = _own_columns(columns, k, len(rig))
        local = np.arange(POSE if k else 2 * POSE, N.shape[1] - 1)
        poses += N[:, :POSE, :POSE]
        pose_right += N[:, :POSE, -1]
        mixed[:, :, own] += N[:, :POSE][:, :, local]
        shared[np.ix_(own, own)] += N[:, local][:, :, local].sum(0)
        right[own] += N[:, local, -1].sum(0)
        vtpv += float(N[:, -1, -1].sum())
        residuals.append(np.where(camera.seen[..., None], v / camera.weight, np.nan))
    return _System(poses, mixed, shared, pose_right, right, vtpv, tuple(residuals))


def _columns(rig) -> list[slice]:
    """Of the shared unknowns: mountings of cameras 1, 2, …, then parameters of cameras 0, 1, …"""
    columns, at = [], 0
    for width in [*[POSE] * (len(rig) - 1), *(len(camera.free) for camera in rig)]:
        columns.append(slice(at, at + width))
        at += width
    return columns


def mounting_columns(rig: Sequence[RigCamera], k: int) -> slice:
    """The columns of the shared unknowns that mount camera k > 0."""
    return _columns(rig)[k - 1]


def interior_columns(rig: Sequence[RigCamera], k: int) -> slice:
    """The columns of the shared unknowns that are free parameters of camera k."""
    return _columns(rig)[len(rig) - 1 + k]


def _own_columns(columns, k, number):
    interior = np.r_[columns[number - 1 + k]]
    return np.concatenate([np.r_[columns[k - 1]], interior]) if k else interior


def adjust_rig(
    rig: Sequence[RigCamera],
    points: Float[np.ndarray, "points 3"],
    start: RigValues,
    max_iterations: int = 50,
) -> RigSolution:
    """Adjust a rig from start values.

    **Arguments:** `points`: known coordinates about their middle; the first camera is the
    reference. Every epoch must be seen by a camera, every camera by more than one point.

    **Returns:** the solution; what is not determined, or did not settle, is not `converged`.
    """
    X = np.asarray(points, float)
    at, system = start, _system(rig, start, X)
    rows = 2 * sum(int(camera.seen.sum()) for camera in rig)
    redundancy = rows - POSE * len(start.shift) - len(system.right)
    damping, converged, steps = FIRST_DAMPING, False, 0
    possible = np.isfinite(system.vtpv) and redundancy >= 0
    while possible and steps < max_iterations and damping <= LARGEST_DAMPING:
        steps += 1
        try:
            d_pose, d_shared, slope = _step(system, damping)
        except np.linalg.LinAlgError:
            damping = max(10 * damping, FIRST_DAMPING)
            continue
        small = TOLERANCE**2 * system.vtpv / max(redundancy, 1) + ROUNDING * system.vtpv
        if slope <= small and damping == 0:
            at, converged = _moved(rig, at, d_pose, d_shared), True
            break
        trial = _moved(rig, at, d_pose, d_shared)
        tried = _system(rig, trial, X)
        if np.isfinite(tried.vtpv) and tried.vtpv <= system.vtpv * (1 + 1e-14):
            near = system.vtpv - tried.vtpv < 1e-3 * system.vtpv
            at, system = trial, tried
            damping = 0.0 if near else damping / 10
        else:
            damping = max(10 * damping, FIRST_DAMPING)
    system = _system(rig, at, X)
    sigma0 = float(np.sqrt(system.vtpv / redundancy)) if redundancy > 0 else float("nan")
    try:
        Q, Q_pose = _cofactors(system)
    except np.linalg.LinAlgError:
        Q = np.full(system.shared.shape, np.inf)
        Q_pose, converged = np.full(system.poses.shape, np.inf), False
    return RigSolution(
        at, converged, steps, system.vtpv, redundancy, sigma0, Q, Q_pose, system.residuals
    )


def _scaled(system, damping):
    """Scales that make the diagonals 1, and the damped blocks."""
    s = 1 / np.sqrt(np.maximum(np.diagonal(system.shared), 1e-300))
    p = 1 / np.sqrt(np.maximum(np.diagonal(system.poses, axis1=1, axis2=2), 1e-300))
    E = system.poses * p[:, :, None] * p[:, None] + damping * np.eye(POSE)
    C = system.mixed * p[:, :, None] * s
    N = system.shared * s[:, None] * s + damping * np.eye(len(s))
    return E, C, N, p, s


def _step(system, damping):
    """Changes of poses and shared unknowns, and what the step promises, −gᵀδ."""
    E, C, N, p, s = _scaled(system, damping)
    solved = np.linalg.solve(E, np.concatenate([C, (p * system.pose_right)[..., None]], 2))
    through, own = solved[..., :-1], solved[..., -1]
    S = N - np.einsum("eps,ept->st", C, through)
    L = np.linalg.cholesky(S)
    g = s * system.right - np.einsum("eps,ep->s", C, own)
    d_shared = -np.linalg.solve(L.T, np.linalg.solve(L, g))
    d_pose = -own - np.einsum("eps,s->ep", through, d_shared)
    d_pose, d_shared = p * d_pose, s * d_shared
    slope = -(system.pose_right * d_pose).sum() - system.right @ d_shared
    if not np.isfinite(slope):
        raise np.linalg.LinAlgError("not finite")
    return d_pose, d_shared, float(slope)


def _cofactors(system):
    E, C, N, p, s = _scaled(system, 0.0)
    inverse = np.linalg.inv(E)
    through = inverse @ C
    S = N - np.einsum("eps,ept->st", C, through)
    np.linalg.cholesky(S)
    Q = np.linalg.inv(S)
    poses = inverse + through @ Q @ through.swapaxes(1, 2)
    return Q * s[:, None] * s, poses * p[:, :, None] * p[:, None]


@jax.jit
def _turned(theta, M):
    return jax.vmap(lambda theta, M: matrix_from_rotation_vector(theta) @ M)(theta, M)


def _moved(rig, at: RigValues, d_pose, d_shared) -> RigValues:
    d_base, d_turn = np.zeros((len(rig), 3)), np.zeros((len(rig), 3))
    interior = []
    for k, camera in enumerate(rig):
        if k:
            change = d_shared[mounting_columns(rig, k)]
            d_base[k], d_turn[k] = change[:3], change[3:]
        p = np.array(at.interior[k], float)
        p[list(camera.free)] += d_shared[interior_columns(rig, k)]
        interior.append(p)
    # the object turns about its middle, its shift is added
    return RigValues(
        tuple(interior), at.base + d_base, np.asarray(_turned(d_turn, at.turn)),
        at.shift + d_pose[:, :3], np.asarray(_turned(d_pose[:, 3:], at.rotation)),
    )
