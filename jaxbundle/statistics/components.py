"""Variance components: does each group of observations keep the precision it was given?

    σ̂²_g = (vᵀPv)_g / r_g,    r_g = Σ redundancy numbers of the group

(Förstner 1979). A value near 1 confirms the a priori σ of the group. Estimation repeats: scale
the σ of every group by σ̂_g, adjust again, until all components are 1. The product of these
scales is the *factor* of the group: what the σ it was given have been multiplied by.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxbundle.adjustment.problem import Problem
from jaxbundle.network.arrays import Data
from jaxbundle.network.structure import Structure
from jaxbundle.network.tables import Camera
from jaxbundle.network.units import ANGLE_UNITS
from jaxbundle.statistics.reliability import Reliability

LEAST_REDUNDANCY = 1.0
"""A group with less redundancy than this has no usable component."""

EXACT = 1e-9
"""Residuals below this fraction of their a priori σ are rounding: there is nothing to estimate."""


@dataclasses.dataclass(frozen=True)
class Component:
    """A group of observations: how many, their redundancy, vᵀPv.

    `given`: the smallest and the largest a priori σ it was given (object unit, unit of the image
    residuals, angle unit; NaN for interior orientation, whose units differ). `factor`: what these
    were multiplied by before the adjustment, 1 unless components are estimated.
    """

    observations: int
    redundancy: float
    vtpv: float
    given: tuple[float, float]
    factor: float = 1.0

    @property
    def ratio(self) -> float:
        """σ̂_g: estimated over used standard deviation; NaN with too little redundancy."""
        if self.redundancy < 1e-6:
            return float("nan")
        return float(np.sqrt(self.vtpv / self.redundancy))

    @property
    def sigma(self) -> float:
        """Estimated over given standard deviation, `factor` × `ratio`."""
        return self.factor * self.ratio

    @property
    def estimated(self) -> tuple[float, float]:
        """The smallest and the largest σ of the group as they are estimated."""
        return tuple(self.sigma * sigma for sigma in self.given)

    @property
    def usable(self) -> bool:
        """Whether the σ of the group can be estimated from its residuals."""
        return self.redundancy >= LEAST_REDUNDANCY and self.sigma > EXACT


def variance_components(
    problem: Problem, data: Data, found: Reliability, factors: Mapping[str, float]
) -> dict[str, Component]:
    """The components of image coordinates (by camera), control, priors and distances; `factors`:
    by group, what the weights in `data` have been divided by (1 if not there)."""
    units = {"exterior orientation, angles": 1 / ANGLE_UNITS[problem.network.angle_unit],
             "interior orientation": np.nan}  # fmt: skip
    groups = {}
    for name, kind, rows in _groups(problem.network.cameras, problem.structure):
        weight = np.asarray(getattr(data, f"{kind}_weight"))[rows]
        v = np.asarray(getattr(found.residual, kind))[rows]
        r = np.asarray(getattr(found.redundancy, kind))[rows]
        used = weight[weight > 0]
        if used.size:
            factor = factors.get(name, 1.0)
            unit = units.get(name, 1.0) / factor
            given = float(unit / used.max()), float(unit / used.min())
            groups[name] = Component(
                used.size, float(r.sum()), float((v**2).sum()), given, factor
            )
    return groups


def _groups(cameras: Sequence[Camera], structure: Structure):
    """Name, kind and rows of every group of observations."""
    camera = np.asarray(structure.camera)
    if len(cameras) == 1 or structure.own_camera:
        yield "image coordinates", "image", np.s_[:]
    else:
        for c, given in enumerate(cameras):
            yield f"image coordinates, camera {given.id}", "image", np.flatnonzero(camera == c)
    for i, axis in enumerate("XYZ"):
        yield f"control points in {axis}", "control", np.s_[:, i]
    yield "exterior orientation, position", "exterior", np.s_[:, :3]
    yield "exterior orientation, angles", "exterior", np.s_[:, 3:]
    yield "interior orientation", "interior", np.s_[:]
    yield "distances", "distance", np.s_[:]


def rescale(
    cameras: Sequence[Camera], structure: Structure, data: Data, factors: Mapping[str, float]
) -> Data:
    """The weights with every group's σ multiplied by its factor."""
    for name, kind, rows in _groups(cameras, structure):
        if name in factors:
            field = f"{kind}_weight"
            weight = np.array(getattr(data, field))
            weight[rows] /= factors[name]
            data = eqx.tree_at(lambda d, f=field: getattr(d, f), data, jnp.asarray(weight))
    return data
