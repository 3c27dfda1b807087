"""The commands of the pages and of the help texts run on the examples, in their order."""

import importlib
import re
import shlex
import sys
from pathlib import Path

import pytest
from test_site import DOCS, ROOT, SOURCES, commands_of

from jaxbundle.explore.server import Server

OWN = re.compile(
    r"PHOTOS|^PROJECT\.toml|DIR\b|INDEX|EXPORT|--budget|left=|image\.tif|\b(a|b)\.(tif|toml)"
    r"|^(project|refine)\.toml|^(planned|points\.csv)$|^(cameras|rigs|phones|surveyed)[./]"
    r"|^(spring|export|control|problem|calibration|epoch\d)\b"
)
"""Words of a command that stand for a reader's own files."""
STANDS_FOR = {"PROJECT": "examples/convergent4/project.toml", "FOLDER": "out/folder",
              "my/project.toml": "examples/convergent4/project.toml"}  # fmt: skip
"""The files of the repository that some of them are tried with."""
BEFORE = {"docs/exchange.md": ["adjust examples/convergent4/project.toml --out out/convergent4"]}
"""What a page expects to have been run."""
NOT_SOLVED = ("--max-iterations 2",)
"""What a page shows as not solved: status 3."""


def runs_here(line: str) -> bool:
    """Whether all inputs of a command are in the repository, or come from a command before it."""
    words = shlex.split(line)
    return "..." not in line and not any(OWN.search(word) for word in words)


def examples_of_help() -> list[str]:
    """The example of every command, from its parser."""
    sys.path.insert(0, str(DOCS / "extensions"))
    try:
        page = importlib.import_module("generated").list_commands([])
    finally:
        sys.path.remove(str(DOCS / "extensions"))
    return re.findall(r"For example:\n\n```text\njaxbundle (.*)", page)


CASES = [
    pytest.param([*BEFORE.get(name, []), *lines], id=name)
    for path in SOURCES
    if (name := str(path.relative_to(ROOT))) != "docs/howto/mistakes.md"
    and (lines := [line for line in commands_of(path) if runs_here(line)])
]


@pytest.mark.further
@pytest.mark.slow
@pytest.mark.parametrize("lines", [*CASES, pytest.param(None, id="help")])
def test_commands_run(lines, command, tmp_path, monkeypatch):
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    (tmp_path / "out").mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Server, "serve_forever", lambda server: server.server_close())
    for line in lines or sorted(filter(runs_here, examples_of_help()), key=needs_others):
        words = [found for word in shlex.split(line) for found in expand(word)]
        if words[0] == "explore":
            words.append("--no-browser")
        told = command(*words)
        expected = 3 if any(part in line for part in NOT_SOLVED) else 0
        assert told.status == expected, f"jaxbundle {line}: {told.err}"


def needs_others(line: str) -> bool:
    """Whether a command reads what others have written."""
    return line.split(" --")[0].startswith(("cloud", "pushbroom")) and "examples/" not in line


def expand(word: str) -> list[str]:
    """What a shell makes of a word."""
    found = sorted(map(str, Path().glob(word))) if re.search(r"[*\[]", word) else []
    return found or [STANDS_FOR.get(word, word)]
