"""`jaxbundle batch`: every camera once in the output, whatever happens in between."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from jaxbundle.errors import InputError
from jaxbundle.io.json_lines import JsonLines

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "convergent4" / "project.toml"
CAMERAS = 60


def command(*arguments):
    return [sys.executable, "-m", "jaxbundle", "batch", *map(str, arguments)]


def run(*arguments):
    return subprocess.run(command(*arguments), capture_output=True, text=True, cwd=ROOT)


def rows(path: Path):
    return [json.loads(line) for line in path.read_text().splitlines()]


@pytest.fixture(scope="module")
def cameras(tmp_path_factory):
    """Many cameras before a board of 5 × 4 corners; the second has no measurements."""
    rng = np.random.default_rng(0)
    X = np.c_[np.mgrid[0:5, 0:4].T.reshape(-1, 2) * 0.1 - [0.2, 0.15], np.zeros(20)]
    images = np.empty((CAMERAS, 6, 20, 2))
    for views in images:
        f = rng.uniform(900, 1100)
        for view in views:
            a, b = rng.uniform(-0.5, 0.5, 2)
            ca, sa, cb, sb = np.cos(a), np.sin(a), np.cos(b), np.sin(b)
            R = np.array([[cb, 0, sb], [sa * sb, ca, -sa * cb], [-ca * sb, sa, ca * cb]])
            x, y, z = R @ X.T + [[0], [0], [1.2]]
            view[:] = np.stack([f * x / z + 640, f * y / z + 480], 1)
    images += rng.normal(0, 0.1, images.shape)
    visible = np.ones(images.shape[:3], bool)
    visible[1] = False
    path = tmp_path_factory.mktemp("cameras") / "cameras.npz"
    np.savez(
        path, object_points=X, image_points=images, image_size=[1280, 960], visible=visible,
        ids=[f"serial {i}" for i in range(CAMERAS)],
    )  # fmt: skip
    return path


def keys_of(path: Path):
    return [f"{path}#serial {i}" for i in range(CAMERAS)]


@pytest.mark.slow
def test_a_killed_run_goes_on_where_it_was(cameras, tmp_path):
    file = tmp_path / "results.jsonl"
    arguments = (cameras, "--json-lines", file, "--portion", "1", "--free", "fx,fy,k1")
    process = subprocess.Popen(command(*arguments), stdout=subprocess.DEVNULL, cwd=ROOT)
    deadline = time.monotonic() + 120
    while process.poll() is None and time.monotonic() < deadline:
        if file.exists() and file.read_bytes().count(b"\n") >= 3:
            process.send_signal(signal.SIGKILL)
            break
        time.sleep(0.002)
    process.wait()
    before = file.read_bytes()
    assert 3 <= before.count(b"\n") < CAMERAS, "killed too late to be a test"
    with file.open("ab") as torn:
        torn.write(b'{"key": "torn \xc3')

    done = run(*arguments[:-4], "--free", "fx,fy,k1")
    assert done.returncode == 0, done.stderr
    number = before.count(b"\n")
    assert done.stderr == "" and f"{number} skipped" in done.stdout
    assert file.read_bytes().startswith(before[: before.rindex(b"\n") + 1])
    result = rows(file)
    assert [row["key"] for row in result] == keys_of(cameras)
    assert [row["status"] for row in result].count("converged") == CAMERAS - 1
    assert result[1]["status"] == "too few points" and "parameters" not in result[1]
    assert set(result[0]["parameters"]) == {"fx", "fy", "k1"}
    assert result[0]["parameters"]["fx"]["sigma"] > 0
    assert len(result[0]["poses"]) == 6 and len(result[0]["covariance"]) == 3
    assert os.listdir(tmp_path) == ["results.jsonl"]

    again = run(*arguments[:-4], "--free", "fx,fy,k1")
    assert again.returncode == 0 and f"{CAMERAS} skipped" in again.stdout
    assert rows(file) == result


@pytest.mark.slow
def test_networks_and_one_that_is_bad(tmp_path):
    bad = tmp_path / "bad.toml"
    bad.write_text("[project]\nname = 3\n")
    file = tmp_path / "results.jsonl"
    done = run(bad, EXAMPLE, "--json-lines", file)
    assert done.returncode == 0, done.stderr
    first, second = rows(file)
    assert first["key"] == str(bad) and first["status"] == "bad input"
    assert "bad.toml" in first["error"]
    assert second["status"] == "converged" and second["redundancy"] == 23
    assert "points" not in second and second["cameras"]["cam"]["parameters"]["c"]["sigma"] > 0


def test_bad_input_ends_with_one_line_and_writes_nothing(cameras, tmp_path):
    file, bad = tmp_path / "results.jsonl", tmp_path / "bad.npz"
    np.savez(bad, object_points=np.zeros((20, 3)), image_points=np.zeros((2, 3, 19, 2)),
             image_size=[9, 9])  # fmt: skip
    other = tmp_path / "other.txt"
    other.write_text("a diary\nof two lines\n")
    for arguments, word in (
        ((tmp_path / "none.npz", "--json-lines", file), "none.npz"),
        ((bad, "--json-lines", file), "[19, 3]"),
        ((cameras, "--json-lines", file, "--model", "opencvv"), "'opencv'"),
        ((cameras, "--json-lines", file, "--free", "fx,k9"), "k9"),
        ((cameras, "--json-lines", other), "line 1"),
    ):
        done = run(*arguments)
        assert done.returncode == 2, done.stderr
        assert word in done.stderr and len(done.stderr.strip().splitlines()) == 1
        assert not file.exists() and other.read_text().startswith("a diary")


def test_lines_are_kept_dropped_and_tried_again(tmp_path):
    file = tmp_path / "results.jsonl"
    lines = JsonLines(file)
    lines.append([{"key": "a", "status": "converged", "rms": float("nan")}])
    lines.append([{"key": "b", "status": "singular"}])
    assert file.read_text().splitlines()[0].endswith('"rms": null}')
    whole = file.read_text()
    file.write_text(whole + '{"key": "c", "stat')
    assert JsonLines(file).keys == {"a", "b"} and file.read_text() == whole
    file.write_text(whole.rstrip("\n"))  # only the line feed was lost
    assert JsonLines(file).keys == {"a", "b"} and file.read_text() == whole
    file.write_text(whole + whole)
    assert "b" in JsonLines(file) and file.read_text() == whole
    assert JsonLines(file, retry=True).keys == {"a"}
    assert [row["key"] for row in rows(file)] == ["a"]
    file.write_text("[1, 2]\n" + whole)
    with pytest.raises(InputError, match="line 1"):
        JsonLines(file)


@pytest.mark.parametrize("text", ["my notes\n", "my notes", '{"key": "a", "sta\n'])
def test_a_file_of_something_else_is_not_taken_for_a_torn_line(tmp_path, text):
    file = tmp_path / "notes.txt"
    file.write_text(text)
    with pytest.raises(InputError, match="line 1: not a result"):
        JsonLines(file)
    assert file.read_text() == text
