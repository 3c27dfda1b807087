"""The precision of a design: all σ as a differentiable function of the design.

    C = σ0²·S·(JᵀPJ)⁻¹·Sᵀ,        S the S-transformation into the datum (`leastsquares/datum`)

Nothing is adjusted, and no measurements are used. J is evaluated at the given values (`Data.start`:
stations, targets, cameras) with predicted image coordinates, so that it is a function of the design
only; P are the weights of the data. Planning a network requires only its visibility (the rows of
the problem). For the precision of a measured network use its adjusted values: `precision(problem,
replace(data, start=solve(…)))`.

Source: Grafarend (1974), Bollettino di Geodesia 33: design of first order (configuration, A) and of
second order (weights, P).
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbundle import cameras
from jaxbundle.adjustment.problem import Problem
from jaxbundle.adjustment.solve import check_given
from jaxbundle.adjustment.unknowns import angles_near, find_unknowns, value_of
from jaxbundle.errors import InputError
from jaxbundle.leastsquares.indexing.reduction import FACTORS
from jaxbundle.leastsquares.problem import complete_data
from jaxbundle.leastsquares.quality.precision import precision as engine_precision
from jaxbundle.leastsquares.quality.precision import redundancy as engine_redundancy
from jaxbundle.leastsquares.spaces import Pose, PoseValue
from jaxbundle.network.arrays import Data, Values
from jaxbundle.network.declare import Rows
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray

ROUNDING = 1e-14
"""A variance below this fraction of the largest of its kind belongs to a datum coordinate: 0."""


class Precision(eqx.Module):
    """σ of all unknowns, 0 if held, and the covariance of the named ones.

    `images`: of X0, Y0, Z0 (object unit) and ω, φ, κ (radians); `cameras`: in the order of the
    parameters of the model, in their units; `points`: of X, Y, Z (object unit).
    `point_covariance` of X, Y, Z; `centre_covariance` of X0, Y0, Z0.
    """

    images: Float[AnyArray, "images 6"]
    cameras: Float[AnyArray, "cameras parameters"]
    points: Float[AnyArray, "points 3"]
    covariance: Float[AnyArray, "names names"]
    point_covariance: Float[AnyArray, "points 3 3"]
    centre_covariance: Float[AnyArray, "images 3 3"]


def precision(
    problem: Problem,
    data: Data | None = None,
    *,
    names: tuple[tuple[str, str, str], ...] = (),
    sigma0: float | Float[AnyArray, ""] = 1.0,
) -> Precision:
    """The precision of a design, differentiable to any order.

    Use it under `jax.jit`, `jax.vmap`, `jax.grad`, `jax.jacfwd` and `jax.jacrev`: `data.start`
    holds the design (stations, targets, cameras), the other fields its weights (1/σ).

    **Arguments:**

    - `problem`: from `make_problem`; it defines visibility, free unknowns, and the datum.
    - `data`: numbers that replace `problem.data` (same shapes); object coordinates relative to
      `problem.origin`. Image coordinates in it are not used.
    - `names`: unknowns for the covariance, as in `Adjustment.covariance`:
      `("camera", "cam", "c")`, `("image", "12", "kappa")`, `("point", "7", "Z")`.
    - `sigma0`: of the unit weight; 1: a priori.

    **Returns:** a `Precision`; all NaN if the design leaves unknowns undetermined, or a
    camera has no image of one of its targets.

    **Raises:** `InputError` if no factor of the network fits into memory; `KeyError` for an unknown
    name.
    """
    check_given(problem, data)
    problem, wanted = problem.with_factor(), [] if names == () else find_unknowns(problem, names)
    if problem.reduction not in FACTORS:
        raise InputError("precision: the network is too large for its covariance; use a part of it")
    data = problem.data if data is None else data

    def of(tables):
        values = problem.layout.values(tables)
        return jnp.stack([value_of(problem, name, values) for name in wanted])

    found = engine_precision(
        problem.system, problem.layout.data(predict(problem, data)), of if wanted else None
    )
    of_points = problem.layout.coordinate_cofactors(data.start.point, found.own["point"])
    return Precision(
        images=_root(
            image_variances(problem.network.images.angles, data.start.rotation, found.own["image"])
        )
        * sigma0,
        cameras=_camera_sigma(problem, data.start, found.own) * sigma0,
        points=_root(jnp.diagonal(of_points, axis1=1, axis2=2)) * sigma0,
        covariance=found.covariance * jnp.square(sigma0),
        point_covariance=of_points * jnp.square(sigma0),
        centre_covariance=found.own["image"][:, :3, :3] * jnp.square(sigma0),
    )


def redundancy(problem: Problem, data: Data | None = None) -> Rows:
    """The redundancy numbers of a design, differentiable to every order in all of it.

    r = 1 − diag(J·Q·Jᵀ) of every observation: 0 (uncontrolled) to 1. Use it as `precision`;
    nothing is adjusted, and image coordinates are predicted from the given values.

    **Returns:** `Rows`: `image` [rays, 2], `control`, `exterior`, `interior`, `distance` and
    `other` in the order of `Data`; 0 where the weight is 0.

    **Raises:** `InputError` if no factor of the network fits into memory.
    """
    check_given(problem, data)
    problem = problem.with_factor()
    if problem.reduction not in FACTORS:
        raise InputError("redundancy: the network is too large for its cofactors; use a part of it")
    data, system = problem.data if data is None else data, problem.system
    given = complete_data(system, problem.layout.data(predict(problem, data)))
    found = engine_redundancy(system.declared, system.plan, given)
    found = {o.name: found[o.name][: o.number] for o in system.observations}
    return problem.layout.rows(found, data)


def predict(problem: Problem, data: Data) -> Data:
    """The data with image coordinates predicted from the given values."""
    xy = data.image_xy
    for table in problem.layout.cameras:
        rows = np.flatnonzero(np.isin(problem.camera, table.cameras))
        touched = (index[rows] for index in (problem.image, problem.camera, problem.point))
        xy = _project(cameras.get_model(table.model), data.start, xy, rows, *touched)
    return eqx.tree_at(lambda d: d.image_xy, data, xy)


@partial(compile_once, static=0)
def _project(model, values: Values, xy, rows, image, camera, point):
    """The image coordinates with those of `rows` computed."""

    def one(pose, interior, X):
        interior = interior[: len(model.parameters)]
        return jnp.stack(cameras.project(model, interior, *Pose().prepare(pose).ray(X)))

    poses = PoseValue(values.position[image], values.rotation[image])
    found = jax.vmap(one)(poses, values.camera[camera], values.point[point])
    return jnp.asarray(xy).at[rows].set(found)


@partial(compile_once, static=())
def _root(variance, rounding=ROUNDING):
    """σ, with derivative 0 where it is 0; NaN stays NaN. `rounding`: see `ROUNDING`."""
    none = variance <= 0
    none |= variance <= rounding * jax.lax.stop_gradient(jnp.max(variance, initial=0.0))
    return jnp.where(none, 0.0, jnp.sqrt(jnp.where(none, 1.0, variance)))


@partial(compile_once, static=())
def image_variances(angles, rotation, Q):
    """Variances [images, 6] of X0, Y0, Z0 and of ω, φ, κ near `angles`, by the Jacobian of the
    angles; `Q`: cofactors of the poses, `rotation`: their quaternions."""
    turn = jax.vmap(jax.jacfwd(angles_near, 1), (0, None, 0))
    A = turn(rotation, jnp.zeros(3), jnp.asarray(angles))
    of_position = jnp.diagonal(Q[:, :3, :3], axis1=1, axis2=2)
    of_angles = jnp.einsum("nij,njk,nik->ni", A, Q[:, 3:, 3:], A)
    return jnp.concatenate([of_position, of_angles], 1)


def _camera_sigma(problem: Problem, values: Values, own):
    sigma = jnp.zeros_like(values.camera)
    for table in problem.layout.cameras:
        moves = map(np.array, problem.system.table(table.name).vector.moves)
        sigma = _with_cameras(sigma, own[table.name], np.asarray(table.cameras), *moves)
    return sigma


@partial(compile_once, static=())
def _with_cameras(sigma, Q, rows, columns, of):
    """σ of all cameras with those of a table."""
    root = _root(jnp.diagonal(Q, axis1=1, axis2=2), 0.0)
    return sigma.at[rows[:, None], columns].set(root[:, of])
