"""A small network for the tests of exchange formats: three images of a dozen points."""

from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from jaxbundle.cameras import default_parameters, get_model
from jaxbundle.cameras.convert_fit import images_of
from jaxbundle.network import Camera
from jaxbundle.network.build import make_network

CAMERAS = {
    "opencv": Camera(
        "1", "opencv", dict(fx=1000.0, fy=1002.0, cx=641.0, cy=358.5, k1=-0.1, k2=0.02, p1=1e-3,
                            p2=-5e-4), image_size=(1280, 720), pixel_size=(0.005, 0.005),
    ),
    "kannala-brandt": Camera(
        "1", "kannala-brandt", dict(fx=700.0, fy=700.0, cx=640.0, cy=360.0, k1=0.05, k2=0.01),
        image_size=(1280, 720),
    ),
    "snavely": Camera("0", "snavely", dict(f=1000.0, k1=-0.1, k2=0.02)),
    "brown": Camera(
        "1", "brown", dict(c=5.0, x0=0.01, y0=-0.02, K1=2e-3, K2=-3e-5, P1=1e-4, P2=-5e-5),
        image_size=(1280, 720), pixel_size=(0.005, 0.005),
    ),
}  # fmt: skip

ANGLES = np.array([[0.1, -0.3, 0.2], [-0.2, 0.35, -2.9], [0.3, 0.05, 1.5]])
POSITION = np.array([[-1.5, -0.2, 4.0], [1.6, 0.6, 4.2], [0.1, -1.5, 4.5]])
POINTS = np.random.default_rng(5).uniform([-0.8, -0.6, -0.4], [0.8, 0.6, 0.4], (12, 3))


def matrix(angles) -> np.ndarray:
    """M = R3(κ)·R2(φ)·R1(ω), by scipy."""
    return Rotation.from_euler("xyz", -np.asarray(angles)).as_matrix()


@cache
def network(model: str = "opencv", names: tuple[str, ...] = ("1", "2", "3"), first_point: int = 1):
    """The network seen with one camera, every point in every image but two of them."""
    camera = CAMERAS[model]
    values = {**default_parameters(get_model(model)), **camera.parameters}
    rows = []
    for i, name in enumerate(names):
        rays = (POINTS - POSITION[i]) @ matrix(ANGLES[i]).T
        for k, (x, y) in enumerate(images_of(get_model(model), values, rays).tolist()):
            if (i, k) not in ((0, 3), (2, 7)):
                rows.append({"image": name, "point": str(k + first_point), "x": x, "y": y})
    exterior = np.concatenate([POSITION, ANGLES], 1)
    columns = ("X0", "Y0", "Z0", "omega", "phi", "kappa")
    return make_network(
        camera,
        [{"id": n, "camera": camera.id, **dict(zip(columns, e))} for n, e in zip(names, exterior)],
        [{"id": str(k + first_point), "role": "tie", **dict(zip("XYZ", p))}
         for k, p in enumerate(POINTS)],
        rows, datum="inner", residuals="measured", image_unit=get_model(model).unit,
    )  # fmt: skip


def assert_same(a, b, atol=1e-12):
    """Two networks agree in ids, orientation, coordinates and image points."""
    assert a.images.id == b.images.id and a.points.id == b.points.id
    np.testing.assert_allclose(a.images.position, b.images.position, atol=atol)
    np.testing.assert_allclose(
        np.stack([matrix(x) for x in a.images.angles]),
        np.stack([matrix(x) for x in b.images.angles]), atol=atol,
    )  # fmt: skip
    np.testing.assert_allclose(a.points.position, b.points.position, atol=atol)
    key = lambda n: np.lexsort((n.observations.point, n.observations.image))
    np.testing.assert_array_equal(a.observations.image[key(a)], b.observations.image[key(b)])
    np.testing.assert_array_equal(a.observations.point[key(a)], b.observations.point[key(b)])
    np.testing.assert_allclose(
        a.observations.xy[key(a)], b.observations.xy[key(b)], atol=1000 * atol
    )
    for mine, theirs in zip(a.cameras, b.cameras):
        assert mine.model == theirs.model
        full = lambda c: {**default_parameters(get_model(c.model)), **c.parameters}
        np.testing.assert_allclose(
            [*full(mine).values()], [full(theirs)[k] for k in full(mine)], rtol=1e-13, atol=1e-15
        )
