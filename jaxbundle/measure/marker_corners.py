"""Corners of square markers (ArUco, AprilTag) as intersections of their sides.

The outer corner of a marker is no saddle of the grey values: a gradient method (`cornerSubPix`)
puts it 0.3 px towards the middle of the marker. Here the four sides are fitted to the grey values
beside them (`straight_edges`), and a corner is where two of them intersect. Its covariance follows
from those of the two sides at their ends,

    n₁·x = u₁,  n₂·x = u₂       C = A⁻¹·diag(σ₁², σ₂²)·A⁻ᵀ,   A = [n₁ᵀ; n₂ᵀ]

A marker is expected in a light margin of at least one of its cells, as it is defined. Corners whose
σ is above a limit are left out.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from jaxbundle.measure.corner_quality import LARGEST_SIGMA, NO_EDGE, TOO_SMALL
from jaxbundle.measure.straight_edges import EdgeFits, Edges, fit_edges, take

NARROWEST = 2.0
"""Narrowest strip, a cell of the marker or of its margin, in τ: below, blurred edges are one."""
NARROW, NARROW_OBLIQUE = 0.5, 1.0
"""σ, in τ, of what the model neglects in strips of a width of one τ; it decreases by
exp(−(width/τ)²/2). The second is multiplied by the cosine of the angle between adjacent sides.
Found on rendered markers."""
SURE = 4.0
"""A strip of this width, in τ, hardly depends on how well its place is known."""
FIRST_BLUR = 0.8
"""τ before it is estimated: a lens in focus, and the pixel."""
CELL_FOR_SHIFT = 7.0
"""Cells at least as wide as this, in τ, show the shift of edges: 2·2.7 at the ends of an edge are
left out."""
FEWEST_INNER_EDGES, MOST_INNER_EDGES = 8, 100
"""Edges between cells that determine it, and are enough."""
GROUPS = (12, 24, 48)
"""Limits of lengths, pixels, of edges that are fitted together."""
CURVATURE = 0.5
"""Prior σ of the curvature of a straight line's image, times the longer side of the image: with
radial distortion k1 a line at the distance d from the centre has 2·k1·d/f²; 0.2·1/f for k1 =
0.2."""


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
    for coarse in (True, False):
        edges, fits, xy, covariance = _fit_sides(grey, xy, cells, border, blur, curvature, coarse)
        before, blur = blur, _blur_of(fits)
        lost = ~_is_near(xy, near)
        xy[lost] = near[lost]
    # where the cells are narrow, or the blur was not the expected one, once more from there
    strip = np.minimum(edges.inner, edges.outer).min(1).reshape(number, 4)
    again = ((np.abs(np.log(blur / before)) > 0.2) | (strip < SURE * blur)).any(1)
    if again.any():
        of = np.repeat(again, 4)
        parts = _fit_sides(grey, xy[again], cells[again], border, blur[again], curvature, False)
        _put(edges, of, parts[0])
        _put(fits, of, parts[1])
        xy[again], covariance[again] = parts[2:]
        lost |= ~_is_near(xy, near)
        xy[lost] = near[lost]
    shift = edge_shift(grey, xy, cells, fits, curvature)
    if shift is not None:
        fits = _shifted(fits, *shift)
        xy, covariance = _intersect(edges, _with_model_errors(edges, fits), number)
    strip = np.minimum(edges.inner, edges.outer).min(1) / fits.blur
    solved = (fits.solved & _alike(fits, number)).reshape(number, 4)
    why = np.full((number, 4), "", dtype=object)
    sigma = np.sqrt(np.maximum(np.linalg.eigvalsh(np.nan_to_num(covariance, nan=1e9))[..., 1], 0))
    why[~(sigma <= LARGEST_SIGMA)] = TOO_SMALL
    why[~(solved & np.roll(solved, 1, 1))] = NO_EDGE
    narrow = (strip < NARROWEST).reshape(number, 4)
    why[narrow | np.roll(narrow, 1, 1)] = TOO_SMALL
    why[~_is_near(xy, near)] = NO_EDGE
    why[lost] = NO_EDGE
    return MarkerCorners(xy, covariance, why)


def _is_near(xy, near):
    """Whether corners are where the marker was found: within 2.5 pixels or a seventh of its side,
    less than a cell."""
    side = np.linalg.norm(near - np.roll(near, 1, 1), axis=2).min(1)
    return np.linalg.norm(xy - near, axis=2) < np.maximum(side / 7, 2.5)[:, None]


def _fit_sides(grey, xy, cells, border, blur, curvature, coarse):
    """The sides of markers whose corners are expected at `xy`: edges, fits, corners, covariance."""
    edges = _sides_of(xy, cells, border)
    fits = _fit_by_length(grey, edges, blur.ravel(), curvature, coarse)
    return edges, fits, *_intersect(edges, _with_model_errors(edges, fits), len(xy))


def _blur_of(fits: EdgeFits):
    """τ of the markers, for each of their sides."""
    blur = fits.blur.reshape(-1, 4)
    return np.repeat(np.median(blur, axis=1), 4).reshape(blur.shape)


def _put(whole, rows, part) -> None:
    """Replace some rows of the arrays of a dataclass."""
    for field in dataclasses.fields(whole):
        getattr(whole, field.name)[rows] = getattr(part, field.name)


def edge_shift(grey, xy, cells, fits: EdgeFits, curvature) -> tuple[float, float] | None:
    """The shift of edges towards their dark side in τ (of inverted markers their light side, which
    is negative), and its σ; None if the markers are too small.

    Grey values are often not proportional to light (gamma), and ink spreads: at the half level,
    light cells are too wide and dark ones too narrow. Of the shift δ the homography of the corners,
    which lie on shifted sides too, explains s·(1 − 2·x/n)·δ at x of n cells from a side, where s is
    1 if the dark cell is beyond, −1 if it is before; so an edge between two cells is seen at a from
    its expected place, with

        a = δ·(1 − s·(1 − 2·x/n))

    δ is proportional to τ: the mean of a/(τ·(…)) over the inner edges of the largest markers.
    """
    n, number = cells.shape[1], len(xy)
    blur = np.median(fits.blur.reshape(number, 4), axis=1)
    side = np.linalg.norm(xy - np.roll(xy, 1, 1), axis=2).min(1)
    ready = fits.solved.reshape(number, 4).all(1) & (side / n > CELL_FOR_SHIFT * blur)
    H = _homographies(xy, n)
    parts = []
    for marker in np.flatnonzero(ready)[np.argsort(-side[ready])]:
        bend = fits.curve.reshape(number, 4, 3)[marker, :, 2]
        parts.append(_inner_edges(marker, xy, cells[marker] > 0, H, bend))
        if sum(len(part[0]) for part in parts) >= MOST_INNER_EDGES:
            break
    if not parts:
        return None
    marker, start, end, factor, bent, width = map(np.concatenate, zip(*parts))
    along = end - start
    across = np.stack([-along[:, 1], along[:, 0]], 1)
    ends = np.zeros((len(start), 2))
    inside = Edges(
        start,
        end,
        np.stack([start, -across], 1),
        np.stack([end, across], 1),
        ends + width[:, None],
        ends + width[:, None],
        np.tile([-1.0, 1.0], (len(start), 1)),
        np.zeros((len(start), 1)),
    )
    for direction in (inside.before, inside.after):
        direction[:, 1] /= np.linalg.norm(direction[:, 1], axis=1)[:, None]
    found = fit_edges(grey, inside, blur[marker], curvature)
    shift = (found.curve[:, 0] - bent) / (found.blur * factor)
    sigma = np.sqrt(found.covariance[:, 0, 0]) / (found.blur * factor)
    good = found.solved & (sigma < 0.5) & (found.contrast * fits.contrast[4 * marker] > 0)
    if good.sum() < FEWEST_INNER_EDGES:
        return None
    for _ in range(3):
        middle = np.median(shift[good])
        spread = 1.4826 * np.median(np.abs(shift[good] - middle)) + 0.01
        good &= np.abs(shift - middle) < 3.5 * spread
    weight = 1 / (sigma[good] ** 2 + 0.02**2)
    mean = weight @ shift[good] / weight.sum()
    scatter = weight @ (shift[good] - mean) ** 2 / weight.sum()
    return float(mean), float(np.sqrt(scatter / (good.sum() - 1)))


def _inner_edges(marker, xy, light, H, bend):
    """Edges between light and dark cells of a marker, with the dark cell on the inner side: marker,
    start, end, factor 1 − s·(1 − 2·x/n), the part of a by the lens, narrowest cell.

    `bend`: c of the upper, right, lower and left side, which is how far they bulge. With x, y = −1
    … 1 across the marker, radial distortion about its middle moves points by −c·(x, y)·(x² + y² −
    2) relative to the corners; what bends opposite sides to the same direction, by (1 − y²) or (1 −
    x²).
    """
    n = len(light)
    mean = bend.mean()
    start, end, factor, bent = [], [], [], []
    for turn in (0, 1):  # edges along columns, along rows
        here = light if turn == 0 else light.T
        row, column = np.nonzero(here[:, 1:] != here[:, :-1])
        x = column + 1.0
        dark_beyond = here[row, column]  # the cell before is light
        a, b = np.stack([x, row], 1), np.stack([x, row + 1.0], 1)
        if turn:
            a, b = a[:, ::-1], b[:, ::-1]
        # the inner side is to the right of start → end as seen in the image
        swap = dark_beyond if turn == 0 else ~dark_beyond
        start.append(np.where(swap[:, None], b, a))
        end.append(np.where(swap[:, None], a, b))
        s = np.where(dark_beyond, 1.0, -1.0)
        factor.append(1 - s * (1 - 2 * x / n))
        p, q = 2 * x / n - 1, 2 * (row + 0.5) / n - 1
        beyond, before = ((bend[1], bend[3]), (bend[2], bend[0]))[turn]
        along = (1 + p) / 2 * (beyond - mean) - (1 - p) / 2 * (before - mean)
        bent.append(s * (along * (1 - q**2) - mean * p * (p**2 + q**2 - 2)))
    start, end = (_image(H[marker : marker + 1], np.concatenate(x))[0] for x in (start, end))
    factor, bent = np.concatenate(factor), np.concatenate(bent)
    useful = factor > 0.5
    width = _narrowest(xy[marker]) / n
    number = int(useful.sum())
    return (
        np.full(number, marker),
        start[useful],
        end[useful],
        factor[useful],
        bent[useful],
        np.full(number, width),
    )


def _narrowest(four):
    """The smaller distance of opposite sides of a quadrilateral, roughly."""
    a, b = four[2] - four[0], four[3] - four[1]
    area = abs(a[0] * b[1] - a[1] * b[0]) / 2
    return area / np.linalg.norm(four - np.roll(four, 1, 0), axis=1).max()


def _shifted(fits: EdgeFits, shift, sigma) -> EdgeFits:
    """Sides moved back outwards by a shift towards the dark side, in τ."""
    curve, covariance = fits.curve.copy(), fits.covariance.copy()
    curve[:, 0] -= shift * fits.blur
    covariance[:, 0, 0] += (sigma * fits.blur) ** 2
    return dataclasses.replace(fits, curve=curve, covariance=covariance)


def _with_model_errors(edges: Edges, fits: EdgeFits) -> EdgeFits:
    """The fits with the σ of what the model neglects in narrow strips added to a."""
    strip = np.minimum(edges.inner, edges.outer).min(1) / fits.blur
    oblique = np.abs(
        [np.einsum("ni,ni->n", near[:, 1], edges.along) for near in (edges.before, edges.after)]
    ).max(0)
    neglected = fits.blur * (NARROW + NARROW_OBLIQUE * oblique) * np.exp(-(strip**2) / 2)
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
        middle = (xy[:, k] + following[:, k]) / 2
        half = np.linalg.norm(following[:, k] - xy[:, k], axis=1)[:, None] / 2

        def along_and_inside(t, depth, k=k, middle=middle, half=half):
            away = _image(H, _on_side(k, n, t, depth)) - middle[:, None]
            return (
                np.einsum("mti,mi->mt", away, along[:, k]) / half,
                np.einsum("mti,mi->mt", away, inward[:, k]),
            )

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
        xy.reshape(-1, 2),
        following.reshape(-1, 2),
        before.reshape(-1, 2, 2),
        after.reshape(-1, 2, 2),
        flat(inner),
        flat(outer),
        flat(far),
        flat(level),
    )


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
    return EdgeFits(
        *(
            np.concatenate([getattr(part, field.name) for part in parts])[back]
            for field in dataclasses.fields(EdgeFits)
        )
    )


def _intersect(edges: Edges, fits: EdgeFits, number: int):
    """Corners [markers, 4, 2], corner k between the sides k − 1 and k, and their covariance."""
    of = np.arange(4 * number).reshape(number, 4)
    pair = np.stack([np.roll(of, 1, 1), of], 2)  # [markers, 4, 2 sides]
    middle, along, inward, half, curve, Q = (
        x[pair]
        for x in (edges.middle, edges.along, edges.inward, edges.half, fits.curve, fits.covariance)
    )
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
