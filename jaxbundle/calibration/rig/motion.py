r"""Two groups of cameras that never see the same board, tied by the motion of the rig.

The first group sees boards fixed to one body, the second other boards fixed to the same body. With

    A_e     the first boards in the first cameras at the epoch e (board to camera, 4 × 4)
    B_e     the second boards in the second cameras
    X       from the frame of the second cameras to that of the first (the mounting)
    Z       from the frame of the first boards to that of the second

every epoch has one equation, that of robot-world and hand-eye calibration:

    A_e = X·B_e·Z        R_A·R_Zᵀ = R_X·R_B,      t_A − R_X·t_B = t_X + R_A·(R_Zᵀ·t_Z)

With rotations about two axes or more, R_X and R_Zᵀ are the smallest singular vector of the first,
which is linear in them, and the translations follow from the second, linear in t_X and
u = R_Zᵀ·t_Z.

With rotations about one axis a only, t_X is open along a, and the first leaves R_X open by a turn
about a; with R_0 a rotation that maps the rotation vectors of the second cameras to those of the
first, it follows from the second, linear in c = cos θ, s = sin θ, t_X and u:

    R_X = (a·aᵀ + c·(1 − a·aᵀ) + s·[a]×)·R_0

Without rotations t_X is open, and R_X turns the shifts of the second cameras into those of the
first.

Source: Shah (2013), Solving the robot-world/hand-eye calibration problem using the Kronecker
product, Journal of Mechanisms and Robotics 5
(two axes); Kabsch (1976), A solution for the best rotation to relate two sets of vectors, Acta
Crystallographica A32.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbundle.geometry.principal_axes import principal_axes
from jaxbundle.network.kinds.fit_hand_eye import nearest_rotation

# Fewest epochs: between three there are two motions, and a motion determines no position along its
# own axis.
MIN_MOTION_EPOCHS = 3
# Iterations of the robust mean: halving the weight of a wrong epoch in each, a million times less
# remains.
REWEIGHTED = 20
# Rotations about a further axis, as a multiple of their own noise, from which they determine a
# position at all; how well is then said by the σ of the adjustment.
SIGNIFICANT = 3.0
# Noise of rotations that fit exactly, radians.
ROUNDING = 1e-9


class Motion(NamedTuple):
    """How the motion of a rig ties two groups of cameras.

    `X`, `Z`: see above, with the smallest translations where they are open;
    `open_directions`: those in the frame of the first cameras along which the mounting is open,
    [3, 0], [3, 1] (the axis of all rotations) or [3, 3] (no rotations); `turn`: the rotation from
    that frame to that of the first boards, for the shifts along these.
    """

    X: Float[np.ndarray, "4 4"]
    Z: Float[np.ndarray, "4 4"]
    open_directions: Float[np.ndarray, "3 directions"]
    turn: Float[np.ndarray, "3 3"]

    @property
    def determined(self) -> bool:
        """Whether the whole mounting follows."""
        return self.open_directions.shape[1] == 0

    def shifted(self, shift: Float[np.ndarray, "3"]) -> "Motion":
        """The same with another translation of X, of which only the open part counts: it moves the
        second boards with the second cameras."""
        open_part = self.open_directions @ self.open_directions.T @ shift
        X, Z = self.X.copy(), self.Z.copy()
        X[:3, 3] += open_part
        Z[:3, 3] -= Z[:3, :3] @ self.turn @ open_part  # u loses what t_X gains
        return self._replace(X=X, Z=Z)


def tie_by_motion(A: Float[np.ndarray, "n 4 4"], B: Float[np.ndarray, "n 4 4"]) -> Motion:
    """X and Z of A = X·B·Z, robustly, and what the motion leaves open.

    **Arguments:** at least `MIN_MOTION_EPOCHS` epochs.
    """
    n, R = len(A), A[:, :3, :3]
    weight, size = np.ones(n), max(float(np.median(np.linalg.norm(A[:, :3, 3], axis=1))), 1e-300)
    for _ in range(REWEIGHTED):
        solutions = {number: _solve(A, B, weight, number) for number in (0, 1, 3)}
        turns = {
            k: _log(R, X[:3, :3] @ B[:, :3, :3] @ Z[:3, :3]) for k, (X, Z) in solutions.items()
        }
        # The median of the length of three errors of σ is 1.54 σ (χ with three degrees of freedom);
        # 6 unknowns are subtracted from the 3n angles. Of rotations about one axis the formulas of
        # any axes have no good solution, and the others less noise.
        lengths = min(float(np.median(np.linalg.norm(turn, axis=1))) for turn in turns.values())
        noise = max(lengths / 1.54 * np.sqrt(3 * n / (3 * n - 6)), ROUNDING)
        extents, V = _rotations(R, weight)
        open_axes = int((extents <= SIGNIFICANT * noise).sum())
        X, Z = solutions[open_axes if open_axes < 2 else 3]
        misclosure = A - X @ B @ Z
        distance = np.linalg.norm(misclosure[:, :3, :3], axis=(1, 2))
        distance = distance + np.linalg.norm(misclosure[:, :3, 3], axis=1) / size
        # The sum of distances instead of squares: a wrong epoch pulls no harder than a right one.
        weight = 1 / np.maximum(distance, max(float(np.median(distance)), ROUNDING))
        weight = weight / weight.mean()
    mean = np.einsum("e,eij->ij", weight / weight.sum(), R)
    turn = nearest_rotation(mean).T
    if open_axes == 0:
        return Motion(X, Z, np.zeros((3, 0)), turn)
    if open_axes == 1:
        axis = mean @ V[2]
        return Motion(X, Z, (axis / np.linalg.norm(axis))[:, None], turn)
    return Motion(X, Z, np.eye(3), turn)


def _rotations(
    R: Float[np.ndarray, "n 3 3"], weight: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """How far rotations move unit vectors, root of the mean square, in three directions (rows) of
    the frame of the boards: what remains of R_A after its mean acts on u; without it t_X and u are
    one unknown."""
    share = weight / weight.sum()
    deviation = np.sqrt(share)[:, None, None] * (R - np.einsum("e,eij->ij", share, R))
    return principal_axes(deviation.reshape(-1, 3))


def _solve(
    A: Float[np.ndarray, "n 4 4"],
    B: Float[np.ndarray, "n 4 4"],
    weight: Float[np.ndarray, " n"],
    number: int,
) -> tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "4 4"]]:
    """X and Z of the weighted equations; `number` of directions that rotations leave open."""
    if number == 0:
        R, W = _rotations_of_any_axes(A, B, weight)
    else:
        R = _turn_about_axis(A, B, weight) if number == 1 else _turn_of_shifts(A, B, weight)
        pairs = zip(weight, A[:, :3, :3], B[:, :3, :3])
        W = nearest_rotation(np.sum([w * a.T @ R @ b for w, a, b in pairs], axis=0))
    t, u = _translations(A, B, weight, R)
    return transformation(R, t), transformation(W.T, W.T @ u)


def _rotations_of_any_axes(
    A: Float[np.ndarray, "n 4 4"], B: Float[np.ndarray, "n 4 4"], weight: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3 3"]]:
    """R_X and R_Zᵀ of rotations about two axes or more."""
    identity = np.eye(3)
    # vec of rows: vec(R_A·W) = (R_A ⊗ 1)·vec W,  vec(R_X·R_B) = (1 ⊗ R_Bᵀ)·vec R_X.
    rows = [
        w * np.hstack([np.kron(a[:3, :3], identity), -np.kron(identity, b[:3, :3].T)])
        for w, a, b in zip(np.sqrt(weight), A, B)
    ]
    _, V = principal_axes(np.concatenate(rows))
    W, R = (part.reshape(3, 3) for part in np.split(V[-1], 2))
    sign = np.sign(np.linalg.det(W)) or 1.0
    return nearest_rotation(sign * R), nearest_rotation(sign * W)


def _turn_about_axis(
    A: Float[np.ndarray, "n 4 4"], B: Float[np.ndarray, "n 4 4"], weight: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "3 3"]:
    """R_X of rotations about one axis and of shifts."""
    Ra, Rb = A[:, :3, :3], B[:, :3, :3]
    heaviest = int(weight.argmax())
    r, q = (_log(R, np.broadcast_to(R[heaviest], R.shape)) for R in (Ra, Rb))
    R0 = nearest_rotation(np.einsum("e,ei,ej->ij", weight, r, q))
    _, V = principal_axes(np.sqrt(weight)[:, None] * r)
    a = V[0]
    cross_matrix = np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])
    projection, rows, right_sides = np.outer(a, a), [], []
    for w, pose_a, pose_b in zip(np.sqrt(weight), A, B):
        t = R0 @ pose_b[:3, 3]
        columns = np.stack([t - projection @ t, cross_matrix @ t], 1)
        rows.append(w * np.hstack([columns, np.eye(3), pose_a[:3, :3]]))
        right_sides.append(w * (pose_a[:3, 3] - projection @ t))
    c, s, *_ = np.linalg.lstsq(np.concatenate(rows), np.concatenate(right_sides), rcond=None)[0]
    c, s = np.array([c, s]) / max(np.hypot(c, s), 1e-300)
    return (projection + c * (np.eye(3) - projection) + s * cross_matrix) @ R0


def _turn_of_shifts(
    A: Float[np.ndarray, "n 4 4"], B: Float[np.ndarray, "n 4 4"], weight: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "3 3"]:
    """R_X of shifts without rotations."""
    share = weight / weight.sum()
    t, s = (T[:, :3, 3] - share @ T[:, :3, 3] for T in (A, B))
    return nearest_rotation(np.einsum("e,ei,ej->ij", share, t, s))


def _translations(
    A: Float[np.ndarray, "n 4 4"],
    B: Float[np.ndarray, "n 4 4"],
    weight: Float[np.ndarray, " n"],
    R: Float[np.ndarray, "3 3"],
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """t_X and u; where they are open, the smallest."""
    root = np.sqrt(weight)
    rows = [w * np.hstack([np.eye(3), a[:3, :3]]) for w, a in zip(root, A)]
    right_sides = [w * (a[:3, 3] - R @ b[:3, 3]) for w, a, b in zip(root, A, B)]
    t, u = np.split(
        np.linalg.lstsq(np.concatenate(rows), np.concatenate(right_sides), rcond=None)[0], 2
    )
    return t, u


def transformation(R: Float[np.ndarray, "3 3"], t: Float[np.ndarray, "3"]) -> np.ndarray:
    """The matrix [4, 4] of R·x + t."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = R, t
    return matrix


def medoid(transformations: Sequence[Float[np.ndarray, "4 4"]]) -> Float[np.ndarray, "4 4"]:
    """The transformation nearest to all others: a wrong one does not move it, as it would a mean,
    and it needs no mean of rotations."""
    stack = np.array(transformations)
    shift, R = stack[:, :3, 3], stack[:, :3, :3]
    size = np.median(np.linalg.norm(shift, axis=1)) + 1e-12
    distance = np.linalg.norm(R[:, None] - R, axis=(2, 3))
    distance += np.linalg.norm(shift[:, None] - shift, axis=2) / size
    return stack[int(np.median(distance, axis=1).argmin())]


def _log(R: Float[np.ndarray, "n 3 3"], S: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n 3"]:
    """The vectors of the small rotations R·Sᵀ, radians."""
    D = R @ S.swapaxes(1, 2)
    return 0.5 * np.stack(
        [D[:, 2, 1] - D[:, 1, 2], D[:, 0, 2] - D[:, 2, 0], D[:, 1, 0] - D[:, 0, 1]], 1
    )
