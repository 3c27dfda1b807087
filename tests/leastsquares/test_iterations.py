"""Where iterations end: the rules of stopping on problems whose iterations are known by hand."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxbundle import leastsquares as ls

ANGLE = ls.Kind("angle", lambda x, measured: jnp.arctan(x) - measured, of=("x",))


@pytest.mark.parametrize("start", [1.2, 1.5])
def test_gauss_newton_that_diverges_has_not_converged(start):
    """x ← x − (1 + x²)·arctan x (Dennis and Schnabel 1983, 5.2): from beyond 1.3917 every step is
    farther from the root 0, and the sum of squares grows towards (π/2)²."""
    angles = ANGLE((np.zeros(2, int),), np.zeros((2, 1)), sigma=1.0)
    problem = [ls.Table("x", np.array([[start]]))], [angles]
    found = ls.adjust(*problem, method="gauss-newton")
    assert found.converged == (start < 1.3917)
    damped = ls.adjust(*problem)
    assert damped.converged
    np.testing.assert_allclose(damped["x"].value, 0.0, atol=1e-6)
