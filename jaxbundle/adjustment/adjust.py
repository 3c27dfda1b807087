"""`adjust`: from a network to an `Adjustment`."""

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
from jaxtyping import Float, Int

from jaxbundle.adjustment.exclusions import transfer_start_values
from jaxbundle.adjustment.far_points import minimise_holding_infinite_points
from jaxbundle.adjustment.first_minimum import FirstMinimum, require_most_oriented
from jaxbundle.adjustment.likely_causes import (
    largest_sigma0,
    likely_causes,
    name_conventions,
    sigma0_at_end,
)
from jaxbundle.adjustment.minimum import (
    inspect_solution,
    names_of_defects,
    weakness_without_solution,
)
from jaxbundle.adjustment.mirrored_control import name_mirrored, name_other_side
from jaxbundle.adjustment.orient import orient
from jaxbundle.adjustment.problem import NetworkProblem, make_problem
from jaxbundle.adjustment.quality.blunder_names import name_suspect
from jaxbundle.adjustment.quality.correlated_errors import DEFAULTS as CORRELATIONS
from jaxbundle.adjustment.quality.inspection import Inspection
from jaxbundle.adjustment.quality.misfit import doubt_of_robust
from jaxbundle.adjustment.readjust import (
    Minimise,
    adjust_robustly,
    eliminate_parameters,
    snoop_network,
    with_components,
)
from jaxbundle.adjustment.result import Adjustment
from jaxbundle.adjustment.second_minima.search import (
    can_have_second,
    find_second_minima,
    is_reported,
)
from jaxbundle.arguments import at_least_zero, integer, one_of, show, truth
from jaxbundle.choices import ESTIMATORS, METHODS, REDUCTIONS
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.io.formats import as_network
from jaxbundle.leastsquares.declarations import ObservationSet, Table
from jaxbundle.leastsquares.indexing.rows import Values
from jaxbundle.leastsquares.iterations.search import SEARCHES
from jaxbundle.leastsquares.iterations.solver import Minimum
from jaxbundle.leastsquares.iterations.stopping import converged
from jaxbundle.leastsquares.problem import with_factor
from jaxbundle.leastsquares.quality.snooping import check_test
from jaxbundle.network.subsets import split_check_points
from jaxbundle.network.tables import Network, Observations, Points
from jaxbundle.network.unit_mistakes import (
    name_unit_of_positions,
)
from jaxbundle.orientation.network import Oriented, lacks_start_values, without_placeholders
from jaxbundle.orientation.swapped_control import CONTRADICTORY_CONTROL
from jaxbundle.types import AnyArray, Progress, not_none

# Name of the undetermined if no single unknown dominates.
UNNAMED = ("a combination of many unknowns",)


def adjust(  # noqa: PLR0913 - the options of an adjustment
    network: Network | str | Path,
    *,
    format: str | None = None,
    overrides: Sequence[str] = (),
    control: str | Path | None = None,
    check: Sequence[str] = (),
    also: Sequence[Table | ObservationSet] = (),
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
    correlated: bool = False,
    second_minimum: bool = True,
    progress: Progress | None = None,
) -> Adjustment:
    """Adjust a network by least squares, with self-calibration of all free parameters.

    **Arguments:**

    - `network`: see `jaxbundle.make_network`, `jaxbundle.read_network`, `jaxbundle.simulate`; or
      the path of one, which is read with `format`, `overrides` (`--set`) and `control`. Missing
      start values are computed first (`jaxbundle.orient`).
    - `check`: control points that are only compared with the result: names, or `"every 3rd"`.
    - `also`: observations of further kinds (`jaxbundle.leastsquares.Kind`), and tables of their
      unknowns. They touch the network's tables "image", "camera" and "point" by id, receive object
      coordinates unchanged, and have their own variance group, redundancy numbers and residuals
      (docs/engine.md).
    - `method`: `"levenberg-marquardt"` or `"gauss-newton"`.
    - `reduction`: solver of the reduced system of images and cameras: `"dense"`, `"banded"` or
      `"iterative"`; by default chosen by size and fill.
    - `robust`: `"huber"`, `"cauchy"` or `"tukey"`: image points that fit badly are downweighted by
      the a posteriori scale of the residuals (`leastsquares.quality.robust.robust_scale`, a MAD).
      The result uses the last weights; its σ are a few per cent too small.
    - `snooping`: `"pope"` or `"baarda"`: remove blunders at the level `significance`: for `"pope"`
      the probability of removing anything from a network without blunders, for `"baarda"` that of
      removing a single observation; also the probability that `robust` suspects anything. If
      blunders prevent an initial solution, image points that grossly contradict the start values
      are removed first (also with `robust`).
    - `doubtful`: (image, point) by id of image points initially removed from data snooping; those
      that pass its test are restored.
    - `eliminate`: fix additional parameters with t < `critical_t` at 0, the least significant
      first, adjusting again each time.
    - `estimate_components`: scale the σ of each group of observations until its variance component
      is 1; the factors are `Adjustment.sigma_factors`.
    - `correlated`: look for errors that image points share (a field on the sensor, interior
      orientations that move between photographs, errors along tracks), and state the σ under them
      beside the classical ones (`Adjustment.error_model`); of eight photographs or more, compare
      halves of them (`Adjustment.replication`). The estimates do not change.
    - `second_minimum`: after convergence look for the second minima that networks of nearly plane
      objects and of small perspective effect may have; take a better one, and report those that
      cannot be separated from the result (`Adjustment.second_minima`; docs/statistics.md).
    - `progress(stage, done, total)`: called for every evaluation, with vᵀPv and the damping in
      the stage; of up to 200 000 observations only when the iterations have ended
      (`jaxbundle.show_progress` shows bars).

    **Returns:** an `Adjustment`; check `converged` first.

    **Raises:** `InputError` if the network cannot be adjusted; `NotSolvedError` if it is not
    determined, initially or after data snooping, elimination or variance components.
    """
    check_options(
        method=method,
        reduction=reduction,
        max_iterations=max_iterations,
        robust=robust,
        snooping=snooping,
        significance=significance,
        eliminate=eliminate,
        critical_t=critical_t,
        estimate_components=estimate_components,
        correlated=correlated,
        second_minimum=second_minimum,
        progress=progress,
    )
    given = without_placeholders(
        as_network(network, format=format, overrides=overrides, control=control, check=check)
    )
    # One step more: the first evaluation is of the start values.
    max_steps = max_iterations + 1
    options: dict[str, Any] = {
        "search": SEARCHES[method],
        "max_steps": max_steps,
        "largest_max_steps": max_steps,
    }
    try_again = partial(_try_mirrored, reduction, options)
    mirror = lambda sigma0: name_mirrored(given, sigma0, try_again, largest_sigma0(given))
    oriented = _orient(given, mirror) if lacks_start_values(given) else None
    common_options = (
        options
        if progress is None
        else options | {"progress": partial(_tell, progress, max_iterations)}
    )
    first_minimum = FirstMinimum(reduction, also, oriented, common_options)
    start = first_minimum.find(given, outliers=bool(robust or snooping))
    problem, minimum = start.problem, start.minimum
    minimise_again = partial(minimise_holding_infinite_points, **common_options)
    # The statistics need the factor of the normal matrix even where the iterations did without.
    state = _AdjustmentState(
        problem.network, with_factor(problem), minimum, method, problem.reduction
    )
    # Without `progress`: every candidate would begin the bars anew.
    search = partial(
        find_second_minima, minimise=partial(minimise_holding_infinite_points, **options)
    )
    # Before anything is excluded or downweighted because of residuals of the wrong minimum.
    if second_minimum:
        state.search_second_minima(search)
    if robust:
        state.weight_robustly(minimise_again, robust, significance)
    if state.inspection:
        if snooping:
            state.remove_blunders(minimise_again, snooping, significance, doubtful)
        if estimate_components:
            state.estimate_components(minimise_again)
        if eliminate:
            state.eliminate_parameters(minimise_again, critical_t)
        if second_minimum and (robust or snooping or estimate_components or eliminate):
            state.search_second_minima(search)
    result = state.adjustment(start.check)
    sigma0 = sigma0_at_end(state.problem, state.minimum) if state.inspection else None
    if state.inspection:
        result = result.with_changes(
            findings=(*result.findings, *_compare_with_start(given, result))
        )
    misfit = sigma0 is None or sigma0 > largest_sigma0(given)
    # The causes named so far are guesses from the start values, which fit a mirrored network as
    # well as a true one: only adjusting the mirror image shows it. It costs a second adjustment,
    # so it is tried last, and only when nothing simpler explains the misfit.
    if misfit and not also and not name_conventions(problem, minimum, state.inspection):
        if mirrored := mirror(sigma0):
            result = result.with_changes(findings=(mirrored,))
    if not correlated:
        return result
    return result.with_changes(correlations=CORRELATIONS).with_correlated_errors()


def snoop_again(
    earlier: Adjustment,
    network: Network,
    values: Values,
    doubtful: Iterable[tuple[str, str]],
    significance: float,
    max_iterations: int,
) -> Adjustment:
    """The result of data snooping by Pope's test in a network that was adjusted before, from values
    near to its end: without the search for start values, a first minimum with all gross errors, and
    what rays do not determine.

    **Arguments:** `earlier`: the result; `network`: that of its problem, with other σ or datum
    points; `values` of the unknowns of its problem; `doubtful`: as of `adjust`, one or more.

    **Raises:** `NotSolvedError` if it is not determined without gross errors."""
    max_steps = max_iterations + 1
    options: dict[str, Any] = {
        "search": SEARCHES[earlier.method],
        "max_steps": max_steps,
        "largest_max_steps": max_steps,
    }
    minimise_again = partial(minimise_holding_infinite_points, **options)
    lengths, reduction = earlier.problem.lengths, earlier.reduction
    problem = make_problem(network, reduction=reduction, lengths=lengths)
    start = transfer_start_values(problem, earlier.problem, values)
    problem, minimum, removed, doubt = snoop_network(
        Inspection(problem, start),
        earlier.minimum,
        minimise_again,
        "pope",
        significance,
        doubtful,
    )
    state = _AdjustmentState(network, problem, minimum, earlier.method, reduction)
    # A minimum left for this one was left by the earlier adjustment.
    state.result_fields |= {
        "removed": tuple(removed),
        "doubts": (doubt,) if doubt else (),
        "second_minima": earlier.second_minima,
    }
    state.search_second_minima(partial(find_second_minima, minimise=minimise_again))
    return state.adjustment(earlier.check or split_check_points(network)[1:])


def _orient(network: Network, mirror: Callable[[float | None], str]) -> Oriented:
    """Start values of most of a network; an error also names mirrored control if that might explain
    it."""
    try:
        return require_most_oriented(network, orient(network))
    except NotSolvedError as error:
        if CONTRADICTORY_CONTROL in str(error) and (mirrored := mirror(None)):
            # The images decide which: of points in a plane both may fit the tolerance.
            raise NotSolvedError(f"{error}; or {mirrored}", [*error.undetermined]) from None
        raise


def _compare_with_start(given: Network, result: Adjustment) -> tuple[str, ...]:
    """What start values of images show about units and axes of a solution, in words."""
    images = result.problem.network.images
    has_start = np.isfinite(given.images.position).all(1) & np.isnan(given.images.sigma).all(1)
    free = {given.images.id[k] for k in np.flatnonzero(has_start)}
    adjusted_positions = {
        id: X for id, X in zip(images.id, result.image_values[:, :3]) if id in free
    }
    return tuple(
        filter(
            None,
            (
                name_unit_of_positions(given, adjusted_positions),
                name_other_side(given, adjusted_positions),
            ),
        )
    )


def _try_mirrored(
    reduction: str | None, options: Mapping[str, Any], network: Network
) -> float | None:
    """σ0 of a network from computed start values; None without a solution."""
    first_minimum = FirstMinimum(
        reduction, (), require_most_oriented(network, orient(network)), options
    )
    minimum = first_minimum.find(network, outliers=False)
    return sigma0_at_end(minimum.problem, minimum.minimum) if minimum.is_solved else None


@dataclasses.dataclass
class _AdjustmentState:
    """State of an adjustment; each step changes it."""

    network: Network
    problem: NetworkProblem
    minimum: Minimum
    method: str
    reduction: str
    result_fields: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Arguments of the `Adjustment`."""
    inspected: tuple[NetworkProblem, Minimum, Inspection | None] | None = None

    @property
    def inspection(self) -> Inspection | None:
        """The solution, if there is one; evaluated once until a step changes it."""
        inspected = self.inspected
        if (
            inspected is None
            or inspected[0] is not self.problem
            or inspected[1] is not self.minimum
        ):
            inspected = self.problem, self.minimum, inspect_solution(self.problem, self.minimum)
            self.inspected = inspected
        return inspected[2]

    def weight_robustly(self, minimise_again: Minimise, robust: str, significance: float) -> None:
        reweighted, self.minimum = adjust_robustly(
            self.problem, self.minimum, minimise_again, robust
        )
        suspects = (name_suspect(self.problem, s) for s in reweighted.suspects(significance))
        self.problem = cast(NetworkProblem, reweighted.solution.problem)
        doubt = doubt_of_robust(reweighted.scale, self.problem.counts.redundancy)
        self.result_fields |= {
            "robust": robust,
            "reweighted": reweighted,
            "suspects": tuple(suspects),
        }
        self.result_fields["doubts"] = (doubt,) if doubt else ()

    def remove_blunders(
        self,
        minimise_again: Minimise,
        test: str,
        significance: float,
        initially_removed: Iterable[tuple[str, str]],
    ) -> None:
        self.problem, self.minimum, removed, doubt = snoop_network(
            not_none(self.inspection),
            self.minimum,
            minimise_again,
            test,
            significance,
            initially_removed,
        )
        self.result_fields |= {"removed": tuple(removed), "doubts": (doubt,) if doubt else ()}

    def estimate_components(self, minimise_again: Minimise) -> None:
        self.problem, self.minimum, factors = with_components(
            self.problem, self.minimum, minimise_again
        )
        self.result_fields["sigma_factors"] = factors

    def eliminate_parameters(self, minimise_again: Minimise, critical_t: float) -> None:
        self.problem, self.minimum, names = eliminate_parameters(
            self.problem, self.minimum, minimise_again, critical_t
        )
        self.result_fields["eliminated"] = tuple(names)

    def search_second_minima(self, search: Callable) -> None:
        """Take the best minimum and keep those that remain; those left before remain known."""
        if self.inspection is None or not can_have_second(self.problem):
            return
        try:
            self.problem, self.minimum, minima = search(self.inspection, self.minimum)
        except (InputError, NotSolvedError, np.linalg.LinAlgError):
            # The result is as good as before the search.
            return
        superseded = [
            second_minimum
            for second_minimum in self.result_fields.get("second_minima", ())
            if second_minimum.taken
        ]
        superseded = [
            second_minimum
            for second_minimum in superseded
            if not is_reported(second_minimum, minima)
        ]
        self.result_fields["second_minima"] = (*minima, *superseded)

    def adjustment(self, check: tuple[Points, Observations]) -> Adjustment:
        """The result, or the reason why there is none."""
        problem, minimum, inspection = self.problem, self.minimum, self.inspection
        names = () if inspection else names_of_defects(problem, minimum)
        if not inspection and converged(int(minimum.termination)):
            names = names or UNNAMED
        unnamed = not inspection and not names
        return Adjustment(
            self.network,
            problem,
            minimum,
            undetermined=tuple(names),
            check=check if len(check[0]) else None,
            method=self.method,
            reduction=self.reduction,
            inspection=inspection,
            weakness=weakness_without_solution(problem, minimum) if unnamed else None,
            findings=likely_causes(problem, minimum, inspection),
            **self.result_fields,
        )


def _tell(
    progress: Progress,
    total: int,
    step: Int[AnyArray, ""],
    cost: Float[AnyArray, ""],
    damping: Float[AnyArray, ""],
) -> None:
    """An evaluation as `progress(stage, done, total)`."""
    stage = f"adjusting: vᵀPv {2 * float(cost):.8g}, λ {float(damping):.2g}"
    progress(stage, int(step), total)


def check_options(  # noqa: PLR0913 - the options of an adjustment
    *,
    method: str = "levenberg-marquardt",
    reduction: str | None = None,
    max_iterations: int = 100,
    robust: str | None = None,
    snooping: str | None = None,
    significance: float = 0.001,
    eliminate: bool = False,
    critical_t: float = 2.0,
    estimate_components: bool = False,
    correlated: bool = False,
    second_minimum: bool = True,
    progress: Progress | None = None,
) -> None:
    """Refuse invalid options of `adjust`.

    **Raises:** `InputError`, naming the option and what is expected."""
    one_of("method", method, METHODS)
    one_of("reduction", reduction, REDUCTIONS, allow_none=True)
    integer("max_iterations", max_iterations)
    one_of("robust", robust, ESTIMATORS, allow_none=True)
    check_test(snooping, significance)
    if robust and snooping:
        raise InputError("robust estimation or data snooping, not both at once")
    truth("eliminate", eliminate)
    at_least_zero("critical_t", critical_t)
    truth("estimate_components", estimate_components)
    truth("correlated", correlated)
    truth("second_minimum", second_minimum)
    if progress is not None and not callable(progress):
        raise InputError(f"progress must be a function, but is {show(progress)}")
