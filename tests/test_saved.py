"""Adjustments saved, loaded and compared: nothing is lost, and differences have the σ they vary
with."""

import copy
import dataclasses
import json
import pickle

import jax.numpy as jnp
import numpy as np
import pytest

import jaxbundle
from jaxbundle.errors import InputError
from jaxbundle.io.results.result_json import result_text
from jaxbundle.leastsquares import Kind

CONVERGENT = "examples/convergent4/project.toml"


@pytest.fixture(autouse=True)
def in_the_repository(monkeypatch, request):
    monkeypatch.chdir(request.config.rootpath)


@pytest.fixture(scope="module")
def network(request):
    project = request.config.rootpath / CONVERGENT
    return jaxbundle.read_network(project, overrides=("sigma_image=1", "sigma_origin=unit"))


def saved(result, tmp_path, **given):
    result.save(tmp_path / "a.npz")
    return jaxbundle.load_adjustment(tmp_path / "a.npz", **given)


def numbers(value):
    return np.array([x for x in _leaves(value) if isinstance(x, int | float)])


def _leaves(value):
    parts = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return [x for part in parts for x in _leaves(part)] if parts or parts == [] else [value]


@pytest.mark.parametrize("options", [
    {}, pytest.param({"robust": "huber"}, marks=pytest.mark.further),
    {"snooping": "pope", "eliminate": True}, {"estimate_components": True},
], ids=lambda options: "-".join(options) or "plain")  # fmt: skip
def test_a_loaded_adjustment_has_all_that_the_saved_one_has(network, tmp_path, options):
    result = jaxbundle.adjust(network, **options)
    again = saved(result, tmp_path)
    assert again.report() == result.report()
    told = [json.loads("".join(result_text(one))) for one in (result, again)]
    assert numbers(told[1]) == pytest.approx(numbers(told[0]), rel=1e-9, abs=1e-12)
    name = ("camera", "cam", "c"), ("point", "7", "Z")
    assert again.covariance(*name) == pytest.approx(result.covariance(*name), rel=1e-9)
    assert (again.fingerprint, again.warnings) == (result.fingerprint, result.warnings)


def test_a_pickled_adjustment_is_the_saved_one(network):
    result = jaxbundle.adjust(network)
    again = pickle.loads(pickle.dumps(result))
    assert again.report() == result.report()
    assert copy.copy(result).report() == copy.deepcopy(result).report() == result.report()


@pytest.mark.further
def test_check_points_are_intersected_after_loading(tmp_path):
    given = jaxbundle.read_network("examples/resection63/project.toml")
    role = np.array(given.points.role, dtype=object)
    if "check" not in role:
        role[-1] = "check"
    points = dataclasses.replace(given.points, role=tuple(role))
    result = jaxbundle.adjust(given.replace(points=points))
    if result.check_points is not None:
        found = saved(result, tmp_path).check_points
        assert found.difference == pytest.approx(result.check_points.difference)


@pytest.mark.further
def test_observations_of_ones_own_are_asked_for(network, tmp_path):
    kind = Kind("height", lambda X, given: X[2:] - given, of=("point",))
    ids = np.array(network.points.id[:3], dtype=object)
    first = jaxbundle.adjust(network)
    at = [network.points.id.index(id) for id in ids]
    also = [kind((ids,), first.point_values[at, 2:], sigma=0.01)]
    result = jaxbundle.adjust(network, also=also)
    again = saved(result, tmp_path, also=also)
    assert again.report() == result.report()
    with pytest.raises(InputError, match=r"height.*also="):
        jaxbundle.load_adjustment(tmp_path / "a.npz")
    with pytest.raises(TypeError, match=r"height.*use save"):
        pickle.dumps(result)


@pytest.mark.parametrize("content", [b"", b"X,Y,Z\n1,2,3\n", b"PK\x03\x04 and no more", None])
def test_what_is_no_saved_adjustment_is_refused_in_a_line(tmp_path, content):
    path = tmp_path / "other.npz"
    if content is None:
        np.savez(path, uv=np.zeros((3, 2)))
    else:
        path.write_bytes(content)
    with pytest.raises(InputError, match="is not a saved adjustment") as caught:
        jaxbundle.load_adjustment(path)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)


def test_a_damaged_file_is_refused(network, tmp_path):
    jaxbundle.adjust(network).save(tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as file:
        arrays = dict(file)
    short = {**arrays, "array0": arrays["array0"][:-1]}
    np.savez(tmp_path / "short.npz", **short)
    head = arrays["head"].tobytes().decode()
    sigma0 = json.loads(head)["Stored"]["sigma0"]
    np.savez(tmp_path / "other.npz", **{
        **arrays, "head": np.frombuffer(head.replace(repr(sigma0), "0.5").encode(), np.uint8)
    })
    for name, said in (("short", "damaged|other version"), ("other", "its σ0 is 0.5, but")):
        with pytest.raises(InputError, match=said):
            jaxbundle.load_adjustment(tmp_path / f"{name}.npz")


# --- compared -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def epochs():
    """A network measured again and again, each time with errors of its own."""
    stations = jaxbundle.ring_of_stations(6, radius=10.0, height=6.0, roll_every=2)
    targets = jaxbundle.cloud_of_targets(12, (6.0, 6.0, 2.0), seed=3)
    camera = jaxbundle.Camera(
        "cam", "brown", {"c": 20.0}, ("c", "x0", "y0"), image_size=(4000, 3000),
        pixel_size=(0.005, 0.005),
    )  # fmt: skip
    return lambda seed: jaxbundle.simulate(stations, targets, camera, noise=0.001, seed=seed)


def points_of(found):
    return found.kind == "point"


@pytest.mark.further
def test_the_datum_does_not_matter_after_a_similarity(epochs):
    inner = jaxbundle.adjust(epochs(1).replace(datum="inner"))
    minimal = jaxbundle.adjust(epochs(1).replace(datum="minimal"))
    other = jaxbundle.adjust(epochs(2).replace(datum="inner"))
    first, second = (jaxbundle.compare(one, other) for one in (inner, minimal))
    assert first.t == pytest.approx(second.t, rel=1e-3, abs=1e-3)
    assert first.tests["points"].f == pytest.approx(second.tests["points"].f, rel=1e-4)
    assert first.tests["points"].rank == 3 * 12 - 7
    back = jaxbundle.compare(other, inner)
    assert back.t == pytest.approx(-first.t, rel=0.02, abs=0.02)  # in the scale of the other


@pytest.mark.further
def test_differences_vary_with_their_sigma(epochs):
    """Of independent measurements t has the variance of Student's t, F a mean of 1."""
    results = [jaxbundle.adjust(epochs(seed).replace(datum="inner")) for seed in range(10)]
    found = [jaxbundle.compare(a, b) for a, b in zip(results[::2], results[1::2])]
    t = np.concatenate([one.t for one in found])
    assert 0.85 < np.sqrt(np.mean(t**2)) < 1.2
    F = np.array([[test.f for test in one.tests.values()] for one in found])
    assert 0.6 < F.mean() < 1.5
    assert sum(one.differs.sum() for one in found) <= 2


@pytest.mark.further
def test_a_point_that_moved_is_found_and_told(epochs):
    stations = jaxbundle.ring_of_stations(6, radius=10.0, height=6.0, roll_every=2)
    targets = jaxbundle.cloud_of_targets(12, (6.0, 6.0, 2.0), seed=3)
    camera = epochs(1).cameras[0]
    shifted = np.array(targets, float)
    shifted[4] += [0.02, 0.0, 0.0]
    a = jaxbundle.adjust(epochs(1).replace(datum="inner"))
    after = jaxbundle.simulate(stations, shifted, camera, noise=0.001, seed=2)
    b = jaxbundle.adjust(after.replace(datum="inner"))
    stable = [id for k, id in enumerate(a.problem.network.points.id) if k != 4]
    found = jaxbundle.compare(a, b, held_by=stable)
    name = a.problem.network.points.id[4]
    at = points_of(found) & (found.id == name) & (found.parameter == "X")
    assert found.difference[at] == pytest.approx(0.02, abs=0.003) and found.differs[at].all()
    others = points_of(found) & (found.id != name)
    assert not found.differs[others].any()
    assert found.tests["points"].probability < 1e-6
    assert f"X of point {name}" in str(found) and len(str(found).splitlines()) < 24


@pytest.mark.further
def test_shared_measurements_are_not_tested(network):
    a, b = jaxbundle.adjust(network), jaxbundle.adjust(network, robust="huber")
    found = jaxbundle.compare(a, b)
    assert found.shared == len(network.observations) and not found.tests
    assert not found.differs.any() and "nothing is tested" in str(found)
    assert found.to_pandas().shape == (len(found), 11)
    same = jaxbundle.compare(a, a)
    assert np.abs(same.difference).max() < 1e-9


def test_what_cannot_be_compared_is_refused(network):
    a = jaxbundle.adjust(network)
    for b, said in ((3, "b must be an Adjustment"), (network, "load_adjustment")):
        with pytest.raises(InputError, match=said):
            jaxbundle.compare(a, b)
    for options, said in (
        ({"held_by": ["nowhere"]}, "'nowhere' are not in both"), ({"significance": 2}, "between"),
        ({"similarity": "yes"}, "True, False or None"),
        ({"held_by": ["1", "2"]}, "needs three points"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=said):
            jaxbundle.compare(a, a, **options)


def test_units_of_tables(network):
    result = jaxbundle.adjust(network)
    frame = result.to_pandas("images")
    assert frame.attrs["units"]["X0"] == network.object_unit
    assert frame.attrs["units"]["skappa"] == network.angle_unit
    assert frame.attrs["units"]["rms"] == "mm" and "id" not in frame.attrs["units"]
    headed = result.to_pandas("images", units=True)
    assert ("X0", network.object_unit) in headed.columns
    assert jnp.asarray(headed["X0"].to_numpy().ravel()).shape == (len(frame),)
