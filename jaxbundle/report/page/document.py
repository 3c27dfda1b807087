"""One page of HTML that holds a whole result: words, charts, tables, the network to be turned.

The page needs nothing from outside: its script and its style stand in it once, and its policy
allows neither another script nor any request. What a browser without scripts cannot show, the
tables, is said to be in the CSV files.
"""

import base64
import hashlib
from collections.abc import Iterator
from importlib.resources import files

from jaxbundle.errors import NotSolvedError
from jaxbundle.report import head
from jaxbundle.report.layout import clean
from jaxbundle.report.page import markup, sections
from jaxbundle.report.page.columns import encode_table, script_text
from jaxbundle.report.page.origin import UNKNOWN, Origin
from jaxbundle.report.page.scene import describe_frames, describe_network
from jaxbundle.report.page.tables import collect_tables

SCRIPTS = (
    "data.js", "table.js", "canvas.js", "pointer.js", "network.js", "photograph.js", "start.js",
)  # fmt: skip
STYLE = "page.css"


def compose(
    adjustment, origin: Origin = UNKNOWN, *, date: str | None = None
) -> Iterator[str]:
    """The page of an adjustment as HTML, in pieces; of one that was not solved, why it was not.

    **Arguments:**

    - `origin`: the files that were read, with their fingerprints (`fingerprint_files`), and
      settings that are to be shown.
    - `date`: printed in the head as it is given; nothing is printed without it, so that the same
      adjustment always gives the same page.
    """
    yield _beginning(clean(adjustment.network.name) or "network", date)
    if adjustment.converged:
        yield from sections.result(adjustment)
    else:
        yield sections.failure(head.failure_facts(adjustment), adjustment.warnings)
    yield sections.describe_origin(head.setting_facts(adjustment), origin)
    if adjustment.converged:
        for id, columns in collect_tables(adjustment).items():
            yield _data(f"data-{id}", encode_table(columns))
        yield _data("network-data", describe_network(adjustment))
        yield _data("frames", describe_frames(adjustment))
    yield _end()


def compose_failure(error: NotSolvedError, origin: Origin = UNKNOWN) -> Iterator[str]:
    """The page of an adjustment that ended before there was a result."""
    rows = [("Why", str(error)), *(("Not determined", name) for name in error.undetermined)]
    yield _beginning("no result")
    yield sections.failure(rows, ())
    yield sections.describe_origin((), origin)
    yield _end()


def _beginning(name: str, date: str | None = None) -> str:
    from jaxbundle import __version__

    style, script = _read(STYLE), _script()
    policy = (
        f"default-src 'none'; img-src data:; style-src '{_digest(style)}'; "
        f"script-src '{_digest(script)}'; base-uri 'none'; form-action 'none'"
    )
    title = markup.text(f"{name}: bundle adjustment")
    made = f"jaxbundle {__version__}" + (f", {date}" if date else "")
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{title}</title>\n<style>{style}</style>\n</head>\n<body>\n"
        f"<header><h1>{title}</h1>{markup.paragraph(made)}</header>\n<main>\n"
    )


def _end() -> str:
    return f"</main>\n<script>{_script()}</script>\n</body>\n</html>\n"


def _data(id: str, value) -> str:
    return f'<script type="application/json" id="{id}">{script_text(value)}</script>\n'


def _script() -> str:
    """All scripts in one function, so that they share their names and leave none behind."""
    body = "\n".join(_read(name) for name in SCRIPTS)
    return f'"use strict";\n(() => {{\n{body}}})();\n'


def _read(name: str) -> str:
    return files("jaxbundle.report.page").joinpath(name).read_text(encoding="utf-8")


def _digest(text: str) -> str:
    """As a content security policy names what it allows."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode("ascii")
