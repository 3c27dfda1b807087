"""Dense matching of rectified pairs: exposures, windows for weak texture, strips."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import ndimage

from jaxbundle.surfaces import disparity_search
from jaxbundle.surfaces.dense import DenseSettings, match_dense
from jaxbundle.surfaces.disparity_refinement import (
    DisparityRefinementSettings,
    refine_disparities,
)
from jaxbundle.surfaces.disparity_search import (
    DisparitySearchSettings,
    find_repetitions,
    semi_global,
)

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
    assert (np.abs(e[known]) < 0.2).mean() > (0.99 if contrast > noise * 5 else 0.98)


def test_strips_of_a_large_image_match_as_the_whole(monkeypatch):
    rng = np.random.default_rng(5)
    right = 128 + 60 * ndimage.gaussian_filter(rng.standard_normal((600, 300)), 1.2)
    y, x = np.indices(right.shape)
    true = 20 + 8 * np.sin(y / 60) + 5 * np.sin(x / 50)
    left = ndimage.map_coordinates(right, [y, x - true], order=3, mode="nearest")
    always_in_strips = DisparitySearchSettings(max_costs=0)

    def match(cores):
        monkeypatch.setattr(disparity_search, "available_cores", lambda: cores)
        return semi_global(left, right, 47, always_in_strips)

    whole, strips = match(1), match(4)
    inner = np.s_[10:-10, 60:-10]
    assert (np.abs(strips - true) < 0.5)[inner].mean() > 0.97
    # Paths from above begin at other rows; nothing else may differ.
    assert (np.abs(strips - whole) < 0.5)[np.isfinite(whole)].mean() > 0.999


def wavy_pair():
    """A surface with waves and a step, and its disparities."""
    rng = np.random.default_rng(6)
    shape = (400, 600)
    right = 128 + 90 * ndimage.gaussian_filter(rng.standard_normal(shape), 1.3)
    y, x = np.indices(shape)
    true = 40 + 6 * np.sin(y / 60) + 9 * np.sin(x / 90) + 12 * ((abs(x - 350) < 60) & (y > 150))
    left = ndimage.map_coordinates(right, [y, x - true], order=3, mode="nearest")
    noisy = [np.float32(a + rng.standard_normal(shape)) for a in (left, right)]
    return SimpleNamespace(left=noisy[0], right=noisy[1]), true


@pytest.mark.parametrize("levels", [0, 1, pytest.param(2, marks=pytest.mark.further)])
def test_a_large_pair_is_matched_at_half_its_size_first(levels):
    pair, true = wavy_pair()
    span = 80
    settings = DenseSettings(max_searched=pair.left.size * span / 8**levels * 1.2)
    found = match_dense(pair, span, settings)
    e, inner = found.disparity - true, np.s_[10:-10, span:-10]
    known = np.isfinite(e[inner])
    assert known.mean() > 0.9
    assert (np.abs(e[inner][known]) < 0.2).mean() > 0.985
    w = (e / found.sigma)[inner][known]
    assert 0.8 < np.median(np.abs(w)) / 0.6745 < 1.2
    assert (np.abs(w) < 3).mean() > 0.98


@pytest.fixture(scope="module")
def refined():
    """Disparities to a quarter of a pixel, the true ones, and those that least squares give."""
    pair, true = wavy_pair()
    start = np.where(true > 0, np.rint(4 * true) / 4, np.nan).astype(np.float32)
    settings = DisparityRefinementSettings(piece=(256, 512))
    return pair, true, start, refine_disparities(pair.left, pair.right, start, settings)


def test_beside_a_step_the_nearer_surface_is_found_up_to_its_edge(refined):
    """By windows that correlate highly in spite of the other surface in them: the surface that ends
    at column 410 hides nothing there."""
    _, true, _, found = refined
    beside = np.s_[160:390, 406:415]
    assert (np.abs(found.disparity - true)[beside] < 0.2).mean() > 0.95


def test_pieces_do_not_matter(refined):
    pair, _, start, one = refined
    settings = DisparityRefinementSettings(piece=(120, 200))
    other = refine_disparities(pair.left, pair.right, start, settings)
    assert (np.isfinite(one.disparity) == np.isfinite(other.disparity)).mean() > 0.999
    off = np.abs(one.disparity - other.disparity)
    # OpenCV tabulates the weights of means by the range of disparities in a piece
    assert np.nanpercentile(off, 99.5) < 0.02


@pytest.mark.further
def test_disparities_beyond_sixteen_bits_of_sixteenths():
    """OpenCV's largest disparity is 2048 pixels."""
    shift = 2060
    texture = np.random.default_rng(8).standard_normal((40, 2 * shift + 300))
    texture = np.float32(128 + 60 * ndimage.gaussian_filter(texture, 1.2))
    columns = shift + 300
    pair = SimpleNamespace(left=texture[:, :columns], right=texture[:, shift : shift + columns])
    found = match_dense(pair, 2100).disparity[5:-5, shift + 10 : -10]
    assert (np.abs(found - shift) < 0.2).mean() > 0.95


@pytest.mark.parametrize("disparity", [10.0, 2000.0, 2100.0, 20_000.0])
def test_only_small_separate_surfaces_are_repetitions(disparity):
    """Stripes of 40 columns: all are kept on one large surface, none on a small one, however far
    both images are apart."""
    shape = (200, 800)
    noise = ndimage.gaussian_filter(np.random.default_rng(0).standard_normal(shape), 1.5)
    stripes = np.float32(128 + 50 * np.sin(2 * np.pi * np.arange(shape[1]) / 40) + 5 * noise)
    large = np.full(shape, disparity, np.float32)
    small = np.full(shape, np.nan, np.float32)
    small[50:60, 100:120] = disparity
    span, settings = int(disparity) + 100, DisparitySearchSettings()
    assert not find_repetitions(stripes, large, span, settings).any()
    np.testing.assert_array_equal(
        find_repetitions(stripes, small, span, settings), np.isfinite(small)
    )


def test_pieces_do_not_matter_after_any_number_of_rounds():
    """To rounding: no shape and no window reaches beyond the margin of a piece."""
    rng, shape = np.random.default_rng(6), (150, 260)
    texture = 128 + 90 * ndimage.gaussian_filter(rng.standard_normal(shape), 2.0)
    # much noise, so that every round changes the shape
    left, right = (np.float32(texture + 4 * rng.standard_normal(shape)) for _ in range(2))
    found = [
        refine_disparities(
            left, right, np.zeros(shape, np.float32),
            DisparityRefinementSettings(piece=piece, rounds=4),
        ).disparity
        for piece in ((256, 512), (120, 200))
    ]  # fmt: skip
    np.testing.assert_allclose(found[0], found[1], atol=1e-5)
    assert np.nanstd(found[0]) > 0.1
