"""Pages of the documentation whose code runs, from the folder of the repository."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest

import jaxbundle

ROOT = Path(__file__).parents[1]


def run_page(name: str, **given) -> dict:
    """The names that the Python blocks of a page leave behind; `given`: the reader's own."""
    text = (ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8")
    names: dict = dict(given)
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
def test_coming_from():
    """Views projected by OpenCV come back with its camera and its poses."""
    import cv2

    board = np.zeros((54, 3), np.float32)
    board[:, :2] = 0.03 * np.mgrid[:9, :6].reshape(2, -1).T
    K, k = np.array([[800.0, 0, 321], [0, 805, 243], [0, 0, 1]]), np.array([-0.2, 0.05, 0, 0, 0])
    turns = [(0.3, -0.2, 0.1), (-0.4, 0.1, 1.5), (0.1, 0.5, -0.2), (0.5, 0.4, 0.0), (-0.2, -0.5, 3)]
    tvecs = [(-0.1 + 0.02 * i, -0.08, 0.5 + 0.05 * i) for i in range(5)]
    views = [cv2.projectPoints(board, np.array(r, float), np.array(t), K, k)[0]
             for r, t in zip(turns, tvecs)]  # fmt: skip
    page = run_page(
        "howto/coming_from", objpoints=[board] * 5, imgpoints=views, image_size=(640, 480)
    )
    values = dict(zip(page["found"].parameters, page["found"].values[0]))
    assert [values[n] for n in ("fx", "fy", "cx", "cy", "k1")] == pytest.approx(
        [800, 805, 321, 243, -0.2], rel=1e-3
    )
    assert page["tvecs"] == pytest.approx(np.array(tvecs), abs=1e-4)
    assert page["R"][1] == pytest.approx(cv2.Rodrigues(np.array(turns[1]))[0], abs=1e-4)


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
