"""A drive past many points: the same network by each way of solving the reduced system."""

import jax
import numpy as np
import pytest

import jaxbundle
from jaxbundle.geometry import matrix_from_omega_phi_kappa
from jaxbundle.network import Camera
from jaxbundle.network.build import make_network

IMAGES, POINTS, REACH = 20, 120, 4


def street():
    """Images along a line, shuffled, each seeing the points next to it; one camera, c free."""
    random = np.random.default_rng(3)
    points = np.c_[random.uniform(0, IMAGES - 1, POINTS), random.uniform(4, 9, POINTS),
                   random.normal(size=POINTS)]  # fmt: skip
    place = random.permutation(IMAGES)
    image, point = np.nonzero(np.abs(place[:, None] - points[:, 0]) < REACH / 2)
    centre = np.c_[place, 0.1 * random.normal(size=IMAGES), 0.1 * random.normal(size=IMAGES)]
    angles = np.c_[np.full(IMAGES, np.pi / 2), np.zeros((IMAGES, 2))]
    angles = angles + 0.15 * random.normal(size=(IMAGES, 3))
    M = np.asarray(jax.vmap(matrix_from_omega_phi_kappa)(angles))
    r, s, q = np.einsum("nij,nj->in", M[image], points[point] - centre[image])
    xy = -20 * np.stack([r, s]).T / q[:, None] + 0.005 * random.normal(size=(len(image), 2))
    table = lambda names, columns: dict(zip(names, columns))
    return make_network(
        Camera("cam", "brown", {"c": 20.0}, free=("c",)),
        table(("id", "camera", "X0", "Y0", "Z0", "omega", "phi", "kappa"),
              (np.arange(IMAGES), ["cam"] * IMAGES, *(centre + 0.01).T, *angles.T)),
        table(("id", "role", "X", "Y", "Z"), (np.arange(POINTS), ["tie"] * POINTS, *points.T)),
        table(("image", "point", "x", "y"), (image, point, *xy.T)),
        sigma_image=0.005, datum="inner",
    )  # fmt: skip


@pytest.fixture(scope="module")
def dense():
    return jaxbundle.adjust(street(), reduction="dense")


@pytest.mark.further
def test_a_network_solved_by_iteration_is_the_same_network(dense):
    found = jaxbundle.adjust(street(), reduction="iterative")
    assert found.reduction == "iterative" and found.converged and dense.counts.datum == 7
    assert found.vtpv == pytest.approx(dense.vtpv, rel=1e-10)
    sigma = np.sqrt(np.diagonal(dense.point_covariance, axis1=1, axis2=2))
    assert (np.abs(found.point_values - dense.point_values) < 1e-3 * sigma).all()
    assert_same_cofactors(found, dense, rtol=1e-4, atol=1e-6)
    assert "conjugate gradients" in found.report()


@pytest.mark.further
def test_a_network_solved_in_a_band_is_the_same_network(dense):
    """Images with common points stand close in the band."""
    found = jaxbundle.adjust(street(), reduction="banded")
    band = found.problem.plan.band
    assert band.group == "image" and band.width <= 2 * REACH < IMAGES - 1
    assert found.vtpv == pytest.approx(dense.vtpv, rel=1e-11)
    assert_same_cofactors(found, dense, rtol=1e-6, atol=1e-8)
    r = found.inspection.reliability.redundancy["image"]
    np.testing.assert_allclose(r, dense.inspection.reliability.redundancy["image"], atol=1e-7)


def assert_same_cofactors(found, dense, rtol, atol):
    for name in ("image_cofactors", "point_cofactors", "camera_cofactors"):
        a, b = (np.asarray(getattr(r.inspection, name)) for r in (dense, found))
        np.testing.assert_allclose(b, a, rtol=rtol, atol=atol * np.abs(a).max())
