"""The start values of a whole network.

1. Images with given exterior orientation and control points are known: images that see enough
   of them are resected, points intersected, more images resected, … (`growth`).
2. If no image can be resected, given coordinates of tie points count as known.
3. If this fails too, or images are left, a model starts from two of them: among the pairs with many
   common points one with good intersection angles, oriented relatively (five points). It grows;
   unreached images are joined by relative orientation to an oriented image. Finally a similarity
   transforms the model to control points or given positions (`frames`); without these it keeps its
   own frame.
4. Images with few agreeing rays are resected again from the points of the others.

A plane has two relative orientations, and two images from one place have none: a pair
from which little grows is replaced by the next.
"""

import dataclasses
import itertools
from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
from jaxtyping import Bool, Float

from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import NotSolvedError
from jaxbundle.network.check import check_tables
from jaxbundle.network.columns import count, list_some
from jaxbundle.network.sightings import keep_images, keep_points, leave_out
from jaxbundle.network.tables import LeftOut, Network
from jaxbundle.network.unit_mistakes import name_pixels
from jaxbundle.orientation import many
from jaxbundle.orientation.alignment import describe_mirror, join, move_to_given_frame, to_scale
from jaxbundle.orientation.conventions import name_image_extent
from jaxbundle.orientation.exchanges import name_contradiction, name_suspects
from jaxbundle.orientation.growth import (
    AGREEING_SHARE,
    FEWEST_POINTS,
    FOR_OTHERS,
    Model,
    are_controlled,
    are_held,
    finish,
    grow,
    misclosures,
    place_far_points,
)
from jaxbundle.orientation.sights import TOLERANCE, Sights, in_plane, sights
from jaxbundle.types import Index

FEWEST_COMMON = 6
"""Minimum common points of a starting pair."""
PAIRS = 16
"""Largest number of pairs for relative orientation."""
SEEDS = 6
"""Largest number of pairs a model is grown from."""
EXCLUSION_RATIO = 3.0
"""Image points with larger misclosures, in tolerances, are excluded."""
CONTRADICTED_SHARE = 0.1
"""Fraction of rays that miss their control points, or of points whose rays do not intersect, above
which a mirror image is tested."""
LEAST_CONTROL = 3
"""Minimum remaining control points for the datum."""
SUFFICIENT_SHARE = 0.8
"""A model that uses at least this fraction of the image points is accepted without alternatives."""
DOUBTFUL = 0.5
"""Share of agreeing rays, relative to the median of the images, below which one is resected
again."""
WIDE_ANGLE = 0.5
"""Angle of intersection, radians, beyond which wider is no better."""


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class Oriented:
    """A network with start values; `images`, `points`: reasons for those that could not be
    oriented; `left_out`: image points that contradict the start values; `frame`: the reference of
    the coordinates; `finding`: contradictory control points, and the correction."""

    network: Network
    frame: str
    images: Mapping[str, str]
    points: Mapping[str, str]
    left_out: tuple[str, ...] = ()
    finding: str = ""

    def __str__(self) -> str:
        placed, known = len(self.network.images), len(self.network.points)
        lines = [
            f"placed {count(placed, 'image')} of {placed + len(self.images)} and "
            f"{count(known, 'point')} of {known + len(self.points)}, {self.frame}"
        ]
        for thing, reasons in (("image", self.images), ("point", self.points)):
            lines += [f"{thing} {id} not placed: {why}" for id, why in reasons.items()]
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
    that are all at one place, or images that all have one orientation, as of columns of zeros."""
    images, points = network.images, network.points
    position, angles, X = images.position, images.angles, points.position
    said = []
    tie = points.has_role("tie")
    if tie.sum() > 1 and (X[tie] == X[tie][0]).all():
        said.append(f"all {int(tie.sum())} tie points have one start value, {_numbers(X[tie][0])}")
        X = np.where(tie[:, None], np.nan, X)
    pose = np.concatenate([position, angles], 1)
    if len(pose) > 1 and np.isnan(images.sigma).all() and (pose == pose[0]).all():
        said.append(f"all {len(pose)} images have one start value, {_numbers(pose[0])}")
        position, angles = np.full_like(position, np.nan), np.full_like(angles, np.nan)
    if not said:
        return network
    computed = "; start values are computed: leave such columns empty"
    return network.warn(*(f"{line}{computed}" for line in said)).replace(
        images=dataclasses.replace(images, position=position, angles=angles),
        points=dataclasses.replace(points, position=X),
    )


def _numbers(values: Float[np.ndarray, " n"]) -> str:
    return ", ".join(f"{value:g}" for value in values)


def find_start_values(
    network: Network, improve: Callable | None = None, tolerance: float = TOLERANCE
) -> Oriented:
    """Missing start values of a network; given ones are kept.

    `improve(network, sights, model)`: adjusts a part of a large network in place.

    Returns and raises like `jaxbundle.orient`, which adds intermediate adjustments.
    """
    network = check_tables(network)
    for one in network.further:
        network = one.begin(network)
    seen = sights(network, tolerance)
    model, frame = _model(network, seen, improve and partial(improve, network))
    if not model.placed.any():
        why = _describe_mirror(network, seen) or _why_nothing(network, seen)
        raise _no_start_values(network, why)
    found = _result(network, seen, model, frame)
    missed = _find_missed(network, seen, model)
    finding = name_contradiction(network, seen, model) if missed.any() else ""
    left = (are_controlled(network.points) & ~missed & (_rays_of(seen, model) > 0)).sum()
    why = ""
    if _control_contradicts(network, seen, model):
        why = _describe_mirror(network, seen) or (finding if left < LEAST_CONTROL else "")
    if why:
        raise _no_start_values(network, why)
    if missed.any() and left < LEAST_CONTROL:
        finding = name_suspects(network, missed)
    if not finding:
        return found
    return dataclasses.replace(found, network=found.network.warn(finding), finding=finding)


def _no_start_values(network: Network, why: str) -> NotSolvedError:
    extent = name_image_extent(network)
    causes = "; ".join(filter(None, (why, name_pixels(network), extent)))
    return NotSolvedError(f"no start values found: {causes}", _names(network))


def _find_missed(network: Network, seen: Sights, model: Model) -> Bool[np.ndarray, " points"]:
    """Control points that most of their rays miss grossly."""
    wrong = np.bincount(seen.point, _out_of_the_question(seen, model), seen.points)
    return are_held(network.points) & (2 * wrong > _rays_of(seen, model))


def _rays_of(seen: Sights, model: Model):
    """Rays of every point from oriented images."""
    return np.bincount(seen.point[model.placed[seen.image]], minlength=seen.points)


def _control_contradicts(network: Network, seen: Sights, model: Model) -> bool:
    """Whether many rays miss their control points grossly, or many points have rays that do not
    intersect."""
    control = are_controlled(network.points)
    placed = model.placed[seen.image]
    rays = control[seen.point] & placed
    wrong = _out_of_the_question(seen, model)
    seen_twice = np.bincount(seen.point[placed], minlength=seen.points) > 1
    unmet = seen_twice & ~model.known
    return bool(control.any()) and bool(
        wrong[rays].sum() > CONTRADICTED_SHARE * rays.sum()
        or unmet.sum() > CONTRADICTED_SHARE * seen_twice.sum()
    )


def _describe_mirror(network: Network, seen: Sights) -> str:
    """Whether a model without control fits it only as a mirror image, in words."""
    model = _from_a_pair(seen, Model.empty(seen), None)
    return "" if model is None else describe_mirror(network, model)


def _model(network: Network, seen: Sights, improve) -> tuple[Model, str]:
    model, frame = _given_model(network, seen), "in the frame given"
    grow(seen, model, improve=improve)
    if not model.placed.any():
        approximate = _with_approximate_points(network, model)
        grow(seen, approximate, improve=improve)
        model = approximate if approximate.placed.any() else model
    fixed = model.placed.any()
    while not model.placed.all():
        part = _from_a_pair(seen, model, improve)
        if part is None:
            break
        if model.placed.any():
            part = join(seen, model, part)
            assert part is not None, "a pair is taken only if it can be joined"
        model = part
        grow(seen, model, improve=improve)
        if not fixed and (moved := move_to_given_frame(network, seen, model)):
            fixed, frame = True, "in the frame given"
            model = _with_control(network, moved)
            grow(seen, model, improve=improve)
    finish(seen, model)
    model = _place_doubtful_again(network, seen, model, improve)
    place_far_points(seen, model)
    return (model, frame) if fixed else to_scale(network, model)


def _place_doubtful_again(network: Network, seen: Sights, model: Model, improve) -> Model:
    """The model, or a better one in which images with few agreeing rays are resected again, from
    the points of the others. An image that repeated parts of an object place wrongly was resected
    from few points, and hides it by leaving the others unknown."""
    placed = model.placed
    if placed.sum() < 3:
        return model
    agreeing, share = _count_agreeing(seen, model)
    doubtful = placed & ~_have_poses(network) & (share < DOUBTFUL * np.median(share[placed]))
    if not doubtful.any() or (placed & ~doubtful).sum() < 2:
        return model
    other = model.without(doubtful)
    grow(seen, other, improve=improve)
    finish(seen, other)
    lost = placed & ~other.placed & ~doubtful
    return model if lost.any() or _count_agreeing(seen, other)[0] <= agreeing else other


def _count_agreeing(seen: Sights, model: Model) -> tuple[int, Float[np.ndarray, " images"]]:
    """The number of agreeing rays; and their share of those of every placed image that belong to
    known control or to points with two rays."""
    checked = model.held | (_rays_of(seen, model) > 1)
    rays = model.placed[seen.image] & checked[seen.point]
    agree = rays & (misclosures(seen, model) < seen.tolerance[seen.image])
    number, good = (np.bincount(seen.image, r, seen.images) for r in (rays, agree))
    return int(agree.sum()), good / np.maximum(number, 1)


def _have_poses(network: Network) -> Bool[np.ndarray, " images"]:
    """Images with all six start values."""
    images = network.images
    return np.all(np.isfinite(np.concatenate([images.position, images.angles], 1)), axis=1)


def _given_model(network: Network, seen: Sights) -> Model:
    """Images with all six start values, points with all three coordinates known."""
    model, images = Model.empty(seen), network.images
    there = _have_poses(network)
    if there.any():
        model.place(there, images.position[there], many.matrices(images.angles[there]))
    return _with_control(network, model)


def _with_control(network: Network, model: Model) -> Model:
    held = are_held(network.points)
    X = np.where(held[:, None], network.points.position, model.X)
    return dataclasses.replace(model, X=X, known=model.known | held, held=held)


def _with_approximate_points(network: Network, model: Model) -> Model:
    points = network.points
    given = np.isfinite(points.position).all(1) & ~points.has_role("check")
    given &= are_held(points) | ~are_controlled(points)
    X = np.where(given[:, None], points.position, model.X)
    return dataclasses.replace(model, X=X, known=model.known | given, placed=model.placed.copy())


def _from_a_pair(seen: Sights, model: Model, improve) -> Model | None:
    """The best of the models grown from a few good pairs of unoriented images; if some are
    oriented, from pairs with one of them, to a model that can be joined to theirs."""
    new, linked = ~model.placed, bool(model.placed.any())
    old = _neighbours(seen, new) & model.placed
    best, most = None, 0
    for image, other, first, second, b in _good_pairs(seen, new | old, old, linked):
        part = Model.empty(seen)
        part.place(image, np.zeros(3), first)
        part.place(other, b, second)
        grow(seen, part, new | old, improve)
        rows = new[seen.image]
        good = int((misclosures(seen, part) < seen.tolerance[seen.image])[rows].sum())
        if good > most and not (linked and join(seen, model, part) is None):
            best, most = part, good
        if most >= SUFFICIENT_SHARE * rows.sum():
            break
    return best


def _neighbours(seen: Sights, images: Bool[np.ndarray, " images"]) -> Bool[np.ndarray, " images"]:
    """The images that share enough points with some of these."""
    of_these = np.zeros(seen.points, bool)
    of_these[seen.point[images[seen.image]]] = True
    return np.bincount(seen.image, of_these[seen.point], minlength=seen.images) >= FEWEST_COMMON


def _good_pairs(seen: Sights, among: Bool[np.ndarray, " images"], old, linked: bool):
    """Pairs, the rotations of both and the base between them, the most promising first; `linked`:
    of an old image and another."""
    pairs, common = _pairs_in_common(seen, among, old, linked)
    if not len(pairs):
        return
    turned = [_common_points(seen, *pair) for pair in pairs]
    enough = [len(xy) >= FEWEST_COMMON for *_, xy, _ in turned]
    turned, pairs, common = list(itertools.compress(turned, enough)), pairs[enough], common[enough]
    if not turned:
        return
    R, Q, xy, other_xy = zip(*turned)
    tolerance = seen.tolerance[pairs].mean(1)
    M, b, part, angle = many.orient_pairs(xy, other_xy, tolerance)
    worth = np.sqrt(common) * part * np.minimum(angle, WIDE_ANGLE)
    usable = (part >= AGREEING_SHARE) & (angle > FOR_OTHERS.angle)
    for k in [k for k in np.argsort(-worth) if usable[k]][:SEEDS]:
        yield *pairs[k], R[k].T, Q[k].T @ M[k], b[k]


def _pairs_in_common(seen: Sights, among, old, linked):
    """Up to `PAIRS` pairs of images, and the number of their points: those with the most, and
    others with enough points and wider bases."""
    pairs, number = _all_pairs(seen, among)
    use = (number >= FEWEST_COMMON) & ((old[pairs[:, 0]] != old[pairs[:, 1]]) | (not linked))
    pairs, number = pairs[use], number[use]
    order = np.argsort(-number, kind="stable")
    enough = order[number[order] >= 0.3 * number.max(initial=0)]
    chosen = np.unique(
        np.concatenate([order[: PAIRS // 2], enough[many.spread(len(enough), PAIRS - PAIRS // 2)]])
    )
    return pairs[chosen], number[chosen]


def _all_pairs(seen: Sights, among):
    """Pairs of these images that share points [pairs, 2], and how many."""
    from scipy.sparse import coo_array, triu

    rows = among[seen.image]
    shape = (seen.images, seen.points)
    sees = coo_array((np.ones(rows.sum(), int), (seen.image[rows], seen.point[rows])), shape)
    sees = sees.tocsr()
    common = triu(sees @ sees.T, k=1)
    return np.stack([common.row, common.col], 1), common.data


def _common_points(seen: Sights, image: Index, other: Index):
    """The common points of two images: of each the rotation and the coordinates of `in_plane`."""
    one, two = seen.of(image), seen.of(other)
    _, k, l = np.intersect1d(seen.point[one], seen.point[two], return_indices=True)
    (R, xy), (Q, other_xy) = in_plane(seen.ray[one][k]), in_plane(seen.ray[two][l])
    there = np.isfinite(xy).all(1) & np.isfinite(other_xy).all(1)
    return R, Q, xy[there], other_xy[there]


def _result(network: Network, seen: Sights, model: Model, frame: str) -> Oriented:
    images, points = network.images, network.points
    position, angles = images.position.copy(), images.angles.copy()
    lacking = model.placed & ~np.isfinite(np.concatenate([position, angles], 1)).all(1)
    model.placed[lacking & _disagrees(seen, model)] = False
    lacking &= model.placed
    position[lacking] = model.X0[lacking]
    if lacking.any():
        angles[lacking] = many.angles(model.M[lacking])
    X = np.where(
        (model.known & ~np.isfinite(points.position).all(1))[:, None], model.X, points.position
    )
    wrong = seen.row[_out_of_the_question(seen, model)]
    keep = model.placed
    known = np.all(np.isfinite(X), axis=1)
    reasons = explain_missing(network, seen, model, known)
    rays = network.observations
    network = network.replace(
        images=dataclasses.replace(images, position=position, angles=angles),
        points=dataclasses.replace(points, position=X),
        observations=rays.take(np.setdiff1d(np.arange(len(rays)), wrong)),
    )
    network = keep_points(keep_images(network, keep), known)
    network = network.note(f"start values found, {frame}")
    for thing, found in zip(("image", "point"), reasons):
        network = note_missing(network, thing, found, "for which no start values were found")
    names = tuple(f"{points.id[rays.point[k]]} in {images.id[rays.image[k]]}" for k in wrong)
    network = leave_out(network, "image point", names, CONTRADICTION)
    return Oriented(network, frame, *reasons, names)


CONTRADICTION = "that contradict the start values"


def note_missing(network: Network, thing: str, reasons: Mapping[str, str], what: str) -> Network:
    """The network with notes that images or points were left out, by name with the reasons."""
    if not reasons:
        return network
    names = list_some((f"{id} ({why})" for id, why in reasons.items()), 5, str)
    groups = {
        why: tuple(id for id, one in reasons.items() if one == why)
        for why in dict.fromkeys(reasons.values())
    }
    network = network.note(f"left out {count(len(reasons), thing)} {what}: {names}")
    notes = (LeftOut(thing, ids, f"{what}: {why}") for why, ids in groups.items())
    return network.replace(left_out=(*network.left_out, *notes))


def _out_of_the_question(seen: Sights, model: Model) -> Bool[np.ndarray, " sights"]:
    """Which rays of known points in oriented images miss them grossly."""
    return misclosures(seen, model) > EXCLUSION_RATIO * seen.tolerance[seen.image]


def _disagrees(seen: Sights, model: Model) -> Bool[np.ndarray, " images"]:
    """The images with too few consistent known points."""
    of_image = lambda rows: np.bincount(seen.image, rows, minlength=seen.images)
    known = of_image(model.known[seen.point])
    return of_image(_out_of_the_question(seen, model)) > (1 - AGREEING_SHARE) * known


def explain_missing(network: Network, seen: Sights, model: Model, known):
    """By id, why images are not placed, and why points are not `known`."""
    rays = np.bincount(seen.image, minlength=seen.images)
    of_known = np.bincount(seen.image, model.known[seen.point], minlength=seen.images).astype(int)
    images = {}
    for image in np.flatnonzero(~model.placed):
        if of_known[image] < FEWEST_POINTS:
            why = (
                f"it sees {of_known[image]} known points of {rays[image]}; "
                f"{FEWEST_POINTS} are needed"
            )
        else:
            why = (
                f"fewer than {AGREEING_SHARE:.0%} of the {of_known[image]} known points it "
                "sees agree on a pose: look for wrong point numbers, or a wrong principal distance"
            )
        images[network.images.id[image]] = why
    placed = model.placed[seen.image]
    by_point = np.bincount(seen.point[placed], minlength=seen.points)
    outside = np.ones(len(network.observations), bool)
    outside[seen.row] = False
    no_ray = np.bincount(network.observations.point[outside], minlength=seen.points)
    points = {}
    for point in np.flatnonzero(~known):
        if by_point[point] < 2 and no_ray[point]:
            number = count(no_ray[point], "image point")
            why = f"{number} of it outside the range of the camera model, where there are no rays"
        elif by_point[point] < 2:
            why = f"seen in {count(by_point[point], 'placed image')}; 2 are needed"
        else:
            why = f"its {by_point[point]} rays do not intersect, or are parallel"
        points[network.points.id[point]] = why
    return images, points


def _why_nothing(network: Network, seen: Sights) -> str:
    known = are_controlled(network.points)
    control = np.bincount(seen.image, known[seen.point], minlength=seen.images)
    best = int(control.argmax())
    begin = (
        f"no image sees {FEWEST_POINTS} control points that agree ({int(control[best])} in "
        f"{network.images.id[best]!r} at most), and "
    )
    one, other, most = _most_in_common(seen)
    if most < FEWEST_COMMON:
        pair = f" ({network.images.id[one]!r}, {network.images.id[other]!r})" if most else ""
        return (
            f"{begin}no two images have the {FEWEST_COMMON} points in common that a relative "
            f"orientation needs: {most} at most{pair}; measure more points in the same images, or "
            "give start values"
        )
    return (
        f"{begin}no two images share {FEWEST_COMMON} points whose rays meet at an angle ({most} "
        "points in common at most): take images from different positions, look for wrong point "
        "numbers, or give start values"
    )


def _most_in_common(seen: Sights) -> tuple[int, int, int]:
    """The two images with the most points in common, and how many."""
    pairs, number = _all_pairs(seen, np.ones(seen.images, bool))
    if not len(number):
        return 0, 0, 0
    best = int(number.argmax())
    return int(pairs[best, 0]), int(pairs[best, 1]), int(number[best])


def _names(network: Network) -> list[str]:
    return [f"image {id}" for id in network.images.id]
