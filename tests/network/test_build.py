"""Networks from plain tables: kinds of tables, units, σ, and complaints."""

import math

import numpy as np
import pandas
import pytest

from jaxbundle.errors import InputError
from jaxbundle.network import Camera
from jaxbundle.network.build import _colours, make_cameras, make_further, make_network
from jaxbundle.network.columns import Columns, RepeatedIds, did_you_mean, list_some
from jaxbundle.network.tables import EXTERIOR, Source
from jaxbundle.network.units import to_image_unit

CAMERAS = [{"id": "a", "c": 50.0, "free": "c, x0", "sigma": {"c": 0.1}}]
IMAGES = [
    {"id": 1, "camera": "a", "X0": 0, "Y0": 0.5, "Z0": 9, "omega": 10, "phi": None, "kappa": 200},
    {"id": 2, "camera": "a", "X0": 1, "Y0": 0.5, "Z0": 9, "omega": 10, "phi": -5.0, "kappa": 0},
]
POINTS = [
    {"id": "p", "role": "control", "X": 0.0, "Y": 1.0, "Z": 2.0, "sX": 0.1, "sY": "free", "sZ": 1},
    {"id": "q", "role": "tie", "X": None, "Y": None, "Z": None},
]
OBSERVATIONS = [
    {"image": 1, "point": "p", "x": 0.5, "y": -2, "sx": 0.2},
    {"image": 2, "point": "q", "x": 1.5, "y": 3, "sy": 0.3},
]


def build(cameras=CAMERAS, images=IMAGES, points=POINTS, observations=OBSERVATIONS, **options):
    return make_network(cameras, images, points, observations, **options)


def columns(rows):
    return {key: [row.get(key) for row in rows] for key in {k: 0 for row in rows for k in row}}


def assert_same(a, b):
    assert a.cameras == b.cameras
    assert (a.images.id, a.points.id, a.points.role) == (b.images.id, b.points.id, b.points.role)
    for table in ("images", "points", "observations", "distances"):
        for name, value in vars(getattr(a, table)).items():
            if isinstance(value, np.ndarray):
                np.testing.assert_array_equal(value, getattr(getattr(b, table), name))


def test_rows():
    network = build(sigma_image=0.7, angle_unit="gon")
    assert network.images.id == ("1", "2")
    np.testing.assert_allclose(network.images.angles[0], [math.pi / 20, np.nan, math.pi])
    np.testing.assert_array_equal(network.points.sigma, [[0.1, np.inf, 1], [np.nan] * 3])
    assert np.isnan(network.points.position[1]).all()
    np.testing.assert_array_equal(network.observations.sigma, [[0.2, 0.7], [0.7, 0.3]])
    assert network.observations.point.tolist() == [0, 1]
    assert network.cameras[0].free == ("c", "x0")
    assert len(network.distances) == 0


def test_columns_make_the_same_network():
    as_columns = build(
        images=columns(IMAGES), points=columns(POINTS), observations=columns(OBSERVATIONS)
    )
    assert_same(as_columns, build())


def test_data_frames_make_the_same_network():
    frames = build(
        cameras=pandas.DataFrame(CAMERAS),
        images=pandas.DataFrame(IMAGES),
        points=pandas.DataFrame(POINTS),
        observations=pandas.DataFrame(OBSERVATIONS),
        distances=pandas.DataFrame([{"from": "p", "to": "q", "value": 1, "sigma": 0.1}]),
    )
    distances = [{"from": "p", "to": "q", "value": 1.0, "sigma": 0.1}]
    assert_same(frames, build(distances=distances))


def test_a_data_frame_may_number_its_points_with_gaps():
    """A column of whole numbers with a missing value is float in pandas."""
    points = pandas.DataFrame({"id": [7.0, 8.0], "role": "tie", "X": 0, "Y": 0, "Z": 0})
    observations = {"image": [1], "point": [8], "x": [0.0], "y": [0.0]}
    network = build(points=points, observations=observations)
    assert network.points.id == ("7", "8")
    assert network.observations.point.tolist() == [1]


def test_start_values_of_images_may_be_left_out():
    """All of them, or positions or angles alone; half a position is a mistake."""
    bare = [{"id": row["id"], "camera": row["camera"]} for row in IMAGES]
    network = build(images=bare)
    assert np.isnan(network.images.position).all() and np.isnan(network.images.angles).all()
    placed = [row | {"X0": 1, "Y0": 2, "Z0": 3} for row in bare]
    network = build(images=placed)
    np.testing.assert_array_equal(network.images.position, [[1, 2, 3]] * len(bare))
    assert np.isnan(network.images.angles).all()
    with pytest.raises(InputError, match="column 'Y0' is missing; .* id, camera, X0, Y0, Z0$"):
        build(images=[row | {"X0": 1} for row in bare])


def test_fixed_and_prior_of_an_image():
    rows = [IMAGES[1] | {"sX0": "fixed", "sY0": 0.5, "somega": 0.1}]
    network = build(images=rows, observations=OBSERVATIONS[1:], angle_unit="deg")
    expected = [0, 0.5, np.nan, math.radians(0.1), np.nan, np.nan]
    np.testing.assert_allclose(network.images.sigma[0], expected)


def test_the_missing_sigma_is_told_when_none_is_given():
    rays = build(image_unit="px", cameras=PIXELS).observations
    assert (rays.sigma_origin, float(rays.sigma[0, 0])) == ("unit", 0.001)  # a pixel, in mm
    assert build(sigma_image=1.0).observations.sigma_origin == "stated"
    assert build(sigma_image=1.0).warnings == ()


@pytest.mark.parametrize("table, change, said", [
    ("images", {"camera": "b"}, "images, row 2: camera 'b' is unknown: no such camera"),
    ("images", {"id": ""}, "images, row 2: id is missing"),
    ("images", {"id": 1}, "images, row 2: image '1' is already in images, row 1"),
    ("images", {"omega": "x"}, "images, row 2: omega is 'x'; expected a number"),
    ("images", {"sphi": "free"}, "sphi is 'free'; expected a number or 'fixed'"),
    ("images", {"omeag": 1}, "images: unknown column 'omeag'; did you mean 'omega'"),
    ("points", {"id": "p"}, "points, row 2: point 'p' is already in points, row 1"),
    ("points", {"X": "nan"}, "points, row 2: X is 'nan'; expected a number"),
    ("points", {"sX": "inf"}, "sX is 'inf'; expected a number or 'free'"),
    ("points", {"X": [1]}, r"points, row 2: X is \[1\]; expected a number"),
    ("observations", {"image": "3"}, "observations, row 2: image '3' is unknown: no such image"),
    ("observations", {"point": "P"}, "row 2: point 'P' is unknown.* in points; did you mean 'p'"),
    ("observations", {"x": None}, "observations, row 2: x is missing"),
    ("observations", {"y": "1_0"}, "observations, row 2: y is '1_0'"),
])  # fmt: skip
def test_a_bad_row_is_refused_with_its_place(table, change, said):
    good = {"images": IMAGES, "points": POINTS, "observations": OBSERVATIONS}[table]
    with pytest.raises(InputError, match=said) as error:
        build(**{table: [good[0], good[1] | change]})
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("camera, said", [
    ({"c": 1.0}, "camera 1: id is missing"),
    ({"id": "a", "model": "brwn", "c": 1.0}, "camera 'a': unknown model 'brwn'; did you mean"),
    ({"id": "a", "c": "1"}, "camera 'a': c is '1'; expected a number"),
    ({"id": "a", "c": 1.0, "k1": 0}, "camera 'a': unknown key 'k1'; did you mean 'K1'"),
    ({"id": "a", "c": 1.0, "free": 3}, "camera 'a': free is 3; expected names"),
    ({"id": "a", "c": 1.0, "free": ["K7"]}, "camera 'a': free names the unknown parameter 'K7'"),
    ({"id": "a", "c": 1.0, "sigma": 0.1}, "camera 'a': sigma is 0.1; expected a table"),
    ({"id": "a", "c": 1.0, "image_size": 5}, "camera 'a': image_size is 5; expected two numbers"),
    ({"id": "a", "c": 1.0, "image_size": [5.5, 4]}, "whole numbers of pixels"),
    ({"id": "a", "c": 0}, "camera 'a': .*c must be positive"),
])  # fmt: skip
def test_a_bad_camera_is_refused(camera, said):
    with pytest.raises(InputError, match=said):
        make_cameras([camera])


@pytest.mark.parametrize("change, said", [
    ({"datum": "free"}, "datum must be one of"),
    ({"angle_unit": "grad"}, "angle_unit must be one of rad, deg, gon"),
    ({"image_unit": "um"}, "image_unit must be one of mm, px"),
    ({"sigma_image": 0.0}, "sigma_image is 0.0; it must be finite and positive"),
    ({"images": []}, "images: column 'id' is missing"),
    ({"images": {"id": []}}, "column 'camera' is missing"),
    ({"images": {"id": ["1"], "camera": []}}, "differ in length"),
    ({"points": [1, 2]}, "points: expected a data frame of pandas, a dict of columns, or a list"),
    ({"points": {"id": "p"}}, "points: column 'id' must be a sequence"),
    ({"cameras": []}, "no camera is given"),
    ({"cameras": [CAMERAS[0]] * 2}, "camera 'a' is already"),
    ({"datum_points": "p"}, "datum_points must be a list of ids, not 'p'"),
    ({"datum_points": 3}, "datum_points must be a list of ids, not 3"),
    ({"image_unit": "px"}, "camera 'a': pixel_size is needed to convert between pixels and mm"),
])  # fmt: skip
def test_bad_arguments_are_refused(change, said):
    with pytest.raises(InputError, match=said):
        build(**change)


PIXELS = [
    {"id": "a", "c": 50.0, "image_size": [4001, 3000], "pixel_size": [0.005, 0.004]},
    {"id": "cv", "model": "opencv", "fx": 900.0, "fy": 900.0, "image_size": [4001, 3000],
     "pixel_size": [0.005, 0.004]},
    {"id": "bal", "model": "snavely", "f": 900.0, "pixel_size": [0.005, 0.004]},
]  # fmt: skip
ONE_EACH = [IMAGES[0] | {"id": camera["id"], "camera": camera["id"]} for camera in PIXELS]


def one_each(uv, **options):
    rows = [
        {"image": camera["id"], "point": "p", "x": uv[0], "y": uv[1], "sx": 2.0, "sy": 2.0}
        for camera in PIXELS
    ]
    return build(cameras=PIXELS, images=ONE_EACH, observations=rows, **options)


def test_pixels_become_millimetres_where_the_model_wants_them():
    """The corner pixel's centre is half the image less half a pixel from the image centre."""
    network = one_each([0.0, 0.0], image_unit="px")
    mm = [-2000 * 0.005, 1499.5 * 0.004]
    np.testing.assert_allclose(network.observations.xy, [mm, [0, 0], [0, 0]], rtol=1e-15)
    np.testing.assert_allclose(network.observations.sigma, [[0.01, 0.008], [2, 2], [2, 2]])


def test_millimetres_become_pixels_where_the_model_wants_them():
    network = one_each([-2000 * 0.005, 1499.5 * 0.004], image_unit="mm")
    expected = [[-10, 5.998], [0, 0], [-2000, 1499.5]]
    np.testing.assert_allclose(network.observations.xy, expected, atol=1e-12)
    np.testing.assert_allclose(network.observations.sigma, [[2, 2], [400, 500], [400, 500]])


@pytest.mark.parametrize("unit", ["mm", "px"])
def test_image_coordinates_go_there_and_back(unit):
    network = one_each([7.25, -3.5], image_unit=unit)
    rays = network.observations
    camera = network.images.camera[rays.image]
    xy, sigma = to_image_unit(network.cameras, camera, rays.xy, rays.sigma, unit)
    np.testing.assert_allclose(xy, [[7.25, -3.5]] * 3, rtol=1e-13)
    np.testing.assert_allclose(sigma, 2.0)


def test_only_cameras_in_use_need_sizes():
    spare = {"id": "spare", "c": 1.0}
    build(cameras=[PIXELS[0], spare], image_unit="px")


def test_cameras_may_be_given_as_such():
    camera = Camera("a", "brown", {"c": 50.0})
    assert build(cameras=camera).cameras == (camera,)
    assert make_cameras({"id": "a", "c": 50.0}) == (camera,)


def test_names_are_listed_only_where_they_are_few():
    """A network may have thousands of images: of these only the closest one is named."""
    assert did_you_mean("i10", ["other", "more"]) == "; known: other, more"
    assert did_you_mean("i10", ["other", "more"], listing=False) == ""
    assert did_you_mean("othr", ["other", "more"], listing=False) == "; did you mean 'other'?"
    assert did_you_mean("i10", []) == ""


def test_a_distance_keeps_the_row_of_its_file():
    """For what is found later, such as a distance of a check point."""
    rows = {"from": ["p"], "to": ["q"], "value": [2.0], "sigma": [0.1]}
    network = build(distances=Columns(rows, Source("tape.csv", np.array([7]))))
    assert network.distances.source(0) == "tape.csv, row 7"


def test_unknown_images_of_priors_are_named_with_their_row():
    given = make_network(
        [{"id": "cam", "c": 100.0}],
        [{"id": id, "camera": "cam"} | dict.fromkeys(EXTERIOR, 0.0) for id in ("a", "b")],
        [{"id": "p", "role": "tie", "X": 0.0, "Y": 0.0, "Z": 0.0}],
        [{"image": id, "point": "p", "x": 0.0, "y": 0.0} for id in ("a", "b")],
        image_unit="mm",
    )
    row = dict.fromkeys(EXTERIOR, 0.0) | {f"s{name}": 0.1 for name in EXTERIOR}
    rows = [{"image": id} | row for id in ("a", "elsewhere")]
    (priors,) = make_further({"exterior_priors": rows}, 1.0)
    with pytest.raises(InputError, match="exterior_priors, row 2: .*'elsewhere'"):
        priors.check(given)


def test_ids_that_repeat_are_looked_up_once():
    """Columns of millions of rows: few labels and their codes, or whole numbers."""
    codes = np.array([2, 0, 0, 1])
    repeated = RepeatedIds(["a ", "b", "c"], codes)
    assert list(repeated) == ["c", "a ", "a ", "b"] and len(repeated) == 4 and repeated[3] == "b"
    table = Columns({"image": repeated, "point": np.array([7, 9, 7, 8])}, Source("t"))
    of = {"a": 0, "b": 1, "c": 2}
    assert table.indices("image", "image", of, "images").tolist() == [2, 0, 0, 1]
    points = {"7": 0, "8": 1, "9": 2}
    assert table.indices("point", "point", points, "points").tolist() == [0, 2, 0, 1]
    with pytest.raises(InputError, match="t, row 4: image 'b' is unknown"):
        table.indices("image", "image", {"a": 0, "c": 2}, "images")
    with pytest.raises(InputError, match="t, row 2: point '9' is unknown"):
        table.indices("point", "point", {"7": 0, "8": 1}, "points")


def test_a_message_lists_five_names_and_counts_the_others():
    """More would hide what it says about them."""
    assert list_some("abcde") == "'a', 'b', 'c', 'd', 'e'"
    assert list_some("abcdefg") == "'a', 'b', 'c', 'd', 'e' and 2 more"
    assert list_some(range(4), 2, str) == "0, 1 and 2 more"


def test_tables_of_no_kind_are_refused():
    with pytest.raises(InputError, match="unknown table 'antenas'; did you mean 'antennas'"):
        make_further({"antenas": []}, 1.0)


def test_ids_of_any_kind_are_looked_up_as_text():
    """An array of objects may mix numbers and texts."""
    of = {"a": 0, "3": 1, "7": 2}
    for ids in (np.array(["a", 3, 7.0], object), ["a", 3, 7.0], np.array(["a", "3", "7"])):
        rows = Columns({"image": ids}, Source("t")).indices("image", "image", of, "images")
        assert rows.tolist() == [0, 1, 2]
    for ids in (np.array([7, 3, 7]), np.array([7.0, 3.0, 7.0])):
        rows = Columns({"image": ids}, Source("t")).indices("image", "image", of, "images")
        assert rows.tolist() == [2, 1, 2]


def test_cameras_numbered_in_a_column_of_floats_have_the_ids_of_images():
    cameras = make_cameras({"id": np.array([1.0, 2.0]), "c": [10.0, 20.0]})
    assert [camera.id for camera in cameras] == ["1", "2"]


@pytest.mark.parametrize("bad", [-1, 256, 1.5])
def test_colours_are_whole_numbers_of_eight_bits(bad):
    """Points without one are grey."""
    colours = {"red": [0, 7, None], "green": [255, 8, None], "blue": [128, 9, None]}
    points = {"id": ["a", "b", "c"], "role": ["tie"] * 3} | dict.fromkeys("XYZ", [0.0] * 3)
    found = _colours(Columns(points | colours, Source("points")))
    assert found.tolist() == [[0, 255, 128], [7, 8, 9], [128] * 3]
    colours["green"] = [255, bad, None]
    with pytest.raises(InputError, match=f"points, row 2: green is {bad}.*from 0 to 255"):
        _colours(Columns(points | colours, Source("points")))
