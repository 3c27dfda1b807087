"""Cameras of a batch with a bad fit, and the likely cause.

A camera is a misfit on its own if few points contribute most of vᵀv. The lengths of normal
residuals have √(mean of squares)/mean = 2/√π = 1.128; beyond 1.5 times that they are not normal.
It is a misfit compared with others if its RMS is above 3 times their median, and above it, in the
logarithm, by more than 5 times their spread (1.4826 times the median deviation). With fewer than 5
cameras there is no spread: then its RMS is above 10 times the smallest of the others
(`MisfitSettings`).

Not detected are errors spread so evenly that the residuals look normal, in a single camera,
in all cameras alike, or below these factors.
"""

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from jaxbundle.batches.input import Batch
from jaxbundle.cameras import CameraModel
from jaxbundle.leastsquares.quality.distributions import NORMAL_SIGMA_BY_MAD

# √(mean of squares)/mean of the lengths of normal residuals (Rayleigh's distribution).
NORMAL = 2 / np.sqrt(np.pi)


@dataclasses.dataclass(frozen=True)
class MisfitSettings:
    """From where residuals are too large, and image points are suspicious.

    **Fields:**

    - `max_tail`: of the ratio √(mean of squares)/mean of residual lengths, in that of normal ones:
      1 for normal residuals, 1.2 if half the views are five times as noisy as the others.
    - `min_ratio`, `max_deviations`: of the RMS to the median of the cameras, and of its logarithm
      from the median in robust standard deviations; both must be exceeded. The second alone
      would find cameras in a batch of equal ones, the first alone in a batch of unequal ones.
    - `min_ratio_of_few`: the same with fewer than `min_cameras`, where there is no spread: lenses,
      boards and focus of two good cameras may differ by less than this.
    - `min_cameras`: solved cameras of a population.
    - `negligible`: a smaller RMS is never a misfit, pixels; that of measured corners is larger.
    - `far_outside`: points farther outside the image, in image sizes, are not measurements.
    - `min_extent`: if the image points span less of the image, they are probably no pixels.
    - `max_outside_of_good`: if a larger fraction is outside although the camera fits, its image has
      another size: points found by correlation are never outside, and blunders are fewer.
    - `max_outside`: if a larger fraction of image points is outside the image, their axes are
      probably wrong.
    """

    max_tail: float = 1.5
    min_ratio: float = 3.0
    max_deviations: float = 5.0
    min_ratio_of_few: float = 10.0
    min_cameras: int = 5
    negligible: float = 0.01
    far_outside: float = 1.0
    min_extent: float = 0.05
    max_outside_of_good: float = 0.01
    max_outside: float = 0.5


DEFAULTS = MisfitSettings()


def misfits(
    rms: Float[np.ndarray, " cameras"],
    mean_length: Float[np.ndarray, " cameras"],
    solved: Bool[np.ndarray, " cameras"],
    settings: MisfitSettings = DEFAULTS,
) -> Bool[np.ndarray, " cameras"]:
    """Which solved cameras do not fit; `mean_length` of their residuals (pixels)."""
    is_misfit = np.zeros(len(rms), bool)
    # A few blunders raise √(mean of squares), hardly the mean: their ratio is a test of one camera
    # by itself, without knowing the noise.
    candidates = np.flatnonzero(solved & (rms > settings.negligible))
    is_misfit[candidates] = rms[candidates] > settings.max_tail * NORMAL * mean_length[candidates]
    factor = settings.min_ratio_of_few
    if solved.sum() >= settings.min_cameras:
        # In the logarithm, since an RMS is positive and its scatter proportional to it.
        log = np.log(np.maximum(rms[solved], settings.negligible))
        scatter = NORMAL_SIGMA_BY_MAD * np.median(np.abs(log - np.median(log)))
        factor = np.exp(max(np.log(settings.min_ratio), settings.max_deviations * scatter))
    return is_misfit | (rms > factor * reference_rms(rms, solved, settings))


def reference_rms(
    rms: Float[np.ndarray, " cameras"],
    solved: Bool[np.ndarray, " cameras"],
    settings: MisfitSettings = DEFAULTS,
) -> Float[np.ndarray, " cameras"]:
    """The reference of the RMS of each solved camera: the median of all, for few cameras the
    smallest of the others; NaN for a single camera, and one without a solution."""
    reference = np.full(len(rms), np.nan)
    solved_rms = np.maximum(rms[solved], settings.negligible)
    if len(solved_rms) >= settings.min_cameras:
        reference[solved] = np.median(solved_rms)
    elif len(solved_rms) > 1:
        smallest, second_smallest = np.sort(solved_rms)[:2]
        reference[solved] = np.where(
            np.arange(len(solved_rms)) == solved_rms.argmin(), second_smallest, smallest
        )
    return reference


def rms_remark(rms: float, reference: float) -> str:
    """A remark if the RMS is far above that of the other cameras."""
    if not rms > DEFAULTS.min_ratio * reference:
        return ""
    return (
        f"RMS {rms:.2g} px against {reference:.2g} px of the others: wrong points may be why "
        "parameters are not determined"
    )


def far_outside(
    xy: Float[np.ndarray, "cameras views points 2"],
    visible: Bool[np.ndarray, "cameras views points"],
    size: Float[np.ndarray, "2"],
    y_down: bool,
) -> Bool[np.ndarray, "cameras views points"]:
    """Which visible points are so far outside the image that they cannot be measurements; none for
    a camera with most points outside, since then the axes or the size are wrong."""
    is_far = visible & _beyond(xy, size, y_down, DEFAULTS.far_outside)
    has_most_outside = is_far.sum((1, 2)) > DEFAULTS.max_outside * visible.sum((1, 2))
    return is_far & ~has_most_outside[:, None, None]


def _corner(size: Float[np.ndarray, "2"], y_down: bool) -> Float[np.ndarray, "2"]:
    """The smallest coordinates in an image."""
    return np.full(2, -0.5) if y_down else -size / 2


def _beyond(
    xy: Float[np.ndarray, "*points 2"], size: Float[np.ndarray, "2"], y_down: bool, margin: float
) -> Bool[np.ndarray, "*points"]:
    """Which points are outside the image by more than `margin` times its size."""
    low = _corner(size, y_down) - margin * size
    high = low + (1 + 2 * margin) * size
    # x and y apart: numpy's `any` over an axis of two takes ten times as long
    x, y = xy[..., 0], xy[..., 1]
    return (x < low[0]) | (x > high[0]) | (y < low[1]) | (y > high[1])


def axes_remark(
    xy: Float[np.ndarray, "points 2"], size: Float[np.ndarray, "2"], y_down: bool
) -> str:
    """A remark about suspicious axes of image points; if most of them are in the image, the number
    of points far outside, if any.

    **Arguments:** `y_down`: y is counted downwards from the upper left pixel, else upwards from the
    middle.
    """
    low = _corner(size, y_down)
    part = _beyond(xy, size, y_down, 0).mean() if len(xy) else 0.0
    if len(xy) and np.ptp(xy, axis=0).max() < DEFAULTS.min_extent * size.max():
        wide, high = np.ptp(xy, axis=0)
        return (
            f"the image points of all views span {wide:.3g} × {high:.3g} of {size[0]:g} × "
            f"{size[1]:g} pixels: are they in pixels, and is image_size right?"
        )
    if part <= DEFAULTS.max_outside:
        number_far = int(_beyond(xy, size, y_down, DEFAULTS.far_outside).sum())
        points = "image point is" if number_far == 1 else "image points are"
        return f"{number_far} {points} far outside the image: data snooping removes them" * (
            number_far > 0
        )
    # Nine points in ten decide about a wrong axis: the others may be blunders.
    if not y_down and ((xy > -0.5) & (xy < size)).all(1).mean() > 0.9:
        return (
            "the image points seem to be counted from a corner of the image: in this model (0, 0) "
            "is its middle, and y goes up"
        )
    if not y_down:
        return f"{100 * part:.0f} % of the image points are outside the image"
    for axis, name in enumerate("xy"):
        negated = (xy[:, axis] < low[axis]) & (xy[:, axis] > -size[axis] - 0.5)
        if negated.mean() > 0.9:
            return f"the {name} axis of the image points seems to be negated: {name} < 0"
    if (np.abs(xy) <= size / 2 + 1).all(1).mean() > 0.9:
        return (
            "the image points seem to be counted from the middle of the image: (0, 0) is its upper "
            "left pixel"
        )
    return f"{100 * part:.0f} % of the image points are outside the image: is image_size right?"


def remarks(
    model: CameraModel, batch: Batch, rows: dict[str, Any], good: Bool[np.ndarray, " cameras"]
) -> np.ndarray:
    """A remark about suspicious image points, if the principal point is outside the image or there
    is no good result; for an undetermined camera, about its RMS."""
    frame = batch.image_size
    if model.principal_point and model.axes == "down":
        columns = [model.parameters.index(name) for name in model.principal_point]
        middle = rows["interior"][:, columns]
        good = good & ((middle > -0.5) & (middle < frame - 0.5)).all(1)
    remark = [""] * len(batch)
    number_outside = (batch.visible & _beyond(batch.xy, frame, model.axes == "down", 0)).sum((1, 2))
    part = number_outside / np.maximum(batch.visible.sum((1, 2)), 1)
    for camera in np.flatnonzero(good & (part > DEFAULTS.max_outside_of_good)):
        remark[camera] = (
            f"{100 * part[camera]:.0f} % of the image points are outside the image of "
            f"{frame[0]:g} × {frame[1]:g} pixels: is image_size right (width, height), or are x "
            "and y exchanged?"
        )
    reference = reference_rms(rows["rms"], np.isfinite(rows["rms"]))
    vague = rows["undetermined"].any(1)
    for camera in np.flatnonzero(~good & batch.finite):
        xy = batch.xy[camera][batch.visible[camera]]
        remarks_of_camera = [axes_remark(xy, frame, model.axes == "down")]
        if vague[camera]:
            remarks_of_camera.append(rms_remark(rows["rms"][camera], reference[camera]))
        remark[camera] = "; ".join(filter(None, remarks_of_camera))
    return np.array(remark)
