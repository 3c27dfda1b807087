"""Numbers in the wrong unit are told with the likely unit; what may be right is let through."""

import dataclasses
import re

import numpy as np
import pytest

import jaxbundle
from jaxbundle import Camera, InputError, grid_of_targets, ring_of_stations, simulate
from jaxbundle.network.check import check_tables
from jaxbundle.network.units import ANGLE_UNITS
from jaxbundle.orientation.angle_units import name_angle_unit

PIXEL = {"image_size": (6000, 4000), "pixel_size": (0.006, 0.006)}
CONTROL = {"control": (0, 4, 20, 24), "control_sigma": 0.002}
TARGETS = grid_of_targets(5, 5, 0.5, relief=0.2)
RING = ring_of_stations(4, 3.0, 2.5, roll_every=2)


def network(c=24.0, **options):
    camera = Camera("cam", "brown", {"c": c}, **PIXEL)
    return simulate(RING, TARGETS, camera, noise=0.002, disturb=0.005, **options)


def with_camera(given, **changed):
    return given.replace(cameras=(dataclasses.replace(given.cameras[0], **changed),))


def measured(given, factor):
    rays = given.observations
    return given.replace(observations=dataclasses.replace(rays, xy=rays.xy * factor))


def placed(given, factor, *roles):
    points = given.points
    rows = points.has_role(*roles)[:, None]
    X = np.where(rows, points.position * factor, points.position)
    return given.replace(points=dataclasses.replace(points, position=X))


@pytest.mark.parametrize(
    "mistake, said",
    [
        (lambda n: with_camera(n, parameters={"c": 0.024}), r"in metres\? .* in mm \(24\)"),
        (lambda n: measured(n, 1 / 0.006), "pixels\\? Set image_unit"),
        (
            lambda n: measured(with_camera(n, pixel_size=(6.0, 6.0)), 1000),
            r"pixel_size 6 in µm\? .*\(0.006\)",
        ),
        (
            lambda n: measured(
                with_camera(n, model="opencv", parameters={"fx": 24.0, "fy": 24.0}), 1 / 0.006
            ),
            "Is fx in mm",
        ),
    ],
    ids=["c in metres", "pixels", "pixel size in µm", "fx in mm"],
)
def test_a_field_no_lens_has_is_refused_with_the_likely_unit(mistake, said):
    with pytest.raises(InputError, match=said) as error:
        jaxbundle.orient(mistake(network()))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "mistake, said",
    [
        (
            lambda n: measured(with_camera(n, pixel_size=(6e-6, 6e-6)), 0.001),
            "pixel_size is 6e-06 mm.*metres.*0.006",
        ),
        (lambda n: placed(n, 1000.0, "control"), "is one of them in mm, the other in m"),
        (lambda n: placed(n, 0.001, "control"), "is one of them in mm, the other in m"),
        (
            lambda n: n.replace(
                distances=dataclasses.replace(n.distances, value=1000 * n.distances.value)
            ),
            "'1 to 5'; are they in m, as the control points",
        ),
    ],
    ids=["pixel size in metres", "control in mm", "start values in mm", "distance in mm"],
)
def test_a_thousandfold_is_warned_of(mistake, said):
    given = network(**CONTROL, distances=[(0, 4)])
    assert check_tables(given).warnings == ()
    line, *_ = check_tables(mistake(given)).warnings  # control in mm contradicts distances too
    assert re.search(said, line)


@pytest.mark.parametrize("field", [1e-5, 1e-3, 0.7, 3.0])
@pytest.mark.parametrize("model", ["brown", "kannala-brandt"])
def test_long_lenses_microscopes_and_fisheyes_pass(field, model):
    """Half of the points at r/c: from a telescope to the edge of an equidistant fisheye, 180°."""
    given = network()
    usual = np.median(np.hypot(*given.observations.xy.T))
    c = usual / field
    parameters = {"c": c} if model == "brown" else {"fx": c, "fy": c}
    given = with_camera(given, model=model, parameters=parameters)
    assert check_tables(given).warnings == ()


def test_blunders_are_no_unit():
    given = network()
    xy = given.observations.xy.copy()
    xy[::3] = 1e5
    rays = dataclasses.replace(given.observations, xy=xy)
    assert check_tables(given.replace(observations=rays)).warnings == ()


@pytest.mark.parametrize("right, wrong", [("deg", "gon"), ("gon", "deg"), ("rad", "deg")])
def test_angles_in_another_unit_are_told(right, wrong):
    given = network()
    assert name_angle_unit(given.replace(angle_unit=right)) == ""
    angles = given.images.angles * ANGLE_UNITS[wrong] / ANGLE_UNITS[right]
    mistaken = given.replace(
        images=dataclasses.replace(given.images, angles=angles), angle_unit=wrong
    )
    assert f'set angle_unit = "{right}"' in name_angle_unit(mistaken)
