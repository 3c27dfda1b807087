"""Forward intersection and absolute orientation: truth, covariance, scipy, degenerate cases."""

import jax
import numpy as np
from orientation_scenes import batch, mahalanobis
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from jaxbundle.geometry import transform_point
from jaxbundle.orientation import Status, absolute_orientation, intersection

N, n = 300, 6
intersect = batch(intersection)
orient = batch(absolute_orientation)
RNG = np.random.default_rng(0)
X = RNG.normal(size=(N, 3))
X0 = RNG.normal(size=(N, n, 3)) + [0, 0, 8]
SOURCE = RNG.normal(size=(N, n, 3)) * 10
TAU = np.concatenate([RNG.normal(size=(N, 6)), RNG.uniform(-2, 2, (N, 1))], 1)
TARGET = np.asarray(jax.vmap(jax.vmap(transform_point, (None, 0)))(TAU, SOURCE))


def test_intersection_of_exact_rays():
    rays = X[:, None] - X0
    result = intersect(X0, rays)
    np.testing.assert_allclose(result.X, X, atol=1e-12)
    assert (result.status == Status.SOUND).all()
    d = rays / np.linalg.norm(rays, axis=2, keepdims=True)
    cosine = np.abs(np.einsum("kni,kmi->knm", d, d)).min((1, 2))
    np.testing.assert_allclose(result.angle, np.arccos(cosine), atol=1e-7)


def test_intersection_with_noise():
    sigma = 1e-3
    rays = X[:, None] - X0
    noise = sigma * RNG.normal(size=rays.shape) * np.linalg.norm(rays, axis=2, keepdims=True)
    result = intersect(X0, rays + noise)
    square = mahalanobis(result.X - X, result.cofactor, sigma)
    assert abs(square.mean() - 3) < 4 * np.sqrt(6 / N)
    assert abs(result.vtpv.mean() / sigma**2 - (2 * n - 3)) < 4 * np.sqrt(2 * (2 * n - 3) / N)


def test_intersection_against_scipy():
    """Tangents of the angles between rays and directions, minimised by scipy from elsewhere."""
    rays = X[:, None] - X0
    rays = rays + 0.01 * RNG.normal(size=rays.shape)
    result = intersect(X0, rays)
    for k in range(10):
        d = rays[k] / np.linalg.norm(rays[k], axis=1, keepdims=True)

        def tangents(point, k=k, d=d):
            off = point - X0[k]
            along = (off * d).sum(1, keepdims=True)
            return ((off - along * d) / along).ravel()

        peer = least_squares(tangents, X[k] + 0.1, xtol=1e-15, ftol=1e-15, gtol=1e-15)
        np.testing.assert_allclose(result.X[k], peer.x, atol=1e-7)
        np.testing.assert_allclose(result.vtpv[k], 2 * peer.cost, rtol=1e-9)
        cofactor = np.linalg.inv(peer.jac.T @ peer.jac)
        np.testing.assert_allclose(result.cofactor[k], cofactor, rtol=1e-3, atol=1e-5)


def test_intersection_that_fails_has_a_name():
    rays = X[:, None] - X0
    parallel = intersect(X0, np.broadcast_to(rays[:, :1], rays.shape))
    assert (parallel.status == Status.PARALLEL_RAYS).all() and np.isinf(parallel.cofactor).all()
    assert (intersect(X0, -rays).status == Status.BEHIND_THE_CAMERA).all()


def test_absent_rays_do_not_count():
    rays = X[:, None] - X0
    weights = np.broadcast_to([1.0, 1, 1, 1, 0, 0], (N, n))
    spoilt = np.where(weights[..., None] > 0, rays, [1.0, 2, 3])
    some = batch(intersection)(X0, spoilt, weights)
    np.testing.assert_allclose(some.X, X, atol=1e-12)


def test_absolute_orientation_of_exact_points():
    result = orient(SOURCE, TARGET)
    back = jax.vmap(jax.vmap(transform_point, (None, 0)))(result.tau, SOURCE)
    np.testing.assert_allclose(back, TARGET, atol=1e-11)
    np.testing.assert_allclose(result.tau[:, 6], TAU[:, 6], atol=1e-13)
    assert (result.status == Status.SOUND).all()


def test_absolute_orientation_against_scipy_without_reflection():
    """Targets mirrored: the best rotation, not the reflection."""
    mirrored = TARGET * [1, 1, -1] + RNG.normal(size=TARGET.shape)
    result = orient(SOURCE, mirrored)
    for k in range(20):
        a, b = SOURCE[k] - SOURCE[k].mean(0), mirrored[k] - mirrored[k].mean(0)
        expected, _ = Rotation.align_vectors(b, a)
        turn = Rotation.from_rotvec(result.tau[k, 3:6].copy()).inv() * expected
        assert turn.magnitude() < 1e-6


def test_absolute_orientation_with_noise():
    sigma = 0.01
    noisy = TARGET + sigma * RNG.normal(size=TARGET.shape)
    result = orient(SOURCE, noisy)
    difference = result.tau - TAU
    known = np.abs(difference[:, 3:6]).max(1) < 1  # not turned by 2π
    square = mahalanobis(difference[known], result.cofactor[known], sigma)
    assert abs(square.mean() - 7) < 4 * np.sqrt(14 / N)
    assert abs(result.vtpv.mean() / sigma**2 - (3 * n - 7)) < 4 * np.sqrt(2 * (3 * n - 7) / N)


def test_points_on_a_line_have_a_name():
    line = SOURCE[:, :1] * np.linspace(1, 2, n)[:, None]
    assert (orient(line, TARGET).status == Status.COLLINEAR_POINTS).all()


def test_derivatives_are_finite():
    by_rays = batch(jax.jacrev(lambda X0, d: intersection(X0, d).X, 1))(X0, X[:, None] - X0)
    by_points = batch(jax.jacrev(lambda a, b: absolute_orientation(a, b).tau))(SOURCE, TARGET)
    assert np.isfinite(by_rays).all() and np.isfinite(by_points).all()
