"""Settings of a reconstruction."""

import dataclasses

from jaxbundle.arguments import integer, one_of
from jaxbundle.choices import MATCHED_PAIRS
from jaxbundle.tiepoints.features import Detection


@dataclasses.dataclass(frozen=True)
class Settings:
    """`detection`: features; `pairs`: which photographs are matched; `points`: desired measurements
    in every photograph; `workers`: threads, all cores if 0; `significance`: of data snooping;
    `targets`: kind of coded targets (`measure.coded_targets`)."""

    detection: Detection = Detection()
    pairs: str = "auto"
    points: int = 1500
    workers: int = 0
    significance: float = 0.001
    targets: str | None = None

    def __post_init__(self):
        one_of("pairs", self.pairs, MATCHED_PAIRS)
        integer("points", self.points)
