"""Settings of the start values of a network.

"Half" and "double" below are measured by `benchmarks/start_values.py`: four networks of 57 images
and 723 points without start values, the camera with a distortion it does not know, a tenth of the
image points wrong. The defaults orient all images, leave out 63 right image points and keep 38
wrong ones; the largest error of a projection centre is 0.18 of their extent.
"""

import dataclasses


@dataclasses.dataclass(frozen=True)
class StartValueSettings:
    """How images and points are oriented one after the other. Angles in radians; "tolerance": of
    start values, see `rays`.

    Images:

    - `min_points`: known points of an image for its resection, from 4: three have up to four
      solutions, a fourth chooses. Half: 16 more right image points are left out; double is as good
      here.
    - `sufficient_points`: an image waits, while others have more, below this many known points,
      from `min_points`. Half and double are as good here.
    - `waiting_share`: or below this share (0 to 1) of the points of the image that has the most;
      for repeated structures, where images with few points are easily placed wrongly. Half is as
      good here, double makes the error 0.22.
    - `agreeing_share`: least share (0 to 1) of consistent points of an image or a pair. At 0.4 the
      60 samples of `robust_resection` still contain a good triple with 98 % (1 − (1 − 0.4³)⁶⁰).
      Half is as good here, double loses 5 images and 97 points.
    - `doubtful_share`: images whose share of agreeing rays is below this part of the median image's
      are resected again from the points of the others. With half and double 8 more right image
      points are left out, and the error is 0.23.

    Pairs, from which a model starts:

    - `min_common_points`: from 6: five have up to ten solutions, a sixth chooses. Half and double
      are as good here.
    - `max_pairs`: that are oriented relatively, in lanes of `batched.LANES`. Half: 21 more right
      image points are left out; double is no better.
    - `max_seeds`: of these, tried until one is sufficient. Half is as good here, double no better.
    - `good_angle`: an angle of intersection beyond which a wider one is no better. Half and double
      are as good here.
    - `sufficient_share`: a model that uses this share (0 to 1) of the image points is accepted
      without alternatives. Half: one point less; above 1 (all seeds are tried): an error of 0.13 in
      2.8 times the time.

    Growth, where models are adjusted meanwhile (`improve`):

    - `first_improvement`: number of images at which a growing model is adjusted first. Larger: it
      may have drifted beyond the tolerance by then; smaller: more adjustments. Not measured.
    - `improvement_growth`: the factor by which it has grown until the next time, above 1; the same
      holds. With f all adjustments together cost f/(f − 1) times the last one.

    Points and control:

    - `gross_ratio`: image points with a misclosure above this many tolerances are excluded. Half:
      46 more right image points are left out and 15 fewer wrong ones kept; double: 13 fewer and 14
      more.
    - `parallel_angle`: between a ray and the mean of the rays of a point, up to which it is far
      away;
    - `far_distance`: its distance then, in radii of the positions of the images: its rays differ
      by 1/2000 from the direction, far below the tolerance. Larger: less well conditioned. Half and
      double make no difference here, where no point is far.
    - `extent_to_misfit`: control agrees with start values, or with a mirror image, to its extent
      divided by this number. It belongs to the tolerance, 3 % of the angle from the axis to the
      edge of an image (`rays.TOLERANCE`): cameras may have an unknown distortion of that size,
      which a model inherits. Half and double make no difference here, where control is right.
    - `refused_axes`, `doubted_axes`: how many times better control must fit with an axis reversed,
      or in another unit, for it to be refused and to be doubted (`control_axes`). Of 18 000 right
      models each, of 4 to 8 points with noise of 0.5 and 2 % of their extent, none was refused and
      up to 0.13 % were doubted for one of the mistakes. With heights over 2 to 50 % of the extent
      and noise of 0.5 %, 47 % of mirror images are refused and 62 % doubted; of 2 %, 14 and 24 %.
    - `contradicted_share`: of rays that miss their control points, or of points whose rays do not
      meet, above which a mirror image is tested. Larger: mirrored networks are not recognised;
      smaller: a test for nothing, which costs a model from a pair. Half and double make no
      difference here.
    """

    min_points: int = 4
    sufficient_points: int = 12
    waiting_share: float = 0.4
    agreeing_share: float = 0.4
    doubtful_share: float = 0.5
    min_common_points: int = 6
    max_pairs: int = 16
    max_seeds: int = 6
    good_angle: float = 0.5
    sufficient_share: float = 0.8
    first_improvement: int = 30
    improvement_growth: float = 2.5
    gross_ratio: float = 3.0
    parallel_angle: float = 2e-3
    far_distance: float = 2e3
    extent_to_misfit: float = 30.0
    refused_axes: float = 5.0
    doubted_axes: float = 2.5
    contradicted_share: float = 0.1


DEFAULTS = StartValueSettings()
