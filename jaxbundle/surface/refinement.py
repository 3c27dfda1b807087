"""Subpixel matches: least squares matching of many windows, from many starts.

Both photographs are smoothed first: aliasing and noise shift matches
towards the middle between pixels, and cause false gradients (Schreier et al., 2000).
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from jaxbundle.measure.least_squares_matching import (
    LeastSquaresMatch,
    MatchingStatus,
    match_least_squares,
)
from jaxbundle.surface.views import OrientedImage, is_inside
from jaxbundle.system.programs import compile_once

LANES = 256
"""Windows matched together."""
WINDOW_MARGIN = 5
"""Margin of the part of the other image around the window at the start, pixels."""
LARGEST_STRETCH = 1.4
"""Maximum ratio of lengths of a window in the other image."""
OVER_NOISE, TOGETHER = 1.5, 4096
"""Minimum ratio of the squared gradients of half a window to those of noise: three σ above 1."""
BLUR, BEYOND = 0.7, 3
"""σ of the Gaussian, and its extent in pixels."""


class Refined(NamedTuple):
    """Positions [n, 2] in the other image, A [n, 2, 2], covariance [n, 2, 2] of the position
    relative to the window, pixels²; ρ; σ0 of a grey value; statuses, `MatchingStatus`."""

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
    """Match windows of 2·`half` + 1 pixels around whole pixels of the base.

    **Arguments:** `start`: positions in the other image, within a few pixels; `A`: start of the
    affine transformation, from the base to the other image.
    """
    n, reach = len(uv), int(np.ceil(LARGEST_STRETCH * half)) + WINDOW_MARGIN
    usable = is_inside(base, uv, half)
    usable &= is_inside(other, start, reach + 1)
    usable &= np.isfinite(A).all((1, 2))
    rows = np.flatnonzero(usable)
    out = Refined(
        start.astype(float),
        A.astype(float),
        np.full((n, 2, 2), np.inf),
        np.full(n, np.nan),
        np.full(n, np.nan),
        np.full(n, int(MatchingStatus.OUTSIDE)),
    )
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


def has_texture(
    grey: Shaped[np.ndarray, "rows columns"],
    uv: Float[np.ndarray, "n 2"],
    sigma0: Float[np.ndarray, " n"],
    half: int,
) -> Bool[np.ndarray, " n"]:
    """Whether windows have texture on all sides of their points, by the squares of its gradients
    relative to noise; otherwise they measure a neighbour: the ground at the edge of a roof. The row
    and the column of a point belong to no side: the edge itself may be there.

    Smoothed noise of variance σ² has σ²/4πs², twice this is σ0²; central differences of it
    have σ²/2 on each axis.
    """
    k = np.arange(-half - 1, half + 2)
    rows, columns = grey.shape
    noise = 2 * np.pi * BLUR**2 * sigma0**2
    good = np.zeros(len(uv), bool)
    for first in range(0, len(uv), TOGETHER):
        part = slice(first, first + TOGETHER)
        u, v = np.rint(uv[part]).astype(int).T
        r = np.clip(v[:, None] + k, 0, rows - 1)
        c = np.clip(u[:, None] + k, 0, columns - 1)
        a = grey[r[:, :, None], c[:, None]].astype(np.float32)
        gx, gy = a[:, 1:-1, 2:] - a[:, 1:-1, :-2], a[:, 2:, 1:-1] - a[:, :-2, 1:-1]
        square = (gx * gx + gy * gy) / 4
        near, far = slice(0, half), slice(half + 1, None)
        sides = square[:, near], square[:, far], square[:, :, near], square[:, :, far]
        least = np.min([side.mean((1, 2)) for side in sides], axis=0)
        with np.errstate(invalid="ignore"):
            good[part] = least > OVER_NOISE * noise[part]
    return good


def _pieces(grey, corner, side):
    """Pieces [n, side, side] from their upper-left pixels (u, v), and `BEYOND` on all sides."""
    k = np.arange(-BEYOND, side + BEYOND)
    rows, columns = (np.clip(c[:, None] + k, 0, n - 1) for c, n in zip(corner.T[::-1], grey.shape))
    return grey[rows[:, :, None], columns[:, None]].astype(np.float32)


@partial(compile_once, static=())
def _match(template, piece, start):
    match = lambda *arrays: match_least_squares(*arrays, blur=BLUR)
    return jax.vmap(match)(_smooth(template), _smooth(piece), start)


def _smooth(pieces):
    """Smoothed pieces, without pixels beyond them."""
    side = pieces.shape[-1] - 2 * BEYOND
    away = np.arange(side + 2 * BEYOND) - np.arange(side)[:, None] - BEYOND
    weight = np.where(np.abs(away) <= BEYOND, np.exp(-(away**2) / (2 * BLUR**2)), 0.0)
    S = jnp.asarray(weight / weight.sum(1, keepdims=True), pieces.dtype)
    return jnp.einsum("ab,cd,nbd->nac", S, S, pieces)
