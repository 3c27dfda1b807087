"""Pages of the documentation whose code runs, from the folder of the repository."""

import dataclasses
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

import jaxbundle

ROOT = Path(__file__).parents[1]


def blocks_of(path: Path) -> list[str]:
    """The Python blocks of a page."""
    return re.findall(r"^```python\n(.*?)^```$", path.read_text(encoding="utf-8"), re.M | re.S)


def run_page(name: str, **given) -> dict:
    """The names defined by the Python blocks of a page; `given`: the reader's own."""
    names: dict = dict(given)
    blocks = blocks_of(ROOT / "docs" / f"{name}.md")
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


def test_the_output_in_the_readme_is_what_its_code_prints():
    """Of lines that no rounding changes: the number of iterations may differ by one."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    code, shown = re.search(r"```python\n(.*?)```\n\n```text\n(.*?)```", text, re.S).groups()
    assert "print(result)" in code
    printed = str(jaxbundle.adjust(re.search(r'read_network\("(.*?)"\)', code)[1]))
    lines = [line for line in shown.splitlines() if "iterations" not in line and "…" not in line]
    assert len(lines) > 6 and not {*lines} - {*printed.splitlines()}


def test_start():
    page = run_page("start")
    assert page["result"].redundancy == 23


@pytest.mark.further
def test_refraction():
    page = run_page("refraction")
    water = page["result"].further_unknowns["interface"]["water"]["Z0"]
    assert abs(water["value"] - 1) < 4 * water["sigma"]


@pytest.mark.further
def test_hand_eye():
    page = run_page("hand_eye")
    camera = page["found"].camera()
    sigma = page["found"].covariance().diagonal()[:3] ** 0.5
    assert (abs(camera[:3, 3] - [0, 0, 0.1]) < 4 * sigma).all()


@pytest.mark.further
def test_known_surfaces():
    page = run_page("known_surfaces")
    found = page["result"].further_unknowns["declination"]["cam"]["declination"]
    assert abs(found["value"] - 0.05) < 4 * found["sigma"]
    assert page["result"].counts.datum == 0


SIZE = (1920, 1080)


@pytest.fixture(scope="module")
def views():
    """A board, its images by OpenCV, and their rotation vectors and translations."""
    board = np.zeros((54, 3), np.float32)
    board[:, :2] = 0.03 * np.mgrid[:9, :6].reshape(2, -1).T
    K, k = np.array([[1600.0, 0, 961], [0, 1610, 541], [0, 0, 1]]), np.array([-0.2, 0.05, 0, 0, 0])
    turns = np.array([
        (0.3, -0.2, 0.1), (-0.4, 0.1, 1.5), (0.1, 0.5, -0.2), (0.5, 0.4, 0.0), (-0.2, -0.5, 3)
    ])  # fmt: skip
    shifts = np.array([(-0.1 + 0.02 * i, -0.08, 0.5 + 0.05 * i) for i in range(5)])
    images = [cv2.projectPoints(board, *pose, K, k)[0] for pose in zip(turns, shifts)]
    return board, images, turns, shifts


@pytest.mark.further
def test_coming_from(views):
    """Views projected by OpenCV come back with its camera and its poses."""
    board, images, turns, shifts = views
    page = run_page(
        "howto/coming_from", objpoints=[board] * 5, imgpoints=images, image_size=SIZE
    )
    K = page["K"]
    assert [K[0, 0], K[1, 1], K[0, 2], K[1, 2], page["dist"][0, 0]] == pytest.approx(
        [1600, 1610, 961, 541, -0.2], rel=1e-3
    )
    assert np.squeeze(page["tvecs"]) == pytest.approx(shifts, abs=1e-4)
    R = cv2.Rodrigues(page["rvecs"][1])[0]
    assert cv2.Rodrigues(turns[1])[0] == pytest.approx(R, abs=1e-4)


@pytest.mark.further
def test_certificate(tmp_path, monkeypatch):
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.chdir(tmp_path)  # it writes a page
    page = run_page("certificate")
    assert page["found"].met and page["test"].verdict == "conformity proven"
    assert (tmp_path / "certificate.html").read_text("utf-8").startswith("<!doctype html>")


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
    xy = data.measured["image"]
    moved = lambda t: dataclasses.replace(
        data, measured=data.measured | {"image": xy.at[page["ray"], 0].add(t)}
    )
    ends = [page["sigma_of_sigma"](moved(t))[0] for t in (-h, h)]
    difference = (ends[1] - ends[0]) / (2 * h)
    assert slopes.measured["image"][page["ray"], 0] == pytest.approx(float(difference), rel=1e-4)


@pytest.mark.further
def test_result(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    page = run_page("result")
    found = page["found"].to_pandas()
    assert {name for name, row in zip(found.index, found.differs) if row} != set()
    assert float(page["sigma_c"](page["start"]["image"].position)) > 0
    assert "bent board" in str(page["budget"]) and "c" in str(page["influence"])


@pytest.mark.further
def test_measure():
    assert len(run_page("measure")["points"]) == 54
