"""Settings of a reconstruction."""

import dataclasses

from jaxbundle.arguments import integer, one_of
from jaxbundle.choices import MATCHED_PAIRS
from jaxbundle.errors import InputError
from jaxbundle.network.rules import CHOICES, check_choice
from jaxbundle.network.units import METRES
from jaxbundle.reconstruction.adjusting import WeightingSettings
from jaxbundle.reconstruction.folding import SuperpositionSettings
from jaxbundle.reconstruction.oriented_block import ControlSettings
from jaxbundle.reconstruction.starting import BlockStartSettings
from jaxbundle.reconstruction.uncoded_targets import UncodedSettings
from jaxbundle.tiepoints.camera_starts import CameraStartSettings
from jaxbundle.tiepoints.duplicates import DuplicateSettings
from jaxbundle.tiepoints.features import FeatureSettings
from jaxbundle.tiepoints.matching import FeatureMatchingSettings
from jaxbundle.tiepoints.pair_consistency import LoopSettings
from jaxbundle.tiepoints.pairs import CandidateSettings
from jaxbundle.tiepoints.static_marks import MarkSettings
from jaxbundle.tiepoints.track_measurement import TrackMatchingSettings
from jaxbundle.tiepoints.tracks import TrackSettings
from jaxbundle.tiepoints.verification import VerificationSettings


@dataclasses.dataclass(frozen=True)
class ReconstructionSettings:
    """Settings of a reconstruction; those of its stages in the order in which they are used."""

    detection: FeatureSettings = FeatureSettings()
    """Features of a photograph."""
    pairs: str = "auto"
    """Which photographs are matched: `auto`, `all`, `sequence`, `place` or `alike`."""
    points: int = 1500
    """Desired measurements in every photograph. The σ of the result falls with the root of it, the
    time of the adjustment grows with it; errors of the camera model do not fall."""
    workers: int = 0
    """Threads, all cores if 0."""
    significance: float = 0.001
    """Significance of data snooping: the probability that a good measurement is removed."""
    angle_unit: str = "deg"
    """Unit of the angles of the result and their σ: "deg", "gon" or "rad"."""
    unit: str = "m"
    """Unit of distances, and of the result where they alone give the scale; positions and control
    are in metres."""
    camera_per_folder: bool = False
    """The photographs of every folder have a camera of their own. Otherwise those of one make,
    model, serial number, focal length and size share one."""
    targets: str | None = None
    """Kind of coded targets (`measure.coded_targets`)."""
    natural_points: bool = True
    """Tie points of features; otherwise the coded targets alone."""
    uncoded: bool = False
    """Discs without a code, too, once the photographs are oriented (ring-coded targets)."""
    min_common_targets: int = 8
    """Common targets that a pair needs where no features are used: five orient it, and three more
    show whether they do. Features need more, some of which are wrong (`verification`)."""
    aspect_sigma: float = 2e-4
    """σ with which fy/fx of an unknown camera is observed as 1, infinite: not at all. Sensors have
    square pixels: for two reflex cameras, in 39 photographs of a panel of surveyed targets, fy/fx
    is 1 − 8e-5 and 1 − 5e-5 (± 3e-6)."""
    correlated: bool = True
    """State σ under errors that image points share, and compare halves by photographs, of parts of
    eight photographs or more."""
    contradictory_share: float = 0.3
    """Share of pairs that contradict others in triplets above which a warning calls the result
    doubtful. In the set `building`, which is right, 23 of 66 do."""
    candidates: CandidateSettings = CandidateSettings()
    matching: FeatureMatchingSettings = FeatureMatchingSettings()
    duplicates: DuplicateSettings = DuplicateSettings()
    marks: MarkSettings = MarkSettings()
    camera_starts: CameraStartSettings = CameraStartSettings()
    verification: VerificationSettings = VerificationSettings()
    loops: LoopSettings = LoopSettings()
    tracks: TrackSettings = TrackSettings()
    track_matching: TrackMatchingSettings = TrackMatchingSettings()
    uncoded_targets: UncodedSettings = UncodedSettings()
    start_values: BlockStartSettings = BlockStartSettings()
    weighting: WeightingSettings = WeightingSettings()
    superposition: SuperpositionSettings = SuperpositionSettings()
    control: ControlSettings = ControlSettings()

    def __post_init__(self):
        one_of("pairs", self.pairs, MATCHED_PAIRS)
        integer("points", self.points)
        check_choice("angle_unit", self.angle_unit, CHOICES["angle_unit"])
        one_of("unit", self.unit, tuple(METRES))
        if not self.natural_points and self.targets is None:
            raise InputError(
                "features none: coded targets alone connect the photographs; give targets, such as "
                "ring14"
            )
        if self.uncoded and not (self.targets or "").startswith("ring"):
            raise InputError("uncoded: expected ring-coded targets, such as ring14")
        if not self.aspect_sigma > 0:
            raise InputError(f"aspect_sigma: expected a positive number, got {self.aspect_sigma}")
