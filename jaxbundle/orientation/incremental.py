"""A model of images and points that grows: images from known points, points from placed images.

    known points ──resection──▶ images ──intersection──▶ more points ──▶ …

An image is resected from at least `min_points` known points, enough of which must agree; images
with the most known points come first. A point is intersected from at least two consistent rays with
an angle above `IntersectionLimits.min_angle`. All tests use the tolerance of start values; the
subsequent adjustment refines the result. The numbers are those of `StartValueSettings`.
"""

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbundle.network.tables import Points
from jaxbundle.orientation import batched
from jaxbundle.orientation.rays import Sights, in_plane
from jaxbundle.orientation.settings import DEFAULTS, StartValueSettings
from jaxbundle.orientation.status import Status
from jaxbundle.types import Index


@dataclasses.dataclass(frozen=True)
class IntersectionLimits:
    """Of an intersected point: its least angle of intersection (radians), and how far its rays may
    miss it, in tolerances."""

    min_angle: float
    max_miss: float


# A point known well enough for resection: an angle of 0.02 (1.1°) makes an error of a direction 50
# times as large along the ray, which an image from the side sees in full.
RESECTION_LIMITS = IntersectionLimits(0.02, 1.0)
# A point that needs a start value: the adjustment decides about it. Its rays may miss it by more
# than `gross_ratio`, so that one bad ray of two is excluded and named, not the point lost. At an
# angle of 1e-3 (0.06°) directions good to 1e-4 still give its distance to a seventh (√2·1e-4/1e-3).
START_VALUE_LIMITS = IntersectionLimits(1e-3, 4.0)


@dataclasses.dataclass
class Model:
    """Images and points of one frame; a point that is `control` is never intersected."""

    X0: Float[np.ndarray, "images 3"]
    M: Float[np.ndarray, "images 3 3"]
    placed: Bool[np.ndarray, " images"]
    X: Float[np.ndarray, "points 3"]
    known: Bool[np.ndarray, " points"]
    control: Bool[np.ndarray, " points"]

    @classmethod
    def empty(cls, sights: Sights) -> "Model":
        images, points = sights.images, sights.points
        return cls(
            np.full((images, 3), np.nan),
            np.full((images, 3, 3), np.nan),
            np.zeros(images, bool),
            np.full((points, 3), np.nan),
            np.zeros(points, bool),
            np.zeros(points, bool),
        )

    def place(
        self,
        image: Index | Bool[np.ndarray, " images"],
        X0: Float[np.ndarray, "*_ 3"],
        M: Float[np.ndarray, "*_ 3 3"],
    ) -> None:
        """An image, or several, with their poses."""
        self.X0[image], self.M[image], self.placed[image] = X0, M, True

    def copy_without(self, images: Bool[np.ndarray, " images"]) -> "Model":
        """A copy without these images, and with only the control points."""
        X = np.where(self.control[:, None], self.X, np.nan)
        return dataclasses.replace(
            self,
            X0=self.X0.copy(),
            M=self.M.copy(),
            placed=self.placed & ~images,
            X=X,
            known=self.known & self.control,
        )

    def transform(self, A: Float[np.ndarray, "3 3"], t: Float[np.ndarray, "3"]) -> "Model":
        """The model in the frame X' = A·X + t, A a rotation times a scale."""
        R = A / np.cbrt(np.linalg.det(A))
        return dataclasses.replace(self, X0=self.X0 @ A.T + t, M=self.M @ R.T, X=self.X @ A.T + t)


def are_controlled(points: Points) -> Bool[np.ndarray, " points"]:
    """Points whose three coordinates are known: fixed, or control with all axes."""
    return points.has_role("fixed") | (
        points.has_role("control") & ~np.isposinf(points.sigma).any(1)
    )


def are_held(
    points: Points, settings: StartValueSettings = DEFAULTS
) -> Bool[np.ndarray, " points"]:
    """Controlled points whose coordinates serve as start values: σ below the misfit allowed of
    control (`extent_to_misfit`). Less exact ones, such as those of handheld receivers, are
    intersected like tie points; with them the model is moved to control, but no ray contradicts
    them."""
    is_controlled = are_controlled(points)
    if is_controlled.sum() < 3:  # they have no extent to compare with
        return is_controlled
    extent = np.ptp(points.position[is_controlled], axis=0).max()
    sigma = np.where(points.has_role("fixed")[:, None], 0.0, np.nan_to_num(points.sigma))
    return is_controlled & (sigma.max(1) * settings.extent_to_misfit <= extent)


# Adjusts the images and points of a model among themselves, in place.
Improve = Callable[[Sights, Model], None]


def grow(
    sights: Sights,
    model: Model,
    candidates: Bool[np.ndarray, " images"] | None = None,
    improve: Improve | None = None,
    settings: StartValueSettings = DEFAULTS,
) -> None:
    """Orient as many images as possible, all or the `candidates`, and intersect their points.

    A growing model drifts: every image inherits the errors of the points it is resected from.
    `improve` is called whenever the model has grown by a factor (2.5), so that all calls together
    cost less than twice the last one."""
    candidates = np.ones(sights.images, bool) if candidates is None else candidates
    # Known points at the last try: an image is tried again only when it has more.
    last_counts = np.zeros(sights.images, int)
    next_improvement = max(
        settings.first_improvement, settings.improvement_growth * model.placed.sum()
    )
    intersect(sights, model, RESECTION_LIMITS)
    while True:
        known_counts = np.bincount(sights.image, model.known[sights.point], minlength=sights.images)
        is_waiting = (
            candidates
            & ~model.placed
            & (known_counts >= settings.min_points)
            & (known_counts > last_counts)
        )
        if not is_waiting.any():
            break
        # Several at a time, those with the most points first; on repeated structures the images
        # with few points are those most easily placed wrongly, and later they have more.
        max_count = known_counts[is_waiting].max()
        sufficient_count = min(
            max(settings.sufficient_points, settings.waiting_share * max_count), max_count
        )
        selected = np.flatnonzero(is_waiting & (known_counts >= sufficient_count))
        last_counts[selected] = known_counts[selected]
        if _place_images(sights, model, selected, settings):
            intersect(sights, model, RESECTION_LIMITS)
        if improve is not None and model.placed.sum() >= next_improvement:
            improve(sights, model)
            next_improvement = settings.improvement_growth * model.placed.sum()


def finish(sights: Sights, model: Model, settings: StartValueSettings = DEFAULTS) -> None:
    """Repeat everything, images from all their points and points from all their rays."""
    # Twice: the second time images are refined by points that already come from refined images.
    # More passes would approach what the adjustment computes anyway.
    for _ in range(2):
        intersect(sights, model, START_VALUE_LIMITS, repeat=True)
        _refine(sights, model, settings)
    intersect(sights, model, START_VALUE_LIMITS, repeat=True)


def place_far_points(sights: Sights, model: Model, settings: StartValueSettings = DEFAULTS) -> None:
    """Unknown points with at least three parallel rays: far away in their direction. Such rays
    hardly intersect, because of noise often behind the cameras.

    None if there are many: then the images have one common projection centre."""
    rows = np.flatnonzero(model.placed[sights.image] & ~model.known[sights.point])
    point, image = sights.point[rows], sights.image[rows]
    ray = np.einsum("nij,ni->nj", model.M[image], sights.ray[rows])
    direction = np.zeros((sights.points, 3))
    np.add.at(direction, point, ray)
    number = np.bincount(point, minlength=sights.points)
    direction /= np.where(number > 0, np.linalg.norm(direction, axis=1), 1.0)[:, None]
    max_sine = np.zeros(sights.points)
    np.fmax.at(max_sine, point, np.linalg.norm(np.cross(ray, direction[point]), axis=1))
    is_far = (number >= 3) & (max_sine < settings.parallel_angle) & ~model.control
    if not is_far.any() or 2 * is_far.sum() > model.known.sum():
        return
    centres = model.X0[model.placed]
    middle = centres.mean(0)
    rms_radius = np.sqrt(((centres - middle) ** 2).sum(1).mean())
    model.X[is_far] = middle + settings.far_distance * rms_radius * direction[is_far]
    model.known[is_far] = True


def _place_images(
    sights: Sights, model: Model, images: Int[np.ndarray, " some"], settings: StartValueSettings
) -> int:
    """Resect images from their known points; returns the number of oriented images."""
    images, rows, R, xy = _in_planes(sights, model, images, settings)
    if not len(images):
        return 0
    X0, M, share = batched.resect(
        xy, [model.X[sights.point[r]] for r in rows], sights.tolerance[images]
    )
    number = np.minimum([len(r) for r in rows], batched.SLOTS)
    good = (share >= settings.agreeing_share) & (share * number >= settings.min_points)
    for i, image in enumerate(images):
        if good[i]:
            model.place(image, X0[i], R[i].T @ M[i])
    return int(good.sum())


def _in_planes(
    sights: Sights, model: Model, images: Int[np.ndarray, " some"], settings: StartValueSettings
) -> tuple[
    Int[np.ndarray, " usable"],
    list[Int[np.ndarray, " _"]],
    Float[np.ndarray, "usable 3 3"],
    list[Float[np.ndarray, "_ 2"]],
]:
    """For each of the images with enough known points: their rows, and their coordinates in a
    camera turned by R (`sights.in_plane`)."""
    usable, image_rows, R, xy = [], [], [], []
    for image in images:
        rows = np.arange(sights.image.size)[sights.rows_of(image)]
        rows = rows[model.known[sights.point[rows]]]
        turn, coordinates = in_plane(sights.ray[rows])
        is_finite = np.isfinite(coordinates).all(1)
        if is_finite.sum() >= settings.min_points:
            usable.append(image)
            image_rows.append(rows[is_finite])
            R.append(turn)
            xy.append(coordinates[is_finite])
    return np.array(usable, int), image_rows, np.reshape(R, (-1, 3, 3)), xy


def _refine(sights: Sights, model: Model, settings: StartValueSettings) -> None:
    """All oriented images improved by consistent points."""
    error = misclosures(sights, model)
    images, rows, R, xy = _in_planes(sights, model, np.flatnonzero(model.placed), settings)
    weights = [(error[r] < sights.tolerance[i]).astype(float) for r, i in zip(rows, images)]
    # Of the rows that `batched.refine` uses: an image whose good points are not among these would
    # be refined by none.
    usable = [
        k
        for k, w in enumerate(weights)
        if w[batched.evenly_spaced(len(w))].sum() >= settings.min_points
    ]
    if not usable:
        return
    images, rows, R = images[usable], [rows[k] for k in usable], R[usable]
    model.X0[images], M = batched.refine(
        (model.X0[images], R @ model.M[images]),
        [xy[k] for k in usable],
        [model.X[sights.point[r]] for r in rows],
        [weights[k] for k in usable],
    )
    model.M[images] = R.swapaxes(1, 2) @ M


def misclosures(sights: Sights, model: Model) -> Float[np.ndarray, " n"]:
    """Tangent of the angle between every ray and the direction to its point; infinite if that is
    behind the ray, NaN if not placed."""
    to_point = model.X[sights.point] - model.X0[sights.image]
    ray = np.einsum("nij,ni->nj", model.M[sights.image], sights.ray)
    distance = (to_point * ray).sum(1)
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.linalg.norm(np.cross(to_point, ray), axis=1) / distance
    return np.where(distance <= 0, np.inf, error)


def intersect(
    sights: Sights, model: Model, limits: IntersectionLimits, repeat: bool = False
) -> None:
    """Intersect the points that are not known yet; with `repeat`, all that are not held.

    If the rays of a point disagree, the worst ray is dropped, as long as two remain.
    """
    rows = np.flatnonzero(model.placed[sights.image])
    rows = rows[np.argsort(sights.point[rows], kind="stable")]
    point = sights.point[rows]
    starts = np.searchsorted(point, np.arange(sights.points))
    number = np.bincount(point, minlength=sights.points)
    selected_points = np.flatnonzero((number >= 2) & ~model.control & (repeat | ~model.known))
    if not len(selected_points):
        return
    place = np.minimum(np.arange(batched.RAYS), number[selected_points, None] - 1)
    scale = np.maximum((number[selected_points, None] - 1) / (batched.RAYS - 1), 1.0)
    row = rows[starts[selected_points, None] + (place * scale).astype(int)]
    weights = (np.arange(batched.RAYS) < number[selected_points, None]).astype(float)
    X0 = model.X0[sights.image[row]]
    rays = np.einsum("nkij,nki->nkj", model.M[sights.image[row]], sights.ray[row])
    tolerance = limits.max_miss * sights.tolerance[sights.image[row]]

    X, good = np.full((len(selected_points), 3), np.nan), np.zeros(len(selected_points), bool)
    todo = np.arange(len(selected_points))
    while len(todo):
        new_X, angle, status = batched.intersect(X0[todo], rays[todo], weights[todo])
        relative_misclosures = (
            _angle_tangents(new_X[:, None] - X0[todo], rays[todo]) / tolerance[todo] * weights[todo]
        )
        sound = status == int(Status.SOUND)
        agrees = sound & (relative_misclosures.max(1) < 1)
        X[todo], good[todo] = new_X, agrees & (angle > limits.min_angle)
        # One ray a round: the worst one draws the point to itself, so that good rays miss it as
        # well. Of two contradicting rays either may be wrong.
        continued = ~agrees & (weights[todo].sum(1) > 2) & np.isfinite(relative_misclosures).all(1)
        weights[todo[continued], relative_misclosures[continued].argmax(1)] = 0.0
        todo = todo[continued]
    model.known[selected_points] = good
    model.X[selected_points] = np.where(good[:, None], X, np.nan)


def _angle_tangents(
    d: Float[np.ndarray, "n rays 3"], rays: Float[np.ndarray, "n rays 3"]
) -> Float[np.ndarray, "n rays"]:
    """Tangent of the angle between a direction and a unit ray; 1000, above all tolerances but
    finite (a ray from there is dropped like others), if it points backwards."""
    parallel = np.einsum("nkj,nkj->nk", d, rays)
    perpendicular = np.linalg.norm(np.cross(d, rays), axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(parallel > 0, perpendicular / parallel, 1e3)
