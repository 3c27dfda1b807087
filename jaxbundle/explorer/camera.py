"""The camera explorer: the effect of its parameters on the image, by its projection function.

The grid: rays with a regular image by the original camera without distortion (grey,
straight lines), and their images with the current parameters. The curve: radial
distortion, measured − ideal, with that of the original camera. A photograph is undistorted
by looking up the image of the ray of every pixel of a perspective image with the same principal
distance.
"""

import base64
import dataclasses
from collections.abc import Mapping
from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from jaxbundle.cameras import check_parameters, default_parameters, get_model, project
from jaxbundle.cameras.convert import image_area
from jaxbundle.cameras.convert_fit import images_of
from jaxbundle.cameras.field_of_view import field_of_view_of_rays
from jaxbundle.cameras.model import CameraModel
from jaxbundle.cameras.pixel_frame import pixel_frame
from jaxbundle.errors import InputError
from jaxbundle.explorer.page import (
    Number,
    draw_controls,
    draw_tools,
    make_page,
    place,
    with_value,
)
from jaxbundle.explorer.view import File, Given, check_keys, number
from jaxbundle.io.networks.project import cameras_text
from jaxbundle.network.tables import Camera
from jaxbundle.photographs.opencv import need_opencv
from jaxbundle.plotting.distortion import distortion_at
from jaxbundle.plotting.style import micrometres
from jaxbundle.report.camera_equations import camera_equations
from jaxbundle.report.layout import clean, digits_of, significant
from jaxbundle.report.page import UNKNOWN, Origin, Page, Section
from jaxbundle.report.page.charts import Curve, draw_curves, draw_plan
from jaxbundle.report.page.markup import figure, grid, items, paragraph

Radii = Float[np.ndarray, " radii"]
# Radial distortion and decentring.
Distortion = Float[np.ndarray, "2 radii"]
Lattice = Float[np.ndarray, "rows columns 2"]


class CameraView:
    """A camera with the size of its image.

    **Arguments:** `sigma`: of its free parameters, where it comes from a calibration; `photograph`:
    red, green, blue, of the camera's image size.

    **Raises:** `InputError` without the size of the image, of a model in mm that of a pixel.
    """

    def __init__(
        self,
        camera: Camera,
        sigma: Mapping[str, float] | None = None,
        photograph: UInt8[np.ndarray, "rows columns 3"] | None = None,
        origin: Origin = UNKNOWN,
    ):
        self.camera, self.sigma, self.origin = camera, dict(sigma or {}), origin
        self.model, self.photograph = get_model(camera.model), photograph
        self.values = {
            **dict.fromkeys(self.model.parameters, 0.0),
            **default_parameters(self.model),
            **{name: float(value) for name, value in camera.parameters.items()},
        }
        if camera.image_size is None:
            raise InputError(f"camera {camera.id!r} has no image_size; see --image-size")
        self.size = camera.image_size
        if photograph is not None and photograph.shape[1::-1] != tuple(self.size):
            columns, rows = photograph.shape[1::-1]
            raise InputError(
                f"the photograph has {columns} × {rows} pixels, camera {camera.id!r} "
                f"{self.size[0]} × {self.size[1]}"
            )
        try:
            self.low, self.high = image_area(self.model, camera.image_size, camera.pixel_size)
            self.origin_of_pixels, self.step = pixel_frame(
                self.model, camera.image_size, camera.pixel_size
            )
        except ValueError as error:
            raise InputError(f"camera {camera.id!r}: {error}; see --pixel-size") from None

    # --- values -----------------------------------------------------------------------------

    def parameters(self, given: Given) -> dict[str, float]:
        """All parameters by name, by default those of the camera.

        **Raises:** `InputError`."""
        check_keys(given, self.values)
        parameters = {name: number(given, name, value) for name, value in self.values.items()}
        try:
            check_parameters(self.model, parameters)
        except ValueError as error:
            raise InputError(str(error)) from None
        return parameters

    @property
    def reach(self) -> float:
        """Half the diagonal of the image, in the unit of the model."""
        return float(np.hypot(*(self.high - self.low)) / 2)

    @cached_property
    def _controls(self) -> list[Number]:
        """A slider for every parameter, as long as it takes to move a corner visibly."""
        # Near a corner, where distortion is large, but inside what most lenses image.
        place = (self.low + self.high) / 2 + np.array([0.7, 0.6]) * (self.high - self.low) / 2
        p = jnp.array([*self.values.values()])
        slopes = np.hypot(*np.asarray(_slopes(self.model, p, place)))
        controls = []
        for name, slope in zip(self.values, slopes):
            value, ranges = self.values[name], dict(self.model.ranges)
            # Half a slider moves that place by 4 % of the half diagonal: seen, and undone, at once.
            length = 0.04 * self.reach / slope if slope > 0 and np.isfinite(slope) else 1.0
            low, high = value - length, value + length
            if name in self.model.principal_distance:
                low = max(low, 0.1 * value)  # at 0 there is no image
            if name in ranges:
                low, high = max(low, ranges[name][0]), min(high, ranges[name][1])
            note = f"σ {significant(self.sigma[name])}" if name in self.sigma else ""
            controls.append(Number(name, name, value, note, float(low), float(high)))
        return controls

    # --- what the server asks ---------------------------------------------------------------

    def answer(self, given: Given) -> dict[str, Any]:
        """`parts`; `radius`, `radial`, `decentring`: the curves; `grid` [lines, points, 2], and how
        far the image moves: `rms`, `largest`."""
        values = self.parameters(given)
        radius, distortion_now, distortion_before = self._curves(values)
        straight, lattice = self._grids(values)
        displacement = lattice - self._grids(self.values)[1]
        length = np.hypot(displacement[..., 0], displacement[..., 1])
        is_finite = np.isfinite(length)
        rms = float(np.sqrt(np.mean(length[is_finite] ** 2))) if is_finite.any() else float("nan")
        largest = float(length[is_finite].max()) if is_finite.any() else float("nan")
        parts = {
            "curve": self._draw_curve(radius, distortion_now, distortion_before),
            "grid": self._draw_grid(straight, lattice, rms, largest),
            "numbers": self._list(values, radius, distortion_now, distortion_before),
        }
        if self.photograph is not None:
            parts["photo"] = self._draw_photograph(self.photograph, values)
        return {
            "parts": parts,
            "radius": radius.tolist(),
            "radial": distortion_now[0].tolist(),
            "decentring": distortion_now[1].tolist(),
            "grid": lattice.tolist(),
            "rms": rms,
            "largest": largest,
        }

    def export(self, name: str, given: Given) -> File:
        """`camera.toml`: the camera with these parameters.

        **Raises:** `InputError`."""
        if name != "camera.toml":
            raise InputError(f"there is no file {name!r}; camera.toml is one")
        camera = dataclasses.replace(self.camera, parameters=self.parameters(given))
        return File(name, "application/toml", cameras_text([camera]).encode())

    def page(self, given: Given, live: bool) -> Page:
        """Sliders, curve, grid and photograph."""
        values = self.parameters(given)
        controls = [with_value(control, values[control.key]) for control in self._controls]
        sections = [
            Section(
                "parameters",
                "Parameters",
                "".join(
                    [
                        paragraph(
                            f"Camera {clean(self.camera.id)}, model {self.model.name}, "
                            f"{self.size[0]} × {self.size[1]} pixels."
                        ),
                        items(camera_equations(self.model)),
                        draw_controls(controls, live),
                        draw_tools(live, {"Camera file": "camera.toml"}),
                        place("numbers"),
                    ]
                ),
            ),
            Section("distortion", "Distortion", place("curve"), "Distortion"),
            Section("grid-section", "Grid", place("grid"), "Grid"),
        ]
        if self.photograph is not None:
            sections.append(
                Section("photo-section", "Undistorted photograph", place("photo"), "Photograph")
            )
        title = f"camera {clean(self.camera.id)}: explorer"
        return make_page(
            title,
            sections,
            self.origin,
            live,
            "camera",
            self.answer(given),
            [("model", self.model.name)],
            given=values,
        )

    # --- drawings ---------------------------------------------------------------------------

    def _curves(
        self, values: Mapping[str, float], radii: int = 61
    ) -> tuple[Radii, Distortion, Distortion]:
        """Radius, and radial distortion and decentring [2, radii] of these values and as given."""
        radius = np.linspace(0, self.reach, radii)
        distortion_of = lambda p: distortion_at(self.model, np.array([*p.values()]), radius)[0]
        return radius, distortion_of(values), distortion_of(self.values)

    def _grids(
        self, values: Mapping[str, float], lines: tuple[int, int] = (13, 9)
    ) -> tuple[Lattice, Lattice]:
        """The images of evenly spaced rays by the given camera without distortion, and with these
        values, at `lines` across and down; NaN where there is no image."""
        axes = [np.linspace(a, b, n) for a, b, n in zip(self.low, self.high, lines)]
        xy = np.stack(np.meshgrid(*axes), -1)
        rays = _plain_rays(self.model, self.values, xy)
        images = images_of(self.model, values, rays.reshape(-1, 3))
        return xy, images.reshape(xy.shape)

    def _draw_curve(
        self, radius: Radii, distortion_now: Distortion, distortion_before: Distortion
    ) -> str:
        scale, unit = micrometres(self.model.unit)
        curves = [
            Curve("as given", radius, scale * distortion_before[0], None, "second"),
            Curve("symmetric radial", radius, scale * distortion_now[0]),
        ]
        return figure(
            draw_curves(
                curves,
                f"distance from the principal point [{self.model.unit}]",
                f"measured − ideal [{unit}]",
            ),
            "Symmetric radial distortion, to the half diagonal of the image",
        )

    def _draw_grid(self, straight: Lattice, lattice: Lattice, rms: float, largest: float) -> str:
        scale, unit = micrometres(self.model.unit)
        lines = []
        for places, label, kind in (
            (straight, "without distortion, as given", "given"),
            (lattice, "with these parameters", "first"),
        ):
            for part in (places, places.swapaxes(0, 1)):
                lines += [Curve(label, line[:, 0], line[:, 1], None, kind) for line in part]
        unit_of_axes = self.model.unit
        drawing = draw_plan(
            lines, f"x [{unit_of_axes}]", f"y [{unit_of_axes}]", y_down=self.model.axes == "down"
        )
        return figure(
            drawing,
            f"Image displacement relative to the original camera: RMS "
            f"{significant(scale * rms)} {unit}, at most {significant(scale * largest)} {unit}",
        )

    def _list(
        self,
        values: Mapping[str, float],
        radius: Radii,
        distortion_now: Distortion,
        distortion_before: Distortion,
        steps: int = 6,
    ) -> str:
        rows = []
        for name, value in values.items():
            value_before, sigma = self.values[name], self.sigma.get(name, 0)
            change = value - value_before
            by_sigma = significant(change / sigma) if sigma > 0 else ""
            both_values = (significant(x, digits_of(x, sigma)) for x in (value_before, value))
            rows.append((name, *both_values, significant(change), by_sigma))
        table = grid(("parameter", "as given", "now", "difference", "difference/σ"), rows)
        view = field_of_view_of_rays(self.model, values, self.size, self.camera.pixel_size)
        degrees = ", ".join(f"{np.degrees(angle):.3f}°" for angle in view)
        scale, unit = micrometres(self.model.unit)
        radii_listed = np.linspace(0, len(radius) - 1, steps + 1).astype(int)[1:]
        rows = [
            (
                f"{radius[k]:.4g}",
                *(
                    significant(scale * x[k])
                    for x in (distortion_before[0], distortion_now[0], distortion_now[1])
                ),
            )
            for k in radii_listed
        ]
        header = (
            f"radius [{self.model.unit}]",
            f"radial as given [{unit}]",
            f"radial [{unit}]",
            f"decentring [{unit}]",
        )
        return "".join(
            [
                table,
                paragraph(f"Field of view {degrees} (horizontal, vertical, diagonal)."),
                grid(header, rows),
            ]
        )

    def _draw_photograph(
        self, photograph: UInt8[np.ndarray, "r c 3"], values: Mapping[str, float]
    ) -> str:
        cv2 = need_opencv()
        u, v = (x.astype(np.float32) for x in self._lookup(photograph.shape[:2], values))
        picture = cv2.remap(
            photograph,
            u,
            v,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=(255, 255, 255),
        )
        # Straight edges are judged: few artefacts of the coding may be beside them.
        options = [cv2.IMWRITE_JPEG_QUALITY, 85]
        _, coded = cv2.imencode(".jpg", picture[..., ::-1], options)
        data = base64.b64encode(coded.tobytes()).decode("ascii")
        return (
            f'<img alt="undistorted photograph" src="data:image/jpeg;base64,{data}">\n'
            + paragraph(
                "In perspective, with the principal distance and point on the "
                "sliders; white outside the photograph.",
                "hint",
            )
        )

    def _lookup(
        self, shape: tuple[int, int], values: Mapping[str, float], max_columns: int = 1000
    ) -> tuple[np.ndarray, ...]:
        """Columns and rows in a photograph of the pixels of its undistorted picture, which has at
        most `max_columns` columns."""
        rows, columns = shape
        step = max(1.0, columns / max_columns)
        u, v = (np.arange(0, n - 1 + 1e-9, step) for n in (columns, rows))
        pixels = np.stack(np.meshgrid(u, v), -1)
        xy = (pixels - self.origin_of_pixels) / self.step
        rays = _plain_rays(self.model, values, xy)
        images = images_of(self.model, values, rays.reshape(-1, 3)).reshape(xy.shape)
        images = self.origin_of_pixels + self.step * images
        # A place without image is looked up far outside, where OpenCV leaves white.
        return tuple(np.nan_to_num(np.moveaxis(images, -1, 0), nan=-1e6))


def _plain_rays(
    model: CameraModel, values: Mapping[str, float], xy: Float[np.ndarray, "*places 2"]
) -> np.ndarray:
    """Rays of a perspective camera of this principal distance and point, without distortion."""
    c = [values[name] for name in model.principal_distance] or [1.0]
    middle = [values[name] for name in model.principal_point] or [0.0, 0.0]
    slope = (np.asarray(xy) - middle) / c
    if model.axes == "down":
        slope = slope * [1, -1]
    return np.concatenate([slope, np.full((*slope.shape[:-1], 1), -1.0)], -1)


@partial(jax.jit, static_argnums=0)
def _slopes(
    model: CameraModel, p: Float[Array, " parameters"], xy: Float[np.ndarray, "2"]
) -> Float[Array, "2 parameters"]:
    """∂(x, y)/∂p of the ray that is imaged at xy."""
    from jaxbundle.cameras import image_ray

    ray = image_ray(model, tuple(p), *xy)
    return jax.jacfwd(lambda p: jnp.stack(project(model, tuple(p), *ray)))(p)
