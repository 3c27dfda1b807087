"""The implicit inverse: convergence, exact derivatives of every order, NaN outside the domain."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from camera_cases import Case, image_rays, project
from numpy.testing import assert_allclose

from jaxbundle import cameras
from jaxbundle.cameras import implicit_inverse


def cubic(p, x, y):
    K, P, b = p
    r2 = x * x + y * y
    return x + K * r2 * x + P * (r2 + 2 * x * x) + b * y, y + K * r2 * y + 2 * P * x * y


def unrolled(p, X, Y):
    """The inverse of `cubic` by a contraction, every iteration differentiated."""

    def step(_, xy):
        gx, gy = cubic(p, *xy)
        return xy[0] + X - gx, xy[1] + Y - gy

    return jax.lax.fori_loop(0, 40, step, (X, Y))


inverse = implicit_inverse(cubic, start=lambda p, X, Y: (X, Y))
SAMPLES = jnp.array(
    [[0.05, 0.01, -0.02, 0.7, -0.4], [-0.04, -0.02, 0.01, 0.3, 0.8], [0.05, 0.01, 0.02, 0.0, 0.0]]
)


def as_vector_function(inverse):
    return lambda a: jnp.stack(inverse((a[0], a[1], a[2]), a[3], a[4]))


def test_the_unrolled_reference_has_converged():
    for a in SAMPLES:
        assert_allclose(cubic(a[:3], *unrolled(a[:3], a[3], a[4])), a[3:], atol=1e-15)


@pytest.mark.parametrize(
    "derivative",
    [
        lambda f: f,
        jax.jacfwd,
        jax.jacrev,
        jax.hessian,
        lambda f: jax.jacfwd(jax.jacfwd(jax.jacfwd(f))),
    ],
    ids=["value", "jacfwd", "jacrev", "hessian", "third"],
)
def test_derivatives_equal_those_of_the_unrolled_inverse(derivative):
    jit = partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
    ours = jit(jax.vmap(derivative(as_vector_function(inverse))))(SAMPLES)
    reference = jit(jax.vmap(derivative(as_vector_function(unrolled))))(SAMPLES)
    assert_allclose(ours, reference, atol=2e-13 * jnp.abs(reference).max())


def test_second_derivatives_against_finite_differences():
    f, step = as_vector_function(inverse), 1e-5 * jnp.eye(5)
    jacobian = jax.jit(jax.vmap(jax.vmap(jax.jacfwd(f))))
    samples = SAMPLES[:, None]
    numerical = (jacobian(samples + step) - jacobian(samples - step)) / 2e-5
    hessian = jax.jit(jax.vmap(jax.hessian(f)))(SAMPLES)
    assert_allclose(jnp.moveaxis(numerical, 1, -1), hessian, atol=1e-8)


THESIS = Case(  # examples/convergent4, all ten parameters; its measured points lie within 12 mm
    "brown",
    dict(c=18.528014315, x0=0.2834298, y0=0.02675643, K1=2.2723256e-4, K2=2.4496753e-6,
         K3=-3.4431701e-8, P1=3.5647508e-5, P2=-3.6367571e-5, b1=-1.5800064e-3, b2=2.7737157e-4,
         r0=0.0),
    (0, 0), (9, 7),
)
FLAT_FISHEYE = Case(  # nearly flat towards 2 rad: the slowest known
    "kannala-brandt",
    dict(fx=285.0, fy=286.0, cx=420.0, cy=400.0, k1=-0.0070, k2=0.0412, k3=-0.0384, k4=0.0064),
    (420, 400), (420, 400),
)


@pytest.mark.parametrize("case", [THESIS, FLAT_FISHEYE], ids=["thesis", "flat fisheye"])
def test_strong_distortions_converge_to_rounding_over_the_image(case):
    xy = case.grid(41)
    back = project(case, image_rays(case, xy))
    assert_allclose(back, xy, atol=1e-12 * case.half_diagonal)


@pytest.mark.parametrize("radius", [0.3, 0.9, 0.99, 1.01, 1.2, 2.0, 10.0, 1e4])
def test_a_target_out_of_range_gives_nan_and_never_another_branch(radius):
    k1 = -0.2  # the measured radius never exceeds 2/3·f/√(3·0.2)
    model, f = cameras.get_model("snavely"), 500.0
    limit = 2 / 3 * f / np.sqrt(3 * 0.2)
    angle = np.linspace(0, 2 * np.pi, 13)
    x, y = radius * limit * np.cos(angle), radius * limit * np.sin(angle)
    ideal = np.asarray(jax.vmap(lambda x, y: model.to_ideal((f, k1, 0.0), x, y))(x, y))
    if radius < 1:
        back = jax.vmap(lambda x, y: model.from_ideal((f, k1, 0.0), x, y))(*ideal)
        assert_allclose(back, (x, y), atol=1e-10)
        assert np.all(np.hypot(*ideal) < f / np.sqrt(3 * 0.2))
    else:
        assert np.all(np.isnan(ideal))


def test_derivatives_where_there_is_no_root_are_nan_too():
    model = cameras.get_model("snavely")
    gradient = jax.grad(lambda k1: model.to_ideal((500.0, k1, 0.0), 600.0, 0.0)[0])
    assert jnp.isnan(gradient(-0.2))


def test_parameters_may_be_integers():
    model = cameras.get_model("brown-projected")
    p = (10, 1, 2, 0.001, 0, 0, 0, 0, 0, 0, 0)
    x, y = model.from_ideal(p, 3, -2)
    assert_allclose(model.to_ideal(p, x, y), (3, -2), rtol=1e-14)
