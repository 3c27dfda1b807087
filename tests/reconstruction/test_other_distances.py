"""Principal distances that are tried when the first fails."""

import dataclasses
from types import SimpleNamespace

import numpy as np

from jaxbundle import Camera
from jaxbundle.network.build import make_further
from jaxbundle.reconstruction import starting


def test_other_distances_of_cameras_that_files_do_not_tell(monkeypatch):
    """Relative to the longer side, for all guessed cameras at once; not the present one again."""
    monkeypatch.setattr(starting, "_with_distances", lambda network, distances: distances)
    settings = starting.BlockStartSettings(other_distances=(0.8, 1.2, 2.0), distinct_ratio=1.1)
    camera = lambda id, f, size: Camera(id, "opencv", {"fx": f, "fy": f}, image_size=size)
    network = SimpleNamespace(cameras=[
        camera("a", 1200.0, (1000, 700)), camera("b", 2400.0, (1400, 2000)),
        camera("told", 900.0, (1000, 700)), camera("without size", 900.0, None),
    ])  # fmt: skip
    found = list(starting._try_other_distances(network, ["a", "b", "without size"], settings))
    expected = [{"a": 800.0, "b": 1600.0}, {"a": 2000.0, "b": 4000.0}]
    assert [one.keys() for one in found] == [one.keys() for one in expected]
    for one, distances in zip(found, expected, strict=True):
        np.testing.assert_allclose([*one.values()], [*distances.values()])
    assert list(starting._try_other_distances(network, [], settings)) == []


def test_the_observed_principal_distance_moves_with_its_start_value():
    """With the same relative σ; the ratio of the axes of a pixel, observed too, remains 1."""
    camera = lambda id: Camera(id, "opencv", {"fx": 1000.0, "fy": 1000.0, "k1": 0.1})
    columns = {"camera": ["a", "a", "b"], "parameter": ["fx", "fy/fx", "fx"],
               "value": [1000.0, 1.0, 1000.0], "sigma": [50.0, 2e-4, 50.0]}  # fmt: skip
    given = (*make_further({"camera_parameters": columns}, 1.0),)
    network = dataclasses.make_dataclass("Network", ["cameras", "further"], namespace={
        "replace": lambda self, **changed: dataclasses.replace(self, **changed)
    })((camera("a"), camera("b")), given)  # fmt: skip
    found = starting._with_distances(network, {"a": 1600.0})
    assert [c.parameters["fx"] for c in found.cameras] == [1600.0, 1000.0]
    (observed,) = found.further
    np.testing.assert_allclose(observed.value, [1600.0, 1.0, 1000.0])
    np.testing.assert_allclose(observed.sigma, [80.0, 2e-4, 50.0])


SIDE = 4000


def adjusted_to(f, start):
    """An adjustment from and to principal distances in longer sides."""
    camera = Camera("c", "opencv", {"fx": start * SIDE, "fy": start * SIDE},
                    image_size=(3000, SIDE))  # fmt: skip
    parameters = {"fx": {"value": f * SIDE}}
    return SimpleNamespace(
        converged=True, network=SimpleNamespace(cameras=(camera,)),
        cameras={"c": {"parameters": parameters}},
    )  # fmt: skip


def test_a_stated_principal_distance_is_plausible_of_any_lens():
    """600 mm of full frame are 17 longer sides, a fisheye in the plane 0.2: as stated, or a tenth
    off, whatever the adjustment began with; not if nothing is known of the lens, nor where
    adjustments end that fail."""
    plausible = lambda stated, ratio, start=1.0: starting.is_plausible(
        adjusted_to(ratio * stated, start * stated), {"c": stated * SIDE}
    )
    for stated in (0.2, 1.0, 17.0):
        assert plausible(stated, 1.0) and plausible(stated, 1.1) and plausible(stated, 0.9)
        assert plausible(stated, 1.4, 0.7) and plausible(stated, 1.6, 1.3) == (stated == 1.0)
        assert starting.is_plausible(adjusted_to(stated, stated), {}) == (stated == 1.0)
        assert not any(plausible(stated, ratio) for ratio in (0.0, 1e-4, 1e4, np.inf, np.nan))
