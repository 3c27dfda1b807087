"""What the command line writes is checked before the adjustment, and replaces existing files."""

import json
import os
import re
from pathlib import Path

import pytest

import jaxbundle
from jaxbundle.cli.outputs import check_targets, write_targets
from jaxbundle.cli.pushbroom.shared import check_outputs
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.io.text.csv_tables import write_text
from jaxbundle.io.writing.folders import MARKER

EXAMPLE = Path(__file__).parents[2] / "examples" / "convergent4" / "project.toml"
REASON = NotSolvedError("not solved: too few images", ["X0 of image 7"])


@pytest.fixture(scope="module")
def network():
    return jaxbundle.read_network(EXAMPLE)


def names(folder):
    return {path.name for path in folder.iterdir()} - {MARKER}


@pytest.mark.parametrize("json, out, said", [
    ("", "file", "--out .*file: cannot be made: .*file is not a folder"),
    ("r.json", "file/deeper", "--out .*deeper: cannot be made: .*file is not a folder"),
    ("missing/r.json", None, "--json .*r.json: there is no folder .*missing"),
    ("folder", None, "--json .*folder: is a folder"),
])  # fmt: skip
def test_what_cannot_be_written_is_refused(network, tmp_path, json, out, said):
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    with pytest.raises(InputError, match=said):
        check_targets(
            EXAMPLE, network, json and str(tmp_path / json), out and tmp_path / out
        )
    assert names(tmp_path) == {"file", "folder"}


@pytest.mark.parametrize("json, out", [
    (str(EXAMPLE), None), (str(EXAMPLE.parent / "points.csv"), None), ("", EXAMPLE.parent),
])  # fmt: skip
def test_the_input_is_not_overwritten(network, json, out):
    with pytest.raises(InputError, match="part of the input and would be overwritten"):
        check_targets(EXAMPLE, network, json, out)


@pytest.mark.parametrize("text", ["id,X,Y,Z\n", "[project]\n", "[[camera]]\n", " \n", "\0"])
def test_only_json_gives_way_to_json(network, tmp_path, text):
    target = tmp_path / "points.csv"
    target.write_text(text)
    said = f"^--json {target}: exists and is not JSON; give another name"
    for out in (None, tmp_path / "out"):
        with pytest.raises(InputError, match=f"{said}, or --force to replace it$"):
            check_targets(EXAMPLE, network, str(target), out)
    check_targets(EXAMPLE, network, str(target), None, force=True)
    assert target.read_text() == text
    with pytest.raises(InputError, match=f"{said}$"):
        check_outputs([], csv=target, json=str(target))  # of the commands without --force


def test_tables_and_figures_are_checked_before_the_work(command, tmp_path):
    """A camera, a cloud, a geoid given as their own output stay as they are."""
    camera, cloud, sigma = (tmp_path / name for name in ("cam.toml", "c.csv", "d_sigma.tif"))
    camera.write_text('[[camera]]\nid = "cam"\nmodel = "brown"\nc = 20.0\n')
    cloud.write_text("X,Y,Z\n0,0,0\n")
    sigma.write_text("notes")
    for arguments, why in (
        (["camera", camera, "--csv", camera], "--csv .*part of the input"),
        (["compare", camera, camera, "--plot", camera], "--plot .*part of the input"),
        (["camera", camera, "--plot", tmp_path / "no" / "a.png"], "there is no folder"),
        (["cloud", cloud, "--dsm", tmp_path / "d.tif", "--size", 1], "d_sigma.tif: exists and is"),
    ):
        before = [file.read_text() for file in (camera, cloud, sigma)]
        told = command(*arguments)
        assert told.status == 2 and re.search(why, told.err), told.err
        assert [file.read_text() for file in (camera, cloud, sigma)] == before
    with pytest.raises(InputError, match="--csv .*there is no folder"):
        check_outputs([], csv=tmp_path / "no" / "a.csv")


def test_tiles_of_a_terrain_are_inputs_and_what_lies_beside_them_is_not(tmp_path):
    (tmp_path / "n50.tif").write_text("a tile")
    (tmp_path / "heights.csv").write_text("of an earlier run")
    check_outputs([tmp_path], csv=tmp_path / "heights.csv")
    with pytest.raises(InputError, match="--csv .*n50.tif: is part of the input"):
        check_outputs([tmp_path], csv=tmp_path / "n50.tif")


@pytest.mark.parametrize("text", ["", "{}", ' {\n "a": 1}', "[]", "[\n[-1", '[{"a', "[ null]"])
def test_json_gives_way_to_json(network, tmp_path, text):
    target = tmp_path / "result"
    target.write_text(text)
    check_targets(EXAMPLE, network, str(target), None)


def test_folders_to_be_made_are_fine(network, tmp_path):
    out = tmp_path / "a" / "b"
    check_targets(EXAMPLE, network, str(out / "r.json"), out)
    check_targets(EXAMPLE, network, "-", out)
    assert names(tmp_path) == set()
    write_targets(REASON, str(out / "r.json"), out, brief=False, plots=False)
    assert names(out) == {"report.txt", "report.html", "result.json", "r.json"}


def test_no_file_of_an_earlier_result_stays(convergent4, tmp_path):
    out = tmp_path / "out"
    write_targets(convergent4, str(out / "r.json"), out, brief=False, plots=False)
    first = names(out)
    assert {"report.txt", "report.html", "r.json", "points.csv", "network"} < first
    for mine in ("notes.txt", "network/residuals.txt"):
        (out / mine).write_text("mine")
    write_targets(REASON, "", out, brief=False, plots=False)
    assert names(out) == {"report.txt", "report.html", "result.json", "notes.txt", "network"}
    assert names(out / "network") == {"residuals.txt"}
    assert (out / "report.txt").read_text() == "not solved: too few images\n"


def test_why_there_is_no_result_is_told_as_json(tmp_path, capsys):
    write_targets(REASON, "-", tmp_path, brief=True, plots=False)
    told = {"converged": False, "termination": "not solved: too few images",
            "undetermined": ["X0 of image 7"]}  # fmt: skip
    assert json.loads(capsys.readouterr().out) == told
    assert json.loads((tmp_path / "result.json").read_text()) == told


def test_a_device_is_written_to_and_stays_one():
    write_targets(REASON, "/dev/null", None, brief=True, plots=False)
    assert Path("/dev/null").is_char_device()


def test_a_link_stays_a_link(tmp_path):
    (tmp_path / "target.json").write_text("old")
    (tmp_path / "link.json").symlink_to("target.json")
    write_text(tmp_path / "link.json", "new")
    assert (tmp_path / "link.json").is_symlink()
    assert (tmp_path / "target.json").read_text() == "new"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["link.json", "target.json"]


def test_what_a_descriptor_leads_to_is_written_and_not_replaced(tmp_path):
    path = tmp_path / "result.json"
    with path.open("w") as file:
        before = os.fstat(file.fileno()).st_ino
        write_text(Path(f"/dev/fd/{file.fileno()}"), "new")
        assert path.stat().st_ino == before
    assert path.read_text() == "new" and os.path.isdir("/dev/fd")
