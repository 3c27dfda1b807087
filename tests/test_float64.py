"""One rule for 64-bit floats: which functions refuse without them, and which switch them on."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from adjustment_checks import synthetic

import jaxbundle
from jaxbundle import leastsquares as ls
from jaxbundle.adjustment.problem import make_problem
from jaxbundle.cameras import get_model
from jaxbundle.cameras.compare import compare_cameras
from jaxbundle.cameras.distortion_table import distortion_table
from jaxbundle.cli.small_inputs import SMALL_INPUT, is_small
from jaxbundle.network import Camera
from jaxbundle.network.reprojection import point_errors
from jaxbundle.pushbroom import (
    AnglePolynomial,
    LineTimes,
    RpcTable,
    Trajectory,
    attitude_table,
    fit_rpc,
    make_image,
    position_table,
)
from jaxbundle.system import xla_flags
from jaxbundle.system.xla_flags import LITTLE_OPTIMISATION

PACKAGE = Path(jaxbundle.__file__).parent
NETWORK = synthetic()[0]
TARGETS = np.random.default_rng(1).uniform(-1, 1, (20, 3))


def scanner_image():
    t = np.array([-1.0, 100.0])
    rows = position_table(t, np.array([[0, 0, 1e3], [0, 5e3, 1e3]]), method="linear")
    level = attitude_table(t, np.zeros((2, 3)), method="linear")
    optics = AnglePolynomial(jnp.zeros(1), jnp.ones(2), jnp.ones(()), jnp.ones(()))
    return make_image(
        Trajectory(rows, level), LineTimes(jnp.zeros(()), jnp.ones(())), optics, 5, 5
    )


ENDS_IN_COORDINATES = {
    "adjust tables": lambda: ls.adjust([ls.Table("height", np.zeros(2))], []),
    "make_problem": lambda: make_problem(NETWORK),
    "adjust": lambda: jaxbundle.adjust(NETWORK),
    "orient": lambda: jaxbundle.orient(NETWORK),
    "simulate": lambda: jaxbundle.simulate(
        jaxbundle.ring_of_stations(4, 5.0, 2.0), TARGETS, Camera("cam", "brown", {"c": 30.0}),
        noise=0.01,
    ),
    "make_image": scanner_image,
    "fit_rpc": lambda: fit_rpc(RpcTable(*np.random.default_rng(2).uniform(size=(5, 60)))),
}  # fmt: skip


@pytest.mark.parametrize("name", ENDS_IN_COORDINATES)
def test_what_ends_in_coordinates_refuses_32_bits(name):
    with jax.enable_x64(False), pytest.raises(RuntimeError, match=r"Call jaxbundle\.enable_x64"):
        ENDS_IN_COORDINATES[name]()


def brown(**parameters):
    return get_model("brown"), {"c": 50.0, "x0": 0.1, "K1": -2e-5, "P1": 1e-6} | parameters


NUMPY_IN_NUMPY_OUT = {
    "compare": lambda: compare_cameras(
        brown(), brown(c=50.1, K2=1e-9), area=((-12.0, -8.0), (12.0, 8.0))
    ).difference,
    "distortion_table": lambda: np.stack(list(distortion_table(*brown(), 2.0, 12.0).values())),
    "point_errors": lambda: point_errors(NETWORK)[0],
}


@pytest.mark.parametrize("name", NUMPY_IN_NUMPY_OUT)
def test_conversions_bring_64_bits_along(name):
    with jax.enable_x64(False):
        without = NUMPY_IN_NUMPY_OUT[name]()
    assert without.dtype == np.float64
    np.testing.assert_array_equal(without, NUMPY_IN_NUMPY_OUT[name]())


def test_the_policy_is_in_one_module():
    words = "jax_enable_x64", "jax.enable_x64"
    texts = {p.name: p.read_text() for p in PACKAGE.rglob("*.py")}
    assert [f for f, text in texts.items() if any(w in text for w in words)] == ["float64.py"]


PROGRAMS_AT_ONCE = """
import threading
import jaxbundle
from jaxbundle.system.cores import allow_programs_at_once, available_cores
allow_programs_at_once()
jaxbundle.enable_x64()
import jax, numpy as np
A = np.eye(8) + 0.01 * np.random.default_rng(0).normal(size=(2000, 8, 8))
solve = jax.jit(lambda A: jax.numpy.linalg.inv(A @ A.mT))
solve(A)
many = lambda: [np.asarray(solve(A)) for _ in range(100)]
threads = [threading.Thread(target=many) for _ in range(available_cores() + 1)]
for thread in threads:
    thread.start()
"""


FACTORISATIONS_AT_ONCE = """
import jax, jaxbundle
jaxbundle.enable_x64()
import jax.numpy as jnp
A = jnp.eye(40) + jax.random.normal(jax.random.key(1), (4, 50, 40, 40)) / 100
b = jnp.ones((50, 40, 1))
at_once = jax.jit(lambda A: [jnp.linalg.solve(a, b) for a in A])
for _ in range(100):
    jax.block_until_ready(at_once(A))
"""


def test_batched_factorisations_at_once_come_to_an_end():
    """jaxlib 0.10 deadlocks if as many of them as XLA has threads are running."""
    run_without_settings(FACTORISATIONS_AT_ONCE, 120)


def test_programs_in_as_many_threads_as_cores_end():
    """They wait for their factorisations in XLA's pool, and deadlock if all of it waits."""
    run_without_settings(PROGRAMS_AT_ONCE, 240)


def run_without_settings(program, timeout):
    here = {k: v for k, v in os.environ.items() if k not in ("NPROC", "XLA_FLAGS")}
    subprocess.run([sys.executable, "-c", program], env=here, check=True, timeout=timeout)


def test_the_compiler_is_given_only_flags_that_it_knows(monkeypatch):
    """XLA ends the process at any other one; a later jaxlib than those tried is asked."""
    run_without_settings("import jax, jaxbundle; jaxbundle.enable_x64(compile_quickly=True); "
                         "assert float(jax.jit(abs)(-1.0)) == 1.0", 120)  # fmt: skip
    flags = [xla_flags.QUICK_LOOPS, LITTLE_OPTIMISATION, "--xla_unheard_of=1"]
    here = xla_flags._known_flags(flags[:2])
    monkeypatch.setattr(xla_flags, "jaxlib_version", lambda: (99, 0, 0))
    assert xla_flags._known_flags(flags) == here and LITTLE_OPTIMISATION in here
    monkeypatch.setattr(sys, "executable", "/nowhere")
    assert xla_flags._known_flags(flags) == []


def test_small_inputs_are_compiled_quickly(tmp_path, monkeypatch):
    project = PACKAGE.parent / "examples" / "convergent4" / "project.toml"
    assert is_small(project) and is_small(project.parent)
    (tmp_path / "points.csv").write_text("x" * (SMALL_INPUT + 1))
    assert not is_small(tmp_path) and not is_small(tmp_path / "points.csv")
    assert not is_small(tmp_path / "missing.csv")
    for quickly, given, expected in ((True, "", 0), (False, "", None), (True, "3", 3)):
        name = LITTLE_OPTIMISATION.partition("=")[0]
        monkeypatch.setenv("XLA_FLAGS", f"{name}={given}" if given else "")
        jaxbundle.enable_x64(compile_quickly=quickly)
        flags = dict(flag.split("=") for flag in os.environ["XLA_FLAGS"].split())
        assert flags.get(name) == (None if expected is None else str(expected))
