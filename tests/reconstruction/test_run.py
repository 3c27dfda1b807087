"""Stages of a reconstruction whose parts are given."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from jaxbundle import Camera
from jaxbundle.reconstruction import reconstruct, square_pixels
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


@pytest.mark.parametrize("left, parts", [(2, 1), (3, 2)])
def test_what_is_left_of_a_part_is_another_one_if_it_is_large_enough(run, monkeypatch, left, parts):
    """Of three photographs or more; fewer are left out with the reason that the first part gave."""
    n = 5 + left
    run.photographs = [SimpleNamespace(name=f"{k}.jpg") for k in range(n)]
    run.names = [photograph.name for photograph in run.photographs]
    pairs = [Connection((k, k + 1)) for k in range(n - 1)]
    made = []

    def make(group, *_):
        made.append(group)
        reasons = {f"{k}.jpg": "elsewhere" for k in group[5:]} if len(made) == 1 else {}
        network = SimpleNamespace(images=group)
        return SimpleNamespace(adjustment=SimpleNamespace(network=network)), reasons

    monkeypatch.setattr(run, "_make_part", make)
    assert len(run._make_parts([], [], pairs)) == parts
    assert made == [[*range(n)], [*range(5, n)]][:parts]
    expected = {f"{k}.jpg": "elsewhere" for k in range(5, n)} if parts == 1 else {}
    assert run.left_out == expected


@pytest.mark.parametrize("confirmed", [True, False])
def test_pixels_are_released_only_if_both_halves_of_the_photographs_agree(
    run, monkeypatch, confirmed
):
    """Otherwise the adjustment with square pixels is the result."""
    ratio = square_pixels.Ratio(0.02, 0.001)
    monkeypatch.setattr(square_pixels, "contradicted_ratios", lambda _: {"cam": ratio})
    monkeypatch.setattr(square_pixels, "replicated_ratios", lambda _: {"cam": (ratio, ratio)})
    monkeypatch.setattr(square_pixels, "is_replicated", lambda *_: confirmed)
    monkeypatch.setattr(square_pixels, "release", lambda network, ids: (network, [*ids]))
    monkeypatch.setattr(reconstruct.dataclasses, "replace", lambda _, network: network)
    monkeypatch.setattr(run, "_adjust", lambda network, measured: (network, "again"))
    oriented, weighted = SimpleNamespace(network="network"), SimpleNamespace(adjustment=None)
    found = run._check_ratios(oriented, weighted, None, "first")
    assert found == ((("network", ["cam"]), "again") if confirmed else (weighted, "first"))
    assert ("are not square" in run.notes[-1]) == confirmed


@pytest.mark.parametrize("correlated", [True, False])
def test_parts_state_errors_that_image_points_share_unless_turned_off(run, monkeypatch, correlated):
    examined = SimpleNamespace()
    adjusted = SimpleNamespace(with_correlated_errors=lambda: examined)
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
    part, _ = run._make_part([], [], [], "part 1")
    assert part.adjustment is (examined if correlated else adjusted)
