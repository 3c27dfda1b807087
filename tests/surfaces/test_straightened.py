"""The straightened other image: its grey values are those at the positions of the mapping."""

from types import SimpleNamespace

import numpy as np

from jaxbundle.surfaces.generic_rectification import _sample_other


def test_grey_values_at_the_edges_are_at_their_positions():
    """Of an image whose grey values are its own coordinates, under a mapping of degree two."""
    rows, columns = 60, 900

    def place(uv):
        u, v = uv.T
        return np.stack([0.9 * u + 0.05 * v + 1e-5 * u**2 + 40, v - 0.02 * u + 45], 1)

    v, u = np.mgrid[0:150, 0:950]
    base = SimpleNamespace(points=lambda uv, q: uv)
    pair = SimpleNamespace(lowest=-3, q0=0.0, base_places=lambda ab: ab)
    y, x = np.mgrid[0:rows, 0:columns]
    expected = place(np.stack([x.ravel() + 3, y.ravel()], 1))
    for k, grey in enumerate((u, v)):
        other = SimpleNamespace(grey=grey.astype(np.float32), size=grey.shape[::-1], project=place)
        found = _sample_other(base, other, pair, (rows, columns))
        np.testing.assert_allclose(found.ravel(), expected[:, k], atol=0.01)
