"""The tracks of a flight in the explorer: an orbit, a track from place to place above the Earth, or
a straight track above a plane.

A flight file has one of them; the others begin with usual values, or as high, as fast and where the
given one is.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbundle.explorer.page import Number
from jaxbundle.geometry.ellipsoid import WGS84, Ellipsoid, earth_fixed, geodetic
from jaxbundle.pushbroom.earth_frames import circular_orbit
from jaxbundle.pushbroom.image import PushbroomImage
from jaxbundle.pushbroom.trajectory import position_at

ORBIT, PLACES, STRAIGHT = "orbit", "from place to place", "straight track"
# The parameters of an orbit: label and unit.
ORBIT_LABELS = {
    "height": ("height of the orbit", "m"),
    "inclination": ("inclination", "°"),
    "node": ("right ascension of the node", "°"),
    "argument": ("argument of latitude", "°"),
}
# The coordinates of the first and the last line.
GEODETIC = {"longitude": "°", "latitude": "°", "height": "m"}
LOCAL = {"X": "m", "Y": "m", "Z": "m"}
ENDS = {"start": "first line", "end": "last line"}
# A circular orbit; at 500 km an inclination of 97.4° makes it synchronous with the sun.
USUAL = {"height": 500e3, "inclination": 97.4, "node": 0.0, "argument": 0.0}

Place = Float[np.ndarray, "3"]


class Tracks(NamedTuple):
    """Which of them the file has, that track, the ellipsoid, and the controls of each by their
    values."""

    kind: str
    given: Mapping[str, Any]
    earth: Ellipsoid
    known: Mapping[str, Mapping[str, float]]


def tracks_of(track: Mapping[str, Any], image: PushbroomImage, earth: Ellipsoid | None) -> Tracks:
    """The tracks of a flight; `image`: the one of its own track. A state vector has no controls."""
    times = [float(image.times.time(line)) for line in (0.0, image.lines - 1.0)]
    ends = [np.asarray(position_at(image.trajectory, jnp.asarray(t))) for t in times]
    if earth is None:
        orbit = dict(USUAL)
        radians = {k: np.radians(v) if k != "height" else v for k, v in orbit.items()}
        on_earth = list(circular_orbit(np.array(times), **radians)[0])
        values_of_tracks = {
            ORBIT: orbit,
            PLACES: _geodetic_ends(on_earth, WGS84, 8),
            STRAIGHT: _values(ends, LOCAL),
        }
        return Tracks(STRAIGHT, track, WGS84, values_of_tracks)
    orbit = {name: shorten_number(np.degrees(track.get(name, 0.0))) for name in USUAL}
    orbit = {**orbit, "height": float(track["height"])} if "height" in track else {}
    if "end" in track:
        # As high over the middle of the track's ends.
        orbit = {
            **USUAL,
            "height": shorten_number(np.linalg.norm(ends, axis=1).mean() - earth.a, 6),
        }
    radius = np.linalg.norm(ends, axis=1)
    length = np.linalg.norm(ends[1] - ends[0]) * float(earth.a) / radius.mean()
    altitude = radius.mean() - float(earth.a)
    straight = [np.array([0.0, y, altitude]) for y in (0.0, length)]
    values_of_tracks = {
        ORBIT: orbit,
        PLACES: _geodetic_ends(ends, earth, 12 if "end" in track else 8),
        STRAIGHT: _values(straight, LOCAL, 6),
    }
    return Tracks(PLACES if "end" in track else ORBIT, track, earth, values_of_tracks)


def track_controls(tracks: Tracks) -> list[Number]:
    """The parameters of all tracks."""
    controls = [
        Number(name, ORBIT_LABELS[name][0], value, ORBIT_LABELS[name][1])
        for name, value in tracks.known[ORBIT].items()
    ]
    for kind, units in ((PLACES, GEODETIC), (STRAIGHT, LOCAL)):
        values = tracks.known[kind]
        reach = _reach(values, kind)
        for key, value in values.items():
            end, axis = key.split("_")
            # Half the track to either side, and half the height.
            half_range = abs(value) / 2 if axis in ("height", "Z") else reach[axis] / 2
            controls.append(
                Number(
                    key,
                    f"{ENDS[end]}: {axis}",
                    value,
                    units[axis],
                    value - half_range,
                    value + half_range,
                )
            )
    return controls


def idle_controls(tracks: Tracks, kind: str) -> list[str]:
    """The keys of the tracks that are not chosen."""
    return [
        name for other_kind, values in tracks.known.items() if other_kind != kind for name in values
    ]


def choose_track(tracks: Tracks, values: Mapping[str, Any]) -> Mapping[str, Any]:
    """The track `values["track"]` with its values; the given one where nothing is changed."""
    kind = values["track"]
    values_of_track = {name: values[name] for name in tracks.known[kind]}
    if kind == tracks.kind and values_of_track == tracks.known[kind]:
        return tracks.given
    if kind == ORBIT:
        given = tracks.given if kind == tracks.kind else {}
        angles = {
            name: float(np.radians(v)) for name, v in values_of_track.items() if name != "height"
        }
        return {**given, "height": values_of_track["height"], **angles}
    if kind == STRAIGHT:
        return {end: [values_of_track[f"{end}_{axis}"] for axis in LOCAL] for end in ENDS}
    ends = {}
    for end in ENDS:
        longitude, latitude, height = (values_of_track[f"{end}_{axis}"] for axis in GEODETIC)
        place = np.radians(longitude), np.radians(latitude), height
        ends[end] = np.array([float(v) for v in earth_fixed(tracks.earth, place)])
    return {**ends, "centre": np.zeros(3)}


def shorten_number(value: Any, places: int = 12) -> float:
    """The shortest form: 0.01, not 0.010000000000000002."""
    return float(f"{value:.{places}g}")


def _values(ends: list[Place], axes: Mapping[str, str], places: int = 12) -> dict[str, float]:
    return {
        f"{end}_{axis}": shorten_number(value, places)
        for end, place in zip(ENDS, ends)
        for axis, value in zip(axes, place)
    }


def _geodetic_ends(ends: list[Place], earth: Ellipsoid, places: int) -> dict[str, float]:
    """Longitude, latitude (degrees) and height of Earth-fixed positions."""
    geodetic_ends = []
    for place in ends:
        longitude, latitude, height = (float(v) for v in geodetic(earth, tuple(place)))
        geodetic_ends.append(np.array([np.degrees(longitude), np.degrees(latitude), height]))
    return _values(geodetic_ends, GEODETIC, places)


def _reach(values: Mapping[str, float], kind: str) -> dict[str, float]:
    """The length of a track along its two horizontal axes, in their units."""
    axes = tuple(GEODETIC if kind == PLACES else LOCAL)[:2]
    x, y = (values[f"end_{axis}"] - values[f"start_{axis}"] for axis in axes)
    stretch = 1.0
    if kind == PLACES:
        # Degrees of longitude are shorter by the cosine of the latitude; not at a pole.
        stretch = max(float(np.cos(np.radians(values["start_latitude"]))), 1e-3)
        x = (x + 180) % 360 - 180
    length = float(np.hypot(x * stretch, y))
    return {axes[0]: length / stretch, axes[1]: length}
