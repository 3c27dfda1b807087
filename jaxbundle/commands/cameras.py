"""`camera`: the field of view of a camera and its distortion by radius; cameras of files."""

import dataclasses
from pathlib import Path
from typing import Any, Literal

import numpy as np

from jaxbundle.adjustment.quality.expected_difference import Covariance
from jaxbundle.arguments import show
from jaxbundle.calibration.result import Calibration
from jaxbundle.cameras import get_model
from jaxbundle.cameras.distortion_table import distortion_table
from jaxbundle.cameras.field_of_view import (
    FieldOfView,
    angle_class,
    equivalent_35mm,
    field_of_view,
    field_of_view_of_rays,
)
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError
from jaxbundle.io.cameras.camera_files import choose_camera, is_camera_file, read_cameras
from jaxbundle.io.cameras.nearest_camera import with_messages
from jaxbundle.io.cameras.result_json import is_result, read_calibrated
from jaxbundle.io.formats import (
    describe_incomplete,
    expected_inputs,
    read_network,
    recognise_format,
)
from jaxbundle.io.networks.assemble import all_parameters
from jaxbundle.io.results.result_json import without_nan
from jaxbundle.network.tables import Camera
from jaxbundle.results import TableMethods

Pair = tuple[float, float]
# A camera, a calibration, a camera with the covariance of its free parameters; or a file of
# cameras, a network, or the JSON result of `calibrate` or `adjust`, with `#ID` behind it where it
# has several cameras.
CameraSource = Camera | Calibration | tuple[Camera, Covariance] | str | Path

# Rows of a table without a given step: as many as fit a terminal with the lines above them.
TABLE_ROWS = 12
# A step that gives more rows was meant in another unit: 1e-3 pixels are a micrometre or less.
MAX_ROWS = 100_000


def open_camera(source: CameraSource, image_size: Pair | None = None) -> Camera:
    """The camera of a source; `image_size`: pixels, where a file needs it and has none.

    **Raises:** `InputError`.
    """
    return open_calibration(source, image_size)[0]


def open_calibration(
    source: CameraSource, image_size: Pair | None = None
) -> tuple[Camera, Covariance | None]:
    """The camera of a source, with the covariance of its free parameters where the source has it: a
    calibration, or a JSON result. `image_size`: as of `open_camera`.

    **Raises:** `InputError`.
    """
    if isinstance(source, Camera):
        return source, None
    if isinstance(source, Calibration):
        return source.camera, source.adjustment.camera_covariance(source.camera.id)
    if isinstance(source, tuple) and len(source) == 2 and isinstance(source[0], Camera):
        return source
    if not isinstance(source, str | Path):
        raise InputError(f"camera: expected a Camera, a Calibration or a file, got {show(source)}")
    text = str(source)
    file, mark, id = text.rpartition("#")
    if not mark or Path(text).exists():
        file, id = text, None
    path = Path(file)
    covariances = {}
    fault = describe_incomplete(path)
    if fault and not is_camera_file(path) and recognise_format(path) is None:
        raise InputError(f"{path}: {fault}")
    if is_result(path):
        results = read_calibrated(path)
        cameras, covariances = [c for c, _ in results], {c.id: C for c, C in results}
    # A project of oriented photographs alone, as `surface` takes it, has cameras but no points.
    elif is_camera_file(path) or (path.is_file() and recognise_format(path) == "project"):
        cameras = read_cameras(path)
    elif path.exists() and recognise_format(path) is None:
        raise InputError(
            f"{path}: not recognised; expected a camera file, the result.json of calibrate or "
            f"adjust, or a network; {expected_inputs(path)}"
        )
    else:
        network = read_network(path, image_size=image_size)
        cameras = network.cameras
        # Of the whole file: what was not understood may concern each of its cameras.
        cameras = tuple(with_messages(camera, *network.warnings) for camera in cameras)
    camera = choose_camera(cameras, id, f"{file} (FILE#ID)")
    return camera, covariances.get(camera.id)


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class CameraDescription(TableMethods):
    """Field of view and distortion of a camera.

    **Fields:** `camera`; its image and pixel size; `extent` of the image and `step` of the radius
    in the unit of the model; `about`: the origin of the radii.
    """

    camera: Camera
    image_size: Pair
    pixel_size: Pair | None
    extent: Pair
    step: float
    about: Literal["principal point", "origin"]

    @property
    def unit(self) -> str:
        """The unit of radii and distortions: that of the model, mm or px."""
        return get_model(self.camera.model).unit

    @property
    def focal(self) -> list[float]:
        """The principal distance, or one along each axis."""
        values = all_parameters(self.camera)
        return [values[name] for name in get_model(self.camera.model).principal_distance]

    @property
    def field_of_view(self) -> FieldOfView:
        """2·atan(d/2c), radians: horizontal, vertical, diagonal."""
        return field_of_view(self.focal, self.extent)

    @property
    def field_of_view_of_rays(self) -> FieldOfView:
        """By the rays of the image's edges and corners, with distortion, radians."""
        model, values = get_model(self.camera.model), all_parameters(self.camera)
        return field_of_view_of_rays(model, values, self.image_size, self.pixel_size)

    def table(self, step: float | None = None) -> dict[str, np.ndarray]:
        """Distortion (measured − ideal) by radius: columns r, radial, decentring.

        **Raises:** `InputError` for an impossible step."""
        model, reach = get_model(self.camera.model), float(np.hypot(*self.extent) / 2)
        try:
            return distortion_table(
                model, self.camera.parameters, step or self.step, reach, self.about
            )
        except ValueError as error:
            raise InputError(f"--step: {error}") from None

    def to_dict(self) -> dict[str, Any]:
        """The description as plain dicts and numbers; angles in degrees."""
        degrees = lambda view: {
            name: float(np.degrees(angle)) for name, angle in view._asdict().items()
        }
        return without_nan(
            {
                "camera": self.camera.id,
                "model": str(self.camera.model),
                "unit": self.unit,
                "extent": list(self.extent),
                "parameters": dict(all_parameters(self.camera)),
                "field_of_view": degrees(self.field_of_view),
                "field_of_view_of_rays": degrees(self.field_of_view_of_rays),
                "equivalent_35mm": float(equivalent_35mm(self.focal, self.extent)),
                "distortion": {name: c.tolist() for name, c in self.table().items()},
            }
        )

    def __str__(self) -> str:
        """Parameters, field of view and the whole table, in lines."""
        described, unit, extent = self.camera, self.unit, self.extent
        lines = [
            f"camera {described.id!r}, model {described.model}, {extent[0]:g} × {extent[1]:g} "
            f"{unit}"
        ]
        for name, value in all_parameters(described).items():
            if value:
                lines.append(f"{name:22}{value:.8g}")
        views = {"2·atan(d/2c)": self.field_of_view, "by the rays": self.field_of_view_of_rays}
        for name, view in views.items():
            angles = ", ".join(f"{np.degrees(angle):.3f}°" for angle in view)
            text = f"{angles} (horizontal, vertical, diagonal), {name}"
            lines.append(f"{'field of view':22}{text}")
        lines.append(f"{'':22}{angle_class(self.field_of_view.diagonal)}")
        lines.append(
            f"{'35 mm equivalent':22}{equivalent_35mm(self.focal, extent):.2f} mm by the diagonal, "
            f"{equivalent_35mm(self.focal, extent, 'width'):.2f} mm by the width"
        )
        lines.append(f"{'r':>12}{'radial':>12}{'decentring':>12}  [{unit}], measured − ideal")
        for row in zip(*self.table().values()):
            lines.append("".join(f"{value:12.5g}" for value in row))
        return "\n".join(lines)


def camera(
    camera: CameraSource,
    *,
    step: float | None = None,
    about_origin: bool = False,
    image_size: Pair | None = None,
    pixel_size: Pair | None = None,
) -> CameraDescription:
    """Field of view, 35 mm equivalent, and distortion by radius of a camera.

    **Arguments:**

    - `camera`: a `Camera`, a `Calibration`, or a file: FILE or FILE#ID.
    - `step`: of the radius, in the unit of the model; default: twelve rows.
    - `about_origin`: radii from the image origin, as in BINGO, not from the principal point.
    - `image_size`: pixels, and `pixel_size`, mm: where the camera has none.

    **Raises:** `InputError`, for a missing size too.
    """
    opened = open_camera(camera, image_size)
    size, pitch = image_size or opened.image_size, pixel_size or opened.pixel_size
    unit = get_model(opened.model).unit
    if size is None or (unit == "mm" and pitch is None):
        missing_size = "image_size" if size is None else "pixel_size"
        where = f"{camera}: " if isinstance(camera, str | Path) else ""
        raise InputError(
            f"{where}camera {opened.id!r} has no {missing_size}; see --image-size and --pixel-size"
        )
    scale = (1.0, 1.0) if unit == "px" or pitch is None else pitch
    extent = size[0] * scale[0], size[1] * scale[1]
    reach = float(np.hypot(*extent) / 2)
    width = reach / TABLE_ROWS if step is None else step
    if width * MAX_ROWS < reach:
        raise InputError(
            f"--step {width:g}: more than {MAX_ROWS} rows to a radius of {reach:.4g} {unit}"
        )
    about = "origin" if about_origin else "principal point"
    described = CameraDescription(opened, size, pitch, extent, width, about)
    described.table()  # an impossible step is refused here, not when the result is shown
    return described
