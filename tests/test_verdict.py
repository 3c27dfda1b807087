"""What the verdict says of a result, in text, page and JSON: neither a false alarm nor silence.

The results are those of the four convergent photographs, and of four images of 25 targets, whose
shapes other tests share.
"""

import dataclasses
import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import jaxbundle
from jaxbundle import Adjustment, Camera, grid_of_targets, ring_of_stations, simulate
from jaxbundle.io.results.result_json import result_dict, result_text
from jaxbundle.io.results.result_project import readjustable_network
from jaxbundle.leastsquares.quality.global_test import chi_squared_test, describe_test
from jaxbundle.network.blunders import Removed, removed_rays
from jaxbundle.network.tables import ESTIMATED, STATED, UNIT, LeftOut
from jaxbundle.report.head import count_removed
from jaxbundle.report.page import compose
from jaxbundle.report.verdict import (
    BAD,
    DOUBTFUL,
    GOOD,
    NOTED,
    explained_by_chance,
    judge_blunders,
    judge_check_points,
)

WORDS = "no a priori σ was given: 1 mm is a unit of weight; σ0 a posteriori estimates it"
TARGETS = grid_of_targets(5, 5, 0.5, relief=0.2, seed=1)
EXAMPLES = Path(__file__).parents[1] / "examples"
RING = ring_of_stations(4, 3.0, 2.5, roll_every=2)


def judged(result: Adjustment, origin: str = UNIT, **changes) -> Adjustment:
    """The same solution of a network with σ of another origin, and other changes."""
    network = result.problem.network
    rays = dataclasses.replace(network.observations, sigma_origin=origin)
    network = network.replace(observations=rays, **changes)
    problem = dataclasses.replace(result.problem, network=network)
    return Adjustment(network, problem, result.minimum)


def finding(result: Adjustment, about: str):
    return next(f for f in result.verdict.findings if f.about == about)


def test_a_priori_sigma_that_nobody_gave_are_not_tested(convergent4):
    """Text, page, JSON and Python say so, and the verdict is good."""
    result = judged(convergent4, UNIT)
    found = result.global_test()
    assert found["passed"] is None and found["sigma_origin"] == UNIT
    told = " ".join(result.report().split())
    page = "".join(compose(result))
    if convergent4.problem.network.observations.sigma[0, 0] == 1:
        assert WORDS in told and WORDS in page
    for text in (told, page):
        assert "is a unit of weight" in text and "not passed" not in text
    assert result.verdict.state == GOOD and "no a priori σ" in result.verdict.words
    document = json.loads("".join(result_text(result)))
    assert document["global_test"]["passed"] is None
    assert document["global_test"]["sigma_origin"] == UNIT
    assert document["verdict"]["state"] == GOOD and document["warnings"] == []
    assert result_dict(result, brief=True)["global_test"] == document["global_test"]


def test_stated_sigma_are_tested_whatever_their_value(convergent4):
    """1 mm is a σ like others where somebody stated it; it is the origin that counts."""
    result = judged(convergent4, STATED)
    found, r = result.global_test(), result.redundancy
    low, high = stats.chi2.ppf([0.025, 0.975], r)
    assert (found["low"], found["high"]) == pytest.approx((low, high))
    assert found["passed"] == (low <= result.vtpv <= high)


@pytest.mark.parametrize("setting, origin", [
    ("", UNIT), ("sigma_image = 0.001", STATED), ('sigma_origin = "unit"', UNIT),
    ('sigma_image = 0.001\nsigma_origin = "estimated"', ESTIMATED),
])  # fmt: skip
def test_the_origin_of_sigma_is_what_the_project_says(tmp_path, setting, origin):
    given = EXAMPLES / "convergent4"
    for name in ("images", "points", "observations"):
        (tmp_path / f"{name}.csv").write_text((given / f"{name}.csv").read_text())
    text = (given / "project.toml").read_text()
    lines = [line for line in text.splitlines() if not line.startswith("sigma_")]
    at = lines.index("[project]") + 1
    (tmp_path / "project.toml").write_text("\n".join([*lines[:at], setting, *lines[at:]]))
    network = jaxbundle.read_network(tmp_path / "project.toml")
    assert network.observations.sigma_origin == origin and network.warnings == ()
    path = jaxbundle.write_project(network, tmp_path / "copy")
    again = jaxbundle.read_network(path)
    assert again.observations.sigma_origin == origin
    np.testing.assert_array_equal(again.observations.sigma, network.observations.sigma)
    if origin == UNIT:  # What nobody gave is not written as if somebody had.
        assert "sx" not in (tmp_path / "copy" / "observations.csv").read_text()
        stated = jaxbundle.read_network(path, overrides=("sigma_image=0.002",)).observations
        assert stated.sigma_origin == STATED and (stated.sigma == 0.002).all()


def test_sigma_of_every_observation_are_stated_and_of_some_are_not():
    rows = [{"image": "1", "point": p, "x": 1.0, "y": 1.0, "sx": 0.1, "sy": 0.1} for p in "ab"]
    images = [{"id": "1", "camera": "c"}]
    points = [{"id": p, "X": 0, "Y": 0, "Z": 0} for p in "ab"]
    make = lambda rows, **more: jaxbundle.make_network(
        Camera("c", "brown", {"c": 1.0}), images, points, rows, **more
    )
    assert make(rows).observations.sigma_origin == STATED
    some = make([rows[0], rows[1] | {"sx": None, "sy": None}])
    assert some.observations.sigma_origin == UNIT
    assert some.warnings == (
        "2 image coordinates of 4 without σ: theirs is 1 mm, beside those given; give sigma_image",
    )
    assert make(rows, sigma_origin=ESTIMATED).observations.sigma_origin == ESTIMATED
    assert make([{k: v for k, v in row.items() if k[0] != "s"} for row in rows],
                sigma_image=1.0).observations.sigma_origin == STATED  # fmt: skip


def test_estimated_sigma_stay_estimated_when_adjusted_again(convergent4):
    result = judged(convergent4, STATED)
    result.sigma_factors = {"image coordinates": 2.0}
    assert result.global_test()["passed"] is None
    assert "not done: the σ were estimated" in result.report()
    assert readjustable_network(result).observations.sigma_origin == ESTIMATED


def test_words_of_the_test():
    words = lambda vtpv, redundancy, origin=STATED: describe_test(
        chi_squared_test(vtpv, redundancy, origin), "1 px"
    )
    assert words(20.0, 20).endswith("the a priori σ are confirmed")
    assert words(1.0, 20).endswith("the observations are better than their a priori σ")
    assert "too small" in words(90.0, 20) and words(90.0, 20).startswith("not passed")
    assert words(90.0, 20, UNIT) == WORDS.replace("mm", "px")
    assert words(0.0, 0).startswith("no redundancy")


@pytest.mark.parametrize("number", [10, 1000, 100_000])
def test_what_chance_explains_is_exceeded_by_chance_in_a_thousandth(number):
    assert stats.binom.sf(np.floor(explained_by_chance(number)), number, 0.001) < 2e-3


@pytest.mark.parametrize("left, state, brief", [
    (LeftOut("tie point", ("9",), "that disagrees"), NOTED, "1 of 11 points left out"),
    (LeftOut("tie point", ("8", "9", "7"), "…"), DOUBTFUL, "3 of 13 points left out"),
    (LeftOut("image", ("9",), "…"), DOUBTFUL, "1 of 5 images left out"),
    (LeftOut("image point", ("9 in 1",), "…"), NOTED, "1 of 41 image points left out"),
    # As many as data snooping may remove, 5 %.
    (LeftOut("image point", ("8 in 1", "9 in 1"), "…"), NOTED, "2 of 42 image points left out"),
    (LeftOut("image point", ("7", "8", "9"), "…"), DOUBTFUL, "3 of 43 image points left out"),
    (LeftOut("point", tuple("abcdefghij"), "without any ray", False), NOTED,
     "points without enough rays"),
])  # fmt: skip
def test_what_is_left_out_lowers_the_verdict_beyond_chance_only(convergent4, left, state, brief):
    result = judged(convergent4, UNIT, left_out=(left,), notes=("left out …",))
    found = finding(result, "Left out")
    assert (found.state, found.brief) == (state, brief)
    verdict = result.verdict
    assert verdict.state == (GOOD if state == NOTED else DOUBTFUL) and brief in verdict.words
    first = result.report().split("Counts\n")[0]  # The first lines of the report.
    assert brief in " ".join(first.split())
    assert brief in "".join(compose(result))


def test_a_free_network_with_start_values_found_is_a_complete_result(convergent4):
    notes = ("start values found, in an arbitrary frame and scale",)
    result = judged(convergent4, UNIT, notes=notes)
    control = finding(result, "Control")
    assert control.state == NOTED and "position, orientation and scale" in control.words
    assert "datum inner" in control.words and result.verdict.state == GOOD
    assert notes[0] in result.report() and notes[0] not in result.warnings
    assert result_dict(result, brief=True)["notes"] == list(notes)


def network(**options):
    camera = Camera("cam", "brown", {"c": 24.0}, free=("c",))
    given = {"control": (0, 4, 20, 24), "control_sigma": 0.002, "datum": "control"} | options
    return simulate(RING, TARGETS, camera, noise=0.002, seed=3, disturb=0.005, **given)


def test_handheld_control_is_an_uncertain_georeference_and_no_weak_network():
    """σ of 0.1 m at 4 m: the block as a whole is known to 0.1/√4 m, its images to each other far
    better."""
    result = jaxbundle.adjust(network(control_sigma=0.1))
    told = result.weakness.georeference
    assert result.weakness.unknowns == () and result.warnings == ()
    assert told.startswith("georeference uncertain to ")
    # The mean of four control points; σ0 is a posteriori.
    value = float(told.split("uncertain to ")[1].split(" ")[0])
    assert value == pytest.approx(0.05 * result.sigma0, rel=0.1)
    X = lambda values: values["point"].mean(0)  # As propagated.
    largest = np.sqrt(np.linalg.eigvalsh(result.covariance_of(X))[-1])
    assert value == pytest.approx(largest, rel=0.05)
    control = finding(result, "Control")
    assert control.state == NOTED and told in control.words
    assert "georeference uncertain to" in result.verdict.words

    # What is said of the images holds: ratios of distances, which no datum changes.
    def ratio(values):
        X0 = values["image"].position
        away = lambda i, k: jnp.linalg.norm(X0[i] - X0[k])
        return jnp.stack([away(0, 1) / away(1, 2), away(2, 3) / away(1, 2)])

    assert (np.diag(result.covariance_of(ratio)) < (1 / 50) ** 2).all()


def test_control_with_small_sigma_says_nothing_of_it():
    result = jaxbundle.adjust(network())
    assert result.weakness.georeference == "" and finding(result, "Control").state == GOOD


def test_a_wrong_control_point_is_said_first():
    given = network()
    k = given.points.id.index("5")
    position = given.points.position.copy()
    position[k, 0] += 0.05  # 25 σ
    points = dataclasses.replace(given.points, position=position)
    result = jaxbundle.adjust(given.replace(points=points))
    assert result.verdict.state == BAD and "control contradicted" in result.verdict.words
    for text in (result.report()[:1500], str(result)):
        assert "control contradicted" in text


def test_a_unit_of_weight_beside_control_with_sigma_is_no_good_result():
    """1 mm for image coordinates of 2 µm: control gets 500 times its weight."""
    given = network()
    rays = dataclasses.replace(
        given.observations, sigma=np.ones_like(given.observations.xy), sigma_origin=UNIT
    )
    result = jaxbundle.adjust(given.replace(observations=rays))
    assert result.verdict.state != GOOD and finding(result, "χ² test").state == DOUBTFUL
    assert any("1 mm was assumed beside the σ of other observations" in w for w in result.warnings)


@pytest.mark.further
def test_a_prior_beside_fixed_points_needs_a_stated_sigma_too():
    """Three fixed points give the datum: every prior is weighted against the image coordinates."""
    given = network(control=(), datum="control")
    role = ["fixed" if k in (0, 4, 20, 24) else r for k, r in enumerate(given.points.role)]
    sigma = np.full_like(given.points.sigma, np.nan)
    rays = dataclasses.replace(
        given.observations, sigma=np.ones_like(given.observations.xy), sigma_origin=UNIT
    )
    prior = dataclasses.replace(given.cameras[0], sigma={"c": 0.001})
    result = jaxbundle.adjust(given.replace(
        points=dataclasses.replace(given.points, role=tuple(role), sigma=sigma),
        observations=rays, cameras=(prior,),
    ))  # fmt: skip
    assert result.weights_matter and finding(result, "χ² test").state == DOUBTFUL


def test_the_judgement_of_blunders_is_one():
    """1000 standard normal values, one of them far: by the critical values of the normal
    distribution at 0.1 % (3.29) and of the largest of 1000 (4.89)."""
    good = 0.9 * stats.norm.ppf((np.arange(1000) + 0.5) / 1000)
    critical = lambda level: stats.norm.isf(level / 2)
    judge = lambda size, removed=0: judge_blunders(np.abs(size), critical, "|w|", removed, 500.0)
    assert judge(good).state == GOOD
    found = judge(np.r_[good, 6.0])
    assert (found.state, found.brief) == (DOUBTFUL, "1 blunder likely")
    assert "1 of 1001 observations over the critical value 3.29" in found.words
    assert judge(good, removed=50).state == DOUBTFUL
    assert judge(np.r_[good, np.full(10, 4.0)]).state == NOTED
    check = lambda ratio: judge_check_points(2, "RMS 1 m", np.array(ratio), 4.0)
    assert (check([3.9, 1.0]).state, check([4.1]).state) == (GOOD, DOUBTFUL)
    assert check([4.1]).brief == "a check point 4.10 σ off"
    # Without a σ of any difference nothing is tested, and nothing is met.
    for ratio in ([], [np.nan]):
        assert (check(ratio).state, check(ratio).brief) == (DOUBTFUL, "check points not tested")
    # Observations that cannot be told apart are two that are missing.
    removed = (Removed("image", 3, "3", 5.0), Removed("image", 4, "4 or 5", 5.0, (5,)))
    assert count_removed(removed) == len(removed_rays(removed)) == 3
