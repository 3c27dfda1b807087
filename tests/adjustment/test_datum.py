"""Datum defects found, and the datum imposed: conditions, invariance, groups of similarities."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from adjustment_checks import (
    DEFECTS,
    NETWORKS,
    adjusted,
    camera,
    columns,
    datum_matrices,
    flat,
    linearised,
    make,
    synthetic,
)

from jaxbundle.adjustment.datum import (
    gauge_directions,
    helmert,
    move_to_datum,
    open_directions_in_words,
    open_similarities,
    s_transform,
)
from jaxbundle.adjustment.jacobian import free_tangent
from jaxbundle.adjustment.problem import make_problem
from jaxbundle.adjustment.residuals import residuals
from jaxbundle.errors import InputError
from jaxbundle.network import make_structure


def with_control(network, rows, sigma):
    """Some points controlled, each with its own σ of X, Y, Z (inf: that axis is not)."""
    role, sigmas = list(network.points.role), network.points.sigma.copy()
    for row, values in zip(rows, sigma):
        role[row], sigmas[row] = "control", values
    points = dataclasses.replace(network.points, role=tuple(role), sigma=sigmas)
    return network.replace(points=points)


FREE, _ = synthetic(datum="inner", cameras=(camera(free=()),))
S, NO = 0.01, np.inf

CASES = {
    "nothing": (FREE, 7),
    "a distance": (synthetic(datum="inner", distances=[(0, 5)])[0], 6),
    # Rotations about the point, and scale about it.
    "a fixed point": (synthetic(datum="inner", fixed=1)[0], 4),
    # The rotation about the line through them.
    "two fixed points": (synthetic(datum="inner", fixed=2)[0], 1),
    "three fixed points": (synthetic(fixed=3)[0], 0),
    "three control points": (synthetic(control=3)[0], 0),
    "a control point": (with_control(FREE, [0], [[S, S, S]]), 4),
    "two control points": (with_control(FREE, [0, 1], [[S, S, S]] * 2), 1),
    # Position and height of the first, horizontal position of the second: its height and the
    # rotation about the line are open together with scale, 7 − 5.
    "5 coordinates of two points": (with_control(FREE, [0, 1], [[S, S, S], [S, S, NO]]), 2),
    "7 coordinates of three points": (
        with_control(FREE, [0, 1, 2], [[S, S, S], [S, S, NO], [NO, NO, S]]), 1
    ),
    # Heights close a shift, two rotations and (points not in one plane) the scale: 7 − 4.
    "four heights": (with_control(FREE, [0, 1, 2, 3], [[NO, NO, S]] * 4), 3),
    # An image held: everything but the scale.
    "a held image": (synthetic(datum="inner", held=[(0, range(6))])[0], 1),
    "a held image and a distance": (
        synthetic(held=[(0, range(6))], distances=[(0, 5)])[0], 0
    ),
    "two held centres": (synthetic(datum="inner", held=[(0, range(3)), (1, range(3))])[0], 1),
    "a held rotation": (synthetic(datum="inner", held=[(0, (3, 4, 5))])[0], 4),
    "exterior priors": (synthetic(exterior_prior=True)[0], 0),
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


@pytest.mark.parametrize(
    "scale, shift",
    [(1, 0), (1000, 0), (1, [5e6, 4e5, 1e3]), (1000, [2e7, -5e6, 0]), (1e-3, 0)],
    ids=["m", "mm", "national grid", "large", "km"],
)
@pytest.mark.parametrize("name", CASES)
def test_defect(name, scale, shift):
    network, defect = CASES[name]
    structure, data, *_ = make_structure(moved(network, scale, shift))
    gauge = open_similarities(structure, data)
    assert gauge.shape == (7, defect)
    # What is held does not move along the open directions.
    G = columns(helmert(structure, data.start)) @ gauge
    still = G[flat(free_tangent(structure)) == 0]
    assert np.abs(still).max(initial=0.0) <= 1e-9 * np.abs(G).max(initial=0.0)


def test_words():
    words = lambda name: open_directions_in_words(open_similarities(*_arrays(CASES[name][0])))
    assert words("nothing").endswith("rotation Z, scale")
    assert words("a distance").endswith("rotation Z")
    assert words("three control points") == "none"


def _arrays(network):
    return make_structure(network)[:2]


def test_an_open_datum_is_refused_unless_asked_for():
    network = CASES["a fixed point"][0]
    with pytest.raises(InputError, match=r"leave open .*scale \(4 of 7\)"):
        make_problem(network.replace(datum="control"))
    assert make_problem(network.replace(datum="minimal")).counts.datum == 4


def test_what_is_open_is_named_about_what_is_known():
    # About its one fixed point a network can only turn and grow.
    network = CASES["a fixed point"][0]
    with pytest.raises(InputError, match="leave open rotation X, rotation Y, rotation Z, scale "):
        make_problem(network.replace(datum="control"))


@pytest.mark.parametrize("chosen", [1, 2])
@pytest.mark.parametrize("datum", ["inner", "minimal"])
def test_datum_points_that_cannot_hold_the_datum_are_refused(datum, chosen):
    network = FREE.replace(datum=datum, datum_points=FREE.points.id[:chosen])
    with pytest.raises(InputError, match="cannot hold the datum"):
        make_problem(network)
    # Three on one line hold it no better.
    position = FREE.points.position.copy()
    position[2] = 0.3 * position[0] + 0.7 * position[1]
    points = dataclasses.replace(FREE.points, position=position)
    with pytest.raises(InputError, match="not on one line"):
        make_problem(network.replace(points=points, datum_points=FREE.points.id[:3]))


def test_start_values_that_cannot_be_computed_are_left_to_the_solver():
    structure, data = _arrays(FREE)
    point = data.start.point.at[0].set(jnp.nan)
    start = dataclasses.replace(data.start, point=point)
    assert open_similarities(structure, dataclasses.replace(data, start=start)).shape == (7, 7)


@pytest.mark.parametrize("name", DEFECTS)
def test_counts(name):
    problem = make(name)
    assert problem.structure.defect == problem.counts.datum == DEFECTS[name]
    assert problem.counts.redundancy == len(linear_rows(problem)) + DEFECTS[name] - int(
        flat(free_tangent(problem.structure)).sum()
    )


def linear_rows(problem):
    return flat(residuals(problem.structure, problem.data.start, problem.data))[
        flat(weights(problem.data)) > 0
    ]


def weights(data):
    return [data.image_weight, data.control_weight, data.exterior_weight, data.interior_weight,
            data.distance_weight]  # fmt: skip


@pytest.mark.parametrize("name", DEFECTS)
def test_s_transformation(name):
    problem = make(name)
    structure, values = problem.structure, problem.data.start
    G, B = datum_matrices(structure, values)
    rng = np.random.default_rng(0)
    change = jax.tree.map(
        lambda f: f * rng.normal(size=f.shape), free_tangent(structure)
    )
    found = flat(s_transform(structure, values, change))
    dense = flat(change) - G @ np.linalg.solve(B.T @ G, B.T @ flat(change))
    np.testing.assert_allclose(found, dense, atol=1e-11)
    np.testing.assert_allclose(B.T @ found, 0, atol=1e-11 * np.abs(B).sum(0).max())


SOLVED_FREE = ["free", "minimal", pytest.param("free with distances", marks=pytest.mark.slow)]


@pytest.mark.parametrize("name", SOLVED_FREE)
def test_the_datum_holds_exactly_after_convergence(name):
    problem, minimum = adjusted(name)
    structure, start = problem.structure, problem.data.start
    _, B = datum_matrices(structure, minimum.values)
    difference = np.asarray(minimum.values.point - start.point).ravel()
    B = B[-difference.size :]
    assert (np.abs(B.T @ difference) < 1e-13 * np.abs(B).sum(0)).all()
    weight = np.asarray(structure.datum_weight)
    if name == "minimal":
        assert weight.sum() == structure.defect
        # Not one rounding: the coordinates are solved for, not copied.
        still = np.abs(difference[weight.ravel() > 0]).max()
        assert still < 1e-14 and np.abs(difference).max() > 1e-3
    else:
        chosen = np.isin(problem.network.points.id, problem.network.datum_points or "")
        expected = chosen if chosen.any() else np.ones(len(weight), bool)
        assert (weight == expected[:, None]).all()


@pytest.mark.parametrize("name", ["free", "one fixed point"])
def test_moving_to_the_datum_changes_no_residual(name):
    problem = make(name)
    structure, data = problem.structure, problem.data
    # Any values will do: here the start values moved by a similarity of the group, not small.
    rng = np.random.default_rng(3)
    elsewhere = data.start.point + 0.3 * rng.normal(size=(1, 3)) + 0.05 * rng.normal(
        size=data.start.point.shape
    )
    target = dataclasses.replace(data.start, point=jnp.asarray(elsewhere))
    values = jax.jit(lambda s, v, t: move_to_datum(s, v, t))(structure, data.start, target)
    before = flat(residuals(structure, data.start, data))
    after = flat(residuals(structure, values, data))
    # Residuals are up to 100 σ, image coordinates 1000 σ: rounding of the coordinates.
    np.testing.assert_allclose(after, before, atol=1e-9)
    moved = np.asarray(values.point - data.start.point)
    assert np.abs(moved).max() > 0.02
    assert (moved[np.asarray(structure.point_free) == 0] == 0).all()
    _, B = datum_matrices(structure, values)
    B = B[-moved.size :]
    np.testing.assert_allclose(B.T @ np.ravel(values.point - target.point), 0, atol=1e-12)
    # The open directions at the new place are those of the same group.
    assert columns(gauge_directions(structure, values)).shape[1] == DEFECTS[name]


def test_inner_constraints_have_the_smallest_trace():
    # Against the minimal datum of the same network: Σσ² of the datum points.
    net = linearised("free")
    structure, values = net.problem.structure, net.problem.data.start
    traces = []
    for name in ("free", "minimal"):
        G, B = datum_matrices(make(name).structure, values)
        S = np.eye(len(G)) - G @ np.linalg.solve(B.T @ G, B.T)
        Q = S @ np.linalg.pinv(net.N, hermitian=True, rcond=1e-13) @ S.T
        traces.append(np.trace(Q[-3 * structure.points :, -3 * structure.points :]))
    assert traces[0] < traces[1]


def test_every_network_says_its_defect():
    assert {name: make(name).structure.defect for name in NETWORKS if name in DEFECTS} == DEFECTS
