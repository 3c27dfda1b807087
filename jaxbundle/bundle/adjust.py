"""`adjust`: a network in, an `Adjustment` out."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from types import MappingProxyType

import numpy as np

from jaxbundle.adjustment.problem import REDUCTIONS, Problem, make_problem
from jaxbundle.arguments import at_least_zero, one_of, shown, truth, whole
from jaxbundle.bundle.far_points import minimise_at_any_distance, minimise_with_infinity
from jaxbundle.bundle.minimum import (
    adjusted_cameras,
    misjudged,
    names_of_defects,
    solved,
    start_with,
    weakness_without_solution,
)
from jaxbundle.bundle.orient import orient, orient_again, screen
from jaxbundle.bundle.repeated import eliminated_parameters, robustly, snooped, with_components
from jaxbundle.bundle.result import Adjustment
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.leastsquares.declarations import Observations, Table
from jaxbundle.leastsquares.robust import ESTIMATORS
from jaxbundle.leastsquares.search import METHODS
from jaxbundle.leastsquares.snooping import check_test
from jaxbundle.leastsquares.solver import Minimum
from jaxbundle.leastsquares.stopping import converged
from jaxbundle.network.check import check_network
from jaxbundle.network.columns import count, some
from jaxbundle.network.sightings import split_check_points
from jaxbundle.network.tables import Camera, Network, require_network
from jaxbundle.network.unit_mistakes import name_pixels
from jaxbundle.orientation.angle_units import name_angle_unit
from jaxbundle.orientation.exchanges import CONTRADICTION, name_contradiction
from jaxbundle.orientation.network import Oriented, lacks_start_values
from jaxbundle.orientation.one_place import name_one_place
from jaxbundle.statistics.blunders import name_suspect
from jaxbundle.statistics.check_points import intersect_check_points
from jaxbundle.statistics.inspection import Inspection
from jaxbundle.statistics.misfit import doubt_of_robust

MISFIT = 5.0
"""A σ0 above this asks for its cause."""
UNNAMED = ("a combination of unknowns that spreads over many of them",)
"""What is not determined, where none stands out."""


def adjust(
    network: Network,
    *,
    also: Sequence[Table | Observations] = (),
    method: str = "levenberg-marquardt",
    reduction: str | None = None,
    max_iterations: int = 100,
    robust: str | None = None,
    snooping: str | None = None,
    significance: float = 0.001,
    doubtful: Iterable[tuple[str, str]] = (),
    eliminate: bool = False,
    critical_t: float = 2.0,
    estimate_components: bool = False,
    progress: Callable | None = None,
) -> Adjustment:
    """Adjust a network by least squares, with self-calibration of whatever is free.

    **Arguments:**

    - `network`: see `jaxbundle.make_network`, `jaxbundle.read_network`, `jaxbundle.simulate`. Start
      values it lacks are found first (`jaxbundle.orient`).
    - `also`: observations of further kinds (`jaxbundle.leastsquares.Kind`), and tables of the
      unknowns they bring. They touch the network's tables "image", "camera" and "point" by id, see
      object coordinates as they are, and have a σ0 group, redundancy numbers and residuals of their
      own (docs/engine.md).
    - `method`: `"levenberg-marquardt"` or `"gauss-newton"`.
    - `reduction`: how the reduced system of images and cameras is solved: `"dense"`, `"banded"` or
      `"iterative"`; chosen by its size and fill if not given.
    - `robust`: `"huber"`, `"cauchy"` or `"tukey"`: image points that fit badly count less, by the
      a posteriori scale of their residuals (`jaxbundle.statistics.robust_scale`, a MAD). Their last
      weights are those of the result, its σ by some per cent too small.
    - `snooping`: `"pope"` or `"baarda"`: remove blunders at the level `significance`: with
      `"pope"` the probability to lose anything of a network without blunders, with `"baarda"`
      that of a single observation; also the probability that `robust` suspects anything. Where
      blunders leave no solution to begin with, image points that contradict the start values
      altogether are left out first (also of `robust`).
    - `doubtful`: (image, point) by id of image points that data snooping begins without; those that
      pass its test come back.
    - `eliminate`: fix additional parameters with t < `critical_t` at 0, the least significant
      first, adjusting again each time.
    - `estimate_components`: scale the σ of each group of observations until its variance
      component is 1; `Adjustment.sigma_factors` says by how much.
    - `progress(step, cost, λ)`: called after every evaluation.

    **Returns:** an `Adjustment`; look at `converged` before anything else.

    **Raises:** `InputError` where the network cannot be adjusted as it stands; `NotSolvedError`
    where it, or what data snooping, elimination or variance components leave of it, determines no
    answer.
    """
    check_options(
        method=method, reduction=reduction, max_iterations=max_iterations, robust=robust,
        snooping=snooping, significance=significance, eliminate=eliminate, critical_t=critical_t,
        estimate_components=estimate_components, progress=progress,
    )  # fmt: skip
    given, finding = require_network(network), ""
    if lacks_start_values(given):
        found = orient(given)
        network, finding = _placed(found), found.finding
    options = {"search": METHODS[method], "max_steps": max_iterations + 1, "progress": progress}
    again = lambda problem, values: minimise_with_infinity(problem, values, **options)

    def begin(network, cameras: Mapping[str, Camera] = MappingProxyType({})):
        network, points, rays = split_check_points(check_network(network))
        make = partial(make_problem, network, reduction, also)
        try:
            problem = make()
        except InputError as error:  # The datum, for want of the control points left out.
            raise InputError(f"{error} {finding}".strip()) from None
        start = start_with(problem, cameras)
        return *minimise_at_any_distance(problem, start, make, **options), (points, rays)

    problem, minimum, check = begin(network)
    while len(network.observations) < len(given.observations) and misjudged(problem, minimum):
        # What the principal distance given made impossible may agree with the one found.
        cameras, fewer = adjusted_cameras(problem, minimum.values), network
        network = orient_again(given, fewer, cameras)
        if network is fewer:
            break
        problem, minimum, check = begin(network, cameras)
    if (robust or snooping) and not solved(problem.with_factor(), minimum):
        screened = screen(network)
        if len(screened.observations) < len(network.observations):
            problem, minimum, check = begin(screened)
    network, used = problem.network, problem.reduction
    problem = problem.with_factor()

    removed, eliminated, factors, reweighted, suspects, doubt = [], [], {}, None, [], None
    if robust:
        reweighted, minimum = robustly(problem, minimum, again, robust)
        suspects = [name_suspect(problem, s) for s in reweighted.suspects(significance)]
        problem = problem.with_system(reweighted.found.problem)
        doubt = doubt_of_robust(reweighted.scale, problem.counts.redundancy)
    inspection = solved(problem, minimum)
    if inspection and (snooping or estimate_components or eliminate):
        if snooping:
            problem, minimum, removed, doubt = snooped(
                inspection, minimum, again, snooping, significance, doubtful
            )
        if estimate_components:
            problem, minimum, factors = with_components(problem, minimum, again)
        if eliminate:
            problem, minimum, eliminated = eliminated_parameters(
                problem, minimum, again, critical_t
            )

        inspection = solved(problem, minimum)
    names = () if inspection else names_of_defects(problem, minimum)
    if not inspection and converged(int(minimum.termination)):
        names = names or UNNAMED
    weak = None if inspection or names else weakness_without_solution(problem, minimum)
    intersected = None
    if len(check[0]):
        points, rays = check
        intersected = lambda result: intersect_check_points(
            result.inspection, points, rays, factors
        )
    return Adjustment(
        network, problem, minimum, removed=tuple(removed), eliminated=tuple(eliminated),
        undetermined=tuple(names), check=intersected, method=method, reduction=used,
        sigma_factors=factors, inspection=inspection, robust=robust, weakness=weak,
        findings=_likely_causes(problem, minimum, inspection), reweighted=reweighted,
        suspects=tuple(suspects), doubts=(doubt,) if doubt else (),
    )  # fmt: skip


def check_options(
    *,
    method="levenberg-marquardt",
    reduction=None,
    max_iterations=100,
    robust=None,
    snooping=None,
    significance=0.001,
    eliminate=False,
    critical_t=2.0,
    estimate_components=False,
    progress=None,
) -> None:
    """Refuse options of `adjust` that cannot be.

    **Raises:** `InputError`, naming the option and what is expected."""
    one_of("method", method, tuple(METHODS))
    one_of("reduction", reduction, REDUCTIONS, none=True)
    whole("max_iterations", max_iterations)
    one_of("robust", robust, ESTIMATORS, none=True)
    check_test(snooping, significance)
    if robust and snooping:
        raise InputError("robust estimation or data snooping, not both at once")
    truth("eliminate", eliminate)
    at_least_zero("critical_t", critical_t)
    truth("estimate_components", estimate_components)
    if progress is not None and not callable(progress):
        raise InputError(f"progress must be a function, but is {shown(progress)}")


def _likely_causes(
    problem: Problem, minimum: Minimum, inspection: Inspection | None
) -> tuple[str, ...]:
    """Why there is no solution, or one that fits badly, in words."""
    network = problem.network
    tried = int(minimum.iterations)
    accepted = np.asarray(minimum.history.accepted)[:tried]
    vtpv = 2 * np.asarray(minimum.history.cost)[:tried][accepted][-1:]
    if inspection and not (vtpv > MISFIT**2 * problem.counts.redundancy).any():
        return ()
    told = any(CONTRADICTION in line for line in network.warnings)
    causes = (
        name_pixels(network), name_angle_unit(network),
        "" if told else name_contradiction(network),
        "" if inspection else name_one_place(network),
    )  # fmt: skip
    return tuple(filter(None, causes))


def _placed(found: Oriented) -> Network:
    """The network with start values; refused where it is half a network or less.

    **Raises:** `NotSolvedError`."""
    network = found.network
    for thing, reasons, left in (
        ("image", found.images, len(network.images)), ("point", found.points, len(network.points))
    ):  # fmt: skip
        if len(reasons) >= left:
            said = some((f"{thing} {id} ({why})" for id, why in reasons.items()), 5, str)
            cause = name_pixels(network)
            raise NotSolvedError(
                f"not solved: no start values were found for {len(reasons)} of "
                f"{count(len(reasons) + left, thing)}: {said}; jaxbundle orient lists all of them"
                + (f"; {cause}" if cause else ""),
                [f"{thing} {id}" for id in reasons],
            )
    return network
