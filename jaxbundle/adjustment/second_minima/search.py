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

from jaxbundle.adjustment.far_points import concatenate_runs
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
from jaxbundle.geometry.principal_axes import principal_axes
from jaxbundle.leastsquares.indexing.reduction import FACTORS
from jaxbundle.leastsquares.indexing.rows import Values
from jaxbundle.leastsquares.iterations.solver import Minimum
from jaxbundle.leastsquares.iterations.stopping import LIMIT
from jaxbundle.leastsquares.quality.distributions import chi2_quantile
from jaxbundle.leastsquares.spaces import PoseValue
from jaxbundle.network.columns import count, list_some
from jaxbundle.network.noise import noise_of_rays
from jaxbundle.network.tables import UNIT
from jaxbundle.orientation import batched
from jaxbundle.orientation.incremental import START_VALUE_LIMITS, Model, grow, intersect
from jaxbundle.orientation.rays import MIN_COSINE, Sights, make_sights

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
    inspection: Inspection,
    minimum: Minimum,
    minimise: Minimise,
    settings: SecondMinimumSettings = SECOND_MINIMUM,
) -> tuple[NetworkProblem, Minimum, tuple[SecondMinimum, ...]]:
    """The best minimum of a solved problem, the given one unless another one fits better; and the
    second minima that the observations cannot distinguish from it, or that it has replaced."""
    superseded, problem = [], inspection.problem
    for round in range(settings.max_rounds + 1):
        state = _State(inspection, minimise, settings)
        other_minima = list(state.adjust_candidates())
        better_minima = [
            minimum_found for minimum_found in other_minima if state.is_better(minimum_found)
        ]
        if not better_minima or round == settings.max_rounds:
            break
        best = min(better_minima, key=lambda minimum_found: minimum_found.inspection.vtpv)
        superseded.append((best, inspection.vtpv))
        problem, inspection = best.problem, best.inspection
        minimum = concatenate_runs([minimum, best.minimum])
    records = [state.record_superseded(better, vtpv) for better, vtpv in superseded]
    reported = [
        dataclasses.replace(minimum_found, taken=is_reported(minimum_found, records))
        for minimum_found in map(state.record, other_minima)
        if minimum_found.ambiguous
    ]
    reported += [
        minimum_found for minimum_found in records if not is_reported(minimum_found, reported)
    ]
    if len(state.untried) and reported:
        ids = [str(problem.network.images.id[k]) for k in np.sort(state.untried)]
        words = f"the second minimum of {count(len(ids), 'further image')} was not adjusted"
        network = problem.network.note(f"{words}: {list_some(ids, 5, str)}")
        problem = dataclasses.replace(problem, network=network)
    return (
        problem,
        minimum,
        tuple(sorted(reported, key=lambda minimum_found: minimum_found.evidence)),
    )


def is_reported(second_minimum: SecondMinimum, known_minima: Iterable[SecondMinimum]) -> bool:
    """Whether all images of a second minimum are among those of others of its kind."""
    images = {
        id
        for known_minimum in known_minima
        if known_minimum.ambiguity == second_minimum.ambiguity
        for id in known_minimum.images
    }
    return images.issuperset(second_minimum.images)


class _State:
    """One minimum, and what is needed to look for others."""

    def __init__(self, inspection: Inspection, minimise: Minimise, settings: SecondMinimumSettings):
        self.first, self.problem, self.settings = inspection, inspection.problem, settings
        self.minimise = minimise
        self.scene, self.all_rays = scene_of(inspection.adjusted), rays_of(inspection.problem)
        self.rays = sample(self.all_rays, len(self.scene.X0), batched.SLOTS)
        free = lambda table: np.asarray(self.problem.table(table).free).max(1) > 0
        self.free, self.free_points = free("image"), free("point")
        network, counts = self.problem.network, self.problem.counts
        self.known = network.points.has_role("control", "fixed")
        self.stated = network.observations.sigma_origin != UNIT
        # vᵀPv of rounding: 1e-10 of the principal distance in every observation.
        self.rounding = counts.observations * (1e-10 / noise_of_rays(network)) ** 2
        vtpv, r = inspection.vtpv, max(counts.redundancy, 1)
        self.scale = max(vtpv / r, 1.0 if self.stated else self.rounding)
        self._poses = SecondPoses(
            problem=self.problem,
            scene=self.scene,
            rays=self.rays,
            all_rays=self.all_rays,
            squares=(inspection.image_residuals[self.problem.used] ** 2).sum(1),
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
        first_image = int(np.argmax(np.bincount(rays.image, minlength=images)))
        common = np.zeros(points, bool)
        common[rays.point[rays.image == first_image]] = True
        shared = np.bincount(rays.image, common[rays.point], images)
        shared[first_image] = 0
        partners = np.argsort(-shared, kind="stable")[: batched.LANES]
        partners = partners[shared[partners] >= 6]
        if not len(partners) or not self._is_plane(first_image, partners):
            return
        sighted = self._sights
        pairs = [_common_rays(sighted, first_image, int(k)) for k in partners]
        if any(len(xy1) < 6 for xy1, _ in pairs):
            return
        M, b, _, possible = batched.orient_planes(*zip(*pairs))
        relative = self.scene.M[partners] @ self.scene.M[first_image].T
        # The solution that is farther from the present one.
        turn = np.stack([angles(M[:, k] @ relative.transpose(0, 2, 1)) for k in (0, 1)], 1)
        base = self.scene.M[first_image] @ (self.scene.X0[partners] - self.scene.X0[first_image]).T
        shift = np.stack(
            [
                np.linalg.norm(b[:, k] - base.T / np.linalg.norm(base, axis=0)[:, None], axis=1)
                for k in (0, 1)
            ],
            1,
        )
        second_solution = np.argmax(turn + shift, axis=1)
        lane = np.arange(len(partners))
        if not possible[lane, second_solution].all():
            return
        best = int(np.argmax(np.linalg.norm(base, axis=0)))
        scene = self._grow(
            sighted,
            first_image,
            int(partners[best]),
            M[best, second_solution[best]],
            b[best, second_solution[best]],
        )
        if scene is not None:
            yield OtherSolution(OTHER_PLANE, np.arange(images), scene)

    def _is_plane(self, first_image: int, partners: Int[np.ndarray, " n"]) -> bool:
        """Whether the points of an image are so near to a plane that the second orientation of a
        plane may fit: by the parallax that `partners` see of points off it."""
        rays, scene = self.all_rays, self.scene
        seen_points = self.rays.point[self.rays.image == first_image]
        X = scene.X[seen_points]
        o = X.mean(0)
        normal = principal_axes(X - o)[1][2]
        sight = X - scene.X0[first_image]
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = ((o - scene.X0[first_image]) @ normal) / (sight @ normal)
        flat = scene.X.copy()
        flat[seen_points] = scene.X0[first_image] + distance[:, None] * sight
        of_point, of_image = np.zeros(len(scene.X), bool), np.zeros(len(scene.X0), bool)
        of_point[seen_points], of_image[partners] = True, True
        is_chosen = of_image[rays.image] & of_point[rays.point]
        image, point = rays.image[is_chosen], rays.point[is_chosen]
        direction, direction_to_plane = (unit(X[point] - scene.X0[image]) for X in (scene.X, flat))
        effect = np.nansum(
            (np.linalg.norm(direction - direction_to_plane, axis=1) / rays.sigma[is_chosen]) ** 2
        )
        share = self.settings.min_reversed_share / self.settings.safety
        return bool(
            np.isfinite(distance).all() and share * effect < self.settings.limit * self.scale
        )

    def _grow(
        self,
        sighted: Sights,
        first_image: int,
        second_image: int,
        M: Float[np.ndarray, "3 3"],
        b: Float[np.ndarray, "3"],
    ) -> NetworkScene | None:
        """All images and points from a pair of images, in the present frame."""
        model = Model.empty(sighted)
        model.place(first_image, np.zeros(3), np.eye(3))
        model.place(second_image, b, M)
        grow(sighted, model)
        intersect(sighted, model, START_VALUE_LIMITS)
        used_points = np.unique(self.all_rays.point)
        if not model.placed.all() or not model.known[used_points].all():
            return None
        is_held = self.known[used_points]
        rows = used_points[is_held] if is_held.sum() >= 3 else used_points
        similarity = batched.similarity(model.X[rows], self.scene.X[rows], np.ones(len(rows)))
        if similarity is None:
            return None
        model = model.transform(*similarity)
        X = np.where(np.isfinite(model.X) & ~self.known[:, None], model.X, self.scene.X)
        return NetworkScene(model.X0, model.M, X)

    @functools.cached_property
    def _sights(self) -> Sights:
        network = self.problem.network
        cameras = adjusted_cameras(self.problem, self.first.adjusted)
        return make_sights(network.replace(cameras=tuple(cameras.values())))

    # --- adjustment -------------------------------------------------------------------------

    def adjust_candidates(self) -> Iterator[Found]:
        """The candidates that lead to another minimum, each minimum once, unless its vᵀPv is above
        the present one by more than `limit` times the variance factor."""
        earlier_minima: list[Found] = []
        for candidate in self.candidates():
            other_minimum = self._adjust(candidate)
            if other_minimum is None or any(
                _are_same(other_minimum, earlier, self.rounding) for earlier in earlier_minima
            ):
                continue
            earlier_minima.append(other_minimum)
            yield other_minimum

    def _adjust(self, candidate: OtherSolution) -> Found | None:
        settings, limit = self.settings, self.settings.limit * self.scale
        start = self._values(candidate.scene)
        first_steps = settings.evaluations_before_rejection
        problem, minimum = self.minimise(self.problem, start, max_steps=first_steps)
        if int(minimum.termination) == LIMIT:
            # `not … <`: NaN is rejected, too.
            if not _cost(minimum) - self.first.vtpv < settings.early_limit * limit:
                return None
            runs = [minimum]
            while int(runs[-1].termination) == LIMIT and len(runs) <= settings.max_runs:
                problem, remaining = self.minimise(problem, runs[-1].values)
                runs.append(remaining)
                if not _cost(remaining) - self.first.vtpv < limit:
                    return None
            minimum = concatenate_runs(runs)
        if not _cost(minimum) - self.first.vtpv < limit:
            return None
        inspection = inspect_solution(problem, minimum)
        if inspection is None:
            return None
        other_scene = scene_of(inspection.adjusted)
        # Never a solution with its points behind the cameras.
        if self._behind(other_scene) > self._behind(self.scene) or not self._differs(other_scene):
            return None
        images = candidate.images
        turn = float(turns(self.scene, other_scene)[images].max())
        shift = float(np.linalg.norm(other_scene.X0 - self.scene.X0, axis=1)[images].max())
        return Found(candidate, problem, minimum, inspection, turn, shift)

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

    def _differs(self, other_scene: NetworkScene) -> bool:
        """Whether the pose of an image, or a point, differs significantly from the present one:
        outside of the ellipsoid of its covariance that holds all but the error probability."""
        scene, first = self.scene, self.first
        turn = rotation_vectors(other_scene.M @ scene.M.transpose(0, 2, 1))
        poses = np.concatenate([other_scene.X0 - scene.X0, turn], 1)
        if self._is_outside(poses, first.image_cofactors):
            return True
        located = self.free_points & ~self.problem.at_any_distance & ~self.problem.excluded
        return self._is_outside((other_scene.X - scene.X)[located], first.point_cofactors[located])

    def _is_outside(self, change: Float[np.ndarray, "n k"], Q: Float[np.ndarray, "n k k"]) -> bool:
        # Of unit size, whatever the units of coordinates and angles.
        size = np.sqrt(np.maximum(np.diagonal(Q, axis1=1, axis2=2), 0))
        inverse = np.where(size > 0, 1 / np.where(size > 0, size, 1), 0)
        change, Q = change * inverse, Q * inverse[:, :, None] * inverse[:, None, :]
        distance = np.einsum("ni,nij,nj->n", change, np.linalg.pinv(Q, 1e-12, True), change)
        limit = chi2_quantile(1 - self.settings.error_probability, change.shape[1])
        return bool((distance > limit * self.scale).any())

    def is_better(self, other_minimum: Found) -> bool:
        """Whether another minimum takes the place of the present one: it fits better, or as well
        with more points in front of the cameras."""
        difference = other_minimum.inspection.vtpv - self.first.vtpv
        if other_minimum.candidate.ambiguity == MIRRORED:
            fewer = self._behind(scene_of(other_minimum.inspection.adjusted)) < self._behind(
                self.scene
            )
            return fewer and difference < self.settings.threshold * self.scale
        return difference < -max(1e-9 * self.first.vtpv, self.rounding)

    def record(self, other_minimum: Found) -> SecondMinimum:
        """The other minimum as reported for the present one."""
        return self._record(
            other_minimum, self.first.vtpv, other_minimum.inspection.vtpv, taken=False
        )

    def record_superseded(self, other_minimum: Found, other_vtpv: float) -> SecondMinimum:
        """A minimum that the present one has replaced; `other_vtpv`: its vᵀPv."""
        return self._record(other_minimum, self.first.vtpv, other_vtpv, taken=True)

    def _record(
        self, other_minimum: Found, vtpv: float, other_vtpv: float, *, taken: bool
    ) -> SecondMinimum:
        """`taken`: whether the iterations ended in the other one first."""
        counts = self.problem.counts
        E = evidence(vtpv, other_vtpv, counts.redundancy, self.stated, self.rounding)
        ids = self.problem.network.images.id
        images = tuple(str(ids[k]) for k in other_minimum.candidate.images)
        mirrored = other_minimum.candidate.ambiguity == MIRRORED
        ambiguous = E < self.settings.threshold and not mirrored
        return SecondMinimum(
            other_minimum.candidate.ambiguity,
            images,
            vtpv,
            other_vtpv,
            E,
            ambiguous,
            taken,
            other_minimum.turn,
            other_minimum.shift,
        )


def _cost(minimum: Minimum) -> float:
    """vᵀPv where iterations ended."""
    steps = int(minimum.iterations)
    cost = np.asarray(minimum.history.cost)[:steps]
    is_accepted = np.asarray(minimum.history.accepted)[:steps]
    return float(2 * cost[is_accepted][-1]) if is_accepted.any() else np.inf


def _are_same(minimum_a: Found, minimum_b: Found, rounding: float) -> bool:
    """Whether two candidates led to one minimum; `rounding`: of vᵀPv."""
    scene_a, scene_b = (scene_of(f.inspection.adjusted) for f in (minimum_a, minimum_b))
    vtpv = minimum_a.inspection.vtpv
    # `<=`: minima that differ in points alone are not turned at all.
    is_near = abs(vtpv - minimum_b.inspection.vtpv) <= max(1e-6 * vtpv, rounding)
    return bool(
        is_near and turns(scene_a, scene_b).max() <= 0.01 * min(minimum_a.turn, minimum_b.turn)
    )


def _common_rays(
    sighted: Sights, first_image: int, second_image: int
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
    """x, y with c = 1 of the points that two images have in common."""
    rows_of_first, rows_of_second = (sighted.rows_of(k) for k in (first_image, second_image))
    _, a, b = np.intersect1d(
        sighted.point[rows_of_first], sighted.point[rows_of_second], return_indices=True
    )
    rays = sighted.ray[rows_of_first][a], sighted.ray[rows_of_second][b]
    front = (rays[0][:, 2] < -MIN_COSINE) & (rays[1][:, 2] < -MIN_COSINE)
    xy = tuple(ray[front, :2] / -ray[front, 2:] for ray in rays)
    return xy[0], xy[1]
