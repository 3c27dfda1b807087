"""From photographs to verified pairs: features, matches, verification."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from jaxbundle.network.tables import Camera
from jaxbundle.network.units import from_image_unit
from jaxbundle.orientation.sights import ideal_points
from jaxbundle.photographs.reading import image_errors
from jaxbundle.system.threads import map_in_threads
from jaxbundle.tiepoints import interior, verification
from jaxbundle.tiepoints.features import Detection, Features, find_features
from jaxbundle.tiepoints.loops import split_contradicted
from jaxbundle.tiepoints.matching import Matches, distances_within, match_features, single_matches
from jaxbundle.tiepoints.pairs import candidate_pairs
from jaxbundle.tiepoints.store import Store
from jaxbundle.tiepoints.verification import Pair, verify_pairs

Tell = Callable[[str, int, int], None]
TOLERANCE = 0.0012
"""Maximum Sampson distance of an agreeing match, relative to the longer side."""


def prepare() -> None:
    """Compile the programs of principal distances and verification, ahead of their data."""
    interior.prepare()
    verification.prepare()


def detect(
    paths: Sequence[Path],
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
            with image_errors(paths[k]):
                found = find_features(read[k](), settings)
            store.save_features(fingerprints[k], found)
        return found

    return map_in_threads(one, range(len(read)), workers, lambda n: tell("features", n, len(read)))


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

    return map_in_threads(one, pairs, workers, lambda n: tell("matching", n, len(pairs)))


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
                kept.append(
                    Pair(
                        m.images,
                        m.rows[good],
                        m.clarity[good],
                        M,
                        b,
                        angle,
                        kind,
                        len(m.rows),
                        sure,
                    )
                )
        tell("verification", min(first + portion, len(matches)), len(matches))
    return kept


def without_contradicted(
    cameras: Sequence[Camera],
    of: Sequence[int],
    features: Sequence[Features],
    pairs: Sequence[Pair],
) -> tuple[list[Pair], list[Pair]]:
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
