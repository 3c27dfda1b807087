"""The list of photographs: the example file, and every way it can be broken."""

from pathlib import Path

import numpy as np
import pytest

from jaxbundle.errors import InputError
from jaxbundle.io import read_network, read_photo_list, read_project
from jaxbundle.network.check import check_network
from jaxbundle.network.tables import STATED, UNIT

EXAMPLE = Path(__file__).parents[2] / "examples" / "convergent4"

SMALL = """\
20.0
first photo 0.1 0.2 0.3 1 2 3 0.1 0.1 0.1 1 1 1
2
a\t1.0\t2.0\t0.01\t0.02

b 3.0 4.0 0.01 0.01
second 0 0 0 1 2 3 0.1 0.1 0.1 1 1 1
1
a 5.0 6.0 0.01 0.01
a 1 2 3 0.5 0.5 0.5
b 4 5 6 0.5 0.5 0.5
"""


@pytest.fixture
def write(tmp_path):
    def write(text):
        path = tmp_path / "list.txt"
        path.write_text(text)
        return path

    return write


def test_the_example_is_the_example_project():
    """The same measurements as the project beside it, once the σ of the file are set aside."""
    overrides = ["sigma_image=0.0007", "free=c,x0,y0,K1,K2,K3,P1,P2,b1,b2"]
    network = read_network(EXAMPLE / "convergent4.txt", overrides=overrides)
    project = read_project(EXAMPLE)
    assert network.cameras == project.cameras
    assert (network.images.id, network.points.id) == (project.images.id, project.points.id)
    for table, names in {
        "images": ("position", "angles", "sigma"), "points": ("position", "sigma"),
        "observations": ("image", "point", "xy", "sigma"),
    }.items():  # fmt: skip
        for name in names:
            np.testing.assert_array_equal(
                getattr(getattr(network, table), name), getattr(getattr(project, table), name)
            )
    assert (network.datum, network.residuals) == ("inner", "corrected")
    assert network.observations.sigma_origin == STATED
    assert network.notes[0].startswith("the σ of the file are ignored")
    check_network(network)


def test_unit_weights_can_be_asked_for():
    network = read_network(EXAMPLE / "convergent4.txt", overrides=["sigma_origin=unit"])
    assert network.observations.sigma_origin == UNIT
    assert (network.observations.sigma == 1).all() and network.warnings == ()


def test_the_sigma_of_the_example_are_refused():
    with pytest.raises(InputError) as error:
        read_photo_list(EXAMPLE / "convergent4.txt")
    for words in ("convergent4.txt, line 6", "σ of x", "'3'", "'DSC_037'", "-0.5",
                  "--set sigma_image=VALUE (mm)", "sigma_origin=unit for unit"):  # fmt: skip
        assert words in str(error.value)


def test_good_sigma_are_used(write):
    network = read_photo_list(write(SMALL))
    np.testing.assert_array_equal(network.observations.sigma[0], [0.01, 0.02])
    assert network.images.id == ("first photo", "second")
    np.testing.assert_array_equal(network.images.angles[0], [0.1, 0.2, 0.3])
    np.testing.assert_array_equal(network.images.position[0], [1, 2, 3])
    assert np.isnan(network.images.sigma).all() and np.isnan(network.points.sigma).all()
    assert network.cameras[0].parameters == {"c": 20.0}
    assert network.cameras[0].free == ()
    assert network.observations.source(1).endswith("list.txt, line 6")
    assert "start values only" in network.notes[0]


def test_overrides(write):
    overrides = ["camera.cam.free=c", "datum=minimal", "residuals=measured", "camera.cam.K1=1e-4"]
    network = read_photo_list(write(SMALL), overrides)
    assert network.cameras[0].free == ("c",)
    assert network.cameras[0].parameters == {"c": 20.0, "K1": 1e-4}
    assert (network.datum, network.residuals) == ("minimal", "measured")
    with pytest.raises(InputError, match="camera 'cam': free names the unknown parameter 'f'"):
        read_photo_list(write(SMALL), ["free=f"])
    with pytest.raises(InputError, match="--set images: unknown key; known: name"):
        read_photo_list(write(SMALL), ["images=x.csv"])


@pytest.mark.parametrize("old, new, said", [
    ("20.0", "", "line 2: the first line must be the focal length in mm alone"),
    ("20.0", "f", "line 1: the focal length is 'f'; expected a number"),
    ("20.0", "0", "c must be positive"),
    ("0.2 0.3", "0.2", "line 2: omega of photograph 'first' is 'photo'; expected a number"),
    ("0.2", "O.2", "line 2: phi of photograph 'first photo' is 'O.2'; expected a number"),
    ("\n2\n", "\n3\n", "line 7: 13 values where an image point"),
    ("\n2\n", "\n1\n", "line 6: 5 values where a photograph"),
    ("\n2\n", f"\n{'9' * 5000}\n", "999… where the number of image points of photograph 'first ph"),
    ("\n2\n", "\ntwo\n", "line 3: 'two' where the number of image points of photograph 'first ph"),
    ("\n2\n", "\n", "line 3: 'a 1.0 2.0 0.01 0.02' where the number of image points"),
    ("3.0 4.0", "3.0 nan", "line 6: y of point 'b' in photograph 'first photo' is 'nan'"),
    ("3.0 4.0", "3.0", "line 6: 4 values where an image point"),
    ("0.02", "nan", "line 4: σ of y of point 'a' in photograph 'first photo' is nan"),
    ("0.02", "x", "σ of y of point 'a' in photograph 'first photo' is 'x'; expected a number"),
    ("3 0.1", "3 -0.1", "line 2: σ of omega of photograph 'first photo' is -0.1"),
    ("6 0.5", "6 0", "line 11: σ of X of object point 'b' is 0"),
    ("b 4 5 6", "b 4 five 6", "line 11: Y of object point 'b' is 'five'; expected a number"),
    ("b 4 5 6 0.5", "b 4 5 6", "line 11: 6 values where an object point"),
    ("b 4 5 6", "c 4 5 6", "line 6: point 'b' is unknown: no such point"),
    ("b 4 5 6", "a 4 5 6", "line 11: point 'a' is already in"),
    ("second", "first photo", "line 7: image 'first photo' is already in"),
])  # fmt: skip
def test_a_fault_is_refused_with_its_line(write, old, new, said):
    assert old in SMALL
    with pytest.raises(InputError) as error:
        read_photo_list(write(SMALL.replace(old, new, 1)))
    assert said in str(error.value)
    assert "list.txt" in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("lines, said", [
    (0, "the file is empty; first comes the focal length"),
    (1, "line 1: no photograph after the focal length"),
    (2, "line 2: the file ends after photograph 'first photo'"),
    (4, "line 4: the file ends after 1 image point; line 3 announces 2 image points of photograph "
        "'first photo'"),
    (9, "line 9: the file ends before the object points"),
    (10, "line 6: point 'b' is unknown"),
])  # fmt: skip
def test_a_truncated_file_is_refused(write, lines, said):
    with pytest.raises(InputError) as error:
        read_photo_list(write("".join(SMALL.splitlines(keepends=True)[:lines])))
    assert said in str(error.value)


def test_only_lists_are_recognised(write):
    assert len(read_network(write(SMALL)).images) == 2
    with pytest.raises(InputError, match="not recognised; .* of this name: .*photo-list"):
        read_network(write("some text\n"))
    with pytest.raises(InputError, match="line 1: the focal length is 'text'"):
        read_network(write("text\n"), format="photo-list")
