"""Pixels that are not square: what the photographs alone give, and what their halves confirm."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

import jaxbundle
from jaxbundle.network.build import make_further
from jaxbundle.reconstruction.square_pixels import (
    Ratio,
    _halves,
    contradicted_ratios,
    is_replicated,
    release,
    replicated_ratios,
)

FREE = ("fx", "fy", "cx", "cy", "k1")


def photographs(fy=900.0, stretched=(), sigma=2e-4):
    """Ten convergent photographs; the coordinates v of some are stretched by 1.002."""
    true = {"fx": 900.0, "fy": fy, "cx": 500.0, "cy": 400.0, "k1": -0.1}
    network = jaxbundle.simulate(
        jaxbundle.ring_of_stations(10, radius=4.0, height=2.0, roll_every=3),
        jaxbundle.cloud_of_targets(60, 1.5, seed=2),
        jaxbundle.Camera("cam", "opencv", true, FREE, image_size=(1000, 800)),
        noise=0.2, seed=3,
    )  # fmt: skip
    rays = network.observations
    xy = rays.xy.copy()
    rows = np.isin(rays.image, stretched)
    xy[rows, 1] = 400 + 1.002 * (xy[rows, 1] - 400)
    columns = {"camera": ["cam"], "parameter": ["fy/fx"], "value": [1.0], "sigma": [sigma]}
    return network.replace(
        observations=dataclasses.replace(rays, xy=xy),
        further=make_further({"camera_parameters": columns}, 1.0),
    )


@pytest.fixture(scope="module")
def squeezed():
    return jaxbundle.adjust(photographs(fy=903.0))


def test_square_pixels_are_not_contradicted_by_chance():
    result = jaxbundle.adjust(photographs())
    assert contradicted_ratios(result) == {}
    p = result.camera_parameters("cam")
    assert abs(p["fy"] / p["fx"] - 1) < 2e-4


def test_without_an_observed_ratio_nothing_is_contradicted():
    """A calibrated camera has none."""
    network = SimpleNamespace(further=())
    assert contradicted_ratios(SimpleNamespace(problem=SimpleNamespace(network=network))) == {}


@pytest.mark.further
def test_the_ratio_of_the_photographs_alone_is_that_without_the_observation(squeezed):
    (found,) = contradicted_ratios(squeezed).values()
    alone = jaxbundle.adjust(release(photographs(fy=903.0), ["cam"]))
    names, C = alone.camera_covariance("cam")
    p, (x, y) = alone.camera_parameters("cam"), map(names.index, ("fx", "fy"))
    slope = np.zeros(len(names))
    slope[[x, y]] = -p["fy"] / p["fx"] ** 2, 1 / p["fx"]
    sigma = np.sqrt(slope @ C @ slope)
    assert found.deviation == pytest.approx(p["fy"] / p["fx"] - 1, abs=0.05 * sigma)
    assert found.sigma / squeezed.sigma0 == pytest.approx(sigma / alone.sigma0, rel=0.02)
    assert abs(found.deviation - 3 / 900) < 4 * sigma


@pytest.mark.further
def test_both_halves_confirm_pixels_that_are_not_square(squeezed):
    (halves,) = replicated_ratios(squeezed).values()
    assert is_replicated(*halves)
    for half in halves:
        assert abs(half.deviation - 3 / 900) < 4 * half.sigma


@pytest.mark.further
def test_what_only_one_half_of_the_photographs_says_is_not_believed():
    result = jaxbundle.adjust(photographs(stretched=(0, 2, 4, 6, 8)))
    assert set(contradicted_ratios(result)) == {"cam"}
    (halves,) = replicated_ratios(result).values()
    assert not is_replicated(*halves)
    assert halves[0].deviation > 5 * halves[0].sigma and abs(halves[1].deviation) < 1e-3


def test_only_the_focal_lengths_of_released_cameras_are_no_longer_one_unknown():
    """Of a lens in portrait format fy lies along the other axis. Its distortion is one all the
    same, and other lenses are not concerned."""
    given = [("a", "a2", "fx"), ("a", "a2", "k1"), ("b", "b2", "fx")]
    columns = dict(zip(("camera", "other", "parameter"), map(list, zip(*given))))
    observed = {"camera": ["a", "b"], "parameter": ["fy/fx"] * 2, "value": [1.0] * 2,
                "sigma": [2e-4] * 2}  # fmt: skip
    further = make_further({"ties": columns, "camera_parameters": observed}, 1.0)
    left = release(photographs().replace(further=further), ["a2", "a"]).further
    tables = {one.TABLE: one for one in left}
    ties, parameters = tables["ties"], tables["camera_parameters"]
    assert [*zip(ties.camera, ties.other, ties.parameter)] == given[1:]
    assert list(parameters.camera) == ["b"]


@pytest.mark.parametrize("camera", [[0, 1] * 6, [0] * 7 + [1] * 5, [0, 1, 2, 2, 1, 0] * 2])
def test_every_camera_is_in_both_halves(camera):
    """Also cameras that alternate in the order of the files."""
    halves = _halves(np.array(camera))
    np.testing.assert_array_equal(halves[0], ~halves[1])
    for c in set(camera):
        in_halves = [int((half & (np.array(camera) == c)).sum()) for half in halves]
        assert abs(in_halves[0] - in_halves[1]) <= 1


@pytest.mark.parametrize("one, other, confirmed", [
    ((2e-3, 1e-4), (1.5e-3, 1e-4), True),
    ((2e-3, 1e-4), (9e-4, 1e-4), False),  # farther apart than one is from 1
    ((2e-3, 1e-4), (-2e-3, 1e-4), False),
    ((2e-3, 1e-3), (1.5e-3, 1e-4), False),
])  # fmt: skip
def test_halves_must_agree(one, other, confirmed):
    assert is_replicated(Ratio(*one), Ratio(*other)) == confirmed


@pytest.mark.further
def test_six_photographs_have_no_halves():
    network = photographs(fy=903.0)
    fewer = network.images.take(np.arange(6))
    rays = network.observations.take(network.observations.image < 6)
    result = jaxbundle.adjust(network.replace(images=fewer, observations=rays))
    assert contradicted_ratios(result) and replicated_ratios(result) == {}
