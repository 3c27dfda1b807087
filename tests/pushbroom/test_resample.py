"""Resampling against scipy and exact polynomials."""

import jax
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from jaxbundle.pushbroom.resampling import resample

rng = np.random.default_rng(0)
BANDS = rng.normal(size=(2, 12, 15))
ROW, COLUMN = rng.uniform(2, 9, 200), rng.uniform(2, 12, 200)
at = jax.jit(resample, static_argnums=3)


@pytest.mark.parametrize("kind, order", [("nearest", 0), ("bilinear", 1)])
def test_against_scipy(kind, order):
    peer = [map_coordinates(band, [ROW, COLUMN], order=order) for band in BANDS]
    np.testing.assert_allclose(at(BANDS, ROW, COLUMN, kind), peer, atol=1e-12)


def test_cubic_is_exact_for_parabolas_and_at_pixels():
    i, j = np.indices(BANDS.shape[1:])
    shape = lambda i, j: 1 + 2 * i - j + 0.3 * i * j + 0.2 * i**2 - 0.1 * j**2
    np.testing.assert_allclose(
        at(shape(i, j)[None], ROW, COLUMN, "cubic")[0], shape(ROW, COLUMN), atol=1e-12
    )
    pixels = at(BANDS, i.astype(float), j.astype(float), "cubic")
    np.testing.assert_allclose(pixels, BANDS, atol=1e-15)


@pytest.mark.parametrize("kind", ["nearest", "bilinear", "cubic", "lanczos"])
def test_edges(kind):
    row = np.array([-0.49, -0.51, 11.49, 11.51, 5.0])
    value = np.array(at(BANDS, row, 0 * row + 3, kind))
    np.testing.assert_array_equal(np.isnan(value[0]), [False, True, False, True, False])
    assert not np.isnan(at(np.ones((1, 12, 15)), row[::2], 0 * row[::2] - 0.4, kind)).any()


def test_lanczos_is_the_windowed_sinc():
    """Against a sum over all pixels; a constant stays one, and pixels keep their values."""
    i, j = np.indices(BANDS.shape[1:])
    kernel = lambda d: np.where(np.abs(d) < 3, np.sinc(d) * np.sinc(d / 3), 0)
    down, right = kernel(ROW[:, None] - np.arange(12)), kernel(COLUMN[:, None] - np.arange(15))
    down, right = (w / w.sum(1, keepdims=True) for w in (down, right))
    expected = np.einsum("ni,kij,nj->kn", down, BANDS, right)
    found = np.array(at(BANDS, ROW, COLUMN, "lanczos"))
    # where all six pixels of each direction are in the image
    inner = (ROW >= 2) & (ROW <= 9) & (COLUMN >= 2) & (COLUMN <= 12)
    np.testing.assert_allclose(found[:, inner], expected[:, inner], atol=1e-12)
    np.testing.assert_allclose(at(BANDS, i * 1.0, j * 1.0, "lanczos"), BANDS, atol=1e-6)
    np.testing.assert_allclose(at(np.ones((1, 12, 15)), ROW, COLUMN, "lanczos"), 1, atol=1e-12)
