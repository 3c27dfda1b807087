"""The pages of batches, reconstructions and several cameras: their contents agree with the
result."""

import dataclasses
import datetime
import json

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from page_reader import Page, column

from jaxbundle.adjustment.result import Adjustment
from jaxbundle.batches.page import compose_batch
from jaxbundle.batches.run_on_files import result_rows
from jaxbundle.reconstruction.adjusting import WeightedAdjustment
from jaxbundle.reconstruction.block import BlockFacts
from jaxbundle.reconstruction.page import compose_part
from jaxbundle.reconstruction.result import ReconstructedPart, Reconstruction
from jaxbundle.report.page import Addition, Finding, Section, compose
from jaxbundle.report.page.charts import draw_field, draw_histogram
from jaxbundle.report.verdict import BAD

HOSTILE = "</script><b>"


def camera_row(i: int, **changed) -> dict:
    """A line as `run_batch` writes it."""
    wobble = (i * 37 % 11 - 5) / 5
    return {
        "key": f"c.npz#{i}", "status": "converged", "model": "opencv", "iterations": 5,
        "redundancy": 1700, "views": 20, "views_left_out": [], "rms": 0.05 + 0.001 * (i % 7),
        "sigma0": 0.04, "parameters": {"fx": {"value": 1000.0 + wobble, "sigma": 0.2}},
    } | changed  # fmt: skip


@pytest.fixture(scope="module")
def rows():
    rows = [camera_row(i) for i in range(40)]
    rows[3]["parameters"] = {"fx": {"value": 1100.0, "sigma": 0.2}}
    rows[5] = camera_row(5, status="misfit", rms=3.0, remark="gross errors")
    rows[7] = {"key": f"{HOSTILE}#7", "status": "singular", "remark": HOSTILE, "iterations": 3,
               "redundancy": 0, "views": 0}  # fmt: skip
    return rows


# --- batches --------------------------------------------------------------------------------


def test_a_batch_shows_its_population(rows):
    text = "".join(compose_batch(rows))
    page = Page(text)
    assert page.texts["title"] == ["40 inputs: batch"]
    # status by status, and of all 38 converged cameras the median and the robust σ of fx
    cells = page.texts["td"]
    assert cells.count("converged") == 1 and {"38", "1", "95.0"} <= set(cells)
    fit = [row for row in rows if row["status"] == "converged"]
    fx = np.array([row["parameters"]["fx"]["value"] for row in fit])
    spread = 1.4826 * np.median(np.abs(fx - np.median(fx)))
    assert f"{np.median(fx):.3f}" in cells and f"{spread:.3f}" in cells
    outlying = [words for words in cells if "robust σ from the median" in words]
    assert outlying == [f"fx {(1100 - np.median(fx)) / spread:.0f} robust σ from the median"]
    assert "misfit; gross errors" in cells and f"singular; {HOSTILE}" in cells


def test_the_table_of_a_batch_has_every_row(rows):
    text = "".join(compose_batch(iter(rows)))
    assert_array_equal(column(text, "results", "status"), [row["status"] for row in rows])
    rms = np.array([row.get("rms", np.nan) for row in rows])
    assert_allclose(column(text, "results", "rms"), rms, rtol=1e-6)
    sigma = np.array([row.get("parameters", {}).get("fx", {}).get("sigma", np.nan) for row in rows])
    assert_allclose(column(text, "results", "sigma_fx"), sigma, rtol=1e-6)


@pytest.mark.parametrize("rows, verdict", [
    ([camera_row(i) for i in range(12)], "The result meets its tests."),
    ([camera_row(0), camera_row(1, status="weak")], "Use the result with care: Fit."),
    ([{"key": "a", "status": "bad input", "error": "no such file"}],
     "The result does not meet its tests: Results."),
])  # fmt: skip
def test_the_verdict_of_a_batch(rows, verdict):
    text = "".join(compose_batch(rows))
    assert verdict in Page(text).texts["p"] and "of these 0" not in text


def test_lines_of_other_inputs_are_not_of_the_batch(tmp_path, rows):
    file = tmp_path / "r.jsonl"
    keys = ["c.npz#1", "other.npz#1", "c.npz", "c.npz2#4"]
    file.write_text("".join(json.dumps({"key": key, "status": "x"}) + "\n" for key in keys))
    found = [row["key"] for row in result_rows([tmp_path / "c.npz"], file)]
    assert found == ["c.npz#1", "c.npz"]


# --- reconstructions ------------------------------------------------------------------------


BLOCK = BlockFacts(
    photographs=4, taken=None, computed=datetime.datetime(2026, 5, 4), system="", unit="m",
    ground_sample_distance=0.01, object_distance=10.0, flying_height=None, area=None,
    rays_per_point=4.0, points_per_photograph=10.0, photographs_per_place=None, positions=None,
)  # fmt: skip


def test_a_reconstruction_names_what_it_left_out(convergent4):
    part = ReconstructedPart("part 1", convergent4, {"sift": 1.75}, BLOCK)
    found = Reconstruction(
        (part,), {f"{HOSTILE}.jpg": "too few matches"}, ("a note",),
        (("a.jpg", "b.jpg", 100, 60, "general"),), {name: None for name in "abcde"},
    )  # fmt: skip
    named = dataclasses.replace(found, name="gravel pit")
    assert Page("".join(compose_part(named, part))).texts["title"] == ["gravel pit: reconstruction"]
    text = "".join(compose_part(found, part))
    page = Page(text)
    cells = page.texts["td"]
    assert f"{HOSTILE}.jpg" in cells and "too few matches" in cells and "1.750" in cells
    assert "a note" in page.texts["li"]
    assert any(words.startswith("4 of 5 photographs in this part") for words in cells)
    assert column(text, "pairs", "verified").tolist() == [60]
    assert len(column(text, "points", "X")) == len(convergent4.points["id"])


def test_estimated_sigma_are_not_confirmed_after_control_either(convergent4):
    """The adjustment to control takes the place of that of the measurements alone."""
    again = lambda: Adjustment(convergent4.network, convergent4.problem, convergent4.minimum)
    found = dataclasses.replace(WeightedAdjustment(again(), {"sift": 3.2}, 40), adjustment=again())
    assert found.adjustment.global_test()["passed"] is None
    for text in (found.adjustment.report(), "".join(compose(found.adjustment))):
        assert "not done: the σ were estimated from these" in text.replace("\n" + " " * 18, " ")


@pytest.mark.parametrize("factor, state, words", [
    (3.0, "noted", ""), (5.0, "doubtful", "doubtful: "), (19.7, "not met", "most likely wrong: ")
])  # fmt: skip
def test_a_reconstruction_that_fits_badly_says_so_first(convergent4, factor, state, words):
    part = ReconstructedPart("part 1", convergent4, {"sift": factor, "other": 1.0}, BLOCK)
    warnings = (f"part 1: {words}measurements fit {factor} times worse",) if words else ()
    found = Reconstruction((part,), {}, ("a note",), (), {"a": None}, warnings)
    first = str(found).splitlines()[0]
    assert first == (f"warning: {warnings[0]}" if words else first) and part.misfit == factor
    page = Page("".join(compose_part(found, part)))
    cells = page.texts["td"]
    fit = next(k for k, cell in enumerate(cells) if cell.startswith("residuals relative to"))
    assert cells[fit - 1] == state
    assert not any("confirmed" in cell for cell in cells)
    assert page.texts["li"][: len(warnings)] == [*warnings]


# --- additions ------------------------------------------------------------------------------


def test_what_is_added_to_an_adjustment_stands_before_it(convergent4):
    added = Addition(
        "trial", (Finding("Own", BAD, "said"),), ("Control",), ("mind this",), "",
        (Section("own", "Own section", "", "Own"),),
    )  # fmt: skip
    page = Page("".join(compose(convergent4, also=added)))
    assert page.texts["h2"][:3] == ["Verdict", "Own section", "Network"]
    assert page.texts["p"][1] == "The result does not meet its tests: Own."
    assert page.texts["li"][0] == "mind this" and "Control" not in page.texts["td"]
    assert page.texts["title"] == ["four convergent photographs: trial"]
    assert page.attributes("href")[0] == "#own"


# --- drawings -------------------------------------------------------------------------------


def test_a_field_is_read_without_colours():
    values = np.array([[0.5, np.nan], [2.0, 1.25]])
    drawn = Page(draw_field(values))
    assert drawn.texts["text"] == ["0.50", "2.0", "1.2"]
    shades = [float(s) for s in drawn.attributes("fill-opacity")]
    assert_allclose(shades, [0, 0.6, 0.3])
    assert Page(draw_field(np.full((2, 2), np.nan))).texts.get("text") is None


def test_bars_are_as_high_as_their_counts():
    counted = np.array([1, 4, 2])
    drawn = Page(draw_histogram(np.array([0.0, 1.0, 2.0, np.inf]), counted, "x", "things"))
    bars = [given for tag, given in drawn.tags if tag == "rect" and given["class"] == "bar"]
    heights = np.array([float(given["height"]) for given in bars[:3]])
    assert_allclose(heights / heights[1], counted / 4, atol=2e-3)
    assert len({given["width"] for given in bars[:3]}) == 1  # the open class, too


