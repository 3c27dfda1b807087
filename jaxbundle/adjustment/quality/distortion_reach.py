"""Check that the distortion of the adjusted cameras is one-to-one over their measurements."""

import dataclasses

import numpy as np
from jaxtyping import Float

from jaxbundle.adjustment.problem import NetworkProblem
from jaxbundle.cameras import get_model, validity_message
from jaxbundle.cameras.validity import measured_centre
from jaxbundle.leastsquares.indexing.rows import Values


@dataclasses.dataclass(frozen=True)
class Reach:
    """The radius to which the distortion of a camera is checked, in the unit of its model.

    `radius`: half the diagonal of the image (`of_image`), or the farthest measurement if the
    image size is unknown. `message`: None, or that the distortion turns back inside.
    """

    radius: float
    of_image: bool
    message: str | None


def distortion_reach(problem: NetworkProblem, values: Values) -> dict[str, Reach]:
    """The checked radius of every camera, by id."""
    reach_of = {}
    farthest = farthest_measurements(problem, values)
    interior = np.asarray(problem.interior_orientation(values))
    for camera, p, farthest_radius in zip(problem.network.cameras, interior, farthest):
        model = get_model(camera.model)
        size, pitch = camera.image_size, camera.pixel_size
        if size is not None and model.unit == "px":
            radius, of_image = float(np.hypot(*size)) / 2, True
        elif size is not None and pitch is not None:
            radius, of_image = float(np.hypot(size[0] * pitch[0], size[1] * pitch[1])) / 2, True
        else:
            radius, of_image = float(farthest_radius), False
        # Beyond the measurements a polynomial may do anything: where the size of the image is not
        # known, only the measured part is judged.
        parameters = dict(zip(model.parameters, p.tolist()))
        message = validity_message(camera.id, model, parameters, radius) if radius > 0 else None
        reach_of[camera.id] = Reach(radius, of_image, message)
    return reach_of


def farthest_measurements(problem: NetworkProblem, values: Values) -> Float[np.ndarray, " cameras"]:
    """The largest distance of a measurement of every camera from its principal point."""
    cameras = problem.network.cameras
    models = [get_model(camera_of_network.model) for camera_of_network in cameras]
    centre = np.array(
        [
            measured_centre(model, p[: len(model.parameters)])
            for model, p in zip(models, np.asarray(problem.interior_orientation(values)))
        ]
    )
    camera = problem.camera
    is_used, xy = problem.used, problem.image_coordinates()
    distance = np.linalg.norm(xy - centre[camera], axis=1)
    farthest = np.zeros(len(cameras))
    np.fmax.at(farthest, camera[is_used], distance[is_used])  # NaN: a camera without a solution
    return farthest
