"""Search for disparities along the rows of a rectified pair, by OpenCV's semi-global matching.

The grey values are reduced by their means over large windows, with equal contrast, since exposures
differ. Surfaces whose texture repeats itself are removed if they are small and separate.

Source: Hirschmüller (2008), Stereo processing by semiglobal matching and mutual information.
"""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Bool, Float

from jaxbundle.photographs.opencv import need_opencv
from jaxbundle.system.configuration import available_cores

BLOCK = 3
"""Side of the blocks of semi-global matching."""
MEAN_WINDOW = 40
"""Half the side of the windows whose means are subtracted from the grey values."""
LEAST_SPREAD = 25.0
"""Minimum standard deviation of compared grey values, of 256."""
MOST_COSTS = 4e8
"""Pixels times disparities up to which all costs, of 2 bytes and more, are held in memory, and
paths from below are also followed."""
STRIP_MARGIN = 128
"""Rows above and below a strip that are matched with it: paths begin there."""
UNIQUENESS = 5
"""Percent by which the best cost must be below the second."""
SMALLEST_REGION = 80
"""Pixels of the smallest region of similar disparities that is kept."""
COARSER, REPEATED, REPETITION, SMALL = 4, 4, 0.8, 0.02
"""Reduction factor; half the side of windows compared with others of the same image; correlation
from which the texture repeats itself; minimum part of the image for a surface of such a texture."""


def alike(
    left, right, inside, right_inside
) -> tuple[Float[np.ndarray, "rows columns"], Float[np.ndarray, "rows columns"]]:
    """Grey values around 128 without differences of exposure and light."""
    cv2 = need_opencv()
    mean = lambda a: cv2.blur(a.astype(np.float32), (2 * MEAN_WINDOW + 1,) * 2)
    found, spread = [], 0.0
    for a, there in ((left, inside), (right, right_inside)):
        away = np.where(there, a - mean(a * there) / np.maximum(mean(there), 1e-6), 0)
        own = float(np.std(away[there])) if there.any() else 0.0
        spread = spread or max(own, LEAST_SPREAD)
        found.append(np.clip(128 + away * (spread / max(own, 1.0)), 0, 255).astype(np.float32))
    return found[0], found[1]


def semi_global(left, right, span: int) -> Float[np.ndarray, "rows columns"]:
    """Disparities by OpenCV, pixels; NaN if removed by the left-right check, the uniqueness or the
    speckle filter. OpenCV follows the paths of a large image on one core: it is matched in strips
    of rows, one for each core."""
    cv2 = need_opencv()
    number = max(16, -(-(span + 1) // 16) * 16)
    large, rows = left.size * number >= MOST_COSTS, len(left)
    mode = cv2.STEREO_SGBM_MODE_SGBM if large else cv2.STEREO_SGBM_MODE_HH4
    eight = [np.clip(np.rint(a), 0, 255).astype(np.uint8) for a in (left, right)]
    # columns of the left image without a full range of disparities are matched with a margin
    wide = [cv2.copyMakeBorder(a, 0, 0, number, 0, cv2.BORDER_REPLICATE) for a in eight]
    strip = -(-rows // available_cores()) if large else rows

    def of_strip(first):
        low, high = max(first - STRIP_MARGIN, 0), min(first + strip + STRIP_MARGIN, rows)
        matcher = cv2.StereoSGBM.create(
            minDisparity=0,
            numDisparities=number,
            blockSize=BLOCK,
            P1=8 * BLOCK**2,
            P2=48 * BLOCK**2,
            disp12MaxDiff=1,
            preFilterCap=31,
            uniquenessRatio=UNIQUENESS,
            speckleWindowSize=SMALLEST_REGION,
            speckleRange=2,
            mode=mode,
        )
        found = matcher.compute(*(np.ascontiguousarray(a[low:high]) for a in wide))
        return found[first - low : first - low + strip, number:]

    with ThreadPoolExecutor(available_cores()) as pool:
        found = np.concatenate([*pool.map(of_strip, range(0, rows, strip))])
    found = found.astype(np.float32) / 16
    return np.where((found >= 0) & (found <= span), found, np.nan)


def ambiguous(
    left: Float[np.ndarray, "rows columns"], disparity: Float[np.ndarray, "rows columns"], span: int
) -> Bool[np.ndarray, "rows columns"]:
    """Pixels whose texture repeats itself along the row within the range of disparities, on a small
    separate surface: parts visible in one image only match the repetition in the other."""
    cv2 = need_opencv()
    rows, columns = (n // COARSER for n in left.shape)
    coarse = cv2.resize(left, (columns, rows), interpolation=cv2.INTER_AREA)
    repeated = _likeness(coarse, span // COARSER) > REPETITION
    if not repeated.any():
        return np.zeros(left.shape, bool)
    repeated = (
        cv2.resize(repeated.astype(np.uint8), left.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0
    )
    known = np.isfinite(disparity)
    whole = np.where(known, 16 * np.nan_to_num(disparity), -16).astype(np.int16)
    kept, _ = cv2.filterSpeckles(whole, -16, int(SMALL * left.size), 16)
    return known & repeated & (kept < 0)


def _likeness(a, farthest):
    """The greatest correlation of each window with one on its row, no farther away."""
    cv2 = need_opencv()
    side = (2 * REPEATED + 1, 2 * REPEATED + 1)
    mean = lambda x: cv2.boxFilter(x, -1, side)
    a = a - a.mean()
    m = mean(a)
    spread = np.sqrt(np.maximum(mean(a * a) - m * m, 1e-3))
    best = np.full(a.shape, -1.0, np.float32)
    for lag in range(REPEATED, farthest + 1):
        rho = mean(a[:, lag:] * a[:, :-lag]) - m[:, lag:] * m[:, :-lag]
        rho /= spread[:, lag:] * spread[:, :-lag]
        np.maximum(best[:, lag:], rho, out=best[:, lag:])
        np.maximum(best[:, :-lag], rho, out=best[:, :-lag])
    return best
