"""Acceptance criteria of batches and of results without quantities of their own."""

import csv
import json
import math
from pathlib import Path

import numpy as np
import pytest

from jaxbundle.batches.population import Population
from jaxbundle.certificates.acceptance import accept, accept_known, check_criteria
from jaxbundle.certificates.check_differences import CheckDifferences, check_point_quantities
from jaxbundle.certificates.quantities import offered
from jaxbundle.certificates.quantity import Subject
from jaxbundle.errors import InputError

ROOT = Path(__file__).parents[2]
PROJECT = ROOT / "examples" / "convergent4" / "project.toml"


def line(key, fx=800.0, sigma=0.5, rms=0.1, status="converged", **more):
    found = {"key": key, "status": status, "sigma0": 1.0, "redundancy": 100, "views": 12}
    parameters = {"fx": {"value": fx, "sigma": sigma}}
    return found | {"model": "opencv", "rms": rms, "parameters": parameters} | more


BAD = {"key": "c", "status": "bad input", "error": "c: no photographs"}


def test_every_input_must_meet_a_criterion():
    found = accept(
        Population([line("a", rms=0.1), line("b", rms=0.3, sigma=0.7), line("d", rms=0.4)]),
        ["rms < 0.35 px", "rms < 0.2 px", "sigma(fx) <= 0.7 px", "value(fx) > 799 px",
         "views >= 12", "solved >= 100 %", "converged > 99 %"],
    )  # fmt: skip
    assert [row.met for row in found.rows] == [False, False, True, True, True, True, True]
    assert found.rows[0].of == "d" and found.rows[0].value == 0.4
    assert found.rows[1].line == "rms < 0.2 px: 0.400 px (d, largest of 3; 2 do not meet it)"
    assert found.meets_all(["a", "b", "d"]).tolist() == [True, False, False]
    assert found.to_dict()["criteria"][1]["failed"] == 2


def test_an_input_without_a_result_is_not_accepted_unless_the_share_is_stated():
    rows = [line("a"), line("b"), BAD]
    found = accept(Population(rows), "rms < 1 px")
    assert not found.met and "solved >= 100 %: 66.7 % (all but c)" in found.unmet[0]
    assert found.meets_all(["a", "b", "c"]).tolist() == [True, True, False]
    assert accept(Population(rows), ["rms < 1 px", "solved > 60 %"]).met
    assert not accept(Population([BAD]), "rms < 1 px").met


def test_a_result_without_the_number_is_not_accepted():
    network = line("n") | {"parameters": {}}
    del network["rms"]
    found = accept(Population([line("a"), network]), ["rms < 1 px", "sigma(fx) < 1 px"])
    assert "the result of n has no rms" in found.unmet[0] and len(found.unmet) == 2
    assert found.meets_all(["a", "n"]).tolist() == [True, False]
    found = accept(Population([line("a")]), "sigma(K9) < 1")
    assert "known: fx" in found.unmet[0]
    assert found.meets_all(["a"]).tolist() == [False]


def test_cameras_of_a_rig_are_judged_each():
    both = {"left fx": {"value": 800.0, "sigma": 0.5}, "right fx": {"value": 801.0, "sigma": 0.9}}
    found = accept(Population([line("r") | {"parameters": both}]), "sigma(fx) < 0.8 px")
    assert found.rows[0].of == "right fx of r" and found.rows[0].number == 2
    assert found.meets_all(["r"]).tolist() == [False]
    assert accept(Population([line("r") | {"parameters": both}]), "sigma(left fx) < 0.8 px").met


def test_criteria_of_a_batch_are_checked_before_the_work():
    check_criteria(["rms < 0.3 px", "sigma(fx) < 1 px", "solved > 95 %"], "batch")
    for text, why in (
        ("coverage > 1 %", "unknown quantity 'coverage'"),
        ("sigma < 1 px", "in parentheses"),
        ("rms(a) < 1 px", "no argument"),
        ("rms < 1 deg", "one of px"),
    ):
        with pytest.raises(InputError, match=why):
            check_criteria([text], "batch")
    good = ["robot.sigma(position) < 1 mm", "robot.repeatability(rotation) < 1 mrad"]
    check_criteria(good, "hand-eye")
    for text, why in (
        ("robot.sigma(rotation) < 1 mm", "one of rad"),
        ("robot.sigma(angle) < 1 rad", "position, rotation"),
    ):
        with pytest.raises(InputError, match=why):
            check_criteria([text], "hand-eye")
    check_criteria(["check.rms(H) < 2 m", "sigma(Z) < 1 m"], "pushbroom refine")
    with pytest.raises(InputError, match="one of X, Y, Z"):
        check_criteria(["sigma(c) < 1 m"], "pushbroom refine")
    # the numbers of their JSON are known afterwards
    check_criteria(["anything.at.all < 1"], "replicate")
    with pytest.raises(InputError, match="expected "):
        check_criteria(["anything"], "replicate")


class Other:
    """A result as of a function without quantities of its own."""

    converged = True

    def to_dict(self):
        return {
            "d2": 3.0,
            "splits": [{"id": "a", "d2": 1.0}, {"id": "b", "d2": 5.0}],
            "check_rms": [0.1, None, 0.3],
            "by": "photographs",
            "empty": [],
        }


def test_numbers_of_lists_are_judged_each():
    assert accept(Other(), "d2 < 4").met
    row = accept(Other(), "splits.d2 < 4").rows[0]
    assert (row.value, row.of, row.number, row.met) == (5.0, "b", 2, False)
    row = accept(Other(), "check_rms < 1").rows[0]
    assert not row.met and math.isnan(row.value) and "not a number" in row.why
    assert not accept(Other(), "empty < 1").met
    for text, why in (("by < 1", "not a number"), ("splits.e < 1", "unknown quantity 'splits.e'")):
        with pytest.raises(InputError, match=why):
            accept(Other(), text)
    found = accept_known(Other(), ["d2 < 4", "d3 < 4"])
    assert [row.met for row in found.rows] == [True, False] and "known: d2" in found.unmet[0]


def test_every_quantity_of_these_commands_is_documented():
    page = (ROOT / "docs" / "certificate.md").read_text(encoding="utf-8")
    for command in ("batch", "hand-eye", "pushbroom refine"):
        for quantity in offered(command).values():
            assert f"`{quantity.form}`" in page, quantity.form
            assert quantity.words


def test_the_command_says_which_inputs_are_not_accepted(command, tmp_path):
    (tmp_path / "empty").mkdir()
    told = command(
        "batch", PROJECT, tmp_path / "empty", "--board", "9x6", "--square", "0.03",
        "--json-lines", tmp_path / "r.jsonl", "--accept", "sigma0 < 1", "--table",
        tmp_path / "t.csv", "--summary", tmp_path / "s.json", "--html", tmp_path / "p.html",
    )  # fmt: skip
    assert told.status == 4 and told.err.count("not met") == 1
    assert "solved >= 100 %: 50 % (all but empty)" in told.err
    with (tmp_path / "t.csv").open(encoding="utf-8") as file:
        rows = {row["key"]: row["accepted"] for row in csv.DictReader(file)}
    assert rows.pop("empty") == "False" and [*rows.values()] == ["True"]
    document = json.loads((tmp_path / "s.json").read_text("utf-8"))
    assert document["not_accepted"] == ["empty"]
    assert [row["met"] for row in document["acceptance"]["criteria"]] == [True, False]
    assert 'id="acceptance"' in (tmp_path / "p.html").read_text("utf-8")
    again = ("batch", PROJECT, "--json-lines", tmp_path / "r.jsonl", "--quiet")
    assert command(*again, "--accept", "sigma0 < 1").status == 0
    told = command(*again, "--accept", "sigm0 < 1")
    assert told.status == 2 and "did you mean 'sigma0'" in told.err


def test_a_refinement_is_judged_by_its_check_points():
    from jaxbundle.refinement import Refinement
    from jaxbundle.refinement.check_points import RefinementCheckPoints

    difference = np.array([[3.0, 4.0, np.nan], [3.0, -4.0, 2.0]])
    check = RefinementCheckPoints(("p", "q"), difference, np.ones((2, 3)), np.array([1, 2]),
                                  np.zeros((3, 2)), np.ones((3, 2)))  # fmt: skip
    result = Refinement(None, check, ("a warning",))
    criteria = ["check.rms(X) <= 3 m", "check.rms(H) <= 5 m", "check.rms(V) <= 2 m",
                "check.rms < 5.385 m", "check.rms < 5.386 m", "check.max < 4 m",
                "check.max(Z) <= 200 cm", "check.number >= 2", "warnings < 1"]  # fmt: skip
    found = accept(result, criteria)
    # by hand: √(3² + 4² + 2²) = 5.38516
    assert [row.met for row in found.rows] == [True, True, True, False, True, False, True, True,
                                               False]  # fmt: skip
    assert not accept(Refinement(None, None, ()), "check.rms < 1 m").met


def test_any_command_ends_with_status_4_and_writes_everything(command, tmp_path):
    cameras = ROOT / "examples" / "video_cameras" / "cameras.toml"
    pair = (f"{cameras}#1-indoor", f"{cameras}#1-outdoor", "--json", tmp_path / "c.json")
    told = command("compare", *pair, "--csv", tmp_path / "c.csv", "--accept", "rings.rms < 1e-9",
                   "--accept", "no.such < 1")  # fmt: skip
    document = json.loads((tmp_path / "c.json").read_text("utf-8"))
    assert told.status == 4 and told.err.count("not met") == 2 and (tmp_path / "c.csv").is_file()
    assert "unknown quantity 'no.such'" in told.err
    assert [row["met"] for row in document["acceptance"]["criteria"]] == [False, False]
    plan = ("plan", "--c", "100", "--image", "68,104", "--area", "300,300", "--sigma-image",
            "0.003", "--height", "1000", "--no-network")  # fmt: skip
    # m = 1000/0.1, which the plan states as such
    assert command(*plan, "--accept", "scale_number <= 10000").status == 0
    assert command(*plan, "--accept", "scale_number < 10000").status == 4
    told = command(*plan, "--accept", "scale_number")
    assert told.status == 2 and "expected " in told.err


def test_an_axis_that_no_check_point_has_is_not_met_by_0():
    difference = np.array([[0.3, 0.0, np.nan], [0.3, 0.8, np.nan]])
    rms, largest, number = check_point_quantities(
        lambda _: CheckDifferences(("p", "q"), difference, "m")
    )
    subject = Subject(None)
    assert rms.find(subject, "").values[""] == pytest.approx(np.sqrt(0.09 + 0.32))
    assert largest.find(subject, "Y").values == {"Y of check point p": 0, "Y of check point q": 0.8}
    assert number.find(subject, "").values == {"": 2}
    for quantity in (rms, largest):
        with pytest.raises(LookupError, match="no check point has this difference"):
            quantity.find(subject, "Z")
    nothing = check_point_quantities(lambda _: None)
    with pytest.raises(LookupError, match="no check points"):
        nothing[0].find(subject, "")
    assert nothing[2].find(subject, "").values == {"": 0}
