"""Held quantities of an adjustment by name, and errors of given σ in them."""

import dataclasses
from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.adjustment.problem import NetworkProblem
from jaxbundle.adjustment.unknowns import require_located
from jaxbundle.arguments import number, positive, show
from jaxbundle.errors import InputError
from jaxbundle.geometry import (
    matrix_from_quaternion,
    omega_phi_kappa_near,
    retract_quaternion,
)
from jaxbundle.leastsquares.declarations import Table
from jaxbundle.leastsquares.indexing.rows import Values
from jaxbundle.leastsquares.quality.names import Name
from jaxbundle.leastsquares.quality.sensitivity import Change
from jaxbundle.leastsquares.spaces import Pose, PoseValue, Rotation, Vector
from jaxbundle.network.columns import did_you_mean, list_some
from jaxbundle.network.kinds.base import ANGLES
from jaxbundle.network.tables import EXTERIOR
from jaxbundle.system.programs import compile_once

# Wildcard for all ids, or all names, of held quantities.
WILDCARD = "*"
ANGLES_OF_POSES = EXTERIOR[3:]


@dataclasses.dataclass(frozen=True)
class Cause:
    """A held quantity with an error: its `name`, in words; σ of the error (None for common errors),
    radians for an `angle`; the independent errors, each a change of held values by one σ."""

    name: str
    words: str
    sigma: float | None
    angle: bool
    errors: tuple[Change, ...]


def find_causes(problem: NetworkProblem, values: Values, held: Mapping[Any, Any]) -> list[Cause]:
    """Held quantities by names KIND:ID:NAME, texts or tuples; `values`: the engine's tables.

    **Raises:** `InputError` for an unknown or estimated quantity, and for a σ that is not
    positive."""
    if not isinstance(held, Mapping) or not held:
        raise InputError(
            'held: expected σ of held quantities by name, such as {"camera:cam:K3": 1e-6}; '
            f"got {show(held)}"
        )
    return [_cause(problem, values, name, amount) for name, amount in held.items()]


def _cause(problem: NetworkProblem, values: Values, name: Any, amount: Any) -> Cause:
    if isinstance(amount, Mapping):
        return _common(problem, values, str(name), amount)
    kind, id, parameter = split_name(name)
    text = ":".join((kind, id, parameter))
    sigma = positive(f"the σ of {text}", amount)
    places = _held_places(problem, kind, id, parameter)
    errors = tuple(
        ((table.name, row, _scale(sigma, _direction(table, values, row, column))),)
        for table, row, column, _ in places
    )
    # σ is that of one error; a name with * stands for as many independent errors.
    table, row, _, parameter_name = places[0]
    words = f"{parameter_name} of {table.title} {table.label(row)}"
    if len(places) > 1:
        words = f"{len(places)} × {text}"
    angle = all(parameter_name in ANGLES for *_, parameter_name in places)
    return Cause(text, words, sigma, angle, errors)


def _common(problem: NetworkProblem, values: Values, name: str, amounts: Mapping) -> Cause:
    """One error common to many held quantities: by name, the change of each."""
    change = []
    for full_name, amount in amounts.items():
        kind, id, parameter = split_name(full_name)
        amount = number(f"{name}, {':'.join((kind, id, parameter))}", amount)
        change += [
            (table.name, row, _scale(amount, _direction(table, values, row, column)))
            for table, row, column, _ in _held_places(problem, kind, id, parameter)
        ]
    if not change:
        raise InputError(f"held: {name!r} changes nothing")
    return Cause(name, name, None, False, (tuple(change),))


def split_name(name: Any) -> tuple[str, str, str]:
    """KIND:ID:NAME in three; an id may contain colons.

    **Raises:** `InputError`."""
    parts = name
    if isinstance(name, str):
        kind, _, after_kind = name.partition(":")
        id, _, parameter = after_kind.rpartition(":")
        parts = kind, id, parameter
    if not isinstance(parts, tuple) or len(parts) != 3 or not all(map(str, parts)):
        raise InputError(f"{show(name)}: expected KIND:ID:NAME, such as camera:cam:K3 or point:*:Z")
    kind, id, parameter = map(str, parts)
    return kind, id, parameter


def _held_places(
    problem: NetworkProblem, kind: str, id: str, parameter: str
) -> list[tuple[Table, int, int, str]]:
    """Table, row, column and name of every held quantity of this name."""
    text, estimated = ":".join((kind, id, parameter)), []
    if kind == "point" and id in problem.network.points.id:
        require_located(problem, Name(kind, id, parameter))
    tables = _tables_of(problem, kind)
    points = np.flatnonzero(~problem.excluded).tolist()
    rows_of = lambda table: points if table.name == "point" else range(table.rows)
    ids = [table.label(row) for table in tables for row in rows_of(table)]
    if id != WILDCARD and id not in ids:
        raise InputError(
            f"{text}: there is no {kind} {id!r}{did_you_mean(id, ids, listing=len(ids) <= 20)}"
        )
    known_names, held_places = [], []
    for table in tables:
        names = _names(problem, table)
        known_names += [name for name in names if name not in known_names]
        for row in rows_of(table):
            if id not in (WILDCARD, table.label(row)):
                continue
            for column, parameter_name in enumerate(names):
                if parameter not in (WILDCARD, parameter_name):
                    continue
                place = table, row, column, parameter_name
                (estimated if _is_free(table, row, column) else held_places).append(place)
    if not held_places and not estimated:
        raise InputError(f"{text}: there is no {parameter!r}{did_you_mean(parameter, known_names)}")
    if not held_places:
        raise InputError(
            f"{text}: is estimated, and its σ is in the result; a budget is for held quantities"
        )
    return held_places


def _tables_of(problem: NetworkProblem, kind: str) -> list[Table]:
    tables = problem.tables
    tables_of_kind = [t for t in tables if t.title == kind or t.name == kind]
    if kind == "camera":
        tables_of_kind = [problem.table(t.name) for t in problem.cameras]
    if not tables_of_kind:
        known_kinds = dict.fromkeys(["camera", "image", "point", *(t.name for t in tables)])
        raise InputError(f"held: unknown kind {kind!r}; known: {list_some(known_kinds, 12, str)}")
    return tables_of_kind


def _names(problem: NetworkProblem, table: Table) -> tuple[str, ...]:
    """The names of the numbers of a row."""
    for camera in problem.cameras:
        if camera.name == table.name:
            return camera.parameters
    if isinstance(table.value, PoseValue):
        return EXTERIOR
    if isinstance(table.space, Rotation):
        return ANGLES_OF_POSES
    if table.name == "point":
        return ("X", "Y", "Z")
    if isinstance(table.space, Vector) and len(table.parameters) == max(table.space.size, 1):
        return table.parameters
    return tuple(map(str, range(1, max(np.shape(table.value)[1:] or (1,)) + 1)))


def _is_free(table: Table, row: int, column: int) -> bool:
    """Whether a number of a row is estimated. The columns of `free` are directions of change, which
    are the numbers of a row only where these add: an angle is free if any rotation is."""
    free = table.free[row] > 0
    if isinstance(table.space, Pose):
        return bool(free[column] if column < 3 else free[3:].any())
    if isinstance(table.space, Vector):
        return any(free[k] for moved_column, k in zip(*table.space.moves) if moved_column == column)
    return bool(free.any())


def _direction(table: Table, values: Values, row: int, column: int) -> Any:
    """The change of a row's value with one of its numbers: that number, or for an angle the unit
    quaternion."""
    value = jax.tree.map(lambda x: np.asarray(x)[row], values[table.name])
    if isinstance(value, PoseValue):
        zero = jax.tree.map(np.zeros_like, value)
        if column < 3:
            return zero._replace(position=np.eye(3)[column])
        return zero._replace(rotation=np.asarray(_turns(value.rotation))[column - 3])
    if isinstance(table.space, Rotation):
        return np.asarray(_turns(value))[column]
    return np.ones(()) if np.ndim(value) == 0 else np.eye(len(value))[column]


@partial(compile_once, static=())
def _turns(rotation: Float[Array, "4"]) -> Float[Array, "3 4"]:
    """∂q/∂(ω, φ, κ) of a unit quaternion, one row per angle: via a small rotation δθ, whose
    derivative of the angles is invertible."""

    def angles_and_quaternion(d: Float[Array, "3"]) -> tuple[Float[Array, "3"], Float[Array, "4"]]:
        q = retract_quaternion(rotation, d)
        return omega_phi_kappa_near(matrix_from_quaternion(q), jnp.zeros(3)), q

    of_angles, of_quaternion = jax.jacfwd(angles_and_quaternion)(jnp.zeros(3))
    return (of_quaternion @ jnp.linalg.inv(of_angles)).T


def _scale(factor: float, direction: Any) -> Any:
    return jax.tree.map(lambda x: factor * x, direction)
