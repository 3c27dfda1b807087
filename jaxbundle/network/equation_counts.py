"""What the rays of a network can determine, and what must be left out.

A point needs three equations: two from every ray, one from every distance and every controlled
axis. An image needs six: two from every ray, one from every prior. Disconnected parts of the
network each need their own datum.
"""

import numpy as np
from jaxtyping import Int

from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.network.columns import count, list_some
from jaxbundle.network.kinds.base import among, rows_of
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


def equations_of(network: Network, things: str) -> Int[np.ndarray, " things"]:
    """The number of equations of further kinds that touch every image ("IMAGES") or point
    ("POINTS")."""
    table = network.images if things == "IMAGES" else network.points
    number = np.zeros(len(table), int)
    for one in among(network):
        for field in getattr(one, things):
            np.add.at(number, rows_of(getattr(one, field), table), one.number_of_equations())
    return number


def leave_out_with_too_few_rays(network: Network) -> Network:
    """The network without points with too few rays and images with too few points, with notes
    that list them.

    **Raises:** `InputError` or `NotSolvedError` if that is half of the images or more."""
    points, images, distances = network.points, network.images, network.distances
    image, point = network.observations.image, network.observations.point
    fixed, check = points.has_role("fixed"), points.has_role("check")
    known = count_controlled_axes(points) + equations_of(network, "POINTS")
    given = (~np.isnan(images.sigma)).sum(1) + equations_of(network, "IMAGES")
    keep, used = np.ones(len(points), bool), np.ones(len(images), bool)
    # Points and images depend on each other: without a point an image may have too few, without the
    # image other points lose a ray. Everything is counted again until nothing changes.
    first = None
    while True:
        rays = np.bincount(point[used[image]], minlength=len(points))
        ends = distances.points[keep[distances.points].all(1)]
        tied = np.bincount(ends.ravel(), minlength=len(points))
        determined = fixed | (2 * rays + tied + known >= 3)
        # Fixed points that no image sees add nothing, nor do images without points, whatever is
        # known of them.
        kept = keep & np.where(check, rays >= 2, (rays + tied > 0) & determined)
        taking_part = (kept & ~check)[point]
        seen = np.bincount(image[taking_part], minlength=len(images))
        still = used & (seen > 0) & (2 * seen + given >= 6)
        if (kept == keep).all() and (still == used).all():
            break
        # Only the first image: those that follow are left out because of it.
        if first is None and (still != used).any():
            measured = np.bincount(image, minlength=len(images))
            worst = int(np.where(still, np.inf, measured).argmin())
            first = _too_few_points(network, worst, seen)
        keep, used = kept, still
    # So many say that something is wrong with the network, not with these images.
    if first is not None and 2 * (~used).sum() >= len(images):
        raise first
    out, notes = ~keep, []
    for mask, thing, why in (
        (out & ~check & (rays == 0), "point", "without any ray"),
        (out & ~check & (rays > 0), "tie point", "with a single ray"),
        (out & check, "check point", "with fewer than two rays"),
    ):
        notes.append((thing, [points.id[row] for row in np.flatnonzero(mask)], why))
    names = [images.id[row] for row in np.flatnonzero(~used)]
    notes.append(("image", names, "with too few points that other images or control determine"))
    left = keep_images(keep_points(network, keep), used)
    for thing, those, why in notes:
        left = record_left_out(left, thing, those, why, measured=thing == "image")
    messages = []
    for one in network.further:
        gone = len(one) - len(one.among(left))
        if gone:
            messages.append(f"{one.TABLE}: left out {count(gone, 'row')} about excluded objects")
    lost = (~keep[distances.points].all(1)).sum()
    if lost:
        messages.append(f"left out {count(lost, 'distance')} to a point that was left out")
    left = left.note(*messages)
    if network.datum_points and not keep[np.isin(points.id, network.datum_points)].any():
        said = left.notes[len(network.notes) :]
        raise InputError(
            f"datum_points: none is left ({'; '.join(said)}); name points with two rays"
        )
    return left


def _too_few_points(
    network: Network, row: int, usable: Int[np.ndarray, " images"]
) -> InputError | NotSolvedError:
    """Why an image with only `usable` [images] of its points is not determined."""
    images, points, rays = network.images, network.points, network.observations
    rays_of_point = np.bincount(rays.point, minlength=len(points))
    place = f"{images.source(row)}: image {images.id[row]!r}: "
    seen = rays.point[rays.image == row]
    if not len(seen):
        return InputError(f"{place}an image with no rays; measure points in it or remove the image")
    lone = [points.id[p] for p in seen if rays_of_point[p] == 1 and points.role[p] == "tie"]
    if len(seen) >= 3 and lone:
        return NotSolvedError(
            f"{place}not solved: it shares too few points with other images, so that neither "
            f"X0, Y0, Z0, omega, phi, kappa of image {images.id[row]} nor X, Y, Z of points "
            f"{list_some(lone)} can be determined; add images of the same points, or "
            "control points",
            [f"{name} of image {images.id[row]}" for name in EXTERIOR]
            + [f"X, Y, Z of point {id}" for id in lone],
        )
    part = "" if usable[row] == len(seen) else f" of the {len(seen)} measured ones"
    why = "" if not part else " (the others are check points or seen in one image only)"
    return InputError(
        f"{place}only {count(usable[row], 'point')}{part} can be used{why}; an image needs at "
        "least 3, or prior σ of its exterior orientation"
    )


def check_parts(network: Network) -> None:
    """Refuse parts of the network that are neither connected nor positioned."""
    images, points, rays = network.images, network.points, network.observations
    known = count_controlled_axes(points) == 3
    ties = ~(known | points.has_role("check"))[rays.point]
    # Only tie points connect: known ones have their coordinates in each part, and check points
    # take no part in the adjustment.
    part = label_connected_parts(rays.image[ties], rays.point[ties], len(images), len(points))
    labels, part = np.unique(part, return_inverse=True)
    if len(labels) == 1:
        return
    known_in_part = np.unique(
        np.stack([part[rays.image], rays.point])[:, known[rays.point]], axis=1
    )
    known_points = np.bincount(known_in_part[0], minlength=len(labels))
    priors = (~np.isnan(images.sigma)).sum(1) + equations_of(network, "IMAGES")
    priors = np.bincount(part, priors, minlength=len(labels))
    loose = np.flatnonzero((known_points < 3) & (priors < 6))
    if len(loose):
        size = np.bincount(part)
        smallest = loose[size[loose].argmin()]
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
        new = label.copy()
        np.minimum.at(new, image, of_point[point])
        np.minimum.at(new, label[image], of_point[point])
        new = new[new]
        if (new == label).all():
            return label
        label = new


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
        known = count_controlled_axes(points).sum() + (~np.isnan(images.sigma)).sum()
        conditions = max(0, 7 - known - (len(network.distances) > 0))
    missing = unknowns - rows - conditions
    if missing > 0:
        with_datum = f" with {conditions} datum conditions" if conditions else ""
        raise InputError(
            f"{network.observations.source.name}: {rows} observations{with_datum} are too few "
            f"for {unknowns} unknowns: {missing} missing; measure more points, free fewer camera "
            "parameters" + ("" if conditions else ', or, without control, set datum = "inner"')
        )
