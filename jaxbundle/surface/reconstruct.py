"""From oriented images to a cloud: pairs, guides, points, matches, base image by base image."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.surface.bounds import Bounds, bounds_from_geometry, bounds_from_points
from jaxbundle.surface.cloud import Cloud, merge
from jaxbundle.surface.correlation import Pyramid, make_pyramid
from jaxbundle.surface.dense_cloud import dense_cloud
from jaxbundle.surface.dense_ground import dense_ground_cloud
from jaxbundle.surface.ground import RpcView
from jaxbundle.surface.guide import MOST_NODES, Guide, coarsest_level, make_guide
from jaxbundle.surface.interest import interest_points
from jaxbundle.surface.matching import Matches, Settings, match_points
from jaxbundle.surface.orientation import is_uncertain
from jaxbundle.surface.pairs import choose_partners
from jaxbundle.surface.segments import segments, visible_range
from jaxbundle.surface.views import FrameView, OrientedImage
from jaxbundle.types import Progress

MOST_PYRAMIDS = 6
"""Maximum pyramids in memory."""
POINTS = 40_000
"""Points of a base image by default."""
DENSE_NODES = 25_000
"""Maximum nodes of the guides of dense matching, which only give the range of depths."""
MOST_POINTS = 16_000_000
"""Maximum points of a dense cloud by default; they take 2.5 GB."""
SAMPLED_PIXELS = 1 << 20
"""Number of pixels sampled for the darkest and the brightest."""


@dataclasses.dataclass(frozen=True)
class Surface:
    """A cloud, statistics of the points of each base image, and messages; `orientation`: whether
    the σ of the orientations are included in those of the points."""

    cloud: Cloud
    bases: tuple[Mapping[str, Any], ...]
    messages: tuple[str, ...]
    orientation: bool = False


def find_bounds(
    views: Sequence[FrameView],
    tie: Float[np.ndarray, "n 3"],
    heights: tuple[float, float] | None = None,
) -> tuple[tuple[Bounds, ...], tuple[str, ...]]:
    """The bounds of every image: heights, if given; tie points; else the geometry, with a
    message."""
    found, messages = [], []
    low, high = heights or (None, None)
    guessed = []
    for view in views:
        others = [o for o in views if o is not view]
        # a view between the heights is not bounded by them
        among = heights is not None and low <= view.X0[2] <= high
        q = bounds_from_points(view, tie) if len(tie) and (heights is None or among) else None
        if q is None:
            wide = bounds_from_geometry(view, others)
            if wide is None:
                raise InputError(
                    f"{view.name}: all images are at one position: a surface needs a base"
                )
            # given heights are searched at any distance
            q = wide if heights is None or among else (1e-2 * wide[0], 1e2 * wide[1])
            if heights is None or among:
                guessed.append((view.name, q))
        found.append(Bounds(view, q, low, high))
    if guessed:
        name, q = guessed[0]
        messages.append(
            f"no tie points in {len(guessed)} image(s): distances from {1 / q[1]:.4g} to "
            f"{1 / q[0]:.4g} are searched ({name})"
            + ("; give --zmin and --zmax" if heights is None else ", the heights are all around it")
        )
    return tuple(found), tuple(messages)


def ground_bounds(
    views: Sequence[OrientedImage], heights: tuple[float, float] | None
) -> tuple[tuple[Bounds, ...], tuple[str, ...]]:
    """The bounds of scanner and RPC images: heights, else the range of the polynomials.

    **Raises:** `InputError` for scanner images without heights."""
    messages: tuple[str, ...] = ()
    if heights is None:
        ranges = [view.range() for view in views if isinstance(view, RpcView)]
        if not ranges:
            raise InputError("line scanner images need --zmin and --zmax, heights of the surface")
        heights = max(low for low, _ in ranges), min(high for _, high in ranges)
        messages = (
            f"heights from {heights[0]:.6g} to {heights[1]:.6g} are searched, the range of the "
            "coefficients; give --zmin and --zmax",
        )
    return tuple(Bounds(view, heights) for view in views), messages


class _Pyramids:
    """Pyramids of the images, the last few kept in memory."""

    def __init__(self, views, levels):
        self.views, self.levels, self.kept = views, levels, {}

    def __getitem__(self, k) -> Pyramid:
        if k in self.kept:
            self.kept[k] = self.kept.pop(k)
        else:
            while len(self.kept) >= MOST_PYRAMIDS:
                self.kept.pop(next(iter(self.kept)))
            self.kept[k] = make_pyramid(self.views[k].grey, self.levels)
        return self.kept[k]


def reconstruct(
    views: Sequence[OrientedImage],
    bounds: Sequence[Bounds],
    partners: Mapping[int, Sequence[int]] | None = None,
    *,
    points: str = "grid",
    step: int | None = None,
    dense: bool = False,
    settings: Settings | None = None,
    progress: Progress | None = None,
) -> Surface:
    """The cloud of all base images.

    **Arguments:** `partners`: indices of the matching partners of each base, by default selected;
    `points`, `step`: see `interest_points`; `dense`: every pixel (or every `step`-th), by rectified
    pairs; `progress(stage, done, total)`.

    **Raises:** `NotSolvedError` if no images overlap, or nothing matches.
    """
    partners = dict(partners or choose_partners(views, bounds))
    if not partners:
        raise NotSolvedError(
            "no two images show the same part of the surface from different directions: check the "
            "orientation and its units, --zmin and --zmax"
        )
    tell = progress or (lambda *_: None)
    levels = max(_level(views, bounds[i], i, others) for i, others in partners.items())
    pyramids = _Pyramids(views, levels)
    guides = _guides(views, bounds, partners, pyramids, tell, dense)
    clouds, told, messages = [], [], []
    every = step or _dense_step(views[i] for i in partners)
    if dense and not step and every > 1:
        messages.append(
            f"every {every}th pixel in both directions, to limit memory; --step 1 takes all"
        )
    for done, (i, others) in enumerate(partners.items()):
        tell("matching", done, len(partners))
        row: dict[str, Any] = {"image": views[i].name, "with": [views[j].name for j in others]}
        if i not in guides:
            row |= {"points": 0, "matched": 0, "variance_factor": None, "rejected": {}}
        elif dense:
            cloud, counts, left_out = _dense(views, i, others, guides[i], bounds[i], every)
            clouds.append(cloud)
            row |= counts
            messages += [
                f"{views[i].name} with {name}: cannot be rectified, left out" for name in left_out
            ]
        else:
            uv = interest_points(views[i].grey, points, step or _step(views[i]))
            found = match_points(
                views[i],
                [views[j] for j in others],
                (pyramids[i], [pyramids[j] for j in others]),
                guides[i],
                uv,
                [guides.get(j) for j in others],
                settings or Settings(),
            )
            clouds.append(_cloud(views[i], found))
            row |= {
                "points": len(uv),
                "matched": len(found.X),
                "variance_factor": found.factor,
                "rejected": found.rejected,
            }
        told.append(row)
    tell("matching", len(partners), len(partners))
    if not any(len(c) for c in clouds):
        raise NotSolvedError(
            "no point was matched: the photographs have too little common texture, or the "
            "orientation or the bounds of the heights are wrong"
        )
    uncertain = any(is_uncertain(views[j]) for i, others in partners.items() for j in (i, *others))
    return Surface(merge(clouds), tuple(told), tuple(messages), uncertain)


def _dense(views, i, others, guide, bounds, step):
    """The cloud of most pixels of an image, its counts, images that cannot be rectified with it."""
    base = views[i]
    partners = [views[j] for j in others]
    if isinstance(base, FrameView):
        cloud, used, left_out = dense_cloud(base, partners, guide, bounds, step)
    else:
        cloud, used, left_out = dense_ground_cloud(base, partners, guide, bounds, step)
    cloud = dataclasses.replace(cloud, colour=_colour(base, cloud.uv))
    columns, rows = base.size
    number = -(-columns // step) * -(-rows // step)
    factor = float(np.mean([f for _, f in used])) if used else None
    reason = "no disparity, or not confirmed by least squares"
    if len(used) > 1:
        reason += ", or pairs disagree"
    return (
        cloud,
        {
            "points": number,
            "matched": len(cloud),
            "variance_factor": factor,
            "rejected": {reason: number - len(cloud)},
        },
        left_out,
    )


def _guides(views, bounds, partners, pyramids, tell, dense) -> dict[int, Guide]:
    """Guides of every base and its partners; dense matching needs only those of the
    bases, coarser ones."""
    with_whom = {i: list(others) for i, others in partners.items()}
    for i, others in partners.items():
        for j in others:
            if j not in partners and not dense:
                with_whom.setdefault(j, []).append(i)
    guides = {}
    for done, (i, others) in enumerate(with_whom.items()):
        tell("depths", done, len(with_whom))
        guide = make_guide(
            views[i],
            [views[j] for j in others],
            (pyramids[i], [pyramids[j] for j in others]),
            bounds[i],
            DENSE_NODES if dense else MOST_NODES,
        )
        if guide is not None:
            guides[i] = guide
    tell("depths", len(with_whom), len(with_whom))
    return guides


def _level(views, bounds, i, others):
    """The coarsest level required for a base image."""
    u, v = (np.linspace(0.1, 0.9, 5) * (n - 1) for n in views[i].size)
    uv = np.stack(np.meshgrid(u, v), -1).reshape(-1, 2)
    q = bounds(uv)
    lengths = [
        segments(views[i], views[j], uv, visible_range(views[i], views[j], uv, q)).length
        for j in others
    ]
    seen = np.concatenate(lengths)
    seen = seen[np.isfinite(seen)]
    return coarsest_level(views[i].size, float(np.max(seen)) if len(seen) else 0.0)


def _dense_step(bases):
    """Pixels between points, so that those of all base images fit into memory."""
    pixels = sum(view.size[0] * view.size[1] for view in bases)
    return max(1, int(np.ceil(np.sqrt(pixels / MOST_POINTS))))


def _step(view):
    columns, rows = view.size
    return max(2, int(np.ceil(np.sqrt(columns * rows / POINTS))))


def _cloud(view, found: Matches) -> Cloud:
    n = len(found.X)
    return Cloud(
        found.X,
        found.covariance,
        found.rays,
        np.zeros(n, int),
        found.uv,
        (view.name,),
        _colour(view, found.uv),
    )


def _colour(view, uv):
    place = np.rint(uv).astype(int)
    if isinstance(view, FrameView) and view.colours is not None:
        return view.colours()[place[:, 1], place[:, 0]]
    grey = np.asarray(view.grey[place[:, 1], place[:, 0]])
    if grey.dtype != np.uint8:
        every = max(1, view.grey.size // SAMPLED_PIXELS)
        low, high = np.percentile(view.grey.ravel()[::every], [0.5, 99.5])
        grey = np.clip((grey - low) * (255 / max(high - low, 1e-9)), 0, 255).astype(np.uint8)
    return np.repeat(grey[:, None], 3, axis=1)
