"""Trajectories of one angle or coordinate against time, for simulation.

| kind | value at t (t₀ the start) |
|---|---|
| `constant` | value |
| `linear` | value + rate·(t − t₀) |
| `sine` | value + amplitude·sin(2π·(t − t₀)/period + phase) |
| `walk` | value + a random walk, `sigma` in a second, smooth between its steps of `step` s |
| `table` | cubic spline through (times, values) |
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline

from jaxbundle.errors import InputError
from jaxbundle.network.columns import did_you_mean, refuse_unknown
from jaxbundle.types import Numbers

Times = Float[np.ndarray, " n"]

KEYS = {
    "constant": ("value",),
    "linear": ("value", "rate"),
    "sine": ("value", "amplitude", "period", "phase"),
    "walk": ("value", "sigma", "step"),
    "table": ("times", "values"),
}
KINDS = tuple(KEYS)


def signal(
    description: Mapping[str, Any] | float, t: Times, start: float, rng: np.random.Generator
) -> Times:
    """The values of a signal at the times t.

    **Arguments:** `description` a number, or `{"kind": …}` with the keys of the kind; missing ones
    are 0 (period or step 1 s). A walk draws from `rng`.

    **Raises:** `InputError` for unknown kinds and keys, periods and steps that are not positive,
    tables that are none or do not cover t.
    """
    if isinstance(description, int | float):
        return np.full(len(t), float(description))
    kind = description.get("kind", "constant")
    if kind not in KINDS:
        raise InputError(f"unknown signal {kind!r}{did_you_mean(str(kind), KINDS)}")
    for key in description:
        refuse_unknown(key, ("kind", *KEYS[kind]), f"signal {kind!r}: ")
    get = lambda key, default=0.0: float(description.get(key, default))
    for key in ("period", "step"):
        if not get(key, 1.0) > 0:
            raise InputError(
                f"signal {kind!r}: {key} is {get(key):g}; a positive number of seconds"
            )
    elapsed = np.asarray(t) - start
    match kind:
        case "linear":
            return get("value") + get("rate") * elapsed
        case "sine":
            turn = 2 * np.pi * elapsed / get("period", 1.0) + get("phase")
            return get("value") + get("amplitude") * np.sin(turn)
        case "walk":
            return get("value") + _walk(elapsed, get("sigma"), get("step", 1.0), rng)
        case "table":
            return _interpolated(t, *(description.get(key, ()) for key in KEYS["table"]))
    return np.full(len(t), get("value"))


def _interpolated(t: Times, times: Numbers, values: Numbers) -> Times:
    """The cubic spline through a table, at times t that it covers."""
    times, values = np.asarray(times, float), np.asarray(values, float)
    if times.ndim != 1 or times.shape != values.shape or len(times) < 2:
        raise InputError(
            f"signal 'table': {times.size} times and {values.size} values; expected as many of "
            "both, two at least"
        )
    if not (np.isfinite(values).all() and (np.diff(times) > 0).all()):
        raise InputError("signal 'table': expected times that increase, and finite values")
    if t.min() < times[0] or t.max() > times[-1]:
        raise InputError(
            f"signal 'table': times from {times[0]:.9g} to {times[-1]:.9g} s; expected from "
            f"{t.min():.9g} s or before to {t.max():.9g} s or after, as far as the records of the "
            "instrument reach beyond the image"
        )
    return CubicSpline(times, values)(t)


def _walk(elapsed: Times, sigma: float, step: float, rng: np.random.Generator) -> Times:
    """A random walk that is 0 at the start, the spline through one node in every step."""
    # Forward and backward from the start by steps of their own: one seed gives one walk for any
    # requested times. The end of a spline acts by a factor of 2 − √3 less at every node, so that 20
    # nodes beyond the requested times leave nothing of it.
    steps_after, steps_before = (
        20 + np.ceil(max(end, 0.0) / step) for end in (elapsed[-1], -elapsed[0])
    )
    # 1 kHz for a quarter of an hour; more would fill the memory
    if not steps_after + steps_before <= 1e6:
        raise InputError(
            f"signal 'walk': step is {step:g} s, {steps_after + steps_before:.3g} in the time of "
            "the image; give a longer one"
        )
    steps_after, steps_before = int(steps_after), int(steps_before)
    forward, backward = (
        np.cumsum(sigma * np.sqrt(step) * generator.normal(size=n))
        for generator, n in zip(rng.spawn(2), (steps_after, steps_before))
    )
    values = np.concatenate([backward[::-1], [0.0], forward])
    return CubicSpline(step * np.arange(-steps_before, steps_after + 1), values)(elapsed)
