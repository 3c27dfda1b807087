"""Features at the same pixel in photographs from different positions: a date or a
name written into them, dirt on the sensor, a part of the vehicle.

These features match in any two photographs, without motion. A match is still if
both features have the same position, size and direction. If the other matches of a pair have moved,
and hardly any by a small amount, the still ones are not on the object; their positions in three
photographs are marks, and still matches at marks are left out of all pairs.

Far objects seen by a camera without rotation are still as well, but those in front of them move
by all amounts, and photographs from one position are still everywhere: neither gives marks.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from jaxbundle.tiepoints.features import Features
from jaxbundle.tiepoints.matching import Matches

LARGEST_MOTION = 0.001
"""Maximum motion of a still feature, relative to the longer side."""
SMALL_MOTION = 5.0
"""A small motion: below this multiple of it."""
FEATURE_TOLERANCES = 1.25, 0.2
"""Ratio of the sizes of equal features, and difference of their directions, radians."""
LEAST, CLEAR = 16, 0.4
"""Minimum moved matches of a pair, and at least as many as still ones; and maximum of those with
small motion, relative to the still ones."""
PHOTOGRAPHS = 3
"""Minimum photographs of a mark."""


def without_marks(
    matches: Sequence[Matches], features: Sequence[Features], sizes: Sequence[tuple[int, int]]
) -> tuple[list[Matches], int]:
    """The matches without those of marks, and the number of photographs with marks."""
    still = [_still(m, features, sizes) for m in matches]
    shown: dict[tuple, set[int]] = {}
    for m, (rows, motion) in zip(matches, still):
        moved = int((motion > 1).sum())
        little = int(((motion > 1) & (motion < SMALL_MOTION)).sum())
        number = int(rows.sum())
        if number and moved >= max(LEAST, number) and little <= CLEAR * number:
            for cell in _cells(m, features, sizes, rows):
                shown.setdefault(cell, set()).update(m.images)
    marks = {cell for cell, images in shown.items() if len(images) >= PHOTOGRAPHS}
    if not marks:
        return list(matches), 0
    near = {(size, i + a, j + b) for size, i, j in marks for a in (-1, 0, 1) for b in (-1, 0, 1)}
    kept, seen = [], set()
    for m, (rows, _) in zip(matches, still):
        drop = np.zeros(len(m.rows), bool)
        drop[rows] = [cell in near for cell in _cells(m, features, sizes, rows)]
        if drop.any():
            seen.update(m.images)
            m = m.take(~drop)
        kept.append(m)
    return kept, len(seen)


def _still(m: Matches, features, sizes) -> tuple[Bool[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Which matches are still, and the motion of all, relative to the limit."""
    i, j = m.images
    if sizes[i] != sizes[j] or not len(m.rows):
        return np.zeros(len(m.rows), bool), np.full(len(m.rows), np.inf)
    a, b = features[i].take(m.rows[:, 0]), features[j].take(m.rows[:, 1])
    motion = np.linalg.norm(a.xy - b.xy, axis=1) / (LARGEST_MOTION * max(sizes[i]))
    ratio, turn = FEATURE_TOLERANCES
    same = np.abs(np.log(a.size / b.size)) < np.log(ratio)
    same &= np.abs(np.angle(np.exp(1j * (a.angle - b.angle)))) < turn
    return same & (motion < 1), motion


def _cells(m: Matches, features, sizes, rows) -> list[tuple]:
    """Size of the photographs, column and row of the cells of matches."""
    i = m.images[0]
    side = SMALL_MOTION * LARGEST_MOTION * max(sizes[i])
    at = np.floor(features[i].xy[m.rows[rows, 0]] / side).astype(int)
    return [(sizes[i], *cell) for cell in at.tolist()]
