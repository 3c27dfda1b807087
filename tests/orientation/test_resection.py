"""Resection: exact truth, noise against cofactors, degenerate configurations by name."""

import jax
import jax.numpy as jnp
import numpy as np
from orientation_scenes import batch, image_points, images, mahalanobis
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from jaxbundle.orientation import CameraPose, Status, image_of, resection, three_points

N, n = 300, 8
resect = batch(resection)


def test_three_points_have_the_truth_among_their_solutions():
    xy, X, M, X0 = images(N, 3, seed=1)
    rays = np.concatenate([xy, -np.ones((N, 3, 1))], 2)
    poses, valid = batch(three_points)(rays, X)
    error = np.abs(poses.X0 - X0[:, None]).max(2) + np.abs(poses.M - M[:, None]).max((2, 3))
    assert np.where(valid, error, np.inf).min(1).max() < 1e-7
    assert set(valid.sum(1)) <= {1, 2, 3, 4}
    for k in range(4):
        computed = image_points(poses.M[:, k], poses.X0[:, k], X)
        np.testing.assert_allclose(computed[valid[:, k]], xy[valid[:, k]], atol=1e-7)


def test_exact_points():
    xy, X, M, X0 = images(N, n)
    result = resect(xy, X)
    np.testing.assert_allclose(result.pose.X0, X0, atol=1e-11)
    np.testing.assert_allclose(result.pose.M, M, atol=1e-12)
    assert (result.status == Status.SOUND).all()


def test_noise_is_what_the_cofactors_say():
    sigma = 1e-3
    xy, X, _, X0 = images(N, n, sigma, seed=2)
    result = resect(xy, X)
    square = mahalanobis(result.pose.X0 - X0, result.cofactor[:, :3, :3], sigma)
    assert abs(square.mean() - 3) < 4 * np.sqrt(6 / N)
    assert abs(result.vtpv.mean() / sigma**2 - (2 * n - 6)) < 4 * np.sqrt(2 * (2 * n - 6) / N)


def test_against_scipy():
    xy, X, M, X0 = images(N, n, 1e-3, seed=3)
    result = resect(xy, X)

    for k in range(5):

        def misclosures(u, k=k):
            turn = Rotation.from_rotvec(u[3:]).as_matrix() @ M[k]
            return (image_points(turn[None], u[None, :3], X[k : k + 1])[0] - xy[k]).ravel()

        peer = least_squares(misclosures, np.r_[X0[k], 0, 0, 0], xtol=1e-14, ftol=1e-14, gtol=1e-14)
        np.testing.assert_allclose(result.pose.X0[k], peer.x[:3], atol=1e-6)
        np.testing.assert_allclose(result.vtpv[k], 2 * peer.cost, rtol=1e-9)


def on_the_danger_cylinder(seed):
    """Points that a turn ω = (0, 0, 1) with a shift t of the camera moves along their rays.

    d × (t + ω × d) = 0 for d = X − X0: a cubic curve on the right cylinder x² + y² = t_x·y, which
    contains the projection centre.
    """
    rng = np.random.default_rng(seed)
    tx, tz = rng.uniform(4, 8, (N, 1)), rng.uniform(2, 4, (N, 1))
    z = rng.uniform(1.5, 8, (N, n))
    square = z * z + tz * tz
    X = np.stack([tz * tx * z / square, tx * z * z / square, z], 2)
    M = np.broadcast_to(np.diag([1.0, -1, -1]), (N, 3, 3))
    return image_points(M, np.zeros((N, 3)), X), X


def test_degenerate_configurations_have_names():
    xy, X, M, X0 = images(N, n, seed=4)
    line = X[:, :1] + (X[:, 1:2] - X[:, :1]) * np.linspace(0, 1, n)[:, None]
    assert (resect(image_points(M, X0, line), line).status == Status.COLLINEAR_POINTS).all()
    cylinder = resect(*on_the_danger_cylinder(5))
    assert (cylinder.status == Status.DANGER_CYLINDER).mean() > 0.95
    assert np.isinf(cylinder.cofactor[cylinder.status == Status.DANGER_CYLINDER]).all()
    for status in Status:
        assert status.advice


def test_derivatives_are_those_of_the_solution():
    """Against differences, also by the points; finite everywhere."""
    xy, X, _, _ = images(N, n, 1e-4, seed=6)
    centre = lambda xy, X: resection(xy, X).pose.X0
    by_xy, by_X = batch(jax.jacrev(centre, (0, 1)))(xy[:20], X[:20])
    assert np.isfinite(by_xy).all() and np.isfinite(by_X).all()
    h = 1e-6
    step = np.zeros_like(xy)
    step[:, 3, 1] = h
    ends = [resect(xy + d, X).pose.X0 for d in (step, -step)]
    difference = ((ends[0] - ends[1]) / (2 * h))[:20]
    np.testing.assert_allclose(by_xy[:, :, 3, 1], difference, rtol=0.01, atol=0.02)


def test_image_of_a_pose_is_the_collinearity_equation():
    xy, X, M, X0 = images(2, n, seed=7)
    pose = CameraPose(jnp.asarray(X0[0]), jnp.asarray(M[0]))
    np.testing.assert_allclose(image_of(pose, X[0, 0]), xy[0, 0], atol=1e-13)
