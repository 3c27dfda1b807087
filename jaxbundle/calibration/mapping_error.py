r"""The expected mapping error of a calibration: one number, comparable between camera models.

With true parameters p + Δp in place of p, the image of every ray moves. After removing the rotation
that later orientations absorb (A' of `adjustment.quality.projection_uncertainty`, frame
"rotation"), the mean squared displacement over the grid of `cameras.compare` is, to first order,
the quadratic form

    K = Δpᵀ·H·Δp,       H = mean of A'ᵀA' over the image

Δp has the covariance C of the calibration. So K is distributed as Σ λᵢ·χ²₁, λ the eigenvalues of
C^½·H·C^½, and the **expected mapping error** is

    EME = E(K) = trace(C^½·H·C^½) = Σ λᵢ

Image points without a ray do not count. Beyond the farthest measured point the camera is
extrapolated; in the black corners of a fisheye photograph, where nothing can be measured, this
extrapolation means nothing and may be large. So the error is also given for the measured part.

Source: Hagemann, Knorr, Janssen, Stiller (2022), Inferring bias and uncertainty in camera
calibration, International Journal of Computer Vision 130.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jaxbundle.adjustment.quality.projection_uncertainty import have_rays, slopes_of_images
from jaxbundle.adjustment.result import Adjustment
from jaxbundle.calibration.pixels import unit_size
from jaxbundle.calibration.quality import grid_of
from jaxbundle.cameras import get_model
from jaxbundle.cameras.convert_fit import GRID
from jaxbundle.cameras.pixel_frame import in_model_units
from jaxbundle.cameras.validity import measured_centre
from jaxbundle.display import print_in_one_screen
from jaxbundle.network.tables import Camera
from jaxbundle.types import not_none


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class MappingError:
    """`weights`: λ, pixels²; their sum `expected` is the expected mapping error. `share`: the
    part of the image it is the mean of. `measured`: that of the image within the farthest
    measured point of the principal point; None if this is all of the image that has rays."""

    weights: Float[np.ndarray, " k"]
    share: float = 1.0
    measured: "MappingError | None" = None

    @property
    def expected(self) -> float:
        """EME, pixels²."""
        return float(self.weights.sum())

    @property
    def rms(self) -> float:
        """√EME: the RMS image error over `share` of the image, pixels."""
        return float(np.sqrt(self.expected))

    def quantile(self, probability: float = 0.95) -> float:
        """The quantile of √K for this probability, pixels; from a reproducible sample."""
        # A weighted sum of χ²₁ has no closed distribution; 20 000 samples give it to 1 %.
        z = np.random.default_rng(0).normal(size=(20_000, len(self.weights)))
        return float(np.sqrt(np.quantile(z**2 @ self.weights, probability)))


def mapping_error(
    adjustment: Adjustment, camera: str, grid: tuple[int, int] = GRID
) -> MappingError:
    """The mapping error of an adjusted camera, whose image size is known.

    **Arguments:** `grid`: columns and rows of the grid for the mean.
    """
    problem = adjustment.problem
    column = [camera_of_network.id for camera_of_network in problem.network.cameras].index(camera)
    adjusted_camera = problem.network.cameras[column]
    names, C = adjustment.camera_covariance(camera)
    p = np.array(list(adjustment.camera_parameters(camera).values()))
    model = get_model(adjusted_camera.model)
    uv = grid_of(not_none(adjusted_camera.image_size), *grid).reshape(-1, 2)
    xy = in_model_units(uv, model, adjusted_camera.image_size, adjusted_camera.pixel_size)
    xy = xy[have_rays(model, p, xy)]
    error_of_image = MappingError(
        _weights(_form(adjusted_camera, p, names, xy, "rotation"), C), len(xy) / len(uv)
    )
    # "measured": up to the farthest point from the distortion's centre, since distortion is radial
    farthest = adjustment.farthest_measurements[column]
    distance = np.linalg.norm(xy - np.asarray(measured_centre(model, p)), axis=1)
    within_reach = xy[distance <= farthest]
    # Two points determine the rotation: three angles from two coordinates each.
    if len(within_reach) < 2 or len(within_reach) == len(xy):
        return error_of_image
    part = _weights(_form(adjusted_camera, p, names, within_reach, "rotation"), C)
    return dataclasses.replace(
        error_of_image, measured=MappingError(part, len(within_reach) / len(uv))
    )


def _weights(H: Float[np.ndarray, "k k"], C: Float[np.ndarray, "k k"]) -> Float[np.ndarray, " k"]:
    """λ, by a root of H, in units of σ: C may be numerically singular, as for tied parameters."""
    sigma = np.sqrt(np.diagonal(C))
    unit = np.where(sigma > 0, sigma, 1.0)
    # λ of C^½·H·C^½ are those of H^½ᵀ·C·H^½
    size, V = np.linalg.eigh(H * np.outer(unit, unit))
    root = V * np.sqrt(np.clip(size, 0, None))
    return np.clip(np.linalg.eigvalsh(root.T @ (C / np.outer(unit, unit)) @ root), 0, None)


def mapping_form(
    camera: Camera,
    p: Float[np.ndarray, " parameters"],
    names: Sequence[str],
    grid: tuple[int, int] = GRID,
    frame: str = "rotation",
) -> Float[np.ndarray, "k k"]:
    """H of the named parameters of a camera at the values `p` of all: pixels²; `frame` "camera":
    that of A, without a rotation."""
    model = get_model(camera.model)
    uv = grid_of(not_none(camera.image_size), *grid).reshape(-1, 2)
    xy = in_model_units(uv, model, camera.image_size, camera.pixel_size)
    return _form(camera, p, names, xy, frame)


def _form(
    camera: Camera,
    p: Float[np.ndarray, " parameters"],
    names: Sequence[str],
    xy: Float[np.ndarray, "n 2"],
    frame: str,
) -> Float[np.ndarray, "k k"]:
    model = get_model(camera.model)
    columns = tuple(model.parameters.index(name) for name in names)
    A = slopes_of_images(model, p, columns, xy, frame)
    A = A / np.array(unit_size(model, camera.pixel_size))[:, None]
    A = A[np.isfinite(A).all((1, 2))]
    return np.einsum("nik,nil->kl", A, A) / len(A)
