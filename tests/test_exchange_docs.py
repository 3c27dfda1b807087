"""docs/exchange.md names every format, model and figure, and its example runs."""

import re
import sys
from pathlib import Path

import pytest

from jaxbundle import choices, cli
from jaxbundle.io import FORMATS, TARGETS, read_network
from jaxbundle.io.cameras.camera_files import read_cameras
from jaxbundle.io.exchange import CAMERA_KINDS
from jaxbundle.io.networks.colmap_models import MODELS
from jaxbundle.io.networks.column_map import KEYS, ROTATIONS

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "docs" / "exchange.md").read_text(encoding="utf-8")
CAMERAS = ROOT / "examples" / "video_cameras" / "cameras.toml"


def test_everything_is_named():
    for name in (*FORMATS, *TARGETS, *CAMERA_KINDS):
        assert f"| `{name}` |" in TEXT, name
    for name in (*MODELS, *ROTATIONS):
        assert re.search(rf"\b{name}\b", TEXT), name
    # and the command line, which does not import them, knows them all
    assert set(choices.FORMATS) == set(FORMATS) and set(choices.TARGETS) == set(TARGETS)
    assert set(choices.CAMERA_FILES) == set(CAMERA_KINDS)
    for key in set(KEYS) - {"comment"}:
        assert f"{key} = " in TEXT, key


def test_the_column_map_of_the_page_is_one(tmp_path):
    text = re.search(r"```toml\n(.*?)```", TEXT, re.S).group(1)
    (tmp_path / "map.toml").write_text(text)
    (tmp_path / "object.txt").write_text("1 0 0 0 0.1 0.1 0.1\n")
    (tmp_path / "exterior.txt").write_text("7 0 0 5 0 0 100\n")
    (tmp_path / "image.txt").write_text("a\nb\nc\n7;1;0,5;-0,25;x;more;of it\n")
    network = read_network(tmp_path / "map.toml")
    assert network.observations.xy.tolist() == [[0.5, 0.25]]


@pytest.mark.parametrize("command", re.findall(r"^\$ (jaxbundle c.*)", TEXT, re.M))
def test_figures_of_the_page(command, tmp_path, monkeypatch, capsys):
    begin = TEXT.index(command) + len(command)
    printed = TEXT[begin : TEXT.index("```", begin)].strip().splitlines()
    words = command.replace("camera.yaml", str(tmp_path / "camera.yaml")).split()
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(sys, "argv", words)
    with pytest.raises(SystemExit) as ended:
        cli.main()
    said = capsys.readouterr().out
    assert not ended.value.code
    for line in printed:
        if line not in ("…", "camera.yaml: opencv"):
            assert line in said


def test_the_video_cameras_are_those_printed():
    """Principal distances in mm, as the thesis' tables 5 and 8 have them."""
    printed = {"1-indoor": 3.969, "2-indoor": 3.967, "1-outdoor": 3.920, "2-outdoor": 3.904}
    found = {camera.id: camera.parameters["c"] for camera in read_cameras(CAMERAS)}
    assert found == pytest.approx(printed, abs=6e-4)


def test_camera_on_the_command_line(monkeypatch, capsys, tmp_path):
    plot, table = tmp_path / "curves.png", tmp_path / "table.csv"
    monkeypatch.setattr(
        sys, "argv", ["jaxbundle", "camera", f"{CAMERAS}#1-indoor", f"{CAMERAS}#1-outdoor",
                      "--step", "1", "--about-origin", "--plot", str(plot), "--csv", str(table)]
    )  # fmt: skip
    with pytest.raises(SystemExit) as ended:
        cli.main()
    said = capsys.readouterr().out
    assert not ended.value.code and "wide angle" in said
    # 2·atan(6/(2·3.9685)), and the distortion at 1 mm, 0.065 mm in the thesis
    assert "74.175°" in said
    row = next(line.split() for line in said.splitlines() if line.split()[:1] == ["1"])
    assert float(row[1]) == pytest.approx(0.065, abs=5e-4)
    assert plot.read_bytes()[:4] == b"\x89PNG"
    assert table.read_text().splitlines()[0] == "r,radial,decentring"
