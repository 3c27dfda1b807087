"""Tie points of scanner and RPC images by matching along epipolar curves.

At corners of a base image the best correlation along the curve in each other image is searched,
coarse to fine over the range of heights, then least squares matching gives the position; an error
of the orientation across the curves, up to some ten pixels, is found first (`relative`). Matches
are checked by uniqueness, convergence and ρ, and against their neighbours: the distance from the
curve is a linear function of the position (what is left of the orientation), and the height does
not leave that of the points around by far more than the others do. What remains are blunders that
only redundancy finds: `refine` with snooping.

**σ.** Half of the covariance of a match is that of each of its windows. Distances from the curves
have no other reason than these errors: their scatter multiplies the covariances of a pair.
"""

import dataclasses
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from jaxbundle.errors import NotSolvedError
from jaxbundle.results import TableMethods
from jaxbundle.surfaces.bounds import Bounds
from jaxbundle.surfaces.correlation import Pyramid, make_pyramid
from jaxbundle.surfaces.guide import GuideSettings, search
from jaxbundle.surfaces.interest import interest_points
from jaxbundle.surfaces.matching import MatchingSettings, is_confirmed
from jaxbundle.surfaces.pairs import score
from jaxbundle.surfaces.relative import align
from jaxbundle.surfaces.scanner_views import GroundView
from jaxbundle.surfaces.scatter import robust_sigma
from jaxbundle.surfaces.segments import positions, segments, visible_range, windows
from jaxbundle.surfaces.subpixel_matching import has_texture, refine
from jaxbundle.surfaces.views import Places, is_inside
from jaxbundle.types import Progress


@dataclasses.dataclass(frozen=True)
class TiePointSettings:
    """How tie points are chosen, matched and checked; pixels of the full images."""

    levels: int = 3
    """Levels of the pyramids: the search over all heights is in eighths of the image."""
    max_deviation: float = 3.5
    """Robust σ by which the distance from the epipolar curve may differ from a linear function of
    the position: of normal errors 0.05 % are lost."""
    max_height_deviation: float = 6.0
    """Robust σ by which a height may differ from the median of those of its neighbours. Wider than
    for errors: terrain and houses differ, too."""
    neighbours: int = 8
    """Points around for this median: the ring of a grid."""
    least_matches: int = 12
    """Fewest matches of a pair: fewer do not tell which of them are wrong."""
    guide: GuideSettings = GuideSettings()
    matching: MatchingSettings = MatchingSettings()


@dataclasses.dataclass(frozen=True)
class TiePoints(TableMethods):
    """Measurements of tie points: names of images; of each measurement the image, the number of
    the point, line and pixel, and their σ; `base`: by points the image whose corner it is;
    `rejected`: numbers of matches by reason; messages.

    A point is named after this image and its place there, T:IMAGE:LINE:PIXEL: tables of several
    calls can be joined, since the same name is the same point."""

    images: tuple[str, ...]
    image: Int[np.ndarray, " n"]
    point: Int[np.ndarray, " n"]
    xy: Float[np.ndarray, "n 2"]
    sigma: Float[np.ndarray, "n 2"]
    base: Int[np.ndarray, " points"]
    rejected: dict[str, int]
    messages: tuple[str, ...] = ()

    def table(self) -> dict[str, np.ndarray]:
        """Columns image, point, line, pixel, sline, spixel; one row a measurement."""
        names = np.array(self.images, object)
        columns = zip(("line", "pixel", "sline", "spixel"), (*self.xy.T, *self.sigma.T))
        points = np.array(self.names, object)[self.point]
        return {"image": names[self.image], "point": points, **dict(columns)}

    @property
    def names(self) -> list[str]:
        """The names of the points, by their numbers."""
        (of_base,) = np.nonzero(self.image == self.base[self.point])
        rows = of_base[np.argsort(self.point[of_base])]
        # Hundredths of a pixel: places of one image are farther apart.
        place = lambda k: ":".join(f"{v:.2f}".rstrip("0").rstrip(".") for v in self.xy[k])
        return [f"T:{self.images[self.image[k]]}:{place(k)}" for k in rows]

    def to_dict(self) -> dict:
        """Counts as plain numbers."""
        rays = np.bincount(np.bincount(self.point)) if len(self.point) else np.zeros(0, int)
        return {
            "points": int(self.point.max(initial=-1)) + 1,
            "measurements": len(self.point),
            "rays": {str(k): int(n) for k, n in enumerate(rays) if n},
            "median_sigma": float(np.median(self.sigma)) if len(self.sigma) else None,
            "rejected": dict(self.rejected),
            "warnings": list(self.messages),
        }

    def __str__(self) -> str:
        """Counts in lines."""
        figures = self.to_dict()
        rays = ", ".join(f"{n} with {k}" for k, n in figures["rays"].items())
        median = f"median σ {figures['median_sigma']:.3g} pixels"
        lines = [f"{figures['points']} tie points, by rays: {rays}; {median}"]
        lines += [f"    {n:8} matches: {reason}" for reason, n in self.rejected.items()]
        return "\n".join([*lines, *self.messages])


class _PairMatches(NamedTuple):
    """Places of points of a base in another image; which are good; σ there and in the base."""

    place: Places
    good: Bool[np.ndarray, " n"]
    sigma: Float[np.ndarray, "n 2"]
    in_base: Float[np.ndarray, "n 2"]


def match_tie_points(
    views: Sequence[GroundView],
    bounds: Sequence[Bounds],
    spacing: int,
    settings: TiePointSettings = TiePointSettings(),
    progress: Progress | None = None,
) -> TiePoints:
    """Tie points about `spacing` pixels apart, each in all images where it is found.

    **Raises:** `NotSolvedError` if no pair has enough matches.
    """
    pyramids = [make_pyramid(view.grey, settings.levels) for view in views]
    losses: Counter[str] = Counter()
    failed_pairs: list[tuple[int, int]] = []
    rows: list[tuple[np.ndarray, np.ndarray, Places, np.ndarray]] = []
    known_places: list[list[Places]] = [[] for _ in views]
    number, bases = 0, []
    for i, base in enumerate(views):
        uv = _new_corners(base, known_places[i], spacing, settings)
        partners = [j for j in range(len(views)) if j != i and score(base, bounds[i], views[j])]
        is_found = np.zeros((len(uv), len(views)), bool)
        place = np.zeros((len(uv), len(views), 2))
        sigma, in_base = np.zeros((2, len(uv), len(views), 2))
        for j in partners:
            pair = _match_pair(
                (base, views[j]), (pyramids[i], pyramids[j]), uv, bounds[i], settings, losses
            )
            if pair is None:
                # From the other side it is the same.
                if i < j:
                    failed_pairs.append((i, j))
                continue
            place[:, j], is_found[:, j], sigma[:, j], in_base[:, j] = pair
        number_of_partners = is_found.sum(1)
        tied_rows = np.flatnonzero(number_of_partners)
        is_found[tied_rows, i], place[tied_rows, i] = True, uv[tied_rows]
        # The base is measured once, at the corner: the mean variance of what its pairs say.
        mean = (in_base[tied_rows] ** 2).sum(1) / number_of_partners[tied_rows, None]
        sigma[tied_rows, i] = np.sqrt(mean)
        for j in range(len(views)):
            rows_of_partner = tied_rows[is_found[tied_rows, j]]
            point_numbers = number + np.searchsorted(tied_rows, rows_of_partner)
            rows.append(
                (
                    np.full(len(rows_of_partner), j),
                    point_numbers,
                    place[rows_of_partner, j],
                    sigma[rows_of_partner, j],
                )
            )
            known_places[j].append(place[rows_of_partner, j])
        number += len(tied_rows)
        bases.append(np.full(len(tied_rows), i))
        if progress:
            progress("tie points", i + 1, len(views))
    if not number:
        raise NotSolvedError(
            "no tie points: the images have too little common texture, or their orientations or "
            "the range of heights are wrong"
        )
    image, point, uv, s = (np.concatenate(columns) for columns in zip(*rows))
    names = tuple(view.name for view in views)
    messages = _describe_untied(names, failed_pairs, image, point)
    places, sigmas = uv[:, ::-1], s[:, ::-1]
    base_of = np.concatenate(bases)
    return TiePoints(names, image, point, places, sigmas, base_of, dict(losses), messages)


def _describe_untied(
    names: Sequence[str],
    failed_pairs: Sequence[tuple[int, int]],
    image: Int[np.ndarray, " n"],
    point: Int[np.ndarray, " n"],
) -> tuple[str, ...]:
    """Which pairs whose matching has failed share no point."""
    is_shown = np.zeros((int(point.max(initial=-1)) + 1, len(names)), bool)
    is_shown[point, image] = True
    # Corners near known points are not matched again: a pair may be tied by an earlier base alone.
    return tuple(
        f"{names[i]} and {names[j]}: too few matches"
        for i, j in failed_pairs
        if not (is_shown[:, i] & is_shown[:, j]).any()
    )


def _new_corners(
    base: GroundView, known_places: Sequence[Places], spacing: int, settings: TiePointSettings
) -> Places:
    """Corners of an image that are not near those it has."""
    uv = interest_points(base.grey, "corners", spacing)
    uv = uv[is_inside(base, uv, settings.matching.edge_margin)]
    all_known = np.concatenate([np.zeros((0, 2)), *known_places])
    if not len(all_known) or not len(uv):
        return uv
    return uv[cKDTree(all_known).query(uv)[0] > spacing / 2]


def _match_pair(
    pair: tuple[GroundView, GroundView],
    pyramids: tuple[Pyramid, Pyramid],
    uv: Places,
    bounds: Bounds,
    settings: TiePointSettings,
    losses: Counter[str],
) -> _PairMatches | None:
    """The matches of points of the first image in the second; None: too few."""
    base, other = pair
    shift_before = other.shift
    try:
        if len(uv) < settings.least_matches or align(base, other, pyramids, bounds) is None:
            return None
        q, rho, second_peak = _search_heights(pair, pyramids, uv, bounds, settings)
        is_found, limits = np.isfinite(q), settings.matching
        with np.errstate(invalid="ignore"):
            is_low = is_found & ~(rho >= limits.min_correlation)
            is_ambiguous = is_found & ~is_low & (second_peak > limits.max_second_ratio * rho)
        losses["low correlation"] += int(is_low.sum())
        losses["not unique"] += int(is_ambiguous.sum())
        q = np.where(is_found & ~is_low & ~is_ambiguous, q, np.nan)
        if np.isfinite(q).sum() < settings.least_matches:
            return None
        return _refine_pair(pair, uv, q, settings, losses)
    finally:
        # Another base has another error.
        other.shift = shift_before


def _search_heights(
    pair: tuple[GroundView, GroundView],
    pyramids: tuple[Pyramid, Pyramid],
    uv: Places,
    bounds: Bounds,
    settings: TiePointSettings,
) -> Float[np.ndarray, "3 n"]:
    """Heights of the best correlation, ρ, and ρ of the second best; NaN: none."""
    base, other = pair
    both_pyramids = pyramids[0], [pyramids[1]]
    whole_range = visible_range(base, other, uv, bounds(uv), settings.matching.edge_margin)
    out = np.full((3, len(uv)), np.nan)
    rows = np.flatnonzero(np.isfinite(whole_range).all(1) & (whole_range[:, 0] < whole_range[:, 1]))
    whole_range = whole_range[rows]
    # Heights per pixel of the curve; below a pixel the whole range is one step.
    pixels = np.maximum(segments(base, other, uv[rows], whole_range).length, 1.0)
    rate, q = (whole_range[:, 1] - whole_range[:, 0]) / pixels, whole_range
    for level in range(len(pyramids[0].levels) - 1, -1, -1):
        q_and_correlation = search(
            base, [other], both_pyramids, uv[rows], q, None, level, settings.guide
        )
        middle = np.where(np.isfinite(q_and_correlation[0]), q_and_correlation[0], q.mean(1))
        # What the search of this level may be off is searched in the next one.
        reach = settings.matching.search_margin * 2.0**level * rate
        q = np.clip(
            middle[:, None] + reach[:, None] * [-1, 1], whole_range[:, :1], whole_range[:, 1:]
        )
        out[:2, rows] = q_and_correlation[:2]
        if level == len(pyramids[0].levels) - 1:
            # Only the search of all heights tells whether there are two.
            out[2, rows] = q_and_correlation[2]
    return out


def _refine_pair(
    pair: tuple[GroundView, GroundView],
    uv: Places,
    q: Float[np.ndarray, " n"],
    settings: TiePointSettings,
    losses: Counter[str],
) -> _PairMatches | None:
    """Least squares matching at heights (NaN: none), and the checks against neighbours."""
    base, other = pair
    n, rows, limits = len(uv), np.flatnonzero(np.isfinite(q)), settings.matching
    uv, q = uv[rows], q[rows]
    window = windows(base, other, base.points(uv, q))
    start = positions(base, other, uv, q[:, None])[:, 0]
    half_window = limits.half_fine_window
    match = refine(base, other, uv, start, window.A, half_window, limits.windows)
    good = window.usable & is_confirmed(match, start, limits)
    good &= has_texture(base.grey, uv, match.sigma0, half_window, limits.windows.min_texture)
    losses["not confirmed by least squares matching"] += int((~good).sum())
    # Along the curve heights move a match, across it only errors do.
    axis_across = np.stack([-window.other_axis[:, 1], window.other_axis[:, 0]], 1)
    axis_across = axis_across / np.linalg.norm(axis_across, axis=1, keepdims=True)
    distance_from_curve = np.einsum("ni,ni->n", match.uv - start, axis_across)
    good, remainder = _near_the_curve(uv, distance_from_curve, good, settings)
    losses["far from the epipolar curve"] += int(np.isfinite(remainder).sum() - good.sum())
    is_near = _as_high_as_neighbours(uv, q, good, settings)
    losses["other height than its neighbours"] += int((good & ~is_near).sum())
    good &= is_near
    if good.sum() < settings.least_matches:
        return None
    C = match.covariance + limits.added_sigma**2 * np.eye(2)
    C = np.where(good[:, None, None], C, 0.0)
    predicted = np.sqrt(np.einsum("ni,nij,nj->n", axis_across, C, axis_across)[good])
    C = C * robust_sigma(remainder[good] / predicted) ** 2
    # A carries the base to the other image: errors there are A⁻¹ times as large in the base
    inverse_A = np.linalg.inv(np.where(good[:, None, None], match.A, np.eye(2)))
    in_base = inverse_A @ C @ np.swapaxes(inverse_A, 1, 2)
    out = _PairMatches(np.zeros((n, 2)), np.zeros(n, bool), np.zeros((n, 2)), np.zeros((n, 2)))
    out.place[rows], out.good[rows] = match.uv, good
    for target, values in ((out.sigma, C), (out.in_base, in_base)):
        target[rows] = np.sqrt(np.einsum("nii->ni", values) / 2)
    return out


def _near_the_curve(
    uv: Places,
    distance: Float[np.ndarray, " n"],
    good: Bool[np.ndarray, " n"],
    settings: TiePointSettings,
) -> tuple[Bool[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Which distances from the curve are those of a linear function of the position, and what is
    left of all that were good; NaN for others."""
    A = np.column_stack([np.ones(len(uv)), uv - uv.mean(0)])
    A[:, 1:] /= np.maximum(np.abs(A[:, 1:]).max(0), 1.0)
    is_kept, remainder = good.copy(), np.full(len(uv), np.nan)
    # The first fit has the blunders in it, the last ones have not.
    for _ in range(5):
        if is_kept.sum() < settings.least_matches:
            return np.zeros_like(good), remainder
        x = np.linalg.lstsq(A[is_kept], distance[is_kept], rcond=None)[0]
        remainder = np.where(good, distance - A @ x, np.nan)
        remainder -= np.median(remainder[is_kept])
        # At least a thousandth of a pixel: without noise the limit would be that of rounding.
        limit = settings.max_deviation * max(robust_sigma(remainder[is_kept]), 1e-3)
        with np.errstate(invalid="ignore"):
            is_kept = good & (np.abs(remainder) < limit)
    return is_kept, remainder


def _as_high_as_neighbours(
    uv: Places,
    q: Float[np.ndarray, " n"],
    good: Bool[np.ndarray, " n"],
    settings: TiePointSettings,
) -> Bool[np.ndarray, " n"]:
    """Which heights do not leave the median of their neighbours' by far more than others do."""
    rows, k = np.flatnonzero(good), settings.neighbours
    if len(rows) <= k:
        return good
    _, nearest = cKDTree(uv[rows]).query(uv[rows], k + 1)
    difference = q[rows] - np.median(q[rows][nearest[:, 1:]], axis=1)
    limit = settings.max_height_deviation * max(robust_sigma(difference), 1e-9)
    is_kept = good.copy()
    is_kept[rows] = np.abs(difference) < limit
    return is_kept
