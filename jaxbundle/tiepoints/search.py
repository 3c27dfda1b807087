"""From photographs to verified pairs: features, matches, principal distances, verification."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Float, UInt8

from jaxbundle.network.tables import Camera
from jaxbundle.network.units import from_image_unit
from jaxbundle.orientation.sights import ideal_points
from jaxbundle.tiepoints import interior, refinement, verification
from jaxbundle.tiepoints.features import Detection, Features, find_features
from jaxbundle.tiepoints.interior import estimate_interior
from jaxbundle.tiepoints.matching import match_features
from jaxbundle.tiepoints.pairs import candidate_pairs
from jaxbundle.tiepoints.store import Store
from jaxbundle.tiepoints.verification import Pair, verify_pairs

Tell = Callable[[str, int, int], None]
TOLERANCE = 0.0012
"""Sampson's distance of a match that agrees, in parts of the longer side."""
WIDEST = 0.6
"""Pairs that determine the principal distance: those with at least this part of the most matches,
and others with fewer, which lie wider apart."""


def prepare() -> None:
    """Compile the programs of start values, verification and measurement, ahead of their data."""
    for module in (interior, verification, refinement):
        module.prepare()


def detect(
    read: Sequence[Callable[[], UInt8[np.ndarray, "rows columns"]]],
    fingerprints: list[str],
    settings: Detection,
    store: Store,
    workers: int,
    tell: Tell,
) -> list[Features]:
    """The features of every photograph, kept ones where there are some."""

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
) -> list[tuple[tuple[int, int], np.ndarray, np.ndarray]]:
    """Pairs with the rows of their features that match, and the clarity of each match."""
    with ThreadPoolExecutor(workers) as pool:
        pairs = candidate_pairs(features, way, place, pool.map)

    def one(pair):
        i, j = pair
        found = store.load_matches(fingerprints[i], fingerprints[j])
        if found is None:
            found = match_features(features[i], features[j])
            store.save_matches(fingerprints[i], fingerprints[j], *found)
        return pair, *found

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
    known: Sequence[bool],
    features: Sequence[Features],
    matches,
) -> tuple[list[Camera], list[str]]:
    """Cameras with the principal distance and K1 that pairs of their photographs agree on."""
    better, notes = [], []
    for c, camera in enumerate(cameras):
        own = [(len(rows), pair, rows) for pair, rows, _ in matches
               if of[pair[0]] == of[pair[1]] == c]  # fmt: skip
        best = _various(own)
        start = estimate_interior(
            camera, [(features[i].xy[rows[:, 0]], features[j].xy[rows[:, 1]])
                     for _, (i, j), rows in best], known[c],
        )  # fmt: skip
        better.append(start.camera)
        if start.pairs:
            p = start.camera.parameters
            notes.append(f"camera {camera.id}: start values from {start.pairs} pairs: principal "
                         f"distance {p['fx']:.0f} px, k1 {p['k1']:.3f}")  # fmt: skip
        elif not known[c]:
            notes.append(f"camera {camera.id}: the principal distance is a guess: no two of its "
                         "photographs agree on one")  # fmt: skip
    return better, notes


def _various(own):
    """The pairs with the most matches, and as many others with enough, each photograph in turn."""
    own = sorted(own, key=lambda found: -found[0])
    if not own:
        return []
    most = own[0][0]
    first = [found for found in own if found[0] >= WIDEST * most][:3]
    enough = [found for found in own if 60 <= found[0] < WIDEST * most]
    step = max(1, len(enough) // 5)
    return first + enough[: 5 * step : step]


def verify(
    cameras: Sequence[Camera],
    of: Sequence[int],
    features: Sequence[Features],
    matches,
    tell: Tell,
) -> list[Pair]:
    """The pairs that one object can explain, with the matches that agree."""
    ideal = [ideal_features(cameras[c], f.xy) for c, f in zip(of, features)]
    size = [max(present_size(cameras[c])) / _scale(cameras[c]) for c in of]
    matches = [m for m in matches if len(m[1])]
    kept, portion = [], 64
    for first in range(0, len(matches), portion):
        some = [_inside(ideal, *m) for m in matches[first : first + portion]]
        tolerance = np.array([TOLERANCE * (size[i] + size[j]) / 2 for (i, j), *_ in some])
        found = verify_pairs(
            [ideal[i][rows[:, 0]] for (i, _), rows, _ in some],
            [ideal[j][rows[:, 1]] for (_, j), rows, _ in some], tolerance,
        )  # fmt: skip
        for ((i, j), rows, clarity), one in zip(some, found):
            if one is not None:
                good, M, b, angle, kind = one
                kept.append(
                    Pair((i, j), rows[good], clarity[good], M, b, angle, kind, len(rows))
                )
        tell("verification", min(first + portion, len(matches)), len(matches))
    return kept


def ideal_features(camera: Camera, uv):
    """Ideal image coordinates, c = 1, of pixels; NaN to the side of the camera."""
    xy, _ = from_image_unit([camera], np.zeros(len(uv), int), uv, np.ones_like(uv), "px")
    return ideal_points(camera, xy) if len(xy) else xy


def present_size(camera: Camera) -> tuple[int, int]:
    """The image size of a camera that has one."""
    assert camera.image_size is not None
    return camera.image_size


def _scale(camera):
    """The principal distance in pixels, by the picture of two points next to the middle."""
    columns, rows = present_size(camera)
    middle = np.array([[columns / 2 - 0.5, rows / 2 - 0.5], [columns / 2 + 0.5, rows / 2 - 0.5]])
    return 1 / np.linalg.norm(np.diff(ideal_features(camera, middle), axis=0))


def _inside(ideal, pair, rows, clarity):
    there = np.isfinite(ideal[pair[0]][rows[:, 0]]).all(1)
    there &= np.isfinite(ideal[pair[1]][rows[:, 1]]).all(1)
    return pair, rows[there], clarity[there]


