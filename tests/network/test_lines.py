"""Image points on straight lines of object space."""

import dataclasses

import numpy as np
import pytest
from further_checks import check_jacobians, sample

import jaxbundle
from jaxbundle.cameras import get_model, project
from jaxbundle.errors import InputError
from jaxbundle.geometry import matrix_from_omega_phi_kappa
from jaxbundle.network.build import make_further
from jaxbundle.network.conversion import convert_cameras

LINES = {
    "edge": ([0.8, 0.6, 0.1], [0.1, 0.2, 1.0]), "ridge": ([-0.5, 0.9, 0.4], [1.0, -0.3, 0.1]),
    "kerb": ([0.2, -1.0, -0.2], [0.3, 1.0, -0.2]),
}  # fmt: skip
CAMERA = jaxbundle.Camera("cam", "brown", {"c": 25.0, "K1": -2e-4, "x0": 0.1}, ("c", "K1"))
SIGMA = 0.002


@pytest.fixture(scope="module")
def simulated():
    return jaxbundle.simulate_with_truth(
        jaxbundle.ring_of_stations(6, radius=4.0, height=2.5, roll_every=2),
        jaxbundle.cloud_of_targets(14, 1.2, seed=3), CAMERA, noise=SIGMA, seed=4,
        disturb=(0.02, 0.003, 0.02),
    )  # fmt: skip


def seen(truth, noise, seed=1):
    """Rows of `edges`: other points of every line in every image, through the distortion."""
    random, rows = np.random.default_rng(seed), []
    model = get_model("brown")
    parameters = tuple(CAMERA.parameters.get(name, 0.0) for name in model.parameters)
    for id, X0, angles in zip(truth.images.id, truth.images.position, truth.images.angles):
        M = np.asarray(matrix_from_omega_phi_kappa(angles))
        for name, (A, d) in LINES.items():
            X = np.array(A) + random.uniform(-0.6, 0.6, (5, 1)) * np.array(d)
            x, y = project(model, parameters, *((X - X0) @ M.T).T)
            for k in range(5):
                rows.append({"line": name, "image": id, "sigma": SIGMA,
                             "x": float(x[k]) + noise * random.normal(),
                             "y": float(y[k]) + noise * random.normal()})  # fmt: skip
    return rows


def with_lines(network, rows):
    return network.replace(further=make_further({"edges": rows}, 1.0))


@pytest.fixture(scope="module")
def result(simulated):
    return jaxbundle.adjust(with_lines(simulated.network, seen(simulated.truth, SIGMA)))


def test_lines_are_found(simulated, result):
    alone = jaxbundle.adjust(simulated.network)
    assert result.converged and 0.8 < result.sigma0 < 1.2 and result.counts.datum == 7
    assert result.redundancy == alone.redundancy + 3 * 6 * 5 - 3 * 4
    # Distance and angle between two lines, in units of the size of the network: no datum needed.
    found = result.further_unknowns["object line"]
    assert all(one["sigma"] > 0 for row in found.values() for one in row.values())
    size = lambda X: np.linalg.norm(X - X.mean(0))
    scale = size(result.point_values) / size(simulated.truth.points.position)
    M = {n: np.asarray(matrix_from_omega_phi_kappa(np.array(
        [found[n][a]["value"] for a in ("omega", "phi", "kappa")]))) for n in LINES}  # fmt: skip
    A = {n: np.array([found[n][a]["value"] for a in ("X0", "Y0", "Z0")]) for n in LINES}
    unit = {n: np.array(d) / np.linalg.norm(d) for n, (_, d) in LINES.items()}
    for a, b in (("edge", "ridge"), ("ridge", "kerb")):
        angle = lambda u, v: np.degrees(np.arccos(abs(u @ v)))
        assert angle(M[a][2], M[b][2]) == pytest.approx(angle(unit[a], unit[b]), abs=0.1)
        n = np.cross(M[a][2], M[b][2])
        between = abs((A[a] - A[b]) @ n) / np.linalg.norm(n) / scale
        n = np.cross(unit[a], unit[b])
        true = abs((np.array(LINES[a][0]) - LINES[b][0]) @ n) / np.linalg.norm(n)
        assert between == pytest.approx(true, abs=4e-3)
    # They show distortion: straight lines are bent by it (Brown 1971).
    K1 = lambda r: r.cameras["cam"]["parameters"]["K1"]
    assert K1(result)["sigma"] / result.sigma0 < K1(alone)["sigma"] / alone.sigma0
    assert abs(K1(result)["value"] + 2e-4) < 4 * K1(result)["sigma"]


def test_jacobians(result):
    check_jacobians(result.problem, result.values)


@pytest.mark.further
def test_sigma_is_that_of_a_sample(simulated, result):
    """Noise of the points moves the residual across the line by one σ, whatever its direction."""
    problem = jaxbundle.make_problem(with_lines(simulated.truth, seen(simulated.truth, 0.0)))
    found = sample(problem, problem.data.start, ("camera",))["camera"][:, 0]
    names = get_model("brown").parameters
    for name in ("c", "K1"):
        sigma = result.cameras["cam"]["parameters"][name]["sigma"] / result.sigma0
        ratio = found[:, names.index(name)].std() / sigma
        assert abs(ratio - 1) < 4 / np.sqrt(2 * len(found)), name


def test_a_line_in_one_plane_is_refused(simulated):
    rows = [row for row in seen(simulated.truth, 0.0) if row["image"] == "1"]
    with pytest.raises(InputError, match="line 'edge' needs two points in each of two images"):
        jaxbundle.make_problem(with_lines(simulated.network, rows))


def test_a_project_keeps_them(simulated, tmp_path):
    network = with_lines(simulated.network, seen(simulated.truth, 0.0))
    again = jaxbundle.read_network(jaxbundle.write_project(network, tmp_path / "lines"))
    np.testing.assert_allclose(again.further[0].xy, network.further[0].xy, rtol=1e-14)
    assert again.further[0].line == network.further[0].line


def test_a_conversion_of_the_camera_leaves_them_out(simulated):
    network = with_lines(simulated.network, seen(simulated.truth, 0.0))
    camera = dataclasses.replace(network.cameras[0], image_size=(3000, 2000),
                                 pixel_size=(0.012, 0.012))  # fmt: skip
    converted, _ = convert_cameras(network.replace(cameras=(camera,)), "opencv")
    assert converted.further == () and "edges are dropped" in " ".join(converted.warnings)
