"""What the tests of the adjustment share: synthetic networks, and the dense algebra as an oracle.

A network is a ring of images around a box of points, every image turned about its axis, every
fifth ray missing. Lengths are in metres, the camera of 20 mm stands 4 m away, σ is 5 µm.
"""

import dataclasses
from functools import cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from jaxbundle import cameras
from jaxbundle.adjustment.datum import gauge_directions
from jaxbundle.adjustment.jacobian import BundleJacobian, free_tangent, jacobian, zero_tangent
from jaxbundle.adjustment.normal import Normal, gradient, hessian, normal_from_jacobian
from jaxbundle.adjustment.problem import Problem, make_problem
from jaxbundle.adjustment.residuals import Residuals, residuals
from jaxbundle.adjustment.solve import find_minimum, make_solver
from jaxbundle.geometry import omega_phi_kappa_from_matrix
from jaxbundle.network import (
    Camera,
    Distances,
    Images,
    Network,
    Observations,
    Points,
    Tangent,
    retract,
)

CAMERAS = {
    "brown": dict(c=20.0, x0=0.11, y0=-0.07, K1=2e-4, K2=-1e-6, K3=4e-9, P1=3e-5, P2=-2e-5,
                  b1=-1e-3, b2=4e-4, r0=1.5),
    "brown-projected": dict(c=20.0, x0=0.02, y0=0.06, K1=-2e-4, K2=1e-6, K3=-2e-9, P1=2e-5,
                            P2=-3e-5, b1=-7e-4, b2=-3e-4, r0=3.0),
    "usgs": dict(c=150.0, x0=-0.03, y0=0.09, K0=-5e-5, K1=4e-8, K2=-3e-12, K3=1e-17, K4=-1e-21,
                 P1=-8e-7, P2=-9e-7, P3=1e-6, P4=-1e-11),
    "bingo": dict(c=127.0, x0=-0.05, y0=0.16, p25=16.3, p26=-1.8, format_factor=1.28),
    "opencv": dict(fx=1000.0, fy=1004.0, cx=640.3, cy=477.6, k1=-0.2, k2=-0.04, p1=1.8e-3,
                   p2=-3e-4, k3=0.2, k4=0.01, k5=-0.02, k6=0.03, s1=1e-3, s2=-2e-3, s3=-1e-3,
                   s4=5e-4),
    "kannala-brandt": dict(fx=700.0, fy=703.0, cx=642.0, cy=478.0, k1=0.1, k2=0.05, k3=-0.03,
                           k4=6e-3),
    "snavely": dict(f=500.0, k1=-0.12, k2=0.03),
}  # fmt: skip
"""A camera for every model, with all its parameters different from zero."""

SELF_CALIBRATION = ("c", "x0", "y0", "K1")
RELATIVE_SIGMA = 2.5e-4
"""σ of image coordinates as a fraction of the principal distance."""


def camera(id="cam", model="brown", free=SELF_CALIBRATION, sigma=None):
    return Camera(id, model, CAMERAS[model], tuple(free), sigma or {})


def free_parameters(model):
    """Everything of a model that may be free."""
    model = cameras.get_model(model)
    return tuple(name for name in model.parameters if name not in model.never_free)


@dataclasses.dataclass(frozen=True)
class Truth:
    """What a synthetic network was made from."""

    position: np.ndarray
    matrix: np.ndarray
    point: np.ndarray


def synthetic(
    *,
    cameras=(camera(),),
    of_image=None,
    images=6,
    points=9,
    control=0,
    fixed=0,
    distances=(),
    held=(),
    exterior_prior=False,
    datum="control",
    datum_points=(),
    domain="corrected",
    scene="ring",
    noise=1.0,
    disturbance=1.0,
    seed=0,
):
    """A network and the truth behind it.

    **Arguments:** `of_image`: the camera of every image (all the first); `control`, `fixed`: how
    many of the first points are control points with σ, and how many of the next are fixed;
    `distances`: pairs of point indices; `held`: pairs (image, columns of its exterior orientation);
    `scene`: "ring", or two that determine too little: "vertical" images above flat ground, and
    images from "one centre"; `noise`: of all observations, in σ; `disturbance`: of the start
    values.
    """
    rng = np.random.default_rng(seed)
    truth = Truth(*SCENES[scene](images), _box(points, rng))
    if scene == "vertical":
        truth.point[:, 2] = 0.0
    of_image = np.zeros(images, int) if of_image is None else np.asarray(of_image)
    image, point = np.divmod(np.arange(images * points), points)
    seen = (image + 2 * point) % 5 != 0
    image, point = image[seen], point[seen]
    xy, sigma = _measure(cameras, of_image, truth, image, point, rng, noise)

    position = truth.position + 0.02 * disturbance * rng.normal(size=(images, 3))
    angles = _angles(truth.matrix) + 0.005 * disturbance * rng.normal(size=(images, 3))
    image_sigma = np.full((images, 6), np.nan)
    if exterior_prior:
        prior = np.array([0.01, 0.02, 0.015, 2e-3, 1e-3, 3e-3])
        image_sigma[:] = prior
        position = truth.position + noise * prior[:3] * rng.normal(size=(images, 3))
        angles = _angles(truth.matrix) + noise * prior[3:] * rng.normal(size=(images, 3))
    for row, columns in held:
        image_sigma[row, list(columns)] = 0.0
    role = ["control"] * control + ["fixed"] * fixed + ["tie"] * (points - control - fixed)
    object_point = truth.point + 0.02 * disturbance * rng.normal(size=(points, 3))
    object_sigma = np.full((points, 3), np.nan)
    object_sigma[:control] = [0.002, 0.003, 0.001]
    object_point[:control] = truth.point[:control] + noise * object_sigma[:control] * rng.normal(
        size=(control, 3)
    )
    object_point[control : control + fixed] = truth.point[control : control + fixed]
    network = Network(
        cameras=tuple(cameras),
        images=Images(
            tuple(f"image {i}" for i in range(images)), of_image, position, angles, image_sigma
        ),
        points=Points(
            tuple(f"P{i}" for i in range(points)), tuple(role), object_point, object_sigma
        ),
        observations=Observations(image, point, xy, sigma),
        distances=_distances(truth.point, distances, rng, noise),
        datum=datum,
        datum_points=tuple(datum_points),
        residuals=domain,
    )
    return network, truth


def _ring(count):
    """Projection centres 4 m around the origin and rotations that look at it."""
    i = np.arange(count)
    azimuth, height = 2 * np.pi * i / count + 0.1, np.where(i % 2, 0.6, 1.0)
    z = np.stack(
        [np.cos(height) * np.cos(azimuth), np.cos(height) * np.sin(azimuth), np.sin(height)], 1
    )
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    y = np.cross(z, x)
    turn = 1.3 * i
    c, s = np.cos(turn)[:, None], np.sin(turn)[:, None]
    return (4 + 0.2 * (i % 3))[:, None] * z, np.stack([c * x + s * y, c * y - s * x, z], 1)


def _one_centre(count):
    position, matrix = _ring(count)
    turn = np.arange(count) * 1.3
    return np.repeat(position[:1], count, 0), _about_z(turn) @ matrix[0]


def _vertical(count):
    i = np.arange(count)
    position = np.stack([0.8 * (i % 3) - 0.8, 0.9 * (i // 3) - 0.4, np.full(count, 4.0)], 1)
    return position, _about_z(1.3 * i)


def _about_z(angle):
    c, s, zero, one = np.cos(angle), np.sin(angle), 0 * angle, 1 + 0 * angle
    return np.stack([c, s, zero, -s, c, zero, zero, zero, one], 1).reshape(-1, 3, 3)


SCENES = {"ring": _ring, "vertical": _vertical, "one centre": _one_centre}


def _box(count, rng):
    return rng.uniform([-0.8, -0.8, -0.5], [0.8, 0.8, 0.5], (count, 3))


def _angles(matrix):
    return np.asarray(jax.vmap(omega_phi_kappa_from_matrix)(jnp.asarray(matrix)))


def _measure(given, of_image, truth, image, point, rng, noise):
    xy, sigma = np.zeros((len(image), 2)), np.zeros((len(image), 2))
    rays = np.einsum(
        "nij,nj->ni", truth.matrix[image], truth.point[point] - truth.position[image]
    )
    of_ray = of_image[image]
    for name in dict.fromkeys(one.model for one in given):
        model = cameras.get_model(name)
        default = cameras.default_parameters(model)
        p = np.array([
            [{**default, **one.parameters}[n] for n in model.parameters]
            if one.model == name else np.zeros(len(model.parameters)) for one in given
        ])  # fmt: skip
        rows = np.array([one.model == name for one in given])[of_ray]
        parameters = p[of_ray[rows]]
        xy[rows] = np.stack(_projection(name)(tuple(parameters.T), *rays[rows].T), 1)
        sigma[rows] = RELATIVE_SIGMA * parameters[:, :1] * rng.uniform(0.8, 1.2, (rows.sum(), 2))
    assert np.isfinite(xy).all()
    return xy + noise * sigma * rng.normal(size=xy.shape), sigma


@cache
def _projection(name):
    return jax.jit(jax.vmap(partial(cameras.project, cameras.get_model(name))))


def _distances(point, ends, rng, noise):
    if not len(ends):
        return Distances.none()
    ends = np.asarray(ends)
    sigma = np.full(len(ends), 1e-3)
    true = np.linalg.norm(point[ends[:, 0]] - point[ends[:, 1]], axis=1)
    return Distances(ends, true + noise * sigma * rng.normal(size=len(ends)), sigma)


SIX = range(6)
NETWORKS = {
    "shared cameras of two models": dict(
        cameras=(camera("a", sigma=dict(x0=0.01, K1=1e-5)), camera("b", "opencv", ("fx", "fy"))),
        of_image=(0, 1, 1, 0, 1, 0), control=4, distances=((0, 5), (5, 6), (4, 7)),
    ),
    "own cameras of two models": dict(
        cameras=tuple(
            camera(f"cam {i}", *(("snavely", ("f",)), ("brown", ("c", "x0", "y0")))[i % 2],
                   sigma=(dict(f=2.0), dict(x0=0.05))[i % 2]) for i in SIX
        ),
        of_image=SIX, points=12, fixed=3, distances=((0, 5), (5, 6)), domain="measured",
    ),
    "held images, exterior priors": dict(
        cameras=(camera(free=()),), exterior_prior=True, held=((0, SIX), (4, (1,))),
    ),
    "free": dict(datum="inner"),
    "minimal": dict(datum="minimal"),
    "free with distances": dict(
        cameras=tuple(camera(f"cam {i}", "brown-projected", ("c",)) for i in SIX), of_image=SIX,
        points=12, datum="inner", datum_points=("P1", "P2", "P4", "P5", "P7"),
        distances=((0, 5), (3, 4)),
    ),
    "one fixed point": dict(fixed=1, datum="inner"),
}  # fmt: skip
"""Kinds of networks that every part of the solver has to handle."""

LINEARISED = tuple(name for name in NETWORKS if name != "one fixed point")
"""Those that differ in the blocks of their equations."""

DEFECTS = {"free": 7, "minimal": 7, "free with distances": 6, "one fixed point": 4}


@cache
def make(name, reduction=None):
    """The problem of one of `NETWORKS`."""
    return make_problem(synthetic(**NETWORKS[name])[0], reduction)


@cache
def adjusted(name):
    """The problem of one of `NETWORKS`, and its solution."""
    return make(name), solved(make(name))


def solved(problem, data=None, **options):
    """Iterated to the last digits: one solver, one compilation for each kind of network."""
    solver = make_solver(problem, **{"atol": 1e-9, **options})
    return find_minimum(solver, problem.data if data is None else data)


def vtpv(problem, values):
    return float((flat(residuals(problem.structure, values, problem.data)) ** 2).sum())


@dataclasses.dataclass(frozen=True)
class Linear:
    """A network linearised at its start values: in blocks, and the Jacobian as a dense matrix."""

    problem: Problem
    jac: BundleJacobian
    J: np.ndarray
    rows: Residuals
    gradient: Tangent
    normal: Normal
    curved: Normal
    gauge: Tangent

    @property
    def N(self):
        """JᵀJ, dense."""
        return self.J.T @ self.J


@cache
def linearised(name):
    """One of `NETWORKS`, linearised; compiled once for all tests."""
    problem = make(name)
    jac, J, *rest = _linearise(problem.structure, problem.data)
    return Linear(problem, jac, np.asarray(J), *rest)


@eqx.filter_jit
def _linearise(s, data):
    jac, rows = jacobian(s, data.start, data), residuals(s, data.start, data)
    return (
        jac, jac.as_matrix(), rows, gradient(jac, rows), normal_from_jacobian(jac),
        hessian(s, data.start, data), gauge_directions(s, data.start),
    )  # fmt: skip


def flat(tree):
    """A tangent, residuals, … as one numpy vector, in the order of `as_matrix`."""
    return np.asarray(ravel_pytree(tree)[0])


def columns(tree):
    """A tangent whose blocks have a last axis of columns, as a matrix [unknowns, columns]."""
    blocks = [np.asarray(x) for x in jax.tree.leaves(tree)]
    return np.concatenate([x.reshape(x.shape[0] * x.shape[1], x.shape[2]) for x in blocks])


def of_change(structure, values, data):
    """residuals ∘ retract as a function of a flat change of the free unknowns, and its size."""
    zero, unravel = ravel_pytree(zero_tangent(structure))
    free = ravel_pytree(free_tangent(structure))[0]

    def function(change):
        moved = retract(structure, values, unravel(change * free))
        return ravel_pytree(residuals(structure, moved, data))[0]

    return function, zero


@eqx.filter_jit
def residuals_of_changes(structure, values, data, changes):
    """residuals(retract(values, change)) as vectors, for many flat changes [changes, unknowns]."""
    return jax.vmap(of_change(structure, values, data)[0])(changes)


@eqx.filter_jit
def gradients_of_changes(structure, values, data, changes):
    """The gradients of ½vᵀPv after many flat changes [changes, unknowns], by reverse mode."""
    function, _ = of_change(structure, values, data)
    return jax.vmap(jax.grad(lambda change: 0.5 * jnp.sum(function(change) ** 2)))(changes)


def differences(function, structure, values, data, J):
    """Central differences of a function of changes: its derivative, one column an unknown.

    The steps move the residuals by 0.01 σ, 2.5e-6 of the principal distance: truncation and
    rounding of the residuals (1e-13) both stay below 1e-8 of a column.
    """
    size = np.linalg.norm(J, axis=0)
    step = 0.01 / np.where(size > 0, size, np.inf)
    ends = [function(structure, values, data, sign * np.diag(step)) for sign in (1, -1)]
    difference = (np.asarray(ends[0]) - np.asarray(ends[1])).T / 2
    return difference / np.where(size > 0, step, 1)


def assert_columns_agree(J, other, tolerance):
    """Two matrices agree to a fraction of the norm of each column."""
    assert np.isfinite(J).all()
    size = np.maximum(np.linalg.norm(other, axis=0), np.linalg.norm(J, axis=0))
    difference = np.linalg.norm(J - other, axis=0) / np.where(size > 0, size, 1)
    assert difference.max() <= tolerance, difference


def dense_normal(structure, normal):
    """The blocks of a normal matrix put into a dense one, block by block, in plain loops."""
    s, n = structure, jax.tree.map(np.asarray, normal)
    w, k = s.image_width, s.camera_width
    at_camera = s.images * w
    at_point = at_camera + s.cameras * k
    N = np.zeros((at_point + 3 * s.points,) * 2)
    image = lambda i: slice(i * w, (i + 1) * w)
    camera = lambda c: slice(at_camera + c * k, at_camera + (c + 1) * k)
    point = lambda p: slice(at_point + 3 * p, at_point + 3 * p + 3)

    def add(rows, columns, block):
        N[rows, columns] += block
        if rows != columns:
            N[columns, rows] += block.T

    for i in range(s.images):
        add(image(i), image(i), n.image[i])
        if k:
            add(image(i), camera(int(s.camera_of_image[i])), n.image_camera[i])
    for c in range(s.cameras if k else 0):
        add(camera(c), camera(c), n.camera[c])
    for p in range(s.points):
        add(point(p), point(p), n.point[p])
    for ray in range(s.rays):
        add(point(int(s.point[ray])), image(int(s.image[ray])), n.image_point[ray])
    for row, ray in enumerate(np.asarray(s.kept_rays)):
        add(point(int(s.point[ray])), image(int(s.image[ray])), n.kept_image[row])
        if k:
            add(point(int(s.point[ray])), camera(int(s.camera[ray])), n.kept_camera[row])
    if k:
        for row in range(s.incidence.point.shape[0]):
            add(point(int(s.incidence.point[row])), camera(int(s.incidence.camera[row])),
                n.camera_point[row])  # fmt: skip
    for row, (a, b) in enumerate(np.asarray(s.distance)):
        add(point(int(a)), point(int(b)), n.kept_kept[row])
    return N


def datum_matrices(structure, values):
    """G of the open directions and B of the datum, dense [unknowns, defect]."""
    G = gauge_directions(structure, values)
    weighted = G.point * structure.datum_weight[..., None]
    B = type(G)(jnp.zeros_like(G.image), jnp.zeros_like(G.camera), weighted)
    return columns(G), columns(B)


def bordered_inverse(N, B, free):
    """The inverse of N with the datum conditions Bᵀδ = 0: the upper left part of [N B; Bᵀ 0]⁻¹.

    Scaled to unit diagonal, held unknowns left out (zero in the result).
    """
    free = np.flatnonzero(np.asarray(free) > 0)
    scale = 1 / np.sqrt(np.diag(N)[free])
    A = N[np.ix_(free, free)] * scale[:, None] * scale
    condition, _ = np.linalg.qr(B[free] * scale[:, None])
    d = condition.shape[1]
    full = np.block([[A, condition], [condition.T, np.zeros((d, d))]])
    inverse = np.linalg.inv(full)[: len(free), : len(free)]
    result = np.zeros_like(N)
    result[np.ix_(free, free)] = inverse * scale[:, None] * scale
    return result
