"""A mounting with its covariance: from the pose that is adjusted to base and angles."""

import dataclasses
from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.display import print_in_one_screen
from jaxbundle.geometry import omega_phi_kappa_from_matrix, omega_phi_kappa_near
from jaxbundle.leastsquares import Pose, PoseValue
from jaxbundle.network.tables import EXTERIOR
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray

POSE = Pose.width
DEGREES = np.array([1, 1, 1, *[180 / np.pi] * 3])


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class Mounting:
    """The mounting of a camera in the frame of the reference camera; or the place of a board in
    that of another one.

    **Fields:** `base`: its projection centre, object unit; `rotation`: R, from the reference's
    frame to its own; `angles`: ω, φ, κ of R, degrees; `covariance` [6, 6] of base and angles, a
    posteriori; `length` of the base and its σ.
    """

    base: Float[np.ndarray, "3"]
    rotation: Float[np.ndarray, "3 3"]
    angles: Float[np.ndarray, "3"]
    covariance: Float[np.ndarray, "6 6"]
    length: float
    length_sigma: float

    @property
    def sigma(self) -> Float[np.ndarray, "6"]:
        """σ of base (object unit) and ω, φ, κ (degrees)."""
        return np.sqrt(np.diagonal(self.covariance))

    @property
    def correlation(self) -> Float[np.ndarray, "6 6"]:
        """Correlations of base and ω, φ, κ; 0 of a σ of 0."""
        positive_sigma = np.maximum(self.sigma, 1e-300)
        return self.covariance / positive_sigma[:, None] / positive_sigma

    @property
    def weakest(self) -> tuple[float, Float[np.ndarray, "3"]]:
        """The largest σ of the base in any direction, and this direction."""
        size, axes = np.linalg.eigh(self.covariance[:3, :3])
        return float(np.sqrt(max(size[2], 0.0))), axes[:, 2]


def table_of_mountings(mountings: Mapping[str, Mounting]) -> dict[str, np.ndarray]:
    """One row a mounting: columns camera, X0, Y0, Z0 (of the base, object unit), omega, phi, kappa
    (degrees), their σ (sX0, …), base and sbase (its length)."""
    values = np.array([[*m.base, *m.angles] for m in mountings.values()]).reshape(-1, POSE)
    sigma = np.array([m.sigma for m in mountings.values()]).reshape(-1, POSE)
    return {
        "camera": np.array([*mountings], dtype=object),
        **dict(zip(EXTERIOR, values.T)),
        **{f"s{name}": column for name, column in zip(EXTERIOR, sigma.T)},
        "base": np.array([m.length for m in mountings.values()]),
        "sbase": np.array([m.length_sigma for m in mountings.values()]),
    }


@partial(compile_once, static=0)
def _to_angles(
    placed: bool,
    pose: PoseValue,
    own_centroid: Float[AnyArray, "3"],
    frame_centroid: Float[AnyArray, "3"],
) -> tuple[Array, Array, Array, Array]:
    """Base, R, ω, φ, κ, and derivatives of base and angles by (δb, δθ).

    Of a camera the pose is its mounting: base and R. A board is `placed` by its pose, from its
    frame to that of its body, relative to the centroids of both, `own_centroid` and
    `frame_centroid`: the inverse says where it is."""
    block = Pose().prepare(pose)

    def place(block: Any) -> tuple[Array, Array]:
        R = block.rotation.matrix()
        if not placed:
            return jnp.stack(block.centre), R
        return frame_centroid - R @ (own_centroid + jnp.stack(block.centre)), R.T

    base, R = place(block)
    # Angles near the given ones, so that κ does not jump by a full turn in the derivatives.
    angles = omega_phi_kappa_from_matrix(R)

    def change(d: Float[Array, "6"]) -> Float[Array, "6"]:
        base, R = place(Pose().move(block, tuple(d)))
        return jnp.concatenate([base, omega_phi_kappa_near(R, angles)])

    return base, R, angles, jax.jacfwd(change)(jnp.zeros(POSE))


def mounting_of(pose: PoseValue, C: Float[np.ndarray, "6 6"]) -> Mounting:
    """A mounting by its pose and the covariance of (δb, δθ)."""
    return _mounting_with_covariance(_to_angles(False, pose, np.zeros(3), np.zeros(3)), C)


def placement_of(
    pose: PoseValue,
    C: Float[np.ndarray, "6 6"],
    own_centroid: Float[np.ndarray, "3"],
    frame_centroid: Float[np.ndarray, "3"],
) -> Mounting:
    """The place of a board by its pose on its body, with the centroids of the board and of the
    first board of the body, and the covariance of the pose."""
    return _mounting_with_covariance(_to_angles(True, pose, own_centroid, frame_centroid), C)


def _mounting_with_covariance(
    values_and_derivatives: tuple, C: Float[np.ndarray, "6 6"]
) -> Mounting:
    base, R, angles, J = map(np.asarray, values_and_derivatives)
    J, length = DEGREES[:, None] * J, float(np.linalg.norm(base))
    # σ of |b|: the variance along b
    direction = base / length if length else np.zeros(3)
    C = J @ C @ J.T
    return Mounting(
        base, R, np.degrees(angles), C, length, float(np.sqrt(direction @ C[:3, :3] @ direction))
    )
