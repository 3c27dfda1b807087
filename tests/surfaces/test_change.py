"""Changes of surfaces: shared errors, false alarms at the stated level, volumes within their σ."""

import dataclasses
import json

import numpy as np
import pytest
import rasterio
from scipy.ndimage import gaussian_filter

import jaxbundle
from jaxbundle.errors import InputError
from jaxbundle.surfaces.change import find_change
from jaxbundle.surfaces.change_scatter import correlation_of
from jaxbundle.surfaces.change_settings import ChangeSettings
from jaxbundle.surfaces.height_cells import HeightGrid, UncertainCells, align, stated_modes
from jaxbundle.surfaces.orientation import orientation_covariance, orientation_modes
from jaxbundle.surfaces.views import FrameView

ROWS, COLUMNS, SIZE = 70, 90, 2.0
SMOOTH = 1.2
"""σ of the Gaussian that makes errors of neighbours alike, cells."""


def hills():
    i, j = np.indices((ROWS, COLUMNS))
    return 20 + 4 * np.sin(i / 9) * np.cos(j / 12)


def grid(height, sigma=0.3, **shared):
    found = HeightGrid(height, np.full(height.shape, sigma), 1000.0, 5000.0, SIZE)
    return dataclasses.replace(found, shared=stated_modes(found, **shared))


def noise(rng, sigma=0.3):
    """Errors with σ, alike in neighbouring cells."""
    field = gaussian_filter(rng.normal(size=(ROWS + 20, COLUMNS + 20)), SMOOTH)[10:-10, 10:-10]
    # the variance of a sum with Gaussian weights: 1/(4π·s²)
    return sigma * field * np.sqrt(4 * np.pi) * SMOOTH


def measured(rng, truth, **shared):
    exact = grid(truth, **shared)
    t = rng.normal(size=len(exact.modes))
    heights = truth + noise(rng) + np.tensordot(t, exact.modes, 1)
    return dataclasses.replace(exact, height=heights)


SHARED = {"vertical": 0.2, "horizontal": 0.4, "tilt": 2e-3}


def test_a_horizontal_shift_of_a_slope_is_a_height():
    i, j = np.indices((ROWS, COLUMNS))
    plane = grid(0.3 * j * SIZE + 0.2 * i * SIZE, horizontal=1.0)
    # z(x − δ) − z(x): x to the east along columns, y to the north against rows
    np.testing.assert_allclose(plane.modes[0], -0.3, atol=1e-9)
    np.testing.assert_allclose(plane.modes[1], 0.2, atol=1e-9)
    tilt = grid(hills(), tilt=1.0).modes
    np.testing.assert_allclose(np.ptp(tilt[0]), (COLUMNS - 1) * SIZE)
    np.testing.assert_allclose(np.diff(tilt[1], axis=0), -SIZE)


def test_the_correlation_of_neighbours_is_found():
    """Of a Gaussian filter: ρ(d) = exp(−d²/4s²), in all Σρ = 4π·s² cells."""
    rng = np.random.default_rng(0)
    fields = [noise(rng, 1.0) for _ in range(20)]
    known = np.ones((ROWS, COLUMNS), bool)
    rho = np.mean([correlation_of(f, known) for f in fields], axis=0)
    reach = len(rho) // 2
    k = np.arange(-2, 3)
    expected = np.exp(-(k**2) / (4 * SMOOTH**2))
    np.testing.assert_allclose(rho[reach, reach - 2 : reach + 3], expected, atol=0.03)
    assert rho.sum() == pytest.approx(4 * np.pi * SMOOTH**2, rel=0.1)
    # of white noise 1, with the noise of as many estimates as there are distances, each of √(1/n)
    n = ROWS * COLUMNS
    white = [correlation_of(rng.normal(size=(ROWS, COLUMNS)), known).sum() for _ in range(50)]
    noise_of_sum = np.sqrt(2 * np.pi * reach**2 / n)
    assert np.mean(white) == pytest.approx(1, abs=3 * noise_of_sum / np.sqrt(50))
    assert np.std(white) == pytest.approx(noise_of_sum, rel=0.3)


def test_the_correlation_of_stripes_is_found_with_its_sign():
    """Stripes of random phase along the rows: ρ(dr, dc) = share·cos(2π·dc/period), whatever dr."""
    rng, known, share, period = np.random.default_rng(8), np.ones((ROWS, COLUMNS), bool), 0.4, 9.0
    j = np.arange(COLUMNS)
    fields = [
        np.sqrt(2 * share) * np.cos(2 * np.pi * (j / period + rng.uniform()))
        + np.sqrt(1 - share) * rng.normal(size=(ROWS, COLUMNS)) for _ in range(20)
    ]  # fmt: skip
    rho = np.mean([correlation_of(f, known) for f in fields], axis=0)
    reach = len(rho) // 2
    k = np.arange(1, reach + 1)
    expected = share * np.cos(2 * np.pi * k / period)
    np.testing.assert_allclose(rho[reach, reach + 1 :], expected, atol=0.02)
    np.testing.assert_allclose(rho[reach + 1 :, reach], share, atol=0.02)


def estimate(L, d, sigma, together):
    """t̂ and P from some cells, of which `together` count as one."""
    weight = 1 / (together * sigma**2)
    P = np.linalg.inv(np.eye(L.shape[1]) + (L * weight[:, None]).T @ L)
    return P @ L.T @ (weight * d), P


def test_variances_are_those_of_dense_algebra():
    """Of every cell, and of the volume of a region, with stable ground and without."""
    rng = np.random.default_rng(3)
    shape = 12, 14
    one, two = (
        HeightGrid(rng.normal(size=shape), rng.uniform(0.2, 0.4, shape), 0.0, 0.0, SIZE,
                   shared=rng.normal(size=(3, *shape))) for _ in range(2)
    )  # fmt: skip
    stable = np.zeros(shape, bool)
    stable[:4] = True
    labels = np.zeros(shape, int)
    labels[6:10, 2:9] = 5
    for same in (False, True):
        for known in (None, stable):
            found = find_change(one, two, stable=known, labels=labels, same_errors=same)
            L = (two.modes - one.modes if same else np.concatenate([one.modes, two.modes]))
            L = L.reshape(len(L), -1).T
            s = np.hypot(one.sigma, two.sigma).ravel()
            d = (two.height - one.height).ravel()
            own = d - L @ np.linalg.solve(
                np.eye(L.shape[1]) + (L / s[:, None] ** 2).T @ L, L.T @ (d / s**2)
            )
            quiet = np.abs(own / s) < 3 * 1.4826 * np.median(np.abs(own / s - np.median(own / s)))
            rho = correlation_of((own / s * quiet).reshape(shape), quiet.reshape(shape))
            assert found.correlation == pytest.approx(max(rho.sum(), 1.0), rel=0.05)
            assert found.sigma_ratio > 1
            given, P = s, np.eye(L.shape[1])
            s, q = given * found.sigma_ratio, given * found.tail_ratio
            if known is None:
                assert found.tail_ratio == found.sigma_ratio
            else:
                # with the scatter by the median first, of cells that are not beyond three of it
                z, some, m = own / given, stable.ravel(), found.correlation
                median = 1.4826 * np.median(np.abs(z[quiet] - np.median(z[quiet])))
                t, P = estimate(L[some], d[some], median * given[some], m)
                v = np.abs(d - L @ t)[some] / given[some]
                taken = np.einsum("ni,ij,nj->n", L[some], P, L[some]) / (median * given[some]) ** 2
                left = np.sqrt(1 - taken.mean())
                assert found.sigma_ratio == pytest.approx(
                    np.sqrt(np.mean(v**2)) / left, rel=0.05
                )
                assert found.tail_ratio == pytest.approx(
                    np.quantile(v, 0.95) / 1.959964 / left, rel=0.05
                )
                t, P = estimate(L[some], d[some], s[some], m)
                np.testing.assert_allclose(found.difference.ravel(), d - L @ t, atol=1e-9)
            C = L @ P @ L.T
            np.testing.assert_allclose(found.sigma.ravel() ** 2, q**2 + np.diag(C), rtol=1e-9)
            r, c = (v.ravel() for v in np.indices(shape))
            m = len(rho) // 2
            i, j = r[:, None] - r + m, c[:, None] - c + m
            near = (i >= 0) & (j >= 0) & (i < 2 * m + 1) & (j < 2 * m + 1)
            R = np.where(near, rho[np.clip(i, 0, 2 * m), np.clip(j, 0, 2 * m)], 0)
            inside = (labels == 5).ravel()
            total = R * np.outer(s, s) + C
            region = found.regions[0]
            # never as if errors of cells were compensated by those of their neighbours
            variance = inside @ C @ inside + max(
                inside @ (total - C) @ inside, np.sum(s[inside] ** 2)
            )
            assert region.sigma == pytest.approx(SIZE**2 * np.sqrt(variance), rel=0.02)
            assert (region.label, region.cells) == (5, 28)


@dataclasses.dataclass(frozen=True)
class Slanted:
    """Errors with a column of L that depends on slopes, so that windows need cells around."""

    number: int = 1

    def __call__(self, grid):
        return 0.3 * grid.slopes()[:1]


@pytest.mark.parametrize("with_stable", [False, True])
def test_tiles_give_what_the_whole_gives(with_stable):
    """Of regions across their edges, of slopes at these; ρ loses the pairs across them."""
    rng, truth = np.random.default_rng(4), hills()
    labels = np.zeros((ROWS, COLUMNS), int)
    labels[20:55, 25:70] = 3
    labels[60:, :8] = 7
    pair = [measured(rng, truth + 2.0 * k * (labels == 3), **SHARED) for k in (0, 1)]
    pair[1].height[10:14, 5:30] = np.nan
    pair = [UncertainCells(one, (Slanted(),)) for one in pair]
    stable = (labels == 0) & (np.arange(COLUMNS) > 60) if with_stable else None
    # as many cells of a tile as 32 numbers each leave, at least eight times the reach a side
    small = ChangeSettings(reach=4, tile_numbers=1, sampled_tiles=99)
    whole = ChangeSettings(reach=4)
    for given in (labels, None):
        one, other = (find_change(*pair, 0.05, stable, given, settings=s) for s in (whole, small))
        assert one.difference.dtype == np.float64 and other.difference.dtype == np.float32
        assert one.modes == other.modes == 12
        assert other.correlation == pytest.approx(one.correlation, rel=0.05)
        np.testing.assert_allclose(other.difference, one.difference, atol=0.01)
        np.testing.assert_allclose(other.sigma, one.sigma, rtol=0.02)
        assert (other.sign == one.sign).mean() > 0.99
        assert other.total.cells == one.total.cells == ROWS * COLUMNS - 100
        for a, b in zip((one.total, *one.regions[:1]), (other.total, *other.regions[:1])):
            assert (a.label, a.cells) == (b.label, pytest.approx(b.cells, rel=0.02))
            assert b.volume == pytest.approx(a.volume, rel=0.02, abs=20)
            assert b.sigma == pytest.approx(a.sigma, rel=0.03)


def test_sigma_that_are_too_small_are_enlarged_by_the_scatter():
    rng, truth = np.random.default_rng(6), hills()
    pair = [dataclasses.replace(grid(truth + noise(rng)), sigma=np.full((ROWS, COLUMNS), 0.1))
            for _ in range(2)]  # fmt: skip
    found = find_change(*pair)
    assert found.sigma_ratio == pytest.approx(3.0, rel=0.1)
    np.testing.assert_allclose(found.sigma, 0.1 * np.sqrt(2) * found.sigma_ratio)
    assert np.mean(found.sign != 0) == pytest.approx(0.05, abs=0.02)
    as_given = find_change(*pair, settings=ChangeSettings(enlarge_sigma=False))
    assert np.mean(as_given.sign != 0) > 0.4
    wide = [dataclasses.replace(one, sigma=np.full((ROWS, COLUMNS), 0.9)) for one in pair]
    np.testing.assert_allclose(find_change(*wide).sigma, 0.9 * np.sqrt(2))


@pytest.mark.further
@pytest.mark.parametrize("with_stable", [False, True])
def test_false_alarms_are_as_stated_and_volumes_within_their_sigma(with_stable):
    """200 pairs without change, but for a region that rises by 2 m."""
    rng, truth = np.random.default_rng(5), hills()
    labels = np.zeros((ROWS, COLUMNS), int)
    labels[30:50, 40:70] = 1
    after, volume = truth + 2.0 * (labels > 0), 2.0 * 600 * SIZE**2
    stable = np.zeros((ROWS, COLUMNS), bool)
    stable[:20] = True
    alarms, within, detected = [], [], []
    for _ in range(200):
        one, two = measured(rng, truth, **SHARED), measured(rng, after, **SHARED)
        found = find_change(one, two, 0.05, stable if with_stable else None, labels)
        alarms.append(np.mean(found.sign[(labels == 0) & ~stable] != 0))
        region = found.regions[0]
        within.append(abs(region.volume - volume) < 2 * region.sigma)
        detected.append(np.mean(found.sign[labels == 1] > 0))
    # shared errors make the share of one pair vary: the mean over all is what is stated
    assert np.mean(alarms) == pytest.approx(0.05, abs=3 * np.std(alarms) / np.sqrt(200) + 0.005)
    # 95.4 % within 2 σ; of 200 draws 3 σ are 4.4 %
    assert 0.91 <= np.mean(within) <= 0.995
    assert np.mean(detected) > (0.95 if with_stable else 0.8)


def test_modes_of_orientations_are_their_covariance():
    """M·Mᵀ along the vertical and a slope, and between two points that share images."""
    camera = jaxbundle.Camera(
        "cam", "opencv", {"fx": 256.0, "fy": 256.0, "cx": 127.5, "cy": 95.5}, image_size=(256, 192)
    )
    sigma = np.array([0.02, 0.03, 0.05, 1e-4, 2e-4, 1e-4])
    views = [
        FrameView(f"{k}", np.zeros((192, 256), np.uint8), camera, np.array([x, 0.0, 12.0]),
                  np.eye(3), sigma) for k, x in enumerate((-2.0, 2.0, 3.0))
    ]  # fmt: skip
    X = np.random.default_rng(1).uniform((-1, -1, 0), (1, 1, 1), (9, 3))
    used = np.ones((9, 3), bool)
    used[:3, 2] = False
    C = orientation_covariance(views, X, used)
    for n in (np.array([0, 0, 1.0]), np.array([0.3, -0.2, 1.0])):
        M = orientation_modes(views, X, used, np.tile(n, (9, 1)))
        np.testing.assert_allclose((M**2).sum(1), np.einsum("i,nij,j->n", n, C, n), rtol=1e-9)
    # the errors of three images; no column of the parameters of the camera, which are held
    assert M.shape == (9, 18)
    # the covariance between two points, by differences of the projections: S of both
    J = [np.stack([view.derivative(X[k : k + 1])[0] for view in views]) for k in (4, 7)]
    S = []
    for k, j in zip((4, 7), J):
        moved = []
        for view in views:
            for step in np.eye(3):
                # a shift of the projection centre is one of the point the other way
                moved.append(-view.derivative(X[k : k + 1])[0] @ step)
        B = np.zeros((3, 2, 9))
        for m, v in enumerate(moved):
            B[m // 3, :, m] = v
        N = np.einsum("vri,vrj->ij", j, j)
        S.append(-np.linalg.solve(N, np.einsum("vri,vrk->ik", j, B)))
    only = [FrameView(v.name, v.grey, camera, v.X0, v.M, np.r_[sigma[:3], 0, 0, 0]) for v in views]
    M = orientation_modes(only, X, used, np.tile([0, 0, 1.0], (9, 1)))
    expected = S[0][2] @ np.diag(np.tile(sigma[:3] ** 2, 3)) @ S[1][2]
    assert M[4] @ M[7] == pytest.approx(expected, rel=1e-8)


def write(path, values, dtype="float32", nodata=-9999.0, x=1000.0, crs="EPSG:32633"):
    with rasterio.open(path, "w", driver="GTiff", width=values.shape[1], height=values.shape[0],
                       count=1, dtype=dtype, nodata=nodata, crs=crs,
                       transform=rasterio.Affine(SIZE, 0, x, 0, -SIZE, 5e3)) as target:  # fmt: skip
        target.write(values.astype(dtype)[None])
    return path


@pytest.fixture
def files(tmp_path):
    rng, truth = np.random.default_rng(7), hills()
    risen = np.zeros((ROWS, COLUMNS))
    risen[20:40, 30:60] = 3.0
    for name, height in (("before", truth), ("after", truth + risen)):
        height = height + noise(rng)
        height[5, 6] = -9999
        write(tmp_path / f"{name}.tif", height)
        write(tmp_path / f"{name}_sigma.tif", np.full((ROWS, COLUMNS), 0.3))
    write(tmp_path / "stable.tif", risen == 0, "uint8", None)
    write(tmp_path / "regions.tif", 4 * (risen > 0), "uint8", None)
    return tmp_path


def test_the_command_writes_maps_and_volumes(files, command):
    out = files / "change"
    command("change", files / "before.tif", files / "after.tif", "--out", out, "--stable",
            files / "stable.tif", "--regions", files / "regions.tif", "--before-error",
            "vertical=0.5", "--after-error", "vertical=0.5")  # fmt: skip
    found = json.loads((out / "change.json").read_text())
    assert found["shared_errors"] == 2 and found["cells"] == ROWS * COLUMNS - 1
    (region,) = found["regions"]
    assert region["label"] == 4 and region["cells"] == 600
    assert abs(region["volume"] - 600 * 4 * 3.0) < 3 * region["sigma"]
    with rasterio.open(out / "difference.tif") as source:
        d, sigma, w = source.read(masked=True)
        assert source.crs.to_epsg() == 32633 and source.transform.c == 1000.0
    np.testing.assert_allclose(w, d / sigma, rtol=1e-5)
    assert bool(d.mask[5, 6]) and d.mask.sum() == 1
    with rasterio.open(out / "significant.tif") as source:
        sign = source.read(1)
    assert sign[5, 6] == 0 and (sign[20:40, 30:60] == 3).mean() > 0.99
    # without labels: the region is found, larger ones first
    result = jaxbundle.change(files / "before.tif", files / "after.tif")
    first = result.change.regions[0]
    assert 550 < first.cells < 800 and first.mean == pytest.approx(3, abs=0.3)
    assert len(result.to_pandas()) == 1 + len(result.change.regions)
    assert "region 1" in str(result)


def test_masks_mark_cells_and_cut_none(files):
    """A raster of stable cells, or of regions, that has a part of the surface only, and one that
    reaches beyond it: as one of all cells that is 0 elsewhere."""
    marked = np.zeros((ROWS, COLUMNS))
    marked[2:12, 5:70] = 1
    errors = {"before_errors": {"vertical": 0.5}, "after_errors": {"vertical": 0.5}}
    given = files / "before.tif", files / "after.tif"
    wide = np.pad(marked, ((0, 3), (4, 6)))
    for name, values, x in (("whole", marked, 1000.0), ("part", marked[:12, 5:70], 1010.0),
                            ("wide", wide, 1000.0 - 4 * SIZE)):  # fmt: skip
        write(files / f"{name}.tif", values, "uint8", None, x=x)
    whole = files / "whole.tif"
    one = jaxbundle.change(*given, stable=whole, regions=whole, **errors)
    assert one.change.known.sum() == ROWS * COLUMNS - 1
    for name in ("part", "wide"):
        mask = files / f"{name}.tif"
        other = jaxbundle.change(*given, stable=mask, regions=mask, **errors)
        np.testing.assert_array_equal(other.change.difference, one.change.difference)
        np.testing.assert_array_equal(other.change.sigma, one.change.sigma)
        assert other.change.regions == one.change.regions
    write(files / "away.tif", marked, "uint8", None, x=9000.0)
    with pytest.raises(InputError, match="away.tif: has no cell of the surfaces"):
        jaxbundle.change(*given, stable=files / "away.tif")
    write(files / "zone.tif", marked, "uint8", None, crs="EPSG:32632")
    with pytest.raises(InputError, match="zone.tif: two rasters are in different coordinate"):
        jaxbundle.change(*given, stable=files / "zone.tif")


def test_sigma_without_orientations_are_used_with_their_covariance(files):
    """The second band of the file of σ, where it is described so."""
    from jaxbundle.surfaces.raster_cells import OWN_SIGMA, open_cells

    cells, path = open_cells(files / "before.tif"), files / "before_sigma.tif"
    with rasterio.open(path) as source:
        profile, values = source.profile, source.read(1)
    with rasterio.open(path, "w", **{**profile, "count": 2}) as target:
        target.write(np.stack([values, 0.5 * values]))
        target.descriptions = ("sigma of height", OWN_SIGMA)
    part = slice(10, 12), slice(20, 25)
    for own, expected in ((False, 0.3), (True, 0.15)):
        grid_ = cells.with_sigma(path, own).part(slice(5, 60), slice(0, 50)).window(*part)
        np.testing.assert_allclose(grid_.sigma, expected, rtol=1e-6)
        np.testing.assert_allclose(grid_.height, cells.values(slice(15, 17), slice(20, 25)))
    write(files / "small.tif", np.full((9, 9), 0.3))
    with pytest.raises(InputError, match="small.tif: does not have the cells of"):
        cells.with_sigma(files / "small.tif", False)


def test_grids_are_cut_to_their_common_cells():
    one = grid(hills())
    other = dataclasses.replace(one, x=one.x + 10 * SIZE, y=one.y - 4 * SIZE)
    a, b = align(one, other)
    assert a.height.shape == b.height.shape == (ROWS - 4, COLUMNS - 10)
    np.testing.assert_array_equal(a.height, one.height[4:, 10:])
    np.testing.assert_array_equal(b.height, one.height[:-4, :-10])
    assert (a.x, a.y) == (b.x, b.y) == (other.x, other.y)
    for odd in ({"x": one.x + 0.7}, {"size": 1.9}, {"x": one.x + 1e5}):
        with pytest.raises(InputError, match="not those of|do not overlap"):
            align(one, dataclasses.replace(one, **odd))


@pytest.mark.parametrize("options, words", [
    ({"level": 1.5}, "--level"), ({"before_errors": {"vertikal": 1}}, "did you mean 'vertical'"),
    ({"after_errors": {"cell": -1.0}}, "from 0 on"), ({"same_adjustment": True}, "--same-adj"),
    ({"before_orientation": "none.toml"}, "none.toml"),
])  # fmt: skip
def test_bad_input_is_named(files, options, words):
    with pytest.raises(InputError, match=words) as found:
        jaxbundle.change(files / "before.tif", files / "after.tif", **options)
    assert "\n" not in str(found.value)


def test_surfaces_that_cannot_be_compared(files):
    (files / "after_sigma.tif").unlink()
    with pytest.raises(InputError, match="no σ of its cells; give --after-sigma"):
        jaxbundle.change(files / "before.tif", files / "after.tif")
    write(files / "zone.tif", hills(), crs="EPSG:32634")
    given = {"after_errors": {"cell": 0.3}}
    write(files / "sea.tif", hills(), crs="EPSG:32633+5773")
    with pytest.raises(InputError, match="before none, after EGM96 height; none is the ellipsoid"):
        jaxbundle.change(files / "before.tif", files / "sea.tif", **given)
    with pytest.raises(InputError, match="different coordinate systems.*32N|33N"):
        jaxbundle.change(files / "before.tif", files / "zone.tif", **given)
    write(files / "degrees.tif", hills(), crs="EPSG:4326", x=10.0)
    with pytest.raises(InputError, match="cells in degrees"):
        jaxbundle.change(files / "before.tif", files / "degrees.tif", **given)
