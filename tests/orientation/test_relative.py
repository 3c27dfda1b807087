"""Relative orientation: exact truth, noise against cofactors, no base and planes by name."""

from functools import partial

import numpy as np
import pytest
from orientation_scenes import batch, image_points, mahalanobis, pairs
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from jaxbundle.orientation import (
    Status,
    five_points,
    orientations,
    planar_orientations,
    relative_orientation,
)

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
    """Rotations of the second camera: M = exp([δ]×)·M_true."""
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


def test_both_solutions_of_a_plane():
    """The truth is one of them, the other fits the images as well; which are in front of both
    cameras is computed here from intersected points."""
    xy1, xy2, M, b = pairs(N, n, seed=5, plane=True)
    found = batch(planar_orientations)(xy1, xy2)
    error = np.abs(found.M - M[:, None]).max((2, 3)) + np.abs(found.b - b[:, None]).max(2)
    right = error.argmin(1)
    assert error.min(1).max() < 1e-6
    assert found.possible[np.arange(N), right].all()
    np.testing.assert_allclose(found.M @ found.M.swapaxes(2, 3), np.eye(3) + 0 * found.M, atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(found.M), 1)
    a1, a2 = (np.concatenate([xy, -np.ones((N, n, 1))], 2) for xy in (xy1, xy2))
    E = found.M @ np.cross(found.b[..., None, :], np.eye(3)).swapaxes(2, 3)
    assert np.abs(np.einsum("kni,ksij,knj->ksn", a2, E, a1)).max() < 1e-8
    # s₁·a₁ = b + s₂·Mᵀ·a₂ by least squares
    for k in range(20):
        for s in range(2):
            turned = a2[k] @ found.M[k, s]
            lengths = [np.linalg.lstsq(np.stack([p, -q], 1), found.b[k, s], rcond=None)[0]
                       for p, q in zip(a1[k], turned)]  # fmt: skip
            assert found.possible[k, s] == (np.array(lengths) > 0).all()
    both = found.possible.all(1)
    assert 0.05 < both.mean() < 0.95
    assert five(xy1, xy2).flat.all()
    xy1, xy2, *_ = pairs(N, n, seed=5)
    assert not five(xy1, xy2).flat.any()
    xy1, xy2, *_ = pairs(N, n, seed=4, base=0.0)
    assert (batch(planar_orientations)(xy1, xy2).status == Status.NO_BASE).all()
    on_a_line = np.arange(n)[:, None] * [0.02, 0.01]
    assert planar_orientations(on_a_line, 1.1 * on_a_line).status == Status.COLLINEAR_POINTS


def test_a_plane_must_be_in_front_of_the_second_camera_too():
    """One point of the plane behind it has an image by the formulas: no solution is possible with
    it, and the true one without."""
    random = np.random.default_rng(6)
    X = np.column_stack([random.uniform(2, 8, n), random.uniform(-2, 2, n), np.full(n, -5.0)])
    X[0, 0] = -4.0
    base, M = np.array([0.5, 0.2, -1.5]), Rotation.from_euler("y", 55, degrees=True).as_matrix()
    images = X, (X - base) @ M.T
    assert (images[1][:, 2] > 0).tolist() == [True] + [False] * (n - 1)
    xy1, xy2 = (-x[:, :2] / x[:, 2:] for x in images)
    weights = np.stack([np.ones(n), np.arange(n) > 0.0])
    found = batch(planar_orientations)(np.stack([xy1] * 2), np.stack([xy2] * 2), weights)
    error = np.abs(found.M - M).max((2, 3))
    np.testing.assert_allclose(error.min(1), 0, atol=1e-9)
    assert not found.possible[0].any() and found.possible[1, error[1].argmin()]


def test_against_scipy():
    """The least corrections of all four coordinates of every point, with the points as unknowns:
    to first order those of Sampson. And its own misclosures, minimised by scipy, exactly."""
    sigma = 2e-4
    xy1, xy2, M, b = pairs(N, n, sigma, seed=7)
    result = five(xy1, xy2)

    def orientation(unknowns, k):
        across = np.linalg.svd(b[k][None])[2][1:]
        base = b[k] + unknowns[3:5] @ across
        return Rotation.from_rotvec(unknowns[:3]).as_matrix() @ M[k], base / np.linalg.norm(base)

    def sampson(unknowns, k):
        turn, base = orientation(unknowns, k)
        E = turn @ np.cross(base, np.eye(3)).T
        a1, a2 = (np.column_stack([xy[k], -np.ones(n)]) for xy in (xy1, xy2))
        line2, line1 = a1 @ E.T, a2 @ E
        return np.sum(a2 * line2, 1) / np.sqrt((line2[:, :2] ** 2 + line1[:, :2] ** 2).sum(1))

    def reprojection(unknowns, k):
        turn, base = orientation(unknowns, k)
        Y = unknowns[5:].reshape(-1, 3)
        Z = (Y - base) @ turn.T
        one, two = -Y[:, :2] / Y[:, 2:] - xy1[k], -Z[:, :2] / Z[:, 2:] - xy2[k]
        return np.concatenate([one, two]).ravel()

    exact = dict(xtol=1e-15, ftol=1e-15, gtol=1e-15)
    for k in range(6):
        own = least_squares(sampson, np.zeros(5), args=(k,), x_scale=1e-3, **exact)
        turn, base = orientation(own.x, k)
        np.testing.assert_allclose(result.M[k], turn, atol=1e-8)
        np.testing.assert_allclose(result.b[k], base, atol=1e-7)
        np.testing.assert_allclose(result.vtpv[k], 2 * own.cost, rtol=1e-8)
        rays = np.column_stack([xy1[k], -np.ones(n)])
        depth = [np.linalg.lstsq(np.stack([p, -q], 1), base, rcond=None)[0][0]
                 for p, q in zip(rays, np.column_stack([xy2[k], -np.ones(n)]) @ turn)]  # fmt: skip
        start = np.concatenate([own.x, (rays * np.array(depth)[:, None]).ravel()])
        whole = least_squares(reprojection, start, args=(k,), **exact)
        turn, base = orientation(whole.x, k)
        assert result.vtpv[k] == pytest.approx(2 * whole.cost, rel=1e-3)
        away = np.sqrt(result.cofactor[k].diagonal()[:3].max()) * sigma
        assert np.abs(result.M[k] - turn).max() < 0.02 * away


def test_an_unknown_method_is_refused():
    with pytest.raises(ValueError, match="seven"):
        relative_orientation(np.zeros((8, 2)), np.zeros((8, 2)), method="seven")


def test_points_are_coplanar_if_a_plane_fits_nearly_as_well_as_the_orientation():
    """Up to six times the variance, each with its redundancy: n − 5 of one misclosure a point,
    2·n − 8 of two differences that contain the errors of both images. Points with more and more
    relief."""
    rng, noise = np.random.default_rng(7), 1e-4
    xy1, _, M, b = pairs(N, n, seed=6)
    rays = np.concatenate([xy1, -np.ones((N, n, 1))], 2)
    relief = np.geomspace(1e-4, 1e-2, N)[:, None, None] * rng.normal(size=(N, n, 1))
    xy2 = image_points(M, b, rays * 6 * (1 + relief)) + noise * rng.normal(size=xy1.shape)
    found = five(xy1, xy2)
    ratio = []
    for a, (x, y), vtpv in zip(rays * [1, 1, -1], xy2.swapaxes(1, 2), found.vtpv):
        nil = np.zeros((n, 3))
        A = np.block([[a, nil, -x[:, None] * a[:, :2]], [nil, a, -y[:, None] * a[:, :2]]])
        h = np.append(np.linalg.lstsq(A, np.concatenate([x, y]), rcond=None)[0], 1).reshape(3, 3)
        image = a @ h.T
        off = image[:, :2] / image[:, 2:] - np.stack([x, y], 1)
        ratio.append((off**2).sum() / (2 * (2 * n - 8)) / (vtpv / (n - 5)))
    sure = np.abs(np.log(np.array(ratio) / 6)) > 0.2
    assert sure.mean() > 0.8 and 0.1 < (np.array(ratio) < 6)[sure].mean() < 0.9
    np.testing.assert_array_equal(found.flat[sure], np.array(ratio)[sure] < 6)
