"""Cameras in the order of their images, where each image has its own."""

import pytest
from test_check import tables

from jaxbundle.network.build import make_network
from jaxbundle.network.declare import order_cameras


@pytest.mark.parametrize("of, ordered", [("bca", "bca"), ("bbb", "abc"), ("aba", "abc")])
def test_cameras_are_ordered_only_if_no_image_shares_one(of, ordered):
    """A shared camera must remain one; cameras without images stay, too."""
    given = tables()
    given["cameras"] = [{"id": id, "c": 100.0} for id in "abc"]
    for image, camera in zip(given["images"], of, strict=True):
        image["camera"] = camera
    network = order_cameras(make_network(**given))
    assert "".join(camera.id for camera in network.cameras) == ordered
    assert "".join(network.cameras[c].id for c in network.images.camera) == of
