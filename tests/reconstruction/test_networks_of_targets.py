"""Networks of coded and uncoded targets alone."""

import csv
from pathlib import Path

import numpy as np
import pytest

import jaxbundle
from jaxbundle.errors import InputError
from jaxbundle.network.subsets import keep_points
from jaxbundle.orientation import absolute_orientation
from jaxbundle.reconstruction.named import (
    NamedMeasurements,
    match_named,
    named_as_features,
)
from jaxbundle.reconstruction.settings import ReconstructionSettings
from jaxbundle.reconstruction.uncoded_targets import UncodedSettings, find_uncoded, name_uncoded

PANEL = Path(__file__).parents[2].parent / "shared" / "data" / "real" / "targets39"


@pytest.fixture(scope="module")
def photographed():
    """An adjusted network, and the discs of its photographs: of 30 points that it lacks, each in
    three photographs and more, of ten that only one shows, and ten that are none; their order."""
    rng = np.random.default_rng(3)
    points = jaxbundle.cloud_of_targets(70, 2.0, seed=1)
    camera = jaxbundle.Camera(
        "cam", "opencv",
        {"fx": 2000.0, "fy": 2000.0, "cx": 999.5, "cy": 749.5, "k1": -0.05},
        image_size=(2000, 1500),
    )  # fmt: skip
    stations = jaxbundle.ring_of_stations(7, radius=6.0, height=2.0)
    network = jaxbundle.simulate(stations, points, camera, noise=0.05, seed=2)
    ids = np.array(network.points.id)
    plain, once = ids[30:60], ids[60:]
    discs, truth = [], []
    of_image, of_point = network.observations.image, network.observations.point
    for k in range(len(network.images)):
        rows = np.flatnonzero(of_image == k)
        names = ids[of_point[rows]]
        shown = np.isin(names, plain)
        if k == 0:
            shown |= np.isin(names, once)
        xy = np.concatenate([network.observations.xy[rows[shown]], rng.uniform(0, 1500, (10, 2))])
        order = rng.permutation(len(xy))
        discs.append(xy[order])
        truth.append(np.array([*names[shown], *[""] * 10], object)[order])
    coded = jaxbundle.adjust(keep_points(network, np.arange(len(ids)) < 30))
    return coded, discs, truth, plain


def test_uncoded_targets_are_found_by_their_rays(photographed):
    """All of them, none of wrong discs, and no disc twice."""
    result, discs, truth, plain = photographed
    names = result.network.images.id
    image, disc, point = find_uncoded(result, names, discs, UncodedSettings())
    named = np.array([truth[k][d] for k, d in zip(image, disc)])
    assert len(set(zip(image.tolist(), disc.tolist()))) == len(image)
    found = {}
    for p in set(point.tolist()):
        (name,) = set(named[point == p])
        assert name not in found
        found[name] = (point == p).sum()
    assert set(found) == set(plain)
    rays = {name: sum(np.sum(t == name) for t in truth) for name in plain}
    assert found == rays
    measured = name_uncoded((image, disc, point), discs, discs)
    assert np.array_equal(measured.xy[0], discs[image[0]][disc[0]])
    assert measured.name[0] == f"u{point[0]}"


def test_two_rays_are_not_enough(photographed):
    """In two photographs every crossing of epipolar lines would be a point."""
    result, discs, _, _ = photographed
    none = np.zeros((0, 2))
    two = [xy if k < 2 else none for k, xy in enumerate(discs)]
    names = result.network.images.id
    assert not len(find_uncoded(result, names, two, UncodedSettings())[0])
    assert len(find_uncoded(result, names, two, UncodedSettings(min_rays=2))[0])


def test_targets_match_by_their_names():
    image = np.array([0, 0, 0, 1, 1, 1, 2])
    name = ("7", "3", "5", "5", "7", "9", "7")
    xy = np.arange(14.0).reshape(7, 2)
    named = NamedMeasurements(image, name, xy, xy)
    (match,) = match_named(named, 3, 2)
    features = named_as_features(named, 3)
    assert match.images == (0, 1)
    both = [features[k].xy[rows] for k, rows in zip((0, 1), match.rows.T)]
    assert sorted(map(tuple, np.concatenate(both, 1))) == [(0, 1, 8, 9), (4, 5, 6, 7)]


def test_what_targets_alone_need():
    with pytest.raises(InputError, match="features none: .* give targets"):
        ReconstructionSettings(natural_points=False)
    with pytest.raises(InputError, match="expected ring-coded targets"):
        ReconstructionSettings(targets="aruco", uncoded=True)


@pytest.mark.further
@pytest.mark.skipif(not PANEL.exists(), reason="no panel of targets in shared")
def test_a_surveyed_panel_of_targets(tmp_path):
    """Two cameras of one model; the printed numbers; the points beside the surveyed ones."""
    for file in (PANEL / "photographs").iterdir():
        folder = tmp_path / file.name[:3]
        folder.mkdir(exist_ok=True)
        (folder / file.name).symlink_to(file)
    folders = sorted(tmp_path.iterdir())
    result = jaxbundle.reconstruct(
        folders, targets="ring14", features="none", uncoded=True, camera_per_folder=True
    )
    (part,) = result.parts
    assert len(part.adjustment.network.images) == 8
    # 2095.53 and 2091.95 by another program from 39 photographs
    c = [part.adjustment.camera_parameters(id)["fx"] for id in ("043", "671")]
    assert np.allclose(c, [2095.53, 2091.95], atol=1.0)
    with open(PANEL / "points.csv", newline="") as file:
        rows = {row["id"]: [float(row[a]) for a in "XYZ"] for row in csv.DictReader(file)}
    coded = {str(int(id)): X for id, X in rows.items() if len(id) == 3}
    ids = np.array(part.adjustment.network.points.id)
    assert len(set(ids) & set(coded)) >= 0.95 * len(coded)
    both = [id for id in ids if id in coded]
    X = part.adjustment.point_values[[ids.tolist().index(id) for id in both]]
    surveyed = np.array([coded[id] for id in both])
    off = np.asarray(absolute_orientation(X, surveyed).residuals)
    # mm; 7, 9, 6 µm from 39 photographs
    assert np.sqrt(np.mean(off**2, 0)).max() < 0.02
    assert sum(id.startswith("u") for id in ids) >= 0.95 * (len(rows) - len(coded))
