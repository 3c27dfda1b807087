"""`reconstruct`: photographs in, adjusted networks out.

photographs ─features─▶ matches ─principal distance by loops─▶ verified pairs ─▶ parts
part ─tracks─▶ measured by least squares matching ─start values─▶ adjusted, weighted, snooped
"""

import dataclasses
import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from jaxbundle.bundle.result import Adjustment
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.float64 import require_x64
from jaxbundle.network.columns import count, list_some
from jaxbundle.network.tables import Camera, Network
from jaxbundle.orientation import many
from jaxbundle.orientation.network import Oriented
from jaxbundle.photographs.at_once import photographs_at_once
from jaxbundle.photographs.reading import read_photograph
from jaxbundle.reconstruction import aspect_ratio
from jaxbundle.reconstruction.adjusting import (
    LARGEST_MISFIT,
    Weighted,
    adjust_weighted,
)
from jaxbundle.reconstruction.attitudes import map_attitudes, with_attitudes
from jaxbundle.reconstruction.block import describe_block
from jaxbundle.reconstruction.control import Control
from jaxbundle.reconstruction.folding import refuse_folded, refuse_superimposed
from jaxbundle.reconstruction.georeferencing import georeference
from jaxbundle.reconstruction.named import find_named, name_unused
from jaxbundle.reconstruction.network import Extra, tie_network, track_name
from jaxbundle.reconstruction.oriented_block import ENOUGH_CONTROL, Given
from jaxbundle.reconstruction.parts import SMALLEST_PART, group_connected, why_alone
from jaxbundle.reconstruction.photographs import (
    Cameras,
    Photograph,
    assign_cameras,
    find_photographs,
    name_other_files,
)
from jaxbundle.reconstruction.result import (
    Part,
    Reconstruction,
    misfit_in_words,
    principal_distances,
)
from jaxbundle.reconstruction.satellite_positions import find_positions
from jaxbundle.reconstruction.settings import Settings
from jaxbundle.reconstruction.starting import is_plausible, start_again, start_values
from jaxbundle.system.configuration import available_cores, can_run_two_programs
from jaxbundle.tiepoints import refinement
from jaxbundle.tiepoints.calibration import start_cameras
from jaxbundle.tiepoints.duplicates import find_duplicates
from jaxbundle.tiepoints.features import Features, memory_of_features
from jaxbundle.tiepoints.refinement import Measurements, measure_tracks
from jaxbundle.tiepoints.search import (
    detect,
    match,
    prepare,
    verify,
    without_contradicted,
)
from jaxbundle.tiepoints.still import without_marks
from jaxbundle.tiepoints.store import Store
from jaxbundle.tiepoints.tracks import choose_tracks, make_tracks
from jaxbundle.tiepoints.verification import Pair
from jaxbundle.types import Progress

DEFAULT = Settings()
NAMED = 99
"""Kind of the measurements of named points."""
REPEATS = 0.3
"""Share of contradictory pairs above which the result is doubtful."""
CONTRADICTS_FILE = 3.29
"""Difference from the principal distance of the files, in σ, that chance explains in one of a
thousand."""
TEXTURE = 16
"""Minimum features of a photograph."""


def reconstruct(
    given: Sequence[str | Path],
    camera: Camera | None = None,
    settings: Settings = DEFAULT,
    store: Path | None = None,
    progress: Progress = lambda stage, done, total: None,
    control: Control | None = None,
    distances: Sequence[dict] = (),
    name: str = "",
) -> Reconstruction:
    """Orient photographs by their content, with self-calibration.

    **Arguments:** `given`: files, and folders of photographs; `camera`: a calibrated one, shared by
    all; `store`: folder for features and matches; `progress(stage, done, total)`;
    `control`: points with coordinates, by the names of coded targets or measured in photographs;
    `distances`: rows `from`, `to`, `value`, `sigma` between named points; `name` of the result,
    default: of the first folder.

    **Raises:** `InputError` if the photographs cannot be used; `NotSolvedError` if no two of
    them can be oriented.
    """
    require_x64()
    photographs, left_out = find_photographs(given)
    cameras = assign_cameras(photographs, camera)
    named, notes = find_named(photographs, settings.targets, control, settings.workers)
    notes += name_other_files(given)
    positions, said = find_positions(photographs, control)
    notes += said
    framed = positions is not None and positions.define_frame
    notes += name_unused(named, control, distances, 1 if framed else ENOUGH_CONTROL)
    attitudes = None
    if positions is not None and framed:
        attitudes = map_attitudes([p.exif.attitude for p in photographs], positions.convergence)
    names = tuple(p.name for p in photographs)
    frame = None
    if control is not None:
        points = control.points.take(~control.points.has_role("tie"))
        frame = Given(points, named, names, control.system, positions and positions[:2])
        checks = {id for id, role in zip(points.id, points.role) if role == "check"}
        named = named.take(np.array([one not in checks for one in named.name], bool))
    extra = Extra(
        named, tuple(distances), positions[:2] if positions and framed else None, attitudes
    )
    system = "" if control is None else control.system
    if positions is not None and (framed or control is not None):
        system = positions.words if control is None else system or positions.system
    first = Path(given[0])
    name = name or (first if first.is_dir() else first.parent).resolve().name
    kept = Store(store, settings.detection)
    run = _ReconstructionRun(photographs, left_out, cameras, settings, kept, progress, extra)
    run.notes += notes
    run.frame, run.system, run.title = frame, system, name
    return run.run()


class _ReconstructionRun:
    """The state of a running reconstruction."""

    def __init__(self, photographs, left_out, cameras: Cameras, settings, store, tell, extra):
        self.photographs: list[Photograph] = photographs
        self.left_out: dict[str, str] = dict(left_out)
        self.cameras, self.settings, self.store, self.tell = cameras, settings, store, tell
        self.extra: Extra = extra
        self.workers = settings.workers or available_cores()
        self.names = [photograph.name for photograph in photographs]
        self.notes, self.stage = list(cameras.notes), ""
        self.warnings: list[tuple[float, str]] = []
        self.tried: set[tuple[int, int]] = set()
        self.frame: Given | None = None
        self.system = self.title = ""

    def run(self) -> Reconstruction:
        with ThreadPoolExecutor(1) as ahead:
            # compiled during the search and matching of features, and the verification of pairs
            programs = (prepare, refinement.prepare, many.prepare) if can_run_two_programs() else ()
            prepared = [ahead.submit(one) for one in programs]
            features, matches = self._matches()
            for first in prepared[:1]:
                first.result()
            self._calibrate(features, matches)
            pairs = self._verify(features, matches)
            for one in prepared:
                one.result()
        parts = self._parts(features, matches, pairs)
        said = tuple(
            (self.names[p.images[0]], self.names[p.images[1]], p.found, len(p), p.kind)
            for p in pairs
        )
        files = {p.name: p.path for p in self.photographs}
        warnings = [said for _, said in sorted(self.warnings, key=lambda one: -one[0])]
        return Reconstruction(
            tuple(parts), self.left_out, tuple(self.notes), said, files, tuple(warnings), self.title
        )

    def _matches(self):
        features = self._features()
        prints = [p.fingerprint for p in self.photographs]
        place = self.extra.positions and self.extra.positions[0]
        matches = match(
            features, prints, self.settings.pairs, place, self.store, self.workers, self.tell
        )
        self.store.drop_unused()
        sizes = [p.size for p in self.photographs]
        again = find_duplicates(matches, features, sizes)
        for k, (other, still, number) in again.items():
            self.left_out.setdefault(
                self.names[k],
                f"it shows the same as {self.names[other]} ({still} of {number} "
                "matches are at the same place): saved again, or taken from the same place",
            )
        self._require_two()
        matches = [m for m in matches if not {*m.images} & again.keys()]
        self.tried = {m.images for m in matches}
        matches, marked = without_marks(matches, features, sizes)
        if marked:
            self.notes.append(
                f"matches of marks at the same pixels of {marked} photographs (a date, a name, "
                "dirt on the sensor) are not used"
            )
        return features, matches

    def _features(self) -> list[Features]:
        read = [self._reader(p) for p in self.photographs]
        prints = [p.fingerprint for p in self.photographs]
        detection = self.settings.detection
        columns, rows = max((p.size for p in self.photographs), key=math.prod)
        need = memory_of_features(rows, columns, detection)
        at_once = photographs_at_once(rows * columns, need, self.workers)
        features = detect(
            [p.path for p in self.photographs],
            read,
            prints,
            detection,
            self.store,
            at_once,
            self.tell,
        )
        bad = {k for k, f in enumerate(features) if len(f) < TEXTURE}
        for k in sorted(bad):
            self.left_out.setdefault(
                self.names[k], f"no texture: {count(len(features[k]), 'feature')}"
            )
        self._require_two()
        return features

    def _require_two(self) -> None:
        """Refuse to go on with a single photograph."""
        if sum(name not in self.left_out for name in self.names) < 2:
            said = list_some((f"{n} ({w})" for n, w in self.left_out.items()), 3, str)
            raise InputError(f"fewer than two photographs can be used: {said}")

    def _reader(self, photograph: Photograph):
        def read():
            try:
                return read_photograph(photograph.path)
            except InputError as error:
                why = str(error).removeprefix(f"{photograph.path}: ")
                self.left_out[photograph.name] = why
                return np.zeros((8, 8), np.uint8)

        return read

    def _calibrate(self, features, matches) -> None:
        if self.cameras.given:
            return
        cameras, notes = start_cameras(
            self.cameras.cameras,
            self.cameras.of,
            self.cameras.lens,
            [one is not None for one in self.cameras.stated],
            features,
            matches,
        )
        self.cameras = dataclasses.replace(self.cameras, cameras=tuple(cameras))
        self.notes += notes

    def _verify(self, features, matches) -> list[Pair]:
        cameras = self.cameras.cameras, self.cameras.of, features
        pairs, wrong = without_contradicted(*cameras, verify(*cameras, matches, self.tell))
        if wrong:
            named = (" and ".join(self.names[k] for k in p.images) for p in wrong)
            self.notes.append(
                f"{count(len(wrong), 'pair')} of photographs not used, contradicted "
                f"by others in triplets: {list_some(named, 3, str)}"
            )
        if len(wrong) > REPEATS * (len(wrong) + len(pairs)):
            self._warn(
                f"{len(wrong)} of {len(wrong) + len(pairs)} pairs contradict others: the object "
                "repeats itself, and parts of it may have been superimposed; compare the "
                "result with the object, or take photographs with shorter bases"
            )
        return pairs

    def _parts(self, features, matches, pairs: Sequence[Pair]) -> list[Part]:
        least = min(SMALLEST_PART, sum(name not in self.left_out for name in self.names))
        waiting = group_connected(len(self.photographs), pairs)
        parts: list[Part] = []
        failed: list[str] = []
        while waiting:
            group = waiting.pop(0)
            if len(group) < least:
                for k in group:
                    self.left_out.setdefault(
                        self.names[k], why_alone(k, self.names, matches, pairs)
                    )
                continue
            try:
                part, reasons = self._part(group, features, pairs, f"part {len(parts) + 1}")
            except (InputError, NotSolvedError) as error:
                failed.append(str(error))
                for k in group:
                    self.left_out.setdefault(self.names[k], "its part could not be oriented")
                continue
            parts.append(part)
            rest = [k for k in group if self.names[k] in reasons]
            among = [p for p in pairs if set(p.images) <= set(rest)]
            again = [
                [rest[k] for k in g]
                for g in group_connected(
                    len(rest),
                    [
                        dataclasses.replace(
                            p, images=(rest.index(p.images[0]), rest.index(p.images[1]))
                        )
                        for p in among
                    ],
                )
            ]
            for g in again:
                if len(g) >= SMALLEST_PART and len(g) < len(group):
                    waiting.append(g)
                else:
                    self.left_out |= {self.names[k]: reasons[self.names[k]] for k in g}
        if not parts:
            raise NotSolvedError(self._why_nothing(pairs, failed), self.names)
        return sorted(parts, key=lambda part: -len(part.adjustment.network.images))

    def _warn(self, said: str, weight: float = 1.0) -> None:
        """Keep a warning; those of larger weight are shown first."""
        self.warnings.append((weight, said))

    def _begin(self, stage: str) -> None:
        """Begin a stage of unknown length, after the end of the one before."""
        if self.stage:
            self.tell(self.stage, 1, 1)
        self.stage = stage
        if stage:
            self.tell(stage, 0, 1)

    def _why_nothing(self, pairs, failed) -> str:
        kinds = {p.kind for p in pairs}
        if kinds == {"rotation"} or kinds == {"rotation", "plane"}:
            return (
                "not solved: a rotation or a plane explains every pair: the photographs were taken "
                "from one position, or show only a plane; take them from different positions"
            )
        if failed:
            return failed[0] if failed[0].startswith("not solved") else f"not solved: {failed[0]}"
        said = list_some((f"{n} ({w})" for n, w in self.left_out.items()), 3, str)
        some = "no three photographs overlap one another" if pairs else "no photographs overlap"
        return (
            f"not solved: {some}: {said}; take sharp photographs, at most 20 degrees from one "
            "to the next, on which the object or its surroundings have texture"
        )

    def _part(self, group, features, pairs, name) -> tuple[Part, dict[str, str]]:
        inside = [p for p in pairs if set(p.images) <= set(group)]
        tracks = make_tracks(features, inside)
        sizes = [photograph.size for photograph in self.photographs]
        kept = choose_tracks(tracks, [f.xy for f in features], sizes, self.settings.points)
        tracks = [track for track, keep in zip(tracks, kept) if keep]
        done = iter(range(1, len(features) + 1))
        measured = measure_tracks(
            tracks,
            features,
            lambda k: read_photograph(self.photographs[k].path, colour=True),
            lambda: self.tell("least squares matching", next(done), len(features)),
        )
        network = tie_network(
            self.photographs, self.cameras, measured, self.extra, name, self.settings.aspect_sigma
        )
        self._begin("start values")
        named = {(self.names[p.images[0]], self.names[p.images[1]]): p for p in inside}
        oriented, weighted, note = self._adjust_first(network, measured, named)
        weighted, note = self._check_ratios(oriented, weighted, measured, note)
        self._begin("")
        refuse_folded(weighted, measured, self.names)
        doubts = refuse_superimposed(weighted.adjustment, network, self.tried, self.names)
        self.notes += [note] if note else []
        self.notes += _name_unused(name, weighted)
        control, no_control = None, ""
        if self.frame is not None:
            try:
                weighted, control = georeference(
                    weighted, self.frame, self.settings.significance, self._begin
                )
            except (InputError, NotSolvedError) as error:
                no_control = str(error)
                self._warn(f"{name}: control is not used: {error}", np.inf)
            self._begin("")
        exif = {photograph.name: photograph.exif for photograph in self.photographs}
        # without control and positions the frame is an arbitrary one
        absolute = control is not None or self.extra.positions is not None
        block = describe_block(weighted.adjustment, exif, self.system if absolute else "")
        part = Part(
            name,
            weighted.adjustment,
            _colours(measured),
            weighted.factors,
            block,
            control,
            no_control,
        )
        if part.misfit >= LARGEST_MISFIT:
            self._warn(f"{name}: {misfit_in_words(part)}", part.misfit)
        for said in (*self._contradict_files(weighted.adjustment), *doubts):
            self._warn(f"{name}: {said}")
        return part, dict(oriented.images)

    def _contradict_files(self, result: Adjustment) -> list[str]:
        """Principal distances that contradict those of the files, in words."""
        stated = {c.id: s for c, s in zip(self.cameras.cameras, self.cameras.stated)}
        said = []
        for id, found in principal_distances(result).items():
            file = stated.get(id)
            if file is None or not found["sigma"]:
                continue
            sigma = np.hypot(file.sigma, found["sigma"])
            if abs(found["value"] - file.value) > CONTRADICTS_FILE * sigma:
                said.append(
                    f"camera {id}: principal distance {found['value']:.0f} px contradicts the "
                    f"{file.value:.0f} ± {file.sigma:.0f} px of the files ({file.source}): the "
                    "photographs were cropped or zoomed, or the result is wrong"
                )
        return said

    def _adjust_first(self, network, measured, pairs) -> tuple[Oriented, Weighted, str]:
        """The first start values that lead to an adjustment, the adjustment, and a note on
        attitudes."""
        guessed = [
            camera.id
            for camera, stated in zip(self.cameras.cameras, self.cameras.stated)
            if stated is None and not self.cameras.given
        ]
        failed: NotSolvedError | None = None
        for oriented in start_values(network, guessed, pairs):
            try:
                weighted, note = self._adjust(oriented, measured)
            except NotSolvedError as error:
                failed = failed or error
                continue
            result = weighted.adjustment
            if not is_plausible(result):
                failed = failed or _not_solved(result)
                continue
            again = start_again(network, oriented, result, pairs)
            if again is not None:
                try:
                    better, other_note = self._adjust(again, measured)
                except NotSolvedError:
                    return oriented, weighted, note
                if is_plausible(better.adjustment):
                    return again, better, other_note
            return oriented, weighted, note
        assert failed is not None, "start values are there, or an error says why not"
        raise failed

    def _check_ratios(
        self, oriented: Oriented, weighted: Weighted, measured, note: str
    ) -> tuple[Weighted, str]:
        """The adjustment with square pixels, unless halves of the photographs agree that they are
        not."""
        contradicted = aspect_ratio.contradicted_ratios(weighted.adjustment)
        if not contradicted:
            return weighted, note
        self._begin("ratio of the focal lengths")
        halves = aspect_ratio.replicated_ratios(weighted.adjustment)
        released = {}
        for id, found in contradicted.items():
            both = halves.get(id)
            said = f"camera {id}: the photographs alone give fy/fx {_ratio_in_words(found)}, "
            if both is None:
                said += "halves of them none: "
            else:
                said += f"halves of them {' and '.join(map(_ratio_in_words, both))}: "
            if both is not None and aspect_ratio.is_replicated(*both):
                released[id] = found
                self.notes.append(f"{said}the pixels are not square")
            else:
                self.notes.append(
                    f"{said}not confirmed, the pixels are taken as square (fy/fx "
                    f"1 ± {self.settings.aspect_sigma:g})"
                )
        if not released:
            return weighted, note
        network = aspect_ratio.release(oriented.network, released)
        return self._adjust(dataclasses.replace(oriented, network=network), measured)

    def _adjust(self, oriented: Oriented, measured) -> tuple[Weighted, str]:
        placed, note = with_attitudes(oriented.network, self.names, self.extra.attitudes)
        kinds, named = _kinds(placed, measured, self.names)
        significance = self.settings.significance
        return adjust_weighted(placed, kinds, named, significance, self._begin), note


def _ratio_in_words(ratio: aspect_ratio.Ratio) -> str:
    return f"{1 + ratio.deviation:.5f} ± {ratio.sigma:.5f}"


def _not_solved(result: Adjustment) -> NotSolvedError:
    if not result.converged:
        why = "; ".join([result.termination, *result.findings, *result.weakness.lines])
        return NotSolvedError(f"not solved: {why}", list(result.undetermined))
    found = ", ".join(
        f"{c['value']:.0f} px in {id}" for id, c in principal_distances(result).items()
    )
    return NotSolvedError(
        f"not solved: impossible principal distance {found}; take photographs from "
        "positions farther apart, or give --camera"
    )


def _name_unused(name: str, weighted: Weighted) -> list[str]:
    if not weighted.unused:
        return []
    return [
        f"{name}: {count(weighted.unused, 'point')} of two rays not used: with them the "
        "measurements contradict each other, as on an object that repeats itself"
    ]


def _kinds(network: Network, measured: Measurements, names: Sequence[str]):
    """The kind of every observation, and the names of kinds."""
    columns = (measured.image, measured.track, measured.level)
    level = {(names[i], track_name(t)): l for i, t, l in zip(*(c.tolist() for c in columns))}
    rays, images, points = network.observations, network.images.id, network.points.id
    kinds = np.array(
        [
            level.get((images[i], points[p]), NAMED)
            for i, p in zip(rays.image.tolist(), rays.point.tolist())
        ],
        int,
    )
    kinds[(kinds > 2) & (kinds < NAMED)] = 2
    words = {
        -1: "features not matched",
        0: "matched in the original",
        1: "matched at half size",
        2: "matched at a quarter or smaller",
        NAMED: "named points",
    }
    return kinds, words


def _colours(measured: Measurements) -> dict[str, tuple[int, int, int]]:
    first = measured.first
    return {
        track_name(t): tuple(c)
        for t, c in zip(measured.track[first].tolist(), measured.colour[first].tolist())
    }
