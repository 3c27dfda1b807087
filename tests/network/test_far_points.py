"""Points at any distance: nearly parallel rays give directions, and distances up to infinity."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from network.further_checks import sample

import jaxbundle
from jaxbundle.adjustment.far_points import at_infinity, minimise_holding_infinite_points
from jaxbundle.adjustment.minimum import inspect_solution
from jaxbundle.adjustment.problem import coordinates
from jaxbundle.adjustment.quality.inspection import Inspection
from jaxbundle.adjustment.quality.points_at_any_distance import find_far_points
from jaxbundle.io import adjusted_network
from jaxbundle.io.results.result_json import result_text
from jaxbundle.leastsquares.any_distance import LARGEST_DISTANCE, AnyDistance, derivative
from jaxbundle.leastsquares.indexing.rows import lay_out_data, residuals
from jaxbundle.leastsquares.problem import pad_data, pad_values
from jaxbundle.leastsquares.quality.error_components import IndependentErrors
from jaxbundle.leastsquares.spaces import Vector

NEAR, FAR = 24, 8
LENGTHS = np.repeat([0.0, 2.0], [NEAR, FAR])


def simulated(distances, seed=4):
    """Six images side by side, 24 points near by and 8 of a horizon, and their truth."""
    random = np.random.default_rng(seed)
    near = random.uniform([-6, 6, -2], [6, 14, 3], (NEAR, 3))
    azimuth, elevation = random.uniform([-0.5, 0.0], [0.5, 0.2], (FAR, 2)).T
    direction = np.stack([np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation),
                          np.sin(elevation)], 1)  # fmt: skip
    centres = np.column_stack([np.linspace(-2.5, 2.5, 6), random.uniform(-0.5, 1, (6, 2))])
    stations = jaxbundle.stations_looking_at(centres, np.array([0.0, 12, 0.3]))
    camera = jaxbundle.Camera("cam", "brown", {"c": 24.0, "K1": -1e-4}, free=("c", "K1"))
    targets = np.concatenate([near, np.asarray(distances)[:, None] * direction])
    network = jaxbundle.simulate(
        stations, targets, camera, noise=0.0005, seed=seed, distances=[(0, 1)]
    )
    return network, targets


def prepared(network, lengths=None):
    return jaxbundle.make_problem(jaxbundle.check_network(network), lengths=lengths)


@pytest.fixture(scope="module")
def horizon():
    """A horizon from two thousand times the base to infinity, and its adjustment."""
    network, targets = simulated(np.geomspace(1e4, 1e9, FAR), seed=6)
    return network, targets, jaxbundle.adjust(network)


@pytest.fixture(scope="module")
def moderate():
    """Points so far that their coordinates still can be adjusted: in both ways."""
    network, _ = simulated(np.full(FAR, 150.0))
    found = []
    for lengths in (None, LENGTHS):
        problem = prepared(network, lengths)
        start = problem.data.start
        problem, minimum = minimise_holding_infinite_points(problem, start, max_steps=50)
        found.append(inspect_solution(problem, minimum))
    return found


# --- the space ------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [(3.0, -2, 5, 2), (4e7, 1e8, -6e7, 2), (3.0, -2, 5, 0)])
def test_a_place_moves_as_its_derivative_says(value):
    value, change = np.array(value), np.array([0.02, -0.03, 0.05])
    A, slope, moved, there, difference = (np.asarray(x) for x in _of_a_place(value, change))
    scale = np.abs(value).max()
    np.testing.assert_allclose(A, slope, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(moved, there[:3], rtol=1e-13, atol=1e-13 * scale)
    np.testing.assert_allclose(difference, change, rtol=1e-7)
    if value[3] == 0:
        np.testing.assert_array_equal(there[:3], Vector(3).retract(jnp.array(value[:3]), change))


@jax.jit
def _of_a_place(value, change):
    space = AnyDistance()
    retracted = lambda d: space.retract(value, d)
    there = retracted(change)
    return (
        derivative(value), jax.jacfwd(retracted)(jnp.zeros(3))[:3],
        jnp.stack(space.move(space.prepare(value), tuple(change))), there,
        space.difference(there, value),
    )  # fmt: skip


def test_across_the_ray_only_the_direction_turns_and_along_it_only_the_distance():
    value = jnp.array([30.0, -20, 50, 2])
    u = value[:3] / jnp.linalg.norm(value[:3])
    A = derivative(value)
    np.testing.assert_allclose(A[:, :2].T @ u, 0, atol=1e-12)
    np.testing.assert_allclose(jnp.cross(A[:, 2], u), 0, atol=1e-12)


def test_a_step_beyond_infinity_ends_there():
    space, value = AnyDistance(), jnp.array([3.0, -2, 500, 2])
    u = value[:3] / jnp.linalg.norm(value[:3])
    there = space.retract(value, jnp.array([0.0, 0.0, -5.0]))
    np.testing.assert_allclose(there[:3], LARGEST_DISTANCE * 2 * u, rtol=1e-12)
    back = space.retract(there, jnp.array([0.0, 0.0, 0.5]))
    assert 0 < jnp.linalg.norm(back[:3]) < 10 and back[:3] @ u > 0


def test_what_is_held_along_its_ray_keeps_its_distance_to_first_order():
    space, given = AnyDistance(), jnp.array([3.0, -2, 50, 2])
    moved = space.retract(given, jnp.array([1e-5, -2e-5, 3e-5]))
    held = space.hold(moved, given, jnp.array([1.0, 1.0, 0.0]))
    wanted = space.retract(given, jnp.array([1e-5, -2e-5, 0.0]))
    np.testing.assert_allclose(held, wanted, rtol=1e-12)
    np.testing.assert_array_equal(space.hold(moved, given, jnp.ones(3)), moved)


# --- the adjustment -------------------------------------------------------------------------


@pytest.mark.further
def test_coordinates_and_their_covariance_do_not_depend_on_how_points_move(moderate):
    one, other = moderate
    assert other.problem.lengths is not None
    np.testing.assert_allclose(other.vtpv, one.vtpv, rtol=1e-10)
    # In both the datum is that of the near points, the distance theirs.
    np.testing.assert_allclose(
        other.solution.propagate(_distances_of(other)),
        one.solution.propagate(_distances_of(one)), rtol=1e-5,
    )  # fmt: skip
    a, b = (np.asarray(coordinates(found.adjusted)) for found in moderate)
    lengths = lambda x: np.linalg.norm(x[NEAR:] - x[0], axis=1)
    sigma = np.sqrt(np.diagonal(one.solution.propagate(_distances_of(one))))
    assert np.abs((lengths(a) - lengths(b)) / sigma).max() < 1e-4


def _distances_of(inspection):
    """The function: distances of all far points from the first point."""

    def distances(tables):
        X = tables["point"][:, :3]
        return jnp.linalg.norm(X[NEAR:] - X[0], axis=1)

    return distances


@pytest.mark.further
def test_sigma_of_direction_and_inverse_distance_are_those_of_a_sample(moderate):
    found = moderate[1]
    far = find_far_points(found, IndependentErrors(found.solution, 1.0))
    draws = sample(found.problem, found.adjusted, ("point",), draws=40)["point"][:, NEAR:, :3]
    inverse = 1 / np.linalg.norm(draws, axis=2)
    ratio = inverse.std(0, ddof=1) / far.sigma_inverse_distance
    # The σ of a σ from 40 draws is 11 %; eight of them.
    assert 0.65 < ratio.min() and ratio.max() < 1.35
    u = draws * inverse[..., None]
    off = u - (u * far.direction).sum(2, keepdims=True) * far.direction
    across = np.sqrt((off**2).sum(2).mean(0) / (far.sigma_direction**2).sum(1))
    assert 0.75 < across.min() and across.max() < 1.25


def test_a_horizon_is_adjusted_and_lies_where_it_is(horizon):
    _, targets, result = horizon
    assert result.converged and 0.8 < result.sigma0 < 1.2
    far = result.far_points
    assert far.id == tuple(str(k + 1) for k in range(NEAR, NEAR + FAR))
    # The datum is inner, and the start values of the near points, which hold it, are the truth.
    truth = targets[NEAR:] - far.origin
    distance = np.linalg.norm(truth, axis=1)
    angle = np.linalg.norm(np.cross(truth / distance[:, None], far.direction), axis=1)
    assert (angle < 4 * np.hypot(*far.sigma_direction.T)).all()
    free = ~far.at_infinity
    error = (far.inverse_distance - 1 / distance) / far.sigma_inverse_distance
    assert np.abs(error[free]).max() < 3.5
    assert 0 < far.at_infinity.sum() < FAR and far.distance[far.at_infinity].min() == np.inf
    low, high = far.reach[free].T
    assert (low < far.distance[free]).all() and (far.distance[free] < high).all()


def test_points_at_infinity_are_named_and_have_no_coordinates(horizon, tmp_path):
    _, _, result = horizon
    there = result.far_points.at_infinity
    text = result.report()
    for id, infinite in zip(result.far_points.id, there):
        line = next(x for x in text.splitlines() if x.startswith(f"{id} ") and ("0." in x))
        assert ("at infinity" in text) and (infinite == np.isnan(result.points["X"][int(id) - 1]))
        assert line
    found = json.loads("".join(result_text(result)))
    told = {id for id, point in found["far_points"]["points"].items() if point["at_infinity"]}
    assert told == set(np.array(result.far_points.id)[there])
    for id in told:
        assert found["points"][id]["X"] == {"value": None, "sigma": None}
        np.testing.assert_allclose(
            sum(x**2 for x in found["far_points"]["points"][id]["direction"].values()), 1
        )
    adjusted = adjusted_network(result)
    assert not told & set(adjusted.points.id)
    assert len(adjusted.points) == NEAR + FAR - len(told)
    jaxbundle.write_project(adjusted, tmp_path / "adjusted")


def test_a_minimum_does_not_depend_on_what_was_held_at_infinity_before(horizon):
    _, _, result = horizon
    problem, values = result.problem, result.values
    point = np.array(values["point"])
    u = point[NEAR:, :3] / np.linalg.norm(point[NEAR:, :3], axis=1)[:, None]
    point[NEAR:, :3] = LARGEST_DISTANCE * LENGTHS[NEAR:, None] * u
    for start in (problem.data.start, values | {"point": jnp.asarray(point)}):
        again, minimum = minimise_holding_infinite_points(problem, start, max_steps=100)
        np.testing.assert_array_equal(
            at_infinity(again, minimum.values), at_infinity(problem, values)
        )
        found = inspect_solution(again, minimum)
        np.testing.assert_allclose(found.vtpv, result.vtpv, rtol=1e-9)


def test_vtpv_would_fall_beyond_infinity_and_nowhere_else(horizon):
    """The active set is right: of points there the slope along the inverse distance is positive,
    of the others it vanishes."""
    _, _, result = horizon
    problem, values = result.problem, result.values
    there = result.far_points.at_infinity
    space = problem.declared.spaces["point"]
    rows = jnp.asarray(values["point"])[NEAR:]

    def vtpv(along):
        X = jnp.stack([jnp.stack(space.move(space.prepare(row), (0.0, 0.0, d)))
                       for row, d in zip(rows, along)])  # fmt: skip
        point = jnp.asarray(values["point"]).at[NEAR:, :3].set(X)
        return _vtpv_of_images(problem, values | {"point": point})

    slope = np.asarray(jax.jit(jax.grad(vtpv))(jnp.zeros(FAR)))
    sigma = result.far_points.sigma_inverse_distance * problem.lengths[NEAR:]
    # An inverse distance falls where δ grows.
    assert (slope[there] > 0).all()
    assert np.abs(slope * sigma)[~there].max() < 1e-3


def _vtpv_of_images(problem, values):
    laid = lay_out_data(problem.plan, pad_data(problem, problem.data))
    rows = residuals(
        problem.declared, problem.plan, pad_values(problem, values), laid
    )
    of_images = [*problem.image_rows]
    return sum(jnp.vdot(rows[k], rows[k]) for k, part in enumerate(problem.plan.parts)
               if part.set_name in of_images)  # fmt: skip


@pytest.mark.further
def test_a_blunder_among_the_rays_of_the_horizon_is_found(horizon):
    network, _, result = horizon
    row = int(np.flatnonzero(network.observations.point == NEAR + 1)[2])
    xy = network.observations.xy.copy()
    xy[row] += 0.02
    rays = dataclasses.replace(network.observations, xy=xy)
    found = jaxbundle.adjust(network.replace(observations=rays), snooping="pope")
    assert found.converged and found.far_points is not None
    name = f"{network.images.id[network.observations.image[row]]}"
    assert len(found.removed) == 1 and str(NEAR + 2) in found.removed[0].name
    assert name in found.removed[0].name
    np.testing.assert_allclose(
        found.camera_parameters("cam")["c"], result.camera_parameters("cam")["c"], atol=3e-3
    )


@pytest.mark.further
def test_a_point_of_the_horizon_without_good_rays_is_excluded(horizon):
    """Two rays that contradict each other across their base: neither is used, nor their point."""
    network, _, result = horizon
    rays, spoilt = network.observations, NEAR + 1
    pair = np.flatnonzero(rays.point == spoilt)[[0, 3]]
    xy = rays.xy.copy()
    xy[pair[0], 1] += 0.03
    kept = (rays.point != spoilt) | np.isin(np.arange(len(rays)), pair)
    rays = dataclasses.replace(rays, xy=xy).take(kept)
    found = jaxbundle.adjust(network.replace(observations=rays), snooping="pope")
    (removed,) = found.removed
    assert removed.name.startswith("either of ") and len(removed.rows) == 2
    excluded = network.points.id[spoilt]
    assert found.converged and {*result.far_points.id} - {*found.far_points.id} == {excluded}
    assert np.isnan(found.point_values[spoilt]).all()
    np.testing.assert_allclose(
        found.camera_parameters("cam")["c"], result.camera_parameters("cam")["c"], atol=3e-3
    )


@pytest.mark.further
def test_start_values_of_a_horizon_are_found(horizon):
    """From image coordinates and one distance alone; most of the rays do not intersect."""
    network, _, result = horizon
    points, images = network.points, network.images
    blank = lambda x: np.full_like(x, np.nan)
    found = jaxbundle.adjust(network.replace(
        points=dataclasses.replace(points, position=blank(points.position)),
        images=dataclasses.replace(
            images, position=blank(images.position), angles=blank(images.angles)
        ),
    ))  # fmt: skip
    assert found.far_points.id == result.far_points.id
    np.testing.assert_array_equal(found.far_points.at_infinity, result.far_points.at_infinity)
    # Infinity is 1e8 of the unit of a frame, which is another: vᵀPv ends 1e-7 apart.
    np.testing.assert_allclose(found.vtpv, result.vtpv, rtol=1e-6)


@pytest.mark.further
def test_images_from_one_place_are_not_solved_by_points_at_infinity():
    """A panorama determines no distance at all; the message says so."""
    network, _ = simulated(np.full(FAR, 50.0))
    images = network.images
    position = np.tile(images.position[:1], (len(images), 1))
    network = network.replace(images=dataclasses.replace(images, position=position))
    problem = prepared(network)
    v = Inspection(problem, problem.data.start).image_residuals
    xy = network.observations.xy + v / problem.image_weights
    seen = dataclasses.replace(network.observations, xy=xy)
    result = jaxbundle.adjust(network.replace(observations=seen))
    assert not result.converged
    assert result.undetermined or result.weakness.lines
