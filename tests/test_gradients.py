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


def test_a_camera_model():
    model = get_model("brown")
    p = np.array([20.0, 0.1, -0.1, 2e-4, -1e-6, 4e-9, 3e-5, -2e-5, -1e-3, 4e-4, 0.0])
    found = jaxbundle.check_gradients(model, p, np.array([0.2, -0.1, -1.0]))
    assert found.passed, str(found)
