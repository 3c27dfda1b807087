"""The reduced system S·x = b of the kept groups, assembled, scaled, factorised.

Dense, by one Cholesky factorisation, here; or banded (`banded.py`); or not at all, by conjugate
gradients (`iterative.py`). S is scaled by the diagonal of A (before elimination). What is held gets
a one.

A problem that may float is singular along its open motions. They are made regular by adding a one
to as many diagonal elements (`Datum.pins`): the solution changes along these motions only.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_solve
from jaxtyping import Array, Float

from jaxbundle.leastsquares.plan import Key, Plan


class Reduced(eqx.Module):
    """S in the blocks it consists of; see `Normal`."""

    own: dict[str, Float[Array, "rows w w"]]
    off: dict[Key, Float[Array, "blocks w v"]]


class DenseFactor(eqx.Module):
    """S = L·Lᵀ, scaled."""

    plan: Plan
    lower: Float[Array, "n n"]
    scale: Float[Array, " n"]

    def solve(self, b):
        """S⁻¹·b."""
        x = cho_solve((self.lower, True), flat(self.plan, b) * self.scale) * self.scale
        return split(self.plan, x)

    def inverse(self) -> Reduced:
        """The blocks of S⁻¹ where S has blocks."""
        plan = self.plan
        Q = cho_solve((self.lower, True), jnp.diag(self.scale)) * self.scale[:, None]
        start, place = 0, {}
        for g in plan.kept:
            place[g] = start
            start += plan.groups[g].free.size

        def between(later, earlier, row, column):
            (n, w), (m, v) = (plan.groups[g].free.shape for g in (later, earlier))
            a, b = place[later], place[earlier]
            blocks = Q[a : a + n * w, b : b + m * v].reshape(n, w, m, v)
            return blocks[row, :, column, :]

        index = {g: jnp.arange(plan.groups[g].rows) for g in plan.kept}
        return Reduced(
            {g: between(g, g, i, i) for g, i in index.items()},
            {key: between(*key, at.row, at.column) for key, at in plan.blocks.items()},
        )

    @property
    def pivots(self) -> Float[Array, " n"]:
        """Square roots of the pivots, 1 without correlation, 0 without determination."""
        return jnp.diagonal(self.lower)


def factorise_reduced(plan: Plan, parts: Reduced, before, regular=True) -> DenseFactor:
    """The factor of S; NaN where it is not positive definite. `before`: diagonal blocks of A."""
    diagonal = flat(plan, {g: jnp.diagonal(B, axis1=1, axis2=2) for g, B in before.items()})
    scale = jnp.where(diagonal > 0, diagonal, 1.0) ** -0.5
    S = dense_matrix(plan, parts, scale, regular)
    return DenseFactor(plan, cholesky_of_lower(S), scale)


@jax.custom_jvp
def cholesky_of_lower(S: Float[Array, "*batch n n"]) -> Float[Array, "*batch n n"]:
    """L of S = L·Lᵀ from the lower triangle of S; NaN where it is not positive definite."""
    return jnp.linalg.cholesky(S, symmetrize_input=False)


@cholesky_of_lower.defjvp
def _(primals, tangents):
    # JAX's own rule takes a change for the whole of it.
    whole = lambda S: jnp.tril(S) + jnp.tril(S, -1).mT
    factor = lambda S: jnp.linalg.cholesky(whole(S), symmetrize_input=False)
    return jax.jvp(factor, primals, tangents)


def dense_matrix(plan: Plan, parts: Reduced, scale, regular=True) -> Float[Array, "n n"]:
    """S scaled, the open motions of the datum made regular; only its lower triangle is right."""
    rows = []
    for b, later in enumerate(plan.kept):
        row = []
        for c, earlier in enumerate(plan.kept):
            n, m = (plan.groups[g].rows for g in (later, earlier))
            w, v = (plan.groups[g].width for g in (later, earlier))
            block = jnp.zeros((n, m, w, v))
            if (later, earlier) in parts.off and c <= b:
                at = plan.blocks[later, earlier]
                block = block.at[at.row, at.column].add(parts.off[later, earlier])
            if later == earlier:
                index = jnp.arange(n)
                block = block.at[index, index].add(parts.own[later])
            row.append(block.transpose(0, 2, 1, 3).reshape(n * w, m * v))
        rows.append(jnp.concatenate(row, 1))
    S = jnp.concatenate(rows) * scale[:, None] * scale[None, :]
    more = 1.0 - flat(plan, {g: plan.groups[g].free for g in plan.kept})
    if plan.datum is not None:
        more = more + regular * flat(plan, plan.datum.pins)
    return S + jnp.diag(more)


def flat(plan: Plan, rows) -> Float[Array, " n"]:
    """The kept groups as one vector."""
    return jnp.concatenate([rows[g].ravel() for g in plan.kept])


def split(plan: Plan, vector):
    """The vector of the kept groups, group by group."""
    found, start = {}, 0
    for g in plan.kept:
        n, w = plan.groups[g].free.shape
        found[g] = vector[start : start + n * w].reshape(n, w)
        start += n * w
    return found
