"""Hand–eye and robot–world transformation in closed form: start values.

    A_i·X = Y·B_i,      so that of every two poses      (A_j⁻¹·A_i)·X = X·(B_j⁻¹·B_i)

A_i the hand in the base of the robot, X the camera on the hand (or the object on it), Y the object
space in the base (or the camera in it). Rotations first, from the rotation vectors of the motions,
α = R_X·β, by least squares (Park and Martin 1994); then the shifts, (R_A − 1)·t_X = R_X·t_B − t_A;
Y is the mean of A_i·X·B_i⁻¹.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

# Rotations of more than this, in radians, are no motions for the start: near π noise may turn the
# axis around.
LARGEST_TURN = 3.0
# The most others with which a pose is combined: of 200 poses all pairs, 20 000; of more
# poses pairs in equal steps, whose number grows with that of the poses only.
MOST_PARTNERS = 200


class Rigid(NamedTuple):
    """Rigid transformations, x' = R·x + t."""

    R: Float[np.ndarray, "*n 3 3"]
    t: Float[np.ndarray, "*n 3"]

    def compose(self, other: "Rigid") -> "Rigid":
        """This one after the other."""
        return Rigid(self.R @ other.R, (self.R @ other.t[..., None])[..., 0] + self.t)

    @property
    def inverse(self) -> "Rigid":
        transpose = np.swapaxes(self.R, -1, -2)
        return Rigid(transpose, -(transpose @ self.t[..., None])[..., 0])


def rotation_vectors(R: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n 3"]:
    """The rotation vectors, of lengths up to π, radians."""
    sine = 0.5 * np.stack(
        [R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], 1
    )
    length, cosine = np.linalg.norm(sine, axis=1), 0.5 * (np.trace(R, axis1=1, axis2=2) - 1)
    angle = np.arctan2(length, cosine)
    factor = np.where(length > 0, angle / np.where(length > 0, length, 1.0), 1.0)
    return factor[:, None] * sine


def motions(A: Rigid, B: Rigid) -> tuple[Rigid, Rigid]:
    """The motions of the hand and of the camera between pairs of poses."""
    n = len(A.t)
    steps = np.unique(np.linspace(1, n - 1, min(n - 1, MOST_PARTNERS)).astype(int))
    pairs = [np.arange(n - step) for step in steps]
    i = np.concatenate([start + step for start, step in zip(pairs, steps)])
    j = np.concatenate(pairs)
    relative_motion = lambda T: Rigid(T.R[j], T.t[j]).inverse.compose(Rigid(T.R[i], T.t[i]))
    return relative_motion(A), relative_motion(B)


class Turns(NamedTuple):
    """How far the hand turns between its poses: RMS about the main axis, and about any other one,
    radians; the main axis in the frame of the hand."""

    about_axis: float
    across_axis: float
    axis: Float[np.ndarray, "3"]


def turns(A: Rigid) -> Turns:
    """About which axes a hand turns."""
    alpha = rotation_vectors(motions(A, A)[0].R)
    size, axes = np.linalg.eigh(alpha.T @ alpha / max(len(alpha), 1))
    about_axis, across_axis = np.sqrt(np.maximum(size[::-1][:2], 0.0))
    axis = axes[:, -1]
    return Turns(
        float(about_axis), float(across_axis), axis if axis[np.abs(axis).argmax()] > 0 else -axis
    )


def solve(A: Rigid, B: Rigid) -> tuple[Rigid, Rigid, float]:
    """X, Y, and the scale by which lengths of B are multiplied to be those of A (1 is expected
    where B has its own)."""
    hand_motions, camera_motions = motions(A, B)
    alpha, beta = rotation_vectors(hand_motions.R), rotation_vectors(camera_motions.R)
    turn_angle = np.linalg.norm(alpha, axis=1)
    good = turn_angle < LARGEST_TURN
    good = good if good.any() else np.ones_like(good)
    R = nearest_rotation(alpha[good].T @ beta[good])
    # (R_A − 1)·t_X − s·R_X·t_B = −t_A
    eye, scaled = hand_motions.R - np.eye(3), -(R @ camera_motions.t.T).T[..., None]
    rows = np.concatenate([eye, scaled], 2).reshape(-1, 4)
    *_, scale = np.linalg.lstsq(rows, -hand_motions.t.ravel())[0]
    t = np.linalg.lstsq(eye.reshape(-1, 3), (-scaled[..., 0] - hand_motions.t).ravel())[0]
    X = Rigid(R, t)
    return X, other_side(A, X, B), float(scale)


def other_side(A: Rigid, X: Rigid, B: Rigid) -> Rigid:
    """Y of A·X = Y·B, the mean over all poses."""
    Y = A.compose(X).compose(B.inverse)
    R = nearest_rotation(Y.R.sum(0))
    # Of the places of B, not of its far origin.
    t = (A.compose(X).t - B.t @ R.T).mean(0)
    return Rigid(R, t)


def nearest_rotation(S: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """The rotation R of the largest trace of Rᵀ·S."""
    U, _, Vt = np.linalg.svd(S)
    return U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
