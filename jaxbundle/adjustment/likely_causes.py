"""Likely causes of a missing solution or a bad fit: units, conventions, contradictory control."""

import dataclasses

import numpy as np

from jaxbundle.adjustment.minimum import name_inseparable, name_undefined
from jaxbundle.adjustment.problem import NetworkProblem
from jaxbundle.adjustment.quality.inspection import Inspection
from jaxbundle.adjustment.quality.misfit import contradicts
from jaxbundle.leastsquares.iterations.solver import Minimum
from jaxbundle.network.noise import noise_of_rays
from jaxbundle.network.tables import UNIT, Network
from jaxbundle.network.unit_mistakes import (
    name_lengths,
    name_pixels,
    name_sigma_unit,
)
from jaxbundle.orientation.angle_conventions import name_angle_convention
from jaxbundle.orientation.image_conventions import name_image_convention, name_image_extent
from jaxbundle.orientation.one_place import name_one_place
from jaxbundle.orientation.swapped_control import CONTRADICTORY_CONTROL, name_contradiction


@dataclasses.dataclass(frozen=True)
class CauseSettings:
    """When a fit is so bad that its causes are looked for.

    - `max_sigma0`: σ0 above which the fit is called bad, and the largest by which the a priori σ
      of rays are multiplied where points are judged: what is beyond comes from blunders, a wrong
      camera, unit or axis, not from the rays. Smaller: causes are named for networks that only
      have optimistic σ; larger: a mirrored image of a nearly plane object, which fits almost as
      well, is not looked for.
    - `max_ray_misfit`: radians, RMS; takes the place of `max_sigma0` where σ are only units of
      weight: a pixel of cameras with 1000 pixels in the principal distance. A search that finds
      nothing costs time only.
    - `max_start_misfit`: radians, RMS of the residuals of the start values: from start values in
      the right convention that predict image points so badly no adjustment settles. 0.1 is 6°.
      Smaller: rough start values are suspected of another convention; larger: a mirrored network
      that settles is not named.
    """

    max_sigma0: float = 5.0
    max_ray_misfit: float = 1e-3
    max_start_misfit: float = 0.1


CAUSES = CauseSettings()


def likely_causes(
    problem: NetworkProblem, minimum: Minimum, inspection: Inspection | None
) -> tuple[str, ...]:
    """Likely causes of a missing solution or a bad fit, in words."""
    network = problem.network
    steps = int(minimum.iterations)
    is_accepted = np.asarray(minimum.history.accepted)[:steps]
    vtpv = 2 * np.asarray(minimum.history.cost)[:steps][is_accepted][-1:]
    largest = largest_sigma0(network)
    # Without redundancy vᵀPv is rounding, and no misfit.
    poor_fit = (vtpv > largest**2 * problem.counts.redundancy).any()
    if inspection and not (poor_fit and problem.counts.redundancy > 0):
        # A good fit may still be wrong: settled far from its start it may be a mirror image, and
        # σ in a larger unit fit everything.
        start_misfit = np.sqrt(
            2 * np.asarray(minimum.history.cost)[0] / problem.rows_and_unknowns.observations
        )
        is_far = start_misfit * noise_of_rays(problem.network) > CAUSES.max_start_misfit
        sigma0 = sigma0_at_end(problem, minimum)
        poor = sigma0 > 1 and contradicts(sigma0, problem.counts.redundancy)
        causes = (
            name_image_convention(network) if is_far else "",
            name_image_extent(network) if poor else "",
            name_sigma_unit(network, sigma0),
        )
        return tuple(filter(None, causes))
    if not inspection and (undefined := name_undefined(problem, minimum)):
        return (undefined,)
    is_told = any(CONTRADICTORY_CONTROL in line for line in network.warnings)
    conventions = name_conventions(problem, minimum, inspection)
    causes = (
        *conventions,
        # Control fits no mirrored image, and its points would be blamed for it: conventions
        # first.
        "" if is_told or conventions else name_contradiction(network),
        "" if inspection else name_one_place(network),
        "" if inspection else name_inseparable(problem, minimum),
    )
    return tuple(filter(None, causes))


def name_conventions(
    problem: NetworkProblem, minimum: Minimum, inspection: Inspection | None
) -> tuple[str, ...]:
    """Units and conventions in which a badly fitting network would fit, in words."""
    network = problem.network
    causes = (
        name_pixels(network),
        name_angle_convention(network),
        *name_lengths(network),
        name_image_convention(network),
        name_image_extent(network),
        name_sigma_unit(network, sigma0_at_end(problem, minimum)) if inspection else "",
    )
    return tuple(filter(None, causes))


def largest_sigma0(network: Network) -> float:
    """The largest σ0 of a network without mistakes; it depends on the unit of weight, if σ is no
    more than that."""
    if network.observations.sigma_origin != UNIT:
        return CAUSES.max_sigma0
    return CAUSES.max_ray_misfit / noise_of_rays(network)


def noise_factor(problem: NetworkProblem, minimum: Minimum) -> float:
    """By what the σ of rays are multiplied; a larger σ0 is that of blunders or a wrong camera, not
    of the rays."""
    return min(sigma0_at_end(problem, minimum), largest_sigma0(problem.network))


def sigma0_at_end(problem: NetworkProblem, minimum: Minimum) -> float:
    """√(vᵀPv/redundancy) where the iterations ended; 1 without redundancy or a finite vᵀPv."""
    cost = np.asarray(minimum.history.cost)[: int(minimum.iterations)]
    is_accepted = np.asarray(minimum.history.accepted)[: int(minimum.iterations)]
    vtpv, redundancy = 2 * cost[is_accepted][-1:], problem.counts.redundancy
    is_known = len(vtpv) and redundancy > 0 and np.isfinite(vtpv[0])
    return float(np.sqrt(vtpv[0] / redundancy)) if is_known else 1.0
