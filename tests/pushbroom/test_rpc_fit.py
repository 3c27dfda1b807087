"""RPC fits: 0.002 pixel to a rigorous model, the minimum, its covariance, what is refused."""

import dataclasses

import jax
import numpy as np
import pytest
from rpc_scenes import made_up, smooth_image, table_of
from scipy.optimize import least_squares

from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import WGS84
from jaxbundle.pushbroom.rpc.fitting import RpcTable, check_rpc, fit_image, fit_rpc, image_table
from jaxbundle.pushbroom.rpc.polynomials import Rpc, project_points

TRUE = made_up()


def test_a_rigorous_model_within_two_thousandths():
    """Over 6000 lines and 4000 pixels, 3100 m of heights, at places the fit has not seen."""
    image = smooth_image(6000, 4000)
    fit, check = fit_image(image, WGS84, (-100.0, 3000.0))
    assert fit.converged and check.largest.max() < 0.002
    assert fit.check.largest.max() < 0.002
    beyond = image_table(image, WGS84, np.array([-137.0, 1499.0, 3050.0]), (9, 9))
    assert check_rpc(fit.rpc, beyond).largest.max() < 0.002
    worst = check.residuals[check.worst]
    assert np.abs(worst).max() == check.largest.max()


def test_coefficients_across_the_date_line_are_found_again():
    fit = fit_rpc(table_of(TRUE))
    assert fit.converged
    elsewhere = table_of(TRUE, (5, 6, 3))
    assert check_rpc(fit.rpc, elsewhere).largest.max() < 1e-3


def test_the_minimum_is_that_of_scipy():
    """The same sum of squares minimised from the true coefficients by another program."""
    table = table_of(TRUE, noise=0.5)
    tau = 0.05
    fit = fit_rpc(table, ridge=tau)
    rpc = jax.tree.map(np.asarray, fit.rpc)
    scale = float(rpc.line_scale)
    places = (
        (np.degrees(table.longitude) - rpc.longitude_offset + 180) % 360 - 180,
        np.degrees(table.latitude) - rpc.latitude_offset, table.height - rpc.height_offset,
    )  # fmt: skip
    L, P, H = (v / s for v, s in zip(places, (
        rpc.longitude_scale, rpc.latitude_scale, rpc.height_scale,
    )))  # fmt: skip
    T = np.stack([
        1 + 0 * L, L, P, H, L * P, L * H, P * H, L**2, P**2, H**2, P * L * H, L**3, L * P**2,
        L * H**2, L**2 * P, P**3, P * H**2, L**2 * H, P**2 * H, H**3,
    ], 1)  # fmt: skip
    D = np.r_[np.full(4, 1e-3), np.ones(35)]
    y = (table.line - rpc.line_offset) / scale
    v = lambda c: np.r_[T @ c[:20] / (1 + T[:, 1:] @ c[20:]) - y, tau * D * c]
    start = np.zeros(39)
    start[2] = -1.0
    found = least_squares(v, start, xtol=1e-15, ftol=1e-15, gtol=1e-15, x_scale=1 / D)
    ours = np.r_[rpc.line_numerator, rpc.line_denominator[1:]]
    assert 2 * found.cost >= np.sum(v(ours) ** 2) * (1 - 1e-10)
    computed = project_points(fit.rpc, table.longitude, table.latitude, table.height)[0]
    theirs = rpc.line_offset + scale * (v(found.x)[: len(y)] + y)
    np.testing.assert_allclose(computed, theirs, atol=2e-4)


@pytest.mark.further
def test_covariance_by_monte_carlo():
    """σ a posteriori, and the scatter of lines and samples at other points, within a few %."""
    noise, draws, tau = 0.3, 150, 0.01
    places = table_of(TRUE, (4, 4, 3))
    fits = [fit_rpc(table_of(TRUE, (6, 6, 4), noise, k), ridge=tau) for k in range(draws)]
    assert all(fit.converged for fit in fits)
    sigma = np.array([fit.sigma for fit in fits])
    np.testing.assert_allclose(np.sqrt(np.mean(sigma**2, 0)), noise, rtol=0.02)
    found = np.stack([
        np.stack(project_points(fit.rpc, *places[:3])[:2]) for fit in fits
    ])  # fmt: skip
    scatter = found.var(axis=0, ddof=1).mean(axis=1)

    def image_of(c, rpc):
        for k, name in enumerate(("line", "sample")):
            full = jax.numpy.concatenate([jax.numpy.ones(1), c[k, 20:]])
            changes = {f"{name}_numerator": c[k, :20], f"{name}_denominator": full}
            rpc = dataclasses.replace(rpc, **changes)
        return jax.numpy.stack(project_points(rpc, *places[:3])[:2])

    fit = fits[0]
    assert isinstance(fit.rpc, Rpc)
    c = np.stack([
        np.r_[fit.rpc.line_numerator, fit.rpc.line_denominator[1:]],
        np.r_[fit.rpc.sample_numerator, fit.rpc.sample_denominator[1:]],
    ])  # fmt: skip
    J = np.asarray(jax.jacfwd(image_of)(c, fit.rpc))
    for k in range(2):
        cofactor = fit.covariance[k] / fit.sigma[k] ** 2
        predicted = noise**2 * np.einsum("ni,ij,nj->n", J[k, :, k], cofactor, J[k, :, k]).mean()
        assert predicted == pytest.approx(scatter[k], rel=0.06)


def test_the_chosen_ridge_predicts_about_as_well_as_any():
    noisy = table_of(TRUE, (5, 5, 4), noise=0.5)
    truth = table_of(TRUE, (8, 8, 5))
    error = lambda tau: check_rpc(fit_rpc(noisy, ridge=tau).rpc, truth).rms.max()
    chosen = check_rpc(fit_rpc(noisy).rpc, truth).rms.max()
    every = [error(tau) for tau in (10.0, 1.0, 1e-1, 1e-2, 1e-3)]
    assert chosen < 1.1 * min(every) and chosen < 0.9 * max(every)


def test_few_points_end_with_a_ridge_that_converges():
    """Sixty random points of a noise of 0.3 pixel: σ is that noise, to four of its deviations."""
    table, rng = table_of(TRUE, (8, 8, 6), noise=0.3), np.random.default_rng(0)
    draws = [rng.choice(len(table.line), 60, replace=False) for _ in range(29)]
    fit = fit_rpc(RpcTable(*(column[draws[28]] for column in table)))
    assert fit.converged
    assert (np.abs(fit.sigma / 0.3 - 1) < 4 / np.sqrt(2 * fit.redundancy)).all()


def broken(**columns):
    table = table_of(TRUE, (4, 4, 3))
    return table._replace(**{k: f(getattr(table, k).copy()) for k, f in columns.items()})


def with_nan(column):
    column[6] = np.nan
    return column


@pytest.mark.parametrize("table, words", [
    (broken(line=with_nan), ["row 7", "line", "finite"]),
    (broken(height=lambda h: 0 * h + 250), ["every height is 250", "several heights"]),
    (broken(longitude=lambda a: 0 * a + 0.3), ["every longitude is 17.1887°", "longitudes"]),
    (broken(longitude=lambda a: 0 * a + np.pi * (-1) ** np.arange(len(a))), ["180°"]),
    (broken(latitude=lambda a: 0 * a), ["every latitude is 0°", "several latitudes"]),
    (broken(sample=lambda s: s[:-1]), ["sample", "shape"]),
    (table_of(TRUE, (3, 3, 3)), ["27 points", "at least 40"]),
], ids=["nan", "height", "longitude", "date line", "latitude", "lengths", "few"])  # fmt: skip
def test_what_is_refused(table, words):
    with pytest.raises(InputError) as refused:
        fit_rpc(table)
    for word in words:
        assert word in str(refused.value)


def test_heights_that_no_ray_meets_are_said():
    with pytest.raises(InputError, match="misses the height 600000 m"):
        fit_image(smooth_image(), WGS84, (0.0, 6e5), size=(3, 3, 2))
