"""A drive past many points: the reduced system dense, banded, and solved by iteration."""

import dataclasses

import equinox as eqx
import jax
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import jaxbundle
from jaxbundle.adjustment.datum import choose_pins, gauge_directions
from jaxbundle.adjustment.jacobian import compiled_jacobian, jacobian
from jaxbundle.adjustment.normal import diagonal, gradient, normal_from_jacobian
from jaxbundle.adjustment.problem import make_problem
from jaxbundle.adjustment.residuals import residuals
from jaxbundle.adjustment.schur import factorise, solve
from jaxbundle.adjustment.solve import find_minimum, make_solver
from jaxbundle.geometry import matrix_from_omega_phi_kappa
from jaxbundle.network import Camera
from jaxbundle.network.build import make_network
from jaxbundle.network.padding import common_sizes, pad, sizes_of, without_filling
from jaxbundle.network.reduction import FACTORS, choose_reduction, find_band, plan_reduction
from jaxbundle.statistics.cofactors import cofactors, undamped_factor
from jaxbundle.statistics.reliability import hat_diagonal

IMAGES, REACH = 40, 4


def street(datum="inner", control=()):
    """Images along a line, shuffled, each seeing the points next to it; one camera, c free."""
    rng = np.random.default_rng(3)
    points = np.c_[rng.uniform(0, IMAGES - 1, 300), rng.uniform(4, 9, 300), rng.normal(size=300)]
    place = rng.permutation(IMAGES)
    image, point = np.nonzero(np.abs(place[:, None] - points[:, 0]) < REACH / 2)
    centre = np.c_[place, 0.1 * rng.normal(size=IMAGES), 0.1 * rng.normal(size=IMAGES)]
    angles = np.c_[np.full(IMAGES, np.pi / 2), np.zeros((IMAGES, 2))]
    angles = angles + 0.15 * rng.normal(size=(IMAGES, 3))
    M = np.asarray(jax.vmap(matrix_from_omega_phi_kappa)(angles))
    r, s, q = np.einsum("nij,nj->in", M[image], points[point] - centre[image])
    xy = -20 * np.stack([r, s]).T / q[:, None] + 0.005 * rng.normal(size=(len(image), 2))
    table = lambda names, columns: dict(zip(names, columns))
    role = np.array(["tie"] * 300, dtype=object)
    role[list(control)] = "fixed"
    return make_network(
        Camera("cam", "brown", {"c": 20.0}, free=("c",)),
        table(("id", "camera", "X0", "Y0", "Z0", "omega", "phi", "kappa"),
              (np.arange(IMAGES), ["cam"] * IMAGES, *(centre + 0.01).T, *angles.T)),
        table(("id", "role", "X", "Y", "Z"), (np.arange(300), role, *points.T)),
        table(("image", "point", "x", "y"), (image, point, *xy.T)),
        sigma_image=0.005, datum=datum,
    )  # fmt: skip


def test_images_with_common_points_stand_close():
    structure = make_problem(street(), "banded").structure
    place = np.asarray(structure.band.place)
    assert sorted(place) == list(range(IMAGES))
    pairs = structure.image_pairs
    apart = np.abs(place[np.asarray(pairs.row)] - place[np.asarray(pairs.column)])
    assert apart.max() == structure.band.width <= 2 * REACH
    assert structure.band.blocks == -(-IMAGES // structure.band.width)


def test_the_way_is_chosen_by_size_and_fill():
    row, column = np.triu_indices(200, 1)
    full = find_band(row, column, 200)
    narrow = find_band(np.arange(199), np.arange(1, 200), 200)
    assert (full.width, narrow.width) == (199, 1)
    way = lambda band, images, rays: choose_reduction(band, images, 9, 0, rays)
    small = plan_reduction((np.arange(99), np.arange(1, 100)), 100, 9, 0, 10_000)
    assert small == ("dense", None)
    assert way(full, 200, 200_000) == "dense"
    assert way(narrow, 200, 200_000) == "banded"
    everywhere = dataclasses.replace(full, width=9999, blocks=2)
    assert way(everywhere, 10_000, 2_000_000) == "iterative"
    # Where a factor is needed and none fits into memory, there is none.
    assert choose_reduction(everywhere, 10_000, 9, 0, 2_000_000, FACTORS) is None


@pytest.mark.parametrize("damped", [True, False], ids=["damped", "undamped"])
@pytest.mark.parametrize("free", [True, False], ids=["free", "controlled"])
@pytest.mark.parametrize("reduction", ["banded", "iterative"])
def test_the_step_is_that_of_the_dense_system(reduction, free, damped):
    options = {} if free else {"datum": "control", "control": (0, 100, 200, 299)}
    steps = []
    for way in ("dense", reduction):
        problem = make_problem(street(**options), way)
        assert problem.structure.reduction == way
        s, data = problem.structure, problem.data

        @eqx.filter_jit
        def step(s, data):
            jac = jacobian(s, data.start, data)
            normal = normal_from_jacobian(jac)
            damping = jax.tree.map(lambda d: damped * 1e-3 * d, diagonal(normal))
            factor = factorise(s, normal, damping, not damped)
            right = gradient(jac, residuals(s, data.start, data))
            change = solve(factor, right)
            # What the step does to the observations does not depend on the datum.
            return jac.mv(change).image, change

        steps.append(step(s, data))
    (rows, change), (other_rows, other_change) = steps
    # Conjugate gradients apply S as the difference A − ZᵀZ, and end at a residual; the condition
    # of a long street stands between it and x, the more the nearer one looks at single unknowns.
    loss = 100 if reduction == "iterative" else 1
    size = np.abs(rows).max()
    np.testing.assert_allclose(other_rows, rows, rtol=1e-7 * loss, atol=1e-8 * loss * size)
    if not free:
        a, b = ravel_pytree(change)[0], ravel_pytree(other_change)[0]
        size = np.abs(a).max()
        # 1e-4 of the step: what the street bends by without moving an image point by 1e-6.
        np.testing.assert_allclose(b, a, rtol=1e-8, atol=1e-4 * size if loss > 1 else 1e-9 * size)


def test_pins_hold_the_datum():
    problem = make_problem(street(), "banded")
    pins = choose_pins(problem.structure, problem.data)
    G = np.asarray(gauge_directions(problem.structure, problem.data.start).image)
    assert pins.sum() == problem.structure.defect == 7
    held = G[pins > 0] / np.linalg.norm(G.reshape(-1, 7), axis=0)
    assert np.linalg.cond(held) < 1e4


@pytest.mark.parametrize("free", [True, False], ids=["free", "controlled"])
def test_cofactors_of_the_band_are_those_of_the_dense_system(free):
    options = {} if free else {"datum": "control", "control": (0, 100, 200, 299)}
    found = []
    for way in FACTORS:
        problem = make_problem(street(**options), way)
        s, values, data = problem.structure, problem.data.start, problem.data
        Q = cofactors(s, values, undamped_factor(s, values, data))
        h = eqx.filter_jit(hat_diagonal)(compiled_jacobian(s, values, data), Q)
        found.append((Q.image, Q.camera, Q.point, h.image))
    for dense, banded in zip(*found):
        size = np.sqrt(np.abs(np.diagonal(dense, axis1=-2, axis2=-1))) if dense.ndim > 2 else 1.0
        if dense.ndim > 2:
            size = size[:, :, None] * size[:, None, :]
            size = np.where(size > 0, size, 1.0)
        assert (np.abs(banded - dense) / size).max() < 1e-7


def test_a_network_solved_by_iteration_is_the_same_network():
    dense, iterative = (jaxbundle.adjust(street(), reduction=r) for r in ("dense", "iterative"))
    assert iterative.reduction == "iterative" and iterative.converged
    assert iterative.vtpv == pytest.approx(dense.vtpv, rel=1e-10)
    sigma = np.sqrt(np.diagonal(dense.point_covariance, axis1=1, axis2=2))
    assert (np.abs(iterative.point_values - dense.point_values) < 1e-3 * sigma).all()
    for name in ("image", "camera", "point"):
        a, b = (np.asarray(getattr(r.cofactors, name)) for r in (dense, iterative))
        np.testing.assert_allclose(b, a, rtol=1e-4, atol=1e-6 * np.abs(a).max())
    assert "conjugate gradients" in iterative.report()


def test_filled_arrays_change_nothing():
    problem = make_problem(street())
    sizes = common_sizes([sizes_of(problem.structure)])
    sizes = dataclasses.replace(
        sizes, chunks=sizes.chunks + 3, images=IMAGES + 2, points=sizes.points + 5, control=2,
        exterior=1, interior=1, incidences=sizes.incidences + 4,
    )  # fmt: skip
    structure, data = pad(problem.structure, problem.data, sizes)
    solver = make_solver(problem)
    expected = find_minimum(solver, problem.data)
    found = find_minimum(dataclasses.replace(solver, structure=structure), data)
    assert int(found.termination) == int(expected.termination) == 1
    np.testing.assert_allclose(
        found.history.cost[: int(found.iterations)],
        expected.history.cost[: int(expected.iterations)], rtol=1e-9,
    )  # fmt: skip
    values = without_filling(found.values, problem.data.start)
    np.testing.assert_allclose(values.camera, expected.values.camera, rtol=1e-10)
    np.testing.assert_allclose(values.point, expected.values.point, atol=1e-7)
