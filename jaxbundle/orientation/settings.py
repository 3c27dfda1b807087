"""Settings of the start values of a network.

Measured by `benchmarks/start_values.py`: networks without start values, with a distortion the
camera does not know, blunders and control, each with half and double of every setting.
"""

import dataclasses


@dataclasses.dataclass(frozen=True)
class StartValueSettings:
    """How images and points are oriented one after the other. Angles in radians; "tolerance": of
    start values, see `sights`.

    Images:

    - `min_points`: known points of an image for its resection, from 4: three have up to four
      solutions, a fourth chooses.
    - `sufficient_points`: an image waits, while others have more, below this many known points,
    - `waiting_share`: or below this share (0 to 1) of the points of the image that has the most.
    - `agreeing_share`: least share (0 to 1) of consistent points of an image or a pair. At 0.4 the
      60 samples of `robust_resection` still contain a good triple with 98 % (1 − (1 − 0.4³)⁶⁰).
    - `doubtful_share`: images whose share of agreeing rays is below this part of the median image's
      are resected again from the points of the others.

    Pairs, from which a model starts:

    - `min_common_points`: from 6: five have up to ten solutions, a sixth chooses.
    - `max_pairs`: that are oriented relatively, in lanes of `many.LANES`;
    - `max_seeds`: of these, tried until one is sufficient.
    - `good_angle`: an angle of intersection beyond which a wider one is no better.
    - `sufficient_share`: a model that uses this share (0 to 1) of the image points is accepted
      without alternatives.

    Growth:

    - `first_improvement`: number of images at which a growing model is adjusted first,
    - `improvement_growth`: and the factor by which it has grown until the next time, above 1.

    Points and control:

    - `gross_ratio`: image points with a misclosure above this many tolerances are excluded.
    - `parallel_angle`: between a ray and the mean of the rays of a point, up to which it is far
      away;
    - `far_distance`: its distance then, in radii of the positions of the images.
    - `extent_to_misfit`: control agrees with start values, or with a mirror image, to its extent
      divided by this number. It belongs to the tolerance (3 % of the image): cameras may have an
      unknown distortion of that size, which a model inherits.
    - `contradicted_share`: of rays that miss their control points, or of points whose rays do not
      meet, above which a mirror image is tested.
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
    contradicted_share: float = 0.1


DEFAULTS = StartValueSettings()
