"""Published figures: BINGO's radial tables, the USGS report, the DSS 439 table."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from jaxbundle import cameras

# format factor, p25, p26 (1/1000 unit), step of R, dr at R = step, 2·step, … (1/1000 unit)
BINGO_TABLES = {
    "camera 1 indoor": (1.2778, 16305.7, -1798.3, 7.8, [
        617.7, 1187.7, 1674.5, 2043.9, 2262.8, 2299.6, 2124.0, 1706.8, 1020.3, 38.1, -1265.2,
        -2913.3, -4928.8]),
    "camera 1 indoor, inside": (1.2778, 16305.7, -1798.3, 4.0, [
        320.5, 633.0, 932.8, 1215.0, 1474.8, 1707.5, 1908.7, 2073.8, 2198.5, 2278.4, 2309.3,
        2287.2, 2208.0]),
    "camera 2 indoor": (1.2778, 16493.6, -1538.6, 7.8, [
        622.3, 1198.1, 1691.5, 2067.4, 2292.0, 2332.6, 2157.6, 1736.4, 1039.5, 38.8, -1292.9,
        -2981.9, -5052.9]),
    "camera 2 indoor, inside": (1.2778, 16493.6, -1538.6, 4.0, [
        322.6, 637.8, 940.4, 1225.7, 1488.8, 1725.0, 1929.6, 2098.0, 2225.6, 2308.2, 2341.3,
        2320.5, 2241.8]),
    "camera 1 outdoor": (1.0, 33808.1, -5020.3, 10.0, [
        1296.5, 2485.1, 3491.7, 4246.0, 4681.5, 4735.1, 4347.5, 3463.2, 2030.1, 0.0, -2671.7,
        -6026.0]),
    "camera 1 outdoor, inside": (1.0, 33808.1, -5020.3, 4.0, [
        526.7, 1043.4, 1545.3, 2027.4, 2485.1, 2913.5, 3308.3, 3664.9, 3978.9, 4246.0, 4462.1,
        4623.0, 4724.7]),
    "camera 2 outdoor": (1.0, 33685.3, -5975.0, 10.0, [
        1300.6, 2487.4, 3487.1, 4230.6, 4653.3, 4695.1, 4300.0, 3416.4, 1997.4, 0.0, -2614.1,
        -5878.8, -9824.0]),
    "camera 2 outdoor, inside": (1.0, 33685.3, -5975.0, 4.0, [
        529.0, 1047.2, 1549.5, 2031.1, 2487.4, 2913.7, 3305.5, 3658.4, 3968.2, 4230.6, 4441.7,
        4597.4, 4694.0]),
}


@pytest.mark.parametrize("table", BINGO_TABLES.values(), ids=BINGO_TABLES.keys())
def test_bingo_radial_tables(table):
    factor, p25, p26, step, listed = table
    to_ideal = cameras.get_model("bingo").to_ideal
    p = (125.0, 0.0, 0.0, p25 / 1000, p26 / 1000, factor)
    R = step * np.arange(1, len(listed) + 1)
    for azimuth in (0.0, 2.0):
        x, y = R * np.cos(azimuth), R * np.sin(azimuth)
        ideal = np.hypot(*to_ideal(p, x, y))
        assert_allclose(1000 * (R - ideal), listed, atol=0.065)


def test_usgs_report_of_calibration():
    values = dict(c=153.068, K0=-4.894e-5, K1=4.278e-9, K2=-2.968e-14, P1=-7.9e-8, P2=-9.158e-8)
    model = cameras.get_model("usgs")
    values = {**cameras.default_parameters(model), **values}
    p = lambda **other: tuple({**values, **other}[n] for n in model.parameters)  # noqa: E731
    r = 153.068 * np.tan(np.deg2rad([7.5, 15, 22.7, 30, 35, 40]))

    corrected, _ = model.to_ideal(p(P1=0.0, P2=0.0), r, 0 * r)
    distortion = 1000 * (r - corrected)
    assert_allclose(distortion, [0.951, 1.716, 2.043, 1.532, 0.398, -1.741], atol=6e-4)
    assert np.array_equal(np.rint(distortion), [1, 2, 2, 2, 0, -2])  # as printed in the report

    # the decentring correction is largest, 3·√(P1² + P2²)·r², in the direction of (P1, P2),
    # and across it √(P1² + P2²)·r², which is what the report lists
    across = np.array([9.158e-8, -7.9e-8]) / np.hypot(7.9e-8, 9.158e-8)
    none = dict(K0=0.0, K1=0.0, K2=0.0)
    x, y = model.to_ideal(p(**none), r * across[0], r * across[1])
    decentring = 1000 * np.hypot(x - r * across[0], y - r * across[1])
    assert_allclose(decentring, [0.049, 0.203, 0.496, 0.945, 1.389, 1.995], atol=6e-4)
    assert np.array_equal(np.rint(decentring), [0, 0, 0, 1, 1, 2])


# radial distortion in µm at 1, 2, … 31 mm
DSS_439 = [
    -0.022, -0.175, -0.591, -1.397, -2.72, -4.68, -7.396, -10.979, -15.534, -21.158, -27.941,
    -35.963, -45.295, -55.999, -68.124, -81.708, -96.779, -113.352, -131.427, -150.996, -172.036,
    -194.509, -218.368, -243.552, -269.987, -297.588, -326.258, -355.892, -386.37, -417.569,
    -449.354,
]


def test_dss_439_radial_table_in_pixels():
    pixel = 0.0068
    p = (59.84 / pixel, 0.0, 0.0, -1.0153726e-9, 1.733408e-17, -9.8033374e-26) + (0.0,) * 5
    model = cameras.get_model("brown")
    r = jnp.arange(1.0, 32.0) / pixel
    x, _ = jax.vmap(lambda r: model.to_ideal(p, r, 0.0))(r)
    assert_allclose(1000 * pixel * (x - r), DSS_439, atol=6e-4)
    assert_allclose(float((x - r)[-1]), -66.08, atol=5e-3)


def test_balanced_radial_distortion_vanishes_at_r0():
    """`brown` with r0 is `brown` without it, c and K_i divided by S = 1 + ΣK_i·r0^2i."""
    model = cameras.get_model("brown")
    A, r0 = np.array([2e-4, -3e-7, 1e-10]), 9.0
    S = 1 - A @ [r0**2, r0**4, r0**6]  # balanced to unbalanced: x·(S + ΣA_i·r^2i)
    balanced = (20.0, 0.1, -0.2, *A, 3e-5, -2e-5, 0.0, 0.0, r0)
    plain = (20.0 / S, 0.1, -0.2, *(A / S), 3e-5 / S, -2e-5 / S, 0.0, 0.0, 0.0)
    x, y = 7.0, -4.0
    assert_allclose(
        cameras.image_ray(model, balanced, x, y), cameras.image_ray(model, plain, x, y), rtol=1e-14
    )
    assert_allclose(model.to_ideal((20.0, 0, 0, *A, 0, 0, 0, 0, r0), r0, 0.0), (r0, 0.0))
