"""Unknowns that leave what was known of them before by more than chance explains."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jaxbundle.leastsquares.quality.distributions import normal_quantile
from jaxbundle.network.columns import list_some


def describe_beyond(
    names: Sequence[object], ratio: Float[np.ndarray, " m"], significance: float
) -> str:
    """The unknowns whose changes are more than chance explains, the largest first, and what to
    check; empty without.

    **Arguments:** `ratio` of the change of every unknown to its σ; `significance` of its test,
    two-sided."""
    limit = normal_quantile(1 - significance / 2)
    beyond = sorted(np.flatnonzero(ratio > limit).tolist(), key=lambda k: -ratio[k])
    if not beyond:
        return ""
    listed = list_some([f"{names[k]} ({ratio[k]:.3g} σ)" for k in beyond], 3, str)
    return (
        f"{listed}; check heights (ellipsoid or geoid, metres or feet) and the system of the points"
    )
