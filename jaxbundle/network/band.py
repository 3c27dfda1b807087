"""An order of the images in which the reduced system is banded, where there is one.

Two images share a block of the reduced matrix only if a point is seen in both. In the order of
Cuthill and McKee (1969), reversed (George 1971), images with common points stand near each other:
a drive along a street, or strips flown one after the other, become a narrow band. Cut into
super-blocks as wide as the band, the matrix is block tridiagonal.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sparse
from jaxtyping import Array, Int
from scipy.sparse.csgraph import reverse_cuthill_mckee

LEAST_UNKNOWNS = 1000
"""Reduced systems with fewer unknowns are solved as they are."""
GAIN = 3.0
"""By how much fewer operations the band must need."""


class Band(eqx.Module):
    """`place`: the position of every image in the band; super-blocks of `width` images."""

    place: Int[Array, " images"]
    width: int = eqx.field(static=True)
    blocks: int = eqx.field(static=True)


def find_band(row, column, images: int, block: int) -> Band | None:
    """The band of a reduced system with blocks (row, column) of `block` unknowns an image, or None
    where the system is small or full."""
    if images * block < LEAST_UNKNOWNS:
        return None
    row, column = np.asarray(row), np.asarray(column)
    links = sparse.coo_matrix((np.ones(len(row)), (row, column)), (images, images))
    order = reverse_cuthill_mckee((links + links.T).tocsr(), symmetric_mode=True)
    place = np.empty(images, np.int64)
    place[order] = np.arange(images)
    width = max(int(np.abs(place[row] - place[column]).max(initial=0)), 1)
    blocks = -(-images // width)
    # Cholesky, triangular solve and product of every super-block against one large Cholesky.
    if GAIN * blocks * width**3 * 10 > float(images) ** 3:
        return None
    return Band(jnp.asarray(place.astype(np.int32)), width, blocks)
