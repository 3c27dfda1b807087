"""Matches of known geometry: principal distance, verification, tracks, what is kept."""

import dataclasses
from itertools import combinations
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxbundle
from jaxbundle.errors import InputError
from jaxbundle.orientation import batched
from jaxbundle.tiepoints import camera_starts, verification
from jaxbundle.tiepoints.camera_starts import start_cameras
from jaxbundle.tiepoints.coplanarity import CoplanaritySettings, estimate_interior
from jaxbundle.tiepoints.features import (
    Features,
    FeatureSettings,
    _search,
    find_features,
    memory_of_features,
)
from jaxbundle.tiepoints.interior_from_loops import (
    ClosureMinimum,
    ClosureSettings,
    close_rotations,
    count_independent,
    find_loops,
)
from jaxbundle.tiepoints.matching import (
    FeatureMatches,
    count_matches_of_largest,
    distances_within,
    match_features,
)
from jaxbundle.tiepoints.pair_consistency import split_contradicted
from jaxbundle.tiepoints.pairs import CandidateSettings, candidate_pairs
from jaxbundle.tiepoints.static_marks import MarkSettings, without_marks
from jaxbundle.tiepoints.store import Store
from jaxbundle.tiepoints.track_measurement import TrackMatchingSettings
from jaxbundle.tiepoints.tracks import choose_tracks, make_tracks
from jaxbundle.tiepoints.verification import (
    Pair,
    VerificationSettings,
    rotation_angle,
    verify_pairs,
)
from jaxbundle.tiepoints.verified_pairs import _with_ideal

SIZE, F, K1 = (1200, 900), 1000.0, -0.1


def seen(X, X0, M):
    """Ideal coordinates, c = 1, y up, of points."""
    ray = (X - X0) @ M.T
    return -ray[:, :2] / ray[:, 2:]


def pixels(xy, rng):
    """Pixels of a camera with distortion, v down, with noise."""
    x, y = xy[:, 0], -xy[:, 1]
    grown = 1 + K1 * (x**2 + y**2)
    u, v = F * x * grown + SIZE[0] / 2 - 0.5, F * y * grown + SIZE[1] / 2 - 0.5
    return np.stack([u, v], 1) + 0.3 * rng.normal(size=(len(x), 2))


def stations(number, rng):
    azimuth = np.linspace(-0.6, 0.6, number)
    for a in azimuth:
        X0 = 8 * np.array([np.sin(a), 0.2 * np.cos(7 * a), np.cos(a)])
        z = X0 / np.linalg.norm(X0)
        x = np.cross([0, 1.0, 0], z)
        x /= np.linalg.norm(x)
        M = np.stack([x, np.cross(z, x), z])
        yield X0, Rotation.from_rotvec(0.1 * rng.normal(size=3)).as_matrix() @ M


@pytest.fixture(scope="module")
def cloud():
    rng = np.random.default_rng(4)
    X = rng.uniform(-2.2, 2.2, (160, 3))
    return rng, X, list(stations(5, rng))


@pytest.mark.further
def test_principal_distance_and_distortion_from_pairs(cloud):
    rng, X, views = cloud
    uv = [pixels(seen(X, *view), rng) for view in views]
    pairs = [(uv[i].copy(), uv[j].copy()) for i in range(5) for j in range(i + 1, 5)]
    for _, other in pairs:
        wrong = rng.random(len(X)) < 0.15
        other[wrong] = rng.uniform(0, 900, (wrong.sum(), 2))
    camera = jaxbundle.Camera(
        "c", "opencv", {"fx": 1440.0, "fy": 1440.0, "cx": 599.5, "cy": 449.5}, image_size=SIZE
    )
    found = estimate_interior(camera, pairs, is_known=False)
    assert found.camera.parameters["fx"] == pytest.approx(F, rel=0.02)
    assert found.camera.parameters["k1"] == pytest.approx(K1, abs=0.03)
    assert found.misclosure < 0.5


@pytest.mark.further
def test_distortion_of_a_known_long_lens_from_pairs():
    """A principal distance of 15 longer sides, 540 mm of full frame, as the files state it."""
    rng, f, k1 = np.random.default_rng(4), 15.0 * SIZE[0], 0.3
    X, views = rng.uniform(-2.2, 2.2, (160, 3)), list(stations(5, rng))
    uv = []
    for X0, M in views:
        xy = seen(X, X0 * f / F, M) * [1, -1]
        uv.append(f * xy * (1 + k1 * (xy**2).sum(1, keepdims=True))
                  + 0.05 * rng.normal(size=xy.shape))  # fmt: skip
    pairs = list(combinations(uv, 2))
    camera = jaxbundle.Camera(
        "c", "opencv", {"fx": f, "fy": f, "cx": 0.0, "cy": 0.0}, image_size=SIZE
    )
    found = estimate_interior(camera, pairs, is_known=True).camera.parameters
    # K1 moves points of the corners, at r = 0.03, by 0.2 px; it is no more than a start value
    assert found["fx"] == pytest.approx(f, rel=0.02)
    assert found["k1"] == pytest.approx(k1, abs=0.1)


@pytest.mark.further
def test_rotations_close_with_the_right_principal_distance_and_distortion():
    """A flat object, EXIF 20 % wrong, a fifth of the matches and one pair wrong: the coplanarity
    condition alone leaves the principal distance undecided."""
    rng = np.random.default_rng(8)
    X = rng.uniform(-2.2, 2.2, (160, 3)) * [1, 1, 0.02]
    views = list(stations(6, rng))
    features = [features_at(pixels(seen(X, *view), rng)) for view in views]
    matches = []
    for i, j in combinations(range(6), 2):
        rows = np.tile(np.arange(len(X))[:, None], 2)
        wrong = rng.random(len(X)) < (0.2 if (i, j) != (1, 4) else 1.0)
        rows[wrong, 1] = rng.permutation(rows[wrong, 1])
        matches.append(FeatureMatches((i, j), rows, np.full(len(X), 0.5), np.ones(len(X), bool)))
    told = {"fx": 1.2 * F, "fy": 1.2 * F, "cx": 599.5, "cy": 449.5, "k1": 0.0}
    camera = jaxbundle.Camera("c", "opencv", told, image_size=SIZE)
    (found,), notes = start_cameras([camera], [0] * 6, [0], [True], features, matches)
    assert found.parameters["fx"] == found.parameters["fy"] == pytest.approx(F, rel=0.02)
    assert found.parameters["k1"] == pytest.approx(K1, abs=0.03)
    assert any(f"distance {found.parameters['fx']:.0f} px" in note for note in notes)
    # two pairs have no loop: what the coplanarity condition gives stays
    two = matches[:2]
    (few,), _ = start_cameras([camera], [0] * 6, [0], [True], features, two)
    middle = np.array([599.5, 449.5])
    xy = [tuple(features[k].xy[rows] - middle for k, rows in zip(m.images, m.rows.T)) for m in two]
    begin = dataclasses.replace(camera, parameters=told | {"cx": 0.0, "cy": 0.0})
    by_pairs = estimate_interior(begin, xy, is_known=True).camera.parameters
    assert few.parameters["fx"] == pytest.approx(by_pairs["fx"], rel=1e-12)


def test_a_lens_is_found_from_the_pairs_of_its_own_photographs(monkeypatch):
    """A pair of two lenses determines neither of them alone."""
    def estimate(camera, pairs, *_):
        used.append([len(a) for a, _ in pairs])
        return SimpleNamespace(camera=camera, pairs=[])

    used = []
    monkeypatch.setattr(camera_starts, "estimate_interior", estimate)
    monkeypatch.setattr(camera_starts, "_choose_pairs", lambda pairs, *_: pairs)
    start = {"fx": F, "fy": F, "cx": 599.5, "cy": 449.5, "k1": 0.0}
    cameras = [jaxbundle.Camera(id, "opencv", start, image_size=SIZE) for id in "abc"]
    features = [features_at(np.zeros((40, 2)))] * 5
    numbers = {(0, 1): 10, (0, 2): 12, (1, 3): 14, (2, 3): 16, (3, 4): 18}
    matches = [
        FeatureMatches(pair, np.zeros((n, 2), int), np.full(n, 0.5), np.ones(n, bool))
        for pair, n in numbers.items()
    ]
    # photographs 0, 1 and 2 are of the cameras a and b, which share a lens
    start_cameras(cameras, [0, 0, 1, 2, 2], [0, 0, 1], [False] * 3, features, matches)
    assert used == [[10, 12], [18]]


def test_a_first_principal_distance_without_loops_is_passed_over(monkeypatch):
    """And one with few loops, which close by chance, is not taken for the best."""
    start = np.array([7.0, -0.1])
    many, few = ClosureMinimum(start + 0.01, 2.0, 30), ClosureMinimum(start + 0.3, 0.6, 4)
    answers = {0.8: None, 1.0: many, 1.25: few}

    def search(oriented, first, middle, settings):
        factor = min(answers, key=lambda f: abs(np.log(f) - first[0] + middle))
        return answers[factor]

    monkeypatch.setattr("jaxbundle.tiepoints.interior_from_loops._search", search)
    np.testing.assert_allclose(close_rotations(lambda x: None, start), start + 0.01)
    answers.update(dict.fromkeys(answers))
    np.testing.assert_array_equal(close_rotations(lambda x: None, start), start)


def test_first_principal_distances_are_one_sigma_on_either_side():
    """Of ln c, in which a camera is as often too long as too short."""
    settings = ClosureSettings()
    first = np.sort(np.log(settings.first_factors)) / settings.sigma_log_distance
    np.testing.assert_allclose(first, [-1.0, 0.0, 1.0], atol=0.12)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.4, 3.0, np.pi])
def test_the_angle_of_a_rotation(angle):
    M = Rotation.from_rotvec(angle * np.array([2, -1, 2]) / 3).as_matrix()
    assert rotation_angle(M) == pytest.approx(angle, abs=1e-12)


def test_loops_are_three_photographs_with_three_pairs():
    pairs = [(0, 1), (0, 2), (1, 2), (2, 3), (1, 3), (3, 4)]
    loops = [[pairs[k] for k in loop] for loop in find_loops(pairs)]
    assert loops == [[(0, 1), (1, 2), (0, 2)], [(1, 2), (2, 3), (1, 3)]]
    assert count_independent(pairs) == 2
    apart = pairs + [(i + 9, j + 9) for i, j in pairs]
    assert count_independent(apart) == 4 and count_independent([]) == 0


def test_numbers_of_matches_and_loops_follow_from_one_another():
    """A pair is oriented by so many matches; as many must have moved beside marks, and remain when
    a third of those that give the principal distance are wrong. Four photographs with all their
    pairs have one independent loop more than there are unknowns, c and K1."""
    oriented = VerificationSettings().min_matches
    assert MarkSettings().min_moved == oriented
    assert CoplanaritySettings().min_matches * 2 / 3 == oriented
    # two right matches of which half are right: one chance in 1e5 that no trial has them
    assert 0.75 ** VerificationSettings().rotation_trials == pytest.approx(1e-5, rel=0.05)
    all_pairs = list(combinations(range(4), 2))
    assert ClosureSettings().min_loops == count_independent(all_pairs) == 2 + 1


def test_matches_need_rays_in_both_photographs():
    """A feature outside the valid field of the camera has none."""
    ideal = [np.zeros((4, 2)), np.zeros((4, 2))]
    ideal[0][1], ideal[1][2, 0] = np.nan, np.nan
    rows = np.tile(np.arange(4)[:, None], 2)
    matches = FeatureMatches((0, 1), rows, np.arange(4.0), np.ones(4, bool))
    assert _with_ideal(ideal, matches).rows[:, 0].tolist() == [0, 3]


def test_verification_keeps_true_matches_and_names_what_is_degenerate(cloud, monkeypatch):
    rng, X, views = cloud
    noise = lambda xy: xy + 3e-4 * rng.normal(size=xy.shape)
    a, b = (noise(seen(X, *views[k])) for k in (0, 3))
    wrong = np.arange(len(X)) % 5 == 4
    b[wrong] = rng.uniform(-0.5, 0.5, (wrong.sum(), 2))
    X0, M = views[1]
    turned = noise(seen(X, X0, Rotation.from_rotvec([0.1, 0.05, 0.2]).as_matrix() @ M))
    flat = X * [1, 1, 0]
    foreign = rng.uniform(-0.5, 0.5, (2, 60, 2))
    first = [a, noise(seen(X, X0, M)), noise(seen(flat, *views[0])), foreign[0]]
    second = [b, turned, noise(seen(flat, *views[2])), foreign[1]]
    run, programs = batched.run_in_lanes, []

    def run_in_lanes(program, lanes, *arrays):
        programs.append((id(program), lanes, tuple(np.shape(a)[1:] for a in arrays)))
        return run(program, lanes, *arrays)

    monkeypatch.setattr(batched, "run_in_lanes", run_in_lanes)
    found = verify_pairs(first, second, np.full(4, 2e-3))
    # the programs that are compiled ahead of the matches are those that these need
    needed = {*programs}
    programs.clear()
    verification.prepare()
    assert {*programs} <= needed and len(programs) == 2
    good, M, base, angle, kind, _ = found[0]
    assert good[~wrong].mean() > 0.97 and good[wrong].mean() < 0.2
    true = views[3][1] @ views[0][1].T
    assert np.linalg.norm(Rotation.from_matrix(M @ true.T).as_rotvec()) < 0.01
    assert 0.5 < angle < 1.3
    assert [one and one[4] for one in found] == ["relative", "rotation", "plane", None]


def test_matches_that_are_not_unique_are_another_trial_only_if_they_are_many(monkeypatch):
    """With fewer than orient a pair, the same matches would fail again, at the cost of all."""
    least, tried = VerificationSettings().min_matches, []

    def find(rows, *_):
        tried.append({k: len(r) for k, r in rows.items()})
        return {}

    monkeypatch.setattr("jaxbundle.tiepoints.verification._find_agreeing", find)
    monkeypatch.setattr("jaxbundle.tiepoints.verification._find_rotation", lambda *_: None)
    n = 3 * least
    xy = [np.zeros((n, 2))] * 3
    unique = [np.arange(n) >= repeated for repeated in (0, least - 1, least)]
    assert verify_pairs(xy, xy, np.ones(3), unique) == [None] * 3
    assert tried == [{0: n, 1: n - least + 1, 2: n - least}, {2: n}]


@pytest.fixture(scope="module")
def windows():
    """Four identical windows with their distance, and places of the wall in no plane."""
    rng = np.random.default_rng(6)
    T = np.array([1.1, 0, 0])
    window = rng.uniform(-0.4, 0.4, (40, 3)) - [1.6, 0, 0]
    X = np.concatenate([window + k * T for k in range(4)])
    return rng, X, T, rng.uniform(-2.2, 2.2, (80, 3))


def test_what_is_there_once_orients_a_pair_of_repeated_windows(cloud, windows):
    views = cloud[2]
    rng, X, T, wall = windows
    noise = lambda xy: xy + 3e-4 * rng.normal(size=xy.shape)
    one = np.concatenate([X[:-40], wall])
    other = np.concatenate([X[40:], wall])  # every window is taken for the next one
    a, b = noise(seen(one, *views[0])), noise(seen(other, *views[3]))
    single = np.arange(len(one)) >= 120
    order = rng.permutation(len(one))
    everything, by_single = (
        verify_pairs([a[order]], [b[order]], np.full(1, 2e-3), given)[0]
        for given in (None, [single[order]])
    )
    true = views[3][1] @ views[0][1].T
    base = views[0][1] @ (views[3][0] - views[0][0])
    assert by_single.sure and by_single.b @ base / np.linalg.norm(base) > 0.9998
    assert np.linalg.norm(Rotation.from_matrix(by_single.M @ true.T).as_rotvec()) < 0.01
    assert by_single.good[single[order]].mean() > 0.95 and not by_single.good[~single[order]].any()
    shifted = base - views[0][1] @ T
    assert everything.b @ shifted / np.linalg.norm(shifted) > 0.999


def test_a_pair_that_does_not_close_around_three_photographs_is_found(windows):
    views, X, T = list(stations(8, np.random.default_rng(5))), windows[1], windows[2]
    ideal = [seen(X, *view) for view in views]
    every = np.arange(len(X))

    def pair(i, j, moved):
        (X0, M), (other, N) = views[i], views[j]
        b = M @ (other - moved * T - X0)
        step = 40 * moved
        rows = np.stack([every[: len(X) - step], every[step:]], 1)
        return Pair((i, j), rows, np.zeros(len(rows)), N @ M.T, b / np.linalg.norm(b), 0.5,
                    "relative", len(rows))  # fmt: skip

    shifted = (1, 2)
    pairs = [pair(i, j, int((i, j) == shifted)) for i in range(5) for j in range(i + 1, 5)]
    kept, wrong = split_contradicted(pairs, ideal)
    assert [p.images for p in wrong] == [shifted] and len(kept) == 9
    assert split_contradicted(pairs[3:4], ideal) == ([pairs[3]], [])
    # without common features the directions of the bases decide
    third = [dataclasses.replace(p, matches=p.matches[k::3], distance_ratio=p.distance_ratio[k::3])
             for k, p in enumerate(pair(i, j, 0) for i, j in ((0, 1), (0, 3), (1, 3)))]  # fmt: skip
    back = dataclasses.replace(third[1], b=-third[1].b)
    assert split_contradicted(third, ideal) == (third, [])
    assert [len(p) for p in split_contradicted([third[0], back, third[2]], ideal)] == [2, 1]
    # of a photograph with few accepted pairs only the best ones are used
    about = lambda angle: Rotation.from_rotvec([0, 0, angle]).as_matrix()
    turned = [dataclasses.replace(pair(k, 7, 0), M=about(k + 1.0)) for k in range(5)]
    weak = dataclasses.replace(pair(5, 7, 0), matches=np.stack([every[:30]] * 2, 1))
    others = [pair(i, j, 0) for i in range(7) for j in range(i + 1, 7)]
    kept, wrong = split_contradicted([*turned, weak, pair(6, 7, 0), *others], ideal)
    assert [p.images for p in kept if 7 in p.images] == [(6, 7)] and len(wrong) == 6
    chain = [pair(0, 1, 0), pair(1, 3, 0), pair(3, 4, 0)]
    far = dataclasses.replace(pair(0, 4, 0), sure=False)
    assert split_contradicted([*chain, far], ideal) == (chain, [far])
    assert split_contradicted([*chain[:2], far], ideal) == ([*chain[:2], far], [])


def features_at(xy):
    n = len(xy)
    rng = np.random.default_rng(n)
    return Features(xy, np.ones(n), np.zeros(n), rng.integers(0, 255, (n, 128), np.uint8))


def paired(i, j, rows, distance_ratio):
    rows = np.array(rows)
    return Pair((i, j), rows, np.array(distance_ratio), np.eye(3), np.zeros(3), 0.1, "relative", 9)


def test_features_lie_at_the_centres_of_blobs(monkeypatch):
    """OpenCV's own upscaling would move the smallest a quarter of a pixel right and down."""
    rng = np.random.default_rng(5)
    true = np.stack(np.meshgrid(np.arange(20, 300, 20), np.arange(20, 220, 20)), -1).reshape(-1, 2)
    true = true + rng.uniform(-0.5, 0.5, true.shape)
    v, u = np.indices((240, 320))
    grey = np.full((240, 320), 60.0)
    for x, y in true:
        grey += 120 * np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * 1.5**2))
    found = find_features(np.rint(grey).astype(np.uint8))
    near = np.linalg.norm(found.xy[:, None] - true[None], axis=2)
    e = (found.xy - true[near.argmin(1)])[near.min(1) < 1.5]
    assert len(e) >= len(true) / 2
    # these are a third of so many, enough: no second search of the features of noise
    searched = []
    search = lambda *given: searched.append(given[-1]) or _search(*given)
    monkeypatch.setattr("jaxbundle.tiepoints.features._search", search)
    settings = FeatureSettings(number=len(true))
    find_features(np.rint(grey).astype(np.uint8), settings)
    assert searched == [settings.contrast]
    assert np.abs(np.median(e, axis=0)).max() < 0.05


@pytest.mark.parametrize("number, searches", [(99, 2), (101, 1)])
def test_fewer_than_a_third_of_the_features_are_searched_again(monkeypatch, number, searches):
    """The time of such a photograph doubles; that of others does not."""
    searched = []
    search = lambda *given: searched.append(given[-1]) or ([None] * number, [])
    monkeypatch.setattr("jaxbundle.tiepoints.features._search", search)
    settings = FeatureSettings(number=300)
    find_features(np.zeros((64, 64), np.uint8), settings)
    assert searched == [settings.contrast, settings.faint_contrast][:searches]


def test_faint_features_are_searched_where_there_are_few():
    """Blobs of six grey values: below the contrast of distinct features."""
    true = np.stack(np.meshgrid(np.arange(20, 300, 20), np.arange(20, 220, 20)), -1).reshape(-1, 2)
    v, u = np.indices((240, 320))
    grey = np.full((240, 320), 60.0)
    for x, y in true:
        grey += 6 * np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * 3.0**2))
    found = find_features(np.rint(grey).astype(np.uint8))
    near = np.linalg.norm(found.xy[:, None] - true[None], axis=2)
    assert (near.min(0) < 1.0).mean() > 0.9


def test_the_memory_of_a_search_is_what_was_measured_and_hardly_more():
    """225 bytes a pixel: with less, photographs would be searched at once that do not fit; with
    twice as much, half as many. Tiles bound it."""
    settings = FeatureSettings(side=0)
    assert 1 <= memory_of_features(1500, 1000, settings) / (225 * 1500 * 1000) < 1.1
    whole, larger = (memory_of_features(n, n, settings) for n in (20_000, 40_000))
    assert whole == larger < 1.6e9
    assert memory_of_features(3600, 3600, FeatureSettings()) == pytest.approx(
        memory_of_features(1800, 1800, settings)
    )
    # a small photograph is not enlarged
    assert memory_of_features(600, 900, FeatureSettings()) == memory_of_features(600, 900, settings)


def test_tracks_without_contradictions():
    spread = [np.random.default_rng(k).uniform(0, 100, (6, 2)) for k in range(3)]
    features = [features_at(xy) for xy in spread]
    pairs = [
        paired(0, 1, [[0, 0], [1, 1], [2, 2]], [0.1, 0.1, 0.3]),
        paired(1, 2, [[0, 0], [1, 1]], [0.1, 0.1]),
        paired(0, 2, [[0, 5], [2, 1]], [0.6, 0.7]),  # both contradict clearer ones
    ]
    tracks = sorted(make_tracks(features, pairs))
    assert tracks == [
        [(0, 0), (1, 0), (2, 0)], [(0, 1), (1, 1), (2, 1)], [(0, 2), (1, 2)],
    ]  # fmt: skip


def test_a_track_has_the_direction_that_was_matched():
    """Of two at one place: the most distinct match says which, and another one joins as well."""
    xy = [np.array([[10.0, 10.0], [10.0, 10.0], [90.0, 50.0]]) for _ in range(3)]
    pairs = [
        paired(0, 1, [[0, 0], [2, 2]], [0.5, 0.3]),
        paired(1, 2, [[1, 1], [2, 2]], [0.2, 0.3]),
    ]
    tracks = sorted(make_tracks([features_at(of_image) for of_image in xy], pairs))
    assert tracks == [[(0, 0), (1, 1), (2, 1)], [(0, 2), (1, 2), (2, 2)]]


def test_chosen_tracks_cover_the_photographs():
    rng = np.random.default_rng(0)
    dense = rng.uniform(0, 200, (3000, 2))
    sparse = rng.uniform(0, 1000, (150, 2))
    xy = np.concatenate([dense, sparse, dense[:20] + 0.2])
    tracks = [[(0, k), (1, k)] for k in range(len(xy))]
    kept = choose_tracks(tracks, [xy, xy], [(1000, 1000)] * 2, 300)
    assert kept[3000:3150].mean() > 0.7 and kept[:3000].sum() < 100
    assert not np.any(kept[:20] & kept[3150:])


def test_matches_are_those_of_both_sides():
    rng = np.random.default_rng(1)
    one = features_at(rng.uniform(0, 100, (80, 2)))
    order = rng.permutation(80)
    noisy = np.clip(one.descriptor[order] + rng.integers(-12, 12, (80, 128)), 0, 255)
    other = Features(one.xy, one.size, one.angle, noisy.astype(np.uint8))
    rows, ratio = match_features(one, other)
    assert len(rows) == 80 and np.all(order[rows[:, 1]] == rows[:, 0])
    assert np.all(np.diff(ratio) >= 0) and ratio.max() < 0.8


@pytest.mark.parametrize("length", [32, 128])
def test_two_features_equal_to_one_of_the_other_photograph_match_nothing(length):
    """Binary descriptors and those of SIFT, in both directions: neither is the right one."""
    rng = np.random.default_rng(5)
    once = rng.integers(0, 256, (20, length), np.uint8)
    twice = np.concatenate([once[:10], once[:5], once[10:15]])
    one, other = (
        Features(rng.uniform(0, 900, (20, 2)), np.ones(20), np.zeros(20), descriptor)
        for descriptor in (twice, once)
    )
    expected = [[k, k] for k in range(5, 10)] + [[15 + k, 10 + k] for k in range(5)]
    for a, b, order in ((one, other, 1), (other, one, -1)):
        rows, _ = match_features(a, b)
        assert sorted(rows[:, ::order].tolist()) == expected
        assert count_matches_of_largest(a, b, 20) == 10


def test_residuals_are_correlated_over_less_than_half_the_window():
    """Over the whole window the sum of the gradients, and so the covariance, would vanish."""
    TrackMatchingSettings(window=17, correlation_length=8)
    with pytest.raises(InputError, match="expected .* less than half the window, 8.5, got 9"):
        TrackMatchingSettings(window=17, correlation_length=9)


def test_candidates():
    none = [features_at(np.zeros((3, 2)))] * 9
    assert len(candidate_pairs(none, "all")) == 36
    assert (0, 6) not in candidate_pairs(none, "sequence")
    place = np.array([[x, 0.0, 0.0] for x in range(9)])
    assert {(0, 1), (0, 8)} <= set(candidate_pairs(none, "place", place))


def test_neighbours_by_similarity_are_those_with_the_most_matches():
    """Each photograph chooses its best one; those with hardly a match are no candidates."""
    counts = {(0, 1): 90, (0, 2): 40, (0, 3): 30, (1, 2): 20, (1, 3): 50, (2, 3): 3}
    run = lambda function, pairs: [counts[pair] for pair in pairs]
    none, settings = [features_at(np.zeros((3, 2)))] * 4, CandidateSettings(neighbours=1)
    assert candidate_pairs(none, "alike", None, run, settings) == [(0, 1), (0, 2), (1, 3)]
    everyone = dataclasses.replace(settings, neighbours=3)
    assert candidate_pairs(none, "alike", None, run, everyone) == [*counts][:-1]


def test_what_is_kept_is_found_again_for_the_same_content_only(tmp_path):
    found = features_at(np.arange(12.0).reshape(6, 2))
    store = Store(tmp_path / "kept", FeatureSettings())
    store.save_features("one", found)
    again = Store(tmp_path / "kept", FeatureSettings())
    np.testing.assert_array_equal(again.load_features("one").descriptor, found.descriptor)
    assert again.load_features("changed") is None
    assert Store(tmp_path / "kept", FeatureSettings(number=7)).load_features("one") is None
    file = next((tmp_path / "kept").glob("*.npz"))
    file.write_bytes(file.read_bytes()[:100])
    assert again.load_features("one") is None
    Store(tmp_path / "kept", FeatureSettings()).drop_unused()
    assert not list((tmp_path / "kept").glob("*.npz"))


def test_what_is_in_a_photograph_twice_matches_nothing():
    rng = np.random.default_rng(2)
    noisy = lambda a: np.clip(a + rng.integers(-6, 6, a.shape), 0, 255).astype(np.uint8)
    once = features_at(rng.uniform(0, 900, (60, 2)))
    window = once.descriptor[:20].astype(int)
    both = np.concatenate([noisy(once.descriptor.astype(int)), noisy(window)])
    xy = np.concatenate([once.xy, once.xy[:20] + [300.0, 0]])
    twice = Features(xy, np.ones(80), np.zeros(80), both)
    one = Features(once.xy, once.size, once.angle, noisy(once.descriptor.astype(int)))
    own = distances_within(twice), distances_within(one)
    assert np.all(own[0][np.r_[:20, 60:80]] < 0.3 * np.median(own[0][20:60]))
    rows, _ = match_features(twice, one, within=own)
    assert set(range(20, 60)) <= set(rows[:, 0].tolist()) and len(rows) <= 42


def with_marks(X, views, marks, rng):
    """Features of photographs of an object with marks at the same pixels; all matches of them."""
    size = np.full(len(X) + len(marks), 8.0)
    photographs = [
        Features(np.r_[pixels(seen(X, *view), rng), marks + 0.1 * rng.normal(size=marks.shape)],
                 size, np.zeros(len(size)), np.zeros((len(size), 128), np.uint8))
        for view in views
    ]  # fmt: skip
    rows = np.tile(np.arange(len(size))[:, None], 2)
    distance_ratio, single = np.full(len(rows), 0.5), np.ones(len(rows), bool)
    pairs = ((i, j) for i in range(len(views)) for j in range(i))
    return photographs, [FeatureMatches(pair, rows, distance_ratio, single) for pair in pairs]


def test_marks_at_the_same_pixels_of_photographs_match_nothing(cloud):
    rng, X, views = cloud
    marks = rng.uniform([900, 800], [1100, 860], (30, 2))
    photographs, matches = with_marks(X, views, marks, rng)
    rows = matches[0].rows
    found, marked = without_marks(matches, photographs, [SIZE] * 5)
    assert marked == 5 and all(set(m.rows[:, 0]) == set(range(len(X))) for m in found)
    # pixels of photographs of different size are not the same, and two of one size are too few
    sizes = [SIZE] * 3 + [SIZE[::-1]] * 2
    found, _ = without_marks(matches, photographs, sizes)
    whole = [m.images for m in found if len(m.rows) == len(rows)]
    assert whole == [(i, j) for i in (3, 4) for j in range(i)]
    same = [photographs[0]] * 5
    assert without_marks(matches, same, [SIZE] * 5)[1] == 0, "photographs from one place"


@pytest.mark.parametrize("principal_distance", [0.4, 1.2, 2.4])
def test_the_background_of_an_object_that_turns_matches_nothing(cloud, principal_distance):
    """It has three times the matches of the object; so have far objects behind one that a camera
    passes without turning, but they agree with its orientation. The principal distance, 0.83 in
    truth, is not known."""
    rng, X, views = cloud
    settings = MarkSettings(principal_distance=principal_distance)
    background = rng.uniform([0, 0], SIZE, (480, 2))
    photographs, matches = with_marks(X, views, background, rng)
    found, marked = without_marks(matches, photographs, [SIZE] * 5, settings)
    assert marked == 5 and all(m.rows[:, 0].max() < len(X) for m in found)
    # A point of the object that hardly moves, in front of a background point, goes too: in 60
    # draws 13 of all pairs have lost one, none two.
    assert all(len(m.rows) >= len(X) - 2 for m in found)
    passing = [(np.array([0.8 * k, 0.1 * k, 8.0]), np.eye(3)) for k in range(5)]
    photographs, matches = with_marks(X, passing, background, rng)
    assert without_marks(matches, photographs, [SIZE] * 5, settings)[1] == 0, "far objects"
    # what moves at random has no orientation
    for photograph in photographs:
        photograph.xy[: len(X)] = rng.uniform([0, 0], SIZE, (len(X), 2))
    assert without_marks(matches, photographs, [SIZE] * 5, settings)[1] == 0, "leaves"
