"""The start values of a whole network.

1. Images with given exterior orientation and control points are known: images that see enough
   of them are resected, points intersected, more images resected, … (`incremental`).
2. If no image can be resected, given coordinates of tie points count as known.
3. If this fails too, or images are left, a model starts from two of them: among the pairs with many
   common points one with good intersection angles, oriented relatively (five points). It grows;
   unreached images are joined by relative orientation to an oriented image, at the scale of common
   points or of known lengths in both parts. Finally a similarity
   transforms the model to control points or given positions (`frames`); without these it keeps its
   own frame.
4. Images with few agreeing rays are resected again from the points of the others.

A plane has two relative orientations, and two images from one place have none: a pair
from which little grows is replaced by the next.
"""

import dataclasses
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import NotSolvedError
from jaxbundle.network.check import check_tables
from jaxbundle.network.columns import count, list_some
from jaxbundle.network.equation_counts import name_undetermined_points
from jaxbundle.network.subsets import keep_images, keep_points, record_left_out
from jaxbundle.network.tables import Network
from jaxbundle.network.unit_mistakes import name_pixels
from jaxbundle.orientation import batched
from jaxbundle.orientation.alignment import join, move_to_given_frame, to_scale
from jaxbundle.orientation.control_axes import describe_wrong_axes
from jaxbundle.orientation.image_conventions import name_image_extent
from jaxbundle.orientation.incremental import (
    Improve,
    Model,
    are_controlled,
    are_held,
    finish,
    grow,
    misclosures,
    place_far_points,
)
from jaxbundle.orientation.missing import explain_missing, note_missing
from jaxbundle.orientation.rays import TOLERANCE, Sights, make_sights
from jaxbundle.orientation.settings import DEFAULTS, StartValueSettings
from jaxbundle.orientation.start_pairs import all_pairs, good_pairs
from jaxbundle.orientation.swapped_control import name_contradiction, name_suspects
from jaxbundle.results import TableMethods

CONTRADICTION = "that contradict the start values"


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class Oriented(TableMethods):
    """A network with start values; `images_not_placed`, `points_not_placed`: the reason by id;
    `left_out`: image points that contradict the start values; `frame`: the reference of the
    coordinates; `finding`: contradictory control points, and, if found, what would correct them."""

    network: Network
    frame: str
    images_not_placed: Mapping[str, str]
    points_not_placed: Mapping[str, str]
    left_out: tuple[str, ...] = ()
    finding: str = ""

    def to_dict(self) -> dict[str, Any]:
        """What was oriented and what was not, with reasons; `write_project(oriented.network, …)`
        writes the start values."""
        return {
            "frame": self.frame,
            "images": list(self.network.images.id),
            "points": len(self.network.points),
            "images_not_placed": dict(self.images_not_placed),
            "points_not_placed": dict(self.points_not_placed),
            "left_out": list(self.left_out),
            "finding": self.finding,
        }

    def table(self) -> dict[str, np.ndarray]:
        """One row an image or a point: columns kind, id, oriented, reason (of those that could not
        be oriented)."""
        rows = [("image", id, True, "") for id in self.network.images.id]
        rows += [("image", id, False, why) for id, why in self.images_not_placed.items()]
        rows += [("point", id, True, "") for id in self.network.points.id]
        rows += [("point", id, False, why) for id, why in self.points_not_placed.items()]
        kind, id, oriented, reason = zip(*rows) if rows else ((), (), (), ())
        return {
            "kind": np.array(kind, dtype=object),
            "id": np.array(id, dtype=object),
            "oriented": np.array(oriented, dtype=bool),
            "reason": np.array(reason, dtype=object),
        }

    def __str__(self) -> str:
        image_count, point_count = len(self.network.images), len(self.network.points)
        lines = [
            f"placed {count(image_count, 'image')} of "
            f"{image_count + len(self.images_not_placed)} and "
            f"{count(point_count, 'point')} of {point_count + len(self.points_not_placed)}, "
            f"{self.frame}"
        ]
        for noun, reasons in (
            ("image", self.images_not_placed),
            ("point", self.points_not_placed),
        ):
            lines += [f"{noun} {id} not placed: {why}" for id, why in reasons.items()]
        if self.left_out:
            names = list_some(self.left_out, 5, str)
            number = count(len(self.left_out), "image point")
            lines.append(f"left out {number} {CONTRADICTION}: {names}")
        if self.finding:
            lines.append(self.finding)
        return "\n".join(lines)


def lacks_start_values(network: Network) -> bool:
    """Whether an image or a tie point has no start value."""
    images, points = network.images, network.points
    tie = points.has_role("tie") | (points.has_role("control") & ~are_controlled(points))
    return bool(
        np.isnan(images.position).any()
        or np.isnan(images.angles).any()
        or np.isnan(points.position[tie]).any()
    )


def without_placeholders(network: Network) -> Network:
    """The network without start values that say nothing, with a warning: of two and more tie points
    all at one place, or all images with one pose, as from columns of zeros. (With σ, poses are
    observations, and stay.)"""
    images, points = network.images, network.points
    position, angles, X = images.position, images.angles, points.position
    messages = []
    tie = points.has_role("tie")
    if tie.sum() > 1 and (X[tie] == X[tie][0]).all():
        messages.append(
            f"all {int(tie.sum())} tie points have one start value, {_format_numbers(X[tie][0])}"
        )
        X = np.where(tie[:, None], np.nan, X)
    pose = np.concatenate([position, angles], 1)
    if len(pose) > 1 and np.isnan(images.sigma).all() and (pose == pose[0]).all():
        messages.append(f"all {len(pose)} images have one start value, {_format_numbers(pose[0])}")
        position, angles = np.full_like(position, np.nan), np.full_like(angles, np.nan)
    if not messages:
        return network
    computed = "; start values are computed: leave such columns empty"
    return network.warn(*(f"{line}{computed}" for line in messages)).replace(
        images=dataclasses.replace(images, position=position, angles=angles),
        points=dataclasses.replace(points, position=X),
    )


def _format_numbers(values: Float[np.ndarray, " n"]) -> str:
    return ", ".join(f"{value:g}" for value in values)


def find_start_values(
    network: Network,
    improve: Callable[[Network, Sights, Model], None] | None = None,
    tolerance: float = TOLERANCE,
    settings: StartValueSettings = DEFAULTS,
) -> Oriented:
    """Missing start values of a network; given ones are kept.

    `improve(network, sights, model)`: adjusts a part of a large network in place.

    Returns and raises like `jaxbundle.orient`, which adds intermediate adjustments.
    """
    network = check_tables(network)
    # Observations of further kinds may give start values, as satellite positions do.
    for rows in network.further:
        network = rows.begin(network)
    sights = make_sights(network, tolerance)
    model, frame = _orient(network, sights, improve and partial(improve, network), settings)
    if not model.placed.any():
        why = _describe_wrong_axes(network, sights, settings) or _why_nothing(
            network, sights, settings
        )
        raise _no_start_values(network, why)
    oriented = _result(network, sights, model, frame, settings)
    # Control points that most of their rays miss grossly.
    gross_counts = np.bincount(sights.point, _are_gross(sights, model, settings), sights.points)
    rays = _ray_counts(sights, model)
    is_missed = are_held(network.points, settings) & (2 * gross_counts > rays)
    finding = _name_contradiction(network, sights, model, settings) if is_missed.any() else ""
    remaining_control = (are_controlled(network.points) & ~is_missed & (rays > 0)).sum()
    why = ""
    if _control_contradicts(network, sights, model, settings):
        # A datum needs three control points; with as many left the wrong ones are only excluded.
        why = _describe_wrong_axes(network, sights, settings) or (
            finding if remaining_control < 3 else ""
        )
    if why:
        raise _no_start_values(network, why)
    if is_missed.any() and remaining_control < 3 and not finding:
        finding = name_suspects(network, is_missed)
    if not finding:
        return oriented
    return dataclasses.replace(oriented, network=oriented.network.warn(finding), finding=finding)


def _no_start_values(network: Network, why: str) -> NotSolvedError:
    extent = name_image_extent(network)
    causes = "; ".join(filter(None, (why, name_pixels(network), extent)))
    return NotSolvedError(
        f"no start values found: {causes}", [f"image {id}" for id in network.images.id]
    )


def _ray_counts(sights: Sights, model: Model) -> Int[np.ndarray, " points"]:
    """Rays of every point from oriented images."""
    return np.bincount(sights.point[model.placed[sights.image]], minlength=sights.points)


def _control_contradicts(
    network: Network, sights: Sights, model: Model, settings: StartValueSettings
) -> bool:
    """Whether many rays miss their control points grossly, or many points have rays that do not
    intersect."""
    control = are_controlled(network.points)
    placed = model.placed[sights.image]
    control_rays = control[sights.point] & placed
    is_gross = _are_gross(sights, model, settings)
    seen_twice = _ray_counts(sights, model) > 1
    is_not_intersected = seen_twice & ~model.known
    return bool(control.any()) and bool(
        is_gross[control_rays].sum() > settings.contradicted_share * control_rays.sum()
        or is_not_intersected.sum() > settings.contradicted_share * seen_twice.sum()
    )


def _name_contradiction(
    network: Network, sights: Sights, model: Model, settings: StartValueSettings
) -> str:
    """How control points contradict each other, in words."""
    # By images oriented without them: those oriented by wrong points fit them in part.
    free_model = _grow_from_a_pair(network, sights, Model.empty(sights), None, settings)
    return name_contradiction(
        network, sights, model if free_model is None else free_model, settings
    )


def _describe_wrong_axes(network: Network, sights: Sights, settings: StartValueSettings) -> str:
    """Whether a model without control fits it only with other axes, in words."""
    model = _grow_from_a_pair(network, sights, Model.empty(sights), None, settings)
    if model is None:
        return ""
    control = are_controlled(network.points) & model.known
    positions = model.X[control], network.points.position[control]
    return describe_wrong_axes(*positions, network.object_unit, settings)


def _orient(
    network: Network, sights: Sights, improve: Improve | None, settings: StartValueSettings
) -> tuple[Model, str]:
    """The model of steps 1 to 4 (see above), and its frame in words."""
    model, frame = _start_from_given(network, sights, settings), "in the frame given"
    grow(sights, model, improve=improve, settings=settings)
    if not model.placed.any():
        approximate = _with_approximate_points(network, model, settings)
        grow(sights, approximate, improve=improve, settings=settings)
        model = approximate if approximate.placed.any() else model
    is_in_given_frame = model.placed.any()
    while not model.placed.all():
        part = _grow_from_a_pair(network, sights, model, improve, settings)
        if part is None:
            break
        # A part of its own frame and scale: images that see too few known points for a resection
        # have points in common with one oriented image, or lengths that are known.
        if model.placed.any():
            part = join(network, sights, model, part)
            assert part is not None, "a pair is taken only if it can be joined"
        model = part
        grow(sights, model, improve=improve, settings=settings)
        # As soon as control is reached, it carries the rest: points that are held do not drift.
        if not is_in_given_frame and (aligned := move_to_given_frame(network, sights, model)):
            is_in_given_frame, frame = True, "in the frame given"
            model = _with_control(network, aligned, settings)
            grow(sights, model, improve=improve, settings=settings)
    finish(sights, model, settings)
    model = _place_doubtful_again(network, sights, model, improve, settings)
    place_far_points(sights, model, settings)
    return (model, frame) if is_in_given_frame else to_scale(network, model)


def _place_doubtful_again(
    network: Network,
    sights: Sights,
    model: Model,
    improve: Improve | None,
    settings: StartValueSettings,
) -> Model:
    """The model, or a better one in which images with few agreeing rays are resected again, from
    the points of the others. An image misplaced because parts of the object repeat was resected
    from few points; the error does not show, since its other points stay unknown."""
    placed = model.placed
    # The points of an image are checked by two others.
    if placed.sum() < 3:
        return model
    agreeing, share = _count_agreeing(sights, model)
    limit = settings.doubtful_share * np.median(share[placed])
    is_doubtful = placed & ~_have_poses(network) & (share < limit)
    if not is_doubtful.any() or (placed & ~is_doubtful).sum() < 2:
        return model
    regrown = model.copy_without(is_doubtful)
    grow(sights, regrown, improve=improve, settings=settings)
    finish(sights, regrown, settings)
    lost_images = placed & ~regrown.placed & ~is_doubtful
    return (
        model if lost_images.any() or _count_agreeing(sights, regrown)[0] <= agreeing else regrown
    )


def _count_agreeing(sights: Sights, model: Model) -> tuple[int, Float[np.ndarray, " images"]]:
    """The number of agreeing rays; and their share of those of every placed image that belong to
    known control or to points with two rays."""
    is_checked = model.control | (_ray_counts(sights, model) > 1)
    rays = model.placed[sights.image] & is_checked[sights.point]
    agrees = rays & (misclosures(sights, model) < sights.tolerance[sights.image])
    number, good = (np.bincount(sights.image, r, sights.images) for r in (rays, agrees))
    return int(agrees.sum()), good / np.maximum(number, 1)


def _have_poses(network: Network) -> Bool[np.ndarray, " images"]:
    """Images with all six start values."""
    images = network.images
    return np.all(np.isfinite(np.concatenate([images.position, images.angles], 1)), axis=1)


def _start_from_given(network: Network, sights: Sights, settings: StartValueSettings) -> Model:
    """Images with all six start values, points with all three coordinates known."""
    model, images = Model.empty(sights), network.images
    has_pose = _have_poses(network)
    if has_pose.any():
        model.place(has_pose, images.position[has_pose], batched.matrices(images.angles[has_pose]))
    return _with_control(network, model, settings)


def _with_control(network: Network, model: Model, settings: StartValueSettings) -> Model:
    is_held = are_held(network.points, settings)
    X = np.where(is_held[:, None], network.points.position, model.X)
    return dataclasses.replace(model, X=X, known=model.known | is_held, control=is_held)


def _with_approximate_points(network: Network, model: Model, settings: StartValueSettings) -> Model:
    points = network.points
    has_coordinates = np.isfinite(points.position).all(1) & ~points.has_role("check")
    has_coordinates &= are_held(points, settings) | ~are_controlled(points)
    X = np.where(has_coordinates[:, None], points.position, model.X)
    # A copy: `grow` changes it in place, and this attempt may be discarded.
    return dataclasses.replace(
        model, X=X, known=model.known | has_coordinates, placed=model.placed.copy()
    )


def _grow_from_a_pair(
    network: Network,
    sights: Sights,
    model: Model,
    improve: Improve | None,
    settings: StartValueSettings,
) -> Model | None:
    """The best of the models grown from a few good pairs of unoriented images; if some are
    oriented, from pairs with one of them, to a model that can be joined to theirs."""
    is_unplaced, must_link = ~model.placed, bool(model.placed.any())
    # Placed images that share enough points with unplaced ones.
    of_new = np.zeros(sights.points, bool)
    of_new[sights.point[is_unplaced[sights.image]]] = True
    shared = np.bincount(sights.image, of_new[sights.point], minlength=sights.images)
    is_linking = (shared >= settings.min_common_points) & model.placed
    best, most_agreeing = None, 0
    for first_image, second_image, first_M, second_M, b in good_pairs(
        sights, is_unplaced | is_linking, is_linking, must_link, settings
    ):
        part = Model.empty(sights)
        part.place(first_image, np.zeros(3), first_M)
        part.place(second_image, b, second_M)
        grow(sights, part, is_unplaced | is_linking, improve, settings)
        rows = is_unplaced[sights.image]
        good = int((misclosures(sights, part) < sights.tolerance[sights.image])[rows].sum())
        if good > most_agreeing and not (must_link and join(network, sights, model, part) is None):
            best, most_agreeing = part, good
        if most_agreeing >= settings.sufficient_share * rows.sum():
            break
    return best


def _result(
    network: Network, sights: Sights, model: Model, frame: str, settings: StartValueSettings
) -> Oriented:
    """The network with the start values of a model, and reasons where there are none."""
    images, points = network.images, network.points
    position, angles = images.position.copy(), images.angles.copy()
    needs_pose = model.placed & ~np.isfinite(np.concatenate([position, angles], 1)).all(1)
    # Images with too few consistent known points.
    is_gross = _are_gross(sights, model, settings)
    of_image = lambda rows: np.bincount(sights.image, rows, minlength=sights.images)
    wrong_share = 1 - settings.agreeing_share
    disagrees = of_image(is_gross) > wrong_share * of_image(model.known[sights.point])
    # In the model itself: `find_start_values` counts only the images left.
    model.placed[needs_pose & disagrees] = False
    needs_pose &= model.placed
    position[needs_pose] = model.X0[needs_pose]
    if needs_pose.any():
        angles[needs_pose] = batched.angles(model.M[needs_pose])
    X = np.where(
        (model.known & ~np.isfinite(points.position).all(1))[:, None], model.X, points.position
    )
    gross_rows = sights.row[is_gross]
    keep = model.placed
    has_coordinates = np.all(np.isfinite(X), axis=1)
    reasons = explain_missing(network, sights, model, has_coordinates, settings)
    given, rays = network, network.observations
    network = network.replace(
        images=dataclasses.replace(images, position=position, angles=angles),
        points=dataclasses.replace(points, position=X),
        observations=rays.take(np.setdiff1d(np.arange(len(rays)), gross_rows)),
    )
    network = keep_points(keep_images(network, keep), has_coordinates)
    network = network.note(f"start values found, {frame}")
    clause, (images_missing, points_missing) = "for which no start values were found", reasons
    network = note_missing(network, "image", images_missing, clause)
    undetermined = name_undetermined_points(given)
    network = note_missing(network, "point", points_missing, clause, undetermined)
    names = tuple(f"{points.id[rays.point[k]]} in {images.id[rays.image[k]]}" for k in gross_rows)
    network = record_left_out(network, "image point", names, CONTRADICTION)
    return Oriented(network, frame, *reasons, names)


def _are_gross(
    sights: Sights, model: Model, settings: StartValueSettings
) -> Bool[np.ndarray, " sights"]:
    """Which rays of known points in oriented images miss them grossly."""
    return misclosures(sights, model) > settings.gross_ratio * sights.tolerance[sights.image]


def _why_nothing(network: Network, sights: Sights, settings: StartValueSettings) -> str:
    """What is lacking if no image could be oriented."""
    fewest = settings.min_common_points
    is_controlled = are_controlled(network.points)
    control = np.bincount(sights.image, is_controlled[sights.point], minlength=sights.images)
    best = int(control.argmax())
    first_clause = (
        f"no image sees {settings.min_points} control points that agree ({int(control[best])} in "
        f"{network.images.id[best]!r} at most), and "
    )
    first_image, second_image, max_common = 0, 0, 0
    pairs, number = all_pairs(sights, np.ones(sights.images, bool))
    if len(number):
        max_common = int(number.max())
        first_image, second_image = pairs[number.argmax()]
    if max_common < fewest:
        pair = (
            f" ({network.images.id[first_image]!r}, {network.images.id[second_image]!r})"
            if max_common
            else ""
        )
        return (
            f"{first_clause}no two images have the {fewest} points in common that a relative "
            f"orientation needs: {max_common} at most{pair}; measure more points in the same "
            "images, or give start values"
        )
    return (
        f"{first_clause}no two images share {fewest} points whose rays meet at an angle "
        f"({max_common} points in common at most): take images from different positions, look for "
        "wrong point numbers, or give start values"
    )
