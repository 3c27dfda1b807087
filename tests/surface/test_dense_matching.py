"""Dense matching of rectified pairs: exposures, windows for weak texture."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import ndimage

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
