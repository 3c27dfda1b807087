"""Rendered stereo pairs of a hilly ground with a roof above it."""

import numpy as np
import rasterio

import jaxbundle
from jaxbundle.planning.rendering import Scene, Sensor, render
from jaxbundle.planning.shapes import HeightField, Rectangle
from jaxbundle.planning.texture import Texture
from jaxbundle.surfaces.views import FrameView

SIZE, F = (256, 192), 256.0
CAMERA = jaxbundle.Camera(
    "cam", "opencv", {"fx": F, "fy": F, "cx": 127.5, "cy": 95.5, "k1": -0.05}, image_size=SIZE
)
ROOF = Rectangle((-1.2, -1.2, 2.0), (2.0, 0, 0), (0, 2.0, 0))
EXTENT = (-15, -15, 15, 15)


def hills(X, Y):
    return 0.6 * np.sin(X / 2) * np.cos(Y / 3)


def two_shapes(**texture):
    shapes = HeightField(hills, EXTENT), ROOF
    return Scene(shapes, (Texture(0.02, seed=1, side=512, **texture),))


def photographs(scene, positions, noise=2.0):
    """Views that look straight down, and the true points of their pixels."""
    views, truth = [], []
    for k, X0 in enumerate(positions):
        sensor = Sensor(noise=noise, seed=k, gain=1 - 0.1 * k, offset=5.0 * k)
        shot = render(scene, CAMERA, X0, np.eye(3), sensor)
        views.append(FrameView(f"photo_{k}.png", shot.grey, CAMERA, np.array(X0, float), np.eye(3)))
        truth.append(shot.point)
    return views, truth


def undulation(longitude, latitude):
    """A geoid without curvature, so that no interpolation errs."""
    return 47 + 4.0 * (longitude - 10) - 3.0 * (latitude - 45)


def write_geoid(path):
    """The geoid as a grid from 5° to 15° E, 40° to 50° N."""
    step, west, north, n = 0.25, 5.0, 50.0, 41
    x, y = np.meshgrid(west + step * np.arange(n), north - step * np.arange(n))
    transform = rasterio.transform.Affine(step, 0, west - step / 2, 0, -step, north + step / 2)
    with rasterio.open(
        path, "w", driver="GTiff", width=n, height=n, count=1, dtype="float64", crs="EPSG:4326",
        transform=transform,
    ) as raster:  # fmt: skip
        raster.write(undulation(x, y)[None])
    return path
