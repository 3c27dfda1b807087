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


def with_value(control: Control, value: Any) -> Control:
    """A control with another value, which its slider reaches."""
    if isinstance(control, Number) and control.low is not None and control.high is not None:
        low, high = min(control.low, value), max(control.high, value)
        return control._replace(value=value, low=low, high=high)
    return control._replace(value=value)


def draw_controls(controls: Iterable[Control], live: bool) -> str:
    """A column of controls; in a copy they only show their values."""
    dead = "" if live else " disabled"
    inside = "".join(_control(control, dead) for control in controls)
    return f'<div class="controls">\n{inside}</div>\n'


def _control(control: Control, dead: str) -> str:
    key = f'data-key="{text(control.key)}"{dead}'
    if isinstance(control, Number):
        value_text = f"{control.value:.{DIGITS_WITHOUT_SIGMA}g}"
        exact = f' data-exact="{control.value!r}"' if float(value_text) != control.value else ""
        field = f'<input type="number" step="any" value="{value_text}"{exact} {key}>'
        slider = (
            ""
            if control.low is None
            else (
                f'<input type="range" step="any" min="{control.low!r}" max="{control.high!r}" '
                f'value="{control.value!r}" data-slides="{text(control.key)}" '
                f'aria-label="{text(control.label)}"'
                f"{dead}>"
            )
        )
        unit = f"<span>{text(control.unit)}</span>"
        return f"<label><span>{text(control.label)}</span>{slider}{field}{unit}</label>\n"
    if isinstance(control, Switch):
        ticked = " checked" if control.value else ""
        box = f'<input type="checkbox"{ticked} {key}>'
        return f"<label><span></span>{box}{text(control.label)}</label>\n"
    options = "".join(
        f"<option{' selected' if word == control.value else ''}>{text(word)}</option>"
        for word in control.words
    )
    return f"<label><span>{text(control.label)}</span><select {key}>{options}</select></label>\n"


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
        tuple(_read_resource(name) for name in SCRIPTS),
        _read_resource(STYLE),
        live,
    )


def place(id: str) -> str:
    """An empty element for a part of an answer."""
    return f'<div id="{id}" aria-live="polite"></div>\n'


def _read_resource(name: str) -> str:
    return files("jaxbundle.explorer.page").joinpath(name).read_text(encoding="utf-8")
