"""The reduced system where the images can be put into an order in which it is banded.

See `jaxbundle.network.band`: a block tridiagonal matrix (diagonal blocks D, blocks E below them)
with a border B for cameras and kept points:

    L_k·L_kᵀ = D_k − C_k·C_kᵀ,   C_{k+1} = E_k·L_k⁻ᵀ,   X_k = L_k⁻¹·(B_k − C_k·X_{k−1})
    L·Lᵀ of the corner = corner − ΣX_kᵀ·X_k

The blocks of the inverse Q in the band and its border follow from the factor backwards, without
the others (Takahashi, Fagan and Chin 1973):

    Q_kb     = −L_k⁻ᵀ·(C_{k+1}ᵀ·Q_{k+1,b} + X_k·Q_bb)               b: the border
    Q_k,k+1  = −L_k⁻ᵀ·(C_{k+1}ᵀ·Q_{k+1,k+1} + X_k·Q_b,k+1)
    Q_kk     =  L_k⁻ᵀ·(L_k⁻¹ − C_{k+1}ᵀ·Q_{k+1,k} − X_k·Q_bk)
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_solve, solve_triangular
from jaxtyping import Array, Float

from jaxbundle.adjustment.cholesky import cholesky_of_lower
from jaxbundle.adjustment.parts import Parts
from jaxbundle.network.structure import Structure


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

    def inverse(self) -> Parts:
        """The blocks of S⁻¹ where S has blocks."""
        s, m = self.structure, self.lower.shape[1]
        n, q = s.images * s.image_width, self.corner.shape[0]
        one, nothing = jnp.eye(m), jnp.zeros((m, m))
        corner = cho_solve((self.corner, True), jnp.eye(q)) if q else self.corner

        def backward(carry, block):
            D_next, with_border_next, C_next = carry
            L, C, X = block
            divided = lambda b: solve_triangular(L, b, lower=True, trans=1)
            with_border = -divided(C_next.T @ with_border_next + X @ corner)
            E = -divided(C_next.T @ D_next + X @ with_border_next.T)
            D = solve_triangular(L, one, lower=True) - C_next.T @ E.T - X @ with_border.T
            D = divided(D)
            return (D, with_border, C), (D, E, with_border)

        start = (nothing, jnp.zeros((m, q)), nothing)
        factor = (self.lower, self.below, self.border)
        _, (D, E, with_border) = jax.lax.scan(backward, start, factor, reverse=True)
        border = jax.vmap(lambda x: _from_band(s, x).ravel(), -1)(with_border)
        images, rest = self.scale[:n].reshape(s.images, -1), self.scale[n:]
        scaled = lambda Q, i, j: Q * images[i][:, :, None] * images[j][:, None, :]
        index = jnp.arange(s.images)
        pairs = s.image_pairs
        return Parts(
            pairs=scaled(_blocks(s, D, E, pairs.row, pairs.column), pairs.row, pairs.column),
            own=scaled(_blocks(s, D, E, index, index), index, index),
            border=border * rest[:, None] * self.scale[None, :n],
            corner=corner * rest[:, None] * rest[None, :],
        )

    @property
    def pivots(self) -> Float[Array, " n"]:
        """Square roots of the pivots, 1 without correlation, 0 without determination."""
        images = jnp.diagonal(self.lower, axis1=1, axis2=2)
        return jnp.concatenate([images.ravel(), jnp.diagonal(self.corner)])


def factorise_band(s: Structure, parts: Parts, scale, free, regular) -> BandFactor:
    """The factor of a banded S; arguments as in `jaxbundle.adjustment.reduced`."""
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
        L = cholesky_of_lower(D - C @ C.T)
        X = solve_triangular(L, B - C @ X, lower=True)
        C_next = solve_triangular(L, E.T, lower=True).T
        return (C_next, X), (L, C, X)

    start = (jnp.zeros((m, m)), jnp.zeros((m, border.shape[2])))
    _, (L, C, X) = jax.lax.scan(step, start, (D, E, border))
    corner = cholesky_of_lower(corner - jnp.einsum("bmi,bmj->ij", X, X))
    return BandFactor(s, L, C, X, corner, scale)


def _into_band(s: Structure, rows: Float[Array, "images w"]) -> Float[Array, "blocks m"]:
    """Rows of images at their places in the band; zero (scale of nothing) where it is filled."""
    whole = jnp.zeros((s.band.blocks * s.band.width, rows.shape[1]))
    return whole.at[s.band.place].set(rows).reshape(s.band.blocks, -1)


def _from_band(s: Structure, x: Float[Array, "blocks m"]) -> Float[Array, "images w"]:
    return x.reshape(-1, s.image_width)[s.band.place]


def _blocks(s: Structure, D, E, row, column) -> Float[Array, "blocks w w"]:
    """The blocks of two images each, from the blocks on (D) and above (E) the diagonal."""
    w, width = s.image_width, s.band.width
    cut = lambda X: X.reshape(-1, width, w, width, w)
    a, b = s.band.place[row], s.band.place[column]
    low, high = jnp.minimum(a, b), jnp.maximum(a, b)
    here = low // width
    found = jnp.where(
        (here == high // width)[:, None, None],
        cut(D)[here, low % width, :, high % width, :],
        cut(E)[here, low % width, :, high % width, :],
    )
    return jnp.where((a > b)[:, None, None], found.transpose(0, 2, 1), found)
