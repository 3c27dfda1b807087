"""Prior tables of a network as a design uses them: information, whatever the values observed.

A network written by an adjustment has its priors in tables, because what was observed differs from
the adjusted values. σ of a design follow from the Jacobian at the stations of the design, so that
only the σ of priors count: those of orientations go to the images, where they follow a station that
moves, and those of camera parameters observe the values that the cameras have.
"""

import dataclasses

import numpy as np

from jaxbundle.cameras import default_parameters, get_model
from jaxbundle.network.kinds import CameraParameters, ExteriorPriors
from jaxbundle.network.kinds.base import rows_of
from jaxbundle.network.kinds.camera_parameters import RATIO
from jaxbundle.network.tables import Network


def use_prior_tables(network: Network) -> Network:
    """The network with the priors of its cameras and of its tables `exterior_priors` and
    `camera_parameters` at its own values."""
    cameras = tuple(dataclasses.replace(camera, observed={}) for camera in network.cameras)
    other_tables = []
    for rows in network.further:
        if isinstance(rows, ExteriorPriors):
            network = _move_to_images(network, rows)
        elif isinstance(rows, CameraParameters):
            other_tables.append(_observe_present_values(network, rows))
        else:
            other_tables.append(rows)
    return network.replace(cameras=cameras, further=tuple(other_tables))


def _move_to_images(network: Network, priors: ExteriorPriors) -> Network:
    """σ of orientations in the table of images; two of the same element are combined."""
    # Independent observations of one element: their weights p = 1/σ² add. σ = 0 is fixed, and
    # stays.
    sigma = network.images.sigma.copy()
    weight = np.where(sigma > 0, 1 / np.where(sigma > 0, sigma, 1.0) ** 2, 0.0)
    np.add.at(weight, rows_of(priors.image, network.images), 1 / priors.sigma**2)
    new = (weight > 0) & (sigma != 0)
    sigma[new] = 1 / np.sqrt(weight[new])
    return network.replace(images=dataclasses.replace(network.images, sigma=sigma))


def _observe_present_values(network: Network, priors: CameraParameters) -> CameraParameters:
    values = {
        camera.id: {**default_parameters(get_model(camera.model)), **camera.parameters}
        for camera in network.cameras
    }

    def value(camera: str, parameter: str) -> float:
        name, _, divisor = parameter.partition(RATIO)
        parameters = values[camera]
        return float(parameters[name] / parameters[divisor] if divisor else parameters[name])

    present = [value(*row) for row in zip(priors.camera, priors.parameter, strict=True)]
    return dataclasses.replace(priors, value=np.array(present))
