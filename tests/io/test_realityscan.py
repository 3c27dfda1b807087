"""Cameras of RealityScan: XMP files and the table of camera parameters, in both directions."""

import dataclasses

import numpy as np
import pytest
from exchange_cases import ANGLES, POINTS, POSITION, matrix
from numpy.testing import assert_allclose
from PIL import Image
from scipy.spatial.transform import Rotation

from jaxbundle.cameras import get_model
from jaxbundle.cameras.convert_fit import images_of
from jaxbundle.errors import InputError
from jaxbundle.io import read_network
from jaxbundle.io.formats import recognise_format
from jaxbundle.io.networks.assemble import all_parameters
from jaxbundle.io.networks.realityscan import (
    _heading_of,
    _rotation_from_heading,
    write_realityscan_csv,
)
from jaxbundle.io.output_formats import TARGETS, recognise_target

F, U, V, K = 24.4, -4.6e-4, -8.2e-4, (-0.12, 0.107, -0.0105, 0.0, 0.0, 0.0)
SIZE = (1280, 720)


def pixels(R, X0, k=K):
    """The published camera: R by rows, Position, and Brown's polynomial, from the corner."""
    x, y, z = ((POINTS - X0) @ R.T).T
    x, y = x / z, y / z
    r2 = x * x + y * y
    radial = 1 + k[0] * r2 + k[1] * r2**2 + k[2] * r2**3 + k[3] * r2**4
    xd = x * radial + 2 * k[4] * x * y + k[5] * (r2 + 2 * x * x)
    yd = y * radial + 2 * k[5] * x * y + k[4] * (r2 + 2 * y * y)
    side = max(SIZE)
    return np.stack([F / 36 * side * xd + U * side + SIZE[0] / 2,
                     F / 36 * side * yd + V * side + SIZE[1] / 2], 1)  # fmt: skip


def poses():
    """R, x right, y down, z forward, and X0 of the images of `exchange_cases`."""
    return [(np.diag([1, -1, -1]) @ matrix(a), X0) for a, X0 in zip(ANGLES, POSITION)]


def xmp(R, X0, k=K, more="", model="brown3"):
    numbers = lambda values: " ".join(map(repr, np.ravel(values).tolist()))
    return f"""<x:xmpmeta xmlns:x="adobe:ns:meta/">
 <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
  <rdf:Description xcr:Version="3" xcr:PosePrior="locked" xcr:Coordinates="absolute"
   xcr:DistortionModel="{model}" xcr:FocalLength35mm="{F}" xcr:Skew="0" xcr:AspectRatio="1"
   xcr:PrincipalPointU="{U}" xcr:PrincipalPointV="{V}" {more}
   xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#">
   <xcr:Rotation>{numbers(R)}</xcr:Rotation>
   <xcr:Position>{numbers(X0)}</xcr:Position>
   <xcr:DistortionCoeficients>{numbers(k)}</xcr:DistortionCoeficients>
  </rdf:Description></rdf:RDF></x:xmpmeta>"""


def folder(tmp_path, **options):
    for name, (R, X0) in zip("abc", poses()):
        (tmp_path / f"{name}.xmp").write_text(xmp(R, X0, **options))
    return tmp_path


def check(net, k=K):
    (camera,) = net.cameras
    assert_allclose(net.images.position, POSITION, atol=1e-9)
    for mine, given, (R, X0) in zip(net.images.angles, ANGLES, poses()):
        assert_allclose(matrix(mine), matrix(given), atol=1e-9)
        rays = (POINTS - X0) @ matrix(mine).T
        theirs = pixels(R, X0, k) - 0.5
        mine = images_of(get_model(camera.model), all_parameters(camera), rays)
        assert_allclose(mine, theirs, atol=1e-6)


def test_a_folder(tmp_path):
    assert recognise_format(folder(tmp_path)) == "realityscan"
    (tmp_path / "other.xmp").write_text("<x:xmpmeta xmlns:x='adobe:ns:meta/'/>")
    net = read_network(tmp_path, image_size=SIZE)
    assert net.images.id == ("a", "b", "c") and net.cameras[0].image_size == SIZE
    check(net)


@pytest.mark.parametrize("suffix", [".png", ".JPG"])
def test_the_size_is_that_of_the_photograph(tmp_path, suffix):
    for name in "abc":
        Image.new("L", SIZE).save(tmp_path / f"{name}{suffix}")
    net = read_network(folder(tmp_path))
    assert net.images.id == (f"a{suffix}", f"b{suffix}", f"c{suffix}")
    check(net)


def test_tangential_distortion_and_r8(tmp_path):
    k = (*K[:3], 0.0, 1e-3, -5e-4)
    net = read_network(folder(tmp_path, k=k, model="brown3t2"), image_size=SIZE)
    check(net, k)
    assert any("p1 and p2 of OpenCV" in told for told in net.warnings)
    net = read_network(folder(tmp_path, k=(*K[:3], 0.02, 0, 0), model="brown4"), image_size=SIZE)
    assert any("k4" in told and "px" in told for told in net.warnings)


def table(tmp_path, header="#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"):
    """Rotations by scipy: intrinsic z, x, y as nerfstudio and brush read them."""
    rows = [header]
    for name, (R, X0) in zip("abc", poses()):
        to_object = (np.diag([1, -1, -1]) @ R).T
        z, x, y = Rotation.from_matrix(to_object).as_euler("ZXY", degrees=True)
        rows.append(",".join(map(str, (f"{name}.jpg", *X0, -z, x, y, F, U, V, *K))))
    path = tmp_path / "cameras.csv"
    path.write_text("\n".join(rows) + "\n")
    return path


@pytest.mark.parametrize("head", ["", "#cameras 3\n"])
def test_a_table(tmp_path, head):
    path = table(tmp_path)
    path.write_text(head + path.read_text())
    assert recognise_format(path) == "realityscan"
    net = read_network(path, image_size=SIZE)
    assert net.images.id == ("a.jpg", "b.jpg", "c.jpg")
    check(net)


# Degrees, also so near 90 that the cosine has few digits.
PITCHES = (90, -90, 90 - 5e-5, 90 - 1e-9, 89.99, 0)


def test_headings_of_any_rotation():
    random = Rotation.random(200, random_state=3).as_matrix()
    down = [_rotation_from_heading(0.4, np.radians(p), 0.3) for p in PITCHES]
    for R in (*random, *down):
        found = _rotation_from_heading(*np.radians(_heading_of(R)))
        assert_allclose(found, R, atol=1e-14)
    # north-up and vertical: all angles are 0, the camera looks down
    assert_allclose(_rotation_from_heading(0, 0, 0), np.eye(3))


@pytest.mark.parametrize("name", ["realityscan", "realityscan.csv"])
def test_both_directions(tmp_path, name):
    (tmp_path / "in").mkdir()
    out = tmp_path / "out" / name
    out.parent.mkdir()
    assert recognise_target(out) == ("realityscan-csv" if name.endswith("csv") else "realityscan")
    net = read_network(folder(tmp_path / "in"), image_size=SIZE)
    net = net.replace(images=dataclasses.replace(net.images, id=("a, 1.jpg", "b.jpg", 'c".jpg')))
    if not out.suffix:
        out.mkdir()
    TARGETS[recognise_target(out)].write(net, out)
    back = read_network(out, image_size=SIZE)
    assert sorted(back.images.id) == sorted(net.images.id)
    check(back)


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        ('Skew="0"', 'Skew="0.1"', "Skew and AspectRatio"),
        ('"brown3"', '"division"', "distortion model division is not read"),
        ("FocalLength35mm", "FocalLength", "unknown key 'FocalLength'"),
        ("xcr:PosePrior=", "xcr:LensTwist=", "may change the geometry"),
        (f'"{F}"', '"-3"', "above 0"),
        (f'"{F}"', '"x"', "a finite number"),
        ("<xcr:Rotation>", "<xcr:Rotation>1 ", "has 10 numbers; expected 9"),
        ("</x:xmpmeta>", "", "not valid XML"),
    ],
)
def test_what_is_wrong_in_an_xmp_is_named(tmp_path, old, new, why):
    folder(tmp_path)
    path = tmp_path / "b.xmp"
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(InputError, match=why):
        read_network(tmp_path, image_size=SIZE)


def test_what_is_wrong_in_a_table_is_named(tmp_path):
    path = table(tmp_path)
    with pytest.raises(InputError, match=r"line 2: the size .* missing; expected a.jpg beside it"):
        read_network(path)
    path.write_text(path.read_text().replace("heading", "bearing"))
    with pytest.raises(InputError, match="not recognised"):
        read_network(path)
    path = table(tmp_path)
    path.write_text(path.read_text().replace(",t2", ",scale"))
    with pytest.raises(InputError, match="unknown key 'scale'.*geometry"):
        read_network(path, image_size=SIZE)


def test_two_focal_lengths_are_refused(tmp_path):
    net = read_network(folder(tmp_path), image_size=SIZE)
    camera = net.cameras[0].__class__("c", "opencv", {"fx": 900.0, "fy": 905.0}, image_size=SIZE)
    near = dataclasses.replace(camera, parameters={"fx": 900.0, "fy": 900.5})
    said = write_realityscan_csv(net.replace(cameras=(near,)), tmp_path / "realityscan.csv")
    # f = √(900·900.5) changes 640 px by 0.18 px
    assert "the difference of fx and fy (largest change in an image 0.18 px)" in said
    with pytest.raises(InputError, match=r"one focal length.* 1.8 px at the edge"):
        write_realityscan_csv(net.replace(cameras=(camera,)), tmp_path / "realityscan.csv")
