"""Figures that were printed by others, reproduced from the examples of the repository.

- convergent4: four convergent photographs (dos Santos, ITN Malang 2013), data as printed there;
  the solutions are those of an independent adjustment of the same data.
- resection63: single photo resection of a lecture with printed answer and residuals.
"""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

import jaxbundle
from jaxbundle.adjustment import make_problem
from jaxbundle.adjustment.adjust import adjust
from jaxbundle.leastsquares.iterations.stopping import converged
from jaxbundle.leastsquares.solution import find_minimum
from jaxbundle.network.check import check_network

pytestmark = pytest.mark.slow

EXAMPLES = Path(__file__).parent.parent / "examples"
ALL_TEN = ("c", "x0", "y0", "K1", "K2", "K3", "P1", "P2", "b1", "b2")

SOLUTIONS = (  # free parameters, domain, redundancy, v'v in mm², σ0 in µm
    ((), "corrected", 33, 1.1855568407e-3, 5.99383),
    (("c", "x0", "y0", "K1"), "measured", 29, 1.2073447447e-5, 0.64523),
    (ALL_TEN, "measured", 23, 9.0102487e-6, 0.62590),
)


def with_free(network, free, domain="corrected"):
    camera = dataclasses.replace(network.cameras[0], free=free)
    return network.replace(cameras=(camera,), residuals=domain)


@pytest.fixture(scope="module")
def network():
    project = EXAMPLES / "convergent4" / "project.toml"
    return jaxbundle.read_network(project, overrides=("sigma_image=1", "sigma_origin=unit"))


@pytest.mark.parametrize("free, domain, redundancy, vtv, sigma0", SOLUTIONS)
def test_the_solutions_of_the_four_photographs(network, free, domain, redundancy, vtv, sigma0):
    problem = make_problem(check_network(with_free(network, free, domain)))
    minimum = find_minimum(problem, problem.data.start)
    assert converged(int(minimum.termination))
    vtpv = 2 * np.nanmin(minimum.history.cost)
    assert problem.counts.redundancy == redundancy
    assert vtpv == pytest.approx(vtv, rel=1e-7)
    assert 1e3 * np.sqrt(vtpv / redundancy) == pytest.approx(sigma0, rel=1e-5)


PUBLISHED = {  # value, σ
    "c": (18.528014315, 0.04530), "x0": (0.28342980, 0.03841), "y0": (0.02675643, 0.09326),
    "K1": (2.2723256e-4, 4.763e-5), "K2": (2.4496753e-6, 1.879e-6),
    "K3": (-3.4431701e-8, 2.291e-8), "P1": (3.5647508e-5, 2.451e-5),
    "P2": (-3.6367571e-5, 3.728e-5), "b1": (-1.5800064e-3, 2.016e-3),
    "b2": (2.7737157e-4, 1.378e-3),
}  # fmt: skip


def test_all_ten_parameters(convergent4):
    result = convergent4
    assert result.redundancy == 23
    assert 1e3 * result.sigma0 == pytest.approx(0.63128, rel=1e-5)
    for name, (value, sigma) in PUBLISHED.items():
        entry = result.cameras["cam"]["parameters"][name]
        assert abs(entry["value"] - value) < 0.002 * sigma
        assert entry["sigma"] == pytest.approx(sigma, rel=1e-3)
    insignificant = {name.parameter for _, name in result.insignificant(2.0)}
    assert insignificant == {"K2", "K3", "P1", "P2", "b1", "b2", "y0"}


def test_four_parameters_correlations_and_redundancy_numbers(network):
    result = adjust(with_free(network, ("c", "x0", "y0", "K1")))
    assert result.redundancy == 29
    assert result.vtpv == pytest.approx(1.2341864164e-5, rel=1e-7)
    assert 1e3 * result.sigma0 == pytest.approx(0.65237, rel=1e-5)
    table = result.cameras["cam"]
    at = {name: i for i, name in enumerate(table["free"])}
    percent = {("c", "x0"): -25.5, ("c", "y0"): 55.3, ("c", "K1"): 66.3, ("x0", "y0"): -12.8,
               ("x0", "K1"): -20.9, ("y0", "K1"): 10.7}  # fmt: skip
    for (a, b), value in percent.items():
        assert 100 * table["correlations"][at[a], at[b]] == pytest.approx(value, abs=0.06)
    r = result.residuals["r"]
    assert r.min() == pytest.approx(0.063, abs=6e-4) and r.max() == pytest.approx(0.612, abs=6e-4)
    assert r.sum() == pytest.approx(29, abs=1e-6)


THESIS_ANSWER = {"c": 18.5504303825, "x0": -0.0675758561, "y0": 0.1276089300,
                 "K1": -1.978100683e-4}  # fmt: skip


def test_from_the_answer_of_the_thesis_the_same_minimum(network, convergent4):
    """Its orientations and coordinates as printed, its camera: the same sum of squares."""
    exterior = np.array([
        [0.000105, -0.02461, 0.000966, -0.01938, -0.0066, -0.00258],
        [-0.60307, 0.091865, 0.130176, 0.157952, 0.553239, -0.05802],
        [-0.90235, -1.37998, -1.02784, -0.67933, 0.124651, -0.71815],
        [-1.22456, -0.86115, -1.19141, -0.63401, 0.610347, -0.5932],
    ])  # fmt: skip
    points = np.array([
        [-0.24883, 0.128105, -0.92536], [-0.0431, 0.1084, -0.74961],
        [0.109593, 0.081502, -0.61046], [-0.2652, 0.054999, -0.89442],
        [-0.05941, 0.054345, -0.72507], [0.099946, 0.04294, -0.59328],
        [-0.15055, -0.00502, -0.77287], [0.086718, -0.01156, -0.57983],
        [-0.18029, -0.08386, -0.77019], [0.067917, -0.10753, -0.56494],
    ])  # fmt: skip
    camera = dataclasses.replace(network.cameras[0], parameters=THESIS_ANSWER)
    start = network.replace(
        cameras=(camera,),
        images=dataclasses.replace(
            network.images, angles=exterior[:, :3], position=exterior[:, 3:]
        ),
        points=dataclasses.replace(network.points, position=points),
    )
    result = adjust(start)
    assert result.vtpv == pytest.approx(convergent4.vtpv, rel=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_from_disturbed_start_values_the_same_minimum(network, convergent4, seed):
    """10 % of the object's size, 10° on every angle."""
    random = np.random.default_rng(seed)
    size = np.ptp(network.points.position, axis=0).max()
    shift = lambda shape: 0.1 * size * random.uniform(-1, 1, shape)
    images, points = network.images, network.points
    start = network.replace(
        images=dataclasses.replace(
            images,
            position=images.position + shift(images.position.shape),
            angles=images.angles + np.radians(10) * random.uniform(-1, 1, images.angles.shape),
        ),
        points=dataclasses.replace(points, position=points.position + shift(points.position.shape)),
    )
    result = adjust(start)
    assert result.converged
    assert result.vtpv == pytest.approx(convergent4.vtpv, rel=1e-9)


PRINTED_RESIDUALS = {  # point: v in mm, as printed
    "40301": (0.005, 0.0002), "40401": (0.0032, 0.0053), "40501": (-0.0051, 0.0067),
    "30301": (-0.0026, -0.0009), "30401": (0.0142, 0.0097), "20301": (0.007, -0.0182),
    "20401": (0.0145, -0.0071), "20501": (-0.035, 0.0046),
}  # fmt: skip


def test_the_resection_of_image_63():
    result = adjust(jaxbundle.read_network(EXAMPLES / "resection63" / "project.toml"))
    expected = {
        "X0": (4907.812267, 0.4686), "Y0": (2088.578565, 0.5544), "Z0": (2257.265547, 0.2167),
        "omega": (2.423432, 0.01185), "phi": (-0.311383, 0.01238), "kappa": (-1.783463, 0.00499),
    }  # fmt: skip
    assert result.redundancy == 10
    for name, (value, sigma) in expected.items():
        assert result.images[name][0] == pytest.approx(value, abs=6e-7)
        assert result.images[f"s{name}"][0] == pytest.approx(sigma, rel=1e-3)
    assert 0.015 * result.sigma0 == pytest.approx(0.0152492, rel=1e-5)
    assert result.sigma0 == pytest.approx(1.0166, rel=1e-4)
    assert 0.015**2 * result.vtpv == pytest.approx(2.32537654e-3, rel=1e-8)
    residuals = result.residuals
    for point, axis, v in zip(residuals["point"], residuals["axis"], residuals["v"]):
        printed = PRINTED_RESIDUALS[point]["xy".index(axis)]
        assert v == pytest.approx(printed, abs=0.6e-4)
