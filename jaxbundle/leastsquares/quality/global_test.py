"""The global test of an adjustment: vᵀPv against the a priori σ that somebody stated.

    χ²(α/2; r) ≤ vᵀPv ≤ χ²(1 − α/2; r)            Mikhail and Ackermann (1976), section 11

It tests these σ, and needs them: σ that nobody gave are units of weight, of which σ0 is the
estimate, and σ estimated from the same residuals make σ0 = 1. Then nothing is tested. This is the
one place that decides it, for text, pages, JSON and every command.
"""

import math

from jaxbundle.choices import ESTIMATED, STATED
from jaxbundle.leastsquares.quality.distributions import chi2_quantile

LEVEL = 0.05
# A scale beyond this factor contradicts the a priori σ, if it is also significant. With σ that are
# too small by 1.2, a test at 0.1 % removes 0.6 % of good observations, 2Φ(−3.29/1.2): no result
# changes by it.
CONTRADICTING_RATIO = 1.2
SIGNIFICANCE = 0.001


def is_tested(redundancy: int, origin: str) -> bool:
    """Whether there are a priori σ to test; `origin` of the σ (`SIGMA_ORIGINS`)."""
    return redundancy > 0 and origin == STATED


def contradicts(scale: float, redundancy: float) -> bool:
    """Whether a scale of 1 can be excluded."""
    low, high = (
        math.sqrt(chi2_quantile(p, redundancy) / redundancy)
        for p in (SIGNIFICANCE / 2, 1 - SIGNIFICANCE / 2)
    )
    return not (min(1 / CONTRADICTING_RATIO, low) <= scale <= max(CONTRADICTING_RATIO, high))


def chi_squared_test(
    vtpv: float, redundancy: int, origin: str = STATED, significance: float = LEVEL
) -> dict:
    """χ² test of vᵀPv against a variance factor of 1, two-sided: `vtpv`; `low`, `high`, the
    interval; `passed`, None if nothing is tested; `sigma_origin`."""
    low = high = has_passed = None
    if redundancy > 0:
        ends = significance / 2, 1 - significance / 2
        low, high = (chi2_quantile(p, redundancy) for p in ends)
        if is_tested(redundancy, origin):
            has_passed = low <= vtpv <= high
    return {"vtpv": vtpv, "low": low, "high": high, "passed": has_passed, "sigma_origin": origin}


def describe_test(
    test: dict,
    unit: str,
    significance: float = LEVEL,
    shared_errors: bool = False,
    further_cause: str = "",
) -> str:
    """The conclusion of a `chi_squared_test`, or why there is none; `unit`: of weight, such as
    "1 mm"; `shared_errors`: whether an error model found errors that residuals hardly show;
    `further_cause` of large residuals, which is named first."""
    if test["low"] is None:
        return "no redundancy: σ0 and standard deviations cannot be estimated"
    if test["sigma_origin"] == ESTIMATED:
        return "not done: the σ were estimated from these residuals, so that σ0 is 1"
    if test["passed"] is None:
        return f"no a priori σ was given: {unit} is a unit of weight; σ0 a posteriori estimates it"
    vtpv, low, high = (f"{test[name]:.5g}" for name in ("vtpv", "low", "high"))
    beginning = (
        f"{'' if test['passed'] else 'not '}passed: vᵀPv {vtpv}, "
        f"{100 * (1 - significance):g} % interval {low} to {high}; "
    )
    if test["passed"] and shared_errors:
        return f"{beginning}it does not show errors that observations share"
    if test["passed"]:
        return f"{beginning}the a priori σ are confirmed"
    if test["vtpv"] < test["low"]:
        return f"{beginning}the observations are better than their a priori σ"
    causes = "the a priori σ are too small, blunders are left, or the cameras lack parameters"
    return f"{beginning}{f'{further_cause}, ' if further_cause else ''}{causes}"
