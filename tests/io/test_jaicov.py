"""AICON's projects as JAiCov reads them: its formula for one point, by hand, there and back."""

import numpy as np
import pytest
from exchange_cases import ANGLES, POINTS, POSITION, assert_same, matrix
from numpy.testing import assert_allclose

from jaxbundle.errors import InputError
from jaxbundle.io import convert, read_network
from jaxbundle.io.networks.jaicov import write_jaicov

C, X0, Y0, R0 = 28.8, 0.02, -0.03, 9.0
A, B, AFFINE = (-1e-4, 2e-7, -1e-10), (1e-5, -2e-5), (1e-4, 3e-5)


def published(angles, position, X):
    """JAiCov's image point: the distortion at the projected point, balanced at r0."""
    (so, co), (sp, cp), (sk, ck) = ((np.sin(a), np.cos(a)) for a in angles)
    R = np.array([[cp * ck, -cp * sk, sp],
                  [co * sk + so * sp * ck, co * ck - so * sp * sk, -so * cp],
                  [so * sk - co * sp * ck, so * ck + co * sp * sk, co * cp]])  # fmt: skip
    kx, ky, N = R.T @ (X - position)
    xs, ys = -C * kx / N, -C * ky / N
    r = np.hypot(xs, ys)
    radial = sum(a * (r ** (2 * i) - R0 ** (2 * i)) for i, a in enumerate(A, 1))
    dx = xs * radial + B[0] * (r * r + 2 * xs * xs) + 2 * B[1] * xs * ys
    dy = ys * radial + B[1] * (r * r + 2 * ys * ys) + 2 * B[0] * xs * ys
    return X0 + xs + dx + AFFINE[0] * xs + AFFINE[1] * ys, Y0 + ys + dy


def files() -> dict[str, str]:
    phc = "# image points\n"
    for i in range(3):
        for k, X in enumerate(POINTS):
            x, y = published(ANGLES[i], POSITION[i], X)
            phc += f"{i + 1} {k + 100} {float(x)!r} {float(y)!r} 0.0005 0.0006 0 0 2 1 0\n"
    phc += "1 100 9.9 9.9 0.1 0.1 0 0 2 0 0\n1 999 9.9 9.9 0.1 0.1 0 0 2 1 0\n"
    row = lambda values: " ".join(repr(float(v)) for v in values)
    ior = f"""1 0 {-C} {X0} {Y0} {A[0]} {A[1]} {R0}
{A[2]}
{row(B)}
{row(AFFINE)}
24.0 16.0 4000 2500
"""
    eor = "".join(f"{i + 1} 1 {row(POSITION[i])} {row(ANGLES[i])} 0 1 3\n" for i in range(3))
    obc = "".join(f"{k + 100} {row(X)} 0 0 0 3 1 1 {int(k < 5)}\n" for k, X in enumerate(POINTS))
    scale = '0 "bar"  100 101 1.25 0.01 1\n1 "off" 100 102 1.25 0.01 0\n'
    return {".phc": phc, ".ior": ior, ".eor": eor, ".obc": obc, ".scale": scale}


def write(folder, **changed):
    for suffix, text in (files() | {f".{k}": v for k, v in changed.items()}).items():
        if text is not None:
            (folder / f"project{suffix}").write_text(text)
    return folder / "project.phc"


def test_a_project(tmp_path):
    from jaxbundle.network.reprojection import point_errors

    net = read_network(write(tmp_path))
    assert net.images.id == ("1", "2", "3") and net.image_unit == "mm"
    assert_allclose(net.images.position, POSITION)
    assert_allclose([matrix(a) for a in net.images.angles], [*map(matrix, ANGLES)], atol=1e-12)
    assert_allclose(point_errors(net)[0], 0, atol=1e-11)
    assert net.datum_points == tuple(str(k + 100) for k in range(5))
    assert_allclose(net.observations.sigma[0], [0.0005, 0.0006])
    assert net.distances.value.tolist() == [1.25] and net.distances.points.tolist() == [[0, 1]]
    assert net.cameras[0].pixel_size == pytest.approx((0.006, 0.0064))
    assert any("1 image point" in told and "'999'" in told for told in net.warnings)


def test_images_that_are_not_active_do_not_come_back_by_their_points(tmp_path):
    rows = files()[".eor"].splitlines(keepends=True)
    off = rows[0] + rows[1].replace(" 0 1 3\n", " 0 0 3\n") + rows[2]
    net = read_network(write(tmp_path, eor=off))
    assert net.images.id == ("1", "3") and len(net.observations) == 2 * len(POINTS)
    assert any("not active in .eor: '2'" in told for told in net.warnings)


def test_a_camera_that_is_guessed_is_told(tmp_path):
    """An image that is only in .phc has no camera; with one camera it is that."""
    eor = "".join(files()[".eor"].splitlines(keepends=True)[:2])
    told = lambda **changed: " ".join(read_network(write(tmp_path, eor=eor, **changed)).warnings)
    assert "not in .eor" not in told()
    ior = files()[".ior"]
    assert "1 image not in .eor" in told(ior=ior + "2" + ior[1:])


def test_there_and_back(tmp_path):
    net = read_network(write(tmp_path))
    assert write_jaicov(net, tmp_path / "new.phc") == ()
    back = read_network(tmp_path / "new.phc")
    assert_same(net, back)
    assert back.datum_points == net.datum_points and back.distances.value == net.distances.value
    assert_allclose(back.observations.sigma, net.observations.sigma)
    with pytest.raises(InputError, match="already there"):
        convert(tmp_path / "project.phc", tmp_path / "new.phc")
    assert convert(tmp_path / "project.phc", tmp_path / "again.phc").kind == "jaicov"


def test_without_orientations_and_coordinates(tmp_path):
    net = read_network(write(tmp_path, eor=None, obc=None, scale=None))
    assert np.isnan(net.images.position).all() and np.isnan(net.points.position).all()
    assert len(net.points) == 13 and len(net.images) == 3


BROKEN = {
    "phc": ("0.0005", "x", r"phc, line 2: sx is 'x'"), "nan": ("0.0006", "nan", "phc, line 2: sy"),
    "ior": ("24.0 16.0 4000 2500", "24.0 16.0", "ior, line 5: 2 values where 4"),
    "end": ("24.0 16.0 4000 2500\n", "", "ior: the file ends after line 4"),
    "sign": ("1 0 -28.8", "1 0 28.8", "ior, line 5: c must be negative"),
    "eor": (" 0 1 3\n", " 0\n", "eor, line 1: 7 values where 9"),
    "twice": ("101 ", "100 ", "obc, line 2: point 100 occurs twice"),
    "scale": ("1.25 0.01 1", "1.25 0 1", "scale, line 1: length and σ must be positive"),
}  # fmt: skip


@pytest.mark.parametrize("name", BROKEN)
def test_broken_projects(tmp_path, name):
    old, new, message = BROKEN[name]
    suffix = message.split(",")[0].split(":")[0].strip("\\")
    text = files()[f".{suffix}"]
    assert old in text
    with pytest.raises(InputError, match=f"project.{message}"):
        read_network(write(tmp_path, **{suffix: text.replace(old, new, 1)}))


def test_no_interior_orientation(tmp_path):
    with pytest.raises(InputError, match="project.ior: no such file"):
        read_network(write(tmp_path, ior=None))
