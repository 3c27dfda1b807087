"""The documentation site without Sphinx: pages are listed, links lead somewhere, every public name
has a docstring and a place in the reference. `make docs` builds it."""

import importlib
import inspect
import re
import shlex
import sys
from pathlib import Path

import pytest

import jaxbundle
from jaxbundle import cli

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
ENTRIES = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")]
SOURCES = [*PAGES, *ENTRIES, ROOT / "benchmarks" / "README.md", *ROOT.glob("examples/*/README.md")]


@pytest.fixture(scope="module")
def generated():
    """The extension that writes the reference from the code."""
    sys.path.insert(0, str(DOCS / "extensions"))
    try:
        yield importlib.import_module("generated")
    finally:
        sys.path.remove(str(DOCS / "extensions"))


def without_code(text):
    return re.sub(r"^(```+).*?^\1$|(?<!`)`[^`\n]+`(?!`)", "", text, flags=re.M | re.S)


def anchors_of(path):
    """The anchors of headings, as GitHub makes them: `code` keeps its words, spaces are hyphens."""
    text = re.sub(r"^(```+).*?^\1$", "", path.read_text(encoding="utf-8"), flags=re.M | re.S)
    anchors = set()
    for heading in re.findall(r"^#+ +(.*)$", text, re.M):
        heading = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).strip().lower()
        slug = re.sub(r"[^\w\- ]", "", heading).replace(" ", "-")
        repeated = re.compile(rf"{re.escape(slug)}(-\d+)?")
        number = sum(bool(repeated.fullmatch(known)) for known in anchors)
        anchors.add(f"{slug}-{number}" if number else slug)
    return anchors


def links_of(path):
    """(file, anchor) of every link to another place of the repository."""
    for target in re.findall(r"\]\(([^)\s]+)\)", without_code(path.read_text(encoding="utf-8"))):
        if not re.match(r"[a-z]+:", target):
            file, _, anchor = target.partition("#")
            yield target, (path.parent / file).resolve() if file else path, anchor


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_to_files_and_headings(path):
    for target, file, anchor in links_of(path):
        assert file.is_relative_to(ROOT) and file.exists(), target
        assert not anchor or anchor in anchors_of(file), target


def test_every_page_is_listed_once_on_the_first(generated):
    listed = generated.LINK.findall((DOCS / "index.md").read_text(encoding="utf-8"))
    assert len(listed) == len(set(listed))
    pages = {(DOCS / page).resolve() for page in listed}
    notebooks = set((ROOT / "notebooks").glob("*.ipynb"))
    assert pages >= {*PAGES, *notebooks} - {DOCS / "index.md"}


def test_every_name_of_the_package_is_in_the_reference_with_a_docstring():
    text = (DOCS / "reference" / "names.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```\{names\}\n(.*?)^```$", text, re.M | re.S)
    assert sorted(" ".join(blocks).split()) == sorted(jaxbundle.__all__)
    for name in jaxbundle.__all__:
        assert is_described(getattr(jaxbundle, name), name), name


def test_every_name_of_a_room_is_in_the_reference_with_a_docstring(generated):
    text = "".join(path.read_text(encoding="utf-8") for path in DOCS.glob("reference/*.md"))
    described = re.findall(r"^```\{room\}\n(\S+)\n```$", text, re.M)
    rooms = [f"jaxbundle.{path.parent.name}" for path in (ROOT / "jaxbundle").glob("*/__init__.py")]
    assert sorted(described) == sorted(r for r in rooms if importlib.import_module(r).__all__)
    for module in described:
        room = importlib.import_module(module)
        for name in generated.names_of(room):
            value = getattr(room, name)
            assert not callable(value) or is_described(value, name), f"{module}.{name}"


def is_described(value, name):
    """Not by the signature alone, which dataclasses have in place of a docstring."""
    return bool(value.__doc__) and not inspect.getdoc(value).startswith(f"{name}(")


def test_the_reference_of_commands_has_every_one(generated):
    page = generated.list_commands([])
    for line in re.findall(r"For example:\n\n```text\njaxbundle (.*)", page):
        command, context, words = generated.find_command(shlex.split(line))
        command.make_context(context.info_name, words, parent=context.parent)
    for command in cli.COMMANDS:
        assert f"## jaxbundle {command}\n" in page
    assert "### jaxbundle pushbroom locate\n" in page and "`--json" in page


def commands_of(path):
    """The lines of code blocks that call the program, up to a pipe or a comment; without lines that
    show a syntax, with options in brackets."""
    text = path.read_text(encoding="utf-8")
    for kind, block in re.findall(r"^```([^\n`]*)\n(.*?)^```$", text, re.M | re.S):
        if kind in ("", "console", "bash", "sh"):
            for line in re.findall(r"^(?:\$ )?jaxbundle (.*)", block.replace("\\\n", " "), re.M):
                if " [" not in line:
                    yield re.split(r" [|>&]|  +#|…", line)[0]


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_commands_of_the_pages_are_understood(path, generated):
    for line in commands_of(path):
        line = re.sub(r"\bINDEX\b", "0", line)
        command, context, words = generated.find_command(shlex.split(line))
        if "--help" not in words:
            command.make_context(context.info_name, words, parent=context.parent)
