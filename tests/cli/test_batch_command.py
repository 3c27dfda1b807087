"""`jaxbundle batch`: every camera once in the output, whatever happens in between."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from batch_cameras import images_of, write_cameras

from jaxbundle.batches.run_on_files import run_batch
from jaxbundle.errors import InputError

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "convergent4" / "project.toml"
CAMERAS = 200


@pytest.fixture
def run(command):
    return lambda *arguments: command("batch", *arguments)


def rows(path: Path):
    return [json.loads(line) for line in path.read_text().splitlines()]


@pytest.fixture(scope="module")
def cameras(tmp_path_factory):
    """Many cameras; the second has no measurements."""
    images = images_of(CAMERAS)
    visible = np.ones(images.shape[:3], bool)
    visible[1] = False
    path = tmp_path_factory.mktemp("cameras") / "cameras.npz"
    return write_cameras(path, images, visible=visible)


def ended(process: subprocess.Popen, file: Path, lines: int, how: signal.Signals, wait: float):
    """The run is ended by a signal, shortly after this number of further lines is in the file.

    Meanwhile no other run can write the file."""
    number = lambda: file.read_bytes().count(b"\n") if file.exists() else 0
    lines += number()
    deadline = time.monotonic() + 120
    while number() < lines:
        assert process.poll() is None and time.monotonic() < deadline, "ended before its time"
        time.sleep(0.001)
    process.send_signal(signal.SIGSTOP)
    with pytest.raises(InputError, match="another run is writing"):
        run_batch([EXAMPLE], file)
    process.send_signal(signal.SIGCONT)
    time.sleep(wait)
    process.send_signal(how)
    _, told = process.communicate(timeout=60)
    assert number() < CAMERAS, "killed too late to be a test"
    return process.returncode, told


@pytest.mark.further
@pytest.mark.slow
def test_ended_at_any_moment_a_run_goes_on_where_it_was(run, cameras, tmp_path):
    file = tmp_path / "results.jsonl"
    arguments = (cameras, "--json-lines", file, "--portion", "1", "--free", "fx,fy,k1")
    random = np.random.default_rng()
    before = b""
    for how, status in ((signal.SIGKILL, -signal.SIGKILL), (signal.SIGTERM, 143)):
        process = subprocess.Popen(
            [sys.executable, "-m", "jaxbundle", "batch", *map(str, arguments)],
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, cwd=ROOT,
        )  # fmt: skip
        lines, wait = int(random.integers(1, 8)), random.uniform(0, 0.01)
        found, told = ended(process, file, lines, how, wait)
        assert found == status, (how, lines, wait, told)
        line = "jaxbundle: terminated; .* to resume\n"
        assert re.fullmatch("" if how == signal.SIGKILL else line, told)
        after = file.read_bytes()
        whole = before[: before.rindex(b"\n") + 1] if before else b""
        assert after.startswith(whole)
        before = after
        if how == signal.SIGKILL:
            before = after[: after.rindex(b"\n") + 1] + b'{"key": "torn \xc3'
            file.write_bytes(before)

    done = run(*arguments[:3], "--free", "fx,fy,k1")
    assert done.status == 0, done.err
    number = before.count(b"\n")
    assert done.err == "" and f"{number} skipped" in done.out
    assert f"{CAMERAS - 1} converged, 1 too few points" in done.out
    assert file.read_bytes().startswith(before[: before.rindex(b"\n") + 1])
    result = rows(file)
    name = os.path.relpath(cameras, tmp_path)
    assert [row["key"] for row in result] == [f"{name}#serial {i}" for i in range(CAMERAS)]
    assert [row["status"] for row in result].count("converged") == CAMERAS - 1
    assert result[1]["status"] == "too few points" and "parameters" not in result[1]
    assert set(result[0]["parameters"]) == {"fx", "fy", "k1"}
    assert result[0]["parameters"]["fx"]["sigma"] > 0
    assert len(result[0]["poses"]) == 6 and len(result[0]["covariance"]) == 3
    assert os.listdir(tmp_path) == ["results.jsonl"]


@pytest.mark.slow
def test_networks_and_one_that_is_bad(run, tmp_path):
    bad = tmp_path / "bad.toml"
    bad.write_text("[project]\nname = 3\n")
    file = tmp_path / "results.jsonl"
    done = run(bad, EXAMPLE, "--json-lines", file)
    assert done.status == 0, done.err
    first, second = rows(file)
    assert first["key"] == "bad.toml" and first["status"] == "bad input"
    assert "bad.toml" in first["error"] and "1 bad input, 1 converged" in done.out
    assert second["status"] == "converged" and second["redundancy"] == 23
    assert "points" not in second and second["cameras"]["cam"]["parameters"]["c"]["sigma"] > 0
    again = run(bad, EXAMPLE, "--json-lines", file, "--quiet")  # resumed: nothing to compute
    assert (again.status, again.out) == (0, "")
    assert "1 of 2 inputs without a result: 1 bad input, 1 converged" in again.err


def test_a_batch_without_any_result_is_not_a_success(run, tmp_path):
    bad = tmp_path / "bad.toml"
    bad.write_text("[project]\nname = 3\n")
    file = tmp_path / "results.jsonl"
    for options in ((), ("--quiet",)):  # computed, then resumed
        done = run(bad, "--json-lines", file, *options)
        assert done.status == 3
        assert "none of 1 input has a result: 1 bad input" in done.err
    assert rows(file)[0]["status"] == "bad input"


def test_bad_input_ends_with_one_line_and_writes_nothing(run, cameras, tmp_path):
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
        ((cameras, "--json-lines", file, "--free", "fx,,fy"), "''"),
    ):
        done = run(*arguments)
        assert done.status == 2, done.err
        assert word in done.err and len(done.err.strip().splitlines()) == 1
        assert not file.exists() and other.read_text().startswith("a diary")
