"""Acceptance criteria: grammar, units, quantities, and the command's exit status."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

import jaxbundle
from jaxbundle.certificates.acceptance import AcceptanceRow, accept, check_criteria
from jaxbundle.certificates.check_differences import CheckDifferences, check_point_quantities
from jaxbundle.certificates.criteria import read_criteria, read_criterion
from jaxbundle.certificates.lengths import read_lengths
from jaxbundle.certificates.quantities import offered
from jaxbundle.certificates.quantity import Subject
from jaxbundle.certificates.units import PixelPitch, convert
from jaxbundle.cli.judgement import Judge
from jaxbundle.errors import InputError, NotSolvedError

ROOT = Path(__file__).parents[2]
PROJECT = ROOT / "examples" / "convergent4" / "project.toml"


@pytest.mark.parametrize(
    ("text", "fields"),
    [
        ("sigma(c) < 2 um", ("sigma", "c", "<", 2.0, "um")),
        ("sigma0<1.2", ("sigma0", "", "<", 1.2, "")),
        ("  check.rms( X )  ≤  5e-3  m ", ("check.rms", "X", "<=", 0.005, "m")),
        ("redundancy >= 20", ("redundancy", "", ">=", 20.0, "")),
        ("coverage ≥ 60 %", ("coverage", "", ">=", 60.0, "%")),
        ("sigma(camera:my cam:c) < .5 µm", ("sigma", "camera:my cam:c", "<", 0.5, "um")),
        ("value(K1) > -1e-3", ("value", "K1", ">", -1e-3, "")),
    ],
)
def test_a_criterion_is_read(text, fields):
    one = read_criterion(text)
    assert (one.name, one.argument, one.comparison, one.limit, one.unit) == fields
    assert read_criterion(one.text) == one
    # as Python has it from a command line in a locale without UTF-8
    assert read_criterion(text.encode().decode("ascii", "surrogateescape")) == one


@pytest.mark.parametrize(
    "text",
    ["", "sigma0", "sigma0 < ", "< 3", "sigma0 == 1", "sigma0 < 1 < 2", "sigma0 < nan",
     "sigma0 < 1e999",
     "__import__('os') < 1", "a < 1; b", "sigma(c < 2 um", "sigma0 < 1 um mm", 3, None],
)  # fmt: skip
def test_anything_else_is_refused_with_the_form(text):
    with pytest.raises(InputError, match="criterion"):
        read_criterion(text)


def test_a_criterion_given_twice_is_refused():
    with pytest.raises(InputError, match="twice"):
        read_criteria(["sigma0 < 1", "sigma0  <  1"])


def test_units_are_converted_and_others_refused():
    assert convert(1.0, "mm", "um") == pytest.approx(1000)
    assert convert(1.0, "gon", "arcsec") == pytest.approx(3240)
    assert convert(0.25, "", "%") == 25
    assert convert(2.0, "px", "um", PixelPitch(0.006)) == pytest.approx(12)
    assert convert(12.0, "um", "px", PixelPitch(0.006)) == pytest.approx(2)
    assert convert(1.0, "ftUS", "m") == pytest.approx(1200 / 3937)
    assert convert(1.0, "model", "model") == 1.0
    for given, wanted, why in (
        ("mm", "deg", "one of nm, um"),
        ("mm", "", "no unit"),
        ("", "mm", "without unit"),
        ("px", "um", "pixel_size"),
        ("model", "mm", "which is no length"),
    ):
        with pytest.raises(InputError, match=why):
            convert(1.0, given, wanted)


def test_quantities_are_those_of_the_result(convergent4):
    sigma = convergent4.cameras["cam"]["parameters"]["c"]["sigma"]
    criteria = [
        f"sigma(c) < {1.001e3 * sigma} um",
        f"sigma(c) < {0.999e3 * sigma} um",
        "sigma0 < 0.01",
        "redundancy >= 23",
        "redundancy > 23",
        "images >= 4",
        f"sigma(Z) <= {convergent4.points['sZ'].max() * (1 + 1e-12)} model",
        f"sigma.rms(Z) < {np.sqrt(np.mean(convergent4.points['sZ'] ** 2)) * 1.001} model",
        f"sigma(point:7:Z) < {convergent4.points['sZ'].max()} model",
        f"r > {convergent4.residuals['r'].min() * 0.99}",
        "t(c) > 2",
        "correlation(c) < 1",
        "check.number > 0",
        "check.rms < 1 model",
    ]
    found = accept(convergent4, criteria)
    expected = [True, False, True, True, False, True, True, True, True, True, True, True, False,
                False]  # fmt: skip
    assert [row.met for row in found.rows] == expected
    assert not found.met and len(found.unmet) == expected.count(False)
    assert "no check points" in found.unmet[-1]
    assert found.rows[0].of == "c of camera cam" and found.rows[3].said == "23"
    worst = convergent4.points["id"][convergent4.points["sZ"].argmax()]
    assert found.rows[6].of == f"Z of point {worst}"
    assert json.loads(json.dumps(jaxbundle.results.finite(found.to_dict())))["met"] is False
    assert len(found.table()["criterion"]) == len(criteria) and "not met" in str(found)


def test_a_lower_limit_is_decided_by_the_smallest_value(convergent4):
    row = accept(convergent4, "sigma(Z) > 1e9 model").rows[0]
    assert row.value == convergent4.points["sZ"].min() and not row.met
    assert "smallest of 10" in row.line


def test_a_value_close_to_its_limit_shows_on_which_side_it_is(convergent4):
    sigma0 = convergent4.sigma0
    text = accept(convergent4, f"sigma0 < {sigma0 * (1 - 1e-7):.17g}").unmet[0]
    assert float(text.split()[-1]) > sigma0 * (1 - 1e-7)


def test_unknown_quantities_and_units_name_what_is_known(convergent4):
    for text, why in (
        ("sigm0 < 1", r"did you mean 'sigma0'\?; known: .*redundancy"),
        ("sigma < 1", "in parentheses"),
        ("sigma(c9) < 1 um", "no parameter 'c9'.*known: c, x0"),
        ("sigma(c) < 1 deg", "one of nm, um, mm"),
        ("sigma0(c) < 1", "no argument"),
        ("check.rms(Q) < 1 m", "check"),
        ("rms < 1 px", "unknown quantity 'rms'"),
    ):
        if text.startswith("check"):
            continue
        with pytest.raises(InputError, match=why):
            accept(convergent4, [text])
    assert "held" in accept(convergent4, "sigma(r0) < 1").rows[0].why


def test_criteria_are_checked_before_the_work():
    network = jaxbundle.read_network(PROJECT)
    good = ["sigma(c) < 1 um", "sigma(omega) < 1 deg", "check.rms < 1 model"]
    check_criteria(good, "adjust", network)
    for text, why in (
        ("sigma(fx) < 1 px", "no parameter 'fx'"),
        ("sigma(c) < 1 deg", "one of nm"),
        ("sigma(omega) < 1 mm", "one of rad"),
        ("check.rms < 1 mm", "'model', which is no length"),
        ("sigma(camera:other:c) < 1 um", "no camera 'other'"),
        ("sigma(r0) < 1", "held, and not estimated"),
        ("t(X0) > 2", "only parameters of cameras"),
        ("correlation(image:*:Z0) < 0.9", "only parameters of cameras"),
        ("sigma(cam:c) < 1 mm", "KIND:ID:NAME"),
        ("sigma(foo:7:X0) < 1 m", "KIND:ID:NAME"),
        ("sigma(point:*:c) < 1 mm", "no 'c' of a point; known: X, Y, Z"),
        ("sigma(image:7:Z) < 1 mm", "no 'Z' of an image"),
        ("views > 3", "unknown quantity"),
        ("sigma0 < 1 px", "without unit"),
    ):
        with pytest.raises(InputError, match=why):
            check_criteria([text], "adjust", network)
    good = ["rms < 0.1 px", "sigma(fx) < 1 px", "views > 8"]
    check_criteria(good, "calibrate", models=["opencv"])
    with pytest.raises(InputError, match="no parameter 'c'"):
        check_criteria(["sigma(c) < 1 um"], "calibrate", models=["opencv"])
    good = ["sigma(base) < 1 mm", "sigma(rotation) < 1 arcsec"]
    check_criteria(good, "calibrate-rig", models=["opencv"])
    known = {"models": ["opencv"], "camera_names": ["left", "right"]}
    good += ["rms < 1 px", "rms(left) < 1 px", "sigma(fx) < 1 px", "sigma(*:fx) < 1 px"]
    good += ["sigma(left:fx) < 1 px", "sigma(camera:right:fx) < 1 px", "sigma0 < 2"]
    check_criteria(good, "calibrate-rig", **known)
    for text in ("rms(lefd) < 1 px", "sigma(lefd:fx) < 1 px", "sigma(camera:lefd:fx) < 1 px"):
        with pytest.raises(InputError, match="no camera 'lefd'; did you mean 'left'"):
            check_criteria([text], "calibrate-rig", **known)


def test_every_quantity_that_is_offered_is_documented():
    page = (ROOT / "docs" / "certificate.md").read_text(encoding="utf-8")
    for command in ("adjust", "calibrate", "calibrate-rig", "reconstruct"):
        for quantity in offered(command).values():
            assert f"`{quantity.form}`" in page, quantity.form
            assert quantity.words and quantity.name in quantity.form


def test_other_results_have_the_numbers_of_their_json():
    camera = jaxbundle.Camera("cam", "opencv", {"fx": 800.0, "fy": 800.0, "cx": 320.0, "cy": 240.0},
                              image_size=(640, 480))  # fmt: skip
    plan = jaxbundle.plan(100, (68, 104), (300, 300), 0.003, height=1000, network=False)
    name = next(k for k, v in plan.to_dict().items() if isinstance(v, float))
    assert accept(plan, f"{name} <= {plan.to_dict()[name]}").met
    with pytest.raises(InputError, match="unknown quantity 'nothing'.*known"):
        accept(jaxbundle.camera(camera), "nothing < 1")


def test_a_result_without_a_solution_is_not_judged():
    class Unsolved:
        converged = False

    with pytest.raises(NotSolvedError, match="no solution"):
        accept(Unsolved(), "sigma0 < 1")


def test_what_cannot_be_judged_does_not_lose_the_result(convergent4):
    """Lengths of a network without scale, and a criterion that is refused, are said at the end."""
    lengths = read_lengths({"from": ["1"], "to": ["2"], "value": [1.0], "sigma": [0.0]})
    judge = Judge(("sigma(nothing) < 1", "sigma0 < 2"), lengths=lengths)
    judgement = judge.judge(convergent4)
    assert [row.met for row in judgement.acceptance.rows] == [False, True]
    with pytest.raises(InputError, match="no scale"):
        judge.end(judgement)


def test_heights_alone_meet_no_criterion_of_three_axes():
    difference = np.array([[np.nan, np.nan, 0.1]])
    differences = CheckDifferences(["a"], difference, "m")
    rms = check_point_quantities(lambda _: differences)[0]
    for argument in ("H", "3D"):
        with pytest.raises(LookupError):
            rms.find(Subject(None), argument)
    for argument in ("V", "Z", ""):
        assert rms.find(Subject(None), argument).values[""] == pytest.approx(0.1)


def test_an_infinite_value_is_said():
    row = AcceptanceRow(read_criterion("chi2 < 1"), math.inf)
    assert row.said == "inf" and not row.met


def test_numbers_that_are_none_are_not_accepted(convergent4):
    one = read_criterion("sigma0 < 1")
    assert not one.holds(math.nan)


# --- the command ----------------------------------------------------------------------------


def test_status_4_and_everything_is_written(command, tmp_path):
    out, page = tmp_path / "out", tmp_path / "certificate.html"
    told = command(
        "adjust", PROJECT, "--accept", "sigma(c) < 2 um", "--accept", "sigma0 < 1.2", "--out", out,
        "--json", tmp_path / "r.json", "--certificate", page, "--no-plots",
    )  # fmt: skip
    assert told.status == 4
    assert told.err.count("not met") == 1 and "sigma(c) < 2 um: 45.3 um" in told.err
    assert "Acceptance: 1 of 2 criteria not met" in told.out
    document = json.loads((tmp_path / "r.json").read_text())
    assert document["acceptance"]["met"] is False and document["converged"]
    assert json.loads((out / "result.json").read_text())["acceptance"] == document["acceptance"]
    assert (out / "acceptance.csv").read_text().count("\n") == 3
    assert "1 of 2 criteria not met" in (out / "report.txt").read_text("utf-8")
    assert 'id="acceptance"' in (out / "report.html").read_text("utf-8")
    assert page.read_text("utf-8").startswith("<!doctype html>")


def test_status_0_if_all_are_met_and_2_before_the_work(command, tmp_path):
    assert command("adjust", PROJECT, "--accept", "sigma0 < 1.2", "--quiet").status == 0
    for options, why in (
        (["--accept", "sigm0 < 1"], "unknown quantity 'sigm0'"),
        (["--accept", "sigma0 smaller than 1"], "expected QUANTITY < NUMBER UNIT"),
        (["--details", tmp_path / "no.toml"], "no such file"),
        (["--certificate", "-"], "standard output"),
        (["--lengths", tmp_path / "no.csv"], "no such file"),
    ):
        told = command("adjust", PROJECT, *options, "--out", tmp_path / "o")
        assert told.status == 2 and why in told.err and told.err.count("\n") == 1, told.err
        assert not (tmp_path / "o").exists()


@pytest.mark.further
def test_a_calibration_is_judged_and_certified(command, tmp_path):
    page = tmp_path / "certificate.html"
    told = command(
        "calibrate", ROOT / "examples" / "board", "--board", "9x6", "--square", "0.03",
        "--out", tmp_path / "out", "--no-plots", "--no-cross-validation", "--certificate", page,
        "--accept", "rms < 0.2 px", "--accept", "sigma(fx) < 1e-3 px", "--accept",
        "coverage > 50 %",
        "--json", tmp_path / "r.json", "--quiet",
    )  # fmt: skip
    assert told.status == 4 and told.err.count("not met") == 1 and "sigma(fx)" in told.err
    document = json.loads((tmp_path / "r.json").read_text())
    assert [row["met"] for row in document["acceptance"]["criteria"]] == [True, False, True]
    assert (tmp_path / "out" / "acceptance.csv").is_file()
    assert 'id="acceptance"' in (tmp_path / "out" / "report.html").read_text("utf-8")
    text = page.read_text("utf-8")
    assert "Calibration certificate" in text and "k1 of camera cam" in text
    told = command("calibrate", ROOT / "examples" / "board", "--board", "9x6", "--square", "0.03",
                   "--accept", "sigma(c) < 1 px")  # fmt: skip
    assert told.status == 2 and "no parameter 'c'" in told.err
