"""Cameras whose lines are exposed one after the other."""

import dataclasses

import numpy as np
import pytest
from further_checks import check_jacobians, sample
from scipy.spatial.transform import Rotation

import jaxbundle
from jaxbundle.batches.population import Population
from jaxbundle.batches.work import network_row
from jaxbundle.cameras import get_model, project
from jaxbundle.errors import InputError
from jaxbundle.geometry import matrix_from_omega_phi_kappa
from jaxbundle.network.build import make_further
from jaxbundle.network.equation_counts import equations_of

LINE = 3e-5
CAMERA = jaxbundle.Camera(
    "cam", "opencv", {"fx": 3000.0, "fy": 3000.0, "cx": 2000.0, "cy": 1500.0}, (),
    image_size=(4000, 3000),
)  # fmt: skip
SIGMA = 0.3


@pytest.fixture(scope="module")
def flown():
    """Six photographs of a moving camera, a hundred points, eight of them control; the truth, and
    the true velocities."""
    random = np.random.default_rng(6)
    stations = jaxbundle.aerial_block(
        strips=2, images_per_strip=3, height=50.0, footprint=(66.0, 50.0), forward_overlap=0.7,
        side_overlap=0.5,
    )  # fmt: skip
    turns = random.uniform(-0.1, 0.1, (6, 3))
    stations = dataclasses.replace(stations, angles=stations.angles + turns)
    X = random.uniform([-50, -45, -5], [50, 45, 5], (100, 3))
    made = jaxbundle.simulate_with_truth(
        stations, X, CAMERA, noise=SIGMA, seed=3, datum="control", control=list(range(8)),
        control_sigma=0.01, disturb=(0.2, 0.002, 0.2),
    )  # fmt: skip
    velocity = np.concatenate(
        [random.normal(size=(6, 3)) * [12, 3, 1], random.normal(size=(6, 3)) * 0.2], 1
    )
    return made, velocity


def seen(truth, velocity):
    """The image coordinates of a moving camera, by iteration of the line, turned by
    scipy."""
    rays, images = truth.observations, truth.images
    M = np.array([np.asarray(matrix_from_omega_phi_kappa(a)) for a in images.angles])
    model, xy = get_model("opencv"), rays.xy.copy()
    parameters = tuple(CAMERA.parameters.get(name, 0.0) for name in model.parameters)
    for _ in range(30):
        t = (LINE * (xy[:, 1] - 1499.5))[:, None]
        v = velocity[rays.image]
        away = truth.points.position[rays.point] - images.position[rays.image] - v[:, :3] * t
        ray = np.einsum("nij,nj->ni", M[rays.image], away)
        ray = Rotation.from_rotvec(v[:, 3:] * t).apply(ray)
        xy = np.stack(project(model, parameters, *ray.T), 1)
    return xy


def moving(network, xy, **section):
    section = {"line_time": LINE, "free": ["vX", "vY", "vZ", "wx", "wy", "wz"]} | section
    network = jaxbundle.add_further(
        network, velocities={"image": list(network.images.id)}, rolling_shutter=section
    )
    return network.replace(observations=dataclasses.replace(network.observations, xy=xy))


def noisy(flown):
    made, velocity = flown
    random = np.random.default_rng(9)
    xy = seen(made.truth, velocity)
    return moving(made.network, xy + SIGMA * random.normal(size=xy.shape))


@pytest.fixture(scope="module")
def result(flown):
    return jaxbundle.adjust(noisy(flown))


def test_at_rest_it_is_the_camera_of_always(flown):
    made, velocity = flown
    np.testing.assert_allclose(seen(made.truth, 0 * velocity), made.truth.observations.xy,
                               atol=1e-8)  # fmt: skip


def test_image_points_are_simulated_as_the_formula_says(flown):
    """Those of `seen`, with the noise they had; of one that moves too fast there are none."""
    made, velocity = flown
    network = moving(made.network, made.network.observations.xy)
    noise = made.network.observations.xy - made.truth.observations.xy
    found = jaxbundle.simulate_further(network, made.truth, unknowns={"velocity": velocity})
    np.testing.assert_allclose(found.observations.xy - noise, seen(made.truth, velocity), atol=1e-7)
    assert len(found.further) == 1
    with pytest.raises(InputError, match="so fast that an image point has no line"):
        unknowns = {"velocity": 300 * velocity}
        jaxbundle.simulate_further(network, made.truth, unknowns=unknowns)
    with pytest.raises(InputError, match="network and truth have other image points"):
        fewer = network.replace(observations=network.observations.take(np.arange(100)))
        jaxbundle.simulate_further(fewer, made.truth, unknowns={"velocity": velocity})


def test_added_angles_have_the_unit_of_the_network(flown):
    network = flown[0].network.replace(angle_unit="deg")
    row = dict.fromkeys(("omega", "phi", "kappa"), [90.0]) | {"image": [network.images.id[0]]}
    row |= dict.fromkeys(("somega", "sphi", "skappa"), [1.0])
    (rows,) = jaxbundle.add_further(network, attitudes=row).further
    np.testing.assert_allclose(rows.angles, np.pi / 2)
    # three angles of one image
    equations = equations_of(network.replace(further=(rows,)), "IMAGES")
    assert equations.tolist() == [3] + [0] * (len(network.images) - 1)
    (rows,) = jaxbundle.add_further(network, attitudes=row, angle_unit="gon").further
    np.testing.assert_allclose(rows.angles, 0.45 * np.pi)
    with pytest.raises(InputError, match="in the unit of the network, deg.*got angle_unit 'rad'"):
        boresight = {"boresight": [0.1, 0.0, 0.0]}
        jaxbundle.add_further(network, attitudes=row, attitude=boresight, angle_unit="rad")
    # Settings without angles are in no unit of angles.
    velocities, section = {"image": [network.images.id[0]]}, {"line_time": LINE}
    jaxbundle.add_further(
        network, velocities=velocities, rolling_shutter=section, angle_unit="rad"
    )


def test_further_observations_are_added_in_place_of_their_kind(flown):
    network = moving(flown[0].network, flown[0].network.observations.xy)
    levelled = {"from": ["1"], "to": ["2"], "dZ": [1.0], "sdZ": [0.1]}
    both = jaxbundle.add_further(network, differences=levelled)
    assert [one.TABLE for one in both.further] == ["velocities", "differences"]
    again = moving(both, both.observations.xy, line_time=1e-5)
    assert [one.TABLE for one in again.further] == ["differences", "velocities"]
    assert again.further[1].settings["line_time"] == 1e-5
    with pytest.raises(InputError, match="row 1: .*point 'P'"):
        jaxbundle.add_further(network, differences=levelled | {"to": ["P"]})


def test_velocities_are_found(flown, result):
    _, velocity = flown
    assert result.converged and 0.8 < result.sigma0 < 1.2
    found = result.unknowns("velocity")
    assert (found.sigma > 0).all()
    assert (np.abs(found.value - velocity) < 4 * found.sigma).all()
    assert np.abs(velocity / found.sigma).max() > 20  # they are seen
    assert result.residuals["r"].sum() == pytest.approx(result.redundancy, abs=1e-5)
    assert "Velocity" in result.report() and "wz" in result.report()


def test_exact_image_points_lead_to_the_truth(flown):
    made, velocity = flown
    found = jaxbundle.adjust(moving(made.truth, seen(made.truth, velocity)))
    assert found.vtpv < 1e-10
    np.testing.assert_allclose(found.unknowns("velocity").value, velocity, atol=1e-5)


def test_jacobians(result):
    check_jacobians(result.problem, result.values, skip=("control points",))


def test_sigma_is_that_of_a_sample(flown, result):
    made, velocity = flown
    problem = jaxbundle.make_problem(moving(made.truth, seen(made.truth, velocity)))
    found = sample(problem, result.values, ("velocity",))
    ratio = found["velocity"].std(0) / (result.unknowns("velocity").sigma / result.sigma0)
    assert (np.abs(ratio - 1) < 5 / np.sqrt(2 * len(found["velocity"]))).all(), ratio


@pytest.mark.further
def test_a_still_camera_does_not_know_its_line_time(flown):
    """Velocities of 0 known to 1 mm/s, the line time free: only their product would show."""
    made, velocity = flown
    sigma = dict.fromkeys(("vX", "vY", "vZ", "wx", "wy", "wz"), 1e-3)
    network = moving(made.network, made.network.observations.xy, sigma=sigma,
                     free=["vX", "vY", "vZ", "wx", "wy", "wz", "line_time"])  # fmt: skip
    found = jaxbundle.adjust(network)
    words = " ".join(map(str, found.undetermined)) + " ".join(found.warnings)
    assert not found.converged or "line_time" in words
    assert "line_time of read-out of camera cam" in words


def test_a_project_keeps_them(flown, result, tmp_path):
    network = noisy(flown)
    path = jaxbundle.write_project(network, tmp_path / "moving")
    again = jaxbundle.read_network(path, overrides=["rolling_shutter.line_time=2e-5"])
    assert again.further[0].settings["line_time"] == 2e-5
    assert list(again.further[0].settings["free"]) == ["vX", "vY", "vZ", "wx", "wy", "wz"]
    assert again.further[0].image == network.further[0].image
    row = network_row(str(path), max_iterations=100)  # the line of a batch
    found = row["further_unknowns"]["velocity"]
    assert list(found) == list(network.images.id) and row["status"] == "converged"
    vx = result.further_unknowns["velocity"][network.images.id[0]]["vX"]
    assert found[network.images.id[0]]["vX"]["sigma"] == pytest.approx(vx["sigma"], rel=1e-6)
    assert not any("velocity" in name for name in Population([row | {"key": "moving"}]).values)


# --- velocities from neighbours -------------------------------------------------------------

TIME, STRIP = np.array([0.0, 2, 4.5, 10, 12, 14]), list("aaabbb")
NEIGHBOURS = {"v": 0.05, "w": 0.002}


def between_neighbours(images):
    """From the pose before to the pose after, by scipy."""
    M = [np.asarray(matrix_from_omega_phi_kappa(a)) for a in images.angles]
    found = []
    for k in range(6):
        a, b = max(k - 1, 3 * (k // 3)), min(k + 1, 3 * (k // 3) + 2)
        turn = Rotation.from_matrix(M[b] @ M[a].T).as_rotvec()
        shift = images.position[b] - images.position[a]
        found.append(np.concatenate([shift, turn]) / (TIME[b] - TIME[a]))
    return np.array(found)


def with_neighbours(network, xy):
    network = moving(network, xy)
    order = [3, 0, 5, 1, 4, 2]
    table = {"image": [network.images.id[k] for k in order], "t": TIME[order],
             "strip": [STRIP[k] for k in order]}  # fmt: skip
    section = network.further[0].settings | {"neighbours": NEIGHBOURS}
    return network.replace(
        further=make_further({"velocities": table, "rolling_shutter": section}, 1.0)
    )


@pytest.mark.further
def test_neighbours_tell_velocities(flown, result):
    made, _ = flown
    truth = made.truth.images
    random = np.random.default_rng(4)
    sigma = np.repeat([NEIGHBOURS["v"], NEIGHBOURS["w"]], 3)
    velocity = between_neighbours(truth) + sigma * random.normal(size=(6, 6))
    xy = seen(made.truth, velocity)
    network = with_neighbours(made.network, xy + SIGMA * random.normal(size=xy.shape))
    found = jaxbundle.adjust(network)
    assert found.converged and 0.8 < found.sigma0 < 1.2
    of = found.unknowns("velocity")
    assert (np.abs(of.value - velocity) < 4 * of.sigma).all()
    assert (of.sigma < 1.3 * sigma).all()
    assert (of.sigma[:, 3:] < 0.7 * result.unknowns("velocity").sigma[:, 3:]).any()
    assert found.residuals["kind"].tolist().count("velocities of neighbours") == 36
    check_jacobians(found.problem, found.values, skip=("control points", "image coordinates"))


def test_free_parameters_are_a_list(flown):
    """Not a word, of which every letter would be one."""
    xy = flown[0].network.observations.xy
    with pytest.raises(InputError, match=r"\[rolling_shutter\]: free is 'vX'; expected a list"):
        moving(flown[0].network, xy, free="vX")


def test_neighbours_need_times(flown, tmp_path):
    made, _ = flown
    with pytest.raises(InputError, match="row 1: t, the time of exposure, is missing"):
        moving(made.network, made.network.observations.xy, neighbours=NEIGHBOURS)
    with pytest.raises(InputError, match="expected the σ of velocities and turns"):
        moving(made.network, made.network.observations.xy, neighbours=3)
    network = with_neighbours(made.network, made.network.observations.xy)
    again = jaxbundle.read_network(jaxbundle.write_project(network, tmp_path / "timed"))
    np.testing.assert_array_equal(again.further[0].time, network.further[0].time)
    assert again.further[0].strip == network.further[0].strip


def test_the_line_is_needed(flown):
    made, _ = flown
    network = moving(made.network, made.network.observations.xy)
    camera = dataclasses.replace(network.cameras[0], image_size=None)
    with pytest.raises(InputError, match="camera 'cam': image_size is needed for the exp"):
        jaxbundle.make_problem(network.replace(cameras=(camera,)))
    for given, said in ("fast", "'fast'"), ({"cam": True}, "True"), (np.nan, "nan"):
        network = moving(made.network, made.network.observations.xy, line_time=given)
        with pytest.raises(InputError, match=f"line_time must be a number, but is {said}"):
            jaxbundle.make_problem(network)
    with pytest.raises(InputError, match=r"\[rolling_shutter\]: line_time is missing"):
        make_further({"velocities": {"image": ["IMG 1"]}}, 1.0)


@pytest.mark.parametrize("images, line_time, message", [
    (["1", "2", "1"], LINE, "row 3: .*image '1'.* row 1"),
    (["1"], {"cam": LINE, "carn": LINE}, "line_time names no camera 'carn'; known: cam"),
])  # fmt: skip
def test_what_is_wrong_is_named(flown, images, line_time, message):
    section = {"line_time": line_time}
    (further,) = make_further({"velocities": {"image": images}, "rolling_shutter": section}, 1.0)
    with pytest.raises(InputError, match=message):
        further.check(flown[0].network)
