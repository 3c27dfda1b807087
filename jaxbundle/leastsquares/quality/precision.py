"""The precision of a design: covariances as a differentiable function of the design.

    C = σ0²·S·(JᵀPJ)⁻¹·Sᵀ,        S the S-transformation into the datum (`datum/conditions.py`)

Nothing is adjusted: J is evaluated at the given values (`Data.start`), P are the weights of the
data. Measurements matter only if J of a kind depends on them. For the precision of a solved problem
use its solution, `dataclasses.replace(data, start=solve(problem, data))`.

Source: Grafarend (1974), Bollettino di Geodesia 33: design of first order (J) and second order (P).
"""

from collections.abc import Callable, Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbundle.errors import InputError
from jaxbundle.leastsquares.equations.elimination import factorise
from jaxbundle.leastsquares.equations.normal import Normal, normal_equations, zero_tangent
from jaxbundle.leastsquares.indexing.plan import Plan, Tangent
from jaxbundle.leastsquares.indexing.reduction import FACTORS
from jaxbundle.leastsquares.indexing.rows import Data, Declared, Values, fill_places, lay_out_data
from jaxbundle.leastsquares.iterations.retraction import retract
from jaxbundle.leastsquares.problem import Problem, complete_data, with_factor, without_filling
from jaxbundle.leastsquares.quality.cofactors import blocks_of_tables, cofactors, propagate
from jaxbundle.leastsquares.quality.reliability import reliability
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray, not_none


class TablePrecision(eqx.Module):
    """Covariances of every row of every table (`own`, zero for held unknowns), in the directions of
    its space, and of the requested functions."""

    own: dict[str, Float[Array, "rows width width"]]
    covariance: Float[Array, "functions functions"]


def precision(
    problem: Problem,
    data: Data | None = None,
    of: Callable[[Values], Array] | None = None,
    *,
    sigma0: float | Float[Array, ""] = 1.0,
) -> TablePrecision:
    """The precision of a design, differentiable to any order.

    **Arguments:** `data`: numbers that replace `problem.data` (same shapes): the design in `start`,
    and weights; `of`: functions of the tables, `values -> [functions]`, for their covariance;
    `sigma0`: of the unit weight, 1: a priori.

    **Returns:** a `TablePrecision`; all NaN if the design leaves unknowns undetermined.

    **Raises:** `InputError` for data of other shapes, or if no factor fits into memory.
    """
    problem = with_factor(problem)
    if problem.plan.reduction not in FACTORS:
        raise InputError("precision: the problem is too large for its covariance; use a part of it")
    declared, plan, data = problem.declared, problem.plan, complete_data(problem, data)

    def functions(change: Tangent) -> Float[Array, " functions"]:
        return jnp.ravel(
            not_none(of)(without_filling(problem, retract(declared, plan, data.start, change)))
        )

    zero_change = zero_tangent(plan)
    if of is None:
        rows = jax.tree.map(lambda x: jnp.zeros((0, *x.shape)), zero_change)
    else:
        rows = jax.jacrev(functions)(zero_change)
    cofactor_blocks, covariance = covariances(declared, plan, data, rows)
    table_precision = TablePrecision(without_filling(problem, cofactor_blocks), covariance)
    return jax.tree.map(lambda C: sigma0**2 * C, table_precision)


@compile_once
def covariances(
    declared: Declared, plan: Plan, data: Data, rows: Tangent
) -> tuple[dict[str, Float[Array, "rows width width"]], Float[Array, "functions functions"]]:
    """Cofactors of all tables and of linear functions `rows` of the unknowns, for data padded to
    the sizes of the plan (`problem.pad_data`): shared by designs of one shape."""
    filled, chunked = fill_places(plan, lay_out_data(plan, data))
    normal = normal_equations(declared, filled, data.start, chunked)[-1]
    factor = factorise(Normal(plan, normal))
    blocks = blocks_of_tables(
        declared, plan, cofactors(declared, data.start, factor).diagonal_blocks, data.start
    )
    return blocks, propagate(declared, data.start, factor, rows)


@compile_once
def redundancy(declared: Declared, plan: Plan, data: Data) -> Mapping[int, Float[AnyArray, "n r"]]:
    """Redundancy numbers by set, for data padded to the sizes of the plan."""
    filled, chunked = fill_places(plan, lay_out_data(plan, data))
    normal = normal_equations(declared, filled, data.start, chunked)[-1]
    factor = factorise(Normal(plan, normal))
    Q = cofactors(declared, data.start, factor)
    return reliability(declared, plan, data.start, data, Q).redundancy
