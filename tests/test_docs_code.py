"""Pages of the documentation whose code runs, from the folder of the repository."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest

import jaxbundle

ROOT = Path(__file__).parents[1]


def run_page(name: str) -> dict:
    """The names that the Python blocks of a page leave behind."""
    text = (ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8")
    names: dict = {}
    blocks = re.findall(r"^```python\n(.*?)^```$", text, re.M | re.S)
    assert blocks
    for code in blocks:
        exec(code, names)
    return names


@pytest.fixture(autouse=True)
def in_the_repository(monkeypatch):
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(jaxbundle, "keep_programs", lambda: None)  # the tests have a folder


def test_statistics():
    page = run_page("statistics")
    assert page["r"].sum() == pytest.approx(page["result"].redundancy)
    assert page["minimal"].sigma0 == pytest.approx(page["result"].sigma0, rel=1e-9)
    # Inner constraints have the smallest trace.
    trace = lambda found: sum((found.points[f"s{axis}"] ** 2).sum() for axis in "XYZ")
    assert trace(page["result"]) < trace(page["minimal"])


def test_start():
    page = run_page("start")
    assert page["result"].redundancy == 23


@pytest.mark.further
def test_explore():
    answer = run_page("explore")["answer"]
    assert np.isfinite(answer["sigma"]["after"]["cameras"]).all()


@pytest.mark.further
@pytest.mark.slow  # derivatives of second order take a minute to compile
def test_derivatives():
    page = run_page("derivatives")
    assert page["check"].passed
    by_hand = page["result"].sigma0 * np.sqrt(
        ((page["propagation"] * page["sigma_image"]) ** 2).sum()
    )
    reported = page["result"].cameras["cam"]["parameters"]["c"]["sigma"]
    assert by_hand == pytest.approx(reported, rel=1e-6)
    assert page["reported"] == pytest.approx(reported, rel=1e-6)
    data, slopes, h = page["data"], page["slopes"], 1e-6
    moved = lambda t: dataclasses.replace(data, image_xy=data.image_xy.at[page["ray"], 0].add(t))
    ends = [page["sigma_of_sigma"](moved(t))[0] for t in (-h, h)]
    difference = (ends[1] - ends[0]) / (2 * h)
    assert slopes.image_xy[page["ray"], 0] == pytest.approx(float(difference), rel=1e-4)
