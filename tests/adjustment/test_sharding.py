"""One adjustment on several devices and processes: the same costs and the same answer as on one."""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from adjustment_checks import make, solved

EXAMPLE = Path(__file__).parents[2] / "examples" / "convergent4"
SCRIPT = Path(__file__).with_name("sharded_run.py")
pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("sharding")]  # one worker, one cache


def start(*arguments, program=(SCRIPT,)):
    return subprocess.Popen(
        [sys.executable, *program, *map(str, arguments)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=dict(os.environ),
    )  # fmt: skip


def finish(process, timeout=600):
    out, error = process.communicate(timeout=timeout)
    assert process.returncode == 0, error[-2000:]
    return json.loads(out.splitlines()[-1])


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@cache
def on_one_processor():
    return finish(start(4))


@pytest.mark.parametrize(
    "name, devices",
    [("shared cameras of two models", 2)]
    + [("free with distances", devices) for devices in (1, 2, 4)],
)
def test_on_several_devices(name, devices):
    found = on_one_processor()[f"{name}, {devices}"]
    expected = solved(make(name))
    assert found["termination"] == int(expected.termination)
    cost = np.asarray(expected.history.cost)[: int(expected.iterations)]
    same = min(len(cost), len(found["cost"]))  # the last steps are steps of rounding
    np.testing.assert_allclose(found["cost"][: same - 2], cost[: same - 2], rtol=1e-9)
    assert found["cost"][-1] == pytest.approx(cost[-1], rel=1e-9)
    np.testing.assert_allclose(found["camera"], expected.values.camera, rtol=1e-7, atol=1e-10)


def test_conjugate_gradients_on_two_devices():
    found = on_one_processor()["free with distances, 2iterative"]
    expected = solved(make("free with distances"))
    assert found["termination"] == int(expected.termination)
    assert found["cost"][-1] == pytest.approx(np.nanmin(expected.history.cost), rel=1e-9)
    np.testing.assert_allclose(found["camera"], expected.values.camera, rtol=1e-6, atol=1e-9)


def test_a_network_adjusted_again_compiles_nothing():
    first, again = on_one_processor()["compiled"]
    assert first > 0 and again == 0


@pytest.mark.parametrize("processes", [2, 4])
def test_in_several_processes(processes):
    port = free_port()
    running = [start(1, processes, k, port) for k in range(processes)]
    found = [finish(process) for process in running]
    name = f"free with distances, {processes}"
    expected = on_one_processor()[name]["cost"]
    for one in found:
        assert one[name]["cost"] == found[0][name]["cost"]
        assert one[name]["cost"][-1] == pytest.approx(expected[-1], rel=1e-9)


@pytest.mark.parametrize("by", [signal.SIGKILL, signal.SIGTERM])
def test_a_lost_process_ends_the_others(by):
    port = free_port()
    running = [start(1, 2, k, port, int(k and by)) for k in range(2)]
    running[1].communicate(timeout=300)
    assert running[1].returncode == -by
    out, error = running[0].communicate(timeout=300)
    assert running[0].returncode != 0
    assert error and not out


@pytest.mark.parametrize("other", ["file", "option"])
def test_different_files_or_options_end_all(tmp_path, other):
    folders = [shutil.copytree(EXAMPLE, tmp_path / name) for name in "ab"]
    if other == "file":
        with (folders[1] / "points.csv").open("a") as file:
            file.write("\n")
    join = ("--join", f"127.0.0.1:{free_port()}", 2)
    running = [
        start("adjust", folder / "project.toml", "--quiet", *join, k,
              *(("--robust", "huber") if k and other == "option" else ()),
              program=("-m", "jaxbundle"))
        for k, folder in enumerate(folders)
    ]  # fmt: skip
    for process in running:
        out, error = process.communicate(timeout=300)
        assert process.returncode == 2 and "different files or options" in error
        assert error.count("\n") == 1
