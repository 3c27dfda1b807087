"""The form of the attitude trajectories of a flight in the explorer: amplitude and period of an
oscillation, σ of a random walk, for roll, pitch and yaw each.

They belong to the first oscillation (`sine`) and the first random walk (`walk`) of an angle of the
flight file (`pushbroom.signals`); the other signals of the angle stay as they are. An angle without
them gets them as soon as they are not 0.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from jaxbundle.explorer.page import Number
from jaxbundle.explorer.tracks import shorten_number

NAMES = ("roll", "pitch", "yaw")
# Of a control: the kind of signal and its key.
FORM = {
    "amplitude": ("sine", "amplitude"),
    "period": ("sine", "period"),
    "walk": ("walk", "sigma"),
}


class AttitudeForms(NamedTuple):
    """The signals of the file, the duration of the image in seconds, and the values of the controls
    by angle: degrees, seconds, degrees in a second."""

    given: Mapping[str, Any]
    duration: float
    known: Mapping[str, Mapping[str, float]]


def attitude_forms(angles: Mapping[str, Any], duration: float) -> AttitudeForms:
    """The forms of the angles of a flight; an angle without oscillation begins with one period in
    the image."""
    forms_of_file = {}
    for name in NAMES:
        values = {}
        for key, (kind, entry) in FORM.items():
            k = _index_of_kind(_parts(angles, name), kind)
            if k is None:
                values[key] = shorten_number(duration, 4) if key == "period" else 0.0
            else:
                value = float(_parts(angles, name)[k].get(entry, 1.0 if key == "period" else 0.0))
                values[key] = value if key == "period" else shorten_number(np.degrees(value))
        forms_of_file[name] = values
    return AttitudeForms(angles, duration, forms_of_file)


def attitude_controls(forms: AttitudeForms) -> list[Number]:
    """Amplitude, period and random walk of every angle, with sliders."""
    # 2° are what a satellite swings by in an image at most; a random walk of this σ in a second
    # reaches 1° in the time of the image
    walk = shorten_number(1 / np.sqrt(forms.duration), 2)
    shortest, longest = (shorten_number(forms.duration * f, 2) for f in (0.1, 10.0))
    controls = []
    for name, values in forms.known.items():
        for key, label, unit, low, high in (
            ("amplitude", "amplitude", "°", 0.0, 2.0),
            ("period", "period", "s", shortest, longest),
            ("walk", "random walk in a second", "°", 0.0, walk),
        ):
            value = values[key]
            control = Number(f"{name}_{key}", f"{name}: {label}", value, unit)
            controls.append(control._replace(low=min(low, value), high=max(high, value)))
    return controls


def choose_angles(forms: AttitudeForms, values: Mapping[str, Any]) -> Mapping[str, Any]:
    """The signals with these values of the controls; those of the file where nothing is changed."""
    changed = {}
    for name, form_of_file in forms.known.items():
        form = {key: values[f"{name}_{key}"] for key in FORM}
        # Controls show rounded values: an angle that nobody has moved keeps those of the file, to
        # the last digit, and its pictures stay.
        if form != form_of_file:
            parts = [dict(p) if isinstance(p, Mapping) else p for p in _parts(forms.given, name)]
            sine = {"amplitude": np.radians(form["amplitude"]), "period": form["period"]}
            if (
                form["amplitude"] != form_of_file["amplitude"]
                or form["period"] != form_of_file["period"]
            ):
                _change(parts, "sine", sine, {})
            if form["walk"] != form_of_file["walk"]:
                # Ten steps in the image, where the file says nothing.
                _change(
                    parts,
                    "walk",
                    {"sigma": np.radians(form["walk"])},
                    {"step": forms.duration / 10},
                )
            changed[name] = parts
    return {**forms.given, **changed} if changed else forms.given


def _parts(angles: Mapping[str, Any], name: str) -> list[Any]:
    parts = angles.get(name, 0.0)
    return list(parts) if isinstance(parts, list | tuple) else [parts]


def _index_of_kind(parts: list[Any], kind: str) -> int | None:
    """The index of the first signal of a kind."""
    kinds = [part.get("kind", "constant") if isinstance(part, Mapping) else None for part in parts]
    return kinds.index(kind) if kind in kinds else None


def _change(
    parts: list[Any], kind: str, entries: Mapping[str, float], otherwise: Mapping[str, float]
) -> None:
    """Change the first signal of a kind; a new one is last, so that the random numbers of the
    others, which follow from their places, stay."""
    k = _index_of_kind(parts, kind)
    if k is None:
        parts.append({"kind": kind, **otherwise})
        k = len(parts) - 1
    parts[k].update({key: float(value) for key, value in entries.items()})
