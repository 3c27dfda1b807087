"""Gross errors in batches: found, removed, or at least a status; axes that are not as expected."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbundle
from jaxbundle.batches.misfit import NORMAL, axes_remark, far_outside, misfits
from jaxbundle.batches.normal import CameraUnknowns, Sightings, design
from jaxbundle.batches.pope_tests import point_tests
from jaxbundle.batches.weakness import weak_geometry
from jaxbundle.cameras import get_model

SIZE, VIEWS, NOISE = (1280, 960), 8, 0.2
BOARD = np.c_[np.mgrid[0:8, 0:5].T.reshape(-1, 2) * 0.03, np.zeros(40)]
CAMERAS, BAD, CORNER = 7, 3, 13


def image(f, rng, X=BOARD):
    """Pixels of a board somewhere in front of a camera without distortion."""
    a, b, c = rng.normal(0, 0.35, 3) * [1, 1, 0.5]
    ca, sa, cb, sb, cc, sc = np.cos(a), np.sin(a), np.cos(b), np.sin(b), np.cos(c), np.sin(c)
    R = np.array([[cb, 0, sb], [sa * sb, ca, -sa * cb], [-ca * sb, sa, ca * cb]])
    R = np.array([[cc, -sc, 0], [sc, cc, 0], [0, 0, 1]]) @ R
    x, y, z = R @ (X - X.mean(0)).T + rng.uniform([-0.05, -0.04, 0.3], [0.05, 0.04, 0.5])[:, None]
    return np.stack([f * x / z + 640, f * y / z + 480], 1)


@pytest.fixture(scope="module")
def clean():
    rng = np.random.default_rng(5)
    xy = np.array([[image(1000, rng) for _ in range(VIEWS)] for _ in range(CAMERAS)])
    return xy + rng.normal(0, NOISE, xy.shape)


@pytest.fixture(scope="module")
def shifted(clean):
    """One corner of one camera is 40 px off in all views."""
    xy = clean.copy()
    xy[BAD, :, CORNER, 0] += 40
    return xy


@pytest.fixture(scope="module")
def plain(shifted):
    return jaxbundle.calibrate_batch(BOARD, shifted, SIZE)


@pytest.fixture(scope="module")
def snooped(shifted):
    return jaxbundle.calibrate_batch(BOARD, shifted, SIZE, snooping="pope")


def equal(a, b, cameras):
    for name in ("values", "sigma", "covariance", "rms", "position", "sigma_angles", "views"):
        np.testing.assert_array_equal(getattr(a, name)[cameras], getattr(b, name)[cameras], name)


def test_a_camera_with_gross_errors_is_a_misfit(clean, plain):
    good = np.arange(CAMERAS) != BAD
    assert plain.status[BAD] == "misfit" and (plain.status[good] == "converged").all()
    assert plain.rms[BAD] > 10 * plain.rms[good].max() and np.isfinite(plain.values[BAD]).all()
    assert plain.solved.all() and not plain.converged[BAD] and plain.removed is None
    equal(plain, jaxbundle.calibrate_batch(BOARD, clean, SIZE), good)
    alone = jaxbundle.calibrate_batch(BOARD, clean[:1], SIZE)
    assert list(alone.status) == ["converged"]


def test_a_camera_far_worse_than_the_others_is_a_misfit(clean):
    """Its own residuals are normal; four cameras are no population, and alone nothing shows it."""
    xy = clean.copy()
    xy[BAD] += np.random.default_rng(1).normal(0, 2, xy[BAD].shape)
    found = jaxbundle.calibrate_batch(BOARD, xy, SIZE)
    assert [i for i, s in enumerate(found.status) if s != "converged"] == [BAD]
    assert found.status[BAD] == "misfit"
    for noise, status in ((1, "converged"), (4, "misfit")):
        xy = clean[:4] + 0.0
        xy[BAD] += np.random.default_rng(1).normal(0, noise, xy[BAD].shape)
        few = jaxbundle.calibrate_batch(BOARD, xy, SIZE)
        assert list(few.status) == ["converged"] * 3 + [status]
        alone = jaxbundle.calibrate_batch(BOARD, xy[BAD:], SIZE)
        assert alone.status[0] not in ("misfit", "iteration limit") and not alone.remark[0]
        equal(few, jaxbundle.calibrate_batch(BOARD, clean[:4], SIZE), slice(BAD))


def test_a_weak_camera_is_judged_by_its_residuals_too(clean):
    """Three views with normal errors of some pixels determine nothing; the message gives the
    cause."""
    for noise, status in ((1.2, "weak"), (6, "misfit")):
        xy, visible = clean[:3].copy(), np.ones((3, VIEWS, 40), bool)
        xy[1] += np.random.default_rng(1).normal(0, noise, xy[1].shape)
        visible[1, 3:] = False
        found = jaxbundle.calibrate_batch(BOARD, xy, SIZE, visible=visible)
        assert list(found.status) == ["converged", status, "converged"]
        assert found.undetermined[1].any() and list(found.remark[::2]) == ["", ""]
        said = f"RMS {found.rms[1]:.2g} px against {found.rms[::2].min():.2g} px of the others"
        assert said in found.remark[1] and said in str(found)


def test_two_cameras_are_compared_with_each_other():
    """[cameras] RMS, pixels; the residuals of each normal by themselves."""
    for rms, expected in (
        ([0.3, 2.9], [0, 0]), ([0.3, 3.1], [0, 1]), ([3.1, 0.3, np.nan, 3.1], [1, 0, 0, 1]),
        ([5.0], [0]), ([np.nan, 5.0], [0, 0]), ([5.0, 5.0, 0.6], [0, 0, 0]),
        ([1e-9, 0.09], [0, 0]), ([0.3] * 4 + [1.0], [0] * 4 + [1]),
    ):  # fmt: skip
        rms = np.array(rms)
        found = misfits(rms, rms / NORMAL, np.isfinite(rms))
        assert found.tolist() == [bool(one) for one in expected], rms


def test_snooping_is_the_calibration_without_the_corner(clean, shifted, plain, snooped):
    assert (snooped.status == "converged").all()
    good = np.arange(CAMERAS) != BAD
    untouched = good & ~snooped.removed.any((1, 2))
    assert untouched.sum() >= CAMERAS - 2
    equal(snooped, plain, untouched)
    expected = np.zeros((VIEWS, 40), bool)
    expected[:, CORNER] = True
    np.testing.assert_array_equal(snooped.removed[BAD], expected)
    visible = ~snooped.removed
    without = jaxbundle.calibrate_batch(BOARD, shifted, SIZE, visible=visible)
    equal(snooped, without, untouched)
    # The middle of the object is that of the points seen: other roundings.
    np.testing.assert_allclose(
        (snooped.values - without.values) / without.sigma, 0, atol=1e-5
    )
    np.testing.assert_allclose(snooped.sigma, without.sigma, rtol=1e-6)
    assert snooped.redundancy[BAD] == plain.redundancy[BAD] - 2 * VIEWS


def test_what_fits_after_all_comes_back(clean):
    """A few large errors in one view distort their neighbours, which are not lost."""
    xy = clean.copy()
    xy[BAD, 2, [0, 1, 8]] += [60, -45]
    found = jaxbundle.calibrate_batch(BOARD, xy, SIZE, snooping="pope")
    assert found.removed[BAD, 2, [0, 1, 8]].all()
    assert found.removed[BAD].sum() <= 5 and found.status[BAD] == "converged"


def test_blunders_of_any_size_are_removed(clean):
    """One that spoils the iterations, two far outside the image, none, and nothing but blunders."""
    xy, expected = clean[:4].copy(), np.zeros((3, VIEWS, 40), bool)
    xy[0, 2, 7, 0], xy[1, 1, 3], xy[1, 4, 9, 1] = 1600, [-1e5, 1e5], 3000
    expected[0, 2, 7] = expected[1, 1, 3] = expected[1, 4, 9] = True
    xy[3] = np.random.default_rng(0).uniform(0, SIZE, xy[3].shape)
    plain = jaxbundle.calibrate_batch(BOARD, xy, SIZE)
    lost = "iteration limit"
    assert list(plain.status) == [lost, lost, "converged", lost]
    assert plain.remark[1].startswith("2 image points are far outside the image")
    assert [len(said) > 0 for said in plain.remark] == [False, True, False, False]
    found = jaxbundle.calibrate_batch(BOARD, xy, SIZE, snooping="pope")
    assert list(found.status) == ["converged"] * 3 + [lost] and not any(found.remark)
    np.testing.assert_array_equal(found.removed[:3], expected)
    assert not found.removed[3].any()
    good = jaxbundle.calibrate_batch(BOARD, clean[:4], SIZE)
    equal(found, good, 2)
    equal(plain, good, 2)
    without = jaxbundle.calibrate_batch(BOARD, xy[:3], SIZE, visible=~expected)
    np.testing.assert_allclose((found.values[:3] - without.values) / without.sigma, 0, atol=1e-4)


def test_a_view_of_something_else_goes_by_snooping(clean):
    xy = clean[:3].copy()
    xy[1, 1] = np.random.default_rng(3).uniform(0, SIZE, xy[1, 1].shape)
    assert jaxbundle.calibrate_batch(BOARD, xy, SIZE).status[1] == "iteration limit"
    found = jaxbundle.calibrate_batch(BOARD, xy, SIZE, snooping="pope")
    assert found.converged.all() and found.removed[1, 1].sum() >= 35
    assert found.removed[1].sum() - found.removed[1, 1].sum() <= 1


def test_nothing_is_screened_where_most_is_outside():
    """In this case the size or the axes are wrong."""
    size, visible = np.array(SIZE, float), np.ones((2, 1, 5), bool)
    xy = np.array([[[[100, 100], [-1e3, 5], [2600, 5], [5, 1e9], [5, 5]]]] * 2)
    xy[1, 0, 4] = 4000
    far = far_outside(xy, visible, size, True)
    assert far.tolist() == [[[False, False, True, True, False]], [[False] * 5]]


def test_good_cameras_lose_nothing_at_the_level_of_significance():
    """At 1 % of 60 cameras without blunders 0.6 lose a point on the average."""
    rng = np.random.default_rng(0)
    xy = np.array([[image(1000, rng) for _ in range(VIEWS)] for _ in range(60)])
    xy += rng.normal(0, NOISE, xy.shape)
    found = jaxbundle.calibrate_batch(BOARD, xy, SIZE, snooping="pope", significance=0.01)
    assert found.converged.all() and found.removed.any((1, 2)).sum() <= 4


def test_tests_are_those_of_a_dense_adjustment(clean, plain):
    """Leverages against the dense hat matrix, and predicted residuals of a point left out."""
    model, free = get_model("opencv"), tuple(range(4))
    rng = np.random.default_rng(2)
    seen = Sightings(
        jnp.asarray(BOARD - BOARD.mean(0)), jnp.asarray(clean[0]),
        jnp.asarray((rng.uniform(size=(VIEWS, 40)) > 0.1).astype(float)),
    )  # fmt: skip
    used = np.asarray(seen.weight).copy()
    used[1, 5] = used[4, 20] = 0
    rotation = np.stack([np.eye(4)[1] + rng.normal(0, 0.1, 4) for _ in range(VIEWS)])
    at = CameraUnknowns(
        jnp.asarray(plain.interior[0]),
        jnp.asarray(rotation / np.linalg.norm(rotation, axis=1, keepdims=True)),
        jnp.asarray(rng.normal([0, 0, -0.4], 0.02, (VIEWS, 3))),
    )
    rows = []
    both = jax.jit(lambda used: (
        design(model, free, seen, at), point_tests(model, free, seen, used, at)
    ))  # fmt: skip
    designs, found = both(jnp.asarray(used))
    for columns in designs:
        A = np.stack([np.asarray(c) for c in columns], -1)
        wide = np.zeros((VIEWS, 40, VIEWS * 6 + 4))
        for v in range(VIEWS):
            wide[v, :, 6 * v : 6 * v + 6] = A[v, :, :6]
        wide[..., -4:] = A[..., 6:10]
        rows.append((wide.reshape(VIEWS * 40, -1), A[..., -1].ravel()))
    part = used.ravel() > 0
    N = sum(A[part].T @ A[part] for A, _ in rows)
    inverse = np.linalg.inv(N)
    expected = np.zeros(VIEWS * 40)
    for A, v in rows:
        h = np.einsum("ni,ij,nj->n", A, inverse, A)
        expected = np.fmax(expected, np.abs(v) / np.sqrt(np.where(part, 1 - h, 1 + h)))
    expected = np.where(np.asarray(seen.weight).ravel() > 0, expected, np.nan)
    np.testing.assert_allclose(np.asarray(found).ravel(), expected, rtol=1e-6)


def test_a_table_and_html(plain, snooped):
    table = plain.to_pandas()
    assert table["status"].tolist() == plain.status.tolist() and len(table) == CAMERAS
    np.testing.assert_array_equal(table["fx"], plain.values[:, 0])
    np.testing.assert_array_equal(table["sigma_k1"], plain.sigma[:, 4])
    assert snooped.to_pandas()["removed"][BAD] == VIEWS and "removed" not in table
    html = plain._repr_html_()
    assert html.count("<tr>") == CAMERAS + 1 and "misfit" in html and "&" not in html
    assert html.index(f">{BAD}<") < html.index(">0<")  # what needs attention first
    many = dataclasses.replace(plain, remark=np.array([f"no. {i}" for i in range(3, 18)]))
    assert len(str(many).splitlines()) == 12 and "and 5 more remarks" in str(many)
    assert "camera 0: no. 3\ncamera 1: no. 4" in str(many)
    assert "8 image points removed" in str(snooped) or "removed by data snooping" in str(snooped)


@pytest.mark.parametrize("axis", [0, 1])
def test_a_negated_axis_is_remarked(clean, axis):
    xy = clean[:2].copy()
    xy[1, :, :, axis] *= -1
    # With the principal point held nothing but the misfit shows it.
    for free in (None, ("fx", "fy", "k1"))[: 2 - axis]:
        found = jaxbundle.calibrate_batch(BOARD, xy, SIZE, free=free)
        assert found.remark[0] == "" and f"{'xy'[axis]} axis" in found.remark[1], free
        assert f"camera 1: the {'xy'[axis]} axis" in str(found)
    assert "remark" in found._repr_html_()


def test_other_axes_are_remarked(clean):
    size = np.array(SIZE, float)
    points = clean[0].reshape(-1, 2)
    assert axes_remark(points, size, True) == ""
    assert "middle of the image" in axes_remark(points - size / 2, size, True)
    assert "image_size" in axes_remark(3 * points, size, True)
    assert axes_remark((points - size / 2) * [1, -1], size, False) == ""
    assert "corner" in axes_remark(points, size, False)


@pytest.mark.parametrize("bad", [dict(snooping="baarda"), dict(snooping=True),
                                 dict(snooping="pope", significance=1)])  # fmt: skip
def test_options_that_are_none(clean, bad):
    with pytest.raises(jaxbundle.InputError, match=list(bad)[-1]):
        jaxbundle.calibrate_batch(BOARD, clean, SIZE, **bad)


def test_image_points_that_are_no_pixels_are_remarked():
    """In mm of a sensor, counted from its corner: all in the upper left corner of the image."""
    xy = np.random.default_rng(0).uniform(0, [6.4, 4.8], (50, 2))
    said = axes_remark(xy, np.array([1280.0, 960.0]), True)
    assert "of 1280 × 960 pixels: are they in pixels" in said
    assert not axes_remark(200 * xy, np.array([1280.0, 960.0]), True)


def tilted_alike(distances, tilt):
    """Views of the board tilted about one axis by one angle, degrees, at distances; no noise."""
    c, s = np.cos(np.radians(tilt)), np.sin(np.radians(tilt))
    R = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    found = []
    for k, distance in enumerate(distances):
        shift = [0.01 * np.sin(k), 0.01 * np.cos(2 * k), distance]
        x, y, z = R @ (BOARD - BOARD.mean(0)).T + np.array(shift)[:, None]
        found.append(np.stack([1000 * x / z + 640, 1000 * y / z + 480], 1))
    return np.array(found)


def test_views_that_do_not_determine_a_camera_are_weak_and_say_why(clean):
    """All from the front, and all with one tilt: never an iteration limit with an RMS of NaN."""
    rng = np.random.default_rng(2)
    xy = clean[:3].copy()
    xy[1] = tilted_alike(np.linspace(0.5, 0.52, VIEWS), 0) + rng.normal(0, NOISE, xy[1].shape)
    xy[2] = tilted_alike(np.linspace(0.5, 0.8, VIEWS), 25) + rng.normal(0, NOISE, xy[2].shape)
    found = jaxbundle.calibrate_batch(BOARD, xy, SIZE)
    assert list(found.status) == ["converged", "weak", "weak"]
    assert np.isfinite(found.rms).all()
    seen = np.ones(xy.shape[1:3], bool)
    assert weak_geometry(BOARD, xy[0], seen) == ""
    assert "straight at the board" in weak_geometry(BOARD, xy[1], seen)
    assert "tilted alike" in weak_geometry(BOARD, xy[2], seen)
    for row in (1, 2):
        if not found.solved[row]:
            assert found.remark[row] == weak_geometry(BOARD, xy[row], seen)
        line = found.row(row)
        assert line["status"] == "weak" and line["rms"] > 0
    people = found.population()
    assert people.solved[0] and list(people.solved) == list(found.solved)
    assert "weak" in str(found)
