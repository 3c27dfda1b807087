"""Parameters that are one unknown: as the model with one focal length, and refused by name."""

import dataclasses
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import jaxbundle
from jaxbundle.adjustment.quality.inspection import Inspection
from jaxbundle.adjustment.readjust import _without_parameter
from jaxbundle.cameras import get_model
from jaxbundle.errors import InputError
from jaxbundle.leastsquares.quality.names import Name
from jaxbundle.leastsquares.spaces import Vector
from jaxbundle.network.build import make_further

PROJECT = Path(__file__).parents[2] / "examples" / "convergent4" / "project.toml"
FREE = ("fx", "fy", "cx", "cy", "k1")
SIZE = {"image_size": (1000, 800), "pixel_size": (0.01, 0.01)}


def network(tie=(("fx", "fy"),), fy=900.0):
    """Ten photographs of a camera of OpenCV's model whose true fx and fy are the same."""
    true = {"fx": 900.0, "fy": fy, "cx": 500.0, "cy": 400.0, "k1": -0.1}
    return jaxbundle.simulate_with_truth(
        jaxbundle.ring_of_stations(6, radius=4.0, height=2.0, roll_every=2),
        jaxbundle.cloud_of_targets(24, 1.5, seed=2),
        jaxbundle.Camera("cam", "opencv", true, FREE, tie=tie, **SIZE),
        noise=0.2, seed=3, disturb=(0.02, 0.002, 0.02),
    )  # fmt: skip


@pytest.fixture(scope="module")
def both():
    """The network with its focal lengths tied, and apart."""
    tied = network()
    return tied, jaxbundle.adjust(tied.network), jaxbundle.adjust(network(()).network)


@pytest.mark.further
def test_one_unknown_less(both):
    truth, tied, apart = both
    assert tied.converged and apart.converged
    assert tied.counts.unknowns == apart.counts.unknowns - 1
    assert tied.redundancy == apart.redundancy + 1
    found = tied.cameras["cam"]
    fx, fy = (found["parameters"][name] for name in ("fx", "fy"))
    assert fx == fy and fx["free"] and fx["sigma"] > 0
    assert found["free"] == ["fx", "cx", "cy", "k1"]
    assert "fx = fy" in tied.report()
    assert abs(fx["value"] - 900.0) < 3.5 * fx["sigma"]


@pytest.mark.further
def test_it_is_the_condition_fx_minus_fy(both):
    """At the same values: cofactors Q − Q·B·(Bᵀ·Q·B)⁻¹·Bᵀ·Q of the network with both free, B of the
    condition fx − fy = 0; and vᵀPv grows by (fx − fy)²/q, to first order."""
    _, tied, apart = both
    pick = lambda values: values["camera"][0, :5]
    of = lambda result: Inspection(result.problem, tied.values).propagate(pick)
    Q, B = of(apart), np.array([1.0, -1.0, 0, 0, 0])
    expected = Q - np.outer(Q @ B, B @ Q) / (B @ Q @ B)
    size = np.sqrt(np.diag(Q))
    assert np.abs((of(tied) - expected) / np.outer(size, size)).max() < 1e-8
    apart_by = B @ [apart.camera_parameters("cam")[p] for p in FREE]
    more = apart_by**2 / (B @ Q @ B)
    assert more > 0.01
    assert tied.vtpv - apart.vtpv == pytest.approx(more, rel=0.05)


def test_a_project_keeps_the_tie(tmp_path):
    path = jaxbundle.write_project(network().network, tmp_path / "tied")
    again = jaxbundle.read_network(path)
    assert again.cameras[0].tie == (("fx", "fy"),)
    apart = jaxbundle.read_network(path, overrides=["camera.cam.tie="])
    assert apart.cameras[0].tie == ()
    other = jaxbundle.read_network(path, overrides=["camera.cam.tie=fx+fy"])
    assert other.cameras[0].tie == (("fx", "fy"),)


@pytest.mark.parametrize("tie, message", [
    ([["fx", "fz"]], "tie names the unknown parameter 'fz'"),
    ([["fx", "fy"], ["fy", "cx"]], "tie names fy twice"),
    ([["fx", "cx"]], "have different values: fx 900, cx 500"),
    (["fx", "fy"], "expected groups of names"),
    ([["fx"]], "expected groups of names"),
])  # fmt: skip
def test_what_is_wrong_is_named(tie, message):
    row = {"id": "cam", "model": "opencv", "fx": 900.0, "fy": 900.0, "cx": 500.0, "tie": tie}
    with pytest.raises(InputError, match=message):
        jaxbundle.make_network([row], [{"id": "a", "camera": "cam"}],
                               [{"id": "1", "role": "tie", "X": 0.0, "Y": 0.0, "Z": 0.0}],
                               [{"image": "a", "point": "1", "x": 0.0, "y": 0.0}])  # fmt: skip


def test_the_space_of_tied_numbers():
    space = Vector(4, (0, 2), ((1, 0),))
    value, change = np.array([5.0, 5.0, 1.0, 7.0]), np.array([0.5, -0.25])
    moved = np.asarray(space.retract(jnp.asarray(value), change))
    np.testing.assert_array_equal(moved, [5.5, 5.5, 0.75, 7.0])
    np.testing.assert_array_equal(space.move(tuple(value), tuple(change)), moved)
    np.testing.assert_array_equal(space.difference(moved, value), change)
    held = space.hold(jnp.asarray(moved), value, np.array([0.0, 1.0]))
    np.testing.assert_array_equal(held, [5.0, 5.0, 0.75, 7.0])


# --- over cameras ---------------------------------------------------------------------------

PAIR = ("c", "K1")


def two_cameras(K1=(1e-4, 1e-4), **tables):
    """Twelve photographs, by two cameras in turn, whose true c is the same."""
    cameras = [
        jaxbundle.Camera(id, "brown", {"c": 24.0, "K1": k}, ("c", "K1"))
        for id, k in zip(("left", "right"), K1)
    ]
    network = jaxbundle.simulate(
        jaxbundle.ring_of_stations(12, radius=4.0, height=2.0, roll_every=2),
        jaxbundle.cloud_of_targets(24, 1.5, seed=2), cameras, camera_of_station=[0, 1] * 6,
        noise=0.0005, seed=3, distances=[(0, 5)],
    )  # fmt: skip
    return network.replace(further=make_further(tables, 1.0)) if tables else network


def rows(*parameters, **more):
    number = len(parameters)
    columns = {"camera": ["left"] * number, "other": ["right"] * number}
    return {**columns, "parameter": [*parameters], **more}


@pytest.fixture(scope="module")
def pair():
    return jaxbundle.adjust(two_cameras(ties=rows(*PAIR))), jaxbundle.adjust(two_cameras())


def test_a_parameter_of_two_cameras_is_one(pair):
    tied, apart = pair
    assert tied.converged and tied.redundancy == apart.redundancy + 2
    sigma = {name: apart.cameras["left"]["parameters"][name]["sigma"] for name in PAIR}
    for name in PAIR:
        left, right = (tied.camera_parameters(id)[name] for id in ("left", "right"))
        assert abs(left - right) < 1e-4 * sigma[name]
    kinds = tied.residuals["kind"].tolist()
    assert kinds.count("same parameters") == 2
    assert "same parameters" in tied.variance_components


def test_it_is_the_condition_left_minus_right(pair):
    """Cofactors Q − Q·B·(Bᵀ·Q·B)⁻¹·Bᵀ·Q, at the same values, but for what an exact σ leaves."""
    tied, apart = pair
    columns = [get_model("brown").parameters.index(name) for name in PAIR]
    pick = lambda values: values["camera"][:, jnp.array(columns)].ravel()
    Q = Inspection(apart.problem, tied.values).propagate(pick)
    B = np.array([[1.0, 0, -1, 0], [0, 1, 0, -1]]).T
    expected = Q - Q @ B @ np.linalg.solve(B.T @ Q @ B, B.T @ Q)
    size = np.sqrt(np.diag(Q))
    off = (Inspection(tied.problem, tied.values).propagate(pick) - expected) / np.outer(size, size)
    assert np.abs(off).max() < 1e-5


@pytest.mark.further
def test_a_sigma_of_the_difference_lets_it_move():
    """With σ as large as those of the parameters themselves the difference is about halved."""
    free = jaxbundle.adjust(two_cameras((1e-4, 1.05e-4)))
    s = free.cameras["left"]["parameters"]["K1"]["sigma"]
    network = two_cameras((1e-4, 1.05e-4), ties=rows("K1", sigma=[s]))
    found = jaxbundle.adjust(network)
    of = lambda result: np.diff([result.camera_parameters(i)["K1"] for i in ("left", "right")])[0]
    column = jnp.array([get_model("brown").parameters.index("K1")])
    Q = Inspection(free.problem, found.values).propagate(
        lambda v: v["camera"][1, column] - v["camera"][0, column]
    )[0, 0]
    assert of(found) == pytest.approx(of(free) * s**2 / (s**2 + Q), rel=0.05)


@pytest.mark.parametrize("table, message", [
    (rows("c") | {"other": ["rigth"]}, "camera 'rigth' is unknown; did you mean 'right'"),
    (rows("k1"), "camera 'left' has no 'k1'; did you mean 'K1'"),
    (rows("c") | {"other": ["left"]}, "expected two different cameras"),
    (rows("x0"), "x0 is free in neither 'left' nor 'right'"),
    (rows("c", sigma=[-1.0]), "sigma is -1; it must be positive"),
    (rows("c", sigma=[1e-200]), "sigma is 1e-200; it must be between 1e-75"),
])  # fmt: skip
def test_ties_that_cannot_be_are_refused(table, message):
    with pytest.raises(InputError, match=message):
        for one in (network := two_cameras(ties=table)).further:
            one.check(network)


def test_a_parameter_is_free_with_any_of_those_tied_to_it_in_its_camera():
    network = two_cameras()
    cameras = [
        jaxbundle.Camera(id, "opencv", {"fx": 900.0, "fy": 900.0}, ("fx",), tie=(("fx", "fy"),))
        for id in ("left", "right")
    ]
    (ties,) = make_further({"ties": rows("fy")}, 1.0)
    ties.check(network.replace(cameras=tuple(cameras)))


def test_ties_are_written_and_read(tmp_path):
    network = two_cameras(ties=rows(*PAIR, sigma=["exact", 1e-6]))
    jaxbundle.write_project(network, tmp_path)
    (again,) = jaxbundle.read_network(tmp_path).further
    (given,) = network.further
    assert again.columns(1.0) == given.columns(1.0)


@pytest.mark.parametrize("prior", ["b1", "b2"])
def test_a_prior_of_a_tied_parameter_goes_with_it(prior):
    """Held at 0, all parameters of a tie are constants: a prior of any of them observes nothing."""
    given = jaxbundle.read_network(PROJECT)
    camera = dataclasses.replace(given.cameras[0], free=("c", "b1", "b2"), tie=(("b1", "b2"),))
    counts = []
    for sigma in ({}, {prior: 1e-4}):
        cameras = (dataclasses.replace(camera, sigma=sigma),)
        problem = jaxbundle.make_problem(given.replace(cameras=cameras))
        held, _ = _without_parameter(problem, problem.data.start, Name("camera", camera.id, "b1"))
        counts.append(held.counts)
    assert counts[0].unknowns == counts[1].unknowns
    assert counts[0].observations == counts[1].observations
