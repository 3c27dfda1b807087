"""States of a design: the network before and after, and which of two is better."""

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbundle.errors import NotSolvedError
from jaxbundle.leastsquares.indexing.rows import Values
from jaxbundle.leastsquares.spaces import PoseValue
from jaxbundle.network.tables import Network
from jaxbundle.network_design.aims import aim_of
from jaxbundle.network_design.feasible import (
    lost_targets,
)
from jaxbundle.network_design.pairs import StationTargetPairs
from jaxbundle.network_design.realise import problem_of, realise
from jaxbundle.network_design.result import DesignState
from jaxbundle.network_design.variables import Configuration


def state_of(
    pairs: StationTargetPairs,
    network: Network,
    values: Values,
    seed: int,
    measured: Bool[np.ndarray, " rays"] | None = None,
) -> DesignState:
    """The visibility of targets at these values."""
    # Soft visibility is for the search: states count what satisfies the conditions, as a
    # photogrammetrist will.
    measured = pairs.measured(values) if measured is None else measured
    exact = realise(pairs, values, measured, None, network.residuals)
    lost_ids, aim = lost_targets(pairs, measured), float("nan")
    if not lost_ids:
        aim = pairs.aim_at(measured, values)
    if not np.isfinite(aim) and (problem := problem_of(exact)) is not None:
        aim = aim_of(problem, pairs.aim)  # Of the remaining targets.
    noisy = realise(pairs, values, measured, seed, network.residuals)
    return DesignState(noisy, exact, aim, lost_ids)


def is_better(a: DesignState, b: DesignState) -> bool:
    """Fewer lost targets first, then the smaller aim."""
    value = lambda state: state.aim if np.isfinite(state.aim) else np.inf
    return (len(a.lost), value(a)) < (len(b.lost), value(b))


def require_determined(state: DesignState) -> None:
    if not np.isfinite(state.aim):
        raise NotSolvedError(
            "design: no network that determines the aim was found; give more stations, more "
            "starts, or weaker conditions"
        )


def place_stations(
    start: Configuration,
    rows: Int[np.ndarray, " rows"],
    position: Float[np.ndarray, "3"],
    rotation: Float[np.ndarray, "4"],
    target: int,
) -> Configuration:
    """Some stations at other positions."""
    values = start.values
    positions, rotations, look = (np.array(x) for x in (*values["image"], start.look))
    positions[rows], rotations[rows] = position, rotation
    look[rows] = np.asarray(values["point"])[target]
    return Configuration(values | {"image": PoseValue(positions, rotations)}, look)
