"""Given mountings of rigs: held, weighted, partly known; bases; what they give the network."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from further_checks import check_jacobians, sample
from scipy.spatial.transform import Rotation

import jaxbundle
from jaxbundle.errors import InputError
from jaxbundle.geometry import (
    matrix_from_omega_phi_kappa,
    matrix_from_quaternion,
    omega_phi_kappa_from_matrix,
)
from jaxbundle.network.build import make_further
from jaxbundle.network.kinds.mountings import observe_mountings, read_mountings
from jaxbundle.network.kinds.rigs import MountedPose, _start_mounting
from jaxbundle.planning.stations import Stations

T = np.array([0.3, 0.02, -0.01])
R = Rotation.from_euler("xyz", [0.02, -0.1, 0.05]).as_matrix()
ANGLES = np.asarray(omega_phi_kappa_from_matrix(R))
EPOCHS = 5


@pytest.fixture(scope="module")
def simulated():
    """Left and right camera at five epochs; the object unit is that of the truth."""
    left = jaxbundle.ring_of_stations(EPOCHS, radius=4.0, height=2.0, roll_every=2)
    M = np.array([np.asarray(matrix_from_omega_phi_kappa(a)) for a in left.angles])
    right = Stations(
        left.position + M.transpose(0, 2, 1) @ T,
        np.array([np.asarray(omega_phi_kappa_from_matrix(R @ m)) for m in M]),
    )
    camera = lambda id, c: jaxbundle.Camera(id, "brown", {"c": c}, ("c",))
    return jaxbundle.simulate_with_truth(
        left + right, jaxbundle.cloud_of_targets(25, 1.5, seed=4),
        [camera("left", 20.0), camera("right", 22.0)],
        camera_of_station=[0] * EPOCHS + [1] * EPOCHS, noise=0.002, seed=2,
        disturb=(0.01, 0.002, 0.01),
    )  # fmt: skip


def rig(network, **section):
    """Angles in radians."""
    ids = network.images.id
    rows = [{"rig": "pair", "epoch": str(e), "image": ids[e + k * EPOCHS]}
            for k in (0, 1) for e in range(EPOCHS)]  # fmt: skip
    network = network.replace(angle_unit="rad")
    further = make_further({"rigs": rows, "rig": {"reference": "left"} | section}, 1.0)
    for one in further:
        one.check(network)
    return network.replace(further=further)


def scaled(network, factor):
    """The network with start values of another size."""
    position = lambda x: type(x)(**{**vars(x), "position": factor * x.position})
    return network.replace(images=position(network.images), points=position(network.points))


def size(points):
    return np.sqrt(((points - points.mean(0)) ** 2).sum(1).mean())


def mounting_of(result):
    found = result.further_unknowns["mounting"]["right of pair"]
    return (np.array([one[key] for one in found.values()]) for key in ("value", "sigma"))


GIVEN = {"position": T.tolist(), "angles": ANGLES.tolist()}


@pytest.mark.further
def test_a_held_mounting_is_held_and_gives_the_scale(simulated):
    """From start values that are 3 % too large: the size of the truth comes back."""
    network = rig(scaled(simulated.network, 1.03), mounting={"right": GIVEN})
    result = jaxbundle.adjust(network)
    assert result.converged and result.counts.datum == 6
    value, sigma = mounting_of(result)
    np.testing.assert_allclose(value, [*T, *ANGLES], atol=1e-12)
    assert (sigma == 0).all()
    ratio = size(result.point_values) / size(simulated.truth.points.position)
    # the size is known as well as the base by the rays: a part in a thousand
    assert abs(ratio - 1) < 3e-3
    free = jaxbundle.adjust(rig(simulated.network))
    assert result.redundancy == free.redundancy + 5  # six unknowns fewer, and one datum condition
    assert "the scale is that of the rig" in result.report()


@pytest.mark.further
def test_a_weighted_mounting_is_the_weighted_mean(simulated):
    """Of the given one and of what the images say with a free mounting and the same scale."""
    sigma = np.array([3e-4, 3e-4, 3e-4, 2e-4, 2e-4, 2e-4])
    off = np.array([2e-4, -3e-4, 1e-4, 1e-4, -2e-4, 1e-4])
    given = {
        "position": (T + off[:3]).tolist(), "angles": ANGLES.tolist(),
        "sigma_position": 3e-4, "sigma_angle": [2e-4] * 3,
    }  # fmt: skip
    base = [{"cameras": ["left", "right"], "length": float(np.linalg.norm(T)), "sigma": 1e-5}]
    # with free principal distances the depth of the mounting is too uncertain for a linear mean
    network = simulated.network
    network = network.replace(cameras=[dataclasses.replace(c, free=()) for c in network.cameras])
    images_only = jaxbundle.adjust(rig(network, bases=base))
    both = jaxbundle.adjust(rig(network, bases=base, mounting={"right": given}))
    x1, _ = mounting_of(images_only)
    x2, s2 = mounting_of(both)
    # parameter by parameter in the table of the engine: ω, φ, κ are near the rotation vector here
    C1 = covariance_of_mounting(images_only)
    x0 = np.array([*(T + off[:3]), *ANGLES])
    W = np.linalg.inv(C1) + np.diag(sigma**-2.0)
    expected = np.linalg.solve(W, np.linalg.solve(C1, x1) + x0 / sigma**2)
    tolerance = 0.05 * np.sqrt(np.diag(np.linalg.inv(W)))
    assert (np.abs(x2 - expected) < tolerance).all(), (x2 - expected) / tolerance
    np.testing.assert_allclose(s2 / both.sigma0, np.sqrt(np.diag(np.linalg.inv(W))), rtol=0.03)


@pytest.mark.further
def test_sigma_is_that_of_a_sample(simulated):
    """Of the mounting and of a principal distance, with the given mounting drawn as well."""
    given = GIVEN | {"sigma_position": 1e-3, "sigma_angle": 1e-3}
    problem = jaxbundle.make_problem(rig(simulated.truth, mounting={"right": given}))
    found = sample(problem, problem.data.start, ("mounting", "camera"))
    result = jaxbundle.adjust(rig(simulated.network, mounting={"right": given}))
    _, sigma = mounting_of(result)
    place = found["mounting"][:, 1]
    ratio = place.std(0) / (sigma[:3] / result.sigma0)
    assert (np.abs(ratio - 1) < 4 / np.sqrt(2 * len(place))).all(), ratio


def covariance_of_mounting(result):
    """Of the six unknowns, by σ0 = 1."""
    def unknowns(values):
        pose = values["mounting"]
        angles = omega_phi_kappa_from_matrix(matrix_from_quaternion(pose.rotation[1]))
        return jnp.concatenate([pose.position[1], jnp.stack(list(angles))])

    return np.asarray(result.covariance_of(unknowns)) / result.sigma0**2


@pytest.mark.further
def test_a_covariance_says_what_its_sigmas_say(simulated):
    sigma = np.array([3e-4, 2e-4, 4e-4, 2e-4, 3e-4, 1e-4])
    by_sigma = GIVEN | {"sigma_position": sigma[:3].tolist(), "sigma_angle": sigma[3:].tolist()}
    # about the axes of the camera: the covariance of ω, φ, κ that belongs to it
    h = 1e-6
    turned = lambda a: Rotation.from_matrix(np.asarray(matrix_from_omega_phi_kappa(a)) @ R.T)
    ends = lambda e: turned(ANGLES + h * e).as_rotvec() - turned(ANGLES - h * e).as_rotvec()
    J = np.array([ends(e) / (2 * h) for e in np.eye(3)]).T
    of_angles = np.linalg.inv(J) @ np.diag(sigma[3:] ** 2) @ np.linalg.inv(J).T
    C = np.zeros((6, 6))
    C[:3, :3], C[3:, 3:] = np.diag(sigma[:3] ** 2), of_angles
    one = jaxbundle.adjust(rig(simulated.network, mounting={"right": by_sigma}))
    two = jaxbundle.adjust(
        rig(simulated.network, mounting={"right": GIVEN | {"covariance": C.tolist()}})
    )
    assert one.sigma0 == pytest.approx(two.sigma0, rel=1e-9)
    np.testing.assert_allclose(two.point_values, one.point_values, atol=1e-7)


def test_a_base_gives_the_scale_with_its_sigma(simulated):
    length = float(np.linalg.norm(T))
    base = [{"cameras": ["right", "left"], "length": length, "sigma": 0.01 * length}]
    result = jaxbundle.adjust(rig(scaled(simulated.network, 1.02), bases=base))
    assert result.converged and result.counts.datum == 6
    value, _ = mounting_of(result)
    # one base alone is met; the σ of the scale is that of the base, a hundredth
    assert np.linalg.norm(value[:3]) == pytest.approx(length, rel=1e-6)
    assert "the scale is that of the rig" in result.report() and "(1 %)" in result.report()


@pytest.mark.further
def test_what_is_known_of_some_axes_alone(simulated):
    """In the plane Y = 0.02 and with parallel x axes, within σ: the other axes stay free."""
    inf = float("inf")
    given = GIVEN | {"sigma_position": [inf, 1e-5, inf], "sigma_angle": [1e-6, inf, inf]}
    result = jaxbundle.adjust(rig(simulated.network, mounting={"right": given}))
    value, sigma = mounting_of(result)
    assert abs(value[1] - T[1]) < 3e-5 and sigma[1] < 1.2e-5
    found = np.asarray(matrix_from_omega_phi_kappa(value[3:]))
    turn = Rotation.from_matrix(found @ R.T).as_rotvec()
    assert abs(turn[0]) < 3e-6 < np.abs(turn[1:]).max()
    assert sigma[[0, 2]].min() > 2e-5


@pytest.mark.parametrize("given, known", [
    ({"position": T.tolist()}, True),  # held
    ({"position": T.tolist(), "sigma_position": 0.1}, True),  # whatever the angles are
    ({"position": T.tolist(), "sigma_position": [0.1, 0.1, float("inf")]}, False),
    ({"angles": ANGLES.tolist()}, False),
])  # fmt: skip
def test_a_mounting_of_known_position_has_a_base(given, known):
    """All three coordinates of it: with one unknown the base may have any length above."""
    (mounting,) = read_mountings("rig", {"right": given}, 1.0).values()
    assert mounting.length == (pytest.approx(np.linalg.norm(T)) if known else None)


def test_mountings_with_sigma_are_observed_and_held_ones_are_not():
    """Those with a covariance on their own: their axes are not independent."""
    C = np.diag([1e-6] * 6)
    given = {
        "held": GIVEN, "weighted": GIVEN | {"sigma_position": 1e-3, "sigma_angle": 1e-3},
        "correlated": GIVEN | {"covariance": C.tolist()},
    }  # fmt: skip
    found = observe_mountings([1, 2, 3], [*read_mountings("rig", given, 1.0).values()])
    rows = {one.name: one.rows[0].tolist() for one in found}
    assert rows == {"given mountings": [2], "correlated mountings": [3]}


@pytest.mark.parametrize("sigma", [{}, {"sigma_position": 1e-3, "sigma_angle": 1e-3}])
def test_a_mounting_starts_where_the_images_are_unless_it_is_held(sigma):
    """A weighted one may be far from them; where nothing connects a camera with the reference,
    there is nothing else."""
    (known,) = read_mountings("rig", {"right": GIVEN | sigma}, 1.0).values()
    images = MountedPose(T + 0.1, np.eye(3))
    start, alone = _start_mounting(images, known), _start_mounting(None, known)
    held = not sigma
    np.testing.assert_allclose(start.position, T if held else images.position)
    np.testing.assert_allclose(start.rotation, R if held else images.rotation, atol=1e-12)
    np.testing.assert_allclose(alone.position, T)
    np.testing.assert_allclose(alone.rotation, R, atol=1e-12)


@pytest.mark.further
def test_start_values_have_the_scale_of_the_base(simulated):
    """Without any start value, twice: the object is as large as the base says."""
    for factor in (1.0, 1000.0):
        bases = [{"cameras": ["left", "right"], "length": factor * float(np.linalg.norm(T)),
                  "sigma": factor * 1e-4}]  # fmt: skip
        network = rig(without_start(simulated.network), bases=bases)
        oriented = jaxbundle.orient(network)
        ratio = size(oriented.network.points.position) / size(simulated.truth.points.position)
        assert ratio == pytest.approx(factor, rel=0.05)
        assert "to scale" in oriented.frame


def without_start(network):
    nan = lambda x, *names: type(x)(**{**vars(x), **{n: np.full_like(vars(x)[n], np.nan)
                                                     for n in names}})  # fmt: skip
    return network.replace(
        images=nan(network.images, "position", "angles"), points=nan(network.points, "position")
    )


def test_jacobians(simulated):
    given = GIVEN | {"sigma_position": 1e-3, "sigma_angle": 1e-3}
    base = [{"cameras": ["left", "right"], "length": 0.3, "sigma": 1e-3}]
    problem = jaxbundle.make_problem(rig(simulated.network, mounting={"right": given}, bases=base))
    check_jacobians(problem, problem.data.start)


@pytest.mark.parametrize("section, message", [
    ({"mounting": 3}, "what is known of the mounting of each camera"),
    ({"mounting": {"right": {}}}, r"\[rig.mounting.right\]: give position, angles, or both"),
    ({"mounting": {"right": {"positon": [1, 2, 3]}}}, "unknown key 'positon'"),
    ({"mounting": {"right": {"position": [1, 2]}}}, "expected 3 numbers"),
    ({"mounting": {"right": GIVEN | {"sigma_angle": 0}}}, "expected one σ, or three, positive"),
    ({"mounting": {"right": {"angles": [0, 0, 0], "sigma_position": 1}}}, "without position"),
    ({"mounting": {"right": GIVEN | {"covariance": [[0] * 6] * 6}}}, "positive definite"),
    ({"mounting": {"right": GIVEN | {"covariance": np.eye(6).tolist(), "sigma_angle": 1}}},
     "covariance, or sigma_position"),
    *(({"mounting": {"right": {one: [1, 2, 3], "covariance": np.eye(6).tolist()}}}, "give both")
      for one in ("position", "angles")),
    ({"mounting": {"rihgt": GIVEN}}, "no rig has a camera 'rihgt'.*right"),
    ({"mounting": {"left": GIVEN}}, "'left' is the reference camera"),
    ({"bases": [{"cameras": ["left", "left"], "length": 1, "sigma": 1}]}, "two names"),
    ({"bases": [{"cameras": ["left", "right"], "length": -1, "sigma": 1}]}, "length"),
    ({"bases": [{"cameras": ["left", "right"], "length": 1}]}, "sigma"),
    ({"bases": [{"cameras": ["left", "middle"], "length": 1, "sigma": 1}]}, "no rig has a camera"),
    ({"bases": 1}, "expected a list"),
])  # fmt: skip
def test_what_is_wrong_is_named(simulated, section, message):
    with pytest.raises(InputError, match=message):
        jaxbundle.make_problem(rig(simulated.network, **section))


def test_in_a_project_and_back(simulated, tmp_path):
    """Written, read, overridden on the command line."""
    given = GIVEN | {"sigma_position": [1e-3, float("inf"), 1e-3]}
    base = [{"cameras": ["left", "right"], "length": 0.3, "sigma": 1e-3}]
    network = rig(simulated.network, mounting={"right": given}, bases=base)
    path = jaxbundle.write_project(network, tmp_path / "pair")
    again = jaxbundle.read_network(str(path))
    assert again.further[0].settings == network.further[0].settings
    changed = jaxbundle.read_network(
        str(path), overrides=("rig.mounting.right.sigma_angle=0.001",)
    )
    assert changed.further[0].settings["mounting"]["right"]["sigma_angle"] == 0.001
