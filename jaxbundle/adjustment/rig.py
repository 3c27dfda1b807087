"""Several cameras on one rigid mounting, adjusted together from views of one object.

    Y = M_e·X + t_e                  a point at the epoch e in the frame of the reference camera
    ray = R_k·(Y − b_k)              camera k, its projection centre at b_k there
    v = image of the ray − measured  (by the camera's own model)

Unknown are the pose of the object at every epoch (δt, δθ about its middle, the origin of X), the
mounting b_k, R_k of every camera but the reference (6 each), the free parameters of every camera,
and the points X, unless they are known: with a σ they are weighted, free ones carry inner
constraints, Gᵀ·δX = 0 (7, scale included). The mounting is the same for all epochs; the adjustment
of a network, where every image has a pose of its own, cannot say so: hence this one. The poses are
eliminated (Schur),

    S = N_ss − Σ_e N_es ᵀ·N_ee⁻¹·N_es

and S has a few tens of unknowns, and three more for every unknown point. The damping is
Marquardt's (1963); derivatives by automatic differentiation of the residual of one point
(`rig_normal`).

Source: Luhmann, Robson, Kyle and Boehm (2014), Close-Range Photogrammetry and 3D Imaging, section
4.4; King (1994), Bundle adjustment of constrained stereo pairs, Geomatics Research Australasia.
"""

import dataclasses
from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Float

from jaxbundle.adjustment.rig_normal import (
    POSE,
    RigCamera,
    RigObject,
    RigValues,
    System,
    interior_columns,
    mounting_columns,
    normal_equations,
)
from jaxbundle.geometry import matrix_from_rotation_vector

TOLERANCE = 1e-5
"""Converged: no unknown would move by more than this part of its σ."""
FIRST_DAMPING, LARGEST_DAMPING = 1e-4, 1e8
ROUNDING = 1e-14
NEAR = 1e-3
"""A step that lowers vᵀPv by less than this part is followed by an undamped one."""


@dataclasses.dataclass(frozen=True)
class RigSolution:
    """The end of the iterations.

    **Fields:** `values`; `converged`, `iterations`; `vtpv`, `redundancy`, `sigma0`; `cofactors` of
    the shared unknowns: δb, δθ (6) of every camera but the first, then the free parameters camera
    after camera, then the points, if they are unknown; `pose_cofactors` of (δt, δθ) of every epoch,
    marginal; `residuals` by camera, NaN where there is no point.
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


def adjust_rig(
    rig: Sequence[RigCamera],
    board: RigObject,
    start: RigValues,
    max_iterations: int = 50,
) -> RigSolution:
    """Adjust a rig from start values.

    **Arguments:** the first camera is the reference. Every epoch must be seen by a camera, every
    camera by more than one point.

    **Returns:** the solution; what is not determined, or did not settle, is not `converged`.
    """
    at, system = start, normal_equations(rig, start, board)
    rows = 2 * sum(int(camera.seen.sum()) for camera in rig) + board.conditions
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
        trial = _moved(rig, at, d_pose, d_shared)
        small = TOLERANCE**2 * system.vtpv / max(redundancy, 1) + ROUNDING * system.vtpv
        if slope <= small and damping == 0:
            at, converged = trial, True
            break
        tried = normal_equations(rig, trial, board)
        if np.isfinite(tried.vtpv) and tried.vtpv <= system.vtpv * (1 + ROUNDING):
            near = system.vtpv - tried.vtpv < NEAR * system.vtpv
            at, system = trial, tried
            damping = 0.0 if near else damping / 10
        else:
            damping = max(10 * damping, FIRST_DAMPING)
    system = normal_equations(rig, at, board)
    sigma0 = float(np.sqrt(system.vtpv / redundancy)) if redundancy > 0 else float("nan")
    try:
        Q, Q_pose = _cofactors(system)
    except np.linalg.LinAlgError:
        Q = np.full(system.shared.shape, np.inf)
        Q_pose, converged = np.full(system.poses.shape, np.inf), False
    return RigSolution(
        at, converged, steps, system.vtpv, redundancy, sigma0, Q, Q_pose, system.residuals
    )


def _scaled(system: System, damping: float):
    """The damped blocks, scaled so that their diagonals are 1 before; the scales."""
    s = 1 / np.sqrt(np.maximum(np.diagonal(system.shared), 1e-300))
    p = 1 / np.sqrt(np.maximum(np.diagonal(system.poses, axis1=1, axis2=2), 1e-300))
    E = system.poses * p[:, :, None] * p[:, None] + damping * np.eye(POSE)
    C = system.mixed * p[:, :, None] * s
    N = system.shared * s[:, None] * s + damping * np.eye(len(s))
    return E, C, N, p, s


def _step(system: System, damping: float):
    """Changes of poses and shared unknowns, and what the step promises, −gᵀδ."""
    E, C, N, p, s = _scaled(system, damping)
    solved = np.linalg.solve(E, np.concatenate([C, (p * system.pose_right)[..., None]], 2))
    through, own = solved[..., :-1], solved[..., -1]
    S = N - np.tensordot(C, through, ((0, 1), (0, 1)))
    L = np.linalg.cholesky(S)
    g = s * system.right - np.einsum("eps,ep->s", C, own)
    d_shared = -np.linalg.solve(L.T, np.linalg.solve(L, g))
    d_pose = -own - through @ d_shared
    d_pose, d_shared = p * d_pose, s * d_shared
    slope = -(system.pose_right * d_pose).sum() - system.right @ d_shared
    if not np.isfinite(slope):
        raise np.linalg.LinAlgError("not finite")
    return d_pose, d_shared, float(slope)


def _cofactors(system: System):
    """Q of the shared unknowns and, marginal, of every pose."""
    E, C, N, p, s = _scaled(system, 0.0)
    inverse = np.linalg.inv(E)
    through = inverse @ C
    S = N - np.tensordot(C, through, ((0, 1), (0, 1)))
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
    d_point = d_shared[interior_columns(rig, len(rig) - 1).stop :]
    return RigValues(
        tuple(interior), at.base + d_base, np.asarray(_turned(d_turn, at.turn)),
        at.shift + d_pose[:, :3], np.asarray(_turned(d_pose[:, 3:], at.rotation)),
        at.points + (d_point.reshape(-1, 3) if len(d_point) else 0.0),
    )
