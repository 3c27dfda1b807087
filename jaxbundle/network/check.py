"""Everything is checked before the solver sees it; what is wrong is said with its place.

`check_network` looks at every value of every table, then (`jaxbundle.network.sightings`) at
what can be determined from them: rays a point, points an image, connected parts, redundancy.
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from jaxbundle.cameras import MODEL_NAMES, check_parameters, default_parameters, get_model
from jaxbundle.errors import InputError
from jaxbundle.network.columns import count, did_you_mean, some
from jaxbundle.network.sightings import (
    check_images,
    check_parts,
    check_redundancy,
    leave_out_undetermined,
    with_roles,
    without_distances,
)
from jaxbundle.network.sightings import split_check_points as split_check_points
from jaxbundle.network.tables import (
    DATUMS,
    EXTERIOR,
    RESIDUAL_DOMAINS,
    ROLES,
    Camera,
    Images,
    Network,
    Source,
)
from jaxbundle.network.units import ANGLE_UNITS, IMAGE_UNITS

AXES = ("X", "Y", "Z")
CHOICES = {
    "datum": DATUMS,
    "residuals": RESIDUAL_DOMAINS,
    "angle_unit": tuple(ANGLE_UNITS),
    "image_unit": IMAGE_UNITS,
}


def check_network(network: Network) -> Network:
    """The network as it can be adjusted, or a complaint a person can act on.

    Control points without σ become fixed; cameras no image uses, points with too few rays and
    distances between fixed points are left out, each with a warning on the network. Check points
    stay in it but count for nothing: set them aside with `split_check_points`.

    **Raises:** `InputError`, one line with file, row, thing and remedy.
    """
    for key, choices in CHOICES.items():
        check_choice(key, getattr(network, key), choices)
    _check_sizes(network)
    network = _check_cameras(network)
    _check_images(network)
    network = _check_points(network)
    _check_observations(network)
    network = _check_distances(network)
    _check_datum_points(network)
    everything = network
    network = leave_out_undetermined(network)
    check_images(everything, network)
    _check_start_values(network)
    check_parts(network)
    check_redundancy(network)
    return _warn_of_points_behind(network)


def check_choice(key: str, value: str, choices: Sequence[str], where: str = "") -> None:
    """Refuse a setting that is not one of its choices."""
    if value not in choices:
        raise InputError(f"{where}{key} must be one of {', '.join(choices)}, not {value!r}")


def check_unique(ids: Sequence[str], source: Source, thing: str) -> None:
    """Refuse an id that stands in two rows of a table."""
    if len(set(ids)) == len(ids):
        return
    first: dict[str, int] = {}
    for row, id in enumerate(ids):
        if first.setdefault(id, row) != row:
            raise InputError(
                f"{source(row)}: {thing} {id!r} stands already in {source(first[id])}; "
                "an id must be unique"
            )


def check_camera(camera: Camera, where: str = "") -> None:
    """Refuse an unknown model or parameter, and impossible values, σ and sizes.

    `where` begins the message: "project.toml, ".
    """
    where = f"{where}camera {camera.id!r}: "
    if camera.model not in MODEL_NAMES:
        raise InputError(
            f"{where}unknown model {camera.model!r}{did_you_mean(camera.model, MODEL_NAMES)}"
        )
    model = get_model(camera.model)
    try:
        check_parameters(model, {**default_parameters(model), **camera.parameters})
    except ValueError as error:
        raise InputError(f"{where}{error}") from None
    for name in camera.free:
        if name not in model.parameters:
            raise InputError(
                f"{where}free names the unknown parameter {name!r}"
                f"{did_you_mean(name, model.parameters)}"
            )
        if name in model.never_free:
            raise InputError(f"{where}{name} cannot be estimated; take it out of free")
        if camera.free.count(name) > 1:
            raise InputError(f"{where}free names {name} twice")
    for name, sigma in camera.sigma.items():
        if name not in camera.free:
            raise InputError(
                f"{where}sigma is given for {name!r}, which is not free; add it to free, or take "
                f"its sigma away (free: {', '.join(camera.free) or 'none'})"
            )
        if not _positive(sigma):
            raise InputError(f"{where}sigma of {name} is {sigma}; it must be finite and positive")
    _check_pair(where, "image_size", camera.image_size, "[columns, rows]")
    _check_pair(where, "pixel_size", camera.pixel_size, "[width, height] in mm")


def _check_pair(where, name, pair, meaning):
    if pair is not None and not (len(pair) == 2 and all(map(_positive, pair))):
        raise InputError(f"{where}{name} is {list(pair)}; expected {meaning}, both positive")


def _positive(value) -> bool:
    return math.isfinite(value) and value > 0


def _check_sizes(network: Network) -> None:
    """Tables have rows, columns of one length, and indices that stay inside."""
    if not network.cameras:
        raise InputError("the network has no camera; give at least one")
    images, points, observations = network.images, network.points, network.observations
    for table in (images, points, observations):
        if not len(table):
            raise InputError(f"{table.source.name}: the table is empty; give at least one row")
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
    for table, name, things, size in (
        (images, "camera", "cameras", len(network.cameras)),
        (observations, "image", "images", n),
        (observations, "point", "points", p),
        (network.distances, "points", "points", p),
    ):
        index = np.asarray(getattr(table, name))
        outside = ((index < 0) | (index >= size)).reshape(len(index), -1).any(1)
        if outside.any():
            raise InputError(
                f"{table.source(outside.argmax())}: {name} index {index[outside.argmax()]} is "
                f"not among the {size} {things}"
            )


def _check_cameras(network: Network) -> Network:
    check_unique([camera.id for camera in network.cameras], Source("cameras"), "camera")
    for camera in network.cameras:
        check_camera(camera)
    used, index = np.unique(network.images.camera, return_inverse=True)
    if len(used) == len(network.cameras):
        return network
    unused = [c.id for i, c in enumerate(network.cameras) if i not in used]
    images = network.images
    images = Images(
        images.id, index.reshape(-1), images.position, images.angles, images.sigma, images.source
    )
    cameras = tuple(network.cameras[i] for i in used)
    return network.replace(cameras=cameras, images=images).warn(
        f"left out {count(len(unused), 'camera')} without images: {some(unused)}"
    )


def _check_images(network: Network) -> None:
    images = network.images
    check_unique(images.id, images.source, "image")
    place = lambda row: f"{images.source(row)}: image {images.id[row]!r}: "
    values = np.concatenate([images.position, images.angles], 1)
    for row, k in np.argwhere(np.isinf(values))[:1]:
        raise InputError(f"{place(row)}{EXTERIOR[k]} is infinite; a number is expected")
    for row, k in np.argwhere(np.abs(images.angles) > 2 * math.pi * 1.01)[:1]:
        value = images.angles[row, k] / ANGLE_UNITS[network.angle_unit]
        hint = "are these degrees? Set angle_unit" if network.angle_unit == "rad" else (
            f"is angle_unit = {network.angle_unit!r} right?"
        )
        raise InputError(
            f"{place(row)}{EXTERIOR[3 + k]} is {value:.6g} {network.angle_unit}, more than a "
            f"full turn; {hint}"
        )
    sigma = images.sigma
    for row, k in np.argwhere((sigma < 0) | np.isinf(sigma))[:1]:
        raise InputError(
            f"{place(row)}σ of {EXTERIOR[k]} is {sigma[row, k]:g}; it must be positive and "
            'finite, empty (no prior), or "fixed" (0) to hold the value'
        )
    held = (sigma[:, 3:] == 0).sum(1)
    for row in np.flatnonzero((held > 0) & (held < 3))[:1]:
        raise InputError(
            f"{place(row)}omega, phi, kappa can be held fixed only all three together; give "
            "the others a small σ instead"
        )


def _check_points(network: Network) -> Network:
    """Also: control points without σ become fixed, those with no controlled axis tie."""
    points = network.points
    check_unique(points.id, points.source, "point")
    for row, role in enumerate(points.role):
        if role not in ROLES:
            raise InputError(
                f"{points.source(row)}: point {points.id[row]!r}: role must be one of "
                f"{', '.join(ROLES)}, not {role!r}"
            )
    place = lambda row: f"{points.source(row)}: {points.role[row]} point {points.id[row]!r}: "
    for row, k in np.argwhere(np.isinf(points.position))[:1]:
        raise InputError(f"{place(row)}{AXES[k]} is infinite; a number is expected")
    missing = np.isnan(points.position) & ~points.has_role("tie")[:, None]
    for row, k in np.argwhere(missing)[:1]:
        raise InputError(f"{place(row)}{AXES[k]} is missing; give the known coordinate")

    sigma, control = points.sigma, points.has_role("control")
    for row, k in np.argwhere(control[:, None] & (sigma <= 0))[:1]:
        raise InputError(
            f"{place(row)}σ of {AXES[k]} is {sigma[row, k]:g}; it must be positive; leave all "
            'three σ empty to hold the point, write "free" for an axis that is not controlled'
        )
    none = control & np.isnan(sigma).all(1)
    for row, k in np.argwhere((control & ~none)[:, None] & np.isnan(sigma))[:1]:
        raise InputError(
            f"{place(row)}σ of {AXES[k]} is missing while another axis has one; give all three, "
            'write "free" for an axis that is not controlled'
        )
    unused = points.has_role("tie", "fixed") & ~np.isnan(sigma).all(1)
    loose = control & np.isposinf(sigma).all(1)
    names = lambda mask: some(points.id[row] for row in np.flatnonzero(mask))
    network = network.replace(points=with_roles(with_roles(points, none, "fixed"), loose, "tie"))
    if unused.any():
        network = network.warn(
            f"σ of {count(unused.sum(), 'tie or fixed point')} not used (only control points "
            f"have one): {names(unused)}"
        )
    if loose.any():
        network = network.warn(
            f"{count(loose.sum(), 'control point')} with all axes free taken as tie: {names(loose)}"
        )
    return network


def _check_observations(network: Network) -> None:
    observations = network.observations
    image = lambda row: network.images.id[observations.image[row]]
    point = lambda row: network.points.id[observations.point[row]]
    for row, k in np.argwhere(~np.isfinite(observations.xy))[:1]:
        raise InputError(
            f"{observations.source(row)}: {'xy'[k]} of point {point(row)!r} in image "
            f"{image(row)!r} is {observations.xy[row, k]}; a finite number is expected"
        )
    sigma = observations.sigma
    for row, k in np.argwhere(~(np.isfinite(sigma) & (sigma > 0)))[:1]:
        raise InputError(
            f"{observations.source(row)}: σ of {'xy'[k]} of point {point(row)!r} in image "
            f"{image(row)!r} is {sigma[row, k]:g}; it must be finite and positive: correct it, "
            "or leave it empty to use sigma_image"
        )
    key = observations.image.astype(np.int64) * len(network.points) + observations.point
    order = np.argsort(key, kind="stable")
    for k in np.flatnonzero(np.diff(key[order]) == 0)[:1]:
        first, second = order[k], order[k + 1]
        raise InputError(
            f"{observations.source(second)}: point {point(second)!r} in image {image(second)!r} "
            f"stands already in {observations.source(first)}; remove one of them"
        )


def _check_distances(network: Network) -> Network:
    """Also: distances between two fixed points are left out."""
    distances, points = network.distances, network.points
    ends = lambda row: " to ".join(repr(points.id[k]) for k in distances.points[row])
    place = lambda row: f"{distances.source(row)}: distance {ends(row)}: "
    for row in np.flatnonzero(distances.points[:, 0] == distances.points[:, 1])[:1]:
        raise InputError(f"{place(row)}it needs two different points")
    for name in ("value", "sigma"):
        column = getattr(distances, name)
        for row in np.flatnonzero(~(np.isfinite(column) & (column > 0)))[:1]:
            raise InputError(
                f"{place(row)}{name} is {column[row]:g}; it must be finite and positive"
            )
    for row in np.flatnonzero(points.has_role("check")[distances.points].any(1))[:1]:
        raise InputError(
            f"{place(row)}a check point takes no part in the adjustment; make it a tie point or "
            "remove the distance"
        )
    idle = points.has_role("fixed")[distances.points].all(1)
    if idle.any():
        network = without_distances(network, idle).warn(
            f"left out {count(idle.sum(), 'distance')} between fixed points: "
            f"{ends(idle.argmax())}{' …' if idle.sum() > 1 else ''}"
        )
    return network


def _check_datum_points(network: Network) -> None:
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


def _check_start_values(network: Network) -> None:
    images, points = network.images, network.points
    values = np.concatenate([images.position, images.angles], 1)
    _refuse_missing(images, values, EXTERIOR, "image")
    taking_part = np.where(points.has_role("check")[:, None], 0.0, points.position)
    _refuse_missing(points, taking_part, AXES, "tie point")


def _refuse_missing(table, values, names, thing):
    missing = np.isnan(values)
    if not missing.any():
        return
    row, k = np.argwhere(missing)[0]
    more = missing.any(1).sum() - 1
    also = f" (and for {more} more)" if more else ""
    raise InputError(
        f"{table.source(row)}: {thing} {table.id[row]!r} has no start value of {names[k]}{also}; "
        "give start values"
    )


def _warn_of_points_behind(network: Network) -> Network:
    """A warning where a start value puts a point behind the camera that sees it (q ≥ 0)."""
    images, rays = network.images, network.observations
    omega, phi, _ = images.angles.T
    axis = np.stack([np.sin(phi), -np.cos(phi) * np.sin(omega), np.cos(phi) * np.cos(omega)], 1)
    ray = network.points.position[rays.point] - images.position[rays.image]
    behind = np.flatnonzero((axis[rays.image] * ray).sum(1) >= 0)
    if not len(behind):
        return network
    first = "; ".join(
        f"point {network.points.id[rays.point[row]]!r} in image {images.id[rays.image[row]]!r}"
        for row in behind[:3]
    )
    return network.warn(
        f"the start values put {count(len(behind), 'image point')} behind the camera: {first}"
        f"{' …' if len(behind) > 3 else ''}; check the start values and the angle unit"
    )
