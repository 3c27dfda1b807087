"""Cofactors: the blocks of the inverse normal matrix that statistics need, never all of it.

From the factor of the reduced system (`jaxbundle.adjustment.schur`), with Q the inverse of S and
Z = L⁻¹Wᵀ of every ray,

    K_n  = Σ_m Z_m·Q[m, n]              over the rays m of the same point
    Q_pn = −L⁻ᵀ·K_n                     point p with the image of its ray n
    Q_pp = L⁻ᵀ·(1 + Σ_n K_n·Z_nᵀ)·L⁻¹   point p

These are marginal cofactors: the uncertainty of images and cameras is in those of the points.
In a free network they belong to the datum by the S-transformation Q ← S·Q·Sᵀ (`datum.py`).
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbundle.adjustment.datum import gauge_directions, s_transform_transposed
from jaxbundle.adjustment.jacobian import compiled_jacobian
from jaxbundle.adjustment.normal import normal_from_jacobian
from jaxbundle.adjustment.parts import Parts
from jaxbundle.adjustment.schur import Factor, factorise, reduced_free, solve
from jaxbundle.network.arrays import Data, Tangent, Values
from jaxbundle.network.structure import Structure


class Cofactors(eqx.Module):
    """Blocks of Q = N⁻¹, of every image, shared camera and point in the datum of the network.

    The internal ones are what the others and the residuals need, in the regularised datum of the
    factor: the blocks of the reduced system, `ray` (every point with the image of its ray) and
    `incidence` (with its shared camera). Use them only for estimable quantities. What is held has
    zeros.
    """

    image: Float[Array, "images image_block image_block"]
    camera: Float[Array, "cameras camera_block camera_block"]
    point: Float[Array, "points 3 3"]
    internal: Parts
    internal_point: Float[Array, "points 3 3"]
    ray: Float[Array, "rays 3 image_block"]
    incidence: Float[Array, "incidences 3 camera_block"]


def undamped_factor(structure: Structure, values: Values, data: Data) -> Factor:
    """The factor of JᵀPJ at the solution, datum directions made regular."""
    blocks = _factor_blocks(compiled_jacobian(structure, values, data))
    return dataclasses.replace(blocks, structure=structure)


@eqx.filter_jit
def _factor_blocks(jac):
    """The factor without its structure, which a compiled function would return as a copy."""
    return dataclasses.replace(
        factorise(jac.structure, normal_from_jacobian(jac)), structure=None
    )


@eqx.filter_jit
def cofactors(structure: Structure, values: Values, factor: Factor) -> Cofactors:
    """All cofactor blocks of a solved network."""
    s = structure
    Q = _without_held(s, factor.reduced.inverse())
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
    image, in_datum = _transformed(s, values, factor, Q.own, point)
    return Cofactors(image, _camera_blocks(s, Q), in_datum, Q, point, ray, incidence)


def _without_held(s, Q: Parts) -> Parts:
    """The inverse of S with zeros, where S had ones, for what is held."""
    n = s.images * s.image_width
    free = reduced_free(s)
    images, rest = free[:n].reshape(s.images, -1), free[n:]
    own = Q.own * images[:, :, None] * images[:, None, :]
    corner = Q.corner * rest[:, None] * rest[None, :]
    return Parts(Q.pairs, own, Q.border, corner)


def _camera_blocks(s, Q: Parts) -> Float[Array, "cameras k k"]:
    """The block of each shared camera; it has no part in the datum."""
    C, k = s.cameras, s.camera_width
    at = jnp.arange(C)
    return Q.corner[: C * k, : C * k].reshape(C, k, C, k)[at, :, at, :]


def _couplings(factor, Q):
    """K of every ray and of every incidence (zero for points that are not eliminated)."""
    s = factor.structure
    C, k, I, w = s.cameras, s.camera_width, s.images, s.image_width
    Z, Zc = factor.ray, factor.incidence
    K = s.image_pairs.spread_within(Z, Q.pairs, s.table.times_matrix(Z, Q.own))
    Kc = jnp.zeros_like(Zc)
    if k:
        at = s.image_camera_pairs
        with_images = Q.border[: C * k].reshape(C, k, I, w)[at.column, :, at.row, :]
        K, Kc = at.spread(Z, Zc, with_images.transpose(0, 2, 1), (K, Kc))
        at = s.camera_pairs
        cameras = Q.corner[: C * k, : C * k].reshape(C, k, C, k)[at.row, :, at.column, :]
        Kc = at.spread_within(Zc, cameras, Kc)
    return K, Kc


def _with_kept(s, Q, point, ray, incidence):
    """Cofactors of the points that stayed in the reduced system, read from it."""
    w, k, K = s.image_width, s.camera_width, s.kept.shape[0]
    m = s.cameras * k
    index = jnp.arange(K)
    point = point.at[s.kept].set(Q.corner[m:, m:].reshape(K, 3, K, 3)[index, :, index, :])
    with_image = Q.border[m:].reshape(K, 3, s.images, w)
    ray = ray.at[s.kept_rays].set(with_image[s.kept_of_ray, :, s.image[s.kept_rays], :])
    if k:
        with_camera = Q.corner[m:, :m].reshape(K, 3, s.cameras, k)
        incidence = incidence.at[s.incidence.of_ray[s.kept_rays]].set(
            with_camera[s.kept_of_ray, :, s.camera[s.kept_rays], :]
        )
    return point, ray, incidence


def _transformed(s, values, factor, image, point):
    """The blocks of images and points in the datum of the network: S·Q·Sᵀ."""
    if not s.defect:
        return image, point
    G = gauge_directions(s, values)
    B = Tangent(
        jnp.zeros_like(G.image), jnp.zeros_like(G.camera), G.point * s.datum_weight[..., None]
    )
    H = jax.vmap(lambda b: solve(factor, b), -1, -1)(B)
    M = jnp.linalg.inv(jnp.einsum("pik,pil->kl", B.point, G.point))
    A = jax.tree.map(lambda h: h @ M.T, H)
    C = M @ jnp.einsum("pik,pil->kl", B.point, A.point)

    def moved(Q, g, a):
        cross = jnp.einsum("pik,pjk->pij", g, a)
        own = jnp.einsum("pik,kl,pjl->pij", g, C, g)
        return Q - cross - cross.transpose(0, 2, 1) + own

    return moved(image, G.image, A.image), moved(point, G.point, A.point)


@eqx.filter_jit
def propagate(structure: Structure, values: Values, factor: Factor, rows: Tangent):
    """F·Q·Fᵀ in the datum for any linear functions F of the unknowns (first axis of `rows`).

    One structured solve for each function; covariances of anything, never conditional ones.
    """
    from_datum = jax.vmap(lambda r: s_transform_transposed(structure, values, r))(rows)
    solved = jax.vmap(lambda r: solve(factor, r))(from_datum)
    flat = lambda t: jnp.concatenate([x.reshape(x.shape[0], -1) for x in jax.tree.leaves(t)], 1)
    return flat(from_datum) @ flat(solved).T
