"""Corners of square markers (ArUco, AprilTag) as intersections of their sides.

The outer corner of a marker is no saddle of the grey values: a gradient method (`cornerSubPix`) puts
it 0.3 px towards the middle of the marker. Here the four sides are fitted to the grey values
beside them (`straight_edges`), and a corner is where two of them intersect. Its covariance follows
from those of the two sides at their ends,

    n₁·x = u₁,  n₂·x = u₂       C = A⁻¹·diag(σ₁², σ₂²)·A⁻ᵀ,   A = [n₁ᵀ; n₂ᵀ]

A marker is expected in a light margin of at least one of its cells, as it is defined. Corners whose σ
is above a limit are left out.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from jaxbundle.measure.corner_quality import LARGEST_SIGMA, NO_EDGE, TOO_SMALL
from jaxbundle.measure.straight_edges import EdgeFits, Edges, fit_edges, take

NARROWEST = 2.0
"""Narrowest strip, a cell of the marker or of its margin, in τ: below, blurred edges are one."""
FIRST_BLUR = 0.8
"""τ before it is estimated: a lens in focus, and the pixel."""
GROUPS = (12, 24, 48)
"""Limits of lengths, pixels, of edges that are fitted together."""
CURVATURE = 0.5
"""Prior σ of the curvature of a straight line's image, times the longer side of the image: with radial
distortion k1 a line at the distance d from the centre has 2·k1·d/f²; 0.2·1/f for k1 = 0.2."""


@dataclasses.dataclass(frozen=True)
class MarkerCorners:
    """Corners [markers, 4] of markers: pixels, covariance, and why a corner was left out, or ""."""

    xy: Float[np.ndarray, "markers 4 2"]
    covariance: Float[np.ndarray, "markers 4 2 2"]
    why: np.ndarray


def fit_marker_corners(
    grey: np.ndarray,
    near: Float[np.ndarray, "markers 4 2"],
    cells: Float[np.ndarray, "markers cells cells"],
    border: int,
) -> MarkerCorners:
    """The corners of markers found in a photograph.

    **Arguments:** `near`: the corners to a few pixels, clockwise from the upper left one of the
    marker; `cells`: 1 for light and 0 for dark cells of the marker, with its `border`, their
    number.
    """
    number = len(near)
    xy = np.asarray(near, float)
    blur = np.full((number, 4), FIRST_BLUR)
    curvature = CURVATURE / max(grey.shape)
    for coarse in (True, False, False):
        edges = _sides_of(xy, cells, border)
        fits = _fit_by_length(grey, edges, blur.ravel(), curvature, coarse)
        xy, covariance = _intersect(edges, _with_model_errors(edges, fits), number)
        blur = np.repeat(np.median(fits.blur.reshape(number, 4), axis=1), 4).reshape(number, 4)
    strip = np.minimum(edges.inner, edges.outer).min(1) / fits.blur
    solved = (fits.solved & _alike(fits, number)).reshape(number, 4)
    why = np.full((number, 4), "", dtype=object)
    sigma = np.sqrt(np.maximum(np.linalg.eigvalsh(np.nan_to_num(covariance, nan=1e9))[..., 1], 0))
    why[~(sigma <= LARGEST_SIGMA)] = TOO_SMALL
    why[~(solved & np.roll(solved, 1, 1))] = NO_EDGE
    narrow = (strip < NARROWEST).reshape(number, 4)
    why[narrow | np.roll(narrow, 1, 1)] = TOO_SMALL
    side = np.linalg.norm(near - np.roll(near, 1, 1), axis=2).min(1)
    moved = np.linalg.norm(xy - near, axis=2)
    why[~(moved < np.maximum(0.15 * side, 2.5)[:, None])] = NO_EDGE
    return MarkerCorners(xy, covariance, why)


def _with_model_errors(edges: Edges, fits: EdgeFits) -> EdgeFits:
    """The fits with the σ of what the model neglects in narrow strips added to a."""
    strip = np.minimum(edges.inner, edges.outer).min(1) / fits.blur
    neglected = fits.blur * 0.5 * np.exp(-(strip**2) / 2)
    covariance = fits.covariance.copy()
    covariance[:, 0, 0] += neglected**2
    return dataclasses.replace(fits, covariance=covariance)


def _alike(fits: EdgeFits, number):
    """Whether a side has the contrast of the marker: another edge may have been met."""
    contrast = fits.contrast.reshape(number, 4)
    usual = np.median(contrast, axis=1, keepdims=True)
    return (np.abs(contrast - usual) < 0.4 * np.abs(usual)).ravel()


def _sides_of(xy, cells, border) -> Edges:
    """The sides of markers as edges: upper, right, lower, left; each from corner k to k + 1."""
    n = cells.shape[1]
    following = np.roll(xy, -1, axis=1)
    along = following - xy
    before = np.stack([np.roll(xy, 1, 1), np.roll(along, 1, 1)], 2)
    after = np.stack([following, np.roll(along, -1, 1)], 2)
    for near in (before, after):
        near[:, :, 1] /= np.linalg.norm(near[:, :, 1], axis=2)[..., None]
    along = along / np.linalg.norm(along, axis=2)[..., None]
    inward = np.stack([-along[..., 1], along[..., 0]], -1)
    H = _homographies(xy, n)
    ticks = np.arange(n + 1.0)
    inner, outer, far, level = [], [], [], []
    for k in range(4):
        turned = np.rot90(cells, k, axes=(1, 2))  # the side k is the first row
        place = lambda t, depth, k=k: _image(H, _on_side(k, n, t, depth))
        middle = (xy[:, k] + following[:, k]) / 2
        half = np.linalg.norm(following[:, k] - xy[:, k], axis=1)[:, None] / 2

        def along_and_inside(t, depth, k=k, middle=middle, half=half):
            away = _image(H, _on_side(k, n, t, depth)) - middle[:, None]
            return (np.einsum("mti,mi->mt", away, along[:, k]) / half,
                    np.einsum("mti,mi->mt", away, inward[:, k]))  # fmt: skip

        for widths, depth in ((inner, border), (outer, -1)):
            # a line of the marker is a line in the image: its distance from the side is linear in t
            t, s = along_and_inside(np.array([0.0, n]), depth)
            slope = (s[:, 1] - s[:, 0]) / (t[:, 1] - t[:, 0])
            ends = s[:, :1] + slope[:, None] * (np.array([-1.0, 1.0]) - t[:, :1])
            widths.append(np.maximum(np.abs(ends), 0.1))
        far.append(along_and_inside(ticks, border)[0])
        level.append(turned[:, border].astype(float))
    flat = lambda x: np.stack(x, 1).reshape(4 * len(xy), -1)
    return Edges(
        xy.reshape(-1, 2), following.reshape(-1, 2), before.reshape(-1, 2, 2),
        after.reshape(-1, 2, 2), flat(inner), flat(outer), flat(far), flat(level),
    )  # fmt: skip


def _on_side(k, n, t, depth):
    """Points of the marker's plane, 0 … n, at t along the side k and `depth` inside."""
    t = np.asarray(t, float)
    d = np.full_like(t, depth)
    return np.stack(((t, d), (n - d, t), (n - t, n - d), (d, n - t))[k], -1)


def _homographies(xy, n):
    """Homographies [markers, 3, 3] from the marker's plane, a square of n × n cells."""
    corners = n * np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    A = np.zeros((len(xy), 8, 8))
    A[:, 0::2, 0:2] = A[:, 1::2, 3:5] = corners
    A[:, 0::2, 2] = A[:, 1::2, 5] = 1
    A[:, 0::2, 6:] = -corners * xy[:, :, :1]
    A[:, 1::2, 6:] = -corners * xy[:, :, 1:]
    try:
        h = np.linalg.solve(A, xy.reshape(len(xy), 8, 1))[..., 0]
    except np.linalg.LinAlgError:
        h = np.einsum("mij,mj->mi", np.linalg.pinv(A), xy.reshape(len(xy), 8))
    return np.concatenate([h, np.ones((len(xy), 1))], 1).reshape(-1, 3, 3)


def _image(H, points):
    """Images [markers, n, 2] of points [n, 2]."""
    image = np.einsum("mij,tj->mti", H, np.concatenate([points, np.ones((len(points), 1))], 1))
    return image[..., :2] / image[..., 2:]


def _fit_by_length(grey, edges: Edges, blur, curvature, coarse) -> EdgeFits:
    """The edges fitted in groups of similar length, so that arrays have little padding."""
    length = 2 * edges.half
    group = np.digitize(length, GROUPS)
    parts, order = [], []
    for g in np.unique(group):
        rows = np.flatnonzero(group == g)
        order.append(rows)
        parts.append(fit_edges(grey, take(edges, rows), blur[rows], curvature, coarse))
    back = np.argsort(np.concatenate(order))
    return EdgeFits(*(
        np.concatenate([getattr(part, field.name) for part in parts])[back]
        for field in dataclasses.fields(EdgeFits)
    ))  # fmt: skip


def _intersect(edges: Edges, fits: EdgeFits, number):
    """Corners [markers, 4, 2], corner k between the sides k − 1 and k, and their covariance."""
    of = np.arange(4 * number).reshape(number, 4)
    pair = np.stack([np.roll(of, 1, 1), of], 2)  # [markers, 4, 2 sides]
    middle, along, inward, half, curve, Q = (
        x[pair] for x in (edges.middle, edges.along, edges.inward, edges.half, fits.curve,
                          fits.covariance)
    )  # fmt: skip
    xy = edges.start.reshape(number, 4, 2)
    for _ in range(4):  # Newton: the curvature is small
        away = xy[:, :, None] - middle
        t = np.einsum("mksi,mksi->mks", away, along) / half
        powers = np.stack([np.ones_like(t), t, t * t], -1)
        f = np.einsum("mksi,mksi->mks", away, inward) - np.einsum("mksi,mksi->mks", powers, curve)
        slope = (curve[..., 1] + 2 * curve[..., 2] * t) / half
        A = inward - slope[..., None] * along
        parallel = np.abs(np.linalg.det(A)) < 0.05
        A = np.where(parallel[..., None, None], np.eye(2), A)
        back = np.linalg.inv(A)
        step = np.einsum("mkis,mks->mki", back, f)
        xy = xy - np.clip(step, -10, 10)
    variance = np.einsum("mksi,mksij,mksj->mks", powers, Q, powers)
    covariance = np.einsum("mkis,mks,mkjs->mkij", back, variance, back)
    return xy, np.where(parallel[..., None, None], np.nan, covariance)
