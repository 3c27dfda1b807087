"""`reconstruct`: photographs in, adjusted networks out.

photographs ─features─▶ matches ─principal distance by loops─▶ verified pairs ─▶ parts
part ─tracks─▶ measured by least squares matching ─start values─▶ adjusted, weighted, snooped
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from jaxtyping import Int, UInt8

from jaxbundle.adjustment.mirrored_control import name_view_from_below
from jaxbundle.adjustment.result import Adjustment
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.float64 import require_x64
from jaxbundle.network.columns import count, list_some
from jaxbundle.network.tables import Camera, Network
from jaxbundle.network.units import METRES
from jaxbundle.orientation import batched
from jaxbundle.orientation.network import Oriented
from jaxbundle.photographs.concurrent import photographs_at_once
from jaxbundle.photographs.reading import read_photograph
from jaxbundle.reconstruction import square_pixels
from jaxbundle.reconstruction.adjusting import (
    DOUBTFUL_MISFIT,
    WeightedAdjustment,
    adjust_weighted,
    leave_out_features,
)
from jaxbundle.reconstruction.attitudes import map_attitudes, with_attitudes
from jaxbundle.reconstruction.block import describe_block
from jaxbundle.reconstruction.control import Control
from jaxbundle.reconstruction.folding import refuse_folded, refuse_superimposed
from jaxbundle.reconstruction.georeferencing import georeference
from jaxbundle.reconstruction.misplaced import NamedPairs
from jaxbundle.reconstruction.named import (
    Discs,
    find_named,
    join_named,
    match_named,
    name_unused,
    named_as_features,
)
from jaxbundle.reconstruction.network import FurtherData, photograph_network, track_name
from jaxbundle.reconstruction.oriented_block import MIN_CONTROL, FrameData
from jaxbundle.reconstruction.parts import SMALLEST_PART, group_connected, why_alone
from jaxbundle.reconstruction.photographs import (
    Cameras,
    Photograph,
    assign_cameras,
    find_photographs,
    name_other_files,
)
from jaxbundle.reconstruction.result import (
    ReconstructedPart,
    Reconstruction,
    misfit_in_words,
    principal_distances,
)
from jaxbundle.reconstruction.satellite_positions import find_positions
from jaxbundle.reconstruction.settings import ReconstructionSettings
from jaxbundle.reconstruction.starting import is_plausible, start_again, start_values
from jaxbundle.reconstruction.uncoded_targets import find_uncoded, name_uncoded
from jaxbundle.report.correlated import stated_sigma_of
from jaxbundle.system.cores import available_cores, can_run_two_programs
from jaxbundle.tiepoints import track_measurement
from jaxbundle.tiepoints.camera_starts import start_cameras
from jaxbundle.tiepoints.duplicates import find_duplicates
from jaxbundle.tiepoints.features import Features, memory_of_features
from jaxbundle.tiepoints.matching import FeatureMatches
from jaxbundle.tiepoints.static_marks import without_marks
from jaxbundle.tiepoints.store import Store
from jaxbundle.tiepoints.track_measurement import Measurements, measure_tracks, no_measurements
from jaxbundle.tiepoints.tracks import choose_tracks, make_tracks
from jaxbundle.tiepoints.verification import Pair
from jaxbundle.tiepoints.verified_pairs import (
    detect,
    match,
    prepare,
    verify,
    without_contradicted,
)
from jaxbundle.types import Progress

DEFAULT = ReconstructionSettings()


def reconstruct(
    given: Sequence[str | Path],
    camera: Camera | None = None,
    settings: ReconstructionSettings = DEFAULT,
    store: Path | None = None,
    progress: Progress = lambda *_: None,
    control: Control | None = None,
    distances: Sequence[dict] = (),
    name: str = "",
) -> Reconstruction:
    """Orient photographs by their content, with self-calibration.

    **Arguments:** `given`: files, and folders of photographs; `camera`: a calibrated one, shared by
    all; `store`: folder for features and matches; `progress(stage, done, total)`;
    `control`: points with coordinates, by the names of coded targets or measured in photographs;
    `distances`: rows `from`, `to`, `value`, `sigma` between named points, in `settings.unit`;
    `name` of the result, default: of the first folder.

    **Raises:** `InputError` if the photographs cannot be used; `NotSolvedError` if no two of
    them can be oriented.
    """
    require_x64()
    photographs, left_out = find_photographs(given)
    cameras = assign_cameras(photographs, camera, settings.camera_per_folder)
    named_measurements, discs, notes = find_named(
        photographs, settings.targets, control, settings.workers or None, settings.uncoded
    )
    notes += name_other_files(given)
    positions, messages = find_positions(photographs, control)
    notes += messages
    framed = positions is not None and positions.define_frame
    notes += name_unused(named_measurements, control, distances, 1 if framed else MIN_CONTROL)
    # Attitudes are those of the map: without positions in it the frame has another orientation.
    attitudes = None
    if positions is not None and framed:
        attitudes = map_attitudes([p.exif.attitude for p in photographs], positions.convergence)
    names = tuple(p.name for p in photographs)
    frame = None
    if control is not None:
        notes += control.notes
        points = control.points.take(~control.points.has_role("tie"))
        frame = FrameData(
            points, named_measurements, names, control.system, positions and positions[:2]
        )
        # Measurements of check points take no part, in the first adjustment either: a wrong one
        # would be judged by what it has changed.
        checks = {id for id, role in zip(points.id, points.role) if role == "check"}
        named_measurements = named_measurements.take(
            np.array([id not in checks for id in named_measurements.name], bool)
        )
    unit = settings.unit
    if unit != "m" and (framed or control is not None):
        in_metres = lambda name, value: (
            float(value) * METRES[unit] if name in ("value", "sigma") else value
        )
        distances = [{name: in_metres(name, x) for name, x in row.items()} for row in distances]
        if distances:
            notes.append(
                f"distances in {unit} are converted to metres, in which positions and control are"
            )
        unit = "m"
    further_data = FurtherData(
        named_measurements,
        tuple(distances),
        positions[:2] if positions and framed else None,
        attitudes,
        unit,
    )
    system = "" if control is None else control.system
    # Control whose file names no system is in that of the positions: `find_positions` has dropped
    # positions far from it.
    if positions is not None and (framed or control is not None):
        system = positions.words if control is None else system or positions.system
    first_source = Path(given[0])
    name = name or (first_source if first_source.is_dir() else first_source.parent).resolve().name
    stored = Store(store, settings.detection, settings.matching)
    run = _ReconstructionRun(
        photographs, left_out, cameras, settings, stored, progress, further_data
    )
    run.notes += notes
    run.frame, run.system, run.title, run.discs = frame, system, name, discs
    return run.run()


class _ReconstructionRun:
    """The state of a running reconstruction."""

    def __init__(
        self,
        photographs: Sequence[Photograph],
        left_out: Mapping[str, str],
        cameras: Cameras,
        settings: ReconstructionSettings,
        store: Store,
        tell: Progress,
        further_data: FurtherData,
    ):
        self.photographs, self.left_out = photographs, dict(left_out)
        self.cameras, self.settings, self.store, self.tell = cameras, settings, store, tell
        self.further = further_data
        self.workers = settings.workers or available_cores()
        self.names = [photograph.name for photograph in photographs]
        self.notes, self.stage = list(cameras.notes), ""
        self.warnings: list[tuple[float, str]] = []
        self.matched_pairs: set[tuple[int, int]] = set()
        self.frame: FrameData | None = None
        self.discs: Discs | None = None
        self.system = self.title = ""

    def run(self) -> Reconstruction:
        with ThreadPoolExecutor(1) as ahead:
            # Compiled during the search and matching of features, and the verification of pairs.
            windows = lambda: track_measurement.prepare(self.settings.track_matching)
            programs = (prepare, windows, batched.prepare) if can_run_two_programs() else ()
            prepared = [ahead.submit(program) for program in programs]
            features, matches = self._match()
            for first_program in prepared[:1]:
                first_program.result()  # an error of the compilation is raised here, not lost
            self._find_cameras(features, matches)
            pairs = self._verify(features, matches)
            for program in prepared:
                program.result()
        parts = self._make_parts(features, matches, pairs)
        verified = tuple(
            (self.names[p.images[0]], self.names[p.images[1]], p.match_count, len(p), p.kind)
            for p in pairs
        )
        files = {p.name: p.path for p in self.photographs}
        warnings = [text for _, text in sorted(self.warnings, key=lambda warning: -warning[0])]
        # The only part needs no name.
        only_name = f"{parts[0].name}: " if len(parts) == 1 else ""
        notes, warned = (
            tuple(text.removeprefix(only_name) for text in texts)
            for texts in (self.notes, warnings)
        )
        return Reconstruction(
            tuple(parts), self.left_out, notes, verified, files, warned, self.title
        )

    def _match(self) -> tuple[list[Features], list[FeatureMatches]]:
        """Features and matches, without those of duplicates and marks; or the named points."""
        if not self.settings.natural_points:
            return self._match_named()
        features = self._detect()
        settings = self.settings
        prints = [p.fingerprint for p in self.photographs]
        place = self.further.positions and self.further.positions[0]
        matches = match(
            features,
            prints,
            settings.pairs,
            place,
            self.store,
            self.workers,
            self.tell,
            settings.matching,
            settings.candidates,
        )
        self.store.drop_unused()
        sizes = [p.size for p in self.photographs]
        compared = {m.images for m in matches}
        # Before duplicates: a background that is always the same would be taken for them.
        matches, marked = without_marks(matches, features, sizes, settings.marks)
        if marked:
            self.notes.append(
                f"matches at the same pixels of {marked} photographs are not used: a date, a name, "
                "dirt on the sensor, or the background of an object that turns"
            )
        duplicates = find_duplicates(matches, features, sizes, settings.duplicates)
        for k, (other_photograph, number_still, number) in duplicates.items():
            self.left_out.setdefault(
                self.names[k],
                f"it shows the same as {self.names[other_photograph]} ({number_still} of {number} "
                "matches are at the same place): saved again, or taken from the same place",
            )
        self._require_two()
        matches = [m for m in matches if not {*m.images} & duplicates.keys()]
        self.matched_pairs = {pair for pair in compared if not {*pair} & duplicates.keys()}
        return features, matches

    def _match_named(self) -> tuple[list[Features], list[FeatureMatches]]:
        """Named points as features and matches."""
        named_measurements, min_common = self.further.named, self.settings.min_common_targets
        features = named_as_features(named_measurements, len(self.names))
        for photograph, name, of_photograph in zip(self.photographs, self.names, features):
            if (number := len(of_photograph)) < min_common:
                # Of a damaged photograph this is the reason, not that it has no targets.
                if number == 0 and name not in self.left_out:
                    self._make_reader(photograph)()
                self.left_out.setdefault(
                    name, f"{count(number, 'coded target')}, at least {min_common} are needed"
                )
        self._require_two()
        matches = match_named(named_measurements, len(self.names), min_common)
        self.matched_pairs = {m.images for m in matches}
        return features, matches

    def _detect(self) -> list[Features]:
        """The features of the photographs; those without are left out."""
        readers = [self._make_reader(p) for p in self.photographs]
        prints = [p.fingerprint for p in self.photographs]
        detection = self.settings.detection
        columns, rows = max((p.size for p in self.photographs), key=math.prod)
        need = memory_of_features(rows, columns, detection)
        at_once = photographs_at_once(rows * columns, need, self.workers)
        features = detect(
            [p.path for p in self.photographs],
            readers,
            prints,
            detection,
            self.store,
            at_once,
            self.tell,
        )
        for name, of_photograph, read in zip(self.names, features, readers):
            # Fewer than the matches that must agree in a pair.
            if (number := len(of_photograph)) < self.settings.verification.min_matches:
                # Features kept by an earlier run do not say that the file is damaged.
                if number == 0 and name not in self.left_out:
                    read()
                self.left_out.setdefault(name, f"no texture: {count(number, 'feature')}")
        self._require_two()
        return features

    def _require_two(self) -> None:
        """Refuse to go on with a single photograph."""
        if sum(name not in self.left_out for name in self.names) < 2:
            reasons = list_some((f"{n} ({w})" for n, w in self.left_out.items()), 3, str)
            raise InputError(f"fewer than two photographs can be used: {reasons}")

    def _make_reader(
        self, photograph: Photograph
    ) -> Callable[[], UInt8[np.ndarray, "rows columns"]]:
        """A function that reads a photograph; a black one, left out, if it is damaged."""

        def read() -> UInt8[np.ndarray, "rows columns"]:
            try:
                return read_photograph(photograph.path)
            except InputError as error:
                why = str(error).removeprefix(f"{photograph.path}: ")
                self.left_out[photograph.name] = why
                # A header may be sound and the pixels not; the others go on without features of it.
                return np.zeros((8, 8), np.uint8)

        return read

    def _find_cameras(
        self, features: Sequence[Features], matches: Sequence[FeatureMatches]
    ) -> None:
        """Start values of the unknown cameras."""
        if self.cameras.calibrated:
            return
        cameras, notes = start_cameras(
            self.cameras.cameras,
            self.cameras.camera_of,
            self.cameras.lens,
            [stated_distance is not None for stated_distance in self.cameras.stated_distances],
            features,
            matches,
            self.settings.camera_starts,
            self.settings.verification,
        )
        self.cameras = dataclasses.replace(self.cameras, cameras=tuple(cameras))
        self.notes += notes

    def _verify(
        self, features: Sequence[Features], matches: Sequence[FeatureMatches]
    ) -> list[Pair]:
        """The verified pairs that do not contradict each other."""
        cameras, settings = (self.cameras.cameras, self.cameras.camera_of, features), self.settings
        pairs = verify(*cameras, matches, self.tell, settings.verification)
        pairs, wrong = without_contradicted(*cameras, pairs, settings.loops)
        if wrong:
            named_pairs = (" and ".join(self.names[k] for k in p.images) for p in wrong)
            self.notes.append(
                f"{count(len(wrong), 'pair')} of photographs not used, contradicted "
                f"by others in triplets: {list_some(named_pairs, 3, str)}"
            )
        if len(wrong) > settings.contradictory_share * (len(wrong) + len(pairs)):
            self._warn(
                f"{len(wrong)} of {len(wrong) + len(pairs)} pairs contradict others: the object "
                "repeats itself, and parts of it may have been superimposed; compare the "
                "result with the object, or take photographs with shorter bases"
            )
        return pairs

    def _make_parts(
        self, features: Sequence[Features], matches: Sequence[FeatureMatches], pairs: Sequence[Pair]
    ) -> list[ReconstructedPart]:
        """The adjusted parts, the largest first. What is left of a part is tried as another one:
        two scenes may be connected by a few wrong pairs."""
        # Two photographs in all are a part, two of many are not.
        min_size = min(SMALLEST_PART, sum(name not in self.left_out for name in self.names))
        waiting = group_connected(len(self.photographs), pairs)
        parts: list[ReconstructedPart] = []
        failures: list[str] = []
        while waiting:
            group = waiting.pop(0)
            if len(group) < min_size:
                for k in group:
                    self.left_out.setdefault(
                        self.names[k], why_alone(k, self.names, matches, pairs)
                    )
                continue
            notes_before = len(self.notes)
            try:
                part, reasons = self._make_part(group, features, pairs, f"part {len(parts) + 1}")
            except (InputError, NotSolvedError) as error:
                failures.append(str(error))
                # The next part gets the name.
                del self.notes[notes_before:]
                why = str(error).removeprefix("not solved: ")
                for k in group:
                    self.left_out.setdefault(
                        self.names[k], f"its part could not be oriented: {why}"
                    )
                continue
            parts.append(part)
            placed = set(part.adjustment.network.images.id)
            reasons = {
                self.names[k]: "none of its tie points is used"
                for k in group
                if self.names[k] not in placed
            } | reasons
            remaining = [k for k in group if self.names[k] in reasons]
            renumbered = [
                dataclasses.replace(
                    p, images=(remaining.index(p.images[0]), remaining.index(p.images[1]))
                )
                for p in pairs
                if set(p.images) <= set(remaining)
            ]
            for rows in group_connected(len(remaining), renumbered):
                next_group = [remaining[k] for k in rows]
                # A smaller group than before: the loop ends.
                if len(next_group) >= SMALLEST_PART and len(next_group) < len(group):
                    waiting.append(next_group)
                else:
                    self.left_out |= {self.names[k]: reasons[self.names[k]] for k in next_group}
        if not parts:
            raise NotSolvedError(self._explain_failure(pairs, failures), self.names)
        return self._in_order(parts)

    def _in_order(self, parts: Sequence[ReconstructedPart]) -> list[ReconstructedPart]:
        """The parts, the largest first, and named in this order, in notes and warnings, too: of
        the photographs of a larger group fewer may be left."""
        ordered = sorted(parts, key=lambda part: -len(part.adjustment.network.images))
        names = {part.name: f"part {number}" for number, part in enumerate(ordered, 1)}

        def rename(text: str) -> str:
            name, colon, sentence = text.partition(":")
            return names.get(name, name) + colon + sentence

        self.notes = [rename(note) for note in self.notes]
        self.warnings = [(weight, rename(warning)) for weight, warning in self.warnings]
        for k, part in enumerate(ordered):
            if part.name != names[part.name]:
                adjustment = part.adjustment.with_changes()
                name = self._network_name(names[part.name])
                adjustment.network = adjustment.network.replace(name=name)
                ordered[k] = dataclasses.replace(part, name=names[part.name], adjustment=adjustment)
        return ordered

    def _warn(self, message: str, weight: float = 1.0) -> None:
        """Keep a warning; those of larger weight are shown first."""
        self.warnings.append((weight, message))

    def _begin(self, stage: str) -> None:
        """Begin a stage of unknown length, after the end of the one before."""
        if self.stage:
            self.tell(self.stage, 1, 1)
        self.stage = stage
        if stage:
            self.tell(stage, 0, 1)

    def _explain_failure(self, pairs: Sequence[Pair], failures: Sequence[str]) -> str:
        """Why no part could be oriented, with a remedy."""
        kinds = {p.kind for p in pairs}
        # The remedy depends on what the verified pairs show.
        if kinds == {"rotation"} or kinds == {"rotation", "plane"}:
            return (
                "not solved: a rotation or a plane explains every pair: the photographs were taken "
                "from one position, or show only a plane; take them from different positions"
            )
        if failures:
            return (
                failures[0]
                if failures[0].startswith("not solved")
                else f"not solved: {failures[0]}"
            )
        reasons = list_some((f"{n} ({w})" for n, w in self.left_out.items()), 3, str)
        some = "no three photographs overlap one another" if pairs else "no photographs overlap"
        return (
            f"not solved: {some}: {reasons}; take sharp photographs, at most 20 degrees from one "
            "to the next, on which the object or its surroundings have texture"
        )

    def _measure(self, features: Sequence[Features], pairs: Sequence[Pair]) -> Measurements:
        """The tracks of pairs, measured."""
        settings, sizes = self.settings, [photograph.size for photograph in self.photographs]
        if not settings.natural_points:
            return no_measurements()
        tracks, xy = make_tracks(features, pairs), [f.xy for f in features]
        is_chosen = choose_tracks(tracks, xy, sizes, settings.points, settings.tracks)
        counter = iter(range(1, len(features) + 1))
        return measure_tracks(
            [track for track, use in zip(tracks, is_chosen) if use],
            features,
            lambda k: read_photograph(self.photographs[k].path, colour=True),
            lambda: self.tell("least squares matching", next(counter), len(features)),
            settings.track_matching,
        )

    def _make_part(
        self, group: Sequence[int], features: Sequence[Features], pairs: Sequence[Pair], name: str
    ) -> tuple[ReconstructedPart, dict[str, str]]:
        """An adjusted part; the photographs left out of it, with the reasons."""
        settings = self.settings
        pairs_inside = [p for p in pairs if set(p.images) <= set(group)]
        measured = self._measure(features, pairs_inside)
        network = self._make_network(name, group, measured, self.further)
        self._begin("start values")
        pair_of_names = {
            (self.names[p.images[0]], self.names[p.images[1]]): p for p in pairs_inside
        }
        oriented, weighted, note = self._adjust_first(network, measured, pair_of_names)
        if self.discs is not None:
            oriented, weighted, note = self._complete(
                name, group, weighted, measured, pair_of_names
            )
        weighted, note = self._check_ratios(oriented, weighted, measured, note)
        self._begin("")
        # Before control, which fits a folded part as well as it can.
        refuse_folded(weighted, measured, self.names, settings.superposition)
        doubts = refuse_superimposed(
            weighted.adjustment, network, self.matched_pairs, self.names, settings.superposition
        )
        self.notes += [note] if note else []
        if weighted.unused_points:
            self.notes.append(
                f"{name}: {count(weighted.unused_points, 'point')} of two rays not used: with "
                "them the measurements contradict each other, as on an object that repeats itself"
            )
        part = self._finish_part(name, weighted)
        for doubt in (*self._compare_with_files(part.adjustment), *doubts):
            self._warn(f"{name}: {doubt}")
        return part, dict(oriented.images_not_placed)

    def _finish_part(self, name: str, weighted: WeightedAdjustment) -> ReconstructedPart:
        """An adjusted part in the system of its control, if there is any, with errors that image
        points share, and notes on what is arbitrary or doubtful."""
        settings, control, no_control = self.settings, None, ""
        if self.frame is not None:
            # Wrong control costs the frame, not the reconstruction.
            try:
                weighted, control = georeference(
                    weighted, self.frame, settings.significance, self._begin, settings.control
                )
            except (InputError, NotSolvedError) as error:
                no_control = str(error)
                self._warn(f"{name}: control is not used: {error}", np.inf)
            self._begin("")
        result = weighted.adjustment
        for doubt in () if control is None else control.warnings:
            self._warn(f"{name}: {doubt}", np.inf)
        if control is not None and self.system:
            below = name_view_from_below(result.image_values)
            if below:
                self._warn(f"{name}: {below}", np.inf)
        if settings.correlated:
            result = result.with_correlated_errors()
        exif = {photograph.name: photograph.exif for photograph in self.photographs}
        # Without control and positions the frame is an arbitrary one.
        absolute = control is not None or self.further.positions is not None
        block = describe_block(result, exif, self.system if absolute else "")
        part = ReconstructedPart(name, result, weighted.factors, block, control, no_control)
        if not (absolute or len(result.network.distances)):
            remedy = (
                "control could not be used"
                if no_control
                else "control points (--control), distances between targets (--targets, "
                "--distances) or positions in the files of the photographs determine them"
            )
            self.notes.append(f"{name}: position, orientation and scale are arbitrary: {remedy}")
        if part.misfit >= DOUBTFUL_MISFIT:
            self._warn(f"{name}: {misfit_in_words(part)}", part.misfit)
        return part

    def _make_network(
        self, part: str, group: Sequence[int], measured: Measurements, further_data: FurtherData
    ) -> Network:
        """The network of a group of photographs, without start values."""
        named = further_data.named
        return photograph_network(
            self.photographs,
            self.cameras,
            measured,
            dataclasses.replace(further_data, named=named.take(np.isin(named.image, group))),
            self._network_name(part),
            self.settings.aspect_sigma,
            self.settings.angle_unit,
        )

    def _network_name(self, part: str) -> str:
        """The name of the job, from the second part on with the part's own."""
        is_first = part in ("", "part 1") and self.title
        return self.title if is_first else ", ".join(filter(None, (self.title, part)))

    def _complete(
        self,
        name: str,
        group: Sequence[int],
        weighted: WeightedAdjustment,
        measured: Measurements,
        pairs: NamedPairs,
    ) -> tuple[Oriented, WeightedAdjustment, str]:
        """The adjustment with uncoded targets, and a note on attitudes."""
        assert self.discs is not None, "asked where discs were looked for"
        self._begin("uncoded targets")
        settings, discs = self.settings, self.discs
        uncoded = find_uncoded(weighted.adjustment, self.names, discs.xy, settings.uncoded_targets)
        uncoded_names = name_uncoded(uncoded, discs.xy, discs.sigma)
        self.notes.append(
            f"{name}: {count(len(set(uncoded_names.name)), 'uncoded target')} in "
            f"{len(uncoded_names)} of {len(discs)} discs"
        )
        extra = dataclasses.replace(
            self.further, named=join_named(self.further.named, uncoded_names)
        )
        network = self._make_network(name, group, measured, extra)
        return self._adjust_first(network, measured, pairs)

    def _compare_with_files(self, result: Adjustment) -> list[str]:
        """Principal distances that contradict those of the files, in words."""
        stated_distances = {
            c.id: s for c, s in zip(self.cameras.cameras, self.cameras.stated_distances)
        }
        messages = []
        for id, adjusted in principal_distances(result).items():
            file = stated_distances.get(id)
            adjusted_sigma = stated_sigma_of(adjusted)
            if file is None or not adjusted_sigma:
                continue
            # The file's value is also an observation of the adjustment, which draws the result
            # towards it: a contradiction is larger than it looks, and the test is cautious.
            sigma = np.hypot(file.sigma, adjusted_sigma)
            deviation = abs(adjusted["value"] - file.value)
            if deviation > square_pixels.CRITICAL_DEVIATION * sigma:
                messages.append(
                    f"camera {id!r}: principal distance {adjusted['value']:.0f} px contradicts the "
                    f"{file.value:.0f} ± {file.sigma:.0f} px of the files ({file.source}): the "
                    "photographs were cropped or zoomed, or the result is wrong"
                )
        return messages

    def _adjust_first(
        self, network: Network, measured: Measurements, pairs: NamedPairs
    ) -> tuple[Oriented, WeightedAdjustment, str]:
        """The first start values that lead to an adjustment, the adjustment, and a note on
        attitudes."""
        stated = self._stated_distances()
        guessed = [camera.id for camera in self.cameras.cameras if camera.id not in stated]
        first_error: NotSolvedError | None = None
        settings = self.settings.start_values
        if not self.settings.natural_points:
            # The codes say which targets are the same: what a pair needs is enough.
            settings = dataclasses.replace(settings, min_rays=self.settings.min_common_targets)
        for oriented in start_values(network, guessed, pairs, settings):
            try:
                weighted, note = self._adjust(oriented, measured)
            except NotSolvedError as error:
                first_error = first_error or error
                continue
            result = weighted.adjustment
            if not is_plausible(result, stated, settings):
                first_error = first_error or _not_solved(result)
                continue
            # Once more with the adjusted camera, if that orients more photographs.
            restarted = start_again(network, oriented, result, pairs, settings)
            if restarted is not None:
                try:
                    better, other_note = self._adjust(restarted, measured)
                except NotSolvedError:
                    return oriented, weighted, note
                if is_plausible(better.adjustment, stated, settings):
                    return restarted, better, other_note
            return oriented, weighted, note
        assert first_error is not None, "start values are there, or an error says why not"
        raise first_error

    def _stated_distances(self) -> dict[str, float]:
        """The principal distances that files or a calibration state, by camera."""
        if self.cameras.calibrated:
            return {c.id: c.parameters.get("fx", np.nan) for c in self.cameras.cameras}
        of_files = zip(self.cameras.cameras, self.cameras.stated_distances)
        return {camera.id: stated.value for camera, stated in of_files if stated is not None}

    def _check_ratios(
        self, oriented: Oriented, weighted: WeightedAdjustment, measured: Measurements, note: str
    ) -> tuple[WeightedAdjustment, str]:
        """The adjustment with square pixels, unless halves of the photographs agree that they are
        not."""
        contradicted = square_pixels.contradicted_ratios(weighted.adjustment)
        if not contradicted:
            return weighted, note
        self._begin("ratio of the focal lengths")
        halves = square_pixels.replicated_ratios(weighted.adjustment)
        released = {}
        as_square = f"the pixels are taken as square (fy/fx 1 ± {self.settings.aspect_sigma:g})"
        for id, ratio in contradicted.items():
            ratios_of_halves = halves.get(id)
            message = f"camera {id!r}: the photographs alone give fy/fx {_ratio_in_words(ratio)}, "
            if ratios_of_halves is None:
                message += "halves of them none: "
            else:
                message += (
                    f"halves of them {' and '.join(map(_ratio_in_words, ratios_of_halves))}: "
                )
            if ratios_of_halves is not None and square_pixels.is_replicated(*ratios_of_halves):
                released[id] = message
            else:
                self.notes.append(f"{message}not confirmed, {as_square}")
        if not released:
            return weighted, note
        # From the start values: the result's gross errors were judged with square pixels.
        network = square_pixels.release(oriented.network, released)
        oriented = dataclasses.replace(oriented, network=network)
        try:
            better, other_note = self._adjust(oriented, measured)
            if not is_plausible(
                better.adjustment, self._stated_distances(), self.settings.start_values
            ):
                raise _not_solved(better.adjustment)
        except NotSolvedError:
            self.notes += [
                f"{words}but not solved with it, {as_square}" for words in released.values()
            ]
            return weighted, note
        self.notes += [f"{words}the pixels are not square" for words in released.values()]
        return better, other_note

    def _adjust(self, oriented: Oriented, measured: Measurements) -> tuple[WeightedAdjustment, str]:
        """The adjustment from start values, and a note on attitudes."""
        placed, note = with_attitudes(oriented.network, self.names, self.further.attitudes)
        classes, class_names = _classify_measurements(placed, measured, self.names)
        significance, weighting = self.settings.significance, self.settings.weighting
        placed, is_kept = leave_out_features(placed, classes == -1, weighting)
        weighted = adjust_weighted(
            placed, classes[is_kept], class_names, significance, self._begin, weighting
        )
        unused = int((~is_kept).sum())
        return dataclasses.replace(weighted, unused_features=unused), note


def _ratio_in_words(ratio: square_pixels.Ratio) -> str:
    return f"{1 + ratio.deviation:.5f} ± {ratio.sigma:.5f}"


def _not_solved(result: Adjustment) -> NotSolvedError:
    if not result.converged:
        why = "; ".join([result.termination, *result.findings, *result.weakness.lines])
        return NotSolvedError(f"not solved: {why}", list(result.undetermined))
    distances = ", ".join(
        f"{c['value']:.0f} px in {id}" for id, c in principal_distances(result).items()
    )
    return NotSolvedError(
        f"not solved: impossible principal distance {distances}; take photographs from "
        "positions farther apart, or give --camera"
    )


def _classify_measurements(
    network: Network, measured: Measurements, names: Sequence[str]
) -> tuple[Int[np.ndarray, " rays"], dict[int, str]]:
    """The class of every observation, and the names of classes, each of which has its own factor
    of σ."""
    columns = (measured.image, measured.track, measured.level)
    level = {(names[i], track_name(t)): l for i, t, l in zip(*(c.tolist() for c in columns))}
    rays, images, points = network.observations, network.images.id, network.points.id
    ids = [(images[i], points[p]) for i, p in zip(rays.image.tolist(), rays.point.tolist())]
    # The coarser the level, the fewer its matches: from the second on they share a factor.
    classes = np.array([min(level[ray], 2) if ray in level else 3 for ray in ids], int)
    words = {
        -1: "features not matched",
        0: "matched in the original",
        1: "matched at half size",
        2: "matched at a quarter or smaller",
        3: "named points",
    }
    return classes, words
