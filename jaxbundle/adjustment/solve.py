"""`solve`: arrays in, adjusted arrays out, differentiable, under jit and vmap."""

from typing import get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxbundle.adjustment import schur
from jaxbundle.adjustment.datum import move_to_datum
from jaxbundle.adjustment.jacobian import jacobian
from jaxbundle.adjustment.normal import gradient, normal_from_jacobian
from jaxbundle.adjustment.problem import Problem
from jaxbundle.adjustment.residuals import residuals
from jaxbundle.adjustment.sensitivity import Sensitivity, attach_derivatives
from jaxbundle.adjustment.solver import (
    INEXACT,
    BundleSolver,
    FullStep,
    Minimum,
    TrustRegion,
    minimise,
)
from jaxbundle.arguments import one_of, positive, shown, whole
from jaxbundle.errors import InputError
from jaxbundle.network.arrays import Data, Values, retract_about
from jaxbundle.network.structure import Structure

METHODS = {"levenberg-marquardt": TrustRegion(), "gauss-newton": FullStep()}


def make_solver(problem: Problem, method: str = "levenberg-marquardt", **options) -> BundleSolver:
    """The solver of a problem; `options` are those of `BundleSolver`."""
    one_of("method", method, tuple(METHODS))
    redundancy = jax.device_put(np.float64(problem.counts.redundancy))
    return BundleSolver(problem.structure, redundancy, METHODS[method], **options)


@eqx.filter_jit
def find_minimum(solver: BundleSolver, data: Data, start: Values | None = None) -> Minimum:
    """Run the solver and put its result into the datum; compiled once for each shape.

    `start` replaces the start values of the iteration, not those the datum refers to.
    """
    minimum = minimise(solver, data, data.start if start is None else start)
    values = move_to_datum(solver.structure, minimum.values, data.start)
    return eqx.tree_at(lambda m: m.values, minimum, values)


@eqx.filter_jit
def take_step(structure: Structure, values: Values, data: Data) -> Values:
    """The unknowns after one undamped Gauss–Newton step, near a solution; NaN if singular."""
    jac = jacobian(structure, values, data)
    g = gradient(jac, residuals(structure, values, data))
    factor = schur.factorise(structure, normal_from_jacobian(jac), tolerance=INEXACT)
    change = schur.solve(factor, jax.tree.map(jnp.negative, g))
    return retract_about(structure, values, change)


def solve(
    problem: Problem,
    data: Data | None = None,
    *,
    sensitivity: Sensitivity = "exact",
    method: str = "levenberg-marquardt",
    max_iterations: int = 100,
    atol: float = 1e-7,
) -> Values:
    """Adjusted unknowns as a differentiable function of the observations and all that is given.

    Use it under `jax.jit`, `jax.vmap` (over any field of `data`), `jax.grad`, `jax.jacfwd` and
    `jax.jacrev`, one inside the other to any order.

    **Arguments:**

    - `problem`: from `make_problem`.
    - `data`: numbers that replace `problem.data` (same shapes); object coordinates relative to
      `problem.origin`.
    - `sensitivity`: `"exact"` (implicit function theorem with the full Hessian) or
      `"gauss-newton"` ((JᵀPJ)⁻¹JᵀP, error propagation, first order only); see
      `jaxbundle.adjustment.sensitivity`.
    - `atol`: stop when no unknown would move by more than this fraction of its σ.

    **Returns:** `Values`; NaN throughout, derivatives too, where the solver did not converge, so
    that a failure can never be taken for an answer.

    **Raises:** `InputError` for arguments of another kind, and for a second derivative of the
    Gauss–Newton form.
    """
    if not isinstance(problem, Problem):
        raise InputError(
            f"problem must be what jaxbundle.make_problem gives, but is {shown(problem)}"
        )
    if data is not None and not isinstance(data, Data):
        raise InputError(f"data must be a Data, as problem.data is one, but is {shown(data)}")
    one_of("sensitivity", sensitivity, get_args(Sensitivity))
    max_iterations, atol = whole("max_iterations", max_iterations), positive("atol", atol)
    data = problem.data if data is None else data
    solver = make_solver(problem, method, atol=atol, max_steps=max_iterations)
    minimum = find_minimum(solver, jax.lax.stop_gradient(data))
    good = converged(minimum.termination)
    values = attach_derivatives(problem.structure, minimum.values, data, sensitivity)
    # A factor, not a choice: derivatives of what was not found are NaN as well, not 0.
    return jax.tree.map(lambda x: x * jnp.where(good, 1.0, jnp.nan), values)


def converged(termination):
    """Whether a termination code means a minimum was reached."""
    return (termination == 1) | (termination == 2)
