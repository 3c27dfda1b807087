"""The mean distance of image points from the images of their points at the start values."""

import numpy as np
import pytest

from jaxbundle.network.build import make_network
from jaxbundle.network.reprojection import point_errors

MM = {"id": "metric", "c": 100.0, "pixel_size": [0.005, 0.005], "image_size": [4001, 4001]}
FILM = {"id": "analogue", "c": 100.0}
PX = {"id": "digital", "model": "opencv", "pixel_size": [0.005, 0.005], "image_size": [4001, 4001],
      "fx": 20000.0, "fy": 20000.0, "cx": 2000.0, "cy": 2000.0}  # fmt: skip


def network(cameras):
    """Both look straight down from 50 on three points; c is 100 mm or 20 000 pixels, and the image
    points are 2, 4 and 6 pixels too far right, or 0.010 mm and so on."""
    in_mm = FILM in cameras
    X = np.array([-2.0, 0.5, 3.0])
    images, observations = [], []
    for k, camera in enumerate(cameras):
        images.append({"id": str(k), "camera": camera["id"], "X0": 0.0, "Y0": 0.0, "Z0": 50.0,
                       "omega": 0.0, "phi": 0.0, "kappa": 0.0})  # fmt: skip
        for p, x in enumerate(20000.0 * X / 50.0 + [2.0, 4.0, 6.0]):
            place = {"x": 0.005 * x, "y": 0.0} if in_mm else {"x": 2000.0 + x, "y": 2000.0}
            observations.append({"image": str(k), "point": str(p)} | place)
    return make_network(
        cameras, images,
        [{"id": str(p), "role": "tie", "X": x, "Y": 0.0, "Z": 0.0} for p, x in enumerate(X)],
        observations, image_unit="mm" if in_mm else "px", sigma_image=0.001,
    )  # fmt: skip


@pytest.mark.parametrize("cameras, unit, pixel", [
    ((MM,), "px", 1.0), ((MM, PX), "px", 1.0), ((FILM,), "mm", 0.005),
])  # fmt: skip
def test_errors_are_in_pixels_where_they_are_known(cameras, unit, pixel):
    errors, found = point_errors(network(cameras))
    assert found == unit
    np.testing.assert_allclose(errors, pixel * np.array([2.0, 4.0, 6.0]))
