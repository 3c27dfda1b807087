"""The global test of an adjustment."""

from jaxbundle.leastsquares.quality.distributions import chi2_quantile


def chi_squared_test(vtpv: float, redundancy: int, significance: float = 0.05) -> dict:
    """χ² test of vᵀPv against a variance factor of 1, two-sided: vtpv, low, high, passed."""
    low, high = (chi2_quantile(p, redundancy) for p in (significance / 2, 1 - significance / 2))
    return {"vtpv": vtpv, "low": low, "high": high, "passed": low <= vtpv <= high}
