"""Points with nearly parallel rays, which determine the direction but hardly the distance.

Their distances drift without end, or make the normal equations singular. So points with parallel
rays, and if an adjustment does not converge all narrow ones, are adjusted as points at any distance
(`leastsquares.any_distance`). A point pulled beyond infinity by its rays is held there as a
direction, and released when they pull it back (an active set).
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float

from jaxbundle.adjustment.minimum import adjusted_cameras, inspect_solution
from jaxbundle.adjustment.problem import NetworkProblem, coordinates, with_coordinates
from jaxbundle.errors import InputError
from jaxbundle.leastsquares.any_distance import LARGEST_DISTANCE, is_at_infinity
from jaxbundle.leastsquares.indexing.rows import Values
from jaxbundle.leastsquares.iterations.solver import History, Minimum
from jaxbundle.leastsquares.iterations.stopping import LIMIT
from jaxbundle.leastsquares.problem import with_data, with_factor, with_free
from jaxbundle.leastsquares.solution import Solution, find_minimum
from jaxbundle.leastsquares.spaces import PoseValue
from jaxbundle.network.noise import noise_of_rays
from jaxbundle.orientation.batched import matrices_of_quaternions
from jaxbundle.orientation.rays import make_sights
from jaxbundle.types import not_none


@dataclasses.dataclass(frozen=True)
class FarPointSettings:
    """Which points may be at any distance, and when that is checked.

    - `narrow`: radians; largest angle between the rays of a point that may be at any distance.
      0.03 is a base of 1/33 of the distance. Larger: well determined points lose their place among
      the datum points; smaller: an adjustment that fails because of such points is not saved.
    - `parallel`: radians; largest angle between the rays of a point that is at any distance from
      the start, unless half of the tie points are: then all images have nearly the same projection
      centre, and no point is far.
    - `vague`: points with an angle below this number of σ of a ray (but at most `narrow`) are at
      any distance from the start as well. σ of their distance is above 1/`vague` of it: at a tenth,
      errors of second order at 3 σ, (3/10)² of the distance, are no longer small, while the
      reciprocal distance is nearly linear in the observations.
    - `evaluations_before_release`: evaluations before narrow points are put at any distance; twice
      as many if half of the tie points are narrow, since then the network may only be slow.
      Larger: failing adjustments take longer to recover; smaller: points move to the other
      parametrisation, and out of the datum, that would have settled.
    - `evaluations_between_checks` of points pulled beyond infinity, or back; doubled whenever no
      point changed. A compromise between iterations with the wrong points held and the cost of a
      check, which is that of a residual.
    - `max_releases`: a point released this often stays at infinity. It ends the cycles that an
      active set may have; few points are released more than once.
    """

    narrow: float = 0.03
    parallel: float = 1e-3
    vague: float = 10.0
    evaluations_before_release: int = 30
    evaluations_between_checks: int = 4
    max_releases: int = 10


FAR_POINTS = FarPointSettings()


def minimise_with_far_points(
    problem: NetworkProblem,
    start: Values,
    make: Callable,
    *,
    max_steps: int,
    settings: FarPointSettings = FAR_POINTS,
    **options: Any,
) -> tuple[NetworkProblem, Minimum]:
    """Iterate from `start` with points with parallel rays at any distance; without convergence,
    with all narrow ones. Returns that problem if it was solved, else the given one.
    `make(lengths=…)`: makes the problem (see `make_problem`)."""
    angle = angle_of_rays(problem, start)
    narrow = angle < settings.narrow
    if not narrow.any():
        return problem, find_minimum(problem, start, max_steps=max_steps, **options)
    are_half = lambda candidates: 2 * candidates.sum() >= (angle < np.pi).sum()
    vague = min(settings.vague * noise_of_rays(problem.network), settings.narrow)
    parallel = angle < max(settings.parallel, vague)
    runs: list[Minimum] = []
    # First only points whose rays are parallel; if that does not converge, all narrow points. The
    # other parametrisation costs little, but points at any distance carry no datum. Evaluations of
    # a first attempt that fails are forgotten: the second one has all of `max_steps` again.
    # If these are half of all, none: straight to the second attempt.
    for candidates in (parallel & ~are_half(parallel), None):
        if candidates is None:
            patience = settings.evaluations_before_release * (2 if are_half(narrow) else 1)
            plain = find_minimum(problem, start, max_steps=min(patience, max_steps), **options)
            if inspect_solution(with_factor(problem), plain) or int(plain.iterations) >= max_steps:
                return problem, plain
            runs, start = [plain], plain.values
            candidates = angle_of_rays(problem, start) < settings.narrow
        remaining_steps = max_steps - sum(int(run.iterations) for run in runs)
        far_problem = _with_far_points(problem, start, candidates, make)
        if far_problem is not None:
            found_problem, minimum = minimise_holding_infinite_points(
                *far_problem, max_steps=remaining_steps, settings=settings, **options
            )
            if inspect_solution(with_factor(found_problem), minimum):
                return found_problem, concatenate_runs([*runs, minimum])
    # It ended before the limit without a solution: further evaluations would change nothing.
    if int(runs[0].termination) != LIMIT:
        return problem, runs[0]
    return problem, concatenate_runs(
        [*runs, find_minimum(problem, start, max_steps=remaining_steps, **options)]
    )


def minimise_holding_infinite_points(
    problem: NetworkProblem,
    start: Values,
    *,
    max_steps: int,
    settings: FarPointSettings = FAR_POINTS,
    **options: Any,
) -> tuple[NetworkProblem, Minimum]:
    """Iterate from `start`; points at any distance that are pulled beyond infinity are held there,
    also in the returned problem."""
    if problem.lengths is None:
        return problem, find_minimum(problem, start, max_steps=max_steps, **options)
    # The third direction of change of such a point is that of its inverse distance.
    is_held = problem.table("point").free[:, 2] == 0
    is_held &= problem.at_any_distance & ~problem.excluded
    released, steps = np.zeros(len(is_held), int), settings.evaluations_between_checks
    runs: list[Minimum] = []
    # An active set: the inverse distance of a point is free, or held at 0 (infinity) while its
    # rays pull it beyond. Holding changes the mask of free columns only, so that all rounds run the
    # same compiled program.
    problem = _hold_at_infinity(problem, is_held, start)
    while True:
        remaining_steps = max_steps - sum(int(run.iterations) for run in runs)
        runs.append(find_minimum(problem, start, max_steps=min(steps, remaining_steps), **options))
        start = runs[-1].values
        to_hold = at_infinity(problem, start)
        if to_hold.any():
            outward = _are_pulled_outward(problem, start)
            to_hold &= np.where(is_held, outward | (released >= settings.max_releases), outward)
            to_hold &= ~problem.excluded
        released += is_held & ~to_hold
        changed = (to_hold != is_held).any()
        if remaining_steps <= steps or not changed and int(runs[-1].termination) != LIMIT:
            return problem, concatenate_runs(runs)
        steps = settings.evaluations_between_checks if changed else 2 * steps
        if changed:
            is_held = to_hold
            problem = _hold_at_infinity(problem, is_held, start)


def angle_of_rays(problem: NetworkProblem, values: Values) -> Float[np.ndarray, " points"]:
    """Approximately the largest angle between two rays of every tie point, radians: twice the sine
    of the largest angle to the mean of its rays; π for other points and points with fewer than two
    rays."""
    point, image = problem.point[problem.used], problem.image[problem.used]
    X0, X = np.asarray(values["image"].position), np.asarray(coordinates(values))
    ray = _unit_vectors(X[point] - X0[image])
    first_ray = np.zeros_like(X)
    # Lines, not directions: a point between two images has opposite rays. All are given the side of
    # the first ray of the point, which is assigned last.
    first_ray[point[::-1]] = ray[::-1]
    ray *= np.where((ray * first_ray[point]).sum(1) < 0, -1.0, 1.0)[:, None]
    middle = np.zeros_like(X)
    np.add.at(middle, point, ray)
    distance = np.linalg.norm(np.cross(ray, _unit_vectors(middle)[point]), axis=1)
    widest = np.zeros(len(middle))
    np.fmax.at(widest, point, distance)
    number = np.bincount(point, minlength=len(middle))
    tie = (number > 1) & problem.network.points.has_role("tie")
    return np.where(tie, 2 * widest, np.pi)


def _with_far_points(
    problem: NetworkProblem, values: Values, is_far: Bool[np.ndarray, " points"], make: Callable
) -> tuple[NetworkProblem, Values] | None:
    """The problem and its values with these points at any distance, except those whose coordinates
    other observations touch; None if none is left, or too few others for the datum.
    """
    lengths = np.where(is_far & ~problem.kept_rows, _unit(problem), 0.0)
    if not lengths.any():
        return None
    try:
        far_problem = make(lengths=lengths)
    except InputError:
        return None
    # The origin becomes the centroid of the projection centres. Frames and other tables would have
    # to move with it: such networks begin again from their start values.
    if problem.further_tables:
        return far_problem, far_problem.data.start
    shift = problem.origin - far_problem.origin
    position, rotation = map(np.asarray, values["image"])
    shifted = values | {"image": PoseValue(position + shift, rotation)}
    X = _in_front(far_problem, shifted, np.asarray(coordinates(values)) + shift)
    return far_problem, shifted | {"point": with_coordinates(far_problem.data.start["point"], X)}


def _in_front(
    problem: NetworkProblem, values: Values, X: Float[np.ndarray, "points 3"]
) -> Float[np.ndarray, "points 3"]:
    """The points X, with those at any distance that drifted to or beyond infinity put at
    infinity."""
    network = problem.network
    position, rotation = map(np.asarray, values["image"])
    sighted = make_sights(
        network.replace(cameras=tuple(adjusted_cameras(problem, values).values()))
    )
    M = matrices_of_quaternions(rotation)[sighted.image]
    ray = np.einsum("nij,ni->nj", M, sighted.ray)
    depth = (ray * (X[sighted.point] - position[sighted.image])).sum(1)
    sides = np.bincount(sighted.point, np.sign(depth), len(X))
    length = np.linalg.norm(X, axis=1)
    farthest = LARGEST_DISTANCE * not_none(problem.lengths)
    move = (farthest > 0) & ((sides < 0) | (length > farthest))
    factor = np.where(move, np.where(sides < 0, -farthest, farthest) / length, 1.0)
    return X * factor[:, None]


def at_infinity(problem: NetworkProblem, values: Values) -> Bool[np.ndarray, " points"]:
    """Which points are at infinity."""
    if problem.lengths is None:
        return problem.at_any_distance
    return is_at_infinity(np.asarray(coordinates(values)), problem.lengths)


def _hold_at_infinity(
    problem: NetworkProblem, is_held: Bool[np.ndarray, " points"], values: Values
) -> NetworkProblem:
    """These points held at infinity, the others not."""
    start, is_free_to_go = problem.data.start, problem.at_any_distance & ~problem.excluded
    point = np.where(is_held[:, None], np.asarray(values["point"]), np.asarray(start["point"]))
    start = start | {"point": jax.device_put(point)}
    problem = with_data(problem, dataclasses.replace(problem.data, start=start))
    free = problem.table("point").free.copy()
    free[:, 2] = np.where(is_free_to_go, ~is_held, free[:, 2])
    return with_free(problem, "point", free)


def _are_pulled_outward(problem: NetworkProblem, values: Values) -> Bool[np.ndarray, " points"]:
    """Whether vᵀPv decreases with the distance of a point."""
    number = len(problem.network.points)
    free = _hold_at_infinity(problem, np.zeros(number, bool), values)
    solution, slope = Solution(free, values), np.zeros(number)
    for name, rows in problem.image_rows.items():
        weighted_slopes = solution.residuals[name] * solution.jacobian_eliminated[name][:, :, 2]
        np.add.at(slope, problem.point[rows], weighted_slopes.sum(1))
    return slope > 0


def _unit(problem: NetworkProblem) -> float:
    """The unit in which inverse distances are of order 1: the RMS distance of the projection
    centres from the origin that a problem with points at any distance has, their centroid in whole
    units (`make_problem`)."""
    centres = problem.network.images.position
    return float(np.sqrt(((centres - np.round(centres.mean(0))) ** 2).sum(1).mean()))


def concatenate_runs(runs: Sequence[Minimum]) -> Minimum:
    """Several successive minimisations combined into one. The first evaluation of every run after
    the first is left out: it repeats the last of the previous one (or is that of other start
    values, as those of a second minimum)."""
    if len(runs) == 1:
        return runs[0]
    rows = [slice(k > 0, int(run.iterations)) for k, run in enumerate(runs)]
    column = lambda name: jax.device_put(
        np.concatenate([np.asarray(getattr(run.history, name))[r] for run, r in zip(runs, rows)])
    )
    history = History(column("cost"), column("damping"), column("accepted"))
    return dataclasses.replace(runs[-1], iterations=np.asarray(len(history.cost)), history=history)


def _unit_vectors(v: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    with np.errstate(invalid="ignore", divide="ignore"):
        return v / np.linalg.norm(v, axis=1, keepdims=True)
