"""What a quantity is that acceptance criteria may name."""

import dataclasses
from collections.abc import Callable, Collection, Mapping
from typing import Any

from jaxbundle.cameras import get_model
from jaxbundle.cameras.model import PRINCIPAL_DISTANCES
from jaxbundle.certificates.lengths import LengthTest
from jaxbundle.certificates.units import NO_PITCH, PixelPitch
from jaxbundle.errors import InputError
from jaxbundle.network.columns import did_you_mean
from jaxbundle.network.tables import EXTERIOR

AXES = ("X", "Y", "Z")


@dataclasses.dataclass(frozen=True)
class Subject:
    """What criteria are about: a result, and the test of calibrated lengths, if there is one."""

    result: Any
    lengths: LengthTest | None = None


@dataclasses.dataclass(frozen=True)
class QuantityValues:
    """Values of a quantity by what they are of ("" for the whole), in `unit`; `owners`: the inputs
    of a batch that a value concerns, by the same names."""

    values: Mapping[str, float]
    unit: str = ""
    pitch: PixelPitch = NO_PITCH
    owners: Mapping[str, str | list[str]] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class Quantity:
    """A quantity: its `form` for lists ("sigma(NAME)", in brackets what may be omitted), its `unit`
    in words, what it is; `find` its values in a subject, by an argument of its form."""

    form: str
    unit: str
    words: str
    find: Callable[[Subject, str], QuantityValues]

    @property
    def name(self) -> str:
        return self.form.partition("(")[0].rstrip("[")

    @property
    def arguments(self) -> tuple[str, ...]:
        """The arguments it may have; names of them in capitals."""
        argument_words = self.form.partition("(")[2].rstrip(")]")
        return tuple(argument_words.split("|")) if argument_words else ()

    def check_argument(self, argument: str) -> None:
        """Refuse an argument that is none of those, where they are not names of a result.

        **Raises:** `InputError`."""
        expected = self.arguments
        if not expected:
            refuse_argument(argument)
        open_ones = any("NAME" in word or word == "CAMERA" for word in expected)
        may_be_omitted = not expected or "[" in self.form
        if open_ones or argument in expected or (not argument and may_be_omitted):
            return
        raise InputError(f"({argument}): expected one of {', '.join(expected)}")


def one_value(value: float, unit: str = "") -> QuantityValues:
    return QuantityValues({"": float(value)}, unit)


def refuse_argument(argument: str) -> None:
    if argument:
        raise InputError(f"it has no argument, but ({argument}) is given")


def number_of_result(function: Callable[[Any], float]) -> Callable[[Subject, str], QuantityValues]:
    """How to find a quantity without an argument: one number, a function of the result."""

    def find(subject: Subject, _: str) -> QuantityValues:
        return one_value(function(subject.result))

    return find


def rig_camera_and_name(argument: str) -> tuple[str, str]:
    """Camera (* for all) and parameter of a σ of a rig: NAME, CAMERA:NAME or camera:CAMERA:NAME."""
    camera, mark, name = argument.partition(":")
    if not mark:
        return "*", argument
    if camera == "camera" and ":" in name:
        camera, _, name = name.rpartition(":")
    return camera, name


def require_rig_camera(camera: str, known_cameras: Collection[str]) -> None:
    """Refuse the name of a camera that a rig does not have; * are all.

    **Raises:** `InputError`."""
    if camera not in ("*", *known_cameras):
        raise InputError(f"there is no camera {camera!r}{did_you_mean(camera, known_cameras)}")


def require_parameter(cameras: Any, name: str) -> None:
    """Refuse a name that is no parameter of any of these cameras.

    **Raises:** `InputError`."""
    models = [get_model(c.model) for c in cameras]
    known_parameters = dict.fromkeys(p for model in models for p in model.parameters)
    if name not in known_parameters:
        hint = did_you_mean(name, known_parameters, listing=False)
        if any(name in names for names in PRINCIPAL_DISTANCES):  # that of other models
            distances = dict.fromkeys(p for model in models for p in model.principal_distance)
            hint = f"; the principal distance of this model is {' and '.join(distances)}"
        raise InputError(
            f"there is no parameter {name!r}{hint}; known: "
            f"{', '.join([*known_parameters, *EXTERIOR, *AXES])}"
        )
