"""Error components against dense algebra, and against errors drawn from them."""

import dataclasses

import numpy as np
import pytest
import scipy.sparse as sp

from jaxbundle import leastsquares as ls
from jaxbundle.leastsquares.problem import make_problem
from jaxbundle.leastsquares.quality.distributions import (
    chi2_quantile,
    normal_quantile,
    skewed_quantile,
)
from jaxbundle.leastsquares.quality.error_components import (
    OTHERS,
    ErrorComponent,
    ErrorSettings,
    fit_error_model,
    products_of,
    quadratic_forms,
)
from jaxbundle.leastsquares.quality.error_effects import effects, remove_fit, stack_rows
from jaxbundle.leastsquares.quality.estimated_sizes import raise_to_independent
from jaxbundle.leastsquares.quality.size_traces import Traces
from jaxbundle.leastsquares.solution import Solution

RANGE = ls.Kind(
    "distance", lambda a, b, d: ((a - b) @ (a - b)) ** 0.5 - d, of=("point", "point")
)
POINTS, SIGMA = 14, 0.01


@pytest.fixture(scope="module")
def network():
    """A free trilateration of its true coordinates, and dense: A, pinv(AᵀA), and the rows i, j."""
    rng = np.random.default_rng(5)
    X = rng.uniform(-10, 10, (POINTS, 3))
    i, j = np.triu_indices(POINTS, 1)
    true = np.linalg.norm(X[i] - X[j], axis=1)
    unit = (X[i] - X[j]) / true[:, None]
    A = np.zeros((len(i), POINTS, 3))
    A[np.arange(len(i)), i], A[np.arange(len(i)), j] = unit, -unit
    A = A.reshape(len(i), -1) / SIGMA

    def adjust(errors):
        result = ls.adjust(
            [ls.Table("point", X)], [RANGE((i, j), true + SIGMA * errors, sigma=SIGMA)],
            datum="inner", motions=ls.similarity(["point"]),
        )  # fmt: skip
        return result.solution

    return adjust, A, np.linalg.pinv(A.T @ A, rcond=1e-9), (i, j)


def components(rows):
    """An offset of each instrument (all distances from a point), and one of a quarter of them."""
    i, j = rows
    by_first = sp.csr_matrix((np.ones(len(i)), (np.arange(len(i)), i)))
    by_group = sp.csr_matrix(np.cos(np.outer(np.arange(len(i)), 1 + np.arange(4))))
    return [
        ErrorComponent("instrument", "σ", by_first),
        ErrorComponent("waves", "σ", by_group),
    ]


def test_maps_are_those_of_dense_algebra(network):
    adjust, A, Q, _ = network
    rng = np.random.default_rng(1)
    found = adjust(rng.normal(size=len(A)))
    e = rng.normal(size=(3, len(A)))
    left, tables = remove_fit(found, e)
    # A of the true coordinates and that of the solution differ by errors of 0.01 of 10 m
    np.testing.assert_allclose(left, e - e @ A @ Q @ A.T, atol=5e-3)
    np.testing.assert_allclose(tables["point"].reshape(3, -1), e @ A @ Q, atol=5e-3 * SIGMA)
    F = rng.normal(size=(5, POINTS, 3))
    D = effects(found, {"point": F})
    np.testing.assert_allclose(D, F.reshape(5, -1) @ Q @ A.T, atol=5e-3 * SIGMA)


def test_sizes_and_covariances_are_those_of_dense_algebra(network):
    adjust, A, Q, rows = network
    rng = np.random.default_rng(4)
    parts = components(rows)
    roots = [part.root.toarray() for part in parts]
    e = rng.normal(size=len(A)) + sum(2 * F @ rng.normal(size=F.shape[1]) for F in roots)
    found = adjust(e)
    model = fit_error_model(found, parts)
    M = np.eye(len(A)) - A @ Q @ A.T
    V = [np.eye(len(A)), *(F @ F.T for F in roots)]
    v = stack_rows(found, found.residuals)
    q = np.array([v @ W @ v for W in V])
    T = np.array([[np.trace(M @ W @ M @ U) for U in V] for W in V])
    theta = np.linalg.solve(T, q)
    assert (theta > 0).all()  # the constraint is not active here
    np.testing.assert_allclose(model.theta, theta, rtol=0.02)
    C = Q @ A.T @ sum(t * W for t, W in zip(model.theta, V)) @ A @ Q
    blocks = np.stack([C[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(POINTS)])
    estimated, near = model.as_estimated, {"rtol": 0.02, "atol": 1e-3 * C.max()}
    np.testing.assert_allclose(estimated.covariance("point"), blocks, **near)
    rows_of = np.eye(3 * POINTS).reshape(-1, POINTS, 3)[:6]
    np.testing.assert_allclose(estimated.propagate_rows({"point": rows_of}), C[:6, :6], **near)
    # σ of θ: T⁻¹·2·tr(V·MΣM·V·MΣM)·T⁻¹
    P = M @ sum(t * W for t, W in zip(theta, V)) @ M
    G = np.array([[2 * np.trace(W @ P @ U @ P) for U in V] for W in V])
    sigma = np.sqrt(np.diag(np.linalg.solve(T, np.linalg.solve(T, G).T)))
    np.testing.assert_allclose(model.theta_sigma, sigma, rtol=0.02)


@pytest.fixture(scope="module")
def distances():
    """Distances between stations and points, which are eliminated, and among stations, in the inner
    datum of both; two are not used. M and X = N⁻¹Aᵀ (by table) from single errors."""
    rng = np.random.default_rng(2)
    stations, points = rng.uniform(-10, 10, (6, 3)), rng.uniform(-5, 5, (12, 3))
    seen = rng.uniform(size=(len(points), len(stations))) < 0.9
    point, station = np.nonzero(seen)
    i, j = np.triu_indices(len(stations), 1)
    residual = lambda a, b, d: ((a - b) @ (a - b)) ** 0.5 - d
    sight = ls.Kind("sight", residual, of=("point", "station"))
    base = ls.Kind("base", residual, of=("station", "station"))
    between = lambda a, b: np.linalg.norm(a - b, axis=1) + SIGMA * rng.normal(size=len(a))
    sigma = np.full(len(point), SIGMA)
    sigma[[3, 40]] = np.inf
    found = ls.adjust(
        [ls.Table("point", points), ls.Table("station", stations)],
        [
            sight((point, station), between(points[point], stations[station]), sigma=sigma),
            base((i, j), between(stations[i], stations[j]), sigma=SIGMA),
        ],
        eliminate="point", datum="inner", motions=ls.similarity(["point", "station"]),
    ).solution  # fmt: skip
    assert found.problem.plan.eliminated == "point" and found.problem.plan.datum is not None
    rows = len(point) + len(i)
    left, tables = remove_fit(found, np.eye(rows))
    used = np.append(np.isfinite(sigma), np.ones(len(i), bool))
    M = np.where(used, left, 0.0)
    return found, M, tables, (point, station, i, j), used


def components_of_distances(given, used):
    """Offsets of stations, waves (mixed), errors of the distances of a point, those of the bases:
    few and many columns."""
    (point, station, i, _), rng = given, np.random.default_rng(9)
    n, rows = len(point), len(point) + len(i)
    number = np.arange(n)
    offsets = sp.csr_matrix((np.ones(n), (number, station)), shape=(rows, 6))
    waves = np.cos(np.outer(np.arange(rows), 1 + np.arange(10)))
    waves[n:] = 0.0
    K = rng.normal(size=(n, n)) * (point[:, None] == point)
    along = sp.csr_matrix(np.pad(K, ((0, rows - n), (0, 0))))
    others = sp.csr_matrix((np.ones(len(i)), (n + np.arange(len(i)), np.arange(len(i)))))
    mixing = rng.normal(size=(5, 3)) / 4
    keep = sp.diags(used.astype(float))
    return [
        ErrorComponent("offsets", "σ", keep @ offsets),
        ErrorComponent("along", "σ", keep @ along / 3),
        ErrorComponent("waves", "σ", keep @ sp.csr_matrix(waves), mixing),
        ErrorComponent(OTHERS, "σ", keep @ others),
    ]


def test_traces_from_reduced_matrices_are_those_of_dense_algebra(distances):
    """With a component of many columns that has a block for every point, to rounding."""
    found, M, tables, given, used = distances
    parts = components_of_distances(given, used)
    settings = ErrorSettings(max_columns=20)
    products = products_of(found, parts, settings)
    assert products.roots.many is not None and products.roots.wide.shape[1] == 10
    traces = products.traces(1000, np.random.default_rng(0))
    F = [part.sparse_root().toarray() for part in parts]
    V = [M, *(M @ f @ f.T @ M for f in F)]
    T = np.einsum("iab,jba->ij", V, V)
    np.testing.assert_allclose(traces.T, T, rtol=1e-9)
    # traces of three are those of M·V: M·V_0·M = M
    cubes = np.einsum("iab,jbc,kca->ijk", V, V, V)
    np.testing.assert_allclose(traces.cubes, cubes, rtol=1e-8)
    theta = np.array([0.8, 0.5, 0.7, 1.2, -0.3])
    Sigma = theta[0] * np.eye(len(M)) + sum(t * f @ f.T for t, f in zip(theta[1:], F))
    P = M @ Sigma @ M
    forms = [np.eye(len(M)), *(f @ f.T for f in F)]
    expected = 2 * np.array([[np.trace(A @ P @ B @ P) for B in forms] for A in forms])
    np.testing.assert_allclose(traces.covariance_of_forms(theta), expected, rtol=1e-8)
    # the same where the columns of the points are taken as few
    few = products_of(found, parts, ErrorSettings(max_columns=100))
    assert few.roots.many is None
    np.testing.assert_allclose(few.traces(1000, None).T, T, rtol=1e-9)
    for blocks in (products.blocks(theta), few.blocks(theta)):
        for f, of_tables in zip(F, blocks):
            for table, X in tables.items():
                D = np.einsum("rni,rc->cni", X, f)
                C = np.einsum("cni,cnj->nij", D, D)
                np.testing.assert_allclose(of_tables[table], C, atol=1e-9 * np.abs(C).max())


def test_traces_from_some_of_the_clusters_are_near_those_of_all(distances):
    """T is exact but for wide roots with the component of many columns; the rest is unbiased."""
    found, M, _, given, used = distances
    parts = components_of_distances(given, used)
    products = products_of(found, parts, ErrorSettings(max_columns=20))
    exact = products.traces(1000, np.random.default_rng(0))
    some = [products.traces(6, np.random.default_rng(seed)) for seed in range(40)]
    few = np.ix_([0, 1, 2, 4], [0, 1, 2, 4])
    np.testing.assert_allclose(some[0].T[few], exact.T[few], rtol=1e-9)
    np.testing.assert_allclose(np.mean([one.T for one in some], 0), exact.T, rtol=0.05)
    cubes = np.array([one.cubes for one in some])
    # within the σ of the mean, and rounding of what is exact
    sigma = cubes.std(0, ddof=1) / np.sqrt(len(some))
    assert (np.abs(cubes.mean(0) - exact.cubes) < 4 * sigma + 1e-9 * np.abs(exact.cubes)).all()


def test_sizes_have_a_variance_whatever_the_clusters_that_it_is_from(distances):
    """Errors along tracks are almost independent of each other here, so that the two sizes can
    hardly be told apart: a covariance from a single cluster gave them negative variances. For
    independent errors the covariance of the forms is exact."""
    found, _, _, given, used = distances
    parts = components_of_distances(given, used)
    independent = sp.diags(used.astype(float)) @ sp.eye(len(used), len(given[0]))
    parts[1] = ErrorComponent("along", "σ", (independent + 0.3 * parts[1].root).tocsr())
    for seed in range(12):
        settings = ErrorSettings(max_columns=20, max_clusters=1, seed=seed)
        model = fit_error_model(found, parts, settings)
        assert np.isfinite(model.theta_sigma).all() and (model.theta_sigma > 0).all()
        products = products_of(found, parts, settings)
        traces = products.traces(1, np.random.default_rng(seed))
        white = traces.covariance_of_forms(np.eye(5)[0])
        np.testing.assert_allclose(white, 2 * traces.T, rtol=1e-9)


def test_forms_are_raised_to_those_of_independent_errors():
    rng = np.random.default_rng(3)
    M = rng.normal(size=(30, 8))
    M = np.eye(30) - M @ np.linalg.solve(M.T @ M, M.T)
    V = [np.eye(30), *(f @ f.T for f in rng.normal(size=(3, 30, 4)))]
    T = np.array([[np.trace(M @ a @ M @ b) for b in V] for a in V])
    A = M @ (0.7 * V[0] + 0.2 * V[1] + 0.1 * V[3]) @ M
    forms = 2 * np.array([[np.trace(A @ a @ A @ b) for b in V] for a in V])
    np.testing.assert_allclose(raise_to_independent(forms, T, 0.7), forms, rtol=1e-9)
    least = 2 * 0.7**2 * T
    disturbed = forms - 1.5 * np.outer(forms[0], forms[0]) / forms[0, 0]
    assert np.linalg.eigvalsh(disturbed).min() < 0
    excess = np.linalg.eigvals(np.linalg.solve(T, raise_to_independent(disturbed, T, 0.7) - least))
    assert excess.real.min() > -1e-9
    # A component that is a combination of others has no direction of its own.
    B = np.vstack([np.eye(4), [1, 2, 0, 0]])
    twice = B @ forms @ B.T
    np.testing.assert_allclose(raise_to_independent(twice, B @ T @ B.T, 0.7), twice, rtol=1e-8)


def test_intervals_hold_although_sizes_are_estimated(network):
    """Thirteen instruments tell the size of their offsets with few degrees of freedom: covariances
    as estimated cover less than 95 %, those with Student's quantile not less. (300 draws: 94.0 and
    96.4 %, 0.3 % each.)"""
    adjust, A, Q, rows = network
    rng, parts, inside, ratios = np.random.default_rng(11), components(rows)[:1], [], []
    for _ in range(60):
        e = rng.normal(size=len(A)) + 4 * parts[0].root @ rng.normal(size=POINTS - 1)
        model = fit_error_model(adjust(e), parts)
        x = (e @ A @ Q).reshape(POINTS, 3)
        models = model.as_estimated, model
        both = [np.diagonal(m.covariance("point"), axis1=1, axis2=2) for m in models]
        held = both[0] > 1e-9 * both[0].max()
        inside.append([np.mean(x[held] ** 2 < 1.96**2 * C[held]) for C in both])
        ratios.append(model.widening[1])
    as_estimated, widened = np.mean(inside, 0)
    assert as_estimated < widened and 0.94 < widened < 0.985
    # t²/z² of twelve squares, of which the points absorb a part, and of six: 1.24, 1.56
    assert 1.1 < np.median(ratios) < 1.6


def test_sizes_are_those_of_the_errors_in_the_mean(network):
    adjust, A, _, rows = network
    rng, parts, theta = np.random.default_rng(7), components(rows), []
    settings = ErrorSettings(significance=1 - 1e-12)  # those that chance could explain, too
    for _ in range(60):
        e = rng.normal(size=len(A))
        e += sum(2 * part.root @ rng.normal(size=part.root.shape[1]) for part in parts)
        theta.append(fit_error_model(adjust(e), parts, settings).theta)
    mean, error = np.mean(theta, 0), np.std(theta, 0) / np.sqrt(60)
    # θ ≥ 0 leaves a bias of a part of σ where it is active
    assert (np.abs(mean - [1, 4, 4]) < 3.5 * error).all(), (mean, error)


def test_roots_of_many_columns_are_combined_at_random(network):
    adjust, A, _, rows = network
    rng = np.random.default_rng(3)
    parts = components(rows)
    e = rng.normal(size=len(A)) + 2 * parts[0].root @ rng.normal(size=POINTS - 1)
    found = adjust(e)
    exact = fit_error_model(found, parts[:1])
    drawn = fit_error_model(found, parts[:1], ErrorSettings(max_columns=4, draws=600))
    np.testing.assert_allclose(drawn.theta, exact.theta, rtol=0.15)
    own = [np.trace(m.own[0]["point"].sum(0)) for m in (exact, drawn)]
    assert abs(own[1] / own[0] - 1) < 0.15


def test_scores_are_standard_normal_without_shared_errors(network):
    adjust, A, _, rows = network
    rng, scores, sizes = np.random.default_rng(4), [], []
    for _ in range(40):
        model = fit_error_model(adjust(rng.normal(size=len(A))), components(rows))
        scores.append(model.score[1:])
        sizes.append(np.sqrt(model.theta))
    scores = np.array(scores)
    # mean 0 ± 1/√40, σ 1 ± 1/√80; forms of 13 and 4 squares are skew
    assert (np.abs(scores.mean(0)) < 0.5).all() and (np.abs(scores.std(0) - 1) < 0.4).all()
    assert abs(np.mean([s[0] for s in sizes]) - 1) < 0.1
    assert model.sizes[0].name == "independent errors" and model.score[0] == 0


def test_effects_on_rows_that_stay_in_the_reduced_system_are_those_of_dense_algebra():
    """Points 1 and 3 are tied by a difference, so that they are not eliminated with the others."""
    n, shifts = 5, 3
    point, shift = (a.ravel() for a in np.meshgrid(np.arange(n), np.arange(shifts), indexing="ij"))
    view = ls.Kind("view", lambda p, s, y: p + s - y, of=("point", "shift"))
    tie = ls.Kind("tie", lambda a, b, d: b - a - d, of=("point", "point"))
    problem = make_problem(
        [ls.Table("point", np.zeros(n)), ls.Table("shift", np.zeros(shifts), free=[0, 1, 1])],
        [view((point, shift), np.zeros(len(point)), sigma=0.5), tie(([1], [3]), [0.0])],
        eliminate="point",
    )  # fmt: skip
    assert problem.plan.eliminated == "point" and problem.kept_rows.tolist() == [0, 1, 0, 1, 0]
    A = np.zeros((len(point) + 1, n + shifts))
    rows = np.arange(len(point))
    A[rows, point] = A[rows, n + shift] = 1 / 0.5
    A[-1, [1, 3]] = -1, 1
    A = np.delete(A, n, axis=1)  # the first shift is held
    e = np.random.default_rng(2).normal(size=(3, len(A)))
    found = Solution(problem, {t.name: t.value for t in problem.tables})
    left, tables = remove_fit(found, e)
    x = e @ np.linalg.pinv(A).T
    np.testing.assert_allclose(left, e - x @ A.T, atol=1e-10)
    np.testing.assert_allclose(tables["point"].reshape(3, n), x[:, :n], atol=1e-10)
    np.testing.assert_allclose(tables["shift"].reshape(3, shifts)[:, 1:], x[:, n:], atol=1e-10)
    assert not tables["shift"].reshape(3, shifts)[:, 0].any()


def test_traces_are_those_of_dense_algebra():
    """Roots of few columns exactly, that of many from random combinations of them."""
    rng = np.random.default_rng(0)
    n, unknowns = 60, 9
    A = rng.normal(size=(n, unknowns))
    M = np.eye(n) - A @ np.linalg.pinv(A)
    F = [sp.csr_matrix(s * rng.normal(size=(n, k))) for k, s in ((4, 1), (7, 0.5), (50, 0.1))]
    traces = Traces(F, n - unknowns)
    for k, root in enumerate(F[:2]):
        traces.add(k, root.toarray().T, root.toarray().T @ M, True)
    drawn = (F[2] @ rng.choice([-1.0, 1.0], (50, 4000))).T / np.sqrt(4000)
    products = traces.add(2, drawn, drawn @ M, False)
    traces.add_cubes(2, drawn @ M, (F[2] @ products).T @ M, 1.0)
    T, cubes = traces.of_all()
    V = [M] + [M @ (f @ f.T).toarray() @ M for f in F]
    np.testing.assert_allclose(T, np.einsum("iab,jba->ij", V, V), rtol=0.02)
    np.testing.assert_allclose(cubes, np.einsum("iab,jbc,kca->ijk", V, V, V), rtol=0.03)
    few = np.ix_(range(3), range(3), range(3))
    exact = np.einsum("iab,jbc,kca->ijk", V[:3], V[:3], V[:3])
    np.testing.assert_allclose(cubes[few], exact, rtol=1e-9)


def test_chance_makes_no_component(network):
    """Independent errors show one in as many adjustments as the level says, though the form of four
    columns is far from normal."""
    adjust, A, _, rows = network
    rng, parts = np.random.default_rng(8), components(rows)
    system = fit_error_model(adjust(rng.normal(size=len(A))), parts).equations
    M = np.eye(len(A)) - A @ np.linalg.pinv(A, 1e-9)
    v = rng.normal(size=(4000, len(A))) @ M
    q = quadratic_forms(parts, v)
    found = {
        name: np.mean([dataclasses.replace(system, **skewed).solve(one)[0][1:].any() for one in q])
        for name, skewed in (("skewed", {}), ("normal", {"cubes": None}))
    }
    # 0.05 ± 0.0035
    assert 0.03 < found["skewed"] < 0.06 < found["normal"], found


@pytest.mark.parametrize("degrees", [1, 5, 80])
def test_skewed_quantiles_are_those_of_chi2(degrees):
    expected = (chi2_quantile(0.99, degrees) - degrees) / np.sqrt(2 * degrees)
    g = np.sqrt(8 / degrees)
    assert skewed_quantile(0.99, g) == pytest.approx(expected)
    assert skewed_quantile(0.01, -g) == pytest.approx(-expected)
    assert skewed_quantile(0.99, 1e-6) == pytest.approx(normal_quantile(0.99))
