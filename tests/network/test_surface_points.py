"""Points on known surfaces: planes, meshes, terrain."""

import dataclasses
import struct

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from further_checks import check_jacobians, sample

import jaxbundle
from jaxbundle.errors import InputError
from jaxbundle.geometry.surfaces import (
    distance_to_nearest_triangle,
    height_above_grid,
    squared_distances_to_triangles,
)
from jaxbundle.network.surface_models import (
    TerrainGrid,
    heights_near,
    read_grid,
    read_mesh,
    triangles_near,
)

SIGMA = 1e-3


def height(x, y):
    return 0.3 * np.sin(1.3 * x) + 0.2 * np.cos(1.7 * y) + 0.1 * x


def bumpy(n=41, size=3.0):
    """A mesh of a surface, two triangles a cell."""
    x = np.linspace(-size, size, n)
    X, Y = np.meshgrid(x, x, indexing="ij")
    k = np.arange(n * n).reshape(n, n)
    a, b, c, d = k[:-1, :-1].ravel(), k[1:, :-1].ravel(), k[1:, 1:].ravel(), k[:-1, 1:].ravel()
    return (np.stack([X, Y, height(X, Y)], -1).reshape(-1, 3),
            np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))  # fmt: skip


def grid(n=61, size=3.0):
    """Heights, rows from north to south."""
    x = np.linspace(-size, size, n)
    X, Y = np.meshgrid(x, x[::-1])
    step = 2 * size / (n - 1)
    return height(X, Y), (-size, size), (step, -step)


@pytest.fixture(scope="module")
def made():
    """Six stations around 40 points, the first 20 of them on the mesh."""
    random = np.random.default_rng(3)
    X = random.uniform([-1.5, -1.5, -0.5], [1.5, 1.5, 0.8], (40, 3))
    vertices, triangles = bumpy()
    w = random.dirichlet([1, 1, 1], 20)
    inner = np.flatnonzero(np.abs(vertices[triangles]).max((1, 2)) < 1.5)
    X[:20] = np.einsum("nk,nkd->nd", w, vertices[triangles[random.choice(inner, 20)]])
    return jaxbundle.simulate_with_truth(
        jaxbundle.ring_of_stations(6, radius=5.0, height=4.0), X,
        jaxbundle.Camera("cam", "brown", {"c": 20.0}, ()), noise=0.002, seed=2,
        disturb=(0.02, 0.004, 0.02),
    )  # fmt: skip


def on(network, sigma=SIGMA, points=range(20), **surfaces):
    (name,) = surfaces
    rows = {"surface": [name] * len(points), "point": [str(k + 1) for k in points]}
    rows |= {"sigma": [sigma] * len(points)}
    return jaxbundle.add_further(network, surface_points=rows, surfaces=surfaces)


def test_a_mesh_gives_the_datum_of_a_free_network(made):
    """All seven of it, of a bumpy one: the points without the mesh lie where they truly are."""
    network = on(made.network, ground={"mesh": bumpy()})
    assert jaxbundle.make_problem(network).counts.datum == 0
    result = jaxbundle.adjust(network.replace(datum="control"))
    assert result.converged and 0.75 < result.sigma0 < 1.25
    error = result.point_values - made.truth.points.position
    sigma = np.stack([result.points[f"s{a}"] for a in "XYZ"], 1)
    assert np.abs(error / sigma).max() < 5 and np.sqrt(np.mean((error / sigma) ** 2)) < 2
    assert "points on known meshes" in result.variance_components


def test_terrain_gives_heights_and_more(made):
    X = made.truth.points.position.copy()
    X[:20, 2] = height(*X[:20, :2].T)
    points = dataclasses.replace(made.truth.points, position=X)
    again = jaxbundle.simulate_with_truth(
        jaxbundle.ring_of_stations(6, radius=5.0, height=4.0), X,
        jaxbundle.Camera("cam", "brown", {"c": 20.0}, ()), noise=0.002, seed=2,
        disturb=(0.02, 0.004, 0.02),
    )  # fmt: skip
    result = jaxbundle.adjust(on(again.network, 0.003, ground={"dem": grid()}))
    assert result.converged and 0.7 < result.sigma0 < 1.3
    assert np.abs(result.point_values[:20] - points.position[:20]).max() < 0.05


@pytest.mark.further
def test_sigma_is_that_of_a_sample(made):
    """200 draws; the points on the mesh have σ from it as well as from their rays."""
    problem = jaxbundle.make_problem(on(made.truth, ground={"mesh": bumpy()}))
    found = sample(problem, problem.data.start, ("point",), draws=200)["point"]
    result = jaxbundle.adjust(on(made.network, ground={"mesh": bumpy()}))
    sigma = np.stack([result.points[f"s{a}"] for a in "XYZ"], 1) / result.sigma0
    ratio = found.std(0, ddof=1) / sigma
    assert 0.9 < np.median(ratio) < 1.1 and 0.7 < ratio.min() and ratio.max() < 1.35


def test_a_known_plane(made):
    """It gives three of the datum; the points near it have the distances of the truth within their
    σ. Without a scale the network would shrink to a point of the plane, which is said."""
    X = made.truth.points.position
    normal = np.array([0.2, -0.1, 1.0]) / np.linalg.norm([0.2, -0.1, 1.0])
    near = np.argsort(np.abs((X - X[7]) @ normal))[:5]
    offset = (X[near] - X[7]) @ normal
    plane = {"plane": X[7].tolist(), "normal": (3 * normal).tolist()}
    network = on(made.network, 0.5, near, wall=plane)
    assert np.abs(offset).max() < 0.5
    with pytest.raises(InputError, match="planes with a common point give no scale"):
        jaxbundle.make_problem(network)
    length = np.linalg.norm(X[0] - X[30])
    scaled = network.replace(distances=jaxbundle.network.tables.Distances(
        np.array([[0, 30]]), np.array([length]), np.array([1e-3])))  # fmt: skip
    assert jaxbundle.make_problem(scaled).counts.datum == 3
    result = jaxbundle.adjust(scaled)
    assert result.converged
    assert np.abs((result.point_values[near] - X[7]) @ normal).max() < 0.5


def test_the_nearest_triangle_by_brute_force():
    """Distances by the closest of many points of the triangles; candidates contain the nearest."""
    random = np.random.default_rng(2)
    corners = random.normal(size=(12, 3, 3))
    w = random.dirichlet([0.5, 0.5, 0.5], 20000)
    for P in random.normal(size=(8, 3)):
        sampled = np.linalg.norm(np.einsum("nk,mkd->mnd", w, corners) - P, axis=2).min(1)
        found = np.sqrt(squared_distances_to_triangles(P, corners, np))
        assert (found <= sampled + 1e-12).all() and np.abs(found - sampled).max() < 0.05
    vertices, triangles = bumpy()
    for P in random.uniform(-1, 1, (10, 3)):
        (near,) = triangles_near(read_mesh_of(vertices, triangles), P[None])
        every = np.sqrt(squared_distances_to_triangles(P, vertices[triangles]))
        nearest = squared_distances_to_triangles(P, near).min()
        assert nearest == pytest.approx(every.min() ** 2)
        signed = float(distance_to_nearest_triangle(jnp.asarray(P), jnp.asarray(near)))
        # the plane of a triangle is no farther than the triangle
        assert abs(signed) <= every.min() + 1e-12


def read_mesh_of(vertices, triangles):
    from jaxbundle.network.surface_models import Mesh

    return Mesh(vertices, triangles)


def test_heights_are_bilinear():
    heights, origin, step = grid()
    random = np.random.default_rng(4)
    X = np.c_[random.uniform(-2.9, 2.9, (50, 2)), np.zeros(50)]
    parts, first = heights_near(TerrainGrid(heights, origin, step), X)
    for P, part, at in zip(X, parts, first):
        i, j = (P[0] - origin[0]) / step[0], (P[1] - origin[1]) / step[1]
        c, r = int(i), int(j)
        x, y = i - c, j - r
        h = heights[r : r + 2, c : c + 2]
        expected = (1 - y) * ((1 - x) * h[0, 0] + x * h[0, 1])
        expected += y * ((1 - x) * h[1, 0] + x * h[1, 1])
        given = tuple(map(jnp.asarray, (P, np.nan_to_num(part), at, step)))
        assert float(height_above_grid(*given)) == pytest.approx(-expected, abs=1e-12)
        slope = jax.grad(height_above_grid)(*given)
        assert slope[2] == 1 and np.isfinite(slope).all()


def test_jacobians(made):
    ends = jaxbundle.network.tables.Distances(np.array([[0, 30]]), np.ones(1), np.ones(1))
    truth = made.truth.replace(distances=ends)
    for surface in ({"mesh": bumpy()}, {"dem": grid()}, {"plane": [0, 0, 0], "normal": [0, 1, 1]}):
        problem = jaxbundle.make_problem(on(truth, ground=surface))
        check_jacobians(problem, problem.data.start)


def write_ply(path, vertices, triangles, form):
    count = lambda t: ["ply", f"format {t} 1.0", f"element vertex {len(vertices)}",
                       "property double x", "property double y", "property double z",
                       "property uchar red", f"element face {len(triangles)}",
                       "property list uchar int vertex_indices", "end_header", ""]  # fmt: skip
    head = "\n".join(count(form)).encode()
    if form == "ascii":
        body = "".join(f"{x!r} {y!r} {z!r} 7\n" for x, y, z in vertices.tolist())
        body += "".join(f"3 {a} {b} {c}\n" for a, b, c in triangles.tolist())
        path.write_bytes(head + body.encode())
        return
    order = "<" if "little" in form else ">"
    body = b"".join(struct.pack(f"{order}dddB", *v, 7) for v in vertices.tolist())
    body += b"".join(struct.pack(f"{order}Biii", 3, *t) for t in triangles.tolist())
    path.write_bytes(head + body)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian", "obj"])
def test_meshes_are_read(tmp_path, form):
    vertices, triangles = bumpy(5)
    path = tmp_path / ("mesh.obj" if form == "obj" else "mesh.ply")
    if form == "obj":
        # squares, with texture indices; the last counted backwards
        text = "".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in vertices.tolist())
        text += "".join(f"f {a + 1}/1 {b + 1}/2 {c + 1}/3\n" for a, b, c in triangles[:-1].tolist())
        a, b, c = triangles[-1] - len(vertices)
        path.write_text(text + f"f {a} {b} {c}\n")
    else:
        write_ply(path, vertices, triangles, form)
    mesh = read_mesh(path)
    np.testing.assert_array_equal(mesh.vertices, vertices)
    np.testing.assert_array_equal(mesh.triangles, triangles)


def test_rasters_are_read(tmp_path):
    import rasterio
    from rasterio.transform import Affine

    heights, origin, (dx, dy) = grid(11)
    place = Affine(dx, 0, origin[0] - dx / 2, 0, dy, origin[1] - dy / 2)
    path = tmp_path / "dem.tif"
    with rasterio.open(path, "w", driver="GTiff", width=11, height=11, count=1, dtype="float64",
                       transform=place, nodata=-9999.0) as out:  # fmt: skip
        out.write(np.where(np.arange(121).reshape(11, 11) == 5, -9999.0, heights), 1)
    found = read_grid(path)
    np.testing.assert_allclose(found.origin, origin)
    np.testing.assert_allclose(found.step, (dx, dy))
    assert np.isnan(found.heights[0, 5]) and np.isnan(found.heights).sum() == 1
    # whole decimetres below 500 m, as terrain models are often stored
    with rasterio.open(path, "w", driver="GTiff", width=11, height=11, count=1, dtype="int16",
                       transform=place) as out:  # fmt: skip
        out.scales, out.offsets = (0.1,), (500.0,)
        out.write(np.round((heights - 500) / 0.1).astype(np.int16), 1)
    np.testing.assert_allclose(read_grid(path).heights, heights, atol=0.05 + 1e-9)


def test_in_a_project(made, tmp_path):
    """Files beside the project; read again, the same."""
    vertices, triangles = bumpy()
    network = on(made.network, ground={"mesh": "ground.ply"})
    path = jaxbundle.write_project(network, tmp_path / "p")
    write_ply(tmp_path / "p" / "ground.ply", vertices, triangles, "binary_little_endian")
    again = jaxbundle.read_network(str(path))
    one = jaxbundle.adjust(again)
    two = jaxbundle.adjust(on(made.network, ground={"mesh": (vertices, triangles)}))
    np.testing.assert_allclose(one.point_values, two.point_values, atol=1e-8)


@pytest.mark.parametrize("surface, message", [
    ({"mesh": "none.ply"}, "none.ply: no such file; expected a mesh"),
    ({"dem": "none.tif"}, "none.tif: no such file; expected a raster"),
    ({"mesh": "a.ply", "dem": "b.tif"}, "expected plane and normal, or mesh, or dem"),
    ({"plane": [0, 0, 0]}, "expected plane and normal"),
    ({"plane": [0, 0, 0], "normal": [0, 0, 0]}, "normal is 0"),
    ({"plane": [0, 0], "normal": [0, 0, 1]}, "3 numbers"),
    ({"mash": "a.ply"}, "unknown key 'mash'; did you mean 'mesh'"),
    ({"mesh": 3}, "expected a file"),
    ({"dem": (np.zeros((4, 4)), (10.0, 10.0), (1.0, 1.0))}, "outside of the surface 'ground'"),
])  # fmt: skip
def test_what_is_wrong_is_named(made, surface, message):
    with pytest.raises(InputError, match=message):
        jaxbundle.make_problem(on(made.network, ground=surface))


def test_a_file_that_is_no_mesh_is_named(tmp_path):
    for name, content in (("a.ply", b"ply\nformat ascii 1.0\nend_header\n"), ("b.obj", b"v 1 2\n"),
                          ("c.ply", b"ply\nformat"), ("d.obj", b"v 1 2 3\nf 1 2 3\n")):  # fmt: skip
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match=name):
            read_mesh(tmp_path / name)


def test_an_unknown_surface_is_named(made):
    with pytest.raises(InputError, match="surface 'grund' is not in .surfaces.; did you mean"):
        jaxbundle.add_further(
            made.network, surface_points={"surface": ["grund"], "point": ["1"]},
            surfaces={"ground": {"mesh": "a.ply"}},
        )  # fmt: skip
