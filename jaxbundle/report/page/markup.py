"""Pieces of HTML; external text is escaped here."""

from collections.abc import Iterable, Sequence
from html import escape

from jaxbundle.report.layout import clean


def text(value: object) -> str:
    """Text of one line, escaped."""
    return escape(clean(value))


def section(id: str, title: str, *content: str) -> str:
    """A section with its heading."""
    return f'<section id="{id}"><h2>{text(title)}</h2>\n{"".join(content)}</section>\n'


def paragraph(words: object, kind: str = "") -> str:
    """A paragraph, of a class if one is given."""
    return f"<p{_class(kind)}>{text(words)}</p>\n"


def items(lines: Iterable[object]) -> str:
    """A list."""
    return "<ul>\n" + "".join(f"<li>{text(line)}</li>\n" for line in lines) + "</ul>\n"


def facts(rows: Iterable[tuple[object, object]]) -> str:
    """Names and their descriptions."""
    cells = "".join(
        f'<tr><th scope="row">{text(name)}</th><td>{text(value)}</td></tr>\n'
        for name, value in rows
    )
    return f'<table class="facts">\n{cells}</table>\n'


def grid(header: Sequence[object], rows: Iterable[Sequence[object]], kind: str = "") -> str:
    """A table with a header, which scrolls where it is wider than the page; all but the first
    column are numbers, of the kind `remarks` also the last are words, of the kind `words` all."""
    head = "".join(f'<th scope="col">{text(cell)}</th>' for cell in header)
    body = "".join(
        "<tr>" + "".join(f"<td>{text(cell)}</td>" for cell in row) + "</tr>\n" for row in rows
    )
    cells = f"<thead><tr>{head}</tr></thead>\n<tbody>\n{body}</tbody>"
    return f'<div class="wide"><table{_class(kind)}>\n{cells}</table></div>\n'


def grid_of_first(
    header: Sequence[object],
    rows: Sequence[Sequence[object]],
    max_rows: int,
    kind: str = "",
    all_are: str = "",
) -> str:
    """The first rows of a table, and how many more there are; `all_are`: where all of them are."""
    number_of_others = len(rows) - max_rows
    table = grid(header, rows[:max_rows], kind)
    if number_of_others <= 0:
        return table
    return table + paragraph(f"… and {number_of_others} more{all_are and f': all are {all_are}'}.")


def figure(drawing: str, caption: object) -> str:
    """A drawing over its caption."""
    return f"<figure>\n{drawing}<figcaption>{text(caption)}</figcaption></figure>\n"


def _class(kind: str) -> str:
    return f' class="{kind}"' if kind else ""
