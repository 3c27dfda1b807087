"""How fine a guide becomes."""

from types import SimpleNamespace

import numpy as np
import pytest

from jaxbundle.surfaces import guide
from jaxbundle.surfaces.segments import Segments


@pytest.mark.parametrize("max_nodes, finest", [(10**9, 0), (2000, 2), (1, 4)])
def test_a_guide_has_at_most_so_many_nodes(monkeypatch, max_nodes, finest):
    """On the coarsest level it begins, whatever their number; each finer one has four times as
    many, and those beyond the limit are left to the points."""
    levels, numbers = [], []

    def smooth(base, level, uv, shape, found, settings):
        levels.append(level)
        numbers.append(len(uv))
        return SimpleNamespace()

    monkeypatch.setattr(guide, "_search_all", lambda *_: SimpleNamespace())
    monkeypatch.setattr(guide, "_search_near", lambda *_: SimpleNamespace())
    monkeypatch.setattr(guide, "_smooth", smooth)
    base, pyramid = SimpleNamespace(size=(1280, 960)), SimpleNamespace(levels=[None] * 5)
    settings = guide.GuideSettings(spacing=8, max_nodes=max_nodes)
    guide.make_guide(base, [], [pyramid], lambda uv: np.zeros((len(uv), 2)), settings)
    assert levels == list(range(4, finest - 1, -1))
    assert max(numbers[1:], default=0) <= max_nodes
    assert finest == 0 or 4 * numbers[-1] > 0.9 * max_nodes


def test_an_image_says_nothing_beyond_the_part_of_a_line_of_sight_that_it_shows(monkeypatch):
    """Although it is searched some positions farther, for peaks at either end."""
    steps, one = 11, np.ones(1, bool)
    monkeypatch.setattr(guide, "correlate", lambda *_, **given: (np.ones((1, steps)), None))
    # 4 pixels between q = 1 and q = 2, in the middle of 11 positions
    segment = Segments(np.array([[1.0, 2.0]]), np.array([4.0]), np.zeros(1))
    window = SimpleNamespace(other_axis=np.array([[1.0, 0.0]]))
    q = np.array([[0.5, 1.0, 1.4, 2.0, 2.5]])
    rho = guide._correlate_at(
        q, (None, None), (None, None), None, segment, window, one, level=0, steps=steps,
        half_window=2,
    )
    np.testing.assert_array_equal(rho, [[np.nan, 1, 1, 1, np.nan]])
    # Of a line of 40 pixels only the 10 in the middle are searched.
    segment = Segments(np.array([[1.0, 2.0]]), np.array([40.0]), np.zeros(1))
    q = np.array([[1.0, 1.35, 1.4, 1.6, 1.65, 2.0]])
    rho = guide._correlate_at(
        q, (None, None), (None, None), None, segment, window, one, level=0, steps=steps,
        half_window=2,
    )
    np.testing.assert_array_equal(rho, [[np.nan, np.nan, 1, 1, np.nan, np.nan]])


def test_the_normal_at_an_edge_is_the_line_of_sight_at_height_zero():
    """Of scanner images q is a height, which may be 0."""
    v, u = np.mgrid[0:4, 0:5].astype(float)
    sight = np.array([0.6, 0.0, 0.8])
    points = lambda uv, q: np.pad(uv, ((0, 0), (0, 1))) + q[:, None] * sight / 0.8
    base = SimpleNamespace(points=points)
    q, rate = np.zeros((4, 5)), np.full((4, 5), 2.0)
    q[:, 3:] = 10.0
    uv = np.stack([u.ravel(), v.ravel()], 1)
    X = points(uv, q.ravel()).reshape(4, 5, 3)
    normal = guide._normals(base, uv, X, q, rate, max_change=1.0)
    np.testing.assert_allclose(abs(normal[:, 2:4] @ sight), 1, atol=1e-12)
    np.testing.assert_allclose(abs(normal[:, 0, 2]), 1, atol=1e-12)
    # Nodes at one place span no plane.
    none = guide._normals(base, 0 * uv, 0 * X, 0 * q, rate, max_change=1.0)
    np.testing.assert_allclose(abs(none @ sight), 1, atol=1e-12)


def test_a_node_far_from_its_neighbours_follows_them():
    """By more than so many pixels of the other image: at twice the size of a pixel, of level 1. A
    poor match is no node either."""
    base = SimpleNamespace(points=lambda uv, q: np.column_stack([uv, q]))
    settings, level, shape = guide.GuideSettings(), 1, (5, 6)
    limit = 2 * settings.max_deviation / 0.5  # of q, of which one unit is half a pixel
    q, rho = np.full(shape, 7.0), np.full(shape, 0.9)
    q[1, 1], q[3, 4], q[2, 3] = 7 + 0.9 * limit, 7 - 1.1 * limit, 7 + 1e-3
    rho[2, 3] = settings.min_correlation - 0.01
    v, u = np.indices(shape).reshape(2, -1)
    found = guide.NodeMatches(q.ravel(), np.full(q.size, 0.5), rho.ravel())
    smooth = guide._smooth(base, level, 1.0 * np.stack([u, v], 1), shape, found, settings)
    bad = np.zeros(shape, bool)
    bad[3, 4] = bad[2, 3] = True
    np.testing.assert_array_equal(smooth.good, ~bad)
    np.testing.assert_allclose(smooth.q, np.where(bad, 7.0, q))
    assert smooth.step == 2 * settings.spacing


def test_an_image_that_no_other_overlaps_has_no_guide(monkeypatch):
    monkeypatch.setattr(guide, "_prepare_searches", lambda *_: ([], 8))
    base, pyramid = SimpleNamespace(size=(640, 480)), SimpleNamespace(levels=[None] * 3)
    bounds = lambda uv: np.tile([1.0, 2.0], (len(uv), 1))
    assert guide.make_guide(base, [], [pyramid, []], bounds) is None


@pytest.mark.parametrize("size, length, level", [
    ((400, 300), 10, 0), ((400, 300), 100, 1), ((400, 190), 100, 0),
    ((4000, 4000), 10, 4),  # 250 pixels, three times the least side or less
    ((4000, 4000), 4000, 5), ((4000, 4000), 10**6, 5),
])  # fmt: skip
def test_the_coarsest_level_has_short_segments_and_a_small_image(size, length, level):
    """Of 64 positions and 300 pixels at most, and not below 100 pixels."""
    settings = guide.GuideSettings(coarse_side=100, max_coarse_steps=64)
    assert guide.coarsest_level(size, length, settings) == level
