"""From photographs to verified pairs: features, matches, principal distances, verification."""

import dataclasses
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Float, UInt8

from jaxbundle.network.columns import count
from jaxbundle.network.tables import Camera
from jaxbundle.network.units import from_image_unit
from jaxbundle.orientation.sights import ideal_points
from jaxbundle.tiepoints import interior, verification
from jaxbundle.tiepoints.features import Detection, Features, find_features
from jaxbundle.tiepoints.interior import CANDIDATES, Start, estimate_interior
from jaxbundle.tiepoints.loops import split_contradicted
from jaxbundle.tiepoints.matching import Matches, distances_within, match_features, single_matches
from jaxbundle.tiepoints.pairs import candidate_pairs
from jaxbundle.tiepoints.store import Store
from jaxbundle.tiepoints.verification import SUFFICIENT_MATCHES, Pair, verify_pairs

Tell = Callable[[str, int, int], None]
TOLERANCE = 0.0012
"""Maximum Sampson distance of an agreeing match, relative to the longer side."""
WIDEST_SHARE = 0.6
"""Pairs that determine the principal distance: those with at least this part of the largest number
of matches, and others with fewer, which have longer bases."""
MOST_ALIKE = 5
"""Minimum number of the former."""
OF_THE_LENS = ("fx", "fy", "k1")
OTHERS, APART = (0.7, 0.9, 1.2, 1.6, 2.2), 1.15
"""Other principal distances to try, relative to the longer side, unless they differ by less
than this factor."""
REQUIRED_RATIO, MORE_THAN_TOLD = 1.05, 1.25
"""Required ratio of the numbers of explained matches; also to replace that from a file, which may
be wrong for cropped or reduced photographs."""
SUFFICIENT_SHARE = 0.85
"""Share of explained matches above which others are not tried."""
COMPARED_PAIRS = 24
"""Number of pairs for this comparison."""


def prepare() -> None:
    """Compile the programs of principal distances and verification, ahead of their data."""
    interior.prepare()
    verification.prepare()


def detect(
    read: Sequence[Callable[[], UInt8[np.ndarray, "rows columns"]]],
    fingerprints: list[str],
    settings: Detection,
    store: Store,
    workers: int,
    tell: Tell,
) -> list[Features]:
    """The features of every photograph, stored ones if available."""

    def one(k):
        found = store.load_features(fingerprints[k])
        if found is None:
            found = find_features(read[k](), settings)
            store.save_features(fingerprints[k], found)
        return found

    return _each(one, range(len(read)), workers, lambda n: tell("features", n, len(read)))


def match(
    features: Sequence[Features],
    fingerprints: list[str],
    way: str,
    place: Float[np.ndarray, "photographs 3"] | None,
    store: Store,
    workers: int,
    tell: Tell,
) -> list[Matches]:
    """The matches of candidate pairs."""
    with ThreadPoolExecutor(workers) as pool:
        pairs = candidate_pairs(features, way, place, pool.map)

    of = lambda pair: (fingerprints[pair[0]], fingerprints[pair[1]])
    kept = {pair: store.load_matches(*of(pair)) for pair in pairs}
    needed = sorted({k for pair, found in kept.items() if found is None for k in pair})
    with ThreadPoolExecutor(workers) as pool:
        own = dict(zip(needed, pool.map(distances_within, (features[k] for k in needed))))

    def one(pair):
        found = kept[pair]
        if found is None:
            both = own[pair[0]], own[pair[1]]
            rows, clarity = match_features(features[pair[0]], features[pair[1]], own=both)
            found = rows, clarity, single_matches(rows, both)
            store.save_matches(*of(pair), *found)
        return Matches(pair, *found)

    return _each(one, pairs, workers, lambda n: tell("matching", n, len(pairs)))


def _each(function, items, workers, advance):
    with ThreadPoolExecutor(workers) as pool:
        found = []
        for one in pool.map(function, items):
            found.append(one)
            advance(len(found))
    return found


def start_cameras(
    cameras: Sequence[Camera],
    of: Sequence[int],
    lens: Sequence[int],
    known: Sequence[bool],
    features: Sequence[Features],
    matches: Sequence[Matches],
) -> tuple[list[Camera], list[str]]:
    """Cameras with the principal distance and K1 of consistent pairs of their lens.

    If the principal distance is unknown, the result of few pairs is compared with other
    distances by the number of matches of many pairs explained by relative orientations.

    **Arguments:** `lens` of every camera; `known`: whether its principal distance is a usable start
    value.
    """
    better, notes = list(cameras), []
    for number in dict.fromkeys(lens):
        own = [c for c in range(len(cameras)) if lens[c] == number]
        found = [_once(m) for m in matches if {of[k] for k in m.images} <= set(own)]
        first, name, told = cameras[own[0]], cameras[own[0]].id, known[own[0]]
        xy = _centre(cameras, of, features, _choose_pairs(found))
        begin = dataclasses.replace(first, parameters={**first.parameters, "cx": 0.0, "cy": 0.0})
        start = estimate_interior(begin, xy, told)
        if start.pairs:
            clear = sorted(found, key=lambda m: -len(m.rows))[:COMPARED_PAIRS]
            explained = lambda camera, clear=clear, own=own: _count_explained(
                with_lens(cameras, own, camera), of, features, clear
            )
            now, every = explained(start.camera), sum(len(m.rows) for m in clear)
            least = (MORE_THAN_TOLD if told else REQUIRED_RATIO) * now
            if now < SUFFICIENT_SHARE * every and least < every:
                start = _choose_principal_distance(start, begin, xy, explained, least)
        p = start.camera.parameters
        better = with_lens(better, own, start.camera)
        if start.pairs:
            notes.append(f"camera {name}: start values from {count(start.pairs, 'pair')}: principal"
                         f" distance {p['fx']:.0f} px, k1 {p['k1']:.3f}")  # fmt: skip
        elif not told:
            notes.append(f"camera {name}: the principal distance is a guess: no two of its "
                         "photographs agree on one")  # fmt: skip
    return better, notes


def _once(matches: Matches) -> Matches:
    """The unique matches, if they are enough."""
    use = matches.single
    return matches.take(use) if use.sum() >= SUFFICIENT_MATCHES else matches


def _centre(cameras, of, features, matches):
    """Matches of pairs, relative to the image centres."""
    centred = lambda k: features[k].xy - _middle(cameras[of[k]])
    return [tuple(centred(k)[rows] for k, rows in zip(m.images, m.rows.T)) for m in matches]


def with_lens(cameras: Sequence[Camera], own: Sequence[int], camera: Camera) -> list[Camera]:
    """The cameras; those at positions `own` with the principal distance and K1 of `camera`."""
    same = {name: camera.parameters[name] for name in OF_THE_LENS if name in camera.parameters}
    with_it = lambda c: dataclasses.replace(c, parameters={**c.parameters, **same})
    return [with_it(c) if k in own else c for k, c in enumerate(cameras)]


def _count_explained(cameras, of, features, matches) -> int:
    """The number of matches explained by relative orientations of pairs that close around
    three photographs, as hardly any do with a wrong principal distance."""
    pairs = verify(cameras, of, features, matches, lambda *_: None)
    return sum(map(len, without_contradicted(cameras, of, features, pairs)[0]))


def _choose_principal_distance(start: Start, begin: Camera, xy, explained, least: float) -> Start:
    """The start, or that from another principal distance that explains clearly more matches."""
    size = max(present_size(begin))
    f = start.camera.parameters["fx"]
    most, best = least, None
    for other in (factor * size for factor in OTHERS):
        if max(f / other, other / f) > APART:
            camera = dataclasses.replace(
                begin, parameters={**begin.parameters, "fx": other, "fy": other}
            )
            number = explained(camera)
            if number > most:
                most, best = number, camera
    return start if best is None else estimate_interior(best, xy, True)


def _middle(camera: Camera):
    return (np.array(present_size(camera)) - 1) / 2


def _choose_pairs(own):
    """The pairs with the most matches, and as many others with enough, by photograph in turn."""
    own = sorted(own, key=lambda found: -len(found.rows))
    if not own:
        return []
    most = len(own[0].rows)
    first = [found for found in own if len(found.rows) >= WIDEST_SHARE * most][:MOST_ALIKE]
    enough = [found for found in own if SUFFICIENT_MATCHES <= len(found.rows) < WIDEST_SHARE * most]
    others = CANDIDATES - MOST_ALIKE
    step = max(1, len(enough) // others)
    return first + enough[: others * step : step]


def verify(
    cameras: Sequence[Camera],
    of: Sequence[int],
    features: Sequence[Features],
    matches: Sequence[Matches],
    tell: Tell,
) -> list[Pair]:
    """The pairs explained by one object, with the agreeing matches."""
    ideal = [ideal_features(cameras[c], f.xy) for c, f in zip(of, features)]
    size = np.array([max(present_size(cameras[c])) / _scale(cameras[c]) for c in of])
    matches = [m for m in matches if len(m.rows)]
    kept, portion = [], 64
    for first in range(0, len(matches), portion):
        some = [_inside(ideal, m) for m in matches[first : first + portion]]
        tolerance = np.array([TOLERANCE * size[list(m.images)].mean() for m in some])
        one, other = ([ideal[m.images[k]][m.rows[:, k]] for m in some] for k in (0, 1))
        found = verify_pairs(one, other, tolerance, [m.single for m in some])
        for m, pair in zip(some, found):
            if pair is not None:
                good, M, b, angle, kind, sure = pair
                kept.append(Pair(m.images, m.rows[good], m.clarity[good], M, b, angle, kind,
                                 len(m.rows), sure))  # fmt: skip
        tell("verification", min(first + portion, len(matches)), len(matches))
    return kept


def without_contradicted(
    cameras: Sequence[Camera], of: Sequence[int], features: Sequence[Features],
    pairs: Sequence[Pair],
) -> tuple[list[Pair], list[Pair]]:  # fmt: skip
    """The pairs consistent in loops of three, and the others."""
    ideal = [ideal_features(cameras[c], f.xy) for c, f in zip(of, features)]
    return split_contradicted(pairs, ideal)


def ideal_features(camera: Camera, uv):
    """Ideal image coordinates, c = 1, of pixels; NaN for rays sideways."""
    xy, _ = from_image_unit([camera], np.zeros(len(uv), int), uv, np.ones_like(uv), "px")
    return ideal_points(camera, xy) if len(xy) else xy


def present_size(camera: Camera) -> tuple[int, int]:
    """The image size of a camera."""
    assert camera.image_size is not None
    return camera.image_size


def _scale(camera):
    """The principal distance in pixels, from the images of two points near the centre."""
    columns, rows = present_size(camera)
    middle = np.array([[columns / 2 - 0.5, rows / 2 - 0.5], [columns / 2 + 0.5, rows / 2 - 0.5]])
    return 1 / np.linalg.norm(np.diff(ideal_features(camera, middle), axis=0))


def _inside(ideal, matches: Matches) -> Matches:
    there = [np.isfinite(ideal[k][rows]).all(1) for k, rows in zip(matches.images, matches.rows.T)]
    return matches.take(there[0] & there[1])


