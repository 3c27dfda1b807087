"""Every fault of a network is refused in one line that names the place, the thing, the remedy."""

import dataclasses
import re
import time

import jax
import numpy as np
import pytest

from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.geometry import matrix_from_omega_phi_kappa
from jaxbundle.network import Camera, Network
from jaxbundle.network.build import make_network
from jaxbundle.network.check import _note_points_behind, check_network
from jaxbundle.network.equation_counts import label_connected_parts
from jaxbundle.network.rules import check_camera
from jaxbundle.network.subsets import split_check_points
from jaxbundle.planning.simulate import simulate
from jaxbundle.planning.stations import aerial_block, cloud_of_targets

RNG = np.random.default_rng(3)
GROUND = RNG.uniform(-10, 10, (8, 3)) * [1, 1, 0.1]


def tables(images=3, points=8):
    """A valid network looking down on `points` points, every image seeing all; a dict to break."""
    return {
        "cameras": [{"id": "cam", "c": 100.0, "free": ["c"], "sigma": {"c": 0.1}}],
        "images": [
            {"id": f"i{k}", "camera": "cam", "X0": 5.0 * k, "Y0": 0.0, "Z0": 50.0,
             "omega": 0.0, "phi": 0.0, "kappa": 0.1 * k}
            for k in range(images)
        ],
        "points": [
            {"id": f"p{k}", "role": "tie", "X": X, "Y": Y, "Z": Z, "sX": None, "sY": None,
             "sZ": None}
            for k, (X, Y, Z) in enumerate(GROUND[:points].tolist())
        ],
        "observations": [
            {"image": f"i{i}", "point": f"p{k}", "x": 1.0 * k, "y": 1.0 * i, "sx": 0.01, "sy": 0.01}
            for i in range(images) for k in range(points)
        ],
        "distances": [{"from": "p0", "to": "p1", "value": 3.0, "sigma": 0.01}],
        "datum": "inner",
    }  # fmt: skip


def network(**changes) -> Network:
    return make_network(**{**tables(), **changes})



def broken(table, k, **changes):
    given = tables()
    given[table][k].update(changes)
    return make_network(**given)


def without_rays(keep) -> dict:
    given = tables()
    given["observations"] = [o for o in given["observations"] if keep(o)]
    return given


def test_a_valid_network_passes_unchanged():
    before = network()
    after = check_network(before)
    assert after.warnings == ()
    assert str(after) == str(before)
    assert after.points.id == before.points.id


CONTROL = {"role": "control"}
SIGMA = {"sX": 0.1, "sY": 0.1, "sZ": 0.1}


@pytest.mark.parametrize("table, k, change, said", [
    ("images", 1, {"X0": np.inf}, ["images, row 2", "'i1'", "X0", "infinite"]),
    ("images", 1, {"phi": None}, ["images, row 2", "'i1'", "phi", "give start values"]),
    ("images", 2, {"omega": 45.0}, ["images, row 3", "'i2'", "omega", "45", "degrees"]),
    ("images", 0, {"sX0": -1.0}, ["images, row 1", "'i0'", "σ of X0", "-1", "positive"]),
    ("images", 0, {"sphi": "fixed"}, ["images, row 1", "'i0'", "all three"]),
    ("points", 2, {"X": np.inf}, ["points, row 3", "'p2'", "X", "infinite"]),
    ("points", 2, {"Z": None}, ["points, row 3", "tie point 'p2'", "Z", "give start values"]),
    ("points", 2, {"role": "controll"}, ["points, row 3", "'p2'", "role", "tie, control, fixed"]),
    ("points", 2, {"role": "check", "Y": None}, ["points, row 3", "'p2'", "Y is missing"]),
    ("points", 2, {**CONTROL, **SIGMA, "sY": 0.0}, ["points, row 3", "'p2'", "σ of Y", "positive"]),
    ("points", 2, {**CONTROL, **SIGMA, "sX": 1e-300},
     ["points, row 3", "'p2'", "σ of X is 1e-300", "between 1e-75 and 1e+75", "empty to hold"]),
    ("points", 2, {**CONTROL, **SIGMA, "sY": 1e308}, ["σ of Y is 1e+308", "between", '"free"']),
    ("images", 0, {"sX0": 1e-76}, ["images, row 1", "'i0'", "σ of X0 is 1e-76", "between"]),
    ("observations", 9, {"sx": 1e76}, ["observations, row 10", "1e+76", "between 1e-75"]),
    ("distances", 0, {"sigma": 1e-200}, ["distances, row 1", "sigma is 1e-200", "between"]),
    ("distances", 0, {"value": 1e200}, ["distances, row 1", "value is 1e+200", "between"]),
    ("points", 2, {**CONTROL, **SIGMA, "sZ": None}, ["row 3", "'p2'", "σ of Z", "free"]),
    ("observations", 9, {"sy": -3.1},
     ["observations, row 10", "σ of y", "'p1'", "'i1'", "-3.1", "finite and positive"]),
    ("observations", 9, {"sx": 1e-200}, ["row 10", "σ of x", "1e-200", "less than the last digit"]),
    ("observations", 9, {"sx": np.inf}, ["observations, row 10", "σ of x", "'p1'", "'i1'"]),
    ("observations", 9, {"x": -np.inf}, ["observations, row 10", "x of point 'p1'", "'i1'"]),
    ("observations", 9, {"point": "p0"},
     ["observations, row 10", "'p0'", "'i1'", "already in observations, row 9"]),
    ("distances", 0, {"to": "p0"}, ["distances, row 1", "'p0' to 'p0'", "two different"]),
    ("distances", 0, {"value": -3.0}, ["distances, row 1", "'p0' to 'p1'", "value", "positive"]),
    ("distances", 0, {"sigma": 0.0}, ["distances, row 1", "sigma", "positive"]),
    ("points", 1, {"role": "check"}, ["distances, row 1", "check point", "remove the distance"]),
])  # fmt: skip
def test_a_bad_value_is_refused_with_its_place(table, k, change, said):
    with pytest.raises(InputError) as error:
        check_network(broken(table, k, **change))
    assert "\n" not in str(error.value)
    for words in said:
        assert words in str(error.value)


@pytest.mark.parametrize("missing, more", [(1, ""), (2, " (and 1 more)")])
def test_the_other_images_without_a_start_value_are_counted(missing, more):
    given = tables()
    for image in given["images"][:missing]:
        image["phi"] = None
    with pytest.raises(InputError) as error:
        check_network(make_network(**given))
    assert f"image 'i0': phi has no start value{more}; give start values" in str(error.value)


@pytest.mark.parametrize("camera, said", [
    (Camera("cam", "browm", {"c": 1.0}), ["'cam'", "browm", "did you mean 'brown'"]),
    (Camera("cam", "brown", {"c": 0.0}), ["'cam'", "c must be positive"]),
    (Camera("cam", "brown"), ["'cam'", "c is missing"]),
    (Camera("cam", "brown", {"c": 1.0, "k1": 0.0}), ["'cam'", "'k1'", "did you mean 'K1'"]),
    (Camera("cam", "brown", {"c": 1.0, "K1": np.nan}), ["'cam'", "K1", "finite"]),
    (Camera("cam", "brown", {"c": 1.0}, ("cc",)), ["'cam'", "'cc'", "did you mean 'c'"]),
    (Camera("cam", "brown", {"c": 1.0}, ("c", "c")), ["'cam'", "c twice"]),
    (Camera("cam", "brown", {"c": 1.0}, ("r0",)), ["'cam'", "r0", "cannot be estimated"]),
    (Camera("cam", "brown", {"c": 1.0}, (), {"c": 1.0}), ["'cam'", "'c'", "not free"]),
    (Camera("cam", "brown", {"c": 1.0}, ("c",), {"c": 0.0}), ["'cam'", "sigma of c", "positive"]),
    (Camera("cam", "brown", {"c": 1.0}, ("c",), {"c": 1e-90}), ["sigma of c is 1e-90", "between"]),
    (Camera("cam", "brown", {"c": 1.0}, image_size=(0, 5)), ["'cam'", "image_size", "positive"]),
])  # fmt: skip
def test_a_bad_camera_is_refused(camera, said):
    with pytest.raises(InputError) as error:
        check_network(network().replace(cameras=(camera,)))
    for words in said:
        assert words in str(error.value)


@pytest.mark.parametrize("change, said", [
    ({"datum": "innner"}, "datum must be one of control, inner, minimal"),
    ({"residuals": "raw"}, "residuals must be one of corrected, measured"),
    ({"datum_points": ("p0", "q")}, "datum_points: no such point 'q' in points"),
    ({"cameras": ()}, "no camera"),
])  # fmt: skip
def test_bad_settings_are_refused(change, said):
    with pytest.raises(InputError, match=said):
        check_network(network().replace(**change))


def test_datum_points_must_be_free_points():
    with pytest.raises(InputError, match="'p3' is a fixed point; name tie points"):
        check_network(broken("points", 3, role="fixed").replace(datum_points=("p3",)))


def test_datum_points_of_a_datum_by_control_are_warned_of():
    given = tables()
    for k in range(4):
        given["points"][k] |= {"role": "control", **SIGMA}
    checked = check_network(make_network(**{**given, "datum": "control", "datum_points": ["p5"]}))
    assert any("datum_points are not used" in warning for warning in checked.notes)
    for change in ({"datum_points": ()}, {"datum": "inner"}):
        assert check_network(checked.replace(notes=(), **change)).notes == ()


@pytest.mark.parametrize("table", ["images", "points"])
def test_duplicate_ids_are_refused_with_both_rows(table):
    good = network()
    rows = getattr(good, table)
    doubled = dataclasses.replace(rows, id=(rows.id[1], *rows.id[1:]))
    with pytest.raises(InputError, match=f"{table}, row 2: .*already in {table}, row 1"):
        check_network(good.replace(**{table: doubled}))


def test_an_empty_table_an_index_outside_and_a_wrong_shape_are_refused():
    good = network()
    none = good.observations.take(np.zeros(len(good.observations), bool))
    with pytest.raises(InputError, match="observations: the table is empty"):
        check_network(good.replace(observations=none))
    outside = dataclasses.replace(good.observations, point=good.observations.point + 1)
    with pytest.raises(InputError, match="observations, row 8: point index 8 is not among the 8"):
        check_network(good.replace(observations=outside))
    short = dataclasses.replace(good.points, position=good.points.position[:-1])
    with pytest.raises(InputError, match="points: position has the shape"):
        check_network(good.replace(points=short))


def test_masked_numbers_given_directly_are_missing_ones():
    """Without a warning of numpy, which the tests would raise."""
    valid = network()
    rays = valid.observations
    hidden = np.ma.masked_array(rays.xy, np.arange(rays.xy.size).reshape(rays.xy.shape) == 3)
    with pytest.raises(InputError, match="observations, row 2: y of point 'p1'.* is nan"):
        check_network(valid.replace(observations=dataclasses.replace(rays, xy=hidden)))
    with pytest.raises(InputError, match="observations: point has masked values"):
        dataclasses.replace(rays, point=np.ma.masked_equal(rays.point, 2))


def test_control_points_without_sigma_become_fixed_and_without_axes_tie():
    given = tables()
    given["points"][0].update(CONTROL)
    given["points"][1].update(CONTROL, sX="free", sY=0.1, sZ=0.1)
    given["points"][2].update(CONTROL, sX="free", sY="free", sZ="free")
    given["points"][3].update(sX=0.1)
    checked = check_network(make_network(**given))
    assert checked.points.role[:4] == ("fixed", "control", "tie", "tie")
    assert np.isposinf(checked.points.sigma[1, 0])
    assert "all axes free" in " ".join(checked.notes)
    assert "σ of 1 tie or fixed point not used" in " ".join(checked.notes)


def test_rows_about_check_points_are_left_out_with_a_note():
    given = tables()
    given["points"][2].update(CONTROL, role="check")
    ids = [p["id"] for p in given["points"]]
    rows = {"from": [ids[0], ids[2], ids[1]], "to": [ids[1], ids[0], ids[3]], "dZ": [0.1] * 3}
    rows |= {"sdZ": [0.1] * 3}
    checked = check_network(make_network(**given, differences=rows))
    assert "row 2: 1 of 3 differences are about check points" in " ".join(checked.notes)


def test_points_with_too_few_rays_are_left_out_with_a_warning():
    given = without_rays(lambda o: not (
        o["point"] == "p5" or (o["point"] in ("p6", "p7") and o["image"] != "i0")
    ))  # fmt: skip
    given["points"][7]["role"] = "fixed"
    given["datum_points"] = ["p0", "p1", "p2", "p5"]
    checked = check_network(make_network(**given))
    assert checked.points.id == ("p0", "p1", "p2", "p3", "p4", "p7")
    assert checked.datum_points == ("p0", "p1", "p2")
    assert len(checked.observations) == 5 * 3 + 1
    assert checked.points.id[checked.observations.point[-1]] == "p4"
    assert "1 point without any ray: 'p5'" in checked.notes[0]
    # nothing is lost of points that rays do not determine
    assert [left.measured for left in checked.left_out] == [False, False]
    assert "1 tie point with a single ray: 'p6'" in checked.notes[1]
    assert checked.points.source(5) == "points, row 8"
    assert check_network(checked).notes == checked.notes


def test_a_point_hangs_on_rays_and_distances_together():
    """One ray and one distance determine a point; a chain of points without rays falls apart."""
    given = without_rays(lambda o: o["point"] not in ("p5", "p6", "p7") or (
        o["point"] == "p5" and o["image"] == "i0"
    ))  # fmt: skip
    distance = {"value": 1.0, "sigma": 0.1}
    given["distances"] = [
        {"from": a, "to": b, **distance}
        for a, b in [("p5", "p0"), ("p6", "p1"), ("p6", "p2"), ("p6", "p7")]
    ]
    checked = check_network(make_network(**given))
    assert checked.points.id == ("p0", "p1", "p2", "p3", "p4", "p5")
    assert len(checked.distances) == 1
    assert "left out 3 distances" in " ".join(checked.notes)


def test_distances_between_fixed_points_are_left_out():
    given = tables()
    given["points"][0]["role"] = given["points"][1]["role"] = "fixed"
    checked = check_network(make_network(**given))
    assert len(checked.distances) == 0
    assert checked.notes[0].endswith("1 distance between fixed points: 'p0' to 'p1'")
    given["points"][2]["role"] = "fixed"
    given["distances"] *= 2
    given["distances"][1] = given["distances"][1] | {"to": "p2"}
    (note,) = check_network(make_network(**given)).notes
    assert note.endswith("2 distances between fixed points: 'p0' to 'p1' …")


def test_cameras_without_images_are_left_out():
    cameras = [{"id": "spare", "c": 1.0}, *tables()["cameras"]]
    checked = check_network(network(cameras=cameras))
    assert [camera.id for camera in checked.cameras] == ["cam"]
    assert (checked.images.camera == 0).all()
    assert "'spare'" in checked.notes[0]


FEW = {
    "no rays": lambda o: False,
    "only 2 points can be used; .* at least 3": lambda o: o["point"] in ("p0", "p1"),
    "X0, .* of image i1 nor X, Y, Z of points 'p4', 'p5'": lambda o: o["point"] in ("p4", "p5"),
}


@pytest.mark.parametrize("said, keep", FEW.items())
def test_images_without_enough_points_are_left_out_by_name(said, keep):
    """One of three is left out, with the points that only it shares with another; one of two is
    refused."""
    given = without_rays(lambda o: o["image"] != "i1" or keep(o))
    found = check_network(make_network(**given))
    assert found.images.id == ("i0", "i2") and len(found.points) == 8
    (left,) = found.left_out
    assert (left.thing, left.names) == ("image", ("i1",)) and "too few points" in left.why
    assert left.measured  # a photograph is always lost
    assert "left out 1 image" in " ".join(found.notes)
    given["images"][1] |= {"sX0": 0.1, "sY0": 0.1}
    kept = "i1" in check_network(make_network(**given)).images.id
    assert kept == (said != "no rays")


@pytest.mark.parametrize("said, keep", FEW.items())
def test_half_of_the_images_without_enough_points_are_refused(said, keep):
    given = tables(images=2)
    lone = ("p4", "p5", "p6")
    share = lambda o: o["point"] not in lone if o["image"] == "i0" else keep(o)
    if said.startswith("X0"):
        share = lambda o: (o["image"] == "i1") == (o["point"] in lone)
    given["observations"] = [o for o in given["observations"] if share(o)]
    with pytest.raises((InputError, NotSolvedError), match=f"image 'i[01]': .*{said}"):
        check_network(make_network(**given))


def two_parts(**changes):
    """Images i0, i1 see p0 to p3, images i2, i3 see p4 to p7."""
    given = tables(images=4)
    given["observations"] = [
        o for o in given["observations"]
        if (o["image"] in ("i0", "i1")) == (o["point"] in ("p0", "p1", "p2", "p3"))
    ]
    for k in range(4):
        given["points"][k] |= changes
    return make_network(**given)


def test_disconnected_parts_need_a_datum_of_their_own():
    with pytest.raises(InputError, match="2 parts .* 0 known points: 2 images 'i0', 'i1'"):
        check_network(two_parts())
    with pytest.raises(InputError, match="2 images 'i2', 'i3'; measure common points"):
        check_network(two_parts(role="fixed"))
    both = two_parts()
    fixed = dataclasses.replace(both.points, role=("fixed",) * 8)
    check_network(both.replace(points=fixed))


def test_connected_parts_of_long_strips():
    """Two strips in random order, each image sharing a point with the next one only."""
    order = RNG.permutation(2000)
    first, second = order[:1200], order[1200:]
    image = np.concatenate([first[:-1], first[1:], second[:-1], second[1:]])
    point = np.concatenate([np.arange(1199)] * 2 + [np.arange(1199, 1998)] * 2)
    label = label_connected_parts(image, point, 2000, 1998)
    assert set(label[first]) == {first.min()}
    assert set(label[second]) == {second.min()}


def test_too_few_observations_are_counted():
    given = tables(images=2, points=4)
    given.update(distances=None, cameras=[{"id": "cam", "c": 1.0, "free": "c,x0,y0"}])
    with pytest.raises(InputError, match="16 observations with 7 datum .* 27 unknowns: 4 missing"):
        check_network(make_network(**given))


def test_points_behind_their_camera_are_warned_of():
    checked = check_network(broken("points", 3, Z=60.0))
    assert "3 image points behind the camera: point 'p3' in image 'i0'" in checked.notes[0]
    assert "'i2'; check" in checked.notes[0]
    # a fisheye sees them
    fisheye = Camera("cam", "kannala-brandt", {"fx": 100.0, "fy": 100.0})
    assert _note_points_behind(broken("points", 3, Z=60.0).replace(cameras=(fisheye,))).notes == ()
    # of more the first three
    given = tables()
    for k in (3, 4):
        given["points"][k]["Z"] = 60.0
    (note,) = check_network(make_network(**given)).notes
    assert "6 image points behind the camera" in note and note.count("point 'p") == 3
    assert " …; check the start values" in note


def test_the_side_of_a_point_agrees_with_the_rotation_matrix():
    given = tables()
    angles = RNG.uniform(-3, 3, (3, 3))
    for image, (omega, phi, kappa) in zip(given["images"], angles):
        image |= {"omega": omega, "phi": phi, "kappa": kappa}
    net = make_network(**given)
    M = np.asarray(jax.vmap(matrix_from_omega_phi_kappa)(angles))
    ray = net.points.position[None] - net.images.position[:, None]
    behind = (np.einsum("ij,ipj->ip", M[:, 2], ray) >= 0).sum()
    assert f"put {behind} image points behind" in check_network(net).notes[0]


def test_check_points_are_set_aside():
    given = tables()
    given["points"][2]["role"] = "check"
    given["points"][6]["role"] = "check"
    checked = check_network(make_network(**given))
    assert len(checked.points) == 8
    adjusted, points, observations = split_check_points(checked)
    assert adjusted.points.id == ("p0", "p1", "p3", "p4", "p5", "p7")
    assert points.id == ("p2", "p6") and points.source(1) == "points, row 7"
    assert observations.point.tolist() == [0, 1] * 3
    assert observations.image.tolist() == [0, 0, 1, 1, 2, 2]
    ids = [adjusted.points.id[p] for p in adjusted.observations.point[:6]]
    assert ids == ["p0", "p1", "p3", "p4", "p5", "p7"]
    assert [adjusted.points.id[p] for p in adjusted.distances.points[0]] == ["p0", "p1"]
    again = check_network(adjusted)
    assert str(again) == str(adjusted)


def test_a_check_point_with_a_single_ray_cannot_be_compared():
    given = without_rays(lambda o: o["point"] != "p2" or o["image"] == "i0")
    given["points"][2]["role"] = "check"
    checked = check_network(make_network(**given))
    assert "p2" not in checked.points.id
    assert "check point with fewer than two rays: 'p2'" in checked.notes[0]


def test_a_large_network_is_checked_quickly():
    images, points, rays = 60, 26_000, 180_000
    key = np.sort(RNG.choice(images * points, rays, replace=False))
    XYZ = RNG.uniform(-1, 1, (points, 3))
    net = make_network(
        [{"id": "cam", "c": 100.0}],
        [{"id": i, "camera": "cam", "X0": 0, "Y0": 0, "Z0": 9, "omega": 0, "phi": 0, "kappa": 0}
         for i in range(images)],
        {"id": np.arange(points), "role": ["tie"] * points,
         "X": XYZ[:, 0], "Y": XYZ[:, 1], "Z": XYZ[:, 2]},
        {"image": key // points, "point": key % points, "x": key * 1e-5, "y": key * 1e-5},
        datum="inner",
    )  # fmt: skip
    start = time.perf_counter()
    check_network(net)
    assert time.perf_counter() - start < 3  # 0.1 s on an idle machine


@pytest.mark.parametrize("off, said", [(0.0, "refused"), (0.3, "warned"), (60.0, "nothing")])
def test_a_single_strip_with_gnss_alone_does_not_fix_its_roll(off, said):
    """The axis goes through all projection centres; one that lies off it fixes the roll."""
    stations = aerial_block(
        1, 5, height=1000, footprint=(920, 600), forward_overlap=0.6, side_overlap=0.3
    )
    position = stations.position + np.outer([0, off, 0, -off, 0], [0, 0, 1])
    stations = type(stations)(position, stations.angles)
    targets = cloud_of_targets(60, (2500, 550, 80.0), seed=1)
    network = simulate(
        stations, targets, Camera("a", "brown", {"c": 100.0}), noise=0.0, image_format=(92.0, 60.0)
    )
    sigma = np.full((5, 6), np.nan)
    sigma[:, :3] = 0.05
    images = dataclasses.replace(network.images, sigma=sigma)
    network = network.replace(images=images, datum="control")
    if said == "refused":
        with pytest.raises(InputError, match="5 projection centres .* on one line .* axis of the"):
            check_network(network)
        assert check_network(network.replace(datum="inner"))
        sigma = sigma.copy()
        sigma[0, 3:] = 1e-4
        network = network.replace(images=dataclasses.replace(images, sigma=sigma))
    told = [text for text in check_network(network).warnings if "roll" in text]
    assert len(told) == (said == "warned")
    if told:
        # σ over √Σs², s the heights left by a straight line through −2 … 2
        x, z = np.arange(-2, 3), np.array([0, off, 0, -off, 0])
        left = z - np.polyval(np.polyfit(x, z, 1), x)
        roll = np.degrees(0.05 / np.sqrt(left @ left))
        assert float(told[0].split("about ")[-1].split("°")[0]) == pytest.approx(roll, rel=0.02)


@pytest.mark.parametrize("field, value, message", [
    ("id", None, "id of a camera must be a text, but is None"),
    ("model", 5, "camera 'cam': model is 5; expected a name or a CameraModel"),
    ("parameters", [20.0], "camera 'cam': parameters is [20.0]; expected numbers by name"),
    ("sigma", 0.1, "camera 'cam': sigma is 0.1; expected numbers by name"),
    ("free", "c", "camera 'cam': free is 'c'; expected names of parameters"),
    ("tie", ["c", "x0"], "camera 'cam': tie is ['c', 'x0']; expected groups of names"),
    ("pixel_size", 0.005, "camera 'cam': pixel_size is 0.005; expected [width, height] in mm"),
])  # fmt: skip
def test_fields_of_a_camera_of_another_kind(field, value, message):
    fields = {"id": "cam", "model": "brown", "parameters": {"c": 20.0}} | {field: value}
    with pytest.raises(InputError, match=re.escape(message)):
        check_camera(Camera(**fields))


@pytest.mark.parametrize("sigma, said", [({}, "(sigma: none)"), ({"c": 0.1}, "(sigma: c)")])
def test_an_observed_parameter_has_a_sigma(sigma, said):
    camera = Camera("cam", "brown", {"c": 20.0}, ("c", "x0"), sigma=sigma, observed={"x0": 0.1})
    with pytest.raises(InputError, match="observed is given for 'x0', which has no sigma") as error:
        check_camera(camera)
    assert said in str(error.value)


def far_away(shift=0.0, scale=1.0):
    given = tables()
    for table, axes in (("points", "XYZ"), ("images", ("X0", "Y0", "Z0"))):
        for row in given[table]:
            row.update({axis: scale * row[axis] + shift for axis in axes})
    return make_network(**given)


@pytest.mark.parametrize("shift, scale", [
    (0.0, 1e150), (1e17, 1.0), (1e13, 1e-4), (1e20, 1.0), (0.0, 1e-150)
])
def test_coordinates_that_cannot_be_computed_with_are_refused(shift, scale):
    with pytest.raises(InputError, match="within ±1e|subtract a common offset|in a smaller unit"):
        check_network(far_away(shift, scale))


def test_one_coordinate_beyond_all_numbers_is_named():
    with pytest.raises(InputError, match="image 'i1': expected Z0 within ±1e.75, got 1e.300"):
        check_network(broken("images", 1, Z0=1e300))


def test_coordinates_with_too_few_digits_are_told_with_their_step():
    """At 1e11 neighbouring numbers are 1.5e-5 apart, 3e-7 of the network; in a national grid 1e-9 m
    are nothing."""
    (warning,) = [w for w in check_network(far_away(1e11)).warnings if "held in steps" in w]
    assert "1e+11 are held in steps of 1.5e-05 m" in warning and "51 m wide" in warning
    assert not any("held in steps" in w for w in check_network(far_away(5e6)).warnings)
