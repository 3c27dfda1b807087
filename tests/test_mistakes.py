"""Typical mistakes: what is said is what docs/howto/mistakes.md says, one line each."""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest

import jaxbundle

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "howto" / "mistakes.md").read_text(encoding="utf-8")
TOLD = re.findall(r"^(\$|>>>) (.*)\n(.*)$", PAGE, re.M)
COMMANDS = [(line, said) for mark, line, said in TOLD if mark == "$"]
CALLS = [(line, said) for mark, line, said in TOLD if mark == ">>>"]


@pytest.fixture(autouse=True)
def in_the_repository(monkeypatch):
    monkeypatch.chdir(ROOT)


def test_there_are_enough():
    assert len(COMMANDS) >= 20 and len(CALLS) >= 20


@pytest.mark.parametrize("line, said", COMMANDS, ids=[line for line, _ in COMMANDS])
def test_at_the_command_line(command, line, said):
    told = command(*shlex.split(line)[1:])
    err = re.sub(r" See .*?jaxbundle", " See jaxbundle", told.err)  # as whose program is running
    assert (told.status, told.out, err) == (2, "", f"{said}\n")


@pytest.mark.parametrize("line, said", CALLS, ids=[line for line, _ in CALLS])
def test_in_python(convergent4, line, said):
    names = {"jaxbundle": jaxbundle, "np": np, "result": convergent4,
             "network": convergent4.network}  # fmt: skip
    with pytest.raises(Exception) as caught:
        exec(line, names)
    text = caught.value.args[0] if isinstance(caught.value, KeyError) else str(caught.value)
    assert f"{type(caught.value).__name__}: {text}" == said
