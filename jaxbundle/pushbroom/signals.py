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
from jaxbundle.network.columns import did_you_mean

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

    **Raises:** `InputError` for unknown kinds and keys.
    """
    if isinstance(description, int | float):
        return np.full(len(t), float(description))
    kind = description.get("kind", "constant")
    if kind not in KINDS:
        raise InputError(f"unknown signal {kind!r}{did_you_mean(str(kind), KINDS)}")
    for key in description:
        if key not in ("kind", *KEYS[kind]):
            raise InputError(f"signal {kind!r}: unknown key {key!r}{did_you_mean(key, KEYS[kind])}")
    get = lambda key, default=0.0: float(description.get(key, default))
    passed = np.asarray(t) - start
    match kind:
        case "linear":
            return get("value") + get("rate") * passed
        case "sine":
            turn = 2 * np.pi * passed / get("period", 1.0) + get("phase")
            return get("value") + get("amplitude") * np.sin(turn)
        case "walk":
            return get("value") + _walk(passed, get("sigma"), get("step", 1.0), rng)
        case "table":
            return CubicSpline(description["times"], description["values"], extrapolate=False)(t)
    return np.full(len(t), get("value"))


def _walk(passed: Times, sigma: float, step: float, rng: np.random.Generator) -> Times:
    """A random walk that is 0 at the start, the spline through one node in every step."""
    # From a fixed time on, so that one seed gives one walk for any requested times; a minute before
    # the start, as tables begin some rows before the image.
    nodes = np.arange(-60.0, passed[-1] + 3 * step, step)
    steps = sigma * np.sqrt(step) * rng.normal(size=len(nodes))
    spline = CubicSpline(nodes, np.cumsum(steps))
    return spline(passed) - spline(0.0)
