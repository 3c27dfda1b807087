"""Units of acceptance criteria, and their conversion."""

import math
from typing import NamedTuple

from jaxbundle.errors import InputError
from jaxbundle.network.units import METRES

ANGLES = {
    "rad": 1.0,
    "mrad": 1e-3,
    "urad": 1e-6,
    "deg": math.pi / 180,
    "arcmin": math.pi / 10800,
    "arcsec": math.pi / 648000,
    "gon": math.pi / 200,
    "mgon": math.pi / 2e5,
}
RATIOS = {"": 1.0, "%": 1e-2, "ppm": 1e-6}
PIXELS = {"px": 1.0, "mpx": 1e-3}
KINDS = {"length": METRES, "angle": ANGLES, "number": RATIOS, "image": PIXELS}


class PixelPitch(NamedTuple):
    """Millimetres of a pixel, of the cameras of a result; None if unknown, or if they differ."""

    mm: float | None = None


NO_PITCH = PixelPitch()


def kind_of(unit: str) -> str:
    """ "length", "angle", "number" or "image"; empty for a unit that is only a label."""
    return next((kind for kind, known_units in KINDS.items() if unit in known_units), "")


def convert(value: float, from_unit: str, to_unit: str, pitch: PixelPitch = NO_PITCH) -> float:
    """A value in another unit; lengths in the image and pixels by the pixel size.

    **Raises:** `InputError` naming the units that would do."""
    if from_unit == to_unit:
        return value
    kinds = kind_of(from_unit), kind_of(to_unit)
    if kinds[0] and kinds[0] == kinds[1]:
        units = KINDS[kinds[0]]
        return value * units[from_unit] / units[to_unit]
    if {*kinds} == {"length", "image"} and pitch.mm is not None:
        if kinds[0] == "image":
            return value * PIXELS[from_unit] * pitch.mm * 1e-3 / METRES[to_unit]
        return value * METRES[from_unit] / (pitch.mm * 1e-3) / PIXELS[to_unit]
    raise InputError(_refusal(from_unit, to_unit))


def _refusal(from_unit: str, to_unit: str) -> str:
    expected = KINDS.get(kind_of(from_unit))
    known_units = [name for name in expected or () if name.isascii() and name]
    given_words = "no unit" if not to_unit else f"the unit {to_unit!r}"
    if expected is None:
        return f"its unit is {from_unit!r}, which is no length, but {given_words} is given"
    if from_unit == "" and to_unit:
        return f"it is a number without unit, but {given_words} is given"
    remark = ""
    if {kind_of(from_unit), kind_of(to_unit)} == {"length", "image"}:
        remark = "; pixels and lengths need one pixel_size of all cameras"
    return f"expected one of {', '.join(known_units)}, but {given_words} is given{remark}"
