"""The verdict on a refinement of scanner images (`jaxbundle.refinement`)."""

import numpy as np

from jaxbundle.leastsquares.quality.distributions import (
    level_of_one,
    normal_quantile,
    tau_quantile,
)
from jaxbundle.leastsquares.quality.global_test import describe_test, is_tested
from jaxbundle.refinement import UNIT_OF_WEIGHT, Refinement
from jaxbundle.refinement.check_points import RefinementCheckPoints
from jaxbundle.report.head import count_removed
from jaxbundle.report.layout import significant
from jaxbundle.report.verdict import (
    LEVEL,
    Finding,
    Verdict,
    describe_reliability,
    in_words,
    judge_blunders,
    judge_check_points,
    judge_fit,
)


def conclude_refinement(result: Refinement) -> Verdict:
    """The verdict on a `Refinement`, from its χ² test, redundancy numbers, blunders and check
    points."""
    used_points = [row for row in result.image_points() if not row["removed"]]
    w, r = (np.concatenate([row[name] for row in used_points]) for name in ("w", "r"))
    test = result.global_test()
    fit = judge_fit(
        test,
        describe_test(test, UNIT_OF_WEIGHT),
        result.sigma0,
        bool(np.isfinite(result.prior_sigma).any()),
        result.redundancy,
    )
    findings = [fit, describe_reliability(r, "coordinate"), _blunders(result, test, w)]
    if result.check is not None:
        findings.append(_check_points(result.check))
    return Verdict(*in_words(findings, len(result.warnings)), tuple(findings))


def _blunders(result: Refinement, test: dict, w: np.ndarray) -> Finding:
    """By Baarda's w with σ that were stated, else Pope's τ."""
    is_stated = is_tested(result.redundancy, test["sigma_origin"])
    number_removed = count_removed(result.removed)
    return judge_blunders(
        np.abs(w) if is_stated else np.abs(w) / result.sigma0,
        lambda level: (
            normal_quantile(1 - level / 2)
            if is_stated
            else tau_quantile(1 - level / 2, result.redundancy)
        ),
        "|w|" if is_stated else "|τ|",
        number_removed,
        len(w) / 2 + number_removed,
    )


def _check_points(check: RefinementCheckPoints) -> Finding:
    is_known = (check.sigma > 0) & np.isfinite(check.difference)
    ratio = np.abs(check.difference[is_known]) / check.sigma[is_known]
    rms = ", ".join(significant(value) for value in check.rms)
    limit = normal_quantile(1 - level_of_one(LEVEL, len(ratio)) / 2)
    return judge_check_points(len(check.id), f"RMS of computed − given {rms} m", ratio, limit)
