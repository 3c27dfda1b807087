"""The flight file: what `jaxbundle pushbroom simulate` simulates.

```toml
[scanner]                           # as in a scanner file
lines = 10000
pixels = 8000
earth = "WGS84"
angle_unit = "deg"

[times]
period = 0.00066

[optics]                            # as in a scanner file, [mounting] too
c = 700.0
pitch = 0.0065

[track]                             # height, inclination, node, argument; or state; or start and
                                    # end; with a local Earth start and velocity or end
height = 505000.0
inclination = 97.4

[angles]                            # pitch, roll, yaw: a number, a signal, or a list of them
roll = { kind = "sine", amplitude = 1.0, period = 135.0 }

[instruments]                       # Hz; how their samples are interpolated
position_rate = 2.0
attitude_rate = 4.0
attitude_interpolation = "spline"

[noise]                             # σ: attitude_… in the unit of angles, position_… in metres
attitude_white = 0.01               # …_bias, …_drift (a second), …_white (every row)

[simulation]
seed = 1
```
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import Ellipsoid, earth_fixed
from jaxbundle.io.scanner.scanner_file import (
    ANGLES,
    check_outside,
    earth_of,
    mounting_of,
    optics_of,
    read_orbit_height,
)
from jaxbundle.io.text.sections import TomlFile, TomlSection, read_sections
from jaxbundle.network.columns import did_you_mean
from jaxbundle.pushbroom.flight import Flight
from jaxbundle.pushbroom.noise import Noise, Sigma
from jaxbundle.pushbroom.signals import KEYS

ORBIT = ("height", "inclination", "node", "argument")
LINE = ("start", "velocity", "end")
ENDS = ("start", "end")
STATE = ("state", "at", "j2")
RATES = ("position_rate", "attitude_rate")
METHODS = ("position_interpolation", "attitude_interpolation")
SECTIONS = {
    "scanner": ("name", "lines", "pixels", "earth", "angle_unit"),
    "times": ("period",),
    "optics": (),
    "mounting": ANGLES,
    "track": (*ORBIT, *LINE, *STATE),
    "angles": ANGLES,
    "instruments": (*RATES, *METHODS),
    "noise": Noise._fields,
    "simulation": ("seed",),
}
REQUIRED_FIELDS = ("scanner", "times", "optics", "track")


class FlightFile(NamedTuple):
    """A flight file, its content, and the ellipsoid of its Earth."""

    file: TomlFile
    flight: Flight
    earth: Ellipsoid | None


def read_flight(path: str | Path) -> FlightFile:
    """The flight of a file.

    **Raises:** `InputError` naming file, section and key.
    """
    file = read_sections(Path(path), SECTIONS, REQUIRED_FIELDS)
    scanner, times = file.section("scanner"), file.section("times")
    earth = earth_of(scanner)
    period = times.number("period")
    if period <= 0:
        raise InputError(f"{times.where}period is {period}; expected a positive number")
    pixels = scanner.integer("pixels")
    instruments = file.section("instruments")
    options: dict[str, Any] = {k: instruments.number(k) for k in RATES if k in instruments}
    for name, rate in options.items():
        if rate <= 0:
            raise InputError(f"{instruments.where}{name} is {rate}; a positive number, in Hz")
    options |= {k: instruments.text(k) for k in METHODS if k in instruments}
    noise = file.section("noise")
    flight = Flight(
        scanner.integer("lines"),
        pixels,
        period,
        optics_of(file, pixels),
        _read_track(file, earth),
        {
            k: _signal_in_radians(v, file.radians, f"{path}, [angles], {k}: ")
            for k, v in file.section("angles").values.items()
        },
        mounting_of(file),
        noise=Noise(*(_sigma(noise, name, file.radians) for name in Noise._fields)),
        seed=file.section("simulation").integer("seed", 0, at_least=0),
        **options,
    )
    return FlightFile(file, flight, earth)


def _read_track(file: TomlFile, earth: Ellipsoid | None) -> dict[str, Any]:
    track = file.section("track")
    if earth is None:
        track.check_keys(LINE)
        if "velocity" in track and "end" in track:
            raise InputError(f"{track.where}velocity and end are both given; give one of them")
        return {k: track.numbers(k, 3) for k in ("start", "end" if "end" in track else "velocity")}
    if "start" in track or "end" in track:
        track.check_keys(ENDS)
        end_positions = {k: _end_position(track, k, file.radians, earth) for k in ENDS}
        return {**end_positions, "centre": np.zeros(3)}
    if "state" in track:
        track.check_keys(STATE)
        j2 = track.switch("j2") or "j2" not in track
        return {"state": track.numbers("state", 6), "at": track.number("at", 0.0), "j2": j2}
    track.check_keys(ORBIT)
    angles = {k: file.radians * track.number(k, 0.0) for k in ORBIT[1:]}
    return {"height": read_orbit_height(track), **angles}


def _end_position(track: TomlSection, key: str, radians: float, earth: Ellipsoid) -> np.ndarray:
    """A position Earth-fixed, of longitude, latitude and height."""
    longitude, latitude, height = track.numbers(key, 3)
    if not abs(radians * latitude) <= np.pi / 2:
        raise InputError(
            f"{track.where}{key} has a latitude of {latitude:g}; expected longitude, latitude, "
            "height, in the unit of angles and metres"
        )
    geographic = radians * longitude, radians * latitude, height
    position = np.array([float(v) for v in earth_fixed(earth, geographic)])
    check_outside(position[None], earth, lambda _: f"{track.where}{key}")
    return position


def _sigma(section: TomlSection, name: str, radians: float) -> Sigma:
    # Attitudes are given in the unit of angles, positions in metres.
    unit = radians if name.startswith("attitude") else 1.0
    if isinstance(section.values.get(name), list):
        sigma = section.numbers(name, 3)
    else:
        sigma = section.number(name, 0.0)
    if np.any(np.asarray(sigma) < 0):
        raise InputError(f"{section.where}{name} is negative; expected a standard deviation")
    return unit * sigma


def _signal_in_radians(value: Any, unit: float, where: str) -> float | dict[str, Any] | list[Any]:
    """A signal with its angles in radians."""
    if isinstance(value, list):
        return [_signal_in_radians(part, unit, where) for part in value]
    if isinstance(value, int | float) and not isinstance(value, bool):
        return unit * value
    if not isinstance(value, Mapping):
        raise InputError(f'{where}expected a number, or a table such as {{ kind = "sine", … }}')
    kind = value.get("kind", "constant")
    if kind not in KEYS:
        raise InputError(f"{where}unknown signal {kind!r}{did_you_mean(str(kind), KEYS)}")
    section = TomlSection(None, where, dict(value))
    section.check_keys(("kind", *KEYS[kind]))
    scaled: dict[str, Any] = {"kind": kind}
    for key in value:
        if key in ("times", "values"):
            scaled[key] = (unit if key == "values" else 1.0) * section.numbers(key)
        elif key != "kind":
            # Times are no angles.
            scaled[key] = (1.0 if key in ("period", "step") else unit) * section.number(key)
    return scaled
