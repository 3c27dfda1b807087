"""A problem that is no network: a levelling net, a height held or none, against dense algebra."""

import numpy as np
import pytest

from jaxbundle.leastsquares.cofactors import cofactors
from jaxbundle.leastsquares.datum import move_to_datum
from jaxbundle.leastsquares.declarations import Kind, Motions, Table
from jaxbundle.leastsquares.elimination import factorise
from jaxbundle.leastsquares.normal import Normal, normal_equations
from jaxbundle.leastsquares.problem import find_minimum, make_problem, make_solver, pad_data
from jaxbundle.leastsquares.reliability import reliability
from jaxbundle.leastsquares.rows import lay_out_data

HEIGHTS, SIGMA = 12, 0.01
LEVELLED = Kind("levelled difference", lambda a, b, dh: b - a - dh, of=("height", "height"))
SHIFT = Motions(("shift",), (("height", lambda motion, height: height + motion[0]),))


def net():
    """Rows of the differences, their values, and approximate heights."""
    random = np.random.default_rng(0)
    height = 10 * random.normal(size=HEIGHTS)
    i, j = np.triu_indices(HEIGHTS, 1)
    some = random.random(len(i)) < 0.4
    i, j = i[some], j[some]
    measured = height[j] - height[i] + SIGMA * random.normal(size=len(i))
    return i, j, measured, height + random.normal(size=HEIGHTS)


@pytest.mark.parametrize("held", [True, False], ids=["a height held", "inner constraints"])
def test_against_dense_algebra(held):
    i, j, measured, start = net()
    observations = [LEVELLED((i, j), measured, sigma=SIGMA)]
    free = np.ones(HEIGHTS)
    free[0] = 0 if held else 1
    table = Table("height", start, free=free)
    datum = {} if held else {
        "motions": SHIFT, "datum": lambda gauge: ({"height": np.ones((HEIGHTS, 1))}, False)
    }
    problem = make_problem([table], observations, **datum)
    data = pad_data(problem, problem.data)
    minimum = find_minimum(make_solver(problem), data, data.start)
    assert int(minimum.termination) == 1
    values = move_to_datum(problem.declared, problem.plan, minimum.values, data.start)

    J = (np.eye(HEIGHTS)[j] - np.eye(HEIGHTS)[i]) / SIGMA
    moving = np.flatnonzero(free)
    N = J.T @ J
    Q = np.zeros_like(N)
    if held:
        Q[np.ix_(moving, moving)] = np.linalg.inv(N[np.ix_(moving, moving)])
    else:
        Q = np.linalg.pinv(N)
    expected = start - Q @ J.T @ (J @ start - measured / SIGMA)
    found = np.asarray(values["height"])[:HEIGHTS]
    np.testing.assert_allclose(found, expected, atol=1e-9)

    normal = normal_equations(
        problem.declared, problem.plan, values, lay_out_data(problem.plan, data)
    )[-1]
    factor = factorise(Normal(problem.plan, normal))
    of_all = cofactors(problem.declared, values, factor)
    np.testing.assert_allclose(
        np.asarray(of_all.own["height"])[:HEIGHTS, 0, 0], np.diag(Q), rtol=1e-9, atol=1e-15
    )
    tested = reliability(problem.declared, problem.plan, values, data, of_all)
    r = np.asarray(tested.redundancy[0])[: len(measured), 0]
    np.testing.assert_allclose(r, 1 - np.einsum("ij,jk,ik->i", J, Q, J), atol=1e-9)
    assert r.sum() == pytest.approx(problem.counts.redundancy)
