"""A scanner image and a photograph in one adjustment: derivatives, a dense solution, each alone."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refinement_scenes import ARCSEC, LINES, PIXELS, SIGMA, control, ground, scanner, spread
from scipy.spatial.transform import Rotation

from jaxbundle.geometry import (
    matrix_from_omega_phi_kappa,
    matrix_from_quaternion,
    omega_phi_kappa_from_matrix,
    retract_quaternion,
)
from jaxbundle.io.formats import read_network
from jaxbundle.io.networks.project import write_project
from jaxbundle.network.tables import Camera, Distances, Images, Network, Observations, Points
from jaxbundle.pushbroom.ground_to_image import misclosure
from jaxbundle.pushbroom.image import pose_at
from jaxbundle.refinement import FREE, Freedom, adjusted_photographs, point_rows, refine
from jaxbundle.refinement.freedom import change_image, change_of, make_form, names

POINTS, CONTROL = 24, 8
TIE = 3 * (POINTS - CONTROL)
FREEDOM = Freedom(
    attitude=FREE, attitude_rate=FREE, jitter=(5 * ARCSEC, 0.0, 0.0), knot_spacing=1.0,
    position=(10.0, 10.0, 10.0), position_rate=(0.5, 0.5, 0.5), focal_length=2e-5,
    mounting=3 * (ARCSEC,), look_across=(0.0, 1e-6, 1e-6), look_along=(1e-6, 1e-6),
)  # fmt: skip
SIGMA_MM, SIGMA_M = 0.01, 0.5
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
    ends = np.array([[1, 2], [4, 0], [7, 11]])
    apart = np.linalg.norm(X[ends[:, 0]] - X[ends[:, 1]], axis=1)
    return Network(
        (CAMERA,),
        Images(("F",), np.zeros(1, int), place[None] + [[40.0, -30.0, 20.0]], angles[None],
               np.full((1, 6), np.nan)),
        Points(ids, ("tie",) * n, nothing, nothing),
        Observations(np.zeros(n, int), np.arange(n), xy + SIGMA_MM * rng.normal(size=(n, 2)),
                     np.full((n, 2), SIGMA_MM)),
        Distances(ends, apart + SIGMA_M * np.array([0.5, -1.0, 0.8]), np.full(3, SIGMA_M)),
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
def equations(case):
    """v/σ of a vector of all unknowns, from image, network and points as they were given: nothing
    of the declarations takes part but S."""
    result = case[0]
    found, given = result.inspection, result.inspection.declared.inputs
    one, form, network = given.images[0], given.forms[0], given.frames
    columns, rays = found.declared.columns, given.observations
    own = [form.sizes, names(form.sizes, "A", "A")]
    at = {str(name): k for k, name in enumerate(own[1])}
    place = np.array([at.get(str(c.name), -1) for c in columns])
    m, free = len(columns), np.flatnonzero(np.array(given.points.role) == "tie")
    S = found.solution.problem.data.measured["scanner points 1"].scale
    start = found.declared.problem.data.start
    camera, frame = network.cameras[0], network.observations
    q, sigma = start["image"].rotation[0], np.array([c.sigma for c in columns])

    @jax.jit
    def rows(y):
        p = jnp.zeros(len(own[1]) + 1).at[place].set(y[:m])[:-1]
        X = jnp.asarray(given.points.X).at[free].set(start["point"].position[free] + given.origin)
        X = X.at[free].add(y[m:].reshape(-1, 3))
        change = change_of(form.sizes, p)

        def scanned(X, xy, S):
            t = one.image.times.time(xy[0])
            image = change_image(one.image, form, change, t)
            return S @ misclosure(image, X, t, xy[1], one.earth) / SIGMA

        v = jax.vmap(scanned)(X[rays.point], jnp.asarray(rays.xy), jnp.asarray(S))
        e = y[m - 7 : m]
        ray = X[frame.point] - network.images.position[0] - e[:3]
        r, s, t = matrix_from_quaternion(retract_quaternion(q, e[3:6])) @ ray.T
        xy = frame.xy * (1 + camera.parameters["K1"] * (frame.xy**2).sum(1, keepdims=True))
        w = -(camera.parameters["c"] + e[6]) * jnp.stack([r, s], 1) / t[:, None] - xy
        ends, d = network.distances.points, network.distances
        length = jnp.linalg.norm(X[ends[:, 0]] - X[ends[:, 1]], axis=1)
        prior = y[:m] / sigma
        return jnp.concatenate([
            v.ravel(), w.ravel() / SIGMA_MM, prior[np.isfinite(sigma)], (length - d.value) / d.sigma
        ])  # fmt: skip

    return m, rows, jax.jit(jax.jacfwd(rows))


def minimum(rows, jacobian, y):
    """Gauss–Newton in columns of unit length."""
    for _ in range(8):
        J = jacobian(y)
        scale = 1 / np.linalg.norm(J, axis=0)
        y = y - scale * np.linalg.lstsq(J * scale, rows(y), rcond=None)[0]
    J = jacobian(y) * scale
    return y, np.asarray(rows(y)), np.linalg.inv(J.T @ J) * scale * scale[:, None]


@pytest.mark.further
def test_the_same_as_a_dense_solution(case, equations):
    """Distances between points included: without them it would be another."""
    result, _, _, unknown = case
    m, rows, jacobian = equations
    found = result.inspection
    y, v, Q = minimum(rows, jacobian, np.zeros(m + TIE))
    sigma = np.sqrt(np.diagonal(Q))
    assert (np.abs(y[:m] - result.estimate) < 1e-4 * sigma[:m]).all()
    assert np.isclose(v @ v, result.sigma0**2 * result.redundancy, rtol=1e-8)
    assert result.redundancy == len(v) - len(y)
    assert np.allclose(found.sigma / result.sigma0, sigma[:m], rtol=1e-4)
    points = sigma[m:].reshape(-1, 3)
    assert np.allclose(found.point_sigma[unknown] / result.sigma0, points, rtol=1e-4)
    scale = np.sqrt(np.diagonal(Q))
    assert np.allclose(found.cofactor / scale[:m] / scale[:m, None],
                       Q[:m, :m] / scale[:m] / scale[:m, None], atol=1e-4)  # fmt: skip
    told = result.distances()
    assert [(row["from"], row["to"]) for row in told] == [("P1", "P2"), ("P4", "P0"), ("P7", "P11")]
    np.testing.assert_allclose([row["v"] for row in told], SIGMA_M * v[-3:], atol=1e-7)
    J = np.asarray(jacobian(y))
    r = 1 - np.einsum("ri,ij,rj->r", J, Q, J)
    np.testing.assert_allclose([row["r"] for row in told], r[-3:], atol=1e-4)
    alone, *_ = minimum(lambda y: rows(y)[:-3], lambda y: jacobian(y)[:-3], y)
    assert (np.abs(alone[m:] - y[m:]) > 0.2 * sigma[m:]).sum() > 6


@pytest.mark.further
def test_together_is_better_than_each_alone(case, equations):
    """σ of every unknown against those of its own rays and control points, which is all that a
    single image has of points seen once."""
    result, X, _, unknown = case
    m, _, jacobian = equations
    found = result.inspection
    J = np.asarray(jacobian(np.r_[result.estimate, np.zeros(TIE)]))
    together = found.sigma / result.sigma0
    rays = np.arange(len(J)) < 4 * POINTS
    control_only = np.zeros(len(J), bool)
    control_only[: 4 * POINTS] = np.tile(np.repeat(~unknown, 2), 2)
    first = np.arange(len(J)) < 2 * POINTS
    for of_scanner in (True, False):
        keep = np.where(rays, control_only & (first == of_scanner), True)
        keep[-3:] = False
        own = [k for k in range(m)
               if result.names[k].owner.startswith(("image", "sensor")) == of_scanner]
        A = J[np.ix_(keep, own)]
        alone = np.sqrt(np.diagonal(np.linalg.inv(A.T @ A)))
        assert (together[own] <= alone * (1 + 1e-4)).all()
        assert (together[own] / alone).min() < 0.95
    assert 0.7 < result.sigma0 < 1.3
    error = (result.positions - X)[unknown]
    normed = np.einsum("pi,pij,pj->p", error, np.linalg.inv(found.point_cofactor[unknown]), error)
    assert 0.6 < np.mean(normed) / 3 < 1.5


@pytest.mark.further
def test_biases_come_back(case):
    result, _, truth, _ = case
    assert (np.abs(result.estimate[:2] - truth[:2]) < 3 * result.inspection.sigma[:2]).all()
    assert {n.owner for n in result.names} == {
        "image A", "sensor A", "photograph F", "camera frame"
    }  # fmt: skip


@pytest.mark.further
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
