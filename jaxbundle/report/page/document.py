"""A self-contained HTML page of a result: text, charts, tables, rotatable drawings.

A command declares its page: the sections, the verdict first, the tables, and script drawings.
The page needs no other file: it contains its script and style, and its policy
forbids other scripts and requests. Without scripts, a note refers to the CSV files for the
tables.
"""

import base64
import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib.resources import files
from types import MappingProxyType
from typing import Any, NamedTuple

from jaxbundle.report.layout import clean
from jaxbundle.report.page import markup
from jaxbundle.report.page.columns import Column, encode_table, script_text
from jaxbundle.report.page.origin import UNKNOWN, Origin, software_versions, stamp
from jaxbundle.system.clock import in_words, now

SCRIPTS = (
    "data.js",
    "table.js",
    "canvas.js",
    "pointer.js",
    "network.js",
    "photograph.js",
    "start.js",
)
STYLE = "page.css"
NO_SCRIPT = "<noscript><p>The tables need JavaScript; --out has them as CSV files.</p></noscript>\n"
NOTHING: Mapping[str, Any] = MappingProxyType({})


class Section(NamedTuple):
    """A section: its `id`, heading and HTML; `link`: its name in the contents, empty: not
    listed."""

    id: str
    title: str
    content: str
    link: str = ""


class Listing(NamedTuple):
    """A table that sorts and searches: its heading, its columns by name, the file that has all of
    its rows, and a note above it."""

    title: str
    columns: Mapping[str, Column]
    file: str = ""
    note: str = ""


class Page(NamedTuple):
    """A page: its title; its sections, the verdict first; the origin of the result, and `settings`
    by name to show with it; its non-empty tables by name; data of script drawings, by id. `scripts`
    run after those of every page, `style` adds to its style; `asks`: the scripts may send requests
    to the page's server."""

    title: str
    sections: Iterable[Section]
    origin: Origin = UNKNOWN
    settings: Sequence[tuple[str, object]] = ()
    tables: Mapping[str, Listing] = NOTHING
    drawings: Mapping[str, Any] = NOTHING
    scripts: Sequence[str] = ()
    style: str = ""
    asks: bool = False


def write(page: Page, date: str | None = None) -> Iterator[str]:
    """The page as HTML, in pieces; `date`: of the computation, by default that of its origin."""
    tables = {
        id: table
        for id, table in page.tables.items()
        if any(len(column.values) for column in table.columns.values())
    }
    # The verdict stands before the contents, on the first screen.
    first_section, *sections = page.sections
    listed = [_listing(id, table) for id, table in tables.items()]
    if listed:
        # One link leads to all tables.
        listed[0] = listed[0]._replace(link="Tables")
    last_section = _origin(page)
    yield _beginning(page, date or page.origin.computed or in_words(now()))
    yield _section(first_section)
    yield _contents([*sections, *listed, last_section])
    yield from map(_section, sections)
    if listed:
        yield markup.paragraph(
            "Click a header to sort, again to reverse the order; type to search.", "hint"
        )
        yield NO_SCRIPT
        yield from map(_section, listed)
    yield _section(last_section)
    for id, table in tables.items():
        yield _data(f"data-{id}", encode_table(table.columns))
    for id, value in page.drawings.items():
        yield _data(id, value)
    yield f"</main>\n<script>{_script(page)}</script>\n</body>\n</html>\n"


def _listing(id: str, table: Listing) -> Section:
    """The placeholder of a table, filled by the script."""
    place = f'<div class="table" data-table="{id}" data-file="{markup.text(table.file)}"></div>\n'
    note = markup.paragraph(table.note) if table.note else ""
    return Section(f"table-{id}", table.title, note + place)


def _contents(sections: Iterable[Section]) -> str:
    """Links to the sections."""
    links = "".join(f'<a href="#{s.id}">{markup.text(s.link)}</a>\n' for s in sections if s.link)
    return f"<nav>{links}</nav>\n"


def _section(section: Section) -> str:
    return markup.section(section.id, section.title, section.content)


def _origin(page: Page) -> Section:
    """Settings, fingerprints of the files read, versions of the software."""
    origin = page.origin
    parts = [markup.facts([*page.settings, *origin.settings.items()])]
    if origin.inputs:
        rows = [(file.name, file.size, file.sha256) for file in origin.inputs]
        listed = markup.grid(("file", "bytes", "SHA-256"), rows, "words files")
        parts += ["<h3>Input files</h3>\n", listed]
    parts += ["<h3>Software</h3>\n", markup.facts(software_versions())]
    title = "Settings and origin"
    return Section("origin", title, "".join(parts), title)


def _beginning(page: Page, date: str) -> str:
    stamp_line = " · ".join(map(clean, stamp([file.name for file in page.origin.inputs], date)))
    # Repeated in the margin of every printed page, by browsers that know margin boxes.
    margins = (
        f'@page {{ @top-left {{ content: "{_css_text(clean(page.title))}"; font-size: 8pt; }} '
        f'@bottom-left {{ content: "{_css_text(stamp_line)}"; font-size: 8pt; }} }}\n'
    )
    style, script = _read(STYLE) + margins + page.style, _script(page)
    policy = (
        f"default-src 'none'; img-src data:; style-src '{_digest(style)}'; "
        f"script-src '{_digest(script)}'; base-uri 'none'; form-action 'none'"
    )
    # Browsers request an icon unless the page declares that it has none.
    icon = '<link rel="icon" href="data:,">\n' if page.asks else ""
    policy += "; connect-src 'self'" if page.asks else ""
    title = markup.text(page.title)
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"{icon}<title>{title}</title>\n<style>{style}</style>\n</head>\n<body>\n"
        f"<header><h1>{title}</h1>{markup.paragraph(stamp_line, 'made')}</header>\n<main>\n"
    )


def _css_text(words: str) -> str:
    """Text in a string of CSS: letters and digits as they are, all else by its code."""
    return "".join(c if c.isalnum() or c in " .,:" else f"\\{ord(c):x} " for c in words)


def _data(id: str, value: Any) -> str:
    return f'<script type="application/json" id="{id}">{script_text(value)}</script>\n'


def _script(page: Page) -> str:
    """All scripts in one function, so that they share their names and leave none behind."""
    body = "\n".join([*(_read(name) for name in SCRIPTS), *page.scripts])
    return f'"use strict";\n(() => {{\n{body}}})();\n'


def _read(name: str) -> str:
    return files("jaxbundle.report.page").joinpath(name).read_text(encoding="utf-8")


def _digest(text: str) -> str:
    """The digest in the form of a content security policy."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode("ascii")
