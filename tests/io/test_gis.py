"""GeoJSON and GeoPackage of a result: geometry, systems, ellipses."""

import dataclasses
import json
import sqlite3
import struct
from pathlib import Path

import numpy as np
import pytest

import jaxbundle
from jaxbundle.cli.gis_output import check_gis
from jaxbundle.errors import InputError
from jaxbundle.io import write_geojson, write_geopackage

ORIGIN = np.array([500_000.0, 5_700_000.0, 100.0])
"""In zone 32 of UTM: 9° east."""


@pytest.fixture(scope="module")
def result():
    """The field of tests/certificates/test_lengths.py, moved to a map system."""
    camera = jaxbundle.Camera("cam", "brown", {"c": 20.0}, ("c", "x0", "y0"))
    stations = jaxbundle.ring_of_stations(8, 3.0, 3.0, roll_every=2)
    stations = dataclasses.replace(stations, position=stations.position + ORIGIN)
    targets = jaxbundle.cloud_of_targets(20, (2.0, 2.0, 0.8), seed=3) + ORIGIN
    network = jaxbundle.simulate(
        stations, targets, camera, noise=1e-3, seed=2, control=range(6), control_sigma=1e-4,
    )  # fmt: skip
    return jaxbundle.adjust(network)


def test_geojson_has_what_rfc_7946_wants(result, tmp_path):
    import pyproj

    path = tmp_path / "a.geojson"
    write_geojson(result, path, "EPSG:25832")
    document = json.loads(path.read_text("utf-8"))
    assert document["type"] == "FeatureCollection" and "crs" not in document
    features = document["features"]
    assert len({one["id"] for one in features}) == len(features)
    back = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:25832", always_xy=True).transform
    of = lambda layer: [one for one in features if one["properties"]["layer"] == layer]
    assert [len(of(layer)) for layer in ("points", "stations", "ellipses")] == [20, 8, 20]
    for one, place in zip(of("points"), result.point_values):
        lon, lat, height = one["geometry"]["coordinates"]
        np.testing.assert_allclose((*back(lon, lat), height), place, atol=2e-4)
        assert one["properties"]["X"] == pytest.approx(place[0], abs=1e-9)
    for one in of("ellipses"):
        (ring,) = one["geometry"]["coordinates"]
        assert ring[0] == ring[-1] and len(ring) == 37
        x, y = (np.array(ring[:-1]) - ring[0]).T
        assert x @ np.roll(y, -1) - y @ np.roll(x, -1) > 0  # counterclockwise: 3.1.6
    json.dumps(document, allow_nan=False)


def test_control_and_check_points_have_their_differences(result, tmp_path):
    given = result.network
    names = [given.points.id[k] for k in (4, 5)]
    role = tuple("check" if id in names else r for id, r in zip(given.points.id, given.points.role))
    points = dataclasses.replace(given.points, role=role)
    checked = jaxbundle.adjust(given.replace(points=points))
    write_geopackage(checked, tmp_path / "a.gpkg")
    with sqlite3.connect(tmp_path / "a.gpkg") as database:
        rows = database.execute("SELECT id, X, Y, Z, dX, dY, dZ, geom FROM checks").fetchall()
        control = database.execute("SELECT id, dX, probability FROM control").fetchall()
    assert [row[0] for row in rows] == names and len(control) == 4
    for row, place in zip(rows, given.points.position[[4, 5]]):
        np.testing.assert_allclose(np.subtract(row[1:4], row[4:7]), place, atol=1e-9)
        assert struct.unpack("<3d", row[7][-24:]) == row[1:4]
    assert [row[1] for row in control] == pytest.approx(checked.table("control")["dX"].tolist())


def test_ellipses_are_those_of_the_covariance(result, tmp_path):
    write_geopackage(result, tmp_path / "a.gpkg", factor=1000.0)
    with sqlite3.connect(tmp_path / "a.gpkg") as database:
        rows = database.execute("SELECT id, a, b, bearing, factor, geom FROM ellipses").fetchall()
    ids = list(result.points["id"])
    for id, a, b, bearing, factor, blob in rows:
        C = result.point_covariance[ids.index(id)][:2, :2]
        assert factor == 1000.0 and a >= b
        u = np.array([np.sin(np.deg2rad(bearing)), np.cos(np.deg2rad(bearing))])
        v = np.array([u[1], -u[0]])
        np.testing.assert_allclose(a**2 * np.outer(u, u) + b**2 * np.outer(v, v), C, rtol=1e-6,
                                   atol=1e-9 * C.max())  # fmt: skip
        ring = np.frombuffer(blob[8 + 13 :], "<f8").reshape(-1, 2)
        away = (ring - result.point_values[ids.index(id), :2]) / 1000.0
        np.testing.assert_allclose(
            np.einsum("ni,ij,nj->n", away, np.linalg.inv(C), away), 1, rtol=1e-4
        )


@pytest.mark.parametrize(("crs", "number"), [("", -1), ("EPSG:25832", 25832), ("epsg:4326", 4326)])
def test_a_geopackage_has_its_tables(result, tmp_path, crs, number):
    """OGC 12-128r18: identification, the three systems, contents, geometry columns, blobs."""
    path = tmp_path / "a.gpkg"
    path.write_text("old")
    write_geopackage(result, path, crs)
    with sqlite3.connect(path) as database:
        one = lambda statement: database.execute(statement).fetchone()
        assert one("PRAGMA application_id")[0] == 0x47504B47
        assert one("PRAGMA user_version")[0] == 10300
        assert one("PRAGMA integrity_check")[0] == "ok"
        assert database.execute("PRAGMA foreign_key_check").fetchall() == []
        systems = {row[0] for row in database.execute("SELECT srs_id FROM gpkg_spatial_ref_sys")}
        assert systems >= {-1, 0, 4326, number}
        contents = database.execute("SELECT table_name, srs_id FROM gpkg_contents").fetchall()
        assert contents == [
            (name, number) for name in ("points", "control", "stations", "ellipses")
        ]
        kinds = dict(database.execute("SELECT table_name, z FROM gpkg_geometry_columns").fetchall())
        assert kinds == {"points": 1, "control": 1, "stations": 1, "ellipses": 0}
        rows = database.execute("SELECT geom, X, Y, Z, sZ FROM points").fetchall()
    for (blob, *place, sigma), s in zip(rows, result.points["sZ"]):
        assert blob[:4] == b"GP\x00\x01" and struct.unpack("<i", blob[4:8]) == (number,)
        assert struct.unpack("<BI3d", blob[8:]) == (1, 1001, *place)
        assert sigma == pytest.approx(s)
    assert [p.name for p in tmp_path.iterdir()] == ["a.gpkg"]


def test_systems_that_cannot_be_used(result, tmp_path):
    wrong = (("25832", "EPSG:NUMBER"), ("EPSG:99999", "crs"), ("", "longitude and latitude"))
    for crs, why in wrong:
        with pytest.raises(InputError, match=why):
            write_geojson(result, tmp_path / "a.geojson", crs)
    with pytest.raises(InputError, match="outside of this system"):
        write_geojson(result, tmp_path / "a.geojson", "EPSG:4326")  # metres are no degrees
    with pytest.raises(InputError, match="positive"):
        write_geopackage(result, tmp_path / "a.gpkg", factor=-1.0)
    assert [*tmp_path.iterdir()] == []


def test_without_pyproj_a_geopackage_says_the_number(result, tmp_path, monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "pyproj", None)
    write_geopackage(result, tmp_path / "a.gpkg", "EPSG:25832")
    with sqlite3.connect(tmp_path / "a.gpkg") as database:
        row = database.execute(
            "SELECT organization, organization_coordsys_id, definition FROM gpkg_spatial_ref_sys "
            "WHERE srs_id = 25832"
        ).fetchone()
    assert row == ("EPSG", 25832, "undefined")
    with pytest.raises(InputError, match="pyproj"):
        write_geojson(result, tmp_path / "a.geojson", "EPSG:25832")


def test_the_command_writes_it_and_refuses_before_the_work(command, tmp_path):
    project = "examples/convergent4/project.toml"
    project = Path(__file__).parents[2] / project
    told = command("adjust", project, "--gis", tmp_path / "n.gpkg", "--quiet")
    assert told.status == 0 and (tmp_path / "n.gpkg").read_bytes()[:15] == b"SQLite format 3"
    (tmp_path / "x.gpkg").write_text("notes")
    for options, why in (
        (["--gis", tmp_path / "n.shp"], "expected a name that ends with .gpkg or .geojson"),
        (["--gis", tmp_path / "n.geojson"], "longitude and latitude"),
        (["--gis", tmp_path / "n.gpkg", "--crs", "utm"], "EPSG:NUMBER"),
        (["--crs", "EPSG:25832"], "it is for --gis"),
        (["--gis", tmp_path / "x.gpkg"], "is not a GeoPackage; give another name, or --force"),
        (["--gis", tmp_path / "no" / "n.gpkg"], "there is no folder"),
    ):
        told = command("adjust", project, *options)
        assert told.status == 2 and why in told.err and told.err.count("\n") == 1, told.err
    for name in ("x.gpkg", "x.geojson"):
        (tmp_path / name).write_text("notes")
        with pytest.raises(InputError, match="or --force to replace it"):
            check_gis(str(tmp_path / name), "EPSG:25832", [])
        check_gis(str(tmp_path / name), "EPSG:25832", [], force=True)
