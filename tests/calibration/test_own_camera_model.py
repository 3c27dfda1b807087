"""`calibrate` and `calibrate_batch` with a user's own camera model."""

import json

import board_photographs as taken
import jax.numpy as jnp
import numpy as np
import pytest
from test_calibrate import TRUTH, VIEWS, normalised, simulated
from test_rig import pair

from jaxbundle import CameraModel
from jaxbundle.batches.calibrate import calibrate_batch
from jaxbundle.calibration import calibrate, calibrate_rig
from jaxbundle.calibration.files import json_text
from jaxbundle.calibration.rig.report import rig_dict, rig_text
from jaxbundle.calibration.start import start_values
from jaxbundle.cameras import opencv
from jaxbundle.errors import InputError

NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
AGAIN = CameraModel(
    "again", NAMES, distort=lambda p, x, y: opencv.distort((*p, *[0.0] * 7), x, y), unit="px"
)


@pytest.mark.further
def test_opencv_said_again_has_the_figures_of_opencv():
    """By `calibrate_batch`; and `calibrate`, whose start is of another model, finds the same."""
    views = simulated()
    ours, batch = (
        calibrate_batch(taken.BOARD.points, views.xy[None], views.image_size, model=model)
        for model in ("opencv", AGAIN)
    )
    assert batch.converged.all() and batch.model is AGAIN
    assert "model again: 1 converged" in str(batch)
    np.testing.assert_allclose(batch.values, ours.values, atol=1e-6 * ours.sigma.min())
    np.testing.assert_allclose(batch.sigma, ours.sigma, rtol=1e-9)
    one = calibrate(views, model=AGAIN, snooping=None, cross_validation=False)
    assert one.rms == pytest.approx(ours.rms[0], rel=1e-6) and one.camera.model is AGAIN
    assert max(map(abs, normalised(one, dict(zip(NAMES, ours.values[0]))).values())) < 1e-3
    np.testing.assert_allclose(list(one.sigma.values()), ours.sigma[0], rtol=1e-5)
    assert max(map(abs, normalised(one, TRUTH).values())) < 3
    document = json.loads(json_text(one.to_dict(brief=True)))
    assert document["cameras"]["cam"]["model"] == "again"


@pytest.mark.further
def test_a_rig_of_such_cameras():
    """The same mounting as with `opencv`."""
    found = []
    for model in ("opencv", AGAIN):
        alone = {
            name: calibrate(views, model=model, free=NAMES, snooping=None, cross_validation=False)
            for name, views in pair().items()
        }
        found.append(calibrate_rig(alone, snooping=None))
    ours, again = found
    assert again.rms == pytest.approx(ours.rms, rel=1e-7)
    assert "Camera left" in rig_text(again) and rig_dict(again)["rms"] == again.rms


def division(p, x, y):
    c, x0, y0, L = p
    r2 = (x - x0) ** 2 + (y - y0) ** 2
    return (x - x0) / (1 + L * r2), (y - y0) / (1 + L * r2)


def unified(p, r, s, q):
    f, cx, cy, alpha = p
    N = alpha * jnp.sqrt(r * r + s * s + q * q) - (1 - alpha) * q
    return cx + f * r / N, cy - f * s / N


@pytest.mark.further
def test_start_values_of_any_formula():
    """Nothing of the formula is known but its images: a fit to those of `opencv`, or of
    `kannala-brandt`."""
    views = simulated()
    model = CameraModel("division-mm", ("c", "x0", "y0", "L"), correct=division)
    found = start_values(views, model, model.free, (0.01, 0.01)).parameters
    assert found["c"] == pytest.approx(0.01 * TRUTH["fx"], rel=0.01)
    assert found["x0"] == pytest.approx(0.01 * (TRUTH["cx"] - 239.5), abs=0.03)
    assert found["L"] * found["c"] ** 2 == pytest.approx(TRUTH["k1"], abs=0.02)
    model = CameraModel("unified", ("f", "cx", "cy", "alpha"), project=unified, unit="px",
                        image="equidistant", defaults={"alpha": 0.5})  # fmt: skip
    found = start_values(views, model, model.free).parameters
    assert found["f"] == pytest.approx(TRUTH["fx"], rel=0.02)
    assert len(views) == VIEWS


def test_what_is_refused():
    views = simulated()
    model = CameraModel("division-mm", ("c", "x0", "y0", "L"), correct=division)
    with pytest.raises(InputError, match="model 'division-mm' is in mm; calibrate_batch needs"):
        calibrate_batch(taken.BOARD.points, views.xy[None], (480, 360), model=model)
    with pytest.raises(InputError, match="'wrong': distort.*must take the parameters"):
        calibrate(views, model=CameraModel("wrong", ("f",), distort=lambda x: x, unit="px"))
    with pytest.raises(InputError, match="'opencv' is built in"):
        calibrate(views, model=CameraModel("opencv", NAMES, distort=opencv.distort, unit="px"))
    with pytest.raises(InputError, match="model 'again' has no free parameter 'k9'"):
        calibrate(views, model=AGAIN, free=["k9"])
