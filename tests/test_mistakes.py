"""Typical mistakes: the messages are those of docs/howto/mistakes.md, one line each.

Words of a message may change a little; `WRITE=1 pytest tests/test_mistakes.py` writes those of
today into the page.
"""

import os
import re
import shlex
from difflib import SequenceMatcher
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


def compare(line, found, said):
    """The same error about the same things, in nearly the same words."""
    if os.environ.get("WRITE"):
        path = ROOT / "docs" / "howto" / "mistakes.md"
        page = path.read_text(encoding="utf-8")
        path.write_text(page.replace(f"{line}\n{said}\n", f"{line}\n{found}\n"), encoding="utf-8")
    else:
        assert found.split(":")[0] == said.split(":")[0]
        assert SequenceMatcher(None, found, said).ratio() > 0.6, found


def test_there_are_enough():
    assert len(COMMANDS) >= 20 and len(CALLS) >= 20


@pytest.mark.parametrize("line, said", COMMANDS, ids=[line for line, _ in COMMANDS])
def test_at_the_command_line(command, line, said):
    told = command(*shlex.split(line)[1:])
    err = re.sub(r" See .*?jaxbundle", " See jaxbundle", told.err)  # as whose program is running
    assert (told.status, told.out, err.count("\n")) == (2, "", 1)
    compare(line, err.rstrip("\n"), said)


@pytest.mark.parametrize("line, said", CALLS, ids=[line for line, _ in CALLS])
def test_in_python(convergent4, line, said):
    names = {"jaxbundle": jaxbundle, "np": np, "result": convergent4,
             "network": convergent4.network}  # fmt: skip
    with pytest.raises(Exception) as caught:
        exec(line, names)
    text = caught.value.args[0] if isinstance(caught.value, KeyError) else str(caught.value)
    compare(line, f"{type(caught.value).__name__}: {text}", said)
