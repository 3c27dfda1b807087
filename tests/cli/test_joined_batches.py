"""`jaxbundle batch --join`: several processes, one file of results."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from batch_cameras import images_of, write_cameras

from jaxbundle.batches.processes import add_parts
from jaxbundle.batches.run_on_files import run_batch

ROOT = Path(__file__).parents[2]
CAMERAS = 9
FREE = ["fx", "fy", "k1"]
"""As in `test_batch_command`: the same compiled program."""


@pytest.fixture
def cameras(tmp_path):
    return write_cameras(tmp_path / "cameras.npz", images_of(CAMERAS))


def joined(cameras: Path, file: Path, *options: str) -> list[tuple[int, str, str]]:
    """Status and outputs of two processes."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "jaxbundle", "batch", str(cameras), "--json-lines", str(file),
               *options, "--join", f"127.0.0.1:{port}", "2"]  # fmt: skip
    running = [
        subprocess.Popen([*command, str(i)], cwd=ROOT, text=True, stdout=subprocess.PIPE,
                         stderr=subprocess.PIPE)
        for i in range(2)
    ]  # fmt: skip
    said = [process.communicate(timeout=150) for process in running]
    return [(process.returncode, *of) for process, of in zip(running, said)]


@pytest.mark.further
@pytest.mark.slow
def test_joined_processes_write_the_lines_of_one(cameras, tmp_path):
    """In its order; the parts are gone; other settings are refused by all of them."""
    one, both = tmp_path / "one.jsonl", tmp_path / "both.jsonl"
    run_batch([cameras], one, free=FREE)
    table = tmp_path / "table.csv"
    found = joined(cameras, both, "--free", "fx,fy,k1", "--table", str(table))
    assert [status for status, *_ in found] == [0, 0], found
    assert f"{CAMERAS} converged" in found[0][1] and "converged" not in found[1][1]
    assert both.read_text() == one.read_text()
    assert len(table.read_text().splitlines()) == CAMERAS + 1
    others = joined(cameras, both, "--free", "fx,fy")
    assert [status for status, *_ in others] == [2, 3]
    assert all("free was fx,fy,k1, is fx,fy" in error for _, _, error in others)
    assert "process 0 of the joined ones has failed" in others[1][2]
    assert both.read_text() == one.read_text()
    assert sorted(os.listdir(tmp_path)) == [
        "both.jsonl", "cameras.npz", "one.jsonl", "table.csv"
    ]  # fmt: skip


def test_parts_of_a_run_that_was_ended_are_added(cameras, tmp_path):
    """Those of three processes, one of them without a line, the last one torn; what is in the file
    already is not added again."""
    one, file = tmp_path / "one.jsonl", tmp_path / "results.jsonl"
    run_batch([cameras], one, free=FREE)
    lines = one.read_text().splitlines(keepends=True)
    file.write_text(lines[0])
    for i in range(3):
        text = "".join(lines[i::3]) if i < 2 else ""
        (tmp_path / f"results.jsonl.part-{i + 1}-of-3").write_text(text[:-30] if i else text)
    add_parts(file)
    assert file.read_text() == "".join(lines[i] for i in (0, 1, 3, 4, 6))
    assert sorted(os.listdir(tmp_path)) == ["cameras.npz", "one.jsonl", "results.jsonl"]
    assert run_batch([cameras], file, free=FREE) == {"converged": CAMERAS, "skipped": 5}
    assert sorted(file.read_text().splitlines()) == sorted(one.read_text().splitlines())
