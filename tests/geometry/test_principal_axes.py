"""Principal axes, against the eigenvectors of the scatter of the points."""

import numpy as np
import pytest

from jaxbundle.geometry.principal_axes import principal_axes


@pytest.mark.parametrize("points", [1, 2, 3, 40])
def test_all_axes_of_any_number_of_points(points):
    X = np.random.default_rng(points).normal(size=(points, 3)) * [3.0, 1.0, 0.1]
    extents, axes = principal_axes(X)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose((axes.T * extents**2) @ axes, X.T @ X, atol=1e-12)
    assert (np.diff(extents) <= 0).all() and (extents[points:] == 0).all()


def test_memory_grows_with_the_points_alone():
    """The left vectors of as many points would be 80 GB."""
    X = np.zeros((100_000, 3))
    X[:, 0] = np.arange(len(X))
    assert abs(principal_axes(X)[1][0, 0]) == pytest.approx(1)
