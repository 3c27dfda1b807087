"""DLT and homographies: exact cameras, distortion, noise, degenerate configurations by name."""

from functools import partial

import jax
import numpy as np
from orientation_scenes import batch, images, mahalanobis
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from jaxbundle.orientation import (
    Status,
    decompose,
    direct_linear_transformation,
    homography,
    interior_from_homographies,
    pose_from_homography,
    refine_camera,
)

N, n = 200, 20
dlt = batch(direct_linear_transformation)
INTERIOR = np.array([20.0, 20.3, 0.05, 0.3, -0.2])  # mm


def measured(xy, K1=0.0):
    """Ideal coordinates to millimetres, with (1 + K1·r²)·measured = ideal."""
    fx, fy, skew, x0, y0 = INTERIOR
    ideal = np.stack([fx * xy[..., 0] + skew * xy[..., 1], fy * xy[..., 1]], -1)
    distorted = ideal
    for _ in range(60):
        distorted = ideal / (1 + K1 * np.sum(distorted**2, -1, keepdims=True))
    return distorted + [x0, y0]


def camera_of(xy, X):
    return decompose(direct_linear_transformation(xy, X)[0])


def refined(xy, X, radial):
    return refine_camera(camera_of(xy, X)[0], xy, X, radial=radial)


def test_exact_camera():
    xy, X, M, X0 = images(N, n)
    camera, status = batch(camera_of)(measured(xy), X)
    np.testing.assert_allclose(camera.interior, np.broadcast_to(INTERIOR, (N, 5)), atol=1e-9)
    np.testing.assert_allclose(camera.pose.X0, X0, atol=1e-10)
    np.testing.assert_allclose(camera.pose.M, M, atol=1e-10)
    assert (status == Status.SOUND).all()


def test_mirrored_image_has_a_name():
    xy, X, _, _ = images(N, n)
    _, status = batch(camera_of)(measured(xy) * [1, -1], X)
    assert (status == Status.BEHIND_THE_CAMERA).all()


def test_refined_with_distortion():
    xy, X, M, X0 = images(N, n, seed=1)
    result = batch(partial(refined, radial=1))(measured(xy, 2e-4), X)
    np.testing.assert_allclose(result.camera.interior, np.tile(INTERIOR, (N, 1)), atol=1e-6)
    np.testing.assert_allclose(result.camera.radial, 2e-4, atol=1e-9)
    np.testing.assert_allclose(result.camera.pose.X0, X0, atol=1e-7)
    assert (result.status == Status.SOUND).all()
    first = jax.tree.map(lambda a: a[0], result.camera)
    again = refine_camera(first, measured(xy, 2e-4)[0], X[0])  # with the distortion that it has
    np.testing.assert_allclose(again.camera.radial, 2e-4, atol=1e-9)


def test_against_scipy():
    """The eleven parameters L of the direct linear transformation, by scipy with numerical
    derivatives: the same image points, and the same vᵀPv as eleven of interior and exterior."""
    xy, X, _, _ = images(N, n, seed=2)
    noisy = measured(xy) + 1e-3 * np.random.default_rng(3).normal(size=xy.shape)
    result = batch(partial(refined, radial=0))(noisy, X)
    P, _ = dlt(noisy, X)
    for k in range(5):
        points = np.column_stack([X[k], np.ones(n)])

        def misclosures(L, k=k, points=points):
            u, v, w = np.append(L, 1.0).reshape(3, 4) @ points.T
            return np.concatenate([u / w - noisy[k, :, 0], v / w - noisy[k, :, 1]])

        start = (P[k] / P[k, 2, 3]).ravel()[:11]
        peer = least_squares(misclosures, start, x_scale=np.abs(start) + 1e-6, xtol=1e-15,
                             ftol=1e-15, gtol=1e-15)  # fmt: skip
        np.testing.assert_allclose(result.vtpv[k], 2 * peer.cost, rtol=1e-6)
        camera, _ = decompose(np.append(peer.x, 1.0).reshape(3, 4))
        sigma = 1e-3 * np.sqrt(np.diagonal(result.cofactor[k]))
        assert (np.abs(camera.interior - result.camera.interior[k]) < 1e-3 * sigma[:5]).all()
        assert (np.abs(camera.pose.X0 - result.camera.pose.X0[k]) < 1e-3 * sigma[5:8]).all()


def test_noise_is_what_the_cofactors_say():
    sigma = 1e-3
    xy, X, _, X0 = images(N, n, seed=2)
    noisy = measured(xy) + sigma * np.random.default_rng(3).normal(size=xy.shape)
    result = batch(partial(refined, radial=0))(noisy, X)
    difference = np.concatenate([result.camera.interior - INTERIOR, result.camera.pose.X0 - X0], 1)
    square = mahalanobis(difference, result.cofactor[:, :8, :8], sigma)
    assert abs(square.mean() - 8) < 4 * np.sqrt(16 / N)
    redundancy = 2 * n - 11
    assert abs(result.vtpv.mean() / sigma**2 - redundancy) < 4 * np.sqrt(2 * redundancy / N)


def test_planes_and_lines_have_names():
    xy, X, _, _ = images(N, n, seed=4)
    line = X[:, :1] * np.linspace(1, 2, n)[:, None]
    plane = X[:, :1] + np.einsum("kni,kij->knj", xy, X[:, 1:3] - X[:, :1])
    assert (dlt(xy, line)[1] == Status.COLLINEAR_POINTS).all()
    assert (dlt(xy, plane)[1] == Status.COPLANAR_POINTS).all()


def views(N, m, noise=0.0, tilt=0.5, seed=0):
    """m images in mm of a board 5 × 4 with their M and X0; no skew."""
    rng = np.random.default_rng(seed)
    grid = np.mgrid[0:5, 0:4].T.reshape(-1, 2) - [2.0, 1.5]
    board = np.c_[grid, np.zeros(len(grid))]
    M = Rotation.from_rotvec(tilt * rng.normal(size=(N * m, 3)).clip(-1.5, 1.5)).as_matrix()
    centre = np.stack([*rng.uniform(-1, 1, (2, N * m)), rng.uniform(-12, -8, N * m)], 1)
    X0 = -np.einsum("kji,kj->ki", M, centre)
    Y = np.einsum("kij,nj->kni", M, board) + centre[:, None]
    xy = -Y[..., :2] / Y[..., 2:] * INTERIOR[:2] + INTERIOR[3:]
    xy = xy + noise * rng.normal(size=xy.shape)
    return grid, xy.reshape(N, m, -1, 2), M.reshape(N, m, 3, 3), X0.reshape(N, m, 3)


def zhang(board, xy):
    H, status = jax.vmap(homography, (None, 0))(board, xy)
    interior, camera = interior_from_homographies(H, 20.0)
    return interior, jax.vmap(pose_from_homography, (0, None))(H, interior), status, camera


def test_camera_from_planes():
    grid, xy, M, X0 = views(N, 3)
    interior, pose, status, camera = batch(partial(zhang, grid))(xy)
    truth = INTERIOR * [1, 1, 0, 1, 1]
    error = np.abs(interior - truth).max(1)
    assert np.median(error) < 1e-10 and np.quantile(error, 0.98) < 1e-6
    good = error < 1e-8
    np.testing.assert_allclose(pose.X0[good], X0[good], atol=1e-6)
    np.testing.assert_allclose(pose.M[good], M[good], atol=1e-6)
    assert (status == Status.SOUND).all() and (camera[good] == Status.SOUND).all()


def test_parallel_planes_have_a_name():
    grid, xy, _, _ = views(N, 3, tilt=0.0)
    assert (batch(partial(zhang, grid))(xy)[3] == Status.PARALLEL_PLANES).all()


def test_points_on_a_line_give_no_homography():
    grid, xy, _, _ = views(2, 3)
    line = np.stack([grid[:, 0], 2 * grid[:, 0]], 1)
    assert homography(line, xy[0, 0])[1] == Status.COLLINEAR_POINTS


def test_derivatives_are_finite():
    xy, X, _, _ = images(20, n, seed=5)
    interior = lambda xy, X: camera_of(xy, X)[0].interior
    assert np.isfinite(batch(jax.jacrev(interior))(measured(xy), X)).all()
    grid, seen, _, _ = views(20, 3, 1e-3)
    assert np.isfinite(batch(jax.jacrev(lambda xy: homography(grid, xy)[0]))(seen[:, 0])).all()
