"""`precision` against the dense inverse of networks built anew, and its derivatives against their
differences."""


import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from adjustment_checks import camera, linearise, synthetic
from scipy.spatial.transform import Rotation

import jaxbundle
from jaxbundle.errors import InputError

NETWORK = dict(
    cameras=(camera(model="snavely", free=("f", "k1")),), images=4, points=7, datum="inner",
    noise=0.0, disturbance=0.0, domain="measured",
)  # fmt: skip
NAMES = ("camera", "cam", "f"), ("point", "P1", "Z"), ("image", "image 2", "Y0")


@pytest.fixture(scope="module")
def problem():
    return jaxbundle.make_problem(synthetic(**NETWORK)[0])


@pytest.fixture(scope="module")
def program(problem):
    """The precision and the derivatives of the covariance by the whole design, at any design."""

    def covariance(data):
        found = jaxbundle.precision(problem, data, names=NAMES)
        return found.covariance, found

    return eqx.filter_jit(jax.jacrev(covariance, has_aux=True))


def dense_covariance(problem, data):
    """Of the unknowns of `NAMES`, from the whole Jacobian at measurements made anew."""
    values = data.start
    xyz = np.roll(values["image"].rotation, -1, axis=1)  # of any length, as the package takes them
    M = Rotation.from_quat(xyz).as_matrix()
    X0, X = np.asarray(values["image"].position), np.asarray(values["point"])
    away = X[problem.point] - X0[problem.image]
    x, y, z = np.einsum("nij,nj->in", M[problem.image], away)
    f, k1, k2 = np.asarray(values["camera"][0])
    r2 = (x * x + y * y) / (z * z)
    xy = np.stack([x, y], 1) * (-f * (1 + k1 * r2 + k2 * r2**2) / z)[:, None]
    data = problem.with_image_coordinates(data, jnp.asarray(xy))
    dense = linearise(problem, data=data)
    columns = dense.columns
    pick = [columns["camera"][0, 0], columns["point"][1, 2], columns["image"][2, 1]]
    return dense.Q[np.ix_(pick, pick)]


PLACES = {
    "position": lambda d: d.start["image"].position,
    "rotation": lambda d: d.start["image"].rotation,
    "point": lambda d: d.start["point"], "camera": lambda d: d.start["camera"],
    "weight": lambda d: d.weight["image"],
}  # fmt: skip


def moved(data, field, place, h):
    at = PLACES[field]
    return eqx.tree_at(at, data, at(data).at[place].add(h))


@pytest.mark.further
def test_precision_is_that_of_the_dense_inverse(problem, program):
    _, found = program(problem.data)
    dense = dense_covariance(problem, problem.data)
    sigma = np.sqrt(np.diag(dense))
    assert np.abs((found.covariance - dense) / np.outer(sigma, sigma)).max() < 1e-7
    np.testing.assert_allclose(
        [found.cameras[0, 0], found.points[1, 2], found.images[2, 1]], sigma, rtol=1e-7
    )
    assert (np.asarray(found.cameras) > 0).sum() == 2  # what is held has none


@pytest.mark.further
def test_derivatives_by_stations_targets_cameras_and_weights(problem, program):
    slopes, _ = program(problem.data)
    places = {
        "position": ((1, 2), 1e-3), "rotation": ((3, 1), 1e-4), "point": ((2, 0), 1e-3),
        "camera": ((0, 0), 0.25), "weight": ((5, 1), 0.16),
    }  # fmt: skip
    for field, (place, h) in places.items():
        slope = np.asarray(PLACES[field](slopes))[(..., *place)]
        ends = {k: dense_covariance(problem, moved(problem.data, field, place, k * h))
                for k in (-2, -1, 1, 2)}  # fmt: skip
        difference = (8 * (ends[1] - ends[-1]) - (ends[2] - ends[-2])) / (12 * h)
        assert np.abs(slope).max() > 0
        assert np.abs(slope - difference).max() < 1e-5 * np.abs(difference).max(), field
    # What was measured is not asked for.
    assert not np.asarray(slopes.measured["image"]).any()


@pytest.mark.further
def test_a_design_that_determines_nothing_is_nan(problem, program):
    """All stations at one place."""
    same = jnp.tile(problem.data.start["image"].position[:1], (4, 1))
    data = eqx.tree_at(lambda d: d.start["image"].position, problem.data, same)
    _, found = program(data)
    assert np.isnan(found.points).all() and np.isnan(found.images).all()
    assert np.isnan(found.cameras[0, 0])


@pytest.mark.further
def test_a_station_moves_the_precision_of_the_principal_distance_in_a_batch(problem):
    """∂σ²/∂X0, forward, under vmap and jit."""
    X0 = problem.data.start["image"].position[1, 0]

    def variance(x):
        data = eqx.tree_at(
            lambda d: d.start["image"].position, problem.data,
            problem.data.start["image"].position.at[1, 0].set(x),
        )  # fmt: skip
        return jaxbundle.precision(problem, data, names=NAMES[:1], sigma0=2.0).covariance[0, 0]

    h = 1e-3
    x = X0 + h * np.array([0, -2, -1, 1, 2])

    slope = lambda x: jax.jvp(variance, (x,), (1.0,))
    value, first = map(np.asarray, jax.jit(jax.vmap(slope))(x))
    assert value[0] == pytest.approx(4 * dense_covariance(problem, problem.data)[0, 0], rel=1e-7)
    stencil = lambda y: (8 * (y[3] - y[2]) - (y[4] - y[1])) / (12 * h)
    assert first[0] == pytest.approx(stencil(value), rel=1e-6)


def test_redundancy_numbers_and_their_derivative_by_a_weight(problem):
    def of(weight):
        data = problem.with_image_weights(problem.data, weight)
        return jaxbundle.redundancy(problem, data)["image"]

    weight, at, h = jnp.asarray(problem.image_weights), (5, 1), 1e-3
    towards = jnp.zeros_like(weight).at[at].set(1.0)
    program = jax.jit(lambda w: jax.jvp(of, (w,), (towards,)))
    r, slope = map(np.asarray, program(weight))
    dense = linearise(problem)  # of measurements without noise, in the measured image
    h_dense = np.einsum("ij,jk,ik->i", dense.J, dense.Q, dense.J)
    np.testing.assert_allclose(r.ravel(), 1 - h_dense, atol=1e-9)
    assert r.sum() == pytest.approx(problem.counts.redundancy)
    ends = [np.asarray(program(weight + k * h * towards)[0]) for k in (-1, 1)]
    difference = (ends[1] - ends[0]) / (2 * h)
    assert difference[at] < 0  # what weighs more controls itself less
    np.testing.assert_allclose(slope, difference, atol=1e-5 * np.abs(difference).max())


@pytest.mark.usefixtures("wrong_types")
def test_names_that_are_not_there(problem):
    with pytest.raises(KeyError, match="no camera parameter 'c'"):
        jaxbundle.precision(problem, names=(("camera", "cam", "c"),))
    with pytest.raises(InputError, match="problem must be"):
        jaxbundle.precision(problem.network)
