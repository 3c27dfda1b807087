"""Affine transformation: published example, group laws, least squares."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from geometry_checks import assert_jacobians_match_differences, jacobians

from jaxbundle.geometry import affine

# Interior orientation of a photograph scanned at 15 µm: image (pixel) → photograph (m), as
# published, and the photograph → image parameters that its inversion must give.
IMAGE_TO_PHOTO = [
    [1.5011859226653e-05, -2.8365288601049e-10, -0.11350077766574],
    [-1.8716778648295e-10, -1.5012983008061e-05, 0.11350467204681],
]
PHOTO_TO_IMAGE = [
    [66614.000616, -1.258594212, 7560.883729611],
    [-0.830480860, -66609.014292995, 7560.340062464],
]

RNG = np.random.default_rng(11)
PARAMS = jnp.array([66.6, -1.2, 7560.9, -0.8, -66.6, 7560.3])
POINTS = RNG.uniform(-113, 113, (30, 2))


fit = jax.jit(affine.fit)


@jax.jit
def apply_all(params, points):
    return jax.vmap(affine.apply, (None, 0))(params, points)


def test_inverse_of_the_published_example():
    params = affine.inverse(jnp.array(IMAGE_TO_PHOTO).reshape(6))
    np.testing.assert_allclose(params, np.ravel(PHOTO_TO_IMAGE), rtol=5e-10)
    corner = affine.apply(params, jnp.array([-0.1135, 0.1135]))  # the first pixels of the scan
    np.testing.assert_allclose(corner, [0, 0], atol=2)


def test_inverse_and_compose():
    back = affine.inverse(PARAMS)
    np.testing.assert_allclose(apply_all(back, apply_all(PARAMS, POINTS)), POINTS, atol=1e-10)
    np.testing.assert_allclose(affine.compose(back, PARAMS), [1, 0, 0, 0, 1, 0], atol=1e-12)
    other = jnp.array([0.9, 0.2, -3.0, 0.1, 1.1, 5.0])
    np.testing.assert_allclose(
        apply_all(affine.compose(other, PARAMS), POINTS),
        apply_all(other, apply_all(PARAMS, POINTS)),
        rtol=1e-13,
    )


@pytest.mark.parametrize("n", [3, 4, 30])
def test_fit_recovers_exact_parameters(n):
    target = apply_all(PARAMS, POINTS[:n])
    np.testing.assert_allclose(fit(POINTS[:n], target), PARAMS, rtol=1e-11)


def test_fit_of_eight_symmetric_fiducials():
    """A square of marks: equal singular values, where the SVD would have no derivative."""
    square = (
        jnp.array([[1, 1], [1, -1], [-1, 1], [-1, -1], [1, 0], [-1, 0], [0, 1], [0, -1.0]]) * 106
    )
    target = apply_all(PARAMS, square)
    np.testing.assert_allclose(fit(square, target), PARAMS, rtol=1e-12)
    jacobians(affine.fit, square[None], target[None], argnums=(0, 1))


def test_fit_is_the_weighted_least_squares_solution():
    target = apply_all(PARAMS, POINTS) + RNG.normal(size=POINTS.shape)
    weights = RNG.uniform(0.1, 10, len(POINTS))
    params = fit(POINTS, target, weights)
    design = np.column_stack([POINTS, np.ones(len(POINTS))]) * np.sqrt(weights)[:, None]
    expected, *_ = np.linalg.lstsq(design, target * np.sqrt(weights)[:, None])
    np.testing.assert_allclose(params, expected.T.ravel(), rtol=1e-11)
    gradient = jax.grad(lambda p: jnp.sum(weights[:, None] * (apply_all(p, POINTS) - target) ** 2))(
        params
    )
    np.testing.assert_allclose(gradient, 0, atol=1e-6)


def test_a_point_of_weight_zero_does_not_count():
    target = np.array(apply_all(PARAMS, POINTS))
    target[3] += 1000
    weights = np.ones(len(POINTS))
    weights[3] = 0
    np.testing.assert_allclose(fit(POINTS, target, weights), PARAMS, rtol=1e-11)


def test_derivatives_against_differences():
    source, target = POINTS.reshape(3, 10, 2) / 100, RNG.normal(size=(3, 10, 2))
    weights = RNG.uniform(0.5, 2, (3, 10))
    assert_jacobians_match_differences(affine.fit, source, target, weights)
    params = RNG.normal(size=(20, 6)) * 0.1 + [1, 0, 0, 0, 1, 0]
    assert_jacobians_match_differences(affine.inverse, params)


@pytest.mark.usefixtures("wrong_types")
def test_too_few_points_and_unequal_lists_are_refused():
    with pytest.raises(ValueError, match="at least three points, but 2"):
        affine.fit(POINTS[:2], POINTS[:2])
    with pytest.raises(ValueError, match="pairs of points"):
        affine.fit(POINTS, POINTS[:5])


def test_dtype_follows_the_input():
    params, points, weights = (jax.ShapeDtypeStruct(s, jnp.float32) for s in [(6,), (9, 2), (9,)])
    with jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        for function, items in [
            (apply_all, (params, points)),
            (affine.inverse, (params,)),
            (affine.compose, (params, params)),
            (affine.fit, (points, points)),
            (affine.fit, (points, points, weights)),
        ]:
            assert jax.eval_shape(function, *items).dtype == jnp.float32
