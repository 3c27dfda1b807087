r"""Design of second order: selection of the best of many photographs.

Every candidate has a weight 0 ≤ w ≤ 1 with Σw = n, which multiplies the weights of its image
coordinates. The square of the aim is convex in w (Pukelsheim 1993, Optimal Design of Experiments),
so that the minimum over all weights is unique, most of them are 0 or 1 there, and for every
selection

    aim² ≥ T(w) + min over w' of ∇T·(w' − w)

is a lower bound for any choice of n photographs. The largest weights are chosen, and
photographs exchanged while this reduces the aim (Fedorov 1972).
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.network_design.pairs import IDLE_VISIBILITY, StationTargetPairs
from jaxbundle.network_design.search import UNDETERMINED_AIM, make_program
from jaxbundle.network_design.settings import DEFAULTS, DesignSettings
from jaxbundle.types import AnyArray

# The weight of an unselected photograph, so that its orientation stays determined.
IDLE_WEIGHT = IDLE_VISIBILITY**2
# `weights -> (log aim², gradient)`.
Squared = Callable[[Float[AnyArray, " images"]], tuple[float, Float[np.ndarray, " images"]]]


class Selection(NamedTuple):
    """`weight` of the relaxed problem; `chosen`; `aims`: by iteration; `bound`: on the aim of any
    selection (0 if there is none)."""

    weight: Float[np.ndarray, " images"]
    chosen: Bool[np.ndarray, " images"]
    aims: list[float]
    bound: float
    converged: bool


def select(
    pairs: StationTargetPairs,
    photographs: int,
    max_iterations: int = 100,
    settings: DesignSettings = DEFAULTS,
) -> Selection:
    """The photographs to take.

    **Raises:** `InputError` for an impossible number, `NotSolvedError` if no selection
    determines the network."""
    from scipy.optimize import minimize

    images = len(pairs.problem.network.images)
    if not 1 <= photographs < images:
        raise InputError(
            f"photographs must be from 1 to {images - 1}, one less than there are "
            f"candidates, but is {photographs}"
        )
    program = _program(pairs)
    start = np.full(images, photographs / images)
    aims: list[float] = []

    def record(w: Float[np.ndarray, " images"]) -> None:
        aims.append(float(np.exp(min(program(w)[0] / 2, 700.0))))

    record(start)
    if program(start)[0] >= 2 * UNDETERMINED_AIM:
        raise NotSolvedError("design: all candidates together do not determine the network")
    minimum = minimize(
        program,
        start,
        jac=True,
        method="SLSQP",
        bounds=[(IDLE_WEIGHT, 1.0)] * images,
        callback=record,
        constraints=[
            {"type": "eq", "fun": lambda w: w.sum() - photographs, "jac": lambda w: np.ones_like(w)}
        ],
        # The problem is convex and its gradient cheap: to the end, since the bound depends on it.
        options={"maxiter": max_iterations, "ftol": 1e-8},
    )
    weight = np.clip(minimum.x, IDLE_WEIGHT, 1.0)
    is_chosen = np.zeros(images, bool)
    is_chosen[np.argsort(-weight, kind="stable")[:photographs]] = True
    is_chosen = _exchange(program, is_chosen, settings.max_exchanges)
    # The smallest ∇T·w' of n whole photographs is the sum of the n smallest slopes.
    value, slope = program(weight)
    square, slope = np.exp(value), np.exp(value) * slope
    lowest = square + np.sort(slope)[:photographs].sum() - slope @ weight
    bound = float(np.sqrt(max(lowest, 0.0))) if pairs.aim.convex else 0.0
    # A weight at its lower bound, which SLSQP meets to its tolerance, is that of none.
    return Selection(
        np.where(weight > 10 * IDLE_WEIGHT, weight, 0.0),
        is_chosen,
        aims,
        bound,
        bool(minimum.success),
    )


def _program(pairs: StationTargetPairs) -> Squared:
    """`weights -> (log aim², gradient)`."""
    values = pairs.problem.data.start
    is_measured = pairs.measured(values).astype(float)
    image = pairs.problem.image
    # Visibilities multiply 1/σ, w the weight 1/σ².
    program = make_program(pairs, lambda w: (values, is_measured * jnp.sqrt(w)[image]))

    def squared(w: Float[AnyArray, " images"]) -> tuple[float, Float[np.ndarray, " images"]]:
        value, slope = program(np.maximum(w, IDLE_WEIGHT))
        return 2 * value, 2 * slope

    return squared


def _exchange(
    program: Squared, is_chosen: Bool[np.ndarray, " images"], max_exchanges: int
) -> Bool[np.ndarray, " images"]:
    """Photographs exchanged, the best pair at a time, while the aim falls."""
    aim = lambda is_chosen: program(is_chosen.astype(float))[0]
    best = aim(is_chosen)
    for _ in range(max_exchanges):
        best_exchange = best, is_chosen
        # The slope at nearly zero weight tells what a photograph adds; at zero the derivative of √w
        # is infinite. The eight that add most are tried in place of every chosen one; all pairs
        # would cost candidates times chosen evaluations.
        slope = program(np.maximum(is_chosen.astype(float), 1e-3))[1]
        candidates = np.flatnonzero(~is_chosen)[np.argsort(slope[~is_chosen])][:8]
        for new in candidates:
            for old in np.flatnonzero(is_chosen):
                trial = is_chosen.copy()
                trial[[new, old]] = True, False
                value = aim(trial)
                if value < best_exchange[0] - 1e-9:  # better beyond rounding, so that exchanges end
                    best_exchange = value, trial
        if best_exchange[1] is is_chosen:
            return is_chosen
        best, is_chosen = best_exchange
    return is_chosen
