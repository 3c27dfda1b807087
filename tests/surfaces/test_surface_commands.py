"""`jaxbundle surface` and `jaxbundle cloud` from files to files, and what they say of bad input;
RPC images whose orientation misses by pixels."""

import json
from types import SimpleNamespace

import cv2
import jax.numpy as jnp
import numpy as np
import pyproj
import pytest
import rasterio
from surface_scenes import CAMERA, SIZE, hills, photographs, two_shapes, undulation, write_geoid

import jaxbundle
from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import WGS84
from jaxbundle.io.rasters.geoid import add_geoid
from jaxbundle.io.rasters.terrain_models import read_terrain
from jaxbundle.io.rasters.vertical import split_system, with_heights_above
from jaxbundle.io.scanner.rpc import write_rpc
from jaxbundle.planning.rendering import Scene, Sensor, render_rays
from jaxbundle.planning.shapes import HeightField
from jaxbundle.planning.texture import Texture
from jaxbundle.pushbroom.rpc.polynomials import Rpc
from jaxbundle.surfaces.cloud import Cloud
from jaxbundle.surfaces.point_files import read_cloud
from jaxbundle.surfaces.scanner_inputs import from_map, map_coordinates
from jaxbundle.surfaces.scanner_views import RpcView, neighbourhood


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    """A project of cameras and oriented images alone, and its photographs."""
    folder = tmp_path_factory.mktemp("project")
    views, truth = photographs(two_shapes(), [(-1.0, 0, 10), (1.0, 0, 10)])
    p = CAMERA.parameters
    values = "\n".join(f"{name} = {value}" for name, value in p.items())
    (folder / "project.toml").write_text(
        '[project]\nimage_unit = "px"\nimages = "images.csv"\n[[camera]]\nid = "cam"\n'
        f'model = "opencv"\nimage_size = {list(SIZE)}\nfree = []\n{values}\n'
    )
    rows = [f"{v.name},cam,{','.join(map(str, v.X0))}" + ",0" * 9 for v in views]
    header = "id,camera,X0,Y0,Z0,omega,phi,kappa,sX0,sY0,sZ0,somega,sphi,skappa"
    (folder / "images.csv").write_text("\n".join([header, *rows]) + "\n")
    (folder / "photos").mkdir()
    for view in views:
        # as bright as before: 0.114·19 = 0.299·7
        colour = np.stack([view.grey - 19.0, view.grey, view.grey + 7.0], 2)
        colour = np.clip(colour, 0, 255).astype(np.uint8)
        cv2.imwrite(str(folder / "photos" / view.name), colour)
    return folder, truth


def test_a_project_becomes_a_cloud_and_a_dsm(project, tmp_path, command, monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1000000000")
    folder, truth = project
    out, check = tmp_path / "out", tmp_path / "check.csv"
    x, y = (a.ravel() for a in np.meshgrid([-3, 1.5, 2.5], [-2, 1.5, 2]))
    rows = np.column_stack([x, y, hills(x, y)])
    np.savetxt(check, rows, delimiter=",", header="X,Y,Z", comments="")
    told = command(
        "surface", folder, "--photos", folder / "photos", "--out", out, "--zmin", -1.5, "--zmax", 3,
        "--pairs", "photo_0.png,photo_1.png", "--dense", "--step", 2, "--dsm", 0.25, "--json", "-",
        "--orthophoto", "--check", check,
    )  # fmt: skip
    assert told.status == 0
    report = json.loads(told.out)
    cloud = read_cloud(out / "cloud.csv")
    assert report["points"] == len(cloud) > 3000
    v, u = cloud.uv.astype(int).T[::-1]
    e = cloud.X[:, 2] - truth[0][v, u][:, 2]
    assert np.median(np.abs(e)) < 0.02 and (np.abs(e) > 0.3).mean() < 0.01
    assert report["sigma_includes"] == ["matching"]
    first, *lines = (out / "report.txt").read_text().splitlines()
    assert all(any(line.startswith(f"σ{axis}  mean ") for line in lines) for axis in "XYZ")
    for row in report["images"]:
        assert row["matched"] + sum(row["rejected"].values()) == row["points"]
    assert "project.toml" in first and "computed 2001-09-09 01:46 UTC, jaxbundle" in first
    # the step is the given one: nothing was thinned
    assert not any("--step 1 takes all" in said for said in report["warnings"])
    assert report["check_points"]["points"] == 9 and report["check_points"]["rms_Z"] < 0.05
    with rasterio.open(out / "dsm.tif") as raster, rasterio.open(out / "orthophoto.tif") as photo:
        assert raster.res == photo.res == (0.25, 0.25) and photo.dtypes == ("uint8",)
        assert (photo.read(1)[raster.read(1) > -99] > 0).mean() > 0.9
    colour = read_cloud(out / "cloud.ply").colour.astype(float)
    inner = (colour > 30).all(1) & (colour < 225).all(1)
    np.testing.assert_allclose(np.diff(colour[inner].mean(0)), [-7, -19], atol=0.1)
    thinned = tmp_path / "thin.ply"
    told = command("cloud", out / "cloud.csv", "--cube", 0.5, "--out", thinned, "--against",
                   out / "cloud.ply", "--json", "-")  # fmt: skip
    found = json.loads(told.out)
    assert found["points"] == len(read_cloud(thinned)) < len(cloud) / 4
    assert abs(found["comparison"]["median"]) < 0.05


@pytest.mark.parametrize("dense, window", [(False, 13), (True, 5)])
def test_cells_of_a_model_know_the_windows_of_their_matching(tmp_path, monkeypatch, dense, window):
    """Of nine points of 3 × 3 pixels 1/(1 − 2/(3·window))² count."""
    v, u = np.indices((3, 3)).reshape(2, -1)
    X = np.stack([(u + 0.5) / 3, (v + 0.5) / 3, 0.0 * u], 1)
    cloud = Cloud(X, np.tile(np.eye(3), (9, 1, 1)), np.full(9, 2), np.zeros(9, int),
                  np.stack([u, v], 1).astype(float), ("a",))  # fmt: skip
    matched = SimpleNamespace(surface=SimpleNamespace(cloud=cloud), views=(), to_views=None,
                              check=np.zeros((0, 3)), heights="")  # fmt: skip
    monkeypatch.setattr("jaxbundle.commands.surface._match_photographs", lambda *_: matched)
    found = jaxbundle.surface(tmp_path, dense=dense, dsm=1.0)
    np.testing.assert_allclose(found.dsm.sigma, 1 - 2 / (3 * window))


@pytest.mark.parametrize("options, written", [([], True), (["--no-csv"], False)])
def test_clouds_are_written_as_text_too(tmp_path, command, monkeypatch, options, written):
    n = 5
    cloud = Cloud(np.zeros((n, 3)), np.zeros((n, 3, 3)), np.full(n, 2), np.zeros(n, int),
                  np.zeros((n, 2)), ("a.jpg",))  # fmt: skip
    found = SimpleNamespace(cloud=cloud, dsm=None, to_dict=dict, report=lambda: "some points")
    monkeypatch.setattr(jaxbundle, "surface", lambda *_, **options: found)
    told = command("surface", tmp_path, "--out", tmp_path / "out", *options)
    assert told.status == 0, told.err
    assert (tmp_path / "out" / "cloud.csv").exists() == written
    assert len(read_cloud(tmp_path / "out" / "cloud.ply")) == n


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"--photos": "nowhere"}, "no such folder"),
        ({"--zmax": "-9"}, "the lower height first"),
        ({"--pairs": "photo_0.png,phot_1.png"}, "no image 'phot_1.png'"),
        ({"--points": "stars"}, "grid, edges, corners"),
        ({"--orthophoto-of": "photo_0.png"}, "needs --dsm"),
    ],
)
def test_bad_input_ends_in_one_line(project, tmp_path, command, change, said):
    folder, _ = project
    options = {"--photos": folder / "photos", "--out": tmp_path / "out", "--zmin": "-1.5",
               "--zmax": "3", **change}  # fmt: skip
    told = command("surface", folder, *(x for pair in options.items() for x in pair))
    assert told.status == 2 and said in told.err and told.err.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_photographs_of_another_size_or_missing_are_named(project, tmp_path, command):
    folder, _ = project
    photos = tmp_path / "photos"
    photos.mkdir()
    run = lambda: command("surface", folder, "--photos", photos, "--out", tmp_path / "out")
    assert "photo_0.png, photo_1.png" in run().err
    for k in (0, 1):
        cv2.imwrite(str(photos / f"photo_{k}.png"), np.zeros((10, 20), np.uint8))
    told = run()
    assert told.status == 2 and "20 × 10" in told.err


@pytest.mark.further
def test_a_block_of_photographs_above_the_other_surface(project, tmp_path, command):
    """From the ellipsoid to the geoid, and back; heights searched are above the same."""
    folder, _ = project
    geoid = write_geoid(tmp_path / "own.tif")
    plain = "+proj=tmerc +lat_0=45 +lon_0=10 +datum=WGS84 +units=m"
    given = {
        "plain": ["--zmin", -1.5, "--zmax", 3],
        "geoid": ["--zmin", -48.5, "--zmax", -44, "--crs", plain, "--geoid", geoid],
        "ellipsoid": ["--zmin", 45.5, "--zmax", 50, "--crs", with_heights_above(plain, "x.gtx"),
                      "--geoid", geoid, "--heights", "ellipsoid"],
    }  # fmt: skip
    told, clouds = {}, {}
    for name, options in given.items():
        said = command(
            "surface", folder, "--photos", folder / "photos", "--out", tmp_path / name, "--pairs",
            "photo_0.png,photo_1.png", "--step", 8, "--json", "-", *options,
        )  # fmt: skip
        assert said.status == 0, said.err
        told[name] = json.loads(said.out)["heights"]
        rows = np.genfromtxt(tmp_path / name / "cloud.csv", delimiter=",", names=True)
        clouds[name] = {(r["u"], r["v"]): r["Z"] for r in rows}
    assert told["plain"] is None
    one = clouds["plain"]
    for name, sign in (("geoid", -1), ("ellipsoid", 1)):
        assert f"above the {name}" in told[name] and str(geoid) in told[name]
        both = one.keys() & clouds[name].keys()
        assert len(both) > 0.9 * len(one) > 100
        moved = np.median([clouds[name][k] - one[k] for k in both])
        # where N begins, the range of heights is another one by millimetres: σ is 10 mm
        assert moved == pytest.approx(sign * 47.0, abs=2e-3)


LINES, SAMPLES = 150, 180


def coefficients(by_height):
    """North up, 2 m a pixel, samples moved by height."""
    z = np.zeros(20)
    line, sample, one = z.copy(), z.copy(), z.copy()
    line[2], line[8], sample[1], sample[3], one[0] = -1, 0.003, 1, by_height, 1
    scalars = (LINES / 2, LINES / 2, SAMPLES / 2, SAMPLES / 2, 10.0, SAMPLES / 2 * 2.5e-5, 45.0,
               LINES / 2 * 1.8e-5, 200.0, 200.0)  # fmt: skip
    return Rpc(*map(jnp.asarray, (line, one, sample, one)), *map(jnp.asarray, map(float, scalars)))


def ground(X, Y):
    return 200 + 12 * np.sin(X / 60) * np.cos(Y / 70)


def write_satellite(folder):
    """a.tif and b.tif with RPC; the second is moved by 3 lines against its coefficients."""
    around = neighbourhood(np.radians(10.0), np.radians(45.0))
    scene = Scene((HeightField(ground, (-600, -600, 600, 600)),), (Texture(1.0, 2, 512),))
    blank = np.zeros((LINES, SAMPLES), np.float32)
    for name, by_height, shift in (("a", 0.6, 0.0), ("b", -0.6, 3.0)):
        view = RpcView(name, blank, coefficients(by_height), around)
        v, u = np.indices((LINES + 1, SAMPLES + 1)).reshape(2, -1)
        uv = np.stack([u, v - shift], 1)
        top, bottom = (view.points(uv, np.full(len(uv), h)) for h in (400.0, 0.0))
        d = (bottom - top) / np.linalg.norm(bottom - top, axis=1, keepdims=True)
        o, d = (a.reshape(LINES + 1, SAMPLES + 1, 3) for a in (top, d))
        shot = render_rays(scene, o, d, Sensor(noise=1.5, seed=len(name)))
        cv2.imwrite(str(folder / f"{name}.tif"), shot.grey.astype(np.uint16) * 9 + 100)
        write_rpc(folder / f"{name}_RPC.TXT", coefficients(by_height))
    return around


@pytest.fixture(scope="module")
def satellite(tmp_path_factory):
    folder = tmp_path_factory.mktemp("satellite")
    return folder, write_satellite(folder)


@pytest.mark.further
@pytest.mark.parametrize("dense", [(), ("--dense",)])
def test_rpc_images_become_a_cloud_in_a_map_system(satellite, tmp_path, command, dense):
    folder, around = satellite
    out = tmp_path / "out"
    told = command(
        "surface", folder / "a.tif", folder / "b.tif", "--out", out, "--zmin", 170, "--zmax", 230,
        "--pairs", "a.tif,b.tif", "--step", 3, "--json", "-", *dense,
    )  # fmt: skip
    assert told.status == 0, told.err
    report = json.loads(told.out)
    assert report["system"] == "EPSG:32632" and "pixels between them" in report["warnings"][0]
    cloud = read_cloud(out / "cloud.csv")
    assert len(cloud) > 0.5 * LINES * SAMPLES / 9
    X = from_map(*cloud.X.T, around, "EPSG:32632")
    e = cloud.X[:, 2] - ground(X[:, 0], X[:, 1])
    w = e / cloud.sigma[:, 2]
    assert (np.abs(w) > 5).mean() < 0.02
    assert 0.55 < np.sqrt(np.mean(w[np.abs(w) < 5] ** 2)) < 1.3


def no_work(*_, **options):
    raise AssertionError("the images are matched")


def test_cells_that_are_far_too_small_are_refused_before_the_work(
    project, satellite, tmp_path, command, monkeypatch
):
    monkeypatch.setattr("jaxbundle.commands.surface.reconstruct_surface", no_work)
    monkeypatch.setattr("jaxbundle.commands.surface.align_all", no_work)
    photographs, images = project[0], satellite[0]
    for given in ((photographs, "--photos", photographs / "photos", "--zmin", -1.5, "--zmax", 3),
                  (images / "a.tif", images / "b.tif", "--zmin", 170, "--zmax", 230)):  # fmt: skip
        for size in (1e-5, 1e-320):
            told = command("surface", *given, "--out", tmp_path / "out", "--dsm", size)
            assert told.status == 2 and "too large; give larger cells" in told.err
    # 7 m below the cameras a photograph has 7 × 5.25 m, of which a base of 2 m is not in common
    with pytest.raises(InputError, match=r"a DSM of 4\d{5} × 4\d{5} cells of 1e-05"):
        jaxbundle.surface(photographs, photos=photographs / "photos", zmin=-1.5, zmax=3, dsm=1e-5)


def test_one_image_twice(satellite, tmp_path, command):
    folder, _ = satellite
    told = command("surface", folder / "a.tif", folder / "a.tif", "--out", tmp_path / "out")
    assert told.status == 2 and "its raster a.tif is also that of" in told.err


def test_a_satellite_surface_above_the_geoid(satellite, tmp_path, command):
    """The heights of the cloud are those of the scene minus N; --zmin and --zmax are above the
    geoid, too; the DSM says so, and is read back as the ellipsoidal one."""
    folder, around = satellite
    out, geoid = tmp_path / "out", write_geoid(tmp_path / "own.tif")
    told = command(
        "surface", folder / "a.tif", folder / "b.tif", "--out", out, "--zmin", 123, "--zmax", 183,
        "--pairs", "a.tif,b.tif", "--step", 3, "--dsm", 6, "--orthophoto", "--geoid", geoid,
        "--json", "-",
    )  # fmt: skip
    assert told.status == 0, told.err
    report = json.loads(told.out)
    assert report["heights"] == f"above the geoid {geoid}"
    assert f"heights above the geoid {geoid}" in (out / "report.txt").read_text()
    with rasterio.open(out / "dsm.tif") as raster:
        system = split_system(raster.crs.to_wkt())
        x, y = np.meshgrid(*(np.arange(n) + 0.5 for n in raster.shape[::-1]))
        x, y = raster.bounds.left + 6 * x, raster.bounds.top - 6 * y
        H = raster.read(1, masked=True)
    assert system.horizontal == "EPSG:32632" and "geoid own.tif" in system.vertical.name
    for name in ("dsm_sigma.tif", "orthophoto.tif"):
        with rasterio.open(out / name) as raster:
            assert raster.crs.to_epsg() == 32632
            if name == "orthophoto.tif":
                assert (raster.read(1)[~H.mask] > 0).mean() > 0.9
    back = pyproj.Transformer.from_crs("EPSG:32632", "EPSG:4326", always_xy=True)
    longitude, latitude = back.transform(x, y)
    X = np.asarray(around.local(np.radians(longitude), np.radians(latitude), 0.0 * x))
    error = (H + undulation(longitude, latitude) - ground(X[0], X[1])).compressed()
    assert np.abs(np.median(error)) < 0.05 and np.percentile(np.abs(error), 90) < 0.5
    with pytest.raises(InputError, match="'height above the geoid own.tif', not above the ellips"):
        read_terrain(out / "dsm.tif", WGS84)
    terrain = add_geoid(read_terrain(out / "dsm.tif", WGS84, above_geoid=True), geoid)
    assert abs(np.nanmean(terrain.heights) - (H + undulation(longitude, latitude)).mean()) < 0.2


@pytest.fixture(scope="module")
def three(tmp_path_factory):
    """Three RPC images, looking ahead, down and back along the track and a little aside."""
    folder = tmp_path_factory.mktemp("three")
    around = neighbourhood(np.radians(10.0), np.radians(45.0))
    scene = Scene((HeightField(ground, (-600, -600, 600, 600)),), (Texture(1.0, 2, 512),))
    blank = np.zeros((LINES, SAMPLES), np.float32)
    for k, by_height in enumerate((0.0, 0.6, -0.6)):
        view = RpcView("", blank, coefficients(by_height), around)
        v, u = np.indices((LINES + 1, SAMPLES + 1)).reshape(2, -1)
        uv = np.stack([u, v], 1).astype(float)
        top, bottom = (view.points(uv, np.full(len(uv), h)) for h in (400.0, 0.0))
        d = (bottom - top) / np.linalg.norm(bottom - top, axis=1, keepdims=True)
        o, d = (a.reshape(LINES + 1, SAMPLES + 1, 3) for a in (top, d))
        shot = render_rays(scene, o, d, Sensor(noise=1.5, seed=k))
        cv2.imwrite(str(folder / f"{k}.tif"), shot.grey.astype(np.uint16) * 9 + 100)
        write_rpc(folder / f"{k}_RPC.TXT", coefficients(by_height))
    return folder, around


@pytest.mark.further
def test_three_images_give_one_point_a_pixel_by_all_rays(three, tmp_path, command):
    """The rays of both pairs are intersected together: σ is smaller than that of a pair, and true.
    No base has more points than pixels."""
    folder, around = three
    files = [folder / f"{k}.tif" for k in range(3)]
    found = {}
    for name, pairs in (("pair", "0.tif,1.tif"), ("three", "0.tif,1.tif,2.tif")):
        told = command(
            "surface", *files, "--out", tmp_path / name, "--zmin", 170, "--zmax", 230, "--dense",
            "--pairs", pairs, "--json", "-",
        )  # fmt: skip
        assert told.status == 0, told.err
        (base,) = json.loads(told.out)["images"]
        found[name] = cloud = read_cloud(tmp_path / name / "cloud.csv")
        assert base["points"] == LINES * SAMPLES and base["matched"] == len(cloud)
        assert list(base["rejected"].values()) == [LINES * SAMPLES - len(cloud)]
        assert len(np.unique(cloud.uv, axis=0)) == len(cloud) > 0.5 * LINES * SAMPLES
        X = from_map(*cloud.X.T, around, "EPSG:32632")
        w = (cloud.X[:, 2] - ground(X[:, 0], X[:, 1])) / cloud.sigma[:, 2]
        assert (np.abs(w) > 5).mean() < 0.02
        assert 0.7 < np.sqrt(np.mean(w[np.abs(w) < 5] ** 2)) < 1.3
    assert set(found["pair"].rays) == {2} and set(found["three"].rays) == {2, 3}
    seen = found["three"].rays == 3
    assert seen.sum() > 0.8 * LINES * SAMPLES
    # one looks ahead, one back: twice the base, and the noise of the middle image cancels
    sigma = [np.median(found["pair"].sigma[:, 2]), np.median(found["three"].sigma[seen, 2])]
    assert 0.45 < sigma[1] / sigma[0] < 0.6


def test_map_coordinates_go_both_ways(satellite):
    _, around = satellite
    X = np.array([[100.0, -50, 200], [0, 0, 0]])
    x, y = map_coordinates(X, around, "EPSG:32632")
    np.testing.assert_allclose(from_map(x, y, X[:, 2], around, "EPSG:32632"), X, atol=1e-6)
    assert 0.999 < np.hypot(x[0] - x[1], y[0] - y[1]) / np.hypot(100, 50) < 1.001
