"""Conversion of camera models: exact ones in both directions, fits against independent figures."""

import cv2
import numpy as np
import pytest
from camera_cases import CASES
from numpy.testing import assert_allclose

from jaxbundle.cameras import convert_camera, get_model
from jaxbundle.cameras.convert_exact import (
    exact_parameters,
    invert_radial,
    normalised_correction,
)
from jaxbundle.cameras.convert_fit import images_of, rays_of
from jaxbundle.cameras.pixel_frame import between_frames

VALUES = {case.name: case.values for case in CASES}
SIZE, PIXEL = (4000, 3000), (0.009, 0.009)
SIZES = dict(image_size=SIZE, pixel_size=PIXEL)

BROWN = VALUES["brown"] | dict(c=24.0, x0=0.3, y0=-0.2, K1=8e-5, K2=-3e-8, K3=1e-11, r0=10.0)
PLAIN_BROWN = BROWN | dict(b1=0.0, b2=0.0)
USGS = dict(VALUES["usgs"], K4=0.0, P3=0.0, P4=0.0)
PROJECTED = VALUES["brown-projected"] | dict(b1=0.0, b2=0.0)
SNAVELY = dict(f=3000.0, k1=-0.12, k2=0.03)
OPENCV = dict(
    fx=3100.0, fy=3100.0, cx=1990.0, cy=1512.0, k1=-0.12, k2=0.07, p1=1e-3, p2=-4e-4, k3=-0.01
)

EXACT = [
    ("brown", BROWN, "brown", 0.0, "brown", 10.0),
    ("brown", PLAIN_BROWN, "usgs", 0.0, "brown", 10.0),
    ("usgs", USGS | {"K0": 0.0}, "brown", 90.0, "usgs", 0.0),
    ("brown-projected", VALUES["brown-projected"], "brown-projected", 5.0, "", 13.488),
    ("brown-projected", PROJECTED, "opencv", 0.0, "brown-projected", 13.488),
    ("opencv", OPENCV, "brown-projected", 11.0, "opencv", 0.0),
    ("snavely", SNAVELY, "opencv", 0.0, "snavely", 0.0),
    ("snavely", SNAVELY, "brown-projected", 8.0, "snavely", 0.0),
]


@pytest.mark.parametrize("name, values, other, r0, _, back_r0", EXACT)
def test_exact_conversions_there_and_back(name, values, other, r0, _, back_r0):
    source, target = get_model(name), get_model(other)
    there = convert_camera(source, values, target, r0=r0, **SIZES)
    assert there.exact and not there.reason
    half_diagonal = {"mm": 22.5, "px": 2500}[target.unit]
    assert there.largest < 1e-12 * half_diagonal
    back = convert_camera(target, there.parameters, source, r0=back_r0, **SIZES)
    assert back.exact
    full = dict.fromkeys(source.parameters, 0.0) | dict(values)
    if name == "usgs":  # its c and K0 express one thing twice: only the ratios come back
        scale = back.parameters["c"] / full["c"]
        linear = (1 + back.parameters["K0"]) / (1 + full["K0"])
        assert linear == pytest.approx(scale, rel=1e-12)
        full = {k: v * (1 if k in ("x0", "y0") else scale) for k, v in full.items()}
        full["K0"] = back.parameters["K0"]
    for key, value in full.items():
        assert back.parameters[key] == pytest.approx(value, rel=1e-9, abs=1e-18), key


def test_unbalanced_to_balanced_by_the_published_formula():
    K = dict(K1=BROWN["K1"], K2=BROWN["K2"], K3=BROWN["K3"])
    r0 = 12.5
    S = 1 + sum(K[f"K{i}"] * r0 ** (2 * i) for i in (1, 2, 3))
    model = get_model("brown")
    balanced = exact_parameters(model, BROWN | {"r0": 0.0}, model, (None, None), r0)
    assert balanced["c"] == pytest.approx(BROWN["c"] / S, rel=1e-14)
    for i in (1, 2, 3):
        assert balanced[f"K{i}"] == pytest.approx(K[f"K{i}"] / S, rel=1e-14)
    assert balanced["P1"] == pytest.approx(BROWN["P1"] / S, rel=1e-14)
    x, y = np.asarray(model.to_ideal(tuple(balanced[n] for n in model.parameters), r0 + 0.3, -0.2))
    plain = {n: 0.0 if n[0] in "Pb" else v for n, v in balanced.items()}
    x, y = model.to_ideal(tuple(plain[n] for n in model.parameters), r0 + 0.3, -0.2)
    assert_allclose((x, y), (r0, 0.0), atol=1e-13)  # no radial distortion at r0


def test_opencv_is_opencv():
    """A forward model in mm, converted, against cv2.projectPoints."""
    source = get_model("brown-projected")
    found = convert_camera(source, PROJECTED, get_model("opencv"), **SIZES).parameters
    rays = np.array([[0.1, 0.2, -1.0], [-0.4, 0.3, -1.0], [0.5, -0.35, -1.0], [0, 0, -1.0]])
    K = np.array([[found["fx"], 0, found["cx"]], [0, found["fy"], found["cy"]], [0, 0, 1]])
    coefficients = np.array([found[n] for n in ("k1", "k2", "p1", "p2", "k3")])
    theirs, _ = cv2.projectPoints(rays * [1, -1, -1], np.zeros(3), np.zeros(3), K, coefficients)
    u, v = theirs[:, 0].T
    x, y = images_of(source, PROJECTED, rays).T
    assert_allclose((u - (SIZE[0] - 1) / 2) * PIXEL[0], x, atol=1e-11)
    assert_allclose(-(v - (SIZE[1] - 1) / 2) * PIXEL[1], y, atol=1e-11)


def test_normalised_correction_is_the_same_correction():
    model = get_model("brown")
    values = BROWN | dict(b1=0.0, b2=0.0, r0=0.0)
    q, c = normalised_correction(values), values["c"]
    x, y = 5.0, -7.0
    xi, yi = model.to_ideal(tuple(values[n] for n in model.parameters), x, y)
    X, Y = (x - values["x0"]) / c, -(y - values["y0"]) / c
    R2 = X * X + Y * Y
    radial = 1 + q["k1"] * R2 + q["k2"] * R2**2 + q["k3"] * R2**3
    Xi = X * radial + 2 * q["p1"] * X * Y + q["p2"] * (R2 + 2 * X * X)
    Yi = Y * radial + q["p1"] * (R2 + 2 * Y * Y) + 2 * q["p2"] * X * Y
    assert_allclose((c * Xi, -c * Yi), (xi, yi), rtol=1e-13)


def test_inverted_radial_is_right_to_the_seventh_order():
    q = np.array([0.1, -0.05, 0.03])
    k = invert_radial(q)
    r = np.array([0.05, 0.1])
    apply = lambda k, r: r * (1 + k[0] * r**2 + k[1] * r**4 + k[2] * r**6)
    error = np.abs(apply(k, apply(q, r)) - r)
    assert error[1] / error[0] == pytest.approx(2**9, rel=0.2)


def test_a_fit_says_what_it_costs():
    """Backward Brown as OpenCV: the largest difference is that of independent points."""
    source, target = get_model("brown"), get_model("opencv")
    found = convert_camera(source, PLAIN_BROWN, target, **SIZES)
    assert not found.exact and "different functions" in found.reason
    assert 1e-6 < found.largest < 1 and found.rms < found.largest / 2
    rng = np.random.default_rng(3)
    xy = rng.uniform([-18, -13.5], [18, 13.5], (2000, 2))
    shift, step = between_frames(source, target, SIZE, PIXEL)
    uv = images_of(target, found.parameters, rays_of(source, PLAIN_BROWN, xy))
    length = np.linalg.norm(uv - (shift + step * xy), axis=1)
    assert length.max() <= 1.02 * found.largest
    assert np.sqrt(np.mean(length**2)) == pytest.approx(found.rms, rel=0.3)


def test_a_fit_is_a_minimum():
    source, target = get_model("opencv"), get_model("brown")
    found = convert_camera(source, OPENCV, target, **SIZES)
    for name in ("c", "x0", "K1", "P2"):
        for sign in (-1, 1):
            changed = dict(found.parameters)
            changed[name] += sign * 1e-4 * max(abs(changed[name]), 1e-3)
            xy = np.stack(np.meshgrid(np.linspace(-0.5, 3999.5, 33), np.linspace(-0.5, 2999.5, 25)),
                          -1).reshape(-1, 2)  # fmt: skip
            shift, step = between_frames(source, target, SIZE, PIXEL)
            rays = rays_of(source, dict.fromkeys(source.parameters, 0.0) | OPENCV, xy)
            v = images_of(target, changed, rays) - (shift + step * xy)
            assert np.sqrt(np.square(v).sum(1).mean()) > found.rms


def test_a_fisheye_near_its_axis_and_beyond_ninety_degrees():
    fisheye, opencv = get_model("kannala-brandt"), get_model("opencv")
    values = VALUES["kannala-brandt"]
    near = ((500.0, 380.0), (780.0, 580.0))
    assert convert_camera(fisheye, values, opencv, area=near).largest < 2e-3
    with pytest.raises(ValueError, match="90° and more"):
        convert_camera(fisheye, values, opencv, image_size=(1280, 960))


@pytest.mark.parametrize(
    "source, values, target, sizes, message",
    [
        ("brown", BROWN, "opencv", {}, "image_size is needed"),
        ("brown", BROWN, "opencv", {"image_size": SIZE}, "pixel_size is needed"),
        ("brown", BROWN, "brown-projected", {}, "image_size is needed to know the area"),
        ("brown", BROWN | {"K1": -0.01, "r0": 0.0}, "usgs", SIZES, "turns back inside the image"),
        (
            "radial-spline-6-40",
            {"fx": 300.0, "fy": 300.0, "cx": 320.0, "cy": 240.0},
            "opencv",
            {"image_size": (640, 480)},
            "its field ends, or its distortion turns back, inside the image",
        ),
    ],
)
def test_what_cannot_be_converted_is_said(source, values, target, sizes, message):
    with pytest.raises(ValueError, match=message):
        convert_camera(get_model(source), values, get_model(target), **sizes)


def test_a_fit_without_differences_is_exact():
    """Backward Brown as OpenCV is a fit, which finds a camera without distortion to rounding."""
    bare = dict(c=30.0, x0=0.1, y0=-0.05)
    found = convert_camera(get_model("brown"), bare, get_model("opencv"), **SIZES)
    assert found.exact and not found.reason and "opencv: exact; largest" in str(found)
    pixel, width = PIXEL[0], SIZE[0]
    expected = dict(fx=30 / pixel, cx=(width - 1) / 2 + 0.1 / pixel, k1=0.0)
    for name, value in expected.items():
        assert found.parameters[name] == pytest.approx(value, abs=1e-9), name
    bent = convert_camera(get_model("brown"), bare | {"K1": -2e-5}, get_model("opencv"), **SIZES)
    assert not bent.exact and bent.reason


def test_why_a_conversion_is_not_exact():
    reasons = {
        "brown-projected": convert_camera(
            get_model("opencv"), OPENCV | {"fy": 3110.0}, get_model("brown-projected"), **SIZES
        ).reason,
        "snavely": convert_camera(
            get_model("opencv"), dict(fx=3000.0, fy=3000.0, cx=1990.0, cy=1499.5),
            get_model("snavely"), **SIZES,
        ).reason,
    }  # fmt: skip
    assert "one principal distance" in reasons["brown-projected"]
    assert "image centre" in reasons["snavely"]


def test_a_fit_stays_where_its_parameters_mean_something():
    """A narrow lens with a barrel distortion: of `eucm` without bounds α = 5.7 comes out."""
    lens = dict(fx=620.0, fy=621.0, cx=242.0, cy=178.0, k1=-0.12, k2=0.05)
    target = get_model("eucm")
    found = convert_camera(get_model("opencv"), lens, target, image_size=(480, 360))
    for name, (low, high) in dict(target.ranges).items():
        assert low <= found.parameters[name] < high
    assert found.rms < 0.2


def test_knots_without_points_stay_at_the_start():
    """The corners of a grid of splines over 80°, of an image of 42°: within σ of their prior."""
    source, target = get_model("opencv"), get_model("spline-8x6-80")
    parameters = {"fx": 620.0, "fy": 620.0, "cx": 240.0, "cy": 180.0, "k1": -0.2, "k2": 0.1}
    knots = [name for name in target.parameters if name.startswith("d")]
    found = convert_camera(source, parameters, target, image_size=(480, 360), free=knots)
    for i, j in ((0, 0), (0, 7), (5, 0), (5, 7), (2, 0), (2, 7)):
        for axis in "xy":
            name = f"d{axis}_{i}_{j}"
            assert abs(found.parameters[name]) < dict(target.prior)[name], name
