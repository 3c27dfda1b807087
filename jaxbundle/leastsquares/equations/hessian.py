"""The exact Hessian of ½vᵀPv in the blocks of the normal equations.

It differs from JᵀPJ by Σ p·v·∂²v, the curvature of the observation equations and, by
`Space.move`, which is correct to second order, that of the manifolds. Second derivatives come from
the function of one observation, forward over reverse, and are summed like those of Gauss–Newton
(`normal.Sums`).
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from jaxbundle.leastsquares.equations.linearise import columns_of, widths_of
from jaxbundle.leastsquares.equations.normal import Contribution, NormalBlocks, Sums, Tangent
from jaxbundle.leastsquares.indexing.plan import ObservationPart, Plan, Slots
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
from jaxbundle.types import Scalar, present


def exact_equations(
    declared: Declared, plan: Plan, values: Values, laid: ChunkedData
) -> tuple[Float[Array, ""], Tangent, NormalBlocks]:
    """½·vᵀPv, its gradient and its Hessian, like `normal.normal_equations`."""
    plan, laid = fill_places(plan, laid)
    prepared, sums = prepare(declared, values), Sums(plan)
    for number, part in enumerate(plan.parts):
        cost, gradient, hessian = _derivatives(declared, plan, number, prepared, laid)
        more = _blocks(declared, plan, part, gradient, hessian)
        sums.add_part(part, cost.sum(), *more)
    return sums.total(declared, values)


def _derivatives(
    declared: Declared, plan: Plan, number: int, prepared: Prepared, laid: ChunkedData
) -> tuple[Array, Array, Array]:
    """½|v|² of every observation of a part, its gradient and Hessian with respect to all directions
    of its slots, with a row and a column of zeros at the end."""
    part = plan.parts[number]
    kind, widths = declared.kinds[part.set_name], widths_of(declared, part)
    one = _HalfSquare(residual_of(declared, part), widths)
    return map_observations(part, kind, prepared, laid, number, one)


@dataclasses.dataclass(frozen=True)
class _HalfSquare:
    """½|v|² of one observation, its gradient and Hessian with respect to the changes of its
    slots."""

    residual: Residual
    widths: tuple[int, ...]

    def __call__(
        self, blocks: tuple[Block, ...], measured: PyTree[Scalar], weight: Weight
    ) -> tuple[Array, Array, Array]:
        # One vector of all directions of all slots: H has the mixed second derivatives of slots,
        # too.
        ends = [sum(self.widths[:s]) for s in range(len(self.widths) + 1)]

        def half_square(x: Float[Array, " n"]) -> Scalar:
            changes = tuple(tuple(x[a:b]) for a, b in zip(ends, ends[1:]))
            return 0.5 * sum(r * r for r in self.residual(blocks, measured, weight, changes))

        def gradient(x: Float[Array, " n"]) -> tuple[Array, tuple[Scalar, Array]]:
            cost, g = jax.value_and_grad(half_square)(x)
            return g, (cost, g)

        # Forward over reverse: as many forward passes as directions over one reverse pass, instead
        # of reverse over reverse, which would keep every intermediate value twice.
        hessian, (cost, g) = jax.jacfwd(gradient, has_aux=True)(jnp.zeros(ends[-1]))
        # The zero at the end is column −1, for directions that a touch lacks.
        return cost, jnp.pad(g, (0, 1)), jnp.pad(hessian, (0, 1))


def _blocks(
    declared: Declared,
    plan: Plan,
    part: ObservationPart,
    g: Float[Array, "chunks length n"],
    H: Float[Array, "chunks length n n"],
) -> Contribution:
    """The contribution of a part, see `Sums.add_part`."""
    widths = widths_of(declared, part)

    def columns(slots: Slots, start: int, stop: int) -> Int[np.ndarray, " w"]:
        at = columns_of(widths, slots, start, stop)
        return np.array([-1 if c is None else sum(widths[: c[0]]) + c[1] for c in at], int)

    def block(
        H: Float[Array, "*at n n"],
        rows: tuple[np.ndarray, Array],
        columns: tuple[np.ndarray, Array],
    ) -> Float[Array, "*at w v"]:
        """Some rows and columns of H, (which, free) each."""
        (i, free), (j, others) = rows, columns
        return H[..., i[:, None], j] * free[..., :, None] * others[..., None, :]

    free = lambda t: plan.groups[t.group].free[t.row, t.start : t.stop]
    touches = [(columns(t.slots, t.start, t.stop), free(t)) for t in part.touches]
    summed, right, eliminated, W = H.sum(1), g.sum(1), None, []
    if part.slot is not None:
        e = columns(((part.slot, 0),), 0, widths[part.slot])
        # V and W of observations, as in Gauss–Newton, from H instead of JᵀJ.
        of_row = e, plan.groups[present(plan.eliminated)].free[part.eliminated]
        flat = lambda x: x.reshape(-1, *x.shape[2:])
        beside = (g[..., e] * of_row[1])[..., None]
        eliminated = flat(jnp.concatenate([block(H, of_row, of_row), beside], -1))
        W = [flat(block(H, of_row, (j, free[:, None]))) for j, free in touches]
    own, gradient = [block(summed, t, t) for t in touches], [right[:, i] * f for i, f in touches]
    couples = [block(summed, touches[c.first], touches[c.second]) for c in part.couples]
    return own, gradient, couples, eliminated, W
