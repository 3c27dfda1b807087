"""Similarity of the object space: group laws, invariance of the image, the Helmert matrix."""

import jax
import jax.numpy as jnp
import numpy as np
from geometry_checks import (
    assert_jacobians_match_differences,
    batch,
    jacobians,
    random_quaternions,
    scipy_rotation,
)
from scipy.spatial.transform import Rotation

from jaxbundle.geometry import (
    helmert_point,
    helmert_pose,
    matrix_from_quaternion,
    quaternion_difference,
    retract_quaternion,
    similarity,
    transform_point,
    transform_pose,
)

RNG = np.random.default_rng(7)
N = 50
TAU = np.concatenate([RNG.normal(size=(N, 6)), RNG.uniform(-2, 2, (N, 1))], axis=1)
OTHER = np.concatenate([RNG.normal(size=(N, 6)), RNG.uniform(-2, 2, (N, 1))], axis=1)
X = RNG.normal(size=(N, 3)) * 10
X0 = RNG.normal(size=(N, 3)) * 10
Q = random_quaternions(N, 8)


def cross_matrix(a):
    return np.cross(a[:, None, :], np.eye(3)).swapaxes(1, 2)


def image_of(X, X0, q):
    """Collinearity with c = 1: [x, y] = −[r, s]/q."""
    r, s, t = matrix_from_quaternion(q) @ (X - X0)
    return jnp.stack([-r / t, -s / t])


def test_point_against_scipy():
    rotation = Rotation.from_rotvec(TAU[:, 3:6])
    expected = np.exp(TAU[:, 6:]) * rotation.apply(X) + TAU[:, :3]
    np.testing.assert_allclose(batch(transform_point)(TAU, X), expected, rtol=1e-13, atol=1e-13)


def test_zero_is_the_identity():
    tau = np.zeros((N, 7))
    np.testing.assert_array_equal(batch(transform_point)(tau, X), X)
    moved_X0, moved_Q = batch(transform_pose)(tau, X0, Q)
    np.testing.assert_array_equal(moved_X0, X0)
    np.testing.assert_array_equal(moved_Q, Q)


def test_image_coordinates_are_invariant():
    before = batch(image_of)(X, X0, Q)
    moved_X0, moved_Q = batch(transform_pose)(TAU, X0, Q)
    after = batch(image_of)(batch(transform_point)(TAU, X), moved_X0, moved_Q)
    np.testing.assert_allclose(after, before, rtol=1e-11)
    np.testing.assert_allclose(np.linalg.norm(moved_Q, axis=1), 1, atol=1e-14)


def test_inverse_and_compose():
    there = batch(transform_point)(TAU, X)
    back = batch(transform_point)(batch(similarity.inverse)(TAU), there)
    np.testing.assert_allclose(back, X, atol=1e-12)
    both = batch(similarity.compose)(OTHER, TAU)
    np.testing.assert_allclose(
        batch(transform_point)(both, X), batch(transform_point)(OTHER, there), atol=1e-11
    )
    nothing = batch(similarity.compose)(TAU, batch(similarity.inverse)(TAU))
    np.testing.assert_allclose(nothing, 0, atol=1e-13)


def test_poses_follow_the_composition():
    twice = batch(transform_pose)(OTHER, *batch(transform_pose)(TAU, X0, Q))
    once = batch(transform_pose)(batch(similarity.compose)(OTHER, TAU), X0, Q)
    np.testing.assert_allclose(twice[0], once[0], atol=1e-11)
    np.testing.assert_allclose(batch(quaternion_difference)(twice[1], once[1]), 0, atol=1e-14)


def test_helmert_matrix_is_the_textbook_one():
    """Points [I, −[X]×, X] (Granshaw, 1980); poses [I, −[X0]×, X0; 0, −M, 0]."""
    eye, zeros = np.broadcast_to(np.eye(3), (N, 3, 3)), np.zeros((N, 3, 3))
    points = np.concatenate([eye, -cross_matrix(X), X[..., None]], axis=2)
    centres = np.concatenate([eye, -cross_matrix(X0), X0[..., None]], axis=2)
    attitudes = np.concatenate([zeros, -scipy_rotation(Q).as_matrix(), zeros[..., :1]], axis=2)
    poses = np.concatenate([centres, attitudes], axis=1)
    np.testing.assert_allclose(batch(helmert_point)(X), points, atol=1e-13)
    slope = jax.vmap(lambda x: jax.jacfwd(transform_point)(jnp.zeros(7), x))(X)
    np.testing.assert_allclose(slope, points, atol=1e-13)
    np.testing.assert_allclose(batch(helmert_pose)(X0, Q), poses, atol=1e-13)


def test_helmert_matrix_is_the_null_space_of_the_collinearity_equations():
    """The Jacobian of an image coordinate with respect to point and pose, times G, is zero."""

    def moved_image(dX, dX0, dtheta, X, X0, q):
        return image_of(X + dX, X0 + dX0, retract_quaternion(q, dtheta))

    zero = np.zeros((N, 3))
    J = jacobians(moved_image, zero, zero, zero, X, X0, Q, argnums=(0, 1, 2), rtol=1e-9)
    G = np.concatenate([batch(helmert_point)(X), batch(helmert_pose)(X0, Q)], axis=1)
    scale = np.abs(J[0]).max(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(np.concatenate(J, axis=2) @ G / scale, 0, atol=1e-11)


def test_derivatives_against_differences():
    """Also at τ = 0, where the Jacobian is the Helmert matrix."""

    def change(tau, X0, q):
        moved_X0, moved_q = transform_pose(tau, X0, q)
        return jnp.concatenate([moved_X0 - X0, quaternion_difference(moved_q, q)])

    tau = np.where(np.arange(N)[:, None] < N / 2, 0, TAU)
    assert_jacobians_match_differences(change, tau, X0, Q, argnums=(0,), atol=1e-6)


def test_dtype_follows_the_input():
    tau, x, q = (jax.ShapeDtypeStruct((n,), jnp.float32) for n in (7, 3, 4))
    with jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        for function, items in [
            (transform_point, (tau, x)),
            (transform_pose, (tau, x, q)),
            (similarity.inverse, (tau,)),
            (similarity.compose, (tau, tau)),
            (helmert_point, (x,)),
            (helmert_pose, (x, q)),
        ]:
            leaves = jax.tree.leaves(jax.eval_shape(function, *items))
            assert all(leaf.dtype == jnp.float32 for leaf in leaves)
