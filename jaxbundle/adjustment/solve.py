"""`solve`: data in, adjusted tables out, differentiable, under jit and vmap."""

from jaxbundle.arguments import one_of, show
from jaxbundle.choices import METHODS
from jaxbundle.errors import InputError
from jaxbundle.leastsquares.indexing.rows import Data, Values
from jaxbundle.leastsquares.iterations.search import SEARCHES
from jaxbundle.leastsquares.problem import Problem
from jaxbundle.leastsquares.quality import derivatives


def solve(
    problem: Problem,
    data: Data | None = None,
    *,
    sensitivity: derivatives.Sensitivity = "exact",
    method: str = "levenberg-marquardt",
    max_iterations: int = 100,
    atol: float = 1e-7,
) -> Values:
    """Adjusted unknowns as a differentiable function of the observations and all other data.

    Use it under `jax.jit`, `jax.vmap` (over any field of `data`), `jax.grad`, `jax.jacfwd` and
    `jax.jacrev`, nested to any order.

    **Arguments:**

    - `problem`: from `make_problem`.
    - `data`: numbers that replace `problem.data` (same shapes): start values, measurements and
      weights by name; object coordinates relative to `problem.origin`.
    - `sensitivity`: `"exact"` (implicit function theorem with the full Hessian) or
      `"gauss-newton"` ((JᵀPJ)⁻¹JᵀP, error propagation, first order only); see
      `jaxbundle.leastsquares.quality.derivatives`.
    - `atol`: stop when no unknown would move by more than this fraction of its σ.

    **Returns:** the tables by name (`network.declare`): `values["point"]`, `values["camera"]`,
    `values["image"].position` and `.rotation`; all NaN, including derivatives, if the solver did
    not converge, so that a failure is never mistaken for a solution.

    **Raises:** `InputError` for invalid arguments, and for a second derivative of the Gauss–Newton
    form.
    """
    check_given(problem, data)
    one_of("method", method, METHODS)
    return derivatives.solve(
        problem,
        data,
        sensitivity=sensitivity,
        max_iterations=max_iterations,
        atol=atol,
        search=SEARCHES[method],
    )


def check_given(problem: Problem, data: Data | None) -> None:
    """Refuse an invalid problem or invalid data.

    **Raises:** `InputError`."""
    if not isinstance(problem, Problem):
        raise InputError(
            f"problem must be a result of jaxbundle.make_problem, but is {show(problem)}"
        )
    if data is not None and not isinstance(data, Data):
        raise InputError(f"data must be a Data like problem.data, but is {show(data)}")
