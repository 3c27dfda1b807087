"""Datum defects found, and the datum imposed: conditions, invariance, groups of similarities."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from adjustment_checks import (
    NETWORKS,
    adjusted,
    camera,
    flat,
    linearise,
    linearised,
    make,
    residuals_of,
    solved,
    synthetic,
)

import jaxbundle
from jaxbundle.adjustment.problem import make_problem
from jaxbundle.adjustment.solve import solve
from jaxbundle.errors import InputError
from jaxbundle.geometry import (
    matrix_from_omega_phi_kappa,
    matrix_from_rotation_vector,
    omega_phi_kappa_from_matrix,
)
from jaxbundle.leastsquares.datum.conditions import generators, move_to_datum, s_transform
from jaxbundle.leastsquares.datum.defect import find_open_motions, survey_motions
from jaxbundle.leastsquares.equations.normal import zero_tangent
from jaxbundle.leastsquares.problem import pad_data, pad_values, with_motions_at, without_filling
from jaxbundle.network.datum_words import open_directions_in_words


def with_control(network, sigma):
    """The first points as control, each with its own σ of X, Y, Z (inf: no control along that
    axis); always four, so that all share their programs."""
    role, sigmas = list(network.points.role), network.points.sigma.copy()
    role[:4], sigmas[:4] = ["control"] * 4, np.inf
    sigmas[: len(sigma)] = sigma
    points = dataclasses.replace(network.points, role=tuple(role), sigma=sigmas)
    return network.replace(points=points)


def network_of(**options):
    return synthetic(**{"datum": "inner", "cameras": (camera(free=()),)} | options)[0]


FREE = network_of()
S, NO = 0.01, np.inf

CASES = {
    "nothing": (FREE, 7),
    "a distance": (network_of(distances=[(0, 5)]), 6),
    # Rotations about the point, and scale about it.
    "a fixed point": (network_of(fixed=1), 4),
    # The rotation about the line through them.
    "two fixed points": (network_of(fixed=2), 1),
    "three fixed points": (network_of(fixed=3), 0),
    "three control points": (with_control(FREE, [[S, S, S]] * 3), 0),
    "a control point": (with_control(FREE, [[S, S, S]]), 4),
    "two control points": (with_control(FREE, [[S, S, S]] * 2), 1),
    # Position and height of the first, horizontal position of the second: its height and the
    # rotation about the line are open together with scale, 7 − 5.
    "5 coordinates of two points": (with_control(FREE, [[S, S, S], [S, S, NO]]), 2),
    "7 coordinates of three points": (with_control(FREE, [[S, S, S], [S, S, NO], [NO, NO, S]]), 1),
    # Heights close a shift, two rotations and (points not in one plane) the scale: 7 − 4.
    "four heights": (with_control(FREE, [[NO, NO, S]] * 4), 3),
    # An image held: everything but the scale.
    "a held image": (network_of(held=[(0, range(6))]), 1),
    "a held image and a distance": (network_of(held=[(0, range(6))], distances=[(0, 5)]), 0),
    "two held centres": (network_of(held=[(0, range(3)), (1, range(3))]), 1),
    "a held rotation": (network_of(held=[(0, (3, 4, 5))]), 4),
    "exterior priors": (network_of(exterior_prior=True), 0),
}  # fmt: skip
"""A network and the defect that follows by hand: 7 less the similarities that are closed."""


def moved(network, scale, shift):
    """The same network in another object unit and far from the origin."""
    points, images = network.points, network.images
    unit = np.array([scale] * 3 + [1.0] * 3)
    return network.replace(
        points=dataclasses.replace(
            points, position=scale * points.position + shift, sigma=scale * points.sigma
        ),
        images=dataclasses.replace(
            images, position=scale * images.position + shift, sigma=images.sigma * unit
        ),
        distances=dataclasses.replace(
            network.distances,
            value=scale * network.distances.value,
            sigma=scale * network.distances.sigma,
        ),
    )


PLACES = ((1, 0), (1000, 0), (1, [5e6, 4e5, 1e3]), (1000, [2e7, -5e6, 0]), (1e-3, 0))
"""In m, in mm, in a national grid, large there, in km."""


@pytest.mark.parametrize("name", CASES)
def test_defect(name):
    network, defect = CASES[name]
    for scale, shift in PLACES:
        system = make_problem(moved(network, scale, shift))
        assert system.counts.datum == defect
        if not defect:
            continue
        # What is held does not move along the open directions.
        moves = program(system.declared, system.data.start)
        along = {t: np.asarray(rows) @ system.plan.datum.gauge for t, rows in moves.items()}
        for table in system.tables:
            still = along[table.name][table.free == 0]
            size = np.abs(along[table.name]).max(initial=0.0)
            assert np.abs(still).max(initial=0.0) <= 1e-9 * size


program = eqx.filter_jit(generators)


def test_open_motions_turn_about_the_control_point_where_it_is():
    """An adjustment moves it, and the rotations and the scale that it leaves open with it."""
    network, defect = CASES["a control point"]
    problem = make_problem(network)
    X = np.array(problem.data.start["point"])
    X[0] += [0.3, -0.2, 0.1]
    values = {**problem.data.start, "point": X}
    there = with_motions_at(problem, values)
    assert there.plan.datum.gauge.shape == (7, defect)
    along = np.asarray(program(there.declared, values)["point"]) @ there.plan.datum.gauge
    assert np.abs(along[0]).max() < 1e-9 * np.abs(along).max()


def test_words():
    gauge = lambda name: make_problem(CASES[name][0]).plan.datum.gauge
    assert open_directions_in_words(gauge("nothing")).endswith("rotation Z, scale")
    assert open_directions_in_words(gauge("a distance")).endswith("rotation Z")
    assert open_directions_in_words(np.zeros((7, 0))) == "none"
    together = np.array([[0, 0, 1, 0, 0, 0, 1.0]]).T
    for size in (1.0, 1e-300, 1e200):  # squares that are no numbers
        assert open_directions_in_words(size * together) == "1 combination of shift Z, scale"


def test_a_sigma_beside_which_others_count_as_none_is_named():
    """Three control points fix a datum; not if one coordinate is a hundred billion times better."""
    control = with_control(FREE, [[1e-11 * S, S, S], [S, S, S], [S, S, S]]).replace(datum="control")
    with pytest.raises(InputError, match="σ of X of control point 'P0' is 1e-13: beside it others"):
        make_problem(control)


def test_an_open_datum_is_refused_unless_asked_for():
    """And described relative to what is known: about its one fixed point a network can only rotate
    and scale."""
    network = CASES["a fixed point"][0]
    open_ones = r"leave open rotation X, rotation Y, rotation Z, scale \(4 of 7\)"
    with pytest.raises(InputError, match=open_ones):
        make_problem(network.replace(datum="control"))
    assert make_problem(network.replace(datum="minimal")).counts.datum == 4


@pytest.mark.parametrize("chosen", [1, 2])
@pytest.mark.parametrize("datum", ["inner", "minimal"])
def test_datum_points_that_cannot_hold_the_datum_are_refused(datum, chosen):
    network = FREE.replace(datum=datum, datum_points=FREE.points.id[:chosen])
    with pytest.raises(InputError, match="cannot fix the datum"):
        make_problem(network)
    # Three on one line hold it no better.
    position = FREE.points.position.copy()
    position[2] = 0.3 * position[0] + 0.7 * position[1]
    points = dataclasses.replace(FREE.points, position=position)
    with pytest.raises(InputError, match="not collinear"):
        make_problem(network.replace(points=points, datum_points=FREE.points.id[:3]))


def test_start_values_that_cannot_be_computed_are_left_to_the_solver():
    system = make_problem(FREE)
    point = system.data.start["point"].at[0].set(jnp.nan)
    data = dataclasses.replace(system.data, start=system.data.start | {"point": point})
    real = {t.name: np.arange(system.sizes["table", t.name]) < t.rows for t in system.tables}
    gauge = find_open_motions(
        survey_motions(system.declared, system.plan, pad_data(system, data), real)
    )
    assert gauge.shape == (7, 7)


@pytest.mark.parametrize("name", ["free", "free with distances"])
def test_s_transformation(name):
    system, dense = make(name), linearised(name)
    G, B, random = dense.G, dense.B, np.random.default_rng(0)
    values = pad_values(system, system.data.start)
    change = jax.tree.map(
        lambda z, f: f * random.normal(size=z.shape), zero_tangent(system.plan),
        {g: group.free for g, group in system.plan.groups.items()},
    )  # fmt: skip
    found = flat(eqx.filter_jit(s_transform)(system.declared, system.plan, values, change))
    expected = flat(change) - G @ np.linalg.solve(B.T @ G, B.T @ flat(change))
    np.testing.assert_allclose(found, expected, atol=1e-11)
    np.testing.assert_allclose(B.T @ found, 0, atol=1e-11 * np.abs(B).sum(0).max())


def chosen_points():
    problem = make_problem(synthetic(**NETWORKS["free"], datum_points=("P1", "P2", "P4", "P7"))[0])
    return problem, solved(problem)


@pytest.mark.parametrize("name", ["free", "minimal", "some points"])
def test_the_datum_holds_exactly_after_convergence(name):
    problem, minimum = chosen_points() if name == "some points" else adjusted(name)
    difference = np.asarray(minimum.values["point"] - problem.data.start["point"]).ravel()
    dense = linearise(problem, minimum.values)
    B = dense.B[dense.columns["point"].ravel()]
    assert (dense.B != 0).sum() == (B != 0).sum() > 0
    assert (np.abs(B.T @ difference) < 1e-13 * np.abs(B).sum(0)).all()
    weight = np.asarray(problem.plan.datum.weight["point"])[: len(problem.network.points)]
    if name == "minimal":
        assert weight.sum() == problem.counts.datum == 7
        # Not one rounding: the coordinates are solved for, not copied.
        still = np.abs(difference[weight.ravel() > 0]).max()
        assert still < 1e-14 and np.abs(difference).max() > 1e-3
    else:
        chosen = np.isin(problem.network.points.id, problem.network.datum_points or "")
        expected = chosen if chosen.any() else np.ones(len(weight), bool)
        assert (weight == expected[:, None]).all()


@pytest.mark.further
def test_moving_to_the_datum_changes_no_residual():
    problem = make("one fixed point")
    system, start = problem, problem.data.start
    # Any values will do: here the start values moved by a similarity of the group, not small.
    random = np.random.default_rng(3)
    shape = start["point"].shape
    elsewhere = start["point"] + 0.3 * random.normal(size=(1, 3)) + 0.05 * random.normal(size=shape)
    target = start | {"point": jnp.asarray(elsewhere)}
    tables = [pad_values(system, v) for v in (start, target)]
    found, there = eqx.filter_jit(move_to_datum)(system.declared, system.plan, *tables)
    assert there
    values = without_filling(system, found)
    # Residuals are up to 100 σ, image coordinates 1000 σ: rounding of the coordinates.
    np.testing.assert_allclose(
        residuals_of(problem, values), residuals_of(problem, start), atol=1e-9
    )
    change = np.asarray(values["point"] - start["point"])
    assert np.abs(change).max() > 0.02 and (change[0] == 0).all()
    dense = linearise(problem, values)
    B = dense.B[dense.columns["point"].ravel()]
    np.testing.assert_allclose(B.T @ np.ravel(values["point"] - target["point"]), 0, atol=1e-12)


def test_inner_constraints_have_the_smallest_trace():
    """Of the cofactors of the datum points, here all; against a minimal datum."""
    traces = [
        np.trace(dense.Q[np.ix_(at, at)])
        for dense in map(linearised, ("free", "minimal")) for at in [dense.columns["point"].ravel()]
    ]  # fmt: skip
    assert traces[0] < 0.9 * traces[1]


@pytest.fixture(scope="module")
def attitudes_without_a_scale():
    """A network of observed attitudes: they turn it, and only its start values give its scale."""
    made = jaxbundle.simulate_with_truth(
        jaxbundle.ring_of_stations(6, radius=4.0, height=2.0),
        jaxbundle.cloud_of_targets(20, 2.0, seed=1),
        jaxbundle.Camera("cam", "brown", {"c": 20.0}, ("c",)),
        noise=0.002, seed=2, datum="inner",
    )  # fmt: skip
    angles, sigmas = ("omega", "phi", "kappa"), ("somega", "sphi", "skappa")
    rows = [
        {"image": id, **dict.fromkeys(angles, 0.0), **dict.fromkeys(sigmas, 1e-3)}
        for id in made.network.images.id
    ]
    network = jaxbundle.add_further(made.network, attitudes=rows)
    return jaxbundle.simulate_further(network, made.truth, seed=3)


def turned_about_z(network, degrees):
    """The network with its start values turned."""
    R = matrix_from_rotation_vector(np.radians(degrees) * np.array([0.0, 0.0, 1.0]))
    M = [matrix_from_omega_phi_kappa(a) @ R.T for a in network.images.angles]
    images = dataclasses.replace(
        network.images,
        position=network.images.position @ R.T,
        angles=np.stack([omega_phi_kappa_from_matrix(m) for m in M]),
    )
    points = dataclasses.replace(network.points, position=network.points.position @ R.T)
    return network.replace(images=images, points=points)


def test_the_scale_of_start_values_stays_however_observations_turn_them(attitudes_without_a_scale):
    """|x|·cos θ would be too small, beyond 90° nothing."""
    points = [
        solved(make_problem(turned_about_z(attitudes_without_a_scale, degrees))).values["point"]
        for degrees in (0.0, 20.0, 150.0)
    ]
    # the centroid is that of the turned start values
    points = [np.asarray(p) - np.mean(p, 0) for p in points]
    np.testing.assert_allclose(points[1:], [points[0]] * 2, atol=1e-9)


@pytest.mark.further
def test_derivatives_by_turned_start_values(attitudes_without_a_scale):
    """First and second, by the start values of a point and by an attitude, against differences."""
    problem = make_problem(turned_about_z(attitudes_without_a_scale, 40.0))
    data = problem.data

    def size(move):
        point = data.start["point"].at[3].add(move[0] * jnp.array([1.0, -2.0, 0.5]))
        attitudes = data.measured["attitudes"].at[0, 2].add(move[1] * 1e-2)
        start, measured = data.start | {"point": point}, data.measured | {"attitudes": attitudes}
        found = solve(problem, dataclasses.replace(data, start=start, measured=measured))
        return jnp.linalg.norm(found["point"][0] - found["point"][7])

    here, step = jnp.array([0.05, 0.1]), 1e-3
    slope, curvature = jax.grad(size)(here), jax.hessian(size)(here)
    for k, e in enumerate(step * np.eye(2)):
        ends = [size(here + e), size(here - e)]
        np.testing.assert_allclose(slope[k], (ends[0] - ends[1]) / (2 * step), rtol=1e-5)
        slopes = [jax.grad(size)(here + e), jax.grad(size)(here - e)]
        difference = (slopes[0] - slopes[1]) / (2 * step)
        np.testing.assert_allclose(curvature[k], difference, rtol=1e-4, atol=1e-8)


def test_open_directions_are_orthonormal_on_the_datum_unknowns():
    """Also where one open motion, as the height of horizontal angles, has no effect on anything:
    with nearly parallel directions the S-transformation loses its digits."""
    network = jaxbundle.read_network("examples/convergent4/project.toml").replace(datum="inner")
    azimuth = lambda at, to: jnp.arctan2(*(to - at)[:2])
    kind = jaxbundle.leastsquares.Kind(
        "horizontal angles", lambda at, a, b, m: azimuth(at, b) - azimuth(at, a) - m,
        of=("point", "point", "point"),
    )  # fmt: skip
    ids = network.points.id
    rows = [[ids[k] for k in ks] for ks in ((0, 4, 8, 2), (5, 1, 3, 7), (9, 8, 6, 5))]
    angles = kind(rows=tuple(rows), measured=np.zeros(4), sigma=1e-4)
    problem = jaxbundle.make_problem(network, also=[angles])
    datum = problem.plan.datum
    assert datum.gauge.shape[1] == 5
    moves = generators(problem.declared, problem.data.start)
    G = [np.asarray(moves[t]) @ datum.gauge for t in datum.weight]
    gram = sum(
        np.einsum("nwi,nw,nwj->ij", g, np.asarray(w)[: len(g)], g)
        for g, w in zip(G, datum.weight.values())
    )
    np.testing.assert_allclose(gram, np.eye(5), atol=1e-10)
