"""The sizes of the error components of a batch, and σ under them.

The sizes θ ≥ 0 of T·θ = q (`correlated`) are estimated for each camera, or for a whole batch from
the sums of T and q; the size of the independent part is always that of the camera. As estimates
they are widened by the rule of `leastsquares.quality.estimated_sizes`.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxbundle.adjustment.quality.correlated_errors import DEFAULTS, CorrelationSettings
from jaxbundle.batches.correlated import (
    COMPONENTS,
    FIELD,
    GIVEN,
    SUMS,
    TRACKS,
    ComponentSums,
)
from jaxbundle.leastsquares.quality.estimated_sizes import SizeEquations, widening
from jaxbundle.leastsquares.quality.size_traces import with_traces


class BatchErrors(NamedTuple):
    """Sizes √θ of the `COMPONENTS` [cameras, k] (NaN where a camera cannot show one), and of every
    camera the covariance of the interior orientation and the variances of the poses under them."""

    sizes: Float[np.ndarray, "cameras k"]
    covariance: Float[np.ndarray, "cameras n n"]
    pose: Float[np.ndarray, "cameras views 6"]


# From θ of all cameras the covariances of their forms q.
Scatter = Callable[[Float[np.ndarray, "cameras k"]], Float[np.ndarray, "cameras k k"]]


def batch_errors(
    sums: ComponentSums,
    views: np.ndarray,
    points: np.ndarray,
    together: bool,
    scatter: Scatter,
    settings: CorrelationSettings = DEFAULTS,
) -> BatchErrors:
    """σ of all cameras under errors that their image points share.

    **Arguments:** `sums` of all cameras, arrays of the host; `views` and image `points` used of
    each; `together`: one set of sizes for all cameras, else one for each; `scatter`: gives the
    covariances of the forms q under errors of given sizes. A camera with fewer than
    `settings.min_images` views has no components by view, with fewer image points no field, with
    fewer given points than `settings.min_given_points` none of these.
    """
    sums = ComponentSums(*(np.asarray(x) for x in sums))
    cubes = np.stack([with_traces(*one) for one in zip(sums.cubes, sums.T)])
    sums = sums._replace(cubes=cubes)
    shown = _shown(sums, views, points, settings)
    critical = settings.estimation.critical(len(COMPONENTS) - 1)
    find = _common_sizes if together else _sizes_of_each
    theta, factor = find(sums, shown, critical, scatter)
    known, none = np.nan_to_num(factor * theta), np.isnan(theta).all(1)
    covariance = np.einsum("nk,nkij->nij", known, np.nan_to_num(sums.interior))
    variance = np.einsum("nk,nkvi->nvi", known, np.nan_to_num(sums.pose))
    # zero would read as without any error
    covariance[none], variance[none] = np.nan, np.nan
    return BatchErrors(np.sqrt(theta), covariance, variance)


def _shown(
    sums: ComponentSums, views: np.ndarray, points: np.ndarray, settings: CorrelationSettings
) -> Bool[np.ndarray, "cameras k"]:
    """Which components every camera can show."""
    shown = np.ones(sums.q.shape, bool)
    shown[:, FIELD:TRACKS] = (views >= settings.min_images)[:, None]
    shown[:, FIELD] &= points >= settings.min_points_of_field
    shown[:, TRACKS] = views > 1
    shown[:, GIVEN] = sums.given >= settings.min_given_points
    sound = np.isfinite(sums.q).all(1) & np.isfinite(sums.T).all((1, 2))
    return shown & np.asarray(sound)[:, None]


Sizes = tuple[Float[np.ndarray, "cameras k"], Float[np.ndarray, "cameras k"]]


def _sizes_of_each(
    sums: ComponentSums, shown: Bool[np.ndarray, "cameras k"], critical: float, scatter: Scatter
) -> Sizes:
    """θ of every camera from its own residuals, and what they are multiplied by in covariances."""
    theta, factor = np.full(shown.shape, np.nan), np.ones(shown.shape)
    for n in np.flatnonzero(shown[:, 0]).tolist():
        of = np.flatnonzero(shown[n])
        block = np.ix_(of, of), np.ix_(of, of, of)
        traces = sums.T[n][block[0]], sums.cubes[n][block[1]]
        equations = SizeEquations(traces[0], False, critical, traces[1])
        theta[n, of] = equations.solve(sums.q[n][of])[0]
    shared = np.asarray(np.nan_to_num(theta[:, 1:]).any(1))
    if shared.any():
        forms = scatter(np.where(shared[:, None], np.nan_to_num(theta), 0.0))
        for n in np.flatnonzero(shared).tolist():
            block = np.ix_(*[np.flatnonzero(shown[n])] * 2)
            tables = [parts[shown[n]] for parts in _tables(sums, n)]
            known = theta[n, shown[n]], sums.T[n][block], forms[n][block]
            factor[n, shown[n]] = widening(*known, tables)
    return theta, factor


def _common_sizes(
    sums: ComponentSums, shown: Bool[np.ndarray, "cameras k"], critical: float, scatter: Scatter
) -> Sizes:
    """The same with one set of sizes, from the cameras that show most components, which others
    take over; θ of the independent part is that of every camera."""
    T, q = sums.T, sums.q
    theta, factor = np.full(shown.shape, np.nan), np.ones(shown.shape)
    known = np.flatnonzero(shown[:, 0])
    if not (shown[:, 0] & sums.traced).any():
        # without any traces independent errors alone
        theta[known, 0] = np.clip(q[known, 0] / T[known, 0, 0], 0, None)
        return theta, factor
    of = np.flatnonzero(shown[np.argmax(shown.sum(1) * sums.traced)])
    block = np.ix_(of, of)
    good = np.flatnonzero(shown[:, of].all(1))
    traced = good[sums.traced[good]]
    # q is the sum of all cameras, T of those with traces: scaled to as many
    times = len(good) / len(traced)
    together = times * T[traced].sum(0)[block]
    cubes = times * sums.cubes[traced].sum(0)[np.ix_(of, of, of)]
    common = SizeEquations(together, False, critical, cubes).solve(q[good].sum(0)[of])[0]
    theta[np.ix_(known, of)] = common
    # E q_0 = Σ θ_k·tr(M·V_k): what the common sizes leave of a camera's own vᵀv
    shared = T[known][:, 0, of[1:]] @ common[1:]
    theta[known, 0] = np.clip((q[known, 0] - shared) / T[known, 0, 0], 0, None)
    if common[1:].any():
        if len(traced) >= 2 * SUMS.draws:
            # q of that many cameras are draws themselves, of errors as they are
            away = q[traced][:, of] - T[traced][:, of][..., of] @ common
            forms = times * away.T @ away
        else:
            forms = times * scatter(np.nan_to_num(theta))[traced].sum(0)[block]
        for n in known.tolist():
            tables = [parts[of] for parts in _tables(sums, n)]
            factor[n, of] = widening(theta[n, of], together, forms, tables)
    return theta, factor


def _tables(sums: ComponentSums, n: int) -> list[Float[np.ndarray, "k unknowns"]]:
    """The variances that components of θ = 1 give the unknowns of a camera, and of its views."""
    interior = np.diagonal(sums.interior[n], axis1=1, axis2=2)
    return [np.nan_to_num(interior), np.nan_to_num(sums.pose[n].reshape(len(COMPONENTS), -1))]
