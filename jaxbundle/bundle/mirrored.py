"""Control that fits the mirror image of a network: an axis of the image coordinates, or of the
control, is in the other direction, or X and Y of the control are exchanged.

Without start values of the expected convention a mirrored image has good ones: of the mirrored
object, and of a nearly plane object almost the same. Only the adjustment does not fit its control.
Turned images are none of this: κ takes them.
"""

import dataclasses
from collections.abc import Callable

import numpy as np

from jaxbundle.cameras import get_model
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.network.sightings import count_controlled_axes
from jaxbundle.network.tables import Network
from jaxbundle.orientation.conventions import EXPECTED_CONVENTION, image_frame

MUCH_BETTER = 5.0
"""Least ratio of σ0 of the given images and of the mirrored ones; below, control is no witness."""
FEWEST_AXES = 9
"""Controlled coordinates: those of three points, of which seven hold a similarity and two can
contradict it."""


def name_mirrored(
    network: Network, sigma0: float | None, try_again: Callable[[Network], float | None]
) -> str:
    """That control fits the mirror image of the network, in words; else empty.

    **Arguments:** `sigma0`: as given, None without a solution; `try_again(network)`: σ0 of
    another network, None without a solution."""
    given = np.isfinite(network.images.sigma).any()
    if network.further or given or count_controlled_axes(network.points).sum() < FEWEST_AXES:
        return ""
    try:
        mirrored = try_again(_mirror(network))
    except (InputError, NotSolvedError):
        return ""
    if mirrored is None or MUCH_BETTER * mirrored > (sigma0 or MUCH_BETTER**2):
        return ""
    instead = f" instead of {sigma0:.3g}" if sigma0 else ""
    unit = get_model(network.cameras[0].model).unit
    axes = "v (or u)" if unit == "px" else "y (or x)"
    return (
        f"the control points fit the mirror image of the network (σ0 {mirrored:.3g}{instead}): "
        "exchange X and Y of the control (lists often give northing first), or reverse "
        f"one of its axes (a right-handed system is expected) or {axes} of the image coordinates "
        f"(expected: {EXPECTED_CONVENTION[unit]})"
    )


def _mirror(network: Network) -> Network:
    """The network with the second axis of its images in the other direction, without start
    values."""
    rays = network.observations
    centre = np.array([image_frame(camera)[0] for camera in network.cameras])
    middle = centre[network.images.camera[rays.image], 1]
    xy = np.stack([rays.xy[:, 0], 2 * middle - rays.xy[:, 1]], 1)
    images, points = network.images, network.points
    unknown, ties = np.full_like(images.position, np.nan), points.has_role("tie")[:, None]
    return network.replace(
        observations=dataclasses.replace(rays, xy=xy),
        images=dataclasses.replace(images, position=unknown, angles=unknown),
        points=dataclasses.replace(points, position=np.where(ties, np.nan, points.position)),
    )
