"""The refine file and command: round trips, and errors reported with their row."""

import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from page_reader import Page, column
from refinement_scenes import (
    COUNT,
    FREEDOM,
    ground_with_sine,
    measured,
    satellite,
    spread,
)
from typer.testing import CliRunner

from jaxbundle.cli.app import app
from jaxbundle.cli.pushbroom import refine as _refine  # noqa: F401
from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import WGS84, geodetic
from jaxbundle.io.scanner.read import read_scanner
from jaxbundle.io.scanner.refinement import read_refinement
from jaxbundle.io.scanner.writing import write_scanner_image
from jaxbundle.io.text.csv_tables import read_csv, write_csv
from jaxbundle.pushbroom.image import pose_at
from jaxbundle.pushbroom.image_to_ground import locate_lines
from jaxbundle.pushbroom.scanner import AnglePolynomial, AngleTable
from jaxbundle.pushbroom.surfaces import Height
from jaxbundle.refinement import Freedom, refine
from jaxbundle.refinement.freedom import change_image, change_of, make_form
from jaxbundle.refinement.refined_image import refined_image

TEXT = """
[refine]
points = "points.csv"
observations = "observations.csv"
sigma = 0.3
snooping = "baarda"

[images]
A = "A.toml"

[unknowns]
attitude = "free"
attitude_rate = "free"
jitter = [0.00222222222222, 0.00222222222222, "held"]
knot_spacing = 0.25
"""
ROWS = {"points": ("id", "role", "longitude", "latitude", "height"),
        "observations": ("image", "point", "line", "pixel")}  # fmt: skip


@pytest.fixture
def folder(tmp_path):
    write_refinement(tmp_path)
    return tmp_path


def write_refinement(folder):
    """A refinement as files: an image with bias and jitter, 40 control points."""
    rng = np.random.default_rng(5)
    places, heights = spread(rng)
    bias, amplitude = np.array([1e-4, -1.5e-4, 4e-4]), np.array([4e-5, 2e-5, 0.0])
    X = ground_with_sine(satellite(), bias, np.zeros(3), amplitude, heights, places)
    write_scanner_image(folder, "A", satellite(), WGS84)
    longitude, latitude, h = (np.asarray(v) for v in geodetic(WGS84, tuple(np.asarray(X).T)))
    table = zip(np.degrees(longitude).tolist(), np.degrees(latitude).tolist(), h.tolist())
    write(folder, "points", [(f"P{k}", "control", *row) for k, row in enumerate(table)])
    seen = measured(places, rng).xy.tolist()
    write(folder, "observations", [("A", f"P{k}", *row) for k, row in enumerate(seen)])
    (folder / "refine.toml").write_text(TEXT)


def write(folder, name, rows):
    write_csv(folder / f"{name}.csv", ROWS[name], rows)


def changed_cell(folder, name, row, column, value):
    """One cell of a table replaced; the header is line 1."""
    table = read_csv(folder / f"{name}.csv")
    rows = [list(r) for r in zip(*table.values.values())]
    rows[row][ROWS[name].index(column)] = value
    write(folder, name, rows)


def test_the_command_writes_what_locate_reads(folder):
    run = CliRunner().invoke(app, [
        "pushbroom", "refine", str(folder / "refine.toml"), "--out", str(folder / "out"),
    ])  # fmt: skip
    assert run.exit_code == 0, run.output
    assert "pitch bias of image A" in run.output
    result = json.loads((folder / "out" / "result.json").read_text())
    assert 0.7 < result["sigma0"] < 1.3
    assert len(result["image_points"]) == COUNT
    points = read_csv(folder / "out" / "points.csv")
    assert len(points) == COUNT and set(points.values["role"]) == {"control"}
    text, plain = ((folder / "out" / name).read_text() for name in ("report.html", "report.txt"))
    for words in ("refine.toml", "computed 20", "jaxbundle"):
        assert words in plain.splitlines()[0] and words in "".join(Page(text).texts["p"])
    assert Page(text).texts["h2"][0] == "Verdict"
    assert f"verdict          {result['verdict']['words']}" in plain
    assert result["verdict"]["words"] in "".join(Page(text).texts["p"])
    v = np.array([row["v"] for row in result["image_points"]])
    np.testing.assert_allclose(column(text, "observations", "v").reshape(-1, 2), v, rtol=1e-6)
    assert set(column(text, "observations", "axis")) == {"line", "pixel"}
    given = read_csv(folder / "observations.csv").values["pixel"]
    across = column(text, "observations", "measured").reshape(-1, 2)[:, 1]
    np.testing.assert_allclose(across, np.array(given, float), rtol=1e-6)
    covered = column(text, "points", "sX")
    np.testing.assert_allclose(covered, [float(s) for s in points.values["sX"]], rtol=1e-5)
    image, given = (read_scanner(folder / p / "A.toml").image for p in ("out", ""))
    pitch = {row["name"]: row["change"] for row in result["unknowns"]}["pitch bias"]
    assert abs(pitch - np.degrees(1e-4) * 3600) < 10
    # the attitude differs by what was injected, to what 40 points determine
    for t in (0.6, 1.4, 2.2):
        R, R0 = (np.asarray(pose_at(one, t).R) for one in (image, given))
        turn = (R0.T @ R)[[2, 0], [1, 2]]
        sine = np.sin(2 * np.pi * t)
        assert np.abs(turn - [1e-4 + 4e-5 * sine, -1.5e-4 + 2e-5 * sine]).max() < 2.5e-5


@pytest.mark.parametrize("kind", ["focal", "polynomial", "table"])
def test_a_refined_image_is_read_as_it_was(tmp_path, kind):
    """Poses and slopes of every kind of optics, after writing and reading, as changed."""
    image = satellite()
    u = np.arange(800.0)
    if kind == "polynomial":
        optics = AnglePolynomial(jnp.array([0.0, 0.016, 1e-6]), jnp.array([1e-5]),
                                 jnp.asarray(380.0), jnp.asarray(300.0))  # fmt: skip
        image = eqx.tree_at(lambda i: i.optics, image, optics)
    elif kind == "table":
        image = eqx.tree_at(
            lambda i: i.optics, image, AngleTable(jnp.asarray((u - 400) * 4e-5), jnp.zeros(800))
        )
    look = (1e-6,) * 3 if kind != "focal" else ()
    freedom = Freedom(jitter=FREEDOM.jitter, look_across=look, look_along=look)
    form = make_form(image, WGS84, freedom)
    p = 1e-5 * np.random.default_rng(1).normal(size=sum(form.sizes))
    change = change_of(form.sizes, jnp.asarray(p))
    new = refined_image(image, form, change)
    read = read_scanner(write_scanner_image(tmp_path, "new", new, WGS84)).image
    assert type(read.optics) is type(image.optics)
    t, pixel = jnp.array([0.011, 1.234, 2.718]), jnp.array([0.0, 333.0, 799.0])

    @jax.jit
    @jax.vmap
    def both(t, pixel):
        of = read, change_image(image, form, change, t)
        return tuple(pose_at(one, t) for one in of), tuple(one.optics.slopes(pixel) for one in of)

    (got, true), slopes = both(t, pixel)
    for one, other in zip(got, true):
        assert np.allclose(one, other, rtol=2e-9, atol=2e-9)
    assert np.allclose(*slopes, atol=1e-12)


WRONG = [
    ("observations", 3, "line", 905.0, r"line 5: point 'P3' in image 'A': line 905 is off"),
    ("observations", 3, "pixel", -2.0, r"line 5: .*pixel -2 is off the image"),
    ("observations", 7, "point", "P99", r"line 9: point 'P99' is unknown"),
    ("observations", 7, "image", "B",
     r"line 9: image 'B' is unknown: no such image in .*refine.toml, \[images\]$"),
    ("observations", 7, "image", "a",
     r"line 9: image 'a' is unknown: no such image in .*, \[images\]; did you mean 'A'\?$"),
    ("observations", 7, "point", "P6", r"line 9: point 'P6' in image 'A' is measured twice"),
    ("observations", 7, "line", "x", r"line 9: line is 'x'"),
    ("points", 2, "role", "gcp", r"line 4: role 'gcp'; expected one of control, tie, check"),
    ("points", 2, "id", "P1", r"line 4: point 'P1' occurs twice"),
    ("points", 2, "height", "", r"line 4: control point 'P2' needs all coordinates"),
    ("points", 2, "latitude", 95.0, r"line 4: latitude 95 is beyond the pole"),
    ("points", 2, "longitude", 3.0, r"line 4: .*control point 'P2' of .*points.csv, line 4 is off"),
]


@pytest.mark.parametrize("name,row,column,value,message", WRONG)
def test_wrong_cells_are_told_with_file_and_row(folder, name, row, column, value, message):
    changed_cell(folder, name, row, column, value)
    with pytest.raises(InputError, match=message):
        file = read_refinement(folder / "refine.toml")
        refine(*file[:4])


@pytest.mark.parametrize("old,new,message", [
    ('attitude = "free"', 'atitude = "free"', "did you mean 'attitude'"),
    ('attitude = "free"', 'attitude = "loose"', "'loose'; expected \"free\", \"held\" or a prior"),
    ('attitude = "free"', "attitude = [1, 2]", "one value or three"),
    ("knot_spacing = 0.25", "knot_spacing = 0", "must be positive"),
    ('"baarda"', '"barda"', "did you mean 'baarda'"),
    ("[unknowns]", "[unknowns.B]\nposition = 1.0\n[unknowns]", r"\[unknowns.B\]: no such image"),
    ('A = "A.toml"', 'A = "C.toml"', "no such file"),
])  # fmt: skip
def test_wrong_settings_are_told_with_file_and_key(folder, old, new, message):
    (folder / "refine.toml").write_text(TEXT.replace(old, new))
    with pytest.raises(InputError, match=message) as error:
        read_refinement(folder / "refine.toml")
    assert ".toml" in str(error.value)


@pytest.mark.parametrize("old,new,message", [
    ("0.25", "0.001", r"'A': knot_spacing = 0.001 s makes 3000 .* 3 s, with 40 .*0.0075 s"),
    ('0.00222222222222, "held"]\nknot_spacing = 0.25', '"free", "held"]\nknot_spacing = 0.05',
     "60 knots .* give 0.075 s at least, or the jitter a prior"),
])  # fmt: skip
def test_more_knots_than_points_can_tell_of(folder, old, new, message):
    assert old in TEXT
    (folder / "refine.toml").write_text(TEXT.replace(old, new))
    file = read_refinement(folder / "refine.toml")
    with pytest.raises(InputError, match=message):
        refine(file.images, file.points, file.observations)


def test_a_line_outside_the_tables_is_told_with_its_time(folder):
    """The table reaches over all lines, but not to the lower edge of the last."""
    table = read_csv(folder / "A_attitude.csv")
    rows = [list(map(float, r)) for r in zip(*table.values.values())]
    last = [899.1 / 300, *rows[-1][1:]]
    write_csv(folder / "A_attitude.csv", list(table.values), [*rows[:2], last])
    changed_cell(folder, "observations", 39, "line", 899.4)
    file = read_refinement(folder / "refine.toml")
    with pytest.raises(InputError, match=r"line 41: point 'P39'.*outside the table of attitude"):
        refine(*file[:4])


@pytest.mark.further
def test_nothing_free_and_nothing_measured(folder):
    (folder / "refine.toml").write_text(TEXT.split("[unknowns]")[0] + "[unknowns]\n")
    file = read_refinement(folder / "refine.toml")
    with pytest.raises(InputError, match="every unknown is held"):
        refine(*file[:4])


@pytest.mark.further
def test_refined_images_as_model_states(folder):
    """Read back, a state sees the ground of the refined scanner file."""
    (folder / "refine.toml").write_text(TEXT.replace("[images]", "csm_states = true\n[images]"))
    run = CliRunner().invoke(app, [
        "pushbroom", "refine", str(folder / "refine.toml"), "--out", str(folder / "out"),
    ])  # fmt: skip
    assert run.exit_code == 0, run.output
    one, other = (read_scanner(folder / "out" / name).image for name in ("A.toml", "A.json"))
    lines, pixels = np.arange(0.0, 600, 37), np.arange(0.0, 400, 31)
    X = [np.asarray(locate_lines(i, Height(500.0), lines, pixels)) for i in (one, other)]
    off = float(np.linalg.norm(X[0] - X[1], axis=0).max())
    told = [line for line in run.output.splitlines() if "model state" in line]
    # the lens of the scene has a distortion of degree 7, which a state cannot contain: it is told
    stated = float(told[0].split("up to ")[1].split(" m")[0]) if told else 3e-3
    assert off < 1.5 * stated + 1e-6
    (folder / "refine.toml").write_text(TEXT.replace("[images]", "csm_states = 1\n[images]"))
    with pytest.raises(InputError, match="csm_states is 1; expected true or false"):
        read_refinement(folder / "refine.toml")
