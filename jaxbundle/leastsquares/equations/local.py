"""Observations that depend on few of many columns of a row: an image point sees sixteen of the
hundreds of knots of a spline camera.

A kind that declares this (`Kind.local`) names, for one observation, the columns its residuals
depend on at the current values, and has its residual as a function of the values in these
columns. J then has their derivatives alone, and products are added to N where they belong:

    N[cᵢ, cⱼ] += JᵢᵀJⱼ,    g[cᵢ] += Jᵢᵀr        c the columns of the observation

in place of products of rows that are zero nearly everywhere. Which columns they are may change from
iteration to iteration; they are not part of the plan.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from jaxbundle.leastsquares.declarations import Kind
from jaxbundle.leastsquares.equations.linearise import (
    columns_of,
    differentiate_rows,
    widths_of,
    zero_held_columns,
    zero_held_columns_of_eliminated,
)
from jaxbundle.leastsquares.indexing.plan import ObservationPart, Plan
from jaxbundle.leastsquares.indexing.rows import (
    ChunkedData,
    Declared,
    Prepared,
    Weight,
    look_up,
    map_blocks,
    whiten,
)
from jaxbundle.leastsquares.spaces import Block, Change, Space, Vector
from jaxbundle.types import Scalar


@dataclasses.dataclass(frozen=True)
class LocalJacobian:
    """Of a part with local columns: residuals [chunks, length, r]; J of its touches and of its
    eliminated row, that of touch number `touch` with as many columns as are local; `columns`, where
    these are in the touched group (beyond its width: held)."""

    r: Float[Array, "chunks length r"]
    touches: tuple[Float[Array, "chunks length r _"], ...]
    eliminated: Float[Array, "chunks length r e"] | None
    touch: int
    columns: Int[Array, "chunks length m"]


def local_touch(declared: Declared, part: ObservationPart) -> int | None:
    """The touch of a part that uses few of many columns; None if there is none."""
    kind = declared.kinds[part.set_name]
    if kind.local is None or not part.large:
        return None
    space = declared.spaces[kind.of[kind.local.slot]]
    if not isinstance(space, Vector) or space.tied or space.width < 2 * kind.local.number:
        return None
    # Only a touch of this slot alone: beside other tables of its group the columns would not be
    # those of the vector.
    is_local = [[s for s, _ in touch.slots] == [kind.local.slot] for touch in part.touches]
    return is_local.index(True) if any(is_local) else None


def differentiate_locally(
    declared: Declared,
    plan: Plan,
    number: int,
    touch: int,
    prepared: Prepared,
    chunked: ChunkedData,
) -> LocalJacobian:
    """As `differentiate`, for a part that has such a touch."""
    part = plan.parts[number]
    kind, local = declared.kinds[part.set_name], declared.kinds[part.set_name].local
    assert local is not None
    blocks = tuple(look_up(prepared[name], rows) for name, rows in zip(kind.of, part.lookup))
    measured, weight = chunked.measured[number], chunked.weight[number]
    columns_used = map_blocks(_Columns(kind), part.by_row, blocks, measured, weight)
    table, row = jnp.stack(prepared[kind.of[local.slot]], -1), part.lookup[local.slot]
    values = tuple(table[row if row.ndim == 2 else row[:, None], column] for column in columns_used)
    spaces = tuple(declared.spaces[name] for name in kind.of)
    widths = list(widths_of(declared, part))
    widths[local.slot] = local.number
    residual = _LocalResidual(kind, spaces)
    r, derivatives = differentiate_rows(
        residual, tuple(widths), part, blocks, (measured, columns_used, values), weight
    )
    group = plan.groups[part.touches[touch].group]
    # From elements of the vector to columns of the group; held elements to a column beyond its
    # width, where `mode="drop"` leaves them out.
    column_of = jnp.full(len(prepared[kind.of[local.slot]]), group.width)
    space = spaces[local.slot]
    assert isinstance(space, Vector)
    moving = jnp.array(space.moving, int)
    column_of = column_of.at[moving].set(part.touches[touch].start + jnp.arange(len(space.moving)))
    columns = column_of[jnp.stack(columns_used, -1)]
    free = group.free[part.touches[touch].row][:, None]
    jacobians = []
    for t, touched in enumerate(part.touches):
        if t == touch:
            J = derivatives[local.slot]
            mask = jnp.take_along_axis(
                jnp.broadcast_to(free, (*columns.shape[:2], group.width)),
                columns,
                -1,
                mode="fill",
                fill_value=0.0,
            )
            J = J * mask[:, :, None, :]
        else:
            # In the order of the group's columns, not of the slots.
            places = columns_of(widths, touched.slots, touched.start, touched.stop)
            nil = jnp.zeros(r.shape)
            J = jnp.stack([derivatives[p[0]][..., p[1]] if p else nil for p in places], -1)
            J = zero_held_columns(plan, touched, J)
        jacobians.append(J)
    E = None
    if plan.eliminated is not None and part.slot is not None:
        E = zero_held_columns_of_eliminated(plan, part, derivatives[part.slot])
    return LocalJacobian(r, tuple(jacobians), E, touch, columns)


@dataclasses.dataclass(frozen=True)
class _Columns:
    """The columns of one observation."""

    kind: Kind

    def __call__(
        self, blocks: tuple[Block, ...], measured: PyTree[Scalar], _weight: Weight
    ) -> tuple:
        assert self.kind.local is not None  # the weight is passed to all functions of observations
        return self.kind.local.columns(*blocks, measured)


@dataclasses.dataclass(frozen=True)
class _LocalResidual:
    """`rows.Residual` as a function of the values in the local columns."""

    kind: Kind
    spaces: tuple[Space, ...]

    def __call__(
        self,
        blocks: tuple[Block, ...],
        local_measured: tuple,
        weight: Weight,
        changes: Sequence[Change],
    ) -> Change:
        local, (measured, columns, values) = self.kind.local, local_measured
        assert local is not None
        values = tuple(v + d for v, d in zip(values, changes[local.slot], strict=True))
        moved_blocks: list[Any] = [
            block if slot == local.slot else space.move(block, change)
            for slot, (space, block, change) in enumerate(zip(self.spaces, blocks, changes))
        ]
        return whiten(local.residual(*moved_blocks, columns, values, measured), weight)


def products_of(
    like: Float[Array, "rows w w"],
    row: Int[Array, " chunks"],
    J: Float[Array, "chunks length r m"],
    columns: Int[Array, "chunks length m"],
) -> Float[Array, "rows w w"]:
    """The products of every observation, added up chunk by chunk in the shape of N."""

    def add(
        N: Float[Array, "rows w w"], chunk: tuple[Array, Array, Array]
    ) -> tuple[Float[Array, "rows w w"], None]:
        row, J, columns = chunk
        products = jnp.einsum("kri,krj->kij", J, J)
        return N.at[row, columns[:, :, None], columns[:, None, :]].add(products, mode="drop"), None

    # A loop over chunks, not one scatter: products of all observations would be m² numbers each,
    # 32² instead of 2 · 32 (16 knots of two numbers).
    return jax.lax.scan(add, jnp.zeros(like.shape), (row, J, columns))[0]


def sum_by_column(
    rows: Float[Array, "chunks length m *v"], columns: Int[Array, "chunks length m"], width: int
) -> Float[Array, "chunks width *v"]:
    """Rows that belong to columns, summed over the observations of a chunk: [chunks, width, v]."""
    zero = jnp.zeros((rows.shape[0], width, *rows.shape[3:]))
    # Two observations of a chunk may share columns: they add up.
    chunk = jnp.arange(rows.shape[0])[:, None, None]
    return zero.at[chunk, columns].add(rows, mode="drop")
