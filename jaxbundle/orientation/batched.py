"""Many orientations at once: lists of any length with one compiled program.

Every item is padded with absent observations (weight 0) to `SLOTS`, and items to full lanes, so
that networks of all sizes share one compiled program of each kind (compiling takes seconds, a call
milliseconds); from more observations a well-spread subset is used. On the host, with numpy input
and output. Weights are p = 1/σ² with σ = 1: 1 for an observation, 0 for padding.
"""

from collections.abc import Callable, Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxbundle.geometry import (
    matrix_from_omega_phi_kappa,
    matrix_from_quaternion,
    omega_phi_kappa_from_matrix,
    quaternion_from_matrix,
    rotation_vector_from_matrix,
    transform_point,
)
from jaxbundle.leastsquares.iterations.small import minimise
from jaxbundle.orientation.absolute import absolute_orientation
from jaxbundle.orientation.intersection import intersection, misclosure
from jaxbundle.orientation.planar import planar_orientations
from jaxbundle.orientation.pose import CameraPose
from jaxbundle.orientation.resection import refine_resection
from jaxbundle.orientation.robust import robust_relative_orientation, robust_resection
from jaxbundle.orientation.status import Status
from jaxbundle.system.programs import compile_once, quick_jit
from jaxbundle.types import AnyArray

# Padded numbers of points of an image, of a pair, of two models. Resections of images of 300
# points, a tenth of them wrong: half of it makes the errors 6 % larger in the same time, double 1 %
# smaller in one and a half times the time.
SLOTS = 64
# Padded number of rays of a point. Points of 40 rays: 4 make the errors 1.6 times as large in two
# thirds of the time, 16 make them 0.7 times as large in 1.8 times the time.
RAYS = 8
# Images, or pairs, of one call. 4 and 16 take the same time for each image; missing ones are
# computed all the same, so that few images are slower with more.
LANES = 8
# Points, or rotations, of one call: 64 take twice the time for each point, 1024 a tenth less.
POINT_LANES = 256
# Coordinates of the observations of every item, of any number each.
Columns = Sequence[Float[np.ndarray, "_ k"]] | Float[np.ndarray, "items _ k"]
# Weights of the observations of every item.
Weights = Sequence[Float[np.ndarray, " _"]] | Float[np.ndarray, "items _"]


def resect(
    xy: Columns, X: Columns, tolerance: Float[np.ndarray, " images"]
) -> tuple[
    Float[np.ndarray, "images 3"], Float[np.ndarray, "images 3 3"], Float[np.ndarray, " images"]
]:
    """X0, M of images, and the share of their points that agree within `tolerance` (c = 1); 0: no
    pose."""
    rows = [evenly_spaced(len(a)) for a in xy]
    X0, M, share = run_in_lanes(
        _resect,
        LANES,
        _gather_slots(xy, rows),
        _gather_slots(X, rows),
        _weights(rows),
        tolerance,
    )
    return X0, M, share


def refine(
    poses: tuple[Float[np.ndarray, "images 3"], Float[np.ndarray, "images 3 3"]],
    xy: Columns,
    X: Columns,
    weights: Weights,
) -> tuple[Float[np.ndarray, "images 3"], Float[np.ndarray, "images 3 3"]]:
    """X0, M of images improved from start values by points of weight > 0."""
    rows = [evenly_spaced(len(a)) for a in xy]
    X0, M = run_in_lanes(
        _refine,
        LANES,
        *poses,
        _gather_slots(xy, rows),
        _gather_slots(X, rows),
        _gather_slots(weights, rows),
    )
    return X0, M


def orient_pairs(
    xy1: Columns, xy2: Columns, tolerance: Float[np.ndarray, " pairs"]
) -> tuple[
    Float[np.ndarray, "pairs 3 3"],
    Float[np.ndarray, "pairs 3"],
    Float[np.ndarray, " pairs"],
    Float[np.ndarray, " pairs"],
]:
    """M, b of pairs of images, the share of the points that agree within `tolerance`, and the
    median angle of intersection (radians)."""
    rows = [evenly_spaced(len(a)) for a in xy1]
    M, b, share, angle = run_in_lanes(
        _orient_pair,
        LANES,
        _gather_slots(xy1, rows),
        _gather_slots(xy2, rows),
        _weights(rows),
        tolerance,
    )
    return M, b, share, angle


def orient_planes(
    xy1: Columns, xy2: Columns
) -> tuple[
    Float[np.ndarray, "pairs 2 3 3"],
    Float[np.ndarray, "pairs 2 3"],
    Float[np.ndarray, "pairs 2 3"],
    Bool[np.ndarray, "pairs 2"],
]:
    """Both M, b and normals of pairs of images of planes, and whether each is possible."""
    rows = [evenly_spaced(len(a)) for a in xy1]
    M, b, normal, possible = run_in_lanes(
        _orient_plane, LANES, _gather_slots(xy1, rows), _gather_slots(xy2, rows), _weights(rows)
    )
    return M, b, normal, possible


def intersect(
    X0: Float[np.ndarray, "n rays 3"],
    rays: Float[np.ndarray, "n rays 3"],
    weights: Float[np.ndarray, "n rays"],
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """X, angle of intersection and status of points with up to `RAYS` rays, [n, RAYS, …]."""
    X, angle, status = run_in_lanes(_intersect, POINT_LANES, X0, rays, weights)
    return X, angle, status


def similarity(
    source: Float[np.ndarray, "n 3"],
    target: Float[np.ndarray, "n 3"],
    weights: Float[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]] | None:
    """A = exp(s)·R and t of X' = A·X + t between two lists of points; None of fewer than three
    points of weight > 0, and of points on a line."""
    # Spread over the points that count: of many points, few of these may be among `SLOTS` of all.
    weighted_rows = np.flatnonzero(weights > 0)
    if len(weighted_rows) < 3:
        return None
    rows = [weighted_rows[evenly_spaced(len(weighted_rows))]]
    A, t, status = run_in_lanes(
        _similarity,
        1,
        _gather_slots([source], rows),
        _gather_slots([target], rows),
        _gather_slots([weights], rows) * _weights(rows),
    )
    return (A[0], t[0]) if status[0] == int(Status.SOUND) else None


def similarity_by_rays(
    X: Float[np.ndarray, "n 3"],
    X0: Float[np.ndarray, "n 3"],
    rays: Float[np.ndarray, "n 3"],
    A: Float[np.ndarray, "3 3"],
    t: Float[np.ndarray, "3"],
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"], Float[np.ndarray, " slots"]]:
    """A and t of X' = A·X + t by which points X come to lie on rays, from start values; and the
    misclosure of every ray, the tangent of its angle."""
    rows = [evenly_spaced(len(X))]
    filled = (_gather_slots([a], rows) for a in (X, X0, rays))
    weights = _weights(rows)
    A, t, misclosures = run_in_lanes(_similarity_by_rays, 1, *filled, weights, A[None], t[None])
    return A[0], t[0], misclosures[0][: len(rows[0])]


def matrices(angles: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 3"]:
    """M of ω, φ, κ."""
    return run_in_lanes(_matrix, POINT_LANES, angles)[0]


def quaternions(M: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n 4"]:
    """Unit quaternions of M."""
    return run_in_lanes(_quaternion, POINT_LANES, M)[0]


def matrices_of_quaternions(q: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 3 3"]:
    """M of unit quaternions."""
    return run_in_lanes(_matrix_of_quaternion, POINT_LANES, q)[0]


def angles(M: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n 3"]:
    """ω, φ, κ of M."""
    return run_in_lanes(_angles, POINT_LANES, M)[0]


def prepare() -> None:
    """Compile what places images and points, ahead of its data."""
    rng = np.random.default_rng(0)
    xy, X = [rng.uniform(-0.5, 0.5, (SLOTS, 2))], [rng.normal(size=(SLOTS, 3))]
    resect(xy, X, np.full(1, 1e-3))
    refine((np.zeros((1, 3)), np.eye(3)[None]), xy, X, np.ones((1, SLOTS)))
    intersect(rng.normal(size=(1, RAYS, 3)), rng.normal(size=(1, RAYS, 3)), np.ones((1, RAYS)))


def evenly_spaced(number: int, max_rows: int = SLOTS) -> Int[np.ndarray, " rows"]:
    """Up to `max_rows` of a number of rows, evenly."""
    if number <= max_rows:
        return np.arange(number)
    return np.linspace(0, number - 1, max_rows).astype(int)


@quick_jit
@jax.vmap
def _resect(
    xy: Float[Array, "slots 2"],
    X: Float[Array, "slots 3"],
    weights: Float[Array, " slots"],
    tolerance: Float[Array, ""],
) -> tuple[AnyArray, AnyArray, AnyArray]:
    # One key for all: equal data give equal start values, whatever else is in the network.
    key = jax.random.key(0)
    solution, good = robust_resection(key, xy, X, weights, threshold=tolerance)
    sound = (solution.status == int(Status.SOUND)) & jnp.all(jnp.isfinite(solution.pose.X0))
    share = jnp.sum(good) / jnp.sum(weights > 0)
    return solution.pose.X0, solution.pose.M, jnp.where(sound, share, 0.0)


@quick_jit
@jax.vmap
def _refine(
    X0: Float[Array, "3"],
    M: Float[Array, "3 3"],
    xy: Float[Array, "slots 2"],
    X: Float[Array, "slots 3"],
    weights: Float[Array, " slots"],
) -> tuple[Array, Array]:
    pose = refine_resection(CameraPose(X0, M), xy, X, weights).pose
    good = jnp.all(jnp.isfinite(pose.X0)) & jnp.all(jnp.isfinite(pose.M))
    return jnp.where(good, pose.X0, X0), jnp.where(good, pose.M, M)


@quick_jit
@jax.vmap
def _orient_pair(
    xy1: Float[Array, "slots 2"],
    xy2: Float[Array, "slots 2"],
    weights: Float[Array, " slots"],
    tolerance: Float[Array, ""],
) -> tuple[AnyArray, AnyArray, AnyArray, AnyArray]:
    key = jax.random.key(0)
    solution, good = robust_relative_orientation(key, xy1, xy2, weights, threshold=tolerance)
    ray = lambda xy: jnp.append(xy, -1.0) / jnp.sqrt(1 + xy @ xy)
    rays1, rays2 = jax.vmap(ray)(xy1), jax.vmap(ray)(xy2) @ solution.M
    angle = jnp.arctan2(jnp.linalg.norm(jnp.cross(rays1, rays2), axis=1), jnp.sum(rays1 * rays2, 1))
    number = jnp.sum(good)
    ordered = jnp.sort(jnp.where(good, angle, jnp.inf))
    share = jnp.where(solution.status == int(Status.SOUND), number / jnp.sum(weights > 0), 0.0)
    return solution.M, solution.b, share, jnp.where(number > 0, ordered[number // 2], 0.0)


@partial(compile_once, static=())
@jax.vmap
def _intersect(
    X0: Float[Array, "rays 3"], rays: Float[Array, "rays 3"], weights: Float[Array, " rays"]
) -> tuple[AnyArray, AnyArray, AnyArray]:
    solution = intersection(X0, rays, weights)
    return solution.X, solution.angle, solution.status


@quick_jit
@jax.vmap
def _similarity(
    source: Float[Array, "slots 3"],
    target: Float[Array, "slots 3"],
    weights: Float[Array, " slots"],
) -> tuple[AnyArray, AnyArray, AnyArray]:
    solution = absolute_orientation(source, target, weights)
    return (*_as_matrix(solution.tau), solution.status)


@quick_jit
@jax.vmap
def _similarity_by_rays(
    X: Float[Array, "slots 3"],
    X0: Float[Array, "slots 3"],
    rays: Float[Array, "slots 3"],
    weights: Float[Array, " slots"],
    A: Float[Array, "3 3"],
    t: Float[Array, "3"],
) -> tuple[AnyArray, AnyArray, AnyArray]:
    scale = jnp.cbrt(jnp.linalg.det(A))
    omega = rotation_vector_from_matrix(A / scale)
    start = jnp.concatenate([t, omega, jnp.log(scale)[None]])

    def misclosures(
        tau: Float[Array, "7"], X: Array, X0: Array, rays: Array, sqrt_weight: Array
    ) -> Float[Array, " 2n"]:
        transformed = jax.vmap(transform_point, (None, 0))(tau, X)
        return jax.vmap(misclosure)(transformed, X0, rays, sqrt_weight).ravel()

    # Weights are 0 or 1, their own roots. The start guesses a depth for points seen once, so that
    # more steps are allowed than the 30 of a closed form.
    tau, _ = minimise(misclosures, jnp.add, start, (X, X0, rays, weights), 7, 40)
    ray_misclosures = misclosures(tau, X, X0, rays, weights).reshape(-1, 2)
    return (*_as_matrix(tau), jnp.linalg.norm(ray_misclosures, axis=1))


def _as_matrix(tau: Float[AnyArray, "7"]) -> tuple[Float[Array, "3 3"], Float[Array, "3"]]:
    """A = exp(s)·R and t."""
    t = transform_point(tau, jnp.zeros(3))
    return jax.vmap(transform_point, (None, 0), 1)(tau, jnp.eye(3)) - t[:, None], t


@partial(compile_once, static=())
@jax.vmap
def _matrix(angles: Float[Array, "3"]) -> tuple[Float[Array, "3 3"]]:
    return (matrix_from_omega_phi_kappa(angles),)


@partial(compile_once, static=())
@jax.vmap
def _matrix_of_quaternion(q: Float[Array, "4"]) -> tuple[Float[Array, "3 3"]]:
    return (matrix_from_quaternion(q),)


@partial(compile_once, static=())
@jax.vmap
def _quaternion(M: Float[Array, "3 3"]) -> tuple[Float[Array, "4"]]:
    return (quaternion_from_matrix(M),)


@partial(compile_once, static=())
@jax.vmap
def _angles(M: Float[Array, "3 3"]) -> tuple[Float[Array, "3"]]:
    return (omega_phi_kappa_from_matrix(M),)


@quick_jit
@jax.vmap
def _orient_plane(
    xy1: Float[Array, "slots 2"], xy2: Float[Array, "slots 2"], weights: Float[Array, " slots"]
) -> tuple[AnyArray, AnyArray, AnyArray, AnyArray]:
    solution = planar_orientations(xy1, xy2, weights)
    return (
        solution.M,
        solution.b,
        solution.normal,
        solution.possible & (solution.status == int(Status.SOUND)),
    )


def _gather_slots(
    columns: Columns | Weights, rows: Sequence[Int[np.ndarray, " _"]]
) -> Float[np.ndarray, "items slots *_"]:
    """[items, SLOTS, …]: the chosen rows of each column, the last one repeated."""
    # Repeated, not zero: a ray of length zero has no direction, and weight 0 times NaN is NaN.
    fill = lambda r: np.concatenate([r, np.full(SLOTS - len(r), r[-1], int)])
    return np.stack([np.asarray(a)[fill(r)] for a, r in zip(columns, rows)])


def _weights(rows: Sequence[Int[np.ndarray, " _"]]) -> Float[np.ndarray, "items slots"]:
    """1 in the slots of chosen rows, 0 in those of padding."""
    return np.stack([(np.arange(SLOTS) < len(r)).astype(float) for r in rows])


def run_in_lanes(
    program: Callable[..., tuple[AnyArray, ...]], lanes: int, *arrays: Float[AnyArray, "items *_"]
) -> tuple[np.ndarray, ...]:
    """The program applied to items, `lanes` at a time; missing ones repeat the last."""
    number = len(arrays[0])
    parts = []
    for begin in range(0, number, lanes):
        lane_items = np.minimum(np.arange(begin, begin + lanes), number - 1)
        parts.append(jax.device_get(program(*(np.asarray(a)[lane_items] for a in arrays))))
    return tuple(np.concatenate(column)[:number] for column in zip(*parts))
