"""The TOML of anipose: its poses against OpenCV's projection, and back; what is refused."""

import dataclasses

import cv2
import numpy as np
import pytest
from foreign_samples import write_sample

import jaxbundle
from jaxbundle.cameras import get_model
from jaxbundle.cameras.convert_fit import images_of
from jaxbundle.errors import InputError
from jaxbundle.geometry import matrix_from_omega_phi_kappa
from jaxbundle.io import read_network
from jaxbundle.io.networks.anipose import write_anipose
from jaxbundle.io.text.csv_tables import read_toml

X = np.array([[-300.0, 200.0, 2000.0], [100.0, -150.0, 1500.0], [400.0, 300.0, 2500.0]])


def test_cameras_see_what_opencv_says(tmp_path):
    path = write_sample(tmp_path, "anipose")
    network, document = read_network(path), read_toml(path)
    for camera, X0, angles, key in zip(network.cameras, network.images.position,
                                       network.images.angles, ("cam_0", "cam_1")):  # fmt: skip
        given = document[key]
        vectors = (np.array(given[name]) for name in ("rotation", "translation"))
        K, d = np.array(given["matrix"]), np.array(given["distortions"])
        project = cv2.fisheye.projectPoints if given.get("fisheye") else cv2.projectPoints
        seen = project(X[:, None], *vectors, K, d)[0][:, 0]
        M = np.asarray(matrix_from_omega_phi_kappa(angles))
        parameters = dict.fromkeys(get_model(camera.model).parameters, 0.0) | camera.parameters
        found = images_of(get_model(camera.model), parameters, (X - X0) @ M.T)
        np.testing.assert_allclose(found, seen, atol=1e-9)
    assert [camera.id for camera in network.cameras] == ["left", "right"]
    assert [camera.image_size for camera in network.cameras] == [(640, 480)] * 2


def test_there_and_back(tmp_path):
    path = write_sample(tmp_path, "anipose")
    done = jaxbundle.convert(path, tmp_path / "calibration_2.toml")
    assert done.lost == ("names of images (2)",) or done.lost == ()
    one, two = read_network(path), read_network(tmp_path / "calibration_2.toml")
    np.testing.assert_allclose(two.images.position, one.images.position, atol=1e-12)
    np.testing.assert_allclose(two.images.angles, one.images.angles, atol=1e-14)
    assert [c.parameters for c in two.cameras] == [c.parameters for c in one.cameras]


@pytest.mark.parametrize("change, message", [
    (("[ 500.0, 0.0, 320.0,]", "[ 500.0, 1.0, 320.0,]"), "matrix has 1 in row 1, column 2"),
    (("[ -0.3, 0.1, 0.001, -0.0005, 0.02,]", "[ 0.1, 0.2,]"), "distortions has 2 numbers"),
    (("[ 640, 480,]", "[ 640,]"), "size"),
    (('name = "left"', 'name = "left"\nrotation_count = 1'), "the images are turned"),
])  # fmt: skip
def test_what_is_refused(tmp_path, change, message):
    path = write_sample(tmp_path, "anipose")
    path.write_text(path.read_text().replace(*change, 1))
    with pytest.raises(InputError, match=message):
        read_network(path)


def test_coefficients_that_it_has_no_place_for_are_refused(tmp_path):
    network = read_network(write_sample(tmp_path, "anipose"))
    first, *others = network.cameras
    prism = dataclasses.replace(first, parameters={**first.parameters, "s1": 1e-4})
    with pytest.raises(InputError, match="camera 'left': anipose has no s1"):
        write_anipose(network.replace(cameras=(prism, *others)), tmp_path / "prism.toml")


def test_a_camera_without_a_pose_is_not_in_the_rig(tmp_path):
    path = write_sample(tmp_path, "anipose")
    path.write_text(path.read_text().replace("rotation = [ 0.02, -0.1, 0.01,]\n", ""))
    network = read_network(path)
    assert np.isnan(network.images.position).all() and not network.further
