"""What a report says about the σ of control."""

from types import SimpleNamespace

import numpy as np
import pytest

from jaxbundle.reconstruction.control_table import describe_sigma


@pytest.mark.parametrize("factor", [1.0, 2.5])
def test_stated_sigma_that_points_contradict_are_multiplied_and_it_is_said(factor):
    given = np.array([[0.01, 0.01, 0.02], [0.01, 0.01, 0.03]])
    said = describe_sigma(given, SimpleNamespace(factor=factor), (), "m")
    assert said.startswith("σ of control as stated (0.010 to 0.030 m)")
    assert ("multiplied by 2.5" in said) == (factor > 1)
