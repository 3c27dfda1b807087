"""The page of a reconstruction: that of an adjusted part, and the use of the photographs."""

from collections.abc import Iterator

import numpy as np

from jaxbundle.network.columns import count, list_some
from jaxbundle.reconstruction.adjusting import DOUBTFUL_MISFIT, WRONG_MISFIT
from jaxbundle.reconstruction.control_table import HEADER
from jaxbundle.reconstruction.result import ReconstructedPart, Reconstruction
from jaxbundle.report.head import count_points
from jaxbundle.report.layout import clean, heading, significant, table
from jaxbundle.report.layout import facts as text_facts
from jaxbundle.report.layout import paragraph as text_paragraph
from jaxbundle.report.page import (
    UNKNOWN,
    Addition,
    Finding,
    Listing,
    Origin,
    Section,
    compose,
)
from jaxbundle.report.page.adjustment import NO_ADDITION
from jaxbundle.report.page.columns import Column
from jaxbundle.report.page.markup import facts, grid, items
from jaxbundle.report.verdict import BAD, DOUBTFUL, GOOD, NOTED, Verdict, conclude

# Findings of an adjustment that do not apply: σ are estimated from the residuals.
INAPPLICABLE = ("χ² test",)
# The finding of an adjustment in place of which that of the control table stands.
CONTROL = ("Control",)


def compose_part(
    reconstruction: Reconstruction,
    part: ReconstructedPart,
    origin: Origin = UNKNOWN,
    also: Addition = NO_ADDITION,
) -> Iterator[str]:
    """The page of a part of a `Reconstruction`: HTML, in pieces; `also`: further findings and
    sections."""
    return compose(part.adjustment, origin, also=_describe(reconstruction, part).followed_by(also))


def conclude_part(reconstruction: Reconstruction, part: ReconstructedPart) -> Verdict:
    """The verdict on a part, with the use of the photographs."""
    return conclude(part.adjustment, *_findings(reconstruction, part), len(reconstruction.warnings))


def _findings(
    reconstruction: Reconstruction, part: ReconstructedPart
) -> tuple[list[Finding], tuple[str, ...]]:
    """The findings of a part, and those of its adjustment that they replace."""
    fit = [_judge_fit(part)] if part.factors else []
    controlled = part.control is not None or part.no_control
    return (
        [*fit, _judge_photographs(reconstruction, part), *_judge_control(part)],
        (*INAPPLICABLE, *CONTROL) if controlled else INAPPLICABLE,
    )


def describe_part(reconstruction: Reconstruction, part: ReconstructedPart) -> str:
    """What a surveyor asks of a part, as text: the block, control and check points."""
    lines = heading(_name(reconstruction, part))[1:]  # without the empty line before it
    lines += text_facts(part.block.facts())
    if part.no_control:
        lines += ["", *text_paragraph(f"Control is not used: {part.no_control}")]
    if part.control is not None:
        unit = part.control.unit
        lines += heading(f"Control and check points: adjusted − given, in {unit}")
        # The reasons of verdicts are in the notes.
        rows = [(*row[:-1], row[-1].partition(":")[0]) for row in part.control.rows()]
        lines += table(HEADER, rows, "lrrrrrrrrl")
        lines += ["", *text_paragraph(f"{part.control.sigma}.")]
        lines += [line for note in part.control.notes for line in text_paragraph(f"- {note}", 0, 2)]
    return "\n".join([*lines, "", ""])


def _describe(reconstruction: Reconstruction, part: ReconstructedPart) -> Addition:
    sections = [*_list_control(part), *_list_positions(part)]
    sections += [_list_factors(part)] if part.factors else []
    if reconstruction.left_out:
        rows = grid(("photograph", "reason"), reconstruction.left_out.items(), "words")
        sections.append(Section("left-out", "Photographs left out", rows, "Left out"))
    overview = f"<h3>Block {clean(reconstruction.name)}</h3>\n{facts(part.block.facts())}"
    overview += f"<h3>Reconstruction</h3>\n{facts(_count_parts(reconstruction, part))}"
    if reconstruction.notes:
        overview += items(reconstruction.notes)
    findings, without = _findings(reconstruction, part)
    return Addition(
        "reconstruction",
        tuple(findings),
        overview=overview,
        warnings=reconstruction.warnings,
        sections=tuple(sections),
        tables={"pairs": _list_pairs(reconstruction)},
        name=_name(reconstruction, part),
        without=without,
    )


def _name(reconstruction: Reconstruction, part: ReconstructedPart) -> str:
    """The name of the reconstruction, with that of the part if there are several."""
    return (
        reconstruction.name
        if reconstruction.name and len(reconstruction.parts) == 1
        else ", ".join(filter(None, (reconstruction.name, part.name)))
    )


def _judge_fit(part: ReconstructedPart) -> Finding:
    """The fit of the measurements, relative to their σ from matching."""
    words = ", ".join(f"{significant(f, 3)} ({kind})" for kind, f in part.factors.items())
    worst = part.misfit
    state = BAD if worst >= WRONG_MISFIT else DOUBTFUL if worst >= DOUBTFUL_MISFIT else NOTED
    # A fit to σ estimated from the same residuals is no test: noted, never met.
    times = f"residuals {significant(worst)} times their σ from matching"
    return Finding(
        "Fit",
        state,
        f"residuals relative to their σ from matching: {words}; these factors are in all σ of the "
        "result, so that the residuals cannot contradict them",
        "σ of image points estimated from their residuals" if state == NOTED else times,
    )


def _judge_photographs(reconstruction: Reconstruction, part: ReconstructedPart) -> Finding:
    number_used, total = len(part.adjustment.network.images), len(reconstruction.photographs)
    words = f"{number_used} of {count(total, 'photograph')} in this part"
    if len(reconstruction.parts) > 1:
        words += f", {len(reconstruction.parts)} unconnected parts"
    if reconstruction.left_out:
        words += f", {len(reconstruction.left_out)} left out"
    # A verdict is about the photographs that somebody took, not about those that were used.
    complete = len(reconstruction.parts) == 1 and not reconstruction.left_out
    brief = f"{total - number_used} of {count(total, 'photograph')} not in this result"
    return Finding("Photographs", GOOD if complete else DOUBTFUL, words, brief)


def _judge_control(part: ReconstructedPart) -> list[Finding]:
    """Control and check points in one line each."""
    if part.no_control:
        return [Finding("Control", BAD, f"not used: {part.no_control}")]
    if (control := part.control) is None:
        return []
    given_points = [p for p in control.points if p.role != "check"]
    checks = [p for p in control.points if p.role == "check"]
    rms = lambda role: " ".join(
        f"{axis} {significant(x)}" for axis, x in zip("XYZ", control.rms(role)) if np.isfinite(x)
    )
    used_points, left_out = [p for p in given_points if p.used], part.control.left_out
    words = (
        f"{len(used_points)} of {count(len(given_points), 'control point')} used, RMS "
        f"{rms('control')} {part.control.unit}; {part.control.sigma}"
    )
    if left_out:
        words += f"; left out: {', '.join(left_out)}"
    wrong = [f"{clean(p.id)} in {clean(m)}" for p in control.points for m in p.wrong_measurements]
    if wrong:
        words += f"; wrong measurements: {', '.join(wrong)}"
    removed = [f"{axis} of {clean(p.id)}" for p in used_points for axis in p.removed_axes]
    if removed:
        words += f"; coordinates that data snooping removed: {', '.join(removed)}"
    is_held = any(p.verdict.startswith("held exactly") for p in used_points)
    doubts = [f"control left out: {list_some(left_out, 3, clean)}"] if left_out else []
    if wrong:
        name = "wrong measurement" if len(wrong) == 1 else "wrong measurements"
        doubts.append(f"{name}: {list_some(wrong, 3, str)}")
    if removed:
        doubts.append(f"control removed by data snooping: {list_some(removed, 3, str)}")
    doubts += ["control held exactly"] if is_held else []
    state = DOUBTFUL if doubts else GOOD
    findings = [Finding("Control", state, words, ", ".join(doubts))]
    if checks:
        compared = [p for p in checks if np.isfinite(p.residual).any()]
        if len(compared) < len(checks):
            words = f"{len(compared)} of {count(len(checks), 'check point')} compared"
            findings.append(Finding("Check points compared", DOUBTFUL, words, words))
    return findings


def _list_control(part: ReconstructedPart) -> list[Section]:
    """Control and check points."""
    if part.control is None:
        return []
    points = grid(HEADER, part.control.rows(), "remarks")
    notes = items([part.control.sigma, *part.control.notes])
    title = f"Control and check points: adjusted − given, in {clean(part.control.unit)}"
    return [Section("control", title, points + notes, "Control")]


def _list_positions(part: ReconstructedPart) -> list[Section]:
    """Camera positions against the given ones."""
    positions = part.block.positions
    if positions is None:
        return []
    rows = [(id, *(significant(x) for x in d)) for id, d in positions.difference.items()]
    rows.append(("RMS", *(significant(x) for x in positions.rms)))
    title = f"Camera positions: adjusted − given, in {clean(part.block.unit)}"
    return [Section("positions", title, grid(("photograph", "dX", "dY", "dZ"), rows), "Positions")]


def _count_parts(reconstruction: Reconstruction, part: ReconstructedPart) -> list[tuple[str, str]]:
    """The parts, this one marked, and the pairs."""
    rows = []
    for listed_part in reconstruction.parts:
        network = listed_part.adjustment.network
        rows.append(
            (
                clean(listed_part.name)
                + (" (this page)" if listed_part is part and len(reconstruction.parts) > 1 else ""),
                f"{count(len(network.images), 'photograph')}, "
                f"{count(count_points(listed_part.adjustment), 'point')}, "
                f"σ0 {significant(listed_part.adjustment.sigma0, 4)}",
            )
        )
    return [*rows, ("Verified pairs", str(len(reconstruction.pairs)))]


def _list_factors(part: ReconstructedPart) -> Section:
    """Factors of σ of the kinds of measurements."""
    rows = [(kind, significant(factor, 4)) for kind, factor in part.factors.items()]
    note = ("kind of measurement", "factor of its a priori σ")
    return Section("factors", "Variance factors", grid(note, rows), "Variance factors")


def _list_pairs(reconstruction: Reconstruction) -> Listing:
    image, partner, matches, verified, kind = (
        zip(*reconstruction.pairs) if reconstruction.pairs else ((),) * 5
    )
    words = lambda values: np.array(values, dtype=object)
    return Listing(
        "Pairs of photographs",
        {
            "image": Column(words(image), "image"),
            "other": Column(words(partner), "other"),
            "matches": Column(np.array(matches, int), "matches"),
            "verified": Column(np.array(verified, int), "verified"),
            "kind": Column(words(kind), "kind"),
        },
        "pairs.csv",
    )
