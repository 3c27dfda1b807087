r"""A datum fixed only by collinear projection centres: a single strip with GNSS.

Their coordinates fix position, scale and two rotations; the third, about the line, moves none of
them. Centres off the line by s fix the roll of the block to about σ/(s·√n).
"""

import numpy as np

from jaxbundle.errors import InputError
from jaxbundle.geometry.principal_axes import principal_axes
from jaxbundle.network.tables import Network

REMEDY = (
    "give a control point beside the strip, a σ of omega or phi, or photographs of a crossing strip"
)


def check_single_strip(network: Network, max_roll_sigma: float = 1.0) -> Network:
    """The network, with a warning if the rotation about the line of its projection centres is
    poorly determined: its σ above `max_roll_sigma`, degrees (half a metre of height 30 m beside the
    strip).

    **Raises:** `InputError` if it is undetermined.
    """
    images, points = network.images, network.points
    sigma = images.sigma[:, :3]
    has_sigma = np.isfinite(sigma).all(1)
    is_known = points.has_role("control") | points.has_role("fixed")
    has_other_datum = np.isfinite(images.sigma[:, 3:]).any() or is_known.any()
    if network.datum != "control" or has_other_datum or has_sigma.sum() < 2:
        return network
    centres = images.position[has_sigma] - images.position[has_sigma].mean(0)
    extents, axes = principal_axes(centres)
    offsets = np.linalg.norm(centres - np.outer(centres @ axes[0], axes[0]), axis=1)
    if np.isfinite(images.sigma[~has_sigma, :3]).any() or not extents[0] > 0:
        return network
    where = f"{images.source.name}: the {has_sigma.sum()} projection centres with σ lie on one line"
    # Coordinates with seven digits that lie on a line do so to their rounding.
    if offsets.max() < 1e-7 * extents[0]:
        raise InputError(
            f"{where} and nothing else fixes the datum: the rotation about the axis of the strip "
            f'(its roll) is not determined; {REMEDY}, or choose datum = "inner" or "minimal"'
        )
    offset_norm = float(np.sqrt((offsets**2).sum()))
    roll = float(np.degrees(np.sqrt(np.mean(sigma[has_sigma] ** 2)) / offset_norm))
    if roll > max_roll_sigma:
        return network.warn(
            f"{where} but for {offsets.max():.2g} {network.object_unit}: the rotation about the "
            f"axis of the strip (its roll) is known only to about {roll:.2g}°; {REMEDY}"
        )
    return network
