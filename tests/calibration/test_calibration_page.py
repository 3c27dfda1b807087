"""The page of a calibration where there is little to draw."""

import warnings

import numpy as np
import pytest

from jaxbundle.adjustment.quality.correlated_errors import CorrelationSettings
from jaxbundle.calibration import calibrate
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


@pytest.mark.further
def test_views_are_compared_in_halves_without_being_asked(calibration):
    """Twelve views of a rendered board: its first lines have the factor, its σ are the larger."""
    halves = calibration.adjustment.replication
    assert halves.by == "views" and halves.dof == len(calibration.sigma)
    # nine parameters, errors of rendering and corners alone: χ² of 9 is below 27.9 with 99.9 %
    assert halves.d2_correlated < 27.9
    assert halves.sentence in str(calibration)
    told = calibration.to_dict(brief=True)
    assert told["replication"]["d2"] == pytest.approx(halves.d2)
    for name, sigma in calibration.stated_sigma.items():
        entry = told["cameras"][calibration.name]["parameters"][name]
        assert sigma == max(entry["sigma"], entry["sigma_correlated"])
    page = "".join(compose_calibration(calibration))
    assert halves.sentence in page.partition("<nav>")[0] and "affine by photograph" in page


@pytest.mark.further
def test_halves_are_not_made_of_few_views_or_if_turned_off(calibration):
    plain = calibrate(calibration.views, correlated=False).adjustment
    assert plain.replication is None and plain.error_model is None
    assert "Replication" not in plain.report() and "replication" not in plain.to_dict(brief=True)
    more_than_there_are = CorrelationSettings(min_images=13)
    assert plain.with_correlated_errors("views", more_than_there_are) is plain
