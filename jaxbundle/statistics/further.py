"""The unknowns that came with further kinds of observations, row by row, with their σ."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxbundle.geometry import matrix_from_quaternion, omega_phi_kappa_near
from jaxbundle.leastsquares.solution import Solution
from jaxbundle.leastsquares.spaces import PoseValue, Rotation
from jaxbundle.network.further.rigs import MOUNTING

ANGLES = ("omega", "phi", "kappa")


class Estimate(NamedTuple):
    """An unknown of a row: table, row, name, value, σ a posteriori (0 where it is held); `angle`:
    radians."""

    table: str
    row: str
    name: str
    value: float
    sigma: float
    angle: bool = False


def estimates(found: Solution, names, sigma0: float, origin) -> list[Estimate]:
    """All unknowns of some tables. Of frames and poses X0, Y0, Z0 in object space (of mountings in
    the reference camera), ω, φ, κ."""
    every = []
    for table in (t for t in found.problem.tables if t.name in names):
        values, Q = found.values[table.name], np.asarray(found.cofactor(table.name))
        for row in range(table.rows):
            value = jax.tree.map(lambda x, row=row: jnp.asarray(x)[row], values)
            readable, labels, angles = _readable(table, value)
            zero = jnp.zeros(table.space.width)
            A = np.asarray(jax.jacfwd(lambda d: readable(table.space.retract(value, d)))(zero))  # noqa: B023
            sigma = sigma0 * np.sqrt(np.clip(np.diag(A @ Q[row] @ A.T), 0, None))
            shown = np.array(readable(value))
            if isinstance(value, PoseValue) and table.name != MOUNTING:
                shown[:3] += origin
            every += [
                Estimate(table.name, table.label(row), label, float(x), float(s), angle)
                for label, x, s, angle in zip(labels, shown, sigma, angles)
            ]
    return every


def _readable(table, value):
    """A value as numbers people read, their names, and which are angles."""
    if isinstance(value, PoseValue):
        near = _angles(value.rotation, jnp.zeros(3))
        function = lambda v: jnp.concatenate([v.position, _angles(v.rotation, near)])
        return function, ("X0", "Y0", "Z0", *ANGLES), (False,) * 3 + (True,) * 3
    if isinstance(table.space, Rotation):
        near = _angles(value, jnp.zeros(3))
        return lambda v: _angles(v, near), ANGLES, (True,) * 3
    leaves = jax.tree.leaves(value)
    size = sum(np.size(x) for x in leaves)
    names = [str(k + 1) for k in range(size)]
    if len(table.parameters) == size:
        names = list(table.parameters)
    flat = lambda v: jnp.concatenate([jnp.ravel(x) for x in jax.tree.leaves(v)])
    return flat, names, (False,) * size


def _angles(q, near):
    return omega_phi_kappa_near(matrix_from_quaternion(q), near)
