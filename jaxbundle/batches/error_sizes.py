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
    """What the errors of a batch are estimated from: the `forms` of the residuals and the `traces`
    of the cameras that are `sampled`, and vᵀv of the others; of the independent part of each camera
    the redundancy, and the covariance of the interior orientation and the variances of the poses
    for σ0 = 1."""

    forms: ComponentForms
    traces: ComponentTraces
    sampled: Bool[np.ndarray, " cameras"]
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
    common: bool,
    programs: BatchPrograms,
    settings: CorrelationSettings = DEFAULTS,
) -> BatchErrors:
    """σ of all cameras under errors that their image points share.

    **Arguments:** `sums` of all cameras; `views` and image `points` used of each; `common`: one
    set of sizes for all cameras, else one for each; `programs`: of components whose size is not
    zero. A camera with fewer than `settings.min_images` views has no components by view, with fewer
    image points no field, with fewer given points than `settings.min_given_points` none of these.
    """
    traces = sums.traces
    cubes = np.zeros_like(traces.cubes)
    for n in np.flatnonzero(sums.sampled).tolist():
        cubes[n] = with_traces(traces.cubes[n], traces.T[n])
    sums = sums._replace(traces=traces._replace(cubes=cubes))
    can_show = _can_show(sums, views, points, settings)
    critical = settings.estimation.critical(len(COMPONENTS) - 1)
    find = _common_sizes if common else _sizes_of_each
    theta, parts = find(sums, can_show, critical, programs)
    # A camera without sizes has no σ: zero would read as without any error.
    has_none = np.isnan(theta).all(1, keepdims=True)
    theta_used = np.where(has_none, np.nan, np.nan_to_num(theta))
    covariance = np.einsum("nk,nkij->nij", parts.factor * theta_used, parts.interior)
    variance = np.einsum("nk,nkvi->nvi", parts.factor * theta_used, parts.pose)
    return BatchErrors(np.sqrt(theta), covariance, variance)


def _can_show(
    sums: BatchSums, views: np.ndarray, points: np.ndarray, settings: CorrelationSettings
) -> Bool[np.ndarray, "cameras k"]:
    """Which components every camera can show."""
    can_show = np.ones(sums.forms.q.shape, bool)
    can_show[:, FIELD:TRACKS] = (views >= settings.min_images)[:, None]
    can_show[:, FIELD] &= points >= settings.min_points_of_field
    can_show[:, TRACKS] = views > 1
    can_show[:, GIVEN:] = (sums.forms.given >= settings.min_given_points)[:, None]
    can_show[:, 1:] &= sums.sampled[:, None]
    sound = np.isfinite(sums.forms.q).all(1) & np.isfinite(sums.traces.T).all((1, 2))
    return can_show & np.asarray(sound)[:, None]


class SizedParts(NamedTuple):
    """The parts of all components and cameras, zero of those without errors, and the factors of θ
    in covariances (`widening`)."""

    factor: Float[np.ndarray, "cameras k"]
    interior: Float[np.ndarray, "cameras k n n"]
    pose: Float[np.ndarray, "cameras k views 6"]

    @staticmethod
    def from_sums(sums: BatchSums, parts: ComponentParts | None) -> "SizedParts":
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
        self, cameras: Int[np.ndarray, " n"], components: Int[np.ndarray, " k"]
    ) -> list[Float[np.ndarray, "n k unknowns"]]:
        """The variances that components of θ = 1 give the unknowns of some cameras, and of their
        views."""
        block = np.ix_(cameras, components)
        interior = np.diagonal(self.interior[block], axis1=2, axis2=3)
        pose = self.pose[block].reshape(len(cameras), len(components), -1)
        return [np.nan_to_num(interior), np.nan_to_num(pose)]


def _sizes_of_each(
    sums: BatchSums,
    can_show: Bool[np.ndarray, "cameras k"],
    critical: float,
    programs: BatchPrograms,
) -> tuple[Float[np.ndarray, "cameras k"], SizedParts]:
    """θ of every camera from its own residuals."""
    (T, cubes), q = sums.traces, sums.forms.q
    theta = np.full(can_show.shape, np.nan)
    for n in np.flatnonzero(can_show[:, 0]).tolist():
        components = np.flatnonzero(can_show[n])
        block = np.ix_(components, components), np.ix_(components, components, components)
        equations = SizeEquations(T[n][block[0]], False, critical, cubes[n][block[1]])
        theta[n, components] = equations.solve(q[n][components])[0]
    is_used: np.ndarray = np.nan_to_num(theta) > 0
    shared = np.asarray(is_used[:, 1:].any(1))
    if not shared.any():
        return theta, SizedParts.from_sums(sums, None)
    parts = SizedParts.from_sums(sums, programs.parts(is_used & shared[:, None]))
    forms = programs.scatter(np.where(shared[:, None], np.nan_to_num(theta), 0.0))
    for n in np.flatnonzero(shared).tolist():
        components = np.flatnonzero(can_show[n])
        block = np.ix_(components, components)
        sizes_and_traces = theta[n, components], T[n][block], forms[n][block]
        tables = [table[0] for table in parts.tables(np.array([n]), components)]
        parts.factor[n, components] = widening(*sizes_and_traces, tables)
    return theta, parts


def _common_sizes(
    sums: BatchSums,
    can_show: Bool[np.ndarray, "cameras k"],
    critical: float,
    programs: BatchPrograms,
) -> tuple[Float[np.ndarray, "cameras k"], SizedParts]:
    """The same with one set of sizes, from the sampled cameras that show most components, which
    others take over; θ of the independent part is that of every camera."""
    (T, cubes), q = sums.traces, sums.forms.q
    theta = np.full(can_show.shape, np.nan)
    known_cameras = np.flatnonzero(can_show[:, 0])
    # E q_0 = Σ θ_k·tr(M·V_k): what the common sizes leave of a camera's own vᵀv
    white = lambda shared: np.clip(
        (q[known_cameras, 0] - shared) / sums.redundancy[known_cameras], 0, None
    )
    if not (can_show[:, 0] & sums.sampled).any():
        # Without any sample independent errors alone.
        theta[known_cameras, 0] = white(0.0)
        return theta, SizedParts.from_sums(sums, None)
    components = np.flatnonzero(can_show[np.argmax(can_show.sum(1) * sums.sampled)])
    block = np.ix_(components, components)
    good = np.flatnonzero(can_show[:, components].all(1) & sums.sampled)
    sum_of_traces = T[good].sum(0)[block]
    of_three = cubes[good].sum(0)[np.ix_(components, components, components)]
    common = SizeEquations(sum_of_traces, False, critical, of_three).solve(
        q[good].sum(0)[components]
    )[0]
    theta[np.ix_(known_cameras, components)] = common
    if not common[1:].any():
        theta[known_cameras, 0] = white(0.0)
        return theta, SizedParts.from_sums(sums, None)
    is_wanted = np.zeros(can_show.shape, bool)
    is_wanted[np.ix_(known_cameras, components)] = common > 0
    parts_found = programs.parts(is_wanted)
    theta[known_cameras, 0] = white(
        parts_found.remaining[known_cameras][:, components[1:]] @ common[1:]
    )
    parts = SizedParts.from_sums(sums, parts_found)
    if len(good) >= 2 * SUMS.draws:
        # q of that many cameras are draws themselves, of errors as they are
        deviation = q[good][:, components] - T[good][:, components][..., components] @ common
        forms = deviation.T @ deviation
    else:
        of_sampled = np.where(sums.sampled[:, None], np.nan_to_num(theta), 0.0)
        forms = programs.scatter(of_sampled)[good].sum(0)[block]
    tables = parts.tables(known_cameras, components)
    parts.factor[np.ix_(known_cameras, components)] = widenings(
        theta[np.ix_(known_cameras, components)], sum_of_traces, forms, tables
    )
    return theta, parts
