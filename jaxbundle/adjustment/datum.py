"""The datum: which similarities the observations leave open, and how they are pinned down.

A similarity of object space (3 shifts, 3 rotations, 1 scale) changes no image coordinate, so the
Jacobian of a free network is singular along the Helmert matrix G (Blaha 1971; Illner 1985).
Which combinations of its seven columns stay open is found from the other observations: a distance
closes the scale, control points and priors close more.

The datum is imposed by an S-transformation (Baarda 1973; Teunissen 1985): with a choice B of
datum coordinates,

    δ ← δ − G(BᵀG)⁻¹Bᵀδ,      Q ← S·Q·Sᵀ,  S = I − G(BᵀG)⁻¹Bᵀ,

B = G on the datum points for inner constraints (trace of their covariance smallest), B = as many
single coordinates as there are defects for a minimal datum. After convergence the whole network
is moved by the finite similarity that makes the datum hold exactly against the start values:
Bᵀ(x − x_start) = 0. So the result does not depend on the path of the iterations.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.adjustment.jacobian import distance_blocks, exterior_blocks, free_tangent
from jaxbundle.geometry import (
    helmert_point,
    helmert_pose,
    similarity,
    transform_point,
    transform_pose,
)
from jaxbundle.implicit import implicit_root, solve_dense
from jaxbundle.network.arrays import Data, Tangent, Values
from jaxbundle.network.structure import Structure

NEAR = 1e-3
"""A motion into the datum by less than this fraction of the network is near its end."""
HELD = 1e-7
"""Relative size of the least motion of datum points that hold the datum."""
OPEN = 1e-10
"""Relative size of J·G below which a direction counts as open (rounding gives about 1e-14)."""


def helmert(structure: Structure, values: Values) -> Tangent:
    """The Helmert matrix G of all unknowns; its 7 columns are the last axis of every block."""
    pose = jax.vmap(helmert_pose)(values.position, values.rotation)
    interior = jnp.zeros((structure.images, structure.image_width - 6, 7))
    return Tangent(
        image=jnp.concatenate([pose, interior], 1),
        camera=jnp.zeros((structure.cameras, structure.camera_width, 7)),
        point=jax.vmap(helmert_point)(values.point),
    )


def gauge_directions(structure: Structure, values: Values) -> Tangent:
    """The open directions only: G times the open combinations."""
    gauge = open_combinations(structure, values)
    return jax.tree.map(lambda g: g @ gauge, helmert(structure, values))


def open_combinations(structure: Structure, values: Values) -> Float[Array, "7 defect"]:
    """The combinations found by `open_similarities`, changed least so that what is held stays where
    it is now: a rotation about a fixed point goes with the point. What only fills the arrays, and
    is held as well, is seen by no ray."""
    s = structure
    if not 0 < s.defect < 7:
        return s.gauge
    G, free, used = helmert(s, values), free_tangent(s), s.table.used
    images = s.table.sum_by_image(used[:, None])
    points = jax.ops.segment_sum(used, s.point, s.points)[:, None]
    held = [
        (g * ((f == 0) & (rays > 0))[..., None]).reshape(-1, 7)
        for g, f, rays in ((G.image, free.image, images), (G.point, free.point, points))
    ]
    A = sum(rows.T @ rows for rows in held)
    scale = jax.lax.stop_gradient(jnp.diagonal(A))
    scale = jnp.where(scale > 0, jax.lax.rsqrt(jnp.where(scale > 0, scale, 1.0)), 1.0)
    A = A * scale * scale[:, None]
    moved = A @ (s.gauge / scale[:, None])
    return s.gauge - scale[:, None] * (jnp.linalg.pinv(A, HELD, hermitian=True) @ moved)


def compiled_helmert(structure: Structure, values: Values) -> Tangent:
    """`helmert`, compiled once, whether or not the datum is known yet."""
    return _helmert(structure.without_datum(), values)


_helmert = eqx.filter_jit(helmert)


def open_similarities(structure: Structure, data: Data) -> Float[np.ndarray, "7 defect"]:
    """The combinations of the seven similarities that change no observation and nothing held.

    An image point is the same after any similarity, so only control points, priors of exterior
    orientations and distances are asked, and what is held. Found at the start values from the
    singular values of their products with G, its columns scaled by the size of their terms, so that
    neither units nor the number of observations matter.
    """
    products, terms, held = _directional_products(structure, data)
    # What cannot be computed from the start values says nothing; the solver will complain.
    products, terms, held = (x[np.isfinite(x).all(1)] for x in (products, terms, held))
    scale = np.sqrt((np.concatenate([terms, held]) ** 2).sum(0))
    scale = np.where(scale > 0, scale, 1.0)
    held = held / scale
    size = np.linalg.norm(held, axis=1, keepdims=True)
    held = held / np.where(size > 0, size, 1.0)
    # Singular values of a QR, not of the Gram matrix, which would lose half of the digits.
    rows = np.concatenate([products / scale, held, np.zeros((7, 7))])
    _, singular, directions = np.linalg.svd(np.linalg.qr(rows, mode="r"))
    return directions[singular < OPEN].T / scale[:, None]


def _directional_products(s: Structure, data: Data):
    """What control points, priors and distances change along G [rows, 7], the terms that cancel in
    it, and G on what is held."""
    G = jax.tree.map(np.asarray, compiled_helmert(s, data.start))
    exterior, distance = np.zeros((0, 6, 6)), np.zeros((0, 2, 3))
    if len(s.exterior) or len(s.distance):
        exterior, distance = (np.asarray(x) for x in _prior_blocks(s, data))
    control = np.asarray(data.control_weight)[..., None] * G.point[np.asarray(s.control)]
    exterior = exterior @ G.image[np.asarray(s.exterior), :6]
    ends = np.einsum("dei,deik->edk", distance, G.point[np.asarray(s.distance)])
    flat = lambda *rows: np.concatenate([x.reshape(-1, 7) for x in rows])
    held = [
        g[np.asarray(f) == 0] for g, f in zip(jax.tree.leaves(G), jax.tree.leaves(free_tangent(s)))
    ]
    return flat(control, exterior, ends.sum(0)), flat(control, exterior, ends), flat(*held)


@eqx.filter_jit
def _prior_blocks(s: Structure, data: Data):
    return exterior_blocks(s, data.start, data), distance_blocks(s, data.start, data)


def s_transform(structure: Structure, values: Values, change: Tangent) -> Tangent:
    """A change with the datum imposed: δ − G(BᵀG)⁻¹Bᵀδ; unchanged where there is no defect."""
    if not structure.defect:
        return change
    G = gauge_directions(structure, values)
    B = G.point * structure.datum_weight[..., None]
    gram = jnp.einsum("pik,pil->kl", B, G.point)
    along = jnp.linalg.solve(gram, jnp.einsum("pik,pi->k", B, change.point))
    return jax.tree.map(lambda d, g: d - g @ along, change, G)


def s_transform_transposed(structure: Structure, values: Values, row: Tangent) -> Tangent:
    """A linear function of the unknowns as one of those before the datum: f − B(GᵀB)⁻¹Gᵀf."""
    if not structure.defect:
        return row
    G = gauge_directions(structure, values)
    B = G.point * structure.datum_weight[..., None]
    gram = jnp.einsum("pik,pil->kl", G.point, B)
    total = sum(
        jnp.einsum("...k,...->k", g, f) for g, f in zip(jax.tree.leaves(G), jax.tree.leaves(row))
    )
    return Tangent(row.image, row.camera, row.point - B @ jnp.linalg.solve(gram, total))


def move_to_datum(
    structure: Structure, values: Values, start: Values, *, derivatives: bool = False
) -> Values:
    """The network after the finite similarity (of the open kind) for which Bᵀ(x − x_start) = 0.

    `derivatives`: those of the motion, of every order, are attached to it."""
    s = structure
    if not s.defect:
        return values
    gauge = open_combinations(s, values)
    still, point, target = jax.lax.stop_gradient((gauge, values.point, start.point))
    motion = _motion_to_datum(dataclasses.replace(s, gauge=still), point, target)
    values = _moved(s, motion, values)
    if not derivatives:
        return values
    # What is held has not moved, and the combinations that leave it there are the same.
    tau = jnp.zeros(s.defect)
    tau = implicit_root(_missing, solve_dense, tau, s, (gauge, values.point, start.point))
    return _moved(s, _exponential(gauge @ tau), values)


def _missing(tau, s: Structure, places) -> Float[Array, " defect"]:
    """Bᵀ(x − x_start) after a motion along the open directions."""
    gauge, point, target = places
    s = dataclasses.replace(s, gauge=gauge)
    return _datum_equations(s, _moved_points(s, _exponential(s.gauge @ tau), point), target)[0]


def _motion_to_datum(s: Structure, point, target, steps: int = 50):
    """The similarity that puts the points into their datum, by motions along the open directions.

    They form a group, so that the whole motion is one of them: a rotation about a fixed point stays
    one. Gauss–Newton steps, of a radian and a factor e at most, until near; then Newton's."""
    size = jnp.abs(point).max()

    def moving(state):
        # Until rounding: no move at all, or a small one that is no smaller than the one before.
        _, distance, before, count = state
        falling = (distance > 1e-6 * size) | (distance < 0.5 * before)
        return (distance > 1e-12 * size) & falling & (count < steps)

    def further(state):
        motion, before, _, count = state
        x = _moved_points(s, motion, point)
        missing, gram = _datum_equations(s, x, target)
        far = before > NEAR * size
        step = jnp.where(far, -jnp.linalg.solve(gram, missing), _newton_step(s, x, target))
        step = s.gauge @ step
        step = _exponential(step / jnp.maximum(jnp.abs(step[3:]).max(), 1.0))
        distance = jnp.abs(_moved_points(s, step, x) - x).max()
        return similarity.compose(step, motion), distance, before, count + 1

    begin = (jnp.zeros(7), jnp.asarray(1e300), jnp.asarray(jnp.inf), 0)
    return jax.lax.while_loop(moving, further, begin)[0]


def _newton_step(s: Structure, point, target) -> Float[Array, " defect"]:
    """The motion that meets Bᵀ(x − x_start) = 0 to first order."""
    G = jax.vmap(helmert_point)(point) @ s.gauge * (s.point_free > 0)[..., None]
    after = lambda tau: _datum_equations(s, point + G @ tau, target)[0]
    slope = jax.jacfwd(after)(jnp.zeros(s.defect))
    return -jnp.linalg.solve(slope, _datum_equations(s, point, target)[0])


def _datum_equations(s: Structure, x, target):
    """Bᵀ(x − x_start) and BᵀG."""
    G = jax.vmap(helmert_point)(x) @ s.gauge
    B = G * s.datum_weight[..., None]
    return jnp.einsum("pik,pi->k", B, x - target), jnp.einsum("pik,pil->kl", B, G)


def _moved(s: Structure, motion, values: Values) -> Values:
    """A network moved by a similarity; what is held stays."""
    position, rotation = jax.vmap(transform_pose, (None, 0, 0))(
        motion, values.position, values.rotation
    )
    held = lambda old, new, free: jnp.where(free > 0, new, old)
    return Values(
        camera=values.camera,
        position=held(values.position, position, s.image_free[:, :3]),
        rotation=held(values.rotation, rotation, s.image_free[:, 3:4]),
        point=_moved_points(s, motion, values.point),
    )


def _moved_points(s: Structure, motion, point):
    moved = jax.vmap(transform_point, (None, 0))(motion, point)
    return jnp.where(s.point_free > 0, moved, point)


NODES, WEIGHTS = (np.asarray(x) / 2 for x in np.polynomial.legendre.leggauss(20))


def _exponential(direction: Float[Array, "7"]) -> Float[Array, "7"]:
    """The similarity reached by moving along t + ω×X + s·X for a unit of time.

    Its shift is ∫₀¹ exp(u·s)·exp(u·[ω]×)·t du, by Gauss–Legendre quadrature (to rounding up to two
    turns and a scale of e⁵); rotation and scale are ω and s themselves.
    """
    still = direction.at[:3].set(0.0)
    moved = jax.vmap(lambda u: transform_point(u * still, direction[:3]))(NODES + 0.5)
    return still.at[:3].set(WEIGHTS @ moved)


def hold_the_datum(
    structure: Structure, data: Data, candidates: Float[np.ndarray, "points 3"]
) -> bool:
    """Whether the open similarities move these coordinates in independent ways."""
    G = np.asarray(compiled_helmert(structure, data.start).point) @ np.asarray(structure.gauge)
    chosen = (G * candidates[..., None]).reshape(-1, structure.defect)
    finite = np.isfinite(chosen).all(1)
    if not finite.all():
        return True  # The solver will complain.
    size = np.linalg.norm(G.reshape(-1, structure.defect), axis=0)
    singular = np.linalg.svd(chosen / size, compute_uv=False)
    return len(singular) == structure.defect and singular[-1] > HELD * singular[0]


def choose_minimal_coordinates(
    structure: Structure, data: Data, candidates: Float[np.ndarray, "points 3"]
) -> Float[np.ndarray, "points 3"]:
    """As many coordinates of object points as there are defects, chosen well spread.

    Rows of G on the candidate coordinates, by Gram–Schmidt with row pivoting: each time the
    coordinate that the ones chosen so far determine least.
    """
    G = np.asarray(compiled_helmert(structure, data.start).point) @ np.asarray(structure.gauge)
    return _pick_rows(G.reshape(-1, structure.defect), candidates.ravel()).reshape(-1, 3)


def choose_pins(structure: Structure, data: Data) -> Float[np.ndarray, "images image_block"]:
    """As many elements of the exterior orientation as there are defects, chosen well spread.

    Angles count times the size of the network, so that they compare with positions.
    """
    G = np.asarray(compiled_helmert(structure, data.start).image) @ np.asarray(structure.gauge)
    places = np.concatenate([np.asarray(data.start.position), np.asarray(data.start.point)])
    places = places[np.isfinite(places).all(1)]
    G[:, 3:] *= np.sqrt(places.var(0).sum()) if len(places) else 1.0
    free = np.asarray(structure.image_block_free)
    return _pick_rows(G.reshape(-1, structure.defect), free.ravel()).reshape(G.shape[:2])


def _pick_rows(G, candidates):
    """1 for as many rows of G as it has columns, the independent ones, 0 for the others."""
    q, _ = np.linalg.qr(G)
    rows = q * candidates[:, None]
    chosen = np.zeros(len(rows))
    for _ in range(G.shape[1]):
        pick = np.argmax((rows**2).sum(1))
        direction = rows[pick] / np.linalg.norm(rows[pick])
        rows = rows - np.outer(rows @ direction, direction)
        chosen[pick] = 1.0
    return chosen


def open_directions_in_words(gauge: Float[np.ndarray, "7 defect"], about=(0.0, 0.0, 0.0)) -> str:
    """Which of shift, rotation and scale the observations leave open, for messages.

    Rotation and scale are about the place `about`: with one point known, no shift is open."""
    gauge = np.array(gauge)
    gauge[:3] += np.cross(gauge[3:6].T, about).T + np.outer(about, gauge[6])
    q, _ = np.linalg.qr(gauge / np.linalg.norm(gauge, axis=0)) if gauge.size else (gauge, None)
    names = ["shift X", "shift Y", "shift Z", "rotation X", "rotation Y", "rotation Z", "scale"]
    parts = [name for name, row in zip(names, q) if np.linalg.norm(row) > 0.1]
    return ", ".join(parts) if parts else "none"
