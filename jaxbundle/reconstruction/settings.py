"""Settings of a reconstruction."""

import dataclasses

from jaxbundle.arguments import integer, one_of
from jaxbundle.choices import MATCHED_PAIRS
from jaxbundle.errors import InputError
from jaxbundle.tiepoints.features import Detection


@dataclasses.dataclass(frozen=True)
class Settings:
    """`detection`: features; `pairs`: which photographs are matched; `points`: desired measurements
    in every photograph; `workers`: threads, all cores if 0; `significance`: of data snooping;
    `targets`: kind of coded targets (`measure.coded_targets`).

    `aspect_sigma`: σ with which fy/fx of an unknown camera is observed as 1, infinite: not at all.
    Sensors have square pixels: for two reflex cameras, in 39 photographs of a panel of surveyed
    targets, fy/fx is 1 − 8e-5 and 1 − 5e-5 (± 3e-6)."""

    detection: Detection = Detection()
    pairs: str = "auto"
    points: int = 1500
    workers: int = 0
    significance: float = 0.001
    targets: str | None = None
    aspect_sigma: float = 2e-4

    def __post_init__(self):
        one_of("pairs", self.pairs, MATCHED_PAIRS)
        integer("points", self.points)
        if not self.aspect_sigma > 0:
            raise InputError(f"aspect_sigma: expected a positive number, got {self.aspect_sigma}")
