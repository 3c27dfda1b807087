"""Detection of wrong angle units of start values: degrees for gon, radians, …

Start values of images and points predict every image point. If the predictions are far from
the measurements, but close with the same numbers in another unit, that is their unit.
"""

import numpy as np

from jaxbundle.network.tables import Network
from jaxbundle.network.units import ANGLE_UNITS
from jaxbundle.orientation import batched
from jaxbundle.orientation.incremental import Model, misclosures
from jaxbundle.orientation.rays import make_sights
from jaxbundle.orientation.settings import DEFAULTS, StartValueSettings


def name_angle_unit(network: Network, settings: StartValueSettings = DEFAULTS) -> str:
    """The unit in which the start values of the images fit the measurements, in words; empty if the
    given one fits, or no other does."""
    sights, images = make_sights(network), network.images
    poses = np.concatenate([images.position, images.angles], axis=1)
    has_pose = np.all(np.isfinite(poses), axis=1)
    has_coordinates = np.all(np.isfinite(network.points.position), axis=1)
    rows = has_pose[sights.image] & has_coordinates[sights.point]
    radians_per_given_unit = ANGLE_UNITS[network.angle_unit]
    if not rows.any():
        return ""
    median_by_unit = {}
    for unit, factor in ANGLE_UNITS.items():
        model = Model.empty(sights)
        M = batched.matrices(images.angles[has_pose] * factor / radians_per_given_unit)
        model.place(has_pose, images.position[has_pose], M)
        model.X[has_coordinates] = network.points.position[has_coordinates]
        relative_misclosures = (
            misclosures(sights, model)[rows] / sights.tolerance[sights.image[rows]]
        )
        median_by_unit[unit] = float(np.median(relative_misclosures))
    best = min(median_by_unit, key=median_by_unit.__getitem__)
    # Half of the image points out of the question in the given unit, half within the tolerance in
    # another; start values that are only poor are neither.
    if not (median_by_unit[best] < 1 and median_by_unit[network.angle_unit] > settings.gross_ratio):
        return ""
    return (
        f"the start values of the images fit the measurements if omega, phi, kappa are in {best}, "
        f'not in {network.angle_unit}: set angle_unit = "{best}"'
    )
