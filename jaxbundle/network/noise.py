"""The a priori noise of the rays of a network."""

import numpy as np

from jaxbundle.cameras import get_model
from jaxbundle.network.tables import Network


def noise_of_rays(network: Network) -> float:
    """The median a priori σ of an image coordinate, in principal distances."""
    c = np.array(
        [
            min(
                (camera.parameters[n] for n in get_model(camera.model).principal_distance),
                default=1.0,
            )
            for camera in network.cameras
        ]
    )
    camera = network.images.camera[network.observations.image]
    return float(np.median(network.observations.sigma.max(1) / np.abs(c[camera])))
