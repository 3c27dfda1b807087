"""`pushbroom rpc`: fitted to a table and to a scanner, applied, compensated, what is refused."""

import csv
import io
import json
import re
import sys

import numpy as np
import pytest
from rpc_scenes import made_up, table_of
from scanner_files import write_scanner

from jaxbundle import cli
from jaxbundle.io.scanner.rpc import StatedErrors, read_rpc, write_rpc
from jaxbundle.io.text.csv_tables import write_csv
from jaxbundle.pushbroom.rpc.fitting import RpcTable, check_rpc
from jaxbundle.pushbroom.rpc.polynomials import project_points

RPC = made_up(longitude_offset=12.3)
COLUMNS = ("longitude", "latitude", "height", "line", "sample")


@pytest.fixture
def run(monkeypatch, capsys):
    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["jaxbundle", "pushbroom", "rpc", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        return ended.value.code or 0, *capsys.readouterr()

    return run


def write_table(path, table):
    columns = (np.degrees(table.longitude), np.degrees(table.latitude), *table[2:])
    write_csv(path, COLUMNS, np.column_stack(columns).tolist())
    return path


def test_a_table_is_fitted(tmp_path, run):
    table = write_table(tmp_path / "table.csv", table_of(RPC))
    status, out, err = run("fit", table, "--out", tmp_path / "fit_RPC.TXT", "--json", "-")
    told = json.loads(out)
    assert err == "" and status == 0 and told["points"] == 196 and told["fit_largest_line"] < 1e-3
    largest = max(abs(row["v_line"]) for row in told["rows"])
    assert len(told["rows"]) == 196 and largest == told["fit_largest_line"]
    given = table_of(RPC)
    np.testing.assert_allclose([r["longitude"] for r in told["rows"]], np.degrees(given.longitude))
    check = check_rpc(read_rpc(tmp_path / "fit_RPC.TXT"), table_of(RPC, (5, 4, 3)))
    assert check.largest.max() < 1e-3


def test_a_table_of_locate_is_fitted(tmp_path, run):
    """Its columns, with pixels for samples; rows without a point are skipped. Of one height only,
    which its intersections reach to rounding, it is refused."""
    given = table_of(RPC)
    names = ("line", "pixel", "X", "Y", "Z", "longitude", "latitude", "height", "status")
    rows = [
        [line, sample, 1.0, 2.0, 3.0, *np.degrees([east, north]), height, "found"]
        for east, north, height, line, sample in zip(*given)
    ]
    write_csv(tmp_path / "located.csv", names, [*rows, [0, 0, *[""] * 6, "misses the surface"]])
    status, out, err = run("fit", tmp_path / "located.csv", "--out", tmp_path / "a.RPB")
    assert status == 0 and "no point (1 rows are skipped)" in err
    assert check_rpc(read_rpc(tmp_path / "a.RPB"), table_of(RPC, (5, 4, 3))).largest.max() < 1e-3
    level = [[*row[:7], 100 + 1e-9 * k, "found"] for k, row in enumerate(rows)]
    write_csv(tmp_path / "level.csv", names, level)
    status, _, err = run("fit", tmp_path / "level.csv", "--out", tmp_path / "b.RPB")
    assert status == 2 and "level.csv: every height is 100; give points at several heights" in err
    assert not (tmp_path / "b.RPB").exists()


def test_a_scanner_is_fitted_as_well_as_its_wobble_allows(tmp_path, run):
    """Its attitude sways by 1e-4 at 0.7 Hz: more than a pixel that no cubic can follow; this is
    reported."""
    scanner = write_scanner(tmp_path)
    status, out, err = run(
        "fit", scanner, "--heights", "0:1000", "--out", tmp_path / "a.RPB", "--json", "-"
    )
    told = json.loads(out)
    largest = max(v for k, v in told.items() if "largest" in k)
    assert largest > 0.5 and f"residuals up to {largest:.3g} pixel" in err
    assert status == 0 and 0.05 < told["check_largest_line"] < 5
    assert float(read_rpc(tmp_path / "a.RPB").height_scale) == pytest.approx(500, abs=1e-6)


def test_there_and_back(tmp_path, run):
    write_rpc(tmp_path / "a.txt", RPC)
    (tmp_path / "places.csv").write_text("id,line,sample\np,2500,2000\nq,3100.5,4000\n")
    status, out, _ = run(
        "apply", tmp_path / "a.txt", "--points", tmp_path / "places.csv", "--height", 300
    )
    rows = list(csv.DictReader(io.StringIO(out)))
    assert status == 0 and [row["id"] for row in rows] == ["p", "q"]
    names = ("id", "longitude", "latitude", "height")
    write_csv(tmp_path / "ground.csv", names, [[row[n] for n in names] for row in rows])
    status, out, _ = run(
        "apply", tmp_path / "a.txt", "--points", tmp_path / "ground.csv", "--json", "-"
    )
    rows = json.loads(out)["rows"]
    np.testing.assert_allclose([row["line"] for row in rows], [2500, 3100.5], atol=1e-6)
    np.testing.assert_allclose([row["sample"] for row in rows], [2000, 4000], atol=1e-6)
    assert [row["status"] for row in rows] == ["inside the domain"] * 2


def test_the_ground_that_locate_wrote_is_projected(tmp_path, run):
    """Its lines and pixels, of another model, are not taken for positions to be located."""
    write_rpc(tmp_path / "a.txt", RPC)
    true = table_of(RPC, (3, 3, 2))
    names = ("line", "pixel", "X", "Y", "Z", "longitude", "latitude", "height", "status")
    rows = [
        (line + 7, sample - 3, 0.0, 0.0, 0.0, np.degrees(east), np.degrees(north), h, "on ground")
        for east, north, h, line, sample in np.array(true).T
    ]
    write_csv(tmp_path / "located.csv", names, rows)
    status, out, _ = run(
        "apply", tmp_path / "a.txt", "--points", tmp_path / "located.csv", "--json", "-"
    )
    found = json.loads(out)["rows"]
    assert status == 0
    np.testing.assert_allclose([row["line"] for row in found], true.line, atol=1e-6)
    np.testing.assert_allclose([row["sample"] for row in found], true.sample, atol=1e-6)


def test_a_bias_is_removed(tmp_path, run):
    write_rpc(tmp_path / "a.txt", RPC)
    true = table_of(RPC, (3, 3, 2))
    rng = np.random.default_rng(0)
    measured = true._replace(
        line=true.line + 4 + 0.1 * rng.normal(size=18), sample=true.sample - 9
    )
    control = write_table(tmp_path / "control.csv", measured)
    status, out, err = run(
        "compensate", tmp_path / "a.txt", "--control", control, "--out", tmp_path / "b.txt",
        "--sigma", 0.1, "--json", "-",
    )  # fmt: skip
    told = json.loads(out)
    assert status == 0 and told["redundancy"] == 34 and len(told["rows"]) == 18
    assert abs(told["line_shift"] - 4) < 4 * told["s_line_shift"] < 0.5
    assert told["sample_shift"] == pytest.approx(-9, abs=1e-9)
    shifted = RpcTable(*true[:3], true.line + told["line_shift"], true.sample - 9)
    assert check_rpc(read_rpc(tmp_path / "b.txt"), shifted).largest.max() < 1e-6


@pytest.mark.parametrize("sigma, residuals_said", [(None, False), (0.02, True), (0.12, False)])
def test_contradicted_sigma_and_stated_errors_are_said(tmp_path, run, sigma, residuals_said):
    """Of a shift of 4 lines, σ of the prior are an error of the ground of 2 m, projected."""
    write_rpc(tmp_path / "a.txt", RPC, StatedErrors(bias=2.0))
    true, noise = table_of(RPC, (3, 3, 2)), 0.1 * np.random.default_rng(0).normal(size=(2, 18))
    measured = true._replace(line=true.line + 4 + noise[0], sample=true.sample + noise[1])
    control = write_table(tmp_path / "control.csv", measured)
    given = "compensate", tmp_path / "a.txt", "--control", control, "--out", tmp_path / "b.txt"
    status, out, err = run(
        *given, "--json", "-", *(["--sigma", sigma] if sigma is not None else [])
    )
    told = json.loads(out)
    residuals = f"control.csv: residuals are {told['sigma0']:.3g} times as large as --sigma"
    assert status == 0 and (residuals in err) == residuals_said
    place = np.radians([12.3, -23.4])
    metre = 1 / (6378137 * np.array([np.cos(place[1]), 1]))  # of a sphere
    steps = np.array([[0, 0], [metre[0], 0], [0, metre[1]]])
    lines = np.asarray(project_points(RPC, *(place + steps).T, np.full(3, 400.0))[0])
    of_measurement = (1.0 if sigma is None else sigma) / np.sqrt(18)
    ratio = told["line_shift"] / np.hypot(2 * np.hypot(*(lines[1:] - lines[0])), of_measurement)
    said = re.search(r"a.txt: beyond the errors that it states .*line shift \((.*) σ\);", err)
    assert float(said[1]) == pytest.approx(ratio, rel=0.01) and "sample shift" not in err


def test_exchanged_lines_and_samples_are_refused_as_by_refine(tmp_path, run):
    """Where both are within the domain of the coefficients."""
    square = made_up(longitude_offset=12.3, line_offset=2500.0, line_scale=2501.0)
    write_rpc(tmp_path / "a.txt", square)
    true = table_of(square, (3, 3, 2))
    exchanged = true._replace(line=true.sample, sample=true.line)
    control = write_table(tmp_path / "control.csv", exchanged)
    out = tmp_path / "b.txt"
    status, _, err = run("compensate", tmp_path / "a.txt", "--control", control, "--out", out)
    assert status == 2 and "control.csv: line and sample seem to be exchanged: " in err
    assert len(err.splitlines()) == 1 and not out.exists()


def test_check_points_snooping_maps_and_heights_above_the_geoid(tmp_path, run):
    """The same control in a map system with heights above a geoid, two points of it for checks and
    one with a blunder, gives the bias of the good ones."""
    import rasterio
    from pyproj import Transformer

    write_rpc(tmp_path / "a.txt", RPC)
    true = table_of(RPC, (3, 3, 2))
    rng = np.random.default_rng(0)
    measured = true._replace(line=true.line + 4 + 0.1 * rng.normal(size=18),
                             sample=true.sample - 9 + 0.1 * rng.normal(size=18))  # fmt: skip
    measured.line[7] += 3.0
    degrees = np.degrees(true.longitude), np.degrees(true.latitude)
    zone = 32601 + int((degrees[0][0] + 180) // 6) + (100 if degrees[1][0] < 0 else 0)
    x, y = Transformer.from_crs("EPSG:4326", f"EPSG:{zone}", always_xy=True).transform(*degrees)
    # N = 30 m + 2 m a degree of longitude
    west, north = np.floor(degrees[0].min()) - 1, np.ceil(degrees[1].max()) + 1
    N = lambda longitude: 30 + 2 * (longitude - west)
    with rasterio.open(tmp_path / "geoid.tif", "w", driver="GTiff", width=41, height=41, count=1,
                       dtype="float64", crs="EPSG:4326",
                       transform=rasterio.Affine(0.1, 0, west, 0, -0.1, north)) as to:  # fmt: skip
        to.write(np.tile(N(west + 0.05 + 0.1 * np.arange(41)), (1, 41, 1)))
    rows = ["x,y,height,line,sample,id,role"]
    for k in range(18):
        role = "check" if k in (3, 11) else "control"
        values = x[k], y[k], true.height[k] - N(degrees[0][k]), measured.line[k], measured.sample[k]
        rows.append(",".join(map(repr, map(float, values))) + f",P{k},{role}")
    (tmp_path / "control.csv").write_text("\n".join(rows))
    given = ("compensate", tmp_path / "a.txt", "--control", tmp_path / "control.csv", "--out",
             tmp_path / "b.txt", "--sigma", 0.1, "--crs", f"EPSG:{zone}", "--geoid",
             tmp_path / "geoid.tif", "--json", "-")  # fmt: skip
    status, out, err = run(*given, "--snooping", "pope")
    told = json.loads(out)
    assert status == 0, err
    roles = {row["id"]: row["role"] for row in told["rows"]}
    assert [id for id, role in roles.items() if role == "removed"] == ["P7"]
    assert (told["control_points"], told["removed_points"], told["check_points"]) == (15, 1, 2)
    good = np.array([k for k in range(18) if roles[f"P{k}"] == "control"])
    # a shift: the mean of the differences of the good control points
    mean = np.mean(measured.line[good] - true.line[good])
    assert told["line_shift"] == pytest.approx(mean, abs=1e-6)
    check = np.array([3, 11])
    rms = np.sqrt(np.mean((true.line[check] + mean - measured.line[check]) ** 2))
    assert told["check_rms_line"] == pytest.approx(rms, abs=1e-6)
    assert told["rows"][3]["w_line"] is None and told["rows"][7]["v_line"] < -2.5
    status, out, _ = run(*given)
    assert json.loads(out)["removed_points"] == 0
    # a check point measured in another image
    values = rows[4].split(",")
    away = ",".join([*values[:3], "1e7", *values[4:]])
    for old, new, words in (
        ("P3,check", "P3,chek", "control or check"), (",control", ",check", "no control point"),
        (rows[4], away, "line 5: line 10000000 is outside"),
    ):  # fmt: skip
        content = "\n".join(rows).replace(old, new)
        (tmp_path / "control.csv").write_text(content)
        status, _, err = run(*given)
        assert status == 2 and words in err
    with_heights = [f"EPSG:{zone}+5773" if a == f"EPSG:{zone}" else a for a in given]
    (tmp_path / "control.csv").write_text("\n".join(rows))
    status, _, err = run(*with_heights)
    assert status == 2 and "has a system of heights" in err


def test_what_is_refused(tmp_path, run):
    write_rpc(tmp_path / "a.txt", RPC)
    table = write_table(tmp_path / "few.csv", table_of(RPC, (3, 3, 3)))
    (tmp_path / "far.csv").write_text("longitude,latitude\n1,2\n")
    rpc, out = tmp_path / "a.txt", tmp_path / "out.txt"
    cases = [
        (["fit", table, "--out", out], ["few.csv", "27 points"]),
        (["fit", tmp_path / "no.toml", "--out", out], ["no.toml"]),
        (["apply", rpc, "--points", tmp_path / "far.csv"], ["far.csv", "'height' is missing"]),
        (["compensate", rpc, "--control", table, "--out", out, "--model", "cubic"], ["'cubic'"]),
        (["fit", write_scanner(tmp_path), "--out", out, "--heights", "9"], ["--heights '9'"]),
    ]
    for arguments, words in cases:
        status, said, err = run(*arguments)
        assert status == 2 and said == "" and len(err.splitlines()) == 1, err
        for word in words:
            assert word in err
        assert not out.exists()
