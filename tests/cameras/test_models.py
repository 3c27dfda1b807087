"""What every camera model must satisfy: round trips, conventions and derivatives."""

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


def residuals_of(case, domain):
    """The residual as a function of one vector (p, r, s, q, x, y), and samples of it."""
    n = len(case.p)

    def v(a):
        a = tuple(a)
        return jnp.stack(
            cameras.residual(case.model, domain, a[:n], a[n : n + 3], a[n + 3 :])
        )

    rng = np.random.default_rng(1)
    xy = case.grid(4)
    ray = jnp.stack(jax.vmap(lambda xy: cameras.image_ray(case.model, case.p, *xy))(xy), 1)
    ray = (ray + 1e-3 * rng.normal(size=ray.shape)) * 5
    ray = ray.at[-1].set(jnp.array([0.0, 0.0, -5.0]))  # on the optical axis
    return v, jnp.concatenate([jnp.broadcast_to(jnp.array(case.p), (len(xy), n)), ray, xy], 1)


@each_case
@pytest.mark.parametrize("domain", ["corrected", "measured"])
def test_jacobians_of_all_parameters_forward_reverse_and_numerical(case, domain):
    v, samples = residuals_of(case, domain)
    forward = jax.jit(jax.vmap(jax.jacfwd(v)))(samples)  # [samples, 2, arguments]
    reverse = jax.jit(jax.vmap(jax.jacrev(v)))(samples)
    scale = jnp.abs(forward).max((0, 1))
    assert jnp.all(scale > 0)
    assert_allclose(reverse / scale, forward / scale, atol=1e-12)

    # central differences of fourth order; each step moves the image equally
    h = 1e-4 * case.half_diagonal / scale
    at = lambda k: v_of_all(samples[:, None] + k * jnp.diag(h))  # noqa: E731
    v_of_all = jax.jit(jax.vmap(jax.vmap(v)))
    numerical = (8 * (at(1) - at(-1)) - (at(2) - at(-2))) / (12 * h[:, None])
    assert_allclose(jnp.swapaxes(numerical, 1, 2) / scale, forward / scale, atol=1e-9)


@each_case
@pytest.mark.parametrize("domain", ["corrected", "measured"])
def test_second_derivatives_are_finite(case, domain):
    v, samples = residuals_of(case, domain)
    assert jnp.all(jnp.isfinite(jax.jit(jax.vmap(jax.hessian(v)))(samples[-6:])))


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
