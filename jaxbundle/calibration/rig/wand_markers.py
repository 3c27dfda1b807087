"""Which marker of a wand is which: by their spacing, or of two alike by their rays.

Three markers in a line at the distances a < b from the middle one appear in an image, where the
depths of the ends are z_a and z_b, at distances of the ratio

    (b/a)·(z_a/z_b)

so that an uneven spacing tells them apart in every image by itself. Two markers, or three at even
distances, look alike in each image. Of two cameras one of both assignments fulfils coplanarity: all
pairings are given to a relative orientation with gross errors, half of which are right.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jaxbundle.errors import InputError
from jaxbundle.network.columns import count
from jaxbundle.network.tables import Camera
from jaxbundle.orientation import batched
from jaxbundle.orientation.relative import sampson_distance
from jaxbundle.tiepoints.verified_pairs import ideal_features


class Mark(NamedTuple):
    """A marker in an image: frame, name of the marker ("": not known), x, y and their σ (pixels;
    NaN: none of its own)."""

    frame: str
    marker: str
    x: float
    y: float
    sx: float = np.nan
    sy: float = np.nan


Marks = list[Mark]
# By frame, its markers.
ByFrame = dict[str, Marks]
# Of two frames of one name the assignment: markers in the same order, or the other way round.
Reversals = dict[str, bool]


@dataclasses.dataclass(frozen=True)
class WandSettings:
    """How markers of a wand without names are told apart.

    **Fields:**

    - `min_ratio`: of the longer to the shorter of the two distances from the middle marker: more
      than `depth_ratio`, so that no image fits both orders.
    - `depth_ratio`: of the ends of the wand, by which perspective changes a ratio in the image: a
      wand of a third of its distance, pointing at the camera, has 1.4.
    - `max_bend`: distance of the middle marker from the line of the others, relative to their
      distance; a pixel in 20. Larger: other blobs are taken for markers; smaller: a wand seen from
      its end is lost.
    - `min_distance`: of two markers in an image, pixels: nearer ones blur into each other.
    - `tolerance`: of coplanarity of two rays, pixels, of interior orientations that are somewhat
      wrong, when two markers are told apart.
    - `min_agreeing`: part of the frames of two cameras in which exactly one assignment is within
      the tolerance. By chance, with a wrong relative orientation, few are.
    """

    min_ratio: float = 1.5
    depth_ratio: float = 1.4
    max_bend: float = 0.05
    min_distance: float = 3.0
    tolerance: float = 3.0
    min_agreeing: float = 0.5


def name_markers(
    marks: Mapping[str, Marks],
    cameras: Mapping[str, Camera],
    pairs: Mapping[tuple[str, str], float],
    settings: WandSettings,
) -> tuple[dict[str, Marks], list[str]]:
    """The markers of all cameras with names, and what was not used.

    **Raises:** `InputError` if markers without names cannot be told apart."""
    named_marks, notes = dict(marks), []
    nameless = [
        camera
        for camera, marks_of_camera in marks.items()
        if marks_of_camera and not marks_of_camera[0].marker
    ]
    if nameless and len({name for pair in pairs for name in pair}) == 2:
        return _name_two(named_marks, nameless, cameras, pairs, settings)
    for camera in nameless:
        named_marks[camera], remarks = name_three(
            camera, marks[camera], cameras[camera], pairs, settings
        )
        notes += remarks
    return named_marks, notes


def name_three(
    camera: str,
    marks: Marks,
    interior: Camera,
    pairs: Mapping[tuple[str, str], float],
    settings: WandSettings,
) -> tuple[Marks, list[str]]:
    """Names of three markers in a line by their distances, in every frame in which exactly three
    blobs can be such."""
    names = sorted({name for pair in pairs for name in pair})
    length_of_pair = {frozenset(pair): length for pair, length in pairs.items()}
    if len(names) != 3 or len(length_of_pair) < 2:
        raise InputError(
            f"markers of camera {camera!r} have no names (marker): only two, or three in a line, "
            "whose distances are given, can be told apart"
        )
    # The pair that is not given, or the longest, are the ends.
    other_names = [frozenset(n for n in names if n != middle_name) for middle_name in names]
    middle = max(range(3), key=lambda k: length_of_pair.get(other_names[k], np.inf))
    ends = [name for name in names if name != names[middle]]
    distances = [length_of_pair[frozenset((names[middle], end))] for end in ends]
    if max(distances) < settings.min_ratio * min(distances):
        raise InputError(
            f"markers of camera {camera!r} have no names (marker), and the middle one is nearly "
            f"half way between the others ({distances[0]:g}, {distances[1]:g}): they cannot be "
            "told apart"
        )
    near_name, far_name = ends if distances[0] < distances[1] else ends[::-1]
    named_marks: Marks = []
    seen_ratios: list[float] = []
    without = ambiguous = 0
    ratio, depth = max(distances) / min(distances), settings.depth_ratio
    for marks_of_frame in _by_frame(marks).values():
        uv = np.array([(mark.x, mark.y) for mark in marks_of_frame])
        straight = _straight_triples(uv, interior, settings)
        # Perspective changes the ratio by that of the depths of both ends, to either side.
        possible = [rows for rows, observed in straight if 1 / depth < observed / ratio < depth]
        without += not possible
        ambiguous += len(possible) > 1
        # For the message where none fits: a wrong length in the table shows in this ratio.
        seen_ratios += [observed for _, observed in straight]
        if len(possible) == 1:
            names_and_rows = zip((near_name, names[middle], far_name), possible[0])
            named_marks += [marks_of_frame[k]._replace(marker=name) for name, k in names_and_rows]
    if not named_marks:
        usual = f"; those in a line are at 1 : {np.median(seen_ratios):.1f}" if seen_ratios else ""
        raise InputError(
            f"camera {camera!r}: no frame shows three markers in a line whose distances from the "
            f"middle one are as 1 : {ratio:.2f}{usual}"
        )
    remarks = [
        f"camera {camera!r}: {count(number, 'frame')} {why} not used"
        for number, why in (
            (without, "without three markers in a line at the ratio of the wand"),
            (ambiguous, "in which several blobs could be the wand"),
        )
        if number
    ]
    return named_marks, remarks


def _straight_triples(
    uv: Float[np.ndarray, "n 2"], interior: Camera, settings: WandSettings
) -> list[tuple[tuple[int, int, int], float]]:
    """Three blobs in a line, as rows of the near end, the middle and the far end, and the ratio of
    the distances of far and near end from the middle."""
    xy, triples = ideal_features(interior, uv), []
    for rows in combinations(range(len(uv)), 3):
        distance_of = {
            pair: np.linalg.norm(uv[pair[0]] - uv[pair[1]]) for pair in combinations(rows, 2)
        }
        if min(distance_of.values()) < settings.min_distance or not np.isfinite(xy[[*rows]]).all():
            continue
        # The ends are farthest from each other.
        near_end, far_end = max(distance_of, key=lambda pair: distance_of[pair])
        (middle,) = {*rows} - {near_end, far_end}
        line, a, b = xy[far_end] - xy[near_end], xy[middle] - xy[near_end], xy[middle] - xy[far_end]
        bend = abs(line[0] * a[1] - line[1] * a[0]) / (line @ line)
        # The near end is that beside the middle marker.
        if np.linalg.norm(a) > np.linalg.norm(b):
            near_end, far_end, a, b = far_end, near_end, b, a
        if bend < settings.max_bend:
            triples.append(
                ((near_end, middle, far_end), float(np.linalg.norm(b) / np.linalg.norm(a)))
            )
    return triples


def _by_frame(marks: Marks) -> ByFrame:
    marks_by_frame: ByFrame = {}
    for mark in marks:
        marks_by_frame.setdefault(mark.frame, []).append(mark)
    return marks_by_frame


def _name_two(
    marks: dict[str, Marks],
    nameless: Sequence[str],
    cameras: Mapping[str, Camera],
    pairs: Mapping[tuple[str, str], float],
    settings: WandSettings,
) -> tuple[dict[str, Marks], list[str]]:
    """The names of the known length for two markers that look alike, the same in all cameras of a
    frame.

    Which end of the wand has which name means nothing; that it is the same end in all cameras
    does."""
    # Markers of named cameras in alphabetical order, like `names`: they come first and decide.
    frames = {
        camera: {
            frame: sorted(marks_of_frame, key=lambda mark: mark.marker)
            for frame, marks_of_frame in _by_frame(marks_of_camera).items()
            if len(marks_of_frame) == 2
        }
        for camera, marks_of_camera in marks.items()
    }
    names = sorted({name for pair in pairs for name in pair})
    rays = {
        camera: {
            frame: ideal_features(cameras[camera], np.array([(m.x, m.y) for m in marks_of_frame]))
            for frame, marks_of_frame in marks_by_frame.items()
        }
        for camera, marks_by_frame in frames.items()
    }
    # Rays have c = 1, the tolerance is in pixels.
    tolerance = {camera: settings.tolerance * _pixel(cameras[camera]) for camera in marks}
    reversals: dict[tuple[str, str], Reversals] = {}
    for camera_a, camera_b in combinations(marks, 2):
        if camera_a in nameless or camera_b in nameless:
            limit = max(tolerance[camera_a], tolerance[camera_b])
            reversals[camera_a, camera_b] = _reversals_of_pair(
                rays[camera_a], rays[camera_b], limit, settings
            )
        else:
            reversals[camera_a, camera_b] = dict.fromkeys(
                frames[camera_a].keys() & frames[camera_b].keys(), False
            )
    named_marks: dict[str, Marks] = {camera: [] for camera in marks}
    undecided = contradicting = 0
    # Named cameras first: the others follow their names.
    order = [*(c for c in marks if c not in nameless), *nameless]
    for frame in dict.fromkeys(
        frame for marks_by_frame in frames.values() for frame in marks_by_frame
    ):
        cameras_with_markers = [camera for camera in order if frame in frames[camera]]
        reversal_of_camera = _reversals_of_frame(frame, cameras_with_markers, reversals)
        contradicting += reversal_of_camera is None
        undecided += reversal_of_camera is not None and len(reversal_of_camera) < len(
            cameras_with_markers
        )
        for camera, is_reversed in (reversal_of_camera or {}).items():
            pair = frames[camera][frame][:: -1 if is_reversed else 1]
            named_marks[camera] += [m._replace(marker=name) for m, name in zip(pair, names)]
    remarks = [
        f"{count(number, 'frame')} {why} not used"
        for number, why in (
            (
                undecided,
                "in which the rays of some cameras do not tell the two markers apart, there",
            ),
            (contradicting, "in which pairs of cameras tell the two markers apart differently"),
        )
        if number
    ]
    for camera, marks_of_camera in marks.items():
        number = len(_by_frame(marks_of_camera)) - len(frames[camera])
        remarks += [
            f"camera {camera!r}: {count(number, 'frame')} without two markers not used"
        ] * bool(number)
    if not any(named_marks.values()):
        raise InputError(
            "the two markers look alike, and the rays of no two cameras tell them apart: expected "
            "15 or more frames in which two cameras see both, at different places and in different "
            "directions; or names (marker), or a wand of three markers at uneven distances"
        )
    return named_marks, remarks


def _pixel(camera: Camera) -> float:
    """The size of a pixel in the middle of the image, c = 1."""
    middle = np.array([(np.array(camera.image_size or (1, 1)) - 1) / 2])
    return float(np.linalg.norm(np.diff(ideal_features(camera, middle + [[0, 0], [1, 0]]), axis=0)))


def _reversals_of_pair(
    rays_a: Mapping[str, Float[np.ndarray, "2 2"]],
    rays_b: Mapping[str, Float[np.ndarray, "2 2"]],
    tolerance: float,
    settings: WandSettings,
) -> Reversals:
    """Of the common frames of two cameras whose assignment is clear, which it is."""
    common_frames = [
        frame
        for frame in rays_a
        if frame in rays_b and np.isfinite([rays_a[frame], rays_b[frame]]).all()
    ]
    # 5 points determine an orientation and 5 frames have 20 pairings, half of them wrong; with
    # three times as many a wrong one does not agree by chance
    if len(common_frames) < 15:
        return {}
    a = np.array([rays_a[frame] for frame in common_frames])
    b = np.array([rays_b[frame] for frame in common_frames])
    # Straight pairings, and crossed ones.
    points_a, points_b = np.concatenate([a, a]), np.concatenate([b, b[:, ::-1]])
    # Mixed, since a search with gross errors may take the first ones for good.
    permutation = np.random.default_rng(0).permutation(4 * len(common_frames))
    xy1, xy2 = points_a.reshape(-1, 2)[permutation], points_b.reshape(-1, 2)[permutation]
    M, base, _, _ = batched.orient_pairs([xy1], [xy2], np.array([tolerance]))
    distances_of_pairs = jax.vmap(sampson_distance, (None, None, 0, 0))
    distance = np.abs(
        distances_of_pairs(M[0], base[0], points_a.reshape(-1, 2), points_b.reshape(-1, 2))
    )
    fits = np.asarray((distance.reshape(2, -1, 2) < tolerance).all(2))
    # Both fit where the wand lies in the epipolar plane: nothing tells them apart there.
    clear = fits[0] != fits[1]
    if clear.mean() < settings.min_agreeing:
        return {}
    return {frame: bool(fits[1, k]) for k, frame in enumerate(common_frames) if clear[k]}


def _reversals_of_frame(
    frame: str, cameras: Sequence[str], reversals: Mapping[tuple[str, str], Reversals]
) -> dict[str, bool] | None:
    """Of the cameras of a frame that hang together, which have the other order; None if pairs of
    them contradict each other."""
    reversal_of_pair: dict[tuple[str, str], bool] = {}
    for (camera_a, neighbour), of_pair in reversals.items():
        if frame in of_pair:
            reversal_of_pair[camera_a, neighbour] = reversal_of_pair[neighbour, camera_a] = of_pair[
                frame
            ]
    best: dict[str, bool] = {}
    for start in cameras:
        if start in best:
            continue
        reversal_of_camera, reached = {start: False}, [start]
        for camera in reached:
            for neighbour in cameras:
                if (camera, neighbour) not in reversal_of_pair:
                    continue
                is_reversed = reversal_of_camera[camera] ^ reversal_of_pair[camera, neighbour]
                if neighbour not in reversal_of_camera:
                    reversal_of_camera[neighbour] = is_reversed
                    reached.append(neighbour)
                # A loop of cameras that does not close: one of its pairs is wrong.
                elif reversal_of_camera[neighbour] != is_reversed:
                    return None
        # The largest group stands for the frame; others have no order in common with it.
        if len(reversal_of_camera) > len(best):
            best = reversal_of_camera
    return best if len(best) > 1 else {}
