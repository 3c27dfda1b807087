"""The input of `calibrate_batch`: checked, turned into principal axes, cut into padded portions."""

import dataclasses
import math
from collections.abc import Iterator

import numpy as np

from jaxbundle.adjustment.batch_normal import Sightings
from jaxbundle.cameras import CameraModel, default_parameters, get_model
from jaxbundle.errors import InputError

FREE = {"opencv": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")}
"""What is free if nothing is said; of other models everything."""

FLAT = 0.02
"""A smaller extent across than this fraction of the second largest: the object starts as flat."""

ON_CPU, ON_ACCELERATOR = 32, 512
"""Cameras of a portion."""


def bucket(n: int) -> int:
    """The next size to pad to: 4, 5, 6, 7, 8, 10, 12, 14, 16, 20, 24, 28, 32, …"""
    step = 2 ** max(0, math.ceil(math.log2(max(n, 4))) - 3)
    return max(4, math.ceil(n / step) * step)


@dataclasses.dataclass(frozen=True)
class Portion:
    """Padded arrays of some cameras, for one call of the compiled program."""

    cameras: np.ndarray
    flat: bool
    seen: Sightings
    interior: np.ndarray
    axes: np.ndarray
    middle: np.ndarray


def check_shapes(X: np.ndarray, xy: np.ndarray, size: np.ndarray, visible: np.ndarray) -> None:
    """Refuse the arrays of a batch whose shapes do not fit each other.

    **Raises:** `InputError`."""
    if xy.ndim != 4 or xy.shape[3] != 2:
        raise InputError(
            f"image_points must have the shape [cameras, views, points, 2], but has {xy.shape}"
        )
    cameras, _, points, _ = xy.shape
    if X.shape not in ((points, 3), (cameras, points, 3)):
        raise InputError(
            f"object_points must have the shape [{points}, 3] or [{cameras}, {points}, 3], as "
            f"image_points has {points} points a view, but has {X.shape}"
        )
    if visible.shape != xy.shape[:3]:
        raise InputError(
            f"visible must have the shape {xy.shape[:3]} of image_points, but has {visible.shape}"
        )
    if not cameras:
        raise InputError("image_points has no camera")
    if size.shape != (2,) or not (np.isfinite(size) & (size > 0)).all():
        raise InputError(
            f"image_size must be width and height in pixels, but is {size.tolist()!r}"
        )


@dataclasses.dataclass(frozen=True)
class Batch:
    """The checked input: object points about their mean and along their principal axes.

    `finite`: all numbers of the camera can be used; the others are not looked at.
    """

    finite: np.ndarray
    point: np.ndarray
    middle: np.ndarray
    axes: np.ndarray
    flat: np.ndarray
    xy: np.ndarray
    visible: np.ndarray
    interior: np.ndarray
    free: tuple[int, ...]
    known: bool
    size: float

    def __len__(self) -> int:
        return len(self.xy)

    @classmethod
    def of(cls, object_points, image_points, image_size, model, visible, free, start):
        model = pixel_model(model)
        xy, X = np.asarray(image_points, float), np.asarray(object_points, float)
        size = np.asarray(image_size, float)
        visible = np.ones(xy.shape[:3], bool) if visible is None else np.asarray(visible)
        check_shapes(X, xy, size, visible)
        cameras = len(xy)
        free = free_parameters(model, free)
        interior, known = _interior(model, free, start, size, cameras)
        visible = visible.astype(bool)
        seen = visible.any(1)
        X = np.where(seen[..., None], X, 0.0)
        xy = np.where(visible[..., None], xy, 0.0)
        finite = np.isfinite(X).all((1, 2)) & np.isfinite(xy).all((1, 2, 3))
        finite &= np.isfinite(interior).all(1)
        X[~finite], xy[~finite] = 0.0, 0.0
        return cls(
            finite, *_principal_axes(X, seen), xy=xy, visible=visible, interior=interior,
            free=tuple(model.parameters.index(name) for name in free), known=known,
            size=float(size.max()),
        )  # fmt: skip

    def portions(self, on_cpu: bool) -> Iterator[Portion]:
        """Cameras in portions, flat and solid objects apart."""
        _, views, points, _ = self.xy.shape
        shape = (bucket(views), bucket(points) if points > 128 else -(-points // 8) * 8)
        size = ON_CPU
        if not on_cpu:
            size = min(ON_ACCELERATOR, 2 ** math.ceil(math.log2(max(len(self), 1))))
        for flat in (True, False):
            cameras = np.flatnonzero(self.flat == flat)
            for first in range(0, len(cameras), size):
                yield self._portion(cameras[first : first + size], flat, size, shape)

    def _portion(self, cameras, flat, size, shape) -> Portion:
        def wide(rows, *axes):
            missing = [n - old for n, old in zip(axes, rows.shape)]
            return np.pad(rows, [(0, n) for n in missing] + [(0, 0)] * (rows.ndim - len(axes)))

        visible = self.visible[cameras] & self.finite[cameras, None, None]
        seen = Sightings(
            point=wide(self.point[cameras], size, shape[1]),
            xy=wide(self.xy[cameras], size, *shape),
            weight=wide(visible.astype(float), size, *shape),
        )
        interior = np.pad(self.interior[cameras], [(0, size - len(cameras)), (0, 0)], mode="edge")
        return Portion(
            cameras, flat, seen, interior,
            wide(self.axes[cameras], size), wide(self.middle[cameras], size),
        )  # fmt: skip

def pixel_model(name: str) -> CameraModel:
    """The camera model of this name, if its unit is the pixel."""
    try:
        model = get_model(name)
    except ValueError as error:
        raise InputError(str(error)) from None
    if model.unit != "px":
        raise InputError(f"model {name!r} is in {model.unit}; a batch needs a camera in pixels")
    return model


def free_parameters(model: CameraModel, free) -> tuple[str, ...]:
    """The parameters to estimate, checked."""
    if free is None:
        free = FREE.get(model.name) or model.parameters
    for name in free:
        if name not in model.parameters or name in model.never_free:
            raise InputError(
                f"free: camera model {model.name!r} has no free parameter {name!r}; "
                f"its parameters are {', '.join(model.parameters)}"
            )
    if not free or len({*free}) < len(free):
        raise InputError("free: name at least one parameter, and each once")
    return tuple(free)


def _interior(model: CameraModel, free, start, size, cameras):
    """Start values [cameras, parameters]; are the focal lengths among them?"""
    values = {name: 1.0 for name in model.principal_distance} | default_parameters(model)
    values |= {name: (n - 1) / 2 for name, n in zip(("cx", "cy"), size) if name in values}
    start = dict(start or {})
    for name in start:
        if name not in values:
            raise InputError(
                f"start: camera model {model.name!r} has no parameter {name!r}; "
                f"its parameters are {', '.join(model.parameters)}"
            )
    given = [name for name in model.principal_distance if name in start]
    missing = [name for name in model.principal_distance if name not in start]
    held = [name for name in missing if name not in free]
    if (given and missing) or held:
        raise InputError(f"start: give {', '.join(missing)} as well")
    try:
        columns = [
            np.broadcast_to(np.asarray((values | start)[name], float), (cameras,))
            for name in model.parameters
        ]
    except (ValueError, TypeError) as error:
        raise InputError(f"start: a number, or one for each of {cameras} cameras") from error
    return np.stack(columns, 1), bool(given)


def _principal_axes(X, seen):
    """Points [cameras, points, 3] about the mean of those seen, along their principal axes; the
    mean; the axes as rows [cameras, 3, 3]; is the object flat?"""
    number = np.maximum(seen.sum(1), 1)[:, None]
    middle = X.sum(1) / number
    centred = np.where(seen[..., None], X - middle[:, None], 0.0)
    values, vectors = np.linalg.eigh(np.einsum("cpi,cpj->cij", centred, centred))
    axes = vectors[:, :, ::-1].swapaxes(1, 2)
    axes = axes * np.linalg.det(axes)[:, None, None]
    flat = values[:, 0] <= np.maximum(FLAT**2 * values[:, 1], 1e-12 * values[:, 2])
    return centred @ axes.swapaxes(1, 2), middle, axes, flat
