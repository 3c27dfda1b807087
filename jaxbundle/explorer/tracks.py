"""The tracks of a flight in the explorer: an orbit, or a straight line above a plane.

A flight file has one of them; the other begins with usual values, as high and as fast as the given
one where that is an orbit.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from jaxbundle.explorer.page import Number
from jaxbundle.geometry.ellipsoid import WGS84, Ellipsoid
from jaxbundle.pushbroom.image import PushbroomImage

ORBIT, STRAIGHT = "orbit", "straight track"
# The parameters of an orbit and of a straight track: label and unit.
LABELS = {
    "height": ("height of the orbit", "m"),
    "inclination": ("inclination", "°"),
    "node": ("right ascension of the node", "°"),
    "argument": ("argument of latitude", "°"),
    "altitude": ("altitude of the track", "m"),
    "speed": ("speed over ground", "m/s"),
    "heading": ("heading, clockwise from y", "°"),
}
# A circular orbit; at 500 km an inclination of 97.4° makes it synchronous with the sun.
USUAL = {"height": 500e3, "inclination": 97.4, "node": 0.0, "argument": 0.0}


class Tracks(NamedTuple):
    """Which of them the file has, that track, the ellipsoid, and the controls of either by their
    values."""

    kind: str
    given: Mapping[str, Any]
    earth: Ellipsoid
    known: Mapping[str, Mapping[str, float]]


def tracks_of(track: Mapping[str, Any], image: PushbroomImage, earth: Ellipsoid | None) -> Tracks:
    """The tracks of a flight; `image`: the one of its own track. A state vector has no controls."""
    if "start" in track:
        x, y, _ = velocity = np.asarray(track["velocity"], float)
        straight = {
            "altitude": track["start"][2],
            "speed": np.linalg.norm(velocity),
            "heading": np.degrees(np.arctan2(x, y)),
        }
        known = {ORBIT: USUAL, STRAIGHT: {name: shorten_number(v) for name, v in straight.items()}}
        return Tracks(STRAIGHT, track, earth or WGS84, known)
    assert earth is not None and image.trajectory.position.rates is not None
    P, V = (
        np.linalg.norm(np.asarray(rows)[0])
        for rows in (image.trajectory.position.values, image.trajectory.position.rates)
    )
    straight = {
        "altitude": shorten_number(P - earth.a, 3),
        "speed": shorten_number(V * earth.a / P, 3),
        "heading": 0.0,
    }
    orbit = {name: shorten_number(np.degrees(track.get(name, 0.0))) for name in USUAL}
    orbit = {**orbit, "height": float(track["height"])} if "height" in track else {}
    return Tracks(ORBIT, track, earth, {ORBIT: orbit, STRAIGHT: straight})


def track_controls(tracks: Tracks) -> list[Number]:
    """The parameters of both tracks."""
    return [
        Number(name, LABELS[name][0], value, LABELS[name][1])
        for values in tracks.known.values()
        for name, value in values.items()
    ]


def idle_controls(tracks: Tracks, kind: str) -> list[str]:
    """The keys of the track that is not chosen."""
    return [name for other, values in tracks.known.items() if other != kind for name in values]


def choose_track(tracks: Tracks, values: Mapping[str, Any]) -> Mapping[str, Any]:
    """The track `values["track"]` with its values; the given one where nothing is changed."""
    kind = values["track"]
    chosen = {name: values[name] for name in tracks.known[kind]}
    if kind == tracks.kind and chosen == tracks.known[kind]:
        return tracks.given
    given = tracks.given if kind == tracks.kind else {}
    if kind == ORBIT:
        angles = {name: float(np.radians(v)) for name, v in chosen.items() if name != "height"}
        return {**given, "height": chosen["height"], **angles}
    x, y, _ = given.get("start", (0.0, 0.0, 0.0))
    climb = float(given.get("velocity", (0.0, 0.0, 0.0))[2])
    heading, level = np.radians(chosen["heading"]), np.sqrt(max(chosen["speed"] ** 2 - climb**2, 0))
    velocity = [float(level * np.sin(heading)), float(level * np.cos(heading)), climb]
    return {"start": [x, y, chosen["altitude"]], "velocity": velocity}


def shorten_number(value: Any, places: int = 12) -> float:
    """The shortest form: 0.01, not 0.010000000000000002."""
    return float(f"{value:.{places}g}")
