"""How the reduced system of images and cameras is solved: dense, banded, or by iteration.

Two images share a block of the reduced matrix only if a point is seen in both. In the order of
Cuthill and McKee (1969), reversed (George 1971), images with common points stand near each other:
a drive along a street, or strips flown one after the other, become a narrow band. Cut into
super-blocks as wide as the band, the matrix is block tridiagonal.

What is chosen is what needs the fewest operations by count: n³/3 for a dense factor, a few m³ for
each of the super-blocks of m unknowns, and for conjugate gradients some forty passes over all rays,
which need no pairs of rays at all.
"""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Int

REDUCTIONS = ("dense", "banded", "iterative")
FACTORS = ("dense", "banded")

SMALL = 1000
"""Reduced systems with fewer unknowns are solved as they are."""
GAIN = 3.0
"""By how much fewer operations than the dense one another way must need."""
LARGEST_FACTOR = 2e9 / 8
"""Elements of a factor; what needs more is solved by iteration."""
MOST_PAIRS = 3e8
"""Pairs of rays; what has more is solved by iteration."""
STEPS, WORK_PER_RAY = 40, 600.0
"""Of conjugate gradients: passes, and what a ray costs in one, in operations of a factorisation."""


class Band(eqx.Module):
    """`place`: the position of every image in the band; super-blocks of `width` images."""

    place: Int[Array, " images"]
    width: int = eqx.field(static=True)
    blocks: int = eqx.field(static=True)


def plan_reduction(
    blocks, images: int, block: int, others: int, rays: int, ways=REDUCTIONS
) -> tuple[str | None, Band | None]:
    """The way for a network whose pairs of images have these blocks (rows, columns), and the band
    where that is its way; see `choose_reduction`. A single one of `ways` is taken as it is."""
    if len(ways) > 1 and images * block + others < SMALL:
        return "dense", None
    band = find_band(*blocks, images) if "banded" in ways else None
    way = ways[0]
    if len(ways) > 1:
        way = choose_reduction(band, images, block, others, rays, ways)
    return way, band if way == "banded" else None


def find_band(row, column, images: int) -> Band:
    """A narrow band of the blocks (row, column) of pairs of images."""
    from scipy import sparse  # A tenth of a second, which small networks are spared.
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    row, column = np.asarray(row), np.asarray(column)
    links = sparse.coo_matrix((np.ones(len(row)), (row, column)), (images, images))
    order = reverse_cuthill_mckee((links + links.T).tocsr(), symmetric_mode=True)
    place = np.empty(images, np.int64)
    place[order] = np.arange(images)
    width = max(int(np.abs(place[row] - place[column]).max(initial=0)), 1)
    return Band(place.astype(np.int32), width, -(-images // width))


def choose_reduction(
    band: Band, images: int, block: int, others: int, rays: int, ways=REDUCTIONS
) -> str | None:
    """The way for a reduced system of `images` blocks of `block` unknowns and `others`; None where
    none of `ways` fits into memory."""
    unknowns = images * block + others
    work = {
        "dense": (unknowns**3 / 3, unknowns**2),
        "banded": (
            band.blocks * (10 / 3) * (band.width * block) ** 3,
            3 * band.blocks * (band.width * block) ** 2,
        ),
        "iterative": (STEPS * WORK_PER_RAY * rays, 0),
    }
    fits = {
        way: cost for way, (cost, size) in work.items() if way in ways and size <= LARGEST_FACTOR
    }
    if not fits:
        return None
    least = min(fits, key=fits.get)
    return "dense" if "dense" in fits and fits["dense"] < GAIN * fits[least] else least
