"""A full disk, a full device, a full pipe: the file is named with the reason, the status is 2, and
nothing half-written stays."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from full_disk import files_end_at

from jaxbundle.errors import InputError
from jaxbundle.io.results.json_lines import JsonLines
from jaxbundle.io.text.csv_tables import write_text
from jaxbundle.tiepoints.features import Features, FeatureSettings
from jaxbundle.tiepoints.store import Store

FULL = "/dev/full"
full_device = pytest.mark.skipif(not os.path.exists(FULL), reason="a system without /dev/full")
NO_SPACE = "No space left on device"


def run(*arguments, **streams):
    """A process of its own: the streams are what is tested."""
    call = [sys.executable, "-m", "jaxbundle", *map(str, arguments)]
    return subprocess.run(call, timeout=60, check=False, **streams)


@full_device
@pytest.mark.parametrize("arguments", [("example",), ("--version",), ("plan", "--help")])
def test_a_full_standard_output_is_named(arguments):
    with open(FULL, "w") as full:
        done = run(*arguments, stdout=full, stderr=subprocess.PIPE)
    said = f"jaxbundle: standard output: cannot be written: {NO_SPACE}\n"
    assert (done.returncode, done.stderr.decode()) == (2, said)


@full_device
def test_a_full_standard_error_keeps_the_status():
    with open(FULL, "w") as full:
        assert run("adjust", "nowhere.toml", stderr=full).returncode == 2


@full_device
def test_a_full_device_is_named_without_a_disk():
    """The free space of its folder would be that of another disk."""
    with pytest.raises(InputError) as found:
        write_text(Path(FULL), "text")
    assert str(found.value) == f"{FULL}: cannot be written: {NO_SPACE}"


@pytest.mark.parametrize("name", ["cloud.laz", "cloud.las", "cloud.ply", "cloud.csv"])
def test_a_cloud_on_a_full_disk(tmp_path, command, name):
    X = np.random.default_rng(1).normal(size=(2000, 3))
    source, out = tmp_path / "given.csv", tmp_path / name
    np.savetxt(source, X, delimiter=",", header="X,Y,Z", comments="")
    with files_end_at(4096):
        told = command("cloud", source, "--out", out)
    assert told.status == 2 and told.err == f"jaxbundle: {out}: cannot be written: File too large\n"
    assert os.listdir(tmp_path) == ["given.csv"]


def test_an_example_on_a_full_disk(tmp_path, command):
    with files_end_at(4096):
        told = command("example", "board", tmp_path / "first")
    assert told.status == 2 and os.listdir(tmp_path) == []
    assert told.err == f"jaxbundle: {tmp_path / 'first'}: cannot be written: File too large\n"


def test_no_part_of_a_line_stays(tmp_path):
    """An interrupted batch mends torn lines; a full disk leaves none."""
    path = tmp_path / "lines.jsonl"
    lines = JsonLines(path)
    lines.append([{"key": "a", "status": "converged"}])
    whole = path.read_bytes()
    with files_end_at(len(whole) + 30):
        with pytest.raises(InputError, match=f"{path}: cannot be written: File too large"):
            lines.append([{"key": "b", "status": "converged", "more": "x" * 1000}])
    assert path.read_bytes() == whole and json.loads(whole)["key"] == "a"


def test_stored_features_on_a_full_disk(tmp_path):
    store = Store(tmp_path, FeatureSettings())
    features = Features(np.zeros((1000, 2)), np.zeros(1000), np.zeros(1000), np.zeros((1000, 128)))
    with files_end_at(4096):
        with pytest.raises(InputError, match=r"\.npz: cannot be written: File too large"):
            store.save_features("photograph", features)
    assert os.listdir(tmp_path) == []
