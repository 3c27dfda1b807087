"""`design`: the network with the smallest σ under given conditions.

    network = jaxbundle.simulate(stations, targets, camera, noise=0.002)
    room = jaxbundle.Conditions(room=((-4, -4, 0), (4, 4, 3)), distance=(1, 6), apart=0.5)
    designed = jaxbundle.design(network, "mean", conditions=room)
    print(designed, designed.proof)

The orders are those of Grafarend (1974), in the words of Fraser (1984): zero, the datum; first, the
configuration; second, the weights of observations, here of whole photographs; third, the
densification of an existing network.
"""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbundle.arguments import integer, one_of, positive, show
from jaxbundle.choices import DESIGNED, ORDERS
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.float64 import require_x64
from jaxbundle.io.formats import as_network, recognise_format
from jaxbundle.io.networks.project import project_file
from jaxbundle.io.text.csv_tables import read_toml
from jaxbundle.leastsquares.indexing.rows import Values
from jaxbundle.leastsquares.spaces import PoseValue
from jaxbundle.network.columns import did_you_mean
from jaxbundle.network.tables import Images, Network, units_of
from jaxbundle.network.undetermined import keep_images, split_check_points
from jaxbundle.network_design.aims import Aim, aim_of
from jaxbundle.network_design.conditions import Conditions
from jaxbundle.network_design.feasible import (
    check_feasible,
    lost_targets,
    room_of,
    start_at,
    targets_of,
    try_stations,
)
from jaxbundle.network_design.pairs import MIN_TARGETS, StationTargetPairs, make_pairs
from jaxbundle.network_design.priors import use_prior_tables
from jaxbundle.network_design.realise import problem_of, realise
from jaxbundle.network_design.result import Design, DesignState
from jaxbundle.network_design.search import Step, configuration, make_program, satisfies, search
from jaxbundle.network_design.settings import DEFAULTS, DesignSettings
from jaxbundle.network_design.variables import Configuration, Variables, bounds, choose_variables
from jaxbundle.network_design.weights import select


def design(  # noqa: PLR0913 (public: a table of options, all but two by name)
    network: Network | str | Path,
    aim: str | Aim = "mean",
    *,
    order: str = "first",
    conditions: Conditions | None = None,
    free: Sequence[str] = DESIGNED[:3],
    stations: Sequence[str] | None = None,
    photographs: int | None = None,
    sigma_image: float | None = None,
    starts: int = 1,
    max_iterations: int = 60,
    seed: int = 0,
    settings: DesignSettings = DEFAULTS,
) -> Design:
    """Design a network: minimise an aim under conditions.

    **Arguments:**

    - `network`: cameras with their `image_size`, targets, and stations to start from, or the path
      of such a project; image points are needed only to add a photograph to an existing network.
    - `aim`: "mean", "worst", "determinant" of the σ of points, "reliability", or an `Aim`.
    - `order`: "zero": the datum of smallest mean σ. "first": positions, directions and roll of
      stations, and targets (`free`: some of "position", "direction", "roll", "targets"), of all
      stations or those in `stations`; for a calibration these are the poses of the board
      (`Design.board_poses`). "second": select this number of `photographs` from the given
      candidates. "third": add this number of `photographs`, default 1, with the last camera.
    - `sigma_image`: σ of future image coordinates, in the unit of the camera models; default: the
      median of the network, or that of a project without image points.
    - `starts`: number of searches of first order, all but one from random stations in the room.
    - `max_iterations`: per round of the search; `seed`: random seed; `settings`: of the search.

    **Returns:** a `Design`. Both of its states are without softness of the visibility.

    **Raises:** `InputError` for conditions that no station satisfies, targets that none sees, an
    aim that depends on the datum; `NotSolvedError` if no network that determines the aim was found.
    """
    require_x64()
    one_of("order", order, tuple(ORDERS))
    aim = aim if isinstance(aim, Aim) else Aim(aim)
    if conditions is not None and not isinstance(conditions, Conditions):
        raise InputError(f"conditions must be Conditions, but is {show(conditions)}")
    conditions = Conditions() if conditions is None else conditions
    # Check points have no part in an adjustment, and so none in its σ.
    given = as_network(network, oriented=True)
    if sigma_image is None and isinstance(network, str | os.PathLike):
        sigma_image = _sigma_of_project(Path(network), given)
    network = use_prior_tables(split_check_points(given)[0])
    sigma = _sigma(network, sigma_image)
    integer("starts", starts)
    if order == "zero":
        return _design_datum(network, aim, conditions, sigma, seed)
    if order == "second":
        return _design_weights(
            network, aim, conditions, sigma, photographs, max_iterations, seed, settings
        )
    if order == "third":
        more = 1 if photographs is None else integer("photographs", photographs)
        return _add_photographs(
            network, aim, conditions, sigma, more, max_iterations, seed, settings
        )
    if photographs is not None:
        raise InputError('photographs: their number is designed by order "second" or "third"')
    pairs = make_pairs(network, aim, conditions, sigma)
    return _design_configuration(
        pairs, network, tuple(free), stations, starts, max_iterations, seed, settings
    )


def _design_configuration(
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
    before = _state(pairs, network, start.values, seed)
    best, path, converged = None, [], True
    for attempt in range(starts):
        begin = _roll(
            start if attempt == 0 else _place_at_random(pairs, start, moving, seed + attempt),
            variables,
            seed + attempt,
            settings.initial_roll,
        )
        end, steps, done = search(pairs, variables, begin, program, ends, max_iterations, settings)
        if not satisfies(conditions, variables, origin, end, settings.edge_sharpness):
            continue
        after = _state(pairs, network, end.values, seed)
        if best is None or _better(after, best):
            best, path, converged = after, steps, done
    if best is None:
        raise NotSolvedError(
            "design: the stations cannot satisfy their conditions (apart, obstacles); "
            "give a larger room, or more starts"
        )
    # The result is never worse than the start, if that satisfies the conditions of stations.
    low, high = boxes[0]
    position = start.values["image"].position
    inside = bool(((position >= low) & (position <= high)).all())
    if _better(before, best) and inside:
        allowed = satisfies(conditions, variables, origin, start, settings.edge_sharpness)
        best = before if allowed else best
    _require_determined(best)
    return Design("first", pairs.aim, conditions, before, best, tuple(path), converged)


def _design_weights(
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
    lost = lost_targets(pairs, pairs.measured(values))
    if lost:
        raise InputError(
            f"targets {', '.join(lost[:10])}: fewer than two of the candidates see "
            "them; give further candidates, or leave these targets out"
        )
    before = _state(pairs, network, values, seed)
    found = select(pairs, integer("photographs", photographs), max_iterations, settings)
    ids = network.images.id
    taken = pairs.measured(values) & found.chosen[pairs.problem.image]
    after = _state(pairs, network, values, seed, taken)
    _require_determined(after)
    path = tuple(Step(0.0, aim, np.zeros((0, 3))) for aim in found.aims)
    return Design(
        "second",
        aim,
        conditions,
        before,
        after,
        path,
        found.converged,
        bound=found.bound or None,
        dropped=tuple(id for id in candidates if id not in after.network.images.id),
        weights=dict(zip(ids, found.weight.tolist())),
    )


def _add_photographs(
    network: Network,
    aim: Aim,
    conditions: Conditions,
    sigma: float,
    more: int,
    max_iterations: int,
    seed: int,
    settings: DesignSettings,
) -> Design:
    """Third order: further photographs, one after the other."""
    # Greedily: each is a search in six variables. Together they would be one in 6·n, with as many
    # more local minima as there are ways to distribute photographs over good places.
    states, path, added, tried, converged = [], [], [], [], True
    for k in range(more):
        measured = bool(len(network.observations))
        network, id = _with_another(network)
        new = np.arange(len(network.images)) == len(network.images) - 1
        pairs = make_pairs(network, aim, conditions, sigma, new if measured else None)
        check_feasible(pairs)
        start, steps, done, places = _best_place(pairs, new, max_iterations, seed + k, settings)
        path += steps
        converged = converged and done
        added.append(id)
        tried.append(places)
        if not states:
            without = pairs.measured(start.values) & ~new[pairs.problem.image]
            states.append(_state(pairs, network, start.values, seed, without))
        states.append(_state(pairs, network, start.values, seed))
        _require_determined(states[-1])
        network = states[-1].network
    return Design(
        "third",
        aim,
        conditions,
        states[0],
        states[-1],
        tuple(path),
        converged,
        tried=tried[0],
        added=tuple(added),
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
    begins = [_place(start, moving, p, q, t) for p, q, t in zip(position, rotation, target)]
    softness = settings.candidate_softness
    aims = np.array([program(variables.vector(s), s, softness)[0] for s in begins])
    boxes = room_of(pairs.conditions, pairs), targets_of(pairs.conditions, pairs)
    ends = lambda start: bounds(variables, start, *boxes)
    # Only the best few: the aim has a local minimum in every region from which other targets are
    # seen, which a search from one of them does not leave.
    best = None
    for k in np.argsort(aims)[: settings.refined]:
        end, steps, done = search(
            pairs, variables, begins[k], program, ends, max_iterations, settings
        )
        value = program(variables.vector(end), end, settings.softness[-1])[0]
        if satisfies(pairs.conditions, variables, origin, end, settings.edge_sharpness) and (
            best is None or value < best[0]
        ):
            best = value, end, steps, done
    if best is None:
        raise NotSolvedError("design: no place for a further photograph satisfies the conditions")
    return *best[1:], (position + origin, np.exp(aims))


def _design_datum(
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
    after = _state(pairs, inner, values, seed)
    _require_determined(after)
    given = {"datum": network.datum, "datum_points": network.datum_points}
    noisy, exact = after.network.replace(**given), after.exact.replace(**given)
    problem = problem_of(exact)
    before = DesignState(
        noisy, exact, np.nan if problem is None else aim_of(problem, aim), after.lost
    )
    return Design("zero", aim, conditions, before, after)


def _state(
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
    lost, aim = lost_targets(pairs, measured), float("nan")
    if not lost:
        aim = pairs.aim_at(measured, values)
    if not np.isfinite(aim) and (problem := problem_of(exact)) is not None:
        aim = aim_of(problem, pairs.aim)  # Of the remaining targets.
    noisy = realise(pairs, values, measured, seed, network.residuals)
    return DesignState(noisy, exact, aim, lost)


def _better(a: DesignState, b: DesignState) -> bool:
    """Fewer lost targets first, then the smaller aim."""
    value = lambda state: state.aim if np.isfinite(state.aim) else np.inf
    return (len(a.lost), value(a)) < (len(b.lost), value(b))


def _require_determined(state: DesignState) -> None:
    if not np.isfinite(state.aim):
        raise NotSolvedError(
            "design: no network that determines the aim was found; give more stations, more "
            "starts, or weaker conditions"
        )


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
        start = _place(start, np.array([row]), p, q, t)
    return start


def _place(
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


def _with_another(network: Network) -> tuple[Network, str]:
    """The network with one more image, of the last camera, at the place of the last one."""
    images, number = network.images, len(network.images) + 1
    while (id := f"new {number}") in images.id:
        number += 1
    again = lambda x: np.concatenate([x, x[-1:]])
    more = Images(
        (*images.id, id),
        again(images.camera),
        again(images.position),
        again(images.angles),
        np.concatenate([images.sigma, np.full((1, 6), np.nan)]),
        images.source,
    )
    return network.replace(images=more), id


def _rows_of(ids: Sequence[str] | None, known: tuple[str, ...]) -> np.ndarray:
    if ids is None:
        return np.arange(len(known))
    for id in ids:
        if id not in known:
            raise InputError(f"stations: there is no image {id!r}{did_you_mean(id, known)}")
    return np.array([known.index(id) for id in ids], int)


def _sigma(network: Network, given: float | None) -> float:
    if given is not None:
        return positive("sigma_image", given)
    sigma = network.observations.sigma
    if not len(sigma) or not np.isfinite(sigma).any():
        raise InputError("sigma_image: the network has no image points; give the σ they will have")
    return float(np.nanmedian(sigma))


def _sigma_of_project(path: Path, network: Network) -> float | None:
    """`sigma_image` of a project without image points; None if image points or no setting give
    it."""
    if len(network.observations) or recognise_format(path) != "project":
        return None
    given = read_toml(project_file(path))["project"].get("sigma_image")
    if given is None or network.image_unit != units_of(network.cameras):
        return None
    return positive("sigma_image", given)
