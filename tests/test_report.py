"""The report gives the computed values, to significant digits, and nothing else."""

import dataclasses
import json
import re
from types import SimpleNamespace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbundle import report
from jaxbundle.adjustment.quality.check_points import CheckPoints
from jaxbundle.adjustment.result import Adjustment
from jaxbundle.cameras import FAMILIES, MODEL_NAMES, get_model
from jaxbundle.cli.outputs import write_targets
from jaxbundle.io.results.result_json import result_dict
from jaxbundle.leastsquares.iterations.stopping import LIMIT, NOT_FINITE, STUCK
from jaxbundle.leastsquares.quality.names import Name
from jaxbundle.network.blunders import Removed
from jaxbundle.network.columns import count
from jaxbundle.network.tables import EXTERIOR, Camera
from jaxbundle.report import head, layout, observations, unknowns
from jaxbundle.report.camera_equations import EQUATIONS, camera_equations

SECTIONS = (
    "Counts",
    "Convergence",
    "Variance factor",
    "Camera cam",
    "Images: exterior orientation in model and rad",
    "Points: precision",
    "Points: coordinates in model",
    "Residuals with |τ| > 3",
    "Normalised residuals τ",
    "Redundancy numbers",
    "Variance components",
)


@pytest.fixture(scope="module")
def text(convergent4):
    return convergent4.report(date="2024-05-02")


def again(adjustment, network=None, problem=None, minimum=None, **changes):
    """The same result with modifications."""
    problem = problem or adjustment.problem
    if network is not None:
        problem = dataclasses.replace(problem, network=network)
    return Adjustment(problem.network, problem, minimum or adjustment.minimum, **changes)


def section(text: str, title: str) -> list[str]:
    lines = text.splitlines()
    start = lines.index(title)
    assert set(lines[start + 1]) == {"-"}
    end = next(
        (i for i in range(start + 2, len(lines) - 1) if set(lines[i + 1]) == {"-"}),
        len(lines),
    )
    return [line for line in lines[start + 2 : end] if line]


def rows(lines, first: str):
    """The words of the rows under a table's header."""
    start = next(i for i, line in enumerate(lines) if line.split()[:1] == [first])
    return [line.split() for line in lines[start + 1 :]]


def assert_plain(text: str) -> None:
    assert all(len(line) <= layout.WIDTH for line in text.splitlines())
    assert "\t" not in text and "\x1b" not in text and "nan" not in text


# --- the whole ------------------------------------------------------------------------------


def test_every_section_is_there_in_order(text):
    lines = text.splitlines()
    places = [lines.index(title) for title in SECTIONS]
    assert places == sorted(places)


def test_layout_of_the_page(text):
    assert_plain(text)
    assert text.endswith("\n") and not text.endswith("\n\n")
    assert all(line == line.rstrip() for line in text.splitlines())


def test_date_only_when_given(convergent4, text):
    assert text.splitlines()[0].endswith("2024-05-02")
    plain = convergent4.report()
    assert plain == convergent4.report()
    assert plain.splitlines()[1:] == text.splitlines()[1:]


def test_published_figures(text):
    assert "0.63128 µm = 0.00063128 mm" in text
    assert re.search(r"^Redundancy +23 ", text, re.M)
    assert re.search(r"^Unknowns +64 .*24.*10.*30$", text, re.M)
    assert re.search(r"^c +18\.5280 +0\.0453 ", text, re.M)
    assert re.search(r"^x0 +0\.2834 +0\.0384 ", text, re.M)
    assert re.search(r"^K1 +2\.272e-04 +4\.76e-05 ", text, re.M)
    assert "defect 7" in text and "1 mm is a unit of weight" in " ".join(text.split())
    assert "a posteriori" in text


def test_insignificant_parameters_are_marked(text):
    table = [row for row in rows(section(text, "Camera cam"), "parameter")][:10]
    assert {row[0] for row in table if row[4] == "no"} == {"y0", "K2", "K3", "P1", "P2", "b1", "b2"}
    assert {row[0] for row in table if row[4] == "yes"} == {"c", "x0", "K1"}


def test_camera_table_and_correlations(convergent4, text):
    lines = section(text, "Camera cam")
    entry = convergent4.cameras["cam"]
    for name, value, sigma, t, _, total in rows(lines, "parameter")[:10]:
        given = entry["parameters"][name]
        assert float(sigma) == pytest.approx(given["sigma"], rel=6e-3)
        assert abs(float(value) - given["value"]) < 0.01 * given["sigma"]
        assert float(t) == pytest.approx(given["t"], rel=6e-3)
        assert float(total) == pytest.approx(100 * given["total_correlation"], abs=0.06)
    start = lines.index("Correlations in %")
    for i, line in enumerate(lines[start + 2 : start + 12]):
        name, *cells = line.split()
        assert name == entry["free"][i]
        np.testing.assert_allclose(
            [float(cell) for cell in cells], 100 * entry["correlations"][i, : i + 1], atol=0.51
        )


def test_rms_of_points_and_images_is_that_of_their_residuals(convergent4):
    rows = convergent4.residuals
    for thing, table in (("point", convergent4.points), ("image", convergent4.images)):
        for id, rms in zip(table["id"], table["rms"]):
            v = rows["v"][(rows["kind"] == "image") & (rows[thing] == id)]
            assert rms == pytest.approx(np.sqrt(np.mean(v**2)), rel=1e-12)


def test_points_and_images_are_those_of_the_tables(convergent4, text):
    table = convergent4.points
    found = rows(section(text, "Points: coordinates in model"), "point")
    assert [row[0] for row in found] == list(table["id"])
    for i, (_, role, *cells) in enumerate(found):
        assert role == table["role"][i]
        for name, cell in zip(("X", "Y", "Z", "sX", "sY", "sZ", "rays"), cells):
            assert float(cell) == pytest.approx(table[name][i], abs=0.51 * unit_of(cell))
    images = convergent4.images
    found = rows(section(text, SECTIONS[4]), "image")
    for i, (values, sigma) in enumerate(zip(found[::2], found[1::2])):
        assert values[0] == images["id"][i] and sigma[0] == "σ"
        for name, value, s in zip(EXTERIOR, values[1:], sigma[1:]):
            assert float(value) == pytest.approx(images[name][i], abs=0.51 * unit_of(value))
            assert float(s) == pytest.approx(images[f"s{name}"][i], abs=0.51 * unit_of(s))
            assert unit_of(s) == unit_of(value)
        assert float(values[-1]) == pytest.approx(1e3 * images["rms"][i], abs=1e-3)


def unit_of(cell: str) -> float:
    return 10.0 ** -len(cell.partition(".")[2])


def test_precision_summary(convergent4, text):
    lines = section(text, "Points: precision")
    found = {row[0]: row[1:] for row in map(str.split, lines)}
    s = np.stack([convergent4.points[f"s{axis}"] for axis in "XYZ"], 1)
    for name, value in (
        ("median", np.median(s, 0)), ("95", np.quantile(s, 0.95, 0)), ("max", s.max(0)),
        ("min", s.min(0)),
    ):  # fmt: skip
        found[name] = [cell for cell in found[name] if cell != "%"]
        np.testing.assert_allclose([float(x) for x in found[name][:3]], value, atol=6e-8)
    counted = np.array([[int(x) for x in found[name]] for name in CLASSES])
    assert (counted.sum(0) == [10, 10, 10, 30]).all()
    assert (counted[:, :3].sum(1) == counted[:, 3]).all()


CLASSES = ("0–0.1", "0.1–0.5", "0.5–1", "1–2", "2–4", "4–∞")


def test_classes_in_a_length_of_ones_own(convergent4):
    lines = section(convergent4.report(accuracy_unit=1e-4), "Points: precision")
    s = np.concatenate([convergent4.points[f"s{axis}"] for axis in "XYZ"])
    found = {row[0]: row[1:] for row in map(str.split, lines)}
    expected = np.histogram(s / 1e-4, (0, 0.1, 0.5, 1, 2, 4, np.inf))[0]
    assert [int(found[name][3]) for name in CLASSES] == expected.tolist()


@pytest.mark.parametrize("test,column,limit", [("pope", "tau", 1.5), ("baarda", "w", 1e-3)])
def test_residuals_over_the_limit_are_sorted(convergent4, test, column, limit):
    text = convergent4.report(limit, test=test)
    symbol = {"pope": "τ", "baarda": "w"}[test]
    found = rows(section(text, f"Residuals with |{symbol}| > {limit:g}"), "kind")
    size = np.abs(convergent4.residuals[column])
    over = [row for row in found if row[0] == "image"]
    assert len(over) == (size > limit).sum() > 3
    shown = [abs(float(row[{"tau": 9, "w": 8}[column]])) for row in over]
    np.testing.assert_allclose(shown, np.sort(size)[::-1][: len(over)], rtol=6e-3)


def test_an_unknown_test_is_refused(convergent4):
    with pytest.raises(ValueError, match="pope"):
        convergent4.report(test="student")


def test_histogram_counts_every_observation(text):
    lines = section(text, "Normalised residuals τ")
    counts = [re.search(r"(\d+) +([\d.]+)(?: +#+)?$", line) for line in lines[1:19]]
    assert sum(int(c.group(1)) for c in counts) == 80
    assert sum(float(c.group(2)) for c in counts) == pytest.approx(80, abs=0.5)


def test_long_lists_are_cut_and_say_so(convergent4):
    text = convergent4.report(max_rows=3)
    assert "… and 7 other points: all 10 are in points.csv." in text
    assert "… and 1 other image: all 4 are in images.csv." in text


# --- what only some networks have -----------------------------------------------------------


def test_removed_and_eliminated(convergent4):
    changed = again(
        convergent4,
        removed=(Removed("image", 3, "point 7 in image DSC_037", 5.25),),
        eliminated=(Name("camera", "cam", "b2"),),
    )
    text = changed.report()
    assert re.search(r"^1 +image +point 7 in image DSC_037 +5\.25$", text, re.M)
    assert "b2 of camera cam" in text
    assert "1 removed observation" in str(changed) and "1 eliminated parameter" in str(changed)


def test_check_points(convergent4):
    found = CheckPoints(
        id=("101", "102"), position=np.arange(6.0).reshape(2, 3),
        difference=np.array([[1e-3, 2e-3, -2e-3], [-1e-3, 0, 0]]),
        covariance=convergent4.sigma0**2 * np.stack([np.eye(3), 4 * np.eye(3)]),
        rays=np.array([3, 4]),
    )  # fmt: skip
    changed = again(convergent4)
    changed.check_points = found
    # given coordinates without σ: the verdict compares with the σ of both
    changed.check = (SimpleNamespace(sigma=np.full((2, 3), np.nan)), None)
    table = rows(section(changed.report(), "Check points: intersected − given, in model"), "point")
    assert [float(x) for x in table[0][1:4]] == [0.001, 0.002, -0.002]
    assert float(table[1][4]) == pytest.approx(2 * convergent4.sigma0, rel=6e-3)
    rms = next(row for row in table if row[0] == "RMS")
    np.testing.assert_allclose([float(x) for x in rms[1:4]], found.rms, atol=1e-6)


def test_distances():
    stub = SimpleNamespace(
        residuals={
            "kind": np.array(["image", "distance"], dtype=object),
            "image": np.array(["1", "A"], dtype=object),
            "point": np.array(["7", "B"], dtype=object),
            "v": np.array([0.0, 0.002]), "sigma": np.array([1.0, 0.001]),
            "r": np.array([0.5, 0.75]), "tau": np.array([0.0, 2.31]),
        },
        points={"id": np.array(["A", "B"], dtype=object)},
        point_values=np.array([[0.0, 0, 0], [3.0, 4.0, 0.0]]),
        sigma0=2.0,
        network=SimpleNamespace(object_unit="m"),
    )  # fmt: skip
    row = observations.distances(stub, 10)[-1].split()
    assert row[:2] == ["A", "B"]
    # 5 m adjusted, v = computed − observed, σ of the adjusted value σ0·σ·√(1 − r)
    assert [float(x) for x in row[2:]] == [4.998, 0.001, 5.0, 0.001, 0.002, 0.75, 2.31]


def test_many_cameras_are_one_table():
    parameter = lambda value, sigma: {"value": value, "sigma": sigma, "free": True}  # noqa: E731
    cameras = {
        str(i): {
            "model": "snavely",
            "parameters": {
                "f": parameter(500.0 + i, 0.5),
                "k1": parameter(-0.1, 1e-3),
                "k2": {"value": 0.0, "sigma": None, "free": False},
            },
        }
        for i in range(20)
    }
    lines = unknowns.cameras(
        SimpleNamespace(cameras=cameras, network=SimpleNamespace(cameras=[Camera("0", "snavely")]))
    )
    table = [line.split() for line in lines]
    assert ["7", "507.000", "-0.10000"] in table and ["σ", "0.500", "0.00100"] in table
    assert "k2" not in "\n".join(lines).split("px")[-1]


def test_without_redundancy_there_is_no_sigma(convergent4):
    counts = convergent4.counts
    counts = dataclasses.replace(counts, unknowns=counts.unknowns + counts.redundancy)
    problem = dataclasses.replace(convergent4.problem, counts=counts)
    changed = again(convergent4, problem=problem)
    text = changed.report()
    assert_plain(text)
    assert "no redundancy" in text and "no redundancy" in str(changed)
    assert_plain(str(changed))


@pytest.mark.further
def test_an_exact_fit_has_no_sigma(convergent4, tmp_path):
    """vᵀPv = 0: σ are 0, t infinite, τ unknown, correlations as ever; nothing divides by zero."""
    changed = again(convergent4)
    changed.__dict__["vtpv"] = 0.0
    assert changed.sigma0 == 0
    entry = changed.cameras["cam"]
    assert entry["parameters"]["c"]["t"] == np.inf and changed.insignificant() == []
    np.testing.assert_allclose(entry["correlations"], convergent4.cameras["cam"]["correlations"])
    assert np.isnan(changed.residuals["tau"]).all()
    assert_plain(str(changed))
    write_targets(changed, str(tmp_path / "r.json"), tmp_path / "out", brief=False, plots=True)
    assert_plain((tmp_path / "out" / "report.txt").read_text())
    told = json.loads((tmp_path / "r.json").read_text())
    assert told["sigma0"] == 0 and told["cameras"]["cam"]["parameters"]["c"]["t"] is None


def test_a_distortion_that_turns_back_is_warned_of(convergent4):
    """With K1 alone 1 + 3·K1·r² = 0 where it turns: at 4 mm, and measurements reach 7 mm."""
    values = convergent4.minimum.values
    model = get_model("brown")
    K1 = -1 / (3 * 4.0**2)
    p = [{"c": 18.5, "K1": K1}.get(name, 0.0) for name in model.parameters]
    turned = values | {"camera": jnp.asarray([p])}
    changed = again(convergent4, minimum=eqx.tree_at(
        lambda m: m.values, convergent4.minimum, turned
    ))  # fmt: skip
    # These residuals are so large that the camera is poorly determined too.
    (warning,) = (line for line in changed.warnings if not line.startswith("poorly determined"))
    assert "'cam'" in warning and "turns back" in warning and "a radius of 4 mm" in warning
    assert result_dict(changed, brief=True)["warnings"][-1] == warning
    assert f"{len(changed.warnings)} warning" in str(changed)
    assert convergent4.warnings == ()


def test_about_a_known_point_only_rotations_and_scale_are_open(convergent4):
    """dX = ω×(X − P) + s·(X − P): as a motion about the origin it has a shift, −ω×P − s·P."""
    problem = convergent4.problem
    points = problem.network.points
    P = points.position[0] - problem.origin
    shifts = np.column_stack([*(-np.cross(axis, P) for axis in np.eye(3)), -P])
    gauge = jnp.asarray(np.concatenate([shifts, np.eye(4)]))
    plan = eqx.tree_at(lambda plan: plan.datum.gauge, problem.plan, gauge)
    network = problem.network.replace(
        points=dataclasses.replace(points, role=("fixed", *points.role[1:]))
    )
    counts = dataclasses.replace(problem.counts, datum=4)
    problem = dataclasses.replace(problem, plan=plan, counts=counts)
    text = head.datum(again(convergent4, network, problem))
    assert "leave open rotation X, rotation Y, rotation Z, scale;" in text


def test_warnings_are_printed(convergent4):
    network = convergent4.problem.network.warn("left out 2 points without any ray: 8, 9")
    assert "- left out 2 points without any ray: 8, 9" in again(convergent4, network).report()


def test_equations_of_every_model():
    families = {name.partition("-N")[0] for name in FAMILIES}
    assert set(EQUATIONS) == {*MODEL_NAMES, *families}
    assert camera_equations(get_model("spline-6x5-90")) == EQUATIONS["spline"]
    for name, lines in EQUATIONS.items():
        assert len(layout.facts([(f"Model {name}", line) for line in lines])) == len(lines)


# --- not solved -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "termination,undetermined,says",
    [
        (LIMIT, (), "Allow more iterations"),
        (STUCK, (), "gross errors"),
        (NOT_FINITE, (), "behind their cameras"),
        (LIMIT, ("c of camera cam", "X, Y, Z of point 7"), "c of camera cam, X, Y, Z of point 7"),
    ],
)
def test_not_converged_shows_no_numbers(convergent4, termination, undetermined, says):
    minimum = eqx.tree_at(lambda m: m.termination, convergent4.minimum, jnp.asarray(termination))
    changed = again(convergent4, minimum=minimum, undetermined=undetermined)
    text = changed.report()
    assert_plain(text)
    assert "Not solved" in text and says in " ".join(text.split())
    if undetermined:
        assert "two directions" in text and "camera parameters" in text
    for shown in ("".join(text.splitlines(True)[1:]), str(changed), repr(changed)):
        assert not re.search(r"\d\.\d|\de-?\d", shown), "a number that looks like an answer"
        assert "σ0 " not in shown or "residuals, σ0 and cameras" in " ".join(shown.split())
    assert "NOT converged" in str(changed) and "NOT converged" in repr(changed)
    assert "NOT converged" in changed._repr_html_()


# --- short forms ----------------------------------------------------------------------------


def test_short_form(convergent4):
    text = str(convergent4)
    assert_plain(text)
    assert len(text.splitlines()) <= 20
    for said in ("converged", "0.63128 µm", "23 = 80", "c 18.5280 ± 0.0453"):
        assert said in text
    middle, most = map(float, re.search(r"median σX (\S+) \((\S+)\)", text).groups())
    expected = np.quantile(convergent4.points["sX"], (0.5, 0.95))
    np.testing.assert_allclose((middle, most), expected, rtol=5e-3)
    assert repr(convergent4) == (
        "<Adjustment 'four convergent photographs': converged, σ0 0.00063128, redundancy 23, "
        "4 images, 10 points>"
    )


def test_html_is_escaped(convergent4):
    network = convergent4.problem.network
    camera = dataclasses.replace(network.cameras[0], id="<script>&")
    network = network.replace(name='a "b" <img src=x>\n', cameras=(camera,))
    html = again(convergent4, network)._repr_html_()
    assert "<script>" not in html and "<img" not in html and "\n" not in html
    assert "Camera &lt;script&gt;&amp;" in html
    assert html.count("<tr>") == html.count("</tr>") > 5
    assert report.html(convergent4) == convergent4._repr_html_()


def test_ids_cannot_break_the_page(convergent4):
    network = convergent4.problem.network
    ids = tuple(f"{id}\t\x1b[31m\n" + "long" * 30 for id in network.points.id)
    network = network.replace(points=dataclasses.replace(network.points, id=ids))
    assert_plain(again(convergent4, network).report(1.0))


# --- numbers --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "value,sigma,expected",
    [
        (18.528014315, 0.04530, ("18.5280", "0.0453")),
        (4907.812267, 0.4686, ("4907.812", "0.469")),
        (500123.456, 1234.5, ("500123", "1234")),
        (-3.4431701e-8, 2.291e-8, ("-3.44e-08", "2.29e-08")),
        (2.2723256e-4, 4.763e-5, ("2.272e-04", "4.76e-05")),
        (0.0, 2e-9, ("0", "2.00e-09")),
        (9.996, 0.09996, ("9.996", "0.100")),
        (1.5, None, ("1.5", "–")),
        (1.5, float("nan"), ("1.5", "–")),
        (float("nan"), 1.0, ("–", "–")),
    ],
)
def test_estimate(value, sigma, expected):
    assert layout.estimate(value, sigma) == expected


def test_value_and_sigma_end_at_the_same_place():
    rng = np.random.default_rng(1)
    for value, sigma in zip(rng.normal(size=200) * 10.0 ** rng.integers(-6, 6, 200),
                            10.0 ** rng.uniform(-9, 3, 200)):  # fmt: skip
        a, b = layout.estimate(value, sigma)
        assert float(b) == pytest.approx(sigma, rel=6e-3)
        assert abs(float(a) - value) <= max(0.006 * sigma, 1e-15 * abs(value))


def test_wide_tables_shorten_their_names():
    lines = layout.table(("id", "value"), [("n" * 120, "1.00"), ("b", "22.00")], "lr")
    assert max(map(len, lines)) == layout.WIDTH
    assert "…" in lines[1] and len({len(line) for line in lines[1:]}) == 1
    assert lines[1].endswith(" 1.00") and lines[2].endswith("22.00")


@pytest.mark.parametrize(
    "words,expected",
    [((1, "image", " held"), "1 image held"), ((4, "image", " held"), "4 images held"),
     ((0, "point"), "0 points")],
)  # fmt: skip
def test_plurals(words, expected):
    assert count(*words) == expected


@pytest.mark.parametrize(
    "value,digits,expected",
    [(0.00063128, 5, "0.00063128"), (1234567.0, 3, "1.23e+06"), (0.0, 3, "0"), (None, 3, "–"),
     (float("inf"), 3, "–"), (154.006, 10, "154.006"), (12.345, 3, "12.3")],
)  # fmt: skip
def test_significant(value, digits, expected):
    assert layout.significant(value, digits) == expected
