"""What is done with matches, whose points and residuals are given, and what is not matched."""

from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest

from jaxbundle.measure.least_squares_matching import MatchingStatus
from jaxbundle.surfaces import relative
from jaxbundle.surfaces.dense_ground import DenseSettings, _match_piece
from jaxbundle.surfaces.intersection import IntersectedPoints
from jaxbundle.surfaces.matching import MatchingSettings, _accept
from jaxbundle.surfaces.subpixel_matching import refine


def test_every_rejected_point_has_one_reason():
    """A point of a narrow angle whose rays do not meet counts once; an undetermined one, too."""
    misfit = np.array([0.0, 99.0, 0.0, 99.0, 99.0, 0.0])
    narrow = np.array([0, 0, 1, 1, 1, 0], bool)
    covariance = np.tile(np.eye(3), (6, 1, 1))
    covariance[4] = np.nan
    found = IntersectedPoints(
        np.zeros((6, 3)), covariance, misfit**2, np.ones(6, int), np.full(6, 2),
        np.where(narrow, 1e-4, 0.5), np.stack([misfit] * 2, 1),
    )  # fmt: skip
    table = SimpleNamespace(views=(), uv=np.zeros((6, 2, 2)), is_used=np.ones((6, 2), bool),
                            intersect=lambda X: found)  # fmt: skip
    lost: Counter[str] = Counter()
    matched = _accept(table, np.zeros((6, 3)), MatchingSettings(), lost)
    assert len(matched.X) == 2
    assert lost == {"undetermined": 1, "narrow angle": 2, "rays do not meet": 1}


@pytest.mark.parametrize("rest", [(0.375, 0.125), (0.25, None)])
def test_an_image_is_shifted_by_what_its_matches_are_beside_their_lines(monkeypatch, rest):
    """By a search in whole pixels, then twice by the rest; where too few match, not at all."""
    true, n = 5.0, 40
    other = SimpleNamespace(shift=(0.0, 2.0))
    base = SimpleNamespace(grey=np.zeros((50, 50)), points=lambda uv, q: np.zeros((n, 3)))
    flat = lambda uv: np.tile([0.0, 1.0], (n, 1))
    shape = SimpleNamespace(other_axis=np.tile([0.0, 2.0], (n, 1)), usable=np.ones(n, bool))
    monkeypatch.setattr(relative, "interest_points", lambda *_: np.zeros((n, 2)))
    monkeypatch.setattr(relative, "visible_range", lambda *_, **options: flat(_))
    monkeypatch.setattr(relative, "windows", lambda *_: shape)

    def search(base, others, *_):
        """More corners correlate the nearer the shift; the lines of sight run along v."""
        near = 1 - abs(-other.shift[0] - true) / n
        return None, np.where(np.arange(n) < near * n, 0.9, 0.1), None

    answers = iter(rest)
    monkeypatch.setattr(relative, "search", search)
    monkeypatch.setattr(relative, "_median_offset", lambda *_: next(answers))
    pyramids = (SimpleNamespace(levels=[0, 0, 0]),) * 2
    found = relative.align(base, other, pyramids, flat)
    if None in rest:
        assert found is None and other.shift == (0.0, 2.0)
    else:
        assert found == pytest.approx(true + sum(rest))
        np.testing.assert_allclose(other.shift, [-found, 2.0])


@pytest.mark.parametrize("likely", [30, 11])
def test_only_corners_that_correlate_say_how_far_an_image_is_shifted(monkeypatch, likely):
    """The others are somewhere; fewer than twelve say nothing."""
    n, across = 80, np.array([0.0, 1.0])
    uv = np.column_stack([np.arange(n), np.zeros(n)]).astype(float)
    rho = np.where(np.arange(n) < likely, 0.9, 0.3)

    def refine(base, other, uv, start, *_):
        off = np.where(uv[:, 0] < likely, 0.5, 9.0)
        good = np.full(len(uv), int(MatchingStatus.CONVERGED))
        return SimpleNamespace(status=good, rho=np.ones(len(uv)), uv=start + off[:, None] * across)

    monkeypatch.setattr(relative, "search", lambda *_: (np.ones(n), rho, None))
    monkeypatch.setattr(relative, "windows", lambda *_: SimpleNamespace(A=None))
    monkeypatch.setattr(relative, "positions", lambda base, other, uv, q: uv[:, None])
    monkeypatch.setattr(relative, "refine", refine)
    base = SimpleNamespace(points=lambda uv, q: None)
    given = base, None, (None, [None]), uv, np.ones((n, 2)), across, relative.AlignmentSettings()
    assert relative._median_offset(*given) == (0.5 if likely == 30 else None)


@pytest.mark.parametrize("side", [-1, 1])
def test_windows_at_the_edge_of_the_other_image_are_not_matched(side):
    """Beyond it there are no grey values; they would be those of the edge."""
    image = SimpleNamespace(grey=np.random.default_rng(0).uniform(size=(60, 60)), size=(60, 60))
    start = np.array([[29.5 + side * 25.0, 30.0]])
    base = np.array([[30.0, 30.0]])
    found = refine(image, image, base, start, np.eye(2)[None], 4)
    assert found.status == int(MatchingStatus.OUTSIDE) and np.isnan(found.rho).all()
    # nor are windows of no shape, as beside the end of the range of a camera
    found = refine(image, image, base, base, np.full((1, 2, 2), np.nan), 4)
    assert found.status == int(MatchingStatus.OUTSIDE) and np.isnan(found.rho).all()


def test_a_piece_with_few_nodes_of_the_guide_is_not_straightened():
    """Four in the corner of an image determine no direction of epipolar lines."""
    nodes = np.zeros(9, int), np.arange(9), np.column_stack([10.0 * np.arange(9), np.zeros(9)])
    guide, window = SimpleNamespace(good_nodes=lambda: nodes), (0, 0, 39, 39)
    found = _match_piece(None, None, guide, None, window, np.zeros((0, 2)), DenseSettings())
    assert found is None
