"""A bridge to the stock solvers of optimistix: their loop and damping, our linear algebra.

    fn, y0, linear_solver = stock_problem(problem)
    solver = optimistix.LevenbergMarquardt(1e-10, 1e-10, linear_solver=linear_solver)
    result = optimistix.least_squares(fn, solver, y0, args=problem.data)
    values = values_of(problem, result.value)

The stock solvers add steps, so the unknowns are changes from the start values. They know the
Jacobian only as an operator; `SchurLinearSolver` reads its blocks by applying it to coloured
directions: one for each column of an image, a camera and a point, since every ray touches one
of each. Stock damping is λ·1, so unknowns are scaled by the Jacobian's columns at the start.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx

from jaxbundle.adjustment.jacobian import BundleJacobian, free_tangent, jacobian, zero_tangent
from jaxbundle.adjustment.normal import diagonal, normal_from_jacobian
from jaxbundle.adjustment.problem import Problem
from jaxbundle.adjustment.residuals import residuals
from jaxbundle.adjustment.schur import factorise, solve
from jaxbundle.network.arrays import Tangent, Values, retract
from jaxbundle.network.structure import Structure


def stock_problem(problem: Problem):
    """Residual function fn(y, data), its start y0 = 0, and a linear solver for stock optimistix.

    Networks must be free of datum defects (`datum = "control"`): the stock loop knows no datum.
    """
    s = problem.structure
    if s.defect:
        raise ValueError(
            "the stock solvers know no datum: fix it by control points, or use jaxbundle.adjust"
        )
    scale = _column_scale(s, problem.data)

    def fn(y: Tangent, data):
        return residuals(s, _values(s, data, scale, y), data)

    return fn, zero_tangent(s), SchurLinearSolver(s)


def values_of(problem: Problem, y: Tangent) -> Values:
    """The unknowns that belong to a result y of the stock solver."""
    scale = _column_scale(problem.structure, problem.data)
    return _values(problem.structure, problem.data, scale, y)


def _values(s, data, scale, y):
    return retract(s, data.start, jax.tree.map(jnp.multiply, y, scale))


@eqx.filter_jit
def _column_scale(s, data):
    normal = normal_from_jacobian(jacobian(s, data.start, data))
    return jax.tree.map(
        lambda d, free: free / jnp.sqrt(d), diagonal(normal), free_tangent(s)
    )


class SchurLinearSolver(lx.AbstractLinearSolver):
    """Least squares solve of a network's Jacobian operator by elimination of the points.

    Takes the Jacobian itself (Gauss–Newton) or stacked on √λ·1 (Levenberg–Marquardt).
    """

    structure: Structure

    def init(self, operator, options):
        jac, damping = _probe(self.structure, operator)
        d = jax.tree.map(lambda f: damping * f, free_tangent(self.structure))
        return factorise(self.structure, normal_from_jacobian(jac), d), operator

    def compute(self, state, vector, options):
        factor, operator = state
        right = operator.transpose().mv(vector)
        return solve(factor, right), lx.RESULTS.successful, {}

    def transpose(self, state, options):
        raise NotImplementedError(
            "a stock solver with the Schur step has no derivatives of its own (the Jacobian is not "
            "square); differentiate jaxbundle.solve instead"
        )

    def conj(self, state, options):
        return state, options

    def assume_full_rank(self):
        return True


def _probe(s: Structure, operator) -> tuple[BundleJacobian, jax.Array]:
    """The Jacobian's blocks and λ, from products with coloured directions.

    A damped operator returns the pair (J·y, √λ·y).
    """
    zero = zero_tangent(s)

    def colour(field: str, column: int):
        part = getattr(zero, field).at[:, column].set(1.0)
        return operator.mv(eqx.tree_at(lambda t: getattr(t, field), zero, part))

    def probe(field: str):
        columns = [colour(field, j) for j in range(getattr(zero, field).shape[1])]
        return [c[0] if isinstance(c, tuple) else c for c in columns], columns

    image, raw = probe("image")
    camera, _ = probe("camera")
    point, _ = probe("point")
    damping = raw[0][1].image[0, 0] ** 2 if isinstance(raw[0], tuple) else jnp.asarray(0.0)
    stack = lambda columns, kind, rows: (
        jnp.stack([getattr(c, kind) for c in columns], -1)
        if columns
        else jnp.zeros((*rows, 0))
    )
    rays = (s.rays, 2)
    interior = camera if s.camera_width else image[6:]
    rows = jnp.arange(s.interior.shape[0])
    diagonal_of = lambda column, j: column.interior[
        rows, s.camera_columns[s.interior, j]
    ]
    jac = BundleJacobian(
        structure=s,
        image=stack(image, "image", rays),
        camera=stack(camera, "image", rays),
        point=stack(point, "image", rays),
        control=jnp.stack([point[j].control[:, j] for j in range(3)], -1),
        exterior=stack(image[:6], "exterior", ()),
        interior=(
            jnp.stack([diagonal_of(c, j) for j, c in enumerate(interior)], -1)
            if interior
            else jnp.zeros((s.interior.shape[0], 0))
        ),
        distance=_distance_rows(s, operator, isinstance(raw[0], tuple)),
        _parameters=image[0].interior.shape[1],
    )
    return jac, damping


def _distance_rows(s: Structure, operator, damped: bool):
    """Derivatives of every distance by its two ends [distances, 2, 3], by transposed products."""
    transposed = operator.transpose()
    zero = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), operator.out_structure())

    def row(unit, ends):
        where = (lambda r: r[0].distance) if damped else (lambda r: r.distance)
        return transposed.mv(eqx.tree_at(where, zero, unit)).point[ends]

    return jax.vmap(row)(jnp.eye(s.distance.shape[0]), s.distance)
