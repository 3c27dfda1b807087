"""The scanner file: a TOML file that describes a pushbroom image, tables in CSV files beside it.

```toml
[scanner]
lines = 10000
pixels = 8000
epoch = "2024-03-01T10:20:30"       # UTC; all times are seconds since then
earth = "WGS84"                     # or [a, b, c] in metres, or "local": a plane, Z up
angle_unit = "deg"                  # rad | deg | gon, of every angle in this file and its tables

[times]                             # of the lines: first and period, or table
first = 0.0
period = 0.00066

[position]                          # table, or tle, or circle, or state
table = "positions.csv"             # t,X,Y,Z[,VX,VY,VZ]
frame = "ITRF"                      # ITRF | GCRF | J2000 | TEME, or "local"
interpolation = "lagrange"          # linear | lagrange | usgscsm | hermite | spline
order = 7
extrapolate = 0.0                   # seconds beyond the ends of the table

[attitude]
table = "attitude.csv"              # t,q0,q1,q2,q3 (scalar first) or t,pitch,roll,yaw
frame = "ITRF"                      # as of positions, or "orbit" with an Earth
interpolation = "slerp"             # slerp | linear | lagrange | usgscsm | spline

[optics]                            # a camera model's parameters, or table, or across and along
model = "brown"
c = 700.0
pitch = 0.0065                      # in the model's unit a pixel
middle = 3999.5                     # the pixel at x = 0
row = 0.0                           # y of the detectors

[mounting]                          # angles of the camera in the frame of the attitude
roll = 12.0

[corrections]
aberration = true                   # light_time, aberration, refraction: false if absent

[earth_orientation]
ut1_utc = -0.12                     # seconds; x_pole, y_pole in arcseconds
```

Or the file of a product, with changes:

```toml
[scanner]
source = "image.json"
interpolation = "lagrange"          # CSM files: usgscsm | lagrange
extrapolate = 2.0                   # CSM files: seconds by which tables may end before the image
corrections = "auto"                # those that the RPC of the product confirms; the default

[corrections]                       # instead: the ones given, others as usual for the product
refraction = true
```
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbundle.arguments import show
from jaxbundle.cameras import check_parameters, default_parameters, get_model
from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import WGS84, Ellipsoid
from jaxbundle.io.scanner.scanner import ScannerInput
from jaxbundle.io.text.sections import TomlFile, TomlSection
from jaxbundle.network.columns import did_you_mean
from jaxbundle.network.tables import Source
from jaxbundle.pushbroom import earth_frames as frames
from jaxbundle.pushbroom.ancillary import (
    attitude_table,
    check_times,
    normalise_quaternions,
    position_table,
)
from jaxbundle.pushbroom.corrections import Corrections
from jaxbundle.pushbroom.image import check_size, make_image
from jaxbundle.pushbroom.interpolation import TimeTable
from jaxbundle.pushbroom.orbit import state_orbit
from jaxbundle.pushbroom.scanner import AnglePolynomial, AngleTable, FocalLine, LineTimes, Optics
from jaxbundle.pushbroom.trajectory import AttitudeTable, Trajectory

FRAMES = (*frames.FRAMES, "local")
ANGLES = ("pitch", "roll", "yaw")
INTERPOLATION = ("interpolation", "order", "gap", "extrapolate")
CIRCLE = ("height", "inclination", "node", "argument")
# Of each way to give the positions, the keys that go with it.
ROWS = ("span", "step", *INTERPOLATION)
KINDS = {
    "table": ("frame", *INTERPOLATION),
    "tle": ROWS,
    "circle": ROWS,
    "state": ("at", "j2", "frame", *ROWS),
}
SECTIONS = {
    "scanner": (
        "name",
        "lines",
        "pixels",
        "epoch",
        "earth",
        "angle_unit",
        "source",
        "interpolation",
        "extrapolate",
        "corrections",
    ),
    "times": ("first", "period", "table"),
    "position": (*KINDS, "at", "j2", "frame", *ROWS),
    "attitude": ("table", "frame", *INTERPOLATION),
    "optics": (),  # depends on its kind
    "mounting": ANGLES,
    "corrections": Corrections._fields,
    "earth_orientation": frames.EarthOrientation._fields,
}
REQUIRED_FIELDS = ("scanner", "times", "position", "attitude", "optics")


def scanner_of(file: TomlFile) -> ScannerInput:
    """The pushbroom image that the sections of a scanner file describe.

    **Raises:** `InputError` naming file, section and key, or table and line.
    """
    scanner = file.section("scanner")
    lines, pixels = (scanner.integer(key) for key in ("lines", "pixels"))
    check_size(lines, pixels, scanner.where.removesuffix(": "))
    earth = earth_of(scanner)
    position, positions = _position(file, earth)
    attitude, attitudes, length_warnings = _attitude(file, earth)
    mounting = mounting_of(file)
    switches = file.section("corrections")
    corrections = Corrections(*(switches.switch(name) for name in Corrections._fields))
    if corrections.any and earth is None:
        raise InputError(f"{switches.where}corrections need an Earth; set [scanner] earth")
    image = make_image(
        Trajectory(position, attitude),
        _times(file, lines),
        optics_of(file, pixels),
        lines,
        pixels,
        mounting,
        corrections,
        (positions, attitudes),
    )
    return ScannerInput(scanner.text("name", file.path.stem), image, earth, length_warnings)


def _orientation(file: TomlFile) -> frames.EarthOrientation:
    section = file.section("earth_orientation")
    fields = frames.EarthOrientation._fields
    return frames.EarthOrientation(*(section.number(name, 0.0) for name in fields))


def _epoch(file: TomlFile) -> str:
    epoch = file.section("scanner").values.get("epoch")
    if epoch is None:
        raise InputError(
            f"{file.path}, [scanner]: epoch is missing; an inertial frame needs the UTC from "
            'which times count, such as epoch = "2024-03-01T10:20:30"'
        )
    return str(epoch)


def _options(section: TomlSection, method: str) -> dict[str, Any]:
    """Interpolation, order, gap, extrapolation."""
    options: dict[str, Any] = {"method": section.text("interpolation", method)}
    if "order" in section:
        options["order"] = section.integer("order", at_least=1)
    if "gap" in section:
        options["gap"] = section.number("gap")
        if options["gap"] <= 0:
            raise InputError(
                f"{section.where}gap is {options['gap']:g}; expected the longest step that "
                "is interpolated, a positive number of seconds"
            )
    if "extrapolate" in section:
        options["extrapolate"] = section.number("extrapolate")
    return options


def mounting_of(file: TomlFile) -> tuple[float, float, float]:
    """Pitch, roll, yaw of the mounting in radians."""
    section = file.section("mounting")
    angles = [file.radians * section.number(name, 0.0) for name in ANGLES]
    for name, angle in zip(ANGLES, angles):
        if abs(angle) > FULL_TURN:
            raise InputError(f"{section.where}{_more_than_a_turn(name, angle)}")
    pitch, roll, yaw = angles
    return pitch, roll, yaw


# A turn, and a little for rounding: degrees read as radians are nearly always more.
FULL_TURN = 2 * math.pi * 1.01


def _more_than_a_turn(name: str, angle: float) -> str:
    return (
        f"{name} is {angle:.6g} rad, more than a full turn; are these degrees? Set [scanner] "
        "angle_unit"
    )


def earth_of(scanner: TomlSection) -> Ellipsoid | None:
    """The ellipsoid of [scanner] earth; None for a local frame."""
    value = scanner.values.get("earth", "WGS84")
    if isinstance(value, list):
        axes = scanner.numbers("earth", 3)
        if (axes <= 0).any():
            raise InputError(f"{scanner.where}earth: the semi-axes must be positive, in metres")
        return Ellipsoid(*axes.tolist())
    if value not in ("WGS84", "local"):
        raise InputError(
            f'{scanner.where}earth is {show(value)}; expected "WGS84", "local" or [a, b, c]'
        )
    return WGS84 if value == "WGS84" else None


def _times(file: TomlFile, lines: int) -> LineTimes:
    section = file.section("times")
    if "table" not in section:
        section.check_keys(("first", "period"))
        period = section.number("period")
        if period <= 0:
            raise InputError(f"{section.where}period is {period}; expected a positive number")
        return LineTimes(jnp.asarray(section.number("first", 0.0)), jnp.asarray(period))
    section.check_keys(("table",))
    columns = section.table()
    columns.check_names(("t",), ("line",))
    t = columns.numbers("t", required=True)
    check_times(t, columns.source)
    if lines == 1:
        raise InputError(f"{section.where}table: one line has no period; give first and period")
    if len(t) != lines:
        raise InputError(
            f"{columns.source.name}: {len(t)} times for {lines} lines; expected one row a line"
        )
    return LineTimes(jnp.zeros(()), jnp.zeros(()), jnp.asarray(t))


def _frame(section: TomlSection, earth: Ellipsoid | None, allowed_frames: Sequence[str]) -> str:
    frame = section.text("frame", "local" if earth is None else "ITRF")
    if frame not in allowed_frames:
        raise InputError(
            f"{section.where}unknown frame {frame!r}{did_you_mean(frame, allowed_frames)}"
        )
    # The orbital frame, too: its vertical leads to the centre of the Earth.
    if (earth is None) != (frame == "local"):
        raise InputError(
            f"{section.where}frame is {frame!r}, earth is {'local' if earth is None else 'given'}; "
            'a local frame belongs to [scanner] earth = "local", and no other does'
        )
    return frame


def _position(file: TomlFile, earth: Ellipsoid | None) -> tuple[TimeTable, Source]:
    section = file.section("position")
    kinds = [kind for kind in KINDS if kind in section]
    if len(kinds) != 1:
        raise InputError(f"{section.where}give one of {', '.join(KINDS)}, not {kinds}")
    section.check_keys((kinds[0], *KINDS[kinds[0]]))
    if kinds != ["table"]:
        return _orbit(file, section, kinds[0], earth)
    frame = _frame(section, earth, FRAMES)
    columns = section.table()
    names, rates = ("X", "Y", "Z"), ("VX", "VY", "VZ")
    columns.check_names(("t", *names), rates)
    t = columns.numbers("t", required=True)
    values = lambda names: np.stack([columns.numbers(n, required=True) for n in names], 1)
    P, V = values(names), values(rates) if "VX" in columns.values else None
    if frame in ("GCRF", "J2000", "TEME"):
        check_times(t, columns.source)
        R = frames.to_earth(frame, _epoch(file), t, _orientation(file))
        P, V = frames.turn_positions(R, P, V, _orientation(file))
    if earth is not None:
        check_outside(P, earth, columns.source)
    table = position_table(t, P, V, **_options(section, "lagrange"), source=columns.source)
    return table, columns.source


def check_outside(
    P: Float[np.ndarray, "n 3"], earth: Ellipsoid, source: Callable[[int], str]
) -> None:
    """Refuse positions deep inside the Earth, such as in kilometres; `source` names rows."""
    distance = np.linalg.norm(P, axis=1)
    # A hundredth of the axis, 64 km: no camera is so deep.
    min_distance = 0.99 * min(float(earth.a), float(earth.b), float(earth.c))
    if (is_too_deep := distance < min_distance).any():
        row = int(is_too_deep.argmax())
        raise InputError(
            f"{source(row)}: the position is {distance[row]:.6g} m from the centre of the Earth, "
            f"whose axes are {min_distance / 0.99:.7g} m and more; expected metres from the "
            "centre: is it in kilometres, or in another frame?"
        )


def _orbit(
    file: TomlFile, section: TomlSection, kind: str, earth: Ellipsoid | None
) -> tuple[TimeTable, Source]:
    """Two-line elements, a circle, a state: as a table for interpolation."""
    # Ellipsoids of the Earth differ by a kilometre, other bodies by hundreds.
    if earth is None or abs(float(earth.a) - float(WGS84.a)) > 10e3:
        raise InputError(
            f"{section.where}{kind}: an orbit is about the Earth, which [scanner] earth is not; "
            "give a table of positions"
        )
    start, end = section.numbers("span", 2)
    step = section.number("step", 1.0)
    max_steps = 1_000_000  # 50 MB of states: more is a mistake in the span or the step
    if not (step > 0 and 0 < (end - start) / step <= max_steps):
        raise InputError(
            f"{section.where}span from {start:g} to {end:g} s in steps of {step:g} s; expected 1 "
            f"to {max_steps} steps forward"
        )
    # The last row is at the end of the span.
    t = np.linspace(start, end, 1 + math.ceil((end - start) / step))
    if kind == "tle":
        lines = section.values["tle"]
        is_list = isinstance(lines, list) and len(lines) == 2
        if not (is_list and all(isinstance(line, str) for line in lines)):
            raise InputError(f"{section.where}tle: expected a list of the two lines, in quotes")
        first_line, second_line = lines
        P, V = frames.two_line_orbit(first_line, second_line, _epoch(file), t, _orientation(file))
    elif kind == "state":
        frame = _frame(section, earth, frames.FRAMES)
        time = section.number("at", 0.0)
        state = section.numbers("state", 6)[None]
        P, V = state[:, :3], state[:, 3:]
        if frame != "ITRF":
            R = frames.to_earth(frame, _epoch(file), np.array([time]), _orientation(file))
            P, V = frames.turn_positions(R, P, V, _orientation(file))
        try:
            P, V = state_orbit(t, P[0], V[0], time, section.switch("j2") or "j2" not in section)
        except InputError as error:
            raise InputError(f"{section.where}{error}") from None
    else:
        values = section.values["circle"]
        if not isinstance(values, dict):
            raise InputError(
                f"{section.where}circle is {show(values)}; expected {{ height = …, inclination = … "
                "}"
            )
        circle = TomlSection(file, f"{section.where}circle: ", values)
        circle.check_keys(CIRCLE)
        angles = (circle.number(k, 0.0) for k in CIRCLE[1:])
        angles = [file.radians * angle for angle in angles]
        P, V = frames.circular_orbit(t, read_orbit_height(circle), *angles)
    source = Source(f"{section.where}span")
    return position_table(t, P, V, **_options(section, "lagrange"), source=source), source


def read_orbit_height(section: TomlSection) -> float:
    """The height of a circular orbit, metres.

    **Raises:** `InputError` where no satellite stays."""
    height = section.number("height")
    frames.check_orbit_height(height, section.where)
    return height


def _attitude(
    file: TomlFile, earth: Ellipsoid | None
) -> tuple[AttitudeTable, Source, tuple[str, ...]]:
    """The attitudes, the source of their rows, warnings."""
    section = file.section("attitude")
    frame = _frame(section, earth, (*FRAMES, "orbit"))
    columns = section.table()
    quaternions = "q0" in columns.values
    names = ("q0", "q1", "q2", "q3") if quaternions else ANGLES
    columns.check_names(("t", *names))
    t = columns.numbers("t", required=True)
    values = np.stack([columns.numbers(n, required=True) for n in names], 1)
    length_warnings: tuple[str, ...] = ()
    if quaternions:
        values, length_warnings = normalise_quaternions(values, columns.source)
    else:
        values = file.radians * values
        if (is_more := np.abs(values) > FULL_TURN).any():
            row, k = np.argwhere(is_more)[0].tolist()
            why = _more_than_a_turn(names[k], float(values[row, k]))
            raise InputError(f"{columns.source(row)}: {why}")
    if frame in ("GCRF", "J2000", "TEME"):
        if not quaternions:
            raise InputError(f"{section.where}frame {frame} needs quaternions; give q0, q1, q2, q3")
        check_times(t, columns.source)
        R = frames.to_earth(frame, _epoch(file), t, _orientation(file))
        values = frames.turn_quaternions(R, values)
    attitude = attitude_table(
        t,
        values,
        **_options(section, "slerp" if quaternions else "linear"),
        reference="orbit" if frame == "orbit" else "earth",
        source=columns.source,
    )
    return attitude, columns.source, length_warnings


def optics_of(file: TomlFile, pixels: int) -> Optics:
    """The optics of the section [optics]."""
    section = file.section("optics")
    middle = section.number("middle", (pixels - 1) / 2)
    if "table" in section:
        section.check_keys(("table",))
        columns = section.table()
        columns.check_names(("across", "along"), ("pixel",))
        angles = [file.radians * columns.numbers(n, required=True) for n in ("across", "along")]
        if len(angles[0]) != pixels:
            raise InputError(
                f"{columns.source.name}: {len(angles[0])} rows for {pixels} pixels; one row a pixel"
            )
        return AngleTable(*(jnp.asarray(a) for a in angles))
    if "across" in section:
        section.check_keys(("across", "along", "middle", "half"))
        half = section.number("half", pixels / 2)
        if half == 0:
            raise InputError(f"{section.where}half is 0; expected pixels, half a line of them")
        return AnglePolynomial(
            jnp.asarray(section.numbers("across")),
            jnp.asarray(section.numbers("along")),
            jnp.asarray(middle),
            jnp.asarray(half),
        )
    try:
        model = get_model(section.text("model", "brown"))
        section.check_keys(("model", "pitch", "middle", "row", *model.parameters))
        parameters = {name: section.number(name) for name in model.parameters if name in section}
        check_parameters(model, parameters)
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"{section.where}{error}") from None
    values = default_parameters(model) | parameters
    pitch = section.number("pitch")
    # A negative one counts the pixels the other way.
    if pitch == 0:
        raise InputError(f"{section.where}pitch is 0; the size of a pixel in {model.unit}, please")
    return FocalLine(
        jnp.asarray([values[name] for name in model.parameters]),
        jnp.asarray(pitch),
        jnp.asarray(middle),
        jnp.asarray(section.number("row", 0.0)),
        model.name,
    )
