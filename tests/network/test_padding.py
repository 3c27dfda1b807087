"""Round sizes: nearly equal networks share their programs; what is filled in changes nothing."""

import jax
import numpy as np
import pytest
from adjustment_checks import NETWORKS, synthetic

from jaxbundle.adjustment.problem import make_problem
from jaxbundle.network.padding import _rounded, filled, round_sizes, sizes_of
from jaxbundle.statistics import Inspection, cofactors, reliability, undamped_factor

OWN_CAMERAS = "own cameras of two models"


def test_round_sizes_are_few_and_never_much_larger():
    found = [_rounded(n) for n in range(1, 5000)]
    assert all(n <= size <= max(n + 1, 1.125 * n) for n, size in enumerate(found, 1))
    assert found == sorted(found) and len(set(found)) < 16 + 8 * 9
    assert _rounded(0) == 0


def shapes(tree):
    return jax.tree.map(lambda x: (x.shape, x.dtype), tree), jax.tree.structure(tree)


@pytest.mark.parametrize("name", ["free", "free with distances", OWN_CAMERAS])
def test_a_few_rays_less_are_the_same_program(name):
    network, _ = synthetic(**NETWORKS[name])
    rows = np.arange(len(network.observations) - 1)
    smaller = network.replace(observations=network.observations.take(rows))
    a, b = (make_problem(n) for n in (network, smaller))
    assert sizes_of(a.structure) != sizes_of(b.structure)
    if round_sizes([a.structure]) == round_sizes([b.structure]):
        tables = (filled(p.structure, p.data)[:2] for p in (a, b))
        assert shapes(next(tables)) == shapes(next(tables))


def test_networks_at_both_ends_of_a_bucket():
    network, _ = synthetic(**NETWORKS["free"])
    sizes = [
        round_sizes([make_problem(network.replace(
            observations=network.observations.take(np.arange(len(network.observations) - n))
        )).structure])
        for n in range(12)
    ]  # fmt: skip
    # Of twelve networks with one ray less each, most share their sizes with another.
    assert len(set(sizes)) <= 6


@pytest.mark.parametrize("name", ["free with distances", OWN_CAMERAS])
def test_what_is_filled_in_changes_no_statistic(name):
    problem = make_problem(synthetic(**NETWORKS[name])[0])
    s, values, data = problem.structure, problem.data.start, problem.data
    factor = undamped_factor(s, values, data)
    Q = cofactors(s, values, factor)
    plain = reliability(s, values, data, Q)
    found = Inspection(problem, values)
    assert found.structure.points > s.points and found.structure.rays >= s.rays
    for part in ("image", "camera", "point"):
        a, b = np.asarray(getattr(Q, part)), np.asarray(getattr(found.cofactors, part))
        np.testing.assert_allclose(b[: len(a)], a, rtol=1e-9, atol=1e-12 * np.abs(a).max(initial=1))
    for a, b in zip(jax.tree.leaves(plain), jax.tree.leaves(found.reliability)):
        np.testing.assert_allclose(b, a, rtol=1e-8, atol=1e-8)
    assert found.vtpv == pytest.approx(
        sum((np.asarray(v) ** 2).sum() for v in jax.tree.leaves(plain.residual)), rel=1e-12
    )
