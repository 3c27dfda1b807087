"""What every camera model must satisfy: round trips, conventions and derivatives."""

import dataclasses
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from camera_cases import CASES, Case, each_case, image_rays, project
from numpy.testing import assert_allclose

from jaxbundle import cameras
from jaxbundle.choices import CAMERA_MODELS


def test_every_model_has_a_case():
    """And every family, whose names have numbers."""
    families = {name.partition("-N")[0] for name in cameras.FAMILIES}
    names = {next((f for f in families if case.name.startswith(f)), case.name) for case in CASES}
    assert names == {*cameras.MODEL_NAMES, *families}


@each_case
def test_every_parameter_of_the_case_counts(case):
    assert set(case.values) == set(case.model.parameters)
    assert all(case.values.values())


@each_case
def test_image_ray_and_project_are_inverse(case):
    xy = case.grid()
    rays = image_rays(case, xy)
    assert_allclose(jnp.linalg.norm(rays, axis=1), 1, rtol=1e-14)
    assert_allclose(project(case, 3.7 * rays), xy, atol=1e-12 * case.half_diagonal)


@each_case
def test_a_point_up_and_right_in_front(case):
    (x, y), (x0, y0) = project(case, [[0.1, 0.1, -1.0], [0.0, 0.0, -1.0]])
    assert x > x0
    assert (y > y0) == (case.model.axes == "up")


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
    """Functions of vectors a = (p, r, s, q, x, y), and samples of them [samples, arguments].

    The functions, compiled and batched: the residuals [samples, 2]; their Jacobians forward and
    reverse [samples, 2, arguments]; the derivative of the Jacobian in a direction.
    """
    n = len(case.p)

    def v(a):
        a = tuple(a)
        return jnp.stack(
            cameras.residual(case.model, domain, a[:n], a[n : n + 3], a[n + 3 :])
        )

    def jacobians(a):
        return jax.jacfwd(v)(a), jax.jacrev(v)(a)

    def second(a, direction):
        return jax.jvp(jax.jacrev(v), (a,), (direction,))[1]

    rng = np.random.default_rng(1)
    xy = case.grid()
    rays = 5 * (image_rays(case, xy) + 1e-3 * rng.normal(size=(len(xy), 3)))
    rays = rays.at[-1].set(jnp.array([0.0, 0.0, -5.0]))  # on the optical axis
    samples = jnp.concatenate([jnp.broadcast_to(jnp.array(case.p), (len(xy), n)), rays, xy], 1)
    jit = partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
    return (
        samples, jit(jax.vmap(v)), jit(jax.vmap(jacobians)), jit(jax.vmap(second, (0, None)))
    )


def difference(f, samples, step):
    """The derivative of f [samples, …] in the direction `step`, by differences of fourth order."""
    at = lambda k: f(samples + k * step)  # noqa: E731
    return (8 * (at(1) - at(-1)) - (at(2) - at(-2))) / 12


def own_domain(case):
    """That of the model's own formula; the other one is by the implicit function."""
    return "corrected" if case.model.own_formula == "to_ideal" else "measured"


FEW = ("brown", "opencv", "bingo", "kannala-brandt")
"""Models whose dear derivatives, by the implicit function, are looked at in every run."""


@pytest.mark.parametrize("case, domain", [
    pytest.param(case, domain, id=f"{domain}-{case.name}", marks=(
        [] if domain == own_domain(case) or case.name in FEW else pytest.mark.further
    ))
    for domain in ("corrected", "measured") for case in CASES
])  # fmt: skip
def test_jacobians_of_all_parameters_forward_reverse_and_numerical(case, domain):
    samples, v, jacobians, _ = residuals_of(case, domain)
    forward, reverse = jacobians(samples)
    scale = jnp.abs(forward).max((0, 1))
    assert jnp.all(scale > 0)
    assert_allclose(reverse / scale, forward / scale, atol=1e-12)

    size = 1e-4 * case.half_diagonal  # each step moves the image by about as much
    steps = jnp.diag(size / scale)
    numerical = jnp.stack([difference(v, samples, step) for step in steps], -1)
    assert_allclose(numerical / size, forward / scale, atol=1e-9)


@pytest.mark.parametrize("case", [
    pytest.param(case, id=case.name, marks=[] if case.name in FEW else pytest.mark.further)
    for case in CASES
])  # fmt: skip
def test_second_derivatives_of_all_parameters(case):
    """In the domain in which the model is inverted, by the implicit function."""
    domain = {"corrected": "measured", "measured": "corrected"}[own_domain(case)]
    samples, _, jacobians, second = residuals_of(case, domain)
    scale = jnp.abs(jacobians(samples)[1]).max((0, 1))
    step = 1e-4 * case.half_diagonal / scale
    p = jnp.abs(jnp.array(case.p))
    step = step.at[: len(p)].set(jnp.minimum(step[: len(p)], 0.01 * p))
    numerical = difference(lambda a: jacobians(a)[1], samples, step)
    assert_allclose(numerical / scale, second(samples, step) / scale, atol=1e-9)


def test_bingo_has_derivatives_at_the_image_origin():
    """√(x² + y²) has none there, x·√(x² + y²) has: the Jacobian is (1 − dr/R)·1."""
    model = cameras.get_model("bingo")
    p = (125.0, 0.3, -0.2, 33.8, -5.0, 1.1)
    J = jax.jit(jax.jacfwd(lambda xy: jnp.stack(model.to_ideal(p, *xy))))(jnp.zeros(2))
    s25, s26 = 0.3737850724543663, 0.304789700626975
    assert_allclose(J, (1 - 0.011 * (33.8 * s25 + 5.0 * s26 * 0.4)) * np.eye(2), rtol=1e-14)


@each_case
def test_single_precision_stays_single(case):
    single = Case(case.name, case.values, case.centre, case.half, jnp.float32)
    xy = case.grid().astype(jnp.float32)
    rays = image_rays(single, xy)
    back = project(single, rays)
    assert rays.dtype == back.dtype == jnp.float32
    assert_allclose(back, xy, atol=1e-5 * case.half_diagonal)


@each_case
def test_models_are_static_arguments(case):
    assert case.model == cameras.get_model(case.name)
    assert hash(case.model) == hash(cameras.get_model(case.name))


def test_unknown_models_are_named_with_the_closest():
    with pytest.raises(ValueError, match="'Brwon': did you mean 'brown'.*snavely"):
        cameras.get_model("Brwon")


@pytest.mark.parametrize("case", [
    pytest.param(case, id=case.name, marks=[] if case.name in FEW else pytest.mark.further)
    for case in CASES
])  # fmt: skip
def test_what_is_free_by_default_is_no_rotation_of_the_camera(case):
    """Otherwise no photographs could determine it: the Jacobian by the default parameters and a
    rotation of the rays has full rank, at the noise of differences in its smallest singular value.
    """
    rays = image_rays(case, case.grid())
    free = jnp.array([case.model.parameters.index(name) for name in case.model.free])

    def image(changes, turn):
        p = jnp.array(case.p).at[free].add(changes)
        return project(dataclasses.replace(case, values=dict(zip(case.model.parameters, p))),
                       rays + jnp.cross(turn, rays))  # fmt: skip

    J = jnp.concatenate(jax.jacfwd(image, (0, 1))(jnp.zeros(len(free)), jnp.zeros(3)), -1)
    J = np.asarray(J).reshape(-1, len(free) + 3)
    J = J[np.isfinite(J).all(1)]
    s = np.linalg.svd(J / np.linalg.norm(J, axis=0), compute_uv=False)
    assert s[-1] > 1e-9 * s[0]


def test_the_options_of_commands_name_every_model():
    assert set(CAMERA_MODELS) == set(cameras.MODEL_NAMES)
