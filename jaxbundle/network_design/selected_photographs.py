"""Second order: the best of given photographs."""

import numpy as np

from jaxbundle.arguments import integer
from jaxbundle.errors import InputError
from jaxbundle.network.subsets import keep_images
from jaxbundle.network.tables import Network
from jaxbundle.network_design.aims import Aim
from jaxbundle.network_design.conditions import Conditions
from jaxbundle.network_design.feasible import (
    lost_targets,
    start_at,
)
from jaxbundle.network_design.pairs import MIN_TARGETS, make_pairs
from jaxbundle.network_design.result import Design
from jaxbundle.network_design.search import Step
from jaxbundle.network_design.settings import DesignSettings
from jaxbundle.network_design.states import require_determined, state_of
from jaxbundle.network_design.weights import select


def select_photographs(
    network: Network,
    aim: Aim,
    conditions: Conditions,
    sigma: float,
    photographs: int | None,
    max_iterations: int,
    seed: int,
    settings: DesignSettings,
) -> Design:
    """Second order: the best of the given photographs."""
    if photographs is None:
        raise InputError('photographs: order "second" needs the number of candidates to select')
    candidates = network.images.id
    pairs = make_pairs(network, aim, conditions, sigma)
    values = start_at(pairs).values
    # Candidates with too few visible targets are undetermined at any weight: they go first.
    rays = np.bincount(pairs.problem.image[pairs.measured(values)], minlength=len(network.images))
    seeing = rays >= MIN_TARGETS
    if seeing.any() and not seeing.all():
        network = keep_images(network, seeing)
        pairs = make_pairs(network, aim, conditions, sigma)
        values = start_at(pairs).values
    lost_ids = lost_targets(pairs, pairs.measured(values))
    if lost_ids:
        raise InputError(
            f"targets {', '.join(lost_ids[:10])}: fewer than two of the candidates see "
            "them; give further candidates, or leave these targets out"
        )
    state_of_all = state_of(pairs, network, values, seed)
    selection = select(pairs, integer("photographs", photographs), max_iterations, settings)
    ids = network.images.id
    is_taken = pairs.measured(values) & selection.chosen[pairs.problem.image]
    state_of_selection = state_of(pairs, network, values, seed, is_taken)
    require_determined(state_of_selection)
    path = tuple(Step(0.0, aim, np.zeros((0, 3))) for aim in selection.aims)
    return Design(
        "second",
        aim,
        conditions,
        state_of_all,
        state_of_selection,
        path,
        selection.converged,
        bound=selection.bound or None,
        dropped=tuple(id for id in candidates if id not in state_of_selection.network.images.id),
        weights=dict(zip(ids, selection.weight.tolist())),
    )
