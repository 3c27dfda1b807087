"""The input of `calibrate_batch`: checked, turned into principal axes, cut into padded portions."""

import dataclasses
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbundle.arguments import numeric_array
from jaxbundle.batches.normal import Sightings
from jaxbundle.cameras import CameraModel, check_own, default_parameters, get_model, is_own
from jaxbundle.errors import InputError
from jaxbundle.io.text.stored_rows import StoredRows

# Larger numbers count as infinite: products of more than three of them overflow 64 bits.
LARGEST_NUMBER = 1e100


@dataclasses.dataclass(frozen=True)
class PortionSettings:
    """How cameras are cut into portions, calls of one compiled program.

    **Fields:**

    - `cameras_on_cpu`: of a portion on a processor, which takes them one after the other: enough to
      hide the call, few enough to share the work among the cores.
    - `points_on_accelerator`: padded image points of a portion on an accelerator: their Jacobian is
      2.3 GB.
    - `points_worth_compiling`: padded points that cost as much as compiling for another number of
      views: 2 to 3 s.
    """

    cameras_on_cpu: int = 32
    points_on_accelerator: int = 1 << 23
    points_worth_compiling: int = 4_000_000


def bucket(n: int) -> int:
    """The next size to pad to: 4, 5, 6, 7, 8, 10, 12, 14, 16, 20, 24, 28, 32, …

    Four for a factor of two: at most a quarter more, and a batch has a few programs."""
    step = 2 ** max(0, math.ceil(math.log2(max(n, 4))) - 3)
    return max(4, math.ceil(n / step) * step)


@dataclasses.dataclass(frozen=True)
class Portion:
    """Padded arrays of some cameras, for one call of the compiled program.

    `views` [cameras, n]: the numbers of the views that are there, all that show anything.
    """

    cameras: np.ndarray
    views: np.ndarray
    flat: bool
    sightings: Sightings
    interior: np.ndarray
    axes: np.ndarray
    middle: np.ndarray


def single_list(X: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Object points listed for every view, as for OpenCV, reduced to one list if all are equal."""
    if xy.ndim != 4 or X.shape in (xy.shape[2:3] + (3,), xy.shape[::2] + (3,)):
        return X
    cameras, views, points, _ = xy.shape
    if X.shape in ((1, points, 3), (views, points, 3), (cameras, views, points, 3)):
        first_view = X[..., :1, :, :]
        if np.array_equal(X, np.broadcast_to(first_view, X.shape), equal_nan=True):
            return first_view[..., 0, :, :]
        raise InputError(
            "object_points differ from view to view; give the points of all views as one list "
            "[points, 3], and by visible which of them a view shows"
        )
    return X


def check_shapes(
    X: np.ndarray | StoredRows,
    xy: np.ndarray | StoredRows,
    size: np.ndarray,
    visible: np.ndarray | StoredRows,
) -> None:
    """Refuse the arrays of a batch, or what has their shapes, where these do not fit each other.

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
    for number, noun in zip(xy.shape, ("camera", "view", "point")):
        if not number:
            raise InputError(f"image_points has no {noun}: its shape is {xy.shape}")
    if visible.dtype.kind != "b" and not np.isin(np.asarray(visible), (0, 1)).all():
        raise InputError("visible must be true or false, or 1 or 0")
    if size.shape != (2,) or not (np.isfinite(size) & (size > 0)).all():
        raise InputError(
            f"image_size must be width and height in pixels, but is {str(size.tolist())[:80]}"
        )


@dataclasses.dataclass(frozen=True)
class Batch:
    """The checked input: object points about their mean and along their principal axes.

    `finite`: all numbers of the camera are usable; other cameras are skipped.
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
    has_focal_length: bool
    image_size: np.ndarray

    @property
    def size(self) -> float:
        """A length of the image, pixels."""
        return float(self.image_size.max())

    def __len__(self) -> int:
        return len(self.xy)

    @classmethod
    def check(
        cls,
        object_points: Any,
        image_points: Any,
        image_size: Any,
        model: str | CameraModel,
        visible: Any,
        free: Any,
        start: Any,
    ) -> "Batch":
        """The arguments of `calibrate_batch`.

        **Raises:** `InputError`."""
        model = pixel_model(model)
        xy = numeric_array("image_points", image_points, "numbers [cameras, views, points, 2]")
        X = single_list(numeric_array("object_points", object_points, "numbers [points, 3]"), xy)
        size = numeric_array("image_size", image_size, "width and height in pixels")
        if visible is None:
            visible = np.ones(xy.shape[:3], bool)
        visible = numeric_array(
            "visible", visible, "true or false [cameras, views, points]", truths=True
        )
        check_shapes(X, xy, size, visible)
        # Single precision stays until a portion is on the device: half of the memory.
        xy = xy if xy.dtype in (np.float32, np.float64) else xy.astype(float)
        cameras = len(xy)
        free = free_parameters(model, free)
        interior, has_focal_length = _interior(model, free, start, size, cameras)
        # NaN is a missing point; infinite numbers are a fault of the camera, and end in its status
        has_coordinates = ~np.any(np.isnan(X), axis=-1)
        # x and y apart: numpy's `any` over an axis of two takes ten times as long
        is_missing = np.isnan(xy[..., 0]) | np.isnan(xy[..., 1])
        visible = visible.astype(bool) & ~is_missing & has_coordinates[..., None, :]
        is_seen = np.any(visible, axis=1)
        X = np.where(is_seen[..., None], X.astype(float), 0.0)
        if not visible.all():
            xy = np.where(visible[..., None], xy, 0.0)
        finite = _usable(X) & _usable(xy) & _usable(interior)
        if not finite.all():
            X[~finite], xy = 0.0, np.where(finite[:, None, None, None], xy, 0.0)
        return cls(
            finite,
            *_principal_axes(X, is_seen),
            xy=xy,
            visible=visible,
            interior=interior,
            free=tuple(model.parameters.index(name) for name in free),
            has_focal_length=has_focal_length,
            image_size=size.astype(float),
        )

    def portions(self, on_cpu: bool, settings: PortionSettings | None = None) -> Iterator[Portion]:
        """Cameras in portions, separated by planar and spatial objects, and by number of views."""
        settings = settings or PortionSettings()
        points = self.xy.shape[2]
        # Few points: to whole vectors of 8 doubles, which cost nothing.
        points = bucket(points) if points > 128 else -(-points // 8) * 8
        is_shown = self.visible.any(2) & self.finite[:, None]
        widths = self._widths(is_shown.sum(1), points, settings.points_worth_compiling)
        size = settings.cameras_on_cpu
        if not on_cpu:
            max_cameras = settings.points_on_accelerator / (max(widths, default=1) * points)
            power = math.log2(max(max_cameras, 1))
            size = 2 ** min(math.floor(power), math.ceil(math.log2(max(len(self), 1))))
        for flat in (True, False):
            for width in np.unique(widths):
                cameras = np.flatnonzero((self.flat == flat) & (widths == width))
                for begin in range(0, len(cameras), size):
                    cameras_of_portion = cameras[begin : begin + size]
                    views = np.argsort(~is_shown[cameras_of_portion], axis=1, kind="stable")[
                        :, :width
                    ]
                    yield self._portion(
                        cameras_of_portion, np.sort(views), flat, size, (width, points)
                    )

    def _widths(
        self, views: Int[np.ndarray, " cameras"], points: int, worth_compiling: int
    ) -> Int[np.ndarray, " cameras"]:
        """The padded number of views of each camera: cameras with fewer views are separated if this
        saves more than the compilation of another program costs."""
        need = np.array([bucket(number) for number in views])
        width = bucket(self.xy.shape[1])
        widths = np.full(len(need), width)
        for fewer in np.unique(need)[::-1]:
            if (need <= fewer).sum() * (width - fewer) * points > worth_compiling:
                width = fewer
            widths[need <= fewer] = width
        return widths

    def _portion(
        self,
        cameras: Int[np.ndarray, " some"],
        views: Int[np.ndarray, "some width"],
        flat: bool,
        size: int,
        shape: tuple[int, int],
    ) -> Portion:
        def wide(rows: np.ndarray, *axes: int) -> np.ndarray:
            if rows.shape[: len(axes)] == axes:
                return rows
            rows_missing = [n - old for n, old in zip(axes, rows.shape)]
            return np.pad(rows, [(0, n) for n in rows_missing] + [(0, 0)] * (rows.ndim - len(axes)))

        # Neighbours are not copied: of 10 000 cameras the new memory costs more than the numbers.
        neighbours = cameras[-1] - cameras[0] == len(cameras) - 1
        camera_rows = slice(cameras[0], cameras[-1] + 1) if neighbours else cameras
        in_order = np.array_equal(views, np.broadcast_to(np.arange(views.shape[1]), views.shape))
        of_views = lambda rows: (
            rows[camera_rows, : views.shape[1]] if in_order else rows[cameras[:, None], views]
        )
        visible = of_views(self.visible) & self.finite[cameras, None, None]
        sightings = Sightings(
            point=wide(self.point[cameras], size, shape[1]),
            xy=wide(of_views(self.xy), size, *shape),
            weight=wide(visible.astype(np.float32), size, *shape),
        )
        # Cameras that fill up the portion have the start values of the last one, and no points.
        interior = np.pad(self.interior[cameras], [(0, size - len(cameras)), (0, 0)], mode="edge")
        return Portion(
            cameras,
            views,
            flat,
            sightings,
            interior,
            wide(self.axes[cameras], size),
            wide(self.middle[cameras], size),
        )


def _usable(numbers: Float[np.ndarray, "cameras *axes"]) -> Bool[np.ndarray, " cameras"]:
    """Whether all numbers of a camera are finite, and so are sums of their squares."""
    of_camera = tuple(range(1, numbers.ndim))
    low, high = numbers.min(of_camera).astype(float), numbers.max(of_camera).astype(float)
    return (low > -LARGEST_NUMBER) & (high < LARGEST_NUMBER)


def any_model(name: str | CameraModel) -> CameraModel:
    """The camera model with this name, or a user-defined one.

    **Raises:** `InputError`."""
    if not isinstance(name, str | CameraModel):
        raise InputError(
            f"model must be a name, such as 'opencv', or a CameraModel, but is {name!r}"
        )
    try:
        model = get_model(name)
        if is_own(model):
            check_own(model)
    except ValueError as error:
        raise InputError(str(error)) from None
    return model


def is_plain(model: CameraModel) -> bool:
    """Whether `calibrate_batch` has its layout: pixels, and no priors."""
    return model.unit == "px" and not model.prior


def pixel_model(name: str | CameraModel) -> CameraModel:
    """The camera model with this name, or a user-defined one, if `calibrate_batch` has its layout.

    **Raises:** `InputError`."""
    model = any_model(name)
    if model.unit != "px":
        raise InputError(
            f"model {model.name!r} is in {model.unit}; calibrate_batch needs a camera in pixels; "
            "calibrate_rigs takes any"
        )
    if model.prior:
        raise InputError(
            f"model {model.name!r} needs priors of its parameters, which calibrate_batch does not "
            "support; calibrate_rigs does"
        )
    return model


def free_parameters(model: CameraModel, free: Any) -> tuple[str, ...]:
    """The parameters to estimate, checked."""
    if free is None:
        free = model.free
    one_by_one = isinstance(free, Iterable) and getattr(free, "ndim", 1) == 1
    if isinstance(free, str | bytes) or not one_by_one:
        raise InputError(f"free must be a list of names, such as ['fx', 'fy'], but is {free!r}")
    free = list(free)
    for name in free:
        if name not in model.parameters or name in model.never_free:
            raise InputError(
                f"free: camera model {model.name!r} has no free parameter {name!r}; "
                f"its parameters are {', '.join(model.parameters)}"
            )
    if not free or len({*free}) < len(free):
        raise InputError("free: expected at least one parameter, and each only once")
    return tuple(free)


def _interior(
    model: CameraModel,
    free: Sequence[str],
    start: Any,
    size: Float[np.ndarray, "2"],
    cameras: int,
) -> tuple[Float[np.ndarray, "cameras parameters"], bool]:
    """Start values [cameras, parameters]; are the focal lengths among them?"""
    values = {name: 1.0 for name in model.principal_distance} | default_parameters(model)
    if model.axes == "down":  # else the principal point is near zero
        values |= {name: (n - 1) / 2 for name, n in zip(model.principal_point, size)}
    start = {} if start is None else start
    if not isinstance(start, Mapping):
        raise InputError(f"start must be like {{'fx': 900.0, 'fy': 900.0}}, but is {start!r:.80}")
    for name in start:
        if name not in values:
            raise InputError(
                f"start: camera model {model.name!r} has no parameter {name!r}; "
                f"its parameters are {', '.join(model.parameters)}"
            )
    names_given = [name for name in model.principal_distance if name in start]
    missing_names = [name for name in model.principal_distance if name not in start]
    held_names = [name for name in missing_names if name not in free]
    if held_names and not names_given:
        raise InputError(
            f"held without a value: {', '.join(held_names)}; free them, or give their start values"
        )
    if (names_given and missing_names) or held_names:
        raise InputError(f"start: give {', '.join(missing_names)} as well")
    number = f"a number, or one for each of {cameras} cameras"
    columns = []
    for name in model.parameters:
        column = numeric_array(f"start: {name}", {**values, **start}[name], number)
        if column.shape not in ((), (1,), (cameras,)):
            raise InputError(f"start: {name} must be {number}, but has the shape {column.shape}")
        if name in model.principal_distance and (column <= 0).any():
            raise InputError(f"start: {name} must be positive")
        columns.append(np.broadcast_to(column.astype(float), (cameras,)))
    return np.stack(columns, 1), bool(names_given)


def _principal_axes(
    X: Float[np.ndarray, "*cameras points 3"], is_seen: Bool[np.ndarray, "*cameras points"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Points [cameras, points, 3] about the mean of those seen, along their principal axes; the
    mean; the axes as rows [cameras, 3, 3]; is the object flat?"""
    if len(X) > 1 and (is_seen == is_seen[0]).all() and (X == X[0]).all():
        a, b, c, d = (
            np.broadcast_to(x, (len(X), *x.shape[1:])) for x in _principal_axes(X[:1], is_seen[:1])
        )
        return a, b, c, d
    number = np.maximum(is_seen.sum(1), 1)[:, None]
    middle = X.sum(1) / number
    centred = np.where(is_seen[..., None], X - middle[:, None], 0.0)
    values, vectors = np.linalg.eigh(np.einsum("cpi,cpj->cij", centred, centred))
    # The longest first, right-handed: a flat object lies in the plane Z = 0, as `start` needs it.
    axes = vectors[:, :, ::-1].swapaxes(1, 2)
    axes = axes * np.linalg.det(axes)[:, None, None]
    # Flat with a thickness below 2 % of the second extent: start values of H, which neglect it, are
    # then nearer than those of P, which hardly follow from it; larger or smaller: not critical,
    # both are adjusted. Or on a line, to rounding.
    flat = values[:, 0] <= np.maximum(0.02**2 * values[:, 1], 1e-12 * values[:, 2])
    return centred @ axes.swapaxes(1, 2), middle, axes, flat
