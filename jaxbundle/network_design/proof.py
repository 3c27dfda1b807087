r"""Proof of a design: many simulated networks are adjusted and compared with the prediction.

The draws are adjusted one after the other, by the programs of `adjust`: for networks of this
size this is faster than compiling one program for all. The deviations from
the truth, in the datum of the network, give covariances C̃ = Σ d·dᵀ/n, from which the aim is
computed like the predicted one. With n draws the relative σ of an estimated σ is 1/√(2n).
"""

import dataclasses

import numpy as np

from jaxbundle.adjustment.problem import PSEUDO_OBSERVATIONS, NetworkProblem, coordinates
from jaxbundle.arguments import integer
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import NotSolvedError
from jaxbundle.leastsquares.indexing.rows import Data
from jaxbundle.leastsquares.iterations.stopping import converged
from jaxbundle.leastsquares.problem import with_data
from jaxbundle.leastsquares.solution import find_minimum
from jaxbundle.network_design.aims import Aim, aim_of, functions_of, measure, points_of_interest

# Sets whose measurements are simulated.
STANDARD = (*PSEUDO_OBSERVATIONS, "image")


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class Proof:
    """The predicted aim, and that from `draws` adjustments of simulated measurements."""

    predicted: float
    found: float
    draws: int
    failed: int

    @property
    def ratio(self) -> float:
        """Ratio of found to predicted aim: 1 except for chance."""
        return self.found / self.predicted

    @property
    def limit(self) -> float:
        """Limit of the random deviation of the ratio of one σ from 1: three times its σ."""
        return 3 / np.sqrt(2 * (self.draws - self.failed))

    @property
    def agrees(self) -> bool:
        """Whether prediction and simulation agree."""
        return not self.failed and abs(self.ratio - 1) <= self.limit

    def __str__(self) -> str:
        failures = f", {self.failed} of them not solved" if self.failed else ""
        return (
            f"{self.found:.4g} from {self.draws} simulated networks{failures}, "
            f"{self.predicted:.4g} predicted: ratio {self.ratio:.3f} (limit 1 ± {self.limit:.3f}) "
            f"{'agrees' if self.agrees else 'DOES NOT AGREE'}"
        )


def prove(problem: NetworkProblem, aim: Aim, draws: int = 200, seed: int = 0) -> Proof:
    """Simulate and adjust a network with exact image coordinates.

    **Arguments:** `problem`: its start values are the truth.

    **Raises:** `NotSolvedError` if no draw can be adjusted."""
    draws = integer("draws", draws, least=2, most=100_000)
    truth, exact = problem.data.start, problem.data
    # Redundancy numbers do not show in deviations: a reliability is proved by a mean σ of the same
    # network, of its points, or of its projection centres if all points are held.
    if aim.measure == "reliability":
        has_points = points_of_interest(problem).any()
        aim = Aim("mean") if has_points else Aim("mean", lambda values: values["image"].position)
    functions = functions_of(problem, aim)
    interest = np.flatnonzero(points_of_interest(problem))
    points = lambda values: np.asarray(coordinates(values))[interest]
    quantities = points if functions is None else lambda values: functions(values)[None]
    random = np.random.default_rng(seed)
    # Adjusted, not propagated: the linear propagation is what is to be proved.
    errors = []
    for _ in range(draws):
        minimum = find_minimum(with_data(problem, _measure(exact, random)))
        if bool(converged(minimum.termination)):
            errors.append(np.asarray(quantities(minimum.values)) - np.asarray(quantities(truth)))
    if not errors:
        raise NotSolvedError("design: none of the simulated networks could be adjusted")
    d = np.array(errors)
    # About zero, not about their mean: a bias of the adjustment is a deviation too.
    blocks = np.einsum("nki,nkj->kij", d, d) / len(d)
    return Proof(aim_of(problem, aim), measure(aim, blocks), draws, draws - len(d))


def _measure(exact: Data, random: np.random.Generator) -> Data:
    """Simulated data."""

    def sigma_of(name: str) -> np.ndarray:
        """0 of what is not measured. The engine's `weight` is 1/σ, the root of the weight."""
        sqrt_p = np.asarray(exact.weight[name])
        return np.where(sqrt_p > 0, 1 / np.where(sqrt_p > 0, sqrt_p, 1.0), 0.0)

    noisy = dict(exact.measured)
    for name, measured in exact.measured.items():
        if name.partition(",")[0] in STANDARD:
            sigma = sigma_of(name).reshape(np.shape(measured))
            noisy[name] = np.asarray(measured) + random.standard_normal(sigma.shape) * sigma
    return dataclasses.replace(exact, measured=noisy)
