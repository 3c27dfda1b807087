"""The adjustment of a reconstruction: estimated weights, gross errors removed.

1. All measurements with the σ of their matching.
2. The σ of measurements of a kind (least squares matching by level of the pyramid, positions of
   features) are multiplied by the root of the variance component of this kind,

       f² = Σ(v/σ)²/Σr,        r = 1 − 3/(2n) for a point with n rays,

   over residuals below `GROSS`·f.
3. Data snooping, and 2. again for the remaining measurements, with their redundancy numbers, until
   the factors converge.
"""

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbundle.bundle.adjust import adjust
from jaxbundle.bundle.result import Adjustment
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.network.sightings import keep_points
from jaxbundle.network.tables import Network
from jaxbundle.orientation.network import find_start_values
from jaxbundle.reconstruction.datum import choose_datum_points

GROSS, DOUBTFUL = 4.0, 5.0
LAST_CHANGE = 0.004
"""Change of a factor that ends the rounds."""
ROUNDS = 4
FEWEST = 60
"""Minimum measurements of a kind with a separate factor."""
SMALLEST, LARGEST = 0.3, 8.0
MANY = 0.25
"""Share of gross errors above which points of two rays are not used: most of their gross errors
cannot be detected."""
SOME, MISFIT = 0.05, 2.0
"""Share of gross errors, and factor of σ of the others, that together make a result doubtful:
undetected ones may distort it."""
LARGEST_MISFIT, WRONG_MISFIT = 4.0, 8.0
"""Factor of σ above which a result is called doubtful, and most likely wrong; right results of
rendered facades have up to 2.5, of a photographed facade with known centres 3.7, wrong ones of real
photographs 11.8 and 19.7."""
AGREEING_RAY = 0.001
"""Maximum misclosure of an agreeing ray, relative to the image extent."""
LOSSES = 6
"""Maximum rounds of excluding points left undetermined, in one adjustment."""
FEWEST_ITERATIONS, MOST_ITERATIONS, MOST_WORK = 200, 2000, 4_000_000
"""Iterations of one adjustment, and iterations times image points. Two photographs, or many with
the same viewing direction, determine an unknown camera only weakly, and the search then needs
several hundred; with more photographs a search that has not ended soon has wrong start values,
and others are tried."""


@dataclasses.dataclass(frozen=True)
class Weighted:
    """The adjustment, and the factor of σ of each kind of measurement, which is also in it; the
    number of measurements that agree with it, and of `unused` points of two rays."""

    adjustment: Adjustment
    factors: dict[str, float]
    agreeing: int
    unused: int = 0

    def __post_init__(self):
        if self.adjustment.converged:
            # σ estimated from the residuals are not confirmed by them: no χ² test
            self.adjustment.sigma_factors = {
                f"image points {name}": factor for name, factor in self.factors.items()
            }

    @property
    def worst(self) -> float:
        """The largest factor."""
        return max(self.factors.values(), default=1.0)


def adjust_weighted(
    network: Network,
    kinds: Int[np.ndarray, " rays"],
    names: dict[int, str],
    significance: float,
    tell: Callable[[str], None],
) -> Weighted:
    """Adjust with variance components of the kinds and data snooping. Without a solution, or with
    a doubtful one, adjust again without points of two rays, whose gross errors can hardly be
    detected: where an object repeats itself, some agree with its photographs by chance.

    **Arguments:** `kinds`: of every observation of the network.

    **Raises:** as `jaxbundle.adjust`; `NotSolvedError` if, with very many gross errors, points of
    three rays do not confirm the result.
    """
    found, failed = None, None
    try:
        found = _weight(network, kinds, names, significance, tell)
        if found.adjustment.converged and (len(network.images) < 3 or not _is_doubtful(found)):
            return found
    except NotSolvedError as error:
        failed = error
    solved = found is not None and found.adjustment.converged
    rays = network.observations
    number = np.bincount(rays.point, minlength=len(network.points))
    several = (number > 2) | ~network.points.has_role("tie")
    clear, kinds = keep_points(network, several), kinds[several[rays.point]]
    try:
        clearer = _weight(clear, kinds, names, significance, tell)
    except (InputError, NotSolvedError):
        # a photograph has hardly any of these points, or they do not determine it
        if failed is not None:
            raise failed from None
    else:
        if not clearer.adjustment.converged and not solved:
            return found or clearer
        if clearer.adjustment.converged and _is_better(clearer, found if solved else None):
            return dataclasses.replace(
                clearer,
                agreeing=_count_agreeing(network, clearer),
                unused=len(network.points) - len(clear.points),
            )
    assert found is not None, "an attempt ends with a result or an error"
    if solved and _removed_many(found.adjustment):
        raise NotSolvedError(
            f"not solved: {len(found.adjustment.removed)} of {len(rays)} measurements are gross "
            "errors, and the points of three rays alone do not confirm the others: the object "
            "repeats itself; take photographs with shorter bases",
            list(network.images.id),
        )
    return found


def _is_doubtful(found: Weighted) -> bool:
    """Whether undetected gross errors, most of them in points of two rays, may distort a result."""
    return _removed_many(found.adjustment) or (
        _removed_many(found.adjustment, SOME) and found.worst > MISFIT
    )


def _removed_many(result: Adjustment, share: float = MANY) -> bool:
    """Whether more than a share of the measurements were gross errors."""
    return len(result.removed) > share * len(result.network.observations)


def _is_better(clearer: Weighted, found: Weighted | None) -> bool:
    """Whether the result of points of three rays replaces that of all points."""
    return found is None or _removed_many(found.adjustment) or clearer.worst < found.worst


def _count_agreeing(network: Network, clearer: Weighted) -> int:
    """The number of measurements of all points that agree with the result of some of them."""
    result = clearer.adjustment
    cameras = tuple(
        dataclasses.replace(c, parameters=result.camera_parameters(c.id)) for c in network.cameras
    )
    values, points = result.image_values, network.points
    tie = points.has_role("tie")[:, None]
    images = dataclasses.replace(network.images, position=values[:, :3], angles=values[:, 3:])
    points = dataclasses.replace(points, position=np.where(tie, np.nan, points.position))
    placed = network.replace(cameras=cameras, images=images, points=points)
    try:
        return len(find_start_values(placed, tolerance=AGREEING_RAY).network.observations)
    except NotSolvedError:  # control does not agree so closely
        return clearer.agreeing


def adjust_determined(network: Network, **options) -> tuple[Adjustment, Network, np.ndarray]:
    """The adjustment without undetermined tie points; the network without them; its rows among
    those given."""
    rows = np.arange(len(network.observations))
    again = lambda: adjust(network, max_iterations=limit_iterations(network), **options)
    for _ in range(LOSSES):
        try:
            result = again()
        except NotSolvedError as error:
            kept = _are_determined(network, error.undetermined)
            if kept.all():
                raise
        else:
            kept = _are_determined(network, result.undetermined)
            if kept.all():
                return result, network, rows
        rows = rows[kept[network.observations.point]]
        network = keep_points(network, kept)
    return again(), network, rows


def limit_iterations(network: Network) -> int:
    """The maximum number of iterations of an adjustment, by its size."""
    work = MOST_WORK // max(len(network.observations), 1)
    return min(max(work, FEWEST_ITERATIONS), MOST_ITERATIONS)


def _are_determined(network: Network, undetermined) -> Bool[np.ndarray, " points"]:
    """False for tie points named among the undetermined."""
    lost = {name.partition(" of point ")[2] for name in undetermined}
    tie = network.points.has_role("tie")
    return ~(tie & np.isin(np.array(network.points.id, object), [*lost]))


def _weight(network: Network, kinds, names, significance, tell) -> Weighted:
    tell("adjustment")
    result, network, kept = adjust_determined(network)
    kinds, given = kinds[kept], network.observations.sigma
    total, doubtful = np.ones(len(kept)), []
    if result.converged:
        (w, r), rows = _of_residuals(result), _rows(result, network)
        total[rows] = _factors(w, r, kinds[rows])
        beyond = np.abs(w) / np.sqrt(np.maximum(r, 0.1)) > DOUBTFUL * total[rows, None]
        doubtful = _name(result, beyond.any(1))
        network = network.replace(datum_points=choose_datum_points(result))
    for _ in range(ROUNDS):
        tell("data snooping")
        network = _with_sigma(network, given * total[:, None])
        result, network, kept = adjust_determined(
            network, snooping="pope", significance=significance, doubtful=doubtful
        )
        kinds, given, total = kinds[kept], given[kept], total[kept]
        if not result.converged:
            break
        rows = _rows(result, network)
        factor = _factors(*_of_reliability(result), kinds[rows], np.inf)
        if np.all(np.abs(factor - 1) < LAST_CHANGE):
            break
        total[rows] *= factor
        used = np.asarray(result.problem.data.image_weight) > 0
        doubtful = _name(result, ~used.any(1))
    kept = {
        name: float(np.median(total[kinds == k])) for k, name in names.items() if (kinds == k).any()
    }
    used = np.asarray(result.problem.data.image_weight) > 0
    return Weighted(result, kept, int(used.any(1).sum()))


def _rows(result: Adjustment, network: Network) -> Int[np.ndarray, " rays"]:
    """For every image point of a result its row in the network, without excluded ones."""
    index = {one: k for k, one in enumerate(_all_ids(network))}
    return np.array([index[one] for one in _name(result, slice(None))], int)


def _ids(network: Network, image, point):
    images, points = network.images.id, network.points.id
    return [(images[i], points[p]) for i, p in zip(image.tolist(), point.tolist())]


def _all_ids(network: Network):
    return _ids(network, network.observations.image, network.observations.point)


def _name(result: Adjustment, rows) -> list[tuple[str, str]]:
    """Image and point, by id, of image points."""
    problem = result.problem
    return _ids(result.network, problem.image[rows], problem.point[rows])


def _with_sigma(network: Network, sigma) -> Network:
    return network.replace(observations=dataclasses.replace(network.observations, sigma=sigma))


def _of_residuals(result: Adjustment):
    """v/σ of the rays, and redundancy numbers from the number of rays of their points."""
    w = np.asarray(result.inspection.residuals.image)
    rays = np.bincount(result.problem.point)[result.problem.point]
    return w, np.repeat(1 - 3 / (2 * rays[:, None]), 2, 1)


def _of_reliability(result: Adjustment):
    found = result.reliability
    used = np.asarray(result.problem.data.image_weight) > 0
    return np.where(used, found.residual.image, np.nan), np.asarray(found.redundancy.image)


def _factors(
    w: Float[np.ndarray, "rays 2"], r: Float[np.ndarray, "rays 2"], kinds, gross: float = GROSS
) -> Float[np.ndarray, " rays"]:
    """Factors of the σ of every ray."""
    r = np.maximum(r, 1e-3)
    factor = np.ones(len(w))
    for kind in np.unique(kinds):
        rows = kinds == kind
        length, spare = np.abs(w[rows]) / np.sqrt(r[rows]), r[rows]
        there = np.isfinite(length) & (spare > 0.05)
        if there.sum() < 2 * FEWEST:
            continue
        scale = 1.4826 * np.median(length[there])
        for _ in range(5):
            good = there & (length < gross * max(scale, 1e-9))
            scale = np.sqrt(np.sum(w[rows][good] ** 2) / np.sum(spare[good]))
        factor[rows] = np.clip(scale, SMALLEST, LARGEST)
    return factor
