"""A scanner image and a photograph in one adjustment: derivatives, a dense solution, each alone."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from refinement_scenes import ARCSEC, LINES, PIXELS, SIGMA, control, ground, scanner, spread
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from jaxbundle.geometry import matrix_from_omega_phi_kappa, omega_phi_kappa_from_matrix
from jaxbundle.io.formats import read_network
from jaxbundle.io.project import write_project
from jaxbundle.network.tables import Camera, Images, Network, Observations, Points
from jaxbundle.pushbroom.image import pose_at
from jaxbundle.refinement import (
    FREE,
    Freedom,
    Unknowns,
    adjusted_photographs,
    point_rows,
    refine,
    residuals,
)
from jaxbundle.refinement.freedom import make_form
from jaxbundle.refinement.inspection import layout_of
from jaxbundle.refinement.solver import normal

pytestmark = pytest.mark.xdist_group("refinement")

POINTS, CONTROL = 24, 8
TIE = 3 * (POINTS - CONTROL)
FREEDOM = Freedom(
    attitude=FREE, attitude_rate=FREE, jitter=(5 * ARCSEC, 0.0, 0.0), knot_spacing=1.0,
    position=(10.0, 10.0, 10.0), position_rate=(0.5, 0.5, 0.5), focal_length=2e-5,
    mounting=3 * (ARCSEC,), look_across=(0.0, 1e-6, 1e-6), look_along=(1e-6, 1e-6),
)  # fmt: skip
SIGMA_MM = 0.01
CAMERA = Camera("frame", "brown", {"c": 700.0, "K1": 1e-8}, ("c",), {"c": 0.05})


def photograph(X, rng):
    """The points in a photograph from 120 km ahead, as a network; its start values are off."""
    image = scanner().image
    P, V = (np.asarray(v) for v in pose_at(image, 1.5)[::2])
    place = P + 120e3 * V / np.linalg.norm(V)
    z = place - X.mean(0)
    z /= np.linalg.norm(z)
    x = np.cross(V, z)
    x /= np.linalg.norm(x)
    M = np.stack([x, np.cross(z, x), z])
    r, s, q = M @ (X - place).T
    # ideal coordinates: the correction of the lens is taken off again by iteration
    ideal = -700.0 * np.stack([r, s], 1) / q[:, None]
    xy = ideal.copy()
    for _ in range(20):
        xy = ideal - 1e-8 * (xy**2).sum(1, keepdims=True) * xy
    off = Rotation.from_rotvec([3e-5, -2e-5, 5e-5]).as_matrix() @ M
    angles = np.asarray(omega_phi_kappa_from_matrix(jnp.asarray(off)))
    assert np.allclose(matrix_from_omega_phi_kappa(jnp.asarray(angles)), off, atol=1e-12)
    n = len(X)
    ids = tuple(f"P{k}" for k in range(n))
    nothing = np.full((n, 3), np.nan)
    return Network(
        (CAMERA,),
        Images(("F",), np.zeros(1, int), place[None] + [[40.0, -30.0, 20.0]], angles[None],
               np.full((1, 6), np.nan)),
        Points(ids, ("tie",) * n, nothing, nothing),
        Observations(np.zeros(n, int), np.arange(n), xy + SIGMA_MM * rng.normal(size=(n, 2)),
                     np.full((n, 2), SIGMA_MM)),
    )  # fmt: skip


@pytest.fixture(scope="module")
def case():
    rng = np.random.default_rng(4)
    one = scanner(FREEDOM)
    places, heights = spread(rng, POINTS, 3000.0)
    form = make_form(one.image, one.earth, FREEDOM)
    truth = np.zeros(16 + 3 * form.spline.unknowns + 5)
    truth[:6] = np.array([20, -30, 50, 4, -3, 10]) * ARCSEC
    X = np.asarray(ground(one.image, form, truth, heights, places))
    noisy = np.clip(places + SIGMA * rng.normal(size=places.shape), 0, (LINES - 1, PIXELS - 1))
    observations = Observations(
        np.zeros(POINTS, int), np.arange(POINTS), noisy, np.full((POINTS, 2), SIGMA)
    )
    given = control(X)
    unknown = np.arange(POINTS) % 3 != 0
    assert (~unknown).sum() == CONTROL
    start = np.where(unknown[:, None], np.nan, X)
    roles = tuple("tie" if u else "control" for u in unknown)
    points = dataclasses.replace(given, X=start, role=roles)
    return refine([one], points, observations, photograph(X, rng)), X, truth, unknown


@pytest.fixture(scope="module")
def dense(case):
    """Residuals of a vector of all unknowns, and their Jacobian by blocks made dense."""
    system = case[0].inspection.system
    m, free = len(system.prior), np.flatnonzero(np.asarray(system.free).ravel())
    compiled = eqx.filter_jit(residuals)

    def unpack(y):
        point = np.zeros(system.free.size)
        point[free] = y[m:]
        return Unknowns(jnp.asarray(y[:m]), jnp.asarray(point.reshape(-1, 3)))

    def jacobian(y):
        rows = normal(system, unpack(y))[0].jacobian
        B = np.zeros((len(rows.of), len(system.X), 3))
        B[np.arange(len(rows.of)), np.asarray(rows.of)] = rows.point
        return np.concatenate([rows.shared, B.reshape(len(B), -1)[:, free]], 1)

    return m, lambda y: np.asarray(compiled(system, unpack(y))), jacobian


def test_jacobian_against_finite_differences(dense):
    m, function, jacobian = dense
    rng = np.random.default_rng(9)
    zero = np.zeros(m + TIE)
    size = np.linalg.norm(jacobian(zero), axis=0)
    y = 0.5 * rng.normal(size=len(size)) / size
    J = jacobian(y)
    for k in range(len(y)):
        step = np.zeros(len(y))
        step[k] = 0.1 / size[k]
        difference = (function(y + step) - function(y - step)) / (2 * step[k])
        assert np.allclose(J[:, k], difference, rtol=1e-6, atol=2e-7 * size[k]), k


def test_the_same_as_a_dense_solution(case, dense):
    result = case[0]
    m, function, jacobian = dense
    start = np.zeros(m + TIE)
    scale = 1 / np.linalg.norm(jacobian(start), axis=0)
    by_scipy = least_squares(
        lambda y: function(scale * y), start, jac="3-point", method="trf",
        xtol=1e-14, ftol=1e-14, gtol=1e-14,
    )  # fmt: skip
    sigma = np.sqrt(np.diagonal(result.inspection.cofactor))
    assert (np.abs(scale[:m] * by_scipy.x[:m] - result.estimate) < 1e-3 * sigma).all()
    assert np.isclose(2 * by_scipy.cost, result.sigma0**2 * result.redundancy, rtol=1e-8)
    J = jacobian(scale * by_scipy.x) * scale
    Q = np.linalg.inv(J.T @ J) * scale * scale[:, None]
    assert np.allclose(sigma, np.sqrt(np.diagonal(Q))[:m], rtol=1e-4)
    points = np.sqrt(np.diagonal(Q)[m:].reshape(-1, 3))
    free = np.asarray(result.inspection.system.free).all(1)
    own = result.inspection.point_sigma[free] / result.sigma0
    assert np.allclose(own, points, rtol=1e-4)


def test_together_is_better_than_each_alone(case, dense):
    """σ of every unknown against those of its own rays and control points, which is all that a
    single image has of points seen once."""
    result, X, _, unknown = case
    m, _, jacobian = dense
    found = result.inspection.unknowns
    J = jacobian(np.r_[result.estimate, np.asarray(found.point)[unknown].ravel()])
    rows = layout_of(result.inspection.system)
    together = np.sqrt(np.diagonal(result.inspection.cofactor))
    index = np.arange(len(J))
    control_only = np.tile(np.repeat(~unknown, 2), 2)
    first = index < 2 * POINTS
    for of_scanner in (True, False):
        keep = np.zeros(len(J), bool)
        keep[rows.image] = control_only & (first[rows.image] == of_scanner)
        keep[rows.prior] = True
        own = [k for k in range(m)
               if result.columns.names[k].owner.startswith(("image", "sensor")) == of_scanner]
        A = J[np.ix_(keep, own)]
        alone = np.sqrt(np.diagonal(np.linalg.inv(A.T @ A)))
        assert (together[own] <= alone * (1 + 1e-9)).all()
        assert (together[own] / alone).min() < 0.95
    assert 0.7 < result.sigma0 < 1.3
    error = (result.positions - X)[unknown]
    normed = np.einsum(
        "pi,pij,pj->p", error,
        np.linalg.inv(result.inspection.point_cofactor[unknown]), error,
    )  # fmt: skip
    assert 0.6 < np.mean(normed) / 3 < 1.5


def test_biases_come_back(case):
    result, _, truth, _ = case
    assert (np.abs(result.estimate[:2] - truth[:2]) < 3 * result.inspection.sigma[:2]).all()
    assert {n.owner for n in result.columns.names} == {
        "image A", "sensor A", "photograph F", "camera frame"
    }  # fmt: skip


def test_photographs_and_points_at_the_solution(case, tmp_path):
    """Written and read; collinearity in numpy leaves the residuals of the adjustment."""
    result, _, _, unknown = case
    network = read_network(write_project(adjusted_photographs(result), tmp_path))
    M = matrix_from_omega_phi_kappa(jnp.asarray(network.images.angles[0]))
    camera, rays = network.cameras[0], network.observations
    r, s, q = np.asarray(M) @ (network.points.position[rays.point] - network.images.position[0]).T
    c, K1 = camera.parameters["c"], camera.parameters["K1"]
    assert c != CAMERA.parameters["c"] and K1 == CAMERA.parameters["K1"]
    corrected = rays.xy * (1 + K1 * (rays.xy**2).sum(1, keepdims=True))
    v = -c * np.stack([r / q, s / q], 1) - corrected
    told = [row for row in result.image_points() if row["image"] == "F"]
    by_id = {row["point"]: row["v"] for row in told}
    assert len(v) == len(told) == POINTS
    expected = [by_id[network.points.id[p]] for p in rays.point]
    np.testing.assert_allclose(v, expected, atol=1e-7)
    rows = point_rows(result)
    np.testing.assert_array_equal([[row[k] for k in "XYZ"] for row in rows], result.positions)
    sigma = np.array([[row[f"s{k}"] for k in "XYZ"] for row in rows])
    # the axes of these points are those of the coordinates; control points are held
    np.testing.assert_allclose(sigma[unknown], result.inspection.point_sigma[unknown])
    assert not sigma[~unknown].any() and [row["role"] for row in rows].count("tie") == unknown.sum()
