"""Variance components: does each group of observations keep the precision it was given?

    σ̂²_g = (vᵀPv)_g / r_g,    r_g = Σ redundancy numbers of the group

(Förstner 1979). A value near 1 confirms the a priori σ of the group. Estimation repeats: scale
the σ of every group by σ̂_g, adjust again, until all components are 1.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxbundle.adjustment.problem import Problem
from jaxbundle.network.arrays import Data
from jaxbundle.statistics.reliability import Reliability

LEAST_REDUNDANCY = 1.0
"""A group with less redundancy than this has no usable component."""


@dataclasses.dataclass(frozen=True)
class Component:
    """A group of observations: how many, their redundancy, vᵀPv, and σ̂ relative to a priori."""

    observations: int
    redundancy: float
    vtpv: float

    @property
    def sigma(self) -> float:
        """σ̂_g: estimated over a priori standard deviation; NaN with too little redundancy."""
        if self.redundancy < 1e-6:
            return float("nan")
        return float(np.sqrt(self.vtpv / self.redundancy))


def variance_components(problem: Problem, data: Data, found: Reliability) -> dict[str, Component]:
    """The components of image coordinates (by camera), control, priors and distances."""
    groups = {}
    for name, kind, rows in _groups(problem):
        weight = np.asarray(getattr(data, f"{kind}_weight"))[rows]
        v = np.asarray(getattr(found.residual, kind))[rows]
        r = np.asarray(getattr(found.redundancy, kind))[rows]
        number = int((weight > 0).sum())
        if number:
            groups[name] = Component(number, float(r.sum()), float((v**2).sum()))
    return groups


def _groups(problem: Problem):
    """Name, kind and rows of every group of observations."""
    cameras = problem.network.cameras
    camera = np.asarray(problem.structure.camera)
    if len(cameras) == 1 or problem.structure.own_camera:
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


def rescale(problem: Problem, data: Data, components: dict[str, Component]) -> Data:
    """The weights with every group's σ multiplied by its component."""
    for name, kind, rows in _groups(problem):
        component = components.get(name)
        if component is None or component.redundancy < LEAST_REDUNDANCY:
            continue
        field = f"{kind}_weight"
        weight = np.array(getattr(data, field))
        weight[rows] /= component.sigma
        data = eqx.tree_at(lambda d, f=field: getattr(d, f), data, jnp.asarray(weight))
    return data
