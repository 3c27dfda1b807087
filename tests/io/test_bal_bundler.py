"""BAL and Bundler: round trips, the formula of the formats, and broken files."""

import gzip

import numpy as np
import pytest
from exchange_cases import assert_same, network
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from jaxbundle.errors import InputError
from jaxbundle.io.networks.bal import read_bal, write_bal
from jaxbundle.io.networks.bundler import is_bundler, read_bundler, write_bundler

NUMBERED = ("0", "1", "2")


def case(names=NUMBERED):
    return network("snavely", names, 0)


def shared(net):
    """The network with a camera for every image, called like it, as both formats have it."""
    cameras = tuple(type(net.cameras[0])(i, "snavely", net.cameras[0].parameters)
                    for i in net.images.id)  # fmt: skip
    images = net.images
    images = type(images)(images.id, np.arange(len(images)), images.position, images.angles,
                          images.sigma)  # fmt: skip
    return net.replace(cameras=cameras, images=images)


@pytest.mark.parametrize("name", ["p.txt", "p.txt.gz", "p.txt.bz2"])
def test_bal_round_trip(tmp_path, name):
    lost = write_bal(case(), tmp_path / name)
    assert lost == ("that images share a camera (2)",)
    assert_same(shared(case()), read_bal(tmp_path / name))


def test_bal_has_the_published_formula(tmp_path):
    write_bal(case(), tmp_path / "p.gz")
    numbers = gzip.decompress((tmp_path / "p.gz").read_bytes()).split()
    n, p, m = map(int, numbers[:3])
    rest = np.array(numbers[3:], float)
    rows, cameras, points = np.split(rest, [4 * m, 4 * m + 9 * n])
    cameras, points = cameras.reshape(n, 9), points.reshape(p, 3)
    for i, k, x, y in rows.reshape(m, 4):
        r, t, (f, k1, k2) = np.split(cameras[int(i)], [3, 6])
        P = Rotation.from_rotvec(r).apply(points[int(k)]) + t
        q = -P[:2] / P[2]
        assert_allclose(f * (1 + k1 * q @ q + k2 * (q @ q) ** 2) * q, (x, y), atol=1e-9)


@pytest.mark.parametrize("names", [NUMBERED, ("a.jpg", "b.jpg", "c.jpg")])
def test_bundler_round_trip(tmp_path, names):
    path = tmp_path / "bundle.out"
    assert write_bundler(case(names), path) == ("that images share a camera (2)",)
    assert is_bundler(path) and (tmp_path / "list.txt").exists() == (names != NUMBERED)
    after = read_bundler(path)
    assert_same(shared(case(names)), after)
    assert after.cameras[0].free == ("f", "k1", "k2") and not after.warnings


def test_other_models_are_refused_and_nothing_is_written(tmp_path):
    for write in (write_bal, write_bundler):
        with pytest.raises(InputError, match="no model 'opencv'.*--model snavely"):
            write(network("opencv"), tmp_path / "x")
    net = case()
    images = type(net.images)(net.images.id, net.images.camera, net.images.position * np.nan,
                              net.images.angles, net.images.sigma)  # fmt: skip
    with pytest.raises(InputError, match="images, row 1: image '0' has no orientation"):
        write_bal(net.replace(images=images), tmp_path / "x")
    assert not list(tmp_path.iterdir())


BUNDLE = """\
# Bundle file v0.3
2 1
800 -0.1 0.01
1 0 0
0 1 0
0 0 1
0 0 -5
0 0 0
0 0 0
0 0 0
0 0 0
0 0 0
0.5 0.25 0
9 9 9
2 0 17 80 40 1 3 1 1
"""


def test_bundler_leaves_out_what_is_not_oriented(tmp_path):
    path = tmp_path / "bundle.out"
    path.write_text(BUNDLE)
    net = read_bundler(path)
    assert net.images.id == ("0",) and len(net.observations) == 1
    assert_allclose(net.images.position, [[0, 0, 5]])
    assert "left out 1 image that have no orientation: '1'" in net.warnings[0]


BROKEN = {
    "version": ("v0.3", "v0.4", "line 1: expected '# Bundle file v0.3'"),
    "count": ("2 1\n", "2.5 1\n", "line 2: cameras is '2.5'"),
    "many points": ("2 1\n", "2 999999999999999999\n", "line 15; expected coordinates of po"),
    "negative": ("2 1\n", "2 -1\n", "points is '-1'"),
    "too many lines": ("2 1\n", "2 0\n", "line 13: a line after the last of 0 points"),
    "not a rotation": ("1 0 0\n0 1", "1 0 0\n0 2", "line 3: R of camera 0 of 2 is not a rotation"),
    "mirror": ("0 0 1\n", "0 0 -1\n", "not a rotation"),
    "text": ("800", "8oo", "line 3: f is '8oo'"),
    "NaN": ("0 0 -5", "0 0 nan", "line 7: t is 'nan'"),
    "camera": ("2 0 17", "2 7 17", "line 15: camera 7 does not exist; there are 2"),
    "rays": ("2 0 17", "3 0 17", "3 rays are announced; 12 numbers should follow, not 8"),
    "huge rays": ("2 0 17", "999999999999999999 0 17", "announced"),
    "cut": ("9 9 9\n2 0 17 80 40 1 3 1 1\n", "9 9 9", "line 14; expected rays of point 0"),
    "colour": ("9 9 9", "9 9", "line 14: 2 values where 3 are expected .red, green, blue"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_bundler_files(tmp_path, name):
    old, new, message = BROKEN[name]
    assert old in BUNDLE
    path = tmp_path / "bundle.out"
    path.write_text(BUNDLE.replace(old, new, 1))
    with pytest.raises(InputError, match=message):
        read_bundler(path)


def test_no_camera_is_oriented(tmp_path):
    path = tmp_path / "bundle.out"
    path.write_text("# Bundle file v0.3\n0 0\n")
    with pytest.raises(InputError, match="no camera is oriented"):
        read_bundler(path)


@pytest.mark.parametrize("read", [read_bal, read_bundler])
def test_angles_are_shown_in_the_unit_asked_for_and_stay(tmp_path, read):
    path = tmp_path / "p.out"
    (write_bal if read is read_bal else write_bundler)(case(), path)
    plain, gon = read(path), read(path, ["angle_unit=gon"])
    assert gon.angle_unit == "gon"
    assert_allclose(gon.images.angles, plain.images.angles)
