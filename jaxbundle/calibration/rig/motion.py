r"""Two groups of cameras that never see the same board, tied by the motion of the rig.

The first group sees boards fixed to one body, the second other boards fixed to the same body. With

    A_e     the first boards in the first cameras at the epoch e (board to camera, 4 × 4)
    B_e     the second boards in the second cameras
    X       from the frame of the second cameras to that of the first (the mounting)
    Z       from the frame of the first boards to that of the second

every epoch has one equation, that of robot-world and hand-eye calibration:

    A_e = X·B_e·Z        R_A·R_Zᵀ = R_X·R_B,      t_A − R_X·t_B = t_X + R_A·(R_Zᵀ·t_Z)

The rotations are the smallest singular vector of the first, linear in R_X and R_Zᵀ; the
translations follow from the second, linear in t_X and u = R_Zᵀ·t_Z. Rotations that are all alike
(a rig that is only shifted) leave t_X open, rotations about one axis leave its part along the axis.

Source: Shah (2013), Solving the robot-world/hand-eye calibration problem using the Kronecker
product, Journal of Mechanisms and Robotics 5.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

MIN_MOTION_EPOCHS = 3
"""Fewest epochs: between three there are two motions, and a motion determines no position along its
own axis."""
REWEIGHTED = 20
"""Iterations of the robust mean: halving the weight of a wrong epoch in each, a million times less
remains."""
SIGNIFICANT = 3.0
"""Rotations about a further axis, as a multiple of their own noise, from which they determine a
position at all; how well is then said by the σ of the adjustment."""
ROUNDING = 1e-9
"""Noise of rotations that fit exactly, radians."""


class Motion(NamedTuple):
    """How the motion of a rig ties two groups of cameras.

    `X`, `Z`: see above; `axis`: the direction in the frame of the first cameras along which the
    mounting is open, None if there is none; `turned`: the rig rotates at all; `noise` of the
    rotations, radians.
    """

    X: Float[np.ndarray, "4 4"]
    Z: Float[np.ndarray, "4 4"]
    axis: Float[np.ndarray, "3"] | None
    turned: bool
    noise: float

    @property
    def determined(self) -> bool:
        """Whether the whole mounting follows."""
        return self.turned and self.axis is None


def tie_by_motion(A: Float[np.ndarray, "n 4 4"], B: Float[np.ndarray, "n 4 4"]) -> Motion:
    """X and Z of A = X·B·Z, robustly, and what the motion leaves open.

    **Arguments:** at least `MIN_MOTION_EPOCHS` epochs.
    """
    n = len(A)
    weight = np.ones(n)
    for _ in range(REWEIGHTED):
        X, Z = _solve(A, B, weight)
        apart = A - X @ B @ Z
        size = max(float(np.median(np.linalg.norm(A[:, :3, 3], axis=1))), 1e-300)
        off = np.linalg.norm(apart[:, :3, :3], axis=(1, 2))
        off = off + np.linalg.norm(apart[:, :3, 3], axis=1) / size
        # the sum of distances instead of squares: a wrong epoch pulls no harder than a right one
        weight = 1 / np.maximum(off, max(float(np.median(off)), ROUNDING))
    turn = np.linalg.norm(_log(A[:, :3, :3], X[:3, :3] @ B[:, :3, :3] @ Z[:3, :3]), axis=1)
    # Median of the length of three errors of σ: 1.54 σ (χ with three degrees of freedom); of the
    # 3n angles 6 unknowns are subtracted
    noise = max(float(np.median(turn)) / 1.54 * np.sqrt(3 * n / (3 * n - 6)), ROUNDING)
    # What remains of R_A after its mean acts on u: without it t_X and u are one unknown
    R, share = A[:, :3, :3], weight / weight.sum()
    rest = np.sqrt(share)[:, None, None] * (R - np.einsum("e,eij->ij", share, R))
    _, size, V = np.linalg.svd(rest.reshape(-1, 3))
    turned, free = size[0] > SIGNIFICANT * noise, size[2] <= SIGNIFICANT * noise
    axis = None
    if turned and free:
        axis = np.einsum("e,eij,j->i", share, R, V[2])
        axis = axis / np.linalg.norm(axis)
    return Motion(X, Z, axis, bool(turned), noise)


def _solve(
    A: Float[np.ndarray, "n 4 4"], B: Float[np.ndarray, "n 4 4"], weight: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "4 4"]]:
    """X and Z of the weighted equations."""
    one, root = np.eye(3), np.sqrt(weight)
    # vec of rows: vec(R_A·W) = (R_A ⊗ 1)·vec W,  vec(R_X·R_B) = (1 ⊗ R_Bᵀ)·vec R_X
    rows = [
        w * np.hstack([np.kron(a[:3, :3], one), -np.kron(one, b[:3, :3].T)])
        for w, a, b in zip(root, A, B)
    ]
    _, _, V = np.linalg.svd(np.concatenate(rows))
    W, R = (part.reshape(3, 3) for part in np.split(V[-1], 2))
    sign = np.sign(np.linalg.det(W)) or 1.0
    W, R = nearest_rotation(sign * W), nearest_rotation(sign * R)
    equations = np.concatenate([w * np.hstack([one, a[:3, :3]]) for w, a in zip(root, A)])
    seen = np.concatenate([w * (a[:3, 3] - R @ b[:3, 3]) for w, a, b in zip(root, A, B)])
    t, u = np.split(np.linalg.lstsq(equations, seen, rcond=None)[0], 2)
    return transformation(R, t), transformation(W.T, W.T @ u)


def transformation(R: Float[np.ndarray, "3 3"], t: Float[np.ndarray, "3"]) -> np.ndarray:
    """The matrix [4, 4] of R·x + t."""
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = R, t
    return found


def nearest_rotation(M: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """The rotation nearest to a matrix."""
    U, _, V = np.linalg.svd(M)
    return U @ np.diag([1.0, 1.0, np.linalg.det(U @ V)]) @ V


def medoid(transformations: Sequence[Float[np.ndarray, "4 4"]]) -> Float[np.ndarray, "4 4"]:
    """The transformation nearest to all others: a wrong one does not move it, as it would a mean,
    and it needs no mean of rotations."""
    found = np.array(transformations)
    shift, R = found[:, :3, 3], found[:, :3, :3]
    size = np.median(np.linalg.norm(shift, axis=1)) + 1e-12
    apart = np.linalg.norm(R[:, None] - R, axis=(2, 3))
    apart += np.linalg.norm(shift[:, None] - shift, axis=2) / size
    return found[int(np.median(apart, axis=1).argmin())]


def _log(R: Float[np.ndarray, "n 3 3"], S: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n 3"]:
    """The vectors of the small rotations R·Sᵀ, radians."""
    D = R @ S.swapaxes(1, 2)
    return 0.5 * np.stack(
        [D[:, 2, 1] - D[:, 1, 2], D[:, 0, 2] - D[:, 2, 0], D[:, 1, 0] - D[:, 0, 1]], 1
    )
