"""Unknowns of a network by name."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.adjustment.problem import NetworkProblem
from jaxbundle.arguments import show
from jaxbundle.cameras import get_model
from jaxbundle.errors import InputError
from jaxbundle.geometry import (
    matrix_from_quaternion,
    omega_phi_kappa_near,
    retract_quaternion,
)
from jaxbundle.leastsquares.indexing.rows import Values
from jaxbundle.leastsquares.quality.names import Name
from jaxbundle.network.columns import did_you_mean
from jaxbundle.network.tables import EXTERIOR
from jaxbundle.types import AnyArray


def find_unknowns(problem: NetworkProblem, names: Sequence[tuple[str, str, str]]) -> list[Name]:
    """Unknowns by name, e.g. `("camera", "cam", "c")`, `("image", "12", "kappa")`,
    `("point", "7", "Z")`.

    **Raises:** `InputError` without names, or for a name that does not have three parts; `KeyError`
    for an unknown name."""
    if not isinstance(names, list | tuple):
        raise InputError(f"covariance: expected a list of names, got {show(names)}")
    requested: Sequence[Any] = names or (None,)
    for name in requested:
        if name is None or isinstance(name, str) or np.shape(name) != (3,):
            fault = "none is given" if name is None else f"one is {show(name)}"
            raise InputError(
                'covariance: expected names of unknowns, such as ("camera", "cam", "c") or '
                f'("point", "7", "Z"), but {fault}'
            )
    unknowns = [Name(*map(str, name)) for name in names]
    for name in unknowns:
        value_of(problem, name, problem.data.start)
    return unknowns


def require_located(problem: NetworkProblem, name: Name) -> None:
    """Refuse an unknown of a point that data snooping excluded; apart from `find_unknowns`, which
    serves designs too, where nothing is excluded.

    **Raises:** `InputError`."""
    if name.kind == "point" and problem.excluded[problem.network.points.id.index(name.id)]:
        raise InputError(f"point {name.id} was excluded by data snooping: it has no coordinates")


def value_of(problem: NetworkProblem, name: Name, values: Values):
    """The unknown with this name; exterior orientation as X0, Y0, Z0, ω, φ, κ (radians).

    **Raises:** `KeyError` for an unknown name."""
    network = problem.network
    if name.kind == "camera":
        c = place_of(name.id, [camera.id for camera in network.cameras], "camera")
        parameters = get_model(network.cameras[c].model).parameters
        table, row = problem.table_of_camera(c)
        return values[table.name][row, place_of(name.parameter, parameters, "camera parameter")]
    if name.kind == "image":
        i = place_of(name.id, network.images.id, "image")
        position, rotation = values["image"]
        angles = angles_near(rotation[i], jnp.zeros(3), network.images.angles[i])
        pose = jnp.concatenate([position[i], angles])
        return pose[place_of(name.parameter, EXTERIOR, "image parameter")]
    if name.kind == "point":
        p = place_of(name.id, network.points.id, "point")
        return values["point"][p, place_of(name.parameter, ("X", "Y", "Z"), "coordinate")]
    raise KeyError(
        f"an unknown is of a 'camera', an 'image' or a 'point', not of {name.kind!r}: give its "
        "kind, its id and its parameter"
    )


def angles_near(
    rotation: Float[AnyArray, "4"], d_theta: Float[AnyArray, "3"], reference: Float[AnyArray, "3"]
) -> Float[Array, "3"]:
    """ω, φ, κ after a small rotation, on the same turn and branch as the given ones."""
    # ω, φ, κ jump by whole turns and have two branches: reported angles stay near those of the
    # network.
    return omega_phi_kappa_near(
        matrix_from_quaternion(retract_quaternion(rotation, d_theta)), reference
    )


def place_of(name: str, names: Sequence[str], thing: str) -> int:
    """The index of a name.

    **Raises:** `KeyError` if it is missing, with the closest existing name."""
    if name not in names:
        suggestion = did_you_mean(name, names, listing=len(names) <= 20)
        raise KeyError(f"there is no {thing} {name!r}{suggestion}")
    return names.index(name)
