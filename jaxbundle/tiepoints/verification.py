"""The matches of two photographs that one object can explain.

A robust relative orientation is computed from the most distinct matches (five points
at a time, `orientation.robust`), refined with the agreeing matches, and then tested with all
matches: the coplanarity misclosure (Sampson), and both rays in front. A pure rotation, or a
homography, that explains nearly all of them as well is reported: two photographs from one position,
or of a plane, which do not start a model.

Unique matches come first (`FeatureMatches.unique`): in a row of windows, matches of each window to
its neighbour are consistent with a wrong orientation, shifted by their distance. All matches are
used only if too few unique ones agree; such a pair is not `sure`. In a sure pair with sufficient
unique matches the others are left out: windows follow one another along an epipolar line.

Agreeing matches must be distributed over both photographs, not in one corner: a common sign
in two scenes does not prove that they are the same.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxbundle.geometry import matrix_from_quaternion
from jaxbundle.leastsquares.iterations.small import minimise
from jaxbundle.orientation import (
    apply_homography,
    batched,
    homography,
    ray_of,
)
from jaxbundle.orientation.absolute import rotation_between
from jaxbundle.orientation.relative import coplanarity_misclosures, retract
from jaxbundle.system.programs import quick_jit

# Padded numbers of matches of a pair, and of pairs in one run of a compiled program. 192 matches
# give a third of the σ that 20 give, which suffices to judge the others; time grows with them.
MATCH_SLOTS, LANES = 192, 8


@dataclasses.dataclass(frozen=True)
class VerificationSettings:
    """Settings of the verification of pairs."""

    tolerance: float = 0.0012
    """Maximum Sampson distance of an agreeing match, relative to the longer side: 2 pixels of a
    photograph reduced to 1800, several σ of a feature and some distortion that the first camera
    lacks. Larger: more wrong matches near the epipolar lines agree; smaller: right ones near the
    border, where distortion is largest, do not."""
    min_matches: int = 16
    """Minimum number of agreeing matches: a relative orientation has 5 unknowns, and of matches
    with random errors some agree with the best of many trials."""
    min_share: float = 0.2
    """Minimum share of agreeing matches. Random matches agree with a share of about two
    tolerances in the height of a photograph, below 1 %, but those of repeated structures along
    epipolar lines with far more. Larger: pairs far apart, most of whose matches are wrong, are
    lost."""
    distinct_share: float = 0.6
    """Share of the most distinct matches used to find the orientation: fewer of them are wrong, and
    the number of trials that a RANSAC needs grows with the fifth power of 1/(share of right
    ones). The least distinct ones are used later, if they agree."""
    sufficient_matches: int = 60
    """Number of unique matches with which the others are left out: enough for tracks across a
    photograph. Larger: windows that repeat themselves take part more often; smaller: pairs with few
    unique matches lose most of their connection."""
    min_extent: float = 0.05
    """Minimum standard deviation of agreeing matches across their longest direction, relative to
    that of a photograph's features: not a spot, and not a line. An object in a tenth of a
    photograph has 0.3."""
    first_factor: float = 3.0
    """The tolerance of the first choice of matches, as a factor of `tolerance`: an orientation from
    five matches predicts the others worse than one refined with all of them."""
    rotation_trials: int = 40
    """Number of pairs of matches for trial rotations: with half of the matches right (fewer are
    not accepted) all trials have a wrong match with a probability of 0.75⁴⁰ = 1e-5."""
    explained_share: float = 0.9
    """Share of the matches that a simpler relation must explain. Smaller: pairs with a short base
    are taken for rotations, and a model does not start from them though it could; larger: ones
    without a base start a model."""


@dataclasses.dataclass(frozen=True)
class Pair:
    """Two overlapping photographs: rows of matching features; M from the first camera to
    the second and base b; angle of intersection (median, radians); `kind`: `"relative"`, or a
    sufficient simpler relation: `"plane"`, `"rotation"` (b is then zero or without meaning);
    `match_count`: before verification; `sure`: oriented by unique matches."""

    images: tuple[int, int]
    matches: Int[np.ndarray, "n 2"]
    distance_ratio: Float[np.ndarray, " n"]
    M: Float[np.ndarray, "3 3"]
    b: Float[np.ndarray, "3"]
    angle: float
    kind: str
    match_count: int
    sure: bool = True

    def __len__(self) -> int:
        return len(self.matches)


class VerifiedPair(NamedTuple):
    """The matches of a pair explained by one object; M, b, angle and kind as of `Pair`."""

    good: Bool[np.ndarray, " n"]
    M: Float[np.ndarray, "3 3"]
    b: Float[np.ndarray, "3"]
    angle: float
    kind: str
    sure: bool


Agreement = tuple[Bool[np.ndarray, " n"], Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]
"""Which matches of a pair agree with its relative orientation; M and b of it."""


def verify_pairs(
    xy1: Sequence[Float[np.ndarray, "_ 2"]],
    xy2: Sequence[Float[np.ndarray, "_ 2"]],
    tolerance: Float[np.ndarray, " pairs"],
    unique: Sequence[Bool[np.ndarray, " _"]] | None = None,
    settings: VerificationSettings = VerificationSettings(),
) -> list[VerifiedPair | None]:
    """The part of each pair explained by one object; None if too few matches agree.

    **Arguments:** matches, the most distinct first, as ideal image coordinates, c = 1; `tolerance`:
    of Sampson's distance, c = 1; `unique`: which matches are unique; all, if not given.
    """
    unique = [np.ones(len(xy), bool) for xy in xy1] if unique is None else unique
    min_matches = settings.min_matches
    usable = [k for k, xy in enumerate(xy1) if len(xy) >= min_matches]
    verified: list[VerifiedPair | None] = [None] * len(xy1)
    if not usable:
        return verified
    find = lambda rows: _find_agreeing(rows, xy1, xy2, tolerance, settings)
    # First the unique matches alone; then all, where enough are added to make it another trial.
    agreed_by_unique = find({k: np.flatnonzero(unique[k]) for k in usable})
    agreed = find(
        {
            k: np.arange(len(xy1[k]))
            for k in usable
            if k not in agreed_by_unique and (~unique[k]).sum() >= min_matches
        }
    )
    agreed |= agreed_by_unique
    for k in agreed_by_unique:
        good, M, b = agreed[k]
        if (good & unique[k]).sum() >= settings.sufficient_matches:
            agreed[k] = good & unique[k], M, b
    # Without a base the coplanarity condition is empty, and the robust orientation may fail; a
    # rotation alone has fewer unknowns and is sought for itself.
    turned = {
        k: turn
        for k in usable
        if k not in agreed
        and (turn := _find_rotation(xy1[k], xy2[k], tolerance[k], settings)) is not None
    }
    pairs_left = sorted(agreed)
    kinds = _classify(
        [agreed[k] for k in pairs_left],
        [xy1[k] for k in pairs_left],
        [xy2[k] for k in pairs_left],
        tolerance[pairs_left],
        settings.explained_share,
    )
    for k, (good, angle, kind) in zip(pairs_left, kinds):
        _, M, b = agreed[k]
        verified[k] = VerifiedPair(good, M, b, angle, kind, k in agreed_by_unique)
    for k, (good, M) in turned.items():
        verified[k] = VerifiedPair(good, M, np.zeros(3), 0.0, "rotation", True)
    return verified


def _find_agreeing(
    rows: Mapping[int, Int[np.ndarray, " _"]],
    xy1: Sequence[Float[np.ndarray, "_ 2"]],
    xy2: Sequence[Float[np.ndarray, "_ 2"]],
    tolerance: Float[np.ndarray, " pairs"],
    settings: VerificationSettings,
) -> dict[int, Agreement]:
    """By pair, the matches that agree with the orientation from some of them (`rows`), if enough of
    these agree. Otherwise only the most distinct ones are tried: for photographs far apart most
    matches may be wrong."""
    rows = {k: r for k, r in rows.items() if len(r) >= settings.min_matches}
    # The most distinct ones, but all of a few.
    distinct = lambda n: batched.evenly_spaced(
        max(int(settings.distinct_share * n), min(n, batched.SLOTS))
    )
    by_distinct = _orient_by_rows(rows, distinct, xy1, xy2, tolerance, settings)
    # The first `batched.SLOTS` are another trial only if the first trial was spread over more.
    rows_again = {
        k: r
        for k, r in rows.items()
        if k not in by_distinct and settings.distinct_share * len(r) > batched.SLOTS
    }
    most_distinct = lambda _: np.arange(batched.SLOTS)
    return {
        **_orient_by_rows(rows_again, most_distinct, xy1, xy2, tolerance, settings),
        **by_distinct,
    }


def _orient_by_rows(
    rows: Mapping[int, Int[np.ndarray, " _"]],
    choose: Callable[[int], Int[np.ndarray, " _"]],
    xy1: Sequence[Float[np.ndarray, "_ 2"]],
    xy2: Sequence[Float[np.ndarray, "_ 2"]],
    tolerance: Float[np.ndarray, " pairs"],
    settings: VerificationSettings,
) -> dict[int, Agreement]:
    """By pair, the matches that agree with the orientation from the rows that `choose(len(rows))`
    selects, if enough of all `rows` agree."""
    if not rows:
        return {}
    keys = np.array(list(rows))
    chosen_rows = [rows[k][choose(len(rows[k]))] for k in rows]
    M, b, share, _ = batched.orient_pairs(
        [xy1[k][r] for k, r in zip(rows, chosen_rows)],
        [xy2[k][r] for k, r in zip(rows, chosen_rows)],
        settings.first_factor * tolerance[keys],
    )
    poses = {k: (M[i], b[i]) for i, k in enumerate(rows) if share[i] > 0}
    # Matches and orientation alternately, the second time with those of the final tolerance.
    for factor in (settings.first_factor, 1.0):
        poses = _improve(poses, rows, xy1, xy2, factor * tolerance, settings.min_matches)
    agreed = {}
    for k, (M, b) in poses.items():
        good = agreeing_matches(M, b, xy1[k], xy2[k], tolerance[k])
        use = rows[k][good[rows[k]]]
        has_enough = len(use) >= max(settings.min_matches, settings.min_share * len(rows[k]))
        # The smaller eigenvalue of the covariance is the variance across a line.
        if has_enough and all(
            np.linalg.eigvalsh(np.cov(xy[k][use].T))[0] > (settings.min_extent * xy[k].std()) ** 2
            for xy in (xy1, xy2)
        ):
            agreed[k] = good, M, b
    return agreed


def prepare() -> None:
    """Compile the programs of `verify_pairs` ahead of its data."""
    xy = np.random.default_rng(0).uniform(-0.5, 0.5, (LANES, MATCH_SLOTS, 2))
    M, b = np.tile(np.eye(3), (LANES, 1, 1)), np.tile([1.0, 0, 0], (LANES, 1))
    weights = np.ones((LANES, MATCH_SLOTS))
    batched.run_in_lanes(_refine, LANES, M, b, xy, xy, weights)
    batched.run_in_lanes(_simpler, LANES, M, xy, xy, weights)


def _find_rotation(
    xy1: Float[np.ndarray, "n 2"],
    xy2: Float[np.ndarray, "n 2"],
    tolerance: float,
    settings: VerificationSettings,
) -> tuple[Bool[np.ndarray, " n"], Float[np.ndarray, "3 3"]] | None:
    """The matches explained by a rotation about the projection centre, and M, if they are most."""
    rays = [np.pad(xy, ((0, 0), (0, 1)), constant_values=-1.0) for xy in (xy1, xy2)]
    rays_1, rays_2 = (a / np.linalg.norm(a, axis=1, keepdims=True) for a in rays)
    rng, best = np.random.default_rng(0), None
    largest_number = max(settings.min_matches, len(xy1) // 2) - 1
    for _ in range(settings.rotation_trials):
        i, j = rng.choice(len(rays_1), 2, replace=False)
        triad_1, triad_2 = (_triad(a[i], a[j]) for a in (rays_1, rays_2))
        if triad_1 is None or triad_2 is None:
            continue
        M = triad_2.T @ triad_1
        # Twice the tolerance: Sampson's distance is 1/√2 of the distance from an epipolar line, and
        # that is one of the two components of the distance of two rays.
        good = np.linalg.norm(rays_1 @ M.T - rays_2, axis=1) < 2 * tolerance
        if good.sum() > largest_number:
            largest_number, best = good.sum(), (good, M)
    return best


def _triad(a: Float[np.ndarray, "3"], b: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"] | None:
    """Three orthogonal unit vectors from two rays (TRIAD; Black 1964); None if the angle between
    them is below a milliradian, about that of their errors."""
    normal = np.cross(a, b)
    length = np.linalg.norm(normal)
    return None if length < 1e-3 else np.stack([a, normal / length, np.cross(a, normal / length)])


def agreeing_matches(
    M: Float[np.ndarray, "3 3"],
    b: Float[np.ndarray, "3"],
    xy1: Float[np.ndarray, "n 2"],
    xy2: Float[np.ndarray, "n 2"],
    tolerance: float,
) -> Bool[np.ndarray, " n"]:
    """Which matches have a Sampson distance below the tolerance, and lie in front of both cameras.

    In NumPy: the number of matches differs from pair to pair, and each would be a compilation."""
    a1, a2 = (np.pad(xy, ((0, 0), (0, 1)), constant_values=-1.0) for xy in (xy1, xy2))
    rays_back = a2 @ M
    # e = |a₂ᵀ·l₂| / √(l₂ₓ² + l₂ᵧ² + l₁ₓ² + l₁ᵧ²) with the epipolar lines l₂ = M·(b × a₁) and
    # l₁ = (Mᵀ·a₂) × b (Sampson 1982)
    line2, line1 = np.cross(b, a1) @ M.T, np.cross(rays_back, b)
    square = (line2[:, :2] ** 2).sum(1) + (line1[:, :2] ** 2).sum(1)
    e = np.abs((a2 * line2).sum(1)) / np.sqrt(np.maximum(square, 1e-300))
    # The determinant is positive: the signs of both depths are those of the numerators.
    depth_1, depth_2, _ = depths_of_rays(a1, rays_back, b)
    return (e < tolerance) & (depth_1 > 0) & (depth_2 > 0)


def depths_of_rays(
    a: Float[np.ndarray, "n 3"], c: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """The depths s and t of the nearest points s·a and b + t·c of rays in one system, times their
    determinant (0 for parallel rays), and this: the normal equations of s·a − t·c = b. In NumPy, of
    many numbers of matches; `orientation.relative.distances_along_rays` is the same for JAX."""
    aa, cc, dot = (a**2).sum(1), (c**2).sum(1), (a * c).sum(1)
    a_b, c_b = a @ b, c @ b
    return cc * a_b - dot * c_b, dot * a_b - aa * c_b, aa * cc - dot * dot


def _improve(
    poses: Mapping[int, tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]],
    candidates: Mapping[int, Int[np.ndarray, " _"]],
    xy1: Sequence[Float[np.ndarray, "_ 2"]],
    xy2: Sequence[Float[np.ndarray, "_ 2"]],
    tolerance: Float[np.ndarray, " pairs"],
    min_matches: int,
) -> dict[int, tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]]:
    """M and b refined by those of the `candidates` (rows of matches) within the tolerance, of pairs
    with at least `min_matches` of them."""
    keys, rows = [], []
    for k, (M, b) in poses.items():
        candidate_rows = candidates[k]
        good = candidate_rows[
            agreeing_matches(M, b, xy1[k][candidate_rows], xy2[k][candidate_rows], tolerance[k])
        ]
        if len(good) >= min_matches:
            keys.append(k)
            rows.append(good[batched.evenly_spaced(len(good), MATCH_SLOTS)])
    if not keys:
        return {}
    filled = lambda xy: np.stack([_fill(xy[k][r]) for k, r in zip(keys, rows)])
    weights = _used_slots(rows)
    start = [np.stack([poses[k][i] for k in keys]) for i in (0, 1)]
    M, b = batched.run_in_lanes(_refine, LANES, *start, filled(xy1), filled(xy2), weights)
    return {k: (M[i], b[i]) for i, k in enumerate(keys) if np.isfinite(M[i]).all()}


def refine_rotations(
    pairs: Sequence[Pair],
    ideal: Sequence[tuple[Float[np.ndarray, "_ 2"], Float[np.ndarray, "_ 2"]]],
) -> Float[np.ndarray, "pairs 3 3"]:
    """M of pairs, refined with their matches at these coordinates, c = 1."""
    rows = [batched.evenly_spaced(len(pair), MATCH_SLOTS) for pair in pairs]
    weights = _used_slots(rows)
    xy1, xy2 = (np.stack([_fill(xy[i][r]) for xy, r in zip(ideal, rows)]) for i in (0, 1))
    # With a strong K1 rays of the border have no image: without weight.
    weights *= np.isfinite(xy1 + xy2).all(-1)
    xy1, xy2 = np.nan_to_num(xy1), np.nan_to_num(xy2)
    start = [np.stack([getattr(pair, name) for pair in pairs]) for name in ("M", "b")]
    return batched.run_in_lanes(_refine, LANES, *start, xy1, xy2, weights)[0]


def rotation_angle(M: Float[np.ndarray, "*n 3 3"]) -> Float[np.ndarray, "*n"]:
    """The angle of rotations, radians."""
    # sin ω from M − Mᵀ, cos ω from the trace: each alone loses half of the digits near 0 or π.
    antisymmetric = M - np.swapaxes(M, -1, -2)
    sine = np.sqrt((antisymmetric**2).sum((-2, -1)) / 8)
    return np.arctan2(sine, (np.trace(M, axis1=-2, axis2=-1) - 1) / 2)


def loop_misclosure(
    ij: Float[np.ndarray, "*n 3 3"],
    jk: Float[np.ndarray, "*n 3 3"],
    ik: Float[np.ndarray, "*n 3 3"],
) -> Float[np.ndarray, "*n"]:
    """The angle of M_jk·M_ij·M_ikᵀ around three photographs, radians; 0 if the rotations close."""
    return rotation_angle(jk @ ij @ np.swapaxes(ik, -1, -2))


def _used_slots(rows: Sequence[Int[np.ndarray, " _"]]) -> Float[np.ndarray, "pairs slots"]:
    """Weights of the matches of pairs: 1, and 0 in slots that they do not need."""
    return np.stack([(np.arange(MATCH_SLOTS) < len(r)).astype(float) for r in rows])


def _fill(a: Float[np.ndarray, "n *shape"]) -> Float[np.ndarray, "slots *shape"]:
    # Cyclically repeated, with weights of 0: rows of zeros have no rays, and 0·NaN is NaN.
    return np.resize(a, (MATCH_SLOTS, *a.shape[1:]))


@quick_jit
@jax.vmap
def _refine(
    M: Float[Array, "3 3"],
    b: Float[Array, "3"],
    xy1: Float[Array, "slots 2"],
    xy2: Float[Array, "slots 2"],
    weights: Float[Array, " slots"],
) -> tuple[Float[Array, "3 3"], Float[Array, "3"]]:
    # Five unknowns; eight steps, since from an orientation by five matches few are needed, and the
    # choice of matches, not the last digit, limits the result.
    (M, b), _ = minimise(coplanarity_misclosures, retract, (M, b), (xy1, xy2, weights), 5, 8)
    return M, b


def _classify(
    agreed: Sequence[Agreement],
    xy1: Sequence[Float[np.ndarray, "_ 2"]],
    xy2: Sequence[Float[np.ndarray, "_ 2"]],
    tolerance: Float[np.ndarray, " pairs"],
    explained_share: float,
) -> list[tuple[Bool[np.ndarray, " _"], float, str]]:
    """Matches, angle and kind of every pair."""
    rows = [
        np.flatnonzero(good)[batched.evenly_spaced(int(good.sum()), MATCH_SLOTS)]
        for good, *_ in agreed
    ]
    if not agreed:
        return []
    filled = lambda xy: np.stack([_fill(a[r]) for a, r in zip(xy, rows)])
    weights = _used_slots(rows)
    M = np.stack([M for _, M, _ in agreed])
    angle, turn, plane = batched.run_in_lanes(_simpler, LANES, M, filled(xy1), filled(xy2), weights)
    kinds = []
    for k, (good, *_) in enumerate(agreed):
        number, double_tolerance = (
            int((weights[k] > 0).sum()),
            2 * tolerance[k],
        )  # as in `_find_rotation`
        by_rotation, by_plane = (
            float((e[k, :number] < double_tolerance).mean()) for e in (turn, plane)
        )
        kind = "plane" if by_plane > explained_share else "relative"
        kinds.append((good, float(angle[k]), "rotation" if by_rotation > explained_share else kind))
    return kinds


@quick_jit
@jax.vmap
def _simpler(
    M: Float[Array, "3 3"],
    xy1: Float[Array, "slots 2"],
    xy2: Float[Array, "slots 2"],
    weights: Float[Array, " slots"],
) -> tuple[Float[Array, ""], Float[Array, " slots"], Float[Array, " slots"]]:
    """Median angle of intersection; misclosures of a rotation and of a homography."""
    unit = lambda a: a / jnp.linalg.norm(a)
    rays1, rays2 = (jax.vmap(lambda xy: unit(ray_of(xy)))(xy) for xy in (xy1, xy2))
    rays_back = rays2 @ M
    angle = jnp.arctan2(
        jnp.linalg.norm(jnp.cross(rays1, rays_back), axis=1), jnp.sum(rays1 * rays_back, 1)
    )
    angle = jnp.nanmedian(jnp.where(weights > 0, angle, jnp.nan))
    turned = rays1 @ matrix_from_quaternion(rotation_between(rays1, rays2, weights)).T
    turn = jnp.linalg.norm(turned[:, :2] / -turned[:, 2:] - xy2, axis=1)
    H, _ = homography(xy1, xy2, weights)
    plane = jnp.linalg.norm(jax.vmap(apply_homography, (None, 0))(H, xy1) - xy2, axis=1)
    return angle, turn, plane
