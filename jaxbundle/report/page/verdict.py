"""The verdict of the page: the conclusion of the tests, in words."""

from typing import NamedTuple

import numpy as np

from jaxbundle.network.columns import count
from jaxbundle.report.head import chi_squared, unit_weights
from jaxbundle.report.layout import clean, significant
from jaxbundle.report.observations import count_weak, critical_value

GOOD, DOUBTFUL, BAD = "met", "doubtful", "not met"


class Finding(NamedTuple):
    """The subject of one test, whether it is met, and its numbers in words."""

    about: str
    state: str
    words: str


def judge(adjustment) -> list[Finding]:
    """The findings of a solved adjustment."""
    return [
        _fit(adjustment), _control(adjustment), *_checks(adjustment), _reliability(adjustment),
        _blunders(adjustment),
    ]  # fmt: skip


def in_words(findings: list[Finding], warnings: int) -> tuple[str, str]:
    """The overall state, and a sentence for it."""
    failed = [f.about for f in findings if f.state == BAD]
    doubtful = [f.about for f in findings if f.state == DOUBTFUL]
    if failed:
        return BAD, f"The result does not meet its tests: {', '.join(failed)}."
    if doubtful or warnings:
        reasons = [*doubtful, *([count(warnings, "warning")] if warnings else [])]
        return DOUBTFUL, f"Use the result with care: {', '.join(reasons)}."
    return GOOD, "The result meets its tests."


def _fit(adjustment) -> Finding:
    words = chi_squared(adjustment)
    if adjustment.redundancy < 1 or unit_weights(adjustment) or adjustment.sigma_factors:
        return Finding("χ² test", DOUBTFUL, words)
    return judge_fit(adjustment.global_test(), words)


def judge_fit(found, words: str) -> Finding:
    """The finding of a χ² test: a result better than the a priori σ only concerns these σ and is
    harmless."""
    state = GOOD if found["passed"] else DOUBTFUL if found["vtpv"] < found["low"] else BAD
    return Finding("χ² test", state, words)


def _control(adjustment) -> Finding:
    points = adjustment.problem.network.points
    number = {role: int(points.has_role(role).sum()) for role in ("control", "fixed")}
    if not any(number.values()):
        words = "no control points: position, orientation and scale are those of the datum"
        return Finding("Control", DOUBTFUL, words)
    parts = [count(n, f"{role} point") for role, n in number.items() if n]
    tau = np.abs(adjustment.residuals["tau"][adjustment.residuals["kind"] == "control"])
    tau = tau[np.isfinite(tau)]
    limit = critical_value(adjustment)
    if not len(tau):
        return _held_control(adjustment, ", ".join(parts), limit)
    words = f"{', '.join(parts)}; largest |τ| {significant(tau.max())}, critical value at 0.1 % "
    state = GOOD if tau.max() <= limit else BAD
    return Finding("Control", state, words + significant(limit))


def _held_control(adjustment, parts: str, limit: float) -> Finding:
    """Points without σ are exact: their errors are in the image residuals, and three of them fit
    any network."""
    rows, points = adjustment.residuals, adjustment.problem.network.points
    ids = [id for id, fixed in zip(points.id, points.has_role("fixed")) if fixed]
    own = (rows["kind"] == "image") & np.isin(rows["point"], np.array(ids, object))
    tau = np.abs(rows["tau"][own])
    tau = tau[np.isfinite(tau)]
    words = f"{parts} held exactly, because no σ is stated; "
    if len(ids) <= 3 or not len(tau):
        return Finding("Control", DOUBTFUL, words + "nothing tests so few: state σ")
    words += (f"largest |τ| of their image points {significant(tau.max())}, critical value at "
              f"0.1 % {significant(limit)}")  # fmt: skip
    return Finding("Control", GOOD if tau.max() <= limit else DOUBTFUL, words)


def _checks(adjustment) -> list[Finding]:
    found = adjustment.check_points
    if found is None:
        return []
    unit = clean(adjustment.network.object_unit)
    rms = ", ".join(f"{axis} {significant(value)}" for axis, value in zip("XYZ", found.rms))
    table, limit = adjustment.table("checks"), critical_value(adjustment)
    d, s = (np.concatenate([table[f"{kind}{a}"] for a in "XYZ"]) for kind in "ds")
    known = (s > 0) & np.isfinite(d)
    largest = np.fmax.reduce(np.abs(d[known]) / s[known], initial=np.nan)
    words = (
        f"{count(len(found.id), 'point')}; RMS of intersected − given {rms} {unit}; largest "
        f"difference {significant(largest)} times the σ of its intersection"
    )
    return [Finding("Check points", DOUBTFUL if largest > limit else GOOD, words)]


def _reliability(adjustment) -> Finding:
    r = adjustment.residuals["r"]
    weak, loose = count_weak(r)
    words = (
        f"mean redundancy number {r.mean():.3f}; {weak} of {count(len(r), 'observation')} weakly "
        f"controlled (r < 0.1), {loose} uncontrolled"
    )
    return Finding("Reliability", DOUBTFUL if weak > 0.05 * len(r) else GOOD, words)


def _blunders(adjustment) -> Finding:
    tau = np.abs(adjustment.residuals["tau"])
    limit = critical_value(adjustment)
    over = int((tau > limit).sum())
    expected = 0.001 * len(tau)
    largest = significant(np.fmax.reduce(tau, initial=np.nan))
    words = (
        f"{over} of {count(len(tau), 'observation')} over the critical value {significant(limit)} "
        f"of |τ| at 0.1 % (by chance about {significant(expected, 2)}); largest {largest}"
    )
    removed, suspects = len(adjustment.removed), len(adjustment.suspects)
    if removed or suspects:
        words += f"; {removed} removed by data snooping, {suspects} suspected"
    # Three standard deviations of a count above its mean, and one blunder always.
    doubtful = over > expected + 3 * np.sqrt(expected) + 1
    return Finding("Blunders", DOUBTFUL if doubtful else GOOD, words)
