"""When a growing model is adjusted, and how many points show that images are from one place."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

import jaxbundle
from jaxbundle.orientation import incremental
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
