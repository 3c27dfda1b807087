"""A calibration with the arguments and the result of `cv2.calibrateCamera`."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxbundle.arguments import numeric_array
from jaxbundle.batches.calibrate import calibrate_batch
from jaxbundle.batches.result import BatchCalibration
from jaxbundle.cameras import get_model
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.geometry.pose_conventions import cv_pose

INTERIOR = ("fx", "fy", "cx", "cy")
# OpenCV's order of coefficients, of which a vector has 4, 5, 8, 12 or 14: those of the model, and
# the tilt of the sensor.
COEFFICIENTS = (*get_model("opencv").parameters[len(INTERIOR) :], "taux", "tauy")
LENGTHS = (5, 8, 12, 14)


class OpenCVCalibration(tuple):
    """What `cv2.calibrateCamera` returns, `rms, K, dist, rvecs, tvecs`, and the uncertainties.

    **Attributes:** `rms`, `camera_matrix`, `dist_coeffs`, `rvecs`, `tvecs`: the five of the tuple;
    `parameters` that were estimated, in the order of `covariance`; `sigma` by name (pixels, none
    of coefficients); `sigma0`, pixels; `redundancy`; `result`: the `BatchCalibration` of one camera
    that it is of, with σ of the poses.
    """

    result: BatchCalibration

    def __new__(cls, values: Sequence[Any], result: BatchCalibration) -> "OpenCVCalibration":
        calibration = super().__new__(cls, values)
        calibration.result = result
        return calibration

    rms = property(lambda self: self[0])
    camera_matrix = property(lambda self: self[1])
    dist_coeffs = property(lambda self: self[2])
    rvecs = property(lambda self: self[3])
    tvecs = property(lambda self: self[4])

    @property
    def parameters(self) -> tuple[str, ...]:
        return self.result.parameters

    @property
    def sigma(self) -> dict[str, float]:
        """σ of the estimated parameters, a posteriori."""
        return dict(zip(self.result.parameters, self.result.sigma[0].tolist()))

    @property
    def covariance(self) -> Float[np.ndarray, "k k"]:
        return self.result.covariance[0]

    @property
    def sigma0(self) -> float:
        return float(self.result.sigma0[0])

    @property
    def redundancy(self) -> int:
        return int(self.result.redundancy[0])

    def __repr__(self) -> str:
        values_in_words = ", ".join(f"{name} ± {value:.3g}" for name, value in self.sigma.items())
        return f"OpenCVCalibration(rms={self[0]:.4f} px, {values_in_words})"


def calibrate_opencv(
    object_points: Sequence[Any],
    image_points: Sequence[Any],
    image_size: tuple[int, int],
    *,
    free: Sequence[str] | None = None,
    snooping: str | None = None,
) -> OpenCVCalibration:
    """Calibrate a camera with the arguments of `cv2.calibrateCamera`.

        rms, K, dist, rvecs, tvecs = found = jaxbundle.calibrate_opencv(objects, images, size)
        found.sigma["fx"], found.covariance

    **Arguments:**

    - `object_points`, `image_points`: for each view an array [n, 3] and [n, 2] (or [n, 1, 2]), as
      OpenCV has them; views may have different points.
    - `image_size`: (columns, rows).
    - `free`: estimated parameters; default: fx, fy, cx, cy, k1, k2, p1, p2, k3, those of OpenCV
      without flags.
    - `snooping`: `"pope"` removes blunders; default: nothing is removed, as in OpenCV.

    **Returns:** an `OpenCVCalibration`, a tuple like OpenCV's: the RMS (pixels), the camera matrix,
    the coefficients [1, 5] (or 8, 12, 14 where such are free), and the rotation vector and the
    shift [3, 1] of every view; NaN for a view that could not be used.

    **Raises:** `InputError` for arrays of other shapes; `NotSolvedError` without a solution.
    """
    objects = [
        _view("object_points", k, points_of_view, 3)
        for k, points_of_view in enumerate(object_points)
    ]
    images = [
        _view("image_points", k, points_of_view, 2) for k, points_of_view in enumerate(image_points)
    ]
    if not objects or len(objects) != len(images):
        raise InputError(
            f"{len(objects)} views of object_points and {len(images)} of image_points are given; "
            "expected one of each for every view"
        )
    for k, (X, x) in enumerate(zip(objects, images)):
        if len(X) != len(x):
            raise InputError(
                f"view {k}: {len(X)} object points and {len(x)} image points; expected equal "
                "numbers"
            )
    # Views of one object share its points: the union, with those not seen as missing.
    points, places = np.unique(np.concatenate(objects), axis=0, return_inverse=True)
    xy = np.full((1, len(objects), len(points), 2), np.nan)
    ends = np.cumsum([0, *map(len, objects)])
    places = np.ravel(places)
    for k, x in enumerate(images):
        rows = places[ends[k] : ends[k + 1]]
        if len({*rows.tolist()}) < len(rows):
            raise InputError(f"view {k}: an object point occurs twice")
        xy[0, k, rows] = x
    calibration = calibrate_batch(points, xy, image_size, free=free, snooping=snooping)
    if not calibration.solved[0]:
        raise NotSolvedError(f"the camera is not determined: {calibration.status[0]}")
    interior = dict(zip(get_model("opencv").parameters, calibration.interior[0].tolist()))
    fx, fy, cx, cy = (interior[name] for name in INTERIOR)
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    coefficients = np.array([interior.get(name, 0.0) for name in COEFFICIENTS])
    free_names = {*calibration.parameters}
    last_coefficient = max((i for i, n in enumerate(COEFFICIENTS) if n in free_names), default=0)
    length = next(n for n in LENGTHS if n > last_coefficient)
    R, t = cv_pose(calibration.rotation[0], calibration.position[0])
    rvecs = tuple(_rotation_vector(matrix)[:, None] for matrix in np.asarray(R))
    tvecs = tuple(np.asarray(shift)[:, None] for shift in np.asarray(t))
    return OpenCVCalibration(
        (float(calibration.rms[0]), K, coefficients[None, :length], rvecs, tvecs), calibration
    )


def _view(name: str, k: int, points: Any, width: int) -> Float[np.ndarray, "n width"]:
    array = numeric_array(f"{name}[{k}]", points, f"an array [n, {width}]").astype(float)
    if array.size and array.ndim > 1 and array.shape[-1] == width:
        return array.reshape(-1, width)
    raise InputError(f"{name}[{k}]: expected an array [n, {width}], got {list(array.shape)}")


def _rotation_vector(R: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3"]:
    """Axis times angle (Rodrigues), which OpenCV calls rvec."""
    if not np.isfinite(R).all():
        return np.full(3, np.nan)
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(R).as_rotvec()
