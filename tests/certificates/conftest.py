import pytest

import jaxbundle


@pytest.fixture(scope="session")
def field():
    """A test field with control, check points and calibrated lengths."""
    camera = jaxbundle.Camera("cam", "brown", {"c": 20.0}, ("c", "x0", "y0"))
    stations = jaxbundle.ring_of_stations(8, 3.0, 3.0, roll_every=2)
    targets = jaxbundle.cloud_of_targets(20, (2.0, 2.0, 0.8), seed=3)
    network = jaxbundle.simulate(
        stations, targets, camera, noise=1e-3, seed=2, control=range(6), control_sigma=1e-4,
        check=range(6, 10), distances=[(10, 11)], distance_sigma=1e-5,
    )  # fmt: skip
    return jaxbundle.adjust(network), targets
