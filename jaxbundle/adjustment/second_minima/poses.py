"""Second poses of single images, found by resection before anything is adjusted.

The pose with the object turned over, and for images with large residuals also the best one in
closed form, are improved by a resection on the adjusted points; by how much Σ(v/σ)² of the image
grows tells what is worth an adjustment.
"""

import dataclasses
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbundle.adjustment.problem import NetworkProblem
from jaxbundle.adjustment.second_minima.closed_forms import (
    ImageRays,
    NetworkScene,
    OtherSolution,
    perspective_effect,
    share_behind,
    turn_over,
    turns,
    unit,
)
from jaxbundle.adjustment.second_minima.evidence import (
    OTHER_POSE,
    TURNED,
    SecondMinimumSettings,
)
from jaxbundle.leastsquares.quality.distributions import chi2_quantile
from jaxbundle.orientation import batched
from jaxbundle.orientation.rays import Sights, in_plane

# Of an image: fewer leave its pose open.
MIN_POINTS = 3


@dataclasses.dataclass
class SecondPoses:
    """The search for second poses of the images of one minimum.

    **Fields:** `rays`: a sample of `all_rays`; `squares`: (v/σ)² of each of `all_rays`, x and y
    together; `free`: images that are not held; `scale`: the variance factor that differences are
    compared with; `stated`: whether σ are stated, not units of weight; `sights`: of the adjusted
    cameras, made when they are needed; `untried`: images that were not tried alone, since they are
    too many.
    """

    problem: NetworkProblem
    scene: NetworkScene
    rays: ImageRays
    all_rays: ImageRays
    squares: Float[np.ndarray, " rays"]
    free: Bool[np.ndarray, " images"]
    scale: float
    stated: bool
    settings: SecondMinimumSettings
    sights: Callable[[], Sights]
    untried: Int[np.ndarray, " n"] = dataclasses.field(default_factory=lambda: np.zeros(0, int))

    def candidates(self) -> Iterator[OtherSolution]:
        """The images that fit better in another pose, all at once and alone, and those that may be
        ambiguous; the points as they are."""
        settings, images = self.settings, len(self.scene.X0)
        turned = turn_over(self.scene, self.rays)
        effect = perspective_effect(self.scene, turned, self.rays)
        number = np.bincount(self.all_rays.image, minlength=images)
        # An image in the wrong minimum has large residuals, however many others fit.
        own_scale = np.bincount(self.all_rays.image, self.squares, images) / np.maximum(
            2 * number, 1
        )
        scale = np.maximum(self.scale, own_scale)
        share = settings.min_turning_share / settings.safety
        usable = self.free & (number >= MIN_POINTS)
        weak = (share * effect < settings.limit * scale) | (number <= settings.few_points)
        weak &= usable
        is_doubted = self._doubted(own_scale, number, weak) & usable
        if not (weak | is_doubted).any():
            return
        views = self._views(np.flatnonzero(weak | is_doubted))
        pose, change = self._improve(turned, views)
        # Where the second minimum nearly vanishes (see `min_turning_share`) an iteration may step
        # over to the first one, which shows in a pose more than halfway back, or wander off: then
        # the closed form is the better start.
        closed_change = np.full(images, np.inf)
        for view in views:
            closed_change[view.image] = self._change(view, turned)
        unimproved = turns(self.scene, pose) < 0.5 * turns(self.scene, turned)
        unimproved |= closed_change < change
        pose, change = (
            _choose(unimproved, turned, pose),
            np.where(unimproved, closed_change, change),
        )
        # A wrong minimum need not be that of the object turned over.
        views = [view for view in views if is_doubted[view.image]]
        best, by_best = self._improve(self._resect(turned, views), views)
        is_other = by_best < change
        pose, change = _choose(is_other, best, pose), np.where(is_other, by_best, change)
        # What is turned by less than a hundredth of the way is the present pose, found again.
        is_apart = turns(self.scene, pose) > 0.01 * turns(self.scene, turned)
        is_apart &= np.isfinite(change) & (share_behind(pose, self.rays) <= 0.5)
        # All that fit better at once; alone only those that may also be ambiguous.
        is_better = is_apart & (change < 0)
        if is_better.sum() > 1:
            name = OTHER_POSE if is_other[is_better].all() else TURNED
            yield OtherSolution(
                name, np.flatnonzero(is_better), _choose(is_better, pose, self.scene)
            )
            is_apart &= change > -settings.threshold * scale
        # Points and cameras are held in these resections: free ones reduce the difference.
        promising = np.flatnonzero(
            is_apart & (change < settings.safety * settings.threshold * scale)
        )
        promising = promising[np.argsort(change[promising])]
        self.untried = promising[settings.max_images :]
        for k in promising[: settings.max_images]:
            is_alone, name = np.arange(images) == k, OTHER_POSE if is_other[k] else TURNED
            yield OtherSolution(name, np.array([k]), _choose(is_alone, pose, self.scene))

    def _doubted(
        self,
        own_scale: Float[np.ndarray, " images"],
        number: Int[np.ndarray, " images"],
        weak: Bool[np.ndarray, " images"],
    ) -> Bool[np.ndarray, " images"]:
        """The images whose pose is also found in closed form: those of weak perspective with
        residuals that contradict their σ, and the few that fit worst of all, if badly; `own_scale`:
        mean squares of their residuals."""
        alpha, degrees = self.settings.error_probability, np.maximum(2 * number, 1)
        largest = np.array([chi2_quantile(1 - alpha, n) for n in degrees]) / degrees
        contradicted = weak & (own_scale > largest) & self.stated
        worst = np.argsort(-own_scale)[: self.settings.max_images]
        bad = own_scale > self.settings.max_misfit**2 * (1.0 if self.stated else self.scale)
        return contradicted | (bad & np.isin(np.arange(len(own_scale)), worst))

    def _views(self, images: Int[np.ndarray, " n"]) -> list["_View"]:
        """What images see, in cameras turned towards it."""
        sighted, problem = self.sights(), self.problem
        place = np.full(len(problem.network.observations), -1)
        place[np.flatnonzero(problem.used)] = np.arange(len(self.all_rays.image))
        views = []
        for k in images:
            part = np.arange(*sighted.rows_of(k).indices(len(sighted.image)))
            part = part[place[sighted.row[part]] >= 0]
            R, xy = in_plane(sighted.ray[part])
            is_finite = np.isfinite(xy).all(1)
            part = part[is_finite]
            weight = 1 / self.all_rays.sigma[place[sighted.row[part]]] ** 2
            X = self.scene.X[sighted.point[part]]
            views.append(
                _View(
                    int(k),
                    R,
                    xy[is_finite],
                    X,
                    sighted.ray[part],
                    weight,
                    float(sighted.tolerance[k]),
                )
            )
        return [view for view in views if len(view.xy) >= MIN_POINTS]

    def _improve(
        self, start: NetworkScene, views: list["_View"]
    ) -> tuple[NetworkScene, Float[np.ndarray, " images"]]:
        """Poses of images improved on the adjusted points, and by how much their Σ(v/σ)² is then
        above the present one; infinite without."""
        X0, M, change = start.X0.copy(), start.M.copy(), np.full(len(start.X0), np.inf)
        if not views:
            return start, change
        images = [view.image for view in views]
        poses = X0[images], np.stack([view.R @ M[view.image] for view in views])
        columns = zip(*((view.xy, view.X, view.weight) for view in views))
        for view, x, m in zip(views, *batched.refine(poses, *columns)):
            k = view.image
            X0[k], M[k] = x, view.R.T @ m
            change[k] = self._change(view, NetworkScene(X0, M, start.X))
        return NetworkScene(X0, M, start.X), np.where(np.isfinite(change), change, np.inf)

    def _change(self, view: "_View", other_scene: NetworkScene) -> float:
        """By how much Σ(v/σ)² of an image is above the present one in another pose."""
        k = view.image
        return view.square(other_scene.X0[k], other_scene.M[k]) - view.square(
            self.scene.X0[k], self.scene.M[k]
        )

    def _resect(self, start: NetworkScene, views: list["_View"]) -> NetworkScene:
        """The poses of images in closed form."""
        if not views:
            return start
        tolerance = np.array([view.tolerance for view in views])
        poses = batched.resect([view.xy for view in views], [view.X for view in views], tolerance)
        X0, M = start.X0.copy(), start.M.copy()
        for view, x, m, share in zip(views, *poses):
            if share > 0:
                X0[view.image], M[view.image] = x, view.R.T @ m
        return NetworkScene(X0, M, start.X)


class _View(NamedTuple):
    """What one image sees: x, y with c = 1 in the camera turned by R, the points, the rays in the
    image's own frame, weights of directions, the tolerance of start values."""

    image: int
    R: Float[np.ndarray, "3 3"]
    xy: Float[np.ndarray, "n 2"]
    X: Float[np.ndarray, "n 3"]
    ray: Float[np.ndarray, "n 3"]
    weight: Float[np.ndarray, " n"]
    tolerance: float

    def square(self, X0: Float[np.ndarray, "3"], M: Float[np.ndarray, "3 3"]) -> float:
        """Σ(v/σ)² of a pose."""
        difference = unit((self.X - X0) @ M.T) - self.ray
        return float((self.weight * (difference**2).sum(1)).sum())


def _choose(
    images: Bool[np.ndarray, " images"], scene_of_some: NetworkScene, scene_of_rest: NetworkScene
) -> NetworkScene:
    """The poses of `scene_of_some` for some images, of `scene_of_rest` for the rest, with its
    points."""
    X0 = np.where(images[:, None], scene_of_some.X0, scene_of_rest.X0)
    return NetworkScene(
        X0, np.where(images[:, None, None], scene_of_some.M, scene_of_rest.M), scene_of_rest.X
    )
