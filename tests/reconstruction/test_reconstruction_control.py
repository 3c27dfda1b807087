"""Control points with their measurements: files of OpenDroneMap, tables, errors by line."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from jaxbundle import read_network
from jaxbundle.errors import InputError
from jaxbundle.io.networks.control import select_checks
from jaxbundle.measure.coded_targets import NamedPoints
from jaxbundle.network.tables import LeftOut
from jaxbundle.orientation.missing import note_missing
from jaxbundle.photographs.exif import GeographicPosition
from jaxbundle.photographs.places import map_positions
from jaxbundle.reconstruction import named
from jaxbundle.reconstruction.control import read_control_measurements, with_sigma
from jaxbundle.reconstruction.controlled_network import without_names, without_returned
from jaxbundle.reconstruction.named import (
    NamedMeasurements,
    find_named,
    name_unused,
    read_distances,
)
from jaxbundle.reconstruction.satellite_positions import find_positions

EXAMPLES = Path(__file__).parents[2] / "examples"


def written(tmp_path, text):
    path = tmp_path / "control.txt"
    path.write_text(text)
    return path


def test_gcp_list_of_opendronemap(tmp_path):
    found = read_control_measurements(written(tmp_path, (
        "WGS84 UTM 33N\n"
        "544256.7 5320919.9 5.0 3044 2622 a.jpg gcp1\n"
        "544256.7 5320919.9 5.0 1022.5 18 b.jpg gcp1 extra\n"
        "544157.7 5320899.2 5.5 4193 1552 a.jpg\n"
    )))  # fmt: skip
    assert found.points.id == ("gcp1", "gcp2") and found.system == "EPSG:32633"  # gcp1 is taken
    assert found.sightings[:2] == (("a.jpg", "gcp1"), ("b.jpg", "gcp1"))
    np.testing.assert_allclose(found.xy[1], [1022.5, 18])
    assert np.isnan(found.points.sigma).all()


def test_points_without_names_are_told_apart_by_their_coordinates(tmp_path):
    """Also those above each other on a façade; an empty last column is no name."""
    found = read_control_measurements(written(tmp_path, (
        "EPSG:32633\n1\t2\t3\t4\t5\ta.jpg\t\n1\t2\t9\t4\t1\ta.jpg\t\n1\t2\t3\t4\t5\tb.jpg\t\n"
    )))  # fmt: skip
    assert found.points.id == ("gcp1", "gcp2")
    (note,) = found.notes
    assert "2 points without a name, numbered in the order of the list: gcp1, gcp2" in note
    assert [id for _, id in found.sightings] == ["gcp1", "gcp2", "gcp1"]


def test_one_row_states_the_role_of_a_point(tmp_path):
    found = read_control_measurements(written(tmp_path, (
        "id,X,Y,Z,role,image,u,v\nP,1,2,3,,a.jpg,1,2\nP,1,2,3,check,b.jpg,1,2\n"
        "P,1,2,3,,c.jpg,1,2\nQ,4,2,3,,a.jpg,1,2\n"
    )))  # fmt: skip
    assert found.points.role == ("check", "control")


def test_degrees_become_metres(tmp_path):
    found = read_control_measurements(written(tmp_path, (
        "EPSG:4326\n15 48 200 1 2 a.jpg P\n15.001 48 200 1 2 a.jpg Q\n"
    )))  # fmt: skip
    # 15° is the middle of zone 33: easting 500 km; 0.001° of the parallel of 48° is 74.6 m
    assert found.points.position[0, 0] == pytest.approx(500_000, abs=0.01)
    assert np.diff(found.points.position[:, 0])[0] == pytest.approx(74.6, abs=0.1)


def test_tables_with_and_without_measurements(tmp_path):
    found = read_control_measurements(written(tmp_path, (
        "id,X,Y,Z,sX,sY,sZ,image,u,v,suv\nP,1,2,3,0.01,0.01,0.02,a.jpg,10,20,0.5\n"
        "P,1,2,3,0.01,0.01,0.02,b.jpg,11,21,\n"
    )))  # fmt: skip
    np.testing.assert_allclose(found.points.sigma, [[0.01, 0.01, 0.02]])
    np.testing.assert_allclose(found.sigma, [0.5, 1.0])
    plain = read_control_measurements(written(tmp_path, "id,X,Y,Z\n45,1,2,3\n"))
    assert plain.points.id == ("45",) and plain.sightings == ()
    # σ stated once, decimal commas, tabs in a list whose names have blanks
    other = read_control_measurements(written(tmp_path, (
        "id;X;Y;Z;sX;sY;sZ;image;u;v\nP;1,5;2;3;0,1;0,1;0,2;a.jpg;10;20\nP;1,5;2;3;;;;b.jpg;11;21\n"
    )))  # fmt: skip
    np.testing.assert_allclose(other.points.position, [[1.5, 2, 3]])
    np.testing.assert_allclose(other.points.sigma, [[0.1, 0.1, 0.2]])
    listed = written(tmp_path, "EPSG:32633\n1\t2\t3\t4\t5\tFlug Süd.jpg\tGCP 02\n")
    assert read_control_measurements(listed).sightings == (("Flug Süd.jpg", "GCP 02"),)
    # A table without a header, of coded targets: seven numbers are no image point
    bare = read_control_measurements(written(tmp_path, "45 1 2 3 0.1 0.1 0.2\n46 2 2 3 1 1 1\n"))
    assert bare.points.id == ("45", "46") and bare.sightings == ()


@pytest.mark.parametrize("text, said", [
    ("", "the file is empty"),
    ("EPSG:4326\n15 48 200 1 a.jpg\n", "line 2: expected X Y Z u v photograph"),
    ("EPSG:32633\n1 2 3 4 5 a.jpg P\n1 2 9 4 5 b.jpg P\n", "line 3: point P has other"),
    ("EPSG:32633\n", "no control points"),
    ("EPSG:2229\n1 2 3 4 5 a.jpg P\n", r"is in US survey foot \(0.30480061 m\)"),
    ("EPSG:4326\n34.4 -119.9 0 4 5 a.jpg P\n", "34.4, -119.9 is no place in EPSG:4326"),
    ("EPSG:32611\n3814000 235000 0 4 5 a.jpg P\n", "outside of EPSG:32611, and within it"),
    ("id;X;Y;Z;image;u;w\nP;1;2;3;a.jpg;1;2\n", "line 1: a table of .*; missing: v"),
    ("1 2 3 4 5 a.jpg P\n", "line 1: the first line of a list .* names its coordinate system"),
    ("EPSG:32633\n1 2 3 4 5 Flug Süd.jpg P\n", "line 2: photograph 'Flug' has no ending"),
    ("id,X,Y,Z,image,u,v\nP,1,2,x,a.jpg,1,2\n", "line 2: z is 'x'"),
    ("id,X,Y,Z,sX,image,u,v\nP,1,2,3,-1,a.jpg,1,2\n", "line 2: sX, sY, sZ must be positive"),
    ("id,X,Y,Z,sX,image,u,v\nP,1,2,3,1,a.jpg,1,2\nP,1,2,3,2,b.jpg,1,2\n", "P has another σ"),
    ("id,X,Y,Z,role,image,u,v\nP,1,2,3,check,a.jpg,1,2\nP,1,2,3,fixed,b.jpg,1,2\n",
     "P has another σ or role"),
    ("id,X,Y,Z,suv,image,u,v\nP,1,2,3,0,a.jpg,1,2\n", "line 2: suv must be positive"),
    ("id,X,Y,Z,image,u,v\n,1,2,3,a.jpg,1,2\n", "line 2: the id is empty"),
    ("id,X,Y,Z,image,u,v\nP,1,2,3,a.jpg,1,2\nP,1,2,3,a.jpg,5,6\n",
     "line 3: point P is measured in a.jpg in line 2, too"),
])  # fmt: skip
def test_what_is_wrong_is_said_with_its_line(tmp_path, text, said):
    with pytest.raises(InputError, match=said):
        read_control_measurements(written(tmp_path, text))


def test_scale_bars_and_control_that_no_photograph_shows(tmp_path):
    names = ("45", "45", "51")
    seen = NamedMeasurements(np.array([0, 1, 0]), names, np.zeros((3, 2)), np.ones((3, 2)))
    bar = lambda a, b: {"from": a, "to": b, "value": 1.0, "sigma": 0.001}
    assert name_unused(seen, None, [], 3) == []
    with pytest.raises(InputError, match="no scale bar has both ends in two .*45 to 51"):
        name_unused(seen, None, [bar("45", "51")], 3)
    with pytest.raises(InputError, match=r"\(1 to 2, 2 to 3, 3 to 4 and 2 more\)"):
        name_unused(seen, None, [bar(str(k), str(k + 1)) for k in range(1, 6)], 3)
    both = dataclasses.replace(seen, image=np.array([0, 1, 0, 1]), name=("45", "45", "51", "51"))
    (note,) = name_unused(both, None, [bar("45", "51"), bar("45", "7")], 3)
    assert "45 to 7" in note and "51" not in note
    # an end in one photograph has no position, however many show the other points
    part = NamedMeasurements(np.array([0, 1, 0, 0, 1]), ("45", "45", "51", "52", "52"),
                             np.zeros((5, 2)), np.ones((5, 2)))  # fmt: skip
    (note,) = name_unused(part, None, [bar("45", "51"), bar("45", "52")], 3)
    assert "45 to 51" in note and "52" not in note
    control = read_control_measurements(written(tmp_path, "id,X,Y,Z\n45,1,2,3\n7,1,2,4\n"))
    with pytest.raises(InputError, match="1 control points are measured .* 3 are needed.*7"):
        name_unused(both, control, [], 3)
    assert name_unused(both, control, [], 1) == ["control points in no photograph: 7"]
    # coordinates of tie points are not used
    ties = dataclasses.replace(control.points, role=("tie", "tie"))
    with pytest.raises(InputError, match="0 control points are measured .* 1 are needed"):
        name_unused(both, dataclasses.replace(control, points=ties), [], 1)


def test_measurements_in_missing_photographs_are_reported(tmp_path):
    """The others are used; if none is left another folder was given."""
    text = "id,X,Y,Z,image,u,v\nA,1,2,3,a.jpg,10,20\nA,1,2,3,b.jpg,11,21\nB,4,2,3,b.jpg,1,2\n"
    control = read_control_measurements(written(tmp_path, text))
    found, _, notes = find_named([SimpleNamespace(name="a.jpg")], None, control)
    assert found.name == ("A",) and notes == ["control measured in missing photographs: 'b.jpg'"]
    none = r"measured in none of the photographs \(c.jpg\), but in a.jpg, b"
    with pytest.raises(InputError, match=none):
        find_named([SimpleNamespace(name="c.jpg")], None, control)


@pytest.mark.parametrize("names, image", [
    (("A.JPG", "B.JPG"), [0, 1, 1]), (("b", "a"), [1, 0, 0]), (("a.png", "b.tif"), [0, 1, 1]),
    (("A.jpg", "a.png", "b.jpg"), [0, 2, 2]), (("a.png", "a.tif", "b.jpg"), [2, 2]),
    (("A", "a.jpg", "B.PNG"), [1, 2, 2]),
])  # fmt: skip
def test_photographs_of_control_are_known_without_case_and_suffix(tmp_path, names, image):
    """If only one has the name; exact names first."""
    text = "id,X,Y,Z,image,u,v\nA,1,2,3,a.jpg,10,20\nA,1,2,3,b.jpg,11,21\nB,4,2,3,b.jpg,1,2\n"
    control = read_control_measurements(written(tmp_path, text))
    found, *_ = find_named([SimpleNamespace(name=name) for name in names], None, control)
    assert found.image.tolist() == image


def test_a_point_measured_by_hand_where_its_target_is_found_is_refused(tmp_path, monkeypatch):
    """Before features are matched. A photograph that cannot be read is named with the reason."""

    def read(path):
        if path.name == "b.jpg":
            raise InputError(f"{path}: damaged")

    target = NamedPoints(("45",), np.zeros((1, 2)), np.eye(2)[None])
    monkeypatch.setattr(named, "read_photograph", read)
    monkeypatch.setattr(named, "find_coded_targets", lambda *_, **options: target)
    given = [
        SimpleNamespace(name=name, path=tmp_path / name, size=(100, 100))
        for name in ("a.jpg", "b.jpg")
    ]
    table = "id,X,Y,Z,image,u,v\n45,1,2,3,{},10,20\n"
    control = read_control_measurements(written(tmp_path, table.format("b.jpg")))
    found, _, notes = find_named(given, "ring14", control)
    assert found.name == ("45", "45") and "b.jpg: no targets are looked for: damaged" in notes
    control = read_control_measurements(written(tmp_path, table.format("a.jpg")))
    with pytest.raises(InputError, match="control.txt: point 45 is measured in a.jpg, where"):
        find_named(given, "ring14", control)


TABLE = ("id,X,Y,Z,sX,sY,sZ,image,u,v\nA,1,2,3,,,,a.jpg,10,20\nB,4,2,3,0.01,0.01,0.02,a.jpg,11,2\n"
         "C,1,5,3,,,,a.jpg,1,2\nD,1,2,9,,,,a.jpg,1,9\n")  # fmt: skip


def test_sigma_and_check_points_by_options(tmp_path):
    control = read_control_measurements(written(tmp_path, TABLE))
    sigma = with_sigma(control, "0.03,0.05").points.sigma
    np.testing.assert_allclose(sigma[0], [0.03, 0.03, 0.05])
    np.testing.assert_allclose(sigma[1], [0.01, 0.01, 0.02])  # the file's own
    for text in ("-1", "a", "1,2,3", "nan"):
        with pytest.raises(InputError, match="--control-sigma .*expected a positive number"):
            with_sigma(control, text)
    roles = lambda *given: select_checks(control.points, given).role
    assert roles("A,C") == roles("A", "C") == ("check", "control", "check", "control")
    assert roles("every 3rd") == ("control", "check", "control", "control")
    assert roles("every 2nd") == ("control", "check", "control", "check")
    with pytest.raises(InputError, match="--check E: expected a control point .*control.txt"):
        roles("E")
    with pytest.raises(InputError, match="all 4 control points are check points"):
        roles("A,B,C,D")


def test_options_of_control_need_control(tmp_path, command):
    (tmp_path / "photos").mkdir()
    done = command("reconstruct", tmp_path / "photos", "--check", "A", "--out", tmp_path / "out")
    assert done.status == 2 and "--control-sigma and --check need --control" in done.err


def test_check_points_of_a_project_are_control_points(command):
    done = command("adjust", EXAMPLES / "bingo_indoor", "--check", "nowhere", "--json", "-")
    assert done.status == 2 and "--check nowhere: expected a control point" in done.err
    points = read_network(EXAMPLES / "bingo_indoor").points
    chosen = select_checks(points, ["every 2nd"])
    assert (chosen.has_role("check") <= points.has_role("control")).all()
    assert chosen.has_role("check").sum() == points.has_role("control").sum() // 2


PLACES = [
    GeographicPosition(34.4064 + 2e-4 * k, -119.88 + 3e-4 * (k % 3), 100.0 + k) for k in range(6)
]


def test_positions_in_the_system_of_control():
    """California, in its state plane in metres and in feet, and in the UTM zone."""
    utm, state = map_positions(PLACES), map_positions(PLACES, "EPSG:26945")
    assert utm.system == "EPSG:32611" and utm.define_frame
    d = [np.linalg.norm(np.diff(p.X[:, :2], axis=0), axis=1) for p in (utm, state)]
    np.testing.assert_allclose(d[0], d[1], rtol=1e-3)
    assert np.linalg.norm(utm.X - state.X) > 1e5
    assert map_positions(PLACES, "EPSG:2229") is None  # feet
    near = [dataclasses.replace(p, latitude=34.4064) for p in PLACES[:1] * 6]
    assert not map_positions(near).define_frame


def test_what_is_done_with_positions_is_said(tmp_path):
    photographs = [SimpleNamespace(exif=SimpleNamespace(place=p)) for p in PLACES]
    control = read_control_measurements(written(tmp_path, TABLE))
    found, notes = find_positions(photographs, control)
    assert found is None and "km from control in EPSG:32611" in notes[-1]
    X = control.points.position + [235_300.0, 3_811_200.0, 0.0]
    near = dataclasses.replace(
        control, points=dataclasses.replace(control.points, position=X), system="EPSG:32611"
    )
    found, notes = find_positions(photographs, near)
    assert found is not None and "satellite positions of 6 photographs with their σ" in notes[-1]
    assert "frame" not in " ".join(notes)
    place = dataclasses.replace(PLACES[0], height=100.0)
    found, notes = find_positions([SimpleNamespace(exif=SimpleNamespace(place=place))] * 6, near)
    assert found is not None and "do not define the frame" in " ".join(notes)
    nothing = [SimpleNamespace(exif=SimpleNamespace(place=None))] * 4
    found, notes = find_positions(nothing, near)
    assert found is None and "no satellite positions in the photographs" in notes[-1]


def test_distances(tmp_path):
    rows = read_distances(written(tmp_path, "from,to,value,sigma\n45,51,1.25,0.0001\n"))
    assert rows == [{"from": "45", "to": "51", "value": 1.25, "sigma": 0.0001}]
    with pytest.raises(InputError, match="'sigma' is missing"):
        read_distances(written(tmp_path, "from,to,value\n1,2,3\n"))


def test_control_that_comes_back_is_not_said_to_be_left_out():
    """One ray gives no point, but known coordinates and one ray are an observation."""
    notes = (
        LeftOut("point", ("gcp00", "17"), "for which no start values were found"),
        LeftOut("tie point", ("gcp00",), "with one ray"),
        LeftOut("image point", ("gcp00 in a.jpg",), "that contradict"),
    )
    found = without_names(notes, ("gcp00",))
    assert [one.names for one in found] == [("17",), ("gcp00 in a.jpg",)]
    network = read_network(EXAMPLES / "bingo_indoor").replace(notes=(), left_out=())
    network = network.note("gcp00 is at the place of gcp01")
    few, clause = "seen in 1 placed image; 2 are needed", "for which no start values were found"
    reasons = {"gcp00": few, "17": few, "18": "its 2 rays do not intersect"}
    noted = note_missing(network, "point", reasons, clause)
    # What is said of the others stays: the same as if the point had never been missing.
    others = {id: why for id, why in reasons.items() if id != "gcp00"}
    expected = note_missing(network, "point", others, clause)
    found = without_returned(noted, ("gcp00",))
    assert (found.notes, found.left_out) == (expected.notes, expected.left_out)
    assert without_returned(noted, ("gcp0",)).notes == noted.notes
    assert without_returned(noted, tuple(reasons)).notes == network.notes
