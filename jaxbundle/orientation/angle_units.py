"""Detection of wrong angle units of start values: degrees for gon, radians, …

Start values of images and points predict every image point. If the predictions are far from
the measurements, but close with the same numbers in another unit, that is their unit.
"""

import numpy as np

from jaxbundle.network.tables import Network
from jaxbundle.network.units import ANGLE_UNITS
from jaxbundle.orientation import batched
from jaxbundle.orientation.incremental import Model, misclosures
from jaxbundle.orientation.rays import sights
from jaxbundle.orientation.settings import DEFAULTS, StartValueSettings


def name_angle_unit(network: Network, settings: StartValueSettings = DEFAULTS) -> str:
    """The unit in which the start values of the images fit the measurements, in words; empty if the
    given one fits, or no other does."""
    sighted, images = sights(network), network.images
    poses = np.concatenate([images.position, images.angles], axis=1)
    has_pose = np.all(np.isfinite(poses), axis=1)
    is_known = np.all(np.isfinite(network.points.position), axis=1)
    rows = has_pose[sighted.image] & is_known[sighted.point]
    given_factor = ANGLE_UNITS[network.angle_unit]
    if not rows.any():
        return ""
    missed = {}
    for unit, factor in ANGLE_UNITS.items():
        model = Model.empty(sighted)
        M = batched.matrices(images.angles[has_pose] * factor / given_factor)
        model.place(has_pose, images.position[has_pose], M)
        model.X[is_known] = network.points.position[is_known]
        misclosure = misclosures(sighted, model)[rows] / sighted.tolerance[sighted.image[rows]]
        missed[unit] = float(np.median(misclosure))
    best = min(missed, key=missed.__getitem__)
    # Half of the image points out of the question in the given unit, half within the tolerance in
    # another; start values that are only poor are neither.
    if not (missed[best] < 1 and missed[network.angle_unit] > settings.gross_ratio):
        return ""
    return (
        f"the start values of the images fit the measurements if omega, phi, kappa are in {best}, "
        f'not in {network.angle_unit}: set angle_unit = "{best}"'
    )
