"""The derivatives of the observations, in blocks, by automatic differentiation.

Each observation touches few rows, so its derivatives are a few small blocks. They come from one
pure function of one observation (`rows.residual_of`): in reverse mode over its scalars for many
observations (plain loops; measured 5 to 7 ms for 83 718 image points, 29 in forward mode), in
forward mode along all directions at once for few (a tenth of the loops to compile).
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxbundle.leastsquares.indexing.plan import ObservationPart, Plan, Slots, TouchedRows
from jaxbundle.leastsquares.indexing.rows import (
    ChunkedData,
    Declared,
    Prepared,
    Residual,
    Weight,
    diagonal_of,
    map_blocks,
    map_observations,
    residual_of,
)
from jaxbundle.leastsquares.spaces import Block, Change
from jaxbundle.types import Scalar, not_none


def widths_of(declared: Declared, part: ObservationPart) -> tuple[int, ...]:
    """The number of directions of every slot of a part, 0 if it is not differentiated."""
    of = declared.kinds[part.set_name].of
    differentiated_slots = {s for touch in part.touches for s, _ in touch.slots} | {part.slot}
    return tuple(
        declared.spaces[name].width if s in differentiated_slots else 0 for s, name in enumerate(of)
    )


def columns_of(
    widths: Sequence[int], slots: Slots, start: int, stop: int
) -> list[tuple[int, int] | None]:
    """The columns of a touch: slot and direction, None if unused."""
    slot_of_column = {first + j: (slot, j) for slot, first in slots for j in range(widths[slot])}
    return [slot_of_column.get(c) for c in range(start, stop)]


def differentiate(
    declared: Declared, plan: Plan, number: int, prepared: Prepared, chunked: ChunkedData
) -> tuple[Array, tuple[Array, ...], Array | None]:
    """Residuals [chunks, length, r] of a part, the blocks of its touches, [chunks, length, r, w]
    each, and of its eliminated rows (None if there are none). Columns of held unknowns are zero."""
    part = plan.parts[number]
    kind, widths = declared.kinds[part.set_name], widths_of(declared, part)
    rows = _ResidualsAndDerivatives(residual_of(declared, part), widths, part.large)
    r, by_slot = map_observations(part, kind, prepared, chunked, number, rows)
    # Of few observations: computed once, not again in every loop that uses some of its columns.
    r, by_slot = (r, by_slot) if part.large else jax.lax.optimization_barrier((r, by_slot))
    shape, starts = r[0].shape, np.cumsum((0, *widths))

    def block(slots: Slots, start: int, stop: int) -> Float[Array, "chunks length r w"]:
        columns = columns_of(widths, slots, start, stop)
        # The index behind the last column stands for a column of zeros.
        positions = [starts[at[0]] + at[1] if at else starts[-1] for at in columns]
        if part.large:
            # Columns that no slot of this part has, as those of another table of the group.
            nil = jnp.zeros(shape)
            parts = [[*derivatives, nil][c] for derivatives in by_slot for c in positions]
            return jnp.stack(parts, -1).reshape(*shape, len(r), stop - start)
        return jnp.take(by_slot, np.array(positions, int), -1, mode="fill", fill_value=0.0)

    touches = []
    for touch in part.touches:
        touches.append(zero_held_columns(plan, touch, block(touch.slots, touch.start, touch.stop)))
    E = None
    if plan.eliminated is not None and part.slot is not None:
        E = block(((part.slot, 0),), 0, widths[part.slot])
        E = zero_held_columns_of_eliminated(plan, part, E)
    return jnp.stack(r, -1), tuple(touches), E


def zero_held_columns(
    plan: Plan, touch: TouchedRows, J: Float[Array, "chunks length r w"]
) -> Float[Array, "chunks length r w"]:
    """The block of a touch with zeros in the columns of held unknowns."""
    group = plan.groups[touch.group]
    if group.all_free:
        return J
    return J * group.free[touch.row, touch.start : touch.stop][:, None, None, :]


def zero_held_columns_of_eliminated(
    plan: Plan, part: ObservationPart, E: Float[Array, "chunks length r w"]
) -> Float[Array, "chunks length r w"]:
    """The block of the eliminated rows of a part with zeros in the columns of held unknowns."""
    group = plan.groups[not_none(plan.eliminated)]
    return E if group.all_free else E * group.free[part.eliminated][:, :, None, :]


def differentiate_rows(
    function: Callable,
    widths: tuple[int, ...],
    part: ObservationPart,
    blocks: tuple[Block, ...],
    measured: PyTree,
    weight: PyTree,
) -> tuple[Array, list[Array]]:
    """Residuals [chunks, length, r] of `function(blocks, measured, weight, changes)` of every
    observation, and their derivatives with respect to the changes of every slot [chunks, length, r,
    width]."""
    rows = _ResidualsAndDerivatives(function, widths, True)
    r, derivatives = map_blocks(rows, part.by_row, blocks, measured, weight)
    starts = np.cumsum((0, *widths))
    empty = jnp.zeros((*r[0].shape, 0))
    # A held slot has no derivatives: a block without columns.
    columns_of_slot = lambda row, a, b: jnp.stack(row[a:b], -1) if b > a else empty
    slots = [
        jnp.stack([columns_of_slot(row, a, b) for row in derivatives], -2)
        for a, b in zip(starts, starts[1:])
    ]
    return jnp.stack(r, -1), slots


def differentiate_chunks(
    declared: Declared,
    plan: Plan,
    number: int,
    prepared: Prepared,
    chunked: ChunkedData,
    of_chunk: Callable,
    at_once: int = 1 << 16,
) -> Any:
    """`of_chunk(part, r, touches, E)` of every chunk of a part, [length, …] each, some chunks at a
    time, so that derivatives of all of it (2 000 000 rows) are never in memory at once. Every touch
    has an `incidence` here, also where the observations are the incidences.

    `at_once`: observations differentiated together. With 65 536 the statistics of 1000 images (2
    million observations) take 3.4 GB, with all of them 5.2; half would save little more."""
    part = plan.parts[number]
    chunks, length = part.source.shape
    in_order = jnp.arange(chunks * length).reshape(chunks, length)
    with_incidence = lambda t: (
        t if t.incidence is not None else dataclasses.replace(t, incidence=in_order)
    )
    touches = tuple(map(with_incidence, part.touches))
    # `place` runs along the set, not along chunks, and could not be cut into these; nothing here
    # reads it.
    part = dataclasses.replace(part, touches=touches, place=in_order)

    def differentiate_one(mapped: tuple) -> Any:
        part, measured, weight = jax.tree.map(lambda x: x[None], mapped)
        one_part = dataclasses.replace(plan, parts=(part,))
        differentiated = differentiate(
            declared, one_part, 0, prepared, ChunkedData((measured,), (weight,))
        )
        return of_chunk(mapped[0], *jax.tree.map(lambda x: x[0], differentiated))

    mapped = part, chunked.measured[number], chunked.weight[number]
    batch = max(at_once // max(length, 1), 1)
    # One chunk at a time would be a loop of tiny operations; all at once 1 kB an observation.
    if chunks > batch:
        return jax.lax.map(differentiate_one, mapped, batch_size=batch)
    return jax.vmap(differentiate_one)(mapped)


@dataclasses.dataclass(frozen=True)
class _ResidualsAndDerivatives:
    """The residuals of one observation and their derivatives with respect to the changes of its
    slots."""

    residual: Callable
    widths: tuple[int, ...]
    large: bool

    def __call__(self, *row: Any) -> tuple:
        return (_reverse if self.large else _forward)(self.residual, self.widths, row)


def _reverse(
    residual: Callable, widths: tuple[int, ...], row: tuple
) -> tuple[Change, list[list[Scalar]]]:
    """Residuals and the derivatives of each: tuples of scalars."""
    # Scalars throughout: for as many residuals as an image point has, two passes of plain loops
    # over all observations, which XLA fuses. Forward mode would need one pass per direction: 12 for
    # a pose, a camera and a point (29 ms instead of 5 to 7 on BAL 16).
    weight = row[2]
    nil = jnp.zeros_like(jax.tree.leaves(weight)[0])
    zero_change = tuple((nil,) * w for w in widths)
    r, pull = jax.vjp(lambda d: residual(*row, d), zero_change)
    unit = lambda i: tuple(jnp.ones_like(nil) if a == i else nil for a in range(len(r)))
    columns = lambda i: [x for slot in pull(unit(i))[0] for x in slot]
    return r, [_where_weighted(weight, i, columns(i)) for i in range(len(r))]


def _forward(
    residual: Callable, widths: tuple[int, ...], row: tuple
) -> tuple[Change, Float[Array, "r directions"]]:
    """Residuals, a tuple of scalars, and their derivatives [r, directions]."""
    blocks, measured, weight = row
    ends = np.cumsum((0, *widths))
    by_slot = lambda x: tuple(tuple(x[a:b]) for a, b in zip(ends, ends[1:]))

    if isinstance(residual, Residual) and residual.is_wide(weight):
        parts = lambda x: [x[a:b] for a, b in zip(ends, ends[1:])]
        residual_of_change = lambda x: residual.array(blocks, measured, weight, parts(x))
        w, nothing = jnp.stack(weight), jnp.zeros(ends[-1])
        return tuple(residual_of_change(nothing)), jnp.where(
            w[:, None] > 0, jax.jacfwd(residual_of_change)(nothing), 0.0
        )

    def stacked(x: Float[Array, " directions"]) -> tuple[Float[Array, " r"], Change]:
        r = residual(blocks, measured, weight, by_slot(x))
        return jnp.stack(r), r

    J, r = jax.jacfwd(stacked, has_aux=True)(jnp.zeros(ends[-1]))
    return r, jnp.stack([_where_weighted(weight, i, J[i]) for i in range(len(r))])


def _where_weighted(weight: Weight, i: int, columns: PyTree[Array]) -> Any:
    """Zero for an observation without weight, even if its derivative is not finite."""
    # `where`, not a product with 0: the derivative of an unused observation may be infinite, as
    # that of a distance between two equal points, and 0·∞ is NaN.
    w = diagonal_of(weight)[i]
    return jax.tree.map(lambda x: jnp.where(w > 0, x, 0.0), columns)
