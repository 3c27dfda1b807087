"""Zero order: the datum."""

import numpy as np

from jaxbundle.errors import InputError
from jaxbundle.network.tables import Network
from jaxbundle.network_design.aims import Aim, aim_of
from jaxbundle.network_design.conditions import Conditions
from jaxbundle.network_design.feasible import (
    start_at,
)
from jaxbundle.network_design.pairs import make_pairs
from jaxbundle.network_design.realise import problem_of
from jaxbundle.network_design.result import Design, DesignState
from jaxbundle.network_design.states import require_determined, state_of


def design_datum(
    network: Network, aim: Aim, conditions: Conditions, sigma: float, seed: int
) -> Design:
    """Inner constraints on all object points, the datum of the smallest mean σ of them (Meissl
    1969), compared with the datum of the network."""
    if aim.measure == "reliability" or aim.of != "points":
        raise InputError('order "zero": the datum is designed for the σ of points')
    if network.datum == "control":
        raise InputError(
            'order "zero": the datum of this network is given by control points and priors; '
            'datum = "minimal" or "inner" leaves it to be chosen'
        )
    inner = network.replace(datum="inner", datum_points=())
    pairs = make_pairs(inner, aim, conditions, sigma)
    values = start_at(pairs).values
    inner_state = state_of(pairs, inner, values, seed)
    require_determined(inner_state)
    datum_of_network = {"datum": network.datum, "datum_points": network.datum_points}
    noisy, exact = (
        inner_state.network.replace(**datum_of_network),
        inner_state.exact.replace(**datum_of_network),
    )
    problem = problem_of(exact)
    given_state = DesignState(
        noisy, exact, np.nan if problem is None else aim_of(problem, aim), inner_state.lost
    )
    return Design("zero", aim, conditions, given_state, inner_state)
