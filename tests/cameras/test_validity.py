"""Where a distortion formula turns back, in closed form where there is one."""

import numpy as np
import pytest
from camera_cases import each_case
from numpy.testing import assert_allclose

from jaxbundle.cameras import get_model, turning_radius, validity_message

TURN = 1 / np.sqrt(3 * 1e-3)  # 1 + 3·K1·r² = 0


def test_correction_with_K1_alone():
    model, values = get_model("brown"), dict(c=20.0, x0=1.0, y0=-2.0, K1=-1e-3)
    assert_allclose(turning_radius(model, values, 30.0), TURN, rtol=1e-12)
    assert turning_radius(model, values, 18.0) is None
    assert turning_radius(model, {**values, "K1": 1e-3}, 1000.0) is None


def test_distortion_with_K1_alone_turns_at_two_thirds_in_the_measured_image():
    model, values = get_model("brown-projected"), dict(c=20.0, x0=1.0, y0=-2.0, K1=-1e-3)
    assert_allclose(turning_radius(model, values, 30.0), 2 / 3 * TURN, rtol=1e-12)
    assert turning_radius(model, values, 12.0) is None


def test_a_second_coefficient_may_save_the_image():
    """The derivative 1 + 3·K1·r² + 5·K2·r⁴ has no root if (3·K1)² < 20·K2."""
    model = get_model("brown")
    for ratio, turns in ((0.99, True), (1.01, False)):
        values = dict(c=20.0, K1=-1e-3, K2=ratio * 9e-6 / 20)
        assert (turning_radius(model, values, 40.0) is not None) == turns


def test_pixels_and_a_sequence_of_parameters():
    assert_allclose(
        turning_radius(get_model("snavely"), (500.0, -0.2, 0.0), 1000.0),
        2 / 3 * 500 / np.sqrt(0.6),
        rtol=1e-12,
    )


def test_a_pole_far_outside_is_no_turn_inside():
    """The image runs to infinity at the pole of the rational model, and never turns before."""
    values = dict(fx=500.0, fy=500.0, cx=320.0, cy=240.0, k4=-0.5)
    assert turning_radius(get_model("opencv"), values, 400.0) is None


@each_case
def test_the_example_cameras_are_valid_over_their_images(case):
    if case.name in ("equirectangular", "spline-6x5-160"):
        return  # a rectangle of their own, which ends before the half diagonal
    assert turning_radius(case.model, case.values, case.half_diagonal) is None
    assert validity_message("1", case.model, case.values, case.half_diagonal) is None


def test_the_message_is_for_people():
    message = validity_message("nadir", get_model("brown"), dict(c=20.0, K1=-1e-3), 21.6333)
    for part in ("'nadir'", "'brown'", "18.26 mm", "21.63 mm"):
        assert part in message


@pytest.mark.parametrize("x0", [0.0, 4.0])
def test_the_radius_counts_from_the_principal_point(x0):
    radius = turning_radius(get_model("usgs"), dict(c=20.0, x0=x0, K1=-1e-3), 30.0)
    assert_allclose(radius, TURN, rtol=1e-12)
