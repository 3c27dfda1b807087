"""The precision of a design: σ of everything as a differentiable function of the design.

    C = σ0²·S·(JᵀPJ)⁻¹·Sᵀ,        S the S-transformation into the datum (`datum.py`)

Nothing is adjusted, and no measurement enters. J is taken at the given values (`Data.start`:
stations, targets, cameras), with image coordinates that are predicted from them, so that it is a
function of the design alone; P are the weights of the data. So a network needs no measurements to
be planned, only who sees whom (the rows of the problem). The precision of a network that was
measured is that of its adjusted values: `precision(problem, replace(data, start=solve(…)))`.

Source: Grafarend (1974), Bollettino di Geodesia 33: design of first order (configuration, A) and of
second order (weights, P).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbundle import cameras
from jaxbundle.adjustment.jacobian import zero_tangent
from jaxbundle.adjustment.problem import Problem, with_factor
from jaxbundle.adjustment.residuals import gather_groups, over_rays
from jaxbundle.adjustment.unknowns import angles_near, named, value_of
from jaxbundle.arguments import shown
from jaxbundle.errors import InputError
from jaxbundle.network.arrays import Data, Values, retract
from jaxbundle.network.reduction import FACTORS
from jaxbundle.network.structure import Structure
from jaxbundle.statistics.cofactors import cofactors, propagate, undamped_factor
from jaxbundle.statistics.inspection import DETERMINED

ROUNDING = 1e-14
"""A variance below this fraction of the largest of its kind is that of what the datum holds: 0."""


class Precision(eqx.Module):
    """σ of all unknowns, 0 where something is held, and the covariance of the named ones.

    `images`: of X0, Y0, Z0 (object unit) and ω, φ, κ (radians); `cameras`: in the order of the
    parameters of the model, in their units; `points`: of X, Y, Z (object unit).
    """

    images: Float[Array, "images 6"]
    cameras: Float[Array, "cameras parameters"]
    points: Float[Array, "points 3"]
    covariance: Float[Array, "names names"]


def precision(
    problem: Problem,
    data: Data | None = None,
    *,
    names: tuple[tuple[str, str, str], ...] = (),
    sigma0: float | Float[Array, ""] = 1.0,
) -> Precision:
    """The precision of a design, differentiable to every order in all of it.

    Use it under `jax.jit`, `jax.vmap`, `jax.grad`, `jax.jacfwd` and `jax.jacrev`: `data.start`
    holds the design (stations, targets, cameras), the other fields its weights (1/σ).

    **Arguments:**

    - `problem`: from `make_problem`; it says who sees whom, what is free, and the datum.
    - `data`: numbers that replace `problem.data` (same shapes); object coordinates relative to
      `problem.origin`. Image coordinates in it are not used.
    - `names`: unknowns whose covariance is wanted, as in `Adjustment.covariance`:
      `("camera", "cam", "c")`, `("image", "12", "kappa")`, `("point", "7", "Z")`.
    - `sigma0`: of the unit weight; 1: a priori.

    **Returns:** a `Precision`; NaN throughout where the design does not determine everything, or a
    camera has no image of one of its targets.

    **Raises:** `InputError` where no factor of the network fits into memory; `KeyError` for a name
    that is not there.
    """
    if not isinstance(problem, Problem):
        raise InputError(
            f"problem must be what jaxbundle.make_problem gives, but is {shown(problem)}"
        )
    if data is not None and not isinstance(data, Data):
        raise InputError(f"data must be a Data, as problem.data is one, but is {shown(data)}")
    problem, wanted = with_factor(problem), named(problem, names) if names else []
    if problem.structure.reduction not in FACTORS:
        raise InputError("precision: the network is too large for its covariance; take part of it")
    s, data = problem.structure, problem.data if data is None else data
    values = data.start
    factor = undamped_factor(s, values, _predicted(s, data))
    sound = jnp.all(factor.reduced.pivots**2 > DETERMINED)
    found = cofactors(s, values, factor)
    parts = Precision(
        images=_root(_image_variances(problem, values, found.image)),
        cameras=_camera_sigma(s, values, found),
        points=_root(jnp.diagonal(found.point, axis1=1, axis2=2)),
        covariance=_covariance(problem, values, factor, wanted),
    )
    unit = sigma0 * jnp.where(sound, 1.0, jnp.nan)
    scales = Precision(unit, unit, unit, unit**2)
    return jax.tree.map(jnp.multiply, parts, scales)


@eqx.filter_jit
def _predicted(s: Structure, data: Data) -> Data:
    """The data with the image coordinates that the given values have."""
    parts = []
    for group in s.groups:
        model = cameras.get_model(group.model)

        def one(rotation, centre, interior, point, xy, weight, model=model):
            sight = [p - c for p, c in zip(point, centre)]
            ray = (sum(m * x for m, x in zip(rotation[3 * i : 3 * i + 3], sight)) for i in range(3))
            return cameras.project(model, interior, *ray)

        parts.append(jnp.stack(over_rays(s, group, one, data.start, data), -1))
    return eqx.tree_at(lambda d: d.image_xy, data, gather_groups(s, parts))


def _root(variance):
    """σ; where it is 0 its derivative is 0 too."""
    good = variance > ROUNDING * jax.lax.stop_gradient(jnp.max(variance, initial=0.0))
    return jnp.where(good, jnp.sqrt(jnp.where(good, variance, 1.0)), 0.0)


def _image_variances(problem: Problem, values: Values, Q):
    """Variances of X0, Y0, Z0 and of ω, φ, κ, by the Jacobian of the angles."""
    free = problem.structure.image_free
    Q = Q[:, :6, :6] * free[:, :, None] * free[:, None, :]
    turn = jax.vmap(jax.jacfwd(angles_near, 1), (0, None, 0))
    A = turn(values.rotation, jnp.zeros(3), jnp.asarray(problem.network.images.angles))
    of_position = jnp.diagonal(Q[:, :3, :3], axis1=1, axis2=2)
    of_angles = jnp.einsum("nij,njk,nik->ni", A, Q[:, 3:, 3:], A)
    return jnp.concatenate([of_position, of_angles], 1)


def _camera_sigma(s: Structure, values: Values, found):
    sigma = jnp.zeros_like(values.camera)
    if not s.interior_width:
        return sigma
    Q = found.image[:, 6:, 6:] if s.own_camera else found.camera
    variance = jnp.diagonal(Q, axis1=1, axis2=2) * s.camera_free
    root = jnp.where(variance > 0, jnp.sqrt(jnp.where(variance > 0, variance, 1.0)), 0.0)
    return sigma.at[jnp.arange(s.cameras)[:, None], s.camera_columns].add(root)


def _covariance(problem: Problem, values: Values, factor, wanted):
    if not wanted:
        return jnp.zeros((0, 0))
    s = problem.structure

    def of_change(change):
        moved = retract(s, values, change)
        return jnp.stack([value_of(problem, name, moved) for name in wanted])

    return propagate(s, values, factor, jax.jacrev(of_change)(zero_tangent(s)))
