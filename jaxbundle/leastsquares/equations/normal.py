"""The normal equations N·δ = −g in blocks.

    N = ⎡ A  Wᵀ ⎤   A: kept groups, diagonal and off-diagonal blocks
        ⎣ W  V  ⎦   V: one small block for each eliminated row; W: one for each incidence

They are filled either from the Jacobian (N = JᵀPJ, Gauss–Newton) or from second derivatives of
every observation (the exact Hessian, `hessian.py`); everything after that is the same.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from functools import partial, reduce
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from jaxbundle.leastsquares.equations.damping import damping_matrix
from jaxbundle.leastsquares.equations.linearise import differentiate
from jaxbundle.leastsquares.equations.local import (
    LocalJacobian,
    differentiate_locally,
    local_touch,
    products_of,
    sum_by_column,
)
from jaxbundle.leastsquares.indexing.plan import (
    Coupling,
    Key,
    ObservationPart,
    Plan,
    Tangent,
    TouchedRows,
)
from jaxbundle.leastsquares.indexing.rows import ChunkedData, Declared, Values, prepare
from jaxbundle.types import AnyArray, not_none

Rows = Float[AnyArray, "rows width"]
AnyTangent = Mapping[str, Rows]
# What a part adds: `diagonal`, `gradient`, `couplings`, `eliminated` and `W` of `Sums.add_part`.
PartProducts = tuple[list[Array], list[Array], list[Array], Array | None, list[Array]]
Sum = TypeVar("Sum")


class NormalBlocks(eqx.Module):
    """N in blocks; rows and columns of held unknowns are zero. Those of kept groups are sums over
    all devices, the others belong to the eliminated rows of one device. `damping_matrix`: D."""

    diagonal_blocks: dict[str, Float[Array, "rows w w"]]
    off_diagonal_blocks: dict[Key, Float[Array, "blocks w v"]]
    eliminated: Float[Array, "rows w w"] | None
    W: dict[str, Float[Array, "chunks length w v"]]
    damping_matrix: dict[str, Float[Array, "rows w *w"]]


class Normal(lx.AbstractLinearOperator):
    """N as a linear operator on changes of the unknowns."""

    plan: Plan
    blocks: NormalBlocks

    def mv(self, vector: Tangent) -> Tangent:
        """N·x."""
        plan, N, e = self.plan, self.blocks, self.plan.eliminated
        product = times_kept(plan, N, vector)
        if e is not None:
            product[e] = jnp.einsum("nij,nj->ni", N.eliminated, vector[e])
            product[e] = product[e] + scatter(plan, N.W, vector)
            for g, addend in gather(plan, N.W, vector[e]).items():
                product[g] = product[g] + addend
        return product

    def diagonal(self) -> Tangent:
        """The diagonal of N."""
        N, e = self.blocks, self.plan.eliminated
        blocks = N.diagonal_blocks if e is None else N.diagonal_blocks | {e: not_none(N.eliminated)}
        return {g: jnp.diagonal(B, axis1=1, axis2=2) for g, B in blocks.items()}

    def as_matrix(self) -> Float[Array, "n n"]:
        """The dense matrix, groups in the order of their names; for small problems and tests."""
        zero = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), self.in_structure())
        flat, unravel = ravel_pytree(zero)
        column = lambda e: ravel_pytree(self.mv(unravel(e)))[0]
        return jax.vmap(column, out_axes=1)(jnp.eye(flat.size))

    def transpose(self) -> "Normal":
        return self

    def in_structure(self) -> Tangent:
        return jax.eval_shape(self.diagonal)

    def out_structure(self) -> Tangent:
        return self.in_structure()


for _trait in (
    lx.is_diagonal,
    lx.is_tridiagonal,
    lx.has_unit_diagonal,
    lx.is_lower_triangular,
    lx.is_upper_triangular,
    lx.is_negative_semidefinite,
):
    _trait.register(Normal)(lambda _: False)
for _trait in (lx.is_symmetric, lx.is_positive_semidefinite):
    _trait.register(Normal)(lambda _: True)
for _same in (lx.linearise, lx.materialise, lx.conj):
    _same.register(Normal)(lambda operator: operator)
lx.diagonal.register(Normal)(lambda operator: operator.diagonal())


def sum_over_devices(plan: Plan, parts: Sum) -> Sum:
    """The sum over the devices of the contributions of their eliminated rows."""
    return parts if plan.axis is None else jax.lax.psum(parts, plan.axis)


def average_over_devices(plan: Plan, value: Sum) -> Sum:
    """The mean over the devices of values that should be the same on all, to make them identical to
    the last digit: devices that decide differently would deadlock."""
    return value if plan.axis is None else jax.lax.pmean(value, plan.axis)


def times_kept(plan: Plan, N: NormalBlocks, x: Tangent) -> Tangent:
    """A·x."""
    product = {g: jnp.einsum("nij,nj->ni", B, x[g]) for g, B in N.diagonal_blocks.items()}
    # One of each pair of blocks is stored; the other is its transpose.
    for (later, earlier), B in N.off_diagonal_blocks.items():
        block_rows = plan.blocks[later, earlier]
        lower_product = jnp.einsum("bij,bj->bi", B, x[earlier][block_rows.column])
        upper_product = jnp.einsum("bij,bi->bj", B, x[later][block_rows.row])
        product[later] = product[later].at[block_rows.row].add(lower_product)
        product[earlier] = product[earlier].at[block_rows.column].add(upper_product)
    return product


def gather(plan: Plan, W: dict[str, Array], h: Float[Array, "rows w"]) -> Tangent:
    """Wᵀ·h for rows h that are eliminated; the sum of all devices."""
    products = {}
    for g, blocks in W.items():
        incidences, rows = plan.incidences[g], _tall(blocks)
        of_chunks = jnp.einsum("cki,ck->ci", rows, h[incidences.eliminated].reshape(rows.shape[:2]))
        products[g] = jax.ops.segment_sum(of_chunks, incidences.row, plan.groups[g].rows)
    return sum_over_devices(plan, products)


def scatter(plan: Plan, W: dict[str, Array], x: Tangent) -> Float[Array, "..."]:
    """W·x."""
    sums = jnp.zeros(())
    for g, blocks in W.items():
        incidences = plan.incidences[g]
        products = jnp.einsum("cki,ci->ck", _tall(blocks), x[g][incidences.row])
        sums = sums + jax.ops.segment_sum(
            products.reshape(-1, blocks.shape[-2]),
            incidences.eliminated.ravel(),
            plan.groups[not_none(plan.eliminated)].rows,
        )
    return sums


def _tall(blocks: Float[Array, "chunks length w v"]) -> Float[Array, "chunks length*w v"]:
    """The blocks of a chunk as one matrix."""
    return blocks.reshape(blocks.shape[0], -1, blocks.shape[-1])


@partial(jax.jit, static_argnums=0, inline=True)
def normal_equations(
    declared: Declared, plan: Plan, values: Values, chunked: ChunkedData
) -> tuple[Float[Array, ""], Tangent, NormalBlocks]:
    """½·vᵀPv, its gradient g = Jᵀr and N = JᵀJ at these values (the weights are in r and J).

    Traced once per plan: the solver needs the shapes of its results before the values."""
    prepared, sums = prepare(declared, values), Sums(plan)
    for number, part in enumerate(plan.parts):
        local = local_touch(declared, part)
        if local is not None:
            sums.add_local(
                part, differentiate_locally(declared, plan, number, local, prepared, chunked)
            )
            continue
        r, touches, E = differentiate(declared, plan, number, prepared, chunked)
        sums.add_part(part, 0.5 * jnp.vdot(r, r), *_gauss_newton_products(part, r, touches, E))
    return sums.total(declared, values)


def _gauss_newton_products(
    part: ObservationPart,
    r: Float[Array, "chunks length r"],
    touches: Sequence[Float[Array, "chunks length r w"]],
    E: Float[Array, "chunks length r w"] | None,
) -> PartProducts:
    """The Gauss–Newton contribution of a part, see `Sums.add_part`: products of the blocks of J."""
    # All observations of a chunk touch the same kept rows: JᵀJ over the chunk is one product of a
    # tall matrix. Sorted by eliminated row instead, every observation would scatter a block (66 ms
    # an iteration on BAL 16; in chunks 45).
    tall = [J.reshape(J.shape[0], -1, J.shape[-1]) for J in touches]
    right, eliminated, W = r.reshape(r.shape[0], -1), None, []
    if E is not None:
        flat = lambda x: x.reshape(-1, *x.shape[2:])
        J = flat(E)
        # Eliminated rows differ from observation to observation: their blocks are summed
        # afterwards, block and gradient in one array, one pass.
        eliminated = transposed_products(J, jnp.concatenate([J, flat(r)[..., None]], -1))
        W = [transposed_products(J, flat(K)) for K in touches]
    diagonal = [jnp.einsum("cki,ckj->cij", J, J) for J in tall]
    gradient = [jnp.einsum("cki,ck->ci", J, right) for J in tall]
    couplings = [jnp.einsum("cki,ckj->cij", tall[c.first], tall[c.second]) for c in part.couplings]
    return diagonal, gradient, couplings, eliminated, W


class Sums:
    """Sums of blocks and gradient over the parts."""

    def __init__(self, plan: Plan):
        self.plan = plan
        zero = lambda g: jnp.zeros((g.rows, g.width))
        self.gradient = {name: zero(g) for name, g in plan.groups.items()}
        self.diagonal_blocks = {
            name: jnp.zeros((g.rows, g.width, g.width)) for name, g in plan.groups.items()
        }
        self.off_diagonal_blocks = {}
        self.W = {}
        self.cost = jnp.zeros(())

    def add_part(
        self,
        part: ObservationPart,
        cost: Float[Array, ""],
        diagonal: Sequence[Array],
        gradient: Sequence[Array],
        couplings: Sequence[Array],
        eliminated: Array | None,
        W: Sequence[Array],
    ) -> None:
        """What a part adds: `diagonal` [chunks, w, w] and `gradient` [chunks, w] of each of its
        touches, `couplings` [chunks, w, v]; `eliminated` [places, w, w + 1], the gradient beside
        the block (None without), and `W` [places, w, v] of each of the touches."""
        self.cost = self.cost + cost
        for touch, N, g in zip(part.touches, diagonal, gradient):
            group, columns = touch.group, slice(touch.start, touch.stop)
            # Columns: a table of the group is touched without the others by kinds of its own.
            self.diagonal_blocks[group] = (
                self.diagonal_blocks[group].at[touch.row, columns, columns].add(N)
            )
            self.gradient[group] = self.gradient[group].at[touch.row, columns].add(g)
        for coupling, N in zip(part.couplings, couplings):
            self._add_coupling(part, coupling, N)
        if eliminated is not None:
            # Positions of padding point at the last, empty row.
            rows, e = not_none(part.eliminated).ravel(), not_none(self.plan.eliminated)
            block_and_gradient = jax.ops.segment_sum(
                eliminated, rows, self.diagonal_blocks[e].shape[0]
            )
            self.diagonal_blocks[e] += block_and_gradient[..., :-1]
            self.gradient[e] += block_and_gradient[..., -1]
        for touch, N in zip(part.touches, W):
            self._add_incidences(touch, N)

    def add_local(self, part: ObservationPart, jacobian: LocalJacobian) -> None:
        """What a part with local columns adds (`local.py`)."""
        t, J, columns = jacobian.touch, jacobian.touches[jacobian.touch], jacobian.columns
        touch, width = part.touches[t], self.plan.groups[part.touches[t].group].width
        other_touches = [k for k in range(len(part.touches)) if k != t]
        couplings = [c for c in part.couplings if t not in (c.first, c.second)]
        other_part = dataclasses.replace(
            part,
            touches=tuple(part.touches[k] for k in other_touches),
            couplings=tuple(
                dataclasses.replace(
                    c, first=other_touches.index(c.first), second=other_touches.index(c.second)
                )
                for c in couplings
            ),
        )
        r, E = jacobian.r, jacobian.eliminated
        other_jacobians = tuple(jacobian.touches[k] for k in other_touches)
        self.add_part(
            other_part,
            0.5 * jnp.vdot(r, r),
            *_gauss_newton_products(other_part, r, other_jacobians, E),
        )
        self.diagonal_blocks[touch.group] += products_of(
            self.diagonal_blocks[touch.group], touch.row, J, columns
        )
        g = sum_by_column(jnp.einsum("clri,clr->cli", J, r), columns, width)
        self.gradient[touch.group] = self.gradient[touch.group].at[touch.row].add(g)
        # The touch with local columns, spread to the width of its row, meets the others as usual.
        whole_touch = dataclasses.replace(touch, start=0, stop=width)
        for coupling in part.couplings:
            if t in (coupling.first, coupling.second):
                k = coupling.second if coupling.first == t else coupling.first
                B = sum_by_column(
                    jnp.einsum("clri,clrj->clij", J, jacobian.touches[k]), columns, width
                )
                touches = tuple(
                    whole_touch if i == t else touched for i, touched in enumerate(part.touches)
                )
                self._add_coupling(
                    dataclasses.replace(part, touches=touches),
                    coupling,
                    B if coupling.first == t else B.mT,
                )
        if E is not None:
            self._add_local_incidences(touch, jnp.einsum("clri,clrj->clij", J, E), columns, width)

    def _add_local_incidences(
        self,
        touch: TouchedRows,
        W: Float[Array, "chunks length m e"],
        columns: Int[Array, "chunks length m"],
        width: int,
    ) -> None:
        plan = self.plan.incidences[touch.group]
        n, shape = plan.eliminated.size, W.shape[:2]
        incidence = jnp.arange(n).reshape(shape) if touch.incidence is None else touch.incidence
        # Held elements have a column beyond the width, where `mode="drop"` leaves them out.
        blocks = (
            jnp.zeros((n, width, W.shape[-1])).at[incidence[..., None], columns].add(W, mode="drop")
        )
        self.W[touch.group] = self.W.get(touch.group, 0.0) + blocks.mT.reshape(
            *plan.eliminated.shape, W.shape[-1], width
        )

    def _add_coupling(
        self, part: ObservationPart, coupling: Coupling, N: Float[Array, "chunks w v"]
    ) -> None:
        """An off-diagonal block, or a diagonal one if the two rows are the same."""
        first, second = part.touches[coupling.first], part.touches[coupling.second]
        key = first.group, second.group
        columns, other_columns = slice(first.start, first.stop), slice(second.start, second.stop)
        # The observation touches one row twice (two slots): J = J₁ + J₂ there, and JᵀJ has the two
        # mixed terms.
        if coupling.same is not None:
            diagonal = N * coupling.same[:, None, None]
            block = (
                self.diagonal_blocks[first.group]
                .at[first.row, columns, other_columns]
                .add(diagonal)
            )
            self.diagonal_blocks[first.group] = block.at[first.row, other_columns, columns].add(
                diagonal.mT
            )
        if coupling.block is None:
            return
        shape = tuple(self.plan.groups[g].width for g in key)
        pad = lambda B, rows, columns: jnp.zeros((B.shape[0], *shape)).at[:, rows, columns].set(B)
        placed = pad(N, columns, other_columns)
        # The block list has the later row first; where this chunk has it second, the transpose.
        if coupling.turned is not None:
            turned = coupling.turned[:, None, None]
            placed = turned * pad(N.mT, other_columns, columns) + (1 - turned) * placed
        summed = jax.ops.segment_sum(placed, coupling.block, self.plan.blocks[key].row.shape[0])
        # The last block is no block: padding and meetings of a row with itself end there.
        self.off_diagonal_blocks[key] = self.off_diagonal_blocks.get(key, 0.0) + summed.at[-1].set(
            0.0
        )

    def _add_incidences(self, touch: TouchedRows, W: Float[Array, "places e w"]) -> None:
        """W of every observation, summed for each incidence."""
        plan = self.plan.incidences[touch.group]
        width = self.plan.groups[touch.group].width
        if W.shape[-1] != width:
            W = jnp.zeros((*W.shape[:-1], width)).at[..., touch.start : touch.stop].set(W)
        if touch.incidence is not None:
            W = jax.ops.segment_sum(W, touch.incidence.ravel(), plan.eliminated.size)
        self.W[touch.group] = self.W.get(touch.group, 0.0) + W.reshape(
            *plan.eliminated.shape, *W.shape[1:]
        )

    def total(
        self, declared: Declared, values: Values
    ) -> tuple[Float[Array, ""], Tangent, NormalBlocks]:
        plan, e = self.plan, self.plan.eliminated
        without_eliminated = lambda tree: {name: x for name, x in tree.items() if name != e}
        # Everything that belongs to kept rows is added up over the devices, in one exchange.
        diagonal, off_diagonal, cost, gradient = sum_over_devices(
            plan,
            (
                without_eliminated(self.diagonal_blocks),
                self.off_diagonal_blocks,
                self.cost,
                without_eliminated(self.gradient),
            ),
        )
        eliminated = None
        if e is not None:
            eliminated, gradient[e] = self.diagonal_blocks[e], self.gradient[e]
        D = damping_matrix(
            declared, plan, values, diagonal | ({e: self.diagonal_blocks[e]} if e else {})
        )
        return cost, gradient, NormalBlocks(diagonal, off_diagonal, eliminated, self.W, D)


def transposed_products(
    a: Float[Array, "n r w"], b: Float[Array, "n r v"]
) -> Float[Array, "n w v"]:
    """aᵀb of every row, written out: a batched product of tiny matrices takes three times as
    long."""
    return reduce(jnp.add, (a[:, i, :, None] * b[:, i, None, :] for i in range(a.shape[1])))


def dot(plan: Plan, a: Tangent, b: Tangent) -> Float[Array, ""]:
    """aᵀb, the eliminated rows of all devices."""
    e = plan.eliminated
    # Kept rows are the same on all devices, so they count once.
    sum_of_kept = sum((jnp.vdot(a[g], b[g]) for g in plan.kept), jnp.zeros(()))
    return sum_of_kept if e is None else sum_of_kept + sum_over_devices(plan, jnp.vdot(a[e], b[e]))


def zero_tangent(plan: Plan) -> Tangent:
    """The zero change."""
    return {name: jnp.zeros((g.rows, g.width)) for name, g in plan.groups.items()}
