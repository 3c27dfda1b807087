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
from jaxtyping import Array, Float, Int

from jaxbundle.cameras import CameraModel, get_model, image_ray
from jaxbundle.leastsquares.iterations.small import minimise
from jaxbundle.network.tables import Camera
from jaxbundle.orientation import batched
from jaxbundle.orientation.rays import ideal_points
from jaxbundle.orientation.relative import retract, sampson_distance
from jaxbundle.system.programs import quick_jit
from jaxbundle.types import AnyArray

# Padded numbers of pairs used together, and of matches of each: 512 misclosures for 2 + 8·5
# unknowns. More pairs would be ones with fewer matches or narrower angles, which determine c less.
PAIRS, SLOTS = 8, 64


@dataclasses.dataclass(frozen=True)
class CoplanaritySettings:
    """Settings of the search for the principal distance by the coplanarity condition."""

    factors: tuple[float, ...] = tuple(0.55 * 1.2**k for k in range(10))
    """Principal distances tried, relative to the longer side: 85° to 20° of view; in steps of 1.2,
    since the adjustment converges from 1.35 times the right one (`max_ratio`)."""
    candidates: int = 16
    """Number of pairs examined; `PAIRS` of them are used (most matches agree, wide angles)."""
    misclosure: float = 4.0
    """Misclosure at which a match has half weight, pixels of a photograph of 3000 pixels: lens
    distortion, which is not yet known, is as large. Smaller: matches at the border, which determine
    c and K1, lose their weight; larger: wrong matches keep theirs."""
    min_matches: int = 24
    """Minimum matches of a pair: a pair adds 5 unknowns to the common 2, and with a third of the
    matches wrong 16 remain."""
    distinct_share: float = 0.6
    """Share of the most distinct matches used, as in `VerificationSettings`."""
    min_agreeing: float = 0.3
    """Minimum share of agreeing matches for a pair to count. Smaller: pairs whose orientation is
    wrong take part in the adjustment; larger: pairs far apart do not."""
    usual: float = 1.0
    """The usual principal distance relative to the longer side: 53° of view, between the wide angle
    of telephones and drones (0.7) and the normal lens of cameras (1.4)."""
    doubt: float = 0.06
    """Relative reduction of the sum required to accept one that differs from the usual by a factor
    of e; for another factor x·(1 + x)/2 times as much, x = |ln| of it. Flat objects and parallel
    views have sums that hardly depend on c: the usual one then stays. Larger: so it does with
    objects that determine c."""
    wide_angle: float = 0.12
    """Angle of intersection, radians (7 degrees), above which wider angles are not better."""
    max_k1: float = 0.35
    """Larger |k1| is rejected: with −0.35 the image radius r·(1 + K1·r²) turns back at
    r = 0.98, 44 degrees off the axis, within a wide-angle photograph."""
    max_ratio: float = 1.35
    """A principal distance tried, or from the file, may be wrong by this factor; an adjustment that
    leads farther away has found another minimum."""


# Changes of ln c and K1; M and b of every pair.
State = tuple[Float[Array, "2"], Float[AnyArray, "pairs 3 3"], Float[AnyArray, "pairs 3"]]


@dataclasses.dataclass(frozen=True)
class CoplanarityResult:
    """The camera, the number of consistent pairs, and the misclosure of their matches (median,
    px)."""

    camera: Camera
    pairs: int
    misclosure: float


def estimate_interior(
    camera: Camera,
    pairs: Sequence[tuple[Float[np.ndarray, "_ 2"], Float[np.ndarray, "_ 2"]]],
    is_known: bool,
    settings: CoplanaritySettings = CoplanaritySettings(),
) -> CoplanarityResult:
    """The camera with the principal distance and K1 of consistent pairs.

    **Arguments:** `camera`: of model `opencv`; `pairs`: the matches of each in pixels, the most
    distinct first, the best pairs first; `is_known`: whether the principal distance of the camera
    is a usable start value."""
    min_matches = settings.min_matches
    pairs = [(side_1, side_2) for side_1, side_2 in pairs if len(side_1) >= min_matches][
        : settings.candidates
    ]
    if not pairs or camera.image_size is None:
        return CoplanarityResult(camera, 0, np.nan)
    size = max(camera.image_size)
    limit = settings.misclosure * size / 3000
    clear = [
        batched.evenly_spaced(max(int(settings.distinct_share * len(a)), min_matches), SLOTS)
        for a, _ in pairs
    ]
    xy1, xy2 = ([pair[i][r] for pair, r in zip(pairs, clear)] for i in (0, 1))
    distances_tried = (
        [camera.parameters["fx"]] if is_known else [size * factor for factor in settings.factors]
    )
    if len(pairs) > PAIRS:
        # Every third distance suffices to see which pairs agree at all, and at which angle.
        first_tried = distances_tried if is_known else distances_tried[1::3]
        _, _, part, _, angle = _orient(
            [_with_distance(camera, f) for f in first_tried], xy1, xy2, limit
        )
        # σ of c falls with the angle; matches that agree count more than it does
        worth = (part * np.sqrt(np.minimum(angle, settings.wide_angle))).max(0)
        chosen_pairs = np.sort(np.argsort(-worth, kind="stable")[:PAIRS])
        xy1, xy2 = ([side[k] for k in chosen_pairs] for side in (xy1, xy2))
    M, b, part, costs, _ = _orient(
        [_with_distance(camera, f) for f in distances_tried], xy1, xy2, limit
    )
    unusual = np.abs(np.log(np.array(distances_tried) / (settings.usual * size)))
    doubt = 1 + settings.doubt * unusual * (1 + unusual) / 2
    # Of all pairs together: one pair alone often has a minimum at the end of the range.
    best = int(np.argmin(costs.sum(1) * (1 if is_known else doubt)))
    f, M, b, part = distances_tried[best], M[best], b[best], part[best]
    use = np.flatnonzero(part > settings.min_agreeing)
    if not len(use):
        return CoplanarityResult(_with_distance(camera, f), 0, np.nan)
    f, k1, e = _adjust(
        _with_distance(camera, f), [(xy1[k], xy2[k]) for k in use], M[use], b[use], limit
    )
    # Relative to what was known or tried: the files know lenses of any length.
    sane = 1 / settings.max_ratio < f / distances_tried[best] < settings.max_ratio
    sane &= abs(k1) < settings.max_k1
    better = (
        _with_distance(camera, f, k1) if sane else _with_distance(camera, distances_tried[best])
    )
    return CoplanarityResult(better, len(use), float(np.median(np.abs(e))))


def prepare() -> None:
    """Compile the programs of `estimate_interior` ahead of its data."""
    xy = np.random.default_rng(0).uniform(-0.5, 0.5, (PAIRS, SLOTS, 2))
    batched.orient_pairs(list(xy), list(xy), np.full(PAIRS, 1e-3))
    camera = Camera("camera", "opencv", {"fx": 1.0, "fy": 1.0})
    M, b = np.tile(np.eye(3), (PAIRS, 1, 1)), np.tile([1.0, 0, 0], (PAIRS, 1))
    _adjust(camera, list(zip(xy, xy)), M, b, 1.0)


def _with_distance(camera: Camera, f: float, k1: float = 0.0) -> Camera:
    return dataclasses.replace(camera, parameters={**camera.parameters, "fx": f, "fy": f, "k1": k1})


def _orient(
    cameras: Sequence[Camera],
    xy1: Sequence[Float[np.ndarray, "_ 2"]],
    xy2: Sequence[Float[np.ndarray, "_ 2"]],
    limit: float,
) -> tuple[Float[np.ndarray, "cameras pairs *_"], ...]:
    """Relative orientations M, b of all pairs with each camera, shares of agreeing matches, robust
    sums, and angles of intersection."""
    f = np.repeat([camera.parameters["fx"] for camera in cameras], len(xy1))
    points_1, points_2 = (
        [ideal_points(c, xy) for c in cameras for xy in side] for side in (xy1, xy2)
    )
    M, b, part, angle = batched.orient_pairs(points_1, points_2, limit / f)
    filled = (np.stack([_fill(a) for a in side]) for side in (points_1, points_2))
    e = np.asarray(batched.run_in_lanes(_sampson, batched.LANES, M, b, *filled)[0])
    # In pixels, so that the distances do not shrink with the scale of a larger c.
    e = np.nan_to_num(f[:, None] * e, nan=1e3)
    # Cauchy's ρ = ln(1 + (e/limit)²); a pair that cannot be oriented counts as with 10 limits
    costs = np.where(part > 0, np.log1p((e / limit) ** 2).mean(1), np.log1p(100.0))
    by_camera = lambda a: a.reshape(len(cameras), len(xy1), *a.shape[1:])
    return tuple(by_camera(a) for a in (M, b, part, costs, angle))


def _fill(a: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "slots 2"]:
    return np.resize(a, (SLOTS, *a.shape[1:]))


@quick_jit
@jax.vmap
def _sampson(
    M: Float[Array, "3 3"],
    b: Float[Array, "3"],
    xy1: Float[Array, "slots 2"],
    xy2: Float[Array, "slots 2"],
) -> tuple[Float[Array, " slots"]]:
    return (jax.vmap(sampson_distance, (None, None, 0, 0))(M, b, xy1, xy2),)


def _adjust(
    camera: Camera,
    pairs: Sequence[tuple[Float[np.ndarray, "_ 2"], Float[np.ndarray, "_ 2"]]],
    M: Float[np.ndarray, "pairs 3 3"],
    b: Float[np.ndarray, "pairs 3"],
    limit: float,
) -> tuple[float, float, Float[np.ndarray, "pairs slots"]]:
    """f, k1 and the misclosures after an adjustment of all pairs together."""
    rows = [k % len(pairs) for k in range(PAIRS)]
    weight = (np.arange(PAIRS) < len(pairs)).astype(float)
    xy1, xy2 = (np.stack([_fill(pairs[k][i]) for k in rows]) for i in (0, 1))
    model = get_model(camera.model)
    p = np.array([camera.parameters.get(name, 0.0) for name in model.parameters])
    f, k1, e = _self_calibrate(model, p, M[rows], b[rows], xy1, xy2, weight, limit)
    return float(f), float(k1), np.asarray(e)[: len(pairs)]


@partial(quick_jit, static=0)
def _self_calibrate(
    model: CameraModel,
    p: Float[Array, " parameters"],
    M: Float[Array, "pairs 3 3"],
    b: Float[Array, "pairs 3"],
    xy1: Float[Array, "pairs slots 2"],
    xy2: Float[Array, "pairs slots 2"],
    weight: Float[Array, " pairs"],
    limit: Float[Array, ""],
) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, "pairs slots"]]:
    """f, K1 and the misclosures, by iteratively re-weighted least squares."""
    names = model.parameters
    fx, fy, k1 = (names.index(name) for name in ("fx", "fy", "k1"))
    start_distance = p[fx]

    def camera(change: Float[Array, "2"]) -> Float[Array, " parameters"]:
        # ln c: it stays positive, and a change is relative to it
        f = start_distance * jnp.exp(change[0])
        return p.at[fx].set(f).at[fy].set(f).at[k1].add(change[1])

    def ideal(q: Float[Array, " parameters"], xy: Float[Array, "2"]) -> Float[Array, "2"]:
        r, s, w = image_ray(model, tuple(q), xy[0], xy[1])
        return jnp.stack([-r / w, -s / w])

    # Traced once for the three uses below.
    @jax.jit
    def misclosures(
        state: State,
        xy1: Float[Array, "pairs slots 2"],
        xy2: Float[Array, "pairs slots 2"],
        root: Float[Array, "pairs slots"],
    ) -> Float[Array, " matches"]:
        change, M, b = state
        q = camera(change)
        points_1, points_2 = jax.vmap(jax.vmap(jax.vmap(lambda xy: ideal(q, xy))))(
            jnp.stack([xy1, xy2])
        )
        e = jax.vmap(jax.vmap(sampson_distance, (None, None, 0, 0)))(M, b, points_1, points_2)
        return (root * q[fx] * e).ravel()

    def move(state: State, delta: Float[Array, " unknowns"]) -> State:
        change, M, b = state
        M, b = jax.vmap(lambda M, b, d: retract((M, b), d))(M, b, delta[2:].reshape(-1, 5))
        return change + delta[:2], M, b

    def adjust_once(_: Int[Array, ""], state: State) -> State:
        e = misclosures(state, xy1, xy2, jnp.ones(xy1.shape[:2])).reshape(xy1.shape[:2])
        # The root of Cauchy's weight 1/(1 + (e/limit)²).
        root = weight[:, None] / jnp.sqrt(1 + (jnp.nan_to_num(e, nan=1e6) / limit) ** 2)
        state, _ = minimise(misclosures, move, state, (xy1, xy2, root), 2 + 5 * len(M), 8)
        return state

    # Four times with at most eight steps: start values, which need not converge.
    state = jax.lax.fori_loop(0, 4, adjust_once, (jnp.zeros(2), M, b))
    e = misclosures(state, xy1, xy2, jnp.ones(xy1.shape[:2])).reshape(xy1.shape[:2])
    q = camera(state[0])
    return q[fx], q[k1], e
