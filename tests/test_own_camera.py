"""docs/own_camera.md, executed; and networks, files and results with a user's own camera model."""

import dataclasses
import json
import re
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbundle
from jaxbundle import Camera, CameraModel, InputError, adjust, plotting, simulate_with_truth
from jaxbundle.adjustment import design_matrix, make_problem, residuals
from jaxbundle.adjustment.readjust import _without_parameter
from jaxbundle.adjustment.unknowns import Name
from jaxbundle.cameras import brown, get_model
from jaxbundle.io import read_cameras
from jaxbundle.io.cameras.camera_files import write_cameras
from jaxbundle.io.results.result_json import result_dict
from jaxbundle.network.check import check_network

PAGE = (Path(__file__).parents[1] / "docs" / "own_camera.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """The names defined by the page's code."""
    names, codes = {}, re.findall(r"```python\n(.*?)```", PAGE, re.S)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("page"))
        for code in codes:
            exec(code, names)
    assert len(codes[0].strip().splitlines()) < 35
    return names


def test_the_truth_is_found(page):
    result, truth = page["result"], page["simulation"].truth
    assert result.converged and 0.8 < result.sigma0 < 1.2
    table = result.cameras["cam"]["parameters"]
    for name, true in {"c": 24.0, "x0": 0.1, "y0": 0.0, "L1": 4e-4}.items():
        assert abs(table[name]["value"] - true) < 3 * table[name]["sigma"], name
    assert table["L2"] == {"value": 0.0, "sigma": None, "free": False, "t": None,
                           "total_correlation": None}  # fmt: skip
    # inner constraints: compare distances, which no datum changes
    found, true = (np.linalg.norm(np.diff(X, axis=0), axis=1)
                   for X in (result.point_values, truth.points.position))  # fmt: skip
    scale = true.sum() / found.sum()
    assert np.abs(scale * found - true).max() < 0.01


def test_a_fisheye_by_distort_is_that_of_kannala_and_brandt(page):
    """And the number of iterations that its inverse needs is that of the page."""
    model, camera, size = page["FISHEYE"], page["camera"], (1920, 1440)
    convert = lambda n: page["convert_camera"](
        dataclasses.replace(model, iterations=n), camera, "kannala-brandt", image_size=size
    )
    found = convert(3)
    assert found.exact and found.covered == 1 and found.largest < 1e-12
    for name, value in camera.items():
        assert found.parameters[name] == pytest.approx(value, rel=1e-10), name
    with pytest.raises(ValueError, match="only 16 % of the image has a ray"):
        convert(2)


def test_the_report_and_json_name_the_model(page):
    result = page["result"]
    report = result.report()
    assert "Model division-mm  xi = x̄/(1 + L1·r² + L2·r⁴)" in report and "Fitzgibbon" in report
    assert "one-to-one over the image, as far as r = 21.63 mm" in report
    document = json.loads(json.dumps(result_dict(result)))
    assert document["cameras"]["cam"]["model"] == "division-mm"
    assert document["units"]["residuals"] == {"cam": "mm"}
    assert set(result.table("cameras")["model"]) == {"division-mm"}


def test_the_plots_draw_it(page):
    title = plotting.distortion_curve(page["result"], "cam").get_title(loc="left")
    assert "distortion (division-mm)" in title
    plotting.correlation_matrix(page["result"])
    plt.close("all")


def test_a_file_names_it_and_the_reader_is_given_it(page, tmp_path):
    network, DIVISION = page["simulation"].network, page["DIVISION"]
    (camera,) = page["network"].cameras
    assert camera.model is DIVISION and camera == network.cameras[0]
    assert page["network"].observations.xy.tolist() == network.observations.xy.tolist()
    path = jaxbundle.write_project(network, tmp_path / "p")
    assert "# 'division-mm' is a model of the user's own" in path.read_text()
    with pytest.raises(InputError, match="'cam': unknown model 'division-mm'.*models=") as said:
        jaxbundle.read_network(path)
    assert "\n" not in str(said.value)
    with pytest.raises(InputError, match="models must be a list of CameraModels, but is"):
        jaxbundle.read_network(path, models=["division-mm"])
    with pytest.raises(InputError, match="model 'division-mm' is already"):
        jaxbundle.read_network(path, models=[DIVISION, DIVISION])
    with pytest.raises(InputError, match="camera 'cam': .*unknown key 'L3'"):
        path.write_text(path.read_text().replace("L1 =", "L3 ="))
        jaxbundle.read_network(path, models=[DIVISION])
    write_cameras(network.cameras, tmp_path / "cameras.toml")
    assert read_cameras(tmp_path / "cameras.toml", [DIVISION]) == network.cameras


def test_conversion_to_and_from_it(page, tmp_path):
    network, DIVISION = page["simulation"].network, page["DIVISION"]
    own, path = {"models": [DIVISION]}, jaxbundle.write_project(network, tmp_path / "own")
    with pytest.raises(InputError, match="colmap has no model 'division-mm', and opencv is not"):
        jaxbundle.convert(path, tmp_path / "colmap", **own)
    made = jaxbundle.convert(path, tmp_path / "pixels", model="opencv", **own)
    assert made.conversions["cam"].largest < 1 and "opencv: fitted" in str(made)
    pixels = jaxbundle.read_network(tmp_path / "pixels")
    assert pixels.cameras[0].free == ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    back = jaxbundle.convert(tmp_path / "pixels", tmp_path / "back", model=DIVISION)
    assert back.conversions["cam"].largest < 0.006  # mm: what the polynomial was apart, 1 px
    (camera,) = jaxbundle.read_network(tmp_path / "back", **own).cameras
    assert camera.model is DIVISION and camera.free == DIVISION.parameters
    assert camera.parameters["L1"] == pytest.approx(4e-4, rel=0.01)
    taken = CameraModel("brown", DIVISION.parameters, correct=DIVISION.correct)
    with pytest.raises(InputError, match="'brown' is built in"):
        jaxbundle.convert(tmp_path / "pixels", tmp_path / "no", model=taken)


STATIONS = jaxbundle.ring_of_stations(5, radius=3.0, height=2.0, roll_every=2)
TARGETS = jaxbundle.grid_of_targets(5, 4, 0.4, relief=0.2)
VALUES = {"c": 24.0, "x0": 0.1, "K1": -1e-4, "K2": 2e-8, "P1": 1e-5, "b1": 1e-4, "r0": 9.0}
FREE = ("c", "x0", "y0", "K1")


@pytest.mark.further
def test_brown_said_again_has_the_figures_of_brown():
    """Residuals and derivatives, to rounding, in the measured image, which needs the inverse. (The
    whole of an adjustment is compared in tests/calibration/test_own_camera_model.py.)"""
    again = CameraModel(
        "again", brown.PARAMETERS, correct=lambda p, x, y: brown.correct(p, x, y),
        never_free=("r0",),
    )  # fmt: skip
    network = simulate_with_truth(
        STATIONS, TARGETS, Camera("cam", "brown", VALUES, FREE), noise=0.002, seed=3,
        residuals="measured", disturb=0.002,
    ).network  # fmt: skip
    camera = dataclasses.replace(network.cameras[0], model=again)
    problems = [make_problem(check_network(network.replace(cameras=(c,))))
                for c in (network.cameras[0], camera)]  # fmt: skip
    assert [p.cameras[0].model for p in problems] == ["brown", again]
    at = problems[0].data.start
    (ours, names), (own, same) = (design_matrix(problem, at) for problem in problems)
    assert names == same and ours.shape == (2 * 5 * 20, 4 + 30 + 60)
    assert_allclose(own, ours, rtol=1e-9, atol=1e-9 * np.abs(ours).max())
    ours, own = (residuals(problem, at)["image"] for problem in problems)
    assert_allclose(own, ours, rtol=1e-9, atol=1e-12)


def bulge(p, xi, yi):
    """x = xi·(1 + k·r²)/(1 + m·r²)"""
    f, k, m = p
    r2 = (xi * xi + yi * yi) / (f * f)
    return xi * (1 + k * r2) / (1 + m * r2), yi * (1 + k * r2) / (1 + m * r2)


@pytest.mark.further
def test_cameras_of_several_models():
    """A network with own and built-in models; the object of a built-in one is its name; what is not
    significant is so against its default."""
    BULGE = CameraModel("bulge", ("f", "k", "m"), distort=bulge, defaults={"m": 0.3})
    cameras = [Camera("a", BULGE, {"f": 24.0, "k": 0.05}, ("f", "m")),
               Camera("b", get_model("brown"), VALUES, ("c",))]  # fmt: skip
    assert cameras[1].model == "brown"
    found = simulate_with_truth(
        STATIONS, TARGETS, cameras, noise=0.002, camera_of_station=[0, 1, 0, 1, 0]
    )
    result = adjust(found.network)
    assert result.converged
    for camera, name, true in (("a", "f", 24.0), ("a", "m", 0.3), ("b", "c", 24.0)):
        entry = result.cameras[camera]["parameters"][name]
        assert abs(entry["value"] - true) < 3 * entry["sigma"]
        default = 0.3 if name == "m" else 0.0
        assert entry["t"] == pytest.approx(abs(entry["value"] - default) / entry["sigma"])
    assert [name.parameter for _, name in result.insignificant(3.0)] == ["m"]
    _, values = _without_parameter(result.problem, result.values, Name("camera", "a", "m"))
    assert result.problem.interior_orientation(values)[0, 2] == 0.3
    other = dataclasses.replace(BULGE, iterations=7)
    twice = (cameras[0], dataclasses.replace(cameras[0], id="b", model=other))
    with pytest.raises(InputError, match="'a' and 'b' have different models named"):
        adjust(found.network.replace(cameras=twice))
    with pytest.raises(InputError, match="camera 'a': unknown model .*read_network.path, models"):
        adjust(found.network.replace(cameras=(Camera("a", "divided", VALUES), cameras[1])))
