"""What every camera model must satisfy: round trips, conventions and derivatives."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from camera_cases import CASES, each_case
from numpy.testing import assert_allclose

from jaxbundle import cameras


def test_every_model_has_a_case():
    assert {case.name for case in CASES} == set(cameras.MODEL_NAMES)


@each_case
def test_every_parameter_of_the_case_counts(case):
    assert set(case.values) == set(case.model.parameters)
    assert all(case.values.values())


@each_case
def test_image_ray_and_project_are_inverse(case):
    @jax.jit
    @jax.vmap
    def there_and_back(xy):
        ray = cameras.image_ray(case.model, case.p, *xy)
        return ray, cameras.project(case.model, case.p, *(3.7 * v for v in ray))

    xy = case.grid(21)
    ray, back = there_and_back(xy)
    assert_allclose(jnp.linalg.norm(jnp.stack(ray), axis=0), 1, rtol=1e-14)
    assert_allclose(jnp.stack(back, 1), xy, atol=1e-12 * case.half_diagonal)


@each_case
def test_a_point_up_and_right_in_front(case):
    x0, y0 = case.model.from_ideal(case.p, 0.0, 0.0)
    x, y = cameras.project(case.model, case.p, 0.1, 0.1, -1.0)
    assert x > x0
    assert (y > y0) == (case.model.axes == "up")


@each_case
def test_the_residual_is_zero_for_a_point_on_its_ray_in_both_domains(case):
    xy = tuple(case.grid(2)[0])
    ray = cameras.image_ray(case.model, case.p, *xy)
    for domain in ("corrected", "measured"):
        v = cameras.residual(case.model, domain, case.p, ray, xy)
        assert_allclose(v, 0, atol=1e-11 * case.half_diagonal)


def test_the_residual_is_computed_minus_observed():
    model = cameras.get_model("brown")
    p = (10.0,) + (0.0,) * 10
    for domain in ("corrected", "measured"):
        v = cameras.residual(model, domain, p, (1.0, 2.0, -10.0), (0.25, 0.5))
        assert_allclose(v, (0.75, 1.5))


def test_an_unknown_domain_is_refused():
    model = cameras.get_model("snavely")
    with pytest.raises(ValueError, match="'corrected' or 'measured', not 'image'"):
        cameras.residual(model, "image", (1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 0.0))


@cache
def residuals_of(case, domain):
    """The residual as a function of one vector a = (p, r, s, q, x, y): samples of it [samples,
    arguments], the residuals [samples, 2], their Jacobians forward and reverse, and the derivative
    of the Jacobian in a direction [samples, 2, arguments]."""
    n = len(case.p)

    def v(a):
        a = tuple(a)
        return jnp.stack(
            cameras.residual(case.model, domain, a[:n], a[n : n + 3], a[n + 3 :])
        )

    def second(a, direction):
        return jax.jvp(jax.jacrev(v), (a,), (direction,))[1]

    rng = np.random.default_rng(1)
    xy = case.grid(4)
    ray = jnp.stack(jax.vmap(lambda xy: cameras.image_ray(case.model, case.p, *xy))(xy), 1)
    ray = (ray + 1e-3 * rng.normal(size=ray.shape)) * 5
    ray = ray.at[-1].set(jnp.array([0.0, 0.0, -5.0]))  # on the optical axis
    samples = jnp.concatenate([jnp.broadcast_to(jnp.array(case.p), (len(xy), n)), ray, xy], 1)
    functions = (v, jax.jacfwd(v), jax.jacrev(v))
    return samples, *(jax.jit(jax.vmap(f)) for f in functions), jax.jit(jax.vmap(second, (0, None)))


def difference(f, samples, step):
    """The derivative of f [samples, …] in the direction `step`, by differences of fourth order."""
    at = lambda k: f(samples + k * step)  # noqa: E731
    return (8 * (at(1) - at(-1)) - (at(2) - at(-2))) / 12


domains = pytest.mark.parametrize("domain", ["corrected", "measured"])


@each_case
@domains
def test_jacobians_of_all_parameters_forward_reverse_and_numerical(case, domain):
    samples, v, jacfwd, jacrev, _ = residuals_of(case, domain)
    forward, reverse = jacfwd(samples), jacrev(samples)
    scale = jnp.abs(forward).max((0, 1))
    assert jnp.all(scale > 0)
    assert_allclose(reverse / scale, forward / scale, atol=1e-12)

    size = 1e-4 * case.half_diagonal  # each step moves the image by about as much
    steps = jnp.diag(size / scale)
    numerical = jnp.stack([difference(v, samples, step) for step in steps], -1)
    assert_allclose(numerical / size, forward / scale, atol=1e-9)


@each_case
@domains
def test_second_derivatives_of_all_parameters(case, domain):
    samples, _, _, jacrev, second = residuals_of(case, domain)
    scale = jnp.abs(jacrev(samples)).max((0, 1))
    signs = np.random.default_rng(2).choice([-1, 1], len(scale))
    step = 1e-4 * case.half_diagonal / scale * signs
    analytic = second(samples, step)
    numerical = difference(jacrev, samples, step)
    assert_allclose(numerical / scale, analytic / scale, atol=1e-9)


def test_bingo_has_derivatives_at_the_image_origin():
    """√(x² + y²) has none there, x·√(x² + y²) has: the Jacobian is (1 − dr/R)·1."""
    model = cameras.get_model("bingo")
    p = (125.0, 0.3, -0.2, 33.8, -5.0, 1.1)
    J = jax.jacfwd(lambda xy: jnp.stack(model.to_ideal(p, *xy)))(jnp.zeros(2))
    s25, s26 = 0.3737850724543663, 0.304789700626975
    assert_allclose(J, (1 - 0.011 * (33.8 * s25 + 5.0 * s26 * 0.4)) * np.eye(2), rtol=1e-14)


@each_case
def test_single_precision_stays_single(case):
    p = tuple(jnp.float32(v) for v in case.p)
    xy = case.grid(2)[0].astype(jnp.float32)
    ray = cameras.image_ray(case.model, p, *xy)
    back = cameras.project(case.model, p, *ray)
    assert {a.dtype for a in (*ray, *back)} == {jnp.dtype("float32")}
    assert_allclose(jnp.stack(back), xy, atol=1e-5 * case.half_diagonal)


@each_case
def test_a_model_is_a_static_argument(case):
    assert hash(case.model) == hash(cameras.get_model(case.name))
    project = jax.jit(cameras.project, static_argnums=0)
    assert_allclose(
        project(case.model, case.p, 0.1, -0.2, -1.0),
        cameras.project(case.model, case.p, 0.1, -0.2, -1.0),
        rtol=1e-14,
    )


def test_unknown_models_are_named_with_the_closest():
    with pytest.raises(ValueError, match="'Brwon': did you mean 'brown'.*snavely"):
        cameras.get_model("Brwon")
