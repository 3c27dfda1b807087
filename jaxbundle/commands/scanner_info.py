"""`info` of line scanners: what a file says of its image, in figures."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbundle.commands.scanner_inputs import Message, ignore, open_image, surface_under
from jaxbundle.display import print_in_one_screen
from jaxbundle.geometry.ellipsoid import Ellipsoid, geodetic, normal
from jaxbundle.io.results.result_json import without_nan
from jaxbundle.io.scanner.scanner import ScannerInput
from jaxbundle.pushbroom.error_propagation import east_north
from jaxbundle.pushbroom.image import PushbroomImage, pose_at
from jaxbundle.pushbroom.image_to_ground import locate_points
from jaxbundle.pushbroom.rpc.image import RpcImage, heights_in_words, locate_rpc_points
from jaxbundle.pushbroom.rpc.polynomials import sight
from jaxbundle.pushbroom.surfaces import GroundSurface
from jaxbundle.results import TableMethods, rows_of
from jaxbundle.types import Column

CORNERS = ("first line, first pixel", "first line, last pixel", "last line, last pixel")
CORNERS += ("last line, first pixel",)

# Units and meaning of the figures.
WORDS = {
    "height": "m, of the ground that these figures are for",
    "ground_sampling_along": "m, from line to line",
    "ground_sampling_across": "m, from pixel to pixel",
    "incidence": "°, of the middle ray from the vertical",
    "azimuth": "°, of the sensor seen from the ground, clockwise from north",
    "duration": "s, from the first line to the last",
    "altitude": "m, of the platform",
    "speed": "m/s, of the platform",
    "rpc_rms": "m, of the rigorous model from the RPC of the product",
    "rpc_rms_pixels": "pixels",
    "rpc_largest": "m",
    "heights": "m, between which the coefficients hold",
}


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class ScannerInfo(TableMethods):
    """What a file says of its image: `figures` by name, None where there is none, and the four
    `corners` on the ground by column."""

    figures: Mapping[str, Any]
    corners: Mapping[str, Column]

    def table(self) -> dict[str, np.ndarray]:
        """The corners."""
        return {name: np.asarray(column) for name, column in self.corners.items()}

    def to_dict(self) -> dict[str, Any]:
        """Figures and corners as plain dicts and numbers, as in JSON."""
        return without_nan({**self.figures, "corners": rows_of(self.table())})

    def __str__(self) -> str:
        figures = [(name, value) for name, value in self.figures.items() if value is not None]
        lines = [
            f"{name:24}{_in_words(value):>16}  {WORDS.get(name, '')}" for name, value in figures
        ]
        names = [name for name in self.corners if name != "corner"]
        lines += ["", f"{'corner':26}" + "".join(f"{name:>14}" for name in names)]
        for row in rows_of(self.table()):
            # Degrees to a millimetre, metres likewise.
            places = {"longitude": 8, "latitude": 8, "line": 0, "pixel": 0}
            # + 0.0: of −0 made by rounding
            cells = (
                ""
                if row[name] is None
                else f"{round(row[name], places.get(name, 3)) + 0.0:.{places.get(name, 3)}f}"
                for name in names
            )
            lines.append(f"{row['corner']:26}" + "".join(f"{cell:>14}" for cell in cells))
        return "\n".join(line.rstrip() for line in lines)


def info(
    scanner: str | Path, *, height: float | None = None, tell: Message = ignore
) -> ScannerInfo:
    """What a scanner file, a product or an image with rational polynomials says of its image: size,
    ground sampling, direction of view, footprint, corrections, and how well a rigorous model agrees
    with the RPC of its product.

    **Arguments:** `height`: of the ground, metres above the ellipsoid (Z in a local frame), as of
    `locate`.

    **Raises:** `InputError`.
    """
    file = open_image(scanner, tell)
    image = file.image
    surface = surface_under(file, height, None, None, tell)
    kind = "rational polynomials" if isinstance(image, RpcImage) else "rigorous"
    figures: dict[str, Any] = {
        "scanner": file.name,
        "model": kind,
        "lines": image.lines,
        "pixels": image.pixels,
        "height": float(getattr(surface, "level", 0.0)),
    }
    # The middle, the next line, the next pixel; the corners.
    line, pixel = (image.lines - 1) / 2, (image.pixels - 1) / 2
    last_corner = image.lines - 1.0, image.pixels - 1.0
    X = _locate(
        image,
        surface,
        np.array([line, line + 1, line, 0.0, 0.0, last_corner[0], last_corner[0]]),
        np.array([pixel, pixel, pixel + 1, 0.0, last_corner[1], last_corner[1], 0.0]),
    )
    middle, next_line, next_pixel = X[:, :3].T
    if not np.isfinite(middle).all():
        suspects = "height, and the heights of the coefficients"
        if not isinstance(image, RpcImage):
            suspects = "attitude, mounting, positions and height"
        tell(f"{scanner}: the ray of the middle of the image misses the ground; check {suspects}")
    figures["ground_sampling_along"] = float(np.linalg.norm(next_line - middle))
    figures["ground_sampling_across"] = float(np.linalg.norm(next_pixel - middle))
    figures["incidence"], figures["azimuth"] = _view(image, surface, middle, line, pixel)
    if isinstance(image, RpcImage):
        figures["heights"] = heights_in_words(image.rpc)
    else:
        figures |= _of_platform(image, file.earth)
        corrections = [name for name, is_on in image.corrections._asdict().items() if is_on]
        figures["corrections"] = ", ".join(corrections).replace("_", " ") or "none"
        if isinstance(file, ScannerInput) and file.agreement is not None:
            figures["rpc_rms"], figures["rpc_largest"], figures["rpc_rms_pixels"] = file.agreement
    return ScannerInfo(figures, _corners(X[:, 3:], last_corner, file.earth))


def _locate(
    image: PushbroomImage | RpcImage,
    surface: GroundSurface,
    line: Float[np.ndarray, " n"],
    pixel: Float[np.ndarray, " n"],
) -> Float[np.ndarray, "3 n"]:
    if isinstance(image, RpcImage):
        return np.asarray(jax.jit(locate_rpc_points)(image, surface, line, pixel)[0])
    return np.asarray(jax.jit(locate_points)(image, surface, line, pixel))


def _view(
    image: PushbroomImage | RpcImage,
    surface: GroundSurface,
    X: Float[np.ndarray, "3"],
    line: float,
    pixel: float,
) -> tuple[float, float]:
    """Angle of the ray from the vertical, and its azimuth, degrees."""
    if isinstance(image, RpcImage):
        ray = -np.asarray(jnp.stack(sight(image.rpc, line, pixel)[1]))
    else:
        ray = np.asarray(pose_at(image, image.times.time(line)).P) - X
    ray = ray / np.linalg.norm(ray)
    earth = surface.earth
    vertical = np.array([0.0, 0.0, 1.0]) if earth is None else np.asarray(normal(earth, tuple(X)))
    vertical = vertical / np.linalg.norm(vertical)
    east, north = np.asarray(east_north(surface, tuple(X))) @ ray
    incidence = np.degrees(np.arctan2(np.linalg.norm(np.cross(vertical, ray)), vertical @ ray))
    return float(incidence), float(np.degrees(np.arctan2(east, north)) % 360)


def _of_platform(image: PushbroomImage, earth: Ellipsoid | None) -> dict[str, float | None]:
    """Duration of the image; altitude and speed of the platform in its middle."""
    ends = [float(image.times.time(line)) for line in (0.0, image.lines - 1.0)]
    pose = pose_at(image, image.middle_time)
    P = tuple(np.asarray(pose.P))
    altitude = float(P[2]) if earth is None else None
    if earth is not None and earth.a == earth.b:
        altitude = float(geodetic(earth, P)[2])
    figures = {"duration": abs(ends[1] - ends[0]), "altitude": altitude}
    return {**figures, "speed": float(np.linalg.norm(pose.V))}


def _corners(
    X: Float[np.ndarray, "3 4"], last_corner: tuple[float, float], earth: Ellipsoid | None
) -> dict[str, Column]:
    columns: dict[str, Column] = {
        "corner": list(CORNERS),
        "line": np.array([0.0, 0.0, last_corner[0], last_corner[0]]),
        "pixel": np.array([0.0, last_corner[1], last_corner[1], 0.0]),
    }
    if earth is None or earth.a != earth.b:
        return columns | dict(zip("XYZ", X))
    longitude, latitude, height = (np.asarray(v) for v in geodetic(earth, tuple(X)))
    degrees = {"longitude": np.degrees(longitude), "latitude": np.degrees(latitude)}
    return columns | degrees | {"height": height}


def _in_words(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
