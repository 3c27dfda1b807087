"""Formulas of other programs' cameras are functions of JAX, with derivatives on the axis too."""

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose

from jaxbundle.cameras import default_parameters, get_model
from jaxbundle.io.cameras import opencv_file
from jaxbundle.io.networks import metashape_camera

SIZES = dict(fx=500.0, fy=400.0, cx=0.0, cy=0.0)
AGISOFT = dict(f=400.0, b1=100.0, w=640.0, h=480.0)


def cases():
    """Name, formula, parameters of no distortion but of the kind."""
    for kind, formula in metashape_camera.FORMULAS.items():
        yield kind, formula, dict.fromkeys(metashape_camera.COEFFICIENTS, 0.0) | AGISOFT
    for name, formula in opencv_file.FORMULAS.items():
        camera = default_parameters(get_model(name)) | SIZES
        if "xi" in camera:  # of the mei model: it divides the scale on the axis by 1 + ξ
            camera["xi"] = 0.0
        yield name, formula, {"camera": camera, "skew": 0.0, "H": np.eye(3)}


CASES = {name: rest for name, *rest in cases()}


@pytest.mark.parametrize("name", CASES)
def test_derivatives_on_the_axis_and_beside_it(name):
    """On the axis they are fx and fy over Z ; beside it the image is that
    of a ray of any length: J·ray = 0 (Euler)."""
    formula, p = CASES[name]
    with jax.enable_x64(True):
        J = jax.jacfwd(lambda ray: formula(p, *ray))
        assert_allclose(J(np.array([0, 0, 1.0])), [[500, 0, 0], [0, 400, 0]], atol=1e-9)
        beside = np.array([0.3, -0.2, 0.9])
        assert_allclose(J(beside) @ beside, 0, atol=1e-9)
        assert abs(np.linalg.det(J(beside)[:, :2])) > 1e4
