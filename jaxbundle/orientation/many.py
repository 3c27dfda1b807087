"""Many orientations at once: lists of any length with one compiled program.

Every item is padded with absent observations (weight 0) to `SLOTS`, and items to full lanes; from
more observations a well-spread subset is used. On the host, with numpy input and output.
"""

from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbundle.geometry import (
    matrix_from_omega_phi_kappa,
    matrix_from_quaternion,
    omega_phi_kappa_from_matrix,
    rotation_vector_from_matrix,
    transform_point,
)
from jaxbundle.leastsquares.iterations.small import minimise
from jaxbundle.orientation.absolute import absolute_orientation
from jaxbundle.orientation.intersection import intersection, misclosure
from jaxbundle.orientation.pose import Pose
from jaxbundle.orientation.resection import refine_resection
from jaxbundle.orientation.robust import robust_relative_orientation, robust_resection
from jaxbundle.orientation.status import Status
from jaxbundle.system.compilation import quick_jit
from jaxbundle.system.programs import compile_once

SLOTS = 64
"""Padded numbers of points of an image, of a pair, of two models."""
RAYS = 8
"""Padded number of rays of a point."""
LANES, POINT_LANES = 8, 256
BY_RAYS = 40
"""Steps of a similarity by rays, which has a rough start."""


def resect(
    xy: Sequence[Float[np.ndarray, "_ 2"]],
    X: Sequence[Float[np.ndarray, "_ 3"]],
    tolerance: Float[np.ndarray, " images"],
):
    """X0, M of images, and the part of their points that agree within `tolerance` (c = 1); 0: no
    pose."""
    rows = [spread(len(a)) for a in xy]
    return run_in_lanes(
        _resect,
        LANES,
        _gather_slots(xy, rows, SLOTS),
        _gather_slots(X, rows, SLOTS),
        _weights(rows, SLOTS),
        tolerance,
    )


def refine(poses, xy, X, weights):
    """X0, M of images improved from start values by points of weight > 0."""
    rows = [spread(len(a)) for a in xy]
    return run_in_lanes(
        _refine,
        LANES,
        *poses,
        _gather_slots(xy, rows, SLOTS),
        _gather_slots(X, rows, SLOTS),
        _gather_slots(weights, rows, SLOTS),
    )


def orient_pairs(xy1, xy2, tolerance):
    """M, b of pairs of images, the part of the points that agree within `tolerance`, and the
    median angle of intersection (radians)."""
    rows = [spread(len(a)) for a in xy1]
    return run_in_lanes(
        _orient_pair,
        LANES,
        _gather_slots(xy1, rows, SLOTS),
        _gather_slots(xy2, rows, SLOTS),
        _weights(rows, SLOTS),
        tolerance,
    )


def intersect(X0, rays, weights):
    """X, angle of intersection and status of points with up to `RAYS` rays, [n, RAYS, …]."""
    return run_in_lanes(_intersect, POINT_LANES, X0, rays, weights)


def similarity(source, target, weights):
    """A = exp(s)·R and t of X' = A·X + t between two lists of points; None of points on a line."""
    rows = [spread(len(source))]
    A, t, status = run_in_lanes(
        _similarity,
        1,
        _gather_slots([source], rows, SLOTS),
        _gather_slots([target], rows, SLOTS),
        _gather_slots([weights], rows, SLOTS) * _weights(rows, SLOTS),
    )
    return (A[0], t[0]) if status[0] == int(Status.SOUND) else None


def similarity_by_rays(X, X0, rays, A, t):
    """A and t of X' = A·X + t by which points X come to lie on rays, from start values; and the
    misclosure of every ray, the tangent of its angle."""
    rows = [spread(len(X))]
    filled = (_gather_slots([a], rows, SLOTS) for a in (X, X0, rays))
    weights = _weights(rows, SLOTS)
    A, t, off = run_in_lanes(_similarity_by_rays, 1, *filled, weights, A[None], t[None])
    return A[0], t[0], off[0][: len(rows[0])]


def matrices(angles):
    """M of ω, φ, κ."""
    return run_in_lanes(_matrix, POINT_LANES, angles)[0]


def matrices_of_quaternions(q):
    """M of unit quaternions."""
    return run_in_lanes(_matrix_of_quaternion, POINT_LANES, q)[0]


def angles(M):
    """ω, φ, κ of M."""
    return run_in_lanes(_angles, POINT_LANES, M)[0]


def prepare() -> None:
    """Compile what places images and points, ahead of its data."""
    rng = np.random.default_rng(0)
    xy, X = [rng.uniform(-0.5, 0.5, (SLOTS, 2))], [rng.normal(size=(SLOTS, 3))]
    resect(xy, X, np.full(1, 1e-3))
    refine((np.zeros((1, 3)), np.eye(3)[None]), xy, X, np.ones((1, SLOTS)))
    intersect(rng.normal(size=(1, RAYS, 3)), rng.normal(size=(1, RAYS, 3)), np.ones((1, RAYS)))


def spread(number: int, most: int = SLOTS) -> np.ndarray:
    """Up to `most` of a number of rows, evenly."""
    if number <= most:
        return np.arange(number)
    return np.linspace(0, number - 1, most).astype(int)


@quick_jit
@jax.vmap
def _resect(xy, X, weights, tolerance):
    key = jax.random.key(0)
    found, good = robust_resection(key, xy, X, weights, threshold=tolerance)
    sound = (found.status == int(Status.SOUND)) & jnp.all(jnp.isfinite(found.pose.X0))
    part = jnp.sum(good) / jnp.sum(weights > 0)
    return found.pose.X0, found.pose.M, jnp.where(sound, part, 0.0)


@quick_jit
@jax.vmap
def _refine(X0, M, xy, X, weights):
    found = refine_resection(Pose(X0, M), xy, X, weights).pose
    good = jnp.all(jnp.isfinite(found.X0)) & jnp.all(jnp.isfinite(found.M))
    return jnp.where(good, found.X0, X0), jnp.where(good, found.M, M)


@quick_jit
@jax.vmap
def _orient_pair(xy1, xy2, weights, tolerance):
    key = jax.random.key(0)
    found, good = robust_relative_orientation(key, xy1, xy2, weights, threshold=tolerance)
    ray = lambda xy: jnp.append(xy, -1.0) / jnp.sqrt(1 + xy @ xy)
    one, two = jax.vmap(ray)(xy1), jax.vmap(ray)(xy2) @ found.M
    angle = jnp.arctan2(jnp.linalg.norm(jnp.cross(one, two), axis=1), jnp.sum(one * two, 1))
    number = jnp.sum(good)
    ordered = jnp.sort(jnp.where(good, angle, jnp.inf))
    part = jnp.where(found.status == int(Status.SOUND), number / jnp.sum(weights > 0), 0.0)
    return found.M, found.b, part, jnp.where(number > 0, ordered[number // 2], 0.0)


@partial(compile_once, static=())
@jax.vmap
def _intersect(X0, rays, weights):
    found = intersection(X0, rays, weights)
    return found.X, found.angle, found.status


@quick_jit
@jax.vmap
def _similarity(source, target, weights):
    found = absolute_orientation(source, target, weights)
    return (*_as_matrix(found.tau), found.status)


@quick_jit
@jax.vmap
def _similarity_by_rays(X, X0, rays, weights, A, t):
    scale = jnp.cbrt(jnp.linalg.det(A))
    omega = rotation_vector_from_matrix(A / scale)
    start = jnp.concatenate([t, omega, jnp.log(scale)[None]])

    def misclosures(tau, X, X0, rays, root):
        moved = jax.vmap(transform_point, (None, 0))(tau, X)
        return jax.vmap(misclosure)(moved, X0, rays, root).ravel()

    tau, _ = minimise(misclosures, jnp.add, start, (X, X0, rays, weights), 7, BY_RAYS)
    off = misclosures(tau, X, X0, rays, weights).reshape(-1, 2)
    return (*_as_matrix(tau), jnp.linalg.norm(off, axis=1))


def _as_matrix(tau):
    """A = exp(s)·R and t."""
    t = transform_point(tau, jnp.zeros(3))
    return jax.vmap(transform_point, (None, 0), 1)(tau, jnp.eye(3)) - t[:, None], t


@partial(compile_once, static=())
@jax.vmap
def _matrix(angles):
    return (matrix_from_omega_phi_kappa(angles),)


@partial(compile_once, static=())
@jax.vmap
def _matrix_of_quaternion(q):
    return (matrix_from_quaternion(q),)


@partial(compile_once, static=())
@jax.vmap
def _angles(M):
    return (omega_phi_kappa_from_matrix(M),)


def _gather_slots(columns, rows, slots):
    """[items, slots, …]: the chosen rows of each column, the last one repeated."""
    return np.stack([np.asarray(a)[_fill(r, slots)] for a, r in zip(columns, rows)])


def _fill(rows, slots):
    return np.concatenate([rows, np.full(slots - len(rows), rows[-1], int)])


def _weights(rows, slots):
    return np.stack([(np.arange(slots) < len(r)).astype(float) for r in rows])


def run_in_lanes(program, lanes, *arrays):
    """The program applied to items, `lanes` at a time; missing ones repeat the last."""
    number = len(arrays[0])
    parts = []
    for first in range(0, number, lanes):
        chosen = np.minimum(np.arange(first, first + lanes), number - 1)
        parts.append(jax.device_get(program(*(np.asarray(a)[chosen] for a in arrays))))
    return tuple(np.concatenate(column)[:number] for column in zip(*parts))
