"""Every kind of observation of a network under jit, vmap, jvp, grad and hessian, and in float32."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbundle
from jaxbundle.network.build import make_further
from jaxbundle.network.kinds import KINDS
from jaxbundle.network.tables import EXTERIOR

EPOCHS, SIGMA = 4, 0.002
pytestmark = pytest.mark.further  # minutes of compiling for twenty kinds at once
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
def problem():
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
    network, truth = made.network, made.truth
    images = list(network.images.id)
    given = network.replace(
        further=tuple(make_further(rows(images), 1.0)),
        images=dataclasses.replace(
            network.images, sigma=np.tile([0.02] * 3 + [0.002] * 3, (len(images), 1))
        ),
    )
    given = jaxbundle.simulate_further(given, truth, seed=3)
    seen = given.observations
    edges = [
        {"line": str(line), "image": images[i], "sigma": 0.01,
         "x": float(seen.xy[k, 0]), "y": float(seen.xy[k, 1])}
        for line, points in enumerate([(0, 1, 2), (6, 7, 8)])
        for k, (i, p) in enumerate(zip(seen.image, seen.point)) if p in points
    ]  # fmt: skip
    given = given.replace(further=(*given.further, *make_further({"edges": edges}, 1.0)))
    return jaxbundle.make_problem(jaxbundle.check_network(given))


def test_every_kind_is_there(problem):
    assert {type(one).TABLE for one in problem.network.further} == KINDS.keys()
    assert any(np.ndim(weight) == 3 for weight in problem.data.weight.values()), "no covariance"


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
    """Values, first derivatives (forward and reverse) and second ones along one direction of all
    data, in one program for five steps: each as by differences of the one before, and the values as
    those of a single call."""
    towards = np.random.default_rng(6).normal(size=len(line.scale))
    along = lambda t: towards @ line(t)

    @jax.jit
    @jax.vmap
    def evaluate(t):
        value, forward = jax.jvp(along, (t,), (1.0,))
        return value, forward, jax.grad(along)(t), jax.hessian(along)(t)

    h = 0.1
    value, forward, first, second = evaluate(h * jnp.arange(-2.0, 3.0))
    assert np.ptp(value) > 1e-4
    np.testing.assert_allclose(value[4], along(2 * h), rtol=1e-9)
    slope = lambda f: (8 * (f[3] - f[1]) - (f[4] - f[0])) / (12 * h)
    np.testing.assert_allclose(forward, first, rtol=1e-8)
    np.testing.assert_allclose(first[2], slope(value), rtol=1e-6)
    np.testing.assert_allclose(second[2], slope(first), rtol=1e-5)


def test_single_precision_is_taken_as_the_numbers_it_holds(line):
    single = jax.tree.map(lambda x: np.asarray(x, np.float32), line.data(0.3))
    double = jax.tree.map(lambda x: np.asarray(x, np.float64), single)
    found, right = (jaxbundle.solve(line.problem, data) for data in (single, double))
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(right), strict=True):
        assert a.dtype == np.float64
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)
