"""The search for a configuration: constrained minimisation with gradients by autodiff.

Sequential quadratic programming (SLSQP, Kraft 1988) of the logarithm of the aim, in rounds: the
conditions of rays are soft at first, so that not yet visible targets have a gradient, and
sharper in every round. Values that are not finite, by rounding or a singular design, count as the
worst.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import logsumexp
from jaxtyping import Array, Float, PyTree

from jaxbundle.leastsquares.indexing.rows import Data as EngineData
from jaxbundle.leastsquares.indexing.rows import Values
from jaxbundle.network_design.aims import log_aim
from jaxbundle.network_design.conditions import Conditions
from jaxbundle.network_design.pairs import StationTargetPairs
from jaxbundle.network_design.settings import DEFAULTS, DesignSettings
from jaxbundle.network_design.variables import Configuration, Variables
from jaxbundle.types import AnyArray

# The logarithm of an undetermined aim: beyond that of every number (e⁷⁰⁹), and finite, so that a
# line search steps back from it.
UNDETERMINED_AIM = 1e3


class Step(NamedTuple):
    """An iteration: softness of the conditions, the aim with them, and the projection centres."""

    softness: float
    aim: float
    position: Float[np.ndarray, "images 3"]


def make_program(
    pairs: StationTargetPairs, design: Callable[..., tuple[Values, AnyArray]]
) -> Callable[..., tuple[float, Float[np.ndarray, " variables"]]]:
    """`(x, *given) -> (log aim, gradient)`; `design(x, *given)` gives values and weights of rays.

    In three programs; the largest by far, that of the aim, is shared by all designs
    of one shape. An undetermined aim has the worst value, with zero gradient."""

    def data(x: Float[Array, " variables"], constants: tuple[PyTree, ...]) -> EngineData:
        return pairs.data(*design(x, *constants))

    forward = eqx.filter_jit(data)

    @eqx.filter_jit
    def pull_back(
        x: Float[Array, " variables"], constants: tuple[PyTree, ...], slopes: EngineData
    ) -> Float[Array, " variables"]:
        return jax.vjp(lambda x: data(x, constants), x)[1](slopes)[0]

    def program(
        x: Float[AnyArray, " variables"], *constants: PyTree
    ) -> tuple[float, Float[np.ndarray, " variables"]]:
        # A Python number as softness would cause a new compilation.
        x, constants = jnp.asarray(x), jax.tree.map(jnp.asarray, constants)
        value, slopes = log_aim(pairs.task, forward(x, constants))
        slope = np.asarray(pull_back(x, constants, slopes))
        if not (np.isfinite(value) and np.isfinite(slope).all()):
            return UNDETERMINED_AIM, np.zeros(len(x))
        return float(value), slope

    return program


def configuration(pairs: StationTargetPairs, variables: Variables) -> Callable:
    """The design of first order, a function `(x, start, softness)`."""

    def design(
        x: Float[Array, " variables"], start: Configuration, softness: Float[Array, ""]
    ) -> tuple[Values, Float[Array, " rays"]]:
        values = variables.place(start, x).values
        return values, pairs.visibilities(values, softness)

    return design


def station_margins(
    conditions: Conditions,
    variables: Variables,
    origin: Float[np.ndarray, "3"],
    edge_sharpness: float = DEFAULTS.edge_sharpness,
) -> Callable | None:
    """`(x, start) -> margins` of projection centres, positive if the conditions are satisfied:
    distances of stations, and stations outside of obstacles. None without conditions."""
    if not (conditions.apart > 0 or conditions.obstacles):
        return None
    boxes = np.array(conditions.obstacles).reshape(-1, 2, 3) - origin
    middle, half_size = boxes.mean(1), (boxes[:, 1] - boxes[:, 0]) / 2
    sharp = edge_sharpness / half_size.mean(1)

    def margins(x: Float[AnyArray, " variables"], start: Configuration) -> Float[Array, " margins"]:
        position = variables.place(start, x).values["image"].position
        images = len(position)
        i, j = np.triu_indices(images, 1)
        moves = np.isin(i, variables.images) | np.isin(j, variables.images)
        margin_parts = [jnp.zeros(0)]
        if conditions.apart > 0:
            difference = position[i[moves]] - position[j[moves]]
            margin_parts.append(jnp.sum(difference**2, 1) / conditions.apart**2 - 1)
        # Outside of a box is outside of one of its faces: the largest of three distances, smooth.
        # Less log 3, so that it is never more than the largest.
        outside_by = jnp.abs(position[variables.images][:, None] - middle) - half_size
        nearest = (logsumexp(sharp[:, None] * outside_by, axis=2) - np.log(3)) / sharp
        margin_parts.append((nearest / variables.unit).ravel())
        return jnp.concatenate(margin_parts)

    return margins


def search(
    pairs: StationTargetPairs,
    variables: Variables,
    start: Configuration,
    program: Callable,
    ends: Callable[[Configuration], tuple[np.ndarray, np.ndarray]],
    max_iterations: int,
    settings: DesignSettings = DEFAULTS,
) -> tuple[Configuration, list[Step], bool]:
    """The best configuration from a start.

    **Arguments:** `ends`: smallest and largest variables at a start; `max_iterations`: of a round.

    **Returns:** the configuration, the steps, and whether the last round converged."""
    origin = pairs.problem.origin
    margins = station_margins(pairs.conditions, variables, origin, settings.edge_sharpness)
    conditions: list[dict[str, Any]] = []
    if margins is not None:
        as_numbers = lambda f: lambda x, start: np.asarray(f(jnp.asarray(x), start))
        value, slope = eqx.filter_jit(margins), eqx.filter_jit(jax.jacfwd(margins))
        conditions = [{"type": "ineq", "fun": as_numbers(value), "jac": as_numbers(slope)}]
    options = {"maxiter": max_iterations, "ftol": settings.smallest_change}
    steps: list[Step] = []
    converged = False
    for softness in settings.softness:
        function = lambda x, start_values=start, s=softness: program(x, start_values, s)
        record = lambda x, aim, start_values=start, s=softness: steps.append(
            Step(s, aim, variables.positions(start_values, x) + origin)
        )
        bound = [{**c, "args": (start,)} for c in conditions]
        begin, limits = variables.vector(start), ends(start)
        x, converged = _minimise(function, begin, limits, bound, options, record, not steps)
        start = jax.tree.map(np.asarray, variables.compiled_place(start, x))
    return start, steps, converged


def _minimise(
    function: Callable[[np.ndarray], tuple[float, np.ndarray]],
    x: Float[np.ndarray, " variables"],
    limits: tuple[np.ndarray, np.ndarray],
    constraints: Sequence[dict[str, Any]],
    options: dict[str, Any],
    record: Callable[[np.ndarray, float], None],
    with_start: bool,
) -> tuple[Float[np.ndarray, " variables"], bool]:
    """The minimum of a logarithm of the aim, and whether it converged; `record(x, aim)` gets every
    iteration, and `with_start` the first x."""
    from scipy.optimize import minimize

    # SLSQP tells its callback x only: the aim there is that of the last evaluation, mostly.
    latest: list[tuple[np.ndarray, float]] = []

    def log_aim(x: Float[np.ndarray, " variables"]) -> tuple[float, np.ndarray]:
        value, slope = function(x)
        latest[:] = [(np.array(x), value)]
        return value, slope

    def keep(x: Float[np.ndarray, " variables"]) -> None:
        if not latest or not np.allclose(latest[0][0], x, 1e-9, 1e-9):
            log_aim(x)
        record(x, float(np.exp(min(latest[0][1], 700.0))))  # e⁷¹⁰ is infinite

    low, high = limits
    x = np.clip(x, low, high)
    if with_start:
        keep(x)
    minimum = minimize(
        log_aim,
        x,
        jac=True,
        method="SLSQP",
        bounds=np.stack([low, high], 1),
        callback=keep,
        constraints=constraints,
        options=options,
    )
    return np.clip(minimum.x, low, high), bool(minimum.success)


def satisfies(
    conditions: Conditions,
    variables: Variables,
    origin: Float[np.ndarray, "3"],
    start: Configuration,
    edge_sharpness: float = DEFAULTS.edge_sharpness,
) -> bool:
    """Whether the stations satisfy their conditions, to a thousandth of their lengths."""
    margins = station_margins(conditions, variables, origin, edge_sharpness)
    if margins is None:
        return True
    # A margin of squared distances: 2e-3 is a thousandth of the distance. SLSQP satisfies
    # constraints to about its tolerance of the aim only.
    return bool((jax.jit(margins)(variables.vector(start), start) > -2e-3).all())
