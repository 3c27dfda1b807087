"""Round sizes: nearly equal networks share their programs. (That what is filled in changes nothing
is seen where networks are compared with dense algebra: their arrays are filled.)"""

import jax
import numpy as np
from adjustment_checks import NETWORKS, synthetic

from jaxbundle.adjustment.problem import make_problem
from jaxbundle.leastsquares.indexing.indices import round_up
from jaxbundle.leastsquares.problem import pad_data


def test_round_sizes_are_few_and_never_much_larger():
    found = [round_up(n) for n in range(1, 5000)]
    assert all(n <= size <= max(n + 1, 1.125 * n) for n, size in enumerate(found, 1))
    assert found == sorted(found) and len(set(found)) < 16 + 8 * 9
    assert round_up(0) == 0


def test_networks_with_a_few_rays_less_share_their_programs():
    """Of twelve networks with one ray less each, most share all shapes with another."""
    network, _ = synthetic(**NETWORKS["free"])
    seen = set()
    for less in range(12):
        rows = np.arange(len(network.observations) - less)
        fewer = network.replace(observations=network.observations.take(rows))
        system = make_problem(fewer)
        given = system.plan, pad_data(system, system.data)
        shapes = tuple((x.shape, x.dtype) for x in jax.tree.leaves(given))
        seen.add((shapes, jax.tree.structure(given), system.declared))
    assert len(seen) <= 6
