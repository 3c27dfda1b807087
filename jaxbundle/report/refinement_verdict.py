"""The verdict on a refinement of scanner images (`jaxbundle.refinement`)."""

import numpy as np

from jaxbundle.leastsquares.quality.distributions import (
    level_of_one,
    normal_quantile,
    tau_quantile,
)
from jaxbundle.leastsquares.quality.global_test import is_tested
from jaxbundle.network.columns import count
from jaxbundle.refinement import Refinement
from jaxbundle.refinement.check_points import RefinementCheckPoints
from jaxbundle.refinement.report import describe_global_test
from jaxbundle.report.head import count_removed
from jaxbundle.report.layout import significant
from jaxbundle.report.verdict import (
    BAD,
    GOOD,
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
    """The verdict on a `Refinement`, from its χ² test, terrain, redundancy numbers, blunders and
    check points."""
    used_points = [row for row in result.image_points() if not row["removed"]]
    w, r = (np.concatenate([row[name] for row in used_points]) for name in ("w", "r"))
    heights = [row["w"] for row in result.terrain_heights() if not row["removed"]]
    test = result.global_test()
    fit = judge_fit(
        test,
        describe_global_test(result),
        result.sigma0,
        bool(np.isfinite(result.prior_sigma).any()),
        result.redundancy,
    )
    blunders = _blunders(result, test, np.r_[w, heights], len(used_points) + len(heights))
    findings = [fit, *_terrain(result), describe_reliability(r, "coordinate"), blunders]
    if result.check is not None:
        findings.append(_check_points(result.check))
    return Verdict(*in_words(findings, len(result.warnings)), tuple(findings))


def _terrain(result: Refinement) -> list[Finding]:
    fit = result.terrain_fit
    if fit is None:
        return []
    times = f"{significant(fit.ratio)} times their σ"
    words = f"residuals of {count(fit.number, 'height')} are {times}, RMS {significant(fit.rms)} m"
    state = BAD if fit.is_contradicted else GOOD
    return [Finding("Terrain", state, words, f"heights of the terrain {times}")]


def _blunders(result: Refinement, test: dict, w: np.ndarray, number: int) -> Finding:
    """By Baarda's w with σ that were stated, else Pope's τ; `number` of image points and heights
    with these w."""
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
        number + number_removed,
    )


def _check_points(check: RefinementCheckPoints) -> Finding:
    is_known = (check.sigma > 0) & np.isfinite(check.difference)
    ratio = np.abs(check.difference[is_known]) / check.sigma[is_known]
    rms = ", ".join(significant(value) for value in check.rms)
    limit = normal_quantile(1 - level_of_one(LEVEL, len(ratio)) / 2)
    return judge_check_points(len(check.id), f"RMS of computed − given {rms} m", ratio, limit)
