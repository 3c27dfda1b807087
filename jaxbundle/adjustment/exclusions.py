"""What takes part in an adjustment: what rays do not determine is left out by name, and what start
values excluded is tried again with the adjusted orientation.

Before and after the iterations points whose rays are one line, and images whose points are on one,
are searched for (`orientation.collinear`). After them, everything that was excluded because of
start values (image points that contradict them, points without intersection, images that could not
be placed) is placed by the adjusted images and points, as `orient` does, and what agrees takes part
in the next adjustment.
"""

import dataclasses
from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxbundle.adjustment.far_points import (
    FAR_POINTS,
    angle_of_rays,
)
from jaxbundle.adjustment.minimum import adjusted_cameras, are_finite
from jaxbundle.adjustment.problem import NetworkProblem, coordinates, with_coordinates
from jaxbundle.leastsquares.indexing.rows import Values
from jaxbundle.leastsquares.spaces import PoseValue
from jaxbundle.network.columns import list_some
from jaxbundle.network.equation_counts import equations_of, name_undetermined_points
from jaxbundle.network.noise import noise_of_rays
from jaxbundle.network.subsets import keep_images, keep_points, record_left_out
from jaxbundle.network.tables import LeftOut, Network, are_among
from jaxbundle.orientation import batched
from jaxbundle.orientation.collinear import rays_coincide, see_collinear_points
from jaxbundle.orientation.incremental import (
    START_VALUE_LIMITS,
    IntersectionLimits,
    Model,
    are_held,
    grow,
    intersect,
    misclosures,
    place_far_points,
)
from jaxbundle.orientation.missing import explain_missing, note_missing
from jaxbundle.orientation.rays import Sights, make_sights
from jaxbundle.types import AnyArray

# Limits for what is readmitted. Start values may miss by 3 tolerances (image points) or 4 (rays of
# a point); adjusted images are better, and blunders should not be readmitted with the others.
READMISSION_LIMITS = IntersectionLimits(START_VALUE_LIMITS.min_angle, 1.0)


@dataclasses.dataclass(frozen=True)
class CollinearGeometry:
    """Tie points whose rays are one line, and images whose points are on one: rays do not determine
    them. Each with the reason."""

    notes: tuple[LeftOut, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.notes)

    def __add__(self, other: "CollinearGeometry") -> "CollinearGeometry":
        return CollinearGeometry(self.notes + other.notes)

    def leaves_majority_of(self, network: Network) -> bool:
        """Whether more than half of the tie points and of the images are determined; otherwise the
        network has no depth, or σ says nothing, and nothing should be left out."""
        number = {
            thing: sum(len(n.names) for n in self.notes if n.thing == thing)
            for thing in ("tie point", "image")
        }
        ties = int(network.points.has_role("tie").sum())
        return 2 * number["tie point"] < max(ties, 1) and 2 * number["image"] < len(network.images)

    def leave_out(self, network: Network) -> Network:
        """The network without them, with notes."""
        excluded = {
            thing: {name for note in self.notes if note.thing == thing for name in note.names}
            for thing in ("tie point", "image")
        }
        keep = lambda ids, names: np.array([id not in names for id in ids], bool)
        network = keep_points(network, keep(network.points.id, excluded["tie point"]))
        network = keep_images(network, keep(network.images.id, excluded["image"]))
        for note in self.notes:
            network = record_left_out(network, note.thing, note.names, note.why)
        return network


def find_collinear(
    problem: NetworkProblem, values: Values, factor: float | None
) -> CollinearGeometry:
    """The tie points whose rays are one line, and the images whose points are on a line.

    **Arguments:** `factor`: σ0, by which the a priori σ are multiplied; None before the adjustment.
    """
    network = problem.network
    narrow, flat = _find_candidates(problem, values, factor)
    if not (narrow.any() or flat.any()):
        return CollinearGeometry()
    sighted = make_sights(
        network.replace(cameras=tuple(adjusted_cameras(problem, values).values()))
    )
    model = _adjusted_model(problem, values, network, sighted)
    points, one_place = rays_coincide(sighted, model, narrow, factor or 1.0)
    images = flat & see_collinear_points(sighted, model, factor or 1.0)
    return CollinearGeometry(_notes(network, sighted, points, one_place, images))


def may_be_collinear(problem: NetworkProblem, values: Values) -> bool:
    """Whether start values show points or images that rays may not determine: they are searched for
    after a few iterations, before they cost many."""
    narrow, flat = _find_candidates(problem, values, None)
    # Poor start values may put a point so near that its rays seem to converge: points of narrow
    # rays count too, if they would be narrow at the usual distance. But not where some rays are
    # parallel: those points are at any distance from the start (`far_points`), and would drift in
    # the few iterations before the check.
    angle = angle_of_rays(problem, values)
    is_narrow_enough = (angle < FAR_POINTS.narrow) & (
        _parallax_at_usual_distance(problem, values) < FAR_POINTS.narrow
    )
    parallel = angle < FAR_POINTS.parallel
    return bool(narrow.any() or flat.any() or (is_narrow_enough.any() and not parallel.any()))


def _parallax_at_usual_distance(
    problem: NetworkProblem, values: Values
) -> Float[np.ndarray, " points"]:
    """The largest angle at which a projection centre of a point is seen off the common line of its
    rays, from the median distance of the points of its image; radians."""
    # Start values may have put a point far out along its rays; seen from the median distance of its
    # neighbours, its base shows whether it is really narrow.
    point, image, n = problem.point, problem.image, len(problem.network.points)
    X0 = np.asarray(values["image"].position)[image]
    to_point = np.asarray(coordinates(values))[point] - X0
    s = np.linalg.norm(to_point, axis=1)
    usual = np.full(len(problem.network.images), np.inf)
    order = np.lexsort((s, image))
    seen_images, first, number = np.unique(image[order], return_index=True, return_counts=True)
    usual[seen_images] = s[order][first + number // 2]
    mean = lambda v: (
        np.stack([np.bincount(point, c, n) for c in v.T], 1)
        / np.maximum(np.bincount(point, minlength=n), 1)[:, None]
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        u = mean(to_point / s[:, None])
        u /= np.linalg.norm(u, axis=1, keepdims=True)
        distance = np.linalg.norm(np.cross(X0 - mean(X0)[point], u[point]), axis=1) / usual[image]
    largest = np.zeros(n)
    np.fmax.at(largest, point, distance)
    return largest


def _find_candidates(
    problem: NetworkProblem, values: Values, factor: float | None, largest_sigma: float = 0.01
) -> tuple[Bool[np.ndarray, " points"], Bool[np.ndarray, " images"]]:
    """Tie points with nearly parallel rays, and images whose points are nearly on a line, that
    nothing but image points determines: found without the rays, which are rarely needed.

    `largest_sigma`: radians; a ray of a larger a priori σ, half a degree, was not measured. Its σ
    is in a wrong unit or was not given, and says nothing before the adjustment has estimated it.
    """
    network = problem.network
    ties, images = network.points.has_role("tie"), len(network.images)
    nothing = np.zeros(len(ties), bool), np.zeros(images, bool)
    noise = noise_of_rays(problem.network)
    if not are_finite(problem, values) or factor is None and noise > largest_sigma:
        return nothing
    noise *= FAR_POINTS.vague * (factor or 1.0)
    free = ties & ~problem.kept_rows & (equations_of(network, "POINTS") == 0)
    free[network.distances.points.ravel()] = False
    narrow = free & (angle_of_rays(problem, values) < noise)
    # Further observations may hold an image through tables of their own: then none is judged.
    if problem.further_sets:
        return narrow, nothing[1]
    only_rays = np.isnan(network.images.sigma).all(1) & (equations_of(network, "IMAGES") == 0)
    return narrow, only_rays & (_width_of_points(problem, values) < noise)


def _notes(
    network: Network,
    sighted: Sights,
    points: Bool[np.ndarray, " points"],
    one_place: Bool[np.ndarray, " points"],
    images: Bool[np.ndarray, " images"],
) -> tuple[LeftOut, ...]:
    ids_of = lambda ids, mask: tuple(ids[k] for k in np.flatnonzero(mask))
    groups = []
    for mask, where in (
        (points & one_place, "from one place (images {})"),
        (points & ~one_place, "along the line through the projection centres (images {})"),
    ):
        photographs = np.unique(sighted.image[mask[sighted.point]])
        where = where.format(list_some((network.images.id[k] for k in photographs), 4))
        why = f"whose rays coincide within their noise, {where}: their distance is undetermined"
        groups.append(LeftOut("tie point", ids_of(network.points.id, mask), why))
    why = "whose points are on one line, about which their rotation is undetermined"
    groups.append(LeftOut("image", ids_of(network.images.id, images), why))
    return tuple(group for group in groups if group.names)


def _width_of_points(problem: NetworkProblem, values: Values) -> Float[np.ndarray, " images"]:
    """The RMS angle between the points of every image and their best line, radians."""
    # The middle eigenvalue of Σ(X − X̄)(X − X̄)ᵀ/s²: the largest belongs to the line, the other two
    # to the directions across it, of which this is the larger (of points on a plane the other is
    # 0). Weighted by 1/s², since an angle counts, not a distance.
    image, n = problem.image, len(problem.network.images)
    X = np.asarray(coordinates(values))[problem.point]
    distance = np.linalg.norm(X - np.asarray(values["image"].position)[image], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        root = np.nan_to_num(1 / distance, posinf=0.0)
    total = lambda v: np.stack([np.bincount(image, c, n) for c in v.reshape(len(image), -1).T], 1)
    weight = np.maximum(np.bincount(image, root**2, n), 1e-300)[:, None]
    scaled = root[:, None] * (X - (total(root[:, None] ** 2 * X) / weight)[image])
    C = np.nan_to_num(total(scaled[:, :, None] * scaled[:, None, :]).reshape(-1, 3, 3))
    number = np.maximum(np.bincount(image, minlength=n), 1)
    return np.sqrt(np.maximum(np.linalg.eigvalsh(C)[:, 1], 0) / number)


def _adjusted_model(
    problem: NetworkProblem, values: Values, network: Network, sighted: Sights
) -> Model:
    """The adjusted images and points, as rows of `network`."""
    model = Model.empty(sighted)
    images, points = (
        np.array([place[id] for id in part.id], int)
        for part, place in (
            (table, {id: k for k, id in enumerate(complete.id)})
            for table, complete in (
                (problem.network.images, network.images),
                (problem.network.points, network.points),
            )
        )
    )
    position, rotation = map(np.asarray, values["image"])
    M = batched.matrices_of_quaternions(rotation)
    model.place(images, position + problem.origin, M)
    X = np.asarray(coordinates(values)) + problem.origin
    model.X[points], model.known[points] = X, np.isfinite(X).all(1)
    return model


def readmit(
    network_as_given: Network,
    current: Network,
    problem: NetworkProblem,
    values: Values,
    factor: float,
) -> Network:
    """The given network with everything that agrees with adjusted images and points, and notes of
    what does not.

    **Arguments:** `current`: the part of `network_as_given` that was adjusted, with its check
    points; `factor`: σ0."""
    sighted, model, straight = _place_left_out(network_as_given, problem, values, factor)
    was_adjusted = are_among(network_as_given.points.id, current.points.id)
    # An image point that was adjusted stays, even if it misses: its residual is judged by the
    # tests. Only what was left out has to agree first.
    is_used = _are_among(network_as_given, current)
    is_off = (
        misclosures(sighted, model) > READMISSION_LIMITS.max_miss * sighted.tolerance[sighted.image]
    )
    is_wrong = is_off & ~is_used[sighted.row]
    agreeing = dataclasses.replace(
        sighted,
        **{
            name: getattr(sighted, name)[~is_wrong]
            for name in ("image", "point", "ray", "sigma", "row")
        },
    )
    left_out_ties = network_as_given.points.has_role("tie") & ~was_adjusted
    line, one_place = rays_coincide(agreeing, model, left_out_ties, factor)
    network = _with_start_values(network_as_given, model)
    images, points = network_as_given.images, network_as_given.points
    X = network.points.position
    # A tie point that was left out is readmitted if its rays meet, even if it has given
    # coordinates.
    is_known = np.isfinite(X).all(1) & (
        was_adjusted | model.known | ~network_as_given.points.has_role("tie")
    )
    missing_images, missing_points = explain_missing(
        network_as_given, sighted, model, is_known | line
    )
    # Two points are always on one line; that there are too few of them is reported elsewhere.
    for k in np.flatnonzero(straight & (np.bincount(sighted.image, minlength=sighted.images) > 2)):
        missing_images[images.id[k]] = (
            "its points are on one line, about which its rotation is undetermined"
        )
    network = network.replace(
        observations=network_as_given.observations.take(
            np.setdiff1d(np.arange(len(is_used)), sighted.row[is_wrong])
        )
    )
    network = keep_points(keep_images(network, model.placed), is_known & ~line)
    reason = "that the adjusted orientation does not determine either"
    undetermined = name_undetermined_points(network_as_given)
    network = note_missing(network, "image", missing_images, reason)
    network = note_missing(network, "point", missing_points, reason, undetermined)
    for note in _notes(network_as_given, agreeing, line, one_place, np.zeros(len(images), bool)):
        network = record_left_out(network, note.thing, note.names, note.why)
    rays = network_as_given.observations
    names = [
        f"{points.id[rays.point[k]]} in {images.id[rays.image[k]]}" for k in sighted.row[is_wrong]
    ]
    return record_left_out(
        network, "image point", names, "that contradict the adjusted orientation"
    )


def _place_left_out(
    network_as_given: Network, problem: NetworkProblem, values: Values, factor: float
) -> tuple[Sights, Model, Bool[np.ndarray, " images"]]:
    """All rays of `network_as_given`, the adjusted images and points with those that were left out
    placed by them, and which images cannot be placed since their points are on a line."""
    # The same steps as in `orient` (place images, intersect points), but from adjusted images, and
    # with a narrower tolerance for what is readmitted.
    cameras = adjusted_cameras(problem, values)
    cameras_as_adjusted = tuple(
        cameras.get(camera.id, camera) for camera in network_as_given.cameras
    )
    sighted = make_sights(network_as_given.replace(cameras=cameras_as_adjusted))
    model = _adjusted_model(problem, values, network_as_given, sighted)
    model.control = are_held(network_as_given.points)
    new = model.control & ~model.known
    model.X[new], model.known[new] = network_as_given.points.position[new], True
    straight = see_collinear_points(sighted, model, factor) & ~model.placed
    grow(sighted, model, ~straight)
    intersect(sighted, model, READMISSION_LIMITS)
    place_far_points(sighted, model)
    return sighted, model, straight


def _with_start_values(network: Network, model: Model) -> Network:
    """The network with poses and coordinates of a model where it has none."""
    images, points = network.images, network.points
    is_given = np.isfinite(np.concatenate([images.position, images.angles], 1)).all(1)
    is_lacking = model.placed & ~is_given
    position, angles = images.position.copy(), images.angles.copy()
    position[is_lacking] = model.X0[is_lacking]
    if is_lacking.any():
        angles[is_lacking] = batched.angles(model.M[is_lacking])
    is_new = model.known & ~np.isfinite(points.position).all(1)
    X = np.where(is_new[:, None], model.X, points.position)
    return network.replace(
        images=dataclasses.replace(images, position=position, angles=angles),
        points=dataclasses.replace(points, position=X),
    )


def _are_among(whole: Network, current: Network) -> Bool[np.ndarray, " rays"]:
    """Which image points of a network are in a part of it."""
    key = lambda network, ids: np.array(
        [
            ids[0][network.images.id[i]] * len(whole.points) + ids[1][network.points.id[p]]
            for i, p in zip(network.observations.image, network.observations.point)
        ],
        np.int64,
    )
    places = [{id: k for k, id in enumerate(table.id)} for table in (whole.images, whole.points)]
    return np.isin(key(whole, places), key(current, places))


def transfer_start_values(
    problem: NetworkProblem, earlier: NetworkProblem, values: Values
) -> Values:
    """Start values of a problem: those at which another of the same network ended, by name; its own
    for what that did not have."""
    start = problem.data.start

    def transfer_rows(
        values_to_fill: Float[AnyArray, "n k"],
        ids: Sequence[str],
        earlier_rows: Float[AnyArray, "m k"],
        earlier_ids: Sequence[str],
        shift: np.ndarray | float = 0.0,
    ) -> Float[Array, "n k"]:
        values_to_fill, earlier_rows = np.array(values_to_fill), np.asarray(earlier_rows)
        place = {id: k for k, id in enumerate(earlier_ids)}
        rows = [(k, place[id]) for k, id in enumerate(ids) if id in place]
        targets, source = np.array(rows, int).reshape(-1, 2).T
        finite = np.isfinite(earlier_rows[source]).all(1)
        values_to_fill[targets[finite]] = (earlier_rows[source] + shift)[finite]
        return jax.device_put(values_to_fill)

    network, old, shift = problem.network, earlier.network, earlier.origin - problem.origin
    images, points = (network.images.id, old.images.id), (network.points.id, old.points.id)
    cameras = [c.id for c in network.cameras], [c.id for c in old.cameras]
    own, earlier_interior = (
        problem.interior_orientation(start),
        earlier.interior_orientation(values),
    )
    # As wide as the widest model among the cameras, which may have come back or been left out;
    # parameters of a camera are the first of its row.
    more = max(own.shape[1] - np.shape(earlier_interior)[1], 0)
    earlier_interior = np.pad(earlier_interior, ((0, 0), (0, more)))[:, : own.shape[1]]
    tables = problem.with_interior_orientation(
        start, transfer_rows(own, cameras[0], earlier_interior, cameras[1])
    )
    position, rotation = start["image"]
    earlier_position, earlier_rotation = values["image"]
    image = PoseValue(
        transfer_rows(position, images[0], earlier_position, images[1], shift),
        transfer_rows(rotation, images[0], earlier_rotation, images[1]),
    )
    X = transfer_rows(coordinates(start), points[0], coordinates(values), points[1], shift)
    return tables | {"image": image, "point": with_coordinates(start["point"], X)}
