"""Which matches of two photographs one object can explain.

From the clearest matches a relative orientation is found that withstands gross errors (five points
at a time, `orientation.robust`); refined with the matches that agree; then all matches are held
against it: the distance of coplanarity (Sampson), and both rays in front. A rotation alone, or a
homography, that explains nearly all of them as well is named: two photographs from one place, or of
a plane, from which no model begins.
"""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxbundle.geometry import matrix_from_quaternion
from jaxbundle.leastsquares.small import minimise
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
"""Matches that must agree, and their least part of all."""
CLEAR = 0.6
"""Part of the matches, the clearest ones, from which the orientation is sought."""
SLOTS, LANES = 192, 8
ROUNDS, STEPS = 2, 8
TURNS = 40
"""Pairs of matches from which a rotation is tried."""
LOOSE = 3.0
"""The first choice of matches, in tolerances."""
EXPLAINED = 0.9
"""Part of the matches that a simpler relation must explain."""
KINDS = ("relative", "plane", "rotation")


@dataclasses.dataclass(frozen=True)
class Pair:
    """Two photographs that show the same: rows of features that match; M from the first camera to
    the second and base b; angle of intersection (median, radians); `kind`: `"relative"`, or what
    explains the pair as well: `"plane"`, `"rotation"` (b is then zero or without meaning); `found`:
    matches before verification."""

    images: tuple[int, int]
    matches: Int[np.ndarray, "n 2"]
    clarity: Float[np.ndarray, " n"]
    M: Float[np.ndarray, "3 3"]
    b: Float[np.ndarray, "3"]
    angle: float
    kind: str
    found: int

    def __len__(self) -> int:
        return len(self.matches)


def verify_pairs(
    xy1: Sequence[Float[np.ndarray, "_ 2"]],
    xy2: Sequence[Float[np.ndarray, "_ 2"]],
    tolerance: Float[np.ndarray, " pairs"],
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray, float, str] | None]:
    """For each pair the matches that agree (a mask), M, b, angle and kind; None where too few do.

    **Arguments:** matches, the clearest first, as ideal image coordinates, c = 1; `tolerance`: of
    Sampson's distance, c = 1.
    """
    usable = [k for k, xy in enumerate(xy1) if len(xy) >= LEAST]
    found: list = [None] * len(xy1)
    if not usable:
        return found
    clear = [_clear_rows(len(xy1[k])) for k in usable]
    M, b, part, _ = many.orient_pairs(
        [xy1[k][r] for k, r in zip(usable, clear)], [xy2[k][r] for k, r in zip(usable, clear)],
        LOOSE * tolerance[usable],
    )  # fmt: skip
    poses = {k: (M[i], b[i]) for i, k in enumerate(usable) if part[i] > 0}
    for limit in (LOOSE, 1.0):
        poses = _improved(poses, xy1, xy2, tolerance, limit)
    for k, (M, b) in poses.items():
        good = _agree(M, b, xy1[k], xy2[k], tolerance[k])
        if good.sum() >= max(LEAST, PART * len(good)):
            found[k] = good, M, b
    turned = {
        k: turn for k in usable if found[k] is None
        and (turn := _by_rotation(xy1[k], xy2[k], tolerance[k])) is not None
    }  # fmt: skip
    left = [k for k in range(len(found)) if found[k] is not None]
    kinds = _kinds([found[k] for k in left], [xy1[k] for k in left], [xy2[k] for k in left],
                   tolerance[left])  # fmt: skip
    for k, (good, angle, kind) in zip(left, kinds):
        found[k] = (good, *found[k][1:], angle, kind)
    for k, (good, M) in turned.items():
        found[k] = good, M, np.zeros(3), 0.0, "rotation"
    return found


def prepare() -> None:
    """Compile what `verify_pairs` runs, ahead of its data."""
    xy = np.random.default_rng(0).uniform(-0.5, 0.5, (LANES, SLOTS, 2))
    M, b = np.tile(np.eye(3), (LANES, 1, 1)), np.tile([1.0, 0, 0], (LANES, 1))
    weights = np.ones((LANES, SLOTS))
    many.in_lanes(_refine, LANES, M, b, xy, xy, weights)
    many.in_lanes(_simpler, LANES, M, b, xy, xy, weights)


def _by_rotation(xy1, xy2, tolerance):
    """The matches that a rotation about the projection centre explains, and M, if most are."""
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
    """The clearest of the matches, all of a few."""
    return many.spread(max(int(CLEAR * number), min(number, many.SLOTS)))


def _agree(M, b, xy1, xy2, tolerance):
    e, front = _distances(M, b, xy1, xy2)
    return (e < tolerance) & front


def _distances(M, b, xy1, xy2):
    """Sampson's distance of every match, and whether it lies in front (numpy, any number)."""
    a1, a2 = (np.pad(xy, ((0, 0), (0, 1)), constant_values=-1.0) for xy in (xy1, xy2))
    back = a2 @ M
    line2, line1 = np.cross(b, a1) @ M.T, np.cross(back, b)
    square = (line2[:, :2] ** 2).sum(1) + (line1[:, :2] ** 2).sum(1)
    e = np.abs((a2 * line2).sum(1)) / np.sqrt(np.maximum(square, 1e-300))
    aa, cc, dot = (a1**2).sum(1), (back**2).sum(1), (a1 * back).sum(1)
    first, second = a1 @ b, back @ b
    front = (cc * first - dot * second > 0) & (dot * first - aa * second > 0)
    return e, front


def _improved(poses, xy1, xy2, tolerance, limit):
    """The relative orientations refined by the matches that agree to `limit` tolerances."""
    keys, rows = [], []
    for k, (M, b) in poses.items():
        good = np.flatnonzero(_agree(M, b, xy1[k], xy2[k], limit * tolerance[k]))
        if len(good) >= LEAST:
            keys.append(k)
            rows.append(good[many.spread(len(good), SLOTS)])
    if not keys:
        return {}
    filled = lambda xy: np.stack([_fill(xy[k][r]) for k, r in zip(keys, rows)])
    weights = np.stack([(np.arange(SLOTS) < len(r)).astype(float) for r in rows])
    start = [np.stack([poses[k][i] for k in keys]) for i in (0, 1)]
    M, b = many.in_lanes(_refine, LANES, *start, filled(xy1), filled(xy2), weights)
    return {k: (M[i], b[i]) for i, k in enumerate(keys) if np.isfinite(M[i]).all()}


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
    weights = np.stack([(np.arange(SLOTS) < len(r)).astype(float) for r in rows])
    M, b = (np.stack([f[i] for f in found]) for i in (1, 2))
    angle, turn, plane = many.in_lanes(
        _simpler, LANES, M, b, filled(xy1), filled(xy2), weights
    )  # fmt: skip
    kinds = []
    for k, (good, *_) in enumerate(found):
        number, near = int((weights[k] > 0).sum()), 2 * tolerance[k]
        by_rotation, by_plane = (float((e[k, :number] < near).mean()) for e in (turn, plane))
        kind = "plane" if by_plane > EXPLAINED else "relative"
        kinds.append((good, float(angle[k]), "rotation" if by_rotation > EXPLAINED else kind))
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
