"""Random images of known truth, many at a time, by the formulas written out in NumPy."""

import jax
import numpy as np
from scipy.spatial.transform import Rotation


def batch(function):
    """The compiled function of many items, its arrays in NumPy: one call at a time."""
    compiled = jax.jit(jax.vmap(function))
    return lambda *items: jax.tree.map(np.asarray, compiled(*items))


def images(N, n, noise=0.0, seed=0):
    """Image points [N, n, 2] and points [N, n, 3] of N cameras, with their M and X0."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-0.8, 0.8, (N, n, 2))
    Y = np.concatenate([xy, -np.ones((N, n, 1))], 2) * rng.uniform(4, 12, (N, n, 1))
    M = Rotation.random(N, random_state=seed + 1).as_matrix()
    X0 = 5 * rng.normal(size=(N, 3))
    X = np.einsum("kji,knj->kni", M, Y) + X0[:, None]
    return xy + noise * rng.normal(size=xy.shape), X, M, X0


def image_points(M, X0, X):
    Y = np.einsum("kij,knj->kni", M, X - X0[:, None])
    return -Y[..., :2] / Y[..., 2:]


def pairs(N, n, noise=0.0, seed=0, base=1.0, plane=False):
    """Image points [N, n, 2] in two images, with M and b; the points may be on a plane."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-0.8, 0.8, (N, n, 2))
    rays = np.concatenate([xy, -np.ones((N, n, 1))], 2)
    depth = rng.uniform(4, 12, (N, n, 1))
    if plane:
        normal = rng.normal(size=(N, 1, 3)) * 0.1 + [0, 0, -1]
        depth = 6 / np.sum(rays * normal, 2, keepdims=True)
    M = Rotation.from_rotvec(0.2 * rng.normal(size=(N, 3))).as_matrix()
    b = rng.normal(size=(N, 3))
    b /= np.linalg.norm(b, axis=1, keepdims=True)
    other = image_points(M, base * b, rays * depth)
    error = lambda: noise * rng.normal(size=xy.shape)
    return xy + error(), other + error(), M, b


def mahalanobis(difference, cofactor, noise):
    """dᵀ·(σ²·Q)⁻¹·d of many items: χ² distributed if Q is correct."""
    inverse = np.linalg.inv(cofactor)
    return np.einsum("ki,kij,kj->k", difference, inverse, difference) / noise**2
