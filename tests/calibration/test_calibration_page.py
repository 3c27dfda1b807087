"""The page of a calibration where there is little to draw."""

import warnings

import numpy as np
import pytest

from jaxbundle.calibration.page import compose_calibration
from jaxbundle.calibration.result import Calibration

EXACT = "The measurements fit exactly: σ of a projected point is 0."


@pytest.mark.further
@pytest.mark.parametrize("middle, corners, drawn", [
    ([0, 0, 0], [0, 0, 0], []),
    ([0, 0, 0], [np.nan, np.nan, np.nan], []),
    ([0.1, 0.2, 0.3], [np.nan, np.nan, np.nan], ["middle of the image"]),
    ([0.0, 0.2, 0.3], [0.1, np.nan, 0.4], ["middle of the image", "worst corner"]),
])  # fmt: skip
def test_what_has_no_logarithm_is_not_drawn(calibration, monkeypatch, middle, corners, drawn):
    distances = np.array([1.0, 2.0, 4.0])
    curves = (distances, np.array(middle, float), np.array(corners, float), np.ones((3, 1)))
    monkeypatch.setattr(Calibration, "uncertainty_curves", lambda self: curves)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        text = "".join(compose_calibration(calibration))
    assert (EXACT in text) == (not drawn)
    for name in ("middle of the image", "worst corner"):
        assert (f"</svg>{name}</span>" in text) == (name in drawn)
