"""`jaxbundle calibrate` from the command line."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from page_reader import Page, column

import jaxbundle.calibration.files
import jaxbundle.calibration.quality

EXAMPLE = Path(__file__).parents[2] / "examples" / "board"
VIEWS = 12


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("command")
    for photograph in EXAMPLE.glob("*.jpg"):
        shutil.copy(photograph, folder)
    (folder / "text.jpg").write_text("no photograph")
    return folder


@pytest.fixture
def calibrate(command):
    return lambda *arguments: command("calibrate", *arguments)


@pytest.mark.further
def test_photographs_to_camera(calibrate, folder, tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(jaxbundle.calibration.files, "save_plots", lambda *a: drawn.append(a))
    out, file = tmp_path / "out", tmp_path / "result.json"
    code, told, error = calibrate(
        folder, "--board", "9x6", "--square", 0.03, "--out", out, "--json", file,
        "--html", tmp_path / "page.html",
    )  # fmt: skip
    assert (code, error) == (0, "")
    assert "photo_13.jpg  no chessboard" in told and "text.jpg      not an image" in told
    assert "Cross-validation" in told
    result = json.loads(file.read_text())
    assert result["converged"] and len(result["calibration"]["photographs"]["used"]) == VIEWS
    fx = result["cameras"]["cam"]["parameters"]["fx"]
    assert abs(fx["value"] - 620) < 3 * fx["sigma"]
    written = {path.name for path in out.iterdir()} - {".jaxbundle"}
    cameras = {"cam.toml", "cam.yaml", "colmap", "network"}
    assert written == {"report.txt", "report.html", "result.json"} | cameras and len(drawn) == 1
    page = (out / "report.html").read_text()
    assert page == (tmp_path / "page.html").read_text()
    said = Page(page).texts["td"]
    assert "no chessboard" in " ".join(said)
    assert {"--snooping", "--unit"} < {*Page(page).texts["th"]}
    sizes = {str(path.stat().st_size) for path in folder.glob("*.jpg")}
    assert sizes <= set(said)  # the photographs with their fingerprints
    first, *_, last = (out / "report.txt").read_text().strip().splitlines()
    assert "computed 20" in first and told.startswith(first)
    assert last not in told and str(out / "report.txt") in told  # printed in short


@pytest.mark.further
def test_two_cameras_and_brief_json_alone(calibrate, folder, tmp_path, monkeypatch):
    monkeypatch.delattr(jaxbundle.calibration.quality, "cross_validation")
    code, told, error = calibrate(
        "--camera", f"a={folder}/photo_*.jpg", "--camera", f"b={folder}/photo_*.jpg",
        "--board", "9x6", "--square", 0.03, "--json", "-", "--brief",
        "--no-cross-validation", "--html", tmp_path / "both.html",
    )  # fmt: skip
    assert (code, error) == (0, "")
    page = (tmp_path / "both.html").read_text()
    assert {"Camera a", "Camera b"} <= set(Page(page).texts["td"])
    assert set(column(page, "cameras", "camera")) == {"a", "b"}
    result = json.loads(told)
    assert result["converged"] and set(result["calibrations"]) == {"a", "b"}
    assert "residuals" not in result["calibrations"]["a"] and "rig" not in result
    assert result["calibrations"]["b"]["calibration"]["cross_validation"] is None


@pytest.mark.parametrize("arguments, said", [
    (["--board", "9x6", "--square", "0.03"], "no photographs: give files"),
    (["FOLDER", "--square", "1"], "--board is missing: COLUMNSxROWS"),
    (["no_such.jpg", "--board", "9x6", "--square", "1"], "no_such.jpg: no such file or folder"),
    (["FOLDER", "--board", "9x6", "--square", "1", "--marker", "0.5"],
     "--marker is not for --kind chessboard, but for charuco"),
    (["FOLDER", "--board", "9x6", "--square", "1", "--html", "FOLDER/photo_01.jpg"],
     "is part of the input"),
    (["FOLDER", "--board", "9by6", "--square", "1"], "--board '9by6': expected COLUMNSxROWS"),
    (["FOLDER", "--board", "9x6"], "--square is missing"),
    (["FOLDER", "--board", "9x6", "--square", "1", "--kind", "dots"], "'dots': expected one of"),
    (["FOLDER", "--board", "9x6", "--square", "1", "--free", "fx,fz"], "no free parameter 'fz'"),
    (["FOLDER", "--board", "9x6", "--square", "1", "--given", "fx"], "expected NAME=VALUE"),
    (["FOLDER", "--board", "9x6", "--square", "1", "--camera", "a"], "either as arguments or by"),
    (["--board", "9x6", "--square", "1", "--camera", "a"], "--camera a: expected NAME=PATTERN"),
    (["--board", "9x6", "--square", "1", "--camera", "a=x", "--camera", "a = y"],
     "--camera a is given twice: a=x, a=y"),
    (["FOLDER", "--board", "9x6", "--square", "1", "--snooping", "x"],
     "--snooping 'x': expected one of pope, baarda, none"),
    (["FOLDER", "--board", "9x6", "--square", "1", "--rig"], "a rig has at least two cameras"),
    (["FOLDER", "--board", "9x6", "--square", "1", "--json", "FOLDER"], "is a folder"),
    (["FOLDER", "--board", "9x6", "--square", "1", "--json", "FOLDER/text.jpg"], "overwritten"),
])  # fmt: skip
def test_bad_arguments_are_one_line(calibrate, folder, arguments, said):
    code, told, error = calibrate(*(a.replace("FOLDER", str(folder)) for a in arguments))
    assert code == 2 and told == ""
    assert said in error and error.count("\n") == 1


def test_photographs_that_show_no_board(calibrate, folder, tmp_path):
    cv2.imwrite(str(tmp_path / "grey.png"), np.full((360, 480), 99, np.uint8))
    out = tmp_path / "out"
    code, _, error = calibrate(tmp_path, "--board", "9x6", "--square", 0.03, "--out", out)
    assert code == 2
    assert f"no photograph of 1 shows the board: {tmp_path}/grey.png: no chessboard" in error
    assert not out.exists()
    code, _, error = calibrate(folder / "photo_01.jpg", "--board", "10x7", "--square", 0.03)
    assert code == 2 and "give --board 9x6" in error
