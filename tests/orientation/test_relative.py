"""Relative orientation: exact truth, noise against cofactors, no base and planes by name."""

from functools import partial

import numpy as np
import pytest
from orientation_scenes import batch, mahalanobis, pairs

from jaxbundle.orientation import Status, five_points, orientations, relative_orientation

N, n = 200, 12
five = batch(relative_orientation)
eight = batch(partial(relative_orientation, method="eight"))


@pytest.mark.parametrize("orient", [five, eight])
def test_exact_points(orient):
    xy1, xy2, M, b = pairs(N, n)
    result = orient(xy1, xy2)
    np.testing.assert_allclose(result.M, M, atol=1e-10)
    np.testing.assert_allclose(result.b, b, atol=1e-10)
    assert (result.status == Status.SOUND).all()
    np.testing.assert_allclose(result.in_front, 1)


def test_noise_is_what_the_cofactors_say():
    """Turns of the second camera: M = exp([δ]×)·M_true."""
    sigma = 2e-4
    xy1, xy2, M, b = pairs(N, n, sigma, seed=1)
    result = five(xy1, xy2)
    sound = result.status == Status.SOUND
    assert sound.mean() > 0.98
    turn = result.M @ M.swapaxes(1, 2)
    delta = np.stack([turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]], 1)
    square = mahalanobis(delta[sound], result.cofactor[sound, :3, :3], sigma)
    assert 0.8 < np.median(square) / 2.366 < 1.25
    assert abs(result.vtpv[sound].mean() / sigma**2 - (n - 5)) < 4 * np.sqrt(2 * (n - 5) / N)


def test_five_points_have_the_truth_among_their_solutions():
    xy1, xy2, M, b = pairs(N, 5, seed=2)
    E, valid = batch(five_points)(xy1, xy2)
    truth = M @ np.cross(b[:, None], np.eye(3)).swapaxes(1, 2)
    error = np.minimum(*(np.abs(E + s * truth[:, None]).max((2, 3)) for s in (1, -1)))
    assert np.where(valid, error, np.inf).min(1).max() < 1e-5
    a1, a2 = (np.concatenate([xy, -np.ones((N, 5, 1))], 2) for xy in (xy1, xy2))
    misclosure = np.abs(np.einsum("kni,ksij,knj->ksn", a2, E, a1)).max(2)
    assert misclosure[valid].max() < 1e-5


def test_an_essential_matrix_has_four_orientations():
    _, _, M, b = pairs(N, 5, seed=3)
    truth = M @ np.cross(b[:, None], np.eye(3)).swapaxes(1, 2)
    Ms, bs = batch(orientations)(truth)
    error = np.abs(Ms - M[:, None]).max((2, 3)) + np.abs(bs - b[:, None]).max(2)
    assert ((error < 1e-12).sum(1) == 1).all()
    np.testing.assert_allclose(np.linalg.det(Ms), 1, atol=1e-12)


def test_a_rotation_has_no_base():
    for noise, named in ((0.0, 1.0), (2e-4, 0.85)):
        xy1, xy2, _, _ = pairs(N, n, noise, seed=4, base=0.0)
        for orient in (five, eight):
            assert (orient(xy1, xy2).status == Status.NO_BASE).mean() >= named


def test_a_plane():
    """Named by the method of eight points; of the two solutions of a plane, five points find one
    that fits exactly, mostly the true one, because the other has points behind a camera."""
    xy1, xy2, M, b = pairs(N, n, seed=5, plane=True)
    assert (eight(xy1, xy2).status == Status.COPLANAR_POINTS).all()
    result = five(xy1, xy2)
    assert (result.vtpv < 1e-16).all()
    near = np.abs(result.M - M).max((1, 2)) < 1e-7
    assert near.mean() > 0.4


def test_an_unknown_method_is_refused():
    with pytest.raises(ValueError, match="seven"):
        relative_orientation(np.zeros((8, 2)), np.zeros((8, 2)), method="seven")
