"""40 % gross errors: found by RANSAC and by least median of squares, the same for the same key."""

from functools import partial

import jax
import numpy as np
import pytest
from orientation_scenes import batch, images, pairs
from scipy.spatial.transform import Rotation

from jaxbundle.orientation import (
    Status,
    robust_absolute_orientation,
    robust_direct_linear_transformation,
    robust_homography,
    robust_intersection,
    robust_relative_orientation,
    robust_resection,
    samples_needed,
)

N, n, GROSS, SIGMA = 20, 25, 10, 2e-4


def spoilt(xy, seed=0):
    """The first ten points anywhere in the image, wrong by at least 0.05."""
    rng = np.random.default_rng(seed)
    wrong = rng.uniform(-0.8, 0.8, (N, GROSS, 2))
    near = np.linalg.norm(wrong - xy[:, :GROSS], axis=2, keepdims=True) < 0.05
    return np.concatenate([np.where(near, wrong + 0.2, wrong), xy[:, GROSS:]], 1)


@pytest.mark.parametrize("threshold", [None, 4 * SIGMA])
def test_resection(threshold):
    xy, X, _, X0 = images(N, n, SIGMA)
    keys = jax.random.split(jax.random.key(0), N)
    robust = batch(partial(robust_resection, threshold=threshold))
    result, good = robust(keys, spoilt(xy), X)
    assert not good[:, :GROSS].any()
    assert good[:, GROSS:].mean() > 0.95
    assert (result.status == Status.SOUND).all()
    sigma = SIGMA * np.sqrt(np.diagonal(result.cofactor, 0, 1, 2)[:, :3])
    assert (np.abs(result.pose.X0 - X0) / sigma).max() < 6


def test_relative_orientation():
    xy1, xy2, M, b = pairs(N, n, SIGMA)
    keys = jax.random.split(jax.random.key(1), N)
    robust = batch(robust_relative_orientation)
    result, good = robust(keys, spoilt(xy1), xy2)
    # a false point that happens to lie on its epipolar line, in front, cannot be found
    assert good[:, :GROSS].mean() < 0.03
    assert good[:, GROSS:].mean() > 0.95
    error = np.abs(result.M - M).max((1, 2)) + np.abs(result.b - b).max(1)
    assert np.median(error) < 5e-3 and error.max() < 0.1
    again, _ = robust(keys, spoilt(xy1), xy2)
    np.testing.assert_array_equal(result.M, again.M)


def test_intersection():
    """Rays of ten images in 25 that point elsewhere."""
    rng = np.random.default_rng(3)
    X, X0 = rng.normal(size=(N, 1, 3)), 8 * rng.normal(size=(N, n, 3))
    rays = X - X0
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    rays += SIGMA * rng.normal(size=rays.shape)
    rays[:, :GROSS] += rng.choice([-1, 1], (N, GROSS, 3)) * rng.uniform(0.1, 0.5, (N, GROSS, 3))
    keys = jax.random.split(jax.random.key(2), N)
    result, good = batch(robust_intersection)(keys, X0, rays)
    assert not good[:, :GROSS].any() and good[:, GROSS:].mean() > 0.95
    assert (result.status == Status.SOUND).all()
    sigma = SIGMA * np.sqrt(np.diagonal(result.cofactor, 0, 1, 2))
    assert (np.abs(result.X - X[:, 0]) / sigma).max() < 6


def test_absolute_orientation():
    rng = np.random.default_rng(4)
    source = rng.normal(size=(N, n, 3))
    R = Rotation.random(N, random_state=5).as_matrix()
    t = rng.normal(size=(N, 1, 3))
    target = 2.5 * np.einsum("kij,knj->kni", R, source) + t
    target += 1e-3 * rng.normal(size=target.shape)
    target[:, :GROSS] += rng.choice([-1, 1], (N, GROSS, 3)) * rng.uniform(0.1, 3, (N, GROSS, 3))
    keys = jax.random.split(jax.random.key(3), N)
    result, good = batch(robust_absolute_orientation)(keys, source, target)
    assert not good[:, :GROSS].any() and good[:, GROSS:].mean() > 0.95
    sigma = 1e-3 * np.sqrt(np.diagonal(result.cofactor, 0, 1, 2))
    assert (np.abs(np.exp(result.tau[:, 6]) - 2.5) / (2.5 * sigma[:, 6])).max() < 6


def test_direct_linear_transformation():
    """The matrix of the good points alone, found among all."""
    xy, X, _, _ = images(N, n, SIGMA)
    keys = jax.random.split(jax.random.key(4), N)
    robust = batch(partial(robust_direct_linear_transformation, threshold=4 * SIGMA))
    (P, status), good = robust(keys, spoilt(xy), X)
    assert (status == Status.SOUND).all()
    assert not good[:, :GROSS].any() and good[:, GROSS:].mean() > 0.9
    x, y, w = np.einsum("kij,knj->ikn", P, np.pad(X, ((0, 0), (0, 0), (0, 1)), constant_values=1))
    error = np.hypot(x / w - xy[..., 0], y / w - xy[..., 1])
    assert np.median(error) < 2 * SIGMA and error[:, GROSS:].max() < 20 * SIGMA


def test_homography():
    rng = np.random.default_rng(6)
    H = np.eye(3) + 0.15 * rng.normal(size=(N, 3, 3))
    H[:, 2, 2] = 1.0
    source = rng.uniform(-0.8, 0.8, (N, n, 2))
    x, y, w = np.einsum("kij,knj->ikn", H, np.pad(source, ((0, 0), (0, 0), (0, 1)),
                                                  constant_values=1))  # fmt: skip
    target = np.stack([x / w, y / w], 2)
    wrong = spoilt(target + SIGMA * rng.normal(size=target.shape))
    keys = jax.random.split(jax.random.key(5), N)
    (found, status), good = batch(robust_homography)(keys, source, wrong)
    assert (status == Status.SOUND).all()
    assert not good[:, :GROSS].any() and good[:, GROSS:].mean() > 0.95
    found = found / found[:, 2:, 2:]
    assert np.abs(found - H).max() < 100 * SIGMA


def test_number_of_samples():
    """Fischler and Bolles (1981): with 40 % errors 29 samples of three give 99.9 %."""
    assert [samples_needed(k) for k in (3, 5, 8)] == [29, 86, 408]
