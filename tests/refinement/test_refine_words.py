"""What a refinement says of its points, images and unknowns; nothing is adjusted here."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from refinement_scenes import scanner
from rpc_block import block
from test_with_photographs import CAMERA

from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import WGS84, Ellipsoid, earth_fixed
from jaxbundle.io.scanner.refinement import read_refinement
from jaxbundle.io.scanner.rpc import write_rpc
from jaxbundle.leastsquares.declarations import ObservationSet, Table
from jaxbundle.leastsquares.quality.snooping import RemovedRow
from jaxbundle.network.kinds.differences import ANGLE, DIFFERENCE
from jaxbundle.network.tables import Images, Observations
from jaxbundle.refinement import inspection, local_points, weakness
from jaxbundle.refinement.correction_tables import columns_of_photographs
from jaxbundle.refinement.freedom import UnknownName
from jaxbundle.refinement.kinds import control
from jaxbundle.refinement.refining import (
    Refinement,
    _beyond_priors,
    _contradicted_terrain,
    east_north_up,
)
from jaxbundle.refinement.tables import check_observations, has_upright_checks
from jaxbundle.refinement.terrain_heights import HeightModel


def geographic_points():
    """Control points with σ along east, north, up; the second along X, Y, Z."""
    X = np.array(earth_fixed(WGS84, (np.array([0.2, 0.3]), np.array([0.8, 0.9]), np.zeros(2)))).T
    points = local_points(["P", "Q"], ["control", "control"], X, 0.1)
    axes = np.stack([east_north_up(WGS84, X)[0], np.eye(3)])
    return dataclasses.replace(points, axes=axes, axis_names=("east", "north", "up"))


def test_axes_are_named_point_by_point():
    points = geographic_points()
    assert points.axis_names_of(0) == ("east", "north", "up")
    assert points.axis_names_of(1) == ("X", "Y", "Z")


def test_check_points_above_a_triaxial_body_have_no_east():
    assert has_upright_checks(WGS84) and not has_upright_checks(None)
    assert not has_upright_checks(Ellipsoid(12.0e3, 11.0e3, 9.0e3))


@pytest.mark.parametrize("kind, rows, axis, expected", [
    (control(("east", "north", "up")), ([1],), 2, ("control", 2, "Z of control point Q")),
    (DIFFERENCE, ([0], [1]), 1,
     ("coordinate differences", 0, "coordinate differences of point P and point Q")),
    (ANGLE, ([1], [0], [1]), None, ("angles", 0, "angles of point Q and point P and point Q")),
])  # fmt: skip
def test_removed_observations_of_every_kind_are_named(kind, rows, axis, expected):
    observations = ObservationSet(kind, tuple(map(np.array, rows)), (), name="set")
    problem = SimpleNamespace(
        observations_of={"set": observations}.get,
        tables=[Table("point", np.zeros((2, 3)), labels=["P", "Q"])],
    )
    declared = SimpleNamespace(
        inputs=SimpleNamespace(points=geographic_points(), ids=()), problem=problem, parts=(),
        rays=SimpleNamespace(points=np.arange(2)), control=np.array([1]),
    )  # fmt: skip
    removed = inspection._describe_removed(declared, RemovedRow("set", 0, axis, 5.0))
    assert (removed.kind, removed.row, removed.name) == expected


def test_weak_directions_of_jitter_have_their_own_eigenvalues(monkeypatch):
    name = lambda group: UnknownName("image A", group, "arcsec", 1.0, group)
    names = [name(g) for g in ("pitch jitter", "pitch jitter", "roll jitter", "yaw bias", "x")]
    S = np.diag([1e-3, 1e-12, 1e-4, 1e-5, 1.0])
    monkeypatch.setattr(weakness, "_matrix_without_priors", lambda *_: (S, names))
    told = weakness.weaknesses(None, None)
    np.testing.assert_allclose([w.eigenvalue for w in told], [1e-12, 1e-5, 1e-4])
    assert "do not determine parts of the pitch jitter of image A;" in told[0].sentence
    assert "hardly determine parts of the roll jitter of image A (σ 1e+02 " in told[2].sentence


@pytest.mark.parametrize("change, unsettled", [(1e-3, 1e-3), (1e-12, 0.0)])
def test_observations_that_never_settle_are_said(monkeypatch, change, unsettled):
    minimum = SimpleNamespace(values={}, iterations=1, termination=None)
    for name, found in {
        "find_minimum": minimum, "converged": True, "_require_solved": None, "Solution": None,
    }.items():  # fmt: skip
        monkeypatch.setattr(inspection, name, lambda *_, found=found: found)
    problem = SimpleNamespace(data=SimpleNamespace(start={}))
    declared = SimpleNamespace(problem=problem, rescale=lambda problem, _: (problem, change))
    found = inspection.adjust(declared, "none", 0.001, max_rounds=7)
    assert found.unsettled == unsettled and found.steps == (7 if unsettled else 1)


@pytest.mark.parametrize("observed, said", [({}, True), ({"c": 700.5}, False)])
def test_cameras_are_compared_with_what_was_observed(observed, said):
    """A camera that starts 0.5 mm from the observed value with a σ of 0.05 mm, and comes to it."""
    camera = dataclasses.replace(CAMERA, observed=observed)
    nothing = np.zeros((1, 3))
    images = Images(("F",), np.zeros(1, int), nothing, nothing, np.full((1, 6), np.nan))
    held, free = np.zeros((1, 6)), np.ones((1, 1))
    tables = [SimpleNamespace(name="image", free=held),
              SimpleNamespace(name="brown", free=free, parameters=("c",))]  # fmt: skip
    network = SimpleNamespace(images=images, cameras=(camera,))
    (column,) = columns_of_photographs(network, tables, {camera.id: ("brown", 0)})
    result = SimpleNamespace(
        estimate=np.array([0.5]), prior_change=np.array([column.prior]), names=[column.name],
        prior_sigma=np.array([column.sigma]),
    )  # fmt: skip
    assert bool(list(_beyond_priors(result, 0.001))) == said


@pytest.mark.parametrize("sigma, said", [(0.1, True), (2.0, False), (np.nan, False)])
def test_given_positions_of_photographs_are_priors(sigma, said):
    """A position that comes to lie 5 m away from where it was given with a σ."""
    nothing, of_image = np.zeros((1, 3)), np.full((1, 6), np.nan)
    of_image[0, 0] = sigma
    images = Images(("F",), np.zeros(1, int), nothing, nothing, of_image)
    tables = [SimpleNamespace(name="image", free=np.eye(6)[:1]),
              SimpleNamespace(name="brown", free=np.zeros((1, 1)))]  # fmt: skip
    network = SimpleNamespace(images=images, cameras=(CAMERA,))
    (column,) = columns_of_photographs(network, tables, {CAMERA.id: ("brown", 0)})
    result = SimpleNamespace(
        estimate=np.array([5.0]), prior_change=np.array([column.prior]), names=[column.name],
        prior_sigma=np.array([column.sigma]),
    )  # fmt: skip
    assert column.sigma == (np.inf if np.isnan(sigma) else sigma)
    assert bool(list(_beyond_priors(result, 0.001))) == said


@pytest.mark.parametrize("v, sigma0, said", [
    ([6.0, -2.0] * 8, 1.5, True), ([6.0, -2.0] * 8, 4.0, False), ([1.0, -2.0] * 8, 0.9, False),
])  # fmt: skip
def test_a_terrain_model_that_fits_worse_than_all_else_is_named(v, sigma0, said):
    """√(vᵀPv/Σr) of its heights, which is σ0 of these alone."""
    rows = [{"v": x, "r": 0.8, "removed": False} for x in v]
    rows += [{"v": 99.0, "r": np.nan, "removed": True}]
    inputs = SimpleNamespace(terrain=HeightModel(None, 2.0, "dem.tif"))
    result = SimpleNamespace(terrain_heights=lambda: rows, inputs=inputs, sigma0=sigma0)
    result.terrain_fit = fit = Refinement.terrain_fit.func(result)
    assert fit.ratio == pytest.approx(np.sqrt(np.mean(np.square(v)) / 0.8) / 2)
    warnings = list(_contradicted_terrain(result))
    assert bool(warnings) == fit.is_contradicted == said
    assert all("dem.tif does not fit: residuals of 16 heights are 2.5 times" in w and
               "on average 2 m above it" in w for w in warnings)  # fmt: skip


@pytest.mark.parametrize("image, hinted", [([0, 1, 1], False), ([0, 0, 1], True)])
def test_one_point_of_an_image_does_not_tell_that_columns_are_exchanged(image, hinted):
    xy = np.array([[100.0, 850.0], [200.0, 300.0], [200.0, 300.0]])
    observations = Observations(np.array(image), np.arange(3), xy, np.ones((3, 2)))
    points = local_points(["P", "Q", "R"], ["tie"] * 3, np.full((3, 3), np.nan))
    with pytest.raises(InputError, match="pixel 850 is off the image") as refused:
        check_observations([scanner(), scanner(id="B")], points, observations)
    assert ("check the columns" in str(refused.value)) == hinted


def test_images_whose_files_have_one_name_are_known_by_their_ids_only(tmp_path):
    """Of two images the last was taken for both."""
    for folder, one in zip("ab", block(rpc=2, scanner=0).images):
        (tmp_path / folder).mkdir()
        write_rpc(tmp_path / folder / "scene_RPC.TXT", one.image.rpc)
    point = "{} 10.0 20.0 100.0 1 1 1 {}.tif 50 60 1 1 B.tif 70 80 1 1\n"
    (tmp_path / "control.gcp").write_text(point.format(1, "scene") + point.format(2, "A"))
    (tmp_path / "refine.toml").write_text(
        '[refine]\nobservations = "control.gcp"\n'
        '[images]\nA = "a/scene_RPC.TXT"\nB = "b/scene_RPC.TXT"\n[unknowns]\nbias_degree = 0\n'
    )
    file = read_refinement(tmp_path / "refine.toml")
    assert file.observations.image.tolist() == [1, 0, 1]
    assert file.warnings[-1].endswith("whose name several of them have: scene.tif")
