"""The page of a reconstruction: that of an adjusted part, and the use of the photographs."""

from collections.abc import Iterator

import numpy as np

from jaxbundle.network.columns import count
from jaxbundle.reconstruction.adjusting import LARGEST_MISFIT, WRONG_MISFIT
from jaxbundle.report.head import count_points
from jaxbundle.report.layout import clean, significant
from jaxbundle.report.page import (
    UNKNOWN,
    Addition,
    Finding,
    Listing,
    Origin,
    Section,
    compose,
)
from jaxbundle.report.page.columns import Column
from jaxbundle.report.page.markup import facts, grid, items
from jaxbundle.report.page.verdict import BAD, DOUBTFUL, GOOD

WITHOUT = ("χ² test",)
"""Findings of an adjustment that do not apply: σ are estimated from the residuals."""


def compose_part(found, part, origin: Origin = UNKNOWN) -> Iterator[str]:
    """The page of a part of a `Reconstruction`: HTML, in pieces."""
    return compose(part.adjustment, origin, also=_describe(found, part))


def _describe(found, part) -> Addition:
    sections = [_factors(part)] if part.factors else []
    if found.left_out:
        rows = grid(("photograph", "reason"), found.left_out.items(), "words")
        sections.append(Section("left-out", "Photographs left out", rows, "Left out"))
    overview = f"<h3>Reconstruction</h3>\n{facts(_counts(found, part))}"
    if found.notes:
        overview += items(found.notes)
    findings = (*([_fit(part)] if part.factors else []), _photographs(found, part))
    return Addition(
        "reconstruction", findings, overview=overview, warnings=found.warnings,
        sections=tuple(sections), tables={"pairs": _pairs(found)}, without=WITHOUT,
    )  # fmt: skip


def _fit(part) -> Finding:
    """The fit of the measurements, relative to their σ from matching."""
    words = ", ".join(f"{significant(f, 3)} ({kind})" for kind, f in part.factors.items())
    worst = part.misfit
    state = BAD if worst >= WRONG_MISFIT else DOUBTFUL if worst >= LARGEST_MISFIT else GOOD
    return Finding("Fit", state, f"residuals relative to their σ from matching: {words}; these "
                   "factors are in all σ of the result")  # fmt: skip


def _photographs(found, part) -> Finding:
    used, total = len(part.adjustment.network.images), len(found.photographs)
    words = f"{used} of {count(total, 'photograph')} in this part"
    if len(found.parts) > 1:
        words += f", {len(found.parts)} unconnected parts"
    if found.left_out:
        words += f", {len(found.left_out)} left out"
    whole = len(found.parts) == 1 and not found.left_out
    return Finding("Photographs", GOOD if whole else DOUBTFUL, words)


def _counts(found, part) -> list[tuple[str, str]]:
    """The parts, this one marked, and the pairs."""
    rows = []
    for one in found.parts:
        network = one.adjustment.network
        rows.append((
            clean(one.name) + (" (this page)" if one is part and len(found.parts) > 1 else ""),
            f"{count(len(network.images), 'photograph')}, "
            f"{count(count_points(one.adjustment), 'point')}, "
            f"σ0 {significant(one.adjustment.sigma0, 4)}",
        ))  # fmt: skip
    return [*rows, ("Verified pairs", str(len(found.pairs)))]


def _factors(part) -> Section:
    """Factors of σ of the kinds of measurements."""
    rows = [(kind, significant(factor, 4)) for kind, factor in part.factors.items()]
    note = ("kind of measurement", "factor of its a priori σ")
    return Section("factors", "Variance factors", grid(note, rows), "Variance factors")


def _pairs(found) -> Listing:
    one, other, matches, verified, kind = zip(*found.pairs) if found.pairs else ((),) * 5
    words = lambda values: np.array(values, dtype=object)
    return Listing("Pairs of photographs", {
        "image": Column(words(one), "image"), "other": Column(words(other), "other"),
        "matches": Column(np.array(matches, int), "matches"),
        "verified": Column(np.array(verified, int), "verified"),
        "kind": Column(words(kind), "kind"),
    }, "pairs.csv")  # fmt: skip
