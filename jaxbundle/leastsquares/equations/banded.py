"""The reduced system if the rows of one group can be ordered so that it is banded.

See `reduction.py`: a block tridiagonal matrix (diagonal blocks D, blocks E below them) with a
border B for all other groups:

    L_k·L_kᵀ = D_k − C_k·C_kᵀ,   C_{k+1} = E_k·L_k⁻ᵀ,   X_k = L_k⁻¹·(B_k − C_k·X_{k−1})
    L·Lᵀ of the corner = corner − ΣX_kᵀ·X_k

The blocks of the inverse Q in the band and its border follow from the factor by a backward
recursion, without the other blocks (Takahashi, Fagan and Chin 1973):

    Q_kb     = −L_k⁻ᵀ·(C_{k+1}ᵀ·Q_{k+1,b} + X_k·Q_bb)               b: the border
    Q_k,k+1  = −L_k⁻ᵀ·(C_{k+1}ᵀ·Q_{k+1,k+1} + X_k·Q_b,k+1)
    Q_kk     =  L_k⁻ᵀ·(L_k⁻¹ − C_{k+1}ᵀ·Q_{k+1,k} − X_k·Q_bk)
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_solve, solve_triangular
from jaxtyping import Array, Float, Int

from jaxbundle.leastsquares.equations.reduced import (
    Reduced,
    blocks_of,
    cholesky_of_lower,
    flat,
    split_by_group,
)
from jaxbundle.leastsquares.indexing.plan import Plan, Tangent
from jaxbundle.types import not_none


class BandFactor(eqx.Module):
    """S block tridiagonal with a border; see the module. `lower`: L_k; `below`: C of the next
    block; `border`: X; `corner`: the Cholesky factor of the corner."""

    plan: Plan
    lower: Float[Array, "blocks m m"]
    below: Float[Array, "blocks m m"]
    border: Float[Array, "blocks m q"]
    corner: Float[Array, "q q"]

    def solve(self, b: Tangent) -> Tangent:
        g, border_groups = _groups(self.plan)

        def forward(
            subtrahend: Float[Array, " m"], block: tuple[Array, Array, Array]
        ) -> tuple[Array, Array]:
            L, C, right = block
            y = solve_triangular(L, right - subtrahend, lower=True)
            return C @ y, y

        nothing, right = jnp.zeros(self.lower.shape[1]), _into_band(self.plan, b[g])
        _, y = jax.lax.scan(forward, nothing, (self.lower, self.below, right))
        border_part = flat(border_groups, b) - jnp.einsum("bmq,bm->q", self.border, y)
        border_part = (
            cho_solve((self.corner, True), border_part) if border_part.size else border_part
        )
        y = y - jnp.einsum("bmq,q->bm", self.border, border_part)

        def backward(
            x: Float[Array, " m"], block: tuple[Array, Array, Array]
        ) -> tuple[Array, Array]:
            L, C, y = block
            x = solve_triangular(L, y - C.T @ x, lower=True, trans=1)
            return x, x

        _, x = jax.lax.scan(backward, nothing, (self.lower, self.below, y), reverse=True)
        return {g: _from_band(self.plan, x)} | split_by_group(self.plan, border_groups, border_part)

    def inverse(self) -> Reduced:
        plan, (g, border_groups) = self.plan, _groups(self.plan)
        m, q = self.border.shape[1:]
        corner = cho_solve((self.corner, True), jnp.eye(q)) if q else self.corner

        def backward(
            carry: tuple[Array, Array], block: tuple[Array, Array, Array]
        ) -> tuple[tuple[Array, Array], tuple[Array, Array, Array]]:
            D_next, with_border_next = carry
            L, C, X = block
            # Q_k,k+1, above the diagonal, is written E, Q_kk D, Q_kb with_border; the last block
            # has no next one (zeros). Here `corner` is Q_bb.
            divided = lambda b: solve_triangular(L, b, lower=True, trans=1)
            with_border = -divided(C.T @ with_border_next + X @ corner)
            E = -divided(C.T @ D_next + X @ with_border_next.T)
            D = solve_triangular(L, jnp.eye(m), lower=True) - C.T @ E.T - X @ with_border.T
            D = divided(D)
            return (D, with_border), (D, E, with_border)

        start = jnp.zeros((m, m)), jnp.zeros((m, q))
        factor = (self.lower, self.below, self.border)
        _, (D, E, with_border) = jax.lax.scan(backward, start, factor, reverse=True)
        # Only the blocks of Q where S has blocks: statistics need no others, and the recursion
        # gives no others.
        Q, index = blocks_of(plan, border_groups, corner), jnp.arange(plan.groups[g].rows)
        Q.diagonal_blocks[g] = _blocks(plan, D, E, index, index)
        border = split_by_group(
            plan, border_groups, jnp.moveaxis(_from_band(plan, with_border), -1, 0)
        )
        for (a, b), block_rows in plan.blocks.items():
            if a == b == g:
                Q.off_diagonal_blocks[a, b] = _blocks(plan, D, E, block_rows.row, block_rows.column)
            elif a == g:
                Q.off_diagonal_blocks[a, b] = border[b][block_rows.column, :, block_rows.row].mT
            elif b == g:
                Q.off_diagonal_blocks[a, b] = border[a][block_rows.row, :, block_rows.column]
        return Q

    @property
    def pivots(self) -> Float[Array, " n"]:
        of_band = jnp.diagonal(self.lower, axis1=1, axis2=2)
        return jnp.concatenate([of_band.ravel(), jnp.diagonal(self.corner)])


def factorise_band(plan: Plan, S: Reduced) -> BandFactor:
    """The factor of a banded S; NaN if it is not positive definite."""
    g, border_groups = _groups(plan)
    band = not_none(plan.band)
    place, width, blocks = band.place, band.width, band.blocks
    w = plan.groups[g].width
    m = width * w
    # Two rows at most one band width apart are in one super-block (0: D) or in two neighbouring
    # ones (1: E): this defines the width. One scatter for both.
    diagonal_and_below = jnp.zeros((2, blocks, width, width, w, w))
    diagonal_and_below = diagonal_and_below.at[0, place // width, place % width, place % width].set(
        S.diagonal_blocks[g]
    )
    if (g, g) in S.off_diagonal_blocks:
        a, b = place[plan.blocks[g, g].row], place[plan.blocks[g, g].column]
        # Which of two rows comes later in the band differs from which is later in the group.
        high, low = jnp.maximum(a, b), jnp.minimum(a, b)
        turned = jnp.where(
            (a < b)[:, None, None], S.off_diagonal_blocks[g, g].mT, S.off_diagonal_blocks[g, g]
        )
        beside = high // width - low // width
        diagonal_and_below = diagonal_and_below.at[
            beside, low // width, high % width, low % width
        ].add(turned)
    D, E = diagonal_and_below.transpose(0, 1, 2, 4, 3, 5).reshape(2, blocks, m, m)
    # Positions of padding get a one, so that every block has a factor; they are never read.
    unused = 1.0 - _into_band(plan, jnp.ones(plan.groups[g].free.shape))
    D = D + unused[:, :, None] * jnp.eye(m)
    border = [S.block(plan, g, other) for other in border_groups]
    # No columns first: without a border there would be nothing to join.
    border = jnp.concatenate([jnp.zeros((plan.groups[g].free.size, 0)), *border], 1)
    # All other groups (shared cameras, mostly): q columns beside the band, dense.
    border = _into_band(plan, border.reshape(plan.groups[g].rows, w, border.shape[1]))

    def step(
        carry: tuple[Array, Array], block: tuple[Array, Array, Array]
    ) -> tuple[tuple[Array, Array], tuple[Array, Array, Array]]:
        C, X = carry
        D, E, B = block
        L = cholesky_of_lower(D - C @ C.T)
        X = solve_triangular(L, B - C @ X, lower=True)
        C = solve_triangular(L, E.T, lower=True).T
        return (C, X), (L, C, X)

    start = jnp.zeros((m, m)), jnp.zeros((m, border.shape[2]))
    # From super-block to super-block: time and memory grow with the length of the street, not with
    # its cube. A street of 1723 images has 15 507 unknowns: 1.9 GB dense; here in blocks of
    # 29 images.
    _, (L, C, X) = jax.lax.scan(step, start, (D, E, border))
    corner = S.matrix(plan, border_groups) - jnp.einsum("bmi,bmj->ij", X, X)
    return BandFactor(plan, L, C, X, cholesky_of_lower(corner))


def _groups(plan: Plan) -> tuple[str, tuple[str, ...]]:
    """The group of the band, and those of the border."""
    group = not_none(plan.band).group
    return group, tuple(g for g in plan.kept if g != group)


def _into_band(plan: Plan, rows: Float[Array, "rows w *q"]) -> Float[Array, "blocks m *q"]:
    """Rows of the group at their positions in the band; zero for padding."""
    band, (_, w, *q) = not_none(plan.band), rows.shape
    padded = jnp.zeros((band.blocks * band.width, w, *q)).at[band.place].set(rows)
    return padded.reshape(band.blocks, band.width * w, *q)


def _from_band(plan: Plan, x: Float[Array, "blocks m *q"]) -> Float[Array, "rows w *q"]:
    band = not_none(plan.band)
    w = plan.groups[band.group].width
    return x.reshape(band.blocks * band.width, w, *x.shape[2:])[band.place]


def _blocks(
    plan: Plan,
    D: Float[Array, "blocks m m"],
    E: Float[Array, "blocks m m"],
    row: Int[Array, " n"],
    column: Int[Array, " n"],
) -> Float[Array, "blocks w w"]:
    """The blocks of two rows each, from the blocks on (D) and above (E) the diagonal."""
    band = not_none(plan.band)
    w, width = plan.groups[band.group].width, band.width
    a, b = band.place[row], band.place[column]
    low, high = jnp.minimum(a, b), jnp.maximum(a, b)
    diagonal_and_above, low_block = (
        jnp.stack([D, E]).reshape(2, -1, width, w, width, w),
        low // width,
    )
    blocks = diagonal_and_above[high // width - low_block, low_block, low % width, :, high % width]
    return jnp.where((a > b)[:, None, None], blocks.mT, blocks)
