"""Rays through flat interfaces and domes: against rays traced forwards by Snell's law."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbundle.geometry import refraction

WATER, GLASS = 1.334, 1.52
refract_flat = jax.jit(refraction.refract_flat)
refract_dome = jax.jit(refraction.refract_dome)


def snell(d, normal, n, n_next):
    """The direction behind an interface, vectors of length 1; the normal on the side of d."""
    cosine = d @ normal
    ratio = n / n_next
    along = np.sqrt(1 - ratio**2 * (1 - cosine**2))
    return ratio * d + (along - ratio * cosine) * normal


def trace_flat(d, normal, distance, thickness, indices, further):
    """A point seen along d: traced through both planes, and further by a length."""
    x = d * distance / (d @ normal)
    d = snell(d, normal, *indices[:2])
    x = x + d * thickness / (d @ normal)
    return x + further * snell(d, normal, *indices[1:])


def trace_dome(d, centre, radius, thickness, indices, further):
    x = np.zeros(3)
    for R, n, n_next in ((radius, *indices[:2]), (radius + thickness, *indices[1:])):
        b = d @ (centre - x)
        x = x + d * (b + np.sqrt(b**2 - (centre - x) @ (centre - x) + R**2))
        d = snell(d, (x - centre) / R, n, n_next)
    return x + further * d


def unit(x):
    x = np.asarray(x, float)
    return x / np.linalg.norm(x)


@pytest.mark.parametrize("indices", [
    (1.0, GLASS, WATER), (1.0, WATER, WATER), (WATER, GLASS, 1.0), (1.0, GLASS, 1.0),
    (1.3, 1.1, 1.5),
])  # fmt: skip
def test_a_flat_port_sends_the_point_back_along_the_ray_it_came_from(indices):
    random = np.random.default_rng(1)
    worst = 0.0
    for _ in range(300):
        normal = unit(random.normal(size=3))
        side = unit(np.cross(normal, random.normal(size=3)))
        # up to 89.9° from the normal, where the ray is let through
        least = np.arcsin(min(1.0, min(indices) / indices[0]))
        angle = 0.9999 * least * random.uniform() ** 0.3
        d = np.cos(angle) * normal + np.sin(angle) * side
        distance, thickness, further = 10 ** random.uniform((-3, -3, -2), (1, 0, 2))
        P = trace_flat(d, normal, distance, thickness, indices, further)
        found = np.array(refract_flat(tuple(P), tuple(normal), distance, thickness, indices))
        worst = max(worst, np.linalg.norm(unit(found) - d))
    # near the critical angle the ray out changes by the root of rounding with that in
    assert worst < (1e-12 if indices[0] == min(indices) else 1e-8), worst


@pytest.mark.parametrize("indices", [(1.0, GLASS, WATER), (1.0, 1.0, 1.0)])
def test_a_dome_sends_the_point_back_along_the_ray_it_came_from(indices):
    random = np.random.default_rng(2)
    for _ in range(300):
        radius, thickness = random.uniform(0.03, 0.2), random.uniform(0.0, 0.02)
        centre = unit(random.normal(size=3)) * radius * random.uniform(0, 0.5)
        d = unit(random.normal(size=3))
        P = trace_dome(d, centre, radius, thickness, indices, 10 ** random.uniform(-3, 2))
        found = np.array(refract_dome(tuple(P), tuple(centre), radius, thickness, indices))
        np.testing.assert_allclose(unit(found), d, atol=1e-12)


def test_a_centred_dome_and_the_normal_do_not_refract():
    P = (0.3, -0.2, -2.0)
    found = refract_dome(P, (0.0, 0.0, 0.0), 0.1, 0.01, (1.0, GLASS, WATER))
    np.testing.assert_allclose(unit(found), unit(P), atol=1e-15)
    along = refract_flat((0.0, 0.0, -2.0), (0.0, 0.0, -1.0), 0.1, 0.01, (1.0, GLASS, WATER))
    np.testing.assert_allclose(unit(along), [0, 0, -1], atol=1e-15)


def test_a_point_that_is_not_behind_the_interface_is_seen_straight():
    down, P = (0.0, 0.0, -1.0), (0.3, 0.1, -1.9)
    above = refract_flat(P, down, 2.0, 0.0, (1.0, WATER, WATER))
    diver = refract_flat(P, down, -2.0, 0.0, (1.0, WATER, WATER))  # the camera is behind it
    inside = refract_dome(P, (0.0, 0.0, 0.01), 2.1, 0.01, (1.0, GLASS, WATER))
    for found in (above, diver, inside):
        np.testing.assert_array_equal(found, P)


FLAT = jnp.array([0.4, -0.3, -2.0, 0.1, 0.05, -1.0, 0.06, 0.01, 1.0, GLASS, WATER])
DOME = jnp.array([0.4, -0.3, -2.0, 0.01, 0.004, -0.02, 0.06, 0.01, 1.0, GLASS, WATER])


def seen_flat(x):
    n = x[3:6] / jnp.linalg.norm(x[3:6])
    r = refract_flat(tuple(x[:3]), tuple(n), x[6], x[7], tuple(x[8:]))
    return jnp.stack([r[0] / r[2], r[1] / r[2]])


def seen_dome(x):
    r = refract_dome(tuple(x[:3]), tuple(x[3:6]), x[6], x[7], tuple(x[8:]))
    return jnp.stack([r[0] / r[2], r[1] / r[2]])


@pytest.mark.parametrize("f, x", [
    (seen_flat, FLAT), (seen_dome, DOME), (seen_flat, FLAT.at[:6].set([0, 0, -2, 0, 0, -1])),
    (seen_dome, DOME.at[3:6].set(0.0)),
], ids=["flat", "dome", "on the normal", "centred"])  # fmt: skip
def test_derivatives_of_first_and_second_order(f, x):
    """Against differences of five points; forward and reverse mode agree."""
    J, H = jax.jit(jax.jacfwd(f))(x), jax.jit(jax.jacfwd(jax.jacrev(f)))(x)
    np.testing.assert_allclose(jax.jit(jax.jacrev(f))(x), J, atol=1e-12)
    for of, found in ((jax.jit(f), J), (jax.jit(jax.jacfwd(f)), H)):
        h = 1e-4
        differences = np.stack([
            sum(w * np.asarray(of(x + k * h * e)) for k, w in
                ((1, 8 / 12), (-1, -8 / 12), (2, -1 / 12), (-2, 1 / 12))) / h
            for e in np.eye(len(x))
        ], -1)  # fmt: skip
        np.testing.assert_allclose(found, differences, rtol=1e-6, atol=1e-6)


def test_iterations_are_enough(monkeypatch):
    """Twice as many change nothing: grazing rays, thin and thick layers, large decentring."""
    random = np.random.default_rng(3)
    flat, dome = [], []
    for _ in range(2000):
        side, depth = 10 ** random.uniform((-2, -3), (3, 1))
        flat.append((side, 0.0, -depth, *10 ** random.uniform((-4, -4), (1, 0))))
        centre = unit(random.normal(size=3)) * random.uniform(0, 0.5)
        dome.append((*unit(random.normal(size=3)) * 10 ** random.uniform(0.1, 3), *centre))
    flat, dome = (tuple(np.array(x).T) for x in (flat, dome))
    air = (1.0, GLASS, WATER)
    x, y, z, distance, thickness = flat
    window = ((0.0, 0.0, -1.0), distance, thickness, air)
    run = lambda: [
        np.stack(refraction.refract_flat((x, y, z - distance - thickness), *window)),
        np.stack(refraction.refract_dome(dome[:3], dome[3:], 1.0, 0.1, air)),
    ]  # fmt: skip
    few = run()
    monkeypatch.setattr(refraction, "FLAT_ITERATIONS", 24)
    monkeypatch.setattr(refraction, "DOME_ITERATIONS", 12)
    for one, other in zip(few, run()):
        one, other = one / np.linalg.norm(one, axis=0), other / np.linalg.norm(other, axis=0)
        assert np.abs(one - other).max() < 1e-13
