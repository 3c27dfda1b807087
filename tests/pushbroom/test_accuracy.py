"""Accuracy on the ground: closed form, propagation and Monte Carlo against each other."""

import itertools

import equinox as eqx
import jax
import numpy as np
import pytest
from pushbroom_scenes import PIXELS, above_a_plane, satellite
from scipy.stats import chi2

from jaxbundle.pushbroom.error_propagation import (
    circular_error,
    closed_form,
    propagate_accuracy,
    simulate_accuracy,
    spread_positions,
)
from jaxbundle.pushbroom.map_accuracy import CovarianceLattice, interpolate_covariances
from jaxbundle.pushbroom.noise import Noise, add_errors, zero_errors
from jaxbundle.pushbroom.surfaces import Ground, Plane
from jaxbundle.pushbroom.trajectory import attitude_at

EDGES = np.linspace(-0.5, PIXELS - 0.5, 201)
at = jax.jit(attitude_at)
LINE = np.full(200, 100.0), (EDGES[1:] + EDGES[:-1]) / 2
SOME = np.array([20.0, 300.0, 577.0]), np.array([3.0, 170.0, 398.0])


@pytest.mark.parametrize("roll, pitch, yaw", [
    (1e-4, 0, 0), (0, 1e-4, 0), (0, 0, 1e-4), (1e-4, 2e-4, 3e-4)
])  # fmt: skip
def test_closed_form_of_a_level_camera(roll, pitch, yaw):
    image = eqx.tree_at(lambda i: i.optics.row, above_a_plane(c=20.0), 0.0)
    noise = Noise(attitude_bias=np.array([pitch, roll, yaw]))
    found = propagate_accuracy(image, Plane(), *LINE, noise)
    view = 2 * np.arctan(0.05 * PIXELS / 2 / 20)
    expected = closed_form(1000, view, roll, pitch, yaw)
    np.testing.assert_allclose(found.overall, expected, rtol=3e-5)


NOISES = {
    "bias": Noise(attitude_bias=1e-4, position_bias=3.0),
    "drift": Noise(attitude_drift=1e-4, position_drift=2.0),
    "white": Noise(attitude_white=1e-4, position_white=5.0),
}


@pytest.mark.parametrize("name", NOISES)
def test_propagation_against_drawing(name):
    """RMS within 3 %, CE90, and covariances within four standard deviations, on the ellipsoid."""
    image, draws = satellite("lagrange", "slerp"), 6000
    exact = propagate_accuracy(image, Ground(), *SOME, NOISES[name])
    found = simulate_accuracy(image, Ground(), *SOME, NOISES[name], draws)
    np.testing.assert_allclose(found.rms, exact.rms, rtol=0.03)
    np.testing.assert_allclose(found.ce90, exact.ce90, rtol=0.04)
    scale = np.sqrt(np.einsum("nii,njj->nij", exact.covariance, exact.covariance))
    assert (np.abs(found.covariance - exact.covariance) / scale).max() < 4 * np.sqrt(2 / draws)


def test_rays_that_miss_are_left_out_of_the_overall_accuracy():
    """A camera rolled by 87° sees the sky on one side: what is known of the others stands. Without
    errors the accuracy is 0."""
    image = above_a_plane((0.0, 1.52, 0.0), c=20.0)
    places = np.full(2, 100.0), np.array([3.0, 396.0])
    for accuracy, noise in itertools.product(
        (propagate_accuracy, simulate_accuracy), (Noise(position_bias=1e-3), Noise())
    ):
        found = accuracy(image, Plane(), *places, noise)
        np.testing.assert_array_equal(np.isnan([found.rms, found.ce90]), [[True, False]] * 2)
        np.testing.assert_allclose(found.overall, found.rms[1])
        np.testing.assert_allclose(found.overall_ce90, found.ce90[1])
        assert (found.overall > 0) == (found.overall_ce90 > 0) == any(noise)
    missed = propagate_accuracy(image, Plane(), *(np.repeat(a[:1], 2) for a in places), Noise())
    assert np.isnan([missed.overall, missed.overall_ce90]).all()


@pytest.mark.further
def test_white_noise_is_averaged_between_the_rows():
    """Halfway between two rows, interpolation on the shortest way leaves σ/√2."""
    at_row, between = 60.0, 67.5  # rows every 0.1 s are 15 lines apart
    places = np.array([at_row, between, 300.0]), np.full(3, 200.0)
    found = propagate_accuracy(satellite(), Ground(), *places, Noise(attitude_white=1e-4))
    np.testing.assert_allclose(found.rms[1] / found.rms[0], np.sqrt(0.5), rtol=1e-3)


def test_errors_turn_angles_and_quaternions_alike():
    """An error of a row is R·exp([ε]×), however the attitude is given."""
    error = np.array([1e-3, -2e-3, 3e-3])
    for turns in ("angles", "slerp"):
        image = satellite(turns=turns)
        table = image.trajectory.attitude.table
        errors = zero_errors(image)
        errors = errors._replace(attitude_white=errors.attitude_white.at[14].set(error))
        t = table.times[14]
        images = image, jax.jit(add_errors)(image, errors)
        before, after = (np.array(at(i.trajectory.attitude, t)) for i in images)
        turn = before.T @ after
        np.testing.assert_allclose([turn[2, 1], turn[0, 2], turn[1, 0]], error, rtol=1e-2)
        np.testing.assert_allclose(
            np.arccos((np.trace(turn) - 1) / 2), np.linalg.norm(error), rtol=1e-6
        )


def test_circular_error():
    np.testing.assert_allclose(circular_error(np.eye(2)), np.sqrt(chi2.ppf(0.9, 2)), rtol=1e-6)
    np.testing.assert_allclose(
        circular_error(np.diag([4.0, 0.0])), 2 * np.sqrt(chi2.ppf(0.9, 1)), rtol=1e-3
    )
    samples = np.random.default_rng(0).normal(size=(400_000, 2)) * [3, 1]
    length = np.linalg.norm(samples, axis=1)
    counted = np.quantile(length, 0.9)
    np.testing.assert_allclose(circular_error(np.diag([9.0, 1.0])), counted, rtol=0.005)
    mixed = np.quantile(np.r_[length, 0.1 * length], 0.9)
    both = np.diag([9.0, 1.0]), np.diag([0.09, 0.01])
    np.testing.assert_allclose(circular_error(np.array(both)), mixed, rtol=0.005)


def test_a_lattice_of_one_line():
    ends, one_line = np.array([0.0, 1.0]), np.zeros(2)
    lattice = CovarianceLattice(ends, one_line, ends, np.full((3, 2, 2, 2), 4.0))
    found = interpolate_covariances(lattice, one_line, ends, np.array([0.2, 0.7]))
    np.testing.assert_allclose(found, 4)


@pytest.mark.parametrize("cells", [(1, 1), (11, 11), (3, 4)])
def test_positions_spread_over_the_lines_of_every_cell(cells):
    """One position in each equal part of the lines of a row of cells, at another place in each."""
    lines, pixels = spread_positions(4000, 2000, cells)
    rows, columns = cells
    assert lines.shape == pixels.shape == (*cells, -(-1000 // (rows * columns)))
    for values, size, axis in ((lines, 4000, 0), (pixels, 2000, 1)):
        cell = np.floor((values + 0.5) * cells[axis] / size)
        assert (cell == np.indices(lines.shape)[axis]).all()
    parts = np.floor((lines + 0.5) * lines.size / 4000).ravel()
    np.testing.assert_array_equal(np.sort(parts), np.arange(lines.size))
    within = np.sort((lines.ravel() + 0.5) * lines.size / 4000 % 1)
    assert np.abs(within - np.arange(lines.size) / lines.size).max() < 0.06
    across = np.sort((pixels + 0.5) * columns / 2000 % 1, axis=None)
    assert np.abs(across - np.arange(lines.size) / lines.size).max() < 0.01
