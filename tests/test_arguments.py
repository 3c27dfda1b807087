"""Unusable arguments of the public API are refused in one line, which names the argument and what
is expected; masks are honoured, complex and traced numbers refused."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pandas
import pytest
from numpy.testing import assert_allclose

import jaxbundle
from jaxbundle.arguments import numeric_array, one_of
from jaxbundle.network.columns import as_columns

NAN, EXAMPLE = float("nan"), Path(__file__).parents[1] / "examples" / "convergent4"
BOARD = jaxbundle.Board(4, 3, 0.1)
XY = np.random.default_rng(0).uniform(0, 100, (3, 12, 2))
STATIONS = dict(stations=4, radius=3.0, height=2.0)
BLOCK = dict(strips=2, images_per_strip=2, height=10.0, footprint=(5.0, 5.0))


def views(**given):
    fields = dict(board=BOARD, names=("a", "b", "c"), image_size=(100, 100), xy=XY)
    return jaxbundle.BoardViews(**fields | given)


def simulated(**given):
    stations = jaxbundle.ring_of_stations(**STATIONS)
    fields = dict(
        stations=stations, targets=jaxbundle.grid_of_targets(3, 3, 0.2), noise=0.001,
        camera=jaxbundle.Camera("cam", "brown", {"c": 24.0}, free=("c",)),
    )  # fmt: skip
    return jaxbundle.simulate(**fields | given)


def calls(result):
    """By the name of a function: how it is called with one bad argument, and which ones are bad."""
    network, problem = result.network, result.problem
    of_board = lambda **given: jaxbundle.Board(
        **{"columns": 9, "rows": 6, "square": 0.1, "kind": "charuco"} | given
    )
    return {
        "adjust": (lambda **given: jaxbundle.adjust(**{"network": network} | given), dict(
            network=[None, problem], method=["x", None], reduction=["x", 3],
            max_iterations=[0, 1.5, -1, None, True, "3", NAN, 10**30], robust=["x", True, []],
            snooping=["x", True], significance=[0, NAN, "a", None, 1j],
            critical_t=[-1, NAN, "x", None, 1j], eliminate=["x", 3], estimate_components=["no"],
            progress=[3],
        )),
        "orient": (jaxbundle.orient, dict(network=[None, 3])),
        "check_network": (jaxbundle.check_network, dict(network=[None, {}])),
        "make_problem": (
            lambda **given: jaxbundle.make_problem(**{"network": network} | given),
            dict(network=[None], reduction=["x", 3]),
        ),
        "solve": (lambda **given: jaxbundle.solve(**{"problem": problem} | given), dict(
            problem=[None, network], data=[3], sensitivity=["x", None], method=["x"],
            max_iterations=[0, 1.5], atol=[0, -1, NAN, "a"],
        )),
        "covariance": (lambda covariance: result.covariance(*covariance), dict(
            covariance=[(), ("c",), (("camera", "cam"),), (3,)],
        )),
        "insignificant": (result.insignificant, dict(critical=[-1, NAN, "a"])),
        "report": (result.report, dict(residual_limit=[-1, NAN, "a"])),
        "Board": (of_board, dict(
            columns=["a", 9.5, None, True], square=["a", NAN, None, 1j], marker=["a", -1], kind=[3],
        )),
        "BoardViews": (views, dict(
            board=["x", None], names=["abc", None, ("a", "a", "b")], image_size=[("a", "b"), None],
            xy=[XY.astype(complex), XY.astype(str), None],
        )),
        "calibrate": (lambda **given: jaxbundle.calibrate(**{"photographs": views()} | given), dict(
            photographs=[None, 3], model=["zz", None], free=["fx", 3, ["zz"], []],
            given=["fx", {"zz": 1}, {"fx": "a"}, {"fx": NAN}, {"fx": -1}, {"k1": 1j}],
            pixel_size=["a", -1, (1, 2, 3), 1j], sigma_image=[0, "a", NAN],
            board_sigma=["a", -1], robust=["x"], snooping=["x"], significance=[2, "a"],
            camera=[3, ""], max_iterations=[0, 1.5], object_unit=[3],
        )),
        "calibrate_cameras": (jaxbundle.calibrate_cameras, dict(photographs=[None, [views()], {}])),
        "calibrate_rig": (
            lambda **given: jaxbundle.calibrate_rig(
                **{"photographs": {"a": views(), "b": views()}} | given
            ),
            dict(
                photographs=[None, 3, [views()], {}, {"a": views()}, {"a": views(), "b": 3}],
                board=[3, {}, {"a:b": 3}, {"wall": 3}], seen_by=[{"x": ["a"]}, 3],
                bodies=[3, {"x": "y"}, {"x": [3]}], mountings=[{"a": 3}, 3], bases=[[3], "a"],
                snooping=["x"], significance=[2, "a"],
            ),
        ),
        "check_gradients": (
            lambda function=jnp.sin, **given: jaxbundle.check_gradients(function, 1.0, **given),
            dict(function=[3], directions=[0, 1.5], step=["a", 0], tolerance=[NAN]),
        ),
        "convert": (
            lambda **given: jaxbundle.convert(**{"input": EXAMPLE, "output": "a.ply"} | given),
            dict(input=[None, network], output=[None]),
        ),
        "read_network": (lambda **given: jaxbundle.read_network(**{"path": EXAMPLE} | given), dict(
            path=[None, network], format=[3, "zz"], overrides=["datum=inner", [3], 3],
        )),
        "write_project": (
            lambda **given: jaxbundle.write_project(**{"network": network, "folder": "x"} | given),
            dict(network=["x"], folder=[network]),
        ),
        "use_cores": (jaxbundle.use_cores, dict(number=[0, -1, "x"])),
        "keep_programs": (jaxbundle.keep_programs, dict(folder=[3])),
        "join_processes": (
            lambda **given: jaxbundle.join_processes("localhost:80", **given),
            dict(processes=["a", 1.5], process=[0.5, -1]),
        ),
        "simulate": (simulated, dict(
            stations=[None, np.zeros((3, 3))], targets=["a", np.ones((5, 3), complex)],
            camera=[None, "a"], noise=["a", -1, NAN, 1j, (1, 2, 3)], seed=["a", -1, 1.5],
            datum=["x"], residuals=["x"], image_format=["a", (1,), (-1, 2)],
            camera_of_station=["a", [9] * 4, [0]], start=["a"], disturb=["a", -1, NAN, (1, 2)],
            control=["a", [99], 3, [0.5]], control_sigma=["a", -1], check=[[99], ["a"]],
            distances=[[(0, 99)], "a", [(0,)], [(0, 0)]], distance_sigma=["a", -1, 0],
            normals=["a", (1, 2), (0, 0, 0)], max_incidence=["a", -1, NAN],
            max_rays=["a", 0, 1.5], min_rays=["a", -1], name=[3], object_unit=[3],
        )),
        "ring_of_stations": (lambda **given: jaxbundle.ring_of_stations(**STATIONS | given), dict(
            stations=[0, -1, 1.5, "a"], radius=["a", NAN, 0, -1, 1j], height=["a", NAN],
            look_at=["a", (0, 0), (0, 0, NAN)], roll_every=[-1, 1.5, "a"],
        )),
        "aerial_block": (lambda **given: jaxbundle.aerial_block(**BLOCK | given), dict(
            strips=[0, 1.5, "a"], images_per_strip=[0, 1.5], height=["a", NAN],
            footprint=["a", (1,), (1, NAN), (1, -1)], forward_overlap=[1, "a", NAN],
            side_overlap=[2], centre=["a", (0,)], heading=["a", NAN], tilt=["a", NAN],
        )),
        "grid_of_targets": (
            lambda **given: jaxbundle.grid_of_targets(
                **{"columns": 3, "rows": 3, "spacing": 0.1} | given
            ),
            dict(columns=[0, 1.5, "a"], rows=[-1], spacing=["a", NAN, (1, 2, 3), -1],
                 relief=["a", NAN, -1], seed=["a"], centre=["a", (0,)]),
        ),
        "cloud_of_targets": (
            lambda **given: jaxbundle.cloud_of_targets(**{"points": 3, "size": 1.0} | given),
            dict(points=[0, -1, 1.5, "a"], size=["a", NAN, (1, 2), -1], seed=["a", -1],
                 centre=["a"]),
        ),
        "stations_looking_at": (
            lambda **given: jaxbundle.stations_looking_at(
                **{"position": np.ones((2, 3)), "look_at": (0, 0, 0)} | given
            ),
            dict(position=["a", 3, [[0, 0]], [[0, 0, NAN]], np.ones((2, 3), complex)],
                 look_at=["a", (0, 0), (0, 0, NAN), np.zeros((5, 3))],
                 roll=["a", [1, 2, 3], NAN], up=["a", (0, 0), (0, 0, 0)]),
        ),
    }  # fmt: skip


SPELLED = {"pixel_size": "pixel", "residuals": "residuals", "camera_of_station": "camera_of",
           "photographs": "photograph", "mountings": "mounting"}  # fmt: skip


def test_what_cannot_be_used_is_refused_by_name(convergent4):
    wrong = []
    for function, (call, bad) in calls(convergent4).items():
        for name, values in bad.items():
            for value in values:
                try:
                    call(**{name: value})
                    said = "accepted"
                except jaxbundle.InputError as error:
                    said = str(error)
                    if SPELLED.get(name, name) in said and "\n" not in said and len(said) < 400:
                        continue
                    if (function, name) == ("calibrate", "photographs") and "board" in said:
                        continue
                except Exception as error:
                    said = f"{type(error).__name__}: {error}"
                wrong.append(f"{function}({name}={value!r:.30}): {said:.100}")
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("call", [
    jaxbundle.check_network, jaxbundle.make_problem,
    lambda path: jaxbundle.write_project(path, "x"),
])  # fmt: skip
def test_a_path_in_place_of_a_network_names_read_network(call):
    for path in ("block/project.toml", Path("block/project.toml")):
        with pytest.raises(jaxbundle.InputError) as error:
            call(path)
        assert "jaxbundle.read_network('block/project.toml')" in str(error.value)


# --- masks ------------------------------------------------------------------------------------


def tables(**observations):
    """A network of one image and four fixed points, by tables."""
    X = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.3]])
    given = {"image": ["1"] * 4, "point": list("abcd"), "x": np.arange(4.0), "y": np.arange(4.0)}
    return jaxbundle.make_network(
        {"id": "cam", "c": 10.0},
        {"id": ["1"], "camera": ["cam"], "X0": [0], "Y0": [0], "Z0": [5], "omega": [0], "phi": [0],
         "kappa": [0]},
        {"id": list("abcd"), "role": ["fixed"] * 4, **dict(zip("XYZ", X.T))},
        given | observations,
    )  # fmt: skip


def masked(values, place):
    return np.ma.masked_array(values, mask=np.arange(len(values)) == place)


def test_a_masked_cell_of_a_table_is_a_missing_value():
    sigma = masked(np.array([0.1, 0.2, 9e9, 0.4]), 2)
    found = tables(sx=sigma, sy=sigma)
    assert_allclose(found.observations.sigma[:, 0], [0.1, 0.2, 1.0, 0.4])
    with pytest.raises(jaxbundle.InputError, match="observations, row 2: x is missing"):
        tables(x=masked(np.arange(4.0), 1))
    with pytest.raises(jaxbundle.InputError, match="observations, row 3: point is missing"):
        tables(point=masked(np.array(list("abcd")), 2))
    rows = [{"id": "1", "X": np.ma.masked}, {"id": "2", "X": 3}, {"id": "3", "X": pandas.NA}]
    assert_allclose(as_columns(rows, "points").numbers("X"), [NAN, 3, NAN])
    nullable = {"X": pandas.array([1, None, 3], dtype="Int64")}
    assert_allclose(as_columns(nullable, "points").numbers("X"), [1, NAN, 3])
    assert_allclose(as_columns(pandas.DataFrame(nullable), "points").numbers("X"), [1, NAN, 3])


@pytest.mark.parametrize("column, said", [
    (np.ones((4, 1)), "column 'x' must have one dimension"),
    (np.array(3.0), "one dimension"),
    (np.ones(4, complex), "row 1: x is"),
    ([1.0, 2.0, np.complex64(3), 4.0], "row 3: x is"),
    (pandas.DataFrame({"a": [1, 2, 3, 4]}), "one dimension"),
], ids=["2-D", "0-D", "complex", "one complex", "a data frame"])  # fmt: skip
def test_columns_that_are_none(column, said):
    with pytest.raises(jaxbundle.InputError) as error:
        tables(x=column)
    assert said in str(error.value) and "observations" in str(error.value)


def test_tables_that_are_none():
    twice = pandas.DataFrame([[1, 2]], columns=["X", "X"])
    for table, said in ((twice, "two columns are called 'X'"), (None, "expected a data frame"),
                        (3, "expected a data frame"), ("images.csv", "dict rows")):  # fmt: skip
        with pytest.raises(jaxbundle.InputError, match=said):
            as_columns(table, "points")
    with pytest.raises(jaxbundle.InputError, match="cameras: expected Camera"):
        jaxbundle.make_network(None, {}, {}, {})


def test_masks_of_arrays_become_nan():
    mask = XY > 50
    rows = [np.ma.masked_array(*part) for part in zip(XY, mask)]
    for given in (np.ma.masked_array(XY, mask), rows, [[*part] for part in rows]):
        assert_allclose(numeric_array("xy", given, "pixels"), np.where(mask, NAN, XY))
        np.testing.assert_array_equal(views(xy=given).visible, ~mask.any(2))
    whole = np.ma.masked_array([1, 2, 3], mask=[0, 1, 0])
    assert_allclose(numeric_array("n", whole, "numbers"), [1, NAN, 3])


@pytest.mark.parametrize("call, said", [
    (lambda: numeric_array("xy", [1j], "pixels"), "xy must be pixels, but contains complex"),
    (lambda: numeric_array("xy", "a", "pixels"), "xy must be pixels, but is 'a'"),
    (lambda: one_of("snooping", True, ("pope",), allow_none=True),
     "must be pope or None, not True"),
    (lambda: one_of("unit", "m", ("mm", "px")), "unit must be one of mm, px, not 'm'"),
])  # fmt: skip
def test_messages_say_what_is_expected_and_what_is_found(call, said):
    with pytest.raises(jaxbundle.InputError, match=said):
        call()


@pytest.mark.parametrize("transform", ["jit", "vmap", "grad"])
def test_what_is_traced_is_refused(transform):
    of = {"jit": jax.jit, "vmap": jax.vmap, "grad": jax.grad}[transform]
    image_points = jnp.zeros((2, 3, 12, 2))

    def rms(shift):
        return jaxbundle.calibrate_batch(BOARD.points, image_points + shift, (100, 100)).rms[0]

    def number(shift):
        return tables(x=shift * jnp.ones(4)).observations.xy[0, 0]

    for function, name in ((rms, "image_points"), (number, "column 'x'")):
        with pytest.raises(jaxbundle.InputError) as error:
            of(function)(jnp.ones(2) if transform == "vmap" else 1.0)
        assert name in str(error.value) and "traced by JAX" in str(error.value)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("function", [
    "absolute_orientation", "direct_linear_transformation", "homography", "intersection",
    "resection", "relative_orientation", "eight_points", "five_points",
])  # fmt: skip
@pytest.mark.parametrize("place", [0, 1])
def test_a_masked_array_is_never_taken_as_numbers_by_an_orientation(function, place):
    given = [np.ones((8, 3)), np.ones((8, 3))]
    given[place] = np.ma.masked_array(given[place], given[place] > 2)
    with pytest.raises(jaxbundle.errors.InputError, match=f"{function}: a masked array"):
        getattr(jaxbundle.orientation, function)(*given)
