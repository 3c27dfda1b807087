"""The adjustment of a reconstruction: estimated weights, gross errors removed.

1. All measurements with the σ of their matching.
2. The σ of measurements of a class (least squares matching by level of the pyramid, positions of
   features) are multiplied by the root of the variance component of this class (Förstner 1979),

       f² = Σ(v/σ)²/Σr,        r = 1 − 3/(2n) for a point with n rays,

   over the measurements whose normalised residual v/(σ·√r) is below `gross_residual`·f. (2n
   coordinates determine 3 of the point; what they add to images and cameras is neglected.)
   Measurements with residuals above `suspect_residual`·f are gross errors, most likely: 2. again
   without them, until they are the same ones.
3. Data snooping, and 2. again for the remaining measurements, with their redundancy numbers, until
   the factors converge; every time from where the last adjustment ended.
"""

import dataclasses
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbundle.adjustment.adjust import adjust, snoop_again
from jaxbundle.adjustment.far_points import minimise_holding_infinite_points
from jaxbundle.adjustment.quality.inspection import Inspection
from jaxbundle.adjustment.readjust import values_without
from jaxbundle.adjustment.result import Adjustment
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.leastsquares.indexing.rows import Values
from jaxbundle.leastsquares.quality.distributions import NORMAL_SIGMA_BY_MAD
from jaxbundle.network.subsets import keep_points
from jaxbundle.network.tables import Network, are_among
from jaxbundle.orientation.network import find_start_values
from jaxbundle.reconstruction.datum import choose_datum_points

# Factor of σ above which a result is called doubtful, and most likely wrong; right results of
# rendered facades have up to 2.5, of a photographed facade with known centres 3.7, wrong ones of
# real photographs 11.8 and 19.7.
DOUBTFUL_MISFIT, WRONG_MISFIT = 4.0, 8.0


@dataclasses.dataclass(frozen=True)
class WeightingSettings:
    """Settings of the weighting of measurements and the removal of gross errors."""

    gross_residual: float = 4.0
    """Normalised residuals above it, in factors of their class, take no part in its factor.
    Normally distributed ones are cut off with a probability of 6e-5, which reduces the factor by
    0.05 %; at 3 it would be 1.3 %, and larger limits let small gross errors in."""
    suspect_residual: float = 5.0
    """Normalised residual, in factors of its class, above which an image point is excluded when
    data snooping begins, with a probability of 6e-7; snooping restores it if it agrees. Smaller:
    more to restore; larger: more rounds until all gross errors are found."""
    max_screenings: int = 10
    """Maximum number of times that factors and suspects are determined before data snooping. In 60
    frames of a video (`benchmarks/reconstruct.py --set video`) the first factors are up to 3.7
    times too large, those of the tenth time within 7 %; data snooping then has two rounds instead
    of four, and 23 adjustments instead of 67."""
    last_change: float = 0.004
    """Relative change of a factor that ends the rounds: less than its own σ, 1/√(2·Σr), unless a
    class has more than 30 000 measurements."""
    max_rounds: int = 4
    """Maximum rounds of data snooping and new factors. What has not converged then changes by
    single measurements."""
    min_measurements: int = 60
    """Minimum measurements of a class with a separate factor: with Σr of about 60 its σ is
    1/√(2·60) = 9 %. Fewer would only copy their own errors into the weights."""
    min_factor: float = 0.3
    """Smallest factor of one round. σ of matching are right to 15 % or too small; a much smaller
    factor comes from measurements that agree because they are hardly checked."""
    max_factor: float = WRONG_MISFIT
    """Largest factor of one round: beyond it the model is wrong, not σ."""
    many_errors: float = 0.25
    """Share of gross errors above which points of two rays are not used: most of their gross errors
    cannot be detected, since one along the epipolar line moves the point and leaves no residual."""
    some_errors: float = 0.05
    """Share of gross errors that, together with `some_misfit`, makes a result doubtful: undetected
    ones may distort it."""
    some_misfit: float = 2.0
    """Largest factor of σ (`WeightedAdjustment.worst`) above which a result with `some_errors` is
    doubtful: around the fountain of the set `loop` it is 1.3, on facades, which repeat themselves,
    1.5 to 3."""
    feature_share: float = 0.01
    """Share of the information of a photograph, Σ 1/σ², below which its positions of features are
    not used where `min_matched_rays` of their point are matched. Without them σ are larger by at
    most 0.5 % (√(1 − 0.01)); smaller: photographs of few matches keep errors that tracks share."""
    min_matched_rays: int = 3
    """Matched rays that determine a point and check each other."""
    agreeing_ray: float = 0.001
    """Maximum misclosure of a ray that agrees with a result, relative to the image extent, the
    angle to the axis that 95 % of the rays do not exceed (`orientation.rays.sights`): 1.4 pixels of
    3000. A third of the tolerance of verified pairs, whose cameras are not yet adjusted."""


@dataclasses.dataclass(frozen=True)
class WeightedAdjustment:
    """The adjustment, and the factor of σ of each class of measurements, which the adjustment has
    as its `sigma_factors`; the number of measurements that agree with it, `unused_points` of two
    rays, and `unused_features`, positions that took no part (`leave_out_features`)."""

    adjustment: Adjustment
    factors: dict[str, float]
    agreeing_rays: int
    unused_points: int = 0
    unused_features: int = 0

    @property
    def worst(self) -> float:
        """The largest factor."""
        return max(self.factors.values(), default=1.0)

    def __post_init__(self) -> None:
        # σ estimated from the residuals are not confirmed by them: no χ² test, neither of this
        # adjustment nor of that with control, which takes its place (`georeferencing`)
        if self.adjustment.converged:
            factors = {f"image points {name}": f for name, f in self.factors.items()}
            changed = self.adjustment.with_changes(sigma_factors=factors)
            object.__setattr__(self, "adjustment", changed)


def leave_out_features(
    network: Network,
    is_feature: Bool[np.ndarray, " rays"],
    settings: WeightingSettings = WeightingSettings(),
) -> tuple[Network, Bool[np.ndarray, " rays"]]:
    """The network without positions of features that hardly contribute; which rays it has.

    A position that was not matched is predicted from the feature of the window of its track, whose
    error all predictions of the track have in common. With σ forty times those of matches they
    determine nothing, but these common errors are most of those along tracks that an error model
    finds: in ten rendered photographs, with true orientations, 0.41 of the variance with and 0.16
    without them, the projection centres 0.052 mm off either way.

    **Arguments:** `is_feature`: which rays are no matches.
    """
    rays = network.observations
    matched = np.bincount(rays.point[~is_feature], minlength=len(network.points))
    superfluous = is_feature & (matched[rays.point] >= settings.min_matched_rays)
    information = (1 / rays.sigma**2).sum(1)
    of_image = lambda some: np.bincount(
        rays.image, information * some, minlength=len(network.images)
    )
    is_in_few = of_image(superfluous) < settings.feature_share * of_image(np.ones(len(rays)))
    keep = ~(superfluous & is_in_few[rays.image])
    return network.replace(observations=rays.take(keep)), keep


def adjust_weighted(
    network: Network,
    measurement_class: Int[np.ndarray, " rays"],
    class_names: dict[int, str],
    significance: float,
    tell: Callable[[str], None],
    settings: WeightingSettings = WeightingSettings(),
) -> WeightedAdjustment:
    """Adjust with variance components of the classes and data snooping. Without a solution, or with
    a doubtful one, adjust again without points of two rays, whose gross errors can hardly be
    detected: where an object repeats itself, some agree with its photographs by chance.

    **Arguments:** `measurement_class`: of every observation of the network; `class_names`;
    `significance`: of data snooping; `tell(stage)`.

    **Raises:** as `jaxbundle.adjust`; `NotSolvedError` if, with very many gross errors, points of
    three rays do not confirm the result.
    """
    with_all, first_error, many = None, None, settings.many_errors
    weight = lambda network, measurement_class: _weight(
        network, measurement_class, class_names, significance, tell, settings
    )
    try:
        with_all = weight(network, measurement_class)
        # Two photographs have no points of three rays to compare with.
        are_few = len(network.images) < 3
        if with_all.adjustment.converged and (are_few or not _is_doubtful(with_all, settings)):
            return with_all
    except NotSolvedError as error:
        first_error = error
    solved = with_all is not None and with_all.adjustment.converged
    rays = network.observations
    # Points of another role than tie are checked by their coordinates.
    number = np.bincount(rays.point, minlength=len(network.points))
    has_several = (number > 2) | ~network.points.has_role("tie")
    clear_network, measurement_class = (
        keep_points(network, has_several),
        measurement_class[has_several[rays.point]],
    )
    try:
        clearer = weight(clear_network, measurement_class)
    except (InputError, NotSolvedError):
        # A photograph has hardly any of these points, or they do not determine it.
        if first_error is not None:
            raise first_error from None
    else:
        if not clearer.adjustment.converged and not solved:
            return with_all or clearer
        if clearer.adjustment.converged and (
            with_all is None
            or not solved
            or _removed_more(with_all, many)
            or clearer.worst < with_all.worst
        ):
            return dataclasses.replace(
                clearer,
                agreeing_rays=_count_agreeing(network, clearer, settings.agreeing_ray),
                unused_points=len(network.points) - len(clear_network.points),
            )
    assert with_all is not None, "an attempt ends with a result or an error"
    if solved and _removed_more(with_all, many):
        raise NotSolvedError(
            f"not solved: {len(with_all.adjustment.removed)} of {len(rays)} measurements are gross "
            "errors, and the points of three rays alone do not confirm the others: the object "
            "repeats itself; take photographs with shorter bases",
            list(network.images.id),
        )
    return with_all


def _is_doubtful(weighted: WeightedAdjustment, settings: WeightingSettings) -> bool:
    """Whether undetected gross errors, most of them in points of two rays, may distort a result."""
    return _removed_more(weighted, settings.many_errors) or (
        _removed_more(weighted, settings.some_errors) and weighted.worst > settings.some_misfit
    )


def _removed_more(weighted: WeightedAdjustment, share: float) -> bool:
    """Whether more than a share of the measurements were gross errors."""
    result = weighted.adjustment
    return len(result.removed) > share * len(result.network.observations)


def _count_agreeing(network: Network, clearer: WeightedAdjustment, tolerance: float) -> int:
    """The number of measurements of all points that agree with the result of some of them."""
    result = clearer.adjustment
    cameras = tuple(
        dataclasses.replace(c, parameters=result.camera_parameters(c.id)) for c in network.cameras
    )
    values, points = result.image_values, network.points
    tie = points.has_role("tie")[:, None]
    # Images are placed, tie points intersected anew: start values count the rays that agree.
    images = dataclasses.replace(network.images, position=values[:, :3], angles=values[:, 3:])
    points = dataclasses.replace(points, position=np.where(tie, np.nan, points.position))
    placed = network.replace(cameras=cameras, images=images, points=points)
    try:
        return len(find_start_values(placed, tolerance=tolerance).network.observations)
    except NotSolvedError:  # control does not agree so closely
        return clearer.agreeing_rays


def adjust_determined(
    network: Network, **options: Any
) -> tuple[Adjustment, Network, Int[np.ndarray, " rays"]]:
    """The adjustment without undetermined tie points; the network without them; its rows among
    those given."""
    rows = np.arange(len(network.observations))
    adjust_again = lambda: adjust(network, max_iterations=limit_iterations(network), **options)
    # Each round may leave further points with one ray; what six do not end is reported as it is.
    for _ in range(6):
        try:
            result = adjust_again()
        except NotSolvedError as error:
            is_determined = _are_determined(network, error.undetermined)
            if is_determined.all():
                raise
        else:
            is_determined = _are_determined(network, result.undetermined)
            if is_determined.all():
                return result, network, rows
        rows = rows[is_determined[network.observations.point]]
        network = keep_points(network, is_determined)
    return adjust_again(), network, rows


def limit_iterations(network: Network) -> int:
    """The maximum number of iterations of an adjustment, by its size: 2000 up to 2000 image points,
    200 from 20 000 on. Two photographs, or many with the same viewing direction, determine an
    unknown camera only weakly, and the search then needs several hundred; with more photographs a
    search that has not ended soon has wrong start values, and others are tried."""
    return min(max(4_000_000 // max(len(network.observations), 1), 200), 2000)


def _are_determined(network: Network, undetermined: Iterable[str]) -> Bool[np.ndarray, " points"]:
    """False for tie points named among the undetermined."""
    # As `leastsquares.quality.names` writes them: "X of point 17".
    undetermined_ids = {name.partition(" of point ")[2] for name in undetermined}
    tie = network.points.has_role("tie")
    return ~(tie & are_among(network.points.id, undetermined_ids))


def _weight(
    network: Network,
    measurement_class: Int[np.ndarray, " rays"],
    class_names: dict[int, str],
    significance: float,
    tell: Callable[[str], None],
    settings: WeightingSettings,
) -> WeightedAdjustment:
    """The steps of the module, for the points of a network."""
    tell("adjustment")
    result, network, is_kept = adjust_determined(network)
    measurement_class, sigma = measurement_class[is_kept], network.observations.sigma
    factor_so_far, suspects, values = np.ones(len(is_kept)), [], None
    if result.converged:
        rows = _rows(result, network)
        screened = _screen(result, measurement_class[rows], settings)
        factor_so_far[rows], is_suspect, values = screened
        suspects = _pairs_of_ids(result, is_suspect)
        # Once: a datum that changes with each round would change all σ, too.
        network = network.replace(datum_points=choose_datum_points(result))
    for rounds_left in reversed(range(settings.max_rounds)):
        tell("data snooping")
        weighted = dataclasses.replace(network.observations, sigma=sigma * factor_so_far[:, None])
        result, network, is_kept = _snoop(
            network.replace(observations=weighted), result, values, suspects, significance
        )
        values = None
        measurement_class, sigma, factor_so_far = (
            measurement_class[is_kept],
            sigma[is_kept],
            factor_so_far[is_kept],
        )
        if not result.converged:
            break
        rows = _rows(result, network)
        # Gross errors are removed by now: no limit.
        factor = _factors(*_redundancy(result), measurement_class[rows], settings, np.inf)
        # The result is that with the last factors.
        if not rounds_left or np.all(np.abs(factor - 1) < settings.last_change):
            break
        factor_so_far[rows] *= factor
        suspects = _pairs_of_ids(result, ~result.problem.used)
    factors = {
        name: float(np.median(factor_so_far[measurement_class == k]))
        for k, name in class_names.items()
        if (measurement_class == k).any()
    }
    return WeightedAdjustment(result, factors, int(result.problem.used.sum()))


def _snoop(
    network: Network,
    earlier: Adjustment,
    values: Values | None,
    suspects: list[tuple[str, str]],
    significance: float,
) -> tuple[Adjustment, Network, Int[np.ndarray, " rays"]]:
    """Data snooping, as `adjust_determined`; where an earlier adjustment was solved and there are
    suspects, from its end, or from other `values` near to it."""
    if suspects and earlier.converged:
        problem, rows = earlier.problem, _rows(earlier, network)
        of_problem = dataclasses.replace(
            problem.network.observations, sigma=network.observations.sigma[rows]
        )
        changed = problem.network.replace(
            observations=of_problem, datum_points=network.datum_points
        )
        start, limit = values or earlier.values, limit_iterations(network)
        try:
            result = snoop_again(earlier, changed, start, suspects, significance, limit)
        except NotSolvedError:
            pass
        else:
            if result.converged:
                return result, network, np.arange(len(network.observations))
    return adjust_determined(network, snooping="pope", significance=significance, doubtful=suspects)


def _screen(
    result: Adjustment, measurement_class: Int[np.ndarray, " rays"], settings: WeightingSettings
) -> tuple[Float[np.ndarray, " rays"], Bool[np.ndarray, " rays"], Values]:
    """The factor of σ of every ray, and which are excluded when data snooping begins, from
    residuals without these: gross errors distort all others as long as they take part; the values
    of the unknowns without them."""
    problem, values = result.problem, result.values
    most = limit_iterations(result.network) + 1
    options: dict[str, Any] = {"max_steps": most, "largest_max_steps": most}
    minimise_again = partial(minimise_holding_infinite_points, **options)
    (v, r), point = _approximate_redundancy(result), problem.point
    # r ≥ 1/4 for two rays; one ray, r < 0, is judged like those that are hardly checked
    root = np.sqrt(np.maximum(r, 0.1))
    are_two = (np.bincount(point) == 2)[point]
    is_suspect = np.zeros(len(v), bool)
    for rounds_left in reversed(range(settings.max_screenings)):
        factor = _factors(v, r, measurement_class, settings, settings.gross_residual)
        excess = np.max(np.abs(v) / root, axis=1) / (settings.suspect_residual * factor)
        # Of every point the worst ray, which may have moved the point and so spoil the others; of
        # two rays both, as nothing decides between them. A suspect that fits after all returns.
        is_new = ~is_suspect & (excess > 1)
        worst = np.zeros(point.max(initial=-1) + 1)
        np.maximum.at(worst, point[is_new], excess[is_new])
        was_suspect = is_suspect
        is_suspect = (is_suspect & (excess > 1)) | (is_new & (are_two | (excess == worst[point])))
        if not rounds_left or (is_suspect == was_suspect).all():
            break
        try:
            values = values_without(result, values, factor, is_suspect, minimise_again)
        except NotSolvedError:
            break
        v = Inspection(problem, values).image_residuals
    return factor, is_suspect, values


def _rows(result: Adjustment, network: Network) -> Int[np.ndarray, " rays"]:
    """For every image point of a result its row in the network, without excluded ones."""
    rays = network.observations
    index = {ids: k for k, ids in enumerate(_ids(network, rays.image, rays.point))}
    return np.array([index[ids] for ids in _pairs_of_ids(result, slice(None))], int)


def _ids(
    network: Network, image: Int[np.ndarray, " rays"], point: Int[np.ndarray, " rays"]
) -> list[tuple[str, str]]:
    """The ids of images and points."""
    images, points = network.images.id, network.points.id
    return [(images[i], points[p]) for i, p in zip(image.tolist(), point.tolist())]


def _pairs_of_ids(
    result: Adjustment, rows: slice | Bool[np.ndarray, " rays"]
) -> list[tuple[str, str]]:
    """Image and point, by id, of image points."""
    problem = result.problem
    return _ids(result.network, problem.image[rows], problem.point[rows])


def _approximate_redundancy(
    result: Adjustment,
) -> tuple[Float[np.ndarray, "rays 2"], Float[np.ndarray, "rays 2"]]:
    """v/σ of the rays, and redundancy numbers from the number of rays of their points: exact ones
    need the cofactors of the whole network, which gross errors would spoil."""
    v = result.inspection.image_residuals
    rays = np.bincount(result.problem.point)[result.problem.point]
    return v, np.repeat(1 - 3 / (2 * rays[:, None]), 2, 1)


def _redundancy(
    result: Adjustment,
) -> tuple[Float[np.ndarray, "rays 2"], Float[np.ndarray, "rays 2"]]:
    """v/σ of the rays, NaN of excluded ones, and their redundancy numbers."""
    reliability, problem = result.reliability, result.problem
    v, r = (problem.image_points(x) for x in (reliability.residual, reliability.redundancy))
    return np.where(problem.used_coordinates, v, np.nan), r


def _factors(
    v: Float[np.ndarray, "rays 2"],
    r: Float[np.ndarray, "rays 2"],
    measurement_class: Int[np.ndarray, " rays"],
    settings: WeightingSettings,
    gross: float,
) -> Float[np.ndarray, " rays"]:
    """Factors of the σ of every ray, from v/σ, of normalised residuals below `gross` factors."""
    # Of rows that are not judged (below): no division by 0.
    r = np.maximum(r, 1e-3)
    factor = np.ones(len(v))
    for number in np.unique(measurement_class):
        rows = measurement_class == number
        normalised_residual, redundancy = np.abs(v[rows]) / np.sqrt(r[rows]), r[rows]
        # With r below 0.05 less than a twentieth of an error appears in the residual, as much as
        # rounding and neglected terms.
        checked = np.isfinite(normalised_residual) & (redundancy > 0.05)
        if checked.sum() < 2 * settings.min_measurements:
            continue
        scale = NORMAL_SIGMA_BY_MAD * np.median(normalised_residual[checked])
        # The choice of good ones and the factor depend on each other; five rounds settle both.
        for _ in range(5):
            # Exact data have a scale of 0, below which there would be no good ones.
            good = checked & (normalised_residual < gross * max(scale, 1e-9))
            scale = np.sqrt(np.sum(v[rows][good] ** 2) / np.sum(redundancy[good]))
        factor[rows] = np.clip(scale, settings.min_factor, settings.max_factor)
    return factor
