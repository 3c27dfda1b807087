"""Matches to a fraction of a pixel: least squares matching of many windows, from many starts."""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from jaxbundle.measure.least_squares_matching import (
    LeastSquaresMatch,
    MatchingStatus,
    match_least_squares,
)
from jaxbundle.surface.views import OrientedImage, is_inside

LANES = 256
"""Windows that are matched together."""
SPARE = 5
"""Pixels that the piece of the other image is larger than the window at the start, each side."""
STRETCH = 1.4
"""By which a window may be longer in the other image."""


class Refined(NamedTuple):
    """Places [n, 2] in the other image, A [n, 2, 2], covariance [n, 2, 2] of the place relative to
    the window, pixels²; ρ; σ0 of a grey value; statuses, `MatchingStatus`."""

    uv: Float[np.ndarray, "n 2"]
    A: Float[np.ndarray, "n 2 2"]
    covariance: Float[np.ndarray, "n 2 2"]
    rho: Float[np.ndarray, " n"]
    sigma0: Float[np.ndarray, " n"]
    status: Int[np.ndarray, " n"]


def refine(
    base: OrientedImage,
    other: OrientedImage,
    uv: Float[np.ndarray, "n 2"],
    start: Float[np.ndarray, "n 2"],
    A: Float[np.ndarray, "n 2 2"],
    half: int,
) -> Refined:
    """Match windows of 2·`half` + 1 pixels about whole pixels of the base.

    **Arguments:** `start`: places in the other image, within a few pixels; `A`: start of the
    affine transformation, from the base to the other image.
    """
    n, reach = len(uv), int(np.ceil(STRETCH * half)) + SPARE
    usable = is_inside(base, uv, half) & is_inside(other, start, reach + 1)
    usable &= np.isfinite(A).all((1, 2))
    rows = np.flatnonzero(usable)
    out = Refined(
        start.astype(float), A.astype(float), np.full((n, 2, 2), np.inf), np.full(n, np.nan),
        np.full(n, np.nan), np.full(n, int(MatchingStatus.OUTSIDE)),
    )  # fmt: skip
    for first in range(0, len(rows), LANES):
        part = rows[first : first + LANES]
        lanes = part[np.minimum(np.arange(LANES), len(part) - 1)]
        origin = np.rint(start[lanes]).astype(int) - reach
        template = _pieces(base.grey, np.rint(uv[lanes]).astype(int) - half, 2 * half + 1)
        piece = _pieces(other.grey, origin, 2 * reach + 1)
        begin = np.concatenate([A[lanes], (start[lanes] - origin)[:, :, None]], 2)
        found: LeastSquaresMatch = _match(template, piece, begin.astype(np.float32))
        k = len(part)
        affine = np.asarray(found.affine, float)[:k]
        out.uv[part] = affine[:, :, 2] + origin[:k]
        out.A[part] = affine[:, :, :2]
        out.covariance[part] = np.asarray(found.covariance)[:k]
        out.rho[part] = np.asarray(found.correlation)[:k]
        out.sigma0[part] = np.asarray(found.sigma0)[:k]
        out.status[part] = np.asarray(found.status)[:k]
    return out


def _pieces(grey, corner, side):
    """Pieces [n, side, side] from their upper-left pixels (u, v)."""
    k = np.arange(side)
    return grey[corner[:, 1, None, None] + k[:, None], corner[:, 0, None, None] + k].astype(
        np.float32
    )


@jax.jit
def _match(template, piece, start):
    return jax.vmap(match_least_squares)(template, piece, start)
