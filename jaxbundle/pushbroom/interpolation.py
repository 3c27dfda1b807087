"""Tables against time and their interpolation.

Between the rows i and i + 1, with τ = (t − tᵢ)/(tᵢ₊₁ − tᵢ) and Δ = tᵢ₊₁ − tᵢ:

    linear      y = (1 − τ)·yᵢ + τ·yᵢ₊₁
    lagrange    y = Σ Lⱼ(t)·yⱼ,  Lⱼ = Π (t − tₖ)/(tⱼ − tₖ),  the order + 1 rows about t
    usgscsm     the same with as many rows before t as after it, hence fewer near the ends of the
                table: order + 1 at most, 6, 4, 2 in the last intervals (usgscsm, lagrangeInterp)
    hermite     y = h₀₀·yᵢ + h₀₁·yᵢ₊₁ + Δ·(h₁₀·ẏᵢ + h₁₁·ẏᵢ₊₁)      with the rates ẏ of the table
    spline      the same with the rates that make ÿ continuous, not-a-knot at both ends
                (de Boor, 1978, A Practical Guide to Splines, chapter IV)

with h₀₁ = τ²(3 − 2τ), h₀₀ = 1 − h₀₁, h₁₀ = τ(1 − τ)², h₁₁ = −τ²(1 − τ). Times need not be evenly
spaced. In a step longer than `gap`, and outside the table by more than `extrapolate` seconds (none
unless it is given), the value is NaN; splines end there. Within `extrapolate` the first and last
interval continue, which is a straight line for `usgscsm`.

Every one of them is a polynomial of degree 7 at most (`order`, if that is higher) in each interval:
`convert_to_pieces` keeps its values at the nodes of Chebyshev there, from which Lagrange's formula
gives it back. Tables of all methods are then data of one compiled program.
"""

from collections.abc import Callable
from typing import Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax.linalg import tridiagonal_solve
from jaxtyping import Array, Bool, Float, Int

from jaxbundle.types import AnyArray, Scalar, not_none

Method = Literal["linear", "lagrange", "usgscsm", "hermite", "spline"]
METHODS: tuple[str, ...] = get_args(Method)


class TimeTable(eqx.Module):
    """Values against time, differentiable in all of them.

    `times` in seconds; `gap` the longest interpolated step between two rows, in seconds;
    `order` the degree of Lagrange's polynomial, the highest one of `usgscsm`; `extrapolate` the
    seconds beyond its ends that the table still covers. `pieces`, where given, replace `values` and
    `method` (`convert_to_pieces`).
    """

    times: Float[AnyArray, " rows"]
    values: Float[AnyArray, "rows k"]
    rates: Float[AnyArray, "rows k"] | None
    gap: float = eqx.field(static=True, default=np.inf)
    method: Method = eqx.field(static=True, default="lagrange")
    order: int = eqx.field(static=True, default=7)
    extrapolate: float = eqx.field(static=True, default=0.0)
    pieces: Float[AnyArray, "intervals nodes k"] | None = None


def interpolate(table: TimeTable, t: Scalar) -> Float[Array, " k"]:
    """The values at the time t, in seconds; NaN outside the table and in gaps."""
    i = interval(table, t)
    if table.pieces is not None:
        return jnp.where(covers(table, i, t), _evaluate_piece(table, i, t), jnp.nan)
    match table.method:
        case "linear":
            tau = fraction(table, i, t)
            value = (1 - tau) * table.values[i] + tau * table.values[i + 1]
        case "lagrange":
            value = _lagrange(table, i, t)
        case "usgscsm":
            value = _usgscsm(table, i, t)
        case "hermite":
            value = _hermite(table, not_none(table.rates), i, t)
        case "spline":
            value = _hermite(table, spline_rates(table.times, table.values, table.gap), i, t)
        case _:
            raise ValueError(f"Unknown interpolation {table.method!r}; known: {METHODS}")
    return jnp.where(covers(table, i, t), value, jnp.nan)


def convert_to_pieces(table: TimeTable, value: Callable[[Scalar], Float[Array, " k"]]) -> TimeTable:
    """The table with `value(t)`, its interpolation, as polynomials (`pieces`).

    They are exact for the methods of a table; of another smooth function, such as `slerp`, to order
    + 1 powers of an interval.
    """
    nodes = max(table.order, 3) + 1  # 3 is the degree of splines and of Hermite's polynomials
    t = table.times[:-1, None] + jnp.diff(table.times)[:, None] * _chebyshev(nodes)
    pieces = jax.vmap(jax.vmap(value))(t)
    return TimeTable(
        table.times,
        table.values,
        None,
        table.gap,
        "lagrange",
        table.order,
        table.extrapolate,
        pieces,
    )


def rate(table: TimeTable, t: Scalar) -> Float[Array, " k"]:
    """The derivative of the interpolated values by time, per second."""
    return jax.jvp(lambda t: interpolate(table, t), (t,), (jnp.ones_like(t),))[1]


def interval(table: TimeTable, t: Scalar) -> Int[Array, "..."]:
    """The row i with tᵢ ≤ t < tᵢ₊₁; the first or last interval beyond the ends."""
    i = jnp.searchsorted(table.times, t, side="right") - 1
    return jnp.clip(i, 0, len(table.times) - 2)


def fraction(table: TimeTable, i: Int[AnyArray, "..."], t: Scalar) -> Scalar:
    """τ, the elapsed fraction of interval i at t; beyond 0 and 1 outside the table."""
    start, end = table.times[i], table.times[i + 1]
    return (t - start) / (end - start)


def covers(table: TimeTable, i: Int[AnyArray, "..."], t: Scalar) -> Bool[AnyArray, "..."]:
    """Whether the table covers t: between its ends, or near enough to them, and not in a gap."""
    times = table.times
    is_between = (t >= times[0] - table.extrapolate) & (t <= times[-1] + table.extrapolate)
    return is_between & (times[i + 1] - times[i] <= table.gap)


def span(table: TimeTable) -> tuple[float, float]:
    """The first and the last time that the table covers."""
    times = np.asarray(table.times)
    return float(times[0]) - table.extrapolate, float(times[-1]) + table.extrapolate


def breaks(table: TimeTable) -> Float[np.ndarray, " rows"]:
    """The times where one polynomial ends and the next begins."""
    return np.asarray(table.times)


def spline_rates(
    times: Float[AnyArray, " rows"], values: Float[AnyArray, "rows k"], gap: float = np.inf
) -> Float[Array, "rows k"]:
    """The rates at the rows of the cubic spline with not-a-knot conditions at both ends,

        hᵢ·ẏᵢ₋₁ + 2(hᵢ₋₁ + hᵢ)·ẏᵢ + hᵢ₋₁·ẏᵢ₊₁ = 3(hᵢ·sᵢ₋₁ + hᵢ₋₁·sᵢ),    s = Δy/h.

    Splines on both sides of a step longer than `gap` are independent; with three rows it is a
    parabola, with two a straight line.
    """
    step = jnp.diff(times)
    slope = jnp.diff(values, axis=0) / step[:, None]
    # One tridiagonal system for all splines of a table: its shape does not depend on the gaps, so
    # that it can be differentiated and compiled.
    ends = jnp.concatenate([jnp.array([True]), step > gap, jnp.array([True])])
    forward = _end_rows(step, slope, ends[1:])
    # Seen from behind, steps and slopes keep their signs.
    backward = _end_rows(step[::-1], slope[::-1], ends[-2::-1])
    backward = tuple(v[::-1] for v in backward)
    zero, zero_row = jnp.zeros(1), jnp.zeros((1, values.shape[1]))
    previous_step, next_step = jnp.concatenate([zero, step]), jnp.concatenate([step, zero])
    inner = 3 * (
        next_step[:, None] * jnp.concatenate([zero_row, slope])
        + previous_step[:, None] * jnp.concatenate([slope, zero_row])
    )
    is_first, is_last = ends[:-1], ends[1:]
    choose = lambda at_first, at_last, within: jnp.where(
        is_first, at_first, jnp.where(is_last, at_last, within)
    )
    right = jnp.where(
        is_first[:, None], forward[2], jnp.where(is_last[:, None], backward[2], inner)
    )
    return tridiagonal_solve(
        choose(0.0, backward[1], next_step),
        choose(forward[0], backward[0], 2 * (previous_step + next_step)),
        choose(forward[1], 0.0, previous_step),
        right,
    )


def _end_rows(
    step: Float[Array, " intervals"],
    slope: Float[Array, "intervals k"],
    is_last: Bool[Array, " intervals"],
) -> tuple[Array, Array, Array]:
    """Diagonal, coefficient of the next rate and right-hand side of each row as the first one.

    `is_last` tells where a spline ends: not-a-knot needs four rows.
    """
    pad = lambda v, shift: jnp.concatenate([v[shift:], jnp.ones((1 + shift, *v.shape[1:]))])
    h0, h1, s0, s1 = pad(step, 0), pad(step, 1), pad(slope, 0), pad(slope, 1)
    step_sum = h0 + h1
    # Not-a-knot: the third derivative is continuous at the second row, which combined with its own
    # equation leaves h₁·ẏ₀ + (h₀ + h₁)·ẏ₁ = knot (de Boor, 1978, chapter IV).
    knot = (((h0 + 2 * step_sum) * h1)[:, None] * s0 + (h0**2)[:, None] * s1) / step_sum[:, None]
    parabola = s0 - (h0 / step_sum)[:, None] * (s1 - s0)
    ending = lambda shift: jnp.concatenate([is_last[shift:], jnp.ones(shift, bool)])
    has_two_rows, has_three_rows = ending(1), ending(2)
    is_short = is_last | has_two_rows | has_three_rows
    right = jnp.where(
        is_last[:, None],
        0.0,
        jnp.where(has_two_rows[:, None], s0, jnp.where(has_three_rows[:, None], parabola, knot)),
    )
    return jnp.where(is_short, 1.0, h1), jnp.where(is_short, 0.0, step_sum), right


def _chebyshev(nodes: int) -> np.ndarray:
    """Places between 0 and 1."""
    return (1 - np.cos(np.pi * (np.arange(nodes) + 0.5) / nodes)) / 2


def _evaluate_piece(table: TimeTable, i: Int[AnyArray, ""], t: Scalar) -> Float[Array, " k"]:
    """Lagrange's formula through the nodes of Chebyshev, which are the same in every interval."""
    pieces = not_none(table.pieces)
    nodes = _chebyshev(pieces.shape[1])
    identity = np.eye(len(nodes), dtype=bool)
    spans = nodes[:, None] - nodes + identity
    tau = fraction(table, i, t)
    return jnp.prod(jnp.where(identity, 1.0, (tau - nodes) / spans), axis=1) @ pieces[i]


def _lagrange(table: TimeTable, i: Int[AnyArray, ""], t: Scalar) -> Float[Array, " k"]:
    """Lagrange's formula through order + 1 rows: half of them before t, except at the ends."""
    rows = table.order + 1
    first_row = jnp.clip(i + 1 - rows // 2, 0, len(table.times) - rows)
    times = jax.lax.dynamic_slice_in_dim(table.times, first_row, rows)
    values = jax.lax.dynamic_slice_in_dim(table.values, first_row, rows)
    identity = jnp.eye(rows, dtype=bool)
    spans = times[:, None] - times + identity
    return jnp.prod(jnp.where(identity, 1.0, (t - times) / spans), axis=1) @ values


def _usgscsm(table: TimeTable, i: Int[AnyArray, ""], t: Scalar) -> Float[Array, " k"]:
    """Lagrange's formula through 2·`half_count` rows, with weights 0 for the rest of a fixed
    number."""
    max_half = (table.order + 1) // 2
    half_count = jnp.minimum(jnp.minimum(i + 1, len(table.times) - 1 - i), max_half)
    offset = jnp.arange(-max_half, max_half) + 1
    is_used = (offset > -half_count) & (offset <= half_count)
    row = jnp.clip(i + offset, 0, len(table.times) - 1)
    times, values = table.times[row], table.values[row]
    factor = ~jnp.eye(2 * max_half, dtype=bool) & is_used & is_used[:, None]
    spans = jnp.where(factor, times[:, None] - times, 1.0)
    weights = jnp.prod(jnp.where(factor, (t - times) / spans, 1.0), axis=1)
    return jnp.where(is_used, weights, 0.0) @ values


def _hermite(
    table: TimeTable, rates: Float[AnyArray, "rows k"], i: Int[AnyArray, ""], t: Scalar
) -> Float[AnyArray, " k"]:
    """The cubic polynomial with the values and these rates at both ends of interval i."""
    tau, step = fraction(table, i, t), table.times[i + 1] - table.times[i]
    h01 = tau**2 * (3 - 2 * tau)
    h10, h11 = tau * (1 - tau) ** 2, -(tau**2) * (1 - tau)
    line = (1 - h01) * table.values[i] + h01 * table.values[i + 1]
    return line + step * (h10 * rates[i] + h11 * rates[i + 1])
