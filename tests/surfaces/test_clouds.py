"""Clouds: filters against counting by hand, files that read back equal, a DSM of a known plane."""

import dataclasses
import functools

import ezdxf
import laspy
import matplotlib.pyplot as plt
import numpy as np
import pytest
import rasterio
from numpy.testing import assert_allclose
from surface_scenes import hills, photographs, two_shapes

from jaxbundle import plotting
from jaxbundle.errors import InputError
from jaxbundle.planning.texture import Texture
from jaxbundle.surfaces.accuracy import accuracy_of, at_check_points, to_plane
from jaxbundle.surfaces.cell_slopes import WINDOW, CellMeans, _neighbours, cell_slopes
from jaxbundle.surfaces.cloud import Cloud, empty_cloud, merge
from jaxbundle.surfaces.cloud_filters import drop_isolated, drop_weak, thin
from jaxbundle.surfaces.compare import compare
from jaxbundle.surfaces.dsm import (
    NO_DATA,
    Dsm,
    DsmSettings,
    _independent_values,
    make_dsm,
    write_dsm,
)
from jaxbundle.surfaces.files import text_of
from jaxbundle.surfaces.orthophoto import orthophoto, write_orthophoto
from jaxbundle.surfaces.point_files import COLOURS, _read_las, read_cloud, write_cloud


def on_plane(x, y):
    return 0.2 * (x - 500_000) - 0.1 * (y - 5_000_000) + 30


def cloud_on_plane(n=4000, noise=0.05, seed=0, system=None):
    """Points of Z = 0.2·X − 0.1·Y + 30 with noise of twice the σ at every second point."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0, 40, (n, 2)) + [500_000, 5_000_000]
    sigma = np.column_stack([np.full((n, 2), noise / 5), noise * (1 + np.arange(n) % 2)])
    Z = on_plane(*xy.T)
    X = np.column_stack([xy, Z + sigma[:, 2] * rng.standard_normal(n)])
    C = np.eye(3) * sigma[:, :, None] ** 2
    colour = rng.integers(0, 256, (n, 3)).astype(np.uint8)
    return Cloud(X, C, 2 + np.arange(n) % 3, np.arange(n) % 2, rng.uniform(0, 99, (n, 2)),
                 ("a.jpg", "b.jpg"), colour, system)  # fmt: skip


@pytest.fixture(scope="module")
def plane():
    return cloud_on_plane(system="EPSG:32633")


def test_a_cube_gives_its_corner_or_mean_where_it_has_enough_points():
    X = np.array([[0.1, 0.1, 0.1], [0.2, 0.6, 0.3], [1.5, 0, 0], [-0.1, 0.5, 0.5]])
    C = np.broadcast_to(np.eye(3), (4, 3, 3)) * np.array([1.0, 4, 1, 1])[:, None, None]
    cloud = Cloud(X, C, np.full(4, 2), np.zeros(4, int), np.zeros((4, 2)), ("a",))
    corners = thin(cloud, 1.0, place="corner")
    assert corners.X.tolist() == [[-1, 0, 0], [0, 0, 0], [1, 0, 0]]
    mean = thin(cloud, 1.0, least=2)
    np.testing.assert_allclose(mean.X, [(4 * X[0] + X[1]) / 5])
    np.testing.assert_allclose(mean.covariance[0], np.eye(3) * 2 / (1 + 1 / 4))
    np.testing.assert_allclose(thin(cloud, 1.0, least=2, place="best").X, X[:1])


def test_a_point_of_no_sigma_has_the_weight_of_the_worst():
    """σ 0 says that nothing is known of it; 1/0 would make it the only one, or the mean NaN."""
    X = np.array([[0.1, 0.2, 0.3], [0.3, 0.4, 0.7], [0.9, 0.9, 0.9]])
    C = np.stack([0 * np.eye(3), 4 * np.eye(3), np.eye(3)])
    cloud = Cloud(X, C, np.full(3, 2), np.zeros(3, int), np.zeros((3, 2)), ("a",))
    np.testing.assert_allclose(thin(cloud, 1.0).X, [(X[0] + X[1] + 4 * X[2]) / 6])


def test_errors_of_orientations_are_not_averaged_in_a_cell():
    """Nine independent points of σ 0.3 and one error of 0.4 common to them: 0.1² + 0.4²."""
    v, u = np.indices((3, 3)).reshape(2, -1)
    # evenly about the centre of the cell: its slope, which is not known, has no effect
    X = np.stack([(u + 0.5) / 3, (v + 0.5) / 3, np.full(9, 5.0)], 1)
    C = np.broadcast_to(np.diag([0.1, 0.1, 0.25]), (9, 3, 3))
    uv = 100.0 * np.arange(18).reshape(9, 2)
    cloud = Cloud(X, C, np.full(9, 2), np.zeros(9, int), uv, ("a",), shared=np.full(9, 0.16))
    dsm = make_dsm(cloud, 1.0)
    np.testing.assert_allclose(dsm.own_sigma, 0.1)
    np.testing.assert_allclose(dsm.sigma, np.hypot(0.1, 0.4))
    # points whose windows overlap count as one: m = 1/(1 − 2/15)² of the nine
    near = dataclasses.replace(cloud, uv=np.stack([u, v], 1).astype(float), shared=None)
    np.testing.assert_allclose(make_dsm(near, 1.0).sigma, 0.5 * 13 / 15)
    # those of a second base image, matched in the same images, have the same errors again
    both = merge([near, dataclasses.replace(near, images=("b",))])
    np.testing.assert_allclose(make_dsm(both, 1.0).sigma, 0.5 * 13 / 15)
    assert make_dsm(near, 1.0).own_sigma is None
    half = cloud.take(np.arange(9) < 4)
    assert len(half.shared) == 4 and merge([half, half]).shared.shape == (8,)
    assert merge([half, near]).shared is None


def test_images_without_points_can_be_merged(plane):
    none = empty_cloud("c.jpg")
    assert merge([none, plane, none]).images == plane.images
    alone = merge([none, none])
    assert alone.X.shape == (0, 3) and alone.covariance.shape == (0, 3, 3)
    assert {len(column) for column in alone.table().values()} == {0}
    with pytest.raises(InputError, match="no clouds to merge"):
        merge([])


def test_lonely_and_weak_points_go(plane):
    far = plane.take([0])
    lost = Cloud(far.X + [0, 0, 50], *(getattr(far, n) for n in
                 ("covariance", "rays", "image", "uv", "images", "colour")))  # fmt: skip
    both = merge([plane, lost])
    kept = drop_isolated(both, limit=6.0)
    assert len(kept) > 0.97 * len(plane) and kept.X[:, 2].max() < 45
    assert len(drop_weak(plane, 0.06)) == len(plane) // 2
    assert set(drop_weak(plane, least_rays=3).rays) == {3, 4}
    # A point has no eight neighbours among eight: nothing is said of its distance from the others.
    assert len(drop_isolated(plane.take(np.arange(8)))) == 8
    without = dataclasses.replace(plane, covariance=np.full_like(plane.covariance, np.nan))
    with pytest.raises(InputError, match="the cloud has no σ: expected columns sX, sY, sZ"):
        drop_weak(without, 0.06)
    assert len(drop_weak(without, least_rays=3)) == (plane.rays > 2).sum()


@pytest.mark.parametrize("kind", ["csv", "ply", "las", "laz"])
def test_files_read_back_equal(plane, tmp_path, kind):
    path = tmp_path / f"cloud.{kind}"
    write_cloud(plane, path)
    back = read_cloud(path)
    rounded = 1e-4 if kind in ("las", "laz") else 0
    np.testing.assert_allclose(back.X, plane.X, rtol=0, atol=rounded)
    np.testing.assert_allclose(back.sigma, plane.sigma, rtol=1e-6)
    assert (back.rays == plane.rays).all()
    if kind in ("csv", "ply"):
        assert [back.images[k] for k in back.image] == [plane.images[k] for k in plane.image]
        exact = plane.uv if kind == "csv" else plane.uv.astype(np.float32)
        np.testing.assert_array_equal(back.uv, exact)
    if kind != "csv":
        np.testing.assert_array_equal(back.colour, plane.colour)
    if kind in ("las", "laz"):
        assert back.system == "EPSG:32633"


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize("kind, numbers, colour", [
    ("uchar", [0, 32, 255], [0, 32, 255]), ("ushort", [0, 256, 65535], [0, 0, 255]),
    ("ushort", [0, 32, 255], [0, 32, 255]), ("float", [0.0, 0.2, 1.0], [0, 51, 255]),
    ("float", [0.0, 51.0, 255.0], [0, 51, 255]),
])  # fmt: skip
def test_colours_of_any_type_in_ply(tmp_path, form, kind, numbers, colour):
    path = tmp_path / "cloud.ply"
    names = [*(f"float {axis}" for axis in "xyz"), *(f"{kind} {c}" for c in COLOURS)]
    head = ["ply", f"format {form} 1.0", "element vertex 1", *(f"property {n}" for n in names)]
    types = [("", "<f4", 3), ("c", {"uchar": "u1", "ushort": "<u2", "float": "<f4"}[kind], 3)]
    row = np.array([((1, 2, 3), tuple(numbers))], types)
    body = row.tobytes() if form != "ascii" else f"1 2 3 {' '.join(map(str, numbers))}\n".encode()
    path.write_bytes("\n".join([*head, "end_header\n"]).encode() + body)
    assert read_cloud(path).colour.tolist() == [colour]


def test_colours_of_eight_bits_in_las(plane, tmp_path):
    """Against the standard, which has 16 bits, but frequent."""
    path = tmp_path / "cloud.las"
    write_cloud(plane, path)
    las = laspy.read(path)
    for k, name in enumerate(COLOURS):
        las[name] = plane.colour[:, k]
    las.write(path)
    np.testing.assert_array_equal(read_cloud(path).colour, plane.colour)


def test_any_name_of_an_image_comes_back_from_ply(plane, tmp_path):
    names = ("Bild ß\n1.jpg", 'end_header "2"')
    path = tmp_path / "cloud.ply"
    write_cloud(dataclasses.replace(plane, images=names, image=np.arange(len(plane)) % 2), path)
    back = read_cloud(path)
    assert back.images == names and (back.image == np.arange(len(plane)) % 2).all()


@pytest.mark.parametrize("wrong", [-1, 2])
def test_a_cloud_that_numbers_an_image_it_does_not_name_is_one_without_images(
    plane, tmp_path, wrong
):
    """Its points are read all the same; −1 would be the last image, and 2 of two an error later."""
    path, few = tmp_path / "cloud.ply", plane.take(np.arange(3))
    write_cloud(dataclasses.replace(few, image=np.array([0, 1, wrong])), path)
    back = read_cloud(path)
    assert back.images == ("",) and not back.image.any() and np.isnan(back.uv).all()
    np.testing.assert_array_equal(back.X, few.X)


def test_a_drawing_passes_the_audit(plane, tmp_path):
    few = plane.take(np.arange(50))
    write_cloud(few, tmp_path / "cloud.dxf")
    drawing = ezdxf.readfile(tmp_path / "cloud.dxf")
    assert not drawing.audit().errors
    found = np.array([tuple(p.dxf.location) for p in drawing.modelspace().query("POINT")])
    np.testing.assert_allclose(found, few.X, rtol=1e-12)


@pytest.mark.parametrize("sigma", [np.nan, np.inf, 0.0])
def test_points_without_sigma_count_as_those_of_the_median(plane, sigma):
    """Also where all points of a cell are without."""
    ordinary = np.tile(0.25**2 * np.eye(3), (len(plane), 1, 1))
    without = ordinary.copy()
    without[plane.X[:, 0] < plane.X[:, 0].mean()] = np.diag([sigma**2] * 3)
    dsm, expected = (
        make_dsm(dataclasses.replace(plane, covariance=c), 2.0, 0) for c in (without, ordinary)
    )
    assert np.isfinite(expected.height).all()
    np.testing.assert_allclose(dsm.height, expected.height)
    np.testing.assert_allclose(dsm.sigma, expected.sigma)


def test_a_drawing_of_too_many_points_is_refused(tmp_path, monkeypatch):
    """At once, with a way out: its objects would take gigabytes, and no CAD program reads it."""
    monkeypatch.setattr("ezdxf.filemanagement.new", lambda _: pytest.fail("it is drawn"))
    n = 5_000_001
    many = lambda *shape: np.broadcast_to(0, (n, *shape))
    cloud = Cloud(many(3), many(3, 3), many(), many(), many(2), ("a",))
    with pytest.raises(InputError, match="5000001 points are too many for a drawing; thin"):
        write_cloud(cloud, tmp_path / "cloud.dxf")
    assert not list(tmp_path.iterdir())


def test_heights_of_a_dsm_are_as_good_as_its_sigma_says(plane, tmp_path):
    dsm = make_dsm(plane, 2.0)
    assert dsm.height.shape == (20, 20)
    # The points of a cell are not spread evenly about its middle, least where they are few.
    one_base = dataclasses.replace(plane, image=0 * plane.image)
    for n, size in ((4000, 2.0), (1200, 2.0), (4000, 1.0)):
        model = make_dsm(one_base.take(np.arange(n)), size, fill=0)
        x, y = model.centres()
        w = (model.height - on_plane(x, y)) / model.sigma
        assert 0.8 < np.sqrt(np.nanmean(w**2)) < 1.2
    path = tmp_path / "dsm.tif"
    write_dsm(dsm, path, tmp_path / "sigma.tif")
    with rasterio.open(path) as raster:
        assert raster.crs.to_epsg() == 32633 and raster.nodata == NO_DATA
        row, column = raster.index(500_007.0, 5_000_013.0)
        np.testing.assert_allclose(raster.read(1)[row, column], dsm.height[row, column])
        assert abs(dsm.height[row, column] - (30 + 1.4 - 1.3)) < 0.3
        assert raster.descriptions == ("height",)
    with rasterio.open(tmp_path / "sigma.tif") as raster:
        assert raster.descriptions == ("sigma of height",)


@pytest.mark.parametrize("length", [0.3, 1.0, 4.0])
def test_overlapping_windows_count_as_the_variance_of_their_mean_says(length):
    """The mean of the correlation 1 − |distance| of all pairs of places of a length."""
    place = (np.arange(2000) + 0.5) / 2000 * length
    correlation = np.maximum(1 - np.abs(place[:, None] - place), 0)
    np.testing.assert_allclose(1 / correlation.mean(), _independent_values(length), rtol=1e-3)


def points_of(surface, n=1200, side=12, seed=3):
    """Points of a surface at random places, without errors; σ 0.01."""
    xy = np.random.default_rng(seed).uniform(0, side, (n, 2))
    C = np.broadcast_to(1e-4 * np.eye(3), (n, 3, 3))
    X = np.column_stack([xy, surface(*xy.T)])
    return Cloud(X, C, np.full(n, 2), np.zeros(n, int), np.full((n, 2), np.nan), ("a",))


def test_heights_are_those_of_the_centres_of_cells():
    """Of a plane exactly: in cells of one point, beside gaps and at the edge."""
    surface = lambda x, y: 7 + 0.6 * x - 0.4 * y
    for n in (150, 1200):
        cloud = points_of(surface, n)
        near_gap = np.abs(cloud.X[:, :2] - 5.0).max(1)
        cloud = cloud.take(near_gap > 1.5)
        dsm = make_dsm(cloud, 1.0, fill=0, settings=DsmSettings(slope=1e3))
        has_slope = np.isfinite(dsm.height) & (dsm.sigma < 1)
        assert has_slope.sum() > 0.6 * np.isfinite(dsm.height).sum()
        assert (dsm.count[has_slope] == 1).sum() > 0.3 * has_slope.sum() or n == 1200
        expected = surface(*dsm.centres())[has_slope]
        np.testing.assert_allclose(dsm.height[has_slope], expected, atol=1e-5)


def test_no_height_leans_over_a_step():
    """Cells beside it have the slope of their own side."""
    surface = lambda x, y: 0.1 * x - 0.2 * y + np.where(x > 6, 3.0, 0.0)
    dsm = make_dsm(points_of(surface), 1.0)
    np.testing.assert_allclose(dsm.height, surface(*dsm.centres()), atol=1e-3)
    # Of a ridge one cell wide no plane is known; its own points are level.
    ridge = make_dsm(points_of(lambda x, y: 3.0 * (np.floor(x) == 6)), 1.0)
    np.testing.assert_allclose(ridge.height[:, 6], 3.0, atol=0.2)
    np.testing.assert_allclose(np.delete(ridge.height, 6, 1), 0.0, atol=1e-9)


def test_a_step_at_a_gap_is_no_slope():
    """Two columns of cells before a gap, on both sides of a step: no plane can tell."""
    surface = lambda x, y: np.where(x > 6, 1.0, 0.0)
    cloud = points_of(surface)
    x = cloud.X[:, 0]
    dsm = make_dsm(cloud.take((x > 5) & (x < 7)), 1.0)
    np.testing.assert_allclose(dsm.height, surface(*dsm.centres()), atol=1e-9)


def test_walls_are_no_slopes():
    """Terraces one cell wide, exactly in a plane, but far steeper than a slope."""
    surface = lambda x, y: 4.0 * np.floor(x)
    dsm = make_dsm(points_of(surface), 1.0)
    np.testing.assert_allclose(dsm.height, surface(*dsm.centres()), atol=1e-9)


def test_neighbours_are_cells_with_points_in_the_grid():
    """Not the last cell of the row above the first one of a row."""
    number = np.array([0, 2, 3, 4, 5, 7, 8, 11])
    zero = np.zeros(8)
    cells = CellMeans(number, 4, 1.0, zero, np.zeros((2, 8)), zero)
    expected = [
        [
            list(number).index(place)
            if 0 <= column + step[1] < 4
            and (place := (row + step[0]) * 4 + column + step[1]) in number
            else 8
            for row, column in zip(*np.divmod(number, 4))
        ]
        for step in WINDOW
    ]
    np.testing.assert_array_equal(_neighbours(cells, slice(0, 8)), expected)


def test_the_slope_that_is_not_known_is_in_the_sigma_of_a_single_cell():
    X = np.array([[0.2, 0.9, 5.0]])
    C = np.full((1, 3, 3), 0.05**2)
    cloud = Cloud(X, C, np.full(1, 2), np.zeros(1, int), np.zeros((1, 2)), ("a",))
    dsm = make_dsm(cloud, 1.0, settings=DsmSettings(slope=0.3))
    assert dsm.height == 5.0
    np.testing.assert_allclose(dsm.sigma, np.hypot(0.05, 0.3 * np.hypot(0.3, 0.4)))


def test_slopes_of_parts_are_those_of_all_cells(monkeypatch):
    """Windows reach over the borders of the parts that are computed at a time."""
    cloud = points_of(lambda x, y: np.sin(x) + 0.3 * y)
    whole = make_dsm(cloud, 1.0)
    in_parts = functools.partial(cell_slopes, at_once=17)
    monkeypatch.setattr("jaxbundle.surfaces.dsm.cell_slopes", in_parts)
    parts = make_dsm(cloud, 1.0)
    np.testing.assert_array_equal(parts.height, whole.height)
    np.testing.assert_array_equal(parts.sigma, whole.sigma)


def test_a_height_far_from_the_others_of_its_cell_is_left_out():
    """By more than three σ; a cell of equal heights is given the σ of a slope, 0.3 of its size."""
    X = np.array([[0.5 + k / 100, 0.5, 30.0] for k in range(8)])
    n, C = len(X) + 1, np.tile(np.eye(3), (len(X) + 1, 1, 1))
    for up, count in ((0.85, 9), (0.95, 8)):
        points = np.vstack([X, [0.5, 0.5, 30 + up]])
        cloud = Cloud(points, C, np.full(n, 2), np.zeros(n, int), np.zeros((n, 2)), ("a",))
        dsm = make_dsm(cloud, 1.0)
        assert dsm.count.tolist() == [[count]]
        np.testing.assert_allclose(dsm.height, 30 + (up / 9 if count == 9 else 0))


def test_gaps_of_a_dsm_are_filled_inside_only(plane):
    hole = ((plane.X[:, :2] - [500_000, 5_000_000] > 9.9) &
            (plane.X[:, :2] - [500_000, 5_000_000] < 12.1)).all(1)  # fmt: skip
    left = plane.take(~hole & ~((plane.X[:, 0] > 500_030) & (plane.X[:, 1] > 5_000_030)))
    plain, filled = make_dsm(left, 2.0, fill=0), make_dsm(left, 2.0)
    gap = np.isnan(plain.height) & np.isfinite(filled.height)
    assert gap.sum() >= 1 and np.isnan(filled.height).sum() > 15
    assert (filled.sigma[gap] > np.nanmedian(plain.sigma)).all()


def test_a_gap_at_the_border_is_filled_from_the_cells_that_there_are():
    """By inverse squares of distances. Heights mirrored at the border would count twice, and bend a
    slope there."""
    row, column = np.indices((7, 7))
    height = 30 + 0.3 * column + 0.1 * row
    gap = (row == 3) & (column == 1)
    X = np.stack([column + 0.5, 6.5 - row, height], 2)[~gap]
    n = len(X)
    C = np.tile(1e-4 * np.eye(3), (n, 1, 1))
    found = make_dsm(Cloud(X, C, np.full(n, 2), np.zeros(n, int), np.zeros((n, 2)), ("a",)), 1.0,
                     fill=1)  # fmt: skip
    square = ((row - 3) ** 2 + (column - 1) ** 2).astype(float)
    near = (abs(row - 3) <= 2) & (abs(column - 1) <= 2) & ~gap
    expected = np.average(height[near], weights=1 / square[near])
    assert found.height[3, 1] == pytest.approx(expected, abs=1e-6)
    np.testing.assert_allclose(found.height[~gap], height[~gap])


def test_a_gap_beside_a_wall_is_filled_from_below(plane):
    X = plane.X.copy()
    east = X[:, 0] - X[:, 0].min()
    X[:, 2] = np.where(east > 20, 9.0, 0.0) + 0.01 * X[:, 1] % 0.05
    walled = dataclasses.replace(plane, X=X).take((east < 19.0) | (east > 22.5))
    plain, filled = make_dsm(walled, 1.0, fill=0), make_dsm(walled, 1.0)
    gap = np.isnan(plain.height) & np.isfinite(filled.height)
    inside = np.abs(filled.x + np.arange(gap.shape[1]) + 0.5 - X[:, 0].min() - 20.7) < 1.5
    assert (gap & inside).sum() > 20
    assert (filled.height[gap] < 1e-3 + 0.05)[inside[None].repeat(len(gap), 0)[gap]].all()


def test_the_report_counts_by_classes(plane):
    found = accuracy_of(plane)
    assert [c["points"] for c in found["classes"]] == [2000, 2000, 0, 0, 0, 0] or (
        sum(c["points"] for c in found["classes"]) == len(plane)
    )
    assert found["sZ"]["smallest"] == pytest.approx(0.05)
    assert found["sZ"]["mean"] == pytest.approx(0.075)
    check = np.array([[500_010, 5_000_010, 31.0], [500_020, 5_000_010, 33.0]])
    at = at_check_points(plane, check, 2.0)
    assert at["points"] == 2 and at["rms_Z"] < 0.05
    # The six points of two rows are twice the unknowns of their plane; five are too few.
    X = np.array([[x, y, 2 * x - y + 7.0] for x in (-1, 0, 1) for y in (-1, 1)])
    six = Cloud(X, np.zeros((6, 3, 3)), np.full(6, 2), np.zeros(6, int), np.zeros((6, 2)), ("a",))
    at = at_check_points(six, np.array([[0.0, 0.0, 6.5]]), 2.0)
    assert at["points"] == 1 and at["mean_Z"] == pytest.approx(0.5)
    assert at_check_points(six.take(np.arange(5)), np.zeros((1, 3)), 2.0)["points"] == 0
    assert to_plane(plane.X)["rms"] == pytest.approx(0.05 * np.sqrt(2.5) / np.sqrt(1.05), rel=0.05)


def test_the_report_says_what_its_sigma_contains(plane):
    image = {"image": "a", "with": ["b"], "matched": 4, "points": 9, "variance_factor": 1.25,
             "rejected": {"narrow angle": 5}}  # fmt: skip
    told = text_of({
        "points": len(plane), "rays": {}, "images": [image], "accuracy": accuracy_of(plane),
        "sigma_includes": ["matching", "orientation"],
        "check_points": {"points": 3, "rms_Z": 0.25, "mean_Z": -0.125, "largest_Z": 0.5},
    })  # fmt: skip
    assert "σ contains: matching, orientation" in told.splitlines() and "holds" not in told
    row = told.splitlines().index("a with b: 4 of 9 points, variance factor 1.25")
    assert told.splitlines()[row + 1].split() == ["5", "narrow", "angle"]
    checked = "3 check points: RMS of heights 0.25, mean -0.125, largest 0.5"
    assert told.splitlines()[-1] == checked


def test_clouds_are_compared_along_normals(plane):
    other = cloud_on_plane(seed=1)
    raised = Cloud(plane.X + [0, 0, 0.5], *(getattr(plane, n) for n in
                   ("covariance", "rays", "image", "uv", "images")))  # fmt: skip
    found = compare(raised, other)
    assert found["median"] == pytest.approx(0.5 / np.sqrt(1.05), abs=0.02)
    assert compare(plane, other)["normalised_rms"] < 1.2
    with pytest.raises(InputError, match="neighbours must be a whole number from 3"):
        compare(plane, other, neighbours=2)
    with pytest.raises(InputError, match="nothing in common"):
        compare(Cloud(plane.X + 1e4, *(getattr(plane, n) for n in
                ("covariance", "rays", "image", "uv", "images"))), other)  # fmt: skip


def test_pictures_show_all_points_and_cells(plane):
    ax = plotting.cloud_perspective(plane)
    low, high = ax.get_xlim()
    assert low < plane.X[:, 0].min() and plane.X[:, 0].max() < high
    dsm = make_dsm(plane, 2.0)
    picture = plotting.dsm_relief(dsm).images[0]
    assert picture.get_extent() == [500_000, 500_040, 5_000_000, 5_000_040]
    # falls to the north-west, away from the light: darker than a plane that rises there
    rising = dataclasses.replace(dsm, height=-dsm.height)
    lit = plotting.dsm_relief(rising).images[0].get_array()[..., :3]
    assert lit.mean() != picture.get_array()[..., :3].mean()
    # two level steps, one with a hole: beside it the ground is as level as elsewhere
    height = np.repeat([[0.0] * 6 + [10.0] * 6], 9, axis=0)
    height[4, 2] = np.nan
    steps = Dsm(height, 0 * height, np.ones((9, 12), int), 0.0, 9.0, 1.0)
    colours = plotting.dsm_relief(steps).images[0].get_array()[:, :5][np.isfinite(height[:, :5])]
    assert_allclose(colours, np.broadcast_to(colours[0], colours.shape))
    plt.close("all")


def test_an_orthophoto_shows_what_the_image_sees_and_nothing_behind_a_roof():
    views, _ = photographs(two_shapes(), [(3.0, 0, 10)], noise=0)
    x, y = np.meshgrid(np.arange(-3, 3, 0.05) + 0.025, -(np.arange(-3, 3, 0.05) + 0.025))
    roof = (np.abs(x + 0.2) < 1) & (np.abs(y + 0.2) < 1)
    dsm = Dsm(np.where(roof, 2.0, hills(x, y)), 0 * x, 0 * x.astype(int), -3.0, 3.0, 0.05)
    grey, steep = orthophoto(views[0], dsm)
    texture = Texture(0.02, seed=1, side=512)
    ground = np.isfinite(grey) & ~roof
    expected = texture(x[ground], y[ground], np.full(ground.sum(), 0.05)) * 255
    assert np.corrcoef(grey[ground], expected)[0, 1] > 0.9
    # the roof's shadow: beyond its edge as seen from X = 3
    behind = (x < -1.35) & (x > -1.7) & (np.abs(y + 0.2) < 0.8)
    assert np.isnan(grey[behind]).mean() > 0.9 and np.isfinite(grey[x > 1]).mean() > 0.95
    assert np.nanmax(steep) <= 1 and steep[20, 110] > steep[20, 30]


def test_a_folder_where_a_cloud_is_expected(tmp_path, command):
    told = command("cloud", tmp_path)
    assert told.status == 2
    assert told.err.startswith(f"jaxbundle: {tmp_path}: is a folder; expected a cloud, .csv")


@pytest.mark.parametrize("values, kind", [([7.0, np.nan], "uint8"), ([np.nan] * 2, "uint8"),
                                          ([7.0, 300.0], "uint16")])  # fmt: skip
def test_an_orthophoto_has_as_many_bits_as_its_grey_values(tmp_path, values, kind):
    """Also where no cell has one, without a warning: 0 stands for none."""
    grey = np.array([values])
    dsm = Dsm(0 * grey, 0 * grey, np.zeros((1, 2), int), 0.0, 1.0, 1.0)
    write_orthophoto(grey, dsm, tmp_path / "o.tif")
    with rasterio.open(tmp_path / "o.tif") as raster:
        assert raster.dtypes == (kind,)
        np.testing.assert_array_equal(raster.read(1), np.nan_to_num(grey))


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_clouds_are_read_in_pieces(tmp_path, suffix):
    path = tmp_path / f"c.{suffix}"
    write_cloud(cloud_on_plane(900, system="EPSG:32633"), path)
    whole, pieces = read_cloud(path), _read_las(path, points_at_once=7)
    for name in ("X", "covariance", "rays", "colour"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(pieces, name))
    assert whole.system == pieces.system
