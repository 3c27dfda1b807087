"""A user's own model: one function and names; the rest follows as for built-in models."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import test_models
from camera_cases import CASES, Case, image_rays, project
from numpy.testing import assert_allclose

from jaxbundle.cameras import (
    CameraModel,
    brown,
    check_own,
    compare_cameras,
    convert_camera,
    get_model,
    turning_radius,
    validity_message,
)
from jaxbundle.cameras.coefficient_units import coefficient_unit
from jaxbundle.cameras.field_of_view import field_of_view_of_rays


def division(p, x, y):
    """xi = (x − x0)/(1 + L1·r² + L2·r⁴)"""
    c, x0, y0, L1, L2 = p
    x, y = x - x0, y - y0
    r2 = x * x + y * y
    return x / (1 + r2 * (L1 + r2 * L2)), y / (1 + r2 * (L1 + r2 * L2))


def unified(p, r, s, q):
    """The unified camera (Mei and Rives 2007)."""
    fx, fy, cx, cy, alpha = p
    N = alpha * jnp.sqrt(r * r + s * s + q * q) - (1 - alpha) * q
    return cx + fx * r / N, cy - fy * s / N


def squeeze(p, xi, yi):
    """An affine camera with a parameter each for scale and shear."""
    focal, across, px, py, shear = p
    return xi + shear * yi + px, yi + py


def unsqueeze(p, X, Y):
    _, _, px, py, shear = p
    return X - px - shear * (Y - py), Y - py


DIVISION = CameraModel("division-mm", ("c", "x0", "y0", "L1", "L2"), correct=division)
UNIFIED = CameraModel(
    "unified", ("fx", "fy", "cx", "cy", "alpha"), project=unified, unit="px", image="equidistant",
    iterations=12,
)  # fmt: skip
SQUEEZED = CameraModel(
    "squeezed", ("focal", "across", "px", "py", "shear"), distort=squeeze, inverse=unsqueeze,
    unit="px", principal_distance=("focal", "across"), principal_point=("px", "py"),
)  # fmt: skip
MINE = [
    Case(DIVISION, dict(c=24.0, x0=0.1, y0=-0.2, L1=4e-4, L2=-1e-7), (0, 0), (18, 12)),
    Case(UNIFIED, dict(fx=380.0, fy=381.0, cx=642.0, cy=478.0, alpha=0.6), (639.5, 479.5),
         (560, 420)),
    Case(SQUEEZED, dict(focal=900.0, across=910.0, px=642.0, py=478.0, shear=0.02),
         (639.5, 479.5), (640, 480)),
]  # fmt: skip
mine = pytest.mark.parametrize("case", MINE, ids=lambda case: case.name.name)


@mine
def test_image_ray_and_project_are_inverse(case):
    test_models.test_image_ray_and_project_are_inverse(case)
    test_models.test_a_point_up_and_right_in_front(case)


@mine
@pytest.mark.parametrize("domain", ["corrected", "measured"])
def test_jacobians(case, domain):
    """Against finite differences of fourth order, forward and reverse."""
    test_models.test_jacobians_of_all_parameters_forward_reverse_and_numerical(case, domain)


@mine
def test_second_derivatives(case):
    test_models.test_second_derivatives_of_all_parameters(case)


@pytest.mark.further
def test_brown_said_again_is_brown():
    again = CameraModel("again", brown.PARAMETERS, correct=brown.correct, never_free=("r0",))
    case = CASES[0]
    own = dataclasses.replace(case, name=again)
    xy = case.grid()
    rays = image_rays(case, xy)
    assert_allclose(image_rays(own, xy), rays, rtol=0, atol=1e-15)
    assert_allclose(project(own, rays), project(case, rays), atol=1e-13)
    assert turning_radius(again, case.values, 30.0) == turning_radius(
        get_model("brown"), case.values, 30.0
    )
    same = compare_cameras((again, case.values), (get_model("brown"), case.values),
                           image_size=(1280, 960), pixel_size=(0.005, 0.005))  # fmt: skip
    assert same.largest < 1e-9


def test_behind_a_wide_camera_rays_go_on():
    """cos θ = −0.1 at 95.7°: the image of the formula, and back."""
    case = MINE[1]
    ray = np.array([[np.sqrt(0.99), 0.0, 0.1]])
    xy = project(case, ray)
    assert_allclose(xy, [[642 + 380 * np.sqrt(0.99) / (0.6 - 0.4 * 0.1), 478]])
    assert_allclose(image_rays(case, xy), ray, atol=1e-12)
    assert UNIFIED.wide and not DIVISION.wide
    fov = field_of_view_of_rays(UNIFIED, case.values, (1280, 960))
    assert np.degrees(fov.horizontal) > 120


def test_the_reach_of_an_own_distortion():
    """x/(1 + L·x²) turns where its derivative (1 − L·x²)/(1 + L·x²)² vanishes: at 1/√L."""
    values = {"c": 24.0, "L1": 1 / 400}
    assert turning_radius(DIVISION, values, 30.0) == pytest.approx(20.0, rel=1e-9)
    assert "'division-mm' turns back at a radius of 20 mm" in validity_message(
        "cam", DIVISION, values, 30.0
    )


def test_conversions_are_fits_and_say_what_they_cost():
    """A division of one coefficient is nearly a polynomial; there and back is the same camera."""
    given = {"c": 24.0, "x0": 0.1, "y0": -0.05, "L1": 2e-4}
    sizes = dict(image_size=(6000, 4000), pixel_size=(0.006, 0.006))
    there = convert_camera(DIVISION, given, get_model("opencv"), **sizes)
    assert not there.exact and "different functions" in there.reason and there.largest < 0.1
    back = convert_camera(get_model("opencv"), there.parameters, DIVISION, **sizes)
    assert back.model == "division-mm" and back.largest < 1e-3
    assert back.parameters["c"] == pytest.approx(24, rel=1e-3)
    assert back.parameters["x0"] == pytest.approx(0.1, abs=0.01)
    same = convert_camera(DIVISION, given, DIVISION, **sizes)
    assert same.exact and same.largest < 1e-9
    fisheye = convert_camera(
        UNIFIED, MINE[1].values, get_model("kannala-brandt"), image_size=(1280, 960)
    )
    assert fisheye.largest < 0.5
    with pytest.raises(ValueError, match="looks 90° and more.*'opencv'"):
        convert_camera(UNIFIED, MINE[1].values, get_model("opencv"), image_size=(1600, 1200))


def test_a_model_is_what_its_function_is():
    """Static in jit: the same function and fields, the same model; a function that reads the same
    is another."""
    same = CameraModel("division-mm", ["c", "x0", "y0", "L1", "L2"], correct=division)
    assert same == DIVISION and hash(same) == hash(DIVISION) and str(same) == "division-mm"
    assert dataclasses.replace(DIVISION, correct=lambda p, x, y: division(p, x, y)) != DIVISION
    assert dataclasses.replace(DIVISION, iterations=7) != DIVISION
    assert DIVISION.principal_distance == ("c",) and DIVISION.principal_point == ("x0", "y0")
    assert SQUEEZED.core == ("focal", "across", "px", "py") and SQUEEZED.axes == "down"
    traced = []
    steps = lambda model, x: traced.append(model) or model.iterations * x
    jitted = jax.jit(steps, static_argnums=0)
    jitted(DIVISION, 1.0), jitted(same, 2.0)
    assert len(traced) == 1


N = ("c", "x0", "y0", "L1", "L2")
IMPOSSIBLE = {
    "no formula": (dict(correct=None), "give one formula.*not none"),
    "two": (dict(distort=division), "not correct and distort"),
    "no function": (dict(correct=3), "correct must be a function, not 3"),
    "name": (dict(name=""), "must be a text"),
    "twice": (dict(parameters=("c", "c")), "different names"),
    "one text": (dict(parameters="c"), "different names"),
    "taken": (dict(parameters=("c", "free")), "none of them id, model"),
    "no identifier": (dict(parameters=("c", "K 1")), "different names"),
    "no distance": (dict(parameters=("a", "b")), "principal_distance must name"),
    "unknown": (dict(free=("K1",)), "free names K1, which is no parameter"),
    "default": (dict(defaults={"K1": 1.0}), "defaults names K1"),
    "unit": (dict(unit="m"), "unit is one of mm, px, not 'm'"),
    "image": (dict(image="fisheye"), "image is one of perspective, equidistant"),
    "iterations": (dict(iterations=0), "iterations"),
}


@pytest.mark.parametrize("case", IMPOSSIBLE)
def test_what_is_no_model_is_refused(case):
    changes, said = IMPOSSIBLE[case]
    given = {"name": "mine", "parameters": N, "correct": division} | changes
    with pytest.raises(ValueError, match=said):
        CameraModel(given.pop("name"), given.pop("parameters"), **given)


def own(function, names=N, **more):
    return CameraModel("mine", names, **({"correct": function} | more))


def radial(p, x, y):
    factor = 1 + p[2] * (x * x + y * y)
    return x * factor, y * factor


UNUSABLE = {
    "arguments": (own(lambda p: p), "correct.p, x, y. must take the parameters .c, x.*raised Type"),
    "number of parameters": (own(division, ("c", "x0")), "raised ValueError: not enough values"),
    "one number": (own(lambda p, x, y: x), "return two numbers"),
    "not element by element": (
        own(lambda p, x, y: tuple(jnp.eye(2) @ jnp.stack([x, y]))), "arrays, element by element"
    ),
    "if": (own(lambda p, x, y: (x, y) if x > 0 else (y, x)), "raised TracerBoolConversionError"),
    "axis": (
        own(lambda p, x, y: (x * (1 + jnp.sqrt(x * x + y * y)), y)),
        "no finite value and derivatives on the optical axis",
    ),
    "mirrored": (own(lambda p, x, y: (x, -y)), "mirrored or rotated.*axes 'up'"),
    "inverse": (own(division, inverse=lambda p, x, y: (x, y)), "inverse is not the inverse"),
    # Right where the coefficient is zero, as at the start; its sign is wrong.
    "inverse with coefficients": (
        own(radial, ("c", "x0", "L2"), inverse=lambda p, x, y: radial((*p[:2], p[2]), x, y)),
        "with parameters near them",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", UNUSABLE)
def test_a_formula_that_cannot_be_used_is_refused(case):
    model, said = UNUSABLE[case]
    values = {"c": 24.0, "x0": 0.0, "y0": 0.0, "L1": 1e-3, "L2": 0.0}
    with pytest.raises(ValueError, match=said):
        check_own(model, {name: values[name] for name in model.parameters})


@pytest.mark.parametrize(
    "model, units",
    [
        ("brown", {"K1": "mm⁻²", "K2": "mm⁻⁴", "K3": "mm⁻⁶", "P1": "mm⁻¹", "b1": ""}),
        ("opencv", {"k1": "", "p1": "", "s1": ""}),
    ],
)
def test_units_of_coefficients_follow_from_their_effect(model, units):
    """Brown (1971) has coefficients of image lengths, OpenCV of ratios."""
    found = {name: coefficient_unit(get_model(model), name) for name in units}
    assert found == units


@mine
def test_what_can_be_used_is_not(case):
    check_own(case.model, case.values)


def test_the_name_of_another_is_refused():
    with pytest.raises(ValueError, match="'brown' is built in; give your own another name"):
        get_model(CameraModel("brown", N, correct=division))
    assert get_model(get_model("brown")) is get_model("brown") and get_model(DIVISION) is DIVISION
