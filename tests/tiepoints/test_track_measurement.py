"""Tracks in photographs that are similarity transformations of one texture: positions are known."""

import numpy as np
import pytest

from jaxbundle.tiepoints import track_measurement
from jaxbundle.tiepoints.features import Features
from jaxbundle.tiepoints.track_measurement import TrackMatchingSettings, measure_tracks

SIDE = 400
TURN, SCALE = np.radians([0.0, 15.0, 0.0]), np.array([1.0, 1.1, 2.0])
MIDDLE = SIDE / 2 - 0.5


def turn(k):
    c, s = np.cos(TURN[k]), np.sin(TURN[k])
    return np.array([[c, -s], [s, c]])


def in_photograph(k, xy):
    """Pixels of points of the texture, which has its origin in the middle of the photographs."""
    return SCALE[k] * xy @ turn(k).T + MIDDLE


@pytest.fixture(scope="module")
def scene():
    """Three photographs, of which one is turned and one has twice the scale, and tracks of features
    a fraction of a pixel from the points; the last feature of the first track is 8 pixels wrong."""
    rng = np.random.default_rng(3)
    direction, phase = rng.uniform(0, 2 * np.pi, (2, 60))
    wave = 2 * np.pi / rng.uniform(9, 30, 60) * np.stack([np.cos(direction), np.sin(direction)])
    v, u = np.indices((SIDE, SIDE))
    pixels = np.stack([u.ravel(), v.ravel()], 1) - MIDDLE
    photographs, features = [], []
    for k in range(3):
        of_texture = pixels @ turn(k) / SCALE[k]
        grey = 127 + 10 * np.sin(of_texture @ wave + phase).sum(1).reshape(SIDE, SIDE)
        grey += 2 * rng.normal(size=grey.shape)
        grey = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
        photographs.append(np.repeat(grey[:, :, None], 3, axis=2))
    points, n = rng.uniform(-70, 70, (40, 2)), 40
    for k in range(3):
        xy = in_photograph(k, points) + SCALE[k] * rng.uniform(-0.4, 0.4, points.shape)
        xy[0] += 8 * SCALE[k] * (k == 2)
        size, angle = np.full(n, 7 * SCALE[k]), np.full(n, TURN[k])
        features.append(Features(xy, size, angle, np.zeros((n, 128), np.uint8)))
    return photographs, features


def measure(scene, **settings):
    photographs, features = scene
    tracks = [[(k, t) for k in range(3)] for t in range(len(features[0].xy))]
    given = TrackMatchingSettings(**settings)
    return measure_tracks(tracks, features, photographs.__getitem__, settings=given)


def by_track(values):
    return values.reshape(-1, 3, *values.shape[1:])


def test_points_are_where_the_texture_is_with_half_the_variance_each(scene):
    """The window is that of the feature of median size, its point the pixel nearest to it; the
    photograph of twice the scale is matched on level 1."""
    measured = measure(scene)
    xy, sigma = by_track(measured.xy), by_track(measured.sigma)
    assert by_track(measured.is_template)[:, 1].all() and measured.is_template.sum() == len(xy)
    np.testing.assert_array_equal(xy[:, 1], np.rint(scene[1][1].xy))
    np.testing.assert_array_equal(by_track(measured.level)[1:], [[0, 0, 1]] * (len(xy) - 1))
    point = (xy[:, 1] - MIDDLE) @ turn(1) / SCALE[1]
    for k in (0, 2):
        error = (xy[:, k] - in_photograph(k, point))[1:]
        # both windows have noise: σ² of each is half of that of the match
        length = error / (np.sqrt(2) * sigma[1:, k])
        assert 0.9 < np.sqrt(np.mean(length**2)) < 1.4, k
    of_level = sigma / 2.0 ** np.maximum(by_track(measured.level), 0)[..., None]
    np.testing.assert_allclose(sigma[1:, 1] ** 2, (of_level[1:, ::2] ** 2).mean(1))
    np.testing.assert_allclose(sigma[0, 1], sigma[0, 0])  # its other match failed


def test_features_without_a_match_stay_where_they_are(scene):
    """The wrong one, as far from its feature as the point of the window, turned and scaled; and all
    if no match is exact enough. σ grows with their size."""
    measured = measure(scene)
    assert np.flatnonzero(measured.level < 0).tolist() == [2]
    offset = SCALE[2] / SCALE[1] * turn(2) @ turn(1).T @ (measured.xy[1] - scene[1][1].xy[0])
    np.testing.assert_allclose(measured.xy[2], scene[1][2].xy[0] + offset)
    np.testing.assert_allclose(measured.sigma[2], 0.12 * 7 * SCALE[2])
    none = measure(scene, max_sigma=1e-6)
    assert (none.level == -1).all()
    features = np.stack([one.xy for one in scene[1]], 1)
    np.testing.assert_array_equal(by_track(none.xy), features)
    np.testing.assert_allclose(by_track(none.sigma), np.tile(0.84 * SCALE[:, None], (40, 1, 2)))


def test_sigma_has_a_floor_in_quadrature(scene):
    """Otherwise strong edges, whose σ by noise alone is thousandths of a pixel, outweigh the other
    measurements a hundred times."""
    with_floor, without = measure(scene, added_sigma=0.05), measure(scene, added_sigma=0.0)
    scale = np.where(with_floor.level < 0, 0.0, 2.0**with_floor.level)[:, None]
    difference = with_floor.sigma**2 - without.sigma**2
    np.testing.assert_allclose(difference, np.tile((0.05 * scale) ** 2, 2), rtol=1e-6)
    default = measure(scene)
    assert (default.sigma >= 0.01 * scale).all() and (without.sigma < 0.02).any()


@pytest.mark.parametrize(("away", "good"), [(2.99, True), (3.01, False)])
def test_matches_are_compared_with_where_the_features_predict_them(scene, monkeypatch, away, good):
    """The point is the middle of a pixel, up to 0.7 pixels from the feature of the window, and as
    far, turned and scaled, from that of the other photograph: this is no error of a match."""
    move = away * np.array([0.6, -0.8])
    found = lambda windows, pieces, others, start, *_: (
        start + np.concatenate([np.zeros((2, 2)), move[:, None]], 1),
        np.zeros((len(others), 2, 2)), np.ones(len(others)), np.zeros(len(others), int),
    )  # fmt: skip
    monkeypatch.setattr(track_measurement, "_match_in_chunks", found)
    measured = measure(scene, max_shift=3.0)
    assert ((measured.level >= 0) == good).all()


@pytest.mark.parametrize(("window", "search_window"), [(17, 41), (25, 41), (17, 61)])
def test_features_are_matched_where_the_window_fits_into_the_photograph(
    window, search_window, monkeypatch
):
    """With two pixels around it, for interpolation and the last step, however large the part in
    which it is searched."""
    found = lambda windows, pieces, others, start, *_: (
        start, np.zeros((len(others), 2, 2)), np.ones(len(others)), np.zeros(len(others), int)
    )  # fmt: skip
    monkeypatch.setattr(track_measurement, "_match_in_chunks", found)
    away = np.arange(30)
    xy = np.concatenate([np.stack([away, away + 100], 1), np.stack([away + 100, 399 - away], 1)])
    n = len(xy)
    of = lambda xy: Features(xy.astype(float), np.full(n, 7.0), np.zeros(n), np.zeros((n, 128)))
    features = [of(xy), of(np.full((n, 2), 200))]
    photograph = np.zeros((SIDE, SIDE, 3), np.uint8)
    settings = TrackMatchingSettings(window=window, search_window=search_window)
    tracks = [[(0, k), (1, k)] for k in range(n)]
    measured = measure_tracks(tracks, features, lambda k: photograph, settings=settings)
    np.testing.assert_array_equal(
        measured.level[measured.image == 0] >= 0, np.tile(away >= window // 2 + 2, 2)
    )


def test_features_are_matched_on_the_level_on_which_they_have_the_same_size():
    """7 pixels, up to 2⁶ · 7 = 450 in the original; larger ones on the coarsest."""
    track, size = np.repeat(np.arange(9), 2), np.repeat(7.0 * 2 ** np.arange(9), 2)
    _, level = track_measurement._choose_templates(track, size, TrackMatchingSettings())
    assert level[::2].tolist() == level[1::2].tolist() == [0, 1, 2, 3, 4, 5, 6, 6, 6]
