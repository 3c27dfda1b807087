"""The unknowns of further kinds of observations, by row, with σ."""

from collections.abc import Collection, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.geometry import matrix_from_quaternion, omega_phi_kappa_near
from jaxbundle.leastsquares.declarations import Table
from jaxbundle.leastsquares.solution import Solution
from jaxbundle.leastsquares.spaces import PoseValue, Rotation, Space
from jaxbundle.network.kinds.base import INSTRUMENT_ANGLES, LENGTHS
from jaxbundle.network.kinds.interfaces import PORT
from jaxbundle.network.kinds.rigs import MOUNTING
from jaxbundle.network.kinds.robot_poses import ON_BASE, ON_HAND
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray

ANGLES = ("omega", "phi", "kappa")
# Frames that are relative to a camera, or a robot, not to the origin of object space.
RELATIVE = (MOUNTING, PORT, ON_HAND, ON_BASE)


class Estimate(NamedTuple):
    """An unknown of a row: table, row, name, value, a posteriori σ (0 if held); `unit`: "length",
    "angle" (radians), "image", or "" for another or none."""

    table: str
    row: str
    name: str
    value: float
    sigma: float
    unit: str = ""


def estimates(
    solution: Solution, names: Collection[str], sigma0: float, origin: Float[np.ndarray, "3"]
) -> list[Estimate]:
    """All unknowns of some tables. Frames and poses are given as X0, Y0, Z0 in object space
    (mountings, ports and cameras of a robot in
    their own frames), ω, φ, κ."""
    all_estimates = []
    for table in (t for t in solution.problem.tables if t.name in names):
        values, Q = solution.values[table.name], np.asarray(solution.cofactor(table.name))
        numbers, A = map(np.array, _read_rows(table.space, values))
        if isinstance(values, PoseValue) and table.name not in RELATIVE:
            numbers[:, :3] += origin
        variance = np.einsum("nij,njk,nik->ni", A, Q, A)
        sigma = sigma0 * np.sqrt(np.clip(variance, 0, None))
        labels, units = _names_and_units(table, numbers.shape[1])
        all_estimates += [
            Estimate(table.name, table.label(row), *fields)
            for row in range(table.rows)
            for fields in zip(labels, numbers[row].tolist(), sigma[row].tolist(), units)
        ]
    return all_estimates


@partial(compile_once, static=0)
def _read_rows(
    space: Space, values: Any
) -> tuple[Float[Array, "rows n"], Float[Array, "rows n width"]]:
    """Every row as reported numbers [rows, n], and their derivatives by its changes [rows, n,
    width]."""

    def of_row(value: Any) -> tuple[Float[Array, " n"], Float[Array, "n width"]]:
        reference = _read_row(space, value, jnp.zeros(3))[-3:]  # of angles, the same after a change
        # σ of what is reported, by the derivative of the reported numbers along the changes: a
        # rotation changes by δθ, and is reported as angles.
        change = lambda d: _read_row(space, space.retract(value, d), reference)
        return _read_row(space, value, reference), jax.jacfwd(change)(jnp.zeros(space.width))

    return jax.vmap(of_row)(values)


def _read_row(space: Space, value: Any, reference: Float[Array, "3"]) -> Float[Array, " n"]:
    """A row as reported numbers; `reference`: choose the angles nearest to these."""
    if isinstance(value, PoseValue):
        return jnp.concatenate([value.position, _angles(value.rotation, reference)])
    if isinstance(space, Rotation):
        return _angles(value, reference)
    return jnp.concatenate([jnp.ravel(x) for x in jax.tree.leaves(value)])


def _names_and_units(table: Table, size: int) -> tuple[Sequence[str], Sequence[str]]:
    """The names of these numbers, and their units."""
    if isinstance(table.value, PoseValue):
        return ("X0", "Y0", "Z0", *ANGLES), ("length",) * 3 + ("angle",) * 3
    if isinstance(table.space, Rotation):
        return ANGLES, ("angle",) * 3
    has_names = len(table.parameters) == size
    names = table.parameters if has_names else [str(k + 1) for k in range(size)]
    if table.units:
        return names, (table.units,) * size if isinstance(table.units, str) else table.units
    unit_of: dict[str, str] = dict.fromkeys(LENGTHS, "length")
    unit_of |= dict.fromkeys(INSTRUMENT_ANGLES, "angle")
    return names, [unit_of.get(name, "") for name in names]


def _angles(q: Float[AnyArray, "4"], reference: Float[AnyArray, "3"]) -> Float[Array, "3"]:
    return omega_phi_kappa_near(matrix_from_quaternion(q), reference)
