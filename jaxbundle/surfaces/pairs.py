"""Selection of images to match with each other: overlapping, from different directions; the extent
of their surface."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from jaxtyping import Float

from jaxbundle.errors import InputError
from jaxbundle.network.columns import did_you_mean
from jaxbundle.surfaces.bounds import Bounds, angle_at
from jaxbundle.surfaces.views import OrientedImage, Places, Points, is_inside


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
    # at three depths between the bounds
    uv = _sample(view)
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


def least_extent(
    views: Sequence[OrientedImage],
    bounds: Sequence[Bounds],
    partners: Mapping[int, Sequence[int]],
    to_map: Callable[[Points], Points] = lambda X: X,
) -> Float[np.ndarray, "2"]:
    """The extent of what base images and a partner see, in x and y of a map: at the lowest, the
    middle or the highest depth between the bounds, wherever it is smallest.

    **Arguments:** `to_map`: from the coordinates of the images."""
    extents = []
    for share in (0.0, 0.5, 1.0):
        seen = []
        for i, others in partners.items():
            uv = _sample(views[i])
            q = bounds[i](uv)
            X = views[i].points(uv, q[:, 0] + share * (q[:, 1] - q[:, 0]))
            is_seen = np.any([is_inside(views[j], views[j].project(X)) for j in others], axis=0)
            seen.append(X[is_seen & np.isfinite(X).all(1)])
        X = np.concatenate(seen) if seen else np.zeros((0, 3))
        extents.append(np.ptp(to_map(X)[:, :2], axis=0) if len(X) else np.zeros(2))
    return min(extents, key=np.prod)


def _sample(view: OrientedImage) -> Places:
    """9 × 9 pixels of an image."""
    u, v = (np.linspace(0.05, 0.95, 9) * (n - 1) for n in view.size)
    return np.stack(np.meshgrid(u, v), -1).reshape(-1, 2)


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
