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
    after = state_of(pairs, inner, values, seed)
    require_determined(after)
    given = {"datum": network.datum, "datum_points": network.datum_points}
    noisy, exact = after.network.replace(**given), after.exact.replace(**given)
    problem = problem_of(exact)
    before = DesignState(
        noisy, exact, np.nan if problem is None else aim_of(problem, aim), after.lost
    )
    return Design("zero", aim, conditions, before, after)
