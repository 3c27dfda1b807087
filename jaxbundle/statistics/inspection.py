"""A solution looked at: its factor, cofactors and reliability, each computed when first asked for.

The arrays are filled up to round sizes (`jaxbundle.network.padding`), so that networks of nearly
the same size share the compiled programs; what was filled in is taken off again here.
"""

import functools

import jax
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.adjustment.problem import Problem
from jaxbundle.adjustment.residuals import Residuals, compiled_residuals
from jaxbundle.adjustment.schur import Factor
from jaxbundle.network.arrays import Data, Tangent, Values
from jaxbundle.network.padding import filled, pad_changes, pad_values, without_filling
from jaxbundle.statistics.cofactors import Cofactors, cofactors, propagate, undamped_factor
from jaxbundle.statistics.reliability import Reliability, held_against, reliability

DETERMINED = 1e-13
"""A pivot of the scaled normal equations below this is rounding."""


class Inspection:
    """What statistics need of a problem at its adjusted `values`.

    `factor` and the internal blocks of `cofactors` are those of the filled arrays, as `structure`,
    `data` and `values` are; `adjusted` are the values as given.
    """

    def __init__(self, problem: Problem, values: Values):
        self.problem, self.adjusted = problem, values
        self.structure, self.data, self.sizes = filled(problem.structure, problem.data)
        self.values = pad_values(values, self.sizes)

    @functools.cached_property
    def residuals(self) -> Residuals:
        """All residuals divided by their σ, in the order of the problem's arrays."""
        return self._rows(compiled_residuals(self.structure, self.values, self.data))

    @property
    def lengths(self) -> Float[np.ndarray, " rays"]:
        """|v/σ| of every image point."""
        return np.hypot(*np.asarray(self.residuals.image).T)

    @functools.cached_property
    def vtpv(self) -> float:
        """vᵀPv of all observations, pseudo-observations included."""
        return float(sum((np.asarray(v) ** 2).sum() for v in jax.tree.leaves(self.residuals)))

    @functools.cached_property
    def factor(self) -> Factor:
        """The normal equations, undamped, factorised."""
        return undamped_factor(self.structure, self.values, self.data)

    @property
    def determined(self) -> bool:
        """Whether no unknown is so weak that its σ is rounding noise."""
        pivots = np.abs(np.asarray(self.factor.reduced.pivots))
        return bool(np.isfinite(pivots).all() and pivots.min(initial=1.0) ** 2 > DETERMINED)

    @functools.cached_property
    def cofactors(self) -> Cofactors:
        """Blocks of the cofactor matrix (`jaxbundle.statistics.cofactors`)."""
        return cofactors(self.structure, self.values, self.factor)

    @functools.cached_property
    def reliability(self) -> Reliability:
        """Redundancy numbers and w of all observations, in the order of the problem's arrays."""
        found = reliability(self.structure, self.values, self.data, self.cofactors)
        parts = (found.residual, found.redundancy, found.w)
        return Reliability(*(self._rows(part) for part in parts))

    def predicted_tests(self, data: Data) -> Residuals:
        """v/√(1 + h) of all observations with the weights of `data`, as if none of them had taken
        part: normalised residuals of those that did not."""
        _, data, _ = filled(self.problem.structure, data)
        v, h = held_against(self.structure, self.values, data, self.cofactors)
        return self._rows(jax.tree.map(lambda v, h: v / np.sqrt(1 + np.asarray(h)), v, h))

    def _rows(self, rows: Residuals) -> Residuals:
        given = self.problem.data
        return without_filling(
            rows,
            Residuals(
                given.image_xy, given.control, given.exterior, given.interior, given.distance
            ),
        )

    def propagate(self, rows: Tangent) -> Float[Array, "n n"]:
        """F·Q·Fᵀ in the datum for linear functions F of the unknowns (first axis of `rows`)."""
        n = self.sizes
        rows = Tangent(
            pad_changes(rows.image, n.images),
            pad_changes(rows.camera, n.cameras),
            pad_changes(rows.point, n.points),
        )
        return propagate(self.structure, self.values, self.factor, rows)
