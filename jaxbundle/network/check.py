"""Checks of a network before the adjustment; errors are reported with their location.

`check_network` checks every value of every table, then (`jaxbundle.network.equation_counts`)
determinability: rays per point, points per image, connected parts, redundancy.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import SupportsIndex

import numpy as np
from jaxtyping import Bool, Float

from jaxbundle.cameras import get_model
from jaxbundle.errors import InputError
from jaxbundle.network.columns import count, did_you_mean, list_some
from jaxbundle.network.equation_counts import (
    check_parts,
    check_redundancy,
    leave_out_with_too_few_rays,
)
from jaxbundle.network.number_range import (
    check_coordinates,
    is_usable_sigma,
    sigma_requirement,
)
from jaxbundle.network.repetitions import warn_of_repetitions
from jaxbundle.network.rules import (
    AXES,
    CHOICES,
    check_camera,
    check_choice,
    check_models,
    check_unique,
)
from jaxbundle.network.single_strip import check_single_strip
from jaxbundle.network.subsets import keep_distances, with_roles
from jaxbundle.network.tables import (
    EXTERIOR,
    ROLES,
    SIGMA_ORIGINS,
    Images,
    Network,
    Points,
    Source,
    require_network,
)
from jaxbundle.network.unit_mistakes import check_units
from jaxbundle.network.units import ANGLE_UNITS


def check_network(network: Network) -> Network:
    """The adjustable network, or an error that tells the user what to do.

    Control points without σ become fixed; unused cameras, points with too few rays, images with too
    few points and distances between fixed points are removed, each with a note on the network.
    Check points are kept but not counted: remove them with `subsets.split_check_points`.

    **Raises:** `InputError`, one line with file, row, cause and remedy.
    """
    # Values first (a message about a row), then what they determine (a message about the network):
    # a missing number would otherwise be reported as a missing point.
    network = leave_out_with_too_few_rays(check_tables(network))
    _check_start_values(network)
    check_parts(network)
    check_redundancy(network)
    network = check_single_strip(network)
    network = warn_of_repetitions(network)
    network = _note_points_behind(network)
    without_repeats = lambda lines: tuple(dict.fromkeys(lines))
    return network.replace(
        warnings=without_repeats(network.warnings), notes=without_repeats(network.notes)
    )


def check_tables(network: Network) -> Network:
    """The network with every value checked as in `check_network`, but not determinability; start
    values may be missing."""
    require_network(network)
    for key, choices in CHOICES.items():
        check_choice(key, getattr(network, key), choices)
    check_choice("sigma_origin", network.observations.sigma_origin, SIGMA_ORIGINS)
    _check_sizes(network)
    network = _check_cameras(check_coordinates(network))
    _check_images(network)
    network = _check_points(network)
    _check_observations(network)
    network = check_units(_check_distances(network))
    return _note_rows_of_check_points(_check_datum_points(network))


def _check_sizes(network: Network) -> None:
    """Check that tables have rows, columns of equal length, and valid indices."""
    if not network.cameras:
        raise InputError("the network has no camera; give at least one")
    images, points, observations = network.images, network.points, network.observations
    tables = (images, "images"), (points, "points"), (observations, "image points")
    for table, noun in tables:
        if not len(table):
            raise InputError(
                f"{table.source.name}: the table is empty: there are no {noun}; give at least one"
            )
    n, p, r, d = len(images), len(points), len(observations), len(network.distances)
    shapes = (
        (images, {"camera": (n,), "position": (n, 3), "angles": (n, 3), "sigma": (n, 6)}),
        (points, {"role": (p,), "position": (p, 3), "sigma": (p, 3)}),
        (observations, {"image": (r,), "point": (r,), "xy": (r, 2), "sigma": (r, 2)}),
        (network.distances, {"points": (d, 2), "value": (d,), "sigma": (d,)}),
    )
    for table, columns in shapes:
        for name, shape in columns.items():
            if np.shape(getattr(table, name)) != shape:
                raise InputError(
                    f"{table.source.name}: {name} has the shape "
                    f"{np.shape(getattr(table, name))}, expected {shape}"
                )
    for table, name, noun, size in (
        (images, "camera", "cameras", len(network.cameras)),
        (observations, "image", "images", n),
        (observations, "point", "points", p),
        (network.distances, "points", "points", p),
    ):
        index = np.asarray(getattr(table, name))
        for row, *_ in np.argwhere((index < 0) | (index >= size))[:1]:
            raise InputError(
                f"{table.source(row)}: {name} index {index[row]} is not among the {size} {noun}"
            )


def _refuse(
    table: Images | Points,
    mask: Bool[np.ndarray, "rows columns"],
    noun: str,
    message: Callable[[int, int], str],
) -> None:
    """Refuse the first entry of a mask [rows, columns]; `message(row, column)` says why."""
    for row, k in np.argwhere(mask)[:1]:
        raise InputError(f"{table.source(row)}: {noun} {table.id[row]!r}: {message(row, k)}")


def _sighting(network: Network, row: SupportsIndex) -> str:
    rays = network.observations
    point, image = network.points.id[rays.point[row]], network.images.id[rays.image[row]]
    return f"point {point!r} in image {image!r}"


def _check_cameras(network: Network) -> Network:
    for camera in network.cameras:
        check_camera(camera)
    check_unique([camera.id for camera in network.cameras], Source("cameras"), "camera")
    check_models(network.cameras)
    used_cameras, index = np.unique(network.images.camera, return_inverse=True)
    if len(used_cameras) == len(network.cameras):
        return network
    unused_ids = [c.id for i, c in enumerate(network.cameras) if i not in used_cameras]
    images = network.images
    images = Images(
        images.id, index.reshape(-1), images.position, images.angles, images.sigma, images.source
    )
    cameras = tuple(network.cameras[i] for i in used_cameras)
    return network.replace(cameras=cameras, images=images).note(
        f"left out {count(len(unused_ids), 'camera')} without images: {list_some(unused_ids)}"
    )


def _check_images(network: Network) -> None:
    images, unit = network.images, network.angle_unit
    check_unique(images.id, images.source, "image")
    values, sigma = np.concatenate([images.position, images.angles], 1), images.sigma
    _refuse(
        images,
        np.isinf(values),
        "image",
        lambda _row, k: f"{EXTERIOR[k]} is infinite; expected a number",
    )
    hint = "are these degrees?" if unit == "rad" else f"is {unit!r} right?"
    _refuse(
        images,
        # A turn, and a little for rounding: degrees read as radians are nearly always more.
        np.abs(images.angles) > 2 * math.pi * 1.01,
        "image",
        lambda row, k: (
            f"{EXTERIOR[3 + k]} is {images.angles[row, k] / ANGLE_UNITS[unit]:.6g} "
            f"{unit}, more than a full turn; {hint} Set angle_unit"
        ),
    )
    _refuse(
        images,
        ~(np.isnan(sigma) | (sigma == 0) | is_usable_sigma(sigma)),
        "image",
        lambda row, k: (
            f"σ of {EXTERIOR[k]} is {sigma[row, k]:g}; it must be "
            f"{sigma_requirement(sigma[row, k], 'positive and finite')}, "
            'empty (no prior), or "fixed" (0) to hold the value'
        ),
    )
    _refuse(
        images,
        ~np.isnan(sigma) & np.isnan(values),
        "image",
        lambda _row, k: f"{EXTERIOR[k]} has a σ but no value; give the value, or leave the σ empty",
    )
    # A rotation changes by a vector δθ in the camera frame: no column of it is one angle.
    held_angles = (sigma[:, 3:] == 0).sum(1, keepdims=True)
    _refuse(
        images,
        (held_angles > 0) & (held_angles < 3),
        "image",
        lambda _row, _k: (
            "omega, phi, kappa can be held fixed only all three together; give the "
            "one to be held a small σ instead"
        ),
    )


def _check_points(network: Network) -> Network:
    """Also make control points without σ fixed, and those without a controlled axis tie points."""
    points, sigma = network.points, network.points.sigma
    check_unique(points.id, points.source, "point")
    _refuse(
        points,
        ~points.has_role(*ROLES)[:, None],
        "point",
        lambda row, _k: f"role must be one of {', '.join(ROLES)}, not {points.role[row]!r}",
    )
    _refuse(
        points,
        np.isinf(points.position),
        "point",
        lambda _row, k: f"{AXES[k]} is infinite; expected a number",
    )
    _refuse(
        points,
        np.isnan(points.position) & ~points.has_role("tie")[:, None],
        "point",
        lambda row, k: f"{AXES[k]} is missing; a {points.role[row]} point needs its coordinates",
    )
    control = points.has_role("control")
    without_sigma, uncontrolled = (
        control & np.isnan(sigma).all(1),
        control & np.isposinf(sigma).all(1),
    )
    _refuse(
        points,
        control[:, None] & ~(np.isnan(sigma) | np.isposinf(sigma) | is_usable_sigma(sigma)),
        "control point",
        lambda row, k: (
            f"σ of {AXES[k]} is {sigma[row, k]:g}; it must be {sigma_requirement(sigma[row, k])}; "
            'leave all three σ empty to hold the point, write "free" for an axis that is not '
            "controlled"
        ),
    )
    _refuse(
        points,
        (control & ~without_sigma)[:, None] & np.isnan(sigma),
        "control point",
        lambda _row, k: (
            f"σ of {AXES[k]} is missing while another axis has one; give all three, "
            'or write "free" for an axis that is not controlled'
        ),
    )
    has_unused_sigma = points.has_role("tie", "fixed") & ~np.isnan(sigma).all(1)
    network = network.replace(
        points=with_roles(with_roles(points, without_sigma, "fixed"), uncontrolled, "tie")
    )
    if has_unused_sigma.any():
        network = network.note(
            f"σ of {count(has_unused_sigma.sum(), 'tie or fixed point')} not used (only control "
            f"points have one): {_list_points(points, has_unused_sigma)}"
        )
    if uncontrolled.any():
        network = network.note(
            f"{count(uncontrolled.sum(), 'control point')} with all axes free taken as tie: "
            f"{_list_points(points, uncontrolled)}"
        )
    return network


def _list_points(points: Points, mask: Bool[np.ndarray, " points"]) -> str:
    return list_some(points.id[row] for row in np.flatnonzero(mask))


def _check_observations(network: Network) -> None:
    observations = network.observations
    for row, k in np.argwhere(~np.isfinite(observations.xy))[:1]:
        raise InputError(
            f"{observations.source(row)}: {'xy'[k]} of {_sighting(network, row)} is "
            f"{observations.xy[row, k]}; expected a finite number"
        )
    sigma = observations.sigma
    last_digit = np.finfo(float).eps * np.abs(observations.xy).max()
    for row, k in np.argwhere(~is_usable_sigma(sigma) & ~((0 < sigma) & (sigma < last_digit)))[:1]:
        raise InputError(
            f"{observations.source(row)}: σ of {'xy'[k]} of {_sighting(network, row)} is "
            f"{sigma[row, k]:g}; it must be "
            f"{sigma_requirement(sigma[row, k], 'finite and positive')}: correct it, or leave it "
            "empty to use sigma_image"
        )
    for row, k in np.argwhere(sigma < last_digit)[:1]:
        raise InputError(
            f"{observations.source(row)}: σ of {'xy'[k]} of {_sighting(network, row)} is "
            f"{sigma[row, k]:g}, less than the last digit of the image coordinates "
            f"({last_digit:.1g}); give it, or sigma_image, in the unit of the coordinates"
        )
    # One number for image and point, so that millions of rows are compared by a sort.
    key = observations.image.astype(np.int64) * len(network.points) + observations.point
    order = np.argsort(key, kind="stable")
    for k in np.flatnonzero(np.diff(key[order]) == 0)[:1]:
        first_row, second_row = int(order[k]), int(order[k + 1])
        raise InputError(
            f"{observations.source(second_row)}: {_sighting(network, second_row)} "
            f"is already in {observations.source(first_row)}; remove one of them"
        )


def _check_distances(network: Network) -> Network:
    """Also remove distances between two fixed points."""
    distances, points = network.distances, network.points
    names = [" to ".join(repr(points.id[k]) for k in ends) for ends in distances.points]
    for row in np.flatnonzero(distances.points[:, 0] == distances.points[:, 1])[:1]:
        raise InputError(
            f"{distances.source(row)}: distance {names[row]}: it needs two different points"
        )
    for name in ("value", "sigma"):
        column = getattr(distances, name)
        # A length has the range of a coordinate, which is that of a σ.
        for row in np.flatnonzero(~is_usable_sigma(column))[:1]:
            raise InputError(
                f"{distances.source(row)}: distance {names[row]}: {name} is {column[row]:g}; it "
                f"must be {sigma_requirement(float(column[row]), 'finite and positive')}"
            )
    for row in np.flatnonzero(points.has_role("check")[distances.points].any(1))[:1]:
        raise InputError(
            f"{distances.source(row)}: distance {names[row]}: a check point is excluded from the "
            "adjustment; make it a tie point or remove the distance"
        )
    idle = np.all(points.has_role("fixed")[distances.points], axis=1)
    if idle.any():
        network = keep_distances(network, ~idle).note(
            f"left out {count(idle.sum(), 'distance')} between fixed points: "
            f"{names[idle.argmax()]}{' …' if idle.sum() > 1 else ''}"
        )
    return network


def _note_rows_of_check_points(network: Network) -> Network:
    """Say which rows of further kinds are about check points, which take no part."""
    check_ids = {id for id, role in zip(network.points.id, network.points.role) if role == "check"}
    for table in network.further if check_ids else ():
        of_check_points = np.zeros(len(table), bool)
        for field in table.POINTS:
            of_check_points |= np.array([id in check_ids for id in getattr(table, field)], bool)
        if of_check_points.any():
            network = network.note(
                f"{table.source(int(of_check_points.argmax()))}: {of_check_points.sum()} of "
                f"{len(table)} {table.TABLE} are "
                "about check points, which take no part in the adjustment, and are left out"
            )
    return network


def _check_datum_points(network: Network) -> Network:
    roles: Mapping[str, str] = dict(zip(network.points.id, network.points.role))
    for id in network.datum_points:
        if id not in roles:
            raise InputError(
                f"datum_points: no such point {id!r} in {network.points.source.name}"
                f"{did_you_mean(id, roles, listing=False)}"
            )
        if roles[id] in ("fixed", "check"):
            raise InputError(
                f"datum_points: point {id!r} is a {roles[id]} point; name tie points (or "
                "control points with σ)"
            )
    if network.datum_points and network.datum == "control":
        return network.note(
            'datum_points are not used: the datum is given by control; choose datum = "inner" or '
            '"minimal" for them'
        )
    return network


def _check_start_values(network: Network) -> None:
    images, points = network.images, network.points
    values = np.concatenate([images.position, images.angles], 1)
    _refuse_missing(images, values, EXTERIOR, "image")
    taking_part = np.where(points.has_role("check")[:, None], 0.0, points.position)
    _refuse_missing(points, taking_part, AXES, "tie point")


def _refuse_missing(
    table: Images | Points,
    values: Float[np.ndarray, "rows columns"],
    names: Sequence[str],
    noun: str,
) -> None:
    is_nan = np.isnan(values)
    other_rows = is_nan.any(1).sum() - 1
    suffix = f" (and {other_rows} more)" if other_rows > 0 else ""
    _refuse(
        table,
        is_nan,
        noun,
        lambda _row, k: (
            f"{names[k]} has no start value{suffix}; give start values, or find them with "
            "jaxbundle.orient"
        ),
    )


def _note_points_behind(network: Network) -> Network:
    """A note if a start value puts a point behind the camera that sees it (q ≥ 0); fisheyes may
    see behind them."""
    images, rays = network.images, network.observations
    is_perspective = [get_model(camera.model).image == "perspective" for camera in network.cameras]
    # The third row of M, the axis of the camera in object space: q = axis·(X − X0) < 0 in front.
    omega, phi, _ = images.angles.T
    axis = np.stack([np.sin(phi), -np.cos(phi) * np.sin(omega), np.cos(phi) * np.cos(omega)], 1)
    ray = network.points.position[rays.point] - images.position[rays.image]
    is_in_front = (axis[rays.image] * ray).sum(1) < 0
    rows_behind = np.flatnonzero(~is_in_front & np.array(is_perspective)[images.camera[rays.image]])
    if not len(rows_behind):
        return network
    examples = "; ".join(_sighting(network, row) for row in rows_behind[:3])
    return network.note(
        f"the start values put {count(len(rows_behind), 'image point')} behind the camera: "
        f"{examples}{' …' if len(rows_behind) > 3 else ''}; check the start values and the angle "
        "unit"
    )
