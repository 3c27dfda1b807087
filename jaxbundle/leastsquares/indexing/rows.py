"""From tables and measurements to the columns of the observation equations.

values (tables)  ──prepare, once a row──▶  columns  ──look up──▶  blocks of every observation

Everything is a structure of arrays: one array for each scalar of a block.
"""

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from jaxbundle.leastsquares.declarations import Kind, Motions
from jaxbundle.leastsquares.indexing.plan import ObservationPart, Plan
from jaxbundle.leastsquares.spaces import Block, Change, Space, Vector
from jaxbundle.system.devices import on_accelerator
from jaxbundle.types import AnyArray, Scalar

# Kinds of arrays with more residuals per observation, as the priors of a spline camera have, are
# differentiated as arrays. Scalar by scalar XLA compiles them for minutes: the program grows with
# residuals × columns, 64² statements at this limit. Half and double make no difference: kinds of
# the package have a few residuals, or hundreds.
SCALAR_RESIDUALS_UP_TO = 64

# Of one observation: 1/σ of every residual, or the rows of L⁻¹ as tuples.
Weight = tuple[Any, ...]

# By table, the prepared blocks of its rows, one array for each scalar.
Prepared = dict[str, PyTree[Float[Array, " rows"]]]

Values = dict[str, PyTree[Float[AnyArray, "rows ..."]]]
"""The rows of every table."""


class Data(eqx.Module):
    """The data of a problem, all differentiable.

    `start`: the start values of the tables, including held values; `measured` and `weight` of every
    set of observations (see `ObservationSet`), by its name. `weight` is 1/σ, the root of the
    textbook's weight p = 1/σ²; of correlated observations W with P = WᵀW. A residual of weight 0
    does not count.
    """

    start: Values
    measured: dict[str, PyTree[Float[Array, "n ..."]]]
    weight: dict[str, Float[AnyArray, "n ..."]]


class ChunkedData(eqx.Module):
    """Measurements and weights of every part in the order of computation, scalar by scalar."""

    measured: tuple[PyTree[Float[Array, "chunks length"]], ...]
    weight: tuple[PyTree[Float[Array, "chunks length"]], ...]


@dataclasses.dataclass(frozen=True)
class Declared:
    """The functions of a problem: the kinds of its sets of observations, the spaces of its tables,
    the motions that may be open. Hashable: a static argument of compiled programs."""

    named_kinds: tuple[tuple[str, Kind], ...]
    named_spaces: tuple[tuple[str, Space], ...]
    motions: Motions | None = None

    @property
    def kinds(self) -> dict[str, Kind]:
        return dict(self.named_kinds)

    @property
    def spaces(self) -> dict[str, Space]:
        return dict(self.named_spaces)


def lay_out_data(plan: Plan, data: Data) -> ChunkedData:
    """The measurements, looked up once per solution."""
    rows_of_part = lambda rows, part: look_up(scalars(rows), part.source)
    return ChunkedData(
        tuple(rows_of_part(data.measured[part.set_name], part) for part in plan.parts),
        tuple(rows_of_part(data.weight[part.set_name], part) for part in plan.parts),
    )


class Elements(tuple):
    """The elements of an array as scalars; other tuples are those of the declaration."""


jax.tree_util.register_pytree_node(Elements, lambda x: (tuple(x), None), lambda _, x: Elements(x))


def scalars(rows: PyTree[Float[Array, "n ..."]]) -> PyTree[Float[Array, " n"]]:
    """The elements of every row: numbers as they are, vectors as tuples, matrices as tuples of
    tuples."""

    def split_elements(x: Float[Array, "n ..."]) -> Any:
        return x if x.ndim == 1 else Elements(split_elements(x[:, i]) for i in range(x.shape[1]))

    return jax.tree.map(split_elements, rows)


def prepare(declared: Declared, values: Values) -> Prepared:
    """The prepared block of every row of every table."""
    return {name: jax.vmap(declared.spaces[name].prepare)(rows) for name, rows in values.items()}


@dataclasses.dataclass(frozen=True)
class Residual:
    """`(blocks, measured, weight) -> residuals / σ`, tuples of scalars, of one observation of a
    kind; `changes` has one tuple for each slot, empty where the table is held."""

    kind: Kind
    spaces: tuple[Space, ...]

    def __call__(
        self,
        blocks: Sequence[Block],
        measured: PyTree[Scalar],
        weight: Weight,
        changes: Sequence[Change] | None = None,
    ) -> Change:
        changes = ((),) * len(self.spaces) if changes is None else changes
        # Derivatives are taken at zero changes; the changed block is the one place where the chart
        # of a space enters the residual.
        moved_blocks = [s.move(b, d) for s, b, d in zip(self.spaces, blocks, changes)]
        return whiten(evaluate(self.kind, moved_blocks, measured), weight)

    def array(
        self,
        blocks: Sequence[Block],
        measured: PyTree[Scalar],
        weight: Change,
        changes: Sequence[Float[Array, " width"]],
    ) -> Float[Array, " r"]:
        """Residuals / σ as an array, of changes [width] of every slot: for kinds of arrays with
        many residuals (`SCALAR_RESIDUALS_UP_TO`)."""
        moved_blocks = []
        for space, block, change in zip(self.spaces, blocks, changes, strict=True):
            if isinstance(space, Vector) and space.size:
                block = _stack(block)
                if change.shape[0]:
                    columns, direction = (jnp.array(x, int) for x in space.moves)
                    block = block.at[columns].add(change[direction])
            else:
                block = _stack(space.move(block, tuple(change)))
            moved_blocks.append(block)
        stacked = jax.tree.map(_stack, measured, is_leaf=lambda x: type(x) is Elements)
        value, w = self.kind.residual(*moved_blocks, stacked), jnp.stack(weight)
        v = jnp.stack(value) if isinstance(value, tuple) else jnp.atleast_1d(value)
        return jnp.where(w > 0, w * v, 0.0)

    def is_wide(self, weight: Weight) -> bool:
        """Whether to use `array`: the kind works on arrays and has many residuals, with a weight
        each."""
        many = len(weight) > SCALAR_RESIDUALS_UP_TO
        return not self.kind.scalars and many and not isinstance(weight[0], tuple)


def residual_of(declared: Declared, part: ObservationPart) -> Residual:
    """The residuals of one observation of a part."""
    kind = declared.kinds[part.set_name]
    return Residual(kind, tuple(declared.spaces[name] for name in kind.of))


def evaluate(kind: Kind, blocks: Iterable[Block], measured: PyTree[Scalar]) -> Change:
    """The residuals of one observation as a tuple of scalars."""
    if not kind.scalars:
        blocks = (_stack(b) for b in blocks)
        measured = jax.tree.map(_stack, measured, is_leaf=lambda x: type(x) is Elements)
    value = kind.residual(*blocks, measured)
    if isinstance(value, tuple):
        return value
    return (value,) if jnp.ndim(value) == 0 else tuple(value)


def _stack(block: Block) -> Any:
    """Tuples of scalars as arrays; other blocks as they are."""
    if type(block) in (tuple, Elements) and block:
        return jnp.stack([_stack(x) for x in block])
    return block


def whiten(v: Change, weight: Weight) -> Change:
    """L⁻¹·v, or v/σ; 0 if the weight is 0, whatever v is."""
    if isinstance(weight[0], tuple):
        has_weight = [row[i] > 0 for i, row in enumerate(weight)]
        v = tuple(jnp.where(u, x, 0.0) for u, x in zip(has_weight, v))
        # L⁻¹ is lower triangular.
        rows = [sum(w * x for w, x in zip(row[: i + 1], v)) for i, row in enumerate(weight)]
        return tuple(jnp.where(u, r, 0.0) for u, r in zip(has_weight, rows))
    return tuple(jnp.where(w > 0, w * x, 0.0) for w, x in zip(weight, v))


def diagonal_of(weight: Weight | Float[AnyArray, "n r *r"]) -> Any:
    """The weight of every residual, 0 if it does not count: of observations [n, r] or [n, r, r], or
    of one as scalars."""
    if isinstance(weight, tuple):
        return tuple(w[i] if isinstance(w, tuple) else w for i, w in enumerate(weight))
    return weight if weight.ndim == 2 else weight.diagonal(axis1=1, axis2=2)


def fill_places(plan: Plan, chunked: ChunkedData) -> tuple[Plan, ChunkedData]:
    """Positions without weight use the rows of one with weight: an undefined value, such as the
    distance of a point from itself, would be NaN in reverse mode in spite of its zero weight."""
    parts, measured = [], []
    for part, values, weight in zip(plan.parts, chunked.measured, chunked.weight):
        shape = part.source.shape
        live = jnp.stack([w > 0 for w in diagonal_of(weight)]).any(0)
        # If the weights are constants of a program, XLA would search for the first one while it
        # compiles: 4 of 11 s of compiling the gradient of 100 000 observations.
        live = jax.lax.optimization_barrier(live)
        # `argmax`: the first position with weight, or 0.
        place = jnp.where(live, jnp.arange(live.size).reshape(shape), jnp.argmax(live))
        in_chunks = lambda at, shape=shape: jnp.broadcast_to(
            at if at.ndim == 2 else at[:, None], shape
        )
        pick = lambda x, place=place: x.ravel()[place]
        lookup, by_row = (
            tuple(pick(in_chunks(at)) for at in part.lookup),
            (True,) * len(part.lookup),
        )
        parts.append(dataclasses.replace(part, lookup=lookup, by_row=by_row))
        measured.append(jax.tree.map(pick, values))
    return dataclasses.replace(plan, parts=tuple(parts)), ChunkedData(
        tuple(measured), chunked.weight
    )


def map_observations(
    part: ObservationPart,
    kind: Kind,
    prepared: Prepared,
    chunked: ChunkedData,
    number: int,
    function: Callable,
) -> Any:
    """`function(blocks, measured, weight)` of every observation of a part; its scalars get the
    axes [chunks, length]. Functions that are equal are traced once for columns of one size."""
    look = _look_up_in_copies if on_accelerator() else look_up
    blocks = tuple(look(prepared[name], at) for name, at in zip(kind.of, part.lookup))
    return map_blocks(
        function, part.by_row, blocks, chunked.measured[number], chunked.weight[number]
    )


@partial(jax.jit, static_argnums=(0, 1), inline=True)
def map_blocks(
    function: Callable,
    by_row: tuple[bool, ...],
    blocks: tuple[Block, ...],
    measured: PyTree[Float[Array, "chunks length"]],
    weight: PyTree[Float[Array, "chunks length"]],
) -> Any:
    """`map_observations` of blocks that are looked up."""
    # Outer axis: chunks; inner: observations of a chunk, over which a row looked up by chunk is
    # constant. Traced once for all parts of equal kinds and shapes.
    axes = tuple(0 if is_by_row else None for is_by_row in by_row)
    return jax.vmap(jax.vmap(function, (axes, 0, 0)))(blocks, measured, weight)


def look_up(
    columns: PyTree[Float[Array, " rows"]], index: Int[Array, "..."]
) -> PyTree[Float[Array, "..."]]:
    """The elements of every column at these (non-negative) indices of a plan."""
    # Indices of a plan are in bounds by construction. Without the promise XLA compares and clamps
    # each, and negative ones are counted from the end.
    promise = {"mode": "promise_in_bounds", "wrap_negative_indices": False}
    return jax.tree.map(lambda column: column.at[index].get(**promise), columns)


def _look_up_in_copies(
    columns: PyTree[Float[Array, " rows"]], index: Int[Array, "..."]
) -> PyTree[Float[Array, "..."]]:
    """`look_up` for an accelerator: each observation of a chunk in a copy of its own, if the copies
    of a column are not more numbers than the observations.

    In reverse mode a look-up is a sum over all observations of a row, whose additions wait for
    each other: the gradient of 100 000 observations of 120 images took 68 ms on an H200, 49 of them
    in these sums, and takes 18 in all with copies (benchmarks/gpu.py, "gradient"). A processor adds
    one by one anyway."""

    def look(column: Float[Array, " rows"]) -> Float[Array, "..."]:
        if index.ndim == 1 or column.size * index.shape[1] > index.size:
            return look_up(column, index)
        copies = jnp.broadcast_to(column[:, None], (column.size, index.shape[1])).ravel()
        return look_up(
            copies, index * index.shape[1] + jnp.arange(index.shape[1], dtype=index.dtype)
        )

    return jax.tree.map(look, columns)


def residuals(
    declared: Declared, plan: Plan, values: Values, chunked: ChunkedData
) -> tuple[Float[Array, "chunks length r"], ...]:
    """Residuals divided by σ of every part, [chunks, length, r]."""
    prepared, by_part = prepare(declared, values), []
    for number, part in enumerate(plan.parts):
        kind = declared.kinds[part.set_name]
        rows = map_observations(part, kind, prepared, chunked, number, residual_of(declared, part))
        by_part.append(jnp.stack(rows, -1))
    return tuple(by_part)


def restore_order(
    plan: Plan, parts: Iterable[Float[Array, "chunks length ..."]]
) -> dict[str, Float[Array, "n ..."]]:
    """Quantities by observation of every part, by the name of its set, rows in the given
    order."""
    by_set: dict[str, Float[Array, "n ..."]] = {}
    for part, rows in zip(plan.parts, parts):
        # Observations of other parts of the set have the empty position, whose value is 0.
        flat = rows.reshape(-1, *rows.shape[2:])[part.place]
        sum_of_parts = by_set.get(part.set_name)
        by_set[part.set_name] = flat if sum_of_parts is None else sum_of_parts + flat
    return by_set
