"""The reduced system dense, banded and solved by iteration: long lines of unknowns, with a border
or without, the datum held or open."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbundle.errors import InputError
from jaxbundle.leastsquares.declarations import Kind, Motions, Table
from jaxbundle.leastsquares.equations.elimination import damp, factorise, solve
from jaxbundle.leastsquares.equations.normal import Normal, normal_equations
from jaxbundle.leastsquares.indexing.reduction import FACTORS, choose_reduction, find_band
from jaxbundle.leastsquares.indexing.rows import lay_out_data
from jaxbundle.leastsquares.iterations.solver import minimise
from jaxbundle.leastsquares.iterations.stopping import SETTLED
from jaxbundle.leastsquares.problem import (
    make_problem,
    make_solver,
    pad_data,
    with_factor,
)
from jaxbundle.leastsquares.quality.cofactors import cofactors
from jaxbundle.leastsquares.quality.reliability import reliability

STATIONS, POINTS, REACH, NOISE = 60, 200, 5, 1e-3
LEVELLED = Kind("levelled difference", lambda a, b, dh: b - a - dh, of=("height", "height"))

find_minimum = eqx.filter_jit(minimise)


def distance(station, X, factor, measured):
    return factor * jnp.hypot(X[0] - station[0], X[1] - station[1]) - measured


def direction(station, X, measured):
    return jnp.sin(jnp.arctan2(X[0] - station[0], X[1] - station[1]) - station[2] - measured)


def turned(motion, X):
    c, s = jnp.cos(motion[2]), jnp.sin(motion[2])
    return jnp.stack([c * X[0] + s * X[1], c * X[1] - s * X[0]]) + motion[:2]


# The border has groups before and after that of the band, in the order of names.
DISTANCE = Kind("distance", distance, of=("station", "point", "unit"), invariant=True)
DIRECTION = Kind("direction", direction, of=("station", "point"), invariant=True)
PLACE = Kind("place", lambda station, e, x: station[:2] + e - x, of=("station", "shift"))
MOTIONS = Motions(("E", "N", "turn"), (
    ("station", lambda tau, s: jnp.append(turned(tau, s), s[2] + tau[2])),
    ("point", turned), ("shift", lambda tau, e: e - tau[:2]),
), curved=(2,))  # fmt: skip


def traverse(reduction=None):
    """Stations in a row, shuffled, with a circle each, that measure the points beside them; one
    factor of all distances. Every other place is known, but for a shift of all."""
    random = np.random.default_rng(3)
    X = np.c_[random.uniform(0, STATIONS - 1, POINTS), random.choice([-3, 3], POINTS)]
    along = random.permutation(STATIONS)
    row, point = np.nonzero(np.abs(along[:, None] - X[:, 0]) < REACH / 2)
    near = lambda x, sigma=0.01: x + sigma * random.normal(size=x.shape)
    station = near(np.c_[along, np.zeros((STATIONS, 2))], 0.3)
    d = X[point] - station[row, :2]
    known = np.arange(0, STATIONS, 2)
    return make_problem(
        [Table("station", near(station)), Table("point", near(X)), Table("shift", np.zeros((1, 2))),
         Table("unit", np.array([1.0]))],
        [DISTANCE((row, point, 0 * row), near(np.hypot(*d.T), NOISE), sigma=NOISE),
         DIRECTION((row, point), near(np.arctan2(*d.T) - station[row, 2], NOISE), sigma=NOISE),
         PLACE((known, 0 * known), near(station[known, :2]), sigma=0.01)],
        "point", motions=MOTIONS, datum=lambda gauge: ({"point": np.ones((POINTS, 2))}, False),
        reduction=reduction,
    )  # fmt: skip


def line(number: int, reduction=None, held=True, noise=None):
    """Heights in a row, shuffled, with the differences of neighbours."""
    random = np.random.default_rng(0)
    order = random.permutation(number)
    noise = random.normal(size=number - 1) if noise is None else noise
    free = np.ones(number)
    free[order[0]] = not held
    motions = Motions(("shift",), (("height", lambda m, height: height + m[0]),))
    return make_problem(
        [Table("height", np.zeros(number), free=free)],
        [LEVELLED((order[:-1], order[1:]), noise)], motions=motions,
        datum=lambda gauge: ({"height": np.ones((number, 1))}, False), reduction=reduction,
    ), order, noise  # fmt: skip


CASES = {
    "borders, shift open": (traverse, 2),
    "no border, datum open": (lambda way: line(150, way, held=False)[0], 1),
}


@eqx.filter_jit
def step(declared, plan, data, values, damping, pin_datum):
    """The gradient, N⁻¹ of it, the factor, and N times the solution, which knows no datum."""
    _, gradient, blocks = normal_equations(declared, plan, values, lay_out_data(plan, data))
    normal = damp(Normal(plan, blocks), damping)
    factor = factorise(normal, pin_datum)
    change = solve(factor, gradient)
    return gradient, change, factor, normal.mv(change)


@eqx.filter_jit
def study(declared, data, factor):
    Q = cofactors(declared, data.start, factor)
    return Q, reliability(declared, factor.plan, data.start, data, Q)


@pytest.fixture(scope="module", params=CASES.values(), ids=CASES)
def ways(request):
    """The problem, its padded data, and the undamped step, by way."""
    make, defect = request.param
    found = {}
    for way in ("dense", "banded", "iterative"):
        problem = make(way)
        assert problem.plan.reduction == way and problem.counts.datum == defect
        data = pad_data(problem, problem.data)
        given = problem.declared, problem.plan, data, data.start
        found[way] = problem, data, step(*given, jnp.array(0.0), jnp.array(True))
    return found


@pytest.mark.parametrize("way, precision", [("banded", 1e-9), ("iterative", 1e-6)])
def test_the_step_is_that_of_the_dense_system(ways, way, precision):
    (gradient, *_, dense), (*_, product) = ways["dense"][2], ways[way][2]
    close = lambda a, b, name: np.testing.assert_allclose(
        a[name], b[name], atol=precision * np.abs(b[name]).max()
    )
    for name in gradient:
        close(product, gradient, name)
        close(dense, gradient, name)
    damped = {}
    for w in ("dense", way):
        problem, data, _ = ways[w]
        given = problem.declared, problem.plan, data, data.start
        damped[w] = step(*given, jnp.array(1e-3), jnp.array(False))[1]
    for name in gradient:
        close(damped[way], damped["dense"], name)


def test_cofactors_of_the_band_are_those_of_the_dense_system(ways):
    (problem, data, (*_, factor, _)), (_, _, (*_, band, _)) = ways["dense"], ways["banded"]
    dense, tested = study(problem.declared, data, factor)
    banded, other = study(problem.declared, data, band)
    sigma = lambda own: {
        g: np.sqrt(np.abs(np.diagonal(B, axis1=1, axis2=2))) for g, B in own.items()
    }
    near = lambda a, b, s, t: (np.abs(a - b) <= 1e-7 * s[:, :, None] * t[:, None, :]).all()
    for g, s in sigma(dense.diagonal_blocks).items():
        assert near(banded.diagonal_blocks[g], dense.diagonal_blocks[g], s, s)
    kept = sigma(dense.kept.diagonal_blocks)
    off, banded_off = dense.kept.off_diagonal_blocks, banded.kept.off_diagonal_blocks
    assert len(off) == len(problem.plan.blocks) == len(banded_off)
    for (a, b), B in off.items():
        at = problem.plan.blocks[a, b]
        real = slice(0, -1)  # The last block is empty.
        s, t = kept[a][at.row][real], kept[b][at.column][real]
        assert near(banded_off[a, b][real], B[real], s, t) and np.abs(B[real]).max() > 0
    for o, r in tested.redundancy.items():
        np.testing.assert_allclose(other.redundancy[o], r, atol=1e-7)
    total = sum(float(r.sum()) for r in other.redundancy.values())
    assert total == pytest.approx(problem.counts.redundancy, abs=1e-5)


@pytest.mark.further
@pytest.mark.parametrize("ways", [*CASES.values()][:1], ids=[*CASES][:1], indirect=True)
def test_iteration_plans_no_pairs_and_finds_the_minimum(ways):
    problem, data, _ = ways["iterative"]
    assert all(at.pairs is None for at in problem.plan.blocks.values())
    minimum = find_minimum(make_solver(problem), data, data.start)
    assert int(minimum.termination) == SETTLED
    again = with_factor(problem)
    assert again.plan.reduction == "dense" and with_factor(again) is again
    given = again.declared, again.plan, data, minimum.values
    gradient, change, *_ = step(*given, jnp.array(0.0), jnp.array(True))
    # δᵀNδ bounds every unknown in units of its σ.
    assert sum(float(jnp.vdot(gradient[g], change[g])) for g in change) < 1e-6


@pytest.mark.parametrize("ways", [*CASES.values()][:1], ids=[*CASES][:1], indirect=True)
def test_a_system_that_is_not_solved_in_time_has_no_solution(ways):
    """Neither exactly nor to a hundredth: half a step is none, and a step of zero is no end."""
    gradient, _, factor, _ = ways["iterative"][2]
    for tolerance in (1e-2, 1e-12):
        few = dataclasses.replace(factor.reduced, tolerance=tolerance, max_steps=2)
        change = solve(dataclasses.replace(factor, reduced=few), gradient)
        assert all(np.isnan(change[name]).any() for name in gradient)


def test_rows_that_are_tied_stand_close():
    plan = traverse("banded").plan
    band, at = plan.band, plan.blocks["station", "station"]
    place = np.asarray(band.place)
    assert band.group == "station" and sorted(place[:STATIONS]) == list(range(STATIONS))
    assert (place[STATIONS:] == band.blocks * band.width - 1).all()
    assert np.abs(place[np.asarray(at.row)] - place[np.asarray(at.column)]).max() <= band.width
    assert band.blocks * band.width > STATIONS


def test_a_line_too_long_for_a_dense_factor_is_banded():
    number = 16_000
    problem, order, noise = line(number)
    assert problem.plan.reduction == "banded"
    data = pad_data(problem, problem.data)
    minimum = find_minimum(make_solver(problem), data, data.start)
    assert int(minimum.termination) == SETTLED
    height = np.asarray(minimum.values["height"])[order]
    np.testing.assert_allclose(height, np.r_[0, np.cumsum(noise)], atol=1e-8)
    given = problem.declared, problem.plan, data, data.start
    factor = step(*given, jnp.array(0.0), jnp.array(True))[2]
    Q = eqx.filter_jit(cofactors)(problem.declared, data.start, factor)
    # The variance of a height grows with the number of differences on the way to it.
    variance = np.asarray(Q.diagonal_blocks["height"])[order, 0, 0]
    np.testing.assert_allclose(variance, np.arange(number), rtol=1e-6)


def test_a_web_too_large_for_any_factor_is_solved_by_iteration():
    number, random = 16_000, np.random.default_rng(1)
    i, j = (np.concatenate([random.permutation(number) for _ in range(4)]) for _ in "ij")
    measured = random.normal(size=len(i))
    free = np.arange(number) > 0
    problem = make_problem(
        [Table("height", np.zeros(number), free=free)], [LEVELLED((i, j), measured)]
    )
    assert problem.plan.reduction == "iterative"
    assert with_factor(problem) is problem
    data = pad_data(problem, problem.data)
    minimum = find_minimum(make_solver(problem), data, data.start)
    assert int(minimum.termination) == SETTLED
    height = np.asarray(minimum.values["height"])[:number]
    v = height[j] - height[i] - measured
    gradient = np.bincount(j, v, number) - np.bincount(i, v, number)
    assert np.abs(gradient[1:]).max() < 1e-3
    with pytest.raises(ValueError, match="with_factor"):
        given = problem.declared, problem.plan, data, data.start
        eqx.filter_eval_shape(step, *given, 0.0, True)[2].inverse()


def test_the_way_is_chosen_by_size_and_fill():
    row, column = np.triu_indices(200, 1)
    full = find_band("a", row, column, 200, 9)
    narrow = find_band("a", np.arange(199), np.arange(1, 200), 200, 9)
    assert (full.width, narrow.width) == (199, 4)
    way = lambda band, n, rows, ways=("dense", "banded", "iterative"): choose_reduction(
        band, 9, 9 * n, 27 * rows, ways
    )
    assert way(full, 200, 200_000) == "dense"
    assert way(narrow, 200, 200_000) == "banded"
    place = dataclasses.replace(full.place, rows=np.zeros(10_000, np.int32))
    everywhere = dataclasses.replace(full, place=place, width=9999, blocks=2)
    assert way(everywhere, 10_000, 2_000_000) == "iterative"
    # A dense factor of 14 400 unknowns fits into memory, but costs ten times more than iteration.
    assert way(None, 1600, 100_000, ("dense", "iterative")) == "iterative"
    # Where a factor is needed and none fits into memory, there is none.
    assert way(everywhere, 10_000, 2_000_000, FACTORS) is None
    with pytest.raises(InputError, match="sparse"):
        line(10, "sparse")
