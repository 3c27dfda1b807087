"""Rendered pairs: matches agree with the truth, heights with their σ, and nothing is found where
nothing is visible."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import ndimage
from surface_scenes import CAMERA, F, hills, photographs, two_shapes

from jaxbundle.measure.least_squares_matching import MatchingStatus
from jaxbundle.surfaces import correlation
from jaxbundle.surfaces.correlation import find_peaks, make_pyramid, slide
from jaxbundle.surfaces.dense_cloud import _inverse_distance, combine
from jaxbundle.surfaces.disparity_refinement import Disparities
from jaxbundle.surfaces.reconstruct import find_bounds, reconstruct_surface
from jaxbundle.surfaces.rectification import RectifiedPair, rectify
from jaxbundle.surfaces.subpixel_matching import refine
from jaxbundle.surfaces.views import FrameView, is_inside, line_of_sight, steps_on_plane
from jaxbundle.types import not_none

NONE = np.zeros((0, 3))


@pytest.fixture(scope="module")
def pair():
    views, truth = photographs(two_shapes(), [(-1.0, 0, 10), (1.0, 0, 10)])
    bounds, _ = find_bounds(views, NONE, (-1.5, 3.0))
    return views, truth, reconstruct_surface(views, bounds, {0: [1]}, step=4)


def errors(cloud, truth):
    v, u = cloud.uv.astype(int).T[::-1]
    true = truth[v, u]
    # along the line of sight: the pixel's true point is where the surface is seen
    return cloud.X[:, 2] - true[:, 2], cloud.sigma[:, 2], true


def test_heights_are_as_good_as_their_sigma_says(pair):
    _, truth, found = pair
    e, s, _ = errors(found.cloud, truth[0])
    assert len(e) > 1200
    outlier = np.abs(e) > 10 * s
    assert outlier.mean() < 0.01
    w = e[~outlier] / s[~outlier]
    assert 0.85 < np.sqrt(np.mean(w**2)) < 1.15
    assert (np.abs(w) < 3).mean() > 0.985
    assert np.median(s) < 0.1 * 10 * 10 / (F * 2)  # 0.1 pixel of parallax: s·Z/(f·b/Z)


def test_matches_are_within_a_fifth_of_a_pixel(pair):
    views, truth, found = pair
    e, _, true = errors(found.cloud, truth[0])
    off = np.linalg.norm(views[1].project(found.cloud.X) - views[1].project(true), axis=1)
    assert (off < 0.2).mean() > 0.95


@pytest.mark.further
def test_nothing_is_found_where_there_is_no_texture():
    blank = lambda s, t: s > 0.5
    views, truth = photographs(two_shapes(blank=blank), [(-1.0, 0, 10), (1.0, 0, 10)])
    bounds, _ = find_bounds(views, NONE, (-1.5, 3.0))
    cloud = reconstruct_surface(views, bounds, {0: [1]}, step=4).cloud
    assert len(cloud) > 300
    on_ground = cloud.X[cloud.X[:, 2] < 1.5]
    assert (on_ground[:, 0] > 0.5 + 9 * 10 / F).sum() == 0  # but for the windows at its edge
    e, s, _ = errors(cloud, truth[0])
    assert (np.abs(e) > 10 * s).mean() < 0.02


def test_bounds_are_found_without_heights():
    views, truth = photographs(two_shapes(), [(-1.0, 0, 10), (1.0, 0, 10)])
    X = truth[0][::20, ::20].reshape(-1, 3)
    bounds, told = find_bounds(views, X)
    q = 1 / np.linalg.norm(truth[0].reshape(-1, 3) - views[0].X0, axis=1)
    assert not told and bounds[0].q[0] < q.min() and q.max() < bounds[0].q[1]
    bounds, told = find_bounds(views, NONE)
    assert "--zmin" in told[0] and bounds[0].q[0] < q.min() and q.max() < bounds[0].q[1]
    assert "in 2 image(s)" in told[0]
    # Given heights bound the search: nothing is guessed, but of an image that is between them.
    assert find_bounds(views, NONE, (-1.5, 3.0))[1] == ()
    (said,) = find_bounds(views, NONE, (-1.5, 12.0))[1]
    assert "in 2 image(s)" in said and "the heights are all around it" in said


def test_the_bounds_of_heights_are_those_along_the_ray(pair):
    views, _, _ = pair
    uv = np.array([[10.0, 20], [200, 100]])
    q = views[0].bounds(uv, -1.0, 2.0)
    for k, Z in enumerate((-1.0, 2.0)):
        np.testing.assert_allclose(views[0].points(uv, q[:, k])[:, 2], Z, atol=1e-9)


def test_the_plane_carries_windows_from_one_image_to_the_other(pair):
    views, _, _ = pair
    X = np.array([[0.3, 0.4, 0.5], [1.0, -2.0, 0.1]])
    normal = np.array([[0.1, 0.2, 1.0], [0.0, 0.0, 1.0]])
    J, K = (view.derivative(X) for view in views)
    T = steps_on_plane(J, normal)
    np.testing.assert_allclose(np.einsum("ni,nij->nj", normal, T), 0, atol=1e-12)
    step = 1e-4 * np.array([0.6, -0.8])
    there = X + T @ step
    np.testing.assert_allclose(views[0].project(there) - views[0].project(X), [step] * 2,
                               atol=1e-8)  # fmt: skip
    moved = views[1].project(there) - views[1].project(X)
    np.testing.assert_allclose(moved, K @ T @ step, atol=1e-8)
    d = line_of_sight(J)
    away = (X - views[0].X0) / np.linalg.norm(X - views[0].X0, axis=1, keepdims=True)
    np.testing.assert_allclose(np.abs(np.sum(d * away, 1)), 1, atol=1e-9)


def test_correlation_along_a_strip_is_that_of_every_window():
    rng = np.random.default_rng(0)
    template, strip = rng.random((2, 5, 5)), rng.random((2, 5, 12))
    strip[1, :, 9:] = np.nan
    rho = slide(template.astype(np.float32), strip.astype(np.float32))
    for n in range(2):
        for k in range(8):
            window = strip[n, :, k : k + 5]
            if np.isnan(window).any():
                assert np.isnan(rho[n, k])
            else:
                expected = np.corrcoef(template[n].ravel(), window.ravel())[0, 1]
                np.testing.assert_allclose(rho[n, k], expected, atol=1e-5)
    peak, best, second = find_peaks(np.array([[0.1, 0.5, 0.9, 0.5, 0.1, 0.3], [np.nan] * 6]))
    np.testing.assert_allclose([peak[0], best[0], second[0]], [0.9, 2.0, 0.3])
    assert np.isnan([peak[1], best[1], second[1]]).all()


def test_a_peak_is_the_vertex_of_the_parabola_through_its_neighbours():
    """At either end, where a neighbour is missing, the largest value itself."""
    k = np.arange(6.0)
    rho = np.stack([0.9 - 0.05 * (k - 2.3) ** 2, 0.9 - 0.05 * (k - 5.2) ** 2, 0.9 - 0.1 * k])
    np.testing.assert_allclose(find_peaks(rho)[1], [2.3, 5.0, 0.0])


def test_correlations_of_several_images_are_the_mean_of_the_better_half():
    """Of n the best ⌊n/2⌋ + 1: an image in which the point is hidden does not spoil the others."""
    nan = np.nan
    rho = np.array([[[0.9, 0.9, nan, 0.7]], [[-0.5, nan, nan, nan]], [[0.8, 0.1, nan, nan]]])
    np.testing.assert_allclose(correlation.combine(rho), [[0.85, 0.5, nan, 0.7]])


@pytest.mark.parametrize("unit, level", [(1.0, 128.0), (1e-3, 0.128), (1e-6, 0.0), (1e4, 1e6)])
def test_correlation_has_no_unit_of_grey_values(unit, level):
    """Rasters of floating point may be reflectances; a flat window is flat in any unit."""
    rng = np.random.default_rng(1)
    strip = 0.3 * rng.standard_normal((1, 5, 30))
    strip[..., 15:25] = 0.0
    template = strip[..., 3:8]
    rho = slide(*(np.float32(level + unit * a) for a in (template, strip)))[0]
    assert rho[3] > 0.999 and (rho[15:21] == -1).all()
    windows = np.lib.stride_tricks.sliding_window_view(strip[0], (5, 5))[0, :15]
    expected = [np.corrcoef(template.ravel(), a.ravel())[0, 1] for a in windows]
    np.testing.assert_allclose(rho[:15], expected, atol=2e-3)


def test_grey_values_between_pixels():
    """Also in the last row and column, and in images longer than OpenCV's 15 bits; none outside,
    and none of positions that are not known."""
    plane = lambda u, v: 2.0 * u + 3.0 * v
    images = ((20, 30), [[29.0, 5.5], [28.5, 19.0], [29.0, 19.0], [0.0, 0.0], [0.25, 18.75]]), (
        (8, 40_000), [[10.0, 3.0], [39_000.5, 4.5], [20_000.0, 7.0], [39_999.0, 0.5], [0.0, 1.0]],
    )  # fmt: skip
    for (rows, columns), places in images:
        v, u = np.indices((rows, columns))
        pyramid = make_pyramid(np.float32(plane(u, v)), 1)
        outside = [[columns - 0.9, 3.0], [-0.1, 2.0], [4.0, rows + 50.0], [np.nan, 2.0], [1e7, 1.0]]
        grid = np.array([places, outside, places[::-1]])
        found = pyramid.sample(0, grid)
        expected = np.float32(plane(*np.moveaxis(grid, 2, 0)))
        np.testing.assert_array_equal(found[[0, 2]], expected[[0, 2]])
        assert np.isnan(found[1]).all()
        # means of 2 × 2 pixels are those of their middle
        inner = np.array([[[2.5, 4.5], [columns / 2, 3.0]]])
        np.testing.assert_allclose(pyramid.sample(1, inner), plane(*np.moveaxis(inner, 2, 0)))


def test_windows_in_an_image_of_three_times_the_scale():
    """Its pixels are the means of 3 × 3 of the other: all are matched, within their σ."""
    rng = np.random.default_rng(0)
    fine = 128 + 480 * ndimage.gaussian_filter(rng.standard_normal((480, 480)), 6.0)
    grey = fine.reshape(160, 3, 160, 3).mean((1, 3)), fine
    base, other = (
        SimpleNamespace(grey=np.float32(a + rng.standard_normal(a.shape)), size=a.shape)
        for a in grey
    )
    uv = rng.integers(30, 130, (60, 2)).astype(float)
    true = 3 * uv + 1
    start = true + rng.uniform(-0.7, 0.7, true.shape)
    found = refine(base, other, uv, start, np.tile(3 * np.eye(2), (60, 1, 1)), 6)
    good = found.status == int(MatchingStatus.CONVERGED)
    assert good.mean() > 0.9
    w = (found.uv - true)[good] / np.sqrt(np.einsum("nii->ni", found.covariance[good]))
    assert 0.7 < np.sqrt(np.mean(w**2)) < 1.2
    # in other windows than those of four times the scale nothing is looked for
    apart = refine(base, other, uv, start, np.tile(9 * np.eye(2), (60, 1, 1)), 6)
    assert (apart.status == int(MatchingStatus.OUTSIDE)).all()


def test_hidden_points_are_not_found(pair):
    """Ground that the roof hides from the second photograph."""
    views, truth, found = pair
    cloud = found.cloud
    e, s, true = errors(cloud, truth[0])
    uv = views[1].project(true)
    inside = is_inside(views[1], uv)
    v, u = np.rint(np.where(inside[:, None], uv, 0)).astype(int).T[::-1]
    hidden = inside & (np.linalg.norm(truth[1][v, u] - true, axis=1) > 0.5)
    assert hidden.sum() < 0.005 * len(cloud)
    np.testing.assert_allclose(true[true[:, 2] < 1.9][:, 2],
                               hills(*true[true[:, 2] < 1.9].T[:2]), atol=1e-6)  # fmt: skip


def test_dense_matching_finds_most_pixels_with_honest_sigma(pair):
    views, truth, _ = pair
    bounds, _ = find_bounds(views, NONE, (-1.5, 3.0))
    cloud = reconstruct_surface(views, bounds, {0: [1]}, dense=True).cloud
    e, s, _ = errors(cloud, truth[0])
    seen = is_inside(views[1], views[1].project(truth[0].reshape(-1, 3))).sum()
    assert len(cloud) > 0.85 * seen
    w = e / s
    assert (np.abs(w) > 10).mean() < 0.01
    assert 0.8 < np.sqrt(np.mean(w[np.abs(w) < 10] ** 2)) < 1.2
    off = np.linalg.norm(views[1].project(cloud.X) - views[1].project(truth[0][
        cloud.uv[:, 1].astype(int), cloud.uv[:, 0].astype(int)]), axis=1)  # fmt: skip
    assert (off < 0.25).mean() > 0.95


def test_rectified_points_are_where_they_are(pair):
    views, truth, _ = pair
    X = truth[0][::16, ::16].reshape(-1, 3)
    found, span = not_none(rectify(*views, X))
    place, d = found.places(X), found.disparity(X)
    assert (d > 0).all() and (d < span).all()
    np.testing.assert_allclose(found.points(place, d), X, atol=1e-9)
    # the same point is as bright in both rectified images, on one row
    row, column = np.rint(place[:, 1]).astype(int), np.rint(place[:, 0]).astype(int)
    assert not_none(rectify(*views[::-1], X))[0].base == found.base
    assert np.isfinite(found.left[row, column]).all()
    # and only what the photograph shows, up to half a pixel from the centres of those at its edge
    rows, columns = found.left.shape
    cells = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), -1).reshape(-1, 2)
    uv = views[0].project(found.points(1.0 * cells, np.full(len(cells), d.mean())))
    size = np.array(views[0].size)
    away = np.minimum(uv + 0.5, size - 0.5 - uv).min(1)
    sure = np.abs(away) > 1e-3
    np.testing.assert_array_equal(np.isfinite(found.left).ravel()[sure], away[sure] > 0)
    assert (np.abs(away) < 0.5).any()


def test_one_camera_before_the_other_cannot_be_rectified(pair):
    views, truth, _ = pair
    below = FrameView("below", views[0].grey, CAMERA, views[0].X0 - [0, 0, 2], np.eye(3))
    assert rectify(views[0], below, truth[0].reshape(-1, 3)) is None


def test_disparities_are_interpolated_on_one_surface_only():
    """Between two surfaces, or beside a gap, the value is that of the nearest pixel: a mean of both
    would be a point in the air."""
    row = np.array([2.0, 2.5, 2.75, 9.0, np.nan, 3.0])
    nothing = np.zeros((4, 6))
    found = Disparities(np.tile(row, (4, 1)), nothing + 0.1, nothing, 1.0)
    f, b = 10.0, 2.0
    pair = RectifiedPair(nothing, nothing, np.zeros(2), 0, np.zeros(3), np.eye(3), f, b)
    x = np.array([0.25, 1.5, 2.25, 2.75, 3.25, 4.25, 5.5])
    d = np.column_stack([x / f, np.full(len(x), 1.5 / f), np.ones(len(x))])
    base = SimpleNamespace(X0=np.zeros(3))
    q, sigma = _inverse_distance(base, d, pair, found, 1.0)
    nan = np.nan
    # 1/depth = disparity/(f·b); outside the image there is none
    np.testing.assert_allclose(q * f * b, [2.125, 2.625, 2.75, 9.0, 9.0, nan, nan])
    np.testing.assert_allclose(sigma * f * b, [0.1] * 6 + [nan])


def test_pairs_that_disagree_are_left_out_where_no_third_decides():
    q = np.array([[1.0, 1.0, 1.0, np.nan], [1.01, 2.0, 2.0, 1.5], [np.nan, np.nan, 1.01, np.nan]])
    sigma = np.full(q.shape, 0.01)
    mean, variance, number = combine(q, sigma)
    np.testing.assert_allclose(mean, [1.005, np.nan, 1.005, 1.5])
    assert number.tolist()[0] == 2 and number.tolist()[2:] == [2, 1]
    # one pair: its σ; of two, the half that is the base image's stays
    np.testing.assert_allclose(variance[[0, 3]], [0.75e-4, 1e-4])


def test_a_value_without_sigma_is_no_value_of_the_only_pair():
    """Beside a step a disparity may be known and its σ not."""
    mean, variance, number = combine(np.array([[1.0, 2.0]]), np.array([[0.1, np.nan]]))
    assert mean[0] == 1.0 and np.isnan(mean[1]) and number.tolist() == [1, 0]
    np.testing.assert_allclose(variance[0], 0.01)


def test_points_that_no_other_image_shows_are_said(pair):
    """Their windows of 9 × 9 pixels are not in the other image; they are not badly correlated."""
    views, truth, found = pair
    every = truth[0][::4, ::4].reshape(-1, 3)
    v, u = 4.0 * np.indices((48, 64))
    inner = is_inside(views[0], np.stack([u, v], -1).reshape(-1, 2), 8)
    unseen = inner & ~is_inside(views[1], views[1].project(every), 4)
    said = found.bases[0]["rejected"]
    assert said["at the edge"] == (~inner).sum()
    # the search continues beyond the surface, as far as the guide is uncertain
    assert said["in no other image at a similar scale"] == pytest.approx(unseen.sum(), rel=0.05)
    assert said["low correlation"] < 0.1 * inner.sum()
