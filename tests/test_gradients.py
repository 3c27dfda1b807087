"""`check_gradients` passes correct derivatives and finds wrong ones."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbundle
from jaxbundle.cameras import get_model


def test_a_right_derivative_passes():
    found = jaxbundle.check_gradients(lambda x: jnp.sin(x) * x[::-1], np.arange(1.0, 5.0))
    assert found.passed and "agree" in str(found)


def test_a_wrong_derivative_is_found():
    @jax.custom_jvp
    def wrong(x):
        return x**2

    wrong.defjvps(lambda dx, y, x: 2.001 * x * dx)
    found = jaxbundle.check_gradients(wrong, np.arange(1.0, 5.0))
    assert not found.passed and "DISAGREE" in str(found)
    assert found.forward == pytest.approx(5e-4, rel=1e-3)


def test_the_step_is_shortened_where_the_function_is_curved():
    """By two steps alone, extrapolated, the differences are wrong by 1e-5 here, as they are for an
    adjustment of a weak network: tan has a pole 1e-3 away."""
    x = np.full(3, np.pi / 2 - 2e-3)
    found = jaxbundle.check_gradients(jnp.tan, x)
    assert found.passed and found.differences < 1e-7, str(found)


def test_a_function_that_is_noisy_is_not_judged_by_its_noise():
    """Rounded to 1e-9, differences over 1e-4 know ten digits at most of a derivative of 1."""
    rounded = jax.custom_jvp(lambda x: jnp.round(x, 9))
    rounded.defjvps(lambda dx, y, x: dx)
    found = jaxbundle.check_gradients(rounded, np.arange(1.0, 5.0), tolerance=1e-9)
    assert not found.passed and "try another step" in str(found)
    assert found.forward < 10 * found.differences


def test_a_derivative_that_is_not_there_does_not_pass():
    found = jaxbundle.check_gradients(lambda x: jnp.sqrt(x - 1), np.array([0.5, 2.0]))
    assert not found.passed and np.isnan(found.forward)


def test_a_camera_model():
    model = get_model("brown")
    p = np.array([20.0, 0.1, -0.1, 2e-4, -1e-6, 4e-9, 3e-5, -2e-5, -1e-3, 4e-4, 0.0])
    found = jaxbundle.check_gradients(model, p, np.array([0.2, -0.1, -1.0]))
    assert found.passed, str(found)


def test_a_camera_on_its_axis_is_moved_too():
    """The image point is 0 there: a step relative to it would compare nothing."""
    model = get_model("brown")
    found = jaxbundle.check_gradients(model, np.array([20.0] + [0.0] * 10), np.array([0.0, 0, -1]))
    assert found.passed and found.differences > 0, str(found)
