"""When a growing model is adjusted, and how many points show that images are from one place."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

import jaxbundle
from jaxbundle.network.tables import Points
from jaxbundle.orientation import incremental
from jaxbundle.orientation import network as start_values
from jaxbundle.orientation.one_place import name_one_place
from jaxbundle.orientation.settings import DEFAULTS
from jaxbundle.planning.stations import Stations

CAMERA = jaxbundle.Camera("cam", "brown", {"c": 100.0})


def test_a_growing_model_is_adjusted_whenever_it_has_grown_by_a_factor(monkeypatch):
    """A strip that grows image by image, each with four points of the one before: adjusted with 5
    images, and whenever there are 2.5 times as many."""
    image, point = np.repeat(np.arange(80), 8), (4 * np.arange(80)[:, None] + np.arange(8)).ravel()
    strip = SimpleNamespace(image=image, point=point, images=80)
    model = SimpleNamespace(placed=np.arange(80) < 1, known=np.arange(324) < 8)

    def place(sights, model, chosen, settings):
        model.placed[chosen] = True
        model.known[point[np.isin(image, chosen)]] = True
        return True

    monkeypatch.setattr(incremental, "_place_images", place)
    monkeypatch.setattr(incremental, "intersect", lambda *_: None)
    sizes = []
    settings = dataclasses.replace(DEFAULTS, first_improvement=5)
    improve = lambda strip, model: sizes.append(int(model.placed.sum()))
    incremental.grow(strip, model, improve=improve, settings=settings)
    assert model.placed.all() and sizes == [5, 13, 33]


@pytest.mark.parametrize("common", [4, 5])
def test_one_place_is_shown_by_five_points(common):
    """A rotation has three parameters: of fewer points, too few coordinates are left to test it."""
    stations = Stations(np.zeros((2, 3)), np.array([[0.0, 0.0, 0.0], [0.1, 0.05, 0.3]]))
    xy = np.array([[-3, -2], [3, -2], [3, 2], [-3, 2], [0, 1.0], [1, 0], [2, 1]])
    targets = np.column_stack([xy, np.full(len(xy), -20.0)])
    network = jaxbundle.simulate(stations, targets, CAMERA, noise=0.001, seed=1, datum="inner")
    rays = network.observations
    keep = (rays.image == 0) | (rays.point < common)
    network = network.replace(observations=rays.take(keep))
    assert bool(name_one_place(network)) == (common == 5)


def test_control_is_a_start_value_if_it_is_as_exact_as_start_values():
    """Handheld control, which is not, is intersected like a tie point; fixed points have no σ."""
    weak = 10.0 / DEFAULTS.extent_to_misfit * np.array([0.0, 0.9, 1.1, 0.0])
    sigma = np.stack([np.full(4, 0.01), weak, np.full(4, 0.01)], 1)
    X = np.array([[0, 0, 0], [10, 0, 0], [0, 5, 0], [5, 5, 1.0]])
    sigma[3] = np.nan
    points = Points(tuple("abcd"), ("control", "control", "control", "fixed"), X, sigma)
    assert incremental.are_held(points).tolist() == [True, True, False, True]


def test_points_of_parallel_rays_are_far_away_in_their_direction():
    """The others, whose rays do not intersect yet, stay unknown."""
    X0 = np.array([[-1.0, 0, 0], [0, 0, 0], [1, 0, 0]])
    down = np.array([0.0, 0, -1])
    near = np.array([0.5, 1.0, -4.0]) - X0
    near /= np.linalg.norm(near, axis=1, keepdims=True)
    seen = SimpleNamespace(
        image=np.tile(np.arange(3), 2), point=np.repeat([0, 1], 3), points=4,
        ray=np.concatenate([np.tile(down, (3, 1)), near]),
    )  # fmt: skip
    model = incremental.Model(
        X0, np.tile(np.eye(3), (3, 1, 1)), np.ones(3, bool), np.zeros((4, 3)),
        np.array([False, False, True, True]), np.zeros(4, bool),
    )  # fmt: skip
    incremental.place_far_points(seen, model)
    assert model.known.tolist() == [True, False, True, True]
    spread = np.sqrt(2 / 3)  # of the stations, about their mean at the origin
    np.testing.assert_allclose(model.X[0], DEFAULTS.far_distance * spread * down)


def test_only_rays_that_another_one_checks_count(monkeypatch):
    """The only ray of a point may be anything, and meets it."""
    seen = SimpleNamespace(
        image=np.array([0, 1, 1, 2]), point=np.array([0, 0, 1, 0]), images=3, points=2,
        tolerance=np.ones(3),
    )  # fmt: skip
    model = SimpleNamespace(control=np.zeros(2, bool), placed=np.array([True, True, False]))
    monkeypatch.setattr(start_values, "misclosures", lambda *_: np.array([0.0, 0.0, 5.0, 0.0]))
    number, share = start_values._count_agreeing(seen, model)
    assert number == 2 and share.tolist() == [1.0, 1.0, 0.0]


@pytest.mark.parametrize("placed, again", [(2, False), (3, True), (5, True)])
def test_an_image_that_few_rays_agree_with_is_placed_again(monkeypatch, placed, again):
    """If two others check its points."""
    share = np.append(np.ones(placed - 1), 0.1 * DEFAULTS.doubtful_share)
    rays = iter([10, 12])
    monkeypatch.setattr(start_values, "_count_agreeing", lambda *_: (next(rays), share))
    monkeypatch.setattr(start_values, "_have_poses", lambda _: np.zeros(placed, bool))
    for name in ("grow", "finish"):
        monkeypatch.setattr(start_values, name, lambda *_, **options: None)
    better = SimpleNamespace(placed=np.ones(placed, bool))
    removed = []
    model = SimpleNamespace(
        placed=np.ones(placed, bool), copy_without=lambda rows: removed.append(rows) or better
    )
    found = start_values._place_doubtful_again(None, None, model, None, DEFAULTS)
    assert found is (better if again else model)
    assert [rows.tolist() for rows in removed] == [[False] * (placed - 1) + [True]] * again


@pytest.mark.parametrize("oriented", [True, False])
def test_a_pair_continues_an_oriented_part_only_if_it_can_be_joined_to_it(monkeypatch, oriented):
    """However many rays agree with the model that grows from it."""
    seen = SimpleNamespace(
        image=np.array([0, 1, 1, 2, 2, 2]), point=np.zeros(6, int), images=3, points=1,
        tolerance=np.ones(3),
    )  # fmt: skip
    model = incremental.Model.empty(seen)
    model.placed[0] = oriented
    grown = []

    def misclosures(seen, part):  # first all rays agree, then those of one image
        grown.append(part)
        return np.where((len(grown) == 1) | (seen.image == 1), 0.0, 9.0)

    pairs = [(1, 2, np.eye(3), np.eye(3), np.array([1.0, 0, 0]))] * 2
    monkeypatch.setattr(start_values, "good_pairs", lambda *_: pairs)
    monkeypatch.setattr(start_values, "grow", lambda *_: None)
    monkeypatch.setattr(start_values, "misclosures", misclosures)
    monkeypatch.setattr(
        start_values, "join", lambda _, seen, model, part: None if part is grown[0] else model
    )
    found = start_values._grow_from_a_pair(None, seen, model, None, DEFAULTS)
    assert found is grown[1 if oriented else 0]


@pytest.mark.parametrize("missed, exchange, told", [
    (1, "", ""), (2, "", "the control points 'a', 'b' contradict"),
    (2, "'a' and 'b' are exchanged", "'a' and 'b' are exchanged"),
])  # fmt: skip
def test_control_that_rays_miss_is_suspect_if_no_datum_is_left_without_it(
    monkeypatch, missed, exchange, told
):
    """Of five control points one is in no image: with one missed, three are left, which give a
    datum; with two, only two. An exchange that explains it is told instead."""
    n = 5
    X = np.array([[0, 0, 0], [10, 0, 0], [0, 10, 0], [5, 5, 1], [2, 3, 0.0]])
    points = Points(tuple("abcde"), ("control",) * n, X, np.full((n, 3), 0.01))
    point = np.repeat(np.arange(n - 1), 2)
    seen = SimpleNamespace(image=np.tile([0, 1], n - 1), point=point, images=2, points=n)
    model = SimpleNamespace(placed=np.ones(2, bool))
    network = SimpleNamespace(points=points, further=(), warn=lambda said: said)
    result = start_values.Oriented(network, "in the frame given", {}, {}, ())
    for name, found in {
        "check_tables": network, "make_sights": seen, "_orient": (model, ""), "_result": result,
        "_are_gross": point < missed, "name_contradiction": exchange, "_control_contradicts": False,
    }.items():  # fmt: skip
        monkeypatch.setattr(start_values, name, lambda *_, found=found, **options: found)
    finding = start_values.find_start_values(network).finding
    assert told in finding and bool(told) == bool(finding)
