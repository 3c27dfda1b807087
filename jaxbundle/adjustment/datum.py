"""The datum: which similarities the observations leave open, and how they are pinned down.

A similarity of object space (3 shifts, 3 rotations, 1 scale) changes no image coordinate, so the
Jacobian of a free network is singular along the Helmert matrix G (Blaha 1971; Illner 1985).
Which combinations of its seven columns stay open is found from the Jacobian itself: a distance
closes the scale, control points and priors close more.

The datum is imposed by an S-transformation (Baarda 1973; Teunissen 1985): with a choice B of
datum coordinates,

    δ ← δ − G(BᵀG)⁻¹Bᵀδ,      Q ← S·Q·Sᵀ,  S = I − G(BᵀG)⁻¹Bᵀ,

B = G on the datum points for inner constraints (trace of their covariance smallest), B = as many
single coordinates as there are defects for a minimal datum. After convergence the whole network
is moved by the finite similarity that makes the datum hold exactly against the start values:
Bᵀ(x − x_start) = 0. So the result does not depend on the path of the iterations.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from jaxbundle.adjustment.jacobian import free_tangent, zero_tangent
from jaxbundle.adjustment.residuals import residuals
from jaxbundle.geometry import helmert_point, helmert_pose, transform_point, transform_pose
from jaxbundle.network.arrays import Data, Tangent, Values, retract
from jaxbundle.network.structure import Structure

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
    """The open directions only: G times the combinations found by `open_similarities`."""
    return jax.tree.map(lambda g: g @ structure.gauge, helmert(structure, values))


def open_similarities(structure: Structure, data: Data) -> Float[np.ndarray, "7 defect"]:
    """The combinations of the seven similarities that change no observation and nothing held.

    Found at the start values from the singular values of J·G, its columns scaled by the size of
    their terms, so that neither units nor the number of observations matter.
    """
    products, terms, held = (np.asarray(x) for x in _directional_products(structure, data))
    # What cannot be computed from the start values says nothing; the solver will complain.
    finite = np.isfinite(products).all(1)
    products, terms = products[finite], terms[np.isfinite(terms).all(1)]
    scale = np.sqrt((terms**2).sum(0))
    scale = np.where(scale > 0, scale, 1.0)
    held = held[np.isfinite(held).all(1)] / scale
    size = np.linalg.norm(held, axis=1, keepdims=True)
    held = held / np.where(size > 0, size, 1.0)
    # Singular values of a QR, not of the Gram matrix, which would lose half of the digits.
    triangle = np.linalg.qr(np.concatenate([products / scale, held]), mode="r")
    _, singular, directions = np.linalg.svd(triangle)
    return directions[singular < OPEN].T / scale[:, None]


@eqx.filter_jit
def _directional_products(structure, data):
    """J·G, the terms that cancel in it, and G on what is held [rows, 7].

    By forward derivatives of the residuals along the seven columns of G.
    """
    G, free = helmert(structure, data.start), free_tangent(structure)
    moving = jax.tree.map(lambda g, f: g * f[..., None], G, free)

    def along(direction):
        shifted = lambda t: residuals(structure, retract(structure, data.start, t), data)
        change = jax.jvp(shifted, (zero_tangent(structure),), (direction,))[1]
        return ravel_pytree(change)[0]

    still = jax.tree.map(jnp.zeros_like, moving)
    images = Tangent(moving.image, moving.camera, still.point)
    points = Tangent(still.image, still.camera, moving.point)
    both = jax.tree.map(lambda a, b: jnp.concatenate([a, b], -1), images, points)
    images, points = jnp.split(jax.vmap(along, -1, -1)(both), 2, -1)
    flat = lambda tree: jnp.concatenate([x.reshape(-1, 7) for x in jax.tree.leaves(tree)])
    held = flat(jax.tree.map(lambda g, m: g - m, G, moving))
    return images + points, jnp.concatenate([images, points]), held


def s_transform(structure: Structure, values: Values, change: Tangent) -> Tangent:
    """A change with the datum imposed: δ − G(BᵀG)⁻¹Bᵀδ; unchanged where there is no defect."""
    if not structure.defect:
        return change
    G = gauge_directions(structure, values)
    B = G.point * structure.datum_weight[..., None]
    gram = jnp.einsum("pik,pil->kl", B, G.point)
    along = jnp.linalg.solve(gram, jnp.einsum("pik,pi->k", B, change.point))
    return jax.tree.map(lambda d, g: d - g @ along, change, G)


def move_to_datum(structure: Structure, values: Values, start: Values, steps: int = 20) -> Values:
    """The network after the finite similarity (of the open kind) for which Bᵀ(x − x_start) = 0.

    The open similarities form a group, so their finite motions are the exponentials of the open
    directions: a rotation about a fixed point stays one.
    Differentiable: the parameters are found by Newton's method without derivatives being taken,
    then attached by one more step (implicit function theorem).
    """
    if not structure.defect:
        return values
    s = structure
    held = lambda old, new, free: jnp.where(free > 0, new, old)

    def moved(tau, point):
        move = _exponential(s.gauge @ tau)
        return held(point, jax.vmap(transform_point, (None, 0))(move, point), s.point_free)

    def condition(tau, point, start):
        x = moved(tau, point)
        G = jax.vmap(helmert_point)(x) @ s.gauge
        c = jnp.einsum("pik,pi->k", G * s.datum_weight[..., None], x - start)
        return c, (c, G)

    point, target = jax.lax.stop_gradient((values.point, start.point))
    size = jnp.abs(point).max()

    def moving(state):
        # Until rounding: no move at all, or a small one that is no smaller than the one before.
        _, _, distance, before, count = state
        falling = (distance > 1e-6 * size) | (distance < 0.5 * before)
        return (distance > 1e-12 * size) & falling & (count < steps)

    def newton(state):
        tau, _, before, _, count = state
        slope, (c, G) = jax.jacfwd(condition, has_aux=True)(tau, point, target)
        step = jnp.linalg.solve(slope, c)
        distance = jnp.abs(G @ step).max()
        return tau - step, slope, distance, before, count + 1

    far = jnp.asarray([1e300, jnp.inf])
    begin = (jnp.zeros(s.defect), jnp.eye(s.defect), far[0], far[1], 0)
    tau, slope, *_ = jax.lax.while_loop(moving, newton, begin)
    tau = tau - jnp.linalg.solve(slope, condition(tau, values.point, start.point)[0])
    position, rotation = jax.vmap(transform_pose, (None, 0, 0))(
        _exponential(s.gauge @ tau), values.position, values.rotation
    )
    return Values(
        camera=values.camera,
        position=held(values.position, position, s.image_free[:, :3]),
        rotation=held(values.rotation, rotation, s.image_free[:, 3:4]),
        point=moved(tau, values.point),
    )


def _exponential(direction: Float[Array, "7"]) -> Float[Array, "7"]:
    """The similarity reached by moving along t + ω×X + s·X for a unit of time.

    Its shift is V·t with V = ∫₀¹ exp(u·B)du = 1 + B/2! + B²/3! + …, B = [ω]× + s·1; rotation and
    scale are ω and s themselves. The series is summed for B/64 and doubled: V(2B) = V + ½B·V².
    """
    t, omega, s = direction[:3], direction[3:6] / 64, direction[6] / 64
    one = jnp.eye(3)
    B = jnp.cross(omega, one, axisb=0, axisc=0) + s * one
    V = jax.lax.fori_loop(0, 8, lambda k, V: one + B @ V / (9 - k), one)
    double = lambda _, VB: (VB[0] + 0.5 * VB[1] @ VB[0] @ VB[0], 2 * VB[1])
    V, _ = jax.lax.fori_loop(0, 6, double, (V, B))
    return jnp.concatenate([V @ t, direction[3:]])


def choose_minimal_coordinates(
    structure: Structure, data: Data, candidates: Float[np.ndarray, "points 3"]
) -> Float[np.ndarray, "points 3"]:
    """As many coordinates of object points as there are defects, chosen well spread.

    Rows of G on the candidate coordinates, by Gram–Schmidt with row pivoting: each time the
    coordinate that the ones chosen so far determine least.
    """
    G = np.asarray(gauge_directions(structure, data.start).point)
    return _pick_rows(G.reshape(-1, structure.defect), candidates.ravel()).reshape(-1, 3)


def choose_pins(structure: Structure, data: Data) -> Float[np.ndarray, "images image_block"]:
    """As many coordinates of projection centres as there are defects, chosen well spread."""
    G = np.asarray(gauge_directions(structure, data.start).image)
    free = np.asarray(structure.image_block_free) * (np.arange(G.shape[1]) < 3)
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


def open_directions_in_words(gauge: Float[np.ndarray, "7 defect"]) -> str:
    """Which of shift, rotation and scale the observations leave open, for messages."""
    q, _ = np.linalg.qr(gauge / np.linalg.norm(gauge, axis=0)) if gauge.size else (gauge, None)
    names = ["shift X", "shift Y", "shift Z", "rotation X", "rotation Y", "rotation Z", "scale"]
    parts = [name for name, row in zip(names, q) if np.linalg.norm(row) > 0.1]
    return ", ".join(parts) if parts else "none"
