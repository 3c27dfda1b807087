"""Stages of a reconstruction whose parts are given."""

import copy
import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from jaxbundle import Camera
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.network.tables import Images
from jaxbundle.photographs.places import MapPositions
from jaxbundle.reconstruction import reconstruct, square_pixels
from jaxbundle.reconstruction.named import NamedMeasurements, no_named_points
from jaxbundle.reconstruction.network import FurtherData
from jaxbundle.reconstruction.photographs import Cameras
from jaxbundle.reconstruction.reconstruct import ReconstructionSettings, _ReconstructionRun
from jaxbundle.tiepoints.matching import FeatureMatches


@pytest.fixture
def run():
    photographs = [
        SimpleNamespace(name=f"{k}.jpg", fingerprint=str(k), size=(9, 6)) for k in range(3)
    ]
    return _ReconstructionRun(
        photographs, {}, SimpleNamespace(notes=()), ReconstructionSettings(),
        SimpleNamespace(drop_unused=lambda: None), lambda *_: None,
        SimpleNamespace(positions=None, distances=()),
    )  # fmt: skip


def test_pairs_with_matches_are_known_with_those_that_are_only_marks(run, monkeypatch):
    """They were compared, whatever was found: without them superimposed parts would not show.
    Duplicates take no part."""
    rows = np.zeros((4, 2), int)
    matches = [FeatureMatches(pair, rows, np.ones(4), np.ones(4, bool))
               for pair in ((0, 1), (0, 2), (1, 2))]  # fmt: skip
    monkeypatch.setattr(run, "_detect", lambda: [])
    monkeypatch.setattr(reconstruct, "match", lambda *_: matches)
    monkeypatch.setattr(reconstruct, "find_duplicates", lambda *_: {2: (0, 4, 4)})
    monkeypatch.setattr(reconstruct, "without_marks", lambda *_: ([], 2))
    assert run._match() == ([], [])
    assert run.matched_pairs == {(0, 1)} and run.left_out.keys() == {"2.jpg"}


def test_the_photographs_are_matched_with_the_cameras_that_the_matches_gave(run, monkeypatch):
    """Not with the first guess; those given as calibrated stay."""
    guess, found = (Camera("c", "opencv", {"fx": f, "fy": f}) for f in (1000.0, 1400.0))
    monkeypatch.setattr(reconstruct, "start_cameras", lambda *_: ([found], ["found"]))
    for calibrated, camera in ((True, guess), (False, found)):
        run.cameras = Cameras((guess,), (0, 0, 0), (None,), calibrated, ())
        run._find_cameras([], [])
        assert run.cameras.cameras == (camera,) and run.cameras.camera_of == (0, 0, 0)


@pytest.mark.parametrize("wrong, warned", [(0, False), (1, False), (20, True)])
def test_many_contradictory_pairs_are_warned_of(run, monkeypatch, wrong, warned):
    """A few are wrong matches; many, an object that repeats itself."""
    pairs = [SimpleNamespace(images=(0, 1))] * 20
    run.cameras = Cameras((), (), (), True, ())
    monkeypatch.setattr(reconstruct, "verify", lambda *_: pairs)
    found = pairs, [SimpleNamespace(images=(1, 2))] * wrong
    monkeypatch.setattr(reconstruct, "without_contradicted", lambda *_: found)
    assert run._verify([], []) == pairs
    assert bool(run.notes) == (wrong > 0)
    said = " ".join(words for _, words in run.warnings)
    assert (f"{wrong} of {20 + wrong} pairs contradict others" in said) == warned


@dataclasses.dataclass
class Connection:
    images: tuple[int, int]


@dataclasses.dataclass
class Adjusted:
    network: SimpleNamespace
    with_changes = copy.copy


@dataclasses.dataclass
class Part:
    name: str
    adjustment: Adjusted


def part_of(group, name):
    """A part of these photographs, and its network with its name."""
    n = len(group)
    zeros = np.zeros((n, 6))
    images = Images(tuple(f"{k}.jpg" for k in group), zeros[:, 0].astype(int), zeros[:, :3],
                    zeros[:, 3:], zeros)  # fmt: skip
    network = lambda name: SimpleNamespace(
        images=images, name=name, replace=lambda name: network(name)
    )
    return Part(name, Adjusted(network(name)))


@pytest.mark.parametrize("left, parts", [(2, 1), (3, 2)])
def test_what_is_left_of_a_part_is_another_one_if_it_is_large_enough(run, monkeypatch, left, parts):
    """Of three photographs or more; fewer are left out with the reason that the first part gave."""
    n = 5 + left
    run.photographs = [SimpleNamespace(name=f"{k}.jpg") for k in range(n)]
    run.names = [photograph.name for photograph in run.photographs]
    pairs = [Connection((k, k + 1)) for k in range(n - 1)]
    made = []

    def make(group, features, pairs, name):
        made.append(group)
        reasons = {f"{k}.jpg": "elsewhere" for k in group[5:]} if len(made) == 1 else {}
        return part_of([k for k in group if f"{k}.jpg" not in reasons], name), reasons

    monkeypatch.setattr(run, "_make_part", make)
    assert len(run._make_parts([], [], pairs)) == parts
    assert made == [[*range(n)], [*range(5, n)]][:parts]
    expected = {f"{k}.jpg": "elsewhere" for k in range(5, n)} if parts == 1 else {}
    assert run.left_out == expected


def three_groups(run, monkeypatch, make):
    """The parts of ten photographs in groups of four and twice three."""
    run.photographs = [SimpleNamespace(name=f"{k}.jpg") for k in range(10)]
    run.names = [photograph.name for photograph in run.photographs]
    pairs = [Connection((k, k + 1)) for k in range(9) if k not in (3, 6)]
    monkeypatch.setattr(run, "_make_part", make)
    return run._make_parts([], [], pairs)


def test_a_photograph_that_is_lost_has_a_reason(run, monkeypatch):
    """That of its part, if this failed; and if none of its points were chosen. What is said of
    a part that failed is not said of the next one, which has its name."""

    def make(group, features, pairs, name):
        run.notes.append(f"{name}: {len(group)} photographs")
        if group[0] == 4:
            raise NotSolvedError("not solved: impossible principal distance")
        return part_of(group[:3], name), {}

    parts = three_groups(run, monkeypatch, make)
    assert [part.name for part in parts] == ["part 1", "part 2"]
    assert run.notes == ["part 1: 4 photographs", "part 2: 3 photographs"]
    why = "its part could not be oriented: impossible principal distance"
    assert run.left_out == {"3.jpg": "none of its tie points is used",
                            **{f"{k}.jpg": why for k in (4, 5, 6)}}  # fmt: skip


def test_parts_are_numbered_by_what_is_left_of_them(run, monkeypatch):
    """The first group has lost two of its four photographs."""
    run.title = "job"

    def make(group, features, pairs, name):
        run.notes.append(f"{name}: begins with {group[0]}")
        run._warn(f"{name}: begins with {group[0]}")
        return part_of(group[:2] if group[0] == 0 else group, name), {}

    parts = three_groups(run, monkeypatch, make)
    assert [part.name for part in parts] == ["part 1", "part 2", "part 3"]
    assert [part.adjustment.network.images.id[0] for part in parts] == ["4.jpg", "7.jpg", "0.jpg"]
    names = ["job", "job, part 2", "job, part 3"]
    assert [part.adjustment.network.name for part in parts] == names
    said = ["part 3: begins with 0", "part 1: begins with 4", "part 2: begins with 7"]
    assert run.notes == said and [words for _, words in run.warnings] == said


def test_targets_of_other_groups_are_not_in_the_network_of_a_part(run, monkeypatch):
    nothing = np.zeros((3, 2))
    named = NamedMeasurements(np.arange(3), ("a", "b", "c"), nothing, nothing)
    monkeypatch.setattr(reconstruct, "photograph_network", lambda *given: given[3].named)
    assert run._make_network("part 1", [0, 2], None, FurtherData(named)).name == ("a", "c")


@pytest.mark.parametrize("natural", [True, False])
def test_a_photograph_needs_no_more_targets_than_a_pair(run, monkeypatch, natural):
    """Where they alone connect the photographs; of features fewer than twelve may be wrong."""
    run.settings = ReconstructionSettings(targets="ring14", natural_points=natural)
    run.cameras = Cameras((), (), (), True, ())

    def start(network, guessed, pairs, settings):
        expected = settings.min_rays if natural else run.settings.min_common_targets
        assert settings.min_rays == expected == (12 if natural else 8)
        raise NotSolvedError("asked")

    monkeypatch.setattr(reconstruct, "start_values", start)
    with pytest.raises(NotSolvedError, match="asked"):
        run._adjust_first(None, None, {})


def test_a_damaged_photograph_without_targets_is_told_as_damaged(run, monkeypatch):
    """Not that it has too few targets."""

    def read(path):
        if path == "1.jpg":
            raise InputError("1.jpg: the file ends early")

    monkeypatch.setattr(reconstruct, "read_photograph", read)
    run.further = FurtherData(no_named_points())
    for photograph in run.photographs:
        photograph.path = photograph.name
    with pytest.raises(InputError, match="fewer than two photographs"):
        run._match_named()
    assert run.left_out["1.jpg"] == "the file ends early"
    assert run.left_out["2.jpg"] == "0 coded targets, at least 8 are needed"


@pytest.mark.parametrize("workers, given", [(0, None), (3, 3)])
def test_targets_are_searched_on_as_many_cores_as_the_settings_say(monkeypatch, workers, given):
    """On all of them without a number."""

    def find(photographs, targets, control, workers, uncoded):
        assert workers == given
        raise InputError("asked")

    for name, found in {"find_photographs": ([], {}), "assign_cameras": None}.items():
        monkeypatch.setattr(reconstruct, name, lambda *_, found=found: found)
    monkeypatch.setattr(reconstruct, "find_named", find)
    with pytest.raises(InputError, match="asked"):
        reconstruct.reconstruct([], settings=ReconstructionSettings(workers=workers))


@pytest.mark.parametrize("confirmed, solved", [
    (True, True), (False, True), (True, False), (True, None),
])  # fmt: skip
def test_pixels_are_released_only_if_both_halves_of_the_photographs_agree(
    run, monkeypatch, confirmed, solved
):
    """And the adjustment has a plausible solution; otherwise that with square pixels is the
    result."""
    ratio = square_pixels.Ratio(0.02, 0.001)
    monkeypatch.setattr(square_pixels, "contradicted_ratios", lambda _: {"cam": ratio})
    monkeypatch.setattr(square_pixels, "replicated_ratios", lambda _: {"cam": (ratio, ratio)})
    monkeypatch.setattr(square_pixels, "is_replicated", lambda *_: confirmed)
    monkeypatch.setattr(square_pixels, "release", lambda network, ids: (network, [*ids]))
    monkeypatch.setattr(reconstruct.dataclasses, "replace", lambda _, network: network)
    better = SimpleNamespace(adjustment=SimpleNamespace(converged=True, cameras={}))

    def adjust(network, measured):
        assert network == ("network", ["cam"])
        if solved is None:
            raise NotSolvedError("not solved")
        return better, "again"

    monkeypatch.setattr(run, "_adjust", adjust)
    monkeypatch.setattr(reconstruct, "is_plausible", lambda *_: solved)
    run.cameras = Cameras((), (), (), True, ())
    oriented, weighted = SimpleNamespace(network="network"), SimpleNamespace(adjustment=None)
    found = run._check_ratios(oriented, weighted, None, "first")
    assert found == ((better, "again") if confirmed and solved else (weighted, "first"))
    (note,) = run.notes
    assert ("are not square" in note) == bool(confirmed and solved) != ("as square" in note)


@pytest.mark.parametrize("correlated", [True, False])
def test_parts_state_errors_that_image_points_share_unless_turned_off(run, monkeypatch, correlated):
    network = SimpleNamespace(distances=())
    examined = SimpleNamespace(network=network)
    adjusted = SimpleNamespace(network=network, with_correlated_errors=lambda: examined)
    weighted = SimpleNamespace(adjustment=adjusted, factors={}, unused_points=0)
    none = np.zeros(0, int)
    measured = SimpleNamespace(is_template=none > 0, track=none, colour=np.zeros((0, 3), int))
    oriented = SimpleNamespace(images_not_placed={})
    for photograph in run.photographs:
        photograph.exif = None
    for name in ("photograph_network", "refuse_folded", "describe_block"):
        monkeypatch.setattr(reconstruct, name, lambda *_: None)
    monkeypatch.setattr(reconstruct, "refuse_superimposed", lambda *_: [])
    for name, found in {
        "_measure": measured, "_adjust_first": (oriented, weighted, ""),
        "_check_ratios": (weighted, ""), "_compare_with_files": [],
    }.items():  # fmt: skip
        monkeypatch.setattr(run, name, lambda *_, found=found: found)
    run.settings = ReconstructionSettings(correlated=correlated)
    run.further = FurtherData(no_named_points(), distances=({"from": "a", "to": "b"},))
    part, _ = run._make_part([], [], [], "part 1")
    assert part.adjustment is (examined if correlated else adjusted)
    # without scale bars of its own, though another part has some
    (note,) = run.notes
    assert note.startswith("part 1: position, orientation and scale are arbitrary")


@pytest.mark.parametrize("positions, distance, unit", [(False, 428.0, "mm"), (True, 0.428, "m")])
def test_distances_give_the_result_their_unit_unless_positions_do(
    monkeypatch, tmp_path, positions, distance, unit
):
    photographs = [
        SimpleNamespace(name=name, exif=SimpleNamespace(attitude=None)) for name in ("a", "b")
    ]
    X = np.zeros((2, 3))
    found = MapPositions(X, X + 1, np.zeros(2), "EPSG:32633", True) if positions else None
    image, names = np.array([0, 0, 1, 1]), ("p", "q", "p", "q")
    named = NamedMeasurements(image, names, np.zeros((4, 2)), np.ones((4, 2)))
    monkeypatch.setattr(reconstruct, "find_photographs", lambda given: (photographs, {}))
    monkeypatch.setattr(reconstruct, "assign_cameras", lambda *_: Cameras((), (), (), False, ()))
    monkeypatch.setattr(reconstruct, "find_named", lambda *_: (named, None, []))
    monkeypatch.setattr(reconstruct, "find_positions", lambda *_: (found, []))
    monkeypatch.setattr(_ReconstructionRun, "run", lambda run: run)
    bars = [{"from": "p", "to": "q", "value": 428.0, "sigma": 0.01}]
    run = reconstruct.reconstruct(
        [tmp_path], settings=ReconstructionSettings(unit="mm"), distances=bars
    )
    further = run.further
    assert positions == any("in mm are converted to metres" in note for note in run.notes)
    (bar,) = further.distances
    assert bar["value"] == pytest.approx(distance) and further.unit == unit
    assert bar["sigma"] / bar["value"] == pytest.approx(0.01 / 428.0)
    with pytest.raises(InputError, match="unit must be one of nm, um"):
        ReconstructionSettings(unit="parsec")
