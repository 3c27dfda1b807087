"""Tables of ground accuracy: attitude trajectories by attitude accuracies.

The columns are trajectories: of the angles of a flight only roll, only pitch, only yaw, or all
three vary. The rows are standard deviations of the attitude, equal for all three axes, each
computed in three ways: by Monte Carlo, by propagation through the exact Jacobian of the
image with this trajectory, and in the closed form of a nadir-looking camera above a plane
(`accuracy`). The row without error shows the interpolation error of the instruments' samples.
Tables 4-1 to 4-3 of Hakim et al. (LAPAN-A3) have this form, without altitude, field of view and
rate of the samples; here they are stated.
"""

import dataclasses
import math
from typing import Any, NamedTuple

import numpy as np

from jaxbundle.choices import AttitudeError
from jaxbundle.display import print_in_one_screen
from jaxbundle.pushbroom.error_propagation import (
    circular_error,
    closed_form,
    ground_errors,
    propagate_accuracy,
    simulate_accuracy,
    spread_positions,
)
from jaxbundle.pushbroom.flight import Flight, measured_image, true_image
from jaxbundle.pushbroom.image import PushbroomImage, pose_at
from jaxbundle.pushbroom.image_to_ground import locate_points
from jaxbundle.pushbroom.noise import Noise
from jaxbundle.pushbroom.scanner import slopes_of
from jaxbundle.pushbroom.surfaces import GroundSurface
from jaxbundle.results import TableMethods, rows_of
from jaxbundle.system.programs import compile_once
from jaxbundle.types import Numbers

TRAJECTORIES = {
    "roll": ("roll",),
    "pitch": ("pitch",),
    "yaw": ("yaw",),
    "3 axes": ("pitch", "roll", "yaw"),
}
FLOORS = ("linear", "spline")
WAYS = ("drawn", "propagated", "closed")
# Default accuracies of attitudes, radians: those of the tables of Hakim et al.
SIGMAS = (math.radians(0.01), math.radians(0.1))


class ErrorFree(NamedTuple):
    """RMS and CE90, metres, of the interpolation of error-free samples."""

    trajectory: str
    interpolation: str
    rms: float
    ce90: float


class Erring(NamedTuple):
    """RMS and CE90, metres, of attitudes with the standard deviation `sigma`, radians."""

    trajectory: str
    sigma: float
    drawn_rms: float
    propagated_rms: float
    closed_rms: float
    drawn_ce90: float
    propagated_ce90: float
    closed_ce90: float


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class AccuracyTable(TableMethods):
    """`altitude` above the surface in metres, `field_of_view` in radians, and the cells."""

    altitude: float
    field_of_view: float
    kind: AttitudeError
    draws: int
    error_free: list[ErrorFree]
    erring: list[Erring]

    @property
    def figures(self) -> dict[str, Any]:
        """Of the whole table; the field of view in degrees."""
        view = _degrees(self.field_of_view)
        return {
            "altitude": self.altitude,
            "field_of_view": view,
            "kind": self.kind,
            "draws": self.draws,
        }

    def table(self) -> dict[str, np.ndarray]:
        """A row per trajectory and accuracy (degrees; 0 for error-free samples, which only their
        interpolation moves), errors in metres."""
        rows = [
            (cell.trajectory, 0.0, cell.interpolation, cell.rms, cell.ce90, *[np.nan] * 4)
            for cell in self.error_free
        ]
        rows += [
            (
                cell.trajectory,
                _degrees(cell.sigma),
                "",
                cell.drawn_rms,
                cell.drawn_ce90,
                cell.propagated_rms,
                cell.propagated_ce90,
                cell.closed_rms,
                cell.closed_ce90,
            )
            for cell in self.erring
        ]
        names = ["trajectory", "sigma", "interpolation", "rms", "ce90"]
        names += [f"{way}_{value}" for way in WAYS[1:] for value in names[3:5]]
        return {name: np.array(column) for name, column in zip(names, zip(*rows))}

    def to_dict(self) -> dict[str, Any]:
        """Figures and rows as plain dicts and numbers, as in JSON."""
        return {**self.figures, "rows": rows_of(self.table())}

    def __str__(self) -> str:
        """Trajectories across, accuracies down."""
        description = {
            "bias": "one error per image",
            "white": "an error in every record of the table",
        }
        view = _degrees(self.field_of_view)
        text = [
            f"altitude {self.altitude / 1e3:.1f} km, field of view {view:g}°",
            f"error of attitude about each axis: {description[self.kind]}; {self.draws} draws",
        ]
        line = lambda name, values, form: f"{name:22}" + "".join(f"{v:>10{form}}" for v in values)
        for value in ("rms", "ce90"):
            text += ["", line(f"{value.upper()} [m]", TRAJECTORIES, "")]
            for method in dict.fromkeys(cell.interpolation for cell in self.error_free):
                cells = [getattr(c, value) for c in self.error_free if c.interpolation == method]
                text.append(line(f"no error, {method}", cells, ".4f"))
            for sigma in dict.fromkeys(cell.sigma for cell in self.erring):
                for way in WAYS:
                    cells = [getattr(c, f"{way}_{value}") for c in self.erring if c.sigma == sigma]
                    text.append(line(f"{_degrees(sigma):g}°, {way}", cells, ".2f"))
        return "\n".join(text)


def _degrees(angle: float) -> float:
    return float(f"{np.degrees(angle):.6g}")


def accuracy_table(
    flight: Flight,
    surface: GroundSurface,
    sigmas: Numbers = SIGMAS,
    kind: AttitudeError = "bias",
    draws: int = 1000,
    seed: int = 0,
    lines: int = 13,
    pixels: int = 6,
) -> AccuracyTable:
    """The table of a flight, with its angles one by one and together.

    **Arguments:** `sigmas` in radians; `kind` of the error: `"bias"`, one for the whole image, or
    `"white"`, another in every row of the attitude table, which interpolation averages (the closed
    form does not); `lines` × `pixels` parts of the image with one irregular position each
    (`spread_positions`) for the errors, a thousand positions for error-free samples. The surface
    must not be a terrain.
    """
    size = flight.lines, flight.pixels
    line, pixel = (v.ravel() for v in spread_positions(*size, (lines, pixels), 1))
    all_lines, all_pixels = (v.ravel() for v in spread_positions(*size))
    noiseless_flight = dataclasses.replace(flight, noise=Noise())
    altitude, view = altitude_and_view(true_image(noiseless_flight), surface)
    error_free, erring = [], []
    for name, axes in TRAJECTORIES.items():
        angles = {axis: flight.angles[axis] for axis in axes if axis in flight.angles}
        varied_flight = dataclasses.replace(noiseless_flight, angles=angles)
        truth = true_image(varied_flight)
        # Without noise only the interpolation of the samples errs.
        for method in FLOORS:
            image = measured_image(
                dataclasses.replace(varied_flight, attitude_interpolation=method)
            )
            errors = ground_errors(image, truth, surface, all_lines, all_pixels)
            length = np.linalg.norm(errors, axis=1)
            # Where a ray meets the surface, as of `GroundAccuracy`.
            finite_length = length[np.isfinite(length)]
            rms, ce90 = np.nan, np.nan
            if len(finite_length):
                rms, ce90 = (
                    float(np.sqrt(np.mean(finite_length**2))),
                    float(np.quantile(finite_length, 0.9)),
                )
            error_free.append(ErrorFree(name, method, rms, ce90))
        image = measured_image(varied_flight)
        for sigma in sigmas:
            noise = Noise(**{f"attitude_{kind}": sigma})
            simulated = simulate_accuracy(image, surface, line, pixel, noise, draws, seed)
            propagated = propagate_accuracy(image, surface, line, pixel, noise)
            level = closed_form(altitude, view, sigma, sigma, sigma)
            # Above a plane, near the nadir, errors along and across are almost alike.
            circle_ce90 = circular_error(np.eye(2) * level**2 / 2)
            erring.append(
                Erring(
                    name,
                    float(sigma),
                    simulated.overall,
                    propagated.overall,
                    level,
                    simulated.overall_ce90,
                    propagated.overall_ce90,
                    circle_ce90,
                )
            )
    return AccuracyTable(altitude, view, kind, draws, error_free, erring)


def altitude_and_view(image: PushbroomImage, surface: GroundSurface) -> tuple[float, float]:
    """Height of the middle line above the surface, metres, and the angle of the line, radians."""
    P = np.asarray(_position(image))
    ground = np.asarray(
        _locate(image, surface, *(np.array([(n - 1) / 2]) for n in (image.lines, image.pixels)))
    )[:, 0]
    heights = [float(surface.height(tuple(X))) for X in (P, ground)]
    edges = np.array([-0.5, image.pixels - 0.5])
    left_ray, right_ray = (
        np.append(slope, -1.0) for slope in np.stack(_slopes(image.optics, edges), 1)
    )
    cosine = left_ray @ right_ray / (np.linalg.norm(left_ray) * np.linalg.norm(right_ray))
    return heights[0] - heights[1], float(np.arccos(cosine))


_position = compile_once(lambda image: pose_at(image, image.middle_time).P, ())
_locate = compile_once(locate_points, ())
_slopes = compile_once(slopes_of, ())
