"""Cameras of a batch that have a solution which does not fit, and what may be the reason.

A camera is a misfit by itself where few points make most of its vᵀv. The lengths of normal
residuals have √(mean of squares)/mean = 2/√π = 1.128; beyond `TAIL` times that they are not normal.
It is one beside the others where its RMS is above `FARTHER` times their median, and above it, in
the logarithm, by more than `DEVIATIONS` times their spread (1.4826 times the median deviation).
Fewer than `FEWEST` cameras have no spread: there its RMS is above `FARTHER_OF_FEW` times the
smallest of the others.

What escapes: errors spread so evenly over the residuals that these look normal, in a camera alone,
in all cameras alike, or below these factors.
"""

import numpy as np
from jaxtyping import Bool, Float

from jaxbundle.batch.input import Batch
from jaxbundle.cameras import CameraModel

TAIL = 1.5
"""1 for normal residuals, 1.2 for half the views five times as noisy as the others."""
NORMAL = 2 / np.sqrt(np.pi)
OF_DEVIATION = 1.4826
"""The standard deviation of a normal distribution over its median absolute deviation."""
FARTHER, DEVIATIONS = 3.0, 5.0
FARTHER_OF_FEW = 10.0
"""Lenses, boards and focus of two good cameras may differ by less than this."""
FEWEST = 5
"""So many solved cameras are a population."""
NEGLIGIBLE = 0.01
"""An RMS below this is no misfit, pixels."""
FAR = 1.0
"""Points outside the image by more than this times its size are no measurements."""
OUTSIDE = 0.5
"""More than this part of the image points is outside the image: their axes are not those meant."""


def misfits(
    rms: Float[np.ndarray, " cameras"],
    mean_length: Float[np.ndarray, " cameras"],
    solved: Bool[np.ndarray, " cameras"],
) -> Bool[np.ndarray, " cameras"]:
    """Which solved cameras do not fit; `mean_length` of their residuals (pixels)."""
    found = np.zeros(len(rms), bool)
    candidates = np.flatnonzero(solved & (rms > NEGLIGIBLE))
    found[candidates] = rms[candidates] > TAIL * NORMAL * mean_length[candidates]
    factor = FARTHER_OF_FEW
    if solved.sum() >= FEWEST:
        log = np.log(np.maximum(rms[solved], NEGLIGIBLE))
        spread = OF_DEVIATION * np.median(np.abs(log - np.median(log)))
        factor = np.exp(max(np.log(FARTHER), DEVIATIONS * spread))
    return found | (rms > factor * rms_beside(rms, solved))


def rms_beside(
    rms: Float[np.ndarray, " cameras"], solved: Bool[np.ndarray, " cameras"]
) -> Float[np.ndarray, " cameras"]:
    """What the RMS of each solved camera is compared with: the median of all, of few cameras the
    smallest of the others; NaN for one alone, and one without a solution."""
    beside = np.full(len(rms), np.nan)
    some = np.maximum(rms[solved], NEGLIGIBLE)
    if len(some) >= FEWEST:
        beside[solved] = np.median(some)
    elif len(some) > 1:
        least, second = np.sort(some)[:2]
        beside[solved] = np.where(np.arange(len(some)) == some.argmin(), second, least)
    return beside


def rms_remark(rms: float, beside: float) -> str:
    """Says so where the RMS is far above that of the other cameras."""
    if not rms > FARTHER * beside:
        return ""
    return (
        f"RMS {rms:.2g} px beside {beside:.2g} px of the others: wrong points may be why "
        "parameters are not determined"
    )


def far_outside(
    xy: Float[np.ndarray, "cameras views points 2"],
    visible: Bool[np.ndarray, "cameras views points"],
    size: Float[np.ndarray, "2"],
    down: bool,
) -> Bool[np.ndarray, "cameras views points"]:
    """Which visible points lie so far outside the image that they cannot be measurements; none of
    a camera where most do, for there the axes or the size are not those meant."""
    far = visible & _beyond(xy, size, down, FAR)
    most = far.sum((1, 2)) > OUTSIDE * visible.sum((1, 2))
    return far & ~most[:, None, None]


def _corner(size, down: bool):
    """The least coordinates in an image."""
    return np.full(2, -0.5) if down else -size / 2


def _beyond(xy, size, down: bool, margin: float):
    """Which points are outside the image by more than `margin` times its size."""
    low = _corner(size, down)
    return ((xy < low - margin * size) | (xy > low + (1 + margin) * size)).any(-1)


def axes_remark(
    xy: Float[np.ndarray, "points 2"], size: Float[np.ndarray, "2"], down: bool
) -> str:
    """What is odd about the axes of image points; where most of them are in the image, how many
    are far outside, if any.

    **Arguments:** `down`: y is counted downwards from the upper left pixel, else upwards from the
    middle.
    """
    low = _corner(size, down)
    part = _beyond(xy, size, down, 0).mean() if len(xy) else 0.0
    if part <= OUTSIDE:
        far = int(_beyond(xy, size, down, FAR).sum())
        points = "image point is" if far == 1 else "image points are"
        return f"{far} {points} far outside the image: data snooping leaves such out" * (far > 0)
    if not down and ((xy > -0.5) & (xy < size)).all(1).mean() > 0.9:
        return (
            "the image points seem to be counted from a corner of the image: in this model (0, 0) "
            "is its middle, and y goes up"
        )
    if not down:
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
    model: CameraModel, batch: Batch, rows: dict, good: Bool[np.ndarray, " cameras"]
) -> np.ndarray:
    """What is odd about the image points: looked for where the principal point is outside the
    image, or there is no good result. Of a camera that is not determined, an RMS that is odd."""
    frame = batch.image_size
    if model.principal_point and model.axes == "down":
        columns = [model.parameters.index(name) for name in model.principal_point]
        middle = rows["interior"][:, columns]
        good = good & ((middle > -0.5) & (middle < frame - 0.5)).all(1)
    remark = [""] * len(batch)
    beside = rms_beside(rows["rms"], np.isfinite(rows["rms"]))
    vague = rows["undetermined"].any(1)
    for camera in np.flatnonzero(~good & batch.finite):
        xy = batch.xy[camera][batch.visible[camera]]
        said = [axes_remark(xy, frame, model.axes == "down")]
        if vague[camera]:
            said.append(rms_remark(rows["rms"][camera], beside[camera]))
        remark[camera] = "; ".join(filter(None, said))
    return np.array(remark)
