"""Networks in another camera model: the same rays, the same pixels."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from jaxbundle.cameras import default_parameters, get_model
from jaxbundle.cameras.convert_fit import rays_of
from jaxbundle.errors import InputError
from jaxbundle.network import Camera
from jaxbundle.network.build import make_network
from jaxbundle.network.conversion import _convert, convert_cameras, convert_one

SIZES = dict(image_size=(1280, 720), pixel_size=(0.005, 0.005))
BROWN = Camera("a", "brown", dict(c=5.0, x0=0.01, y0=-0.02, K1=2e-3, K2=-3e-5, P1=1e-4),
               free=("c", "x0", "K1"), sigma={"c": 0.1}, **SIZES)  # fmt: skip
OPENCV = Camera("b", "opencv", dict(fx=1000.0, fy=1000.0, cx=641.0, cy=358.5, k1=-0.1, k2=0.02),
                free=("fx", "fy", "k1"), **SIZES)  # fmt: skip
PIXELS = np.array([[10.0, 20.0], [1200.0, 700.0], [640.0, 360.0], [100.0, 650.0]])


def network(*cameras, unit="px"):
    images = [{"id": f"{c.id}", "camera": c.id, "X0": 0, "Y0": 0, "Z0": 5, "omega": 0, "phi": 0,
               "kappa": 0} for c in cameras]  # fmt: skip
    points = [{"id": k, "role": "tie", "X": k, "Y": 0, "Z": 0} for k in range(len(PIXELS))]
    rays = [{"image": c.id, "point": k, "x": x, "y": y, "sx": 0.5, "sy": 0.25}
            for c in cameras for k, (x, y) in enumerate(PIXELS)]  # fmt: skip
    return make_network(cameras, images, points, rays, image_unit=unit)


def rays_in(net, image):
    camera = net.cameras[net.images.camera[image]]
    values = {**default_parameters(get_model(camera.model)), **camera.parameters}
    mine = net.observations.image == image
    return rays_of(get_model(camera.model), values, net.observations.xy[mine])


@pytest.mark.parametrize("model", ["opencv", "brown-projected", "usgs", "snavely"])
def test_rays_are_those_before_to_the_difference_told(model):
    before = network(BROWN, OPENCV)
    after, done = convert_cameras(before, model)
    assert {c.model for c in after.cameras} == {model}
    for i, camera in enumerate(before.cameras):
        limit = 1e-12
        if camera.id in done:
            focal = 5.0 if done[camera.id].unit == "mm" else 1000.0
            limit += 1.5 * done[camera.id].largest / focal
        difference = np.linalg.norm(rays_in(before, i) - rays_in(after, i), axis=1)
        assert difference.max() < limit
    assert after.image_unit == get_model(model).unit


def test_pixels_and_sigmas_stay():
    after, done = convert_cameras(network(BROWN), "opencv")
    assert_allclose(after.observations.xy, PIXELS, atol=1e-10)
    assert_allclose(after.observations.sigma[0], (0.5, 0.25))
    back, _ = convert_cameras(after, "brown")
    assert_allclose(back.observations.xy, network(BROWN).observations.xy, atol=1e-12)
    assert_allclose(back.observations.sigma[0], (0.0025, 0.00125))
    assert after.cameras[0].free == ("fx", "fy", "cx", "k1")
    assert back.cameras[0].free == ("c", "x0", "K1")
    assert "prior σ" in after.warnings[-1] and done["a"].largest < 0.1


def test_snavely_counts_from_the_principal_point():
    after, done = convert_cameras(network(OPENCV), "snavely")
    assert done["b"].exact and after.cameras[0].parameters["f"] == 1000
    assert_allclose(after.observations.xy, (PIXELS - [641.0, 358.5]) * [1, -1], atol=1e-10)
    without = Camera("b", "opencv", OPENCV.parameters)
    after, done = convert_cameras(network(without), "snavely")
    assert done["b"].exact
    assert_allclose(after.observations.xy, (PIXELS - [641.0, 358.5]) * [1, -1], atol=1e-10)


def test_one_camera_and_what_is_refused():
    made, cost = convert_one(BROWN, "usgs")
    assert made.model == "usgs" and cost.exact
    with pytest.raises(InputError, match="camera 'a': pixel_size is needed"):
        convert_one(Camera("a", "brown", {"c": 5.0}, image_size=(10, 10)), "opencv")
    # A fit over one pixel would say nothing of its error.
    lens = Camera("a", "brown", {"c": 5.0, "K1": 2e-3, "P1": 1e-4}, pixel_size=(0.005, 0.005))
    with pytest.raises(InputError, match="camera 'a': image_size is needed, since .* fitted"):
        convert_one(lens, "snavely")
    with pytest.raises(InputError, match="unknown camera model 'opencx'.*'opencv'"):
        convert_cameras(network(BROWN), "opencx")


@pytest.mark.parametrize("measured", [False, True])
def test_a_camera_is_converted_over_its_image_or_where_points_are_measured(measured):
    """Over the whole image, if its size is known, unless only its measured part is asked for: in
    the middle other polynomials fit best."""
    corner = np.array([[-3.2, -1.8], [3.2, 1.8]])
    found = [
        _convert(BROWN, "opencv", 0.0, part * corner, measured)[0].parameters
        for part in (1.0, 0.5)
    ]
    assert (found[0] == found[1]) == (not measured)
