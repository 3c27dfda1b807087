"""Bias compensation: injected biases found, covariance by Monte Carlo, tests, what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rpc_scenes import made_up, places

from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import WGS84, earth_fixed
from jaxbundle.pushbroom.rpc.bias import (
    RpcBias,
    apply_bias,
    bias_terms,
    fit_bias,
    images_and_slopes,
    project_compensated,
)
from jaxbundle.pushbroom.rpc.fitting import RpcTable
from jaxbundle.pushbroom.rpc.polynomials import project_points

RPC = made_up()
PLACES = places(RPC, 12)
BIAS = RpcBias(jnp.array([3.0, 0.5, -0.8]), jnp.array([-7.0, 0.2, 0.4]))
SHIFT = RpcBias(jnp.array([3.0, 0, 0]), jnp.array([-7.0, 0, 0]))
QUADRATIC = RpcBias(jnp.array([3.0, 0.5, -0.8, 0.3, 0.2, -0.4]),
                    jnp.array([-7.0, 0.2, 0.4, -0.1, 0.5, 0.3]))  # fmt: skip
image = jax.jit(jax.vmap(project_compensated, (None, None, 0, 0, 0)))


def control(bias, noise=0.0, rng=None):
    measured = np.stack(image(RPC, bias, *PLACES))
    noisy = measured if rng is None else measured + noise * rng.normal(size=measured.shape)
    return RpcTable(*PLACES, *noisy)


@pytest.mark.parametrize(
    "model, bias", [("shift", SHIFT), ("affine", BIAS), ("quadratic", QUADRATIC)]
)
def test_an_injected_bias_is_found_and_put_into_the_coefficients(model, bias):
    fit = fit_bias(RPC, control(bias), model=model)
    np.testing.assert_allclose(fit.bias.line, bias.line, atol=1e-9)
    np.testing.assert_allclose(fit.bias.sample, bias.sample, atol=1e-9)
    rpc, check = apply_bias(RPC, fit.bias)
    found = project_points(rpc, *PLACES)[:2]
    np.testing.assert_allclose(found, image(RPC, bias, *PLACES), atol=2e-3)
    assert (check is None) == (model == "shift")
    assert check is None or check.largest.max() < 2e-3


def test_covariance_redundancy_and_tests_by_drawing():
    """With σ of image and ground: unknowns scatter as stated, w is standard normal, σ0 is 1."""
    rng, noise, ground = np.random.default_rng(1), 0.4, np.array([2.0, 1.0, 5.0])
    draws = 400
    base = control(BIAS)
    east, north, h = PLACES
    X = np.array(earth_fixed(WGS84, PLACES))
    # the point as given is off the true one by east, north, up, here by spherical formulas
    N = np.linalg.norm(X, axis=0)
    unknowns, tests, sigma0 = [], [], []
    for _ in range(draws):
        e = ground * rng.normal(size=(len(h), 3))
        given = (east + e[:, 0] / (N * np.cos(north)), north + e[:, 1] / N, h + e[:, 2])
        measured = (column + noise * rng.normal(size=len(h)) for column in base[3:])
        fit = fit_bias(
            RPC, RpcTable(*given, *measured), model="affine", sigma=noise,
            ground_sigma=np.tile(ground, (len(h), 1)),
        )  # fmt: skip
        unknowns.append(np.r_[fit.bias.line, fit.bias.sample])
        tests.append(fit.w)
        sigma0.append(fit.sigma0)
    scatter = np.cov(np.array(unknowns).T)
    whitened = np.linalg.solve(fit.cofactor, scatter)
    assert np.trace(whitened) / 6 == pytest.approx(1.0, abs=0.06)
    assert np.mean(np.square(tests)) == pytest.approx(1.0, abs=0.05)
    assert np.mean(np.square(sigma0)) == pytest.approx(1.0, abs=0.05)
    assert fit.redundancy_numbers.sum() == pytest.approx(fit.redundancy, rel=1e-9) == 18


def test_every_point_by_its_own_block_as_of_the_dense_matrices():
    """All of P, Qv and A at once (Baarda, 1968), for a few points; 20 000 points are as cheap."""
    rng, ground = np.random.default_rng(3), np.array([2.0, 1.0, 5.0])
    table = control(BIAS, 0.4, rng)
    sigma = rng.uniform(0.3, 0.6, (12, 2))
    given = {"model": "affine", "ground_sigma": np.tile(ground, (12, 1))}
    fit = fit_bias(RPC, table, sigma=sigma, **given)
    computed, G = map(np.asarray, images_and_slopes(RPC, WGS84, *table[:3]))
    C = np.zeros((12, 2, 12, 2))
    for i in range(12):
        C[i, :, i] = G[i] @ np.diag(ground**2) @ G[i].T + np.diag(sigma[i] ** 2)
    C = C.reshape(24, 24)
    terms = np.stack(bias_terms(RPC, *computed.T), 1)[:, :3]
    A = np.kron(terms, np.eye(2)).reshape(24, 3, 2).swapaxes(1, 2).reshape(24, 6)
    P = np.linalg.inv(C)
    Q = np.linalg.inv(A.T @ P @ A)
    v = A @ (Q @ A.T @ P @ (np.stack(table[3:], 1) - computed).ravel())
    v -= (np.stack(table[3:], 1) - computed).ravel()
    Qv = C - A @ Q @ A.T
    np.testing.assert_allclose(fit.cofactor, Q, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(fit.residuals.ravel(), v, atol=1e-9)
    np.testing.assert_allclose(fit.redundancy_numbers.ravel(), np.diag(Qv @ P), atol=1e-10)
    w = (P @ v) / np.sqrt(np.diag(P @ Qv @ P))
    np.testing.assert_allclose(fit.w.ravel(), w, rtol=1e-8)
    assert fit.sigma0 == pytest.approx(np.sqrt(v @ P @ v / 18))
    many = RpcTable(*(np.resize(column, 20_000) for column in table))
    fit = fit_bias(RPC, many, **given | {"ground_sigma": np.tile(ground, (20_000, 1))})
    assert fit.redundancy_numbers.sum() == pytest.approx(39_994) == fit.redundancy


def test_a_blunder_has_the_largest_w_and_moves_its_residual_by_r():
    clean = control(SHIFT, 0.3, np.random.default_rng(2))
    line = clean.line.copy()
    line[4] += 6.0
    before, after = (fit_bias(RPC, c, sigma=0.3) for c in (clean, clean._replace(line=line)))
    assert np.abs(after.w).argmax() == 2 * 4
    moved = after.residuals[4, 0] - before.residuals[4, 0]
    assert moved == pytest.approx(-6.0 * before.redundancy_numbers[4, 0], rel=1e-9)
    np.testing.assert_allclose(before.redundancy_numbers, 1 - 1 / 12)
    np.testing.assert_allclose(before.covariance, np.eye(2) * (before.sigma0 * 0.3) ** 2 / 12)


def test_without_redundancy():
    one = RpcTable(*(column[:1] for column in control(SHIFT)))
    fit = fit_bias(RPC, one, sigma=0.5)
    assert fit.redundancy == 0 and np.isnan(fit.sigma0) and np.isnan(fit.w).all()
    np.testing.assert_allclose(fit.covariance, 0.25 * np.eye(2))


def one_point_twice(table):
    return RpcTable(*(np.repeat(column[:1], 4) for column in table))


def elsewhere(axis, shift):
    """The fourth point a turn and so much farther."""
    table = control(BIAS)
    moved = np.array(getattr(table, axis))
    moved[3] += shift + (2 * np.pi if axis == "longitude" else 0)
    return table._replace(**{axis: moved})


@pytest.mark.parametrize("table, options, words", [
    (control(BIAS), {"model": "afine"}, ["'afine'"]),
    (RpcTable(*(c[:2] for c in control(BIAS))), {"model": "affine"}, ["2 control points", "3"]),
    (one_point_twice(control(BIAS)), {"model": "affine"}, ["one line", "shift"]),
    (control(BIAS), {"sigma": 0.0}, ["row 1", "positive"]),
    (control(BIAS)._replace(height=np.r_[np.zeros(11), np.inf]), {}, ["row 12", "height"]),
    (elsewhere("latitude", 0.01), {}, ["row 4", "latitude", "domain", "-23.521 to -23.279"]),
    (elsewhere("longitude", -0.01), {}, ["row 4", "longitude"]),
    (elsewhere("height", 1500), {}, ["row 4", "height", "-260 to 1060 m", "ellipsoid"]),
    (elsewhere("line", 99999), {}, ["row 4", "line", "-300.6 to 6301.6", "measurement"]),
    (elsewhere("sample", -5000), {}, ["row 4", "sample"]),
], ids=["model", "few", "on a line", "sigma", "inf", "north", "east", "up", "line", "sample"])
def test_what_is_refused(table, options, words):
    with pytest.raises(InputError) as refused:
        fit_bias(RPC, table, **options)
    for word in words:
        assert word in str(refused.value)
