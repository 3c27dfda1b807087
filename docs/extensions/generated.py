"""What pages of the documentation take from the code, so that it is written once.

A fenced block of one of these kinds is replaced before Sphinx reads the page:

- `{names}`: a name of `jaxbundle` a line; each with signature and docstring;
- `{room}`: a module; its docstring, and every name it offers;
- `{commands}`: empty; every command, from the parsers of the command line.

`docs/index.md` needs none: its lists of links are the table of contents, a part for each heading.
Before them the first page of the site has what the README says; a reader of the repository has the
README itself.
"""

import functools
import importlib
import inspect
import re
import types
from collections.abc import Iterator
from pathlib import Path

import typer

import jaxbundle
from jaxbundle import cli
from jaxbundle.cli.app import app as application

BLOCK = re.compile(r"^```\{(names|room|commands)\}\n(.*?)^```$", re.M | re.S)
LINK = re.compile(r"^ *- \[[^\]]*\]\(([^)#]+\.(?:md|ipynb))\)", re.M)


def expand_page(app, docname: str, source: list[str]) -> None:
    """Replace the blocks of a page; Sphinx calls it when it has read one."""
    if docname == app.config.root_doc:
        readme = Path(app.srcdir) / "README.md"
        app.env.note_dependency(str(readme))  # a changed README is read again
        source[0] = add_contents(add_readme(source[0], readme.read_text(encoding="utf-8")))
    makers = {"names": list_names, "room": list_room, "commands": list_commands}
    source[0] = BLOCK.sub(lambda block: makers[block[1]](block[2].split()), source[0])


def add_readme(text: str, readme: str) -> str:
    """The first page with what the README has between its picture and its last section, which lists
    pages as this one does, in place of what follows the picture here."""
    top, readme_top = (re.match(r".*?^!\[.*?$", page, re.M | re.S) for page in (text, readme))
    body = readme[readme_top.end() : readme.rindex("\n## ")]
    # links of README are from the folder above
    body = re.sub(r"\]\((?!https?:|#)", "](../", body).replace("](../docs/", "](")
    lists = text[text.index("\n## ") :]
    return f"{top[0]}\n{body}{lists}"


def add_contents(text: str) -> str:
    """A hidden table of contents after each section of the first page: the links it lists."""
    first, *sections = re.split(r"^## ", text, flags=re.M)
    parts = [first]
    for section in sections:
        caption = section.split("\n", 1)[0]
        pages, contents = "\n".join(LINK.findall(section)), ""
        if pages:
            contents = f"```{{toctree}}\n:hidden:\n:caption: {caption}\n\n{pages}\n```\n\n"
        parts.append(f"## {section}\n\n{contents}")
    return "".join(parts)


def names_of(room: types.ModuleType) -> list[str]:
    """What a module offers: what its `__all__` lists, or a file without one defines."""
    defined = [
        name
        for name, value in vars(room).items()
        if getattr(value, "__module__", None) == room.__name__ and not name.startswith("_")
    ]
    return sorted(getattr(room, "__all__", defined), key=str.casefold)


def list_names(names: list[str]) -> str:
    """The names of `jaxbundle`, in the order given."""
    return in_rst(line for name in names for line in describe("jaxbundle", name))


def list_room(modules: list[str]) -> str:
    """A module and all it offers; modules in it are described with it."""
    lines = []
    for module in modules:
        room = importlib.import_module(module)
        lines += [f".. automodule:: {module}", "   :no-members:", ""]
        for name in names_of(room):
            lines += describe(module, name)
    return in_rst(lines)


def home_of(module: str, name: str) -> str:
    """Where a name of several modules is described: in `jaxbundle`, else where it belongs."""
    value = getattr(importlib.import_module(module), name)
    if getattr(jaxbundle, name, None) is value:
        return "jaxbundle"
    room = ".".join(getattr(value, "__module__", module).split(".")[:2])
    return room if getattr(importlib.import_module(room), name, None) is value else module


def describe(module: str, name: str) -> Iterator[str]:
    """The directives for one name."""
    value = getattr(importlib.import_module(module), name)
    if inspect.ismodule(value):
        yield from (f".. automodule:: {value.__name__}", "   :members:", "")
        return
    if (home := home_of(module, name)) != module:
        yield from (f"``{module}.{name}`` is :py:obj:`{home}.{name}`.", "")
        return
    constant = not callable(value)
    kind = "data" if constant else "class" if inspect.isclass(value) else "function"
    if kind == "class" and issubclass(value, Exception):
        kind = "exception"
    yield f".. auto{kind}:: {module}.{name}"
    if kind == "class":
        yield "   :members:"
    yield ""


def in_rst(lines) -> str:
    return "\n".join(["```{eval-rst}", *lines, "```"])


def list_commands(_) -> str:
    """Every command with its arguments and options, as its parser has them."""
    return "\n".join(walk(*whole_program(), 1))


@functools.cache
def whole_program():
    """The parser of all commands, and its context."""
    for command in cli.COMMANDS:
        cli.import_command(command)
    group = typer.main.get_command(application)
    return group, typer.Context(group, info_name="jaxbundle")


def find_command(words: list[str]):
    """The parser that words on the command line are for, its context, and the words left to it."""
    command, context = whole_program()
    while words and words[0] in getattr(command, "commands", {}):
        name, *words = words
        command = command.commands[name]
        context = typer.Context(command, parent=context, info_name=name)
    return command, context, words


def walk(command, context, level: int) -> Iterator[str]:
    if level > 1:
        yield f"{'#' * level} {context.command_path}\n"
        yield from paragraphs(command.help)
    if found := getattr(command, "commands", None):
        for name, below in found.items():
            yield from walk(below, typer.Context(below, parent=context, info_name=name), level + 1)
        return
    usage = " ".join(command.collect_usage_pieces(context))
    yield f"```text\n{context.command_path} {usage}\n```\n"
    yield "| | |\n|---|---|"
    for parameter in command.get_params(context):
        if (record := parameter.get_help_record(context)) and parameter.name != "help":
            yield f"| `{record[0]}` | {escape(record[1])} |"
    yield f"\nFor example:\n\n```text\n{context.command_path} {command.example}\n```\n"


def paragraphs(text: str | None) -> Iterator[str]:
    for paragraph in inspect.cleandoc(text or "").split("\n\n"):
        yield escape(" ".join(paragraph.split())) + "\n"


def escape(text: str) -> str:
    return re.sub(r"([\\`*_\[\]<>|$])", r"\\\1", text)


def setup(app):
    """As Sphinx wants it."""
    app.connect("source-read", expand_page)
    return {"parallel_read_safe": True, "version": jaxbundle.__version__}
