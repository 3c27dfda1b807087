"""Calibrations of one camera at several epochs: stated against simulated values."""

import dataclasses
import json

import numpy as np
import pytest

from jaxbundle.calibration.stability import stability
from jaxbundle.errors import InputError
from jaxbundle.network.tables import Camera

NAMES = ("fx", "fy", "cx", "cy", "k1", "k2")
TRUTH = np.array([620.0, 621.0, 242.0, 178.0, -0.12, 0.05])
SIGMA = np.array([0.2, 0.2, 0.25, 0.22, 0.004, 0.02])


def covariance():
    R = np.eye(6)
    R[0, 1] = R[1, 0] = 0.9
    R[4, 5] = R[5, 4] = -0.8
    return SIGMA[:, None] * R * SIGMA


def epochs(changes, seed=0):
    rng, C = np.random.default_rng(seed), covariance()
    values = TRUTH + np.asarray(changes) + rng.multivariate_normal(np.zeros(6), C, len(changes))
    of = lambda p: Camera("cam", "opencv", dict(zip(NAMES, p.tolist())), image_size=(480, 360))
    return [(of(p), (NAMES, C)) for p in values]


def test_a_stable_camera_is_homogeneous():
    """χ² of both tests over 40 series has the mean of its degrees of freedom."""
    found = [stability(epochs(np.zeros((6, 6)), seed)) for seed in range(40)]
    for of, degrees in (("all_parameters", 30), ("rotation_removed", None)):
        tests = [getattr(one, of) for one in found]
        expected = degrees or tests[0].degrees
        assert tests[0].degrees == expected
        ratio = np.mean([test.chi2 for test in tests]) / expected
        assert ratio == pytest.approx(1, abs=5 * np.sqrt(2 / expected / 40))
    assert found[0].rotation_removed.degrees == 5 * 4  # two changes are nearly rotations
    ratio = np.mean([one.image_found**2 / one.image_expected**2 for one in found])
    assert ratio == pytest.approx(1, abs=0.2)


def test_between_epochs_the_principal_distance_moves():
    random = np.random.default_rng(1)
    tau, found = 0.8, []
    for seed in range(30):
        change = np.zeros((8, 6))
        change[:, :2] = tau * random.normal(size=(8, 1))
        found.append(stability(epochs(change, seed)))
    assert np.mean([one.between[0] ** 2 for one in found]) == pytest.approx(tau**2, rel=0.3)
    assert np.mean([one.rotation_removed.probability < 0.01 for one in found]) > 0.9
    assert np.mean([one.image_between > one.image_expected for one in found]) > 0.9
    # σ of the mean holds the variance between epochs
    error = np.array([(one.mean[0] - TRUTH[0]) / one.mean_sigma[0] for one in found])
    assert np.sqrt(np.mean(error**2)) == pytest.approx(1, abs=0.4)


def test_a_shift_of_the_principal_point_is_nearly_a_rotation():
    change = np.zeros((6, 6))
    change[:, 2] = [0, 2, 0, 2, 0, 2]
    found = stability(epochs(change))
    assert found.all_parameters.probability < 1e-9 < found.rotation_removed.probability
    assert found.probability[2] < 1e-6


def test_a_slope_with_temperature():
    at = np.arange(6) * 10.0
    change = np.zeros((6, 6))
    change[:, :2] = 0.05 * at[:, None]
    found = stability(epochs(change), at)
    assert found.slope is not None and found.slope_sigma is not None
    assert abs(found.slope[0] - 0.05) < 4 * found.slope_sigma[0] < 0.2
    assert found.to_dict()["parameters"]["fx"]["slope"] == found.slope[0]


@pytest.mark.further
def test_scatter_about_a_slope():
    """Seven epochs on a line with scatter: the line's τ is the scatter alone, the slope's σ and its
    probability are correct if there is no trend."""
    at, tau, none, steep = np.array([3.0, 8, 12, 15, 22, 26, 31]), 0.4, [], []
    random = np.random.default_rng(7)
    for seed in range(60):
        change = np.zeros((7, 6))
        change[:, :2] = tau * random.normal(size=(7, 1))
        none.append(stability(epochs(change, seed), at))
        change[:, :2] += 0.5 * at[:, None]
        steep.append(stability(epochs(change, seed), at))
    of = lambda series, name: np.array([getattr(one, name)[0] for one in series])
    assert np.mean(of(steep, "about_slope") ** 2) == pytest.approx(tau**2, rel=0.3)
    error = (of(steep, "slope") - 0.5) / of(steep, "slope_sigma")
    assert np.sqrt(np.mean(error**2)) == pytest.approx(1, abs=0.45)
    assert of(steep, "slope_probability").max() < 0.01
    assert 0.01 < np.mean(of(none, "slope_probability") < 0.1) < 0.25
    np.testing.assert_allclose(of(steep, "about_slope"), of(none, "about_slope"), atol=1e-6)


def test_what_is_not_one_camera_is_refused():
    given = epochs(np.zeros((2, 6)))
    with pytest.raises(InputError, match="two calibrations"):
        stability(given[:1])
    with pytest.raises(InputError, match="one for each"):
        stability(given, [1.0, 2.0, 3.0])
    with pytest.raises(InputError, match="1 and 3 agree to all digits"):
        stability([*given, given[0]])
    other = dataclasses.replace(given[1][0], image_size=(10, 10))
    with pytest.raises(InputError, match="calibration 2 is of another"):
        stability([given[0], (other, given[1][1])])
    with pytest.raises(InputError, match="other free parameters"):
        stability([given[0], (given[1][0], (NAMES[:5], covariance()[:5, :5]))])


def test_the_command_reads_results(command, tmp_path):
    files = []
    for number, (camera, (names, C)) in enumerate(epochs(np.zeros((3, 6)))):
        sigma = np.sqrt(np.diagonal(C))
        R = C / np.outer(sigma, sigma)
        entry = {
            "model": "opencv",
            "parameters": {
                n: {"value": camera.parameters[n], "sigma": s, "free": True}
                for n, s in zip(names, sigma.tolist())
            },
            "correlations": {a: dict(zip(names, row)) for a, row in zip(names, R.tolist())},
        }
        files.append(tmp_path / f"{number}.json")
        files[-1].write_text(json.dumps({
            "converged": True, "cameras": {"cam": entry},
            "calibration": {"image_size": [480, 360]},
        }))  # fmt: skip
    told = command("stability", *files, "--at", "1,2,3", "--json", tmp_path / "found.json")
    assert told.status == 0 and "rotation removed" in told.out and "σ slope" in told.out
    found = json.loads((tmp_path / "found.json").read_text())
    assert found["all_parameters"]["degrees"] == 12 and found["at"] == [1.0, 2.0, 3.0]
    assert command("stability", files[0]).status == 2
    dates = "2026-05-01,2026-08-01,2026-05-31"
    told = command("stability", *files, "--at", dates, "--json", "-")
    assert np.diff(json.loads(told.out)["at"]).tolist() == [92, -62]
    assert "a number or a date" in command("stability", *files, "--at", "1,x,3").err


def test_equal_parameters_are_one_unknown():
    """Given by one of them, or by all, as in files, where their covariance is singular; the images
    move as if both were given."""
    apart = epochs(np.zeros((4, 6)))
    values = [(camera.parameters | {"fy": camera.parameters["fx"]}) for camera, _ in apart]
    cameras = [
        dataclasses.replace(camera, parameters=p, tie=(("fx", "fy"),))
        for (camera, _), p in zip(apart, values)
    ]
    one = [0, 2, 3, 4, 5]
    C = covariance()[np.ix_(one, one)]
    names, every = tuple(NAMES[k] for k in one), [0, 0, 1, 2, 3, 4]
    found = stability([(camera, (names, C)) for camera in cameras])
    by_all = stability([(camera, (NAMES, C[np.ix_(every, every)])) for camera in cameras])
    assert found.names == by_all.names == names
    assert found.all_parameters.degrees == 3 * 5
    assert by_all.all_parameters == found.all_parameters
    untied = [dataclasses.replace(camera, tie=()) for camera in cameras]
    both = stability([(camera, (NAMES, covariance())) for camera in untied])
    assert found.image_found == pytest.approx(both.image_found)


def test_a_principal_point_alone_leaves_nothing_beside_rotations():
    camera, C = epochs(np.zeros((1, 6)))[0][0], np.diag(SIGMA[2:4] ** 2)
    moved = dataclasses.replace(camera, parameters=camera.parameters | {"cx": 242.1})
    found = stability([(one, (("cx", "cy"), C)) for one in (camera, moved)])
    assert found.rotation_removed.degrees == 0 and found.rotation_removed.probability == 1
    assert "nothing is left" in str(found)
    assert found.to_dict()["rotation_removed"]["probability"] == 1
