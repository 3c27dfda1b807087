"""The first touch: help, the version and errors of usage come without waiting for JAX; on a
terminal a message explains the wait of a first adjustment."""

import json
import subprocess
import sys

import jax
import jax.numpy as jnp
import pytest
from rich.console import Console

from jaxbundle.cli import COMMANDS
from jaxbundle.cli.progress import iterating

HEAVY = {"jax", "jaxlib", "numpy", "scipy", "equinox", "rich", "matplotlib", "cv2"}
LIGHT_ROOMS = {"choices", "cli", "errors", "lazy", "system"}
SCANNER = ("accuracy", "correct", "locate", "project", "refine", "simulate")
HELPS = [
    ["--help"], ["--version"], *([command, "--help"] for command in COMMANDS),
    *(["pushbroom", command, "--help"] for command in SCANNER),
    *(["pushbroom", "rpc", command, "--help"] for command in ("fit", "apply", "compensate")),
]  # fmt: skip
ERRORS = [
    ("adjst", "did you mean 'adjust'"),
    ("pushbroom locat", "did you mean 'locate'"),
    ("pushbroom rpc fitt", "did you mean 'fit'"),
    ("adjust", "missing argument 'input'"),
    ("adjust x --jsno y", "--json"),
    ("adjust x --max-iterations many", "--max-iterations"),
    ("adjust x --method gauss-newtn", "did you mean 'gauss-newton'"),
    ("adjust x --snooping popes", "--snooping 'popes': expected one of pope, baarda"),
    ("batch x --json-lines y --snooping baarda", "expected one of pope, none"),
    ("calibrate x --kind chesboard", "did you mean 'chessboard'"),
    ("cloud x --place men", "did you mean 'mean'"),
    ("design x --order frist", "did you mean 'first'"),
    ("plan --c 50", "missing option '--image'"),
    ("reconstruct x --out y --features shift", "did you mean 'sift'"),
    ("surface x --out y --points edge", "did you mean 'edges'"),
    ("pushbroom correct x y --out z --resampling cubical", "did you mean 'cubic'"),
    ("pushbroom accuracy x --table drift", "expected one of bias, white"),
    ("pushbroom rpc compensate x --control y --out z --model affin", "did you mean 'affine'"),
]
ALL_IN_ONE_PROCESS = """
import contextlib, io, json, sys
from jaxbundle import cli

told = []
for arguments in json.loads(sys.argv[1]):
    sys.argv = ["jaxbundle", *arguments]
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            cli.main(lambda: print("a command begins"))
        except SystemExit as ended:
            told.append((ended.code or 0, out.getvalue(), err.getvalue()))
print(json.dumps((told, list(sys.modules))))
"""


@pytest.fixture(scope="module")
def first_touch():
    """What each line of `HELPS` and `ERRORS` said, and the modules imported by all of them."""
    lines = [*HELPS, *(arguments.split() for arguments, _ in ERRORS)]
    command = [sys.executable, "-c", ALL_IN_ONE_PROCESS, json.dumps(lines)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    told, modules = json.loads(done.stdout)
    assert len(told) == len(lines)
    return told, modules


def test_help_and_errors_of_usage_import_neither_jax_nor_rooms_that_work(first_touch):
    _, modules = first_touch
    assert {name.split(".")[0] for name in modules} & HEAVY == set()
    rooms = {name.split(".")[1] for name in modules if name.startswith("jaxbundle.")}
    assert rooms - {"__main__"} <= LIGHT_ROOMS


def test_every_command_has_help(first_touch):
    for (status, out, err), arguments in zip(first_touch[0], HELPS):
        assert (status, err) == (0, ""), arguments
        assert "--help" in out or arguments == ["--version"], arguments
        if arguments[0] in COMMANDS and arguments not in (["pushbroom", "--help"],):
            program = " ".join(["jaxbundle", *arguments[:-1]])
            assert f"Example:\n  {program} " in out and "Exit status:\n  0 done; 2 bad" in out
    listed = first_touch[0][0][1]
    assert all(command in listed for command in COMMANDS) and "..." not in listed.split("\n", 1)[1]


def test_an_error_of_usage_is_one_line_with_the_nearest_word(first_touch):
    for (status, out, err), (arguments, words) in zip(first_touch[0][len(HELPS) :], ERRORS):
        assert status == 2 and out == "" and err.count("\n") == 1, (arguments, err)
        assert words in err.replace("Did", "did").replace("Missing", "missing"), err


def test_a_terminal_is_told_what_is_compiled(monkeypatch):
    monkeypatch.setattr(Console, "is_terminal", True)
    line, said = iterating(silent=False), []
    with line as tell:
        monkeypatch.setattr(line.bar, "update", lambda _, description: said.append(description))
        jax.jit(lambda x: jnp.cos(x) + 0.125)(1.0)
        assert said[0] == "compiling programs, once per size"
        assert said[-1] == "starting"
        assert tell is not None
        tell("adjusting: vᵀPv 1", 3, 50)
        assert said[-1] == "iteration 3: vᵀPv 1"
    before = len(said)
    jax.jit(lambda x: jnp.sin(x) + 0.125)(1.0)
    assert len(said) == before
