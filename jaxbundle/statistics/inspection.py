"""A solution looked at: its factor, cofactors and reliability, each computed when first asked for.

The arrays are filled up to round sizes (`jaxbundle.network.padding`), so that networks of nearly
the same size share the compiled programs; what was filled in is taken off again here.
"""

import dataclasses
import functools

import jax
from jaxtyping import Array, Float

from jaxbundle.adjustment.problem import Problem
from jaxbundle.adjustment.schur import Factor
from jaxbundle.network.arrays import Tangent, Values
from jaxbundle.network.padding import bucket_of, pad, pad_tangents, pad_values
from jaxbundle.statistics.cofactors import Cofactors, cofactors, propagate, undamped_factor
from jaxbundle.statistics.reliability import Reliability, reliability


class Inspection:
    """What statistics need of a problem at its adjusted `values`."""

    def __init__(self, problem: Problem, values: Values):
        self.problem = problem
        self.sizes = bucket_of(problem.structure)
        self.structure, self.data = pad(problem.structure, problem.data, self.sizes)
        self.values = pad_values(values, self.sizes)

    @functools.cached_property
    def factor(self) -> Factor:
        """The normal equations, undamped, factorised; of the filled arrays."""
        return undamped_factor(self.structure, self.values, self.data)

    @functools.cached_property
    def _cofactors(self) -> Cofactors:
        return cofactors(self.structure, self.values, self.factor)

    @functools.cached_property
    def cofactors(self) -> Cofactors:
        """Blocks of the cofactor matrix (`jaxbundle.statistics.cofactors`); the internal ones are
        those of the filled arrays."""
        s, Q = self.problem.structure, self._cofactors
        return dataclasses.replace(
            Q, image=Q.image[: s.images], camera=Q.camera[: s.cameras], point=Q.point[: s.points]
        )

    @functools.cached_property
    def reliability(self) -> Reliability:
        """Redundancy numbers and w of all observations, in the order of the problem's arrays."""
        found = reliability(self.structure, self.values, self.data, self._cofactors)
        data = self.problem.data
        rows = (data.image_xy, data.control, data.exterior, data.interior, data.distance)
        return jax.tree.map(
            lambda x, n: x[:n], found,
            Reliability(*3 * [type(found.residual)(*(len(x) for x in rows))]),
        )  # fmt: skip

    def propagate(self, rows: Tangent) -> Float[Array, "n n"]:
        """F·Q·Fᵀ in the datum for linear functions F of the unknowns (first axis of `rows`)."""
        rows = pad_tangents(rows, self.sizes)
        return propagate(self.structure, self.values, self.factor, rows)
