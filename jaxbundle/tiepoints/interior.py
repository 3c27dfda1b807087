"""The principal distance and K1 of a camera from pairs of its photographs, without prior knowledge.

Matches of two photographs satisfy the coplanarity condition only for the right interior
orientation. Every pair is oriented relatively with principal distances over a wide range, and the
distance with the smallest robust sum of Sampson's distances (in pixels) starts an adjustment of

    c, K1, and M, b of every pair

in which matches with larger misclosures have less weight (Cauchy). Pairs of parallel views hardly
determine c, nor do pairs of a plane: their sums are flat, and other pairs decide.
"""

import dataclasses
from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbundle.cameras import get_model, image_ray
from jaxbundle.leastsquares.iterations.small import minimise
from jaxbundle.network.tables import Camera
from jaxbundle.orientation import many
from jaxbundle.orientation.relative import retract, sampson_distance
from jaxbundle.orientation.sights import ideal_points
from jaxbundle.system.compilation import quick_jit

FACTORS = tuple(0.55 * 1.2**k for k in range(10))
"""Principal distances tried, relative to the longer side: 85° to 20° of view."""
CANDIDATES, PAIRS, SLOTS, PIXELS = 16, 8, 64, 4.0
"""Number of pairs examined, of pairs used (most matches agree, wide angles), and of their matches;
the misclosure at which a match has half weight, for a photograph of 3000 pixels: lens
distortion is not yet known."""
ROUNDS, STEPS = 4, 8
USUAL, DOUBT = 1.0, 0.06
"""The usual principal distance relative to the longer side, and the relative reduction of the sum
required to accept one that differs by a factor of e; for another factor x·(1 + x)/2 times as much,
x = |ln| of it."""
WIDE_ANGLE = 0.12
"""Angle of intersection, radians, above which wider angles are not better."""
LARGEST_K1 = 0.35
"""Larger |k1| is rejected."""
LARGEST_RATIO = 1.35
"""A principal distance tried, or from the file, may be wrong by this factor."""


@dataclasses.dataclass(frozen=True)
class Start:
    """The camera, the number of consistent pairs, and the misclosure of their matches (median,
    px)."""

    camera: Camera
    pairs: int
    misclosure: float


def estimate_interior(
    camera: Camera,
    pairs: Sequence[tuple[Float[np.ndarray, "_ 2"], Float[np.ndarray, "_ 2"]]],
    known: bool,
) -> Start:
    """A camera of model `opencv` with the principal distance and K1 of consistent pairs.

    **Arguments:** matches of each pair in pixels, the most distinct first, the best pairs first;
    `known`: whether the principal distance of the camera is a usable start value.
    """
    pairs = [(one, other) for one, other in pairs if len(one) >= 24][:CANDIDATES]
    if not pairs or camera.image_size is None:
        return Start(camera, 0, np.nan)
    size = max(camera.image_size)
    limit = PIXELS * size / 3000
    clear = [many.spread(max(int(0.6 * len(a)), 24), SLOTS) for a, _ in pairs]
    xy1, xy2 = ([pair[i][r] for pair, r in zip(pairs, clear)] for i in (0, 1))
    tried = [camera.parameters["fx"]] if known else [size * factor for factor in FACTORS]
    if len(pairs) > PAIRS:
        first = tried if known else tried[1::3]
        _, _, part, _, angle = _orient([_with(camera, f) for f in first], xy1, xy2, limit)
        worth = (part * np.sqrt(np.minimum(angle, WIDE_ANGLE))).max(0)
        chosen = np.sort(np.argsort(-worth, kind="stable")[:PAIRS])
        xy1, xy2 = ([side[k] for k in chosen] for side in (xy1, xy2))
    M, b, part, costs, _ = _orient([_with(camera, f) for f in tried], xy1, xy2, limit)
    unusual = np.abs(np.log(np.array(tried) / (USUAL * size)))
    usual = 1 + DOUBT * unusual * (1 + unusual) / 2
    best = int(np.argmin(costs.sum(1) * (1 if known else usual)))
    f, M, b, part = tried[best], M[best], b[best], part[best]
    use = np.flatnonzero(part > 0.3)
    if not len(use):
        return Start(_with(camera, f), 0, np.nan)
    f, k1, e = _adjust(_with(camera, f), [(xy1[k], xy2[k]) for k in use], M[use], b[use], limit)
    sane = np.isfinite(f) and 0.3 * size < f < 12 * size and abs(k1) < LARGEST_K1
    sane &= 1 / LARGEST_RATIO < f / tried[best] < LARGEST_RATIO
    better = _with(camera, f, k1) if sane else _with(camera, tried[best])
    return Start(better, len(use), float(np.median(np.abs(e))))


def prepare() -> None:
    """Compile the programs of `estimate_interior` ahead of its data."""
    xy = np.random.default_rng(0).uniform(-0.5, 0.5, (PAIRS, SLOTS, 2))
    many.orient_pairs(list(xy), list(xy), np.full(PAIRS, 1e-3))
    camera = Camera("camera", "opencv", {"fx": 1.0, "fy": 1.0})
    M, b = np.tile(np.eye(3), (PAIRS, 1, 1)), np.tile([1.0, 0, 0], (PAIRS, 1))
    _adjust(camera, list(zip(xy, xy)), M, b, 1.0)


def _with(camera, f, k1=0.0):
    return dataclasses.replace(camera, parameters={**camera.parameters, "fx": f, "fy": f, "k1": k1})


def _orient(cameras, xy1, xy2, limit):
    """Relative orientations of all pairs with each camera, shares of agreeing matches, robust sums,
    and angles of intersection."""
    f = np.repeat([camera.parameters["fx"] for camera in cameras], len(xy1))
    one, two = ([ideal_points(c, xy) for c in cameras for xy in side] for side in (xy1, xy2))
    M, b, part, angle = many.orient_pairs(one, two, limit / f)
    filled = (np.stack([_fill(a) for a in side]) for side in (one, two))
    e = np.asarray(many.run_in_lanes(_sampson, many.LANES, M, b, *filled)[0])
    e = np.nan_to_num(f[:, None] * e, nan=1e3)
    costs = np.where(part > 0, np.log1p((e / limit) ** 2).mean(1), np.log1p(100.0))
    by_camera = lambda a: a.reshape(len(cameras), len(xy1), *a.shape[1:])
    return tuple(by_camera(a) for a in (M, b, part, costs, angle))


def _fill(a):
    return np.resize(a, (SLOTS, *a.shape[1:]))


@quick_jit
@jax.vmap
def _sampson(M, b, xy1, xy2):
    return (jax.vmap(sampson_distance, (None, None, 0, 0))(M, b, xy1, xy2),)


def _adjust(camera, pairs, M, b, limit):
    """f, k1 and the misclosures after an adjustment of all pairs together."""
    rows = np.arange(PAIRS) % len(pairs)
    there = (np.arange(PAIRS) < len(pairs)).astype(float)
    xy1, xy2 = (np.stack([_fill(pairs[k][i]) for k in rows]) for i in (0, 1))
    model = get_model(camera.model)
    p = np.array([camera.parameters.get(name, 0.0) for name in model.parameters])
    f, k1, e = _self_calibrate(model, p, M[rows], b[rows], xy1, xy2, there, limit)
    return float(f), float(k1), np.asarray(e)[: len(pairs)]


@partial(quick_jit, static=0)
def _self_calibrate(model, p, M, b, xy1, xy2, there, limit):
    names = model.parameters
    fx, fy, k1 = (names.index(name) for name in ("fx", "fy", "k1"))
    size = p[fx]

    def camera(change):
        f = size * jnp.exp(change[0])
        return p.at[fx].set(f).at[fy].set(f).at[k1].add(change[1])

    def ideal(q, xy):
        r, s, w = image_ray(model, tuple(q), xy[0], xy[1])
        return jnp.stack([-r / w, -s / w])

    def misclosures(state, xy1, xy2, root):
        change, M, b = state
        q = camera(change)
        one, two = (jax.vmap(jax.vmap(lambda xy: ideal(q, xy)))(xy) for xy in (xy1, xy2))
        e = jax.vmap(jax.vmap(sampson_distance, (None, None, 0, 0)))(M, b, one, two)
        return (root * q[fx] * e).ravel()

    def move(state, delta):
        change, M, b = state
        M, b = jax.vmap(lambda M, b, d: retract((M, b), d))(M, b, delta[2:].reshape(-1, 5))
        return change + delta[:2], M, b

    def again(_, state):
        e = misclosures(state, xy1, xy2, jnp.ones(xy1.shape[:2])).reshape(xy1.shape[:2])
        root = there[:, None] / jnp.sqrt(1 + (jnp.nan_to_num(e, nan=1e6) / limit) ** 2)
        state, _ = minimise(misclosures, move, state, (xy1, xy2, root), 2 + 5 * len(M), STEPS)
        return state

    state = jax.lax.fori_loop(0, ROUNDS, again, (jnp.zeros(2), M, b))
    e = misclosures(state, xy1, xy2, jnp.ones(xy1.shape[:2])).reshape(xy1.shape[:2])
    q = camera(state[0])
    return q[fx], q[k1], e
