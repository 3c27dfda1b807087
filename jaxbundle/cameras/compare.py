r"""The difference of two calibrations of one camera, as a map over the image.

A pixel u has the ray a(u) by calibration A; by B the ray has the image b(·). Two calibrations may
differ by a rotation of the camera frame without effect on any photograph, since every exterior
orientation absorbs it: a shift of the principal point is nearly one. The implied rotation is
removed,

    d(u) = b(exp([θ]×)·a(u)) − u,        Σ |d(u)|² → min over θ

and d is the remaining difference of the images of one object.

Source: the differencing of mrcal (Kogan), here at infinity, by least squares over the whole image.
"""

import dataclasses
from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.cameras.catalogue import get_model
from jaxbundle.cameras.convert import Area, image_area
from jaxbundle.cameras.convert_fit import GRID, come_back, image_grid, images_of, rays_of
from jaxbundle.cameras.model import CameraModel, project
from jaxbundle.cameras.parameters import default_parameters
from jaxbundle.cameras.pixel_frame import between_frames
from jaxbundle.display import data_set, print_in_one_screen
from jaxbundle.float64 import local_x64
from jaxbundle.geometry import matrix_from_rotation_vector
from jaxbundle.leastsquares.iterations.small import minimise
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray, Numbers


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class Comparison:
    """A difference map, in the unit and axes of the first calibration.

    `x` [columns], `y` [rows] of the grid; `difference` [rows, columns, 2], NaN if one of the
    calibrations has no ray or image; `rotation` θ, radians, removed; `rms` and `largest` lengths of
    the differences, `where` the position of the largest; `covered`: the part of the grid with
    values.
    """

    unit: str
    x: Float[np.ndarray, " columns"]
    y: Float[np.ndarray, " rows"]
    difference: Float[np.ndarray, "rows columns 2"]
    rotation: Float[np.ndarray, "3"]
    rms: float
    largest: float
    where: tuple[float, float]
    covered: float

    @property
    def length(self) -> Float[np.ndarray, "rows columns"]:
        """Lengths of the differences."""
        return np.linalg.norm(self.difference, axis=2)

    def to_xarray(self) -> Any:
        """The difference along both axes and its length over x and y of the image, as an
        `xarray.Dataset` (extra `grids`)."""
        dims, d = ("y", "x"), self.difference
        return data_set(
            {
                "dx": (dims, d[..., 0], self.unit),
                "dy": (dims, d[..., 1], self.unit),
                "length": (dims, self.length, self.unit),
            },
            {"y": (self.y, self.unit), "x": (self.x, self.unit)},
            rotation_removed=self.rotation,
            rms=self.rms,
        )

    def __str__(self) -> str:
        x, y = self.where
        angles = ", ".join(f"{angle:.2f}" for angle in np.degrees(self.rotation) * 3600)
        return (
            f"RMS difference {self.rms:.4g} {self.unit}, largest {self.largest:.4g} {self.unit} at "
            f"({x:.4g}, {y:.4g}); rotation removed: {angles} arc seconds about x, y, z"
        )


def compare_cameras(
    a: tuple[str | CameraModel, Mapping[str, float]],
    b: tuple[str | CameraModel, Mapping[str, float]],
    *,
    image_size: Numbers | None = None,
    pixel_size: Numbers | None = None,
    area: Area | None = None,
    rotate: bool = True,
    radius: float = np.inf,
) -> Comparison:
    """The differences between images of two calibrations, with the implied rotation removed.

    **Arguments:**

    - `a`, `b`: model, or its name, and parameters by name (those left out have their defaults).
    - `image_size` (pixels), `pixel_size` (mm): required if the models differ in unit or axes, or
      to determine the area.
    - `area`: corners (low, high) of the part of the image to compare, in a's coordinates.
    - `rotate`: False: nothing is removed.
    - `radius`: the rotation is fitted within this radius of the centre of the area: where both
      calibrations had measurements.

    **Raises:** `ValueError` naming a missing size, or if nothing can be compared.
    """
    (source, values), (other, others) = (
        (model, {**default_parameters(model), **given})
        for model, given in (
            (get_model(model) if isinstance(model, str) else model, given)
            for model, given in (a, b)
        )
    )
    low, high = area or image_area(source, image_size, pixel_size)
    xy = image_grid(low, high)
    shift, step = between_frames(other, source, image_size, pixel_size)
    rays = rays_of(source, values, xy)
    is_seen = come_back(source, values, xy, rays) & _are_one_to_one(other, others, rays)
    if is_seen.sum() < 3:
        raise ValueError("no part of the image has a ray in both calibrations")
    # Beyond the measurements a calibration extrapolates: differences there would turn the frame.
    is_near = is_seen & (np.linalg.norm(xy - xy.mean(0), axis=1) <= radius)
    if rotate and is_near.sum() < 3:
        raise ValueError(f"a radius of {radius:g} {source.unit} holds too few points to fit")
    p = np.array([others[name] for name in other.parameters], float)
    rotation = np.zeros(3)
    target = (xy - shift) / step
    with local_x64():
        if rotate:
            # In the unit of the first calibration, whatever that of the second is.
            weight = is_near[:, None] * np.abs(step)
            rotation = np.array(_best_turn(other, p, rays, target, weight))
        turned = np.array(_turn(other, p, rotation, rays))
    difference = np.where(is_seen[:, None], shift + step * turned - xy, np.nan)
    return _as_comparison(source.unit, xy, difference, rotation)


def _as_comparison(
    unit: str,
    xy: Float[np.ndarray, "points 2"],
    difference: Float[np.ndarray, "points 2"],
    rotation: Float[np.ndarray, "3"],
) -> Comparison:
    """The map of differences at the points of `image_grid`."""
    length = np.linalg.norm(difference, axis=1)
    is_known = np.isfinite(length)
    worst = int(np.nanargmax(length))
    columns, rows = GRID
    grid = xy.reshape(rows, columns, 2)
    return Comparison(
        unit,
        grid[0, :, 0],
        grid[:, 0, 1],
        difference.reshape(rows, columns, 2),
        rotation,
        float(np.sqrt(np.mean(length[is_known] ** 2))),
        float(length[worst]),
        tuple(xy[worst].tolist()),
        float(is_known.mean()),
    )


def difference_rings(comparison: Comparison, step: float) -> dict[str, np.ndarray]:
    """The differences by their distance from the image centre, in rings of a width.

    **Returns:** columns r (outer radius of the ring), radial and tangential (means over the ring,
    outward and counter-clockwise in the axes of the map), rms, largest, points.

    **Raises:** `ValueError` if the width is not positive.
    """
    if not (np.isfinite(step) and step > 0):
        raise ValueError(f"the width of rings is {step}; it must be positive")
    x, y = np.meshgrid(comparison.x - comparison.x.mean(), comparison.y - comparison.y.mean())
    r = np.hypot(x, y).ravel()
    d = comparison.difference.reshape(-1, 2)
    is_known = np.isfinite(d).all(1)
    r, d, x, y = r[is_known], d[is_known], x.ravel()[is_known], y.ravel()[is_known]
    ring = np.floor(r / step).astype(int)
    # At the centre itself no direction is outward: 0.
    out = np.stack([x, y], 1) / np.maximum(r, 1e-300)[:, None]
    radial, tangential = (d * out).sum(1), out[:, 0] * d[:, 1] - out[:, 1] * d[:, 0]
    rings = np.unique(ring)
    in_rings = lambda function, v: np.array([function(v[ring == k]) for k in rings])
    length = np.hypot(*d.T)
    return {
        "r": (rings + 1) * step,
        "radial": in_rings(np.mean, radial),
        "tangential": in_rings(np.mean, tangential),
        "rms": in_rings(lambda v: np.sqrt(np.mean(v**2)), length),
        "largest": in_rings(np.max, length),
        "points": in_rings(len, length),
    }


def _are_one_to_one(
    model: CameraModel, values: Mapping[str, float], rays: Float[np.ndarray, "points 3"]
) -> np.ndarray:
    """Which rays have an image that belongs to no other ray: a polynomial turns back, and beyond
    that radius its images are those of rays nearer to the axis."""
    images = images_of(model, values, rays)
    has_image = np.all(np.isfinite(images), axis=1)
    rays_back = rays_of(model, values, np.where(has_image[:, None], images, np.nan))
    unit = lambda v: v / np.linalg.norm(v, axis=1, keepdims=True)
    # 1e-6 radians: far more than the inverse's rounding, far less than the way to another branch.
    return has_image & (np.linalg.norm(unit(rays_back) - unit(rays), axis=1) < 1e-6)


@partial(compile_once, static=0)
def _turn(
    model: CameraModel,
    p: Float[AnyArray, " parameters"],
    rotation: Float[AnyArray, "3"],
    rays: Float[AnyArray, "points 3"],
) -> Float[Array, "points 2"]:
    """Images of the rotated rays [n, 2]."""
    R = matrix_from_rotation_vector(rotation)
    return jax.vmap(lambda ray: jnp.stack(project(model, tuple(p), *(R @ ray))))(rays)


@partial(compile_once, static=0)
def _best_turn(
    model: CameraModel,
    p: Float[AnyArray, " parameters"],
    rays: Float[AnyArray, "points 3"],
    xy: Float[AnyArray, "points 2"],
    weight: Float[AnyArray, "points 2"],
) -> Float[Array, "3"]:
    """θ that minimises the distances of the images of the rays to xy; rays of weight 0 may have no
    image."""

    def misclosures(
        rotation: Float[AnyArray, "3"],
        rays: Float[AnyArray, "points 3"],
        xy: Float[AnyArray, "points 2"],
        weight: Float[AnyArray, "points 2"],
    ) -> Float[Array, " equations"]:
        d = weight * (_turn(model, p, rotation, rays) - xy)
        # `where`: NaN · 0 is NaN.
        return jnp.where((weight > 0) & jnp.isfinite(xy), d, 0.0).ravel()

    return minimise(misclosures, jnp.add, jnp.zeros(3), (rays, xy, weight), 3)[0]
