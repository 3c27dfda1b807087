"""What the views of a camera do not determine: parameters that a status alone does not name.

A singular camera has directions of its interior orientation in which the normal equations, scaled
by their diagonal before the elimination of the views, vanish; the parameters involved are named. If
the noise of the measurements makes the equations solvable, the σ of the result show it: views of a
board all parallel to the image determine neither principal distance nor distances, and the σ of fx
is as large as fx.
"""

import numpy as np
from jaxtyping import Bool, Float

from jaxbundle.batches.camera import INDETERMINATE
from jaxbundle.cameras import CameraModel
from jaxbundle.geometry.principal_axes import principal_axes
from jaxbundle.leastsquares.quality.weakness import VAGUE_RATIO


def is_vague(
    model: CameraModel,
    free: tuple[int, ...],
    interior: Float[np.ndarray, "cameras parameters"],
    sigma: Float[np.ndarray, "cameras k"],
) -> Bool[np.ndarray, "cameras k"]:
    """Principal distances and points with a σ above a fiftieth of the principal distance.

    Distortion coefficients never count: an insignificant one has a σ larger than itself.
    """
    columns = [model.parameters.index(name) for name in model.principal_distance]
    shortest = np.abs(interior[:, columns]).min(1)
    of_these = {model.parameters.index(name) for name in model.core}
    return ~(VAGUE_RATIO * sigma <= shortest[:, None]) & [column in of_these for column in free]


def vanishing(reduced: Float[np.ndarray, "cameras k k"]) -> Bool[np.ndarray, "cameras k"]:
    """Parameters with part in the null space of the scaled reduced normal matrix."""
    finite = np.all(np.isfinite(reduced), axis=(1, 2))
    values, vectors = np.linalg.eigh(np.where(finite[:, None, None], reduced, 0.0))
    # Before the elimination the diagonal is 1, so that an eigenvalue is the part that remains.
    null = values < INDETERMINATE
    share = np.einsum("cij,cj->ci", vectors**2, null.astype(float))
    # A twentieth of the square of the direction: of those that nothing determines, the ones that
    # change visibly together.
    return finite[:, None] & (share > 0.05)


def weak_geometry(
    points: Float[np.ndarray, "points 3"],
    xy: Float[np.ndarray, "views points 2"],
    visible: Bool[np.ndarray, "views points"],
) -> str:
    """Why views of a flat board do not determine a principal distance, in words; "" if their
    geometry does, or the board is not flat.

    The vanishing line of the board, by the homography of each view, shows its tilt: w = 1 + l·x is
    the relative distance of a point at x from the middle of the view. Equal l in all views give two
    conditions for the camera, however many there are (Sturm and Maybank, 1999).
    """
    # Largest change of scale across half of a board that counts as seen from the front, and largest
    # difference between photographs that count as tilted alike: a tilt of 20° at a distance of five
    # boards makes 0.04.
    max_tilt = max_difference = 0.01
    centred = points - points.mean(0)
    size, axes = principal_axes(centred)
    # Flat as given, to six digits: the homographies below know no depth.
    if size[2] > 1e-6 * size[0]:
        return ""
    X = centred @ axes[:2].T / size[0] * np.sqrt(len(points))
    tilts, middles, extents = [], [], []
    for view, is_seen in zip(xy, visible):
        if is_seen.sum() < 6:  # four points determine a homography, two control it
            continue
        tilt, middle, extent = _find_tilt(X[is_seen], view[is_seen])
        tilts.append(tilt)
        middles.append(middle)
        extents.append(extent)
    if len(tilts) < 2 or not np.isfinite(tilts).all():
        return ""
    extent = np.median(extents)
    # The tilts about the middle of one view, in the same unit of length.
    tilts, middles = np.array(tilts) * (extent / np.array(extents))[:, None], np.array(middles)
    if np.linalg.norm(tilts, axis=1).max() < max_tilt:
        return (
            "all photographs look straight at the board: a longer principal distance and a larger "
            "distance give the same images"
        )
    shift = (middles - middles[0]) / extent
    about_one = tilts / (1 - np.einsum("vi,vi->v", tilts, shift))[:, None]
    if np.linalg.norm(about_one - about_one.mean(0), axis=1).max() < max_difference:
        return (
            "all photographs show the board tilted alike, in the same direction of the image: one "
            "tilt does not separate the principal distance from the distance, nor the principal "
            "point from the tilt"
        )
    return ""


def _find_tilt(
    X: Float[np.ndarray, "n 2"], xy: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"], float]:
    """l of a view (`weak_geometry`), about the middle of its points and in units of their extent;
    this middle and extent, pixels."""
    middle = xy.mean(0)
    extent = np.sqrt(((xy - middle) ** 2).sum(1).mean())
    x, ones, zero = (xy - middle) / extent, np.ones((len(xy), 1)), np.zeros((len(xy), 3))
    # The direct linear transformation of the plane (Hartley, 1997); its least singular vector.
    from_plane = np.concatenate([X, ones], 1)
    A = np.concatenate(
        [
            np.concatenate([from_plane, zero, -x[:, :1] * from_plane], 1),
            np.concatenate([zero, from_plane, -x[:, 1:] * from_plane], 1),
        ]
    )
    H = principal_axes(A)[1][-1].reshape(3, 3)
    line = np.linalg.lstsq(H.T, np.array([0, 0, 1.0]), rcond=None)[0]
    with np.errstate(all="ignore"):
        return line[:2] / line[2], middle, extent
