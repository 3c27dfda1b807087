"""Distortion tables and fields of view against printed ones."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from jaxbundle.cameras import get_model
from jaxbundle.cameras.distortion_table import distortion_table
from jaxbundle.cameras.field_of_view import (
    angle_class,
    equivalent_35mm,
    field_of_view,
    field_of_view_of_rays,
)

BINGO = [  # camera and place; c, x0, y0, p25, p26, format factor; step, dr in 1/1000 unit
    ("1 indoor", (126.9924, -0.0049, 0.1569, 16.3057, -1.7983, 1.2778), 7.8,
     [617.7, 1187.7, 1674.5, 2043.9, 2262.8, 2299.6, 2124.0, 1706.8, 1020.3, 38.1, -1265.2,
      -2913.3, -4928.8]),
    ("1 outdoor", (125.4565, -0.3684, -0.1726, 33.8081, -5.0203, 1.0), 10.0,
     [1296.5, 2485.1, 3491.7]),
]  # fmt: skip


@pytest.mark.parametrize("_, values, step, printed", BINGO)
def test_bingo_prints_it_from_the_image_origin(_, values, step, printed):
    model = get_model("bingo")
    table = distortion_table(
        model, dict(zip(model.parameters, values)), step, step * len(printed), "origin"
    )
    assert_allclose(table["r"], step * np.arange(1, len(printed) + 1))
    assert_allclose(1000 * table["radial"], printed, atol=0.11)
    assert_allclose(table["decentring"], 0, atol=1e-12)


def test_the_same_in_millimetres():
    """The table of a thesis in steps of 0.1 mm (Repanšek 2009, table 7): a unit is 0.03125 mm."""
    printed = [0.008, 0.016, 0.023, 0.031, 0.038, 0.044, 0.050, 0.056, 0.060, 0.065, 0.067]
    model = get_model("bingo")
    table = distortion_table(
        model, dict(zip(model.parameters, BINGO[0][1])), 3.2, 3.2 * 11, "origin"
    )
    assert_allclose(0.03125 * table["radial"], printed, atol=1.6e-3)


def test_a_usgs_report():
    """Report of Calibration of an RC30: distortion in µm at angles from the axis."""
    model = get_model("usgs")
    p = dict(c=153.068, x0=-0.003, y0=0.009, K0=-4.894e-5, K1=4.278e-9, K2=-2.968e-14, P1=-7.9e-8,
             P2=-9.158e-8)  # fmt: skip
    angle = np.radians([7.5, 15.0, 22.7, 30.0, 35.0, 40.0])
    tables = [distortion_table(model, p, r, r) for r in 153.068 * np.tan(angle)]
    radial, decentring = (
        1000 * np.array([t[k][0] for t in tables]) for k in ("radial", "decentring")
    )
    assert_allclose(radial, [0.951, 1.716, 2.043, 1.532, 0.398, -1.741], atol=1e-3)
    # around the axis the tangential part of P·r² is P·r², the radial one three times that
    assert_allclose(decentring, [0.049, 0.203, 0.496, 0.945, 1.389, 1.995], atol=1e-3)


@pytest.mark.parametrize("step, largest", [(0, 5), (-1, 5), (2, 1), (1, np.inf), (np.nan, 1)])
def test_impossible_steps(step, largest):
    with pytest.raises(ValueError, match="0 < step"):
        distortion_table(get_model("snavely"), {"f": 500.0}, step, largest)


def test_three_fields_of_view():
    """152.4 mm on 23 × 23 cm: the 94° across the corners of the textbooks; 60° for 1 : √3."""
    view = field_of_view(152.4, (230, 230))
    assert round(np.degrees(view.diagonal)) == 94 and angle_class(view.diagonal) == "wide angle"
    assert np.degrees(field_of_view(np.sqrt(3) / 2, (1.0, 1.0)).horizontal) == pytest.approx(60)
    assert angle_class(np.radians(74.9)) == "normal angle"
    assert angle_class(np.radians(100.1)) == "superwide angle"


def test_by_rays_it_is_the_formula_without_distortion():
    plain = dict(fx=500.0, fy=510.0, cx=319.5, cy=239.5)
    rays = field_of_view_of_rays(get_model("opencv"), plain, (640, 480))
    assert rays.horizontal == pytest.approx(field_of_view(500, (640, 480)).horizontal, rel=1e-14)
    assert rays.vertical == pytest.approx(field_of_view(510, (640, 480)).vertical, rel=1e-14)
    a = np.array([320 / 500, 240 / 510, 1])
    b = a * [-1, -1, 1]
    assert rays.diagonal == pytest.approx(np.arccos(a @ b / (a @ a)), rel=1e-12)


def test_each_side_has_its_principal_distance():
    """fx 1000, fy 500 on 2000 × 1000: 90° both, and 2·atan(√2) across the corners."""
    view = field_of_view((1000.0, 500.0), (2000, 1000))
    assert np.degrees(view[:2]) == pytest.approx((90, 90))
    assert view.diagonal == pytest.approx(2 * np.arctan(np.sqrt(2)))
    p = dict(fx=1000.0, fy=500.0, cx=999.5, cy=499.5)
    assert view == pytest.approx(field_of_view_of_rays(get_model("opencv"), p, (2000, 1000)))
    # tan = 1 at the edge: half of 36 mm; √2 at the corner: √(18² + 12²)/√2
    assert equivalent_35mm((1000.0, 500.0), (2000, 1000), "width") == pytest.approx(18)
    assert equivalent_35mm((1000.0, 500.0), (2000, 1000)) == pytest.approx(np.sqrt(468 / 2))


def test_a_fisheye_sees_behind_itself():
    """Equidistant without coefficients: the angle is the diameter over the principal distance."""
    p = dict(fx=200.0, fy=200.0, cx=399.5, cy=399.5)
    view = field_of_view_of_rays(get_model("kannala-brandt"), p, (800, 800))
    assert view.horizontal == pytest.approx(800 / 200) and view.horizontal > np.pi


def test_equivalent():
    assert equivalent_35mm(50.0, (36, 24)) == pytest.approx(50)
    assert equivalent_35mm(4.0, (4.8, 3.6)) == pytest.approx(4.0 * np.sqrt(36**2 + 24**2) / 6)
    assert equivalent_35mm(4.0, (4.8, 3.6), "width") == pytest.approx(30)
    with pytest.raises(ValueError, match="not by 'area'"):
        equivalent_35mm(4.0, (4.8, 3.6), "area")
