"""The sizes of the error components of a batch, and σ under them.

The sizes θ ≥ 0 of T·θ = q (`correlated`) are estimated for each camera, or for a whole batch from
the sums of T and q; the size of the independent part is always that of the camera. As estimates
they are widened by the rule of `leastsquares.quality.estimated_sizes`.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbundle.adjustment.quality.correlated_errors import DEFAULTS, CorrelationSettings
from jaxbundle.batches.correlated import ComponentForms, ComponentParts
from jaxbundle.batches.error_spans import COMPONENTS, FIELD, GIVEN, TRACKS
from jaxbundle.batches.error_traces import SUMS, ComponentTraces
from jaxbundle.leastsquares.quality.estimated_sizes import SizeEquations, widening, widenings
from jaxbundle.leastsquares.quality.size_traces import with_traces


class BatchErrors(NamedTuple):
    """Sizes √θ of the `COMPONENTS` [cameras, k] (NaN where a camera cannot show one), and of every
    camera the covariance of the interior orientation and the variances of the poses under them."""

    sizes: Float[np.ndarray, "cameras k"]
    covariance: Float[np.ndarray, "cameras n n"]
    pose: Float[np.ndarray, "cameras views 6"]


class BatchSums(NamedTuple):
    """What the errors of a batch are estimated from: `forms` of the residuals of all cameras, and
    the `traces` of those that are `traced`; of the independent part of each camera the redundancy,
    and the covariance of the interior orientation and the variances of the poses for σ0 = 1."""

    forms: ComponentForms
    traces: ComponentTraces
    traced: Bool[np.ndarray, " cameras"]
    redundancy: Float[np.ndarray, " cameras"]
    interior: Float[np.ndarray, "cameras n n"]
    pose: Float[np.ndarray, "cameras views 6"]


class BatchPrograms(NamedTuple):
    """What is computed of cameras when it is known for which: from θ of all cameras the covariances
    of their forms q; the parts of components that are wanted."""

    scatter: Callable[[Float[np.ndarray, "cameras k"]], Float[np.ndarray, "cameras k k"]]
    parts: Callable[[Bool[np.ndarray, "cameras k"]], ComponentParts]


def batch_errors(
    sums: BatchSums,
    views: np.ndarray,
    points: np.ndarray,
    together: bool,
    programs: BatchPrograms,
    settings: CorrelationSettings = DEFAULTS,
) -> BatchErrors:
    """σ of all cameras under errors that their image points share.

    **Arguments:** `sums` of all cameras; `views` and image `points` used of each; `together`: one
    set of sizes for all cameras, else one for each; `programs`: of components whose size is not
    zero. A camera with fewer than `settings.min_images` views has no components by view, with fewer
    image points no field, with fewer given points than `settings.min_given_points` none of these.
    """
    traces = sums.traces
    cubes = np.zeros_like(traces.cubes)
    for n in np.flatnonzero(sums.traced).tolist():
        cubes[n] = with_traces(traces.cubes[n], traces.T[n])
    sums = sums._replace(traces=traces._replace(cubes=cubes))
    shown = _shown(sums, views, points, settings)
    critical = settings.estimation.critical(len(COMPONENTS) - 1)
    find = _common_sizes if together else _sizes_of_each
    theta, parts = find(sums, shown, critical, programs)
    # A camera without sizes has no σ: zero would read as without any error.
    none = np.isnan(theta).all(1, keepdims=True)
    used = np.where(none, np.nan, np.nan_to_num(theta))
    covariance = np.einsum("nk,nkij->nij", parts.factor * used, parts.interior)
    variance = np.einsum("nk,nkvi->nvi", parts.factor * used, parts.pose)
    return BatchErrors(np.sqrt(theta), covariance, variance)


def _shown(
    sums: BatchSums, views: np.ndarray, points: np.ndarray, settings: CorrelationSettings
) -> Bool[np.ndarray, "cameras k"]:
    """Which components every camera can show."""
    shown = np.ones(sums.forms.q.shape, bool)
    shown[:, FIELD:TRACKS] = (views >= settings.min_images)[:, None]
    shown[:, FIELD] &= points >= settings.min_points_of_field
    shown[:, TRACKS] = views > 1
    shown[:, GIVEN:] = (sums.forms.given >= settings.min_given_points)[:, None]
    sound = np.isfinite(sums.forms.q).all(1) & np.isfinite(sums.traces.T).all((1, 2))
    return shown & np.asarray(sound)[:, None]


class SizedParts(NamedTuple):
    """The parts of all components and cameras, zero of those without errors, and the factors of θ
    in covariances (`widening`)."""

    factor: Float[np.ndarray, "cameras k"]
    interior: Float[np.ndarray, "cameras k n n"]
    pose: Float[np.ndarray, "cameras k views 6"]

    @staticmethod
    def of(sums: BatchSums, parts: ComponentParts | None) -> "SizedParts":
        """Without any widening; None: independent errors alone."""
        factor = np.ones(sums.forms.q.shape)
        if parts is None:
            interior, pose = (
                np.zeros((*factor.shape, *x.shape[1:])) for x in (sums.interior, sums.pose)
            )
        else:
            interior, pose = np.array(parts.interior), np.array(parts.pose)
        interior[:, 0], pose[:, 0] = sums.interior, sums.pose
        return SizedParts(factor, interior, pose)

    def tables(
        self, some: Int[np.ndarray, " n"], of: Int[np.ndarray, " k"]
    ) -> list[Float[np.ndarray, "n k unknowns"]]:
        """The variances that components of θ = 1 give the unknowns of some cameras, and of their
        views."""
        block = np.ix_(some, of)
        interior = np.diagonal(self.interior[block], axis1=2, axis2=3)
        pose = self.pose[block].reshape(len(some), len(of), -1)
        return [np.nan_to_num(interior), np.nan_to_num(pose)]


def _sizes_of_each(
    sums: BatchSums, shown: Bool[np.ndarray, "cameras k"], critical: float, programs: BatchPrograms
) -> tuple[Float[np.ndarray, "cameras k"], SizedParts]:
    """θ of every camera from its own residuals."""
    (T, cubes), q = sums.traces, sums.forms.q
    theta = np.full(shown.shape, np.nan)
    for n in np.flatnonzero(shown[:, 0]).tolist():
        of = np.flatnonzero(shown[n])
        block = np.ix_(of, of), np.ix_(of, of, of)
        equations = SizeEquations(T[n][block[0]], False, critical, cubes[n][block[1]])
        theta[n, of] = equations.solve(q[n][of])[0]
    used: np.ndarray = np.nan_to_num(theta) > 0
    shared = np.asarray(used[:, 1:].any(1))
    if not shared.any():
        return theta, SizedParts.of(sums, None)
    parts = SizedParts.of(sums, programs.parts(used & shared[:, None]))
    forms = programs.scatter(np.where(shared[:, None], np.nan_to_num(theta), 0.0))
    for n in np.flatnonzero(shared).tolist():
        of = np.flatnonzero(shown[n])
        block = np.ix_(of, of)
        known = theta[n, of], T[n][block], forms[n][block]
        tables = [table[0] for table in parts.tables(np.array([n]), of)]
        parts.factor[n, of] = widening(*known, tables)
    return theta, parts


def _common_sizes(
    sums: BatchSums, shown: Bool[np.ndarray, "cameras k"], critical: float, programs: BatchPrograms
) -> tuple[Float[np.ndarray, "cameras k"], SizedParts]:
    """The same with one set of sizes, from the cameras that show most components, which others
    take over; θ of the independent part is that of every camera."""
    (T, cubes), q = sums.traces, sums.forms.q
    theta = np.full(shown.shape, np.nan)
    known = np.flatnonzero(shown[:, 0])
    # E q_0 = Σ θ_k·tr(M·V_k): what the common sizes leave of a camera's own vᵀv
    white = lambda shared: np.clip((q[known, 0] - shared) / sums.redundancy[known], 0, None)
    if not (shown[:, 0] & sums.traced).any():
        # Without any traces independent errors alone.
        theta[known, 0] = white(0.0)
        return theta, SizedParts.of(sums, None)
    of = np.flatnonzero(shown[np.argmax(shown.sum(1) * sums.traced)])
    block = np.ix_(of, of)
    good = np.flatnonzero(shown[:, of].all(1))
    traced = good[sums.traced[good]]
    # q is the sum of all cameras, T of those with traces: scaled to as many
    times = len(good) / len(traced)
    together = times * T[traced].sum(0)[block]
    of_three = times * cubes[traced].sum(0)[np.ix_(of, of, of)]
    common = SizeEquations(together, False, critical, of_three).solve(q[good].sum(0)[of])[0]
    theta[np.ix_(known, of)] = common
    if not common[1:].any():
        theta[known, 0] = white(0.0)
        return theta, SizedParts.of(sums, None)
    wanted = np.zeros(shown.shape, bool)
    wanted[np.ix_(known, of)] = common > 0
    found = programs.parts(wanted)
    theta[known, 0] = white(found.remaining[known][:, of[1:]] @ common[1:])
    parts = SizedParts.of(sums, found)
    if len(traced) >= 2 * SUMS.draws:
        # q of that many cameras are draws themselves, of errors as they are
        away = q[traced][:, of] - T[traced][:, of][..., of] @ common
        forms = times * away.T @ away
    else:
        forms = times * programs.scatter(np.nan_to_num(theta))[traced].sum(0)[block]
    tables = parts.tables(known, of)
    parts.factor[np.ix_(known, of)] = widenings(theta[np.ix_(known, of)], together, forms, tables)
    return theta, parts
