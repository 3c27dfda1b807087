"""An own kind of observation in a network that was read from a project: heights that a level has
measured between points, with an unknown error of collimation; an inclinometer on the camera."""

import dataclasses
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import jaxbundle
from jaxbundle import InputError
from jaxbundle import leastsquares as ls
from jaxbundle.geometry import matrix_from_quaternion

PROJECT = Path(__file__).parent.parent / "examples" / "convergent4" / "project.toml"
LEVELLED = ls.Kind(
    "levelled height difference", lambda a, b, error, dh: b[2] - a[2] + error - dh,
    of=("point", "point", "level"), axes=("dZ",),
)  # fmt: skip


@pytest.fixture(scope="module")
def network():
    return jaxbundle.read_network(PROJECT, overrides=("sigma_image=1", "sigma_origin=unit"))


@pytest.fixture(scope="module")
def alone(network):
    return jaxbundle.adjust(network)


def levelled(alone, sigma, collimation=0.4):
    """Differences of height between points of the adjusted network, by a level with an error."""
    ids, Z = alone.problem.network.points.id, alone.point_values[:, 2]
    pairs = [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5), (5, 6), (6, 7), (7, 8), (8, 9), (0, 9), (2, 7)]
    a, b = np.array(pairs).T
    return ls.Table("level", np.array([0.0]), labels=["Ni2"]), LEVELLED(
        rows=([ids[k] for k in a], [ids[k] for k in b], ["Ni2"] * len(a)),
        measured=Z[b] - Z[a] + collimation, sigma=sigma,
    )  # fmt: skip


def test_levelling_in_a_network(network, alone):
    table, differences = levelled(alone, sigma=0.05)
    result = jaxbundle.adjust(network, also=[table, differences])
    # What agrees with the adjusted network changes it not at all, and finds its own unknown.
    assert result.converged
    assert result.vtpv == pytest.approx(alone.vtpv, rel=1e-9)
    assert result.counts.datum == 4  # height differences give the plumb line and the scale
    assert result.redundancy == alone.redundancy + differences.number - 1 - 3
    np.testing.assert_allclose(result.point_values, alone.point_values, atol=1e-5)
    level = result.unknowns("level")
    assert level.value[0] == pytest.approx(0.4, abs=1e-6) and level.sigma[0] > 0
    rows = result.residuals["kind"] == "levelled height difference"
    assert rows.sum() == differences.number
    assert ((result.residuals["r"][rows] > 0) & (result.residuals["r"][rows] < 1)).all()
    component = result.variance_components["levelled height difference"]
    assert component.observations == differences.number
    every = result.residuals["r"].sum()
    assert every == pytest.approx(result.redundancy, abs=1e-6)
    assert "levelled height difference" in result.report()


def test_tables_have_the_units_of_own_unknowns_and_components(network, alone):
    """The collimation as the angle of a line of sight of 100 units: radians here, in the unit of
    the network in the tables."""
    gon = network.replace(angle_unit="gon")
    ids, Z = network.points.id, alone.point_values[:, 2]
    a, b = np.arange(6), np.arange(1, 7)
    kind = dataclasses.replace(
        LEVELLED, residual=lambda a, b, t, dh: b[2] - a[2] + 100 * t - dh, units="length"
    )  # fmt: skip
    level = ls.Table("level", np.zeros(1), labels=["Ni2"], parameters=("tilt",), units="angle")
    result = jaxbundle.adjust(gon, also=[level, kind(
        rows=([ids[k] for k in a], [ids[k] for k in b], ["Ni2"] * 6),
        measured=Z[b] - Z[a] + 0.4, sigma=0.05,
    )])  # fmt: skip
    one = result.further_unknowns["level"]["Ni2"]["tilt"]
    found = result.unknowns("level")
    assert one["value"] == pytest.approx(0.004 * 200 / np.pi, rel=1e-4)
    assert one["sigma"] == pytest.approx(found.sigma[0] * 200 / np.pi, rel=1e-12)
    (line,) = (line for line in result.report().splitlines() if line.startswith("Ni2"))
    assert line.split()[1] == "tilt" and line.split()[-1] == "gon"
    units = {name: c.unit for name, c in result.variance_components.items()}
    assert units == {
        "image coordinates": network.image_unit, "levelled height difference": network.object_unit,
    }  # fmt: skip
    assert "σ̂  unit" in result.report()
    with pytest.raises(InputError, match="expected one unit, or 1; got 2 of them"):
        ls.Table("level", np.zeros(1), units=("angle", "length"))


def test_heights_are_those_of_object_space(network, alone):
    """One height that is known: the datum shifts to it, wherever the origin of the arrays is. And
    the plumb line in the frame of every image, measured: the pose is seen as it is."""
    height = ls.Kind("height", lambda p, Z: p[2] - Z, of=("point",))
    plumb = ls.Kind(
        "plumb line", lambda pose, xy: jnp.stack(pose.rotation.apply((0.0, 0.0, 1.0))[:2]) - xy,
        of=("image",), axes=("x", "y"),
    )  # fmt: skip
    moved = network.replace(points=_shifted(network.points), images=_shifted(network.images))
    points, images = moved.points.id, moved.images.id
    Z = alone.point_values[3, 2] + 5e6 + 0.25
    M = np.stack([np.asarray(matrix_from_quaternion(q)) for q in alone.values["image"].rotation])
    result = jaxbundle.adjust(moved, also=[
        height(rows=([points[3]],), measured=np.array([Z]), sigma=1e-3),
        plumb(rows=(images,), measured=M[:, :2, 2], sigma=1e-3),
    ])  # fmt: skip
    assert result.counts.datum == alone.counts.datum - 1 - 2
    assert result.redundancy == alone.redundancy + 2 * len(images) - 2
    assert result.vtpv == pytest.approx(alone.vtpv, rel=1e-9)
    assert result.point_values[3, 2] == pytest.approx(Z, abs=1e-6)


def _shifted(table):
    return dataclasses.replace(table, position=table.position + np.array([0.0, 0.0, 5e6]))


def test_what_does_not_fit_is_told(network, alone):
    table, differences = levelled(alone, sigma=0.05)
    with pytest.raises(jaxbundle.InputError, match="there is no point 'nowhere'"):
        wrong = LEVELLED(rows=(["nowhere"], ["1"], ["Ni2"]), measured=np.zeros(1))
        jaxbundle.adjust(network, also=[table, wrong])
    with pytest.raises(jaxbundle.InputError, match="no table 'level'"):
        jaxbundle.adjust(network, also=[differences])
    with pytest.raises(jaxbundle.InputError, match="already has a table 'point'"):
        jaxbundle.adjust(network, also=[ls.Table("point", np.zeros((2, 3)))])
    with pytest.raises(jaxbundle.InputError, match="also: expected tables .*"):
        jaxbundle.adjust(network, also=[3.0])


@pytest.mark.parametrize(
    "residual, why",
    [
        (lambda a: a, "it raised TypeError"),
        (lambda a, b, m: a.position - m, "it raised AttributeError"),
    ],
)
def test_a_residual_that_cannot_be_evaluated_names_its_kind(network, residual, why):
    bar = ls.Kind("bar", residual, of=("point", "point"))
    observed = bar(rows=(["1"], ["2"]), measured=[1.0], sigma=0.1)
    with pytest.raises(InputError, match=f"bar: .*row of point, point.*{why}"):
        jaxbundle.adjust(network, also=[observed])
    with pytest.raises(InputError, match="also must be a list"):
        jaxbundle.adjust(network, also=observed)
