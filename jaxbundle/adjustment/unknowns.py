"""Names for the columns of the adjustment, for people: which image, which parameter."""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxbundle.adjustment.jacobian import jacobian
from jaxbundle.adjustment.normal import normal_from_jacobian
from jaxbundle.adjustment.problem import Problem
from jaxbundle.adjustment.schur import scaled_matrix
from jaxbundle.arguments import shown
from jaxbundle.cameras import get_model
from jaxbundle.errors import InputError
from jaxbundle.geometry import (
    matrix_from_quaternion,
    omega_phi_kappa_near,
    retract_quaternion,
)
from jaxbundle.network.arrays import Data, Values
from jaxbundle.network.columns import did_you_mean
from jaxbundle.network.tables import EXTERIOR

INDETERMINATE = 1e-12
"""Scaled eigenvalues of the normal matrix below this are rounding: nothing determines them."""


@dataclasses.dataclass(frozen=True)
class Name:
    """One unknown: kind (camera, image or point), the id of the thing, the parameter."""

    kind: str
    id: str
    parameter: str

    def __str__(self) -> str:
        return f"{self.parameter} of {self.kind} {self.id}"


def reduced_names(problem: Problem) -> list[Name]:
    """Names of the reduced system's columns, in its order: images, cameras, kept points."""
    s, network = problem.structure, problem.network
    names = []
    for i, image in enumerate(network.images.id):
        names += [Name("image", image, p) for p in EXTERIOR]
        if s.own_camera:
            names += interior_names(problem, i)
    if s.camera_width:
        for c in range(s.cameras):
            names += interior_names(problem, c)
    for p in np.asarray(s.kept):
        names += [Name("point", network.points.id[p], axis) for axis in "XYZ"]
    return names


def interior_names(problem: Problem, c: int) -> list[Name]:
    """Names of a camera's interior columns (held ones too)."""
    camera = problem.network.cameras[c]
    parameters = get_model(camera.model).parameters
    columns = np.asarray(problem.structure.camera_columns)[c]
    return [Name("camera", camera.id, parameters[column]) for column in columns]


def named(problem: Problem, names: Sequence[tuple[str, str, str]]) -> list[Name]:
    """Unknowns by name, e.g. `("camera", "cam", "c")`, `("image", "12", "kappa")`,
    `("point", "7", "Z")`.

    **Raises:** `InputError` where nothing is named, or a name has other than three parts;
    `KeyError` for a name that is not there."""
    for name in names or (None,):
        if isinstance(name, str) or np.shape(name) != (3,):
            given = "none is given" if name is None else f"one is {shown(name)}"
            raise InputError(
                'covariance: names of unknowns are expected, such as ("camera", "cam", "c") or '
                f'("point", "7", "Z"), but {given}'
            )
    wanted = [Name(*map(str, name)) for name in names]
    for name in wanted:
        value_of(problem, name, problem.data.start)
    return wanted


def value_of(problem: Problem, name: Name, values: Values):
    """The unknown of this name; of an exterior orientation X0, Y0, Z0, ω, φ, κ (radians).

    **Raises:** `KeyError` for a name that is not there."""
    network = problem.network
    if name.kind == "camera":
        c = place_of(name.id, [camera.id for camera in network.cameras], "camera")
        parameters = get_model(network.cameras[c].model).parameters
        return values.camera[c, place_of(name.parameter, parameters, "camera parameter")]
    if name.kind == "image":
        i = place_of(name.id, network.images.id, "image")
        angles = angles_near(values.rotation[i], jnp.zeros(3), network.images.angles[i])
        pose = jnp.concatenate([values.position[i], angles])
        return pose[place_of(name.parameter, EXTERIOR, "image parameter")]
    if name.kind == "point":
        p = place_of(name.id, network.points.id, "point")
        return values.point[p, place_of(name.parameter, ("X", "Y", "Z"), "coordinate")]
    raise KeyError(f"an unknown is of a camera, an image or a point, not of a {name.kind!r}")


def angles_near(rotation, d_theta, given):
    """ω, φ, κ after a small rotation, on the turn and branch of the given ones."""
    return omega_phi_kappa_near(
        matrix_from_quaternion(retract_quaternion(rotation, d_theta)), given
    )


def place_of(name: str, names: Sequence[str], thing: str) -> int:
    """The place of a name among others.

    **Raises:** `KeyError` where it is not there, with the nearest one that is."""
    if name not in names:
        known = did_you_mean(name, names, listing=len(names) <= 20)
        raise KeyError(f"there is no {thing} {name!r}{known}")
    return names.index(name)


def undetermined(problem: Problem, values: Values, data: Data) -> list[str]:
    """The unknowns that the observations do not determine, most affected first."""
    matrix, V = _scaled_reduced(problem.structure, values, data)
    matrix = np.tril(matrix) + np.tril(matrix, -1).T
    points = _undetermined_points(problem, np.asarray(V))
    if not np.isfinite(matrix).all():
        return points
    eigenvalues, vectors = np.linalg.eigh(matrix)
    null = vectors[:, eigenvalues < INDETERMINATE * max(1.0, eigenvalues[-1])]
    share = (null**2).sum(1)
    names = reduced_names(problem)
    order = np.argsort(-share, kind="stable")
    return [str(names[i]) for i in order if share[i] > 0.05] + points


@eqx.filter_jit
def _scaled_reduced(structure, values, data):
    normal = normal_from_jacobian(jacobian(structure, values, data))
    return scaled_matrix(structure, normal), normal.point


def _undetermined_points(problem: Problem, V) -> list[str]:
    finite = np.isfinite(V).all((1, 2))
    V = np.where(finite[:, None, None], V, np.eye(3))
    diagonal = np.diagonal(V, axis1=1, axis2=2)
    free = np.asarray(problem.structure.eliminated)[:, 0] > 0
    scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    smallest = np.linalg.eigvalsh(V * scale[:, :, None] * scale[:, None, :])[:, 0]
    weak = np.flatnonzero(free & finite & (smallest < INDETERMINATE))
    return [f"X, Y, Z of point {problem.network.points.id[p]}" for p in weak]
