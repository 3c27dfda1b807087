"""Shared by the tests of the adjustment: synthetic networks, and dense algebra as an oracle.

A network is a ring of images around a box of points, every image rotated about its axis, every
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
from jaxbundle.adjustment.problem import NetworkProblem, make_problem
from jaxbundle.adjustment.quality.inspection import Inspection
from jaxbundle.geometry import omega_phi_kappa_from_matrix
from jaxbundle.leastsquares.datum.conditions import datum_directions
from jaxbundle.leastsquares.equations.normal import zero_tangent
from jaxbundle.leastsquares.indexing.rows import (
    fill_places,
    lay_out_data,
    residuals,
    restore_order,
)
from jaxbundle.leastsquares.iterations.retraction import changes_of_tables, retract
from jaxbundle.leastsquares.problem import pad_data, pad_values, with_data
from jaxbundle.leastsquares.solution import find_minimum
from jaxbundle.network import Camera, Distances, Images, Network, Observations, Points

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
    """All parameters of a model that may be free."""
    model = cameras.get_model(model)
    return tuple(name for name in model.parameters if name not in model.never_free)


@dataclasses.dataclass(frozen=True)
class Truth:
    """The true values of a synthetic network."""

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
    twice=(),
    seed=0,
):
    """A network and the truth behind it.

    **Arguments:** `of_image`: the camera of every image (all the first); `control`, `fixed`: how
    many of the first points are control points with σ, and how many of the next are fixed;
    `distances`: pairs of point indices; `held`: pairs (image, columns of its exterior orientation);
    `scene`: "ring", or two that determine too little: "vertical" images above flat ground, and
    images from "one centre"; `noise`: of all observations, in σ; `disturbance`: of the start
    values; `twice`: rows of image points that are measured again.
    """
    rng = np.random.default_rng(seed)
    truth = Truth(*SCENES[scene](images), _box(points, rng))
    if scene == "vertical":
        truth.point[:, 2] = 0.0
    of_image = np.zeros(images, int) if of_image is None else np.asarray(of_image)
    image, point = np.divmod(np.arange(images * points), points)
    seen = (image + 2 * point) % 5 != 0
    rows = np.append(np.flatnonzero(seen), np.flatnonzero(seen)[list(twice)])
    image, point = image[rows], point[rows]
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
    return np.asarray(_angles_of(matrix))


_angles_of = jax.jit(jax.vmap(omega_phi_kappa_from_matrix))


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
    "cameras of two models": dict(
        cameras=(camera("a", sigma=dict(x0=0.01, K1=1e-5)), camera("b", "usgs", ("c", "x0")),
                 camera("d", free=("x0", "K1"))),
        of_image=(0, 1, 1, 0, 2, 0), control=4, fixed=1,
    ),
    "everything given": dict(
        cameras=tuple(camera(f"cam {i}", free=("c", "K1"), sigma=dict(c=0.01)) for i in range(4)),
        of_image=range(4), images=4, control=4, distances=((0, 5), (5, 6)), exterior_prior=True,
        twice=(3, 3, 20),
    ),
    "held images, exterior priors": dict(
        cameras=(camera(free=()),), exterior_prior=True, held=((0, SIX), (4, (1,))),
        domain="measured",
    ),
    "free": dict(datum="inner"),
    "minimal": dict(datum="minimal"),
    "free with distances": dict(
        datum="inner", datum_points=("P1", "P2", "P4", "P5", "P7"), distances=((0, 5), (3, 4)),
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
    return make_problem(synthetic(**NETWORKS[name])[0], reduction=reduction)


@cache
def adjusted(name):
    """The problem of one of `NETWORKS`, and its solution."""
    return make(name), solved(make(name))


def solved(problem, data=None, **options):
    """Iterated to the last digits: one compilation for each kind of network."""
    problem = problem if data is None else with_data(problem, data)
    return find_minimum(problem, problem.data.start, **{"atol": 1e-9, **options})


def vtpv(problem, values):
    return Inspection(problem, values).vtpv


def flat(tree):
    """Values, residuals, … as one numpy vector."""
    return np.concatenate([np.ravel(x) for x in jax.tree.leaves(tree)])


def residuals_of(problem, values):
    """v/σ of all observations as one vector, in the order of `rows_of_change`."""
    found = Inspection(problem, values).solution.residuals
    return np.concatenate([rows.ravel() for rows in found.values()])


def rows_of_change(declared, plan, values, data):
    """v/σ in the order given, with padding, as a function of a flat change of the groups, which
    uses nothing of the engine but residuals ∘ retract; and the change 0."""
    plan, laid = fill_places(plan, lay_out_data(plan, data))
    zero, unravel = ravel_pytree(zero_tangent(plan))
    free = ravel_pytree({g: group.free for g, group in plan.groups.items()})[0]

    def function(change):
        moved = retract(declared, plan, values, unravel(change * free))
        return restore_order(plan, residuals(declared, plan, moved, laid))

    return function, zero


@dataclasses.dataclass(frozen=True)
class Dense:
    """A network linearised: J [rows, unknowns] and v/σ of all rows, which unknowns are free, the
    directions G and B of the datum; by table the columns [rows, width] of its unknowns."""

    J: np.ndarray
    v: np.ndarray
    free: np.ndarray
    G: np.ndarray
    B: np.ndarray
    columns: dict[str, np.ndarray]

    @property
    def N(self):
        """JᵀJ."""
        return self.J.T @ self.J

    @property
    def Q(self):
        """The cofactors of all unknowns, in the datum."""
        return bordered_inverse(self.N, self.B, self.free)


def linearise(problem: NetworkProblem, values=None, data=None) -> Dense:
    """The dense matrices of a problem at its start values, or at others."""
    system = problem
    data = problem.data if data is None else data
    values = data.start if values is None else values
    given = pad_data(system, data)
    tables = pad_values(system, values)
    plan, sets = system.plan, system.observations
    v, J, G, B, index = _linearise(system.declared, plan, tables, given)
    tall = lambda rows: np.concatenate([
        np.asarray(rows[o.name])[: o.number].reshape(-1, *rows[o.name].shape[2:]) for o in sets
    ])  # fmt: skip
    columns = {t.name: np.asarray(index[t.name], int)[: t.rows] - 1
               for t in system.tables if t.name in index}  # fmt: skip
    free = flat({g: group.free for g, group in plan.groups.items()}) > 0
    return Dense(tall(J), tall(v), free, *map(_columns, (G, B)), columns)


@cache
def linearised(name):
    """The dense matrices of one of `NETWORKS` at its start values."""
    return linearise(make(name))


@eqx.filter_jit
def _linearise(declared, plan, values, data):
    function, zero = rows_of_change(declared, plan, values, data)
    G = B = {g: jnp.zeros((*group.free.shape, 0)) for g, group in plan.groups.items()}
    if plan.datum is not None:
        G, B = datum_directions(declared, plan, values)
    unravel = ravel_pytree(zero_tangent(plan))[1]
    index = changes_of_tables(plan, values, unravel(jnp.arange(1.0, zero.size + 1)))
    return function(zero), jax.jacfwd(function)(zero), G, B, index


def _columns(tangent):
    """A tangent whose blocks have a last axis of columns, as a matrix [unknowns, columns]."""
    blocks = [np.asarray(x) for x in jax.tree.leaves(tangent)]
    return np.concatenate([x.reshape(x.shape[0] * x.shape[1], x.shape[2]) for x in blocks])


def bordered_inverse(N, B, free):
    """The inverse of N with the datum conditions Bᵀδ = 0: the upper left part of [N B; Bᵀ 0]⁻¹.

    Scaled to unit diagonal, held unknowns left out (zero in the result).
    """
    free = np.flatnonzero(free)
    scale = 1 / np.sqrt(np.diag(N)[free])
    A = N[np.ix_(free, free)] * scale[:, None] * scale
    condition, _ = np.linalg.qr(B[free] * scale[:, None])
    d = condition.shape[1]
    full = np.block([[A, condition], [condition.T, np.zeros((d, d))]])
    inverse = np.linalg.inv(full)[: len(free), : len(free)]
    result = np.zeros_like(N)
    result[np.ix_(free, free)] = inverse * scale[:, None] * scale
    return result


def standard_deviations(Q):
    """0 for held unknowns, in a minimal datum up to rounding of either sign."""
    variance = np.diag(Q)
    return np.sqrt(np.where(variance > 1e-14 * variance.max(), variance, 0))
