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
from jaxbundle.orientation.rays import Sights, make_sights
from jaxbundle.orientation.settings import DEFAULTS, StartValueSettings

CONTRADICTORY_CONTROL = "control points contradict each other"
# With at most this many points every swap of two (66) is tried, and every similarity of three (220)
# tested. More points have a majority, which needs no trial.
MAX_POINTS_FOR_TRIALS = 12


def name_contradiction(
    network: Network,
    sights: Sights | None = None,
    model: Model | None = None,
    settings: StartValueSettings = DEFAULTS,
) -> str:
    """Which control points contradict the others and the correction, in words; empty if
    none do, or if no swap and no single point explains it.

    `model`: images oriented in any frame; default: those of the start values."""
    sights = make_sights(network) if sights is None else sights
    points = network.points
    # The points determined by the images alone.
    free_model = Model.empty(sights)
    if model is not None:
        free_model.place(model.placed, model.X0[model.placed], model.M[model.placed])
    else:
        images = network.images
        has_pose = np.all(np.isfinite(np.concatenate([images.position, images.angles], 1)), axis=1)
        if has_pose.any():
            free_model.place(
                has_pose, images.position[has_pose], batched.matrices(images.angles[has_pose])
            )
    intersect(sights, free_model, START_VALUE_LIMITS)
    control = np.flatnonzero(are_controlled(points) & free_model.known)
    explanation = contradiction(
        free_model.X[control], points.position[control], points.sigma[control], settings
    )
    if explanation is None:
        return ""
    ids, unit = [points.id[p] for p in control], network.object_unit
    causes = [f"{ids[i]!r} and {ids[j]!r} are exchanged" for i, j in explanation.exchanges]
    causes += [f"the coordinates or the number of {ids[k]!r} are wrong" for k in explanation.wrong]
    shown_causes = [*causes[:5], *(["…"] if len(causes) > 5 else [])]
    first_clause = (
        f"the {len(ids)} {CONTRADICTORY_CONTROL} by {explanation.misfit_before:.2g} {unit}"
    )
    if explanation.all_at_once or len(causes) == 1:
        return (
            f"{first_clause}, and fit to {explanation.misfit_after:.2g} {unit} if "
            f"{' and '.join(shown_causes)}: correct the "
            "control points, or the numbers in the image points"
        )
    return (
        f"{first_clause}, and fit to {explanation.misfit_after:.2g} {unit} if "
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
    """The misfit of points before and after two are swapped (`exchanges`) or one is removed
    (`wrong`): all of these at once (`all_at_once`), or each as one of several explanations."""

    misfit_before: float
    misfit_after: float
    exchanges: Sequence[tuple[int, int]]
    wrong: Sequence[int]
    all_at_once: bool


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
    misfits = _misfits(source, target, np.ones(n, bool))
    if misfits is None or misfits.max() < tolerance:
        return None
    good = _agreeing(source, target, tolerance)
    if good.sum() >= max(MIN_AGREEING, n / 2):
        return _by_majority(source, target, good, tolerance, misfits.max())
    return _by_trial(source, target, tolerance, misfits.max())


def _by_majority(
    source: Float[np.ndarray, "n 3"],
    target: Float[np.ndarray, "n 3"],
    good: Bool[np.ndarray, " n"],
    tolerance: float,
    misfit_before: float,
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
    return Contradiction(misfit_before, max(misfits), exchanges, sorted(suspects), all_at_once=True)


def _by_trial(
    source: Float[np.ndarray, "n 3"],
    target: Float[np.ndarray, "n 3"],
    tolerance: float,
    misfit_before: float,
) -> Contradiction | None:
    """Every swap of two, and every point left out: those after which all points fit."""
    n = len(source)
    if n > MAX_POINTS_FOR_TRIALS:
        return None
    trials = [(pair, ()) for pair in itertools.combinations(range(n), 2)]
    trials += [((), (k,)) for k in range(n) if n >= MIN_AGREEING]
    explanations = []
    for pair, left_out in trials:
        order = np.arange(n)
        order[list(pair)] = pair[::-1]
        is_used = ~np.isin(np.arange(n), left_out)
        misfits = _misfits(source, target[order], is_used)
        if misfits is not None and misfits[is_used].max() < tolerance:
            explanations.append((misfits[is_used].max(), pair, left_out))
    if not explanations:
        return None
    # Of few points several explanations fit. Their misfits are of a few redundant coordinates each,
    # whose chance differs by a factor of three easily; what fits worse than that is no equal.
    best = min(explanations)[0]
    explanations = [entry for entry in sorted(explanations) if entry[0] <= 3 * best]
    exchanges = [pair for _, pair, _ in explanations if pair]
    wrong = [k for *_, left_out in explanations for k in left_out]
    return Contradiction(misfit_before, best, exchanges, wrong, all_at_once=False)


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
        is_used = np.isin(np.arange(len(source)), triple)
        misfits = _misfits(source, target, is_used)
        if misfits is not None and (misfits < tolerance).sum() > best.sum():
            best = misfits < tolerance
    misfits = _misfits(source, target, best) if best.sum() >= 3 else None
    return best if misfits is None else misfits < tolerance


def _misfits(
    source: Float[np.ndarray, "n 3"],
    target: Float[np.ndarray, "n 3"],
    is_used: Bool[np.ndarray, " n"],
) -> Float[np.ndarray, " n"] | None:
    """Distances of points after the similarity of some of them; None: these are on a line."""
    transformation = batched.similarity(source, target, is_used.astype(float))
    if transformation is None:
        return None
    A, t = transformation
    return np.linalg.norm(source @ A.T + t - target, axis=1)
