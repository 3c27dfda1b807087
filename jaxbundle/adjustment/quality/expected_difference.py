r"""The expected difference of two calibrations.

The images of one ray by two independent calibrations differ, to first order, by

    C(d) = C_a + C_b,       C = A·Cp·Aᵀ

at every image position, each without the rotation that an exterior orientation absorbs
(`projection`, frames "rotation" and "camera"). A difference (`cameras.compare`) well above its σ
means that the camera has changed, or that a model does not fit.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from jaxbundle.adjustment.quality.projection_uncertainty import interior_covariance_of_images
from jaxbundle.cameras import CameraModel, Comparison, default_parameters
from jaxbundle.cameras.pixel_frame import between_frames

# Names of free parameters, and their covariance.
Covariance = tuple[Sequence[str], Float[np.ndarray, "k k"]]


def expected_difference(
    comparison: Comparison,
    a: tuple[CameraModel, Mapping[str, float]],
    b: tuple[CameraModel, Mapping[str, float]],
    covariances: tuple[Covariance, Covariance],
    *,
    image_size: Sequence[float] | None = None,
    pixel_size: Sequence[float] | None = None,
    rotate: bool = True,
) -> Float[np.ndarray, "rows columns 2 2"]:
    """The covariance of a difference map, in the unit and axes of the first calibration.

    **Arguments:** the comparison of a and b, and what it was made from; `covariances` of their
    free parameters.

    **Returns:** NaN where the difference is undefined.
    """
    xy = np.stack(np.meshgrid(comparison.x, comparison.y), -1).reshape(-1, 2)
    image_in_b = xy + comparison.difference.reshape(-1, 2)
    frame, total = "rotation" if rotate else "camera", 0.0
    for (model, stated), (names, C), places in (
        (a, covariances[0], xy),
        (b, covariances[1], image_in_b),
    ):
        shift, step = between_frames(model, a[0], image_size, pixel_size)
        values = {**default_parameters(model), **stated}
        p = np.array([values[name] for name in model.parameters], float)
        free = tuple(model.parameters.index(name) for name in names)
        own_covariance = interior_covariance_of_images(
            model, p, free, C, (places - shift) / step, frame
        )
        total = total + step[:, None] * own_covariance * step
    return np.where(np.isfinite(image_in_b)[:, :, None], total, np.nan).reshape(
        *comparison.length.shape, 2, 2
    )
