"""The search for a configuration: constrained minimisation with gradients by autodiff.

Sequential quadratic programming (SLSQP, Kraft 1988) of the logarithm of the aim, in rounds: the
conditions of rays are soft at first, so that not yet visible targets have a gradient, and
sharper in every round. Values that are not finite, by rounding or a singular design, count as the
worst.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import logsumexp
from jaxtyping import Float

from jaxbundle.network.arrays import Values
from jaxbundle.network_design.aims import log_aim
from jaxbundle.network_design.conditions import Conditions
from jaxbundle.network_design.pairs import Pairs
from jaxbundle.network_design.variables import Start, Variables
from jaxbundle.types import AnyArray

ROUNDS = (0.3, 0.1, 0.03)
"""Softness of the conditions."""
UNDETERMINED_AIM = 1e3
"""The logarithm of an undetermined aim."""
SMALLEST_CHANGE = 1e-4
"""A change of the logarithm of the aim that ends a round."""
EDGE_ROUNDING = 20.0
"""Edges of obstacles are rounded to 1/20 of their half size for projection centres."""


class Step(NamedTuple):
    """An iteration: softness of the conditions, the aim with them, and the projection centres."""

    softness: float
    aim: float
    position: Float[np.ndarray, "images 3"]


def make_program(
    pairs: Pairs, design: Callable[..., tuple[Values, AnyArray]]
) -> Callable[..., tuple[float, Float[np.ndarray, " variables"]]]:
    """`(x, *given) -> (log aim, gradient)`; `design(x, *given)` gives values and weights of rays.

    In three programs; the largest by far, that of the aim, is shared by all designs
    of one shape. An undetermined aim has the worst value, with zero gradient."""

    def data(x, given):
        return pairs.data(*design(x, *given))

    forward = eqx.filter_jit(data)

    @eqx.filter_jit
    def back(x, given, slopes):
        return jax.vjp(lambda x: data(x, given), x)[1](slopes)[0]

    def program(x, *given):
        # A Python number as softness would cause a new compilation.
        x, given = jnp.asarray(x), jax.tree.map(jnp.asarray, given)
        value, slopes = log_aim(pairs.task, forward(x, given))
        slope = np.asarray(back(x, given, slopes))
        if not (np.isfinite(value) and np.isfinite(slope).all()):
            return UNDETERMINED_AIM, np.zeros(len(x))
        return float(value), slope

    return program


def configuration(pairs: Pairs, variables: Variables) -> Callable:
    """The design of first order, a function `(x, start, softness)`."""

    def design(x, start, softness):
        values = variables.place(start, x).values
        return values, pairs.weights(values, softness)

    return design


def station_margins(
    conditions: Conditions, variables: Variables, origin: Float[np.ndarray, "3"]
) -> Callable | None:
    """`(x, start) -> margins` of projection centres, positive if the conditions are satisfied:
    distances of stations, and stations outside of obstacles. None without conditions."""
    if not (conditions.apart > 0 or conditions.obstacles):
        return None
    boxes = np.array(conditions.obstacles).reshape(-1, 2, 3) - origin
    middle, half = boxes.mean(1), (boxes[:, 1] - boxes[:, 0]) / 2
    sharp = EDGE_ROUNDING / half.mean(1)

    def margins(x, start):
        position = variables.place(start, x).values.position
        images = len(position)
        i, j = np.triu_indices(images, 1)
        moves = np.isin(i, variables.images) | np.isin(j, variables.images)
        found = [jnp.zeros(0)]
        if conditions.apart > 0:
            away = position[i[moves]] - position[j[moves]]
            found.append(jnp.sum(away**2, 1) / conditions.apart**2 - 1)
        out = jnp.abs(position[variables.images][:, None] - middle) - half
        nearest = (logsumexp(sharp[:, None] * out, axis=2) - np.log(3)) / sharp
        found.append((nearest / variables.unit).ravel())
        return jnp.concatenate(found)

    return margins


def search(
    pairs: Pairs,
    variables: Variables,
    start: Start,
    program: Callable,
    ends: Callable[[Start], tuple[np.ndarray, np.ndarray]],
    max_iterations: int,
    rounds: tuple[float, ...] = ROUNDS,
) -> tuple[Start, list[Step], bool]:
    """The best configuration from a start.

    **Arguments:** `ends`: smallest and largest variables at a start; `max_iterations`: of a round.

    **Returns:** the configuration, the steps, and whether the last round converged."""
    from scipy.optimize import minimize

    margins = station_margins(pairs.conditions, variables, pairs.problem.origin)
    conditions = () if margins is None else _compile(margins)
    steps: list[Step] = []
    converged = False
    for softness in rounds:
        low, high = ends(start)
        latest: list[tuple[np.ndarray, float]] = []

        def log_aim(x, start=start, softness=softness, latest=latest):
            value, slope = program(x, start, softness)
            latest[:] = [(np.array(x), value)]
            return value, slope

        def keep(x, start=start, softness=softness, latest=latest):
            if not latest or not np.allclose(latest[0][0], x, 1e-9, 1e-9):
                log_aim(x)
            value = latest[0][1]
            position = variables.positions(start, x) + pairs.problem.origin
            steps.append(Step(softness, float(np.exp(min(value, 700.0))), position))

        x = np.clip(variables.vector(start), low, high)
        if not steps:
            keep(x)
        bound = [{**c, "args": (start,)} for c in conditions]
        found = minimize(
            log_aim,
            x,
            jac=True,
            method="SLSQP",
            bounds=np.stack([low, high], 1),
            callback=keep,
            constraints=bound,
            options={"maxiter": max_iterations, "ftol": SMALLEST_CHANGE},
        )
        start = jax.tree.map(np.asarray, variables.placed(start, np.clip(found.x, low, high)))
        converged = bool(found.success)
    return start, steps, converged


def _compile(margins):
    value, slope = eqx.filter_jit(margins), eqx.filter_jit(jax.jacfwd(margins))
    as_numbers = lambda f: lambda x, start: np.asarray(f(jnp.asarray(x), start))
    return ({"type": "ineq", "fun": as_numbers(value), "jac": as_numbers(slope)},)


def satisfies(
    conditions: Conditions, variables: Variables, origin: np.ndarray, start: Start
) -> bool:
    """Whether the stations satisfy their conditions, to a thousandth of their lengths."""
    margins = station_margins(conditions, variables, origin)
    if margins is None:
        return True
    return bool((jax.jit(margins)(variables.vector(start), start) > -2e-3).all())
