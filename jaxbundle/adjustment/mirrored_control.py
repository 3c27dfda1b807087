"""Control that fits the mirror image of a network: an axis of the image coordinates, or of the
control, is in the other direction, or X and Y of the control are exchanged.

Without start values of the expected convention a mirrored image has good ones: of the mirrored
object, and of a nearly plane object almost the same. Only the adjustment does not fit its control.
Turned images are none of this: κ takes them.
"""

import dataclasses
import math
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from jaxbundle.cameras import get_model
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.geometry.principal_axes import principal_axes
from jaxbundle.network.columns import count
from jaxbundle.network.equation_counts import count_controlled_axes
from jaxbundle.network.tables import Network
from jaxbundle.orientation.image_conventions import (
    EXPECTED_CONVENTION,
    convention_of,
    explains_better,
    image_frame,
)
from jaxbundle.orientation.network import lacks_start_values

REMEDY = (
    "exchange X and Y of the control (lists often give northing first), or reverse one of its axes "
    "(a right-handed system is expected)"
)


def name_mirrored(
    network: Network,
    sigma0: float | None,
    try_again: Callable[[Network], float | None],
    largest: float,
) -> str:
    """That control fits the mirror image of the network, in words; else empty.

    **Arguments:** `sigma0`: as given, None without a solution; `try_again(network)`: σ0 of
    another network, None without a solution; `largest` σ0 of a network without mistakes."""
    # The coordinates of three points: seven hold a similarity, and two can contradict it.
    min_axes = 9
    has_priors = np.isfinite(network.images.sigma).any()
    if network.further or has_priors or count_controlled_axes(network.points).sum() < min_axes:
        return ""
    mirrored = _try(_without_start_values(_mirror(network)), try_again)
    if mirrored is None or mirrored > largest:
        return ""
    if sigma0 and not explains_better(mirrored, sigma0):
        return ""
    # The mirrored network was adjusted from computed start values: the given one has to be as well,
    # or poor start values of its own would look like a mirror.
    if not lacks_start_values(network):
        plain = _try(_without_start_values(network), try_again)
        if plain is not None and not explains_better(mirrored, plain):
            return ""
    instead = f" instead of {sigma0:.3g}" if sigma0 else ""
    unit = get_model(network.cameras[0].model).unit
    axes = "v (or u)" if unit == "px" else "y (or x)"
    return (
        f"the control points fit the mirror image of the network (σ0 {mirrored:.3g}{instead}): "
        f"{REMEDY} or {axes} of the image coordinates "
        f"(expected: {EXPECTED_CONVENTION[convention_of(network.cameras[0])]})"
    )


def name_other_side(network: Network, images: dict[str, Float[np.ndarray, "3"]]) -> str:
    """That adjusted images are on the other side of the known points than their start values, at
    about the same distance, in words; else empty. Images of a nearly plane object fit its mirror
    image almost as well.

    **Arguments:** `images`: adjusted projection centres by id."""
    points = network.points
    is_known = points.has_role("control", "fixed") & np.isfinite(points.position).all(1)
    rows = [k for k, id in enumerate(network.images.id) if id in images]
    if is_known.sum() < 3 or not rows:
        return ""
    # The side of the plane of the control: a mirrored image of a nearly plane object is where the
    # camera would be on the other side of it.
    X = points.position[is_known]
    normal = principal_axes(X - X.mean(0))[1][2]
    distance_at_start = (network.images.position[rows] - X.mean(0)) @ normal
    adjusted_distance = (
        np.array([images[network.images.id[k]] for k in rows]) - X.mean(0)
    ) @ normal
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = -adjusted_distance / distance_at_start
    # Within a factor of two of the distance: start values of a block are good to a few percent, and
    # those that say nothing (0, 0, 0) are seldom as far.
    is_on_other_side = (ratio > 1 / 2) & (ratio < 2)
    if 2 * is_on_other_side.sum() <= len(rows):
        return ""
    return (
        f"{count(int(is_on_other_side.sum()), 'image')} of {len(rows)} moved from the start value "
        f"to the other side of the control points, where their mirror image is seen: {REMEDY}"
    )


def name_view_from_below(images: Float[np.ndarray, "images 6"]) -> str:
    """That most images look up within 45° of the zenith, in words; else empty. Control on nearly
    level ground fits a flight as well in the mirror: seen from below.

    **Arguments:** `images`: centres, and ω, φ, κ in radians, in a system with heights."""
    # The camera looks along −z: the direction's height is −cos ω·cos φ.
    height = -np.cos(images[:, 3]) * np.cos(images[:, 4])
    looking_up = int((height > math.sqrt(0.5)).sum())
    if 2 * looking_up <= len(images):
        return ""
    return (
        f"{count(looking_up, 'photograph')} of {len(images)} look up at the control points, from "
        f"below the ground if this is a flight: its mirror image fits, so {REMEDY}"
    )


def _try(network: Network, try_again: Callable[[Network], float | None]) -> float | None:
    try:
        return try_again(network)
    except (InputError, NotSolvedError):
        return None


def _mirror(network: Network) -> Network:
    """The network with the second axis of its images in the other direction."""
    rays = network.observations
    centre = np.array([image_frame(camera)[0] for camera in network.cameras])
    middle = centre[network.images.camera[rays.image], 1]
    xy = np.stack([rays.xy[:, 0], 2 * middle - rays.xy[:, 1]], 1)
    return network.replace(observations=dataclasses.replace(rays, xy=xy))


def _without_start_values(network: Network) -> Network:
    images, points = network.images, network.points
    unknown, ties = np.full_like(images.position, np.nan), points.has_role("tie")[:, None]
    return network.replace(
        images=dataclasses.replace(images, position=unknown, angles=unknown),
        points=dataclasses.replace(points, position=np.where(ties, np.nan, points.position)),
    )
