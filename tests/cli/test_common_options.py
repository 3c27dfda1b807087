"""--quiet and --verbose: every command has them, and they do the same everywhere."""

import inspect
import json
import re
from pathlib import Path

import pytest
import typer

from jaxbundle import cli
from jaxbundle.cli.app import app as application

ROOT = Path(__file__).parents[2]
CAMERAS = "examples/video_cameras/cameras.toml"
PLAN = ("plan", "--c", "100", "--image", "68,104", "--area", "1000,600", "--sigma-image", "0.003",
        "--height", "1000", "--no-network")  # fmt: skip


def without_minute(text):
    """A report has the minute in which it was computed."""
    return re.sub(r"\d\d:\d\d UTC", "", text)


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
        cli.import_command(name)
    found = dict(commands(typer.main.get_command(application)))
    assert len(found) > 20
    for name, command in found.items():
        options = [option for parameter in command.params for option in parameter.opts]
        assert options.count("--quiet") == options.count("--verbose") == 1, name


def test_a_function_keeps_its_arguments():
    """Python callers do not see the options of the command line."""
    from jaxbundle.cli.plan import plan

    assert "verbose" not in inspect.signature(plan).parameters


LOCATE = ("pushbroom", "locate", "scanner.toml", "--grid", "2x2")
SCANNER = """
[scanner]
lines = 20
pixels = 10
earth = "local"
[times]
period = 0.1
[position]
table = "positions.csv"
interpolation = "linear"
[attitude]
table = "attitude.csv"
[optics]
c = 100.0
pitch = 0.01
[mounting]
"""


@pytest.fixture
def scanner(tmp_path):
    (tmp_path / "scanner.toml").write_text(SCANNER)
    (tmp_path / "positions.csv").write_text("t,X,Y,Z\n-1,0,0,500\n3,0,40,500\n")
    (tmp_path / "attitude.csv").write_text("t,pitch,roll,yaw\n-1,0,0,0\n3,0,0,0\n")
    return tmp_path / "scanner.toml"


@pytest.mark.parametrize("arguments", [
    PLAN, ("compare", f"{CAMERAS}#1-indoor", f"{CAMERAS}#2-indoor"),
    ("camera", f"{CAMERAS}#1-indoor"), ("example",), ("completion", "bash"), LOCATE,
    ("pushbroom", "project", "scanner.toml", "--points", "points.csv"),
    ("pushbroom", "accuracy", "scanner.toml", "--attitude-bias", "0.1", "--grid", "1x1"),
    ("adjust", "examples/convergent4/project.toml"), ("orient", "examples/convergent4"),
], ids=lambda arguments: "-".join(arguments[:2]))  # fmt: skip
def test_quiet_prints_the_result_alone(command, scanner, arguments):
    """Of commands whose result is what they print."""
    (scanner.parent / "points.csv").write_text("X,Y,Z\n0,15,0\n")
    at = {"scanner.toml": scanner, "points.csv": scanner.parent / "points.csv"}
    arguments = [at.get(word, word) for word in arguments]
    loud, told = command(*arguments), command(*arguments, "--quiet")
    assert loud.status == 0 and loud.out
    assert (told.status, without_minute(told.out), told.err) == (0, without_minute(loud.out), "")


@pytest.mark.parametrize("arguments, option, name", [
    (LOCATE, "--csv", "points.csv"), (LOCATE, "--json", "points.json"),
    (("adjust", "examples/convergent4/project.toml"), "--json", "result.json"),
    (("adjust", "examples/convergent4/project.toml"), "--gis", "network.gpkg"),
    (("adjust", "examples/convergent4/project.toml"), "--certificate", "certificate.html"),
    (PLAN, "--out", "block"),
    (("example", "convergent4"), None, "first"),
], ids=lambda given: "-".join(given[:2]) if isinstance(given, tuple) else None)  # fmt: skip
def test_quiet_prints_nothing_where_the_result_is_in_a_file(
    command, scanner, arguments, option, name
):
    file = scanner.parent / name
    arguments = [scanner if word == "scanner.toml" else word for word in arguments]
    told = command(*arguments, *([option] if option else []), file, "--quiet")
    assert (told.status, told.out, told.err) == (0, "", "") and file.exists()


def test_quiet_still_tells_errors_and_what_goes_to_standard_output_by_name(command, tmp_path):
    told = command("compare", "nowhere", f"{CAMERAS}#2-indoor", "--quiet")
    assert told.status == 2 and "nowhere" in told.err and told.out == ""
    (tmp_path / "a.csv").write_text("X,Y,Z\n0,0,0\n1,0,0\n0,1,0\n1,1,0\n")
    told = command("cloud", tmp_path / "a.csv", "--json", "-", "--quiet")
    assert told.status == 0 and json.loads(told.out)["points"] == 4


def test_verbose_tells_versions_iterations_and_times(command):
    quiet = command("adjust", "examples/convergent4/project.toml")
    told = command("adjust", "examples/convergent4/project.toml", "--verbose")
    assert without_minute(told.out) == without_minute(quiet.out)
    lines = told.err.splitlines()
    assert lines[0].startswith("jaxbundle ") and "numpy " in lines[0]
    assert any(line.startswith("iteration 1: ") and "λ" in line for line in lines)
    assert " s in all" in lines[-1]


def test_a_terminal_shows_what_is_written_and_drawn(command, tmp_path, monkeypatch):
    """A pipe shows nothing of it."""
    call = "adjust", "examples/convergent4/project.toml", "--out"
    assert command(*call, tmp_path / "a").err == ""
    monkeypatch.setenv("FORCE_COLOR", "1")  # a terminal for rich
    shown = command(*call, tmp_path / "b").err
    assert "writing the report" in shown and "drawing" in shown


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


@pytest.mark.parametrize("arguments", [
    PLAN, ("camera", f"{CAMERAS}#1-indoor", f"{CAMERAS}#2-indoor"),
    ("compare", f"{CAMERAS}#1-indoor", f"{CAMERAS}#2-indoor"), ("cloud", "cloud.csv"),
], ids=lambda arguments: arguments[0])  # fmt: skip
def test_json_goes_to_a_file_beside_the_report_or_alone(command, tmp_path, arguments):
    """And never over a file that is not JSON."""
    (tmp_path / "cloud.csv").write_text("X,Y,Z\n0,0,0\n1,0,0\n0,1,0\n1,1,0\n")
    arguments = [tmp_path / word if word == "cloud.csv" else word for word in arguments]
    report, alone = command(*arguments), command(*arguments, "--json", "-")
    beside = command(*arguments, "--json", tmp_path / "result.json")
    assert (alone.status, beside.out) == (0, report.out)
    assert json.loads((tmp_path / "result.json").read_text()) == json.loads(alone.out)
    (tmp_path / "notes").write_text("a word")
    refused = command(*arguments, "--json", tmp_path / "notes")
    assert refused.status == 2 and "is not JSON" in refused.err and refused.out == ""
    assert (tmp_path / "notes").read_text() == "a word"


def test_a_cloud_replaces_clouds_only(command, tmp_path):
    cloud, other = tmp_path / "cloud.csv", tmp_path / "other.csv"
    cloud.write_text("X,Y,Z\n0,0,0\n1,0,0\n0,1,0\n1,1,0\n")
    other.write_text("name,price\n")
    refused = command("cloud", cloud, "--out", other)
    assert refused.status == 2 and "is not a cloud" in refused.err
    assert other.read_text() == "name,price\n"
    for options in (["--force"], []):
        assert command("cloud", cloud, "--out", other, *options).status == 0
        assert other.read_text().startswith("X,Y,Z")
