"""The frame that runs README and docs as processes, and a sample of it: `make test-commands` runs
all."""

import subprocess

import pytest
from camera_models import processes_of_model
from documents import ROOT, foreign_names, pages, processes_of
from own_files import OWN, OWN_NAMES
from run import Checkout, run_page, why_not


@pytest.mark.parametrize("page", pages())
def test_blocks_have_all_their_names(page):
    """A reader can copy them: names that they use are theirs, or of the blocks before them."""
    given = OWN_NAMES.get(page, "")
    for process in processes_of(page):
        if process.python:
            assert not foreign_names(given + process.text), process.name


def test_few_commands_do_not_run():
    """Installations, this test, and several machines."""
    found = [one for page in pages() for one in processes_of(page)]
    assert len(found) > 140 and sum(why_not(one) is not None for one in found) <= 12


def test_files_that_a_reader_has_are_named_somewhere():
    texts = [one.text for page in pages() for one in processes_of(page)]
    texts += [one.text for one in processes_of_model("brown")]
    for name in OWN:
        assert any(name in text for text in texts), name


def test_blocks_continue_those_before_them():
    first, *others = [one for one in processes_of("docs/derivatives.md") if one.python]
    assert not others and "import jaxbundle" in first.text
    lines = (ROOT / first.page).read_text(encoding="utf-8").splitlines()
    for k, line in enumerate(first.text.splitlines()):
        assert not line or line == lines[first.line - 1 + k]


@pytest.mark.slow
def test_the_first_block_and_commands_of_the_readme(tmp_path):
    """From a clone, with an empty home, and once more with the programs that it keeps."""
    if subprocess.run(["git", "-C", ROOT, "rev-parse", "HEAD"], capture_output=True).returncode:
        pytest.skip("not a clone")
    block = next(one for one in processes_of("README.md") if one.python)
    command = next(one for one in processes_of("README.md") if "jaxbundle adjust" in one.text)
    cold, _, warm, _ = told = list(run_page(Checkout(tmp_path), "README.md", [block, command]))
    for one in told:
        assert not one.failed, one
        assert one.stderr.count("\n") <= 2, one.stderr  # a first adjustment says why it waits
    assert "0.63128 µm" in warm.stdout and warm.stdout == cold.stdout
