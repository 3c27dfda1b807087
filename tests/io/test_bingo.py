"""BINGO's image coordinates and geo input."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from jaxbundle.errors import InputError
from jaxbundle.io.networks.bingo import is_bingo, read_bingo

IMAGE = """\
C a comment
*
1001 CAM1
 100  -20.5  10.25
 A17   30.0  -5.125
-99
1002
 100  -21.5  11.25
 200   3e1   4.0
-99
"""
GEO = """\
C   geo input
CAPA 3 CAM1 127.0 0.0 0.1 0.1 0.2 0.2
RADI CAM1 7.8
ADPA 25 26
CONT 100 1.0 2.0 3.0
CHCK 200 4.0 5.0 6.0
CONT 300 7.0 8.0 9.0
"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "image.dat").write_text(IMAGE)
    (tmp_path / "GEOIN.DAT").write_text(GEO)
    return tmp_path


def test_both_files(folder):
    assert is_bingo(folder) and is_bingo(folder / "image.dat") and not is_bingo(folder.parent)
    net = read_bingo(folder)
    assert net.images.id == ("1001", "1002") and np.isnan(net.images.position).all()
    (camera,) = net.cameras
    assert (camera.id, camera.model, camera.free) == ("CAM1", "bingo", ("c", "x0", "y0"))
    assert camera.parameters == {"c": 127.0, "x0": 0.0, "y0": 0.1}
    assert camera.sigma == {"c": 0.1, "x0": 0.2, "y0": 0.2}
    assert dict(zip(net.points.id, net.points.role)) == {
        "100": "fixed", "200": "check", "A17": "tie"
    }  # fmt: skip
    assert_allclose(net.points.position[0], (1, 2, 3))
    assert_allclose(net.observations.xy, [[-20.5, 10.25], [30, -5.125], [-21.5, 11.25], [30, 4]])
    text = " ".join((*net.warnings, *net.notes))
    assert "'300'" in text and "RADI, ADPA" in text and "itera.dat" in text
    assert net.datum == "control" and net.image_unit == "mm"


def test_without_end_marks_and_with_settings(folder):
    (folder / "image.dat").write_text(IMAGE.replace("-99\n", "\n"))
    net = read_bingo(folder / "image.dat", ["sigma_image=0.03", "free=c,x0,y0,p25"])
    assert len(net.observations) == 4 and (net.observations.sigma == 0.03).all()
    assert net.cameras[0].free == ("c", "x0", "y0", "p25")


BROKEN = {
    "no photograph": ("image.dat", "1001 CAM1\n", "", "line 3: 3 values where a photograph"),
    "after the end": ("image.dat", "1002\n", "", "where a photograph"),
    "too many values": ("image.dat", "10.25\n", "10.25 0.03\n", "3 values where 2 are expected"),
    "text": ("image.dat", "10.25", "1O.25", "line 4: y is '1O.25'"),
    "NaN": ("image.dat", "10.25", "nan", "y is 'nan'"),
    "camera": ("image.dat", "CAM1", "CAM2", "photograph 1001: camera 'CAM2'; CAPA .*: CAM1"),
    "twice": ("image.dat", " A17 ", " 100 ", None),
    "statement": ("GEOIN.DAT", "CHCK", "DIST", "line 6: the statement 'DIST' is not known"),
    "close": ("GEOIN.DAT", "CHCK", "CHEK", "did you mean 'CHCK'"),
    "short": ("GEOIN.DAT", "3.0\n", "\n", "2 values where 3 are expected"),
    "long": ("GEOIN.DAT", "3.0\n", "3.0 0.01\n", "4 values where 3 are expected"),
    "capa": ("GEOIN.DAT", " 0.1 0.2 0.2", " 0.1", "CAPA key CAMERA c xH yH"),
    "no camera": ("GEOIN.DAT", "CAPA", "RADI", "no camera"),
    "principal distance": ("GEOIN.DAT", "127.0", "-127.0", "c must be positive"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_files(folder, name):
    file, old, new, message = BROKEN[name]
    text = (folder / file).read_text()
    assert old in text
    (folder / file).write_text(text.replace(old, new, 1))
    if message is None:  # a point twice in a photograph is left to check_network
        assert len(read_bingo(folder).observations) == 4
        return
    with pytest.raises(InputError, match=message):
        read_bingo(folder)


def test_missing_files(folder, tmp_path):
    (folder / "GEOIN.DAT").unlink()
    with pytest.raises(InputError, match="there is no geoin.dat"):
        read_bingo(folder)
    (folder / "image.dat").write_text("")
    (folder / "geoin.dat").write_text(GEO)
    with pytest.raises(InputError, match="no image points"):
        read_bingo(folder)
