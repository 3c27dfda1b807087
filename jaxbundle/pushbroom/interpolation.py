"""A table against time and what stands between its rows.

Between the rows i and i + 1, with τ = (t − tᵢ)/(tᵢ₊₁ − tᵢ) and Δ = tᵢ₊₁ − tᵢ:

    linear      y = (1 − τ)·yᵢ + τ·yᵢ₊₁
    lagrange    y = Σ Lⱼ(t)·yⱼ,  Lⱼ = Π (t − tₖ)/(tⱼ − tₖ),  the order + 1 rows about t
    hermite     y = h₀₀·yᵢ + h₀₁·yᵢ₊₁ + Δ·(h₁₀·ẏᵢ + h₁₁·ẏᵢ₊₁)      with the rates ẏ of the table
    spline      the same with the rates that make ÿ continuous, not-a-knot at both ends
                (de Boor, 1978, A Practical Guide to Splines, chapter IV)

with h₀₁ = τ²(3 − 2τ), h₀₀ = 1 − h₀₁, h₁₀ = τ(1 − τ)², h₁₁ = −τ²(1 − τ). Times need not be evenly
spaced. Nothing is extrapolated: outside the table, and in a step longer than `gap`, the value is
NaN.
"""

from typing import Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax.linalg import tridiagonal_solve
from jaxtyping import Array, Float, Int

Method = Literal["linear", "lagrange", "hermite", "spline"]
METHODS: tuple[str, ...] = get_args(Method)


class Table(eqx.Module):
    """Values against time, differentiable in all of them.

    `times` in seconds; `gap` the longest step between two rows that is interpolated, in seconds;
    `order` the degree of Lagrange's polynomial.
    """

    times: Float[Array, " rows"]
    values: Float[Array, "rows k"]
    rates: Float[Array, "rows k"] | None
    gap: float = eqx.field(static=True, default=np.inf)
    method: Method = eqx.field(static=True, default="lagrange")
    order: int = eqx.field(static=True, default=7)


def interpolate(table: Table, t: Float[Array, ""]) -> Float[Array, " k"]:
    """The values at the time t, in seconds; NaN where the table says nothing."""
    i = interval(table, t)
    match table.method:
        case "linear":
            value = _linear(table, i, t)
        case "lagrange":
            value = _lagrange(table, i, t)
        case "hermite":
            value = _hermite(table, table.rates, i, t)
        case "spline":
            value = _hermite(table, spline_rates(table.times, table.values), i, t)
        case _:
            raise ValueError(f"Unknown interpolation {table.method!r}; known: {METHODS}")
    return jnp.where(covers(table, i, t), value, jnp.nan)


def rate(table: Table, t: Float[Array, ""]) -> Float[Array, " k"]:
    """The derivative of the interpolated values by time, per second."""
    return jax.jvp(lambda t: interpolate(table, t), (t,), (jnp.ones_like(t),))[1]


def interval(table: Table, t: Float[Array, ""]) -> Int[Array, ""]:
    """The row i with tᵢ ≤ t < tᵢ₊₁; the first or last interval beyond the ends."""
    i = jnp.searchsorted(table.times, t, side="right") - 1
    return jnp.clip(i, 0, len(table.times) - 2)


def fraction(table: Table, i: Int[Array, ""], t: Float[Array, ""]) -> Float[Array, ""]:
    """τ, the part of the interval i that has passed at t."""
    start, end = table.times[i], table.times[i + 1]
    return (t - start) / (end - start)


def covers(table: Table, i: Int[Array, ""], t: Float[Array, ""]) -> Array:
    """Whether the table tells about t: between its ends and not in a gap."""
    times = table.times
    inside = (t >= times[0]) & (t <= times[-1])
    return inside & (times[i + 1] - times[i] <= table.gap)


def breaks(table: Table) -> Float[np.ndarray, " rows"]:
    """The times where one polynomial ends and the next begins."""
    return np.asarray(table.times)


def spline_rates(
    times: Float[Array, " rows"], values: Float[Array, "rows k"]
) -> Float[Array, "rows k"]:
    """The rates at the rows of the cubic spline that is not-a-knot at both ends; rows ≥ 4."""
    step = jnp.diff(times)
    slope = jnp.diff(values, axis=0) / step[:, None]
    ends = times[2] - times[0], times[-1] - times[-3]
    first = ((step[0] + 2 * ends[0]) * step[1] * slope[0] + step[0] ** 2 * slope[1]) / ends[0]
    last = ((step[-1] + 2 * ends[1]) * step[-2] * slope[-1] + step[-1] ** 2 * slope[-2]) / ends[1]
    inner = 3 * (step[1:, None] * slope[:-1] + step[:-1, None] * slope[1:])
    zero = jnp.zeros(1)
    return tridiagonal_solve(
        jnp.concatenate([zero, step[1:], ends[1][None]]),
        jnp.concatenate([step[1:2], 2 * (step[:-1] + step[1:]), step[-2:-1]]),
        jnp.concatenate([ends[0][None], step[:-1], zero]),
        jnp.concatenate([first[None], inner, last[None]]),
    )


def _linear(table, i, t):
    tau = fraction(table, i, t)
    return (1 - tau) * table.values[i] + tau * table.values[i + 1]


def _lagrange(table, i, t):
    rows = table.order + 1
    first = jnp.clip(i + 1 - rows // 2, 0, len(table.times) - rows)
    times = jax.lax.dynamic_slice_in_dim(table.times, first, rows)
    values = jax.lax.dynamic_slice_in_dim(table.values, first, rows)
    same = jnp.eye(rows, dtype=bool)
    spans = times[:, None] - times + same
    return jnp.prod(jnp.where(same, 1.0, (t - times) / spans), axis=1) @ values


def _hermite(table, rates, i, t):
    tau, step = fraction(table, i, t), table.times[i + 1] - table.times[i]
    h01 = tau**2 * (3 - 2 * tau)
    h10, h11 = tau * (1 - tau) ** 2, -(tau**2) * (1 - tau)
    line = (1 - h01) * table.values[i] + h01 * table.values[i + 1]
    return line + step * (h10 * rates[i] + h11 * rates[i + 1])
