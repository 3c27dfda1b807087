"""From photographs to verified pairs: features, matches, verification."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from jaxbundle.network.tables import Camera
from jaxbundle.network.units import from_image_unit
from jaxbundle.orientation.rays import ideal_points
from jaxbundle.photographs.reading import image_errors
from jaxbundle.system.threads import map_in_threads
from jaxbundle.tiepoints import coplanarity, verification
from jaxbundle.tiepoints.features import Features, FeatureSettings, find_features
from jaxbundle.tiepoints.matching import (
    FeatureMatches,
    FeatureMatchingSettings,
    are_unique,
    distances_within,
    match_features,
)
from jaxbundle.tiepoints.pair_consistency import LoopSettings, split_contradicted
from jaxbundle.tiepoints.pairs import CandidateSettings, candidate_pairs
from jaxbundle.tiepoints.store import Store
from jaxbundle.tiepoints.verification import Pair, VerificationSettings, verify_pairs
from jaxbundle.types import Progress


def prepare() -> None:
    """Compile the programs of principal distances and verification, ahead of their data."""
    coplanarity.prepare()
    verification.prepare()


def detect(
    paths: Sequence[Path],
    readers: Sequence[Callable[[], UInt8[np.ndarray, "rows columns"]]],
    fingerprints: list[str],
    settings: FeatureSettings,
    store: Store,
    workers: int,
    tell: Progress,
) -> list[Features]:
    """The features of every photograph, stored ones if available."""

    def load_or_find(k: int) -> Features:
        features = store.load_features(fingerprints[k])
        if features is None:
            with image_errors(paths[k]):
                features = find_features(readers[k](), settings)
            store.save_features(fingerprints[k], features)
        return features

    return map_in_threads(
        load_or_find, range(len(readers)), workers, lambda n: tell("features", n, len(readers))
    )


def match(
    features: Sequence[Features],
    fingerprints: list[str],
    method: str,
    place: Float[np.ndarray, "photographs 3"] | None,
    store: Store,
    workers: int,
    tell: Progress,
    settings: FeatureMatchingSettings,
    candidates: CandidateSettings,
) -> list[FeatureMatches]:
    """The matches of candidate pairs, stored ones if available."""
    with ThreadPoolExecutor(workers) as pool:
        pairs = candidate_pairs(features, method, place, pool.map, candidates)

    names = lambda pair: (fingerprints[pair[0]], fingerprints[pair[1]])
    stored = {pair: store.load_matches(*names(pair)) for pair in pairs}
    needed = sorted({k for pair, columns in stored.items() if columns is None for k in pair})
    # Once for each photograph, not for each of its pairs: as much work as a pair.
    with ThreadPoolExecutor(workers) as pool:
        within = dict(zip(needed, pool.map(distances_within, (features[k] for k in needed))))

    def match_pair(pair: tuple[int, int]) -> FeatureMatches:
        columns = stored[pair]
        if columns is None:
            i, j = pair
            distances_within_both = within[i], within[j]
            rows, distance_ratio = match_features(
                features[i], features[j], settings, distances_within_both
            )
            columns = rows, distance_ratio, are_unique(rows, distances_within_both, settings)
            store.save_matches(*names(pair), *columns)
        return FeatureMatches(pair, *columns)

    return map_in_threads(match_pair, pairs, workers, lambda n: tell("matching", n, len(pairs)))


def verify(
    cameras: Sequence[Camera],
    camera_of: Sequence[int],
    features: Sequence[Features],
    matches: Sequence[FeatureMatches],
    tell: Progress,
    settings: VerificationSettings,
) -> list[Pair]:
    """The pairs explained by one object, with the agreeing matches.

    **Arguments:** `camera_of`: the camera of every photograph.
    """
    ideal = [ideal_features(cameras[c], f.xy) for c, f in zip(camera_of, features)]
    # The longer side in units of c.
    size = np.array(
        [max(required_image_size(cameras[c])) / central_distance(cameras[c]) for c in camera_of]
    )
    matches = [m for m in matches if len(m.rows)]
    # 64 pairs at once fill eight runs of eight lanes; in between the progress is shown
    pairs, chunk = [], 64
    for begin in range(0, len(matches), chunk):
        portion = [_with_ideal(ideal, m) for m in matches[begin : begin + chunk]]
        tolerance = np.array([settings.tolerance * size[list(m.images)].mean() for m in portion])
        points_1, points_2 = ([ideal[m.images[k]][m.rows[:, k]] for m in portion] for k in (0, 1))
        verified = verify_pairs(
            points_1, points_2, tolerance, [m.unique for m in portion], settings
        )
        for m, pair in zip(portion, verified):
            if pair is not None:
                good, M, b, angle, kind, is_unique = pair
                rows, distance_ratio = m.rows[good], m.distance_ratio[good]
                pairs.append(
                    Pair(m.images, rows, distance_ratio, M, b, angle, kind, len(m.rows), is_unique)
                )
        tell("verification", min(begin + chunk, len(matches)), len(matches))
    return pairs


def without_contradicted(
    cameras: Sequence[Camera],
    camera_of: Sequence[int],
    features: Sequence[Features],
    pairs: Sequence[Pair],
    settings: LoopSettings,
) -> tuple[list[Pair], list[Pair]]:
    """The pairs consistent in loops of three, and the others."""
    ideal = [ideal_features(cameras[c], f.xy) for c, f in zip(camera_of, features)]
    return split_contradicted(pairs, ideal, settings)


def ideal_features(camera: Camera, uv: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """Ideal image coordinates, c = 1, of pixels; NaN for rays sideways."""
    xy, _ = from_image_unit([camera], np.zeros(len(uv), int), uv, np.ones_like(uv), "px")
    return ideal_points(camera, xy) if len(xy) else xy


def required_image_size(camera: Camera) -> tuple[int, int]:
    """The image size of a camera, which cameras of photographs have."""
    assert camera.image_size is not None
    return camera.image_size


def central_distance(camera: Camera) -> float:
    """The principal distance in pixels, from the images of two points near the centre."""
    columns, rows = required_image_size(camera)
    middle = np.array([[columns / 2 - 0.5, rows / 2 - 0.5], [columns / 2 + 0.5, rows / 2 - 0.5]])
    return 1 / float(np.linalg.norm(np.diff(ideal_features(camera, middle), axis=0)))


def _with_ideal(
    ideal: Sequence[Float[np.ndarray, "_ 2"]], matches: FeatureMatches
) -> FeatureMatches:
    """The matches whose rays point forward in both photographs."""
    xy = [ideal[k][rows] for k, rows in zip(matches.images, matches.rows.T)]
    finite = [np.all(np.isfinite(a), axis=1) for a in xy]
    return matches.take(finite[0] & finite[1])
