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
from jaxbundle.network.subsets import keep_images, keep_points, record_left_out
from jaxbundle.network.tables import Network
from jaxbundle.network.unit_mistakes import name_pixels
from jaxbundle.orientation import batched
from jaxbundle.orientation.alignment import describe_mirror, join, move_to_given_frame, to_scale
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
from jaxbundle.orientation.rays import TOLERANCE, Sights, sights
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
        placed, number_known = len(self.network.images), len(self.network.points)
        lines = [
            f"placed {count(placed, 'image')} of {placed + len(self.images_not_placed)} and "
            f"{count(number_known, 'point')} of {number_known + len(self.points_not_placed)}, "
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
            f"all {int(tie.sum())} tie points have one start value, {_numbers(X[tie][0])}"
        )
        X = np.where(tie[:, None], np.nan, X)
    pose = np.concatenate([position, angles], 1)
    if len(pose) > 1 and np.isnan(images.sigma).all() and (pose == pose[0]).all():
        messages.append(f"all {len(pose)} images have one start value, {_numbers(pose[0])}")
        position, angles = np.full_like(position, np.nan), np.full_like(angles, np.nan)
    if not messages:
        return network
    computed = "; start values are computed: leave such columns empty"
    return network.warn(*(f"{line}{computed}" for line in messages)).replace(
        images=dataclasses.replace(images, position=position, angles=angles),
        points=dataclasses.replace(points, position=X),
    )


def _numbers(values: Float[np.ndarray, " n"]) -> str:
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
    sighted = sights(network, tolerance)
    model, frame = _orient(network, sighted, improve and partial(improve, network), settings)
    if not model.placed.any():
        why = _describe_mirror(network, sighted, settings) or _why_nothing(
            network, sighted, settings
        )
        raise _no_start_values(network, why)
    oriented = _result(network, sighted, model, frame, settings)
    # Control points that most of their rays miss grossly.
    wrong = np.bincount(sighted.point, _are_gross(sighted, model, settings), sighted.points)
    rays = _rays_of(sighted, model)
    missed = are_held(network.points, settings) & (2 * wrong > rays)
    finding = name_contradiction(network, sighted, model, settings) if missed.any() else ""
    control_left = (are_controlled(network.points) & ~missed & (rays > 0)).sum()
    why = ""
    if _control_contradicts(network, sighted, model, settings):
        # A datum needs three control points; with as many left the wrong ones are only excluded.
        why = _describe_mirror(network, sighted, settings) or (finding if control_left < 3 else "")
    if why:
        raise _no_start_values(network, why)
    if missed.any() and control_left < 3:
        finding = name_suspects(network, missed)
    if not finding:
        return oriented
    return dataclasses.replace(oriented, network=oriented.network.warn(finding), finding=finding)


def _no_start_values(network: Network, why: str) -> NotSolvedError:
    extent = name_image_extent(network)
    causes = "; ".join(filter(None, (why, name_pixels(network), extent)))
    return NotSolvedError(
        f"no start values found: {causes}", [f"image {id}" for id in network.images.id]
    )


def _rays_of(sighted: Sights, model: Model) -> Int[np.ndarray, " points"]:
    """Rays of every point from oriented images."""
    return np.bincount(sighted.point[model.placed[sighted.image]], minlength=sighted.points)


def _control_contradicts(
    network: Network, sighted: Sights, model: Model, settings: StartValueSettings
) -> bool:
    """Whether many rays miss their control points grossly, or many points have rays that do not
    intersect."""
    control = are_controlled(network.points)
    placed = model.placed[sighted.image]
    rays = control[sighted.point] & placed
    wrong = _are_gross(sighted, model, settings)
    seen_twice = _rays_of(sighted, model) > 1
    unmet = seen_twice & ~model.known
    return bool(control.any()) and bool(
        wrong[rays].sum() > settings.contradicted_share * rays.sum()
        or unmet.sum() > settings.contradicted_share * seen_twice.sum()
    )


def _describe_mirror(network: Network, sighted: Sights, settings: StartValueSettings) -> str:
    """Whether a model without control fits it only as a mirror image, in words."""
    model = _grow_from_a_pair(network, sighted, Model.empty(sighted), None, settings)
    return "" if model is None else describe_mirror(network, model, settings)


def _orient(
    network: Network, sighted: Sights, improve: Improve | None, settings: StartValueSettings
) -> tuple[Model, str]:
    """The model of steps 1 to 4 (see above), and its frame in words."""
    model, frame = _start_from_given(network, sighted, settings), "in the frame given"
    grow(sighted, model, improve=improve, settings=settings)
    if not model.placed.any():
        approximate = _with_approximate_points(network, model, settings)
        grow(sighted, approximate, improve=improve, settings=settings)
        model = approximate if approximate.placed.any() else model
    fixed = model.placed.any()
    while not model.placed.all():
        part = _grow_from_a_pair(network, sighted, model, improve, settings)
        if part is None:
            break
        # A part of its own frame and scale: images that see too few known points for a resection
        # have points in common with one oriented image, or lengths that are known.
        if model.placed.any():
            part = join(network, sighted, model, part)
            assert part is not None, "a pair is taken only if it can be joined"
        model = part
        grow(sighted, model, improve=improve, settings=settings)
        # As soon as control is reached, it carries the rest: points that are held do not drift.
        if not fixed and (in_given_frame := move_to_given_frame(network, sighted, model)):
            fixed, frame = True, "in the frame given"
            model = _with_control(network, in_given_frame, settings)
            grow(sighted, model, improve=improve, settings=settings)
    finish(sighted, model, settings)
    model = _place_doubtful_again(network, sighted, model, improve, settings)
    place_far_points(sighted, model, settings)
    return (model, frame) if fixed else to_scale(network, model)


def _place_doubtful_again(
    network: Network,
    sighted: Sights,
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
    agreeing, share = _count_agreeing(sighted, model)
    limit = settings.doubtful_share * np.median(share[placed])
    doubtful = placed & ~_have_poses(network) & (share < limit)
    if not doubtful.any() or (placed & ~doubtful).sum() < 2:
        return model
    replaced = model.copy_without(doubtful)
    grow(sighted, replaced, improve=improve, settings=settings)
    finish(sighted, replaced, settings)
    is_lost = placed & ~replaced.placed & ~doubtful
    return model if is_lost.any() or _count_agreeing(sighted, replaced)[0] <= agreeing else replaced


def _count_agreeing(sighted: Sights, model: Model) -> tuple[int, Float[np.ndarray, " images"]]:
    """The number of agreeing rays; and their share of those of every placed image that belong to
    known control or to points with two rays."""
    checked = model.control | (_rays_of(sighted, model) > 1)
    rays = model.placed[sighted.image] & checked[sighted.point]
    agree = rays & (misclosures(sighted, model) < sighted.tolerance[sighted.image])
    number, good = (np.bincount(sighted.image, r, sighted.images) for r in (rays, agree))
    return int(agree.sum()), good / np.maximum(number, 1)


def _have_poses(network: Network) -> Bool[np.ndarray, " images"]:
    """Images with all six start values."""
    images = network.images
    return np.all(np.isfinite(np.concatenate([images.position, images.angles], 1)), axis=1)


def _start_from_given(network: Network, sighted: Sights, settings: StartValueSettings) -> Model:
    """Images with all six start values, points with all three coordinates known."""
    model, images = Model.empty(sighted), network.images
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
    is_given = np.isfinite(points.position).all(1) & ~points.has_role("check")
    is_given &= are_held(points, settings) | ~are_controlled(points)
    X = np.where(is_given[:, None], points.position, model.X)
    # A copy: `grow` changes it in place, and this attempt may be discarded.
    return dataclasses.replace(model, X=X, known=model.known | is_given, placed=model.placed.copy())


def _grow_from_a_pair(
    network: Network,
    sighted: Sights,
    model: Model,
    improve: Improve | None,
    settings: StartValueSettings,
) -> Model | None:
    """The best of the models grown from a few good pairs of unoriented images; if some are
    oriented, from pairs with one of them, to a model that can be joined to theirs."""
    new, linked = ~model.placed, bool(model.placed.any())
    # Placed images that share enough points with unplaced ones.
    of_new = np.zeros(sighted.points, bool)
    of_new[sighted.point[new[sighted.image]]] = True
    shared = np.bincount(sighted.image, of_new[sighted.point], minlength=sighted.images)
    old = (shared >= settings.min_common_points) & model.placed
    best, largest_number = None, 0
    for image, partner, rotation_1, rotation_2, b in good_pairs(
        sighted, new | old, old, linked, settings
    ):
        part = Model.empty(sighted)
        part.place(image, np.zeros(3), rotation_1)
        part.place(partner, b, rotation_2)
        grow(sighted, part, new | old, improve, settings)
        rows = new[sighted.image]
        good = int((misclosures(sighted, part) < sighted.tolerance[sighted.image])[rows].sum())
        if good > largest_number and not (linked and join(network, sighted, model, part) is None):
            best, largest_number = part, good
        if largest_number >= settings.sufficient_share * rows.sum():
            break
    return best


def _result(
    network: Network, sighted: Sights, model: Model, frame: str, settings: StartValueSettings
) -> Oriented:
    """The network with the start values of a model, and reasons where there are none."""
    images, points = network.images, network.points
    position, angles = images.position.copy(), images.angles.copy()
    lacking = model.placed & ~np.isfinite(np.concatenate([position, angles], 1)).all(1)
    # Images with too few consistent known points.
    gross = _are_gross(sighted, model, settings)
    of_image = lambda rows: np.bincount(sighted.image, rows, minlength=sighted.images)
    wrong_share = 1 - settings.agreeing_share
    disagrees = of_image(gross) > wrong_share * of_image(model.known[sighted.point])
    # In the model itself: `find_start_values` counts only the images left.
    model.placed[lacking & disagrees] = False
    lacking &= model.placed
    position[lacking] = model.X0[lacking]
    if lacking.any():
        angles[lacking] = batched.angles(model.M[lacking])
    X = np.where(
        (model.known & ~np.isfinite(points.position).all(1))[:, None], model.X, points.position
    )
    wrong = sighted.row[gross]
    keep = model.placed
    is_known = np.all(np.isfinite(X), axis=1)
    reasons = explain_missing(network, sighted, model, is_known, settings)
    rays = network.observations
    network = network.replace(
        images=dataclasses.replace(images, position=position, angles=angles),
        points=dataclasses.replace(points, position=X),
        observations=rays.take(np.setdiff1d(np.arange(len(rays)), wrong)),
    )
    network = keep_points(keep_images(network, keep), is_known)
    network = network.note(f"start values found, {frame}")
    for noun, reasons_of_missing in zip(("image", "point"), reasons):
        network = note_missing(
            network, noun, reasons_of_missing, "for which no start values were found"
        )
    names = tuple(f"{points.id[rays.point[k]]} in {images.id[rays.image[k]]}" for k in wrong)
    network = record_left_out(network, "image point", names, CONTRADICTION)
    return Oriented(network, frame, *reasons, names)


def _are_gross(
    sighted: Sights, model: Model, settings: StartValueSettings
) -> Bool[np.ndarray, " sights"]:
    """Which rays of known points in oriented images miss them grossly."""
    return misclosures(sighted, model) > settings.gross_ratio * sighted.tolerance[sighted.image]


def _why_nothing(network: Network, sighted: Sights, settings: StartValueSettings) -> str:
    """What is lacking if no image could be oriented."""
    fewest = settings.min_common_points
    is_known = are_controlled(network.points)
    control = np.bincount(sighted.image, is_known[sighted.point], minlength=sighted.images)
    best = int(control.argmax())
    begin = (
        f"no image sees {settings.min_points} control points that agree ({int(control[best])} in "
        f"{network.images.id[best]!r} at most), and "
    )
    image_a, image_b, largest_number = 0, 0, 0
    pairs, number = all_pairs(sighted, np.ones(sighted.images, bool))
    if len(number):
        largest_number = int(number.max())
        image_a, image_b = pairs[number.argmax()]
    if largest_number < fewest:
        pair = (
            f" ({network.images.id[image_a]!r}, {network.images.id[image_b]!r})"
            if largest_number
            else ""
        )
        return (
            f"{begin}no two images have the {fewest} points in common that a relative "
            f"orientation needs: {largest_number} at most{pair}; measure more points in the same "
            "images, or "
            "give start values"
        )
    return (
        f"{begin}no two images share {fewest} points whose rays meet at an angle ({largest_number} "
        "points in common at most): take images from different positions, look for wrong point "
        "numbers, or give start values"
    )
