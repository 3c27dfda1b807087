"""The verdict on a refinement of scanner images (`jaxbundle.refinement`)."""

import numpy as np

from jaxbundle.leastsquares.quality.distributions import (
    level_of_one,
    normal_quantile,
    tau_quantile,
)
from jaxbundle.network.columns import count
from jaxbundle.refinement import UNIT_OF_WEIGHT, Refinement
from jaxbundle.refinement.check_points import RefinementCheckPoints
from jaxbundle.report.layout import significant
from jaxbundle.report.verdict import (
    DOUBTFUL,
    GOOD,
    LEVEL,
    Finding,
    Verdict,
    describe_reliability,
    in_words,
    judge_fit,
)
from jaxbundle.statistics.global_test import describe_test, is_tested


def conclude_refinement(result: Refinement) -> Verdict:
    """The verdict on a `Refinement`, from its χ² test, redundancy numbers, blunders and check
    points."""
    used = [row for row in result.image_points() if not row["removed"]]
    w, r = (np.concatenate([row[name] for row in used]) for name in ("w", "r"))
    found = result.global_test()
    fit = judge_fit(
        found,
        describe_test(found, UNIT_OF_WEIGHT),
        result.sigma0,
        bool(np.isfinite(result.prior_sigma).any()),
        result.redundancy,
    )
    findings = [fit, describe_reliability(r, "coordinate"), _blunders(result, found, w)]
    if result.check is not None:
        findings.append(_check_points(result.check))
    return Verdict(*in_words(findings, len(result.warnings)), tuple(findings))


def _blunders(result: Refinement, found: dict, w: np.ndarray) -> Finding:
    """As many tests as coordinates: Baarda's w with σ that were stated, else Pope's τ."""
    stated = is_tested(result.redundancy, found["sigma_origin"])
    size = np.abs(w) if stated else np.abs(w) / result.sigma0
    largest = float(np.fmax.reduce(size, initial=np.nan))
    probability = 1 - level_of_one(LEVEL, len(w)) / 2
    limit = normal_quantile(probability) if stated else tau_quantile(probability, result.redundancy)
    words = (
        f"largest |{'w' if stated else 'τ'}| {significant(largest)}, critical value of "
        f"{count(len(w), 'coordinate')} at {100 * LEVEL:g} % {significant(limit)}; "
        f"{len(result.removed)} removed by data snooping"
    )
    likely = f"{count(int((size > limit).sum()), 'blunder')} likely"
    return Finding("Blunders", DOUBTFUL if largest > limit else GOOD, words, likely)


def _check_points(check: RefinementCheckPoints) -> Finding:
    ratio = np.abs(check.difference[check.sigma > 0]) / check.sigma[check.sigma > 0]
    largest = np.fmax.reduce(ratio, initial=np.nan)
    limit = normal_quantile(1 - level_of_one(LEVEL, len(ratio)) / 2)
    rms = ", ".join(significant(value) for value in check.rms)
    words = (
        f"{count(len(check.id), 'point')}; RMS of computed − given {rms} m; largest difference "
        f"{significant(largest)} times its σ, critical value {significant(limit)}"
    )
    brief = f"a check point {significant(largest)} σ off"
    return Finding("Check points", DOUBTFUL if largest > limit else GOOD, words, brief)
