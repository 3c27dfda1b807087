"""Common parts of the explorer pages: controls, scripts, style, and the page itself."""

from collections.abc import Iterable, Mapping, Sequence
from importlib.resources import files
from typing import Any, NamedTuple

from jaxbundle.io.results.result_json import without_nan
from jaxbundle.report.layout import DIGITS_WITHOUT_SIGMA
from jaxbundle.report.page import Listing, Origin, Page, Section
from jaxbundle.report.page.markup import text

STYLE = "explore.css"
SCRIPTS = ("explore.js", "moves.js")
NOTHING: Mapping[str, Any] = {}


class Number(NamedTuple):
    """A number field; `low`, `high`: the ends of a slider beside it."""

    key: str
    label: str
    value: float
    unit: str = ""
    low: float | None = None
    high: float | None = None


class Choice(NamedTuple):
    """A selection list."""

    key: str
    label: str
    value: str
    words: Sequence[str]


class Switch(NamedTuple):
    """A check box."""

    key: str
    label: str
    value: bool


Control = Number | Choice | Switch


def draw_controls(controls: Iterable[Control], live: bool) -> str:
    """A column of controls; in a copy they only show their values."""
    dead = "" if live else " disabled"
    return f'<div class="controls">\n{"".join(_control(one, dead) for one in controls)}</div>\n'


def _control(one: Control, dead: str) -> str:
    key = f'data-key="{text(one.key)}"{dead}'
    if isinstance(one, Number):
        shown = f"{one.value:.{DIGITS_WITHOUT_SIGMA}g}"
        exact = f' data-exact="{one.value!r}"' if float(shown) != one.value else ""
        field = f'<input type="number" step="any" value="{shown}"{exact} {key}>'
        slider = (
            ""
            if one.low is None
            else (
                f'<input type="range" step="any" min="{one.low!r}" max="{one.high!r}" '
                f'value="{one.value!r}" data-slides="{text(one.key)}" '
                f'aria-label="{text(one.label)}"'
                f"{dead}>"
            )
        )
        unit = f"<span>{text(one.unit)}</span>"
        return f"<label><span>{text(one.label)}</span>{slider}{field}{unit}</label>\n"
    if isinstance(one, Switch):
        ticked = " checked" if one.value else ""
        box = f'<input type="checkbox"{ticked} {key}>'
        return f"<label><span></span>{box}{text(one.label)}</label>\n"
    options = "".join(
        f"<option{' selected' if word == one.value else ''}>{text(word)}</option>"
        for word in one.words
    )
    return f"<label><span>{text(one.label)}</span><select {key}>{options}</select></label>\n"


def draw_tools(live: bool, exports: Mapping[str, str] = NOTHING) -> str:
    """Buttons: save the page, download a file (by the label of the button); and the
    message area. A copy has none."""
    if not live:
        return '<p class="hint">A copy: the values are those it was saved with.</p>\n'
    buttons = "".join(
        f'<button type="button" data-export="{text(name)}">{text(words)}</button>\n'
        for words, name in exports.items()
    )
    return (
        f'<div class="tools">{buttons}<button type="button" id="explore-save">Save as page'
        '</button>\n</div>\n<p id="explore-said" class="said" aria-live="polite"></p>\n'
    )


def make_page(
    title: str,
    sections: Iterable[Section],
    origin: Origin,
    live: bool,
    kind: str,
    answer: Mapping[str, Any],
    settings: Sequence[tuple[str, object]] = (),
    tables: Mapping[str, Listing] = NOTHING,
    drawings: Mapping[str, Any] = NOTHING,
    given: Mapping[str, Any] = NOTHING,
) -> Page:
    """A page of the explorer with the answer to the values `given`."""
    state = {"live": live, "kind": kind, "given": dict(given), "answer": dict(answer)}
    state = without_nan(state)
    return Page(
        title,
        sections,
        origin,
        settings,
        tables,
        {**drawings, "explore": state},
        tuple(_read(name) for name in SCRIPTS),
        _read(STYLE),
        live,
    )


def place(id: str) -> str:
    """An empty element for a part of an answer."""
    return f'<div id="{id}" aria-live="polite"></div>\n'


def _read(name: str) -> str:
    return files("jaxbundle.explorer.page").joinpath(name).read_text(encoding="utf-8")
