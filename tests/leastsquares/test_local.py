"""Observations that depend on few of many columns: the same normal equations as with all."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbundle.cameras.cubic_splines import basis
from jaxbundle.leastsquares.declarations import Kind, Local, Table
from jaxbundle.leastsquares.equations.normal import normal_equations
from jaxbundle.leastsquares.indexing import rows
from jaxbundle.leastsquares.indexing.settings import PLANNING
from jaxbundle.leastsquares.problem import make_problem, pad_data

KNOTS, CURVES, SHIFTS, POINTS = 12, 2, 3, 40


def curve(c, shift, tilt, z, given):
    """A cubic spline at a shifted place, above a point, twice and with a slope."""
    t, y, slope = given
    weights = basis(t + shift[0], 0, KNOTS)
    height = sum(weights[..., j] * c[j] for j in range(KNOTS))
    return height + z[0] - y + tilt[0] * tilt[1], height * (1 + shift[0]) + c[0] - slope + tilt[0]


def columns(c, shift, tilt, z, given):
    first = jnp.clip(jnp.floor(given[0] + shift[0]) - 1, 0, KNOTS - 4).astype(int)
    return (*(first + k for k in range(4)), 0 * first)


def by_columns(c, shift, tilt, z, at, values, given):
    """c[0] may be among the four as well: the two derivatives are added up."""
    t, y, slope = given
    weights = basis(t + shift[0] - at[0], 0, 4)
    height = sum(weights[..., j] * values[j] for j in range(4))
    second = height * (1 + shift[0]) + values[4] - slope + tilt[0]
    return height + z[0] - y + tilt[0] * tilt[1], second


OF = ("curve", "shift", "tilt", "point")
LOCAL = Kind("curve", curve, OF, ("y", "slope"), scalars=True,
             local=Local(0, 5, columns, by_columns))  # fmt: skip


@pytest.fixture(scope="module", params=["point", None])
def problem(request):
    random = np.random.default_rng(2)
    number = PLANNING.small_part + 300
    value = random.normal(size=(CURVES, KNOTS))
    free = np.ones((CURVES, KNOTS), bool)
    free[1, 3] = False
    # Shifts and tilts, met at the same rows, are one group, in the order of the tables.
    tables = [
        Table("curve", value, free=free),
        Table("tilt", random.normal(size=(SHIFTS, 2))),
        Table("shift", random.normal(0, 0.2, (SHIFTS, 1))),
        Table("point", random.normal(size=(POINTS, 1)), free=np.arange(POINTS) > 4),
    ]
    curves, shifts, points = (random.integers(0, n, number) for n in (CURVES, SHIFTS, POINTS))
    touched = (curves, shifts, shifts, points)
    measured = np.c_[random.uniform(1, KNOTS - 2, number), random.normal(size=(number, 2))]
    seen = LOCAL(touched, measured, sigma=random.uniform(0.1, 0.3, (number, 2)))
    return make_problem(tables, [seen], eliminate=request.param)


def test_the_normal_equations_are_those_of_all_columns(problem):
    data = pad_data(problem, problem.data)
    merged = [len(group.members) for group in problem.plan.groups.values()]
    assert (max(merged) > 1) == (problem.plan.eliminated is not None)
    found = []
    for kind in (LOCAL, dataclasses.replace(LOCAL, local=None)):
        declared = dataclasses.replace(problem.declared, named_kinds=((LOCAL.name, kind),))
        assert problem.plan.parts[0].large
        found.append(normal_equations(
            declared, problem.plan, data.start, rows.lay_out_data(problem.plan, data)
        ))  # fmt: skip
    for one, other in zip(*map(jax.tree.leaves, found), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-11, atol=1e-11 * np.abs(other).max())


def test_wide_observations_are_computed_as_arrays(monkeypatch):
    """Many priors of one camera: the same as scalar by scalar, one of them without weight."""
    random, found = np.random.default_rng(3), []
    start, sigma = random.normal(size=(2, 70)), random.uniform(0.1, 0.3, (2, 70))
    sigma[1, 5] = np.inf
    for name, wide in (("array", rows.SCALAR_RESIDUALS_UP_TO), ("scalars", 1000)):
        monkeypatch.setattr(rows, "SCALAR_RESIDUALS_UP_TO", wide)
        kind = Kind(name, lambda v, given: v * v[::-1] - given, ("wide",))
        table = Table("wide", start, free=np.arange(70)[None] != 8)
        problem = make_problem([table], [kind((np.arange(2),), 0 * start, sigma=sigma)])
        data = pad_data(problem, problem.data)
        found.append(normal_equations(
            problem.declared, problem.plan, data.start, rows.lay_out_data(problem.plan, data)
        ))  # fmt: skip
    for one, other in zip(*map(jax.tree.leaves, found), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12 * np.abs(other).max())
