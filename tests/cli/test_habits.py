"""--quiet and --verbose: every command has them, and they do the same everywhere."""

import importlib
import inspect
import json
from pathlib import Path

import pytest
import typer

from jaxbundle import cli
from jaxbundle.cli.app import app as application

ROOT = Path(__file__).parents[2]
CAMERAS = "examples/video_cameras/cameras.toml"
PLAN = ("plan", "--c", "100", "--image", "68,104", "--area", "1000,600", "--sigma-image", "0.003",
        "--height", "1000", "--no-network")  # fmt: skip


@pytest.fixture(autouse=True)
def in_the_repository(monkeypatch):
    monkeypatch.chdir(ROOT)


def commands(command, name="jaxbundle"):
    if not (found := getattr(command, "commands", None)):
        yield name, command
        return
    for word, below in found.items():
        yield from commands(below, f"{name} {word}")


def test_every_command_has_both():
    for name in cli.COMMANDS:
        importlib.import_module(f"jaxbundle.cli.{name}")
    found = dict(commands(typer.main.get_command(application)))
    assert len(found) > 20
    for name, command in found.items():
        options = [option for parameter in command.params for option in parameter.opts]
        assert options.count("--quiet") == options.count("--verbose") == 1, name


def test_a_function_keeps_its_arguments():
    """Python callers do not see the options of the command line."""
    from jaxbundle.cli.plan import plan

    assert "verbose" not in inspect.signature(plan).parameters


@pytest.mark.parametrize("arguments", [
    PLAN, ("compare", f"{CAMERAS}#1-indoor", f"{CAMERAS}#2-indoor"),
    ("camera", f"{CAMERAS}#1-indoor"), ("example",),
], ids=lambda arguments: arguments[0])  # fmt: skip
def test_quiet_prints_nothing(command, arguments):
    loud = command(*arguments)
    assert loud.status == 0 and loud.out
    told = command(*arguments, "--quiet")
    assert (told.status, told.out, told.err) == (0, "", "")


def test_quiet_still_tells_errors_and_what_goes_to_standard_output_by_name(command, tmp_path):
    told = command("compare", "nowhere", f"{CAMERAS}#2-indoor", "--quiet")
    assert told.status == 2 and "nowhere" in told.err and told.out == ""
    (tmp_path / "a.csv").write_text("X,Y,Z\n0,0,0\n1,0,0\n0,1,0\n1,1,0\n")
    told = command("cloud", tmp_path / "a.csv", "--json", "-", "--quiet")
    assert told.status == 0 and json.loads(told.out)["points"] == 4


def test_verbose_tells_versions_iterations_and_times(command):
    quiet = command("adjust", "examples/convergent4/project.toml")
    told = command("adjust", "examples/convergent4/project.toml", "--verbose")
    assert told.out == quiet.out
    lines = told.err.splitlines()
    assert lines[0].startswith("jaxbundle ") and "numpy " in lines[0]
    assert any(line.startswith("iteration 1: ") and "λ" in line for line in lines)
    assert " s in all" in lines[-1]


def test_verbose_tells_an_error_and_the_time(command):
    told = command("compare", "nowhere", f"{CAMERAS}#2-indoor", "--verbose")
    assert told.status == 2 and "nowhere" in told.err.splitlines()[-1]
    assert " s in all" in told.err.splitlines()[-2]


def test_both_together_are_refused(command):
    told = command(*PLAN, "--quiet", "--verbose")
    assert told.status == 2 and "give one of them" in told.err


@pytest.mark.parametrize("given, said, help", [
    ("adjst x", "No such command 'adjst'. Did you mean 'adjust'?", ""),
    ("pushbroom locate", "Missing argument 'scanner'.", "pushbroom locate "),
    ("adjust --frobnicate x", "No such option: --frobnicate", "adjust "),
])  # fmt: skip
def test_a_wrong_call_leads_to_the_help(command, given, said, help):
    run = command(*given.split())
    assert run.status == 2 and run.err.startswith(f"jaxbundle: {said}")
    assert run.err.endswith(f" {help}--help.\n") and run.err.count("\n") == 1
