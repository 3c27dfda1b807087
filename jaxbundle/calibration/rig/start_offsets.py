"""Start values of time offsets between cameras: by how fast their targets turn and move.

The angular velocity of a body relative to a rig is the same for all cameras on it, wherever they
are, and so is the speed of a point of a target that all see. The offset of two cameras is where
these correlate most (Furgale, Rehder and Siegwart 2013, section IV), by the likelihood ratio
−n·ln(1 − r²) against no correlation, χ² distributed with a degree of freedom for each speed; the
cameras are joined along the pairs of most.
"""

import dataclasses
from collections import defaultdict
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxbundle.calibration.rig.connections import BoardView


@dataclasses.dataclass(frozen=True)
class OffsetSettings:
    """How start values of offsets are searched.

    **Fields:**

    - `half_window`: frames before and after, between which a speed is taken: over four frames of 30
      a second hands move smoothly, and errors of poses count a quarter.
    - `steps`: offsets tried within a frame.
    - `significance`: of a correlation, for all offsets tried together.
    - `min_overlap`: of the shorter sequence at an offset that is tried.
    """

    half_window: int = 2
    steps: int = 2
    significance: float = 0.001
    min_overlap: float = 0.25


class Speeds(NamedTuple):
    """A speed at several times of one camera, without gaps beyond `gap`; seconds."""

    time: Float[np.ndarray, " n"]
    value: Float[np.ndarray, " n"]
    gap: float


# By what the speed is of: ("turn", body) or ("move", board).
SpeedsOfCamera = dict[tuple[str, int], Speeds]


def speeds_of_cameras(
    views: Sequence[BoardView],
    time: Float[np.ndarray, " epochs"],
    body: Sequence[int],
    frame: Float[np.ndarray, " cameras"],
    settings: OffsetSettings,
) -> list[SpeedsOfCamera]:
    """Angular velocities of bodies and speeds of boards in every camera; `time` of every epoch by
    the clock of its camera, `body` of every board, `frame`: the time between photographs."""
    tracks: dict[tuple[int, int], list[BoardView]] = defaultdict(list)
    for view in views:
        tracks[view.camera, view.board].append(view)
    speeds: list[dict] = [defaultdict(list) for _ in frame]
    h = settings.half_window
    for (camera, board), views_of_track in tracks.items():
        views_of_track = sorted(views_of_track, key=lambda view: time[view.epoch])
        t = time[[view.epoch for view in views_of_track]]
        T = np.array([view.pose for view in views_of_track])
        begin, end = (
            np.arange(len(views_of_track) - 2 * h),
            np.arange(2 * h, len(views_of_track)),
        )
        span = t[end] - t[begin]
        # Half a frame of tolerance: none is missing between.
        is_complete = (span > 0) & (span < (2 * h + 0.5) * frame[camera])
        begin, end, span = begin[is_complete], end[is_complete], span[is_complete]
        if not len(span):
            continue
        middle = (t[begin] + t[end]) / 2
        trace = np.einsum("nij,nij->n", T[begin, :3, :3], T[end, :3, :3])
        angular_velocity = np.arccos(np.clip((trace - 1) / 2, -1, 1)) / span
        speed = np.linalg.norm(T[end, :3, 3] - T[begin, :3, 3], axis=1) / span
        speeds[camera]["turn", body[board]].append((middle, angular_velocity))
        speeds[camera]["move", board].append((middle, speed))
    gap = (2 * h + 0.5) * frame
    return [
        {key: _merge(parts, gap[k]) for key, parts in of_camera.items()}
        for k, of_camera in enumerate(speeds)
    ]


def _merge(parts: Sequence[tuple[np.ndarray, np.ndarray]], gap: float) -> Speeds:
    time, value = (np.concatenate(column) for column in zip(*parts))
    order = np.argsort(time, kind="stable")
    return Speeds(time[order], value[order], gap)


def start_offsets(
    speeds: Sequence[SpeedsOfCamera], frame: Float[np.ndarray, " cameras"], settings: OffsetSettings
) -> Float[np.ndarray, " cameras"]:
    """Seconds that are added to the clock of each camera to have that of the first; NaN where no
    correlation is significant."""
    number = len(speeds)
    offset, score = np.zeros((number, number)), np.full((number, number), -np.inf)
    for i in range(number):
        for j in range(i + 1, number):
            offset_and_score = _offset_of_pair(
                speeds[i], speeds[j], min(frame[i], frame[j]), settings
            )
            offset[i, j], score[i, j] = offset_and_score
            offset[j, i], score[j, i] = -offset_and_score[0], offset_and_score[1]
    of_first = np.full(number, np.nan)
    of_first[0] = 0.0
    while True:
        is_joined = np.isfinite(of_first)
        open_pairs = np.where(is_joined[:, None] & ~is_joined[None], score, -np.inf)
        i, j = np.unravel_index(np.argmax(open_pairs), score.shape)
        if not np.isfinite(open_pairs[i, j]):
            return of_first
        of_first[j] = of_first[i] + offset[i, j]


def _offset_of_pair(
    speeds_a: SpeedsOfCamera, speeds_b: SpeedsOfCamera, frame: float, settings: OffsetSettings
) -> tuple[float, float]:
    """The offset of the other clock relative to the one, and its likelihood ratio; −∞ if it is not
    significant."""
    from scipy.stats import chi2

    common = [key for key in speeds_a if key in speeds_b]
    if not common:
        return 0.0, -np.inf
    ends = [
        (a.time[0] - b.time[-1], a.time[-1] - b.time[0])
        for a, b in _pairs(speeds_a, speeds_b, common)
    ]
    step = frame / settings.steps
    first_step, last_offset = int(np.floor(min(e[0] for e in ends) / step)), max(e[1] for e in ends)
    offsets = step * np.arange(first_step, int(np.ceil(last_offset / step)) + 1)
    score = np.sum(
        [_scores(*pair, offsets, settings) for pair in _pairs(speeds_a, speeds_b, common)], axis=0
    )
    k = int(np.argmax(score))
    limit = chi2.isf(settings.significance / len(offsets), len(common))
    if score[k] < limit:
        return 0.0, -np.inf
    score_before, score_at, score_after = (
        score[max(k - 1, 0)],
        score[k],
        score[min(k + 1, len(offsets) - 1)],
    )
    bend = score_before - 2 * score_at + score_after
    # The vertex of the parabola through three values.
    shift = 0.5 * (score_before - score_after) / bend if bend < 0 else 0.0
    return float(offsets[k] + step * np.clip(shift, -0.5, 0.5)), float(score_at)


def _pairs(
    speeds_a: SpeedsOfCamera, speeds_b: SpeedsOfCamera, common: Sequence[tuple[str, int]]
) -> list[tuple[Speeds, Speeds]]:
    return [(speeds_a[key], speeds_b[key]) for key in common]


def _scores(
    a: Speeds, b: Speeds, offsets: Float[np.ndarray, " offsets"], settings: OffsetSettings
) -> Float[np.ndarray, " offsets"]:
    """The likelihood ratio of a positive correlation at every offset of b."""
    scores, min_number = (
        np.zeros(len(offsets)),
        settings.min_overlap * min(len(a.time), len(b.time)),
    )
    # Speeds over several frames are not independent.
    independent = 1 / (2 * settings.half_window)
    for k, offset in enumerate(offsets):
        t = a.time - offset
        right: Int[np.ndarray, " n"] = np.searchsorted(b.time, t).clip(1, len(b.time) - 1)
        is_inside = (t >= b.time[right - 1]) & (t <= b.time[right])
        is_inside &= b.time[right] - b.time[right - 1] < b.gap
        n = int(is_inside.sum())
        if n < max(min_number, 1 / independent):
            continue
        x, y = a.value[is_inside], np.interp(t[is_inside], b.time, b.value)
        x, y = x - x.mean(), y - y.mean()
        size = np.sqrt((x @ x) * (y @ y))
        r = x @ y / size if size > 0 else 0.0
        # 1e-12: of equal sequences without errors the ratio would be infinite
        scores[k] = -independent * n * np.log(max(1 - r * r, 1e-12)) if r > 0 else 0.0
    return scores
