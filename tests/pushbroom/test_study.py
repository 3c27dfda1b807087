"""The table of trajectories and accuracies against the closed form and the theory of its floor."""

import dataclasses
import json
import sys
from pathlib import Path

import numpy as np
import pytest

from jaxbundle import cli
from jaxbundle.cli.pushbroom.accuracy_table import table_of, write_table
from jaxbundle.io.scanner.flight import read_flight
from jaxbundle.pushbroom.error_propagation import ground_errors
from jaxbundle.pushbroom.flight import measured_image, true_image
from jaxbundle.pushbroom.noise import Noise
from jaxbundle.pushbroom.study import TRAJECTORIES
from jaxbundle.pushbroom.surfaces import Ground

FLIGHT = Path(__file__).parents[2] / "examples" / "lapan_a3" / "flight.toml"
DRAWS = 600
HEIGHT, DEGREE = 650e3, np.pi / 180


@pytest.fixture(scope="module")
def table():
    return table_of(FLIGHT, "bias", "0.01,0.1", DRAWS, 0, None)


@pytest.mark.further
def test_what_the_table_states(table):
    assert abs(table.altitude / HEIGHT - 1) < 1e-3
    np.testing.assert_allclose(table.field_of_view, 2 * np.arctan(1000 * 0.065 / 700))


@pytest.mark.further
def test_errors_follow_the_closed_form(table):
    """RMS = h·√[(1 + 2V²/3 + V⁴/5)·σr² + σp² + V²/3·σy²]; drawn within three of its own σ."""
    V = 1000 * 0.065 / 700
    per_radian = HEIGHT * np.sqrt(2 + V**2 + V**4 / 5)
    assert len(table.erring) == 8
    for cell in table.erring:
        assert cell.sigma in (pytest.approx(0.01 * DEGREE), pytest.approx(0.1 * DEGREE))
        np.testing.assert_allclose(cell.closed_rms, per_radian * cell.sigma, rtol=1e-3)
        # the Earth is curved, and the camera looks up to 1.4° beside the nadir
        np.testing.assert_allclose(cell.propagated_rms, cell.closed_rms, rtol=2e-3)
        # the errors of one draw are alike all over the image: two normal numbers a draw
        np.testing.assert_allclose(cell.drawn_rms, cell.propagated_rms, rtol=3 / 2 / DRAWS**0.5)
        # 90 % of a chi-square of two: r = √(2·ln 10)·σ, σ = RMS/√2
        np.testing.assert_allclose(cell.closed_ce90, cell.closed_rms * np.sqrt(np.log(10)))
        np.testing.assert_allclose(cell.propagated_ce90, cell.closed_ce90, rtol=2e-3)
        # f(r) = 2r/RMS²·exp(−r²/RMS²), so that the quantile has σ = √(0.9·0.1/draws)/f
        density = 2 * np.sqrt(np.log(10)) / 10
        limit = 3 * np.sqrt(0.09 / DRAWS) / density / np.sqrt(np.log(10))
        np.testing.assert_allclose(cell.drawn_ce90, cell.propagated_ce90, rtol=limit)


def test_the_floor_without_errors(table):
    """Linear: h·ÿ·Δ²/8·√(8/15), on average over the swing, as published; spline: below 1 cm."""
    rms = {(cell.trajectory, cell.interpolation): cell.rms for cell in table.error_free}
    curvature = DEGREE * (2 * np.pi / 135) ** 2 / np.sqrt(2)
    expected = HEIGHT * curvature * 0.25**2 / 8 * np.sqrt(8 / 15)
    for name in ("roll", "pitch"):
        np.testing.assert_allclose(rms[name, "linear"], expected, rtol=0.03)
    # yaw swings by 5.5°, and moves only the ends of the line
    lever = 5.5 * 1000 * 0.065 / 700 / np.sqrt(3)
    np.testing.assert_allclose(rms["yaw", "linear"], expected * lever, rtol=0.05)
    published = {"roll": 0.099, "pitch": 0.099, "yaw": 0.029, "3 axes": 0.144}
    for name, metres in published.items():
        assert abs(rms[name, "linear"] - metres) < 0.005
    assert max(rms[name, "spline"] for name in TRAJECTORIES) < 0.01


def test_noise_of_the_instruments():
    """White noise of 0.01° in the rows moves the ground by about h·σ along each axis."""
    noise = Noise(attitude_white=np.array([0.01, 0.01, 0.0]) * DEGREE)
    flight = dataclasses.replace(read_flight(FLIGHT).flight, angles={}, noise=noise)
    places = np.linspace(0, 3999, 78), np.full(78, 999.5)
    of = lambda: ground_errors(measured_image(flight), true_image(flight), Ground(), *places)
    errors = of()
    rms = np.sqrt(np.mean(np.sum(errors**2, 1)))
    # 40 rows: the sample's own spread; linear interpolation leaves 2/3 of the variance
    assert abs(rms / (HEIGHT * 0.01 * DEGREE * np.sqrt(2 * 2 / 3)) - 1) < 0.25
    np.testing.assert_array_equal(errors, of())


def test_the_table_in_words_and_as_data(table, tmp_path, capsys):
    write_table(table, None, "")
    said = capsys.readouterr().out
    assert "altitude 650" in said and "field of view 10.61" in said and f"{DRAWS} draws" in said
    line = next(line for line in said.splitlines() if line.startswith("0.1°, propagated"))
    cells = [c for c in table.erring if c.sigma > 0.05 * DEGREE]
    np.testing.assert_allclose(
        [float(v) for v in line.split()[2:]], [c.propagated_rms for c in cells], atol=0.006
    )
    write_table(table, tmp_path / "table.csv", "")
    assert len((tmp_path / "table.csv").read_text().splitlines()) == 1 + 8 + 8
    write_table(table, None, "-")
    told = json.loads(capsys.readouterr().out)
    assert told["kind"] == "bias" and len(told["rows"]) == 16
    assert told["rows"][-1]["propagated_rms"] == table.erring[-1].propagated_rms


@pytest.mark.parametrize("options, words", [
    (["--table", "drift"], ["'drift'", "bias, white"]),
    (["--table", "bias", "--levels", "0,1"], ["--levels '0,1'", "0.01,0.1"]),
    (["--table", "bias", "--dem", "x.tif"], ["--dem", "--height"]),
    (["--table", "bias", "--attitude-white", "5"], ["--attitude-white", "--table"]),
])  # fmt: skip
def test_what_is_refused(monkeypatch, capsys, options, words):
    monkeypatch.setattr(sys, "argv", ["jaxbundle", "pushbroom", "accuracy", str(FLIGHT), *options])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    err = capsys.readouterr().err
    assert ended.value.code == 2 and all(word in err for word in words), err
