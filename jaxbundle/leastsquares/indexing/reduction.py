"""The choice of solver for the reduced system of the kept groups: dense, banded, or iterative.

Two rows of a group share a block of the reduced matrix only if observations or eliminated rows
tie them. In the reverse order of Cuthill and McKee (1969; George 1971), tied rows are close
together: a drive along a street, a traverse, or successive strips become a
narrow band. Cut into super-blocks as wide as the band, the matrix is block tridiagonal. The group
with most unknowns is ordered in this way; all others are a border.

The solver with the lowest operation count is chosen: n³/3 for a dense factor, a few m³ for
each super-block of m unknowns, and for conjugate gradients about forty passes over all
observations, without pairs of incidences.
"""

from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Int

from jaxbundle.leastsquares.indexing.indices import as_column

FACTORS = ("dense", "banded")
ALWAYS_DENSE = 1000
"""Smaller reduced systems are always solved densely."""
GAIN = 3.0
"""Required saving of operations relative to the dense solver."""
LARGEST_FACTOR = 2e9 / 8
"""Largest factor, in elements; larger systems are solved iteratively."""
MOST_PAIRS = 3e8
"""Largest number of pairs of incidences; systems with more are solved iteratively."""
STEPS, WORK = 40, 600.0
"""For conjugate gradients: number of passes, and cost per observation and pass, in operations of a
factorisation."""
NARROWEST = 32
"""Minimum size of a super-block; with fewer unknowns overhead dominates."""


class Band(eqx.Module):
    """`place`: the position of every row of `group` in the band (the last for padding);
    super-blocks of `width` rows."""

    group: str = eqx.field(static=True)
    place: Int[Array, " rows"]
    width: int = eqx.field(static=True)
    blocks: int = eqx.field(static=True)


def plan_reduction(shapes: dict[str, tuple[int, int]], ties, observations: int, ways):
    """The solver for kept groups of these shapes (rows, width), None if none of `ways` fits into
    memory, and the band if it is banded; a single one of `ways` is used regardless.

    `ties(group)`: row and column of its blocks beside the diagonal."""
    unknowns = sum(n * w for n, w in shapes.values())
    if not shapes or (len(ways) > 1 and unknowns < ALWAYS_DENSE):
        return "dense", None
    group = max(shapes, key=lambda g: np.prod(shapes[g]))
    (row, column), (rows, w) = ties(group), shapes[group]
    band = find_band(group, row, column, rows, w) if "banded" in ways else None
    way = ways[0]
    if len(ways) > 1:
        way = choose_reduction(band, w, unknowns, observations, ways)
    return way, band if way == "banded" else None


def find_band(group: str, row, column, rows: int, w: int) -> Band:
    """A narrow band of the blocks (row, column) of a group of so many rows of `w` unknowns."""
    from scipy import sparse  # imported here: a tenth of a second
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    links = sparse.coo_matrix((np.ones(len(row)), (row, column)), (rows, rows))
    place = np.empty(rows, np.int32)
    place[reverse_cuthill_mckee((links + links.T).tocsr(), symmetric_mode=True)] = np.arange(rows)
    width = max(int(np.abs(place[row] - place[column]).max(initial=0)), -(-NARROWEST // w))
    blocks = rows // width + 1  # The last position is empty.
    return Band(group, as_column(place, ("group", group), blocks * width - 1), width, blocks)


def choose_reduction(band: Band | None, w: int, unknowns: int, observations: int, ways):
    """The solver for this number of unknowns, those of the band in blocks of `w`; None: none
    fits."""
    n, work = float(unknowns), {"iterative": (STEPS * WORK * observations, 0.0)}
    work["dense"] = n**3 / 3, n**2
    if band is not None:
        place: Any = band.place  # not an array yet (`as_column`)
        m, rows = float(band.width * w), len(place.rows) * w
        q = n - rows
        border = 2 * rows * m * q + rows * q**2 + q**3 / 3
        work["banded"] = band.blocks * 10 / 3 * m**3 + border, 3 * band.blocks * m**2 + n * q
    fits = {way: work[way][0] for way in ways if work[way][1] <= LARGEST_FACTOR}
    least = min(fits, key=fits.__getitem__, default=None)
    return "dense" if "dense" in fits and fits["dense"] < GAIN * fits[least] else least
