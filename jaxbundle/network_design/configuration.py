"""First order: positions and directions of stations, and targets."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Int

from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.network.columns import did_you_mean
from jaxbundle.network.tables import Network
from jaxbundle.network_design.feasible import (
    check_feasible,
    room_of,
    start_at,
    targets_of,
    try_stations,
)
from jaxbundle.network_design.pairs import StationTargetPairs
from jaxbundle.network_design.result import Design
from jaxbundle.network_design.search import configuration, make_program, satisfies, search
from jaxbundle.network_design.settings import DesignSettings
from jaxbundle.network_design.states import is_better, place_stations, require_determined, state_of
from jaxbundle.network_design.variables import Configuration, Variables, bounds, choose_variables


def design_configuration(
    pairs: StationTargetPairs,
    network: Network,
    free: tuple[str, ...],
    stations: Sequence[str] | None,
    starts: int,
    max_iterations: int,
    seed: int,
    settings: DesignSettings,
) -> Design:
    """First order: the best of several searches."""
    conditions, origin = pairs.conditions, pairs.problem.origin
    check_feasible(pairs)
    moving = _rows_of(stations, pairs.problem.network.images.id)
    tie = np.flatnonzero(pairs.problem.network.points.has_role("tie"))
    start = start_at(pairs)
    targets = tie if "targets" in free else np.zeros(0, int)
    variables = choose_variables(start.values, free, moving, targets)
    boxes = room_of(conditions, pairs), targets_of(conditions, pairs)
    ends = lambda start: bounds(variables, start, *boxes)
    program = make_program(pairs, configuration(pairs, variables))
    start_state = state_of(pairs, network, start.values, seed)
    best, path, converged = None, [], True
    for attempt in range(starts):
        begin = _roll(
            start if attempt == 0 else _place_at_random(pairs, start, moving, seed + attempt),
            variables,
            seed + attempt,
            settings.initial_roll,
        )
        end, steps, has_converged = search(
            pairs, variables, begin, program, ends, max_iterations, settings
        )
        if not satisfies(conditions, variables, origin, end, settings.edge_sharpness):
            continue
        end_state = state_of(pairs, network, end.values, seed)
        if best is None or is_better(end_state, best):
            best, path, converged = end_state, steps, has_converged
    if best is None:
        raise NotSolvedError(
            "design: the stations cannot satisfy their conditions (apart, obstacles); "
            "give a larger room, or more starts"
        )
    # The result is never worse than the start, if that satisfies the conditions of stations.
    low, high = boxes[0]
    position = start.values["image"].position
    is_inside = bool(((position >= low) & (position <= high)).all())
    if is_better(start_state, best) and is_inside:
        is_allowed = satisfies(conditions, variables, origin, start, settings.edge_sharpness)
        best = start_state if is_allowed else best
    require_determined(best)
    return Design("first", pairs.aim, conditions, start_state, best, tuple(path), converged)


def _roll(start: Configuration, variables: Variables, seed: int, sigma: float) -> Configuration:
    """A small roll, so that the search leaves a symmetrical start."""
    x = variables.vector(start)
    if "roll" not in variables.sizes:
        return start
    random = np.random.default_rng(seed)
    part = variables.parts(np.arange(len(x)))["roll"].ravel()
    x[part] = sigma * random.standard_normal(len(part))
    return variables.compiled_place(start, x)


def _place_at_random(
    pairs: StationTargetPairs, start: Configuration, moving: Int[np.ndarray, " moving"], seed: int
) -> Configuration:
    """The moving stations at random in the room."""
    position, rotation, target = try_stations(pairs, len(moving), seed)
    for row, p, q, t in zip(moving, position, rotation, target):
        start = place_stations(start, np.array([row]), p, q, t)
    return start


def _rows_of(ids: Sequence[str] | None, known_ids: tuple[str, ...]) -> np.ndarray:
    if ids is None:
        return np.arange(len(known_ids))
    for id in ids:
        if id not in known_ids:
            raise InputError(f"stations: there is no image {id!r}{did_you_mean(id, known_ids)}")
    return np.array([known_ids.index(id) for id in ids], int)
