"""Shared by the tests of geometry: batches, Jacobians in both modes, numerical differences."""

from functools import cache

import jax
import numpy as np
from scipy.spatial.transform import Rotation


@cache
def batch(function):
    """The compiled function of many items; compiled once per shape over all tests."""
    return jax.jit(jax.vmap(function))


@cache
def _both_jacobians(function, argnums):
    def both(*item):
        return jax.jacfwd(function, argnums)(*item), jax.jacrev(function, argnums)(*item)

    return batch(both)


def jacobians(function, *items, argnums=(0,), rtol=1e-12):
    """The Jacobian of many items by each argument, after a check that both modes agree."""
    forward, reverse = _both_jacobians(function, argnums)(*items)
    for f, r in zip(forward, reverse):
        assert np.isfinite(f).all() and np.isfinite(r).all()
        np.testing.assert_allclose(f, r, rtol=rtol, atol=rtol * (1 + np.abs(f).max()))
    return [np.asarray(f) for f in forward]


def assert_jacobians_match_differences(function, *items, argnums=None, h=1e-6, atol=1e-8):
    """Jacobians by the chosen arguments (all) against central differences, item by item."""
    argnums = argnums or tuple(range(len(items)))
    for k, exact in zip(argnums, jacobians(function, *items, argnums=argnums)):
        x = items[k]
        for index in np.ndindex(x.shape[1:]):
            step = np.zeros_like(x)
            step[(slice(None), *index)] = h
            ends = [batch(function)(*items[:k], x + d, *items[k + 1 :]) for d in (step, -step)]
            difference = (ends[0] - ends[1]) / (2 * h)
            np.testing.assert_allclose(exact[(..., *index)], difference, atol=atol)


def assert_identities(matrices, atol):
    matrices = np.asarray(matrices)
    np.testing.assert_allclose(
        matrices, np.broadcast_to(np.eye(matrices.shape[-1]), matrices.shape), atol=atol
    )


def assert_rotations(M):
    M = np.asarray(M)
    assert_identities(M @ np.swapaxes(M, -1, -2), 1e-14)
    np.testing.assert_allclose(np.linalg.det(M), 1, atol=1e-14)


def random_quaternions(n, seed=0):
    q = np.random.default_rng(seed).normal(size=(n, 4))
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def scipy_rotation(q):
    """The oracle's rotation of quaternions in the order w, x, y, z."""
    return Rotation.from_quat(np.roll(q, -1, axis=-1))
