"""Selection of images to match with each other: overlapping, from different directions."""

from collections.abc import Sequence

import numpy as np

from jaxbundle.errors import InputError
from jaxbundle.network.columns import did_you_mean
from jaxbundle.surfaces.bounds import Bounds, angle_at
from jaxbundle.surfaces.views import OrientedImage, is_inside


def choose_partners(
    views: Sequence[OrientedImage], bounds: Sequence[Bounds], max_partners: int = 3
) -> dict[int, list[int]]:
    """For every image its matching partners, best first; may be empty."""
    partners = {}
    for i, view in enumerate(views):
        scores = [(score(view, bounds[i], o), j) for j, o in enumerate(views) if j != i]
        good = sorted((s for s in scores if s[0] > 0), reverse=True)[:max_partners]
        if good:
            partners[i] = [j for _, j in good]
    return partners


def score(view: OrientedImage, bounds: Bounds, other: OrientedImage) -> float:
    """Overlap times a weight of the angle of intersection, 0 to 1; 0: no pair."""
    # The weight grows up to 14°, a ratio of base and height of 1/4, and falls to 0 at 60°, where
    # windows are no longer alike; below 1° depths are hardly determined. Only these limits exclude
    # pairs: the weight gives their order.
    narrowest, best_angle, widest = np.radians([1.0, 14.0, 60.0])
    # 9 × 9 points of the base image at three depths between the bounds
    u, v = (np.linspace(0.05, 0.95, 9) * (n - 1) for n in view.size)
    uv = np.stack(np.meshgrid(u, v), -1).reshape(-1, 2)
    q = bounds(uv)
    best = 0.0
    for share in (0.25, 0.5, 0.75):
        X = view.points(uv, q[:, 0] + share * (q[:, 1] - q[:, 0]))
        is_seen = is_inside(other, other.project(X))
        # A tenth of the image is a pair not worth its time.
        if is_seen.mean() < 0.1:
            continue
        angle = float(np.median(angle_at((view, other), X[is_seen])))
        if narrowest <= angle <= widest:
            wide = (widest - angle) / (widest - 2 * best_angle)
            worth = min(angle / best_angle, 1.0) * min(1.0, wide)
            best = max(best, float(is_seen.mean()) * worth)
    return best


def parse_partners(pairs: Sequence[str], names: Sequence[str]) -> dict[int, list[int]]:
    """Pairs as texts BASE,OTHER[,OTHER…] of image names, as indices.

    **Raises:** `InputError`."""
    partners_of: dict[int, list[int]] = {}
    for text in pairs:
        parts = [part.strip() for part in text.split(",") if part.strip()]
        if len(parts) < 2:
            raise InputError(f"--pairs {text!r}: expected BASE,OTHER[,OTHER…], names of images")
        for part in parts:
            if part not in names:
                raise InputError(
                    f"--pairs {text!r}: no image {part!r}{did_you_mean(part, list(names))}"
                )
        base, *others = (list(names).index(part) for part in parts)
        if base in others:
            raise InputError(f"--pairs {text!r}: an image cannot be matched with itself")
        partners_of.setdefault(base, []).extend(
            j for j in others if j not in partners_of.get(base, [])
        )
    return partners_of
