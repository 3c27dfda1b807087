"""Depths of an image on a grid, coarse to fine: the search range of surface points.

At the coarsest level of the pyramids all positions between the bounds are compared for all nodes,
in all images at once, with semi-global aggregation. Every finer level searches around the result of
its neighbours in the coarser one, with windows on the plane through these.

    q:    the parameter along a line of sight: 1/s of a photograph, the height of a scanner image
    rate: pixels of the other image per unit of q, the greatest of all images
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from jaxbundle.surfaces.correlation import Pyramid, combine, correlate, find_peaks
from jaxbundle.surfaces.cost_aggregation import aggregate
from jaxbundle.surfaces.segments import Segments, Windows, segments, visible_range, windows
from jaxbundle.surfaces.views import OrientedImage, Places

# Those of the base image and of the others.
ImagePyramids = tuple[Pyramid, Sequence[Pyramid]]
PerNode = Float[np.ndarray, " n"]
Nodes = Float[np.ndarray, "r c"]
ArrayRecord = TypeVar("ArrayRecord", Segments, Windows)


@dataclasses.dataclass(frozen=True)
class GuideSettings:
    """The depths of an image on a grid; pixels are those of the level of the pyramid.

    Figures "half …, double …" are of `benchmarks/surface_accuracy.py "no texture" --sparse` with
    every fifth pixel: 2251 points, RMS of errors over σ 0.999, 14.6 s.
    """

    spacing: int = 4
    """Distance of nodes, pixels. Half: four times the nodes, 10 points more, RMS 1.03; double: a
    quarter of the nodes, 6 more, 0.98."""
    coarse_side: int = 90
    """Minimum pixels of the shorter side of the coarsest level, so that it has some 20 × 20 nodes
    for the aggregation. Half and double: the same points within 2."""
    max_coarse_steps: int = 128
    """Maximum positions at the coarsest level, if the image is large enough for a coarser one. Half
    and double: no difference."""
    max_steps: int = 512
    """Maximum positions compared for a node, for memory: larger ranges are searched only around
    their middle."""
    half_window: int = 4
    """Half the side of the windows of correlation, pixels. Half: the same points within 1; double:
    RMS 1.09 and only 98.4 % of the errors within 3 σ (99.6), since windows reach over steps."""
    search_margin: float = 2.0
    """Pixels of the coarser level searched beyond the range of the neighbouring nodes. Half: 13
    points fewer; double: 4 fewer, and more time."""
    min_correlation: float = 0.35
    """Minimum ρ of a node. Half and double: the same points within 2: the median of the neighbours
    replaces wrong nodes as well."""
    max_deviation: float = 2.0
    """Maximum distance of a node from the median of its neighbours, pixels. Half and double: the
    same points within 1, RMS 0.99."""
    max_slope: float = 0.7
    """Maximum change of position from node to node on one plane, relative to their distance. Half:
    RMS 1.006; double: 0.998."""
    small_change: float = 0.08
    """P₁ of the semi-global aggregation, for costs 1 − ρ. Half and double: the same points within
    1."""
    large_change: float = 0.5
    """P₂ of it. Half and double: the same points within 1."""
    max_nodes: int = 60_000
    """Maximum nodes of a guide; then the finest levels are left to the points. It limits the time
    of large images, since points search two pixels around their nodes in any case."""


@dataclasses.dataclass(frozen=True)
class Guide:
    """Nodes u = `step`·column + `first`, v likewise: `q`, the rate, ρ, normals; `good`: measured at
    the node, not taken from its neighbours."""

    step: float
    first: float
    q: Nodes
    rate: Nodes
    rho: Nodes
    normal: Float[np.ndarray, "r c 3"]
    good: Bool[np.ndarray, "r c"]

    def good_nodes(
        self,
    ) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"], Float[np.ndarray, "n 2"]]:
        """Rows, columns and pixels of the good nodes."""
        row, column = np.nonzero(self.good)
        return row, column, np.stack([column, row], 1) * self.step + self.first

    def look_up(
        self, uv: Float[np.ndarray, "n 2"], margin: float
    ) -> tuple[
        Float[np.ndarray, " n"],
        Float[np.ndarray, "n 2"],
        Float[np.ndarray, "n 3"],
        Float[np.ndarray, " n"],
    ]:
        """q at positions, its lowest and highest value among the four nodes around each, widened by
        `margin` pixels; the normals; the rate."""
        place = (uv - self.first) / self.step
        rows, columns = self.q.shape
        x = np.clip(place[:, 0], 0, columns - 1)
        y = np.clip(place[:, 1], 0, rows - 1)
        interpolate = lambda a: ndimage.map_coordinates(a, [y, x], order=1, mode="nearest")
        j, i = (np.minimum(np.floor(a).astype(int), n - 2) for a, n in ((x, columns), (y, rows)))
        four = np.stack([self.q[i + a, j + b] for a in (0, 1) for b in (0, 1)])
        nearest = np.rint(y).astype(int), np.rint(x).astype(int)
        rate = self.rate[nearest]
        low, high = four.min(0) - margin / rate, four.max(0) + margin / rate
        return interpolate(self.q), np.stack([low, high], 1), self.normal[nearest], rate


def make_guide(
    base: OrientedImage,
    others: Sequence[OrientedImage],
    pyramids: ImagePyramids,
    bounds: Callable[[Places], Float[np.ndarray, "n 2"]],
    settings: GuideSettings = GuideSettings(),
) -> Guide | None:
    """The guide of an image from others; None without overlap.

    **Arguments:** `bounds(uv)`: bounds of q of the surface at every pixel, ascending.
    """
    coarsest = len(pyramids[0].levels) - 1
    guide = None
    for level in range(coarsest, -1, -1):
        uv, shape = _place_nodes(base, level, settings.spacing)
        if guide is not None and len(uv) > settings.max_nodes:
            break
        q = bounds(uv)
        if guide is None:
            matches = _search_all(base, others, pyramids, uv, q, level, shape, settings)
            if matches is None:
                return None
        else:
            matches = _search_near(base, others, pyramids, uv, q, level, guide, settings)
        guide = _smooth(base, level, uv, shape, matches, settings)
    return guide


def coarsest_level(
    size: tuple[int, int], length: float, settings: GuideSettings = GuideSettings()
) -> int:
    """The first level for segments of this length in pixels."""
    level, side = 0, settings.coarse_side
    # A coarser level also if the image is large for its segments: it costs a quarter, and its
    # windows show four times the surroundings.
    while min(size) / 2 ** (level + 1) >= side and (
        length / 2**level > settings.max_coarse_steps or min(size) / 2**level > 3 * side
    ):
        level += 1
    return level


def _place_nodes(base: OrientedImage, level: int, spacing: int) -> tuple[Places, tuple[int, int]]:
    """Nodes at the centres of pixels of a level, in pixels of the full image; rows and columns."""
    step = spacing * 2**level
    columns, rows = (max(int((n - 1) // step), 1) + 1 for n in base.size)
    v, u = np.indices((rows, columns)).reshape(2, -1) * step + (2**level - 1) / 2
    return np.stack([u, v], 1), (rows, columns)


class NodeMatches(NamedTuple):
    """q of nodes (NaN: none), pixels of another image per unit of q, ρ."""

    q: PerNode
    rate: PerNode
    rho: PerNode


class PairSearch(NamedTuple):
    """Where the nodes are searched in another image, and with how many positions."""

    other: OrientedImage
    pyramid: Pyramid
    segment: Segments
    window: Windows
    visible: Bool[np.ndarray, " n"]
    steps: int


def _search_all(
    base: OrientedImage,
    others: Sequence[OrientedImage],
    pyramids: ImagePyramids,
    uv: Places,
    q: Float[np.ndarray, "n 2"],
    level: int,
    shape: tuple[int, int],
    settings: GuideSettings,
) -> NodeMatches | None:
    """Every position between the bounds, at all nodes, with semi-global aggregation."""
    searches, steps = _prepare_searches(base, others, pyramids[1], uv, q, level, settings)
    if not searches:
        return None
    common = q[:, :1] + np.linspace(0, 1, steps) * (q[:, 1:] - q[:, :1])
    curves, rates = [], []
    for pair in searches:
        both_pyramids, segment = (pyramids[0], pair.pyramid), pair.segment
        curves.append(
            _correlate_at(
                common,
                (base, pair.other),
                both_pyramids,
                uv,
                segment,
                pair.window,
                pair.visible,
                level=level,
                steps=pair.steps,
                half_window=settings.half_window,
            )
        )
        rate = segment.length / (segment.q[:, 1] - segment.q[:, 0])
        rates.append(np.where(pair.visible, rate, 0))
    rho = combine(curves)
    # Anticorrelation is no worse than no correlation, nearly: an image of a hidden point may show
    # anything. Positions outside all images have the cost of no correlation.
    cost = (1 - np.where(np.isfinite(rho), np.maximum(rho, -0.2), 0.0)).astype(np.float32)
    total = aggregate(
        cost.reshape(*shape, steps), settings.small_change, settings.large_change
    ).reshape(-1, steps)
    _, best, _ = find_peaks(-total)
    nearest = np.clip(np.rint(np.nan_to_num(best)).astype(int), 0, steps - 1)
    q_found = q[:, 0] + best / (steps - 1) * (q[:, 1] - q[:, 0])
    return NodeMatches(q_found, np.max(rates, axis=0), rho[np.arange(len(rho)), nearest])


def _prepare_searches(
    base: OrientedImage,
    others: Sequence[OrientedImage],
    pyramids: Sequence[Pyramid],
    uv: Places,
    q: Float[np.ndarray, "n 2"],
    level: int,
    settings: GuideSettings,
) -> tuple[list[PairSearch], int]:
    """The images in which nodes are visible, and the number of common positions of all."""
    # At least 8 positions: a peak, its neighbours, and others to tell it from (`find_peaks`).
    searches, steps = [], 8
    for other, pyramid in zip(others, pyramids):
        r = visible_range(base, other, uv, q)
        visible = np.isfinite(r).all(1) & (r[:, 0] < r[:, 1])
        window = windows(base, other, base.points(uv, np.where(visible, r.mean(1), 1.0)))
        segment = segments(base, other, uv, np.where(visible[:, None], r, np.nan))
        step_length = 2.0**level * np.linalg.norm(window.other_axis, axis=1)
        with np.errstate(invalid="ignore"):
            number = segment.length / step_length
            share = (r[:, 1] - r[:, 0]) / (q[:, 1] - q[:, 0])
        visible = visible & window.usable & np.isfinite(number)
        if visible.any():
            # One number for all nodes, for arrays without gaps. The longest 2 % of the segments are
            # those at the edge of a wide image: they would double the positions of all. Three more
            # positions: n steps have n + 1, and a peak at either end needs a neighbour beyond.
            number_here = int(np.ceil(np.percentile(number[visible], 98))) + 3
            steps = max(steps, int(np.ceil(np.percentile((number / share)[visible], 98))) + 1)
            number_here = min(number_here, settings.max_steps)
            searches.append(PairSearch(other, pyramid, segment, window, visible, number_here))
    return searches, min(steps, settings.max_steps)


def _correlate_at(
    common: Float[np.ndarray, "n k"],
    pair: tuple[OrientedImage, OrientedImage],
    pyramids: tuple[Pyramid, Pyramid],
    uv: Places,
    segment: Segments,
    window: Windows,
    visible: Bool[np.ndarray, " n"],
    *,
    level: int,
    steps: int,
    half_window: int,
) -> Float[np.ndarray, "n k"]:
    """ρ at common parameters, interpolated along each segment."""
    rho, _ = correlate(
        pair, pyramids, uv, segment, window, level=level, half_window=half_window, steps=steps
    )
    step_length = 2.0**level * np.linalg.norm(window.other_axis, axis=1)[:, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        index = (segment.length_at(common) - segment.length[:, None] / 2) / step_length + (
            steps - 1
        ) / 2
        is_inside = (index >= 0) & (index <= steps - 1) & visible[:, None]
        is_inside &= (common >= segment.q[:, :1]) & (common <= segment.q[:, 1:])
        low = np.clip(np.nan_to_num(index).astype(int), 0, steps - 2)
        part = index - low
        a, b = (np.take_along_axis(rho, low + k, axis=1) for k in (0, 1))
        return np.where(is_inside, a + part * (b - a), np.nan)


def _search_near(
    base: OrientedImage,
    others: Sequence[OrientedImage],
    pyramids: ImagePyramids,
    uv: Places,
    bounds: Float[np.ndarray, "n 2"],
    level: int,
    guide: Guide,
    settings: GuideSettings,
) -> NodeMatches:
    """Positions around the coarser guide at the nodes."""
    margin = settings.search_margin * 2.0 ** (level + 1)
    q0, q, normal, rate = guide.look_up(uv, margin)
    q = np.clip(q, bounds[:, :1], bounds[:, 1:])
    q_found, rho, _ = search(base, others, pyramids, uv, q, normal, level, settings)
    is_lost = ~np.isfinite(q_found)
    return NodeMatches(np.where(is_lost, q0, q_found), rate, np.where(is_lost, np.nan, rho))


def search(
    base: OrientedImage,
    others: Sequence[OrientedImage],
    pyramids: ImagePyramids,
    uv: Places,
    q: Float[np.ndarray, "n 2"],
    normal: Float[np.ndarray, "n 3"] | None,
    level: int,
    settings: GuideSettings,
) -> Float[np.ndarray, "3 n"]:
    """The best position of each point between its bounds, in all images: q, ρ, and the largest ρ
    more than two positions away. Points with segments of similar length are processed together."""
    middle = base.points(uv, q.mean(1))
    window = [windows(base, other, middle, normal) for other in others]
    segment = [segments(base, other, uv, q) for other in others]
    number = np.stack(
        [
            np.where(w.usable & np.isfinite(s.length), s.length, 0)
            / (2.0**level * np.maximum(np.linalg.norm(w.other_axis, axis=1), 1e-9))
            for s, w in zip(segment, window)
        ]
    ).max(0)
    number = np.nan_to_num(number)
    # Powers of two: at most twice the positions that a point needs, in few groups.
    bucket = np.clip(2 ** np.ceil(np.log2(number + 3)), 8, settings.max_steps).astype(int)
    out = np.full((3, len(uv)), np.nan)
    for steps in np.unique(bucket):
        rows = np.flatnonzero(bucket == steps)
        common = q[rows, :1] + np.linspace(0, 1, steps) * (q[rows, 1:] - q[rows, :1])
        curves = []
        for k, other in enumerate(others):
            both_pyramids = pyramids[0], pyramids[1][k]
            s, w = _take(segment[k], rows), _take(window[k], rows)
            curves.append(
                _correlate_at(
                    common,
                    (base, other),
                    both_pyramids,
                    uv[rows],
                    s,
                    w,
                    w.usable,
                    level=level,
                    steps=int(steps),
                    half_window=settings.half_window,
                )
            )
        peak, best, second_peak = find_peaks(combine(curves))
        out[0, rows] = common[:, 0] + best / (steps - 1) * (common[:, -1] - common[:, 0])
        out[1, rows], out[2, rows] = peak, second_peak
    return out


def _take(record: ArrayRecord, rows: Int[np.ndarray, " k"]) -> ArrayRecord:
    """The rows of a record of arrays."""
    fields = {f.name: getattr(record, f.name)[rows] for f in dataclasses.fields(record)}
    return type(record)(**fields)


def _smooth(
    base: OrientedImage,
    level: int,
    uv: Places,
    shape: tuple[int, int],
    matches: NodeMatches,
    settings: GuideSettings,
) -> Guide:
    """A guide from matches: poor or isolated nodes follow their neighbours."""
    step = settings.spacing * 2.0**level
    q, rate, rho = (np.asarray(a, float).reshape(shape) for a in matches)
    is_known = np.isfinite(q) & (rho > settings.min_correlation)
    rate = np.where((rate > 0) & np.isfinite(rate), rate, np.nan)
    rate = np.where(np.isfinite(rate), rate, np.nanmedian(rate))
    middle = _median(np.where(is_known, q, np.nan))
    with np.errstate(invalid="ignore"):
        is_known &= np.abs(q - middle) * rate <= settings.max_deviation * 2.0**level
    filled = np.where(is_known, q, middle)
    filled = _fill_from_nearest(filled, q)
    X = base.points(uv, filled.ravel()).reshape(*shape, 3)
    return Guide(
        step,
        float(uv[0, 0]),
        filled,
        rate,
        np.nan_to_num(rho, nan=-1.0),
        _normals(base, uv, X, filled, rate, settings.max_slope * step),
        is_known,
    )


def _median(q: Nodes) -> Nodes:
    """Median of the known ones of the 3 × 3 nodes around each; NaN: fewer than 3, of which a wrong
    one may be the median."""
    padded = np.pad(q, 1, constant_values=np.nan)
    nine = np.lib.stride_tricks.sliding_window_view(padded, (3, 3)).reshape(*q.shape, 9)
    has_enough = np.isfinite(nine).sum(-1) >= 3
    safe = np.where(has_enough[..., None], nine, 0.0)
    return np.where(has_enough, np.nanmedian(safe, axis=-1), np.nan)


def _fill_from_nearest(q: Nodes, fallback: Nodes) -> Nodes:
    """Unknown nodes filled with the nearest known node."""
    is_known = np.isfinite(q)
    if not is_known.any():
        return np.where(np.isfinite(fallback), fallback, np.nanmedian(fallback))
    if is_known.all():
        return q
    nearest = ndimage.distance_transform_edt(~is_known, return_distances=False, return_indices=True)
    return q[tuple(nearest)]


def _normals(
    base: OrientedImage,
    uv: Places,
    X: Float[np.ndarray, "r c 3"],
    q: Nodes,
    rate: Nodes,
    max_change: float,
) -> Float[np.ndarray, "r c 3"]:
    """Normals of the planes through neighbouring nodes; across the line of sight if these are not
    on a plane: positions that change by more than `max_change` pixels."""
    du, dv = (_difference(X, axis) for axis in (1, 0))
    normal = np.cross(du, dv)
    # The nodes on both sides of a change are at an edge.
    bent = np.zeros(q.shape, bool)
    for axis in (0, 1):
        change = np.abs(np.diff(q, axis=axis)) * (rate[1:] if axis == 0 else rate[:, 1:])
        is_bent = change > max_change
        width = [(0, 0), (0, 0)]
        width[axis] = (1, 0)
        bent |= np.pad(is_bent, width)
        width[axis] = (0, 1)
        bent |= np.pad(is_bent, width)
    # The line of sight, to a point one pixel of the other image nearer (q itself may be 0: a
    # height).
    d = X - base.points(uv, (q + 1 / rate).ravel()).reshape(X.shape)
    bent |= ~(np.linalg.norm(normal, axis=-1) > 0)
    normals = np.where(bent[..., None], d, normal)
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def _difference(X: Float[np.ndarray, "r c 3"], axis: int) -> Float[np.ndarray, "r c 3"]:
    """Between the nodes on both sides."""
    a = np.moveaxis(X, axis, 0)
    inner = np.concatenate([a[1:2] - a[:1], a[2:] - a[:-2], a[-1:] - a[-2:-1]])
    return np.moveaxis(inner, 0, axis)
