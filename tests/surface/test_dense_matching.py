"""Dense matching of rectified pairs: exposures, windows for weak texture, strips."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import ndimage

from jaxbundle.surface import dense, disparity_search
from jaxbundle.surface.dense import match_dense

SHAPE, SHIFT, SPAN = (160, 460), 50, 90


def shifted_pair(gain, contrast, noise):
    """A texture, and the same `SHIFT` columns to the left in another exposure."""
    rng = np.random.default_rng(4)
    texture = ndimage.gaussian_filter(rng.standard_normal((SHAPE[0], SHAPE[1] + SHIFT)), 1.2)
    texture = 128 + contrast * texture / texture.std()
    left, right = texture[:, : SHAPE[1]], texture[:, SHIFT:]
    grey = [a + noise * rng.standard_normal(SHAPE) for a in (left, 20 + gain * right)]
    return SimpleNamespace(**dict(zip(("left", "right"), np.float32(grey))))


@pytest.mark.parametrize("gain, contrast, noise", [(1.0, 25.0, 1.0), (0.5, 25.0, 1.0), (1, 9, 3)])
def test_disparities_of_any_exposure_have_honest_sigma(gain, contrast, noise):
    found = match_dense(shifted_pair(gain, contrast, noise), SPAN)
    e = found.disparity[10:-10, SHIFT + 10 : -10] - SHIFT
    known = np.isfinite(e)
    assert known.mean() > 0.97
    w = (e / found.sigma[10:-10, SHIFT + 10 : -10])[known]
    assert 0.8 < np.sqrt(np.mean(w**2)) < 1.2
    assert (np.abs(e[known]) < 0.2).mean() > 0.99


def test_strips_of_a_large_image_match_as_the_whole(monkeypatch):
    rng = np.random.default_rng(5)
    right = 128 + 60 * ndimage.gaussian_filter(rng.standard_normal((600, 300)), 1.2)
    y, x = np.indices(right.shape)
    true = 20 + 8 * np.sin(y / 60) + 5 * np.sin(x / 50)
    left = ndimage.map_coordinates(right, [y, x - true], order=3, mode="nearest")
    monkeypatch.setattr(disparity_search, "MOST_COSTS", 0)

    def match(cores):
        monkeypatch.setattr(disparity_search, "available_cores", lambda: cores)
        return disparity_search.semi_global(left, right, 47)

    whole, strips = match(1), match(4)
    inner = np.s_[10:-10, 60:-10]
    assert (np.abs(strips - true) < 0.5)[inner].mean() > 0.97
    # Paths from above begin at other rows; nothing else may differ.
    assert (np.abs(strips - whole) < 0.5)[np.isfinite(whole)].mean() > 0.999
