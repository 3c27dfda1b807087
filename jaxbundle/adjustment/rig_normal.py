"""The normal equations of a rig: by camera and epoch, then all of them together (`rig.py`).

Columns shared by all epochs: the mounting (δb, δθ) of every camera but the first, the free
parameters of every camera, and the points, if they are unknown.
"""

import dataclasses
from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import block_diag

from jaxbundle import cameras
from jaxbundle.cameras import CameraModel

POSE = 6
CONSTRAINT = 1e6
"""Weight of the inner constraints in that of a point: they hold to a millionth of σ."""


@dataclasses.dataclass(frozen=True)
class RigCamera:
    """A camera of a rig: model, columns of its free parameters, image points in the unit of the
    model, [epochs, points, 2], which of them are there, and their weight 1/σ."""

    model: CameraModel
    free: tuple[int, ...]
    xy: Float[np.ndarray, "epochs points 2"]
    seen: Bool[np.ndarray, "epochs points"]
    weight: float = 1.0


@dataclasses.dataclass(frozen=True)
class RigValues:
    """The unknowns: interior orientation of every camera; base b_k [cameras, 3] and R_k of the
    mounting, b = 0 and R = 1 of the first camera, the reference; t_e and M_e of the object; its
    points about their middle."""

    interior: tuple[Float[np.ndarray, " parameters"], ...]
    base: Float[np.ndarray, "cameras 3"]
    turn: Float[np.ndarray, "cameras 3 3"]
    shift: Float[np.ndarray, "epochs 3"]
    rotation: Float[np.ndarray, "epochs 3 3"]
    points: Float[np.ndarray, "points 3"]


@dataclasses.dataclass(frozen=True)
class RigObject:
    """What is known of the points: coordinates about their middle; exact, with a σ, or free."""

    given: Float[np.ndarray, "points 3"]
    sigma: float | None = None
    free: bool = False

    @property
    def known(self) -> bool:
        return self.sigma is None and not self.free

    @property
    def unknowns(self) -> int:
        """Columns of the points in the shared unknowns."""
        return 0 if self.known else self.given.size

    @property
    def conditions(self) -> int:
        """Pseudo-observations, or inner constraints."""
        return 0 if self.known else 7 if self.free else self.given.size

    def weight(self, D: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
        """What is added to the normal matrix D of the points."""
        if self.sigma is not None:
            return np.eye(len(D)) / self.sigma**2
        X = self.given
        alone = np.diagonal(D) == 0
        G = [np.tile(axis, len(X)) for axis in np.eye(3)]
        G += [np.cross(axis, X).ravel() for axis in np.eye(3)] + [X.ravel()]
        G = np.linalg.svd(np.array(G) * ~alone, full_matrices=False)[2]
        size = np.diagonal(D)[~alone].mean()
        # points that no camera sees keep their place
        return CONSTRAINT * size * G.T @ G + size * np.diag(alone.astype(float))


@dataclasses.dataclass(frozen=True)
class System:
    """The normal equations: poses N_ee, mixed N_es, shared N_ss, right sides Jᵀv, vᵀPv, and the
    residuals by camera, NaN where there is no point."""

    poses: Float[np.ndarray, "epochs 6 6"]
    mixed: Float[np.ndarray, "epochs 6 s"]
    shared: Float[np.ndarray, "s s"]
    pose_right: Float[np.ndarray, "epochs 6"]
    right: Float[np.ndarray, " s"]
    vtpv: float
    residuals: tuple[Float[np.ndarray, "epochs points 2"], ...]


def mounting_columns(rig: Sequence[RigCamera], k: int) -> slice:
    """The shared columns that mount camera k > 0."""
    return slice(POSE * (k - 1), POSE * k)


def interior_columns(rig: Sequence[RigCamera], k: int) -> slice:
    """The shared columns that are free parameters of camera k."""
    first = POSE * (len(rig) - 1) + sum(len(camera.free) for camera in rig[:k])
    return slice(first, first + len(rig[k].free))


def _residual(model, free, interior, base, turn, shift, rotation, X, xy, change):
    """v of one image point after changes of pose (6), mounting (6), free parameters, point (3)."""
    spin = lambda theta, y: y + jnp.cross(theta, y)
    Y = spin(change[3:6], rotation @ (X + change[-3:])) + shift + change[:3]
    ray = spin(change[9:12], turn @ (Y - base - change[6:9]))
    p = interior.at[jnp.array(free, int)].add(change[12:-3])
    return jnp.stack(cameras.residual(model, "measured", tuple(p), tuple(ray), (xy[0], xy[1])))


@partial(jax.jit, static_argnums=(0, 1))
def _of_camera(model, free, interior, base, turn, shift, rotation, X, xy, weight):
    """By epoch: AᵀA of A = [pose, mounting, interior | v]; AᵀB with the points' columns B, [epochs,
    columns, points, 3]; BᵀB of every point over all epochs; v."""
    zero = jnp.zeros(2 * POSE + len(free) + 3)

    def row(shift, rotation, X, xy, w):
        def of(change):
            v = _residual(model, free, interior, base, turn, shift, rotation, X, xy, change)
            return w * v, w * v

        J, v = jax.jacfwd(of, has_aux=True)(zero)
        return jnp.concatenate([J[:, :-3], v[:, None]], 1), J[:, -3:], v

    there = weight > 0
    # what is not seen stands in the middle of the object, whose image always exists
    X = jnp.where(there[..., None], X, 0.0)
    xy = jnp.where(there[..., None], xy, 0.0)
    of_epoch = jax.vmap(row, (None, None, 0, 0, 0))
    A, B, v = jax.vmap(of_epoch)(shift, rotation, X, xy, weight)
    A, B = (jnp.where(there[..., None, None], rows, 0.0) for rows in (A, B))
    N = jnp.einsum("epri,eprj->eij", A, A)
    return N, jnp.einsum("epri,eprx->eipx", A, B), jnp.einsum("eprx,epry->pxy", B, B), v


def normal_equations(rig: Sequence[RigCamera], at: RigValues, board: RigObject) -> System:
    """The normal equations of all cameras at given values."""
    first = interior_columns(rig, len(rig) - 1).stop
    points = slice(first, first + board.unknowns)
    epochs = len(at.shift)
    poses, pose_right = np.zeros((epochs, POSE, POSE)), np.zeros((epochs, POSE))
    mixed = np.zeros((epochs, POSE, points.stop))
    shared, right = np.zeros((points.stop, points.stop)), np.zeros(points.stop)
    vtpv, residuals = 0.0, []
    for k, camera in enumerate(rig):
        N, cross, D, v = map(np.asarray, _of_camera(
            camera.model, camera.free, at.interior[k], at.base[k], at.turn[k], at.shift,
            at.rotation, at.points, camera.xy, camera.weight * camera.seen,
        ))  # fmt: skip
        # the first camera is the reference: it has no mounting
        local = np.arange(POSE if k else 2 * POSE, N.shape[1] - 1)
        own = np.r_[mounting_columns(rig, k) if k else slice(0, 0), interior_columns(rig, k)]
        poses += N[:, :POSE, :POSE]
        pose_right += N[:, :POSE, -1]
        mixed[:, :, own] += N[:, :POSE][:, :, local]
        shared[np.ix_(own, own)] += N[:, local][:, :, local].sum(0)
        right[own] += N[:, local, -1].sum(0)
        vtpv += float(N[:, -1, -1].sum())
        residuals.append(np.where(camera.seen[..., None], v / camera.weight, np.nan))
        if not board.known:
            cross = cross.reshape(*cross.shape[:2], -1)
            mixed[:, :, points] += cross[:, :POSE]
            shared[own, points] += cross[:, local].sum(0)
            shared[points, own] += cross[:, local].sum(0).T
            shared[points, points] += block_diag(*D)
            right[points] += cross[:, -1].sum(0)
    if not board.known:
        P, away = board.weight(shared[points, points]), (at.points - board.given).ravel()
        shared[points, points] += P
        right[points] += P @ away
        if board.sigma is not None:
            vtpv += float(away @ P @ away)
    return System(poses, mixed, shared, pose_right, right, vtpv, tuple(residuals))
