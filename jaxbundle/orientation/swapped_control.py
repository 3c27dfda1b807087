"""Contradictory control points, and the swap of names that resolves it.

The images determine the control points up to a similarity. If the given coordinates do not fit
it, the largest consistent group is searched for (a similarity from every three points), and among
the others two whose coordinates fit when swapped; for few points every swap is tried.
"""

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from jaxbundle.network.columns import list_some
from jaxbundle.network.tables import Network
from jaxbundle.orientation import batched
from jaxbundle.orientation.control_consistency import MIN_AGREEING
from jaxbundle.orientation.incremental import START_VALUE_LIMITS, Model, are_controlled, intersect
from jaxbundle.orientation.rays import Sights, sights
from jaxbundle.orientation.settings import DEFAULTS, StartValueSettings

CONTRADICTORY_CONTROL = "control points contradict each other"
# With at most this many points every swap of two (66) is tried, and every similarity of three (220)
# tested. More points have a majority, which needs no trial.
MAX_POINTS_FOR_TRIALS = 12


def name_contradiction(
    network: Network,
    sighted: Sights | None = None,
    model: Model | None = None,
    settings: StartValueSettings = DEFAULTS,
) -> str:
    """Which control points contradict the others and the correction, in words; empty if
    none do, or if no swap and no single point explains it.

    `model`: images oriented in any frame; default: those of the start values."""
    sighted = sights(network) if sighted is None else sighted
    points = network.points
    # The points determined by the images alone.
    images_alone = Model.empty(sighted)
    if model is not None:
        images_alone.place(model.placed, model.X0[model.placed], model.M[model.placed])
    else:
        images = network.images
        has_pose = np.all(np.isfinite(np.concatenate([images.position, images.angles], 1)), axis=1)
        if has_pose.any():
            images_alone.place(
                has_pose, images.position[has_pose], batched.matrices(images.angles[has_pose])
            )
    intersect(sighted, images_alone, START_VALUE_LIMITS)
    control = np.flatnonzero(are_controlled(points) & images_alone.known)
    contradiction_found = contradiction(
        images_alone.X[control], points.position[control], points.sigma[control], settings
    )
    if contradiction_found is None:
        return ""
    ids, unit = [points.id[p] for p in control], network.object_unit
    causes = [f"{ids[i]!r} and {ids[j]!r} are exchanged" for i, j in contradiction_found.exchanges]
    causes += [
        f"the coordinates or the number of {ids[k]!r} are wrong" for k in contradiction_found.wrong
    ]
    shown_causes = [*causes[:5], *(["…"] if len(causes) > 5 else [])]
    begin = f"the {len(ids)} {CONTRADICTORY_CONTROL} by {contradiction_found.before:.2g} {unit}"
    if contradiction_found.together or len(causes) == 1:
        return (
            f"{begin}, and fit to {contradiction_found.after:.2g} {unit} if "
            f"{' and '.join(shown_causes)}: correct the "
            "control points, or the numbers in the image points"
        )
    return (
        f"{begin}, and fit to {contradiction_found.after:.2g} {unit} if "
        f"{', or if '.join(shown_causes)}; with so few "
        "points more than one explanation is possible: look at the images"
    )


def name_suspects(network: Network, suspects: Bool[np.ndarray, " points"]) -> str:
    """Control points that contradict the images without an explanation."""
    names = [network.points.id[p] for p in np.flatnonzero(suspects)]
    return (
        f"the control points {list_some(names)} contradict the images or each other, and no "
        "exchange of two explains it: look for wrong numbers, wrong coordinates, wrong units, and "
        "a wrong principal distance"
    )


@dataclasses.dataclass(frozen=True)
class Contradiction:
    """The misclosure of points `before`, and `after` two are swapped (`exchanges`) or one is
    removed (`wrong`): all of these `together`, or each as one of several explanations."""

    before: float
    after: float
    exchanges: Sequence[tuple[int, int]]
    wrong: Sequence[int]
    together: bool


def contradiction(
    source: Float[np.ndarray, "n 3"],
    target: Float[np.ndarray, "n 3"],
    sigma: Float[np.ndarray, "n 3"] | None = None,
    settings: StartValueSettings = DEFAULTS,
) -> Contradiction | None:
    """How two lists of points contradict each other after a similarity; None where they do not, or
    where no explanation is found.

    Start values fit to the extent by `extent_to_misfit`, and control to four times the largest of
    its `sigma` (NaN: exact); the tolerance is the root of the sum of both squares."""
    n = len(source)
    if n < 3:
        return None
    largest = 0.0 if sigma is None else float(np.nan_to_num(sigma, posinf=0.0).max())
    # Four σ of a coordinate: chance exceeds it in space once in a thousand points (the root of the
    # 99.9 % quantile of χ² with three degrees of freedom is 4.03).
    extent = np.ptp(target, axis=0).max()
    tolerance = float(np.hypot(extent / settings.extent_to_misfit, 4 * largest))
    misfit = _misfits(source, target, np.ones(n, bool))
    if misfit is None or misfit.max() < tolerance:
        return None
    good = _agreeing(source, target, tolerance)
    if good.sum() >= max(MIN_AGREEING, n / 2):
        return _by_majority(source, target, good, tolerance, misfit.max())
    return _by_trial(source, target, tolerance, misfit.max())


def _by_majority(
    source: Float[np.ndarray, "n 3"],
    target: Float[np.ndarray, "n 3"],
    good: Bool[np.ndarray, " n"],
    tolerance: float,
    largest_misfit: float,
) -> Contradiction | None:
    """Two of the points outside the largest consistent group are exchanged if both fit when
    swapped; the others are wrong."""
    transformation = batched.similarity(source, target, good.astype(float))
    if transformation is None:
        return None
    A, t = transformation
    transformed, suspects = source @ A.T + t, set(np.flatnonzero(~good).tolist())
    misfits = [np.linalg.norm(transformed - target, axis=1)[good].max()]
    exchanges = []
    for i, j in itertools.combinations(sorted(suspects), 2):
        miss = max(
            np.linalg.norm(transformed[i] - target[j]), np.linalg.norm(transformed[j] - target[i])
        )
        if miss < tolerance and {i, j} <= suspects:
            exchanges.append((i, j))
            suspects -= {i, j}
            misfits.append(miss)
    return Contradiction(largest_misfit, max(misfits), exchanges, sorted(suspects), together=True)


def _by_trial(
    source: Float[np.ndarray, "n 3"],
    target: Float[np.ndarray, "n 3"],
    tolerance: float,
    largest_misfit: float,
) -> Contradiction | None:
    """Every swap of two, and every point left out: those after which all points fit."""
    n = len(source)
    if n > MAX_POINTS_FOR_TRIALS:
        return None
    trials = [(pair, ()) for pair in itertools.combinations(range(n), 2)]
    trials += [((), (k,)) for k in range(n) if n >= MIN_AGREEING]
    solutions = []
    for pair, left_out in trials:
        order = np.arange(n)
        order[list(pair)] = pair[::-1]
        use = ~np.isin(np.arange(n), left_out)
        misfit = _misfits(source, target[order], use)
        if misfit is not None and misfit[use].max() < tolerance:
            solutions.append((misfit[use].max(), pair, left_out))
    if not solutions:
        return None
    # Of few points several explanations fit. Their misfits are of a few redundant coordinates each,
    # whose chance differs by a factor of three easily; what fits worse than that is no equal.
    best = min(solutions)[0]
    solutions = [entry for entry in sorted(solutions) if entry[0] <= 3 * best]
    exchanges = [pair for _, pair, _ in solutions if pair]
    wrong = [k for *_, left_out in solutions for k in left_out]
    return Contradiction(largest_misfit, best, exchanges, wrong, together=False)


def _agreeing(
    source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "n 3"], tolerance: float
) -> Bool[np.ndarray, " n"]:
    """The most points that fit one similarity from three of them, and after it once more."""
    if len(source) <= MAX_POINTS_FOR_TRIALS:
        triples = list(itertools.combinations(range(len(source)), 3))
    else:
        # With half of the points wrong an eighth of the triples is good: fifteen of 120.
        rng = np.random.default_rng(0)
        triples = [rng.choice(len(source), 3, replace=False) for _ in range(120)]
    best = np.zeros(len(source), bool)
    for triple in triples:
        use = np.isin(np.arange(len(source)), triple)
        misfit = _misfits(source, target, use)
        if misfit is not None and (misfit < tolerance).sum() > best.sum():
            best = misfit < tolerance
    misfit = _misfits(source, target, best) if best.sum() >= 3 else None
    return best if misfit is None else misfit < tolerance


def _misfits(
    source: Float[np.ndarray, "n 3"],
    target: Float[np.ndarray, "n 3"],
    use: Bool[np.ndarray, " n"],
) -> Float[np.ndarray, " n"] | None:
    """Distances of points after the similarity of some of them; None: these are on a line."""
    transformation = batched.similarity(source, target, use.astype(float))
    if transformation is None:
        return None
    A, t = transformation
    return np.linalg.norm(source @ A.T + t - target, axis=1)
