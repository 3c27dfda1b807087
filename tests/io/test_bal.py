"""BAL problems: what is read is what the Snavely camera projects; damaged files are refused."""

import bz2
import gzip
import tracemalloc

import numpy as np
import pytest

import jaxbundle
from jaxbundle.adjustment.quality.inspection import Inspection
from jaxbundle.errors import InputError
from jaxbundle.geometry import matrix_from_omega_phi_kappa, matrix_from_rotation_vector

CAMERAS = np.array([
    [0.1, -0.2, 0.3, 0.5, 0.1, -9.0, 500.0, -0.1, 0.02],
    [2.0, 1.0, -0.5, -0.3, 0.2, -8.0, 480.0, 0.05, 0.0],
])  # fmt: skip
POINTS = np.random.default_rng(1).uniform(-1, 1, (6, 3))


def projected(camera, point):
    """The formulas of the data sets' own page."""
    P = np.asarray(matrix_from_rotation_vector(camera[:3])) @ point + camera[3:6]
    p = -P[:2] / P[2]
    return camera[6] * (1 + camera[7] * p @ p + camera[8] * (p @ p) ** 2) * p


def text():
    rows = [
        f"{c} {p} {x!r} {y!r}"
        for c, camera in enumerate(CAMERAS)
        for p, point in enumerate(POINTS)
        for x, y in [map(float, projected(camera, point))]
    ]
    numbers = [repr(float(x)) for x in (*CAMERAS.ravel(), *POINTS.ravel())]
    return "\n".join(["2 6 12", *rows, *numbers, ""])


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "problem-2-6.txt"
    path.write_text(text())
    return path


def test_network(path):
    network = jaxbundle.read_network(path)
    assert (len(network.images), len(network.points), len(network.observations)) == (2, 6, 12)
    assert network.cameras[1].parameters == {"f": 480.0, "k1": 0.05, "k2": 0.0}
    assert network.cameras[0].free == ("f", "k1", "k2")
    assert (network.datum, network.residuals) == ("inner", "measured")
    M = matrix_from_omega_phi_kappa(network.images.angles[1])
    np.testing.assert_allclose(M, matrix_from_rotation_vector(CAMERAS[1, :3]), atol=1e-14)
    np.testing.assert_allclose(-M @ network.images.position[1], CAMERAS[1, 3:6], atol=1e-14)


def test_exact_projections_have_no_residuals(path):
    problem = jaxbundle.make_problem(jaxbundle.read_network(path))
    rows = Inspection(problem, problem.data.start).image_residuals
    np.testing.assert_allclose(rows, 0, atol=1e-10)


def test_compressed_and_overridden(path, tmp_path):
    packed = tmp_path / "problem.txt.gz"
    packed.write_bytes(gzip.compress(text().encode()))
    network = jaxbundle.read_network(packed, overrides=["free=f", "sigma_image=0.5"])
    assert all(camera.free == ("f",) for camera in network.cameras)
    assert (network.observations.sigma == 0.5).all()


def test_a_damaged_compressed_file(tmp_path):
    packed = bytearray(gzip.compress(text().encode()))
    packed[20:40] = b"\xff" * 20
    path = tmp_path / "problem.txt.gz"
    path.write_bytes(packed)
    with pytest.raises(InputError, match="problem.txt.gz"):
        jaxbundle.read_network(path)
    with pytest.raises(InputError, match="problem.txt.gz: cannot be read"):
        jaxbundle.read_network(path, format="bal")


def test_a_count_of_thousands_of_digits(tmp_path):
    path = tmp_path / "problem.txt"
    path.write_text(f"{'9' * 5000} 6 12\n")
    with pytest.raises(InputError, match="line 1: expected three whole numbers"):
        jaxbundle.read_network(path, format="bal")
    path.write_text(f"{'9' * 50} 6 12\n")
    with pytest.raises(InputError, match="line 1: 9+ 6 12: more cameras.* than a file can hold"):
        jaxbundle.read_network(path, format="bal")


@pytest.mark.parametrize("counts", ["2 6 12", "999999999999999999 6 12"])
@pytest.mark.parametrize("suffix, pack", [(".gz", gzip.compress), (".bz2", bz2.compress),
                                          ("", bytes)])  # fmt: skip
def test_no_more_is_unpacked_than_the_counts_allow(tmp_path, counts, suffix, pack):
    """100 MB of blanks: the memory used while the file is refused stays far below."""
    path = tmp_path / f"problem.bal{suffix}"
    blanks = 10**8 if suffix else 10**6
    path.write_bytes(pack(counts.encode() + b"\n" + b" " * blanks))
    tracemalloc.start()
    complaint = "too many for the 84 numbers" if counts == "2 6 12" else "numbers"
    with pytest.raises(InputError, match=complaint):
        jaxbundle.read_network(path, format="bal")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 5e7


@pytest.mark.parametrize(
    "damage, complaint",
    [
        (lambda t: t.replace("0 3 ", "0 6 "), "line 5: point 6 does not exist"),
        (lambda t: t.replace("1 2 ", "2 2 "), "line 10: camera 2 does not exist"),
        (lambda t: t + "1.0\n", "49 numbers follow|numbers follow the first line"),
        (lambda t: t.replace("480.0", "nan"), "'nan' where a number is expected"),
        (lambda t: t.replace("480.0", "f=480"), "'f=480' where a number is expected"),
    ],
)
def test_damaged_files(tmp_path, damage, complaint):
    path = tmp_path / "bad.txt"
    path.write_text(damage(text()))
    with pytest.raises(InputError, match=complaint):
        jaxbundle.read_network(path)
