"""The line scanner explorer: track and attitude trajectories, interpolation, attitude errors,
corrections, ground height, and pictures of a scene.

Two kinds of files. Changes of a *scanner file* are compared with the unchanged image, or with a
known truth. A *flight file* is simulated: the records of its instruments, sampled, noisy
and interpolated by the chosen methods, are compared with the true trajectory; its track, the form
of its attitudes, its rates and σ are controls too.

Attitude errors are given as roll, pitch, yaw of the camera (R·exp([ε]×)) and put into the rows of
the table, so that the exported flight file has them. Ground places are those of `locate`, the error
map is `ground_errors`, σ → RMS and CE90 are `propagate_accuracy` and, for a level camera,
`closed_form`.
"""

import dataclasses
import io
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbundle.choices import RESAMPLINGS, Resampling
from jaxbundle.errors import InputError
from jaxbundle.explorer.attitudes import attitude_controls, attitude_forms, choose_angles
from jaxbundle.explorer.page import (
    Choice,
    Control,
    Number,
    Switch,
    draw_controls,
    draw_tools,
    make_page,
    place,
    with_value,
)
from jaxbundle.explorer.pictures import (
    GroundFrame,
    Taken,
    draw_pictures,
    frame_around,
    pattern,
    scene_of_raster,
    take_pictures,
    without_pictures,
)
from jaxbundle.explorer.scanner_drawing import (
    ANGLES,
    draw_accuracy,
    draw_errors,
    draw_flight,
    draw_ground,
    outline,
)
from jaxbundle.explorer.tracks import (
    ORBIT,
    PLACES,
    STRAIGHT,
    Tracks,
    choose_track,
    idle_controls,
    shorten_number,
    track_controls,
    tracks_of,
)
from jaxbundle.explorer.view import File, Given, check_keys, number, switch, word
from jaxbundle.geometry.ellipsoid import Ellipsoid
from jaxbundle.io.rasters.scenes import SceneRaster
from jaxbundle.io.scanner.writing import write_scanner_image
from jaxbundle.plotting import image_map
from jaxbundle.plotting.files import png
from jaxbundle.pushbroom.ancillary import attitude_table, position_table
from jaxbundle.pushbroom.corrections import Corrections
from jaxbundle.pushbroom.error_propagation import (
    circular_error,
    closed_form,
    ground_errors,
    propagate_accuracy,
    spread_positions,
)
from jaxbundle.pushbroom.flight import Flight, measured_image, true_image, with_errors_in_rows
from jaxbundle.pushbroom.image import PushbroomImage, make_image
from jaxbundle.pushbroom.interpolation import METHODS, TimeTable
from jaxbundle.pushbroom.noise import Noise, Sigma, zero_errors
from jaxbundle.pushbroom.study import altitude_and_view
from jaxbundle.pushbroom.surfaces import Ground, GroundSurface, Height, Plane
from jaxbundle.pushbroom.trajectory import (
    AttitudeTable,
    Trajectory,
    trajectory_in_pieces,
)
from jaxbundle.report.layout import clean
from jaxbundle.report.page import UNKNOWN, Origin, Page, Section
from jaxbundle.report.page.markup import paragraph
from jaxbundle.types import not_none

# Ends of the keys of σ and of random walks, which may be 0 but not negative.
POSITIVE_KEYS = ("white", "walk")
FLIGHT_FILE, TABLE_FILE, PICTURE_FILE = "flight.zip", "accuracy.csv", "error_map.png"


class Chosen(NamedTuple):
    """An image with what was chosen, the ellipsoid (None in a local frame), the surface it is
    located on, and the image that is true."""

    image: PushbroomImage
    earth: Ellipsoid | None
    surface: GroundSurface
    truth: PushbroomImage


class FlightView:
    """The image of a scanner file, or what a flight file simulates.

    **Arguments:** `given` the image, or the flight; `earth`: the ellipsoid, None in a local frame;
    `truth`: an image that is true, the given one if none is given; `cells`: parts of the image,
    along lines and pixels, of the error map, with irregular positions in each; `scene`: a raster
    that the pictures show, in the coordinates of the Earth or the local frame of the image; without
    one they show a pattern.
    """

    def __init__(
        self,
        name: str,
        given: PushbroomImage | Flight,
        earth: Ellipsoid | None,
        truth: PushbroomImage | None = None,
        origin: Origin = UNKNOWN,
        cells: tuple[int, int] = (7, 6),
        scene: SceneRaster | None = None,
    ):
        self.cells, self.raster = cells, scene
        self._scenes: dict[str, tuple[GroundFrame, np.ndarray]] = {}
        self.name, self.earth, self.origin = name, earth, origin
        self.flight = given if isinstance(given, Flight) else None
        self.image = measured_image(given) if isinstance(given, Flight) else given
        self.truth = (
            truth
            if truth is not None
            else (self.image if self.flight is None else true_image(self.flight))
        )
        self.known = truth is not None or self.flight is not None
        self.tracks = (
            None if self.flight is None else tracks_of(self.flight.track, self.image, earth)
        )
        self.forms = (
            None
            if self.flight is None
            else attitude_forms(
                self.flight.angles, self.flight.period * max(self.flight.lines - 1, 1)
            )
        )

    # --- values -----------------------------------------------------------------------------

    @cached_property
    def controls(self) -> list[Control]:
        """The controls with the values of the file."""
        position, attitude = self.image.trajectory.position, self.image.trajectory.attitude
        quaternions = attitude.table.values.shape[1] == 4
        ways = [m for m in METHODS if m != "hermite" or position.rates is not None]
        turns = [m for m in METHODS if m != "hermite"] + ["slerp"] * quaternions
        all_controls: list[Control] = []
        if self.tracks is not None and self.forms is not None:
            all_controls += [
                Choice("track", "trajectory", self.tracks.kind, (ORBIT, PLACES, STRAIGHT)),
                *track_controls(self.tracks),
                *attitude_controls(self.forms),
            ]
        all_controls += [
            Choice(
                "position_interpolation", "interpolation of the position", position.method, ways
            ),
            Choice(
                "attitude_interpolation",
                "interpolation of the attitude",
                "slerp" if attitude.slerp else attitude.table.method,
                turns,
            ),
        ]
        all_controls += [Number(name, f"error of {name}", 0.0, "°", -0.2, 0.2) for name in ANGLES]
        if self.flight is not None:
            all_controls += [
                Number("position_rate", "samples of the position", self.flight.position_rate, "Hz"),
                Number("attitude_rate", "samples of the attitude", self.flight.attitude_rate, "Hz"),
                Number(
                    "attitude_white",
                    "σ of every attitude row",
                    shorten_number(np.degrees(_largest(self.flight.noise.attitude_white))),
                    "°",
                ),
                Number(
                    "position_white",
                    "σ of every position row",
                    _largest(self.flight.noise.position_white),
                    "m",
                ),
            ]
        if self.earth is not None or self.tracks is not None:
            all_controls += [
                Switch(name, name.replace("_", " "), is_on)
                for name, is_on in zip(Corrections._fields, self.image.corrections)
            ]
        return [
            *all_controls,
            Number("ground", "height of the ground", 0.0, "m"),
            Choice("resampling", "resampling of the pictures", "bilinear", RESAMPLINGS),
        ]

    def values(self, given: Given) -> dict[str, Any]:
        """All values by key, by default those of the file.

        **Raises:** `InputError`."""
        check_keys(given, [control.key for control in self.controls])
        all_values: dict[str, Any] = {}
        for known_control in self.controls:
            if isinstance(known_control, Number):
                positive = (
                    known_control.key.endswith(POSITIVE_KEYS) or known_control.key == "height"
                )
                all_values[known_control.key] = number(
                    given, known_control.key, known_control.value, 0.0 if positive else -np.inf
                )
                if known_control.key.endswith("period") and not all_values[known_control.key] > 0:
                    raise InputError(
                        f"{known_control.key} is {all_values[known_control.key]:g}; expected a "
                        "number above 0"
                    )
                if (
                    known_control.key.endswith("latitude")
                    and not abs(all_values[known_control.key]) <= 90
                ):
                    raise InputError(
                        f"{known_control.key} is {all_values[known_control.key]:g}; expected a "
                        "number from -90 to 90"
                    )
                if (
                    known_control.key.endswith("rate")
                    and not 0 < all_values[known_control.key] <= 1000
                ):
                    raise InputError(
                        f"{known_control.key} is {all_values[known_control.key]:g}; above 0, to "
                        "1000 Hz"
                    )
            elif isinstance(known_control, Switch):
                all_values[known_control.key] = switch(
                    {known_control.key: given.get(known_control.key, known_control.value)},
                    known_control.key,
                )
            else:
                all_values[known_control.key] = word(
                    given, known_control.key, known_control.value, known_control.words
                )
        return all_values

    def choose(self, values: Mapping[str, Any]) -> Chosen:
        """The image with these values.

        **Raises:** `InputError`."""
        image, truth, earth = self.image, self.truth, self.earth
        if self.flight is not None and self.tracks is not None:
            flight = self._flight_with(self.flight, self.tracks, values)
            image = measured_image(flight)
            flight_given = self.flight
            if flight.track is not flight_given.track or flight.angles is not flight_given.angles:
                truth = true_image(flight)
            earth = None if values["track"] == STRAIGHT else self.tracks.earth
        trajectory = Trajectory(
            _table_with(image.trajectory.position, values["position_interpolation"]),
            _attitude_with(image.trajectory.attitude, values["attitude_interpolation"]),
        )
        corrections = Corrections(
            *(earth is not None and values.get(name, False) for name in Corrections._fields)
        )
        image = make_image(
            trajectory,
            image.times,
            image.optics,
            image.lines,
            image.pixels,
            image.mounting,
            corrections,
        )
        error = np.zeros(3)
        for name, k in ANGLES.items():
            error[k] = np.radians(values[name])
        if error.any():
            errors = zero_errors(image)._replace(attitude_bias=jnp.asarray(error))
            image = with_errors_in_rows(image, errors)
        return Chosen(image, earth, _surface_at(values["ground"], earth), truth)

    def _flight_with(self, flight: Flight, tracks: Tracks, values: Mapping[str, Any]) -> Flight:
        noise = flight.noise
        for name, unit in (("attitude_white", np.pi / 180), ("position_white", 1.0)):
            # A σ for every axis stays as the file has it until it is changed.
            if values[name] != next(
                control.value for control in self.controls if control.key == name
            ):
                noise = noise._replace(**{name: unit * values[name]})
        names = (
            "position_interpolation",
            "attitude_interpolation",
            "position_rate",
            "attitude_rate",
        )
        return dataclasses.replace(
            flight,
            noise=noise,
            track=choose_track(tracks, values),
            angles=choose_angles(not_none(self.forms), values),
            **{n: values[n] for n in names},
        )

    # --- what the server asks ---------------------------------------------------------------

    def answer(self, given: Given) -> dict[str, Any]:
        """`parts`; `rms`, `ce90`, `largest` of the errors on the ground, metres; `errors`: the RMS
        of each part of the image [lines, pixels]; `expected`: rows of the accuracy table;
        `difference`: of the map and the scene, RMS of 255 grey values; `idle`: controls without
        effect."""
        values = self.values(given)
        chosen = _in_pieces(self.choose(values))
        errors = self._errors(chosen)
        length = np.hypot(*errors.T)
        if not np.isfinite(length).all():
            raise InputError(
                "not every image position has a point on the ground: check "
                "attitude, mounting and height"
            )
        expected = self._expected_accuracy(chosen)
        rms, ce90 = np.sqrt(np.mean(length**2)), np.quantile(length, 0.9)
        error_figures = {"rms": float(rms), "ce90": float(ce90), "largest": float(length.max())}
        field = self._rms_of_cells(length)
        pictures, difference = self._draw_pictures(chosen, values)
        return {
            "parts": {
                "flight": draw_flight(chosen.image, chosen.truth, chosen.earth),
                "pictures": pictures,
                "ground": draw_ground(chosen.image, chosen.truth, chosen.surface, chosen.earth),
                "errors": draw_errors(field, error_figures),
                "accuracy": draw_accuracy(error_figures, errors, expected),
            },
            **error_figures,
            "errors": field.tolist(),
            "expected": expected,
            "difference": difference,
            "idle": self._idle(values),
        }

    def _idle(self, values: Mapping[str, Any]) -> list[str]:
        """The controls without effect: those of the other track, corrections without an Earth."""
        if self.tracks is None:
            return []
        corrections = Corrections._fields if values["track"] == STRAIGHT else ()
        return [*idle_controls(self.tracks, values["track"]), *corrections]

    def export(self, name: str, given: Given) -> File:
        """The flight file with its tables (zip), the accuracy table (CSV), the error map (PNG).

        **Raises:** `InputError`."""
        values = self.values(given)
        chosen = self.choose(values)
        if name == FLIGHT_FILE:
            return File(name, "application/zip", self._zip(chosen))
        if name == TABLE_FILE:
            return File(name, "text/csv", self._csv(chosen).encode())
        if name == PICTURE_FILE:
            return File(name, "image/png", self._picture(chosen))
        raise InputError(
            f"there is no file {name!r}; {FLIGHT_FILE}, {TABLE_FILE} and {PICTURE_FILE} are"
        )

    def page(self, given: Given, live: bool) -> Page:
        """Controls, the ground, the error map, the table; a live page asks for them itself, since
        the first answer compiles programs."""
        values = self.values(given)
        controls = [with_value(control, values[control.key]) for control in self.controls]
        image = self.image
        if self.flight is not None:
            reference = "the true trajectory of the flight"
        else:
            reference = "the given truth" if self.known else "the image as its file has it"
        exports = {
            "Flight file (zip)": FLIGHT_FILE,
            "Table (CSV)": TABLE_FILE,
            "Picture (PNG)": PICTURE_FILE,
        }
        sections = [
            Section(
                "choices",
                "Trajectory and attitude",
                "".join(
                    [
                        paragraph(
                            f"{image.lines} lines of {image.pixels} pixels; errors are against "
                            f"{reference}."
                        ),
                        draw_controls(controls, live),
                        draw_tools(live, exports),
                        place("flight"),
                    ]
                ),
            ),
            Section("pictures-section", "Pictures", place("pictures"), "Pictures"),
            Section("accuracy-section", "Accuracy", place("accuracy"), "Accuracy"),
            Section("errors-section", "Error map", place("errors"), "Error map"),
            Section("ground-section", "Ground track and footprint", place("ground"), "Ground"),
        ]
        title = f"{clean(self.name)}: explorer"
        rows = [(key.replace("_", " "), value) for key, value in values.items()]
        return make_page(
            title,
            sections,
            self.origin,
            live,
            "scanner",
            {} if live else self.answer(given),
            rows,
            given=values,
        )

    # --- numbers ----------------------------------------------------------------------------

    @cached_property
    def positions(self) -> tuple[np.ndarray, np.ndarray]:
        """Lines and pixels at which errors are computed, cell after cell of the error map."""
        lines, pixels = spread_positions(self.image.lines, self.image.pixels, self.cells)
        return lines.ravel(), pixels.ravel()

    def _errors(self, chosen: Chosen) -> Float[np.ndarray, "n 2"]:
        return ground_errors(chosen.image, chosen.truth, chosen.surface, *self.positions)

    def _rms_of_cells(self, length: Float[np.ndarray, " n"]) -> Float[np.ndarray, "rows columns"]:
        return np.sqrt(np.mean(length.reshape(*self.cells, -1) ** 2, axis=2))

    def _expected_accuracy(
        self, chosen: Chosen, levels: Sequence[float] = (0.01, 0.1)
    ) -> list[dict[str, float]]:
        """RMS and CE90 of attitudes with given σ about every axis, degrees, one error an image."""
        image, surface = chosen.image, chosen.surface
        altitude, view = altitude_and_view(image, surface)
        # A constant error has no structure that a few positions could miss.
        positions = spread_positions(image.lines, image.pixels, self.cells, 1)
        line, pixel = (v.ravel() for v in positions)
        rows = []
        for level in levels:
            sigma = np.radians(level)
            exact = propagate_accuracy(image, surface, line, pixel, Noise(attitude_bias=sigma))
            rms = closed_form(altitude, view, sigma, sigma, sigma)
            rows.append(
                {
                    "sigma": level,
                    "rms": exact.overall,
                    "ce90": exact.overall_ce90,
                    "closed_rms": rms,
                    "closed_ce90": circular_error(np.eye(2) * rms**2 / 2),
                }
            )
        return rows

    # --- pictures ---------------------------------------------------------------------------

    def take_pictures(self, given: Given) -> Taken:
        """Scene, image and map with these values.

        **Raises:** `InputError`."""
        values = self.values(given)
        return self._take_pictures(_in_pieces(self.choose(values)), values)

    def _take_pictures(self, chosen: Chosen, values: Mapping[str, Any]) -> Taken:
        frame, scene = self._scene(values.get("track", ""), chosen)
        images = chosen.truth, chosen.image
        return take_pictures(scene, frame, *images, chosen.surface, _kernel(values))

    def _scene(self, kind: str, chosen: Chosen) -> tuple[GroundFrame, np.ndarray]:
        """The scene around the image of the file, or of a track of another kind with its first
        values: it stays where it is when values change."""
        if chosen.earth is not None and chosen.earth.a != chosen.earth.b:
            raise InputError("the ellipsoid has three different axes")
        if kind not in self._scenes:
            truth = self.truth
            if self.flight is not None and self.tracks is not None and kind != self.tracks.kind:
                track = choose_track(self.tracks, self.values({"track": kind}))
                truth = true_image(dataclasses.replace(self.flight, track=track))
            surface = _surface_at(0.0, chosen.earth)
            frame = frame_around(truth, surface, outline(truth))
            if self.raster is not None and self._has_coordinates_of_raster(chosen):
                self._scenes[kind] = frame, scene_of_raster(self.raster, frame, surface)
            else:
                self._scenes[kind] = frame, pattern(frame)
        return self._scenes[kind]

    def _has_coordinates_of_raster(self, chosen: Chosen) -> bool:
        """Whether the track is over the Earth, or above a plane, as the one of the file is."""
        return (chosen.earth is None) == (self.earth is None)

    def _draw_pictures(self, chosen: Chosen, values: Mapping[str, Any]) -> tuple[str, float | None]:
        """The pictures, and the difference of map and scene; words in their place where there are
        none, since the numbers are of use without them."""
        try:
            taken = self._take_pictures(chosen, values)
            frame, _ = self._scene(values.get("track", ""), chosen)
            figures = draw_pictures(taken, frame, _kernel(values))
            if self.raster is not None and not self._has_coordinates_of_raster(chosen):
                words = "The scene has coordinates of the file's track: a pattern is in its place."
                figures = paragraph(words, "hint") + figures
            return figures, taken.rms
        except InputError as error:
            return without_pictures(error), None

    # --- files ------------------------------------------------------------------------------

    def _zip(self, chosen: Chosen) -> bytes:
        """`scanner.toml` with its tables."""
        data = io.BytesIO()
        with tempfile.TemporaryDirectory() as folder, zipfile.ZipFile(data, "w") as archive:
            write_scanner_image(
                folder, "scanner", chosen.image, chosen.earth, prefix="", angle_unit="deg"
            )
            for path in sorted(Path(folder).iterdir()):
                archive.write(path, path.name, zipfile.ZIP_DEFLATED)
        return data.getvalue()

    def _csv(self, chosen: Chosen) -> str:
        lines, pixels = self.positions
        errors = self._errors(chosen)
        rows = ["line,pixel,east,north,error"]
        rows += [
            f"{line!r},{pixel!r},{e!r},{n!r},{float(np.hypot(e, n))!r}"
            for line, pixel, (e, n) in zip(lines.tolist(), pixels.tolist(), errors.tolist())
        ]
        rows += ["", "sigma_degrees,rms,ce90,closed_rms,closed_ce90"]
        expected = self._expected_accuracy(chosen)
        rows += [",".join(repr(float(v)) for v in row.values()) for row in expected]
        return "\n".join(rows) + "\n"

    def _picture(self, chosen: Chosen) -> bytes:
        size = self.image.lines, self.image.pixels
        lines, pixels = ((np.arange(k) + 0.5) * n / k - 0.5 for k, n in zip(self.cells, size))
        length = np.hypot(*self._errors(chosen).T)
        overall = f"RMS {np.sqrt(np.mean(length**2)):.3g} m"
        try:
            return png(
                (7.5, 6),
                None,
                lambda ax: image_map(
                    lines,
                    pixels,
                    self._rms_of_cells(length),
                    "Error on the ground",
                    "m",
                    overall,
                    ax,
                ),
            )
        except ImportError as error:
            raise InputError(str(error)) from None


def _surface_at(height: float, earth: Ellipsoid | None) -> GroundSurface:
    if earth is None:
        return Plane(level=height)
    if height == 0:
        return Ground(earth)
    if earth.a != earth.b:
        raise InputError(
            f"the height of the ground is {height:g}: above an ellipsoid with three different axes "
            "there are no heights; expected 0"
        )
    return Height(level=height, earth=earth)


def _in_pieces(chosen: Chosen) -> Chosen:
    """An image and its truth with trajectories in pieces, whose interpolation is data: another
    method needs no other program."""
    image, truth = (
        eqx.tree_at(lambda i: i.trajectory, image, _pieces(image.trajectory))
        for image in (chosen.image, chosen.truth)
    )
    return chosen._replace(image=image, truth=truth)


def _table_with(table: TimeTable, method: str) -> TimeTable:
    """Positions with another interpolation."""
    if method == table.method:
        return table
    return position_table(
        np.asarray(table.times),
        np.asarray(table.values),
        None if table.rates is None else np.asarray(table.rates),
        method=method,
        order=table.order,
        gap=table.gap if np.isfinite(table.gap) else None,
        extrapolate=table.extrapolate,
    )


def _attitude_with(attitude: AttitudeTable, method: str) -> AttitudeTable:
    """Attitudes with another interpolation."""
    table = attitude.table
    if method == ("slerp" if attitude.slerp else table.method):
        return attitude
    return attitude_table(
        np.asarray(table.times),
        np.asarray(table.values),
        method=method,
        order=table.order,
        gap=table.gap if np.isfinite(table.gap) else None,
        extrapolate=table.extrapolate,
        reference=attitude.reference,
    )


def _kernel(values: Mapping[str, Any]) -> Resampling:
    return cast(Resampling, values["resampling"])


def _largest(sigma: Sigma) -> float:
    """A σ of three axes as one number, the largest."""
    return float(np.max(sigma))


_pieces = jax.jit(trajectory_in_pieces)
