"""The solution of a network, with what the network's statistics ask of it."""

import functools
from collections.abc import Callable

import numpy as np
from jaxtyping import Array, Float

from jaxbundle.adjustment.problem import NetworkProblem
from jaxbundle.leastsquares.indexing.rows import Values
from jaxbundle.leastsquares.quality.reliability import Reliability
from jaxbundle.leastsquares.solution import Solution


class Inspection:
    """Quantities for the statistics of a problem at its `adjusted` values; `solution`: the
    engine's. What is given by set of observations has the names of `network.declare`."""

    def __init__(self, problem: NetworkProblem, values: Values):
        self.problem, self.adjusted = problem, values
        self.solution = Solution(problem, values)

    @property
    def residuals(self) -> dict[str, Float[np.ndarray, "n r"]]:
        """All residuals divided by their σ, by set."""
        return self.solution.residuals

    @property
    def image_residuals(self) -> Float[np.ndarray, "rays 2"]:
        """Those of the image points, in the order of the network."""
        return self.problem.image_points(self.residuals)

    @property
    def lengths(self) -> Float[np.ndarray, " rays"]:
        """|v/σ| of every image point."""
        return np.hypot(*self.image_residuals.T)

    @property
    def vtpv(self) -> float:
        """vᵀPv of all observations, pseudo-observations included."""
        return self.solution.vtpv

    @property
    def determined(self) -> bool:
        """Whether no unknown is so weak that its σ is rounding noise."""
        return self.solution.determined

    @functools.cached_property
    def image_cofactors(self) -> Float[np.ndarray, "images 6 6"]:
        """Cofactors of X0, Y0, Z0 and the small rotation δθ of every image; zero if held."""
        return self.solution.cofactor("image")

    @functools.cached_property
    def point_cofactors(self) -> Float[np.ndarray, "points 3 3"]:
        """Cofactors of X, Y, Z of every point; zero if held."""
        # Of far points the engine's are those of direction and inverse distance.
        Q = self.solution.cofactor("point")
        return np.asarray(self.problem.cofactors_of_coordinates(self.adjusted["point"], Q))

    @functools.cached_property
    def camera_cofactors(self) -> list[Float[np.ndarray, "k k"]]:
        """Cofactors of the parameters of every camera that are free in any camera of its model."""
        # By camera of the network, not by row of a table of one model.
        cofactors = [np.zeros((0, 0))] * len(self.problem.network.cameras)
        for table in self.problem.cameras:
            for c, Q in zip(table.cameras, self.solution.cofactor(table.name)):
                cofactors[c] = Q
        return cofactors

    @property
    def reliability(self) -> Reliability:
        """Redundancy numbers and w of all observations, by set."""
        return self.solution.reliability

    def propagate(self, function: Callable[[Values], Array]) -> Float[np.ndarray, "n n"]:
        """The cofactors of any differentiable function (`Values` → [n]) of the unknowns; it is
        compiled, once for the same function (an `equinox.Partial`: of whatever arrays)."""
        return self.solution.propagate(function)
