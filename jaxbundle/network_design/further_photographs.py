"""Third order: the best places of further photographs."""

import numpy as np
from jaxtyping import Bool, Float

from jaxbundle.choices import DESIGNED
from jaxbundle.errors import NotSolvedError
from jaxbundle.network.tables import Images, Network
from jaxbundle.network_design.aims import Aim
from jaxbundle.network_design.conditions import Conditions
from jaxbundle.network_design.feasible import (
    check_feasible,
    room_of,
    start_at,
    targets_of,
    try_stations,
)
from jaxbundle.network_design.pairs import StationTargetPairs, make_pairs
from jaxbundle.network_design.result import Design
from jaxbundle.network_design.search import Step, configuration, make_program, satisfies, search
from jaxbundle.network_design.settings import DesignSettings
from jaxbundle.network_design.states import place_stations, require_determined, state_of
from jaxbundle.network_design.variables import Configuration, bounds, choose_variables


def add_photographs(
    network: Network,
    aim: Aim,
    conditions: Conditions,
    sigma: float,
    number_added: int,
    max_iterations: int,
    seed: int,
    settings: DesignSettings,
) -> Design:
    """Third order: further photographs, one after the other."""
    # Greedily: each is a search in six variables. Together they would be one in 6·n, with as many
    # more local minima as there are ways to distribute photographs over good places.
    states, path, added_ids, places_tried, converged = [], [], [], [], True
    for k in range(number_added):
        measured = bool(len(network.observations))
        network, id = _with_another(network)
        new = np.arange(len(network.images)) == len(network.images) - 1
        pairs = make_pairs(network, aim, conditions, sigma, new if measured else None)
        check_feasible(pairs)
        start, steps, has_converged, places = _best_place(
            pairs, new, max_iterations, seed + k, settings
        )
        path += steps
        converged = converged and has_converged
        added_ids.append(id)
        places_tried.append(places)
        if not states:
            without = pairs.measured(start.values) & ~new[pairs.problem.image]
            states.append(state_of(pairs, network, start.values, seed, without))
        states.append(state_of(pairs, network, start.values, seed))
        require_determined(states[-1])
        network = states[-1].network
    return Design(
        "third",
        aim,
        conditions,
        states[0],
        states[-1],
        tuple(path),
        converged,
        tried=places_tried[0],
        added=tuple(added_ids),
    )


def _best_place(
    pairs: StationTargetPairs,
    new: Bool[np.ndarray, " images"],
    max_iterations: int,
    seed: int,
    settings: DesignSettings,
) -> tuple[
    Configuration,
    list[Step],
    bool,
    tuple[Float[np.ndarray, "tried 3"], Float[np.ndarray, " tried"]],
]:
    """Compare random positions and refine the best."""
    moving, origin = np.flatnonzero(new), pairs.problem.origin
    start = start_at(pairs)
    variables = choose_variables(start.values, DESIGNED[:3], moving, np.zeros(0, int))
    program = make_program(pairs, configuration(pairs, variables))
    position, rotation, target = try_stations(pairs, settings.candidates, seed)
    begins = [place_stations(start, moving, p, q, t) for p, q, t in zip(position, rotation, target)]
    softness = settings.candidate_softness
    aims = np.array([program(variables.vector(s), s, softness)[0] for s in begins])
    boxes = room_of(pairs.conditions, pairs), targets_of(pairs.conditions, pairs)
    ends = lambda start: bounds(variables, start, *boxes)
    # Only the best few: the aim has a local minimum in every region from which other targets are
    # seen, which a search from one of them does not leave.
    best = None
    for k in np.argsort(aims)[: settings.refined]:
        end, steps, has_converged = search(
            pairs, variables, begins[k], program, ends, max_iterations, settings
        )
        value = program(variables.vector(end), end, settings.softness[-1])[0]
        if satisfies(pairs.conditions, variables, origin, end, settings.edge_sharpness) and (
            best is None or value < best[0]
        ):
            best = value, end, steps, has_converged
    if best is None:
        raise NotSolvedError("design: no place for a further photograph satisfies the conditions")
    # Infinite where it is not determined.
    with np.errstate(over="ignore"):
        return *best[1:], (position + origin, np.exp(aims))


def _with_another(network: Network) -> tuple[Network, str]:
    """The network with one more image, of the last camera, at the place of the last one."""
    images, number = network.images, len(network.images) + 1
    while (id := f"new {number}") in images.id:
        number += 1
    repeat_last = lambda x: np.concatenate([x, x[-1:]])
    extended = Images(
        (*images.id, id),
        repeat_last(images.camera),
        repeat_last(images.position),
        repeat_last(images.angles),
        np.concatenate([images.sigma, np.full((1, 6), np.nan)]),
        images.source,
    )
    return network.replace(images=extended), id
