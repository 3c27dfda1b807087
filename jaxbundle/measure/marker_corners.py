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
from jaxtyping import Bool, Float, Real

from jaxbundle.leastsquares.quality.distributions import NORMAL_SIGMA_BY_MAD
from jaxbundle.measure.corner_quality import MAX_SIGMA, NO_EDGE, TOO_SMALL
from jaxbundle.measure.straight_edges import EdgeFits, EdgeSettings, StraightEdges, fit_edges, take

Grey = Real[np.ndarray, "rows columns"]
Quadrilaterals = Float[np.ndarray, "markers 4 2"]


@dataclasses.dataclass(frozen=True)
class MarkerSettings:
    """How the sides of markers are fitted, and which corners are too uncertain.

    Half and double were tried as for `EdgeSettings`; what has no figures below changes nothing in
    markers of 15 pixels a side and more, but decides about smaller ones.

    **Fields:**

    - `edges`: of the fits of the sides; its `blur_in_focus` is also the first τ of every marker.
    - `min_strip`: narrowest strip, a cell of the marker or of its margin, in τ: below, blurred
      edges are one.
    - `neglected`, `neglected_oblique`: σ, in τ, of what the model neglects in strips of a width of
      one τ; it decreases by exp(−(width/τ)²/2). The second is multiplied by the cosine of the angle
      between adjacent sides. Found on rendered markers, so that normalised errors have an RMS of 1.
    - `wide_strip`: a strip of this width, in τ, hardly depends on how well its place is known:
      exp(−4²/2) = 0.03 %. Markers with narrower ones are fitted once more (double: RMS 0.0138 for
      a third fit of all).
    - `shift_cell`: cells at least as wide as this, in τ, show the shift of edges: twice `clearance`
      of the edges, at both ends, is left out (double, so that fewer markers are corrected: 0.0147,
      with grey values proportional to light).
    - `min_shift_edges`, `max_shift_edges`: edges between cells that determine it, and are enough:
      σ decreases by their root.
    - `lengths`: limits, pixels, of edges that are fitted together, so that arrays have little
      padding; they change only the time.
    - `curvature`: prior σ of the curvature of a straight line's image, times the longer side of the
      image: with radial distortion k1 a line at the distance d from the centre has 2·k1·d/f²;
      0.2·1/f for k1 = 0.2.
    """

    edges: EdgeSettings = EdgeSettings()
    min_strip: float = 2.0
    neglected: float = 0.5
    neglected_oblique: float = 1.0
    wide_strip: float = 4.0
    shift_cell: float = 7.0
    min_shift_edges: int = 8
    max_shift_edges: int = 100
    lengths: tuple[int, ...] = (12, 24, 48)
    curvature: float = 0.5


@dataclasses.dataclass(frozen=True)
class MarkerCorners:
    """Corners [markers, 4] of markers: pixels, covariance, and why a corner was left out, or ""."""

    xy: Float[np.ndarray, "markers 4 2"]
    covariance: Float[np.ndarray, "markers 4 2 2"]
    why: np.ndarray  # of str


@dataclasses.dataclass(frozen=True)
class _Fitting:
    """What all fits of a call have in common: the photograph, the border of the markers, σ of the
    curvature, pixels⁻¹, and the settings."""

    grey: Grey
    border: int
    curvature: float
    settings: MarkerSettings


def fit_marker_corners(
    grey: Grey,
    approximate: Quadrilaterals,
    cells: Float[np.ndarray, "markers cells cells"] | Bool[np.ndarray, "markers cells cells"],
    border: int,
    settings: MarkerSettings | None = None,
) -> MarkerCorners:
    """The corners of markers found in a photograph.

    **Arguments:** `approximate`: the corners to a few pixels, clockwise from the upper left one of
    the marker; `cells`: 1 for light and 0 for dark cells of the marker, with its `border`, their
    number."""
    settings = settings or MarkerSettings()
    fitting = _Fitting(grey, border, settings.curvature / max(grey.shape), settings)
    number = len(approximate)
    xy = np.asarray(approximate, float)
    blur = np.full((number, 4), settings.edges.blur_in_focus)
    # First from the detected corners, a few pixels off, then from the ones of the first fit.
    for coarse in (True, False):
        edges, fits, xy, covariance = _fit_sides(fitting, xy, cells, blur, coarse)
        # One lens, one distance: τ of a marker is the median over its sides.
        own_blur = fits.blur.reshape(-1, 4)
        blur_before, blur = blur, np.repeat(np.median(own_blur, axis=1), 4).reshape(own_blur.shape)
        is_lost = ~_is_near(xy, approximate, cells.shape[1])
        xy[is_lost] = approximate[is_lost]
    # Where the cells are narrow, or the blur was not the expected one, once more from there: with τ
    # larger by a fifth `clearance` leaves 1.4 % of the contrast of adjacent edges instead of 0.4 %.
    strip = np.minimum(edges.inner, edges.outer).min(1).reshape(number, 4)
    needs_repeat = (
        (np.abs(np.log(blur / blur_before)) > 0.2) | (strip < settings.wide_strip * blur)
    ).any(1)
    if needs_repeat.any():
        sides = np.repeat(needs_repeat, 4)
        parts = _fit_sides(
            fitting, xy[needs_repeat], cells[needs_repeat], blur[needs_repeat], False
        )
        _replace_rows(edges, sides, parts[0])
        _replace_rows(fits, sides, parts[1])
        xy[needs_repeat], covariance[needs_repeat] = parts[2:]
        is_lost |= ~_is_near(xy, approximate, cells.shape[1])
        xy[is_lost] = approximate[is_lost]
    shift = edge_shift(fitting, xy, cells, fits)
    if shift is not None:
        # The sides back outwards, by a shift in τ towards the dark side.
        fits.curve[:, 0] -= shift[0] * fits.blur
        fits.covariance[:, 0, 0] += (shift[1] * fits.blur) ** 2
        xy, covariance = _intersect(edges, _with_model_errors(edges, fits, settings), number)
    why = _find_reasons(edges, fits, covariance, settings)
    why[~_is_near(xy, approximate, cells.shape[1]) | is_lost] = NO_EDGE
    return MarkerCorners(xy, covariance, why)


def _find_reasons(
    edges: StraightEdges,
    fits: EdgeFits,
    covariance: Float[np.ndarray, "markers 4 2 2"],
    settings: MarkerSettings,
) -> np.ndarray:
    """Why corners [markers, 4] are left out, or "": each is of two sides, its own and the one
    before."""
    number = len(covariance)
    strip = np.minimum(edges.inner, edges.outer).min(1) / fits.blur
    # A side with another contrast than the marker: another edge was met.
    contrast = fits.contrast.reshape(number, 4)
    usual = np.median(contrast, axis=1, keepdims=True)
    solved = fits.solved.reshape(number, 4) & (np.abs(contrast - usual) < 0.4 * np.abs(usual))
    why = np.full((number, 4), "", dtype=object)
    sigma = np.sqrt(np.maximum(np.linalg.eigvalsh(np.nan_to_num(covariance, nan=1e9))[..., 1], 0))
    why[~(sigma <= MAX_SIGMA)] = TOO_SMALL
    why[~(solved & np.roll(solved, 1, 1))] = NO_EDGE
    narrow = (strip < settings.min_strip).reshape(number, 4)
    why[narrow | np.roll(narrow, 1, 1)] = TOO_SMALL
    return why


def _is_near(
    xy: Quadrilaterals, approximate: Quadrilaterals, cells_across: int
) -> Bool[np.ndarray, "markers 4"]:
    """Whether corners are where the marker was found: within 2.5 pixels, or a little less than a
    cell."""
    side = np.linalg.norm(approximate - np.roll(approximate, 1, 1), axis=2).min(1)
    return (
        np.linalg.norm(xy - approximate, axis=2)
        < np.maximum(side / (cells_across + 1), 2.5)[:, None]
    )


def _fit_sides(
    fitting: _Fitting,
    xy: Quadrilaterals,
    cells: Float[np.ndarray, "markers cells cells"] | Bool[np.ndarray, "markers cells cells"],
    blur: Float[np.ndarray, "markers 4"],
    coarse: bool,
) -> tuple[StraightEdges, EdgeFits, Quadrilaterals, Float[np.ndarray, "markers 4 2 2"]]:
    """The sides of markers whose corners are expected at `xy`: edges, fits, corners, covariance."""
    edges, settings = _sides_of(xy, cells, fitting.border), fitting.settings
    # In groups of similar length, so that arrays have little padding.
    group, parts, order = np.digitize(2 * edges.half, settings.lengths), [], []
    for g in np.unique(group):
        rows = np.flatnonzero(group == g)
        order.append(rows)
        parts.append(
            fit_edges(
                fitting.grey,
                take(edges, rows),
                blur.ravel()[rows],
                fitting.curvature,
                settings.edges,
                coarse,
            )
        )
    back = np.argsort(np.concatenate(order))
    names = (field.name for field in dataclasses.fields(EdgeFits))
    fits = EdgeFits(*(np.concatenate([getattr(p, name) for p in parts])[back] for name in names))
    return edges, fits, *_intersect(edges, _with_model_errors(edges, fits, settings), len(xy))


def _replace_rows(
    all_rows: StraightEdges | EdgeFits,
    rows: Bool[np.ndarray, " sides"],
    part: StraightEdges | EdgeFits,
) -> None:
    """Replace some rows of the arrays of a dataclass."""
    for field in dataclasses.fields(all_rows):
        getattr(all_rows, field.name)[rows] = getattr(part, field.name)


def edge_shift(
    fitting: _Fitting,
    xy: Quadrilaterals,
    cells: Float[np.ndarray, "markers cells cells"] | Bool[np.ndarray, "markers cells cells"],
    fits: EdgeFits,
) -> tuple[float, float] | None:
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
    n, number, settings = cells.shape[1], len(xy), fitting.settings
    blur = np.median(fits.blur.reshape(number, 4), axis=1)
    side = np.linalg.norm(xy - np.roll(xy, 1, 1), axis=2).min(1)
    ready = fits.solved.reshape(number, 4).all(1) & (side / n > settings.shift_cell * blur)
    H = _homographies(xy, n)
    parts = []
    for marker in np.flatnonzero(ready)[np.argsort(-side[ready])]:
        bend = fits.curve.reshape(number, 4, 3)[marker, :, 2]
        parts.append(_inner_edges(marker, xy, cells[marker] > 0, H, bend))
        if sum(len(part[0]) for part in parts) >= settings.max_shift_edges:
            break
    if not parts:
        return None
    marker, start, end, factor, bent, width = map(np.concatenate, zip(*parts))
    edge_direction = end - start
    perpendicular = np.stack([-edge_direction[:, 1], edge_direction[:, 0]], 1)
    ends = np.zeros((len(start), 2))
    inner_edges = StraightEdges(
        start,
        end,
        np.stack([start, -perpendicular], 1),
        np.stack([end, perpendicular], 1),
        ends + width[:, None],
        ends + width[:, None],
        np.tile([-1.0, 1.0], (len(start), 1)),
        np.zeros((len(start), 1)),
    )
    for direction in (inner_edges.before, inner_edges.after):
        direction[:, 1] /= np.linalg.norm(direction[:, 1], axis=1)[:, None]
    edge_fits = fit_edges(
        fitting.grey, inner_edges, blur[marker], fitting.curvature, settings.edges
    )
    shift = (edge_fits.curve[:, 0] - bent) / (edge_fits.blur * factor)
    sigma = np.sqrt(edge_fits.covariance[:, 0, 0]) / (edge_fits.blur * factor)
    # Shifts by gamma are of the order of τ/3: an edge of σ 0.5 says nothing; edges of the other
    # sign of contrast are not the ones meant.
    good = edge_fits.solved & (sigma < 0.5) & (edge_fits.contrast * fits.contrast[4 * marker] > 0)
    if good.sum() < settings.min_shift_edges:
        return None
    return _robust_mean(shift, sigma, good)


def _robust_mean(
    shift: Float[np.ndarray, " edges"],
    sigma: Float[np.ndarray, " edges"],
    good: Bool[np.ndarray, " edges"],
) -> tuple[float, float]:
    """The mean of shifts without outliers, and its σ from their scatter."""
    # Outliers beyond 3.5 σ of the median, σ from the median deviation; 0.01 and
    # 0.02 τ: what no photograph does better.
    for _ in range(3):
        middle = np.median(shift[good])
        spread = NORMAL_SIGMA_BY_MAD * np.median(np.abs(shift[good] - middle)) + 0.01
        good = good & (np.abs(shift - middle) < 3.5 * spread)
    weight = 1 / (sigma[good] ** 2 + 0.02**2)
    mean = weight @ shift[good] / weight.sum()
    scatter = weight @ (shift[good] - mean) ** 2 / weight.sum()
    return float(mean), float(np.sqrt(scatter / (good.sum() - 1)))


def _inner_edges(
    marker: int,
    xy: Quadrilaterals,
    light: Bool[np.ndarray, "n n"],
    H: Float[np.ndarray, "markers 3 3"],
    bend: Float[np.ndarray, "4"],
) -> tuple[np.ndarray, ...]:
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
        cells = light if turn == 0 else light.T
        row, column = np.nonzero(cells[:, 1:] != cells[:, :-1])
        x = column + 1.0
        dark_beyond = cells[row, column]  # the cell before is light
        a, b = np.stack([x, row], 1), np.stack([x, row + 1.0], 1)
        if turn:
            a, b = a[:, ::-1], b[:, ::-1]
        # The inner side is to the right of start → end as seen in the image.
        swap = dark_beyond if turn == 0 else ~dark_beyond
        start.append(np.where(swap[:, None], b, a))
        end.append(np.where(swap[:, None], a, b))
        s = np.where(dark_beyond, 1.0, -1.0)
        factor.append(1 - s * (1 - 2 * x / n))
        p, q = 2 * x / n - 1, 2 * (row + 0.5) / n - 1
        bend_beyond, bend_before = ((bend[1], bend[3]), (bend[2], bend[0]))[turn]
        bend_along = (1 + p) / 2 * (bend_beyond - mean) - (1 - p) / 2 * (bend_before - mean)
        bent.append(s * (bend_along * (1 - q**2) - mean * p * (p**2 + q**2 - 2)))
    start, end = (_image(H[marker : marker + 1], np.concatenate(x))[0] for x in (start, end))
    factor, bent = np.concatenate(factor), np.concatenate(bent)
    useful = factor > 0.5  # others hardly show the shift: the corners share it
    # The smaller distance of opposite sides of the quadrilateral, roughly, over its cells.
    four = xy[marker]
    a, b = four[2] - four[0], four[3] - four[1]
    area = abs(a[0] * b[1] - a[1] * b[0]) / 2
    width = area / np.linalg.norm(four - np.roll(four, 1, 0), axis=1).max() / n
    number = int(useful.sum())
    return (
        np.full(number, marker),
        start[useful],
        end[useful],
        factor[useful],
        bent[useful],
        np.full(number, width),
    )


def _with_model_errors(edges: StraightEdges, fits: EdgeFits, settings: MarkerSettings) -> EdgeFits:
    """The fits with the σ of what the model neglects in narrow strips added to a."""
    strip = np.minimum(edges.inner, edges.outer).min(1) / fits.blur
    oblique = np.abs(
        [
            np.einsum("ni,ni->n", adjacent[:, 1], edges.along)
            for adjacent in (edges.before, edges.after)
        ]
    ).max(0)
    neglected = settings.neglected + settings.neglected_oblique * oblique
    covariance = fits.covariance.copy()
    covariance[:, 0, 0] += (fits.blur * neglected * np.exp(-(strip**2) / 2)) ** 2
    return dataclasses.replace(fits, covariance=covariance)


def _sides_of(
    xy: Quadrilaterals,
    cells: Float[np.ndarray, "markers cells cells"] | Bool[np.ndarray, "markers cells cells"],
    border: int,
) -> StraightEdges:
    """The sides of markers as edges: upper, right, lower, left; each from corner k to k + 1."""
    n = cells.shape[1]
    following = np.roll(xy, -1, axis=1)
    direction = following - xy
    adjacent_before = np.stack([np.roll(xy, 1, 1), np.roll(direction, 1, 1)], 2)
    adjacent_after = np.stack([following, np.roll(direction, -1, 1)], 2)
    for adjacent in (adjacent_before, adjacent_after):
        adjacent[:, :, 1] /= np.linalg.norm(adjacent[:, :, 1], axis=2)[..., None]
    direction = direction / np.linalg.norm(direction, axis=2)[..., None]
    inward = np.stack([-direction[..., 1], direction[..., 0]], -1)
    H = _homographies(xy, n)
    ticks = np.arange(n + 1.0)
    inner, outer, far_ticks, level = [], [], [], []
    for k in range(4):
        turned = np.rot90(cells, k, axes=(1, 2))  # the side k is the first row
        middle = (xy[:, k] + following[:, k]) / 2
        half_length = np.linalg.norm(following[:, k] - xy[:, k], axis=1)[:, None] / 2

        def along_and_inside(
            t: Float[np.ndarray, " n"],
            depth: float,
            k: int = k,
            middle: Float[np.ndarray, "markers 2"] = middle,
            half_length: Float[np.ndarray, "markers 1"] = half_length,
        ) -> tuple[Float[np.ndarray, "markers n"], Float[np.ndarray, "markers n"]]:
            from_middle = _image(H, _on_side(k, n, t, depth)) - middle[:, None]
            return (
                np.einsum("mti,mi->mt", from_middle, direction[:, k]) / half_length,
                np.einsum("mti,mi->mt", from_middle, inward[:, k]),
            )

        for widths, depth in ((inner, border), (outer, -1)):
            # A line of the marker is a line in the image: its distance from the side is linear in t
            t, s = along_and_inside(np.array([0.0, n]), depth)
            slope = (s[:, 1] - s[:, 0]) / (t[:, 1] - t[:, 0])
            ends = s[:, :1] + slope[:, None] * (np.array([-1.0, 1.0]) - t[:, :1])
            widths.append(np.maximum(np.abs(ends), 0.1))
        far_ticks.append(along_and_inside(ticks, border)[0])
        level.append(turned[:, border].astype(float))
    flat = lambda x: np.stack(x, 1).reshape(4 * len(xy), -1)
    return StraightEdges(
        xy.reshape(-1, 2),
        following.reshape(-1, 2),
        adjacent_before.reshape(-1, 2, 2),
        adjacent_after.reshape(-1, 2, 2),
        flat(inner),
        flat(outer),
        flat(far_ticks),
        flat(level),
    )


def _on_side(k: int, n: int, t: Float[np.ndarray, " n"], depth: float) -> Float[np.ndarray, "n 2"]:
    """Points of the marker's plane, 0 … n, at t along the side k and `depth` inside."""
    t = np.asarray(t, float)
    d = np.full_like(t, depth)
    return np.stack(((t, d), (n - d, t), (n - t, n - d), (d, n - t))[k], -1)


def _homographies(xy: Quadrilaterals, n: int) -> Float[np.ndarray, "markers 3 3"]:
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


def _image(
    H: Float[np.ndarray, "markers 3 3"], points: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "markers n 2"]:
    """Images [markers, n, 2] of points [n, 2]."""
    image = np.einsum("mij,tj->mti", H, np.concatenate([points, np.ones((len(points), 1))], 1))
    return image[..., :2] / image[..., 2:]


def _intersect(
    edges: StraightEdges, fits: EdgeFits, number: int
) -> tuple[Quadrilaterals, Float[np.ndarray, "markers 4 2 2"]]:
    """Corners [markers, 4, 2], corner k between the sides k − 1 and k, and their covariance."""
    side = np.arange(4 * number).reshape(number, 4)
    pair = np.stack([np.roll(side, 1, 1), side], 2)  # [markers, 4, 2 sides]
    middle, direction, inward, half_length, curve, Q = (
        x[pair]
        for x in (edges.middle, edges.along, edges.inward, edges.half, fits.curve, fits.covariance)
    )
    xy = edges.start.reshape(number, 4, 2)
    for _ in range(4):  # Newton: the curvature is small
        from_middle = xy[:, :, None] - middle
        t = np.einsum("mksi,mksi->mks", from_middle, direction) / half_length
        powers = np.stack([np.ones_like(t), t, t * t], -1)
        f = np.einsum("mksi,mksi->mks", from_middle, inward) - np.einsum(
            "mksi,mksi->mks", powers, curve
        )
        slope = (curve[..., 1] + 2 * curve[..., 2] * t) / half_length
        A = inward - slope[..., None] * direction
        parallel = np.abs(np.linalg.det(A)) < 0.05  # 3° between two sides
        A = np.where(parallel[..., None, None], np.eye(2), A)
        inverse_A = np.linalg.inv(A)
        step = np.einsum("mkis,mks->mki", inverse_A, f)
        # Corners are known to a few pixels: longer steps are those of sides that were not found,
        # whose corners `_is_near` refuses.
        xy = xy - np.clip(step, -10, 10)
    variance = np.einsum("mksi,mksij,mksj->mks", powers, Q, powers)
    covariance = np.einsum("mkis,mks,mkjs->mkij", inverse_A, variance, inverse_A)
    return xy, np.where(parallel[..., None, None], np.nan, covariance)
