"""Points with names in photographs: coded targets, control points, ends of scale bars."""

import dataclasses
import itertools
import math
import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbundle.errors import InputError
from jaxbundle.io.text.csv_tables import read_csv
from jaxbundle.measure.coded_targets import NamedPoints, find_coded_targets, memory_of_targets
from jaxbundle.network.columns import list_some
from jaxbundle.photographs.concurrent import photographs_at_once
from jaxbundle.photographs.reading import image_errors, read_photograph
from jaxbundle.reconstruction.control import Control
from jaxbundle.reconstruction.photographs import Photograph
from jaxbundle.system.threads import map_in_threads
from jaxbundle.tiepoints.features import Features
from jaxbundle.tiepoints.matching import FeatureMatches


@dataclasses.dataclass(frozen=True)
class NamedMeasurements:
    """Measurements of named points: photograph, name, pixels, σ in pixels."""

    image: Int[np.ndarray, " n"]
    name: tuple[str, ...]
    xy: Float[np.ndarray, "n 2"]
    sigma: Float[np.ndarray, "n 2"]

    def __len__(self) -> int:
        return len(self.name)

    def take(self, selection: Bool[np.ndarray, " n"]) -> "NamedMeasurements":
        """The chosen measurements."""
        rows = np.flatnonzero(selection)
        return NamedMeasurements(
            self.image[rows], tuple(self.name[k] for k in rows), self.xy[rows], self.sigma[rows]
        )


def no_named_points() -> NamedMeasurements:
    """No measurements."""
    return NamedMeasurements(np.zeros(0, int), (), np.zeros((0, 2)), np.zeros((0, 2)))


@dataclasses.dataclass(frozen=True)
class Discs:
    """Uncoded discs of every photograph: pixels and their σ."""

    xy: tuple[Float[np.ndarray, "_ 2"], ...]
    sigma: tuple[Float[np.ndarray, "_ 2"], ...]

    def __len__(self) -> int:
        return sum(map(len, self.xy))


def find_named(
    photographs: Sequence[Photograph],
    targets: str | None,
    control: Control | None,
    workers: int | None = None,
    uncoded: bool = False,
) -> tuple[NamedMeasurements, Discs | None, list[str]]:
    """The coded targets of all photographs and the measurements of control points; uncoded discs,
    if they are looked for; notes. `workers`: photographs in work at once, at most; default: one for
    each core.

    **Raises:** `InputError` if control points are measured in unknown photographs only, or where
    their coded target is found, too.
    """
    image, name, xy, sigma, notes = [], [], [], [], []
    discs = None
    if targets:
        columns, rows = max((p.size for p in photographs), key=math.prod)
        need = memory_of_targets(rows, columns, targets)
        at_once = photographs_at_once(rows * columns, need, workers)
        find = lambda photograph: _find_targets(photograph, targets, uncoded)
        of_photographs = map_in_threads(find, photographs, at_once)
        for k, points in enumerate(of_photographs):
            if isinstance(points, str):
                notes.append(f"{photographs[k].name}: no targets are looked for: {points}")
                continue
            image += [k] * len(points)
            name += points.names
            xy += list(points.xy)
            sigma += list(points.sigma)
        left_out = Counter(
            why
            for points in of_photographs
            if not isinstance(points, str)
            for _, why in points.left_out
        )
        notes += [
            f"{n} measurements of coded targets are left out: {why}" for why, n in left_out.items()
        ]
        notes.append(f"{len(set(name))} coded targets ({targets}) in {len(set(image))} photographs")
        if uncoded:
            uncoded_targets = [getattr(points, "uncoded", None) for points in of_photographs]
            discs = Discs(
                tuple(np.zeros((0, 2)) if p is None else p.xy for p in uncoded_targets),
                tuple(np.zeros((0, 2)) if p is None else p.sigma for p in uncoded_targets),
            )
    if control is not None and control.sightings:
        files = sorted({file for file, _ in control.sightings})
        names = [photograph.name for photograph in photographs]
        index = _find_by_name(files, names)
        unknown = [file for file in files if file not in index]
        # All: another folder was given; some: photographs that were left out of it.
        if not index:
            raise InputError(
                f"{control.points.source.name}: measured in none of the photographs "
                f"({list_some(names, 3, str)}), but in {list_some(unknown, 3, str)}"
            )
        if unknown:
            notes.append(f"control measured in missing photographs: {list_some(unknown)}")
        found = set(zip(image, name))
        for (file, id), place, s in zip(control.sightings, control.xy, control.sigma):
            if file in index:
                if (index[file], id) in found:
                    raise InputError(
                        f"{control.points.source.name}: point {id} is measured in {file}, where "
                        f"the coded target {id} is found, too: leave out the row, or give the "
                        "point another id"
                    )
                image.append(index[file])
                name.append(id)
                xy.append(place)
                sigma.append((s, s))
    if not name:
        return no_named_points(), discs, notes
    columns = np.array(image), tuple(name), np.array(xy, float), np.array(sigma, float)
    return NamedMeasurements(*columns), discs, notes


def _find_by_name(files: Sequence[str], names: Sequence[str]) -> dict[str, int]:
    """By file the photograph of this name; else the only one whose name differs by case, or only by
    case and suffix."""
    index: dict[str, int] = {}
    stem = lambda name: os.path.splitext(name.casefold())[0]
    for of_name, of_file in (
        (str, str),
        (str.casefold, str.casefold),
        (stem, str.casefold),
        (stem, stem),
    ):
        numbers: dict[str, list[int]] = {}
        for k, name in enumerate(names):
            numbers.setdefault(of_name(name), []).append(k)
        for file in files:
            same_name = numbers.get(of_file(file), [])
            if file not in index and len(same_name) == 1 and same_name[0] not in index.values():
                index[file] = same_name[0]
    return index


def join_named(first_part: NamedMeasurements, second_part: NamedMeasurements) -> NamedMeasurements:
    """The measurements of both."""
    return NamedMeasurements(
        np.concatenate([first_part.image, second_part.image]),
        (*first_part.name, *second_part.name),
        np.concatenate([first_part.xy, second_part.xy]),
        np.concatenate([first_part.sigma, second_part.sigma]),
    )


def named_as_features(named_measurements: NamedMeasurements, photographs: int) -> list[Features]:
    """Named points as features, which have neither size nor descriptor."""
    places = [named_measurements.xy[named_measurements.image == k] for k in range(photographs)]
    nothing = lambda xy: (np.ones(len(xy)), np.zeros(len(xy)), np.zeros((len(xy), 1), np.uint8))
    return [Features(xy, *nothing(xy)) for xy in places]


def match_named(
    named_measurements: NamedMeasurements, photographs: int, min_common: int
) -> list[FeatureMatches]:
    """Pairs of photographs with at least `min_common` common names, as matches of
    `named_as_features`."""
    names = np.array(named_measurements.name, object)
    row = [
        {name: k for k, name in enumerate(names[named_measurements.image == image])}
        for image in range(photographs)
    ]
    matches = []
    for i, j in itertools.combinations(range(photographs), 2):
        rows = np.array([(a, row[j][name]) for name, a in row[i].items() if name in row[j]])
        if len(rows) >= min_common:
            # By their names they are certain.
            certainty = np.zeros(len(rows)), np.ones(len(rows), bool)
            matches.append(FeatureMatches((i, j), rows, *certainty))
    return matches


def name_unused(
    named_measurements: NamedMeasurements,
    control: Control | None,
    distances: Sequence[dict],
    min_control: int,
) -> list[str]:
    """Notes about scale bars and control points in no photographs.

    **Raises:** `InputError` if no scale bar, or fewer than `min_control` control points, are left.
    """
    photograph_count = {
        name: len(set(named_measurements.image[np.array(named_measurements.name) == name].tolist()))
        for name in set(named_measurements.name)
    }
    # An end in one photograph has no position, and a distance to it says nothing.
    ends = lambda d: min(photograph_count.get(d["from"], 0), photograph_count.get(d["to"], 0))
    unseen = [f"{d['from']} to {d['to']}" for d in distances if ends(d) < 2]
    if distances and len(unseen) == len(distances):
        raise InputError(
            f"no scale bar has both ends in two photographs ({list_some(unseen, 3, str)}): check "
            "the names of the targets"
        )
    notes = [f"scale bars that are not in two photographs: {list_some(unseen, 3, str)}"] * bool(
        unseen
    )
    if control is not None:
        # Tie points with coordinates are no control (`reconstruct`).
        points = control.points.take(~control.points.has_role("tie"))
        unseen = [id for id in points.id if id not in photograph_count]
        number = sum(
            id in photograph_count and role != "check" for id, role in zip(points.id, points.role)
        )
        if number < min_control:
            raise InputError(
                f"{points.source.name}: {number} control points are measured in the photographs, "
                f"{min_control} are needed"
                + (f"; not found: {list_some(unseen, 5, str)}" if unseen else "")
            )
        notes += [f"control points in no photograph: {list_some(unseen, 5, str)}"] * bool(unseen)
    return notes


def _find_targets(photograph: Photograph, kind: str, uncoded: bool) -> NamedPoints | str:
    """The coded targets of a photograph, or why it cannot be read."""
    try:
        grey = read_photograph(photograph.path)
    except InputError as error:
        return str(error).removeprefix(f"{photograph.path}: ")
    with image_errors(photograph.path):
        return find_coded_targets(grey, kind, uncoded=uncoded)


def read_distances(path: str | Path) -> list[dict]:
    """Rows `from`, `to`, `value`, `sigma` of scale bars between named points.

    **Raises:** `InputError`."""
    table = read_csv(Path(path))
    value = table.numbers("value", required=True)
    sigma = table.numbers("sigma", required=True)
    return [
        {"from": a, "to": b, "value": float(v), "sigma": float(s)}
        for a, b, v, s in zip(table.ids("from"), table.ids("to"), value, sigma)
    ]
