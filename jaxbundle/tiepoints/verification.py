"""The matches of two photographs that one object can explain.

A robust relative orientation is computed from the most distinct matches (five points
at a time, `orientation.robust`), refined with the agreeing matches, and then tested with all
matches: the coplanarity misclosure (Sampson), and both rays in front. A pure rotation, or a
homography, that explains nearly all of them as well is reported: two photographs from one position,
or of a plane, which do not start a model.

Unique matches come first (`Matches.single`): in a row of windows, matches of each window to its
neighbour are consistent with a wrong orientation, shifted by their distance. All matches are used
only if too few unique ones agree; such a pair is not `sure`. In a sure pair with
`SUFFICIENT_MATCHES` unique matches the others are left out: windows follow one another along an
epipolar line.

Agreeing matches must be distributed over both photographs, not in one corner: a common sign
in two scenes does not prove that they are the same.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbundle.geometry import matrix_from_quaternion
from jaxbundle.leastsquares.iterations.small import minimise
from jaxbundle.orientation import (
    apply_homography,
    homography,
    many,
    ray_of,
)
from jaxbundle.orientation.absolute import rotation_between
from jaxbundle.orientation.relative import retract, sampson_distance
from jaxbundle.system.compilation import quick_jit

LEAST, PART = 16, 0.2
"""Minimum number of agreeing matches, and their minimum share of all."""
DISTINCT = 0.6
"""Share of the most distinct matches used to find the orientation."""
SUFFICIENT_MATCHES = 60
"""Sufficient number of unique matches."""
EXTENT = 0.05
"""Minimum standard deviation of agreeing matches across their longest direction, relative to
that of a photograph's features: not a spot, and not a line."""
SLOTS, LANES = 192, 8
ROUNDS, STEPS = 2, 8
TURNS = 40
"""Number of pairs of matches for trial rotations."""
FIRST_TOLERANCE = 3.0
"""The first choice of matches, in tolerances."""
EXPLAINED_SHARE = 0.9
"""Share of the matches that a simpler relation must explain."""
KINDS = ("relative", "plane", "rotation")


@dataclasses.dataclass(frozen=True)
class Pair:
    """Two overlapping photographs: rows of matching features; M from the first camera to
    the second and base b; angle of intersection (median, radians); `kind`: `"relative"`, or a
    sufficient simpler relation: `"plane"`, `"rotation"` (b is then zero or without meaning);
    `found`: matches before verification; `sure`: oriented by unique matches."""

    images: tuple[int, int]
    matches: Int[np.ndarray, "n 2"]
    clarity: Float[np.ndarray, " n"]
    M: Float[np.ndarray, "3 3"]
    b: Float[np.ndarray, "3"]
    angle: float
    kind: str
    found: int
    sure: bool = True

    def __len__(self) -> int:
        return len(self.matches)


class Verified(NamedTuple):
    """The matches of a pair explained by one object; M, b, angle and kind as of `Pair`."""

    good: Bool[np.ndarray, " n"]
    M: Float[np.ndarray, "3 3"]
    b: Float[np.ndarray, "3"]
    angle: float
    kind: str
    sure: bool


def verify_pairs(
    xy1: Sequence[Float[np.ndarray, "_ 2"]],
    xy2: Sequence[Float[np.ndarray, "_ 2"]],
    tolerance: Float[np.ndarray, " pairs"],
    single: Sequence[Bool[np.ndarray, " _"]] | None = None,
) -> list[Verified | None]:
    """The part of each pair explained by one object; None if too few matches agree.

    **Arguments:** matches, the most distinct first, as ideal image coordinates, c = 1; `tolerance`:
    of Sampson's distance, c = 1; `single`: which matches are unique; all, if not given.
    """
    single = [np.ones(len(xy), bool) for xy in xy1] if single is None else single
    usable = [k for k, xy in enumerate(xy1) if len(xy) >= LEAST]
    found: list = [None] * len(xy1)
    if not usable:
        return found
    sure = _find_agreeing({k: np.flatnonzero(single[k]) for k in usable}, xy1, xy2, tolerance)
    others = {
        k: np.arange(len(xy1[k])) for k in usable if k not in sure and (~single[k]).sum() >= LEAST
    }
    agreed = {**_find_agreeing(others, xy1, xy2, tolerance), **sure}
    for k in sure:
        good, M, b = agreed[k]
        if (good & single[k]).sum() >= SUFFICIENT_MATCHES:
            agreed[k] = good & single[k], M, b
    turned = {
        k: turn
        for k in usable
        if k not in agreed and (turn := _by_rotation(xy1[k], xy2[k], tolerance[k])) is not None
    }
    left = sorted(agreed)
    kinds = _kinds(
        [agreed[k] for k in left], [xy1[k] for k in left], [xy2[k] for k in left], tolerance[left]
    )
    for k, (good, angle, kind) in zip(left, kinds):
        _, M, b = agreed[k]
        found[k] = Verified(good, M, b, angle, kind, k in sure)
    for k, (good, M) in turned.items():
        found[k] = Verified(good, M, np.zeros(3), 0.0, "rotation", True)
    return found


def _find_agreeing(rows: dict[int, np.ndarray], xy1, xy2, tolerance):
    """The agreeing matches of pairs with the orientation from some of them (`rows`), M and b, if
    enough of these agree. Otherwise only the most distinct ones are tried: for photographs far
    apart most matches may be wrong."""
    rows = {k: r for k, r in rows.items() if len(r) >= LEAST}
    found = _by_some(rows, _clear_rows, xy1, xy2, tolerance)
    again = {k: r for k, r in rows.items() if k not in found and DISTINCT * len(r) > many.SLOTS}
    return {**_by_some(again, lambda _: np.arange(many.SLOTS), xy1, xy2, tolerance), **found}


def _by_some(rows: dict[int, np.ndarray], clear, xy1, xy2, tolerance):
    """As `_find_agreeing`, from the number of matches given by `clear`."""
    if not rows:
        return {}
    keys = np.array(list(rows))
    few = [rows[k][clear(len(rows[k]))] for k in rows]
    M, b, part, _ = many.orient_pairs(
        [xy1[k][r] for k, r in zip(rows, few)],
        [xy2[k][r] for k, r in zip(rows, few)],
        FIRST_TOLERANCE * tolerance[keys],
    )
    poses = {k: (M[i], b[i]) for i, k in enumerate(rows) if part[i] > 0}
    for limit in (FIRST_TOLERANCE, 1.0):
        poses = _improve(poses, rows, xy1, xy2, tolerance, limit)
    found = {}
    for k, (M, b) in poses.items():
        good = _agree(M, b, xy1[k], xy2[k], tolerance[k])
        use = rows[k][good[rows[k]]]
        enough = len(use) >= max(LEAST, PART * len(rows[k]))
        if enough and all(_is_extended(xy[k][use], xy[k]) for xy in (xy1, xy2)):
            found[k] = good, M, b
    return found


def _is_extended(some, every) -> bool:
    """Whether some points extend over more than a spot or a line among all."""
    return np.linalg.eigvalsh(np.cov(some.T))[0] > (EXTENT * every.std()) ** 2


def prepare() -> None:
    """Compile the programs of `verify_pairs` ahead of its data."""
    xy = np.random.default_rng(0).uniform(-0.5, 0.5, (LANES, SLOTS, 2))
    M, b = np.tile(np.eye(3), (LANES, 1, 1)), np.tile([1.0, 0, 0], (LANES, 1))
    weights = np.ones((LANES, SLOTS))
    many.run_in_lanes(_refine, LANES, M, b, xy, xy, weights)
    many.run_in_lanes(_simpler, LANES, M, b, xy, xy, weights)


def _by_rotation(xy1, xy2, tolerance):
    """The matches explained by a rotation about the projection centre, and M, if they are most."""
    rays = [np.pad(xy, ((0, 0), (0, 1)), constant_values=-1.0) for xy in (xy1, xy2)]
    one, two = (a / np.linalg.norm(a, axis=1, keepdims=True) for a in rays)
    rng, best = np.random.default_rng(0), None
    most = max(LEAST, len(xy1) // 2) - 1
    for _ in range(TURNS):
        i, j = rng.choice(len(one), 2, replace=False)
        first, second = (_triad(a[i], a[j]) for a in (one, two))
        if first is None or second is None:
            continue
        M = second.T @ first
        good = np.linalg.norm(one @ M.T - two, axis=1) < 2 * tolerance
        if good.sum() > most:
            most, best = good.sum(), (good, M)
    return best


def _triad(a, b):
    normal = np.cross(a, b)
    length = np.linalg.norm(normal)
    return None if length < 1e-3 else np.stack([a, normal / length, np.cross(a, normal / length)])


def _clear_rows(number):
    """The most distinct matches, all of a few."""
    return many.spread(max(int(DISTINCT * number), min(number, many.SLOTS)))


def _agree(M, b, xy1, xy2, tolerance):
    e, front = _distances(M, b, xy1, xy2)
    return (e < tolerance) & front


def _distances(M, b, xy1, xy2):
    """Sampson's distance of every match, and whether it is in front (numpy, any number)."""
    a1, a2 = (np.pad(xy, ((0, 0), (0, 1)), constant_values=-1.0) for xy in (xy1, xy2))
    back = a2 @ M
    line2, line1 = np.cross(b, a1) @ M.T, np.cross(back, b)
    square = (line2[:, :2] ** 2).sum(1) + (line1[:, :2] ** 2).sum(1)
    e = np.abs((a2 * line2).sum(1)) / np.sqrt(np.maximum(square, 1e-300))
    aa, cc, dot = (a1**2).sum(1), (back**2).sum(1), (a1 * back).sum(1)
    first, second = a1 @ b, back @ b
    front = (cc * first - dot * second > 0) & (dot * first - aa * second > 0)
    return e, front


def _improve(poses, of, xy1, xy2, tolerance, limit):
    """The relative orientations refined by the matches (`of` these rows) within `limit`
    tolerances."""
    keys, rows = [], []
    for k, (M, b) in poses.items():
        good = of[k][_agree(M, b, xy1[k][of[k]], xy2[k][of[k]], limit * tolerance[k])]
        if len(good) >= LEAST:
            keys.append(k)
            rows.append(good[many.spread(len(good), SLOTS)])
    if not keys:
        return {}
    filled = lambda xy: np.stack([_fill(xy[k][r]) for k, r in zip(keys, rows)])
    weights = _used_slots(rows)
    start = [np.stack([poses[k][i] for k in keys]) for i in (0, 1)]
    M, b = many.run_in_lanes(_refine, LANES, *start, filled(xy1), filled(xy2), weights)
    return {k: (M[i], b[i]) for i, k in enumerate(keys) if np.isfinite(M[i]).all()}


def turn_pairs(
    pairs: Sequence[Pair],
    ideal: Sequence[tuple[Float[np.ndarray, "_ 2"], Float[np.ndarray, "_ 2"]]],
) -> Float[np.ndarray, "pairs 3 3"]:
    """M of pairs, refined with their matches at these coordinates, c = 1."""
    rows = [many.spread(len(pair), SLOTS) for pair in pairs]
    weights = _used_slots(rows)
    xy1, xy2 = (np.stack([_fill(xy[i][r]) for xy, r in zip(ideal, rows)]) for i in (0, 1))
    weights *= np.isfinite(xy1 + xy2).all(-1)
    xy1, xy2 = np.nan_to_num(xy1), np.nan_to_num(xy2)
    start = [np.stack([getattr(pair, name) for pair in pairs]) for name in ("M", "b")]
    return many.run_in_lanes(_refine, LANES, *start, xy1, xy2, weights)[0]


def rotation_angle(M: Float[np.ndarray, "*n 3 3"]) -> Float[np.ndarray, "*n"]:
    """The angle of rotations, radians."""
    across = M - np.swapaxes(M, -1, -2)
    sine = np.sqrt((across**2).sum((-2, -1)) / 8)
    return np.arctan2(sine, (np.trace(M, axis1=-2, axis2=-1) - 1) / 2)


def _used_slots(rows) -> Float[np.ndarray, "pairs slots"]:
    """Weights of the matches of pairs: 1, and 0 in slots that they do not need."""
    return np.stack([(np.arange(SLOTS) < len(r)).astype(float) for r in rows])


def _fill(a):
    return np.resize(a, (SLOTS, *a.shape[1:]))


@quick_jit
@jax.vmap
def _refine(M, b, xy1, xy2, weights):
    def misclosures(pair, xy1, xy2, root):
        M, b = pair
        return root * jax.vmap(sampson_distance, (None, None, 0, 0))(M, b, xy1, xy2)

    (M, b), _ = minimise(misclosures, retract, (M, b), (xy1, xy2, weights), 5, STEPS)
    return M, b


def _kinds(found, xy1, xy2, tolerance):
    """Matches, angle and kind of every pair."""
    rows = [np.flatnonzero(good)[many.spread(int(good.sum()), SLOTS)] for good, *_ in found]
    if not found:
        return []
    filled = lambda xy: np.stack([_fill(a[r]) for a, r in zip(xy, rows)])
    weights = _used_slots(rows)
    M, b = (np.stack([f[i] for f in found]) for i in (1, 2))
    angle, turn, plane = many.run_in_lanes(_simpler, LANES, M, b, filled(xy1), filled(xy2), weights)
    kinds = []
    for k, (good, *_) in enumerate(found):
        number, near = int((weights[k] > 0).sum()), 2 * tolerance[k]
        by_rotation, by_plane = (float((e[k, :number] < near).mean()) for e in (turn, plane))
        kind = "plane" if by_plane > EXPLAINED_SHARE else "relative"
        kinds.append((good, float(angle[k]), "rotation" if by_rotation > EXPLAINED_SHARE else kind))
    return kinds


@quick_jit
@jax.vmap
def _simpler(M, b, xy1, xy2, weights):
    """Median angle of intersection; misclosures of a rotation and of a homography."""
    unit = lambda a: a / jnp.linalg.norm(a)
    rays1, rays2 = (jax.vmap(lambda xy: unit(ray_of(xy)))(xy) for xy in (xy1, xy2))
    back = rays2 @ M
    angle = jnp.arctan2(jnp.linalg.norm(jnp.cross(rays1, back), axis=1), jnp.sum(rays1 * back, 1))
    angle = jnp.nanmedian(jnp.where(weights > 0, angle, jnp.nan))
    turned = rays1 @ matrix_from_quaternion(rotation_between(rays1, rays2, weights)).T
    turn = jnp.linalg.norm(turned[:, :2] / -turned[:, 2:] - xy2, axis=1)
    H, _ = homography(xy1, xy2, weights)
    plane = jnp.linalg.norm(jax.vmap(apply_homography, (None, 0))(H, xy1) - xy2, axis=1)
    return angle, turn, plane
