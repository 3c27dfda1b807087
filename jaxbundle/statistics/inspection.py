"""Inspection of a network solution, in terms and order of the network."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.adjustment.problem import Problem
from jaxbundle.leastsquares.solution import Solution
from jaxbundle.network.arrays import Values
from jaxbundle.network.declare import Rows, Tables


class OfNetwork(NamedTuple):
    """`Reliability` in the order of the network."""

    residual: Rows
    gain: Rows
    redundancy: Rows
    w: Rows
    hat: Rows


class Tested(NamedTuple):
    """The same columns for one kind of observation, [observations, axes]."""

    residual: np.ndarray
    gain: np.ndarray
    redundancy: np.ndarray
    w: np.ndarray
    hat: np.ndarray


class _OfTables(eqx.Module):
    """A function of a network's values as one of the engine's tables."""

    function: Callable[[Values], Array]
    values: Callable[[Tables], Values]

    def __call__(self, tables: Tables) -> Array:
        return self.function(self.values(tables))


class Inspection:
    """Quantities for the statistics of a problem at its `adjusted` values; `solution`: the
    engine's."""

    def __init__(self, problem: Problem, values: Values):
        self.problem, self.adjusted = problem, values
        self.solution = Solution(problem.system, problem.layout.tables(values))

    @functools.cached_property
    def residuals(self) -> Rows:
        """All residuals divided by their σ."""
        return self._rows(self.solution.residuals)

    @property
    def lengths(self) -> Float[np.ndarray, " rays"]:
        """|v/σ| of every image point."""
        return np.hypot(*self.residuals.image.T)

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
        Q = self.solution.cofactor("point")
        return np.asarray(self.problem.layout.coordinate_cofactors(self.adjusted.point, Q))

    @functools.cached_property
    def camera_cofactors(self) -> list[Float[np.ndarray, "k k"]]:
        """Cofactors of the parameters of every camera that are free in any camera of its model."""
        found = [np.zeros((0, 0))] * len(self.problem.network.cameras)
        for table in self.problem.layout.cameras:
            for c, Q in zip(table.cameras, self.solution.cofactor(table.name)):
                found[c] = Q
        return found

    @functools.cached_property
    def reliability(self) -> OfNetwork:
        """Redundancy numbers and w of all observations."""
        found = self.solution.reliability
        return OfNetwork(*(self._rows(getattr(found, name)) for name in OfNetwork._fields))

    def propagate(self, function: Callable[[Values], Array]) -> Float[np.ndarray, "n n"]:
        """The cofactors of any differentiable function (`Values` → [n]) of the unknowns; it is
        compiled, once for the same function (an `equinox.Partial`: of whatever arrays)."""
        return self.solution.propagate(self.of_tables(function))

    def of_tables(self, function: Callable[[Values], Array]) -> Callable[[Tables], Array]:
        """A function of a network's values as one of the engine's tables."""
        return _OfTables(function, self.problem.layout.values)

    def _rows(self, by_set) -> Rows:
        return self.problem.layout.rows(by_set, self.problem.data)
