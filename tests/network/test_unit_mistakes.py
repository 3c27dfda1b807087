"""Numbers in the wrong unit are reported with the likely unit; plausible ones are accepted."""

import dataclasses
import re

import numpy as np
import pytest

import jaxbundle
from jaxbundle import Camera, InputError, grid_of_targets, ring_of_stations, simulate
from jaxbundle.geometry import matrix_from_omega_phi_kappa, omega_phi_kappa_from_matrix
from jaxbundle.network.check import check_tables
from jaxbundle.network.unit_mistakes import LIMITS, name_pixels
from jaxbundle.network.units import ANGLE_UNITS
from jaxbundle.orientation.angle_conventions import name_angle_convention

PIXEL = {"image_size": (6000, 4000), "pixel_size": (0.006, 0.006)}
CONTROL = {"control": (0, 4, 20, 24), "control_sigma": 0.002}
TARGETS = grid_of_targets(5, 5, 0.5, relief=0.2)
RING = ring_of_stations(4, 3.0, 2.5, roll_every=2)


def network(c=24.0, **options):
    camera = Camera("cam", "brown", {"c": c}, **PIXEL)
    return simulate(RING, TARGETS, camera, noise=0.002, disturb=0.005, **options)


def with_camera(given, **changed):
    return given.replace(cameras=(dataclasses.replace(given.cameras[0], **changed),))


def measured(given, factor):
    rays = given.observations
    return given.replace(observations=dataclasses.replace(rays, xy=rays.xy * factor))


def placed(given, factor, *roles):
    points = given.points
    rows = points.has_role(*roles)[:, None]
    X = np.where(rows, points.position * factor, points.position)
    return given.replace(points=dataclasses.replace(points, position=X))


@pytest.mark.parametrize(
    "mistake, said",
    [
        (lambda n: with_camera(n, parameters={"c": 0.024}), r"in metres\? .* in mm \(24\)"),
        (lambda n: measured(n, 1 / 0.006), "pixels\\? Set image_unit"),
        (
            lambda n: measured(with_camera(n, pixel_size=(6.0, 6.0)), 1000),
            r"pixel_size 6 in µm\? .*\(0.006\)",
        ),
        (
            lambda n: measured(
                with_camera(n, model="opencv", parameters={"fx": 24.0, "fy": 24.0}), 1 / 0.006
            ),
            "Is fx in mm",
        ),
    ],
    ids=["c in metres", "pixels", "pixel size in µm", "fx in mm"],
)
def test_a_field_no_lens_has_is_refused_with_the_likely_unit(mistake, said):
    with pytest.raises(InputError, match=said) as error:
        jaxbundle.orient(mistake(network()))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "mistake, said",
    [
        (
            lambda n: measured(with_camera(n, pixel_size=(6e-6, 6e-6)), 0.001),
            "pixel_size is 6e-06 mm.*metres.*0.006",
        ),
        (lambda n: placed(n, 1000.0, "control"), "is one of them in mm, the other in m"),
        (lambda n: placed(n, 0.001, "control"), "is one of them in mm, the other in m"),
        (
            lambda n: n.replace(
                distances=dataclasses.replace(n.distances, value=1000 * n.distances.value)
            ),
            "'1 to 5'; are they in m, like the control points",
        ),
    ],
    ids=["pixel size in metres", "control in mm", "start values in mm", "distance in mm"],
)
def test_a_thousandfold_is_warned_of(mistake, said):
    given = network(**CONTROL, distances=[(0, 4)])
    assert check_tables(given).warnings == ()
    line, *_ = check_tables(mistake(given)).warnings  # control in mm contradicts distances too
    assert re.search(said, line)


@pytest.mark.parametrize("field", [1e-5, 1e-3, 0.7, 3.0])
@pytest.mark.parametrize("model", ["brown", "kannala-brandt"])
def test_long_lenses_microscopes_and_fisheyes_pass(field, model):
    """Half of the points at r/c: from a telescope to the edge of an equidistant fisheye, 180°."""
    given = network()
    usual = np.median(np.hypot(*given.observations.xy.T))
    c = usual / field
    parameters = {"c": c} if model == "brown" else {"fx": c, "fy": c}
    # With the pixels' size, r/c of 1e-3 is the usual lens of `test_c_in_pixels…` and asked about.
    size = None if field == 1e-3 else PIXEL["pixel_size"]
    given = with_camera(given, model=model, parameters=parameters, image_size=None, pixel_size=size)
    assert check_tables(given).warnings == ()


IN_PIXELS = {"c": 4000.0}  # of 0.006 mm: 24 mm


@pytest.mark.parametrize(
    "known, expected",
    [
        (PIXEL, r"\(24\)"),
        ({"image_size": None, "pixel_size": PIXEL["pixel_size"]}, r"\(24\)"),
        ({"image_size": PIXEL["image_size"], "pixel_size": None}, "size of a pixel"),
    ],
    ids=["both", "pixel size", "image size"],
)
def test_c_in_pixels_is_warned_of_where_the_pixels_are_known(known, expected):
    given = with_camera(network(), **known)
    assert check_tables(given).warnings == ()
    (line,) = check_tables(with_camera(given, parameters=IN_PIXELS)).warnings
    assert re.search(f"c is 4000 mm .* is c in pixels.* in mm .*{expected}", line)


@pytest.mark.parametrize("known", [PIXEL, {"image_size": None, "pixel_size": None}])
def test_long_lenses_and_points_close_together_are_not_in_pixels(known):
    given = with_camera(network(), **known)
    assert name_pixels(given) == ""
    assert name_pixels(measured(given, 0.02)) == ""  # half of the points within 0.1 mm
    full_frame = measured(given, 2.0)  # half of them within 10 mm
    assert name_pixels(with_camera(full_frame, parameters={"c": 450.0})) == ""
    lens = with_camera(full_frame, parameters={"c": 600.0})
    assert bool(name_pixels(lens)) == (known is not PIXEL)  # cannot be told, and only asked


def test_c_in_pixels_is_a_likely_cause_where_nothing_is_known_of_the_pixels():
    given = with_camera(network(), image_size=None, pixel_size=None, parameters=IN_PIXELS)
    assert check_tables(given).warnings == ()
    assert "camera 'cam': c is 4000 mm" in name_pixels(given)
    two = dataclasses.replace(given.cameras[0], id="second")
    images = given.images
    each = dataclasses.replace(images, camera=np.arange(len(images)) % 2)
    both = given.replace(cameras=(given.cameras[0], two), images=each)
    assert name_pixels(both).endswith("so with 1 other camera")


def test_half_of_the_points_of_an_image_are_within_a_third_of_its_longer_side():
    """Of 3:2, evenly covered: a circle of half the area, π·r² = 1/2 · 2/3."""
    assert LIMITS.half_of_points == pytest.approx(np.sqrt(1 / (3 * np.pi)), rel=0.05)


def test_blunders_are_no_unit():
    given = network()
    xy = given.observations.xy.copy()
    xy[::3] = 1e5
    rays = dataclasses.replace(given.observations, xy=xy)
    assert check_tables(given.replace(observations=rays)).warnings == ()


@pytest.mark.parametrize("right, wrong", [("deg", "gon"), ("gon", "deg"), ("rad", "deg")])
def test_angles_in_another_unit_are_told(right, wrong):
    given = network()
    assert name_angle_convention(given.replace(angle_unit=right)) == ""
    angles = given.images.angles * ANGLE_UNITS[wrong] / ANGLE_UNITS[right]
    mistaken = given.replace(
        images=dataclasses.replace(given.images, angles=angles), angle_unit=wrong
    )
    assert f'set angle_unit = "{right}"' in name_angle_convention(mistaken)


def angles_of_matrices(M):
    return np.array([omega_phi_kappa_from_matrix(one) for one in M])


D = np.diag([1.0, -1, -1])
CONVENTIONS = {
    "the rotations lead from the camera to the object": lambda M, X0: (M.transpose(0, 2, 1), X0),
    "the axes of the cameras have y down and z forward": lambda M, X0: (D @ M, X0),
    "y down and z forward and the rotations lead from the camera to the object and X0, Y0, Z0 is":
        lambda M, X0: ((D @ M).transpose(0, 2, 1), -np.einsum("nij,nj->ni", D @ M, X0)),
    "if X0, Y0, Z0 is the translation": lambda M, X0: (M, -np.einsum("nij,nj->ni", M, X0)),
}  # fmt: skip


@pytest.mark.parametrize("words", CONVENTIONS)
def test_poses_in_another_convention_are_told(words):
    given = network()
    M = np.array([matrix_from_omega_phi_kappa(a) for a in given.images.angles])
    other_M, X0 = CONVENTIONS[words](M, given.images.position)
    images = dataclasses.replace(given.images, angles=angles_of_matrices(other_M), position=X0)
    assert words in name_angle_convention(given.replace(images=images))


@pytest.mark.parametrize("order, words", [
    ((1, 0, 2), "phi, omega, kappa"), ((1, 2, 0), "kappa, omega, phi"),
    ((2, 0, 1), "phi, kappa, omega"),
])  # fmt: skip
def test_angles_in_another_order_are_told(order, words):
    """Columns omega, phi, kappa that hold the angles of `words`."""
    given = network()
    names = ["omega", "phi", "kappa"]
    columns = given.images.angles[:, [names.index(word) for word in words.split(", ")]]
    images = dataclasses.replace(given.images, angles=columns)
    said = name_angle_convention(given.replace(images=images))
    assert f"omega, phi, kappa are in fact {words};" in said
