"""After convergence: the second minima of a network, adjusted from their closed forms.

The candidates (`closed_forms`) are few, and most are excluded before anything is adjusted: by the
effect of perspective, which is of second order in the image coordinates and known without any
iteration, and those of single images by a resection on the adjusted points. The others are adjusted
from their own start values by the program of the first minimum.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxbundle.adjustment.far_points import concatenate_runs, noise_of_rays
from jaxbundle.adjustment.minimum import adjusted_cameras, inspect_solution
from jaxbundle.adjustment.problem import NetworkProblem, with_coordinates
from jaxbundle.adjustment.quality.inspection import Inspection
from jaxbundle.adjustment.second_minima.closed_forms import (
    NetworkScene,
    OtherSolution,
    angles,
    mirror,
    mirror_images,
    perspective_effect,
    rays_of,
    reverse_depth,
    rotation_vectors,
    sample,
    scene_of,
    share_behind,
    turns,
    unit,
)
from jaxbundle.adjustment.second_minima.evidence import (
    MIRRORED,
    OTHER_PLANE,
    REVERSED,
    SECOND_MINIMUM,
    SecondMinimum,
    SecondMinimumSettings,
    evidence,
)
from jaxbundle.adjustment.second_minima.poses import SecondPoses
from jaxbundle.cameras import get_model
from jaxbundle.leastsquares.indexing.reduction import FACTORS
from jaxbundle.leastsquares.indexing.rows import Values
from jaxbundle.leastsquares.iterations.solver import Minimum
from jaxbundle.leastsquares.iterations.stopping import LIMIT
from jaxbundle.leastsquares.quality.distributions import chi2_quantile
from jaxbundle.leastsquares.spaces import PoseValue
from jaxbundle.network.columns import count, list_some
from jaxbundle.network.tables import UNIT
from jaxbundle.orientation import batched
from jaxbundle.orientation.incremental import START_VALUE_LIMITS, Model, grow, intersect
from jaxbundle.orientation.rays import MIN_COSINE, Sights, sights

# `minimise(problem, start)` iterates from given values, `max_steps` at most if given; returns the
# problem as it ended.
Minimise = Callable[..., tuple[NetworkProblem, Minimum]]


class Found(NamedTuple):
    """A minimum that was adjusted from a candidate, and the largest differences of rotations
    (radians) and projection centres."""

    candidate: OtherSolution
    problem: NetworkProblem
    minimum: Minimum
    inspection: Inspection
    turn: float
    shift: float


def can_have_second(problem: NetworkProblem) -> bool:
    """Whether second minima are looked for: not in systems without a factor, and not where other
    tables (mountings of a rig, shifts of antennas) would have to change with the images."""
    return problem.reduction in FACTORS and not problem.further_tables


def find_second_minima(
    first: Inspection,
    minimum: Minimum,
    minimise: Minimise,
    settings: SecondMinimumSettings = SECOND_MINIMUM,
) -> tuple[NetworkProblem, Minimum, tuple[SecondMinimum, ...]]:
    """The best minimum of a solved problem, the given one unless another one fits better; and the
    second minima that the observations cannot distinguish from it, or that it has replaced."""
    superseded, problem = [], first.problem
    for round in range(settings.max_rounds + 1):
        state = _State(first, minimise, settings)
        found = list(state.adjust_candidates())
        better = [one for one in found if state.is_better(one)]
        if not better or round == settings.max_rounds:
            break
        best = min(better, key=lambda one: one.inspection.vtpv)
        superseded.append((best, first.vtpv))
        problem, first = best.problem, best.inspection
        minimum = concatenate_runs([minimum, best.minimum])
    records = [state.record_superseded(*one) for one in superseded]
    said = [
        dataclasses.replace(one, taken=is_said(one, records))
        for one in map(state.record, found)
        if one.ambiguous
    ]
    said += [one for one in records if not is_said(one, said)]
    if len(state.untried) and said:
        ids = [str(problem.network.images.id[k]) for k in np.sort(state.untried)]
        words = f"the second minimum of {count(len(ids), 'further image')} was not adjusted"
        network = problem.network.note(f"{words}: {list_some(ids, 5, str)}")
        problem = dataclasses.replace(problem, network=network)
    return problem, minimum, tuple(sorted(said, key=lambda one: one.evidence))


def is_said(one: SecondMinimum, others: Iterable[SecondMinimum]) -> bool:
    """Whether all images of a second minimum are among those of others of its kind."""
    images = {id for other in others if other.ambiguity == one.ambiguity for id in other.images}
    return images.issuperset(one.images)


class _State:
    """One minimum, and what is needed to look for others."""

    def __init__(self, first: Inspection, minimise: Minimise, settings: SecondMinimumSettings):
        self.first, self.problem, self.settings = first, first.problem, settings
        self.minimise = minimise
        self.scene, self.all_rays = scene_of(first.adjusted), rays_of(first.problem)
        self.rays = sample(self.all_rays, len(self.scene.X0), batched.SLOTS)
        free = lambda table: np.asarray(self.problem.table(table).free).max(1) > 0
        self.free, self.free_points = free("image"), free("point")
        network, counts = self.problem.network, self.problem.counts
        self.known = network.points.has_role("control", "fixed")
        self.stated = network.observations.sigma_origin != UNIT
        # vᵀPv of rounding: 1e-10 of the principal distance in every observation.
        self.rounding = counts.observations * (1e-10 / noise_of_rays(network)) ** 2
        vtpv, r = first.vtpv, max(counts.redundancy, 1)
        self.scale = max(vtpv / r, 1.0 if self.stated else self.rounding)
        self._poses = SecondPoses(
            problem=self.problem,
            scene=self.scene,
            rays=self.rays,
            all_rays=self.all_rays,
            squares=(first.image_residuals[self.problem.used] ** 2).sum(1),
            free=self.free,
            scale=self.scale,
            stated=self.stated,
            settings=settings,
            sights=lambda: self._sights,
        )

    @property
    def untried(self) -> Int[np.ndarray, " n"]:
        """Images whose second pose was not adjusted, since they are too many."""
        return self._poses.untried

    # --- candidates -------------------------------------------------------------------------

    def candidates(self) -> Iterator[OtherSolution]:
        """What is worth an adjustment."""
        yield from self._mirrored()
        yield from self._poses.candidates()
        if len(self.scene.X0) > 1 and self.problem.lengths is None and self.free.all():
            yield from self._reversed()
            yield from self._other_plane()

    def _mirrored(self) -> Iterator[OtherSolution]:
        network = self.problem.network
        plain = np.array([get_model(c.model).image == "perspective" for c in network.cameras])
        behind = (share_behind(self.scene, self.rays) > 0.5) & plain[network.images.camera]
        behind &= self.free
        if behind.all() and self.problem.lengths is None:
            yield OtherSolution(MIRRORED, np.flatnonzero(behind), mirror(self.scene, self.known))
        elif behind.any() and not behind.all():
            scene = mirror_images(self.scene, self.rays, behind)
            yield OtherSolution(MIRRORED, np.flatnonzero(behind), scene)

    def _reversed(self) -> Iterator[OtherSolution]:
        scene = reverse_depth(self.scene, self.rays, self.known)
        effect = perspective_effect(self.scene, scene, self.rays).sum()
        share = self.settings.min_reversed_share / self.settings.safety
        if share * effect < self.settings.limit * self.scale:
            yield OtherSolution(REVERSED, np.arange(len(scene.X0)), scene)

    def _other_plane(self) -> Iterator[OtherSolution]:
        """Of an image and those that see most of its points, the orientations with the other plane,
        if the plane is possible in all of them."""
        images, points = len(self.scene.X0), len(self.scene.X)
        rays = self.all_rays
        first = int(np.argmax(np.bincount(rays.image, minlength=images)))
        common = np.zeros(points, bool)
        common[rays.point[rays.image == first]] = True
        shared = np.bincount(rays.image, common[rays.point], images)
        shared[first] = 0
        partners = np.argsort(-shared, kind="stable")[: batched.LANES]
        partners = partners[shared[partners] >= 6]
        if not len(partners) or not self._is_plane(first, partners):
            return
        seen = self._sights
        pairs = [_common_rays(seen, first, int(k)) for k in partners]
        if any(len(xy1) < 6 for xy1, _ in pairs):
            return
        M, b, _, possible = batched.orient_planes(*zip(*pairs))
        relative = self.scene.M[partners] @ self.scene.M[first].T
        # The solution that is farther from the present one.
        turn = np.stack([angles(M[:, k] @ relative.transpose(0, 2, 1)) for k in (0, 1)], 1)
        base = self.scene.M[first] @ (self.scene.X0[partners] - self.scene.X0[first]).T
        across = np.stack(
            [
                np.linalg.norm(b[:, k] - base.T / np.linalg.norm(base, axis=0)[:, None], axis=1)
                for k in (0, 1)
            ],
            1,
        )
        other = np.argmax(turn + across, axis=1)
        lane = np.arange(len(partners))
        if not possible[lane, other].all():
            return
        best = int(np.argmax(np.linalg.norm(base, axis=0)))
        scene = self._grow(
            seen, first, int(partners[best]), M[best, other[best]], b[best, other[best]]
        )
        if scene is not None:
            yield OtherSolution(OTHER_PLANE, np.arange(images), scene)

    def _is_plane(self, first: int, partners: Int[np.ndarray, " n"]) -> bool:
        """Whether the points of an image are so near to a plane that the second orientation of a
        plane may fit: by the parallax that `partners` see of points off it."""
        rays, scene = self.all_rays, self.scene
        seen = self.rays.point[self.rays.image == first]
        X = scene.X[seen]
        o = X.mean(0)
        normal = np.linalg.svd(X - o)[2][2]
        sight = X - scene.X0[first]
        with np.errstate(divide="ignore", invalid="ignore"):
            along = ((o - scene.X0[first]) @ normal) / (sight @ normal)
        flat = scene.X.copy()
        flat[seen] = scene.X0[first] + along[:, None] * sight
        of_point, of_image = np.zeros(len(scene.X), bool), np.zeros(len(scene.X0), bool)
        of_point[seen], of_image[partners] = True, True
        chosen = of_image[rays.image] & of_point[rays.point]
        image, point = rays.image[chosen], rays.point[chosen]
        one, two = (unit(X[point] - scene.X0[image]) for X in (scene.X, flat))
        effect = np.nansum((np.linalg.norm(one - two, axis=1) / rays.sigma[chosen]) ** 2)
        share = self.settings.min_reversed_share / self.settings.safety
        return bool(np.isfinite(along).all() and share * effect < self.settings.limit * self.scale)

    def _grow(
        self,
        seen: Sights,
        first: int,
        second: int,
        M: Float[np.ndarray, "3 3"],
        b: Float[np.ndarray, "3"],
    ) -> NetworkScene | None:
        """All images and points from a pair of images, in the present frame."""
        model = Model.empty(seen)
        model.place(first, np.zeros(3), np.eye(3))
        model.place(second, b, M)
        grow(seen, model)
        intersect(seen, model, START_VALUE_LIMITS)
        used = np.unique(self.all_rays.point)
        if not model.placed.all() or not model.known[used].all():
            return None
        held = self.known[used]
        rows = used[held] if held.sum() >= 3 else used
        moved = batched.similarity(model.X[rows], self.scene.X[rows], np.ones(len(rows)))
        if moved is None:
            return None
        model = model.transform(*moved)
        X = np.where(np.isfinite(model.X) & ~self.known[:, None], model.X, self.scene.X)
        return NetworkScene(model.X0, model.M, X)

    @functools.cached_property
    def _sights(self) -> Sights:
        network = self.problem.network
        cameras = adjusted_cameras(self.problem, self.first.adjusted)
        return sights(network.replace(cameras=tuple(cameras.values())))

    # --- adjustment -------------------------------------------------------------------------

    def adjust_candidates(self) -> Iterator[Found]:
        """The candidates that lead to another minimum, each minimum once, unless its vᵀPv is above
        the present one by more than `limit` times the variance factor."""
        seen: list[Found] = []
        for candidate in self.candidates():
            found = self._adjust(candidate)
            if found is None or any(_are_same(found, other, self.rounding) for other in seen):
                continue
            seen.append(found)
            yield found

    def _adjust(self, candidate: OtherSolution) -> Found | None:
        settings, limit = self.settings, self.settings.limit * self.scale
        start = self._values(candidate.scene)
        few = settings.evaluations_before_rejection
        problem, minimum = self.minimise(self.problem, start, max_steps=few)
        if int(minimum.termination) == LIMIT:
            # `not … <`: NaN is rejected, too.
            if not _cost(minimum) - self.first.vtpv < settings.early_limit * limit:
                return None
            runs = [minimum]
            while int(runs[-1].termination) == LIMIT and len(runs) <= settings.max_runs:
                problem, rest = self.minimise(problem, runs[-1].values)
                runs.append(rest)
                if not _cost(rest) - self.first.vtpv < limit:
                    return None
            minimum = concatenate_runs(runs)
        if not _cost(minimum) - self.first.vtpv < limit:
            return None
        found = inspect_solution(problem, minimum)
        if found is None:
            return None
        there = scene_of(found.adjusted)
        # Never a solution with its points behind the cameras.
        if self._behind(there) > self._behind(self.scene) or not self._differs(there):
            return None
        images = candidate.images
        turn = float(turns(self.scene, there)[images].max())
        shift = float(np.linalg.norm(there.X0 - self.scene.X0, axis=1)[images].max())
        return Found(candidate, problem, minimum, found, turn, shift)

    def _behind(self, scene: NetworkScene) -> int:
        """Images with most of their points behind them."""
        return int(np.sum(share_behind(scene, self.rays) > 0.5))

    def _values(self, scene: NetworkScene) -> Values:
        values = dict(self.first.adjusted)
        free = self.free[:, None]
        position, rotation = (np.asarray(part) for part in values["image"])
        values["image"] = PoseValue(
            np.where(free, scene.X0, position),
            np.where(free, batched.quaternions(scene.M), rotation),
        )
        X = np.where(self.free_points[:, None], scene.X, self.scene.X)
        values["point"] = with_coordinates(values["point"], X)
        return values

    def _differs(self, there: NetworkScene) -> bool:
        """Whether the pose of an image, or a point, differs significantly from the present one:
        outside of the ellipsoid of its covariance that holds all but the error probability."""
        here, first = self.scene, self.first
        turn = rotation_vectors(there.M @ here.M.transpose(0, 2, 1))
        poses = np.concatenate([there.X0 - here.X0, turn], 1)
        if self._outside(poses, first.image_cofactors):
            return True
        located = self.free_points & ~self.problem.at_any_distance & ~self.problem.excluded
        return self._outside((there.X - here.X)[located], first.point_cofactors[located])

    def _outside(self, change: Float[np.ndarray, "n k"], Q: Float[np.ndarray, "n k k"]) -> bool:
        # Of unit size, whatever the units of coordinates and angles.
        size = np.sqrt(np.maximum(np.diagonal(Q, axis1=1, axis2=2), 0))
        inverse = np.where(size > 0, 1 / np.where(size > 0, size, 1), 0)
        change, Q = change * inverse, Q * inverse[:, :, None] * inverse[:, None, :]
        distance = np.einsum("ni,nij,nj->n", change, np.linalg.pinv(Q, 1e-12, True), change)
        limit = chi2_quantile(1 - self.settings.error_probability, change.shape[1])
        return bool((distance > limit * self.scale).any())

    def is_better(self, found: Found) -> bool:
        """Whether another minimum takes the place of the present one: it fits better, or as well
        with more points in front of the cameras."""
        difference = found.inspection.vtpv - self.first.vtpv
        if found.candidate.ambiguity == MIRRORED:
            fewer = self._behind(scene_of(found.inspection.adjusted)) < self._behind(self.scene)
            return fewer and difference < self.settings.threshold * self.scale
        return difference < -max(1e-9 * self.first.vtpv, self.rounding)

    def record(self, found: Found) -> SecondMinimum:
        """The other minimum as reported for the present one."""
        return self._record(found, self.first.vtpv, found.inspection.vtpv, taken=False)

    def record_superseded(self, found: Found, other: float) -> SecondMinimum:
        """A minimum that the present one has replaced; `other`: its vᵀPv."""
        return self._record(found, self.first.vtpv, other, taken=True)

    def _record(self, found: Found, vtpv: float, other: float, *, taken: bool) -> SecondMinimum:
        """`taken`: whether the iterations ended in the other one first."""
        counts = self.problem.counts
        E = evidence(vtpv, other, counts.redundancy, self.stated, self.rounding)
        ids = self.problem.network.images.id
        images = tuple(str(ids[k]) for k in found.candidate.images)
        mirrored = found.candidate.ambiguity == MIRRORED
        ambiguous = E < self.settings.threshold and not mirrored
        return SecondMinimum(
            found.candidate.ambiguity,
            images,
            vtpv,
            other,
            E,
            ambiguous,
            taken,
            found.turn,
            found.shift,
        )


def _cost(minimum: Minimum) -> float:
    """vᵀPv where iterations ended."""
    steps = int(minimum.iterations)
    cost = np.asarray(minimum.history.cost)[:steps]
    accepted = np.asarray(minimum.history.accepted)[:steps]
    return float(2 * cost[accepted][-1]) if accepted.any() else np.inf


def _are_same(found: Found, other: Found, rounding: float) -> bool:
    """Whether two candidates led to one minimum; `rounding`: of vᵀPv."""
    one, two = (scene_of(f.inspection.adjusted) for f in (found, other))
    vtpv = found.inspection.vtpv
    # `<=`: minima that differ in points alone are not turned at all.
    near = abs(vtpv - other.inspection.vtpv) <= max(1e-6 * vtpv, rounding)
    return bool(near and turns(one, two).max() <= 0.01 * min(found.turn, other.turn))


def _common_rays(
    seen: Sights, first: int, second: int
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
    """x, y with c = 1 of the points that two images have in common."""
    one, two = (seen.rows_of(k) for k in (first, second))
    _, a, b = np.intersect1d(seen.point[one], seen.point[two], return_indices=True)
    rays = seen.ray[one][a], seen.ray[two][b]
    front = (rays[0][:, 2] < -MIN_COSINE) & (rays[1][:, 2] < -MIN_COSINE)
    xy = tuple(ray[front, :2] / -ray[front, 2:] for ray in rays)
    return xy[0], xy[1]
