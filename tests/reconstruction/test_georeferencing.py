"""Control and satellite positions of a simulated drone block: what is used, named and written."""

import csv
import dataclasses
import datetime
import json
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from drone_block import CONTROL, NAMES, OFFSET, SATELLITE, drone_block, swapped

from jaxbundle import Camera
from jaxbundle.adjustment.result import Adjustment
from jaxbundle.cli.outputs import write_targets
from jaxbundle.cli.reconstruct_files import write_reconstruction
from jaxbundle.errors import InputError
from jaxbundle.network.kinds import Antennas
from jaxbundle.network.tables import Points
from jaxbundle.photographs.exif import Exif
from jaxbundle.reconstruction import georeferencing, page
from jaxbundle.reconstruction.block import (
    BlockFacts,
    CameraPositions,
    camera_positions,
    describe_block,
)
from jaxbundle.reconstruction.control_choice import (
    ControlChoice,
    has_doubtful_heights,
    with_heights_as_in_plane,
)
from jaxbundle.reconstruction.controlled_network import network_with_control
from jaxbundle.reconstruction.georeferencing import georeference
from jaxbundle.reconstruction.oriented_block import OrientedBlock
from jaxbundle.reconstruction.page import describe_part
from jaxbundle.reconstruction.result import ReconstructedPart, Reconstruction

SIGMA = 0.5
"""Of handheld control, metres."""


def controlled(drone, given):
    """The final adjustment, the table by name, and the whole table."""
    block = drone.block(given.positions is not None)
    final, table = georeference(block, given, 0.001, lambda stage: None)
    return final.adjustment, {p.id: p for p in table.points}, table


@pytest.fixture(scope="module")
def drone():
    return drone_block(4)


@pytest.fixture(scope="module")
def handheld(drone):
    return drone.truth + SIGMA * np.random.default_rng(8).standard_normal((CONTROL, 3))


@pytest.fixture(scope="module")
def good(drone, handheld):
    return controlled(drone, drone.given(handheld))


@pytest.mark.further
def test_positions_are_observed_with_an_offset(drone, good):
    result, _, table = good
    assert isinstance(result, Adjustment) and result.network.datum == "control"
    positions = describe_block(result, {}, "EPSG:32611").positions
    assert len(positions.difference) == 9
    # three σ of the offset; the RMS of nine positions
    assert np.all(np.abs(positions.offset - OFFSET) < 3 * positions.offset_sigma + 0.3)
    assert np.all(positions.rms / SATELLITE < 1.8) and np.all(positions.rms / SATELLITE > 0.4)
    assert "estimated from the residuals" in table.sigma


@pytest.mark.further
def test_sigma_of_control_is_estimated_and_used(good):
    _, points, _ = good
    assert all(p.used for p in points.values())
    sigma = points["gcp00"].sigma
    # its own relative σ is 1/√(2·redundancy), about 0.2 in the plane and 0.3 in height
    assert 0.25 < sigma[0] < 0.9 and 0.2 < sigma[2] < 1.1


def test_the_ground_is_within_its_sigma(drone, good):
    result, points, _ = good
    X = np.array([result.point_values[result.problem.network.points.id.index(n)] for n in NAMES])
    sigma = np.sqrt(np.diagonal(result.point_covariance, axis1=1, axis2=2))
    rows = [result.problem.network.points.id.index(n) for n in NAMES]
    assert np.all(np.abs(X - drone.truth) < 4 * sigma[rows])


@pytest.mark.parametrize("positions", [True, False])
def test_exchanged_axes_and_other_units_are_refused(drone, positions):
    for X, words in (
        (drone.truth[:, [1, 0, 2]], "9 control points fit the images better as a mirror image"),
        (drone.truth * [1, 1, 1 / 0.3048], "9 control points .* better with heights in feet"),
    ):
        with pytest.raises(InputError, match=words):
            controlled(drone, drone.given(X, positions=positions))


def test_control_that_fits_better_as_a_mirror_image_is_doubted(drone, handheld):
    """Noise of a handheld receiver leaves it less than five times better."""
    *_, table = controlled(drone, drone.given(handheld[:, [1, 0, 2]], positions=False))
    assert len(table.warnings) == 1 and "or its errors are that large" in table.warnings[0]


@pytest.mark.parametrize("columns, words", [
    (lambda xy: xy[:, ::-1], "rays of 0 meet.* with u and v exchanged those of 9 meet"),
    (lambda xy: xy * [1, -1] + [0, 1499], "rays of 0 .* with v counted from the other edge .* 9"),
    (lambda xy: xy / 2, "rays of 0 meet.* u and v are pixels of the photographs as they are"),
])  # fmt: skip
def test_image_points_in_wrong_columns_are_named(drone, columns, words):
    named = dataclasses.replace(drone.named, xy=columns(drone.named.xy))
    with pytest.raises(InputError, match=words):
        controlled(drone, drone.given(drone.truth, positions=False, named=named))


def test_stated_sigma_that_are_far_too_small_are_a_warning(drone, handheld):
    """2 mm of coordinates with errors of 0.5 m."""
    *_, table = controlled(drone, drone.given(handheld, 0.002, positions=False))
    assert len(table.warnings) == 1 and "multiplied by" in table.warnings[0]


@pytest.fixture(scope="module", params=[
    pytest.param(positions, marks=pytest.mark.further) for positions in (True, False)
], ids=["positions", "no positions"])  # fmt: skip
def spoilt(drone, handheld, request):
    """With a wrong name, a bad point and a check point."""
    named, row = swapped(drone.named, "gcp04", "gcp00")
    X = handheld.copy()
    X[6] += [2.9, -2.6, 0.0]
    roles = tuple("check" if k == 8 else "control" for k in range(CONTROL))
    given = drone.given(X, roles=roles, positions=request.param, named=named)
    return drone.images[named.image[row]], *controlled(drone, given)


def test_a_wrong_name_and_a_bad_point_are_named(spoilt):
    image, _, points, table = spoilt
    assert table.left_out == ["gcp06"]
    assert "the other points and the photographs put it" in points["gcp06"].verdict
    assert points["gcp04"].used and image in points["gcp04"].verdict
    assert "the place of gcp00: a wrong name" in points["gcp04"].verdict
    others = [p.verdict for id, p in points.items() if id not in ("gcp04", "gcp06", "gcp08")]
    assert set(others) == {"used"}
    # compared although not used: the error of the point, with that of the others
    assert np.linalg.norm(points["gcp06"].residual[:2] + [2.9, -2.6]) < 3 * SIGMA


def test_every_point_and_every_measurement_is_predicted(spoilt):
    """Good ones within 3 σ of it, or hardly beyond; the wrong ones far."""
    image, result, points, _ = spoilt
    for id, point in points.items():
        t = np.abs(point.prediction / point.prediction_sigma)
        assert len(point.measurements) > 1
        if id == "gcp06":
            # its difference from the result, with both σ
            assert t[:2].max() > 3.5
        else:
            assert t.max() < 3.5 and (point.prediction_sigma > 0).all()
        for one in point.measurements:
            wrong = (id, one.image) == ("gcp04", image)
            # 27 measurements and more, of two coordinates: 4.5 σ by chance with 1e-4
            assert (one.distance > 20 * one.sigma) if wrong else one.distance < 4.5 * one.sigma
    assert points["gcp04"].wrong_measurements == [image]
    # of used points it is the deletion residual, which a coordinate with σ enlarges
    used = [p for p in points.values() if p.used]
    larger = np.abs([p.prediction for p in used]) / np.abs([p.residual for p in used])
    # by 1/r of the redundancy number r of a coordinate, a few tenths with nine points
    assert (larger > 1.02).mean() > 0.9
    told = points["gcp06"].numbers()
    json.dumps(told, allow_nan=False)
    assert told["prediction"]["sigma"]["X"] > 0


@pytest.mark.further
def test_stated_sigma_is_not_refused(drone, handheld):
    named, _ = swapped(drone.named, "gcp04", "gcp00")
    X = handheld.copy()
    X[6] += [4.9, -4.6, 0.0]
    _, points, table = controlled(drone, drone.given(X, SIGMA, named=named))
    assert table.left_out == ["gcp06"] and "as stated (0.50 m)" in table.sigma
    np.testing.assert_allclose(points["gcp01"].sigma, SIGMA)


def test_exchanged_coordinates_are_named(drone, handheld, monkeypatch):
    X = handheld.copy()
    X[[2, 7]] = X[[7, 2]]
    block = drone.block()
    # only what is chosen: the adjustment with control is left out
    monkeypatch.setattr(georeferencing, "adjust_determined",
                        lambda network, **_: (block.adjustment, network, None))  # fmt: skip
    _, points, table = controlled(drone, drone.given(X))
    assert table.left_out == ["gcp02", "gcp07"]
    assert "it fits the coordinates of gcp07" in points["gcp02"].verdict


def test_two_wrong_points_are_no_exchange(drone, handheld, monkeypatch):
    """36 m apart, with errors of 8 m: within what satellite positions may be shifted, but this
    shift is known from the other points."""
    X = handheld.copy()
    X[2] += [6.0, -5.0, 0.0]
    X[7] += [-7.0, 3.0, 4.0]
    block = drone.block()
    monkeypatch.setattr(georeferencing, "adjust_determined",
                        lambda network, **_: (block.adjustment, network, None))  # fmt: skip
    _, points, table = controlled(drone, drone.given(X))
    assert table.left_out == ["gcp02", "gcp07"]
    assert not any("it fits" in point.verdict for point in points.values())


@pytest.mark.further
def test_heights_of_zero_are_unknown(drone, handheld):
    X = handheld * [1, 1, 0]
    result, points, table = controlled(drone, drone.given(X))
    assert "the heights of all control points are 0" in table.notes[0]
    assert "unknown" in table.notes[0]
    assert all(p.used and np.isnan(p.residual[2]) for p in points.values())
    positions = describe_block(result, {}, "x").positions
    # the heights are those of the satellite positions: no offset is estimated
    assert np.isnan(positions.offset[2]) and np.isfinite(positions.offset[:2]).all()
    k = result.problem.network.points.id.index("gcp01")
    assert abs(result.point_values[k, 2] - drone.truth[1, 2] - OFFSET[2]) < 3 * SATELLITE[2]


def test_heights_of_zero_have_the_sigma_of_the_plane_if_theirs_is_smaller():
    """A block bends to a plane of zeros: residuals show nothing of their errors."""
    unknown = np.full((4, 3), np.nan)
    X = np.arange(12.0).reshape(4, 3) * [1, 1, 0]
    flat = Points(tuple("abcd"), ("control",) * 4, X, unknown)
    assert has_doubtful_heights(flat)
    assert not has_doubtful_heights(dataclasses.replace(flat, position=X + [0, 0, 1]))
    stated = dataclasses.replace(flat, sigma=np.where([0, 0, 1], 0.1, unknown))
    assert not has_doubtful_heights(stated)
    for height, expected in ((0.02, [np.nan, np.nan, 0.8]), (1.9, [np.nan] * 3)):
        assessed = SimpleNamespace(sigma=np.tile([0.8, 0.8, height], (3, 1)))
        found = with_heights_as_in_plane(flat, range(3), assessed).sigma
        np.testing.assert_array_equal(found, np.tile(expected, (4, 1)))
    # A stated σ of one point in the plane is not that of the others' heights.
    mixed = unknown.copy()
    mixed[1, :2] = 5.0
    assessed = SimpleNamespace(sigma=np.array([[0.8, 0.8, 0.02], [5, 5, 0.02], [0.8, 0.8, 0.02]]))
    found = with_heights_as_in_plane(dataclasses.replace(flat, sigma=mixed), range(3), assessed)
    np.testing.assert_array_equal(found.sigma[:, 2], np.full(4, 0.8))


@pytest.mark.further
def test_check_points_are_compared_and_never_used(drone, handheld):
    X = handheld.copy()
    X[3] += [40.0, 0.0, 0.0]
    roles = tuple("check" if k in (3, 8) else "control" for k in range(CONTROL))
    result, points, table = controlled(drone, drone.given(X, roles=roles))
    assert {"gcp03", "gcp08"}.isdisjoint(result.problem.network.points.id)
    assert points["gcp03"].residual[0] == pytest.approx(-40.0, abs=4 * SIGMA)
    assert points["gcp03"].verdict == "check" and not points["gcp03"].used
    assert np.isfinite(table.rms("check")).all() and table.rms("check")[0] > 20


def test_positions_that_contradict_control_are_told_with_numbers():
    difference = {str(k): np.array([0.5, -9.0 + 18 * (k % 2), 1.0]) for k in range(4)}
    sigma, nothing = np.array([1.0, 1.0, 2.0]), np.full(3, np.nan)
    positions = CameraPositions(difference, sigma, np.array([154.0, 2.0, 31.0]), sigma)
    offset, rms = positions.contradictions(np.array([10.0, 10.0, 100.0]), "m")
    assert "offset in X is +154.0 m, its prior σ 10 m" in offset
    assert "RMS in Y 9.00 m, their σ 1.00 m" in rms
    good = CameraPositions({"1": sigma}, sigma, nothing, nothing)
    assert good.contradictions(np.array([10.0, 10.0, 100.0]), "m") == []


@pytest.mark.further
def test_control_that_cannot_give_a_frame_is_refused(drone, handheld):
    roles = ("control", "control", *["check"] * (CONTROL - 2))
    with pytest.raises(InputError, match="expected 3, got 2"):
        controlled(drone, drone.given(handheld, roles=roles, positions=False))


def test_satellite_positions_do_not_stand_for_control_that_is_not_used(
    drone, handheld, monkeypatch
):
    """They give a frame, but not that of control."""

    def choose_none(*given):
        choice = choose_control(*given)
        choice.used[:], choice.reasons = False, {"gcp00": "far away"}
        return choice

    choose_control = georeferencing.choose_control
    monkeypatch.setattr(georeferencing, "choose_control", choose_none)
    with pytest.raises(InputError, match="expected 1 control point without .* 0: gcp00: far away"):
        controlled(drone, drone.given(handheld))


def test_a_photograph_that_the_last_adjustment_loses_takes_its_measurements_along(
    drone, handheld, monkeypatch
):
    """The others keep theirs."""
    block, measure = drone.block(), OrientedBlock.measure

    def measure_fewer(self, id):
        point = measure(self, id)
        of_rays = {one.name: getattr(point, one.name) for one in dataclasses.fields(point)}
        del of_rays["position"]
        return dataclasses.replace(point, **{n: x[point.image > 0] for n, x in of_rays.items()})

    def adjust(network, **_):
        monkeypatch.setattr(OrientedBlock, "measure", measure_fewer)
        return block.adjustment, network, None

    monkeypatch.setattr(georeferencing, "adjust_determined", adjust)
    _, points, _ = controlled(drone, drone.given(handheld))
    named = drone.named
    for id, point in points.items():
        images = {drone.images[i] for i, name in zip(named.image, named.name) if name == id}
        assert {one.image for one in point.measurements} == images - {drone.images[0]}


def test_a_removed_coordinate_of_control_is_named_and_not_in_its_rms(drone):
    """Of four points, the fewest that remain, none is left out for one wrong coordinate: data
    snooping removes this."""
    X = drone.truth.copy()
    X[8, 0] += 1.0
    roles = tuple("control" if k in (0, 2, 6, 8) else "check" for k in range(CONTROL))
    _, points, table = controlled(drone, drone.given(X, 0.02, roles, positions=False))
    point = points["gcp08"]
    assert point.used and point.removed_axes == "X" and point.verdict.startswith("used: ")
    assert "data snooping removed X of control point gcp08" in table.notes
    assert abs(point.residual[0]) > 0.9 and table.rms("control")[0] < 0.04
    assert table.as_dict()["points"]["gcp08"]["removed"] == ["X"]
    assert not any(other.removed_axes for other in table.points if other is not point)


@pytest.mark.parametrize("id, removed, of_it", [
    ("5", "point 5 in image a.jpg", True),
    ("5", "either of point 4 in image a.jpg or point 5 in image b.jpg", True),
    ("5", "Z of control point 5", True),
    ("5", "point 5 b in image a.jpg", False),
    ("5 b", "point 5 b in image a.jpg", True),
    ("5", "Z of control point 5 b", False),
    ("5", "distance 5–7", False),
])  # fmt: skip
def test_removed_observations_of_a_point(id, removed, of_it):
    assert georeferencing._is_of_point(removed, id) == of_it


def test_a_point_without_height_leaves_the_others_to_give_the_frame(drone, monkeypatch):
    """A free height of one point of nine, without satellite positions: the block gets to the truth
    by the others; with two that have heights it is refused, and these are counted."""
    X = drone.truth + 0.05 * np.random.default_rng(8).standard_normal((CONTROL, 3))
    sigma = np.full((CONTROL, 3), 0.05)
    sigma[0, 2] = np.inf
    weighted, given = drone.block(False), drone.given(X, sigma, positions=False)
    block = OrientedBlock(weighted.adjustment, given)
    block.move(range(CONTROL), given.points)
    moved = np.array([block.X[block.row_of_determined[name]] for name in NAMES])
    # of coordinates by eight points, and of intersections by photographs of 40 mm a pixel
    assert np.sqrt(np.mean((moved - drone.truth) ** 2)) < 0.1
    sigma[2:, 2] = np.inf
    with pytest.raises(InputError, match="heights .* expected 3, got 1 "):
        controlled(drone, drone.given(X, sigma, positions=False))


def test_the_adjustment_with_control_starts_at_the_block_in_its_frame(drone):
    """Also the projection centres: without satellite positions those of the block may be in any
    frame, and map coordinates are 4000 km from its origin."""
    given = drone.given(drone.truth, 0.05, positions=False)
    block = OrientedBlock(drone.block(False).adjustment, given)
    block.move(range(CONTROL), given.points)
    used, sigma = np.ones(CONTROL, bool), given.points.sigma
    choice = ControlChoice(block.resolve(), used, sigma, {}, {}, None)
    network = network_with_control(block, given.points, choice)
    far = network.images.position - (drone.positions[0] - OFFSET)
    # satellite positions with their errors; those of the block are centimetres
    assert np.abs(far / SATELLITE).max() < 4


def test_sigma_of_positions_is_the_median_of_those_given():
    """Each axis by itself: of heights it is larger."""
    sigma = np.array([[1.0, 2.0, 5.0], [1.5, 2.5, 6.0], [9.0, 9.0, 90.0]])
    covariance = sigma[:, :, None] * sigma[:, None] * (np.eye(3) + 0.1) / 1.1
    antennas = Antennas(image=tuple("abc"), position=np.zeros((3, 3)), covariance=covariance,
                        strip=("",) * 3, time=np.zeros(3))  # fmt: skip
    network = SimpleNamespace(further=(antennas,), images=SimpleNamespace(id=tuple("abc")))
    result = SimpleNamespace(problem=SimpleNamespace(network=network),
                             image_values=np.ones((3, 6)), further_unknowns={})  # fmt: skip
    found = camera_positions(result)
    np.testing.assert_allclose(found.sigma, sigma[1])
    np.testing.assert_allclose(found.rms, 1.0)
    # priors of the images: of those that have one; a held position is no measurement
    images = SimpleNamespace(id=tuple("abcde"), position=np.zeros((5, 3)), sigma=np.ones((5, 6)))
    images.sigma[:3, :3], images.sigma[3], images.sigma[4] = sigma, np.nan, 0.0
    result.problem.network = SimpleNamespace(further=(), images=images)
    result.image_values = np.ones((5, 6))
    found = camera_positions(result)
    np.testing.assert_allclose(found.sigma, sigma[1])
    assert found.difference.keys() == set("abc") and np.isnan(found.offset).all()


def test_report_page_and_json_show_control_and_block(drone, spoilt, tmp_path):
    image, result, _, table = spoilt
    positions = any(one.TABLE == "antennas" for one in result.network.further)
    time = datetime.datetime(2026, 5, 4, 10, 30)
    exif = {id: Exif((2000, 1500), time=time) for id in drone.images}
    facts = describe_block(result, exif, "EPSG:32611")
    part = ReconstructedPart("part 1", result, {}, facts, table)
    found = Reconstruction((part,), {}, ("a note",), (), {}, name="quarry")
    folder = tmp_path / "out"
    write_reconstruction(found, "", folder, True, False, False)
    text = (folder / "report.txt").read_text()
    page = (folder / "report.html").read_text()
    told = json.loads((folder / "result.json").read_text())["reconstruction"]
    for said in ("quarry", "2026-05-04", "EPSG:32611", "Ground sample distance", "Flying height",
                 "Area covered", "Overlap", "Camera positions", "gcp06", "a wrong name",
                 image, "estimated from the residuals"):  # fmt: skip
        assert said in " ".join(text.split()) and said in page, said
    assert told["name"] == "quarry"
    (one,) = told["parts"]
    assert one["block"]["ground_sample_distance"] == pytest.approx(60.0 / 1500.0, rel=0.1)
    assert one["block"]["flying_height"] == pytest.approx(60.0, rel=0.1)
    # 36 × 28 m of stations, and half a footprint of 80 × 60 m in any direction around them
    assert 36 * 28 < one["block"]["area"] < 116 * 108
    control = one["control"]["points"]
    assert not control["gcp06"]["used"] and control["gcp08"]["verdict"] == "check"
    assert control["gcp01"]["residual"]["X"] is not None
    if positions:
        assert set(one["block"]["camera_positions"]["difference"]) == set(drone.images)
    with (folder / "control.csv").open() as file:
        rows = {row["id"]: row for row in csv.DictReader(file)}
    assert rows["gcp06"]["used"] == "False" and "left out" in rows["gcp06"]["verdict"]


def test_distances_in_images_are_told_in_pixels():
    """Image coordinates of metric cameras are in mm, of others in pixels already."""
    cameras = (
        Camera("metric", "brown", {"c": 24.0}, pixel_size=(0.005, 0.005)),
        Camera("pixels", "opencv", {"fx": 900.0, "fy": 900.0}, pixel_size=(0.005, 0.005)),
    )
    network = SimpleNamespace(cameras=cameras, images=SimpleNamespace(camera=np.array([0, 1, 0])))
    found = georeferencing._pixels(SimpleNamespace(problem=SimpleNamespace(network=network)))
    np.testing.assert_allclose(found, [0.005, 1.0, 0.005])


def test_the_time_of_computation_is_in_whole_seconds():
    """As the times of the photographs, which have no fractions, in ISO 8601."""
    time = datetime.datetime(2024, 5, 1, 10, 20, 30, 123456, datetime.UTC)
    facts = BlockFacts(3, None, time, "local", "m", 0.01, 60.0, None, None, 3.0, 90.0, None, None)
    assert facts.as_dict()["computed"] == "2024-05-01T10:20:30+00:00"


def test_control_that_is_not_used_is_reported_with_the_reason():
    """In the text, too: a surveyor who gave control sees why the block is without it."""
    block = SimpleNamespace(facts=lambda: [("Photographs", "3")])
    part = SimpleNamespace(name="part 1", block=block, control=None, no_control="expected 3, got 2")
    whole = SimpleNamespace(name="survey", parts=(part,))
    assert "Control is not used: expected 3, got 2" in describe_part(whole, part)
    assert describe_part(whole, part).splitlines()[0] == "survey"


def test_a_part_of_several_has_its_name_and_says_how_many_there_are():
    """Numbers of a report without them would be taken for those of all photographs."""
    block = SimpleNamespace(facts=lambda: [("Photographs", "3")])
    images = SimpleNamespace(network=SimpleNamespace(images=range(3)))
    part = SimpleNamespace(
        name="part 2", block=block, control=None, no_control="", adjustment=images
    )
    whole = SimpleNamespace(name="survey", parts=(None, part), photographs=range(7), left_out={})
    assert describe_part(whole, part).splitlines()[0] == "survey, part 2"
    told = page._judge_photographs(whole, part)
    assert told.words == "3 of 7 photographs in this part, 2 unconnected parts"
    assert told.state == page.DOUBTFUL


@pytest.mark.further
def test_the_written_network_gives_the_same_numbers(good, tmp_path):
    result, _, _ = good
    write_targets(result, "", tmp_path / "out", brief=True, plots=False)
    tables = {p.name for p in (tmp_path / "out" / "network").iterdir()}
    assert {"antennas.csv", "camera_parameters.csv"} <= tables
    done = subprocess.run(
        [sys.executable, "-m", "jaxbundle", "adjust", tmp_path / "out" / "network", "--json",
         tmp_path / "again.json", "--quiet"], capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    again = json.loads((tmp_path / "again.json").read_text())
    before = json.loads((tmp_path / "out" / "result.json").read_text())
    assert again["redundancy"] == before["redundancy"] and again["datum"] == "control"
    assert again["sigma0"] == pytest.approx(before["sigma0"], rel=1e-8)
    pairs = [(row[n], again["further_unknowns"]["GNSS strip"]["all"][n])
             for row in before["further_unknowns"]["GNSS strip"].values() for n in row]  # fmt: skip
    pairs += [(point[axis], again["points"][id][axis]) for id, point in before["points"].items()
              for axis in "XYZ"]  # fmt: skip
    for one, other in pairs:
        assert other["value"] == pytest.approx(one["value"], abs=1e-5)
        assert other["sigma"] == pytest.approx(one["sigma"], rel=1e-5)
