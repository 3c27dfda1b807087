"""One problem on several devices and processes: the same costs and the same answer as on one."""

import json
import os
import signal
import socket
import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from sharded_run import PROBLEMS, solve

SCRIPT = Path(__file__).with_name("sharded_run.py")
pytestmark = pytest.mark.slow


def start(*arguments):
    return subprocess.Popen(
        [sys.executable, SCRIPT, *map(str, arguments)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=dict(os.environ),
    )  # fmt: skip


def finish(process, timeout=300):
    out, error = process.communicate(timeout=timeout)
    assert process.returncode == 0, error[-2000:]
    return json.loads(out.splitlines()[-1])


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@cache
def on_two_devices():
    return finish(start(2, "; ".join(("network", "traverse, iterative"))))


def assert_same(found, name):
    expected = solve(PROBLEMS[name]())
    assert found["termination"] == expected["termination"]
    assert len(expected["cost"]) > 2
    same = min(len(found["cost"]), len(expected["cost"])) - 1  # the last is a step of rounding
    # Conjugate gradients of an early step end at a loose tolerance, after one more or less of
    # theirs as rounding has it.
    rtol = 1e-7 if "iterative" in name else 1e-9
    np.testing.assert_allclose(found["cost"][:same], expected["cost"][:same], rtol=rtol)
    for a, b in zip(found["values"], expected["values"], strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-7, atol=1e-8)


@pytest.mark.further
@pytest.mark.parametrize("name", ["network", "traverse, iterative"])
def test_on_two_devices(name):
    assert_same(on_two_devices()[name], name)


def test_a_problem_solved_again_compiles_nothing():
    first, again = on_two_devices()["compiled"]
    assert first > 0 and again == 0


def test_devices_share_a_problem_if_it_is_large():
    """The figure that says how large is 0 for these runs."""
    assert on_two_devices()["shared"] == {"small": [False, False], "large": [True, True]}


def test_shared_iterations_begin_at_the_given_values():
    """From the minimum: there the cost is the last one, and no step is left."""
    found = on_two_devices()
    first, *_ = found["again"]["cost"]
    assert first == pytest.approx(found["network"]["cost"][-1], rel=1e-9)
    assert first < 0.99 * found["network"]["cost"][0]


@pytest.mark.further
def test_in_two_processes():
    port, name = free_port(), "traverse, banded"
    running = [start(1, name, 2, k, port) for k in range(2)]
    found = [finish(process) for process in running]
    assert found[0][name] == found[1][name]
    assert_same(found[0][name], name)


@pytest.mark.further
def test_a_lost_process_ends_the_others():
    port = free_port()
    running = [start(1, "traverse, banded", 2, k, port, k * signal.SIGKILL) for k in range(2)]
    running[1].communicate(timeout=300)
    assert running[1].returncode == -signal.SIGKILL
    out, error = running[0].communicate(timeout=300)
    assert running[0].returncode != 0
    assert error and not out
