"""What is at the same pixel of photographs although they were taken from other places: a date or a
name that was written into them, dirt on the sensor, a part of the vehicle.

Its features match in any two photographs, and agree that nothing has moved. A match is still if
both features have one place, size and direction. Where the other matches of a pair have moved, and
hardly any of them by little, the still ones are of no object; their places in three photographs are
marks, and still matches at marks are left out of all pairs.

Far objects seen by a camera that is not turned are still as well, but those in front of them move
by all amounts, and photographs from one place are still everywhere: neither makes marks.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from jaxbundle.tiepoints.features import Features
from jaxbundle.tiepoints.matching import Matches

STILL = 0.001
"""Motion, in parts of the longer side, of a feature that has not moved."""
LITTLE = 5.0
"""Motion by little: below so many times as much."""
ALIKE = 1.25, 0.2
"""Ratio of the sizes of features that are one, and difference of their directions, radians."""
LEAST, CLEAR = 16, 0.4
"""Matches of a pair that must have moved, and at least as many as still ones; and those that have
moved by little, at most, in parts of the still ones."""
PHOTOGRAPHS = 3
"""Photographs that must show a mark."""


def without_marks(
    matches: Sequence[Matches], features: Sequence[Features], sizes: Sequence[tuple[int, int]]
) -> tuple[list[Matches], int]:
    """The matches without those of marks, and how many photographs show marks."""
    still = [_still(m, features, sizes) for m in matches]
    shown: dict[tuple, set[int]] = {}
    for m, (rows, motion) in zip(matches, still):
        moved = int((motion > 1).sum())
        little = int(((motion > 1) & (motion < LITTLE)).sum())
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


def _still(
    m: Matches, features, sizes
) -> tuple[Bool[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Which matches are still, and how far all have moved, in parts of what counts as still."""
    i, j = m.images
    if sizes[i] != sizes[j] or not len(m.rows):
        return np.zeros(len(m.rows), bool), np.full(len(m.rows), np.inf)
    a, b = features[i].take(m.rows[:, 0]), features[j].take(m.rows[:, 1])
    motion = np.linalg.norm(a.xy - b.xy, axis=1) / (STILL * max(sizes[i]))
    ratio, turn = ALIKE
    same = np.abs(np.log(a.size / b.size)) < np.log(ratio)
    same &= np.abs(np.angle(np.exp(1j * (a.angle - b.angle)))) < turn
    return same & (motion < 1), motion


def _cells(m: Matches, features, sizes, rows) -> list[tuple]:
    """Size of the photographs, column and row of the cells of matches."""
    i = m.images[0]
    side = LITTLE * STILL * max(sizes[i])
    at = np.floor(features[i].xy[m.rows[rows, 0]] / side).astype(int)
    return [(sizes[i], *cell) for cell in at.tolist()]
