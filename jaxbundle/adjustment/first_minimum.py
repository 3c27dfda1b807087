"""The first minimum of a network: from start values, without what its rays do not determine."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from jaxbundle.adjustment.exclusions import (
    CollinearGeometry,
    find_collinear,
    may_be_collinear,
    readmit,
    transfer_start_values,
)
from jaxbundle.adjustment.far_points import (
    concatenate_runs,
    minimise_with_far_points,
)
from jaxbundle.adjustment.likely_causes import (
    noise_factor,
)
from jaxbundle.adjustment.minimum import (
    adjusted_cameras,
    inspect_solution,
    is_misjudged,
    start_with,
)
from jaxbundle.adjustment.orient import orient_again, screen
from jaxbundle.adjustment.problem import NetworkProblem, make_problem
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.leastsquares.declarations import ObservationSet, Table
from jaxbundle.leastsquares.indexing.rows import Values
from jaxbundle.leastsquares.iterations.solver import Minimum
from jaxbundle.leastsquares.iterations.stopping import converged
from jaxbundle.leastsquares.problem import with_data, with_factor
from jaxbundle.leastsquares.solution import find_minimum
from jaxbundle.network.check import check_network
from jaxbundle.network.columns import count, list_some
from jaxbundle.network.equation_counts import name_undetermined_points
from jaxbundle.network.kinds.figures import KNOWN_SHAPES, sigma_across_rays
from jaxbundle.network.subsets import split_check_points
from jaxbundle.network.tables import Network, Observations, Points
from jaxbundle.network.unit_mistakes import (
    name_pixels,
)
from jaxbundle.orientation.image_conventions import name_image_extent
from jaxbundle.orientation.network import Oriented


@dataclasses.dataclass(frozen=True)
class RoundSettings:
    """When the rounds of an adjustment exclude and readmit.

    - `evaluations_before_check`: evaluations before points that rays may not determine are
      searched for: the images are then nearly where they end. More: such points drift away
      meanwhile and slow the iterations; fewer: images that still move make points look weak that
      are not.
    - `max_retries`: repeated adjustments with what start values excluded. Each readmits what
      agrees with a better orientation, most of it the first; what is left after five is reported
      in a warning.
    - `soft_sigma`: least σ of the points of known shapes, relative to that of a point across a ray,
      with which values to begin from are computed. A shape that turns moves its points along arcs,
      a step along tangents: exact conditions allow short steps only. Boards seen through water
      (`benchmarks/refraction.py`, 5 cameras, 15 frames) take 74 iterations with exact conditions
      alone; with those before them 24 and 5 (0.01), 7 and 6 (0.1), 8 and 7 (0.3).
    """

    evaluations_before_check: int = 6
    max_retries: int = 5
    soft_sigma: float = 0.1


ROUNDS = RoundSettings()


class FoundMinimum(NamedTuple):
    """Where the iterations of a network ended.

    `check`: check points and their image points; `collinear`: what was left out because rays do
    not determine it; `network`: what was adjusted, with its check points."""

    problem: NetworkProblem
    minimum: Minimum
    check: tuple[Points, Observations]
    collinear: CollinearGeometry
    network: Network

    @property
    def is_solved(self) -> bool:
        return inspect_solution(with_factor(self.problem), self.minimum) is not None


@dataclasses.dataclass(frozen=True)
class FirstMinimum:
    """How the first minimum is found; `oriented`: computed start values, if they were needed."""

    reduction: str | None
    also: Sequence[Table | ObservationSet]
    oriented: Oriented | None
    options: Mapping[str, Any]
    settings: RoundSettings = ROUNDS

    def find(self, network_as_given: Network, outliers: bool) -> FoundMinimum:
        """Adjust from the start values of `network_as_given`, which may contain `outliers`, or
        those computed for it."""
        network = network_as_given if self.oriented is None else self.oriented.network
        found_minimum = self._minimise(network)
        # Observations excluded because of a wrong principal distance may agree with the adjusted
        # one: start values are computed again with it, as long as that uses more of them.
        while len(network.observations) < len(network_as_given.observations) and is_misjudged(
            found_minimum.problem, found_minimum.minimum
        ):
            cameras, unscreened = (
                adjusted_cameras(found_minimum.problem, found_minimum.minimum.values),
                network,
            )
            network = orient_again(network_as_given, unscreened, cameras)
            if network is unscreened:
                break
            found_minimum = self._minimise(network, partial(start_with, cameras=cameras))
        # Blunders may keep the iterations from a solution that snooping could start from: those
        # that contradict the start values by far are removed first.
        if outliers and not found_minimum.is_solved:
            screened = screen(network)
            if len(screened.observations) < len(network.observations):
                found_minimum, network = self._minimise(screened), screened
        left_out = (
            network is not network_as_given and network.left_out[len(network_as_given.left_out) :]
        )
        return (
            self._try_again(network_as_given, found_minimum)
            if left_out or found_minimum.collinear
            else found_minimum
        )

    def _try_again(self, network_as_given: Network, found_minimum: FoundMinimum) -> FoundMinimum:
        """Adjust again, with everything left out because of start values that agrees with the
        adjusted orientation, until nothing more does."""
        if self.oriented is not None:
            network_as_given = network_as_given.note(f"start values found, {self.oriented.frame}")
            network_as_given = network_as_given.warn(*filter(None, [self.oriented.finding]))
        # Excluded because of start values is not excluded for good: a point that misses by three
        # tolerances of a rough orientation may fit the adjusted one to its σ. What rays do not
        # determine (`final`) stays out, or it would return and leave in every round.
        rounds, final = 0, CollinearGeometry()
        while found_minimum.is_solved:
            problem, minimum, _, collinear, current = found_minimum
            # What the first minimum leaves undetermined may only be so because of what was still
            # missing.
            if rounds:
                final += collinear
            candidates, factor = final.leave_out(network_as_given), noise_factor(problem, minimum)
            try:
                larger = readmit(candidates, current, problem, minimum.values, factor)
                larger = check_network(larger)
                gained = len(larger.observations) - len(current.observations)
                if gained <= 0 or rounds == self.settings.max_retries:
                    if gained > 0:
                        larger = larger.warn(
                            f"{count(gained, 'image point')} left out because of start values "
                            f"would still come back after {rounds} repeated adjustments"
                        )
                    network = problem.network.replace(
                        warnings=larger.warnings, notes=larger.notes, left_out=larger.left_out
                    )
                    return found_minimum._replace(
                        problem=dataclasses.replace(problem, network=network)
                    )
                begin = partial(transfer_start_values, earlier=problem, values=minimum.values)
                tried = self._minimise(larger, begin, check_early=False)
                solved = tried.is_solved
            except (InputError, NotSolvedError):
                solved = False
            if not solved:
                network = problem.network.warn(
                    "what start values excluded was tried again with the adjusted orientation, "
                    "but with it there is no solution"
                )
                return found_minimum._replace(problem=dataclasses.replace(problem, network=network))
            found_minimum, rounds = tried, rounds + 1
        return found_minimum

    def _minimise(
        self,
        network: Network,
        begin: Callable[[NetworkProblem], Values] | None = None,
        check_early: bool = True,
    ) -> FoundMinimum:
        """The minimum of a network without what its rays do not determine; `begin`: gives the
        values to begin from (default: start values); `check_early`: whether what rays do not
        determine is searched for before the minimum, too."""
        # What rays do not determine is searched for three times: at the start values (cheap, but
        # they may be poor), after a few evaluations (before such points slow the iterations down),
        # and at the minimum. Each exclusion begins again from where the last iterations ended.
        excluded, factor = CollinearGeometry(), None
        while True:
            current = check_network(excluded.leave_out(network))
            used_network, points, observations = split_check_points(current)
            make = partial(make_problem, used_network, reduction=self.reduction, also=self.also)
            problem = self._make_problem(make)
            start = self._soften(problem) if begin is None else begin(problem)
            remaining_steps = self.options["max_steps"]
            runs: list[Minimum] = []
            find_more = partial(self._find_more, network, excluded)
            newly_found = find_more(problem, start, factor) if check_early else CollinearGeometry()
            if not newly_found and check_early and may_be_collinear(problem, start):
                check_early, first_steps = (
                    False,
                    min(self.settings.evaluations_before_check, remaining_steps),
                )
                run = find_minimum(problem, start, **{**self.options, "max_steps": first_steps})
                runs, remaining_steps = [run], remaining_steps - int(run.iterations)
                factor, start = noise_factor(problem, run), run.values
                newly_found = find_more(problem, start, factor)
                begin = partial(transfer_start_values, earlier=problem, values=start)
            if not newly_found:
                if remaining_steps > 0:
                    options = {**self.options, "max_steps": remaining_steps}
                    # Points at any distance make another problem.
                    problem, run = minimise_with_far_points(problem, start, make, **options)
                    runs.append(run)
                minimum = concatenate_runs(runs)
                factor = noise_factor(problem, minimum)
                newly_found = find_more(problem, minimum.values, factor)
                begin = partial(transfer_start_values, earlier=problem, values=minimum.values)
                if not newly_found:
                    return FoundMinimum(problem, minimum, (points, observations), excluded, current)
            excluded += newly_found

    def _make_problem(self, make: Callable[[], NetworkProblem]) -> NetworkProblem:
        """`make()`; an error also says why control points were excluded."""
        try:
            return make()
        except InputError as error:
            # Without the control points that were excluded the datum may be open; `orient` has
            # said why they were.
            finding = "" if self.oriented is None else self.oriented.finding
            raise InputError(f"{error} {finding}".strip()) from None

    def _soften(self, problem: NetworkProblem) -> Values:
        """The values to begin from: start values, or where they lead if the conditions of known
        shapes hold them less. The iterations are not counted among those of the adjustment."""
        start, weights = problem.data.start, problem.data.weight
        if KNOWN_SHAPES not in weights:
            return start
        stiff = np.asarray(weights[KNOWN_SHAPES])
        soft = np.minimum(
            stiff, 1 / (self.settings.soft_sigma * sigma_across_rays(problem.network))
        )
        if not (soft < stiff).any():
            return start
        data = dataclasses.replace(problem.data, weight={**weights, KNOWN_SHAPES: soft})
        softened = find_minimum(with_data(problem, data), start, **self.options)
        return softened.values if converged(softened.termination) else start

    @staticmethod
    def _find_more(network: Network, excluded: CollinearGeometry, *where: Any) -> CollinearGeometry:
        """What rays leave undetermined beside the `excluded`; nothing if together these were most
        of the network."""
        newly_found = find_collinear(*where)
        return (
            newly_found
            if (excluded + newly_found).leaves_majority_of(network)
            else CollinearGeometry()
        )


def require_most_oriented(network_as_given: Network, oriented: Oriented) -> Oriented:
    """The start values of a network unchanged; refused if they exclude half or more of the images,
    or of the points that start values can make determinable.

    **Raises:** `NotSolvedError`."""
    network = oriented.network
    # Tie points of a single photograph say nothing about its orientation: they are left out of any
    # network. Without other points they are why nothing can be solved.
    undetermined = name_undetermined_points(network_as_given) if len(network.points) else ()
    missing_points = {
        id: why for id, why in oriented.points_not_placed.items() if id not in undetermined
    }
    # A half that is placed may be the wrong half: with so little, what is excluded says more about
    # the network than what is left.
    for thing, reasons, remaining in (
        ("image", oriented.images_not_placed, len(network.images)),
        ("point", missing_points, len(network.points)),
    ):
        if len(reasons) >= remaining:
            reasons_in_words = list_some(
                (f"{thing} {id} ({why})" for id, why in reasons.items()), 5, str
            )
            causes = filter(None, (name_pixels(network), name_image_extent(network)))
            cause = "; ".join(causes)
            raise NotSolvedError(
                f"not solved: no start values for {len(reasons)} of "
                f"{count(len(reasons) + remaining, thing)}: {reasons_in_words}; jaxbundle orient "
                "lists them all" + (f"; {cause}" if cause else ""),
                [f"{thing} {id}" for id in reasons],
            )
    return oriented
