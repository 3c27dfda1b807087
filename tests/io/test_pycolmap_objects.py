"""Networks and reconstructions of pycolmap in memory."""

import numpy as np
import pycolmap
import pytest
from exchange_cases import assert_same, network
from numpy.testing import assert_allclose

import jaxbundle
from jaxbundle.errors import InputError

NAMES = ("a.jpg", "b.jpg", "c d.jpg")


@pytest.mark.parametrize("model", ["opencv", "kannala-brandt"])
def test_a_network_is_the_same_after_the_way_there_and_back(model):
    before = network(model, NAMES)
    made = jaxbundle.to_pycolmap(before)
    assert made.num_reg_images() == 3 and made.num_cameras() == len(before.cameras)
    after = jaxbundle.from_pycolmap(made)
    assert_same(before, after)
    assert after.name == "reconstruction"


def test_pycolmap_projects_points_where_they_were_measured():
    """An independent reading: its own camera and pose give the image points of the network."""
    before = network("opencv", NAMES)
    made = jaxbundle.to_pycolmap(before)
    for image in made.images.values():
        for point in image.points2D:
            if point.has_point3D():
                xyz = made.points3D[point.point3D_id].xyz
                seen = image.project_point(xyz)
                assert_allclose(seen, point.xy, atol=3.0)  # measured with noise


def test_an_adjustment_goes_with_its_solution_and_a_setting_frees_parameters(convergent4):
    stations = jaxbundle.ring_of_stations(5, 3.0, 3.0, roll_every=2)
    targets = jaxbundle.cloud_of_targets(12, (2.0, 2.0, 0.8), seed=3)
    values = {"fx": 800.0, "fy": 805.0, "cx": 640.0, "cy": 360.0, "k1": -0.1}
    camera = jaxbundle.Camera("1", "opencv", values, ("fx", "fy"), image_size=(1280, 720))
    result = jaxbundle.adjust(jaxbundle.simulate(
        stations, targets, camera, noise=0.2, seed=1, residuals="measured"
    ))  # fmt: skip
    made = jaxbundle.to_pycolmap(result)
    assert made.cameras[1].params[0] == pytest.approx(result.camera_parameters("1")["fx"])
    found = np.array([made.points3D[int(id)].xyz for id in result.points["id"]])
    assert_allclose(found, result.point_values, atol=1e-12)
    again = jaxbundle.from_pycolmap(made, ["free=fx,fy"])
    assert again.cameras[0].free == ("fx", "fy")
    assert jaxbundle.adjust(again).camera_parameters("1")["fx"] == pytest.approx(
        result.camera_parameters("1")["fx"], abs=1e-4
    )


def test_what_is_no_reconstruction_or_has_no_images():
    with pytest.raises(InputError, match="expected a pycolmap.Reconstruction, got int"):
        jaxbundle.from_pycolmap(3)
    with pytest.raises(InputError, match="^reconstruction: the model has no images"):
        jaxbundle.from_pycolmap(pycolmap.Reconstruction())
    with pytest.raises(InputError, match="must be a Network"):
        jaxbundle.to_pycolmap(3)


def test_without_pycolmap(monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(InputError, match="pip install pycolmap"):
        jaxbundle.to_pycolmap(network("opencv", NAMES))
