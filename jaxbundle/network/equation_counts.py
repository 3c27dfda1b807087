"""What the rays of a network can determine, and what must be left out.

A point needs three equations: two from every ray, one from every distance and every controlled
axis. An image needs six: two from every ray, one from every prior. Disconnected parts of the
network each need their own datum.
"""

import numpy as np
from jaxtyping import Bool, Int

from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.network.columns import count, list_some
from jaxbundle.network.kinds.base import included_tables, rows_of
from jaxbundle.network.subsets import keep_images, keep_points, record_left_out
from jaxbundle.network.tables import (
    EXTERIOR,
    Network,
    Points,
)


def count_controlled_axes(points: Points) -> Int[np.ndarray, " points"]:
    """The number of known coordinates of each point: fixed 3, control those with a finite σ."""
    axes = np.isfinite(points.sigma).sum(1)
    return np.where(points.has_role("fixed"), 3, np.where(points.has_role("control"), axes, 0))


def equations_of(network: Network, object_type: str) -> Int[np.ndarray, " things"]:
    """The number of equations of further kinds that touch every image ("IMAGES") or point
    ("POINTS")."""
    objects = network.images if object_type == "IMAGES" else network.points
    number = np.zeros(len(objects), int)
    for table in included_tables(network):
        for field in getattr(table, object_type):
            np.add.at(number, rows_of(getattr(table, field), objects), table.number_of_equations())
    return number


def _count_measurements(
    network: Network,
    points_kept: Bool[np.ndarray, " points"],
    images_kept: Bool[np.ndarray, " images"],
) -> tuple[Int[np.ndarray, " points"], Int[np.ndarray, " points"]]:
    """The rays of every point from the images kept, and its distances to points kept."""
    rays, distances = network.observations, network.distances
    ends = distances.points[points_kept[distances.points].all(1)]
    return (
        np.bincount(rays.point[images_kept[rays.image]], minlength=len(points_kept)),
        np.bincount(ends.ravel(), minlength=len(points_kept)),
    )


def name_undetermined_points(network: Network) -> frozenset[str]:
    """Ids of the points that no start value would make determinable: they have fewer than three
    equations even if every image and every other point is used."""
    points, images = network.points, network.images
    rays, distance_counts = _count_measurements(
        network, np.ones(len(points), bool), np.ones(len(images), bool)
    )
    equations = 2 * rays + distance_counts
    equations += count_controlled_axes(points) + equations_of(network, "POINTS")
    return frozenset(points.id[row] for row in np.flatnonzero(~_determine_points(equations)))


def _determine_points(equations: Int[np.ndarray, " points"]) -> Bool[np.ndarray, " points"]:
    """Which numbers of equations are enough for a point: one for each coordinate."""
    return equations >= 3


def leave_out_with_too_few_rays(network: Network) -> Network:
    """The network without points with too few rays and images with too few points, with notes
    that list them.

    **Raises:** `InputError` or `NotSolvedError` if that is half of the images or more."""
    points, images, distances = network.points, network.images, network.distances
    image, point = network.observations.image, network.observations.point
    is_fixed, is_check = points.has_role("fixed"), points.has_role("check")
    point_equations = count_controlled_axes(points) + equations_of(network, "POINTS")
    image_equations = (~np.isnan(images.sigma)).sum(1) + equations_of(network, "IMAGES")
    points_kept, images_kept = np.ones(len(points), bool), np.ones(len(images), bool)
    # Points and images depend on each other: without a point an image may have too few, without the
    # image other points lose a ray. Everything is counted again until nothing changes.
    first_error = None
    while True:
        rays, distance_counts = _count_measurements(network, points_kept, images_kept)
        equations = 2 * rays + distance_counts + point_equations
        determined = is_fixed | _determine_points(equations)
        # Fixed points that no image sees add nothing, nor do images without points, whatever is
        # known of them.
        next_points_kept = points_kept & np.where(
            is_check, rays >= 2, (rays + distance_counts > 0) & determined
        )
        taking_part = (next_points_kept & ~is_check)[point]
        point_counts = np.bincount(image[taking_part], minlength=len(images))
        next_images_kept = (
            images_kept & (point_counts > 0) & (2 * point_counts + image_equations >= 6)
        )
        if (next_points_kept == points_kept).all() and (next_images_kept == images_kept).all():
            break
        # Only the first image: those that follow are left out because of it.
        if first_error is None and (next_images_kept != images_kept).any():
            measured = np.bincount(image, minlength=len(images))
            worst = int(np.where(next_images_kept, np.inf, measured).argmin())
            first_error = _too_few_points(network, worst, point_counts)
        points_kept, images_kept = next_points_kept, next_images_kept
    # So many say that something is wrong with the network, not with these images.
    if first_error is not None and 2 * (~images_kept).sum() >= len(images):
        raise first_error
    left_out, notes = ~points_kept, []
    for mask, noun, why in (
        (left_out & ~is_check & (rays == 0), "point", "without any ray"),
        (left_out & ~is_check & (rays > 0), "tie point", "with a single ray"),
        (left_out & is_check, "check point", "with fewer than two rays"),
    ):
        notes.append((noun, [points.id[row] for row in np.flatnonzero(mask)], why))
    names = [images.id[row] for row in np.flatnonzero(~images_kept)]
    notes.append(("image", names, "with too few points that other images or control determine"))
    remaining = keep_images(keep_points(network, points_kept), images_kept)
    for noun, ids, why in notes:
        remaining = record_left_out(remaining, noun, ids, why, measured=noun == "image")
    messages = []
    for table in network.further:
        lost_rows = len(table) - len(table.restrict_to(remaining))
        if lost_rows:
            messages.append(
                f"{table.TABLE}: left out {count(lost_rows, 'row')} about excluded objects"
            )
    lost_distances = (~points_kept[distances.points].all(1)).sum()
    if lost_distances:
        messages.append(
            f"left out {count(lost_distances, 'distance')} to a point that was left out"
        )
    remaining = remaining.note(*messages)
    if network.datum_points and not points_kept[np.isin(points.id, network.datum_points)].any():
        reasons = remaining.notes[len(network.notes) :]
        raise InputError(
            f"datum_points: none is left ({'; '.join(reasons)}); name points with two rays"
        )
    return remaining


def _too_few_points(
    network: Network, row: int, usable: Int[np.ndarray, " images"]
) -> InputError | NotSolvedError:
    """Why an image with only `usable` [images] of its points is not determined."""
    images, points, rays = network.images, network.points, network.observations
    rays_of_point = np.bincount(rays.point, minlength=len(points))
    place = f"{images.source(row)}: image {images.id[row]!r}: "
    measured_points = rays.point[rays.image == row]
    if not len(measured_points):
        return InputError(f"{place}an image with no rays; measure points in it or remove the image")
    single_ray_points = [
        points.id[p] for p in measured_points if rays_of_point[p] == 1 and points.role[p] == "tie"
    ]
    if len(measured_points) >= 3 and single_ray_points:
        return NotSolvedError(
            f"{place}not solved: it shares too few points with other images, so that neither "
            f"X0, Y0, Z0, omega, phi, kappa of image {images.id[row]} nor X, Y, Z of points "
            f"{list_some(single_ray_points)} can be determined; add images of the same points, or "
            "control points",
            [f"{name} of image {images.id[row]}" for name in EXTERIOR]
            + [f"X, Y, Z of point {id}" for id in single_ray_points],
        )
    part = (
        ""
        if usable[row] == len(measured_points)
        else f" of the {len(measured_points)} measured ones"
    )
    why = "" if not part else " (the others are check points or seen in one image only)"
    return InputError(
        f"{place}only {count(usable[row], 'point')}{part} can be used{why}; an image needs at "
        "least 3, or prior σ of its exterior orientation"
    )


def check_parts(network: Network) -> None:
    """Refuse parts of the network that are neither connected nor positioned."""
    images, points, rays = network.images, network.points, network.observations
    is_known = count_controlled_axes(points) == 3
    ties = ~(is_known | points.has_role("check"))[rays.point]
    # Only tie points connect: known ones have their coordinates in each part, and check points
    # take no part in the adjustment.
    part = label_connected_parts(rays.image[ties], rays.point[ties], len(images), len(points))
    labels, part = np.unique(part, return_inverse=True)
    if len(labels) == 1:
        return
    known_in_part = np.unique(
        np.stack([part[rays.image], rays.point])[:, is_known[rays.point]], axis=1
    )
    known_points = np.bincount(known_in_part[0], minlength=len(labels))
    priors = (~np.isnan(images.sigma)).sum(1) + equations_of(network, "IMAGES")
    priors = np.bincount(part, priors, minlength=len(labels))
    # Three known points hold a part with its scale, six priors one image and what it sees; else 7
    # equations of both kinds are needed. Whether they suffice, the solution shows.
    equations = 3 * known_points + priors
    loose_parts = np.flatnonzero((known_points < 3) & (priors < 6) & (equations < 7))
    if len(loose_parts):
        size = np.bincount(part)
        smallest = loose_parts[size[loose_parts].argmin()]
        names = [id for id, p in zip(images.id, part) if p == smallest]
        raise InputError(
            f"{images.source.name}: the network consists of {len(labels)} parts without common tie "
            f"points, and one part has only {count(known_points[smallest], 'known point')}: "
            f"{count(len(names), 'image')} {list_some(names)}; measure common points, or at least "
            "3 control points in it"
        )


def label_connected_parts(
    image: Int[np.ndarray, " rays"], point: Int[np.ndarray, " rays"], images: int, points: int
) -> Int[np.ndarray, " images"]:
    """A label for each image; images that share points, directly or in a chain, have the same.

    Smallest labels travel along the rays, with hooking and halving, so that a strip of n images
    needs about log n rounds.
    """
    label = np.arange(images)
    while True:
        of_point = np.full(points, images)
        np.minimum.at(of_point, point, label[image])
        next_label = label.copy()
        np.minimum.at(next_label, image, of_point[point])
        np.minimum.at(next_label, label[image], of_point[point])
        next_label = next_label[next_label]
        if (next_label == label).all():
            return label
        label = next_label


def check_redundancy(network: Network) -> None:
    """Refuse fewer observations, priors and datum conditions than unknowns; with further kinds,
    which have their own unknowns, the adjustment detects this."""
    if network.further:
        return
    images, points = network.images, network.points
    points = points.take(~points.has_role("check"))
    taking_part = ~network.points.has_role("check")[network.observations.point]
    interior = [len(camera.sigma) for camera in network.cameras]
    weighted = np.isfinite(points.sigma) & points.has_role("control")[:, None]
    exterior = images.sigma > 0
    rows = (
        2 * taking_part.sum()
        + weighted.sum()
        + exterior.sum()
        + sum(interior)
        + len(network.distances)
    )
    unknowns = (
        (images.sigma != 0).sum()
        + sum(len(camera.unknowns) for camera in network.cameras)
        + 3 * (~points.has_role("fixed")).sum()
    )
    # The datum defect as it must be at least: the engine finds the true one, but only after a
    # problem has been made, and a count says what is missing in numbers that a reader can check.
    conditions = 0
    if network.datum != "control":
        datum_values = count_controlled_axes(points).sum() + (~np.isnan(images.sigma)).sum()
        conditions = max(0, 7 - datum_values - (len(network.distances) > 0))
    missing_equations = unknowns - rows - conditions
    if missing_equations > 0:
        with_datum = f" with {conditions} datum conditions" if conditions else ""
        raise InputError(
            f"{network.observations.source.name}: {rows} observations{with_datum} are too few "
            f"for {unknowns} unknowns: {missing_equations} missing; measure more points, free "
            "fewer camera parameters"
            + ("" if conditions else ', or, without control, set datum = "inner"')
        )
