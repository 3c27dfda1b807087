"""The verdict on a result: the conclusion of its tests, in words.

`met` and `noted` are what a good result has: nothing to test for want of a priori σ, a free
network, a few things left out. `doubtful` is a test that a good result fails only by chance at
0.1 %, or that could not be made although the result depends on it; `not met`: σ or control that
were stated are contradicted.
"""

from collections.abc import Callable, Container, Iterable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxbundle.leastsquares.quality.distributions import chi2_quantile, level_of_one
from jaxbundle.leastsquares.quality.global_test import contradicts
from jaxbundle.network.columns import count, list_some
from jaxbundle.network.tables import ESTIMATED
from jaxbundle.report.correlated import has_shared_errors, remarks
from jaxbundle.report.head import chi_squared, count_removed, open_datum
from jaxbundle.report.layout import clean, significant
from jaxbundle.report.observations import count_weak, critical_value
from jaxbundle.types import not_none

if TYPE_CHECKING:
    from jaxbundle.adjustment.result import Adjustment

GOOD, NOTED, DOUBTFUL, BAD = "met", "noted", "doubtful", "not met"
# Probability that a good result fails a test of the verdict: the level at which data snooping is
# done by convention (Baarda, 1968: α₀ = 0.1 %), so that the verdict and the removal of blunders
# agree.
LEVEL = 0.001
# A larger fraction of removed image points, beyond chance, is reported: with one of twenty removed,
# every fifth point of four rays has lost one, and the network is not the one that was planned.
LARGEST_FRACTION_REMOVED = 0.05


class Finding(NamedTuple):
    """The subject of one test, whether it is met, its numbers in words; `brief`: for the sentence
    of the verdict, otherwise the subject."""

    about: str
    state: str
    words: str
    brief: str = ""

    @property
    def lowers(self) -> bool:
        """Whether it lowers the verdict."""
        return self.state in (DOUBTFUL, BAD)


class Verdict(NamedTuple):
    """The overall state, a sentence, and the findings it follows from."""

    state: str
    words: str
    findings: tuple[Finding, ...]


def judge(adjustment: "Adjustment") -> list[Finding]:
    """The findings of a solved adjustment."""
    return [
        judge_fit(
            adjustment.global_test(),
            chi_squared(adjustment),
            adjustment.sigma0,
            adjustment.weights_matter,
            adjustment.redundancy,
        ),
        _control(adjustment),
        *_checks(adjustment),
        *_second_minima(adjustment),
        describe_reliability(adjustment.residuals["r"]),
        *_correlated(adjustment),
        _blunders(adjustment),
        *_left_out(adjustment),
    ]


def in_words(findings: list[Finding], warnings: int) -> tuple[str, str]:
    """The overall state, and a sentence for it."""
    brief = {
        state: [f.brief or f.about for f in findings if f.state == state]
        for state in (NOTED, DOUBTFUL, BAD)
    }
    doubtful = [*brief[DOUBTFUL], *([count(warnings, "warning")] if warnings else [])]
    if brief[BAD]:
        return BAD, f"The result does not meet its tests: {', '.join(brief[BAD])}."
    if doubtful:
        return DOUBTFUL, f"Use the result with care: {', '.join(doubtful)}."
    noted = f" (noted: {', '.join(brief[NOTED])})" if brief[NOTED] else ""
    return GOOD, f"The result meets its tests{noted}."


def conclude(
    adjustment: "Adjustment",
    findings: Iterable[Finding] = (),
    without: Container[str] = (),
    warnings: int = 0,
) -> Verdict:
    """The verdict on a solved adjustment, for a command with its own `findings` `without` some of
    those of the adjustment, and with further `warnings`."""
    # Those of the command first: they are about its own question.
    all_findings = [*findings, *(f for f in judge(adjustment) if f.about not in without)]
    return Verdict(
        *in_words(all_findings, warnings + len(adjustment.warnings)), tuple(all_findings)
    )


def judge_fit(
    test: dict, words: str, sigma0: float, weights_matter: bool, redundancy: float
) -> Finding:
    """The finding of a χ² test (`leastsquares.quality.global_test`). Observations better than
    their a priori σ, or than a unit of weight, only concern these σ, since those of the result are
    a posteriori; but where there are observations of other kinds, `weights_matter`."""
    fit = _judge_fit(test, words, sigma0)
    unsuited = weights_matter and fit.state == NOTED and contradicts(sigma0, int(redundancy))
    unsuited &= test["sigma_origin"] != ESTIMATED
    return fit._replace(state=DOUBTFUL) if unsuited else fit


def _judge_fit(test: dict, words: str, sigma0: float) -> Finding:
    about, has_passed = "χ² test", test["passed"]
    if test["low"] is None:
        return Finding(about, DOUBTFUL, words, "no redundancy, so that nothing is tested")
    if has_passed is None:
        no_test = "σ estimated" if test["sigma_origin"] == ESTIMATED else "no a priori σ"
        return Finding(about, NOTED, words, no_test)
    if has_passed:
        return Finding(about, GOOD, words)
    times = f"{significant(sigma0)} times their a priori σ"
    if test["vtpv"] < test["low"]:
        return Finding(about, NOTED, words, f"residuals only {times}")
    return Finding(about, BAD, words, f"residuals {times} (χ² test)")


def _tested(
    adjustment: "Adjustment", rows: Bool[np.ndarray, " n"] | slice
) -> tuple[float, float, str]:
    """The largest |τ| of some observations, NaN if none of them is controlled; its critical value
    for the largest of their number; both in words."""
    tau = np.abs(adjustment.residuals["tau"][rows])
    tau = tau[np.isfinite(tau)]
    largest = float(np.fmax.reduce(tau, initial=np.nan))
    limit = critical_value(adjustment, level=level_of_one(LEVEL, len(tau)))
    return largest, limit, _compare_largest(largest, limit, len(tau))


def _correlated(adjustment: "Adjustment") -> list[Finding]:
    """σ that shared errors make larger, and the comparison of halves of the network."""
    all_findings = []
    if adjustment.error_model is not None:
        ratio, sentences = adjustment.sigma_ratio, remarks(adjustment)
        words = f"σ under correlated errors are {significant(ratio, 2)} times the classical ones"
        words += f"; {'; '.join(sentences[:2])}" if sentences else ""
        state = NOTED if has_shared_errors(adjustment) else GOOD
        brief = f"σ {significant(ratio, 2)} times as large under correlated errors"
        all_findings.append(Finding("Correlated errors", state, words, brief))
    elif why := adjustment.why_no_error_model:
        brief = "no look at correlated errors"
        all_findings.append(Finding("Correlated errors", NOTED, f"not looked for: {why}", brief))
    return [*all_findings, *filter(None, [judge_replication(adjustment)])]


def judge_replication(adjustment: "Adjustment") -> Finding | None:
    """The finding about halves of the network; None if they were not adjusted."""
    halves = adjustment.replication
    if halves is None:
        return None
    if not halves.splits:
        return Finding("Replication", NOTED, halves.sentence, "halves not compared")
    # The root of d²/n: differences are compared with σ, not with variances.
    limit = np.sqrt(chi2_quantile(1 - LEVEL, halves.dof) / halves.dof)
    words = f"{halves.sentence}; by chance by more than {limit:.2f} in one of 1000 cases"
    state = DOUBTFUL if halves.probability < LEVEL else GOOD
    return Finding("Replication", state, words, f"halves by {halves.by} contradict each other")


def _second_minima(adjustment: "Adjustment") -> list[Finding]:
    """Solutions of which the observations choose none, and those left for a better one."""
    minima = adjustment.second_minima
    if not minima:
        return []
    unit, max_named = clean(adjustment.network.object_unit), 3
    sentences = [clean(second_minimum.in_words(unit)) for second_minimum in minima[:max_named]]
    if len(minima) > max_named:
        sentences.append(f"and {len(minima) - max_named} more: see second_minima in the JSON")
    about, words = "Second minimum", "; ".join(sentences)
    ambiguous = [second_minimum for second_minimum in minima if second_minimum.ambiguous]
    if ambiguous:
        brief = f"a second solution fits as well ({ambiguous[0].ambiguity})"
        return [Finding(about, DOUBTFUL, words, brief)]
    return [Finding(about, NOTED, words, f"a better second solution taken ({minima[0].ambiguity})")]


def _control(adjustment: "Adjustment") -> Finding:
    points = adjustment.problem.network.points
    number = {role: int(points.has_role(role).sum()) for role in ("control", "fixed")}
    if not any(number.values()):
        return _free_network(adjustment)
    parts = ", ".join(count(n, f"{role} point") for role, n in number.items() if n)
    largest, limit, words = _tested(adjustment, adjustment.residuals["kind"] == "control")
    if np.isnan(largest):
        return _held_control(adjustment, parts)
    words = f"{parts}; largest |τ| {words}{name_contradicted(adjustment)}"
    if largest > limit:
        return Finding("Control", BAD, words, "control contradicted")
    if vague := adjustment.weakness.georeference:
        brief = vague.partition(",")[0]
        return Finding("Control", NOTED, f"{words}; {vague}", brief)
    return Finding("Control", GOOD, words)


def name_contradicted(adjustment: "Adjustment") -> str:
    """Control points and image measurements of control that all other observations contradict, in
    words; empty without."""
    prediction = adjustment.control_prediction
    if prediction is None:
        return ""
    points = prediction.contradicted(level_of_one(LEVEL, len(prediction.id)))
    rays = prediction.wrong_measurements(level_of_one(LEVEL, len(prediction.measurement)))
    sentences = []
    if points:
        sentences.append(f"contradicted by all others: {list_some(points, 5, clean)}")
    if rays:
        names = (f"{point} in {image}" for image, point in rays)
        sentences.append(f"measurements contradicted by all others: {list_some(names, 5, clean)}")
    return "".join(f"; {words}" for words in sentences)


def _free_network(adjustment: "Adjustment") -> Finding:
    """Without control a network is complete: in its datum, which is named."""
    open_part = open_datum(adjustment)
    if not open_part:
        vague = adjustment.weakness.georeference
        words = "no control points; the datum is given by other observations (Datum)"
        brief = vague.partition(",")[0] or "no control points"
        return Finding("Control", NOTED, f"{words}; {vague}" if vague else words, brief)
    words = (
        f"no control points: a free network, {open_part} are those of the start values (datum "
        f"{adjustment.network.datum})"
    )
    return Finding("Control", NOTED, words, "free network")


def _held_control(adjustment: "Adjustment", parts: str) -> Finding:
    """Points without σ are exact: their errors are in the image residuals."""
    rows, points = adjustment.residuals, adjustment.problem.network.points
    ids = [id for id, fixed in zip(points.id, points.has_role("fixed")) if fixed]
    is_of_control = (rows["kind"] == "image") & np.isin(rows["point"], np.array(ids, object))
    largest, limit, test_in_words = _tested(adjustment, is_of_control)
    words, brief = f"{parts} held exactly, because no σ is stated; ", "control held exactly"
    # Of nine coordinates of three points a similarity takes seven. The two that are left test
    # lengths in their plane: an error at right angles to it turns the network, and does not show.
    if len(ids) <= 3 or np.isnan(largest):
        return Finding("Control", DOUBTFUL, words + "so few do not test each other: state σ", brief)
    state = GOOD if largest <= limit else DOUBTFUL
    return Finding(
        "Control", state, f"{words}largest |τ| of their image points {test_in_words}", brief
    )


def _checks(adjustment: "Adjustment") -> list[Finding]:
    check = adjustment.check_points
    if check is None:
        return []
    unit = clean(adjustment.network.object_unit)
    rms = ", ".join(f"{axis} {significant(value)}" for axis, value in zip("XYZ", check.rms))
    table = adjustment.table("checks")
    d, s = (np.concatenate([table[f"{kind}{a}"] for a in "XYZ"]) for kind in "ds")
    given_sigma = np.concatenate(not_none(adjustment.check)[0].sigma.T)
    s = np.hypot(
        s, np.where(np.isfinite(given_sigma), given_sigma, 0.0)
    )  # of the difference of both
    is_known = (s > 0) & np.isfinite(d)
    ratio = np.abs(d[is_known]) / s[is_known]
    limit = critical_value(adjustment, level=level_of_one(LEVEL, len(ratio)))
    rms = f"RMS of intersected − given {rms} {unit}"
    return [
        judge_check_points(
            len(check.id), rms, ratio, limit, ", of intersection and given coordinates"
        )
    ]


def judge_check_points(
    number: int, rms: str, ratio: Float[np.ndarray, " n"], limit: float, sigma_of: str = ""
) -> Finding:
    """The finding about check points: whether the largest difference is one of good points.

    **Arguments:** `rms` in words; `ratio` of every difference to its σ; `limit`: the critical value
    of the largest of them; `sigma_of`: of what, in words.
    """
    largest = float(np.fmax.reduce(ratio, initial=np.nan))
    if np.isnan(largest):
        words = f"{count(number, 'point')}; {rms}; none has a σ to judge its difference by"
        return Finding("Check points", DOUBTFUL, words, "check points not tested")
    words = (
        f"{count(number, 'point')}; {rms}; largest difference {significant(largest)} times its "
        f"σ{sigma_of}, critical value {significant(limit)}"
    )
    brief = f"a check point {significant(largest)} σ off"
    return Finding("Check points", DOUBTFUL if largest > limit else GOOD, words, brief)


def describe_reliability(
    r: Float[np.ndarray, " n"], noun: str = "observation", max_weak_share: float = 0.05
) -> Finding:
    """The finding about redundancy numbers: blunders in weakly controlled observations hardly show,
    which a design can change and an adjustment cannot.

    **Arguments:** `max_weak_share` of weakly controlled observations that is not noted: a few stand
    at the edge of every network.
    """
    weak, loose = count_weak(r)
    words = (
        f"mean redundancy number {r.mean():.3f}; {weak} of {count(len(r), noun)} weakly "
        f"controlled (r < 0.1), {loose} uncontrolled"
    )
    brief = f"{weak} of {count(len(r), noun)} weakly controlled"
    state = NOTED if weak > max_weak_share * len(r) else GOOD
    return Finding("Reliability", state, words, brief)


def _blunders(adjustment: "Adjustment") -> Finding:
    number_removed = count_removed(adjustment.removed)
    return judge_blunders(
        np.abs(adjustment.residuals["tau"]),
        lambda level: critical_value(adjustment, level=level),
        "|τ|",
        number_removed,
        adjustment.counts.observations / 2 + number_removed,
        len(adjustment.suspects),
    )


def judge_blunders(
    size: Float[np.ndarray, " n"],
    critical: Callable[[float], float],
    symbol: str,
    number_removed: int,
    rays: float,
    suspects: int = 0,
) -> Finding:
    """The finding about blunders: in the largest test, the share that was removed, and more large
    residuals than chance explains.

    **Arguments:** `size` of the test values, NaN where uncontrolled; `critical` value at a level;
    `number_removed` and suspected ones of as many `rays`.
    """
    tested = size[np.isfinite(size)]
    largest = float(np.fmax.reduce(tested, initial=np.nan))
    single, limit = critical(LEVEL), critical(level_of_one(LEVEL, len(tested)))
    number_over, expected = int((size > single).sum()), LEVEL * len(size)
    words = (
        f"{number_over} of {count(len(size), 'observation')} over the critical value "
        f"{significant(single)} of {symbol} at {100 * LEVEL:g} % (by chance about "
        f"{significant(expected, 2)}); largest {_compare_largest(largest, limit, len(tested))}"
    )
    if number_removed or suspects:
        words += f"; {number_removed} removed by data snooping, {suspects} suspected"
    if largest > limit:
        number_left = int((size > limit).sum())
        return Finding("Blunders", DOUBTFUL, words, f"{count(number_left, 'blunder')} likely")
    if number_removed > most_removed(rays):
        brief = f"{number_removed} of {rays:.0f} image points removed as blunders"
        return Finding("Blunders", DOUBTFUL, words, brief)
    # More than chance explains, but none that stands out: σ of some are too small.
    has_many = number_over > explained_by_chance(len(size))
    brief = []
    if has_many:
        excess = f"{count(number_over, 'large residual')}, {significant(expected, 2)} expected"
        brief.append(f"{excess} by chance")
    if number_removed:
        brief.append(f"{count(number_removed, 'observation')} removed by data snooping")
    return Finding("Blunders", NOTED if brief else GOOD, words, ", ".join(brief))


def _compare_largest(largest: float, limit: float, number: int) -> str:
    """The largest test value of a number of observations and its critical value, in words."""
    return (
        f"{significant(largest)}, critical value of the largest of {number} at "
        f"{100 * LEVEL:g} % {significant(limit)}"
    )


def explained_by_chance(number: float, level: float = LEVEL) -> float:
    """The largest number of rejections among good observations that chance explains: their mean,
    three standard deviations, and one always."""
    # The number is binomial, its variance n·p·(1 − p) ≈ n·p.
    expected = level * number
    return expected + 3 * np.sqrt(expected) + 1


def most_removed(number: float, level: float = LEVEL) -> float:
    """The largest number of blunders among `number` observations of a good result, whether tests at
    a `level` removed them or they were left out at the start."""
    return max(LARGEST_FRACTION_REMOVED * number, explained_by_chance(number, level))


def _left_out(adjustment: "Adjustment") -> list[Finding]:
    """What was left out although it was measured often enough: a note if data snooping might have
    removed as many, or if rays do not determine so few points; photographs never are."""
    network = adjustment.problem.network
    notes = [note for note in network.left_out if note.names]
    if not notes:
        return []
    number: dict[str, int] = {}
    for note in notes:
        if note.measured:
            noun = note.thing.removeprefix("tie ")
            number[noun] = number.get(noun, 0) + len(note.names)
    number_kept = {
        "image": len(network.images),
        "point": len(network.points),
        "image point": len(network.observations),
    }
    share = {
        noun: f"{n} of {count(n + number_kept.get(noun, 0), noun)} left out"
        for noun, n in number.items()
    }
    doubtful = [
        noun
        for noun, n in number.items()
        if noun == "image" or n > most_removed(n + number_kept.get(noun, 0))
    ]
    number_few = sum(len(note.names) for note in notes if not note.measured)
    words = [*share.values(), *([f"{number_few} without enough rays"] if number_few else [])]
    brief = ", ".join(share[noun] for noun in doubtful or number) or "points without enough rays"
    return [Finding("Left out", DOUBTFUL if doubtful else NOTED, "; ".join(words), brief)]
