"""Similarities of object space: what the image points of a network leave open, its datum.

They move its points and images; the freedoms that other observations leave open as well are the
datum defect.
"""

import dataclasses

from jaxbundle.leastsquares.any_distance import move_at_any_distance
from jaxbundle.leastsquares.datum.motions import similarity

SIMILARITY = similarity(("point",), ("image",))
SIMILARITY_AT_ANY_DISTANCE = dataclasses.replace(
    SIMILARITY,
    actions=tuple(
        (name, move_at_any_distance if name == "point" else act) for name, act in SIMILARITY.actions
    ),
)
