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

import dataclasses
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxbundle import cameras
from jaxbundle.adjustment.problem import NetworkProblem
from jaxbundle.adjustment.quality.correlated_errors import stated_errors
from jaxbundle.adjustment.solve import check_given
from jaxbundle.adjustment.unknowns import angles_near, find_unknowns, value_of
from jaxbundle.errors import InputError
from jaxbundle.leastsquares.indexing.reduction import FACTORS
from jaxbundle.leastsquares.indexing.rows import Data, Values
from jaxbundle.leastsquares.problem import complete_data, with_data, with_factor
from jaxbundle.leastsquares.quality.precision import precision as engine_precision
from jaxbundle.leastsquares.quality.precision import redundancy as engine_redundancy
from jaxbundle.leastsquares.solution import Solution
from jaxbundle.leastsquares.spaces import Pose, Space
from jaxbundle.network.kinds.interfaces import MEDIA, RefractedImagePoint, Refraction
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray


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
    problem: NetworkProblem,
    data: Data | None = None,
    *,
    names: tuple[tuple[str, str, str], ...] = (),
    sigma0: float | Float[AnyArray, ""] = 1.0,
    errors: Mapping[str, float] | None = None,
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
    - `errors`: sizes of errors that image points share, by name as an adjustment lists them
      (`ErrorModel.sizes`, `error_components` in the JSON), such as
      `{"principal point by photograph": 0.2}`, in the unit of the images: those of a camera from
      earlier jobs. Outside of `jax.jit` and derivatives only.

    **Returns:** a `Precision`; all NaN if the design leaves unknowns undetermined, or a
    camera has no image of one of its targets.

    **Raises:** `InputError` if no factor of the network fits into memory, and for unknown `errors`;
    `KeyError` for an unknown name.
    """
    # Without the factor of the normal matrix there are no cofactors: it is planned for, even where
    # the iterations of an adjustment would do without.
    check_given(problem, data)
    problem, unknowns = with_factor(problem), [] if names == () else find_unknowns(problem, names)
    if problem.reduction not in FACTORS:
        raise InputError("precision: the network is too large for its covariance; use a part of it")
    data = problem.data if data is None else data

    def values_of_unknowns(values: Values) -> Float[Array, " names"]:
        return jnp.stack([value_of(problem, name, values) for name in unknowns])

    if errors is not None:
        return _under_errors(
            problem, data, values_of_unknowns if unknowns else None, float(sigma0), errors
        )
    precision_of_tables = engine_precision(
        problem, predict(problem, data), values_of_unknowns if unknowns else None
    )
    return _precision_of(
        problem, data, precision_of_tables.own, precision_of_tables.covariance, sigma0
    )


def _precision_of(
    problem: NetworkProblem,
    data: Data,
    cofactors: Mapping[str, Float[AnyArray, "rows width width"]],
    covariance: Float[AnyArray, "names names"],
    sigma0: float | Float[AnyArray, ""],
) -> Precision:
    """The precision by the covariance blocks `cofactors` of all tables, for σ0 = 1."""
    of_points = problem.cofactors_of_coordinates(data.start["point"], cofactors["point"])
    rotation = data.start["image"].rotation
    return Precision(
        images=_root(image_variances(problem.network.images.angles, rotation, cofactors["image"]))
        * sigma0,
        cameras=_camera_sigma(problem, data.start, cofactors) * sigma0,
        points=_root(jnp.diagonal(of_points, axis1=1, axis2=2)) * sigma0,
        covariance=covariance * jnp.square(sigma0),
        point_covariance=of_points * jnp.square(sigma0),
        centre_covariance=cofactors["image"][:, :3, :3] * jnp.square(sigma0),
    )


def _under_errors(
    problem: NetworkProblem,
    data: Data,
    function: Callable[[Values], Array] | None,
    sigma0: float,
    sizes: Mapping[str, float],
) -> Precision:
    """The precision under errors of these sizes that image points share."""
    predicted = with_data(problem, predict(problem, data))
    solution = Solution(predicted, data.start)
    model = stated_errors(solution, predicted, sizes, sigma0)
    covariances = {table.name: model.covariance(table.name) for table in problem.tables}
    covariance = np.zeros((0, 0)) if function is None else model.propagate(function)
    return _precision_of(problem, data, covariances, covariance, 1.0)


def redundancy(problem: NetworkProblem, data: Data | None = None) -> dict[str, Float[Array, "n r"]]:
    """The redundancy numbers of a design, differentiable to every order in all of it.

    r = 1 − diag(J·Q·Jᵀ) of every observation: 0 (uncontrolled) to 1. Use it as `precision`;
    nothing is adjusted, and image coordinates are predicted from the given values.

    **Returns:** by set of observations, such as `["image"]` [rays, 2]; 0 where the weight is 0.

    **Raises:** `InputError` if no factor of the network fits into memory.
    """
    check_given(problem, data)
    problem = with_factor(problem)
    if problem.reduction not in FACTORS:
        raise InputError("redundancy: the network is too large for its cofactors; use a part of it")
    data = problem.data if data is None else data
    predicted = complete_data(problem, predict(problem, data))
    numbers = engine_redundancy(problem.declared, problem.plan, predicted)
    return {o.name: numbers[o.name][: o.number] for o in problem.observations}


def predict(problem: NetworkProblem, data: Data) -> Data:
    """The data with image coordinates predicted from the given values."""
    measured = dict(data.measured)
    for table in problem.cameras:
        if table.image_set not in measured:
            continue
        # A rolling shutter has further tables between image and camera; the prediction is that of
        # the middle line. Those of a refracting interface bend the ray.
        image_points = problem.observations_of(table.image_set)
        image, *touched, camera, point = image_points.rows
        interior, bend = data.start[table.name], None
        if isinstance(image_points.kind.residual, RefractedImagePoint):
            bend = RayBending(
                image_points.kind.residual.refraction, problem.table(image_points.kind.of[1]).space
            )
        predicted = _project(
            cameras.get_model(table.model),
            bend,
            data.start,
            interior,
            (image, camera, point, *(touched[:1] if bend else ())),
        )
        planned = measured[table.image_set]
        measured[table.image_set] = (
            (predicted, planned[1]) if isinstance(planned, tuple) else predicted
        )
    return dataclasses.replace(data, measured=measured)


class RayBending(NamedTuple):
    """How an interface, whose table has this space, refracts a ray."""

    refraction: Refraction
    space: Space


@partial(compile_once, static=(0, 1))
def _project(
    model: cameras.CameraModel,
    bend: RayBending | None,
    values: Values,
    interior: Float[Array, "rows parameters"],
    rows: tuple[Int[Array, " rays"], ...],
) -> Float[Array, "rays 2"]:
    """The image coordinates of a set of image points: `rows` of image, camera, point, and of the
    interface where there is one."""

    def project_point(pose: Any, interior: Any, X: Any, *refraction: Any) -> Float[Array, "2"]:
        ray = Pose().prepare(pose).ray(X)
        if bend is not None:
            interface, medium = refraction
            block = bend.space.prepare(interface)
            ray = bend.refraction(Pose().prepare(pose), block, tuple(medium), tuple(X))
        return jnp.stack(cameras.project(model, interior, *ray))

    image, camera, point, *interface = rows
    rows_of = lambda name, row: jax.tree.map(lambda rows: jnp.asarray(rows)[row], values[name])
    points = jnp.asarray(values["point"])[point, :3]
    refraction = (
        [rows_of(name, interface[0]) for name in (bend.refraction.table, MEDIA)] if bend else []
    )
    return jax.vmap(project_point)(
        rows_of("image", image), jnp.asarray(interior)[camera], points, *refraction
    )


@partial(compile_once, static=())
def _root(variance: Float[AnyArray, "..."], rounding: float = 1e-14) -> Float[Array, "..."]:
    """σ, with derivative 0 where it is 0; NaN stays NaN. `rounding`: a variance below this fraction
    of the largest belongs to a coordinate that the datum holds: 0. The S-transformation leaves the
    difference of equal numbers there, about 1e-16 of the largest; the σ that is lost is below 1e-7
    of the largest."""
    # √ has an infinite derivative at 0, and 0·∞ is NaN in reverse mode: take the root of 1 there.
    is_zero = variance <= 0
    is_zero |= variance <= rounding * jax.lax.stop_gradient(jnp.max(variance, initial=0.0))
    return jnp.where(is_zero, 0.0, jnp.sqrt(jnp.where(is_zero, 1.0, variance)))


@partial(compile_once, static=())
def image_variances(
    angles: Float[AnyArray, "images 3"],
    rotation: Float[AnyArray, "images 4"],
    Q: Float[AnyArray, "images 6 6"],
) -> Float[Array, "images 6"]:
    """Variances [images, 6] of X0, Y0, Z0 and of ω, φ, κ near `angles`, by the Jacobian of the
    angles; `Q`: cofactors of the poses, `rotation`: their quaternions."""
    turn = jax.vmap(jax.jacfwd(angles_near, 1), (0, None, 0))
    A = turn(rotation, jnp.zeros(3), jnp.asarray(angles))
    of_position = jnp.diagonal(Q[:, :3, :3], axis1=1, axis2=2)
    of_angles = jnp.einsum("nij,njk,nik->ni", A, Q[:, 3:, 3:], A)
    return jnp.concatenate([of_position, of_angles], 1)


def _camera_sigma(
    problem: NetworkProblem, values: Values, cofactors: Mapping[str, Float[AnyArray, "rows k k"]]
) -> Float[Array, "cameras parameters"]:
    sigma = jnp.zeros_like(problem.interior_orientation(values))
    for table in problem.cameras:
        moves = (np.array(x, int) for x in problem.table(table.name).vector.moves)
        sigma = _with_cameras(sigma, cofactors[table.name], np.asarray(table.cameras), *moves)
    return sigma


@partial(compile_once, static=())
def _with_cameras(
    sigma: Float[Array, "cameras parameters"],
    Q: Float[AnyArray, "rows k k"],
    rows: Int[np.ndarray, " rows"],
    columns: Int[np.ndarray, " columns"],
    columns_of_root: Int[np.ndarray, " columns"],
) -> Float[Array, "cameras parameters"]:
    """σ of all cameras with those of a table."""
    root = _root(jnp.diagonal(Q, axis1=1, axis2=2), 0.0)
    return sigma.at[rows[:, None], columns].set(root[:, columns_of_root])
