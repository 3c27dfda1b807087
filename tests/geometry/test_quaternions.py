"""Quaternions and the exponential map: against scipy, at zero, at 180°, and as a manifold."""

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from geometry_checks import (
    assert_identities,
    assert_jacobians_match_differences,
    assert_rotations,
    batch,
    jacobians,
    random_quaternions,
    scipy_rotation,
)
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from jaxbundle.geometry import (
    matrix_from_quaternion,
    matrix_from_rotation_vector,
    quaternion_conjugate,
    quaternion_difference,
    quaternion_from_matrix,
    quaternion_from_rotation_vector,
    quaternion_multiply,
    retract_quaternion,
    rotation_vector_from_matrix,
    rotation_vector_from_quaternion,
)

LEVI_CIVITA = np.zeros((3, 3, 3))
LEVI_CIVITA[[0, 1, 2], [1, 2, 0], [2, 0, 1]] = 1
LEVI_CIVITA[[0, 2, 1], [2, 1, 0], [1, 0, 2]] = -1

# Rotation angles at zero, on both sides of each switch between series and closed form, up to 180°.
# All samples have one size, so that each function is compiled once.
ANGLES = np.concatenate(
    [[0, 1e-300, 1e-160, 1e-20, 1e-10, 1e-8, 1e-5, 1e-3], np.linspace(0.02, 3.14, 314)]
)
N = len(ANGLES)


def random_axes(n, seed=0):
    n = np.random.default_rng(seed).normal(size=(n, 3))
    return n / np.linalg.norm(n, axis=1, keepdims=True)


def rotation_vectors():
    return random_axes(N) * ANGLES[:, None]


def half_turns():
    """Rotations by 180°, or up to 1e-3 less or more, about general and special axes."""
    special = np.array([a for a in product([-1, 0, 1], repeat=3) if any(a)])
    axes = np.concatenate([random_axes(20), special / np.linalg.norm(special, axis=1)[:, None]])
    offsets = [-1e-3, -1e-8, -1e-15, 0.0, 1e-15, 1e-8, 1e-3]
    return (axes[:, None] * (np.pi + np.array(offsets))[:, None]).reshape(-1, 3)


def special_matrices():
    """Random matrices and the cube's rotations: ties between two, three and all four elements."""
    cube = Rotation.create_group("O").as_matrix().round()
    tetrahedron = Rotation.create_group("T").as_matrix()
    general = scipy_rotation(random_quaternions(N - len(cube) - len(tetrahedron), 4)).as_matrix()
    return np.concatenate([cube, tetrahedron, general])


MATRICES = {
    "special": special_matrices(),
    "half turns": Rotation.from_rotvec(half_turns()).as_matrix(),
    "all angles": Rotation.from_rotvec(rotation_vectors()).as_matrix(),
}


def test_matrix_of_a_quaternion_is_that_of_scipy():
    q = random_quaternions(N)
    M = batch(matrix_from_quaternion)(q)
    np.testing.assert_allclose(M, scipy_rotation(q).as_matrix(), atol=1e-15)
    assert_rotations(M)
    np.testing.assert_allclose(batch(matrix_from_quaternion)(3.7 * q), M, atol=1e-15)


def test_product_of_quaternions_is_the_product_of_matrices():
    p, q = random_quaternions(N, 1), random_quaternions(N, 2)
    M = batch(matrix_from_quaternion)
    np.testing.assert_allclose(M(batch(quaternion_multiply)(p, q)), M(p) @ M(q), atol=1e-14)
    np.testing.assert_allclose(
        M(batch(quaternion_conjugate)(q)), np.swapaxes(M(q), 1, 2), atol=1e-15
    )


@pytest.mark.parametrize("M", MATRICES.values(), ids=MATRICES)
def test_quaternion_of_a_matrix_on_every_branch_and_tie(M):
    q = np.asarray(batch(quaternion_from_matrix)(M))
    assert (q[:, 0] >= 0).all()
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1, atol=1e-15)
    np.testing.assert_allclose(batch(matrix_from_quaternion)(q), M, atol=2e-15)
    # Its derivative along exp([δ]×)·M is ½(0, δ)∘q, on each branch.
    (J,) = jacobians(quaternion_from_matrix, M)
    for k, axis in enumerate(np.eye(3)):
        turned = np.einsum("ij,njk->nik", -LEVI_CIVITA[k], M)
        quarter = np.tile([0, *axis / 2], (N, 1))
        expected = batch(quaternion_multiply)(quarter, q)
        np.testing.assert_allclose(np.einsum("nqij,nij->nq", J, turned), expected, atol=1e-14)


def test_all_branches_are_reached():
    q = batch(quaternion_from_matrix)(MATRICES["special"])
    assert set(np.argmax(np.abs(q), axis=1)) == {0, 1, 2, 3}


def test_exponential_against_scipy_and_the_matrix_exponential():
    for v in (rotation_vectors(), half_turns(), 5 * rotation_vectors()):
        M = batch(matrix_from_rotation_vector)(v)
        np.testing.assert_allclose(M, Rotation.from_rotvec(v).as_matrix(), atol=2e-14)
        cross_matrices = np.cross(v[::20, None, :], np.eye(3)).swapaxes(1, 2)
        np.testing.assert_allclose(M[::20], expm(cross_matrices), atol=1e-13)


def test_logarithm_returns_at_every_angle():
    v = rotation_vectors()
    q = batch(quaternion_from_rotation_vector)(v)
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1, atol=1e-15)
    np.testing.assert_allclose(batch(rotation_vector_from_quaternion)(q), v, rtol=1e-14, atol=1e-15)
    np.testing.assert_allclose(
        batch(rotation_vector_from_quaternion)(-2 * q), v, rtol=1e-14, atol=1e-15
    )
    M = batch(matrix_from_quaternion)(q)
    np.testing.assert_allclose(batch(rotation_vector_from_matrix)(M), v, atol=1e-14)


def test_tiny_rotations_keep_their_relative_precision():
    v = random_axes(N) * np.geomspace(1e-300, 1e-9, N)[:, None]
    q = batch(quaternion_from_rotation_vector)(v)
    np.testing.assert_allclose(batch(rotation_vector_from_quaternion)(q), v, rtol=1e-15)


def test_logarithm_of_half_turns_reproduces_the_rotation():
    M = MATRICES["half turns"]
    v = batch(rotation_vector_from_matrix)(M)
    assert (np.linalg.norm(v, axis=1) <= np.pi + 1e-15).all()
    np.testing.assert_allclose(batch(matrix_from_rotation_vector)(v), M, atol=5e-15)
    jacobians(rotation_vector_from_matrix, M)
    jacobians(matrix_from_rotation_vector, half_turns())
    exact = np.tile(np.eye(4)[1:], (N, 1))[:N]
    v = batch(rotation_vector_from_quaternion)(exact)
    np.testing.assert_allclose(v, np.pi * exact[:, 1:], rtol=1e-15)
    jacobians(rotation_vector_from_quaternion, exact)


def test_first_and_second_derivatives_of_log_exp():
    """The round trip is the identity: Jacobian I, Hessian 0, on both sides of each switch."""

    def round_trip(v):
        return rotation_vector_from_quaternion(quaternion_from_rotation_vector(v))

    v = rotation_vectors()
    assert_identities(jacobians(round_trip, v)[0], 1e-12)
    hessian = batch(jax.jacfwd(jax.jacfwd(round_trip)))(v)
    np.testing.assert_allclose(hessian, 0, atol=1e-10)


def second_derivative(function, x):
    return jax.jit(jax.jacfwd(jax.jacfwd(function)))(x)


def test_derivatives_of_the_exponential_at_zero():
    """q(v) = (1 − v²/8, v/2) and exp([v]×) = I + [v]× + ½[v]×², both to second order."""
    eye, zero = np.eye(3), np.zeros((N, 3))
    first = jacobians(quaternion_from_rotation_vector, zero)[0][0]
    second = second_derivative(quaternion_from_rotation_vector, zero[0])
    np.testing.assert_allclose(first, np.vstack([np.zeros(3), eye / 2]), atol=1e-16)
    np.testing.assert_allclose(second, [-eye / 4, *np.zeros((3, 3, 3))], atol=1e-16)

    generators = -LEVI_CIVITA  # [e_k]× is generators[:, :, k]
    products = np.einsum("abi,bcj->acij", generators, generators)
    first = jacobians(matrix_from_rotation_vector, zero)[0][0]
    second = second_derivative(matrix_from_rotation_vector, zero[0])
    np.testing.assert_allclose(first, generators, atol=1e-16)
    np.testing.assert_allclose(second, (products + products.swapaxes(2, 3)) / 2, atol=1e-15)


def test_retraction_turns_on_the_left():
    q, delta = random_quaternions(N), rotation_vectors()
    moved = batch(retract_quaternion)(q, delta)
    np.testing.assert_allclose(np.linalg.norm(moved, axis=1), 1, atol=1e-15)
    np.testing.assert_allclose(
        batch(matrix_from_quaternion)(moved),
        batch(matrix_from_rotation_vector)(delta) @ batch(matrix_from_quaternion)(q),
        atol=1e-14,
    )
    np.testing.assert_allclose(batch(retract_quaternion)(1.01 * q, delta), moved, atol=1e-15)


def test_difference_inverts_the_retraction():
    v = rotation_vectors()
    q = random_quaternions(N)
    moved = batch(retract_quaternion)(q, v)
    np.testing.assert_allclose(batch(quaternion_difference)(moved, q), v, atol=1e-14)
    np.testing.assert_allclose(batch(quaternion_difference)(-moved, q), v, atol=1e-14)
    (J,) = jacobians(lambda d, q: quaternion_difference(retract_quaternion(q, d), q), v, q)
    assert_identities(J, 1e-12)


def test_second_derivatives_of_the_difference_where_it_vanishes():
    """log(exp(a)·exp(−b)) = a − b − ½ a × b + third order (Baker, Campbell, Hausdorff)."""
    q = random_quaternions(1)[0]

    def difference(ab):
        return quaternion_difference(retract_quaternion(q, ab[:3]), retract_quaternion(q, ab[3:]))

    second = second_derivative(difference, jnp.zeros(6))
    np.testing.assert_allclose(second[:, :3, :3], 0, atol=1e-15)
    np.testing.assert_allclose(second[:, 3:, 3:], 0, atol=1e-15)
    np.testing.assert_allclose(second[:, :3, 3:], -LEVI_CIVITA / 2, atol=1e-15)


FUNCTIONS = [
    (matrix_from_quaternion, ["q"]),
    (quaternion_multiply, ["q", "q"]),
    (quaternion_conjugate, ["q"]),
    (quaternion_from_rotation_vector, ["v"]),
    (matrix_from_rotation_vector, ["v"]),
    (rotation_vector_from_quaternion, ["q"]),
    (retract_quaternion, ["q", "v"]),
    (quaternion_difference, ["q", "q"]),
    (quaternion_from_matrix, ["M"]),
    (rotation_vector_from_matrix, ["M"]),
]
functions = pytest.mark.parametrize(
    "function, kinds", FUNCTIONS, ids=lambda x: getattr(x, "__name__", "")
)


@functions
def test_derivatives_against_differences(function, kinds):
    samples = {"q": random_quaternions(N, 5), "v": rotation_vectors(), "M": MATRICES["all angles"]}
    # The second argument in reversed order, so that no two of one kind are equal.
    items = [samples[kind][:: 1 - 2 * i] for i, kind in enumerate(kinds)]
    assert_jacobians_match_differences(function, *items, atol=1e-6)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@functions
def test_dtype_follows_the_input(function, kinds, dtype):
    shapes = {"q": (4,), "v": (3,), "M": (3, 3)}
    items = [jax.ShapeDtypeStruct(shapes[kind], dtype) for kind in kinds]
    with jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        assert jax.eval_shape(function, *items).dtype == dtype


def test_single_precision_is_accurate_to_its_rounding():
    v = rotation_vectors().astype(np.float32)
    M = batch(matrix_from_rotation_vector)(v)
    np.testing.assert_allclose(M, Rotation.from_rotvec(v).as_matrix(), atol=1e-6)
