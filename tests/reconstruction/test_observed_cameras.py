"""What is known of a camera before the adjustment: observed, wherever its start value is."""

from pathlib import Path

import numpy as np
import pytest

import jaxbundle
from jaxbundle.errors import InputError
from jaxbundle.network.tables import Camera
from jaxbundle.photographs.exif import Exif, StatedDistance
from jaxbundle.reconstruction.camera_priors import observed_parameters
from jaxbundle.reconstruction.named import no_named_points
from jaxbundle.reconstruction.network import FurtherData, photograph_network
from jaxbundle.reconstruction.photographs import Cameras, Photograph
from jaxbundle.reconstruction.settings import ReconstructionSettings
from jaxbundle.reconstruction.square_pixels import release
from jaxbundle.reconstruction.starting import _with_distances
from jaxbundle.tiepoints import camera_starts
from jaxbundle.tiepoints.coplanarity import CoplanarityResult
from jaxbundle.tiepoints.track_measurement import Measurements

SIZE = (3000, 2000)
FILE = StatedDistance(2350.0, 117.5, "focal length and sensor")


def network(stated, aspect_sigma=2e-4, lens=(0, 1), positions=None, angle_unit="deg"):
    """Two cameras, whose start values come from matches, with two photographs each."""
    cameras = tuple(
        Camera(id, "opencv", {"fx": 2100.0, "fy": 2100.0, "cx": 1499.5, "cy": 999.5, "k1": 0.05},
               image_size=SIZE) for id in "ab"
    )  # fmt: skip
    photographs = [Photograph(Path(f"{k}.jpg"), f"{k}.jpg", str(k), Exif(SIZE)) for k in range(4)]
    track, image = (x.ravel() for x in np.meshgrid(np.arange(30), np.arange(4)))
    n = len(track)
    xy = np.random.default_rng(0).uniform(0, 2000, (n, 2))
    measured = Measurements(track, image, xy, np.full((n, 2), 0.1), np.zeros(n, int),
                            image == 0, np.zeros((n, 3), np.uint8))  # fmt: skip
    of = Cameras(cameras, (0, 0, 1, 1), stated, False, (), lens)
    further = FurtherData(no_named_points(), positions=positions)
    return photograph_network(photographs, of, measured, further, "part", aspect_sigma,
                              angle_unit)  # fmt: skip


def rows(network):
    found = observed_parameters(network)
    names = zip(found.camera, found.parameter)
    return dict(zip(names, zip(found.value.tolist(), found.sigma.tolist())))


def test_the_file_is_observed_not_the_start_value_from_matches():
    made = network((FILE, None))
    found = rows(made)
    assert made.cameras[0].parameters["fx"] == 2100.0
    assert found["a", "fx"] == (FILE.value, FILE.sigma)
    assert found["b", "fx"] == pytest.approx((2100.0, 0.2 * 2100.0))
    assert found["a", "k1"] == (0.0, 0.3) and found["a", "cx"] == (1499.5, 30.0)
    assert found["a", "fy/fx"] == found["b", "fy/fx"] == (1.0, 2e-4)
    for camera in made.cameras:
        assert {"fx", "fy"} <= {*camera.free} and not camera.sigma and not camera.tie


def test_focal_lengths_of_one_lens_are_tied_only_if_its_pixels_are_square():
    """Then the file states it for both once, not twice."""
    ties = lambda made: next(one for one in made.further if one.TABLE == "ties")
    one = network((FILE, FILE), lens=(0, 0))
    assert "fx" in ties(one).parameter
    assert ("a", "fx") in rows(one) and not {("b", "fx"), ("b", "k1")} & rows(one).keys()
    free = network((FILE, FILE), np.inf, lens=(0, 0))
    assert "fx" not in ties(free).parameter and ("a", "fy/fx") not in rows(free)
    assert {("a", "fx"), ("b", "fx")} <= rows(free).keys()


def test_pixels_that_are_not_square_separate_the_focal_lengths_of_both_formats():
    made = release(network((FILE, FILE), lens=(0, 0)), ["a"])
    (ties,) = (one for one in made.further if one.TABLE == "ties")
    assert set(ties.parameter) == {"k1", "k2", "k3"}
    assert ("a", "fy/fx") not in rows(made) and ("b", "fy/fx") in rows(made)
    # Each is now an unknown of its own, of which the file states the same.
    assert rows(made)["a", "fx"] == rows(made)["b", "fx"] == (FILE.value, FILE.sigma)


def test_another_principal_distance_changes_only_that_of_unknown_cameras():
    found = _with_distances(network((FILE, None)), {"b": 4200.0})
    assert [c.parameters["fx"] for c in found.cameras] == [2100.0, 4200.0]
    assert rows(found)["b", "fx"] == pytest.approx((4200.0, 0.2 * 4200.0))
    assert rows(found)["a", "fx"] == (FILE.value, FILE.sigma)


@pytest.mark.parametrize("told, from_matches, used", [
    (True, 1161.0, 2350.0), (True, 4900.0, 2350.0), (True, 2000.0, 2000.0), (False, 1161.0, 1161.0),
])  # fmt: skip
def test_a_start_from_matches_far_from_the_file_is_not_believed(
    monkeypatch, told, from_matches, used
):
    camera = jaxbundle.Camera("cam", "opencv", {"fx": 2350.0, "fy": 2350.0, "k1": 0.0},
                              image_size=SIZE)  # fmt: skip
    result = lambda camera, *_: CoplanarityResult(camera, 5, 0.3)
    monkeypatch.setattr(camera_starts, "estimate_interior", result)
    monkeypatch.setattr(
        camera_starts, "close_rotations", lambda *_: np.array([np.log(from_matches), -0.2])
    )
    (found,), (said,) = camera_starts.start_cameras([camera], [0], [0], [told], [], [])
    assert found.parameters["fx"] == found.parameters["fy"] == pytest.approx(used)
    assert f"principal distance {from_matches:.0f} px" in said
    if used != from_matches:
        assert found.parameters["k1"] == 0.0
        assert "but 2350 px by the files: that of the files is used" in said


def test_what_nothing_scales_has_no_unit_of_length():
    """Photographs alone show a model of any size; satellite positions are in metres."""
    alone, placed = network((None, None)), network((None, None), positions=(np.eye(4, 3),) * 2)
    assert (alone.object_unit, alone.datum) == ("unit", "inner")
    assert (placed.object_unit, placed.datum) == ("m", "control")


def test_angles_have_the_unit_of_the_settings():
    assert ReconstructionSettings().angle_unit == "deg"
    assert network((FILE, None)).angle_unit == "deg"
    assert network((FILE, None), angle_unit="gon").angle_unit == "gon"
    with pytest.raises(InputError, match="angle_unit.*furlong"):
        ReconstructionSettings(angle_unit="furlong")
