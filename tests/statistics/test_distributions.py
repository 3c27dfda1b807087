"""Quantiles against scipy, and Pope's τ against the distribution it is defined by."""

import numpy as np
import pytest
from scipy import integrate, special, stats

from jaxbundle.leastsquares.quality.distributions import (
    chi2_quantile,
    normal_quantile,
    t_quantile,
    tau_quantile,
)

PROBABILITIES = (0.5, 0.8, 0.95, 0.975, 0.999, 0.9995)


def test_quantiles_of_tables():
    # As printed in every textbook's tables.
    assert normal_quantile(0.975) == pytest.approx(1.959964, abs=1e-6)
    assert chi2_quantile(0.95, 10) == pytest.approx(18.307, abs=1e-3)
    assert chi2_quantile(0.025, 29) == pytest.approx(16.047, abs=1e-3)
    assert t_quantile(0.975, 7) == pytest.approx(2.365, abs=1e-3)
    assert t_quantile(0.9995, 29) == pytest.approx(3.659, abs=1e-3)


@pytest.mark.parametrize("degrees", (1, 2, 7, 500, 18804))
def test_probability_below_a_quantile_by_integration(degrees):
    for p in PROBABILITIES:
        x, t = chi2_quantile(p, degrees), t_quantile(p, degrees)
        assert stats.chi2.cdf(x, degrees) == pytest.approx(p, abs=1e-11)
        assert stats.t.cdf(t, degrees) == pytest.approx(p, abs=1e-11)
        assert stats.norm.cdf(normal_quantile(p)) == pytest.approx(p, abs=1e-12)


@pytest.mark.parametrize("f", (3, 5, 30))
def test_tau_follows_from_its_density(f):
    # Pope (1976): τ = √f·cos of the angle of a random direction with an axis in f dimensions,
    # density proportional to (1 − τ²/f)^((f − 3)/2) on |τ| < √f.
    density = lambda tau: (1 - tau**2 / f) ** ((f - 3) / 2)
    total = np.sqrt(f) * special.beta(0.5, (f - 1) / 2)
    for p in (0.9, 0.975, 0.9995):
        critical = tau_quantile(p, f)
        above, _ = integrate.quad(density, critical, np.sqrt(f), epsabs=1e-13)
        assert above / total == pytest.approx(1 - p, rel=1e-6)


def test_tau_of_random_residuals():
    # v standardised by its own estimate of σ: τ = v_i/(σ̂·√r_i), in any linear model.
    rng = np.random.default_rng(0)
    A = rng.normal(size=(9, 4))
    R = np.eye(9) - A @ np.linalg.pinv(A)
    v = rng.normal(size=(40000, 9)) @ R
    tau = v[:, 0] / np.sqrt(R[0, 0] * (v**2).sum(1) / 5)
    share = (np.abs(tau) > tau_quantile(0.975, 5)).mean()
    assert abs(share - 0.05) < 4 * np.sqrt(0.05 * 0.95 / 40000)


def test_tau_of_large_redundancy_is_normal_and_of_one_never_rejects():
    assert tau_quantile(0.975, 1e6) == pytest.approx(stats.norm.ppf(0.975), rel=1e-5)
    assert tau_quantile(0.975, 1) == np.inf
