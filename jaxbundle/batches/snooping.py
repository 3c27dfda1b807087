"""Data snooping for batches, camera by camera: blunders are removed and the camera calibrated
again.

Only the worst point of a view is removed at a time, and only points at least half as bad as the
worst of all, because a blunder affects the residuals of its view. Finally, removed points are
tested against the calibration without them and restored if they pass. A camera without blunders
keeps its first solution. The test is Pope's (`leastsquares.quality.distributions`), because a batch
has no a priori σ. Its σ0 is that of the residuals, or from their median if this is smaller: many
blunders make σ0 so large that they mask each other.
"""

import numpy as np
from jaxtyping import Bool, Float

from jaxbundle.leastsquares.quality.distributions import critical_w
from jaxbundle.leastsquares.quality.snooping import REMOVED_TOGETHER

TESTS = ("pope",)
# Rounds of removal and adjustment. Each removes at most a point of every view; a camera that needs
# more has more blunders than a test can find. It only bounds the time.
MAX_ROUNDS = 200


class Snooping:
    """The used points of one camera; `next` updates them after a solution."""

    def __init__(self, is_seen: Bool[np.ndarray, "views points"], test: str, significance: float):
        self.used, self.seen = is_seen.copy(), is_seen
        self.test, self.significance = test, significance
        self.returned = np.zeros_like(is_seen)

    def next(
        self, tests: Float[np.ndarray, "views points"], sigma0: float, redundancy: int
    ) -> bool:
        """Remove blunders found by the test, or, if there are none, restore points that pass.

        **Arguments:** `tests`: |v|/√(redundancy number), NaN if undefined.

        **Returns:** whether anything has changed.
        """
        fitting = tests[self.used & np.isfinite(tests)]
        if not len(fitting):
            return False
        # 1.0518: median of the larger of two normal |w|, (2Φ(m) − 1)² = ½. At least a millionth of
        # a pixel: below is arithmetic noise.
        sigma0 = max(min(sigma0, float(np.median(fitting)) / 1.0518), 1e-6)
        critical = critical_w(self.test, self.significance, 2 * len(fitting), redundancy, sigma0)
        tests = np.nan_to_num(tests, nan=0.0)
        included = np.where(self.used, tests, 0.0)
        if included.max(initial=0.0) > critical:
            worst, largest = included.argmax(1), included.max(1)
            rows = np.flatnonzero(largest > max(critical, REMOVED_TOGETHER * largest.max()))
            self.used[rows, worst[rows]] = False
            return True
        # Each only once, so that no point alternates.
        is_restored = self.seen & ~self.used & ~self.returned & (tests < critical) & (tests > 0)
        self.used |= is_restored
        self.returned |= is_restored
        return bool(is_restored.any())
