"""The exact Hessian of ½vᵀPv in the blocks of the normal equations.

It differs from JᵀPJ by Σ p·v·∂²v, the curvature of the observation equations and, by
`Space.move`, which is correct to second order, that of the manifolds. Second derivatives come from
the function of one observation, forward over reverse, and are summed like those of Gauss–Newton
(`normal.Sums`).
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from jaxbundle.leastsquares.equations.linearise import columns_of, widths_of
from jaxbundle.leastsquares.equations.normal import NormalBlocks, PartProducts, Sums
from jaxbundle.leastsquares.indexing.plan import ObservationPart, Plan, Slots, Tangent
from jaxbundle.leastsquares.indexing.rows import (
    ChunkedData,
    Declared,
    Prepared,
    Residual,
    Values,
    Weight,
    fill_places,
    map_observations,
    prepare,
    residual_of,
)
from jaxbundle.leastsquares.spaces import Block
from jaxbundle.types import Scalar, not_none


class SecondOrder(eqx.Module):
    """The derivatives of the observations of a part by all directions of its slots: J = ∂v, and the
    curvature Σ v·∂²v, with a column (and a row) of zeros at the end. H = JᵀJ + curvature."""

    jacobian: Float[Array, "chunks length r n"]
    curvature: Float[Array, "chunks length n n"]


def equations_and_terms(
    declared: Declared, plan: Plan, values: Values, chunked: ChunkedData
) -> tuple[tuple[Float[Array, ""], Tangent, NormalBlocks], tuple[SecondOrder, ...]]:
    """½·vᵀPv, its gradient and its Hessian, like `normal.normal_equations`, and the derivatives of
    every part, of which they are sums."""
    plan, chunked = fill_places(plan, chunked)
    prepared, sums, terms = prepare(declared, values), Sums(plan), []
    for number, part in enumerate(plan.parts):
        v, derivatives = _derivatives(declared, plan, number, prepared, chunked)
        J = derivatives.jacobian
        gradient = jnp.einsum("clri,clr->cli", J, v)
        hessian = jnp.einsum("clri,clrj->clij", J, J) + derivatives.curvature
        blocks = _blocks(declared, plan, part, gradient, hessian)
        sums.add_part(part, 0.5 * jnp.vdot(v, v), *blocks)
        terms.append(derivatives)
    return sums.total(declared, values), tuple(terms)


def count_terms(declared: Declared, plan: Plan) -> int:
    """The numbers of the curvature of all observations."""
    directions = (sum(widths_of(declared, part)) for part in plan.parts)
    return sum(part.source.size * n**2 for part, n in zip(plan.parts, directions))


def _derivatives(
    declared: Declared, plan: Plan, number: int, prepared: Prepared, chunked: ChunkedData
) -> tuple[Float[Array, "chunks length r"], SecondOrder]:
    """The residuals of every observation of a part and their derivatives."""
    part = plan.parts[number]
    kind, widths = declared.kinds[part.set_name], widths_of(declared, part)
    second_order = _SecondOrderOfOne(residual_of(declared, part), widths)
    v, J, curvature = map_observations(part, kind, prepared, chunked, number, second_order)
    return v, SecondOrder(J, curvature)


@dataclasses.dataclass(frozen=True)
class _SecondOrderOfOne:
    """The residuals v of one observation, J = ∂v and Σ v·∂²v by the changes of its slots."""

    residual: Residual
    widths: tuple[int, ...]

    def __call__(
        self, blocks: tuple[Block, ...], measured: PyTree[Scalar], weight: Weight
    ) -> tuple[Array, Array, Array]:
        # One vector of all directions of all slots: the curvature has the mixed second derivatives
        # of slots, too.
        ends = [sum(self.widths[:s]) for s in range(len(self.widths) + 1)]
        zero_change = jnp.zeros(ends[-1])

        def residuals(x: Float[Array, " n"]) -> tuple[Array, Array]:
            changes = tuple(tuple(x[a:b]) for a, b in zip(ends, ends[1:]))
            v = jnp.stack(self.residual(blocks, measured, weight, changes))
            return v, v

        J, v = jax.jacfwd(residuals, has_aux=True)(zero_change)
        # Forward over reverse: as many forward passes as directions over one reverse pass, instead
        # of reverse over reverse, which would keep every intermediate value twice.
        curvature = jax.jacfwd(jax.grad(lambda x: jnp.vdot(v, residuals(x)[0])))(zero_change)
        # The zero at the end is column −1, for directions that a touch lacks.
        return v, jnp.pad(J, ((0, 0), (0, 1))), jnp.pad(curvature, (0, 1))


def _blocks(
    declared: Declared,
    plan: Plan,
    part: ObservationPart,
    g: Float[Array, "chunks length n"],
    H: Float[Array, "chunks length n n"],
) -> PartProducts:
    """The contribution of a part, see `Sums.add_part`."""
    widths = widths_of(declared, part)

    def columns(slots: Slots, start: int, stop: int) -> Int[np.ndarray, " w"]:
        slots_and_directions = columns_of(widths, slots, start, stop)
        return np.array(
            [-1 if c is None else sum(widths[: c[0]]) + c[1] for c in slots_and_directions], int
        )

    def block(
        H: Float[Array, "*at n n"],
        rows: tuple[np.ndarray, Array],
        columns: tuple[np.ndarray, Array],
    ) -> Float[Array, "*at w v"]:
        """Some rows and columns of H, (which, free) each."""
        (i, free), (j, column_free) = rows, columns
        return H[..., i[:, None], j] * free[..., :, None] * column_free[..., None, :]

    free = lambda t: plan.groups[t.group].free[t.row, t.start : t.stop]
    touches = [(columns(t.slots, t.start, t.stop), free(t)) for t in part.touches]
    summed, right, eliminated, W = H.sum(1), g.sum(1), None, []
    if part.slot is not None:
        e = columns(((part.slot, 0),), 0, widths[part.slot])
        # V and W of observations, as in Gauss–Newton, from H instead of JᵀJ.
        of_row = e, plan.groups[not_none(plan.eliminated)].free[part.eliminated]
        flat = lambda x: x.reshape(-1, *x.shape[2:])
        beside = (g[..., e] * of_row[1])[..., None]
        eliminated = flat(jnp.concatenate([block(H, of_row, of_row), beside], -1))
        W = [flat(block(H, of_row, (j, free[:, None]))) for j, free in touches]
    diagonal, gradient = (
        [block(summed, t, t) for t in touches],
        [right[:, i] * f for i, f in touches],
    )
    couplings = [block(summed, touches[c.first], touches[c.second]) for c in part.couplings]
    return diagonal, gradient, couplings, eliminated, W
