"""Terminals, pipes and files that are not UTF-8, as every redirect on Windows: nothing is lost."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from jaxbundle.cli import COMMANDS
from jaxbundle.system import terminals

ROOT = Path(__file__).parents[2]
ENVIRONMENTS = {
    "ascii": {"PYTHONIOENCODING": "ascii"},
    "cp1252": {"PYTHONIOENCODING": "cp1252"},
    "C": {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
}
NAME = "σ7é\U0001f4cd"
"""Of a point: nothing in it is ASCII but the 7, and only é is in cp1252."""
HELPS = """
import sys
from jaxbundle import cli
from jaxbundle.system.terminals import write_everywhere
write_everywhere()
for command in sys.argv[1].split():
    sys.argv = ["jaxbundle", *command.split("."), "--help"]
    try:
        cli.main()
    except SystemExit as ended:
        assert not ended.code, (command, ended.code)
"""
PRINTED = """
import sys, jaxbundle
jaxbundle.enable_x64(compile_quickly=True)
jaxbundle.keep_programs()
result = jaxbundle.adjust(jaxbundle.read_network(sys.argv[1]))
assert sys.stdout.errors == "strict"
print(result)
print(repr(result))
"""


@pytest.fixture
def project(tmp_path):
    """A project in a folder, and with a point, that not every encoding has."""
    folder = tmp_path / "résumé σ"
    shutil.copytree(ROOT / "examples" / "convergent4", folder)
    for name, place in ("points.csv", 0), ("observations.csv", 1):
        rows = [row.split(",") for row in (folder / name).read_text("utf-8").splitlines()]
        for row in rows:
            if row[place : place + 1] == ["7"]:
                row[place] = NAME
        (folder / name).write_text("\n".join(map(",".join, rows)) + "\n", encoding="utf-8")
    return folder / "project.toml"


def run(*arguments, kind):
    environment = {k: v for k, v in os.environ.items() if k not in ("LC_ALL", "PYTHONIOENCODING")}
    command = [sys.executable, *map(str, arguments)]
    environment |= {"PYTHONPATH": str(ROOT)} | ENVIRONMENTS[kind]
    done = subprocess.run(command, capture_output=True, env=environment)
    coding = "ascii" if kind == "C" else kind
    # In a locale without UTF-8 names of files are written as the bytes that they are.
    errors = "surrogateescape" if kind == "C" else "strict"
    out, err = done.stdout.decode(coding, errors), done.stderr.decode(coding, errors)
    assert "Traceback" not in err and "UnicodeEncodeError" not in err
    return done.returncode, out, err


@pytest.mark.further
@pytest.mark.parametrize("kind", ["cp1252", "C"])
def test_report_iterations_and_files(kind, project, tmp_path):
    out = tmp_path / "out"
    options = ("--verbose", "--no-plots", "--out", out)
    status, said, err = run("-m", "jaxbundle", "adjust", project, *options, kind=kind)
    assert status == 0
    assert "s0" in said and "chi2" in said.replace("²", "2") and "vTPv" in err
    report = (out / "report.txt").read_text("utf-8")
    assert "σ0" in report and NAME in report
    assert NAME in json.loads((out / "result.json").read_text("utf-8"))["points"]
    assert len(said.splitlines()) == pytest.approx(len(report.splitlines()), abs=3)


@pytest.mark.further
def test_json_on_standard_output_is_json(project):
    options = ("--json", "-", "--brief")
    status, said, _ = run("-m", "jaxbundle", "adjust", project, *options, kind="ascii")
    assert status == 0
    assert json.loads(said)["sigma0"] > 0
    whole, piece = f'{{"{NAME}": 1}}', '{"\udcc3\udca9": "\ud83d"}'
    for coding in "ascii", "cp1252", "latin-1", "utf-8":
        assert json.loads(written(whole, coding).decode(coding)) == {NAME: 1}
        assert json.loads(written(piece, coding).decode(coding)) == {"é": "\ufffd"}
    assert written(whole, "utf-8") == whole.encode()


def written(text, coding) -> bytes:
    """JSON as it arrives in a pipe."""
    stream = Recorder(coding, [])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "stdout", stream)
        terminals.write_json(text)
    return b"".join(stream.pieces)


class Recorder:
    """A stream of an encoding."""

    errors = "strict"

    def __init__(self, encoding, pieces):
        self.encoding, self.pieces = encoding, pieces

    def write(self, text):
        self.pieces.append(text.encode(self.encoding))


@pytest.mark.parametrize("kind", ENVIRONMENTS)
def test_help_of_every_command(kind):
    commands = " ".join([*COMMANDS, "pushbroom.accuracy", "pushbroom.locate", "pushbroom.rpc.fit"])
    status, said, err = run("-c", HELPS, commands, kind=kind)
    assert (status, err) == (0, "")
    assert said.count("--help") >= len(COMMANDS) and said.isascii() == (kind != "cp1252")


def test_errors_and_a_whole_help(tmp_path):
    status, said, err = run("-m", "jaxbundle", "adjust", tmp_path / "σ é.toml", kind="ascii")
    assert (status, said) == (2, "") and err.count("\n") == 1 and "\\xe9.toml" in err
    status, said, err = run("-m", "jaxbundle", "adjust", "--help", kind="ascii")
    assert (status, err) == (0, "") and said.isascii()


def test_a_file_that_the_locale_cannot_name_is_bad_input(project):
    table = project.with_name("σ.csv")
    project.with_name("points.csv").rename(table)
    text = project.read_text("utf-8").replace("points.csv", "σ.csv")
    project.write_text(text, encoding="utf-8")
    status, _, err = run("-m", "jaxbundle", "adjust", project, kind="C")
    assert status == 2 and err.count("\n") == 1


@pytest.mark.further
@pytest.mark.parametrize("kind", ["ascii", "C"])
def test_criteria_and_certificates(kind, project, tmp_path):
    """Signs that the terminal lacks, in what is asked and in what is said."""
    asked = ("--accept", "sigma(c) ≤ 2 µm", "--no-second-minimum", "--quiet")
    page = tmp_path / "certificate.html"
    for options in asked, (*asked, "--certificate", page):
        status, said, err = run("-m", "jaxbundle", "adjust", project, *options, kind=kind)
        assert status == 4
        assert "sigma(c) <= 2 um: 45" in err and err.count("\n") == 1
        # --quiet prints the result where no file is asked for.
        assert ("Acceptance: 1 of 1 criteria not met" in said) == (options is asked)
    assert "±" in page.read_text("utf-8")


def test_results_can_be_printed_in_python(project):
    status, said, err = run("-c", PRINTED, project, kind="ascii")
    assert (status, err) == (0, "")
    assert "s0" in said and said.isascii()


def test_utf8_is_not_changed(convergent4, monkeypatch):
    text = "σ̂0 0.631 µm, χ², vᵀPv, é, \udcff"
    monkeypatch.setattr(sys, "stdout", Recorder("utf-8", []))
    assert terminals.for_output(text) == text and "σ0" in str(convergent4)
    monkeypatch.setattr(sys, "stdout", Recorder("latin-1", []))
    assert terminals.for_output(text) == "s0 0.631 µm, chi², vTPv, é, ÿ"
    assert "s0" in str(convergent4)
    for stream in Recorder("utf-8", []), None:
        monkeypatch.setattr(sys, "stdout", stream)
        assert terminals.for_printing("σ") == "σ"
