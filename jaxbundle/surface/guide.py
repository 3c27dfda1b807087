"""Depths of an image on a grid, coarse to fine: the search range of surface points.

At the coarsest level of the pyramids all positions between the bounds are compared for all nodes,
in all images at once, with semi-global aggregation. Every finer level searches around the result of
its neighbours in the coarser one, with windows on the plane through these.

    rate = pixels of the other image per unit of q, the greatest of all images
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from jaxbundle.surface.correlation import Pyramid, combine, correlate, top
from jaxbundle.surface.segments import segments, visible_range, windows
from jaxbundle.surface.semiglobal import aggregate
from jaxbundle.surface.views import OrientedImage

SPACING = 4
"""Distance of nodes, pixels of the level."""
COARSE_SIDE = 90
"""Minimum pixels of the shorter side of the coarsest level."""
COARSE_STEPS = 128
"""Maximum positions at the coarsest level, if the image is large enough for a coarser one."""
MOST_STEPS = 512
"""Maximum positions compared for a node."""
HALF_WINDOW = 4
"""Half the side of the windows, pixels of the level."""
SEARCH_MARGIN = 2.0
"""Pixels of the coarser level searched beyond the neighbours' range."""
SMALLEST_CORRELATION = 0.35
"""Minimum correlation of a node."""
LARGEST_DEVIATION = 2.0
"""Maximum distance of a node from the median of its neighbours, pixels of the level."""
LARGEST_SLOPE = 0.7
"""Change of position from node to node on one plane, relative to their distance."""
MOST_NODES = 60_000
"""Maximum nodes of a guide; then the finest levels are left to the points."""


@dataclasses.dataclass(frozen=True)
class Guide:
    """Nodes u = `step`·column + `first`, v likewise: `q`, the rate, ρ, normals; `good`: measured at
    the node, not taken from its neighbours."""

    step: float
    first: float
    q: Float[np.ndarray, "r c"]
    rate: Float[np.ndarray, "r c"]
    rho: Float[np.ndarray, "r c"]
    normal: Float[np.ndarray, "r c 3"]
    good: Bool[np.ndarray, "r c"]

    def around(self, uv: Float[np.ndarray, "n 2"], reach: float):
        """q at positions, its lowest and highest value among the four nodes around each, widened by
        `reach` pixels; the normals; the rate."""
        place = (uv - self.first) / self.step
        rows, columns = self.q.shape
        x = np.clip(place[:, 0], 0, columns - 1)
        y = np.clip(place[:, 1], 0, rows - 1)
        at = lambda a: ndimage.map_coordinates(a, [y, x], order=1, mode="nearest")
        j, i = (np.minimum(np.floor(a).astype(int), n - 2) for a, n in ((x, columns), (y, rows)))
        four = np.stack([self.q[i + a, j + b] for a in (0, 1) for b in (0, 1)])
        nearest = np.rint(y).astype(int), np.rint(x).astype(int)
        rate = self.rate[nearest]
        low, high = four.min(0) - reach / rate, four.max(0) + reach / rate
        return at(self.q), np.stack([low, high], 1), self.normal[nearest], rate


def make_guide(
    base: OrientedImage,
    others: Sequence[OrientedImage],
    pyramids: tuple[Pyramid, Sequence[Pyramid]],
    bounds,
    most: int = MOST_NODES,
) -> Guide | None:
    """The guide of an image from others; None without overlap.

    **Arguments:** `bounds(uv)`: bounds of q of the surface at every pixel, [n, 2], ascending;
    `most`: maximum nodes.
    """
    coarsest = len(pyramids[0].levels) - 1
    guide = None
    for level in range(coarsest, -1, -1):
        uv, shape = _nodes(base, level)
        if guide is not None and len(uv) > most:
            break
        q = bounds(uv)
        if guide is None:
            found = _search_all(base, others, pyramids, uv, q, level, shape)
            if found is None:
                return None
        else:
            found = _search_near(base, others, pyramids, uv, q, level, shape, guide)
        guide = _smooth(base, level, *found)
    return guide


def coarsest_level(size: tuple[int, int], length: float) -> int:
    """The first level for segments of this length in pixels."""
    level = 0
    while min(size) / 2 ** (level + 1) >= COARSE_SIDE and (
        length / 2**level > COARSE_STEPS or min(size) / 2**level > 3 * COARSE_SIDE
    ):
        level += 1
    return level


def _nodes(base, level):
    step = SPACING * 2**level
    columns, rows = (max(int((n - 1) // step), 1) + 1 for n in base.size)
    v, u = np.indices((rows, columns)).reshape(2, -1) * step + (2**level - 1) / 2
    return np.stack([u, v], 1), (rows, columns)


def _search_all(base, others, pyramids, uv, q, level, shape):
    """Every position between the bounds, at all nodes, with semi-global aggregation."""
    looked = [visible_range(base, o, uv, q) for o in others]
    seen = [np.isfinite(r).all(1) & (r[:, 0] < r[:, 1]) for r in looked]
    if not any(s.any() for s in seen):
        return None
    parts, steps = [], 8
    for o, r, s in zip(others, looked, seen):
        middle = base.points(uv, np.where(s, r.mean(1), 1.0))
        shape_ = windows(base, o, middle)
        segment = segments(base, o, uv, np.where(s[:, None], r, np.nan))
        spacing = 2.0**level * np.linalg.norm(shape_.other_along, axis=1)
        with np.errstate(invalid="ignore"):
            number = segment.length / spacing
            share = (r[:, 1] - r[:, 0]) / (q[:, 1] - q[:, 0])
        good = s & shape_.usable & np.isfinite(number)
        if good.any():
            own = int(np.ceil(np.percentile(number[good], 98))) + 3
            steps = max(steps, int(np.ceil(np.percentile((number / share)[good], 98))) + 1)
            parts.append((o, segment, shape_, good, min(own, MOST_STEPS)))
    if not parts:
        return None
    steps = min(steps, MOST_STEPS)
    common = q[:, :1] + np.linspace(0, 1, steps) * (q[:, 1:] - q[:, :1])
    curves, rates = [], []
    for o, segment, shape_, good, own in parts:
        pyramid = pyramids[1][[id(x) for x in others].index(id(o))]
        curves.append(
            _at_common(
                base, o, (pyramids[0], pyramid), uv, segment, shape_, good, level, own, common
            )
        )
        rates.append(np.where(good, segment.length / (segment.q[:, 1] - segment.q[:, 0]), 0))
    rho = combine(curves)
    cost = (1 - np.where(np.isfinite(rho), np.maximum(rho, -0.2), 0.0)).astype(np.float32)
    total = aggregate(cost.reshape(*shape, steps)).reshape(-1, steps)
    _, best, _ = top(-total)
    near = np.clip(np.rint(np.nan_to_num(best)).astype(int), 0, steps - 1)
    at = rho[np.arange(len(rho)), near]
    found = q[:, 0] + best / (steps - 1) * (q[:, 1] - q[:, 0])
    return uv, shape, found, np.max(rates, axis=0), at, None


def _at_common(base, other, pyramids, uv, segment, shape, good, level, steps, common):
    """ρ at common parameters, interpolated along each segment."""
    rho, q = correlate(
        (base, other), pyramids, uv, segment, shape, level=level, half=HALF_WINDOW, steps=steps
    )
    spacing = 2.0**level * np.linalg.norm(shape.other_along, axis=1)[:, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        index = (segment.along(common) - segment.length[:, None] / 2) / spacing + (steps - 1) / 2
        inside = (index >= 0) & (index <= steps - 1) & good[:, None]
        inside &= (common >= segment.q[:, :1]) & (common <= segment.q[:, 1:])
        low = np.clip(np.nan_to_num(index).astype(int), 0, steps - 2)
        part = index - low
        a, b = (np.take_along_axis(rho, low + k, axis=1) for k in (0, 1))
        return np.where(inside, a + part * (b - a), np.nan)


def _search_near(base, others, pyramids, uv, bounds, level, shape, guide):
    """Positions around the coarser guide at the nodes."""
    reach = SEARCH_MARGIN * 2.0 ** (level + 1)
    q0, q, normal, rate = guide.around(uv, reach)
    q = np.clip(q, bounds[:, :1], bounds[:, 1:])
    found, rho, _ = search(base, others, pyramids, uv, q, normal, level, HALF_WINDOW)
    lost = ~np.isfinite(found)
    return uv, shape, np.where(lost, q0, found), rate, np.where(lost, np.nan, rho), normal


def search(base, others, pyramids, uv, q, normal, level, half):
    """The best position of each point between its bounds, in all images: q, ρ, and the largest ρ
    other than its neighbours. Points with segments of similar length are processed together."""
    middle = base.points(uv, q.mean(1))
    shapes = [windows(base, o, middle, normal) for o in others]
    parts = [segments(base, o, uv, q) for o in others]
    number = np.stack(
        [
            np.where(w.usable & np.isfinite(s.length), s.length, 0)
            / (2.0**level * np.maximum(np.linalg.norm(w.other_along, axis=1), 1e-9))
            for s, w in zip(parts, shapes)
        ]
    ).max(0)
    number = np.nan_to_num(number)
    bucket = np.clip(2 ** np.ceil(np.log2(number + 3)), 8, MOST_STEPS).astype(int)
    out = np.full((3, len(uv)), np.nan)
    for steps in np.unique(bucket):
        rows = np.flatnonzero(bucket == steps)
        share = np.linspace(0, 1, steps)
        common = q[rows, :1] + share * (q[rows, 1:] - q[rows, :1])
        curves = []
        for k, o in enumerate(others):
            segment, shape = _take(parts[k], rows), _take(shapes[k], rows)
            curves.append(
                _at_common(
                    base,
                    o,
                    (pyramids[0], pyramids[1][k]),
                    uv[rows],
                    segment,
                    shape,
                    shape.usable,
                    level,
                    int(steps),
                    common,
                )
            )
        peak, best, second = top(combine(curves))
        out[0, rows] = common[:, 0] + best / (steps - 1) * (common[:, -1] - common[:, 0])
        out[1, rows], out[2, rows] = peak, second
    return out


def _take(record, rows):
    """The rows of a record of arrays."""
    fields = {f.name: getattr(record, f.name)[rows] for f in dataclasses.fields(record)}
    return type(record)(**fields)


def _smooth(base, level, uv, shape, q, rate, rho, _):
    """A guide from matches: poor or isolated nodes follow their neighbours."""
    step = SPACING * 2.0**level
    q, rate, rho = (np.asarray(a, float).reshape(shape) for a in (q, rate, rho))
    known = np.isfinite(q) & (rho > SMALLEST_CORRELATION)
    rate = np.where((rate > 0) & np.isfinite(rate), rate, np.nan)
    rate = np.where(np.isfinite(rate), rate, np.nanmedian(rate))
    middle = _median(np.where(known, q, np.nan))
    with np.errstate(invalid="ignore"):
        known &= np.abs(q - middle) * rate <= LARGEST_DEVIATION * 2.0**level
    filled = np.where(known, q, middle)
    filled = _nearest_filled(np.where(np.isfinite(filled), filled, np.nan), q)
    X = base.points(uv, filled.ravel()).reshape(*shape, 3)
    return Guide(
        step,
        float(uv[0, 0]),
        filled,
        rate,
        np.nan_to_num(rho, nan=-1.0),
        _normals(base, uv, X, filled, rate, step),
        known,
    )


def _median(q):
    """Median of the known ones of the 3 × 3 nodes around each; NaN: fewer than 3."""
    padded = np.pad(q, 1, constant_values=np.nan)
    nine = np.lib.stride_tricks.sliding_window_view(padded, (3, 3)).reshape(*q.shape, 9)
    enough = np.isfinite(nine).sum(-1) >= 3
    safe = np.where(enough[..., None], nine, 0.0)
    return np.where(enough, np.nanmedian(safe, axis=-1), np.nan)


def _nearest_filled(q, fallback):
    """Unknown nodes filled with the nearest known node."""
    known = np.isfinite(q)
    if not known.any():
        return np.where(np.isfinite(fallback), fallback, np.nanmedian(fallback))
    if known.all():
        return q
    near = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    return q[tuple(near)]


def _normals(base, uv, X, q, rate, step):
    """Normals of the planes through neighbouring nodes; across the line of sight if these are not
    on a plane."""
    du, dv = (_difference(X, axis) for axis in (1, 0))
    normal = np.cross(du, dv)
    bent = np.zeros(q.shape, bool)
    for axis in (0, 1):
        change = np.abs(np.diff(q, axis=axis)) * (rate[1:] if axis == 0 else rate[:, 1:])
        off = change > LARGEST_SLOPE * step
        width = [(0, 0), (0, 0)]
        width[axis] = (1, 0)
        bent |= np.pad(off, width)
        width[axis] = (0, 1)
        bent |= np.pad(off, width)
    d = X - base.points(uv, q.ravel() * 1.01).reshape(X.shape)
    size = np.linalg.norm(normal, axis=-1)
    bent |= ~(size > 0)
    found = np.where(bent[..., None], d, normal)
    return found / np.linalg.norm(found, axis=-1, keepdims=True)


def _difference(X, axis):
    """Between the nodes on both sides."""
    a = np.moveaxis(X, axis, 0)
    inner = np.concatenate([a[1:2] - a[:1], a[2:] - a[:-2], a[-1:] - a[-2:-1]])
    return np.moveaxis(inner, 0, axis)
