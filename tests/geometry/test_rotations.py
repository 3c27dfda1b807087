"""Angles and Rodrigues' parameters: against scipy, round trips, and at the locks."""

from functools import cache

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
)
from scipy.spatial.transform import Rotation

from jaxbundle import geometry
from jaxbundle.geometry.rotations import quaternion_from_omega_phi_kappa

# A system of angles: both functions, the oracle, the middle angle at the two locks, and an
# interval of it in which the three angles are unique.
SYSTEMS = {
    "omega_phi_kappa": (
        geometry.matrix_from_omega_phi_kappa,
        geometry.omega_phi_kappa_from_matrix,
        lambda a: Rotation.from_euler("xyz", -a),
        (-np.pi / 2, np.pi / 2),
        (-1.5, 1.5),
    ),
    "phi_omega_kappa": (
        geometry.matrix_from_phi_omega_kappa,
        geometry.phi_omega_kappa_from_matrix,
        lambda a: Rotation.from_euler("yxz", -a),
        (-np.pi / 2, np.pi / 2),
        (-1.5, 1.5),
    ),
    "azimuth_tilt_swing": (
        geometry.matrix_from_azimuth_tilt_swing,
        geometry.azimuth_tilt_swing_from_matrix,
        lambda a: Rotation.from_euler("zxz", a * [1, -1, -1] + [0, 0, np.pi]),
        (0.0, np.pi),
        (0.05, 3.1),
    ),
}
systems = pytest.mark.parametrize("name", SYSTEMS)


def random_angles(name):
    low, high = SYSTEMS[name][4]
    return np.random.default_rng(1).uniform([-3.1, low, -3.1], [3.1, high, 3.1], (900, 3))


def angles_near_locks(name):
    """At both locks and 1e-1 to 1e-17 beside them, for a grid of the other two angles."""
    locks, interval = SYSTEMS[name][3:]
    offsets = np.concatenate([[0.0], 10.0 ** -np.arange(1, 18)])
    middle = np.concatenate([x + np.sign(np.mean(interval) - x) * offsets for x in locks])
    outer = [-2.9, -np.pi / 2, 0.0, 0.7, np.pi]
    return np.stack(np.meshgrid(outer, middle, outer, indexing="ij"), -1).reshape(-1, 3)


@cache
def round_trip(name):
    """The function of the angles that makes a matrix and reads the angles from it."""
    matrix, from_matrix = SYSTEMS[name][:2]
    return lambda angles: from_matrix(matrix(angles))


def test_the_elements_are_those_of_the_textbook():
    a, b, c = 0.3, -0.7, 1.9
    (so, sp, sk), (co, cp, ck) = np.sin([a, b, c]), np.cos([a, b, c])
    omega_phi_kappa = [
        [cp * ck, co * sk + so * sp * ck, so * sk - co * sp * ck],
        [-cp * sk, co * ck - so * sp * sk, so * ck + co * sp * sk],
        [sp, -so * cp, co * cp],
    ]
    (sa, st, ss), (ca, ct, cs) = np.sin([a, b, c]), np.cos([a, b, c])
    azimuth_tilt_swing = [
        [-ca * cs - sa * ct * ss, sa * cs - ca * ct * ss, -st * ss],
        [ca * ss - sa * ct * cs, -sa * ss - ca * ct * cs, -st * cs],
        [-sa * st, -ca * st, ct],
    ]
    rodrigues = [
        [1 + (a * a - b * b - c * c) / 4, -c + a * b / 2, b + a * c / 2],
        [c + a * b / 2, 1 + (-a * a + b * b - c * c) / 4, -a + b * c / 2],
        [-b + a * c / 2, a + b * c / 2, 1 + (-a * a - b * b + c * c) / 4],
    ] / np.array(1 + (a * a + b * b + c * c) / 4)
    for function, expected in [
        (geometry.matrix_from_omega_phi_kappa, omega_phi_kappa),
        (geometry.matrix_from_azimuth_tilt_swing, azimuth_tilt_swing),
        (geometry.matrix_from_rodrigues, rodrigues),
    ]:
        np.testing.assert_allclose(function(jnp.array([a, b, c])), expected, atol=1e-15)


@pytest.mark.parametrize("axis, R", [(0, geometry.R1), (1, geometry.R2), (2, geometry.R3)])
def test_elementary_rotations_are_exponentials_of_the_negative_axis(axis, R):
    angles = np.linspace(-3, 3, 13)
    vectors = -angles[:, None] * np.eye(3)[axis]
    expected = batch(geometry.matrix_from_rotation_vector)(vectors)
    np.testing.assert_allclose(batch(R)(angles), expected, atol=1e-15)


@systems
def test_matrix_is_the_rotation_of_scipy(name):
    matrix, _, oracle, *_ = SYSTEMS[name]
    angles = random_angles(name)
    M = batch(matrix)(angles)
    assert_rotations(M)
    np.testing.assert_allclose(M, oracle(angles).as_matrix(), atol=1e-14)


def test_the_quaternion_of_angles_is_that_of_the_matrix():
    angles = random_angles("omega_phi_kappa")
    q = batch(quaternion_from_omega_phi_kappa)(angles)
    assert np.all(q[:, 0] >= 0)
    M = batch(geometry.matrix_from_omega_phi_kappa)(angles)
    np.testing.assert_allclose(batch(geometry.matrix_from_quaternion)(q), M, atol=2e-15)


@systems
def test_angles_return_and_so_do_their_derivatives(name):
    angles = random_angles(name)
    np.testing.assert_allclose(batch(round_trip(name))(angles), angles, atol=1e-13)
    assert_identities(jacobians(round_trip(name), angles, rtol=1e-11)[0], 1e-11)


@systems
def test_angles_reproduce_the_matrix_at_and_near_the_locks(name):
    matrix, from_matrix, *_ = SYSTEMS[name]
    M = batch(matrix)(angles_near_locks(name))
    np.testing.assert_allclose(batch(matrix)(batch(from_matrix)(M)), M, atol=5e-15)


@systems
def test_first_angle_is_zero_at_the_locks(name):
    matrix, from_matrix, _, locks, _ = SYSTEMS[name]
    angles = np.array([[0.4, lock, -1.1] for lock in locks])
    again = batch(from_matrix)(batch(matrix)(angles))
    np.testing.assert_array_equal(again[:, 0], 0)
    np.testing.assert_allclose(again[:, 1], locks, atol=1e-15)


@systems
def test_jacobians_are_finite_at_and_near_the_locks(name):
    """Also for the 24 rotations of the cube: exact zeros, exact ties, angles of 90° and 180°."""
    matrix, from_matrix, *_ = SYSTEMS[name]
    cube = Rotation.create_group("O").as_matrix().round()
    angles = angles_near_locks(name)
    jacobians(matrix, angles)
    M = np.concatenate([batch(matrix)(angles)[len(cube) :], cube])
    jacobians(from_matrix, M, rtol=1e-9)
    np.testing.assert_allclose(batch(matrix)(batch(from_matrix)(M)), M, atol=5e-15)


@systems
def test_jacobians_against_differences(name):
    matrix, from_matrix, *_ = SYSTEMS[name]
    angles = random_angles(name)
    angles[:, 1] = 0.5 + 0.4 * np.sin(angles[:, 1])  # away from the locks
    assert_jacobians_match_differences(matrix, angles)
    angles[:, [0, 2]] *= 0.9  # away from the jump at π
    assert_jacobians_match_differences(from_matrix, np.asarray(batch(matrix)(angles)), atol=1e-6)


def rodrigues_samples():
    """Half-tangent parameters of rotations by 0 to 180° less 1e-7, with their rotation vectors."""
    n = np.random.default_rng(3).normal(size=(50, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    angle = np.concatenate([[0, 1e-300, 1e-12], np.linspace(0.01, 3.1, 46), [np.pi - 1e-7]])[
        :, None
    ]
    return 2 * n * np.tan(angle / 2), n * angle


def test_rodrigues_is_the_cayley_form_and_the_rotation_of_scipy():
    p, v = rodrigues_samples()
    M = batch(geometry.matrix_from_rodrigues)(p)
    assert_rotations(M)
    np.testing.assert_allclose(M, Rotation.from_rotvec(v).as_matrix(), atol=1e-14)
    S = np.cross(p[:, None, :] / 2, np.eye(3)).swapaxes(1, 2)
    cayley = np.linalg.solve(np.eye(3) - S, np.eye(3) + S)
    np.testing.assert_allclose(M[:-1], cayley[:-1], atol=1e-12)


def test_rodrigues_returns_up_to_180_degrees():
    p, _ = rodrigues_samples()
    M = batch(geometry.matrix_from_rodrigues)(p)
    again = batch(geometry.rodrigues_from_matrix)(M)
    np.testing.assert_allclose(again[:-1], p[:-1], rtol=1e-11, atol=1e-15)
    np.testing.assert_allclose(again[-1], p[-1], rtol=1e-7)
    jacobians(geometry.rodrigues_from_matrix, M)
    assert_jacobians_match_differences(geometry.matrix_from_rodrigues, p)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@systems
def test_dtype_follows_the_input(name, dtype):
    matrix, from_matrix, *_ = SYSTEMS[name]
    with jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        angles = jax.ShapeDtypeStruct((3,), dtype)
        M = jax.eval_shape(matrix, angles)
        p = jax.eval_shape(geometry.rodrigues_from_matrix, M)
        assert M.dtype == jax.eval_shape(from_matrix, M).dtype == dtype
        assert p.dtype == jax.eval_shape(geometry.matrix_from_rodrigues, p).dtype == dtype


@pytest.mark.parametrize("given", [(0.3, 1.2, -2.0), (0.3, 2.0, -2.0), (4.0, -1.8, 9.0)])
def test_the_representation_nearest_to_given_angles(given):
    # A rotation near the given one, whichever of its representations the given angles are.
    given = np.array(given)
    M = geometry.matrix_from_omega_phi_kappa(jnp.asarray(given + [0.01, -0.02, 0.03]))
    found = geometry.omega_phi_kappa_near(M, jnp.asarray(given))
    np.testing.assert_allclose(found, given + [0.01, -0.02, 0.03], atol=1e-12)
