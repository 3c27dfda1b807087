"""A drive past many points: the banded reduced system against the dense one."""

import dataclasses

import equinox as eqx
import jax
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from jaxbundle.adjustment.datum import choose_pins, gauge_directions
from jaxbundle.adjustment.jacobian import jacobian
from jaxbundle.adjustment.normal import diagonal, gradient, normal_from_jacobian
from jaxbundle.adjustment.problem import make_problem
from jaxbundle.adjustment.residuals import residuals
from jaxbundle.adjustment.schur import factorise, solve
from jaxbundle.geometry import matrix_from_omega_phi_kappa
from jaxbundle.network import Camera, band
from jaxbundle.network.build import make_network

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


def both(monkeypatch, **options):
    """The problem of a street with a dense reduced system, and with a banded one."""
    dense = make_problem(street(**options))
    monkeypatch.setattr(band, "LEAST_UNKNOWNS", 1)
    banded = make_problem(street(**options))
    assert dense.structure.band is None and banded.structure.band is not None
    return dense, banded


def test_images_with_common_points_stand_close(monkeypatch):
    structure = both(monkeypatch)[1].structure
    place = np.asarray(structure.band.place)
    assert sorted(place) == list(range(IMAGES))
    pairs = structure.image_pairs
    apart = np.abs(place[np.asarray(pairs.row)] - place[np.asarray(pairs.column)])
    assert apart.max() == structure.band.width <= 2 * REACH
    assert structure.band.blocks == -(-IMAGES // structure.band.width)


def test_a_full_system_has_no_band():
    row, column = np.triu_indices(200, 1)
    assert band.find_band(row, column, 200, 9) is None


@pytest.mark.parametrize("damped", [True, False], ids=["damped", "undamped"])
@pytest.mark.parametrize("free", [True, False], ids=["free", "controlled"])
def test_the_step_is_that_of_the_dense_system(monkeypatch, free, damped):
    options = {} if free else {"datum": "control", "control": (0, 100, 200, 299)}
    steps = []
    for problem in both(monkeypatch, **options):
        s, data = problem.structure, problem.data

        @eqx.filter_jit
        def step(s, data):
            jac = jacobian(s, data.start, data)
            normal = normal_from_jacobian(jac)
            damping = jax.tree.map(lambda d: damped * 1e-3 * d, diagonal(s, normal))
            gauge = gauge_directions(s, data.start)
            factor = factorise(s, normal, damping, gauge, not damped)
            right = gradient(jac, residuals(s, data.start, data))
            change = solve(factor, right)
            # What the step does to the observations does not depend on the datum.
            return jac.mv(change).image, change

        steps.append(step(s, data))
    (rows, change), (banded_rows, banded_change) = steps
    np.testing.assert_allclose(banded_rows, rows, rtol=1e-7, atol=1e-8 * np.abs(rows).max())
    if not free:
        a, b = ravel_pytree(change)[0], ravel_pytree(banded_change)[0]
        np.testing.assert_allclose(b, a, rtol=1e-8, atol=1e-9 * np.abs(a).max())


def test_pins_hold_the_datum(monkeypatch):
    problem = both(monkeypatch)[1]
    pins = choose_pins(problem.structure, problem.data)
    G = np.asarray(gauge_directions(problem.structure, problem.data.start).image)
    assert pins.sum() == problem.structure.defect == 7
    held = G[pins > 0] / np.linalg.norm(G.reshape(-1, 7), axis=0)
    assert np.linalg.cond(held) < 1e4


def test_filled_arrays_change_nothing():
    from jaxbundle.adjustment.solve import find_minimum, make_solver
    from jaxbundle.network.padding import common_sizes, pad, sizes_of, unpad_values

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
    values = unpad_values(found.values, problem.data.start)
    np.testing.assert_allclose(values.camera, expected.values.camera, rtol=1e-10)
    np.testing.assert_allclose(values.point, expected.values.point, atol=1e-7)
