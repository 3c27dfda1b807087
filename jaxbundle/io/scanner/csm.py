"""Line scanners of the Community Sensor Model: support data (ISD) as ALE writes them, model states.

The fields have the meaning of usgscsm:

- lines and samples: (0.5, 0.5) is the centre of the first pixel, here (0, 0);
- `line_scan_rate`: rows of line L₀, start t₀ after the centre time, period p: line l here is taken
  at t₀ + p·(l + 1 − L₀); with a negative period the tables are read backwards in time;
- position, pointing and rotation of the body: `csm_trajectory`;
- focal plane and distortion: `csm_optics`;
- radii in km, or in their `unit`.

The camera looks towards the planet. No correction is set, as usgscsm applies none.
"""

import dataclasses
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from jaxbundle.arguments import show
from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import Ellipsoid
from jaxbundle.io.scanner.csm_optics import optics_of
from jaxbundle.io.scanner.csm_state import MODEL, is_state, support_data_of
from jaxbundle.io.scanner.csm_trajectory import (
    LAGRANGE_ORDER,
    states_of,
    trajectory_of,
    unit_of,
    view_directions,
)
from jaxbundle.io.scanner.scanner import ScannerInput
from jaxbundle.io.text.csv_tables import read_text
from jaxbundle.io.text.json_fields import JsonFields, read_object
from jaxbundle.io.text.known_keys import Keys, UnknownKeys
from jaxbundle.network.tables import Source
from jaxbundle.pushbroom.ancillary import DEFAULTS, check_times
from jaxbundle.pushbroom.image import check_size, make_image
from jaxbundle.pushbroom.scanner import LineTimes

KEYS = Keys(
    (
        *("name_model", "name_sensor", "image_lines", "image_samples", "center_ephemeris_time"),
        *("line_scan_rate", "body_rotation", "instrument_pointing", "instrument_position"),
        *("sensor_position", "sensor_orientation", "radii", "focal_length_model"),
        *("detector_center", "detector_sample_summing", "detector_line_summing"),
        *("focal2pixel_lines", "focal2pixel_samples", "optical_distortion"),
        *("starting_detector_line", "starting_detector_sample", "projection", "geotransform"),
    ),
    {
        **dict.fromkeys(
            (
                "isis_camera_version",
                "name_platform",
                "image_identifier",
                "naif_keywords",
                "interpolation_method",
                "number_of_*",
                "dt_ephemeris",
                "t0_ephemeris",
                "dt_quaternion",
                "t0_quaternion",
                "b_summing",
                "exposure_duration",
                "starting_ephemeris_time",
            ),
            "names and sources; times that stand in the tables as well",
        ),
        **dict.fromkeys(
            ("reference_height", "sun_position", "sun_velocity", "velocity*", "sensor_velocity"),
            "heights of the terrain, the sun; velocities stand in the table of positions",
        ),
    },
)
# The models of frame and push-frame cameras (`io.networks.csm_frame`), and what they are read as.
FRAME_MODELS = {
    "USGS_ASTRO_FRAME_SENSOR_MODEL": "a photograph",
    "USGS_ASTRO_PUSH_FRAME_SENSOR_MODEL": "photographs, one for each framelet",
}


def read_csm(
    path: str | Path, interpolation: str = "usgscsm", extrapolate: float | None = None
) -> ScannerInput:
    """The pushbroom image of an ISD or a model state.

    **Arguments:** `interpolation` of positions and attitudes: `"usgscsm"`, as usgscsm does it, or
    `"lagrange"`, through eight rows up to the ends of the tables (`csm_trajectory`);
    `extrapolate`: seconds by which tables may end before the image, default those of
    `AncillarySettings`.

    **Raises:** `InputError` naming file and field: missing, of another kind, not a number,
    an unknown distortion; tables that end too long before the image.
    """
    unknown = UnknownKeys()
    isd, order = _read_support_data(Path(path), unknown)
    lines, pixels = (isd.number(key) for key in ("image_lines", "image_samples"))
    check_size(lines, pixels, f"{path}: image_lines, image_samples")
    lines, pixels = int(lines), int(pixels)
    times, backwards = _line_times(isd, lines)
    end_times = np.array([float(times.time(line)) for line in (0.0, lines - 1.0)])
    line_times = (
        np.linspace(end_times[0], end_times[1], lines)
        if times.table is None
        else np.asarray(times.table)
    )
    settings = DEFAULTS
    if extrapolate is not None:
        limits = {"min_extrapolation": extrapolate, "max_extrapolation": extrapolate}
        settings = dataclasses.replace(settings, **limits)
    states = states_of(isd, -line_times if backwards else line_times, interpolation, settings)
    if backwards:
        # The same poses in the same lines; only corrections depend on the direction of time.
        t, P, rows, R = states[:4]
        states = states._replace(t=-t[::-1], P=P[::-1], rows=-rows[::-1], R=R[::-1])
    middle = view_directions(states.t, states.P, states.rows, states.R, end_times.mean())
    optics, rotation = optics_of(isd, pixels, *middle)
    image = make_image(
        trajectory_of(states, rotation, interpolation, order),
        times,
        optics,
        lines,
        pixels,
        sources=states.sources,
    )
    name = str(isd.get("name_sensor") or Path(path).stem)
    messages = (*states.warnings, *unknown.messages())
    return ScannerInput(name, image, _earth(isd), messages, backwards)


def _read_support_data(path: Path, unknown: UnknownKeys) -> tuple[JsonFields, int]:
    """The fields of an ISD, also of a state, and the degree of its interpolation; keys of an ISD
    that are not known are noticed."""
    text = read_text(path)
    name, brace, _ = text.partition("{")
    name = name.strip()
    # A state has the name of its model before the braces.
    if name and brace and name.replace("_", "").isalnum():
        if name != MODEL:
            raise InputError(f"{path}: a model state of {show(name)}; expected {MODEL}")
        text = text[text.index("{") : text.rfind("}") + 1 or len(text)]
    isd, order = (
        JsonFields(path, read_object(path, text, "an ISD or a model state")),
        LAGRANGE_ORDER,
    )
    if name or is_state(isd.document):
        document, order = support_data_of(isd)
        return JsonFields(path, document), order
    if not {"image_lines", "line_scan_rate"} & isd.document.keys():
        raise InputError(
            f"{path}: JSON of another kind, without image_lines and line_scan_rate; expected an "
            "ISD or a model state of a line scanner"
        )
    refuse_map(isd)
    model = isd.get("name_model", MODEL)
    if model != MODEL:
        kind = FRAME_MODELS.get(str(model))
        hint = "" if kind is None else f" (`jaxbundle convert` reads it as {kind})"
        raise InputError(f"{path}: name_model is {show(model)}{hint}; expected {MODEL}")
    unknown.check(isd.document, KEYS, path)
    return isd, order


def refuse_map(isd: JsonFields) -> None:
    """Refuse an image whose rows are not the lines of the scanner: ALE states the projection and
    GDAL's transformation (x₀, dx, 0, y₀, 0, dy) of the file, empty and the identity for a raw one.
    """
    remedy = (
        "; give the support data (ISD) and the file of the whole raw image, before map projection"
    )
    projection = isd.get("projection")
    if projection:
        raise InputError(
            f"{isd.path}: its image is a map, projection {show(projection)}: its rows are not the "
            f"lines of the scanner{remedy}"
        )
    if isd.get("geotransform") is None:
        return
    x, dx, rx, y, ry, dy = isd.array("geotransform", (6,))
    if (x, dx, rx, y, ry, abs(dy)) != (0, 1, 0, 0, 0, 1):
        raise InputError(
            f"{isd.path}: geotransform is {show(isd.get('geotransform'))}: its image is a crop, or "
            f"resampled: line {y:g}, sample {x:g} and steps of {dy:g} and {dx:g} of the image that "
            f"the scanner took{remedy}"
        )


def _earth(isd: JsonFields) -> Ellipsoid:
    unit = unit_of(isd, "radii", "km")
    a, c = (unit * isd.number(f"radii.{key}") for key in ("semimajor", "semiminor"))
    if not min(a, c) > 0:
        raise InputError(f"{isd.path}: radii must be positive")
    return Ellipsoid(a, a, c)


def _line_times(isd: JsonFields, lines: int) -> tuple[LineTimes, bool]:
    """The times of the lines; of negative periods (lines from the last one taken to the first, as
    of the Apollo panoramic camera) those of a clock that runs backwards, −t, and True."""
    rates = isd.array("line_scan_rate", (None, 3))
    backwards = bool(len(rates) and (rates[:, 2] < 0).all())
    if not len(rates) or (rates[:, 2] <= 0).any() != backwards:
        raise InputError(
            f"{isd.path}: line_scan_rate needs rows of a positive period, or all of a negative one"
        )
    first_lines, start, period = (rates * np.array([1, -1, -1]) if backwards else rates).T
    # The centre of line l is l + ½ in the coordinates of the ISD.
    l = np.arange(lines)
    row = np.clip(np.searchsorted(first_lines, l + 0.5, side="right") - 1, 0, None)
    t = start[row] + period[row] * (l + 1 - first_lines[row])
    # One rate: times follow from it, and need no table.
    if (row == row[0]).all():
        return LineTimes(jnp.asarray(t[0]), jnp.asarray(period[row[0]])), backwards
    check_times(t, Source(f"{isd.path}, line_scan_rate", None, "line"))
    return LineTimes(jnp.zeros(()), jnp.zeros(()), jnp.asarray(t)), backwards
