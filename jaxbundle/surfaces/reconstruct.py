"""From oriented images to a cloud: pairs, guides, points, matches, base image by base image."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.surfaces.bounds import Bounds, bounds_from_geometry, bounds_from_points
from jaxbundle.surfaces.cloud import Cloud, empty_cloud, merge
from jaxbundle.surfaces.correlation import Pyramid, make_pyramid
from jaxbundle.surfaces.dense import DenseSettings
from jaxbundle.surfaces.dense_cloud import dense_cloud
from jaxbundle.surfaces.dense_ground import dense_ground_cloud
from jaxbundle.surfaces.guide import (
    Guide,
    GuideSettings,
    ImagePyramids,
    coarsest_level,
    make_guide,
)
from jaxbundle.surfaces.interest import interest_points, sample_percentiles, to_eight_bits
from jaxbundle.surfaces.matching import MatchingSettings, match_points
from jaxbundle.surfaces.orientation import is_uncertain
from jaxbundle.surfaces.pairs import choose_partners
from jaxbundle.surfaces.scanner_views import RpcView
from jaxbundle.surfaces.segments import segments, visible_range
from jaxbundle.surfaces.views import FrameView, OrientedImage, Places
from jaxbundle.types import Progress


@dataclasses.dataclass(frozen=True)
class SurfaceSettings:
    """The stages of a surface."""

    guide: GuideSettings = GuideSettings()
    matching: MatchingSettings = MatchingSettings()
    dense: DenseSettings = DenseSettings()
    points: int = 40_000
    """Points of a base image by default. Time and memory grow with it; σ of the points does not
    depend on it."""
    max_pyramids: int = 6
    """Maximum pyramids in memory, each of a third of the pixels of its image more, in 4 bytes:
    those of a base image with its three partners, and two that the next may share. With fewer,
    pyramids are made again."""

    def window(self, dense: bool) -> int:
        """Side of the windows of matching, pixels: of dense matching the smallest, which pixels of
        good texture take."""
        refinement = self.dense.refinement
        half = min(refinement.half_windows) if dense else self.matching.half_fine_window
        return 2 * half + 1


@dataclasses.dataclass(frozen=True)
class SurfaceResult:
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
    all_bounds, messages = [], []
    low, high = heights or (None, None)
    guessed = []
    for view in views:
        others = [o for o in views if o is not view]
        # A view between the heights is not bounded by them.
        is_between = heights is not None and low <= view.X0[2] <= high
        q = bounds_from_points(view, tie) if len(tie) and (heights is None or is_between) else None
        if q is None:
            usual_bounds = bounds_from_geometry(view, others)
            if usual_bounds is None:
                raise InputError(
                    f"{view.name}: all images are at one position: a surface needs a base"
                )
            # Given heights are searched at any distance: q of the geometry says only the order.
            is_bounded = heights is not None and not is_between
            q = (1e-2 * usual_bounds[0], 1e2 * usual_bounds[1]) if is_bounded else usual_bounds
            if not is_bounded:
                guessed.append((view.name, q))
        all_bounds.append(Bounds(view, q, low, high))
    if guessed:
        name, q = guessed[0]
        messages.append(
            f"no tie points in {len(guessed)} image(s): distances from {1 / q[1]:.4g} to "
            f"{1 / q[0]:.4g} are searched ({name})"
            + ("; give --zmin and --zmax" if heights is None else ", the heights are all around it")
        )
    return tuple(all_bounds), tuple(messages)


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
            # Millimetres, and not −1e-9 for 0.
            f"heights from {round(heights[0], 3) + 0.0:.6g} to {round(heights[1], 3) + 0.0:.6g} "
            "are searched, the range of the "
            "coefficients; give --zmin and --zmax",
        )
    return tuple(Bounds(view, heights) for view in views), messages


class _Pyramids:
    """Pyramids of the images, the last few kept in memory."""

    def __init__(self, views: Sequence[OrientedImage], levels: int, number: int) -> None:
        self.views, self.levels, self.number = views, levels, number
        self.cache: dict[int, Pyramid] = {}

    def __getitem__(self, k: int) -> Pyramid:
        # A dictionary keeps the order of insertion: the first is the one not used for longest.
        pyramid = self.cache.pop(k, None)
        if pyramid is None:
            while len(self.cache) >= self.number:
                self.cache.pop(next(iter(self.cache)))
            pyramid = make_pyramid(self.views[k].grey, self.levels)
        self.cache[k] = pyramid
        return pyramid

    def select(self, base: int, others: Sequence[int]) -> ImagePyramids:
        """Those of a base image and others."""
        return self[base], [self[k] for k in others]


def reconstruct_surface(
    views: Sequence[OrientedImage],
    bounds: Sequence[Bounds],
    partners: Mapping[int, Sequence[int]] | None = None,
    *,
    points: str = "grid",
    step: int | None = None,
    dense: bool = False,
    settings: SurfaceSettings = SurfaceSettings(),
    progress: Progress | None = None,
) -> SurfaceResult:
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
    # Every pixel of a photograph is searched between the bounds, without a guide, if their range is
    # not too wide.
    beforehand = {
        i: others
        for i, others in partners.items()
        if not (dense and isinstance(views[i], FrameView))
    }
    guides = _Guides(views, bounds, partners, dense, settings)
    for done, i in enumerate(beforehand):
        tell("depths", done, len(beforehand))
        guides[i]
    if beforehand:
        tell("depths", len(beforehand), len(beforehand))
    # Pixels between the points of a dense cloud, so that those of all base images fit into memory.
    pixels = sum(views[i].size[0] * views[i].size[1] for i in partners)
    every_nth = step or max(1, int(np.ceil(np.sqrt(pixels / settings.dense.max_points))))
    thinned = f"one of {every_nth} pixels in both directions, to limit memory; --step 1 takes all"
    messages = [thinned] if dense and not step and every_nth > 1 else []
    clouds, counts_of_images = [], []
    for done, (i, others) in enumerate(partners.items()):
        tell("matching", done, len(partners))
        base, used_views = views[i], [views[j] for j in others]
        counts = {"points": 0, "matched": 0, "variance_factor": None, "rejected": {}}
        if dense:
            find_guide = partial(guides.__getitem__, i)
            cloud, counts, pair_messages = _match_every_pixel(
                base, used_views, find_guide, bounds[i], every_nth, settings.dense
            )
            clouds.append(cloud)
            messages += pair_messages
        elif (guide := guides[i]) is not None:
            others_guides = [guides[j] for j in others]
            group = guides.pyramids.select(i, others)
            cloud, counts = _match_interest_points(
                base, used_views, group, guide, others_guides, points, step, settings
            )
            clouds.append(cloud)
        counts_of_images.append(
            {"image": base.name, "with": [view.name for view in used_views], **counts}
        )
    tell("matching", len(partners), len(partners))
    if not any(len(c) for c in clouds):
        raise NotSolvedError(
            "no point was matched: the photographs have too little common texture, or the "
            "orientation or the bounds of the heights are wrong"
        )
    uncertain = any(is_uncertain(views[j]) for i, others in partners.items() for j in (i, *others))
    return SurfaceResult(merge(clouds), tuple(counts_of_images), tuple(messages), uncertain)


def _match_interest_points(
    base: OrientedImage,
    others: Sequence[OrientedImage],
    pyramids: ImagePyramids,
    guide: Guide,
    guides: Sequence[Guide | None],
    points: str,
    step: int | None,
    settings: SurfaceSettings,
) -> tuple[Cloud, dict[str, Any]]:
    """The cloud of some pixels of an image, and its counts."""
    columns, rows = base.size
    spacing = step or max(2, int(np.ceil(np.sqrt(columns * rows / settings.points))))
    uv = interest_points(base.grey, points, spacing)
    matched = match_points(
        base, others, pyramids, guide, uv, guides, settings.guide, settings.matching
    )
    n = len(matched.X)
    cloud = Cloud(
        matched.X,
        matched.covariance,
        matched.rays,
        np.zeros(n, int),
        matched.uv,
        (base.name,),
        _colour(base, matched.uv),
        shared=matched.shared,
    )
    return cloud, {
        "points": len(uv),
        "matched": n,
        "variance_factor": matched.factor,
        "rejected": matched.rejected,
    }


def _match_every_pixel(
    base: OrientedImage,
    others: Sequence[OrientedImage],
    find_guide: Callable[[], Guide | None],
    bounds: Bounds,
    step: int,
    settings: DenseSettings,
) -> tuple[Cloud, dict[str, Any], list[str]]:
    """The cloud of most pixels of an image, its counts, messages on images left out.

    **Arguments:** `find_guide()`: the guide of the image, made when it is needed."""
    if isinstance(base, FrameView):
        photographs = [view for view in others if isinstance(view, FrameView)]
        cloud, used_images, left_out = dense_cloud(
            base, photographs, find_guide, bounds, step, settings
        )
    elif (guide := find_guide()) is not None:
        cloud, used_images, left_out = dense_ground_cloud(
            base, others, guide, bounds, step, settings
        )
    else:
        cloud, used_images, left_out = empty_cloud(base.name), [], []
    cloud = dataclasses.replace(cloud, colour=_colour(base, cloud.uv))
    columns, rows = base.size
    number = -(-columns // step) * -(-rows // step)
    factor = float(np.mean([f for _, f in used_images])) if used_images else None
    reason = "no disparity, or not confirmed by least squares"
    if len(used_images) > 1:
        reason += ", or pairs disagree"
    return (
        cloud,
        {
            "points": number,
            "matched": len(cloud),
            "variance_factor": factor,
            "rejected": {reason: number - len(cloud)},
        },
        [f"{base.name} with {name}: cannot be rectified, left out" for name in left_out],
    )


class _Guides:
    """Guides of base images and of their partners, made when they are asked for; None without
    overlap. Dense matching needs only those of the bases, coarser ones."""

    def __init__(
        self,
        views: Sequence[OrientedImage],
        bounds: Sequence[Bounds],
        partners: Mapping[int, Sequence[int]],
        dense: bool,
        settings: SurfaceSettings,
    ) -> None:
        self.views, self.bounds, self.settings = views, bounds, settings
        self.partners = {i: list(others) for i, others in partners.items()}
        for i, others in partners.items():
            for j in others:
                if j not in partners:
                    self.partners.setdefault(j, []).append(i)
        self.bases = partners
        nodes = settings.dense.max_guide_nodes if dense else settings.guide.max_nodes
        self.guide_settings = dataclasses.replace(settings.guide, max_nodes=nodes)
        self.made: dict[int, Guide | None] = {}

    @cached_property
    def pyramids(self) -> _Pyramids:
        """The pyramids of all images, of as many levels as any base image requires."""
        levels = max(
            _level(self.views, self.bounds, i, others, self.settings.guide)
            for i, others in self.bases.items()
        )
        return _Pyramids(self.views, levels, self.settings.max_pyramids)

    def __getitem__(self, i: int) -> Guide | None:
        if i not in self.made:
            others = self.partners[i]
            self.made[i] = make_guide(
                self.views[i],
                [self.views[j] for j in others],
                self.pyramids.select(i, others),
                self.bounds[i],
                self.guide_settings,
            )
        return self.made[i]


def _level(
    views: Sequence[OrientedImage],
    bounds: Sequence[Bounds],
    i: int,
    others: Sequence[int],
    settings: GuideSettings,
) -> int:
    """The coarsest level required for a base image."""
    # 5 × 5 lines of sight: lengths of segments change slowly over an image
    u, v = (np.linspace(0.1, 0.9, 5) * (n - 1) for n in views[i].size)
    uv = np.stack(np.meshgrid(u, v), -1).reshape(-1, 2)
    q = bounds[i](uv)
    lengths = [
        segments(views[i], views[j], uv, visible_range(views[i], views[j], uv, q)).length
        for j in others
    ]
    lengths_seen = np.concatenate(lengths)
    lengths_seen = lengths_seen[np.isfinite(lengths_seen)]
    return coarsest_level(
        views[i].size, float(np.max(lengths_seen)) if len(lengths_seen) else 0.0, settings
    )


def _colour(view: OrientedImage, uv: Places) -> UInt8[np.ndarray, "n 3"]:
    place = np.rint(uv).astype(int)
    if isinstance(view, FrameView) and view.colours is not None:
        return view.colours()[place[:, 1], place[:, 0]]
    grey = np.asarray(view.grey[place[:, 1], place[:, 0]])
    if grey.dtype != np.uint8:
        grey = to_eight_bits(grey, sample_percentiles(view.grey, 0.5, 99.5))
    return np.repeat(grey[:, None], 3, axis=1)
