"""Docstrings are Markdown; autodoc reads reStructuredText. This is the translation."""

import ast
import re

from markdown_it import MarkdownIt
from markdown_it.tree import SyntaxTreeNode

READER = MarkdownIt("commonmark").enable("table")
PUBLIC = re.compile(r"jaxbundle(\.\w+)*\.\w+")


def translate_docstring(app, what, name, obj, options, lines: list[str]) -> None:
    """Replace the lines of a docstring; autodoc calls it for each."""
    lines[:] = [*blocks(SyntaxTreeNode(READER.parse("\n".join(lines)))), ""]


def blocks(node: SyntaxTreeNode) -> list[str]:
    """The children of a node, as lines of reStructuredText."""
    return [line for child in node.children for line in [*block(child), ""]]


def block(node: SyntaxTreeNode) -> list[str]:
    if node.type in ("bullet_list", "ordered_list"):
        mark = "-" if node.type == "bullet_list" else "#."
        return [line for item in node.children for line in [*hang(mark, blocks(item)), ""]]
    if node.type in ("code_block", "fence"):
        language = "python" if is_python(node.content) else "text"
        lines = node.content.rstrip("\n").split("\n")
        return [f".. code-block:: {language}", "", *indent(lines, 3)]
    if node.type == "blockquote":
        return indent(blocks(node), 3)
    if node.type == "table":
        rows = [row for part in node.children for row in part.children]
        cells = [
            f"{'  -' if place else '* -'} {inline(cell)}"
            for row in rows
            for place, cell in enumerate(row.children)
        ]
        return [".. list-table::", "   :header-rows: 1", "", *indent(cells, 3)]
    if node.type == "heading":
        return [f"**{inline(node)}**"]
    return inline(node).split("\n")


def is_python(text: str) -> bool:
    """Whether it is code, not a formula."""
    try:
        ast.parse(text)
    except SyntaxError:
        return False
    return True


def hang(mark: str, lines: list[str]) -> list[str]:
    first, *rest = lines or [""]
    return [f"{mark} {first}", *indent(rest, len(mark) + 1)]


def indent(lines: list[str], width: int) -> list[str]:
    return [" " * width + line if line else "" for line in lines]


def inline(node: SyntaxTreeNode) -> str:
    if node.type == "text":
        return re.sub(r"([\\*`|_])", r"\\\1", node.content)
    if node.type == "code_inline":
        return code(node.content)
    if node.type in ("softbreak", "hardbreak"):
        return "\n"
    inside = "".join(inline(child) for child in node.children) or node.content
    if node.type == "strong":
        return rf"\ **{inside}**\ "
    if node.type == "em":
        return rf"\ *{inside}*\ "
    return inside


def code(text: str) -> str:
    """A name of the package as a reference, which is plain code where the name is not described."""
    if PUBLIC.fullmatch(text):
        return rf"\ :py:obj:`{text}`\ "
    return rf"\ ``{text}``\ "


def setup(app):
    """As Sphinx wants it."""
    app.connect("autodoc-process-docstring", translate_docstring)
    return {"parallel_read_safe": True}
