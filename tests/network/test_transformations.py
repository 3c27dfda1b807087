"""Every kind of observation of a network under jit, vmap, jvp, grad and hessian, and in float32."""

import dataclasses
from functools import partial
from itertools import chain

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbundle
from jaxbundle.geometry import matrix_from_omega_phi_kappa
from jaxbundle.leastsquares.equations.normal import zero_tangent
from jaxbundle.leastsquares.indexing.rows import fill_places, lay_out_data, residuals
from jaxbundle.leastsquares.iterations.retraction import retract
from jaxbundle.leastsquares.problem import complete_data
from jaxbundle.network.build import make_further
from jaxbundle.network.kinds import KINDS
from jaxbundle.network.tables import EXTERIOR

EPOCHS, SIGMA = 4, 0.002
pytestmark = pytest.mark.further  # minutes of compiling
# In three problems: of all kinds in one, XLA compiles the derivatives in minutes and 6 GB.
TABLES_OF = {
    "robot": ("robot_poses", "hand_eye", "tilts", "tilt", "azimuths", "azimuth"),
    "water": ("interfaces", "surface_points", "surfaces"),
    "navigation": ("antennas", "antenna", "attitudes", "attitude", "exterior_priors"),
    "rigs": ("rigs", "rig", "camera_parameters", "ties", "velocities", "rolling_shutter"),
    "object": ("differences", "angles", "figures", "shapes", "edges"),
}
AXIS = np.array([-1.0, 0.0, 1.0])
GRID = np.stack(np.meshgrid(AXIS, AXIS, AXIS, indexing="ij"), -1).reshape(-1, 3)


def rows(images):
    """Rows of every kind about images and about points "1" to "27" of the grid."""
    plane = [str(k + 1) for k in np.flatnonzero(GRID[:, 2] == -1)]
    body = [str(k + 1) for k in np.flatnonzero(GRID[:, 0] == 1)][:5]
    antenna = {f"s{a}": [0.01] * len(images) for a in "XYZ"} | dict.fromkeys("XYZ", [0.0] * 8)
    angles = ("omega", "phi", "kappa")
    return {
        "antennas": antenna
        | {"image": images, "rXY": [0.8] * 8, "rXZ": [-0.3] * 8, "strip": list("aaaabbbb")},
        "antenna": {"free": ["shift"], "sigma": {"shift": 0.05}},
        "hand_eye": {"sigma_position": 0.01, "sigma_angle": 0.002},
        "interfaces": [{"interface": "port", "type": "flat", "camera": "left", "Z": -0.1,
                        "thickness": 0.01, "index_window": 1.5, "index": 1.33, "sZ": 0.01,
                        "somega": 0.01, "sphi": 0.01, "sindex": 0.01}],
        "tilts": {"image": images} | dict.fromkeys(("right", "view"), [0.0] * 8)
        | dict.fromkeys(("sright", "sview"), [1e-3] * 8),
        "tilt": {"free": ["view"], "sigma": {"view": 0.01}},
        "azimuth": {"free": ["declination"], "sigma": {"declination": 0.01}},
        "surface_points": {"surface": ["floor"] * 9, "point": plane, "sigma": [0.01] * 9},
        # a plane: the choice of a triangle has no derivative
        "surfaces": {"floor": {"plane": [0.0, 0.0, -1.0], "normal": [0.0, 0.0, 1.0]}},
        "attitudes": {"image": images}
        | {a: [0.0] * 8 for a in angles} | {f"s{a}": [1e-3] * 8 for a in angles},
        "attitude": {"free": ["boresight"], "sigma": {"boresight": 0.01}},
        "rigs": [
            {"rig": "pair", "epoch": str(e), "image": images[e + k * EPOCHS]}
            for k in (0, 1) for e in range(EPOCHS)
        ],
        "rig": {"reference": "left", "sigma_position": 0.01, "sigma_angle": 0.001},
        "velocities": {"image": images} | {f"s{v}": [0.5] * 8 for v in ("vX", "vY", "vZ")}
        | {f"s{w}": [0.1] * 8 for w in ("wx", "wy", "wz")},
        "rolling_shutter": {"line_time": 1e-4, "free": ["vX", "vY", "vZ", "wx", "wy", "wz"]},
        "differences": [{"from": "1", "to": "27", "dX": 0.0, "dY": 0.0, "dZ": None,
                         "sdX": 0.01, "sdY": 0.01, "sdZ": None}],
        "angles": [{"from": "1", "at": "2", "to": "14", "value": 1.0, "sigma": 1e-3}],
        "camera_parameters": [
            {"camera": "right", "parameter": "c", "value": 30.02, "sigma": 0.05}
        ],
        "exterior_priors": {"image": images[:2]} | dict.fromkeys(EXTERIOR, [0.0] * 2)
        | {f"s{name}": [0.05] * 2 for name in EXTERIOR},
        "ties": [{"camera": "left", "other": "right", "parameter": "c", "sigma": 0.1}],
        "figures": [{"figure": "floor", "type": "plane", "point": p, "sigma": 0.01} for p in plane],
        "shapes": [
            {"shape": "body", "point": p, "sigma": 0.01}
            | dict(zip("xyz", GRID[int(p) - 1] @ [[0, 1, 0], [0, 0, 1], [1, 0, 0]]))
            for p in body
        ],
    }  # fmt: skip


@pytest.fixture(scope="module")
def network_and_truth():
    """Two cameras in a rig at four epochs, with control, distances and priors."""
    ring = jaxbundle.ring_of_stations(EPOCHS, radius=6.0, height=2.0, roll_every=2)
    camera = lambda id: jaxbundle.Camera(
        id, "brown", {"c": 30.0, "K1": -1e-4}, ("c", "K1"), {"c": 0.1}, image_size=(3600, 2400),
        pixel_size=(0.01, 0.01),
    )  # fmt: skip
    shifted = dataclasses.replace(ring, position=ring.position + [0.4, 0.1, 0.0])
    made = jaxbundle.simulate_with_truth(
        ring + shifted, GRID, [camera("left"), camera("right")],
        camera_of_station=[0] * EPOCHS + [1] * EPOCHS, noise=SIGMA, seed=2,
        disturb=(0.01, 0.002, 0.01), datum="control", control=[0, 8, 20, 26], control_sigma=0.005,
        distances=((1, 5), (5, 7)), distance_sigma=0.002,
    )  # fmt: skip
    sigma = np.tile([0.02] * 3 + [0.002] * 3, (2 * EPOCHS, 1))
    images = dataclasses.replace(made.network.images, sigma=sigma)
    return made.network.replace(images=images), made.truth


@pytest.fixture(scope="module", params=TABLES_OF)
def problem(request, network_and_truth):
    network, truth = network_and_truth
    images, seen = list(network.images.id), network.observations
    tables = rows(images)
    tables["edges"] = [
        {"line": str(line), "image": images[i], "sigma": 0.01,
         "x": float(seen.xy[k, 0]), "y": float(seen.xy[k, 1])}
        for line, points in enumerate([(0, 1, 2), (6, 7, 8)])
        for k, (i, p) in enumerate(zip(seen.image, seen.point)) if p in points
    ]  # fmt: skip
    exterior = np.concatenate([truth.images.position, truth.images.angles], 1)
    tables["robot_poses"] = {"image": images} | dict(
        zip(("X", "Y", "Z", "omega", "phi", "kappa"), exterior.T)
    )
    M = [np.asarray(matrix_from_omega_phi_kappa(a)) for a in truth.images.angles]
    tables["azimuths"] = {"image": images, "sigma": [1e-3] * 8, "value": [
        float(np.arctan2(-m[2, 0], -m[2, 1])) for m in M
    ]}  # fmt: skip
    of_this = {name: tables[name] for name in TABLES_OF[request.param]}
    edges = make_further({"edges": of_this.pop("edges")}, 1.0) if "edges" in of_this else ()
    given = network.replace(further=tuple(make_further(of_this, 1.0)))
    given = jaxbundle.simulate_further(given, truth, seed=3)
    given = given.replace(further=(*given.further, *edges))
    return jaxbundle.make_problem(jaxbundle.check_network(given))


def test_every_kind_is_there():
    assert KINDS.keys() <= set(chain(*TABLES_OF.values()))


def test_antennas_have_a_covariance(problem):
    if "antennas" in {type(one).TABLE for one in problem.network.further}:
        assert any(np.ndim(weight) == 3 for weight in problem.data.weight.values())


@dataclasses.dataclass(frozen=True)
class Line:
    """The solution along one direction of all data; everything in units of its a priori σ."""

    problem: jaxbundle.Problem
    base: jaxbundle.Data
    along: jaxbundle.Data
    scale: np.ndarray

    def data(self, t):
        return jax.tree.map(lambda x, d: x + t * d, self.base, self.along)

    def __call__(self, t):
        values = jaxbundle.solve(self.problem, self.data(t))
        return jnp.concatenate([jnp.ravel(x) for x in jax.tree.leaves(values)]) / self.scale


@pytest.fixture(scope="module")
def line(problem):
    random = np.random.default_rng(5)
    base = jax.tree.map(np.asarray, problem.data)
    # Weights change by a hundredth, other numbers by a thousandth of their size.
    of = lambda x, part: part * random.normal(size=np.shape(x)) * np.abs(x)
    along = jax.tree.map(lambda x: of(x, 1e-3), base)
    weight = {name: of(w, 1e-2) for name, w in base.weight.items()}
    along = dataclasses.replace(along, weight=weight)
    values = jax.tree.leaves(jaxbundle.solve(problem))
    scale = np.concatenate([np.full(np.size(x), np.abs(x).max() + 1e-3) for x in values])
    return Line(problem, base, along, scale)


def test_jit_vmap_and_derivatives(line):
    """Values and first derivatives, forward and reverse, along one direction of all data, in one
    program for five steps: each as by differences, and the values as those of a single call."""
    towards = np.random.default_rng(6).normal(size=len(line.scale))

    def along(t, base, change):
        data = jax.tree.map(lambda x, d: x + t * d, base, change)
        values = jax.tree.leaves(jaxbundle.solve(line.problem, data))
        return towards @ (jnp.concatenate([jnp.ravel(x) for x in values]) / line.scale)

    # Data as arguments: of constants XLA computes what it can while compiling, for minutes.
    @jax.jit
    @partial(jax.vmap, in_axes=(0, None, None))
    def evaluate(t, *data):
        value, reverse = jax.value_and_grad(along)(t, *data)
        return value, reverse, jax.jvp(lambda t: along(t, *data), (t,), (1.0,))[1]

    h = 0.1
    value, reverse, forward = evaluate(h * jnp.arange(-2.0, 3.0), line.base, line.along)
    assert np.ptp(value) > 1e-4
    np.testing.assert_allclose(value[4], along(2 * h, line.base, line.along), rtol=1e-9)
    np.testing.assert_allclose(forward, reverse, rtol=1e-8)
    np.testing.assert_allclose(reverse[2], slope(value, h), rtol=1e-6)


def slope(f, h):
    return (8 * (f[3] - f[1]) - (f[4] - f[0])) / (12 * h)


def test_residuals_have_the_derivatives_of_a_hessian(line):
    """The second derivatives of the solution need the third ones of all residuals (those of the
    engine: tests/leastsquares/test_derivatives.py; all kinds in one program: 20 minutes)."""
    problem, data = line.problem, complete_data(line.problem, None)
    random, tangent = np.random.default_rng(8), zero_tangent(problem.plan)
    group = lambda name, x: 1e-2 * random.normal(size=x.shape) * problem.plan.groups[name].free
    change = {name: group(name, x) for name, x in tangent.items()}
    plan, laid = fill_places(problem.plan, lay_out_data(problem.plan, data))

    def seen(t):
        moved = {name: t * d for name, d in change.items()}
        moved = retract(problem.declared, plan, data.start, moved)
        return jnp.concatenate([v.ravel() for v in residuals(problem.declared, plan, moved, laid)])

    derivative = lambda f: lambda t: jax.jvp(f, (t,), (1.0,))[1]
    second = derivative(derivative(seen))
    h = 0.05
    seconds, thirds = jax.jit(jax.vmap(lambda t: jax.jvp(second, (t,), (1.0,))))(
        h * jnp.arange(-2.0, 3.0)
    )
    third, scale = thirds[2], np.abs(seconds[2]).max()
    assert np.all(np.isfinite(thirds)) and np.ptp(third) > 1e-6 * scale
    np.testing.assert_allclose(third, slope(seconds, h), atol=1e-5 * np.abs(third).max())


def test_single_precision_is_taken_as_the_numbers_it_holds(line):
    single = jax.tree.map(lambda x: np.asarray(x, np.float32), line.data(0.3))
    double = jax.tree.map(lambda x: np.asarray(x, np.float64), single)
    found, right = (jaxbundle.solve(line.problem, data) for data in (single, double))
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(right), strict=True):
        assert a.dtype == np.float64
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)
