"""Planning: the formulas by projection and Monte Carlo, blocks by counting, σ by the network."""

import re
import sys

import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbundle
from jaxbundle import cli
from jaxbundle.adjustment.quality.expected_precision import expected_precision
from jaxbundle.errors import InputError
from jaxbundle.network import Camera
from jaxbundle.planning.block_design import (
    design_block,
    relief_displacement,
    scale,
    sigma_height,
    sigma_plan,
)
from jaxbundle.planning.block_network import planned_network

C, H, SIGMA = 0.153, 1530.0, 5e-6
DESIGN = dict(c=153.0, image_format=(230.0, 230.0), area=(3000.0, 3500.0), sigma_image=0.005)


def test_scale_and_relief_are_those_of_a_projection():
    assert 1 / scale(C, H + 200, 200) == pytest.approx(10_000)
    distance, tall = 800.0, 60.0
    foot, top = C * distance / H, C * distance / (H - tall)
    assert relief_displacement(foot, tall, H) == pytest.approx(top - foot, rel=1e-12)


def test_expected_sigmas_by_monte_carlo():
    """A point between two vertical photographs, from noisy coordinates and the known geometry."""
    rng = np.random.default_rng(0)
    base, X = 920.0, 300.0
    x1 = C * X / H + SIGMA * rng.standard_normal(100_000)
    x2 = C * (X - base) / H + SIGMA * rng.standard_normal(100_000)
    height = base * C / (x1 - x2)
    assert height.std() == pytest.approx(sigma_height(C, H, base, SIGMA), rel=0.02)
    assert (H * x1 / C).std() == pytest.approx(sigma_plan(C, H, SIGMA), rel=0.02)


def test_a_block_covers_its_area():
    design = design_block(height=H, **DESIGN)
    assert design.scale_number == pytest.approx(10_000)
    assert design.footprint == pytest.approx((2300, 2300)) and design.base == pytest.approx(920)
    # 3000 m are 3.26 bases: the centres of 5 photographs reach over both ends
    assert design.photographs_per_strip == 5
    assert (design.photographs_per_strip - 1) * design.base >= 3000
    # a strip covers 2300 of 3500 m, two with 30 % overlap 3910
    assert design.strips == 2 and design.photographs == 10
    assert design.spacing == pytest.approx(1200)
    assert (design.strips - 1) * design.spacing + 2300 == pytest.approx(3500)
    assert design.side_overlap >= 0.3
    one = design_block(height=H, **{**DESIGN, "area": (3000.0, 2000.0)})
    assert one.strips == 1 and design.base_to_height == pytest.approx(0.4 * 230 / 153)


def test_three_ways_to_give_the_height():
    by_height = design_block(height=1530.0, pixel=0.01, **DESIGN)
    assert by_height == design_block(scale_number=10_000.0, pixel=0.01, **DESIGN)
    by_pixel = design_block(pixel_on_ground=0.1, pixel=0.01, **DESIGN)
    assert by_pixel.height == pytest.approx(1530) and by_pixel.pixel_on_ground == 0.1


@pytest.mark.parametrize(
    "changes, message",
    [
        ({}, "give one of height, scale_number, pixel_on_ground"),
        (dict(height=1.0, scale_number=2.0), "give one of"),
        (dict(height=-1.0), "height is -1.0; it must be positive"),
        (dict(height=1.0, c=float("nan")), "c is nan"),
        (dict(height=1.0, forward_overlap=1.0), "forward_overlap is 1.0"),
        (dict(height=1.0, forward_overlap=60), r"forward_overlap is 60; .* \(60 % is 0.6\)"),
        (dict(pixel_on_ground=0.1), "needs the pixel size"),
        (dict(height=1.0, c=0.153, image_format=(0.23, 0.23)), "are they in m"),
        (dict(height=1.0, c=8000.0, image_format=(6000, 4000)), "are they in pixels"),
    ],
)
def test_impossible_plans(changes, message):
    with pytest.raises(InputError, match=message):
        design_block(**{**DESIGN, **changes})


@pytest.fixture(scope="module")
def block():
    design = design_block(height=H, **{**DESIGN, "area": (1900.0, 3500.0)})
    camera = Camera("cam", "brown", {"c": 153.0})
    return design, planned_network(design, camera, (230, 230), (1900, 3500), 0.005, 0.05)


def test_expected_precision_is_that_of_the_adjustment(block):
    design, network = block
    assert len(network.images) == design.photographs
    assert sum(role == "control" for role in network.points.role) == 9
    expected, result = expected_precision(network), jaxbundle.adjust(network)
    assert expected.redundancy == result.redundancy
    found = np.stack([result.points[f"s{axis}"] for axis in "XYZ"], 1) / result.sigma0
    assert list(result.points["id"]) == list(expected.point_ids)
    assert_allclose(expected.points, found, rtol=0.01, atol=1e-6)
    centres = np.stack([result.images[f"s{n}0"] for n in "XYZ"], 1) / result.sigma0
    assert_allclose(expected.centres, centres, rtol=0.01)


def test_the_formula_is_the_right_order(block):
    design, network = block
    mean = {axis: sigma[0] for axis, sigma in expected_precision(network).summary().items()}
    assert 0.5 < mean["X"] / design.sigma_plan < 3
    assert 0.5 < mean["Z"] / design.sigma_height < 3
    assert mean["Z"] > mean["X"]


def test_no_control_point_is_lost_by_relief(block):
    """A point 20 % of the flying height above the datum is seen 25 % further from the nadir."""
    camera = Camera("cam", "brown", {"c": 153.0})
    network = planned_network(block[0], camera, (230, 230), (1900, 3500), 0.005, 0.05, relief=0.2)
    assert sum(role == "control" for role in network.points.role) == 9


def test_more_control_is_better_control(block):
    design, few = block
    camera = Camera("cam", "brown", {"c": 153.0})
    arguments = (design, camera, (230, 230), (1900, 3500), 0.005, 0.05)
    many = planned_network(*arguments, control_every=1)
    count = lambda net: sum(role == "control" for role in net.points.role)
    assert count(many) > count(few) == 9
    worse, better = (expected_precision(net).summary()["Z"][0] for net in (few, many))
    assert better < worse
    with pytest.raises(InputError, match="control every 0 bases"):
        planned_network(*arguments, control_every=0)


def run(monkeypatch, capsys, *arguments):
    monkeypatch.setattr(sys, "argv", ["jaxbundle", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    return ended.value.code, capsys.readouterr()


def test_the_command(monkeypatch, capsys, tmp_path):
    options = ["--c", 153, "--image", "230,230", "--area", "1900,3500", "--sigma-image", 0.005]
    code, said = run(monkeypatch, capsys, "plan", *options, "--height", 1530, "--no-network",
                     "--out", tmp_path / "block")  # fmt: skip
    assert not code and "scale                 1 : 10000" in said.out
    assert "4 per strip, 8 in all" in said.out and (tmp_path / "block" / "project.toml").exists()
    code, said = run(monkeypatch, capsys, "plan", *options, "--height", 10)
    assert code == 2 and "photographs: too many for a covariance" in said.err
    code, said = run(monkeypatch, capsys, "plan", *options)
    assert code == 2 and "give one of --height, --scale, --ground-pixel" in said.err


def test_compare_on_the_command_line(monkeypatch, capsys, tmp_path):
    camera = (
        '[[camera]]\nid = "{}"\nmodel = "opencv"\nimage_size = [640, 480]\nfx = {}\nfy = 500.0\n'
    )
    (tmp_path / "a.toml").write_text(camera.format("1", 500.0))
    (tmp_path / "b.toml").write_text(camera.format("1", 505.0) + camera.format("2", 500.0))
    code, said = run(monkeypatch, capsys, "compare", tmp_path / "a.toml", f"{tmp_path}/b.toml#2")
    assert not code and re.search(r"RMS difference \S+e-1\d px|RMS difference 0 px", said.out)
    code, said = run(monkeypatch, capsys, "compare", tmp_path / "a.toml", f"{tmp_path}/b.toml#1",
                     "--csv", tmp_path / "r.csv", "--plot", tmp_path / "m.png")  # fmt: skip
    assert not code and (tmp_path / "m.png").read_bytes()[:4] == b"\x89PNG"
    row = next(line for line in said.out.splitlines() if line.startswith("fx"))
    assert row.split() == ["fx", "500", "505", "5"]
    assert (tmp_path / "r.csv").read_text().startswith("r,radial,tangential,rms,largest,points\n")
    (tmp_path / "c.toml").write_text(camera.format("1", 500.0).replace("640", "320"))
    code, said = run(monkeypatch, capsys, "compare", tmp_path / "a.toml", tmp_path / "c.toml")
    assert code == 2 and "[640, 480] and [320, 480] pixels are not from one camera" in said.err
    code, said = run(monkeypatch, capsys, "compare", tmp_path / "a.toml", tmp_path / "b.toml")
    assert code == 2 and "2 cameras (1, 2); name one of them" in said.err


def test_camera_on_the_command_line(monkeypatch, capsys, tmp_path):
    """90° along and across, each by its own principal distance; and what may hold a camera."""
    (tmp_path / "a.toml").write_text(
        '[[camera]]\nid = "1"\nmodel = "opencv"\nimage_size = [2000, 1000]\nfx = 1000.0\n'
        "fy = 500.0\ncx = 999.5\ncy = 499.5\n"
    )
    code, said = run(monkeypatch, capsys, "camera", tmp_path / "a.toml")
    assert not code and said.out.count("90.000°, 90.000°, 109.471°") == 2
    (tmp_path / "a.foo").write_text("")
    code, said = run(monkeypatch, capsys, "camera", tmp_path / "a.foo")
    assert code == 2 and "not recognised; expected a camera file" in said.err
    code, said = run(monkeypatch, capsys, "camera", tmp_path / "b.foo")
    assert code == 2 and "b.foo: no such file" in said.err
