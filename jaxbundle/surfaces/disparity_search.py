"""Search for disparities along the rows of a rectified pair, by OpenCV's semi-global matching.

Means over large windows are subtracted from the grey values, and contrasts are made equal, since
exposures differ. Surfaces whose texture repeats itself are removed if they are small and separate.

Source: Hirschmüller (2008), Stereo processing by semiglobal matching and mutual information.
"""

import dataclasses
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbundle.photographs.opencv import need_opencv
from jaxbundle.system.cores import available_cores

RowImage = Float[np.ndarray, "rows columns"]
RowMask = Bool[np.ndarray, "rows columns"]

MAX_INT16 = 2**15 - 1
# OpenCV's disparities are whole sixteenths of a pixel of 16 bits.
MAX_SPAN = MAX_INT16 // 16


@dataclasses.dataclass(frozen=True)
class DisparitySearchSettings:
    """The search for disparities, by OpenCV's semi-global matching.

    Figures "half …, double …" are of `benchmarks/surface_accuracy.py "no texture" --dense` with
    windows of one size and a search from one image: 66 870 points, RMS of errors over σ 1.003,
    0.106 % wrong by more than a pixel; `benchmarks/surface_settings.py --dense` prints today's. On
    eight real pairs no half or double of block, costs, cap or uniqueness has fewer wrong
    disparities for the same number of pixels.
    """

    block_side: int = 3
    """Side of the blocks whose costs are added, pixels, odd: larger ones have less noise, and wider
    seams along steps in the surface. 1: RMS 1.018; 5: 1.010."""
    mean_half_window: int = 40
    """Half the side of the windows whose means are subtracted from the grey values, pixels: wider
    than any detail that is matched, narrower than differences of light. Half and double: RMS 1.01,
    the same pixels within 0.1 %."""
    min_contrast: float = 25.0
    """Minimum standard deviation to which images of low contrast are stretched, of 256 grey values:
    OpenCV has whole grey values and clips their gradients (`preFilterCap`). Half: no difference;
    double: RMS 1.013, 0.094 % wrong."""
    uniqueness: int = 5
    """Percent by which the best cost must be below the second. OpenCV recommends 5 to 15; least
    squares tests what is left. Half and double: the same pixels within 0.03 %."""
    min_region: int = 80
    """Pixels of the smallest region of similar disparities that is kept. OpenCV recommends 50 to
    200. Half: 0.14 % wrong in the scene "repeated" instead of 0.10 %; double: no difference."""
    max_left_right: float = 1.0
    """Maximum difference between the disparity of a pixel and that of its match, searched from the
    right image by itself, pixels. On a real pair half: 1.3 % fewer pixels, 4.8 % of those left
    wrong by two pixels (5.3); double: 0.5 % more, 5.7 %."""
    repetition: float = 0.8
    """Correlation of a window with another on its row from which a texture repeats itself. In the
    scene "repeated" 0.6: 0.06 % of the points wrong by a pixel instead of 0.10 %; 0.95: 0.46 %."""
    min_repetitive_share: float = 0.02
    """Minimum share of the image for a separate surface of such a texture: smaller ones are mostly
    parts visible in one image only, matched to the repetition in the other. Half: 1.6 % wrong in
    the scene "repeated"; double: no difference."""
    max_costs: float = 4e8
    """Pixels times disparities up to which all costs, of 2 bytes and more, are held in memory and
    four paths are followed, both ways along rows and columns. A larger pair is matched in strips,
    along five paths, none of them from below."""


def equalise_exposures(
    left: RowImage,
    right: RowImage,
    is_inside: RowMask,
    right_inside: RowMask,
    settings: DisparitySearchSettings,
) -> tuple[RowImage, RowImage]:
    """Grey values around 128 without differences of exposure and light."""
    cv2 = need_opencv()
    mean = lambda a: cv2.blur(a.astype(np.float32), (2 * settings.mean_half_window + 1,) * 2)
    equalised, common_contrast = [], 0.0
    for a, has_value in ((left, is_inside), (right, right_inside)):
        deviation = np.where(
            has_value, a - mean(a * has_value) / np.maximum(mean(has_value), 1e-6), 0
        )
        contrast = float(np.std(deviation[has_value])) if has_value.any() else 0.0
        # The right image gets the contrast of the left one.
        common_contrast = common_contrast or max(contrast, settings.min_contrast)
        stretched = 128 + deviation * (common_contrast / max(contrast, 1.0))
        equalised.append(np.clip(stretched, 0, 255).astype(np.float32))
    return equalised[0], equalised[1]


def semi_global(
    left: RowImage,
    right: RowImage,
    span: int,
    settings: DisparitySearchSettings = DisparitySearchSettings(),
) -> RowImage:
    """Disparities by OpenCV, pixels; NaN if removed by the left-right check, the uniqueness or the
    speckle filter. OpenCV follows the paths of a large image on one core: it is matched in strips
    of rows, one for each core."""
    cv2 = need_opencv()
    # OpenCV's number of disparities is a multiple of 16
    number = max(16, -(-(span + 1) // 16) * 16)
    large, rows = left.size * number >= settings.max_costs, len(left)
    mode = cv2.STEREO_SGBM_MODE_SGBM if large else cv2.STEREO_SGBM_MODE_HH4
    eight = [np.clip(np.rint(a), 0, 255).astype(np.uint8) for a in (left, right)]
    # Columns of the left image without a full range of disparities are matched with a margin.
    wide = [cv2.copyMakeBorder(a, 0, 0, number, 0, cv2.BORDER_REPLICATE) for a in eight]
    strip = -(-rows // available_cores()) if large else rows

    # Rows above and below a strip that are matched with it: paths begin there, and after some ten
    # rows hardly depend on their beginning.
    margin = 128
    block = settings.block_side

    def match_strip(begin: int) -> Int[np.ndarray, "strip columns"]:
        low, high = max(begin - margin, 0), min(begin + strip + margin, rows)
        matcher = cv2.StereoSGBM.create(
            minDisparity=0,
            numDisparities=number,
            blockSize=block,
            # OpenCV's example has 8 and 32 grey values for each pixel of a block; more for a step
            # keeps surfaces of little texture together
            P1=8 * block**2,
            P2=48 * block**2,
            disp12MaxDiff=1,  # pixels; the least that does not disable the check
            preFilterCap=31,
            uniquenessRatio=settings.uniqueness,
            speckleWindowSize=settings.min_region,
            speckleRange=2,  # pixels; OpenCV recommends 1 or 2
            mode=mode,
        )
        disparities = matcher.compute(*(np.ascontiguousarray(a[low:high]) for a in wide))
        return disparities[begin - low : begin - low + strip, number:]

    with ThreadPoolExecutor(available_cores()) as pool:
        disparities = np.concatenate([*pool.map(match_strip, range(0, rows, strip))])
    disparities = disparities.astype(np.float32) / 16  # OpenCV's unit is 1/16 pixel
    return np.where((disparities >= 0) & (disparities <= span), disparities, np.nan)


def search_both_ways(
    left: RowImage,
    right: RowImage,
    span: int,
    settings: DisparitySearchSettings = DisparitySearchSettings(),
) -> RowImage:
    """Disparities of the left image that a search from the right image confirms; NaN: none.

    OpenCV's own check takes both directions from one search, whose paths are those of the left
    image. A search of the mirrored pair has others: of the wrong disparities of real pairs, mostly
    of pixels hidden in the right image, it finds a third to a half more, and loses 2 % of the right
    ones."""
    from_left = semi_global(left, right, span, settings)
    mirror = lambda a: np.ascontiguousarray(a[:, ::-1])
    from_right = semi_global(mirror(right), mirror(left), span, settings)[:, ::-1]
    columns = np.arange(from_left.shape[1])
    match = columns - np.rint(np.nan_to_num(from_left)).astype(int)
    confirmed = np.take_along_axis(from_right, np.clip(match, 0, len(columns) - 1), axis=1)
    with np.errstate(invalid="ignore"):
        agree = (match >= 0) & (np.abs(confirmed - from_left) <= settings.max_left_right)
    return np.where(agree, from_left, np.float32(np.nan))


def find_repetitions(
    left: RowImage, disparity: RowImage, span: int, settings: DisparitySearchSettings
) -> RowMask:
    """Pixels whose texture repeats itself along the row within the range of disparities, on a small
    separate surface: parts visible in one image only match the repetition in the other."""
    cv2 = need_opencv()
    # At a quarter of the size: 64 times as fast, and repetitions finer than that are within one
    # window of the search.
    coarser = 4
    rows, columns = (n // coarser for n in left.shape)
    coarse = cv2.resize(left, (columns, rows), interpolation=cv2.INTER_AREA)
    repeated = _autocorrelate_rows(coarse, span // coarser) > settings.repetition
    if not repeated.any():
        return np.zeros(left.shape, bool)
    repeated = (
        cv2.resize(repeated.astype(np.uint8), left.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0
    )
    is_known = np.isfinite(disparity)
    # Units of a sixteenth of a pixel, OpenCV's, or larger ones for ranges beyond its 16 bits.
    per_pixel = max(1, min(16, MAX_INT16 // (span + 1)))
    unknown = -MAX_INT16
    scaled = np.where(is_known, per_pixel * np.nan_to_num(disparity), unknown).astype(np.int16)
    min_surface_pixels = int(settings.min_repetitive_share * left.size)
    # Neighbours of one surface differ by up to a pixel.
    remaining, _ = cv2.filterSpeckles(scaled, unknown, min_surface_pixels, per_pixel)
    return is_known & repeated & (remaining == unknown)


def _autocorrelate_rows(a: RowImage, farthest: int) -> RowImage:
    """The greatest correlation of each window with one on its row, no farther away.

    Windows have 9 × 9 pixels; those compared are at least half a window apart, since nearer ones
    are alike in any texture.
    """
    cv2 = need_opencv()
    half_window = 4
    side = (2 * half_window + 1, 2 * half_window + 1)
    mean = lambda x: cv2.boxFilter(x, -1, side)
    a = a - a.mean()
    m = mean(a)
    standard_deviation = np.sqrt(np.maximum(mean(a * a) - m * m, 1e-3))
    best = np.full(a.shape, -1.0, np.float32)
    for lag in range(half_window, min(farthest, a.shape[1] - 1) + 1):
        rho = mean(a[:, lag:] * a[:, :-lag]) - m[:, lag:] * m[:, :-lag]
        rho /= standard_deviation[:, lag:] * standard_deviation[:, :-lag]
        np.maximum(best[:, lag:], rho, out=best[:, lag:])
        np.maximum(best[:, :-lag], rho, out=best[:, :-lag])
    return best
