"""Data snooping camera by camera, for batches: blunders go, each camera is calibrated again.

Of every view only the worst point goes at a time, and only points at least half as bad as the worst
of all, for a blunder spoils the residuals of its view. In the end whatever was removed is held
against the calibration it took no part in: what passes comes back. A camera without blunders keeps
its first solution. The test is Pope's (`leastsquares.distributions`), for a batch knows no σ a
priori. Its σ0 is that of the residuals, or that of their median where this is smaller: many
blunders make σ0 so large that each of them hides behind the others.
"""

import numpy as np
from jaxtyping import Bool, Float

from jaxbundle.leastsquares.distributions import critical_w
from jaxbundle.leastsquares.snooping import TOGETHER

TESTS = ("pope",)
MEDIAN = 1.0518
"""Median of the larger of two normal |w|: (2Φ(m) − 1)² = ½."""
ROUNDING = 1e-6
"""A smaller σ0 is noise of the arithmetic, pixels."""
ROUNDS = 200


class Snooping:
    """The points of one camera that are in use; `next` says which are after a solution."""

    def __init__(self, seen: Bool[np.ndarray, "views points"], test: str, significance: float):
        self.used, self.seen = seen.copy(), seen
        self.test, self.significance = test, significance
        self.returned = np.zeros_like(seen)

    def next(
        self, tests: Float[np.ndarray, "views points"], sigma0: float, redundancy: int
    ) -> bool:
        """Remove what the test calls blunders, or, where there are none, bring back what passes.

        **Arguments:** `tests`: |v|/√(redundancy number), NaN where there is none.

        **Returns:** whether anything has changed.
        """
        fitting = tests[self.used & np.isfinite(tests)]
        if not len(fitting):
            return False
        sigma0 = max(min(sigma0, float(np.median(fitting)) / MEDIAN), ROUNDING)
        critical = critical_w(self.test, self.significance, 2 * len(fitting), redundancy, sigma0)
        tests = np.nan_to_num(tests, nan=0.0)
        own = np.where(self.used, tests, 0.0)
        if own.max(initial=0.0) > critical:
            worst = own.argmax(1)
            rows = np.flatnonzero(own.max(1) > max(critical, TOGETHER * own.max()))
            self.used[rows, worst[rows]] = False
            return True
        back = self.seen & ~self.used & ~self.returned & (tests < critical) & (tests > 0)
        self.used |= back
        self.returned |= back
        return bool(back.any())
