"""The page of a result: well-formed, without external content, and with the values of the
result."""

import base64
import dataclasses
import hashlib
import json
import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from page_reader import Page, column, decode

import jaxbundle
from jaxbundle.adjustment.result import Adjustment
from jaxbundle.adjustment.result_tables import measured_values
from jaxbundle.cli.outputs import check_targets
from jaxbundle.leastsquares.problem import with_data
from jaxbundle.report.head import NO_RESULT
from jaxbundle.report.page import InputFile, Origin, compose, compose_failure, fingerprint_files
from jaxbundle.report.page.columns import Column, encode_table, encode_values
from jaxbundle.report.page.document import SCRIPTS, STYLE
from jaxbundle.report.page.tables import choose_largest
from jaxbundle.report.verdict import BAD, DOUBTFUL, GOOD, NOTED, Finding, in_words, judge

ROOT = Path(__file__).parent.parent
EXAMPLE = ROOT / "examples" / "convergent4" / "project.toml"
HOSTILE = "</script><script>alert('1')</script><!--<img src=x onerror=\"alert(2)\">&amp;"


@pytest.fixture(scope="module")
def text(convergent4):
    return "".join(compose(convergent4, Origin(fingerprint_files([EXAMPLE])), date="2024-05-02"))


@pytest.fixture(scope="module")
def page(text):
    return Page(text)


# --- the whole ------------------------------------------------------------------------------


def test_the_page_is_well_formed(page):
    ids = page.attributes("id")
    assert len(ids) == len(set(ids))
    links = page.attributes("href")
    assert links and all(link[0] == "#" and link[1:] in ids for link in links)
    assert page.texts["title"] == ["four convergent photographs: bundle adjustment"]
    assert page.texts["h2"][0] == "Verdict"


def test_nothing_comes_from_outside(text, page):
    """No address; the policy allows the one script and the one style by their digests alone."""
    assert not re.search(r"https?:|\bsrc=|@import|url\(", text)
    (policy,) = (given["content"] for _, given in page.tags if "http-equiv" in given)
    assert policy.startswith("default-src 'none'")
    scripts = [given for tag, given in page.tags if tag == "script" and "type" not in given]
    assert len(scripts) == 1 and not any(name.startswith("on") for _, g in page.tags for name in g)
    for kind in ("script", "style"):
        (content,) = re.findall(rf"<{kind}>(.*?)</{kind}>", text, re.DOTALL)
        digest = base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()
        assert f"{kind}-src 'sha256-{digest}'" in policy
    assert page.attributes("style") == []


def test_the_same_result_gives_the_same_page(convergent4, monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1000000000")
    first, second = ("".join(compose(convergent4)) for _ in range(2))
    assert first == second and "computed 2001-09-09 01:46 UTC" in first


def test_words_and_numbers_are_those_of_the_protocol(convergent4, page):
    said = set(page.texts["td"])
    assert {str(convergent4.redundancy), "80", "64"} <= said
    assert any(words.startswith("no a priori σ was given: 1 mm") for words in said)
    assert set(convergent4.warnings) <= set(page.texts.get("li", []))
    assert hashlib.sha256(EXAMPLE.read_bytes()).hexdigest() in said
    assert jaxbundle.__version__ in said and np.__version__ in said


# --- arrays ---------------------------------------------------------------------------------


def test_arrays_are_those_of_the_adjustment(convergent4, text):
    for name in "XYZ":
        assert_array_equal(column(text, "points", name), convergent4.points[name])
    assert_array_equal(column(text, "points", "id"), convergent4.points["id"])
    covariance = [column(text, "points", name) for name in ("c00", "c11", "c22")]
    assert_allclose(np.sqrt(covariance[2]), convergent4.points["sZ"], rtol=1e-6)
    assert_array_equal(column(text, "images", "kappa"), convergent4.images["kappa"])
    found = convergent4.residuals
    for name in ("v", "r", "tau"):
        assert_allclose(column(text, "observations", name), found[name], rtol=1e-6)
    for name in ("kind", "image", "point", "axis"):
        assert_array_equal(column(text, "observations", name), found[name])


def test_measured_coordinates_stand_beside_their_residuals(convergent4, text):
    given = convergent4.problem.network
    measured = column(text, "observations", "measured").reshape(-1, 2)
    assert_allclose(measured, given.observations.xy, rtol=1e-6)
    images = np.array(given.images.id, dtype=object)[given.observations.image]
    assert_array_equal(column(text, "observations", "image")[::2], images)

def test_what_was_measured_stands_beside_residuals_of_every_kind():
    """Angles in the unit of the network, coordinates of control with their origin, and nothing for
    what is not given."""
    network = jaxbundle.read_network(EXAMPLE)
    ids, X = network.points.id[:3], network.points.position[:3]
    angles = {"from": [ids[0]], "at": [ids[1]], "to": [ids[2]], "value": [61.5], "sigma": [0.01]}
    levelled = {"from": [ids[0]], "to": [ids[1]], "dZ": [1.25], "sdZ": [0.001]}
    network = jaxbundle.add_further(
        network.replace(angle_unit="gon"), angle_unit="gon", angles=angles, differences=levelled
    )
    role, sigma = np.array(network.points.role, dtype=object), network.points.sigma.copy()
    role[2], sigma[2] = "control", 0.001
    points = dataclasses.replace(network.points, role=tuple(role), sigma=sigma)
    problem = jaxbundle.make_problem(network.replace(points=points))
    rays = 2 * len(network.observations)
    measured = measured_values(problem)
    assert_array_equal(measured[:rays].reshape(-1, 2), network.observations.xy)
    assert_allclose(np.sort(measured[rays:]), np.sort([*X[2], 61.5, 1.25]), atol=1e-12)


@pytest.mark.parametrize("values, kind", [
    ([0, 255, 3], "u1"), ([0, 256], "u2"), ([0, 70000], "i4"), ([-1, 5], "i4"), ([2**40, 1], "f8"),
    ([1.5, np.nan, -np.inf], "f4"), (["b", "a", "b"], "u1"), ([True, False], "u1"),
])  # fmt: skip
def test_columns_are_packed_without_loss(values, kind):
    packed = encode_values(np.array(values, object if values and values[0] == "b" else None))
    assert packed["type"] == kind
    expected = ["yes" if v else "no" for v in values] if kind == "u1" and True in values else values
    assert_array_equal(decode(packed, len(values)), expected)


def test_equal_values_are_packed_as_one():
    assert encode_values(np.full(1000, 0.5))["same"] == 0.5
    assert "same" not in encode_values(np.full(1000, np.inf))
    table = encode_table({"a": Column(np.arange(3), "A", 2), "b": Column(np.zeros(3))})
    assert table["length"] == 3 and table["columns"]["a"]["places"] == 2


def test_of_too_many_observations_the_largest_are_kept():
    tau = np.array([0.1, -5.0, np.nan, 3.0, 0.2])
    assert_array_equal(choose_largest(tau, 2), [1, 3])
    assert_array_equal(choose_largest(tau, 5), range(5))


# --- hostile names --------------------------------------------------------------------------


def with_names(adjustment, name: str) -> Adjustment:
    """The same result with this in the names of everything."""
    network = adjustment.problem.network
    rename = lambda table: dataclasses.replace(table, id=tuple(f"{name}{id}" for id in table.id))
    network = network.replace(
        name=name, object_unit=name, warnings=(name,), images=rename(network.images),
        points=rename(network.points),
        cameras=tuple(dataclasses.replace(c, id=f"{name}{c.id}") for c in network.cameras),
    )  # fmt: skip
    problem = dataclasses.replace(adjustment.problem, network=network)
    return Adjustment(network, problem, adjustment.minimum)


def test_names_cannot_leave_their_place(convergent4, page):
    origin = Origin((InputFile(f"{HOSTILE}.csv", 3, "0"),), {HOSTILE: HOSTILE})
    text = "".join(compose(with_names(convergent4, HOSTILE), origin, date=HOSTILE))
    found = Page(text)
    kinds = lambda of: {tag for tag, _ in of.tags}
    assert kinds(found) <= kinds(page) | {"ul", "li"}
    assert len(found.attributes("type")) == len(page.attributes("type"))
    assert HOSTILE in "".join(found.texts["h2"]) and HOSTILE in found.texts["li"]
    ids = column(text, "points", "id")
    assert ids[0] == f"{HOSTILE}{convergent4.points['id'][0]}"


def test_names_that_are_no_unicode_can_be_written(convergent4):
    text = "".join(compose(with_names(convergent4, "\udc80\u2028\0")))
    assert Page(text.encode().decode())


# --- verdicts -------------------------------------------------------------------------------


def test_a_result_that_was_not_reached_shows_no_numbers(convergent4):
    singular = Adjustment(convergent4.network, convergent4.problem, convergent4.minimum,
                          undetermined=("X0 of image <1>",))  # fmt: skip
    text = "".join(compose(singular))
    assert NO_RESULT in Page(text).texts["p"] and "application/json" not in text
    error = jaxbundle.NotSolvedError("not solved: too few images", ["X0 of image <2>"])
    said = Page("".join(compose_failure(error))).texts
    assert "not solved: too few images" in said["td"] and "X0 of image <2>" in said["td"]


def test_the_worst_finding_makes_the_verdict():
    good, doubtful, bad = (Finding(state, state, "") for state in (GOOD, DOUBTFUL, BAD))
    assert in_words([good], 0)[0] == GOOD
    assert in_words([good], 1)[0] == in_words([good, doubtful], 0)[0] == DOUBTFUL
    assert in_words([bad, doubtful], 3) == (BAD, "The result does not meet its tests: not met.")


def test_a_fit_that_the_test_refuses_is_not_met(convergent4):
    """χ² with 23 degrees of freedom: 95 % are between 11.69 and 38.08 (published tables)."""
    problem = convergent4.problem
    scaled = problem.with_image_weights(problem.data, 1.5 * problem.image_weights)
    problem, network = with_data(problem, scaled), problem.network
    rays = dataclasses.replace(network.observations, sigma_origin="stated")
    problem = dataclasses.replace(problem, network=network.replace(observations=rays))
    changed = Adjustment(convergent4.network, problem, convergent4.minimum)
    states = {}
    for vtpv in (11.0, 12.0, 38.0, 39.0):
        changed.__dict__["vtpv"] = vtpv
        states[vtpv] = next(f.state for f in judge(changed) if f.about == "χ² test")
    assert states == {11.0: NOTED, 12.0: GOOD, 38.0: GOOD, 39.0: BAD}


# --- files ----------------------------------------------------------------------------------


def test_the_distribution_carries_scripts_and_style():
    """The wheel takes what lies in the package and git does not ignore; nothing is excluded."""
    wheel = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]
    assert wheel["targets"]["wheel"]["packages"] == ["jaxbundle"] and "exclude" not in wheel
    folder = ROOT / "jaxbundle" / "report" / "page"
    assert {p.name for p in folder.iterdir() if p.suffix in (".js", ".css")} == {*SCRIPTS, STYLE}
    assert not any(line.startswith("*.") and line.rstrip()[2:] in ("js", "css")
                   for line in (ROOT / ".gitignore").read_text().splitlines())  # fmt: skip


def test_a_file_that_is_no_page_is_not_replaced(convergent4, tmp_path):
    target = tmp_path / "notes.html"
    check = lambda **options: check_targets(
        EXAMPLE, convergent4.network, "", None, html=str(target), **options
    )
    for content in ("", "<!DOCTYPE HTML>", "\n<html lang='en'>"):
        target.write_text(content)
        check()
    target.write_text("mine")
    with pytest.raises(jaxbundle.InputError, match="exists and is not HTML.*--force"):
        check()
    check(force=True)
    with pytest.raises(jaxbundle.InputError, match="part of the input"):
        check_targets(EXAMPLE, convergent4.network, "", None, html=str(EXAMPLE))


# --- in a browser ---------------------------------------------------------------------------

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
PROBE = """<script>
window.dispatchEvent(new Event("beforeprint"));
const drawn = id => {
  const canvas = document.getElementById(id);
  const pixels = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
  return pixels.some(value => value !== 255);
};
const first = () => document.querySelector("[data-table=points] td").textContent;
const sort = document.querySelectorAll("[data-table=points] th button")[2];
const rows = () => document.querySelectorAll("[data-table=points] td.name:first-child").length;
const found = { drawn: [drawn("network-canvas"), drawn("photograph-canvas")], rows: rows() };
sort.click(); found.least = document.querySelectorAll("[data-table=points] td")[0].textContent;
sort.click(); found.most = document.querySelectorAll("[data-table=points] td")[0].textContent;
const search = document.querySelector("[data-table=points] input");
search.value = found.most; search.dispatchEvent(new Event("input"));
found.searched = rows();
document.body.append(Object.assign(document.createElement("pre"), {
  id: "found", textContent: JSON.stringify(found) }));
</script></body>"""


def dump(path: Path) -> tuple[str, str]:
    """The document after its scripts have run, and what the console says."""
    done = subprocess.run(
        [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr",
         f"--user-data-dir={path.parent / 'profile'}", "--virtual-time-budget=2000", "--dump-dom",
         path.as_uri()],
        capture_output=True, timeout=120, text=True,
    )  # fmt: skip
    return done.stdout, "\n".join(x for x in done.stderr.splitlines() if "CONSOLE" in x)


@pytest.mark.skipif(CHROMIUM is None, reason="chromium is missing")
def test_a_browser_draws_sorts_and_searches(convergent4, text, tmp_path):
    (tmp_path / "page.html").write_text(text)
    shown, console = dump(tmp_path / "page.html")
    assert console == "" and "error ellipsoids" in shown
    # the probe is a script that the policy would refuse
    opened = re.sub(r'<meta http-equiv="Content-Security-Policy".*?>', "", text)
    (tmp_path / "probe.html").write_text(opened.replace("</body>", PROBE))
    shown, console = dump(tmp_path / "probe.html")
    assert console == ""
    found = json.loads(re.search(r'<pre id="found">(.*?)</pre>', shown)[1])
    points = convergent4.points
    assert found["drawn"] == [True, True] and found["rows"] == len(points["id"])
    assert found["least"] == points["id"][points["X"].argmin()]
    assert found["most"] == points["id"][points["X"].argmax()]
    assert found["searched"] == sum(found["most"].lower() in id.lower() for id in points["id"])
