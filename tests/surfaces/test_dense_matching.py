"""Dense matching of rectified pairs: exposures, windows for weak texture, strips."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import ndimage

from jaxbundle.surfaces import disparity_search
from jaxbundle.surfaces.dense import DenseSettings, match_dense
from jaxbundle.surfaces.disparity_refinement import (
    DisparityRefinementSettings,
    _choose_windows,
    _find_steps,
    _measure_relief,
    _SizeMatches,
    refine_disparities,
)
from jaxbundle.surfaces.disparity_search import (
    DisparitySearchSettings,
    find_repetitions,
    search_both_ways,
    semi_global,
)
from jaxbundle.surfaces.row_windows import RowWindows

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
    assert 0.75 < np.sqrt(np.mean(w**2)) < 1.2
    assert (np.abs(e[known]) < 0.2).mean() > (0.99 if contrast > noise * 5 else 0.97)


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
@pytest.mark.further
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
    assert 0.6 < np.median(np.abs(w)) / 0.6745 < 1.2
    assert (np.abs(w) < 3).mean() > 0.98


@pytest.fixture(scope="module")
def refined():
    """Disparities to a quarter of a pixel, the true ones, and those that least squares give."""
    pair, true = wavy_pair()
    start = np.where(true > 0, np.rint(4 * true) / 4, np.nan).astype(np.float32)
    settings = DisparityRefinementSettings(piece=(256, 512))
    return pair, true, start, refine_disparities(pair.left, pair.right, start, settings)


def test_beside_a_step_disparities_are_right_or_left_out(refined):
    """The surface that ends at column 410 hides nothing there."""
    _, true, _, found = refined
    e = (found.disparity - true)[160:390, 395:425]
    known = np.isfinite(e)
    assert (np.abs(e[known]) < 0.2).mean() > 0.97
    # five pixels from the step, and at it: two surfaces in the smallest windows
    assert known[:, [9, 20]].mean() > 0.95 and not known[:, 14:16].any()


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


@pytest.fixture(scope="module")
def windows():
    """Two images of one texture, a third of a pixel and some noise apart, a tenth of the pixels
    unknown."""
    rng, shape = np.random.default_rng(7), (40, 60)
    y, x = np.indices(shape)
    texture = 60 * ndimage.gaussian_filter(rng.standard_normal((50, 70)), 2.0)
    sample = lambda dx: ndimage.map_coordinates(texture, [y + 5, x + 5 + dx], order=3)
    noisy = lambda a: np.float32(128 + a + rng.standard_normal(shape))
    left, right = noisy(sample(0.3)), noisy(sample(0))
    known = rng.random(shape) > 0.1
    return left, 0.8 * right + 10, known


@pytest.mark.parametrize("half", [2, 4])
def test_sums_over_windows_solve_the_same_system_as_dense_least_squares(windows, half):
    left, right, known = windows
    made = RowWindows(left, right, known)
    found = made.correct(half)
    ratio = made._contrast_ratio(left - left[known].mean(), right - left[known].mean())
    derivative = lambda a, axis: ndimage.correlate1d(a, np.array([1, -8, 0, 8, -1]) / 12, axis)
    g = [-0.5 * (derivative(left, k) + ratio * derivative(right, k)) for k in (1, 0)]
    for r, c in ((20, 30), (15, 41), (25, 22)):
        window = np.s_[r - half : r + half + 1, c - half : c + half + 1]
        use = known[window]
        A = np.column_stack([a[window][use] for a in (g[0], g[1], right)] + [np.ones(use.sum())])
        L = left[window][use].astype(float)
        x, *_ = np.linalg.lstsq(A, L, rcond=None)
        variance = np.sum((L - A @ x) ** 2) / (use.sum() - 4)
        sigma = np.sqrt(variance * np.diag(np.linalg.inv(A.T @ A)))
        assert found.delta[r, c] == pytest.approx(x[0], abs=2e-3)
        assert found.contrast[r, c] == pytest.approx(x[2], abs=2e-3)
        assert found.sigma[r, c] == pytest.approx(sigma[0], rel=5e-3)
        assert found.normalised_row_shift[r, c] == pytest.approx(x[1] / sigma[1], abs=0.02)
        assert found.noise[r, c] == pytest.approx(variance / 2, rel=5e-3)


def test_windows_have_texture_of_their_own():
    """A square of no texture on a ground with some: none in its middle and beside it."""
    rng = np.random.default_rng(9)
    image = np.float32(128 + 80 * ndimage.gaussian_filter(rng.standard_normal((60, 80)), 1.0))
    image[20:40, 30:50] = 128
    image += rng.standard_normal(image.shape).astype(np.float32)
    made = RowWindows(image, image, np.ones(image.shape, bool))
    own = made.find_own_texture(2, np.full(image.shape, 1.0, np.float32))
    assert own[3:15, 3:-3].mean() > 0.9 and not own[22:38, 32:48].any()


def test_pixels_hidden_in_the_right_image_are_not_confirmed():
    """A square moved by 30 pixels before a background moved by 10 hides 20 columns."""
    rng, shape, span = np.random.default_rng(3), (120, 300), 47
    far, near = (128 + 60 * ndimage.gaussian_filter(rng.standard_normal(shape), 1.0) for _ in "ab")
    inside = np.zeros(shape, bool)
    inside[30:90, 150:210] = True
    left = np.where(inside, near, far)
    right = np.where(np.roll(inside, -30, 1), np.roll(near, -30, 1), np.roll(far, -10, 1))
    found = search_both_ways(left, right, span)
    hidden, visible = np.s_[35:85, 131:149], np.s_[5:-5, 60:-5]
    assert np.isfinite(found[hidden]).mean() < 0.1
    assert (np.abs(found - np.where(inside, 30, 10)) < 0.5)[visible].mean() > 0.92


def test_distances_and_heights_of_steps():
    d = np.full((40, 60), 5.0, np.float32)
    d[:, 30:] = 9.0
    d[10, 5], inside = np.nan, np.ones(d.shape, bool)
    inside[:, :2], d[:, :2] = False, np.nan
    distance, height = _find_steps(d, inside, DisparityRefinementSettings())
    assert (distance[25, 29:31] == 0).all() and distance[25, 20] == pytest.approx(9)
    assert distance[10, 8] == pytest.approx(3) and distance[25, 3] > 15
    assert height[25, 27] == height[25, 33] == 4 and height[25, 10] == 0


def test_relief_is_measured_from_a_plane():
    y, x = np.indices((80, 100))
    plane = (300 + 0.3 * x - 0.2 * y).astype(np.float32)
    assert _measure_relief(plane, 4)[5:-5, 5:-5].max() < 1e-3
    noise = np.random.default_rng(2).normal(0, 0.1, plane.shape).astype(np.float32)
    # three parameters of 81 values
    expected = 0.1 * np.sqrt(1 - 3 / 81)
    found = _measure_relief(plane + noise, 4)[5:-5, 5:-5]
    assert np.sqrt(np.mean(found**2)) == pytest.approx(expected, rel=0.03)


def test_larger_windows_are_chosen_where_the_surface_is_flat():
    """Windows of 15 × 15 pixels smooth the waves of the right half, and noise everywhere."""
    rng, shape, halves = np.random.default_rng(4), (120, 240), (2, 4, 7)
    y, x = np.indices(shape)
    true = np.where(x < 120, 10.0, 10 + 0.5 * np.sin(x / 3))
    sizes = []
    for half in halves:
        side = 2 * half + 1
        noise = ndimage.uniform_filter(rng.standard_normal(shape), side) * 0.5
        d = ndimage.uniform_filter(true, side) + noise
        sigma = np.full(shape, 0.5 / side)
        across = ndimage.uniform_filter(rng.standard_normal(shape), side) * side
        sizes.append(_SizeMatches(*(a.astype(np.float32) for a in (d, sigma, across))))
    found = _choose_windows(sizes, DisparityRefinementSettings())
    flat, waves = np.s_[:, 10:100], np.s_[:, 140:230]
    assert (found.disparity == sizes[2].disparity)[flat].mean() > 0.7
    assert (found.disparity == sizes[2].disparity)[waves].mean() < 0.02
    e = found.disparity - true
    s = np.sqrt(found.scaled_noise + found.shape)
    assert (np.abs(e / s) < 3).mean() > 0.97
