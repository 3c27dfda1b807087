"""The reduced system S·x = b of images, cameras and kept points: assembled, scaled, factorised.

Dense, by one Cholesky factorisation; or, where the images can be put into an order in which S is
banded (`jaxbundle.network.band`), as a block tridiagonal matrix with a border for cameras and kept
points:

    L_k·L_kᵀ = D_k − C_k·C_kᵀ,   C_{k+1} = E_k·L_k⁻ᵀ,   X_k = L_k⁻¹·(B_k − C_k·X_{k−1})
    L·Lᵀ of the corner = corner − ΣX_kᵀ·X_k

S is scaled to a unit diagonal (before elimination of the points). What is held gets a one there.

A free network is singular along its datum directions G (similarities). Dense, they are made
regular by adding q·qᵀ, q an orthonormal basis of G's part in the scaled system; banded, by adding
a one to as many diagonal elements, positions of images far apart. Either way the solution changes
along G only.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_solve, solve_triangular
from jaxtyping import Array, Float

from jaxbundle.network.structure import Structure


class Parts(eqx.Module):
    """S as sums over all devices: blocks of pairs of images and of each image, and the rows of
    cameras and kept points against images (`border`) and each other (`corner`)."""

    pairs: Float[Array, "blocks w w"]
    own: Float[Array, "images w w"]
    border: Float[Array, "q images_w"]
    corner: Float[Array, "q q"]


class DenseFactor(eqx.Module):
    """S = L·Lᵀ, scaled."""

    lower: Float[Array, "n n"]
    scale: Float[Array, " n"]

    def solve(self, b: Float[Array, " n"]) -> Float[Array, " n"]:
        """S⁻¹·b."""
        return cho_solve((self.lower, True), b * self.scale) * self.scale

    @property
    def pivots(self) -> Float[Array, " n"]:
        """Square roots of the pivots, 1 without correlation, 0 without determination."""
        return jnp.diagonal(self.lower)


class BandFactor(eqx.Module):
    """S block tridiagonal with a border; see the module."""

    structure: Structure
    lower: Float[Array, "blocks m m"]
    below: Float[Array, "blocks m m"]
    border: Float[Array, "blocks m q"]
    corner: Float[Array, "q q"]
    scale: Float[Array, " n"]

    def solve(self, b: Float[Array, " n"]) -> Float[Array, " n"]:
        """S⁻¹·b."""
        s, m = self.structure, self.lower.shape[1]
        b = b * self.scale
        images = s.images * s.image_width
        right = _into_band(s, b[:images].reshape(s.images, -1))

        def forward(y, block):
            L, C, right = block
            y = solve_triangular(L, right - C @ y, lower=True)
            return y, y

        _, y = jax.lax.scan(forward, jnp.zeros(m), (self.lower, self.below, right))
        rest = b[images:] - jnp.einsum("bmq,bm->q", self.border, y)
        rest = cho_solve((self.corner, True), rest) if rest.size else rest
        y = y - jnp.einsum("bmq,q->bm", self.border, rest)

        def backward(carry, block):
            x, C_next = carry
            L, C, y = block
            x = solve_triangular(L, y - C_next.T @ x, lower=True, trans=1)
            return (x, C), x

        start = (jnp.zeros(m), jnp.zeros((m, m)))
        _, x = jax.lax.scan(backward, start, (self.lower, self.below, y), reverse=True)
        return jnp.concatenate([_from_band(s, x).ravel(), rest]) * self.scale

    @property
    def pivots(self) -> Float[Array, " n"]:
        """Square roots of the pivots, 1 without correlation, 0 without determination."""
        images = jnp.diagonal(self.lower, axis1=1, axis2=2)
        return jnp.concatenate([images.ravel(), jnp.diagonal(self.corner)])


def factorise_reduced(structure: Structure, parts: Parts, scale, free, gauge, regular=True):
    """The factor of S; NaN where it is not positive definite.

    **Arguments:** `scale` [n], `free` [n] (0: held), `gauge` [n, defect]; `regular`: whether to
    make the datum directions of a banded system regular.
    """
    if structure.band is not None:
        return _factorise_band(structure, parts, scale, free, regular)
    lower = jnp.linalg.cholesky(
        dense_matrix(structure, parts, scale, free, gauge, regular), symmetrize_input=False
    )
    return DenseFactor(lower, scale)


def dense_matrix(
    structure: Structure, parts: Parts, scale, free, gauge, regular=True
) -> Float[Array, "n n"]:
    """S scaled, its datum directions made regular; only its lower triangle is right."""
    s = structure
    I, w, q = s.images, s.image_width, parts.corner.shape[0]
    index = jnp.arange(I)
    S = jnp.zeros((I, I, w, w))
    S = S.at[s.image_pairs.column, s.image_pairs.row].add(parts.pairs.transpose(0, 2, 1))
    S = S.at[index, index].add(parts.own).transpose(0, 2, 1, 3).reshape(I * w, I * w)
    if q:
        S = jnp.concatenate([jnp.pad(S, ((0, 0), (0, q))),
                             jnp.concatenate([parts.border, parts.corner], 1)])  # fmt: skip
    S = S * scale[:, None] * scale[None, :]
    index = jnp.arange(S.shape[0])
    S = S.at[index, index].set(jnp.where(free > 0, jnp.diagonal(S), 1.0))
    if gauge.shape[1]:
        directions, _ = jnp.linalg.qr(gauge / scale[:, None])
        S = S + regular * directions @ directions.T
    return S


def _factorise_band(s: Structure, parts: Parts, scale, free, regular) -> BandFactor:
    w, images = s.image_width, s.images * s.image_width
    width, blocks, place = s.band.width, s.band.blocks, s.band.place
    m = width * w
    a, b = place[s.image_pairs.row], place[s.image_pairs.column]
    high, low = jnp.maximum(a, b), jnp.minimum(a, b)
    turned = jnp.where((a < b)[:, None, None], parts.pairs.transpose(0, 2, 1), parts.pairs)
    beside = high // width != low // width
    at = lambda here: (jnp.where(here, low // width, blocks), high % width, low % width)
    empty = jnp.zeros((blocks, width, width, w, w))
    D = empty.at[at(~beside)].add(turned, mode="drop")
    D = D.at[place // width, place % width, place % width].add(parts.own)
    E = empty.at[at(beside)].add(turned, mode="drop")
    flat = lambda x: x.transpose(0, 1, 3, 2, 4).reshape(blocks, m, m)
    of_images = lambda x: _into_band(s, x[:images].reshape(s.images, -1))
    scales, is_free = of_images(scale), of_images(free) > 0
    D = flat(D) * scales[:, :, None] * scales[:, None, :]
    E = flat(E) * jnp.roll(scales, -1, 0)[:, :, None] * scales[:, None, :]
    index = jnp.arange(m)
    diagonal = jnp.where(is_free, jnp.diagonal(D, axis1=1, axis2=2), 1.0)
    D = D.at[:, index, index].set(diagonal + regular * of_images(s.pins.ravel()))
    rest = scale[images:]
    border = parts.border * rest[:, None] * scale[None, :images]
    border = jax.vmap(lambda row: _into_band(s, row.reshape(s.images, -1)), 0, -1)(border)
    corner = parts.corner * rest[:, None] * rest[None, :]
    corner_index = jnp.arange(corner.shape[0])
    corner = corner.at[corner_index, corner_index].set(
        jnp.where(free[images:] > 0, jnp.diagonal(corner), 1.0)
    )

    def step(carry, block):
        C, X = carry
        D, E, B = block
        L = jnp.linalg.cholesky(D - C @ C.T, symmetrize_input=False)
        X = solve_triangular(L, B - C @ X, lower=True)
        C_next = solve_triangular(L, E.T, lower=True).T
        return (C_next, X), (L, C, X)

    start = (jnp.zeros((m, m)), jnp.zeros((m, border.shape[2])))
    _, (L, C, X) = jax.lax.scan(step, start, (D, E, border))
    corner = jnp.linalg.cholesky(
        corner - jnp.einsum("bmi,bmj->ij", X, X), symmetrize_input=False
    )
    return BandFactor(s, L, C, X, corner, scale)


def _into_band(s: Structure, rows: Float[Array, "images w"]) -> Float[Array, "blocks m"]:
    """Rows of images at their places in the band; zero (scale of nothing) where it is filled."""
    whole = jnp.zeros((s.band.blocks * s.band.width, rows.shape[1]))
    return whole.at[s.band.place].set(rows).reshape(s.band.blocks, -1)


def _from_band(s: Structure, x: Float[Array, "blocks m"]) -> Float[Array, "images w"]:
    return x.reshape(-1, s.image_width)[s.band.place]
