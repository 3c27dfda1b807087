"""Networks: tables, checks, and their declaration to the engine."""

from jaxbundle.network.tables import (
    Camera,
    Distances,
    Images,
    Network,
    Observations,
    Points,
    Source,
)

__all__ = [
    "Camera",
    "Distances",
    "Images",
    "Network",
    "Observations",
    "Points",
    "Source",
]
