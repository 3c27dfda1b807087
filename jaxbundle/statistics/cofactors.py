"""Cofactors: the blocks of the inverse normal matrix that statistics need, never all of it.

From the factor of the reduced system (`jaxbundle.adjustment.schur`), with Q the inverse of S and
Z = L⁻¹Wᵀ of every ray,

    K_n  = Σ_m Z_m·Q[m, n]              over the rays m of the same point
    Q_pn = −L⁻ᵀ·K_n                     point p with the image of its ray n
    Q_pp = L⁻ᵀ·(1 + Σ_n K_n·Z_nᵀ)·L⁻¹   point p

These are marginal cofactors: the uncertainty of images and cameras is in those of the points.
In a free network they belong to the datum by the S-transformation Q ← S·Q·Sᵀ (`datum.py`).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbundle.adjustment.datum import gauge_directions
from jaxbundle.adjustment.jacobian import compiled_jacobian
from jaxbundle.adjustment.normal import normal_from_jacobian
from jaxbundle.adjustment.schur import (
    Factor,
    factorise,
    reduced_free,
    reduced_vector,
    solve,
)
from jaxbundle.network.arrays import Data, Tangent, Values
from jaxbundle.network.structure import Structure

PAIRS_PER_STEP = 8192


class Cofactors(eqx.Module):
    """Blocks of Q = N⁻¹ in the datum of the network, and what is needed for any others.

    `reduced`: images, cameras and kept points together; `point`: 3×3 of every point; `ray`: every
    point with the image block of its ray; `incidence`: with its shared camera. `ray` and
    `incidence` belong to the internal (regularised) datum: use them only for estimable
    quantities, such as residuals. What is held has zeros.
    """

    factor: Factor
    reduced: Float[Array, "reduced reduced"]
    point: Float[Array, "points 3 3"]
    ray: Float[Array, "rays 3 image_block"]
    incidence: Float[Array, "incidences 3 camera_block"]
    internal_reduced: Float[Array, "reduced reduced"]
    internal_point: Float[Array, "points 3 3"]


def undamped_factor(structure: Structure, values: Values, data: Data) -> Factor:
    """The factor of JᵀPJ at the solution, datum directions made regular."""
    return _factorised(compiled_jacobian(structure, values, data), values)


@eqx.filter_jit
def _factorised(jac, values):
    gauge = gauge_directions(jac.structure, values)
    return factorise(jac.structure, normal_from_jacobian(jac), gauge=gauge)


@eqx.filter_jit
def cofactors(structure: Structure, values: Values, factor: Factor) -> Cofactors:
    """All cofactor blocks of a solved network."""
    s = structure
    free = reduced_free(s)
    Q = jax.vmap(factor.reduced.solve, 1, 1)(jnp.diag(free)) * free[:, None]
    K, Kc = _couplings(factor, Q)
    inner = jnp.eye(3) + jax.ops.segment_sum(
        jnp.einsum("nij,nkj->nik", K, factor.ray), s.point, s.points
    )
    if s.camera_width:
        inner += jax.ops.segment_sum(
            jnp.einsum("qij,qkj->qik", Kc, factor.incidence),
            s.incidence.point, s.points, indices_are_sorted=True,
        )  # fmt: skip
    L = factor.point
    point = jnp.einsum("pji,pjk,pkl->pil", L, inner, L)
    point = point * s.eliminated[:, :, None] * s.point_free[:, :, None] * s.point_free[:, None]
    ray = -jnp.einsum("nji,njk->nik", L[s.point], K)
    incidence = Kc
    if s.camera_width:
        incidence = -jnp.einsum("qji,qjk->qik", L[s.incidence.point], Kc)
    if s.kept.shape[0]:
        point, ray, incidence = _with_kept(s, Q, point, ray, incidence)
    reduced, in_datum = _transformed(s, values, factor, Q, point)
    return Cofactors(factor, reduced, in_datum, ray, incidence, Q, point)


def _couplings(factor, Q):
    """K of every ray and of every incidence (zero for points that are not eliminated)."""
    s = factor.structure
    w, k = s.image_width, s.camera_width
    n = s.images * w
    m = n + s.cameras * k
    QII = Q[:n, :n].reshape(s.images, w, s.images, w)
    at = jnp.arange(s.images)
    K = jnp.einsum("nij,njk->nik", factor.ray, s.table.of_image(QII[at, :, at, :]))
    Kc = jnp.zeros_like(factor.incidence)
    K = _add_pairs(K, K, s.image_pairs, factor.ray, factor.ray, QII, s.image, s.image, True)[0]
    if k:
        camera = s.incidence.camera
        QIC = Q[:n, n:m].reshape(s.images, w, s.cameras, k)
        QCC = Q[n:m, n:m].reshape(s.cameras, k, s.cameras, k)
        K, Kc = _add_pairs(
            K, Kc, s.image_camera_pairs, factor.ray, factor.incidence, QIC, s.image, camera, False
        )
        Kc = _add_pairs(
            Kc, Kc, s.camera_pairs, factor.incidence, factor.incidence, QCC, camera, camera, True
        )[0]
    return K, Kc


def _add_pairs(K_a, K_b, pairs, Z_a, Z_b, Q, block_a, block_b, same):
    """Add Z_b·Q[b, a] to K_a and Z_a·Q[a, b] to K_b over pairs (a, b).

    `same`: both sides are one table; pairs within a block are then listed in both orders (a row
    with itself once).
    """
    if not pairs.row.shape[0]:
        return K_a, K_b
    a, b = pairs.flat()
    missing = a >= K_a.shape[0] - pairs.empty[0]
    a, b = jnp.where(missing, 0, a), jnp.where(missing, 0, b)
    fill = -a.shape[0] % PAIRS_PER_STEP
    step = lambda x, value: jnp.pad(x, (0, fill), constant_values=value).reshape(
        -1, PAIRS_PER_STEP
    )

    def add(carry, chunk):
        K_a, K_b = carry
        a, b, missing = chunk
        weight = jnp.where(missing, 0.0, 1.0)[:, None, None]
        block = Q[block_a[a], :, block_b[b], :] * weight
        to_a = jnp.einsum("cij,ckj->cik", Z_b[b], block)
        once = jnp.where(block_a[a] == block_b[b], 0.0, 1.0)[:, None, None] if same else 1.0
        to_b = jnp.einsum("cij,cjk->cik", Z_a[a], block) * once
        K_a = K_a.at[a].add(to_a)
        if same:
            return (K_a.at[b].add(to_b), K_b), None
        return (K_a, K_b.at[b].add(to_b)), None

    chunks = (step(a, 0), step(b, 0), step(missing, True))
    return jax.lax.scan(add, (K_a, K_b), chunks)[0]


def _with_kept(s, Q, point, ray, incidence):
    """Cofactors of the points that stayed in the reduced system, read from it."""
    w, k, K = s.image_width, s.camera_width, s.kept.shape[0]
    n = s.images * w
    m = n + s.cameras * k
    kept = Q[m:, m:].reshape(K, 3, K, 3)
    index = jnp.arange(K)
    point = point.at[s.kept].set(kept[index, :, index, :])
    with_image = Q[m:, :n].reshape(K, 3, s.images, w)
    ray = ray.at[s.kept_rays].set(with_image[s.kept_of_ray, :, s.image[s.kept_rays], :])
    if k:
        with_camera = Q[m:, n:m].reshape(K, 3, s.cameras, k)
        incidence = incidence.at[s.incidence.of_ray[s.kept_rays]].set(
            with_camera[s.kept_of_ray, :, s.camera[s.kept_rays], :]
        )
    return point, ray, incidence


def _transformed(s, values, factor, Q, point):
    """Reduced and point cofactors in the datum of the network: S·Q·Sᵀ."""
    if not s.defect:
        return Q, point
    G = gauge_directions(s, values)
    B = Tangent(
        jnp.zeros_like(G.image), jnp.zeros_like(G.camera), G.point * s.datum_weight[..., None]
    )
    H = jax.vmap(lambda b: solve(factor, b), -1, -1)(B)
    M = jnp.linalg.inv(jnp.einsum("pik,pil->kl", B.point, G.point))
    A = jax.tree.map(lambda h: h @ M.T, H)
    C = M @ jnp.einsum("pik,pil->kl", B.point, A.point)
    stacked = lambda t: jax.vmap(lambda x: reduced_vector(s, x), -1, -1)(t)
    g, a = stacked(G), stacked(A)
    reduced = Q - g @ a.T - a @ g.T + g @ C @ g.T
    cross = jnp.einsum("pik,pjk->pij", G.point, A.point)
    own = jnp.einsum("pik,kl,pjl->pij", G.point, C, G.point)
    return reduced, point - cross - cross.transpose(0, 2, 1) + own


@eqx.filter_jit
def propagate(structure: Structure, values: Values, factor: Factor, rows: Tangent):
    """F·Q·Fᵀ in the datum for any linear functions F of the unknowns (first axis of `rows`).

    One structured solve for each function; covariances of anything, never conditional ones.
    """
    from_datum = jax.vmap(lambda r: _datum_transposed(structure, values, r))(rows)
    solved = jax.vmap(lambda r: solve(factor, r))(from_datum)
    flat = lambda t: jnp.concatenate([x.reshape(x.shape[0], -1) for x in jax.tree.leaves(t)], 1)
    return flat(from_datum) @ flat(solved).T


def _datum_transposed(s, values, row):
    """Sᵀ·f: f − B(GᵀB)⁻¹Gᵀf."""
    if not s.defect:
        return row
    G = gauge_directions(s, values)
    B = G.point * s.datum_weight[..., None]
    gram = jnp.einsum("pik,pil->kl", G.point, B)
    total = sum(
        jnp.einsum("...k,...->k", g, f) for g, f in zip(jax.tree.leaves(G), jax.tree.leaves(row))
    )
    return Tangent(row.image, row.camera, row.point - B @ jnp.linalg.solve(gram, total))
