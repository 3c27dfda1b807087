"""The population of a batch: distributions, outlying cameras, what parameters correlate with."""

import json

import numpy as np
import pytest
from scipy import stats

from jaxbundle.batches.population import Population, read_against
from jaxbundle.errors import InputError

CAMERAS = 200


def rows():
    """fx grows with the serial number by 0.02, k1 is correlated with nothing."""
    rng = np.random.default_rng(3)
    found = []
    for i in range(CAMERAS):
        values = {"fx": 1000 + 0.02 * i + rng.normal(), "k1": -0.1 + 0.01 * rng.normal()}
        found.append({
            "key": f"c.npz#{i}", "status": "converged", "rms": 0.1 + 0.01 * rng.random(),
            "sigma0": 0.1, "redundancy": 100, "iterations": 5, "views": 20,
            "parameters": {name: {"value": v, "sigma": 0.2} for name, v in values.items()},
        })  # fmt: skip
    found[5]["parameters"]["k1"]["value"] = 0.4
    found[6]["rms"] = 0.4
    found[7] = {"key": "c.npz#7", "status": "singular", "remark": "no views"}
    return found


@pytest.fixture(scope="module")
def population():
    return Population(rows())


SERIAL = {"id": [str(i) for i in range(CAMERAS)], "serial": list(range(CAMERAS)),
          "made": [f"2026-01-{1 + i % 28:02d}" for i in range(CAMERAS)]}  # fmt: skip


def test_correlations_are_spearmans(population):
    against = read_against(SERIAL, population.keys, "serials")
    assert against["made"][0] == 20454 and np.isfinite(against["made"]).all()
    told = population.correlations(against)
    first, fit = told[0], population.fit
    assert (first.column, first.parameter, first.cameras) == ("serial", "fx", CAMERAS - 1)
    r, p = stats.spearmanr(against["serial"][fit], population.values["fx"][fit])
    assert first.rank_correlation == pytest.approx(r) and first.probability == pytest.approx(p)
    assert first.change == pytest.approx(2, abs=0.6)
    summary = population.summary(against)
    marked = [(c["column"], c["parameter"]) for c in summary["correlations"] if c["significant"]]
    assert marked == [("serial", "fx")]
    ties = next(one for one in told if (one.column, one.parameter) == ("made", "k1"))
    known = stats.spearmanr(against["made"][fit], population.values["k1"][fit])
    assert ties.rank_correlation == pytest.approx(known.statistic)


def test_the_summary_has_distributions_and_what_is_outlying(population):
    summary = population.summary()
    json.dumps(summary)
    assert summary["status"] == {"converged": CAMERAS - 1, "singular": 1}
    assert [one["key"] for one in summary["outlying"]] == ["c.npz#7", "c.npz#5", "c.npz#6"]
    assert summary["outlying"][0]["why"] == "singular; no views"
    assert "k1" in summary["outlying"][1]["why"] and "RMS" in summary["outlying"][2]["why"]
    fx, k1 = summary["parameters"]["fx"], summary["parameters"]["k1"]
    assert sum(fx["histogram"]["numbers"]) == CAMERAS - 1 == fx["cameras"]
    assert k1["histogram"]["edges"][-1] == np.inf and k1["histogram"]["numbers"][-1] >= 1
    values = population.values["fx"][population.fit]
    assert fx["median"] == pytest.approx(np.median(values))
    assert fx["robust_sigma"] == pytest.approx(stats.median_abs_deviation(values) * 1.4826)
    assert summary["rms"]["cameras"] == CAMERAS - 1


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ({"id": ["1", "1"], "serial": [1, 2]}, "twice"),
        ({"id": ["1"], "serial": ["soon"]}, "a number or a date"),
        ({"id": ["x"], "serial": [1]}, "none of its ids"),
        ({"serial": [1]}, "a column id"),
        ({"id": ["1"]}, "and others"),
    ],
)
def test_tables_that_cannot_be_used_are_refused(population, table, said):
    with pytest.raises(InputError, match=said):
        read_against(table, population.keys, "table")


def test_a_camera_known_worse_than_others_may_be_farther_off():
    """Eight robust σ of the population off: outlying with the usual σ, not if its own σ is four of
    them."""
    given = rows()
    spread = Population(given).spread(Population(given).values["k1"])[1]
    for row in given:
        if "parameters" in row:
            row["parameters"]["k1"]["sigma"] = 0.1 * spread
    given[20]["parameters"]["k1"]["value"] = -0.1 + 8 * spread
    given[21]["parameters"]["k1"] = {"value": -0.1 + 8 * spread, "sigma": 4 * spread}
    found = Population(given)
    odd = {found.keys[i]: why for i, why in found.outlying()}
    assert "k1" in odd["c.npz#20"] and "c.npz#21" not in odd
    assert found.apart["k1"][20] == pytest.approx(8, rel=0.1)
    assert found.apart["k1"][21] == pytest.approx(8 / np.sqrt(17), rel=0.1)
