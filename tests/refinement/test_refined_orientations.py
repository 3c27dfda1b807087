"""The covariance of refined images, carried to points, surfaces and changes of surfaces."""

import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest
import rasterio
from pyproj import Transformer
from rpc_block import block, scanner_image
from test_refine_rpc_files import TEXT, write_files
from typer.testing import CliRunner

import jaxbundle
from jaxbundle.cli.app import app
from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import WGS84, geodetic
from jaxbundle.io.networks.orientation_covariance import OrientationCovariance
from jaxbundle.io.scanner.refined_orientations import joint_covariance, read_refined_orientations
from jaxbundle.pushbroom.rpc.bias import RpcBias, domain_of_bias, project_compensated
from jaxbundle.refinement import Freedom, refine
from jaxbundle.refinement.freedom import change_of, make_form, names
from jaxbundle.refinement.refined_image import refined_image
from jaxbundle.surfaces.ground_orientation import rpc_orientation, scanner_orientation
from jaxbundle.surfaces.intersection import intersect
from jaxbundle.surfaces.orientation import orientation_covariance
from jaxbundle.surfaces.scanner_inputs import read_refined_views
from jaxbundle.surfaces.scanner_views import RpcView, ScannerView, neighbourhood


def grey(image):
    return np.broadcast_to(np.uint8(0), (image.lines, image.pixels))


@pytest.fixture(scope="module")
def scene():
    return block(rpc=3, scanner=0, points=40, control=10, checks=8, degree=1, rays=3)


@pytest.fixture(scope="module")
def refined(scene):
    return refine(*scene.draw(np.random.default_rng(4))[0])


def place_of(scene):
    longitude, latitude, _ = geodetic(WGS84, tuple(scene.X.mean(0)))
    return neighbourhood(float(longitude), float(latitude))


@pytest.fixture(scope="module")
def around(scene):
    return place_of(scene)


def local(scene, around):
    return np.asarray(around.local(*geodetic(WGS84, tuple(scene.X.T)))).T


@pytest.mark.further
def test_a_bias_moves_projections_as_its_derivative_says(scene, refined, around):
    joint, image = joint_covariance(refined), refined.image("R1")
    view = RpcView("R1", grey(image), image.rpc, around)
    given = scene.images[1].image.rpc
    view.orientation = rpc_orientation(joint, "R1", domain_of_bias(given))
    X = local(scene, around)[:5]
    B = view.derivative_by_orientation(X)
    assert B.shape == (5, 2, 6)
    assert [u[2] for u in view.unknowns][:2] == ["line shift", "line bias l̂"]
    place = [np.asarray(v) for v in around.geographic(X.T)]
    for k in range(6):
        bias = np.zeros(6)
        bias[k] = 0.5
        moved, at = (
            np.stack(project_compensated(given, RpcBias(*b.reshape(2, 3)), *place)[::-1], 1)
            for b in (bias, 0 * bias)
        )
        # (l̂, ŝ) without the estimated bias, of some pixels of 2000, there and with it here
        np.testing.assert_allclose(B[:, :, k], (moved - at) / 0.5, atol=0.01)


@pytest.mark.further
def test_corrections_of_a_scanner_move_projections_as_their_derivative_says():
    """Of every kind of unknown, against the image that is written for them."""
    scene = block(rpc=1, scanner=1, points=8, control=4, checks=0, rays=1)
    one, around = scene.images[-1], place_of(scene)
    freedom = Freedom(attitude=(1.0,) * 3, attitude_rate=(1.0,) * 3, jitter=(1.0,) * 3,
                      knot_spacing=1.0, position=(1.0,) * 3, focal_length=1.0,
                      mounting=(1.0,) * 3, look_across=(1.0, 1.0), look_along=(1.0,))  # fmt: skip
    form = make_form(one.image, WGS84, freedom)
    every = [(*name.owner.split(" "), name.parameter) for name in names(form.sizes, "S0", "cam")]
    joint = OrientationCovariance(tuple(every), np.eye(len(every)))
    view = ScannerView("S0", grey(one.image), one.image, WGS84, around)
    view.orientation = scanner_orientation(joint, "S0", "cam", one.image, WGS84, 1.0)
    assert list(view.unknowns) == every
    X = local(scene, around)[:4]
    B, at = view.derivative_by_orientation(X), view.project(X)
    for k in range(len(every)):
        p = np.zeros(len(every))
        # about a pixel of 20 m from 505 km
        p[k] = 10.0 if "position" in every[k][2] else 2.0 if "velocity" in every[k][2] else 2e-5
        image = refined_image(one.image, form, change_of(form.sizes, jnp.asarray(p)))
        moved = ScannerView("S0", grey(one.image), image, WGS84, around).project(X)
        expected = (moved - at) / p[k]
        size = max(np.abs(expected).max(), 1e-3 / abs(p[k]))
        np.testing.assert_allclose(B[:, :, k], expected, atol=0.01 * size, err_msg=str(every[k]))


@pytest.mark.further
def test_the_covariance_of_points_is_that_of_check_points(scene, refined, around):
    """Measurement and orientation together: what the adjustment says of check points."""
    joint, views = joint_covariance(refined), []
    for id in ("R0", "R1", "R2"):
        image = refined.image(id)
        views.append(RpcView(id, grey(image), image.rpc, around))
        domain = domain_of_bias(refined.inputs.rpc[len(views) - 1].image.rpc)
        views[-1].orientation = rpc_orientation(joint, id, domain)
    X, check = local(scene, around), refined.check
    at = {f"P{k}": k for k in range(len(X))}
    seen = scene.seen[:, [at[id] for id in check.id]]
    # those of images with RPC alone, whose measurements have one σ: their weights are equal
    chosen = np.flatnonzero(~seen[3:].any(0) & (seen[:3].sum(0) > 1))
    assert len(chosen) > 0
    X, used = X[[at[check.id[k]] for k in chosen]], seen[:3, chosen].T
    sigma = refined.inputs.observations.sigma[0, 0]
    noise = np.broadcast_to(sigma**2 * np.eye(2), (*used.shape, 2, 2))
    uv = np.nan_to_num(np.stack([view.project(X) for view in views], 1))
    C = refined.sigma0**2 * intersect(views, uv, noise, used, X).covariance
    C = C + orientation_covariance(views, X, used)
    found = np.sqrt(np.diagonal(C, axis1=1, axis2=2))
    # coordinates of the images are a plane about the origin, those of the block along its axes
    np.testing.assert_allclose(found, check.sigma[chosen], rtol=3e-3)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A refinement of three images with RPC in files, and its results."""
    folder = tmp_path_factory.mktemp("refined")
    scene = block(rpc=3, scanner=0, points=24, control=6, checks=0, degree=1, rays=3)
    write_files(folder, scene)
    assert (folder / "refine.toml").read_text() == TEXT
    done = CliRunner().invoke(
        app, ["pushbroom", "refine", str(folder / "refine.toml"), "--out", str(folder / "out")]
    )
    assert done.exit_code == 0, done.output
    return folder


def surface(path, folder, height, sigma):
    """A level surface of 4 km in the middle of the scene."""
    around = read_refined_views(folder / "out")[1]
    longitude, latitude = (np.degrees(float(v)) for v in (around.longitude, around.latitude))
    zone = 32601 + int((longitude + 180) // 6)
    x, y = Transformer.from_crs("EPSG:4326", f"EPSG:{zone}", always_xy=True).transform(
        longitude, latitude
    )
    x, y = (100 * np.round(v / 100) for v in (x, y))
    for name, value in ((path, height), (path.with_name(f"{path.stem}_sigma.tif"), sigma)):
        with rasterio.open(name, "w", driver="GTiff", width=40, height=40, count=1,
                           dtype="float32", crs=f"EPSG:{zone}", nodata=-9999,
                           transform=rasterio.Affine(100, 0, x - 2000, 0, -100, y + 2000)
                           ) as to:  # fmt: skip
            to.write(np.full((1, 40, 40), value, "float32"))
    return path


@pytest.mark.further
def test_a_change_has_the_covariance_of_the_refinement(folder, tmp_path):
    before = surface(tmp_path / "before.tif", folder, 400.0, 0.1)
    after = surface(tmp_path / "after.tif", folder, 400.0, 0.1)
    out = folder / "out"
    found = jaxbundle.change(before, after, before_orientation=out)
    views, around = read_refined_views(out)
    # a level cell, in the coordinates of the images
    zone = rasterio.open(before)
    back = Transformer.from_crs(zone.crs, "EPSG:4326", always_xy=True)
    place = back.transform(*zone.xy(20, 20))
    X = np.asarray(around.local(*np.radians(place), 400.0))[None]
    used = np.ones((1, len(views)), bool)
    up = orientation_covariance(views, X, used)[0, 2, 2]
    assert up > 0.01
    assert found.change.sigma[20, 20] ** 2 == pytest.approx(0.02 + up, rel=1e-3)
    assert found.change.modes == 18
    both = jaxbundle.change(before, after, before_orientation=out, after_orientation=out)
    assert both.change.sigma[20, 20] ** 2 == pytest.approx(0.02 + 2 * up, rel=1e-3)
    # of one adjustment and the same images the errors are the same, and cancel
    same = {"before_orientation": out, "after_orientation": out, "same_adjustment": True}
    assert jaxbundle.change(before, after, **same).change.sigma[20, 20] == pytest.approx(
        np.sqrt(0.02), rel=1e-6
    )
    two = jaxbundle.change(before, after, before_orientation=out, before_images="A, B")
    assert two.change.modes == 12 and two.change.sigma[20, 20] > found.change.sigma[20, 20]
    with pytest.raises(InputError, match="A names 1 of its images"):
        jaxbundle.change(before, after, before_orientation=out, before_images="A")


@pytest.mark.further
def test_what_makes_sigma_doubtful_is_said(folder, tmp_path):
    """Cells that fewer than two images see, and σ that may have the errors already."""
    before = surface(tmp_path / "before.tif", folder, 400.0, 0.1)
    after = surface(tmp_path / "after.tif", folder, 400.0, 0.1)
    out = folder / "out"
    found = jaxbundle.change(before, after, before_orientation=out)
    (told,) = found.warnings
    assert "before_sigma.tif: has no σ of its own" in told and "count twice" in told
    assert found.to_dict()["warnings"] == [told] and f"warning: {told}" in str(found)
    assert not jaxbundle.change(before, after, after_errors={"vertical": 0.1}).warnings
    # the right half of the surface is moved out of the images, 12 km wide
    with rasterio.open(before) as source:
        profile, (height,) = source.profile, source.read()
    wide = np.tile(height, (1, 10))
    for stem, value in (("before", wide), ("before_sigma", 0.1 + 0 * wide),
                        ("after", wide), ("after_sigma", 0.1 + 0 * wide)):  # fmt: skip
        with rasterio.open(tmp_path / f"wide_{stem}.tif", "w",
                           **{**profile, "width": wide.shape[1]}) as to:  # fmt: skip
            to.write(value[None].astype("float32"))
    found = jaxbundle.change(
        tmp_path / "wide_before.tif", tmp_path / "wide_after.tif", before_orientation=out
    )
    (share,) = [w for w in found.warnings if "fewer than two of its images" in w]
    number = float(share.split(": ")[1].split(" %")[0])
    # cells with the errors of the orientations have a larger σ: counted cell by cell
    plain = np.isclose(found.change.sigma, found.change.sigma.min(), rtol=1e-9)
    assert number == pytest.approx(100 * plain.mean(), abs=1.0) and 20 < number < 90


@pytest.mark.further
def test_an_edited_covariance_is_refused(folder, tmp_path):
    copy = tmp_path / "copy"
    copy.mkdir()
    for path in (folder / "out").iterdir():
        if path.is_file():
            (copy / path.name).write_bytes(path.read_bytes())
    text = (copy / "precision.csv").read_text()
    lines = text.splitlines()
    first = lines[1].split(",")
    for edited, words in (
        (text.replace("line shift", "line shaft", 1), "precision.csv: image A has no unknown"),
        (text.replace(",".join(lines[2].split(",")[:3]), ",".join(first[:3]), 1), "listed twice"),
        (text.replace(first[3], "wide", 1), "σ above 0"),
        (text.replace("image,A", "picture,A", 1), "which refined.csv does not list"),
    ):
        (copy / "precision.csv").write_text(edited)
        with pytest.raises(InputError, match=words):
            read_refined_views(copy)
    # correlations of no errors: 1 between two that a third is correlated with in opposite ways
    cells = [line.split(",") for line in lines]
    cells[2][4], cells[3][4], cells[3][5] = "0.99", "0.99", "-0.99"
    (copy / "precision.csv").write_text("\n".join(map(",".join, cells)))
    with pytest.raises(InputError, match="not those of any errors"):
        read_refined_views(copy)


def test_an_unknown_of_a_scanner_without_exponent_is_refused():
    unknown = ("sensor", "cam", "look angle across û^two")
    joint = OrientationCovariance((unknown,), np.eye(1))
    with pytest.raises(InputError, match=r"sensor cam has no unknown 'look angle across û\^two'"):
        scanner_orientation(joint, "S0", "cam", scanner_image(0.0, 0.1), WGS84, 1.0)


@pytest.mark.further
def test_the_files_of_a_refinement_are_checked(folder, tmp_path):
    out = folder / "out"
    block_ = read_refined_orientations(out)
    told = json.loads((out / "result.json").read_text())
    assert [one.id for one in block_.images] == ["A", "B", "C"]
    assert block_.images[0].raster.samefile(folder / "a.tif") and block_.images[1].raster is None
    sigma = np.sqrt(np.diagonal(block_.covariance.matrix))
    np.testing.assert_allclose(sigma, [row["sigma"] for row in told["unknowns"]], rtol=1e-9)
    copy = tmp_path / "copy"
    copy.mkdir()
    assert read_refined_orientations(copy) is None
    for name in ("refined.csv", "precision.csv", "A_RPC.TXT", "B_RPC.TXT"):
        (copy / name).write_bytes((out / name).read_bytes())
    with pytest.raises(InputError, match="refined.csv.*no such file.*C_RPC.TXT"):
        read_refined_orientations(copy)
    lines = (copy / "refined.csv").read_text().splitlines()
    (copy / "refined.csv").write_text("\n".join(lines[:3]) + "\n")
    with pytest.raises(InputError, match="unknowns of image C, which refined.csv does not list"):
        read_refined_orientations(copy)


@pytest.mark.further
def test_a_folder_of_refined_images_is_an_input_of_surface(folder, tmp_path):
    """All of its images; their pixels where they were, or in --photos."""
    from jaxbundle.surfaces.scanner_inputs import is_ground_image, read_ground_views

    out = folder / "out"
    assert is_ground_image(out)
    with pytest.raises(InputError, match="no raster B_RPC.tif beside it; --photos"):
        read_ground_views([out], None)
    views, _ = read_ground_views([out / "A_RPC.TXT"], None)
    assert views[0].name == "a.tif" and len(views[0].unknowns) == 6
    assert dataclasses.is_dataclass(views[0].orientation)
