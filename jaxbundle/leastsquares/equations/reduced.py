"""The reduced system S·x = b of the kept groups: its blocks, and its dense factor.

It is solved by a dense Cholesky factorisation (here), a banded one (`banded.py`), or without
factorisation by conjugate gradients (`iterative.py`). All three have

- `solve(b)`: S⁻¹·b for rows of the kept groups;
- `inverse()`: the blocks of S⁻¹ where S has blocks;
- `pivots`: the square roots of the pivots, 1 if uncorrelated, 0 if undetermined.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_solve
from jaxtyping import Array, Float

from jaxbundle.leastsquares.equations.normal import AnyTangent
from jaxbundle.leastsquares.indexing.plan import Key, Plan, Tangent

Groups = tuple[str, ...]


class Reduced(eqx.Module):
    """S, or another symmetric matrix, in the blocks that S consists of; see `NormalBlocks`."""

    diagonal_blocks: dict[str, Float[Array, "rows w w"]]
    off_diagonal_blocks: dict[Key, Float[Array, "blocks w v"]]

    def scale_symmetrically(self, plan: Plan, scale: Tangent) -> "Reduced":
        """Rows and columns times `scale`."""
        times = lambda B, s, t: B * s[:, :, None] * t[:, None, :]
        return Reduced(
            {g: times(B, scale[g], scale[g]) for g, B in self.diagonal_blocks.items()},
            {
                (a, b): times(
                    B, scale[a][plan.blocks[a, b].row], scale[b][plan.blocks[a, b].column]
                )
                for (a, b), B in self.off_diagonal_blocks.items()
            },
        )

    def matrix(self, plan: Plan, groups: Groups) -> Float[Array, "n n"]:
        """The matrix of some groups; only its lower triangle is right."""
        # The factorisation reads the lower triangle alone, so that the upper one is not assembled.
        size = lambda g: plan.groups[g].free.size
        rows = [
            [
                self.block(plan, a, b) if j <= i else jnp.zeros((size(a), size(b)))
                for j, b in enumerate(groups)
            ]
            for i, a in enumerate(groups)
        ]
        return jnp.block(rows) if rows else jnp.zeros((0, 0))

    def block(self, plan: Plan, a: str, b: str) -> Float[Array, "n m"]:
        """The matrix of two groups; of one with itself only its lower triangle is right."""
        if (b, a) in self.off_diagonal_blocks and a != b:
            return self.block(plan, b, a).T
        (n, w), (m, v) = plan.groups[a].free.shape, plan.groups[b].free.shape
        matrix = jnp.zeros((n, m, w, v))
        if (a, b) in self.off_diagonal_blocks:
            block_rows = plan.blocks[a, b]
            # Of one group with itself the blocks are those below the diagonal.
            matrix = matrix.at[block_rows.row, block_rows.column].add(
                self.off_diagonal_blocks[a, b]
            )
        if a == b:
            matrix = matrix.at[jnp.arange(n), jnp.arange(n)].add(self.diagonal_blocks[a])
        return matrix.transpose(0, 2, 1, 3).reshape(n * w, m * v)


class DenseFactor(eqx.Module):
    """S = L·Lᵀ."""

    plan: Plan
    lower: Float[Array, "n n"]

    def solve(self, b: Tangent) -> Tangent:
        kept_groups = self.plan.kept
        return split_by_group(
            self.plan, kept_groups, cho_solve((self.lower, True), flat(kept_groups, b))
        )

    def inverse(self) -> Reduced:
        Q = cho_solve((self.lower, True), jnp.eye(self.lower.shape[0]))
        return blocks_of(self.plan, self.plan.kept, Q)

    @property
    def pivots(self) -> Float[Array, " n"]:
        return jnp.diagonal(self.lower)


def factorise_dense(plan: Plan, S: Reduced) -> DenseFactor:
    """The factor of S; NaN if it is not positive definite."""
    return DenseFactor(plan, cholesky_of_lower(S.matrix(plan, plan.kept)))


@jax.custom_jvp
def cholesky_of_lower(S: Float[Array, "*batch n n"]) -> Float[Array, "*batch n n"]:
    """L of S = L·Lᵀ from the lower triangle of S; NaN if it is not positive definite."""
    return jnp.linalg.cholesky(S, symmetrize_input=False)


@cholesky_of_lower.defjvp
def _(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    # JAX's derivative rule expects the full symmetric change.
    whole = lambda S: jnp.tril(S) + jnp.tril(S, -1).mT
    factor = lambda S: jnp.linalg.cholesky(whole(S), symmetrize_input=False)
    return jax.jvp(factor, primals, tangents)


def blocks_of(plan: Plan, groups: Groups, Q: Float[Array, "n n"]) -> Reduced:
    """The blocks of a symmetric matrix of some groups where S has blocks."""
    # Cut by rows, then by columns: `parts[b][a]` is [row of a, column of a, row of b, column of b].
    split_groups = lambda x: split_by_group(plan, groups, x)
    parts = {b: split_groups(jnp.moveaxis(x, -1, 0)) for b, x in split_groups(Q).items()}
    index = {g: jnp.arange(plan.groups[g].rows) for g in groups}
    diagonal = {g: parts[g][g][i, :, i] for g, i in index.items()}
    keys = [(a, b) for a, b in plan.blocks if a in index and b in index]
    block_rows = plan.blocks
    return Reduced(
        diagonal,
        {(a, b): parts[b][a][block_rows[a, b].row, :, block_rows[a, b].column] for a, b in keys},
    )


def flat(groups: Groups, rows: AnyTangent) -> Float[Array, " n"]:
    """Some groups as one vector."""
    return jnp.concatenate([jnp.zeros(0), *(rows[g].ravel() for g in groups)])


def split_by_group(
    plan: Plan, groups: Groups, vector: Float[Array, "n ..."]
) -> dict[str, Float[Array, "rows w ..."]]:
    """The rows of some groups in one, group by group."""
    ends = np.cumsum([plan.groups[g].free.size for g in groups])
    parts = jnp.split(vector, ends[:-1]) if groups else ()
    return {g: x.reshape(*plan.groups[g].free.shape, *x.shape[1:]) for g, x in zip(groups, parts)}
