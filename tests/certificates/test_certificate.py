"""The certificate: its page, its details, and that it prints."""

import json

import numpy as np
import pytest
from page_reader import Page

import jaxbundle
from jaxbundle.certificates.details import read_details
from jaxbundle.certificates.page import readable_length
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.report.page.markup import grid_of_first

DETAILS = {
    "certificate": {"number": "2026-014", "laboratory": "A <b>lab</b> & sons", "object": "camera"},
    "evaluation": {"mpe": "1 mm + L/1000", "horizontal_class": 0.05},
    "input": [{"name": "camera:cam:K2", "limits": 1e-8, "words": "K2 not modelled"}],
}


@pytest.fixture(scope="module")
def document(field):
    result, targets = field
    length = float(np.linalg.norm(targets[12] - targets[13]))
    lengths = {
        "from": ["13", "no"], "to": ["14", "14"], "value": [length, 1.0], "sigma": [1e-6] * 2,
    }  # fmt: skip
    return jaxbundle.certificate(
        result, details=DETAILS, lengths=lengths, criteria=["LME < 1 mm", "sigma0 < 0.01"]
    )


@pytest.mark.further
def test_the_page_has_every_part_once_and_nothing_of_others_unescaped(document):
    html = document.html()
    page = Page(html)
    ids = [attributes["id"] for _, attributes in page.tags if "id" in attributes]
    assert len(ids) == len({*ids})
    for id in ("certificate", "results", "budget", "lengths", "acceptance", "accuracy",
               "adjustment", "statements", "origin"):  # fmt: skip
        assert id in ids
    assert "A &lt;b&gt;lab&lt;/b&gt; &amp; sons" in html
    assert "2026-014" in html and "K2 not modelled" in html
    for words in ("Expanded uncertainty".lower(), "neither proven", "RMSE_3D", "not accepted"):
        assert words in html
    assert html.count('class="blank"') == 8  # wanted fields that are not given


def test_the_numbers_are_those_of_its_parts(document, tmp_path):
    (part,) = document.parts
    found = document.to_dict()
    assert found["parts"][0]["budget"]["measurands"]["camera:cam:c"]["expanded"] == pytest.approx(
        part.budget.expanded[0]
    )
    assert found["acceptance"]["met"] is False
    assert found["length_errors"]["missing"] == [["no", "14"]]
    # One conforms, the other is missing: all of them must.
    assert found["length_errors"]["verdict"] == "neither proven"
    assert found["acceptance"]["criteria"][0]["met"] is False
    assert found["parts"][0]["positional_accuracy"]["horizontal_class"] == 0.05
    held = part.budget.lines[-1]
    assert held.words == "K2 not modelled" and held.uncertainty == pytest.approx(1e-8 / 3**0.5)
    document.save(tmp_path / "c.html")
    document.save(tmp_path / "c.json")
    assert (tmp_path / "c.html").read_text("utf-8").startswith("<!doctype html>")
    assert json.loads((tmp_path / "c.json").read_text())["details"]["number"] == "2026-014"
    assert "Budget of c" in str(document)


@pytest.mark.further
def test_cameras_that_are_held_are_no_measurands(document):
    result = document.result
    import dataclasses

    held = tuple(dataclasses.replace(c, free=()) for c in result.network.cameras)
    fixed = jaxbundle.adjust(result.network.replace(cameras=held))
    found = jaxbundle.certificate(fixed)
    assert found.parts[0].budget is None and "measurands" in found.parts[0].no_budget
    named = jaxbundle.certificate(fixed, details={"evaluation": {"measurands": ["point:15:Z"]}})
    assert named.parts[0].budget.measurands[0].unit == "m"
    assert "measurands in the details" in found.html()


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ({"certificat": {}}, "unknown key 'certificat'; did you mean 'certificate'"),
        ({"certificate": {"numbr": "1"}}, r"\[certificate\]: unknown key 'numbr'"),
        ({"evaluation": {"coverage": 95}}, "between 0 and 1"),
        ({"evaluation": {"rule": "none"}}, "one of guard band"),
        ({"evaluation": {"volume": [1, 2]}}, "three sides"),
        ({"evaluation": {"measurands": ["c"]}}, "KIND:ID:NAME"),
        ({"input": [{"limits": 1.0}]}, "input 1: name is missing"),
        ({"evaluation": {"mpe": "50"}}, r"\[evaluation\], mpe: MPE '50': expected A UNIT"),
        ({"input": [{"name": "camera:cam:K3", "sigma": 1, "k": 2}]}, "k is the coverage factor"),
        ({"input": [{"name": "camera:cam:K3"}]}, "one of sigma, limits, expanded"),
        ({"input": [{"name": "camera:cam:K3", "sigma": -1}]}, "positive"),
        (
            {"input": [{"name": "camera:cam:K3", "sigma": 1, "distribution": "flat"}]},
            "one of normal",
        ),
        ({"input": [{"name": "camera:cam:K3", "sigma": 1}] * 2}, "given twice"),
        (3, "the path of a TOML file"),
    ],
)
def test_details_that_cannot_be_used_say_where(given, why):
    with pytest.raises(InputError, match=why):
        read_details(given)


def test_inputs_of_details():
    found = read_details({"input": [
        {"name": "image:1:phi", "expanded": 0.02, "k": 2.0, "degrees": 9},
        {"name": "camera:a:K1", "limits": 6.0, "distribution": "triangular"},
    ]})  # fmt: skip
    assert found.held("deg")["image:1:phi"].uncertainty == pytest.approx(np.deg2rad(0.01))
    assert found.held("deg")["image:1:phi"].degrees == 9
    assert found.inputs["camera:a:K1"].uncertainty == pytest.approx(6**0.5)


def test_a_length_test_made_otherwise_than_the_details_say_is_refused(document):
    """The one that was made with them is taken."""
    result, test = document.result, document.lengths
    assert jaxbundle.certificate(result, details=DETAILS, lengths=test).lengths is test
    for change in ({"mpe": "2 mm"}, {"rule": "simple acceptance"}, {"volume": [9, 9, 9]}):
        with pytest.raises(InputError, match=f"^{next(iter(change))} of the details"):
            jaxbundle.certificate(result, details={"evaluation": change}, lengths=test)


def test_the_rest_of_a_long_table_is_counted():
    rows = [("1",), ("2",), ("3",)]
    assert "… and 1 more: all are in the JSON." in grid_of_first("a", rows, 2, "", "in the JSON")
    assert "more" not in grid_of_first("a", rows, 3)


def test_lengths_are_readable():
    assert readable_length(1.14e-4, "m") == "114 µm"
    assert readable_length(2.5, "mm") == "2.50 mm"
    assert readable_length(0.5, "model") == "0.500 model"
    assert readable_length(12.0, "m") == "12.0 m"


def test_what_is_no_adjustment_is_refused():
    with pytest.raises(InputError, match="adjust, calibrate"):
        jaxbundle.certificate(3)
    with pytest.raises(NotSolvedError):
        from jaxbundle.adjustment.result import Adjustment

        unsolved = Adjustment.__new__(Adjustment)
        unsolved.undetermined = ("c",)
        unsolved.minimum = type("M", (), {"termination": 0})()
        jaxbundle.certificate(unsolved)
