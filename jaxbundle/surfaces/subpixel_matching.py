"""Subpixel matches: least squares matching of many windows, from many starts.

Both photographs are smoothed first: aliasing and noise shift matches
towards the middle between pixels, and cause false gradients (Schreier et al., 2000).
"""

import dataclasses
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Int

from jaxbundle.measure.least_squares_matching import (
    LeastSquaresMatch,
    MatchingStatus,
    match_least_squares,
)
from jaxbundle.surfaces.segments import MAX_SCALE
from jaxbundle.surfaces.views import Grey, OrientedImage, is_inside
from jaxbundle.system.programs import compile_once

# σ of the Gaussian that smooths both windows, pixels: at the Nyquist frequency exp(−π²·0.7²/2) = 9
# % are left of the detail that interpolation falsifies. Half: RMS of errors over σ 1.06 (0.999),
# only 99.2 % of them within 3 σ (99.6); double: 0.96, and two points instead of one wrong by a
# pixel (the scene is that of `WindowSettings`). It is compiled in.
BLUR = 0.7
# Extent of the Gaussian in pixels, 4 σ.
BLUR_EXTENT = 3


@dataclasses.dataclass(frozen=True)
class WindowSettings:
    """Least squares matching of single windows.

    Figures "half …, double …" are of `benchmarks/surface_settings.py` (scene "no texture", every
    fifth pixel): 2251 points, RMS of errors over σ 0.999, 0.04 % wrong by more than a pixel.
    """

    search_margin: int = 5
    """Margin of the part of the other image around the window at the start, pixels: windows may
    move in it. Half: 65 points more, near the edge of the other image; double: 150 fewer."""
    max_stretch: float = 1.4
    """Maximum ratio of lengths of a window in the other image, for the size of that part: √2, a
    window turned by 45°; windows that are not in it with their margin have a larger part. Half: 77
    points more, near the edge; double: 227 fewer, and more time."""
    min_texture: float = 1.5
    """Minimum ratio of the squared gradients of half a window to those of noise: three standard
    deviations above 1, √(2/78) for the 78 pixels of a side of 13 × 13. Half: 0.31 % of the points
    wrong by more than a pixel instead of 0.04 %; double: none, and 9 points fewer."""


class SubpixelMatches(NamedTuple):
    """Positions [n, 2] in the other image, A [n, 2, 2], covariance [n, 2, 2] of the position
    relative to the window, pixels²; ρ; σ0 of a residual, which has the noise of both windows, grey
    values; statuses, `MatchingStatus`."""

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
    half_window: int,
    settings: WindowSettings = WindowSettings(),
) -> SubpixelMatches:
    """Match windows of 2·`half_window` + 1 pixels around whole pixels of the base.

    **Arguments:** `start`: positions in the other image, within a few pixels; `A`: start of the
    affine transformation, from the base to the other image.
    """
    n = len(uv)
    out = SubpixelMatches(
        start.astype(float),
        A.astype(float),
        np.full((n, 2, 2), np.inf),
        np.full(n, np.nan),
        np.full(n, np.nan),
        np.full(n, int(MatchingStatus.OUTSIDE)),
    )
    is_inside_base = is_inside(base, uv, half_window)
    # How far the corners of the windows are from their middle, along the rows or the columns; half
    # a pixel more, as pieces begin at whole pixels; NaN, where A does not exist, is within nothing.
    reach = half_window * np.abs(A).sum(2).max(1) + 0.5
    margin_done = -1.0
    for stretch in (settings.max_stretch, max(settings.max_stretch, np.sqrt(2) * MAX_SCALE)):
        margin = int(np.ceil(stretch * half_window)) + settings.search_margin
        rows = (
            is_inside_base
            & (reach > margin_done)
            & (reach <= margin)
            & is_inside(other, start, margin + 1)
        )
        _refine_rows(base, other, uv, out, np.flatnonzero(rows), half_window, margin)
        # Few windows are larger: in pieces of their own, which take more time.
        margin_done = float(margin)
    return out


def _refine_rows(
    base: OrientedImage,
    other: OrientedImage,
    uv: Float[np.ndarray, "n 2"],
    out: SubpixelMatches,
    rows: Int[np.ndarray, " k"],
    half_window: int,
    margin: int,
) -> None:
    """Match some of the windows from their starts in `out`, which is changed, in pieces of the
    other image with `margin` pixels around the start."""
    start, A = out.uv.copy(), out.A.copy()
    # 256 windows a call: all iterate until the last has converged
    windows_at_once = 256
    for first_row in range(0, len(rows), windows_at_once):
        part = rows[first_row : first_row + windows_at_once]
        lanes = part[np.minimum(np.arange(windows_at_once), len(part) - 1)]
        origin = np.rint(start[lanes]).astype(int) - margin
        template = _cut_out(
            base.grey, np.rint(uv[lanes]).astype(int) - half_window, 2 * half_window + 1
        )
        piece = _cut_out(other.grey, origin, 2 * margin + 1)
        begin = np.concatenate([A[lanes], (start[lanes] - origin)[:, :, None]], 2)
        matched: LeastSquaresMatch = _match(template, piece, begin.astype(np.float32))
        k = len(part)
        affine = np.asarray(matched.affine, float)[:k]
        out.uv[part] = affine[:, :, 2] + origin[:k]
        out.A[part] = affine[:, :, :2]
        out.covariance[part] = np.asarray(matched.covariance)[:k]
        out.rho[part] = np.asarray(matched.correlation)[:k]
        out.sigma0[part] = np.asarray(matched.sigma0)[:k]
        out.status[part] = np.asarray(matched.status)[:k]


def has_texture(
    grey: Grey,
    uv: Float[np.ndarray, "n 2"],
    sigma0: Float[np.ndarray, " n"],
    half_window: int,
    min_texture: float = WindowSettings.min_texture,
) -> Bool[np.ndarray, " n"]:
    """Whether windows have texture on all sides of their points, by the squares of the gradients
    relative to noise; otherwise they measure a neighbour: the ground at the edge of a roof. The row
    and the column of a point belong to no side: the edge itself may be there.

    Noise of variance σ² has σ²/4πs² after smoothing; twice this is σ0². Central differences of the
    grey values, which are not smoothed here, have σ²/2 on each axis, σ² in all.
    """
    k = np.arange(-half_window - 1, half_window + 2)
    rows, columns = grey.shape
    noise = 2 * np.pi * BLUR**2 * sigma0**2
    good = np.zeros(len(uv), bool)
    # 15 × 15 pixels of each (`half_window` 6): 4 MB
    points_at_once = 4096
    for begin in range(0, len(uv), points_at_once):
        part = slice(begin, begin + points_at_once)
        u, v = np.rint(uv[part]).astype(int).T
        r = np.clip(v[:, None] + k, 0, rows - 1)
        c = np.clip(u[:, None] + k, 0, columns - 1)
        a = grey[r[:, :, None], c[:, None]].astype(np.float32)
        gx, gy = a[:, 1:-1, 2:] - a[:, 1:-1, :-2], a[:, 2:, 1:-1] - a[:, :-2, 1:-1]
        square = (gx * gx + gy * gy) / 4
        before_middle, after_middle = slice(0, half_window), slice(half_window + 1, None)
        sides = (
            square[:, before_middle],
            square[:, after_middle],
            square[:, :, before_middle],
            square[:, :, after_middle],
        )
        weakest_side = np.min([side.mean((1, 2)) for side in sides], axis=0)
        with np.errstate(invalid="ignore"):
            good[part] = weakest_side > min_texture * noise[part]
    return good


def _cut_out(
    grey: Grey, corner: Int[np.ndarray, "n 2"], side: int
) -> Float32[np.ndarray, "n wide wide"]:
    """Pieces from their upper-left pixels (u, v), with `BLUR_EXTENT` pixels more on all sides."""
    k = np.arange(-BLUR_EXTENT, side + BLUR_EXTENT)
    rows, columns = (np.clip(c[:, None] + k, 0, n - 1) for c, n in zip(corner.T[::-1], grey.shape))
    return grey[rows[:, :, None], columns[:, None]].astype(np.float32)


@partial(compile_once, static=())
def _match(
    template: Float32[Array, "n side side"],
    piece: Float32[Array, "n other_side other_side"],
    start: Float32[Array, "n 2 3"],
) -> LeastSquaresMatch:
    match = lambda *arrays: match_least_squares(*arrays, blur=BLUR)
    return jax.vmap(match)(_smooth(template), _smooth(piece), start)


def _smooth(pieces: Float32[Array, "n wide wide"]) -> Float32[Array, "n side side"]:
    """The pieces smoothed, without the `BLUR_EXTENT` pixels on all sides."""
    side = pieces.shape[-1] - 2 * BLUR_EXTENT
    distance = np.arange(side + 2 * BLUR_EXTENT) - np.arange(side)[:, None] - BLUR_EXTENT
    weight = np.where(np.abs(distance) <= BLUR_EXTENT, np.exp(-(distance**2) / (2 * BLUR**2)), 0.0)
    S = jnp.asarray(weight / weight.sum(1, keepdims=True), pieces.dtype)
    return jnp.einsum("ab,cd,nbd->nac", S, S, pieces)
