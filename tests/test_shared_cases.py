"""Projects with the answer of an independent adjustment, if the folder of cases is next to the
checkout (most data belong to others and are not in the repository)."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

import jaxbundle
from jaxbundle.adjustment.adjust import adjust

CASES = Path(__file__).parents[2] / "shared" / "cases"
PROJECTS = (
    "convergent4/project",
    "camcal/project",
    "sxb_weighted_control/project",
    "riva_3dfield/project",
    "aicon_free_scalebar/project",
)

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not CASES.is_dir(), reason="the folder ../shared/cases is not here"),
]


@pytest.fixture(scope="module", params=PROJECTS)
def case(request):
    """(adjustment, reference, whether object coordinates are comparable as they are)."""
    path = CASES / f"{request.param}.toml"
    network = jaxbundle.read_network(path)
    reference = json.loads(path.with_suffix(".reference.json").read_text())
    return adjust(network), reference, not request.param.startswith("convergent4")


def pairs(reference):
    return np.array([[np.nan if x is None else x for x in entry] for entry in reference]).T


def test_sigma0_and_redundancy(case):
    result, reference, _ = case
    assert result.redundancy == reference["redundancy"]
    assert result.sigma0 == pytest.approx(reference["sigma0"], rel=1e-6)
    assert result.vtpv == pytest.approx(reference["vtpv"], rel=1e-6)
    assert result.counts.observations == reference["observations"]
    assert result.counts.unknowns == reference["unknowns"]


def test_redundancy_numbers(case):
    result, reference, _ = case
    image = result.residuals["kind"] == "image"
    np.testing.assert_allclose(result.residuals["r"][image], reference["r"], atol=1e-6)
    assert result.residuals["r"].sum() == pytest.approx(result.redundancy, abs=1e-6)


def test_camera_parameters(case):
    result, reference, _ = case
    for camera, parameters in reference["cameras"].items():
        for name, (value, sigma) in parameters.items():
            entry = result.cameras[camera]["parameters"][name]
            if sigma is None:
                assert not entry["free"]
                continue
            assert abs(entry["value"] - value) < 0.002 * sigma
            assert entry["sigma"] == pytest.approx(sigma, rel=1e-3)


def test_images_and_points(case):
    """In a free network without a scale of its own only σ can be compared as they stand."""
    result, reference, comparable = case
    ids = [list(result.images["id"]), list(result.points["id"])]
    for table, names, listed, order in (
        (result.images, ("X0", "Y0", "Z0", "omega", "phi", "kappa"), reference["images"], ids[0]),
        (result.points, tuple("XYZ"), reference["points"], ids[1]),
    ):
        for id, entries in listed.items():
            value, sigma = pairs(entries)
            row = order.index(id)
            free = np.isfinite(sigma) & (sigma > 0)
            found = np.array([table[name][row] for name in names])
            found_sigma = np.array([table[f"s{name}"][row] for name in names])
            np.testing.assert_allclose(found_sigma[free], sigma[free], rtol=1e-3)
            if comparable:
                assert np.all(np.abs(found - value)[free] < 0.002 * sigma[free])


@pytest.mark.further
def test_camcal_with_blunders():
    """5 % of 5 to 50 σ (a posteriori): those above 8 σ with redundancy numbers above 0.3 are found,
    1 % of the good ones may go; Huber's estimate stays within its σ of the clean one."""
    network = jaxbundle.read_network(CASES / "camcal/project.toml")
    clean, rays = adjust(network), network.observations
    rng = np.random.default_rng(0)
    bad, size = rng.random(len(rays)) < 0.05, rng.uniform(5, 50, len(rays))
    angle = rng.uniform(0, 2 * np.pi, len(rays))
    length = bad * size * clean.sigma0 * rays.sigma[:, 0]
    xy = rays.xy + length[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
    spoilt = network.replace(observations=dataclasses.replace(rays, xy=xy))

    removed = {r.name for r in adjust(spoilt, snooping="pope").removed}
    gone = np.array([
        f"point {network.points.id[p]} in image {network.images.id[i]}" in removed
        for i, p in zip(rays.image, rays.point)
    ])
    clear = bad & (size > 8) & (clean.residuals["r"][: 2 * len(rays)].reshape(-1, 2).min(1) > 0.3)
    assert gone[clear].mean() >= 0.95
    assert gone[~bad].mean() <= 0.01

    huber = adjust(spoilt, robust="huber").cameras["cam"]["parameters"]
    for name, entry in clean.cameras["cam"]["parameters"].items():
        if entry["free"]:
            assert abs(huber[name]["value"] - entry["value"]) < huber[name]["sigma"]


SMALL = CASES.parent / "data" / "real" / "small"
needs_small = pytest.mark.skipif(not SMALL.is_dir(), reason="../shared/data/real is not here")


@needs_small
@pytest.mark.further
def test_a_repeated_video_frame_leaves_the_rest_adjusted():
    """Three points are seen only in the two equal frames; σ0 without frame and points 0.6146."""
    network = jaxbundle.read_network(SMALL / "twin_frames" / "project.toml")
    result = adjust(network)
    assert result.converged
    (note,) = result.problem.network.left_out
    assert note.names == ("only_twins0", "only_twins1", "only_twins2")
    assert any("'i5_again' repeats 'i5'" in line for line in result.warnings)
    images, keep = network.images, np.array([id != "i5_again" for id in network.images.id])
    single = adjust(network.replace(
        images=images.take(keep),
        observations=network.observations.take(keep[network.observations.image]),
    ))  # fmt: skip
    assert (single.counts.observations, single.counts.unknowns) == (360, 126)
    assert single.sigma0 == pytest.approx(0.6146, abs=1e-4)
    # the same minimum with the frame twice: its residuals count twice
    np.testing.assert_allclose(result.image_values[:6], single.image_values, atol=0.05)


@needs_small
@pytest.mark.further
def test_poor_start_values_of_a_fisheye_lose_nothing():
    result = adjust(jaxbundle.read_network(SMALL / "poor_start_poses" / "project.toml"))
    assert result.converged and not result.problem.network.left_out
    assert (result.counts.observations, result.counts.unknowns) == (2486, 387)
    assert result.sigma0 == pytest.approx(1.010, abs=1e-3)
