"""The first section of every page of a result: the verdict."""

from collections.abc import Iterable, Sequence

from jaxbundle.report import head
from jaxbundle.report.page.document import Section
from jaxbundle.report.page.markup import facts, grid, items, paragraph
from jaxbundle.report.verdict import Finding, in_words


def give_verdict(findings: Sequence[Finding], warnings: Sequence[str], *parts: str) -> Section:
    """The verdict, the warnings, the findings, and further summary content."""
    state, words = in_words(list(findings), len(warnings))
    rows = [(f.about, f.state, f.words) for f in findings]
    content = [
        paragraph(words, f"verdict {state.replace(' ', '-')}"),
        list_messages("Warnings", warnings),
        "<h3>Tests</h3>\n",
        grid(("test", "", "what was found"), rows, "words"),
        *parts,
    ]
    return Section("overview", "Verdict", "".join(content))


def explain_failure(
    rows: Iterable[tuple[str, str]], warnings: Sequence[str], *parts: str
) -> Section:
    """The verdict without a result, and the remedy."""
    content = [
        paragraph(head.NO_RESULT, "verdict not-met"),
        list_messages("Warnings", warnings),
        facts(rows),
    ]
    return Section("overview", "Verdict", "".join([*content, *parts]))


def list_messages(title: str, lines: Sequence[str]) -> str:
    """Messages under a title; nothing without any."""
    return f"<h3>{title}</h3>\n{items(lines)}" if lines else ""
