"""Which images form pairs: by overlap and angle of intersection, known for two vertical ones."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from jaxbundle.errors import InputError
from jaxbundle.surfaces import matching
from jaxbundle.surfaces.bounds import bounds_from_points
from jaxbundle.surfaces.pairs import choose_partners, parse_partners, score
from jaxbundle.surfaces.reconstruct import ground_bounds
from jaxbundle.surfaces.scanner_views import RpcView

HEIGHT = 100.0


@dataclasses.dataclass
class Vertical:
    """A vertical image of 200 × 200 pixels with q = Z, from a height of 100 m, with pixels of 1 m
    on the ground."""

    x: float
    size: tuple[int, int] = (201, 201)

    def points(self, uv, q):
        away = (HEIGHT - q)[:, None] / HEIGHT
        return np.column_stack([(uv - 100) * away + [self.x, 0], q])

    def project(self, X):
        return (X[:, :2] - [self.x, 0]) * (HEIGHT / (HEIGHT - X[:, 2]))[:, None] + 100

    def parameter(self, X):
        return X[:, 2]

    def derivative(self, X):
        away = HEIGHT - X[:, 2]
        along = np.zeros((len(X), 2, 3))
        along[:, 0, 0] = along[:, 1, 1] = HEIGHT / away
        along[:, :, 2] = (X[:, :2] - [self.x, 0]) * (HEIGHT / away**2)[:, None]
        return along


@pytest.mark.parametrize("base", [0.1, 10.0, 25.0, 60.0, 150.0])
def test_the_score_is_overlap_times_the_weight_of_the_angle(base):
    """Of 9 × 9 points between 0.05 and 0.95 of the sides, on flat ground: the weight grows up to
    14° and falls from 28° to 0 at 60°; less than 1° is no pair."""
    flat = lambda uv: np.zeros((len(uv), 2))
    x = np.linspace(-90, 90, 9)
    x = x[x - base >= -100]
    y = np.linspace(-90, 90, 9)[:, None]
    d, f = (np.stack(np.broadcast_arrays(x - b, y, -HEIGHT), -1) for b in (0.0, base))
    cosine = (d * f).sum(-1) / np.linalg.norm(d, axis=-1) / np.linalg.norm(f, axis=-1)
    angle = np.degrees(np.median(np.arccos(np.clip(cosine, -1, 1))))
    worth = min(angle / 14, 1) * min((60 - angle) / 32, 1) if 1 <= angle <= 60 else 0.0
    assert score(Vertical(0.0), flat, Vertical(base)) == pytest.approx(len(x) / 9 * worth)


def test_of_depths_the_best_counts_and_images_far_apart_are_no_pair():
    hills = lambda uv: np.tile([-400.0, 60.0], (len(uv), 1))
    flat = lambda uv: np.full((len(uv), 2), -55.0)  # the middle of the three depths
    at_depths = [score(Vertical(0.0), lambda uv, q=q: np.full((len(uv), 2), q), Vertical(60.0))
                 for q in (-285.0, -170.0, -55.0)]  # fmt: skip
    assert score(Vertical(0.0), hills, Vertical(60.0)) == max(at_depths) > min(at_depths)
    assert score(Vertical(0.0), flat, Vertical(300.0)) == 0.0


def test_partners_are_the_images_that_overlap_the_best_first():
    """At most so many; one without any is not in the list, and is not matched in vain."""
    views = [Vertical(x) for x in (0.0, 10.0, 25.0, 1000.0)]
    flat = [lambda uv: np.zeros((len(uv), 2))] * 4
    found = choose_partners(views, flat)
    assert found.keys() == {0, 1, 2} and found[0] == [2, 1] and set(found[2]) == {0, 1}
    assert choose_partners(views, flat, max_partners=1)[0] == [2]


def test_bounds_need_five_points():
    """They lie within them with a margin; fewer tell little of the range of a surface."""
    X = np.column_stack([np.zeros((5, 2)), np.linspace(10, 20, 5)])
    low, high = bounds_from_points(Vertical(0.0), X)
    assert 0 < low < 10 and high > 20
    assert bounds_from_points(Vertical(0.0), X[:4]) is None
    outside = np.concatenate([X[:4], [[500.0, 0.0, 10.0]]])
    assert bounds_from_points(Vertical(0.0), outside) is None


def test_the_scatter_of_points_in_one_column_of_the_grid(monkeypatch):
    """Of a narrow overlap: the step of the grid along the image is not known then."""
    n, shapes = 9, []
    monkeypatch.setattr(matching, "missing_sigma", lambda q, *_: shapes.append(q.shape))
    X = np.column_stack([np.zeros(n), np.arange(n), np.zeros(n)])
    uv = np.repeat(Vertical(0.0).project(X)[:, None], 2, axis=1)
    table = SimpleNamespace(
        views=(Vertical(0.0), Vertical(25.0)), uv=uv, is_used=np.ones((n, 2), bool)
    )
    found = SimpleNamespace(covariance=np.tile(np.eye(3), (n, 1, 1)), X=X)
    settings = dataclasses.replace(matching.MatchingSettings(), block_side=3)
    assert matching._shape_variance(table, found, 0.5, settings) is None
    assert shapes == [(n, 1)]


def test_pairs_are_given_by_names_the_base_first():
    names = ["a.jpg", "b.jpg", "c.jpg"]
    found = parse_partners(["b.jpg, a.jpg", "a.jpg,b.jpg,c.jpg", "b.jpg,c.jpg,a.jpg"], names)
    assert found == {1: [0, 2], 0: [1, 2]}


@pytest.mark.parametrize("text, said", [
    ("a.jpg", "BASE,OTHER"), (" , ", "BASE,OTHER"),
    ("a.jpg,d.jpg", "no image 'd.jpg'"), ("a.jpg,b.jpg,a.jpg", "cannot be matched with itself"),
])  # fmt: skip
def test_pairs_that_are_none_are_refused(text, said):
    with pytest.raises(InputError, match=said):
        parse_partners([text], ["a.jpg", "b.jpg"])


def test_bounds_of_satellite_images_are_given_or_those_of_their_coefficients():
    """Heights that all of them have; a line scanner has no range of its own."""
    rpc = [object.__new__(RpcView) for _ in range(2)]
    for view, middle in zip(rpc, (200.0, 230.0)):
        view.rpc = SimpleNamespace(height_offset=middle, height_scale=100.0)
    scanner = Vertical(0.0)
    found, said = ground_bounds([scanner, *rpc], None)
    assert "heights from 130 to 300 are searched" in said[0] and len(found) == 3
    assert [bounds.q for bounds in found] == [(130.0, 300.0)] * 3
    assert ground_bounds([scanner], (0.0, 9.0))[1] == ()
    with pytest.raises(InputError, match="line scanner images need --zmin and --zmax"):
        ground_bounds([scanner], None)
