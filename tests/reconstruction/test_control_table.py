"""What a report says about control and its σ."""

from types import SimpleNamespace

import numpy as np
import pytest

from jaxbundle.reconstruction.control_table import (
    ControlMeasurement,
    ControlPoint,
    describe_sigma,
)


@pytest.mark.parametrize("factor", [1.0, 2.5])
def test_stated_sigma_that_points_contradict_are_multiplied_and_it_is_said(factor):
    given = np.array([[0.01, 0.01, 0.02], [0.01, 0.01, 0.03]])
    said = describe_sigma(given, SimpleNamespace(factor=factor), (), "m", 2.0)
    assert said.startswith("σ of control as stated (0.010 to 0.030 m)")
    assert ("multiplied by 2.5" in said) == (factor > 1)


def test_sigma_of_one_axis_alone_is_described_with_the_assumed_pixels():
    """Of a table with sX and sZ, without sY."""
    given = np.array([[0.01, np.nan, 0.02]] * 3)
    assessed = SimpleNamespace(
        factor=1.0, sigma=np.array([[0.01, 0.3, 0.02]] * 3), redundancy=(0.0, 0.0),
        assumed=(True, False),
    )  # fmt: skip
    said = describe_sigma(given, assessed, (), "m", 1.5)
    assert "control without σ: 0.30 m in the plane, assumed, 1.5 pixels on the ground" in said
    assert "in height" not in said


def test_the_name_of_a_wrong_measurement_is_no_part_of_a_longer_one():
    """11.jpg ends with 1.jpg; 2.jpg is wrong, too."""
    names = ("1.jpg", "11.jpg", "2.jpg")
    unknown = np.full(3, np.nan)
    verdict = "used: 11.jpg is a wrong measurement and not used; 2.jpg is a wrong measurement"
    point = ControlPoint(
        "A", "control", True, 2, unknown, unknown, unknown, 0.1, verdict, unknown, unknown,
        tuple(ControlMeasurement(name, False, None, None) for name in names),
    )  # fmt: skip
    assert point.wrong_measurements == ["11.jpg", "2.jpg"]
