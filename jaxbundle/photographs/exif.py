"""Metadata of a photograph: camera, time, position (EXIF) and attitude (XMP).

Every value may be missing, and some cameras write wrong ones: they are start values and priors.
"""

import dataclasses
import datetime
import math
import warnings
from pathlib import Path
from typing import NamedTuple

from jaxbundle.photographs.reading import open_image
from jaxbundle.photographs.sensors import sensor_width
from jaxbundle.photographs.xmp import Attitude, Xmp, parse_xmp

MAKE, MODEL, ORIENTATION, DATE = 0x010F, 0x0110, 0x0112, 0x0132
DETAILS, GPS, PACKET = 0x8769, 0x8825, 0x02BC
PNG_PACKET = "XML:com.adobe.xmp"
FOCAL_LENGTH, FOCAL_LENGTH_35, DATE_TAKEN, FRACTION = 0x920A, 0xA405, 0x9003, 0x9291
PLANE_X, PLANE_UNIT = 0xA20E, 0xA210
TAKEN_X, TAKEN_Y = 0xA002, 0xA003
SHAPE = 0.02
"""Difference of the ratio of the sides, from rounding and borders, without a crop."""
FILM_DIAGONAL = math.hypot(36, 24)
"""mm: reference of focal lengths equivalent to 35 mm film."""
MM = {2: 25.4, 3: 10.0, 4: 1.0}
"""Units of the resolution in the focal plane."""
UPRIGHT = 1
NOMINAL = 0.05
"""Relative σ of a principal distance from a stated focal length: focal lengths are rounded, the
sensor is a few per cent wider than the photograph, and focused at 20 focal lengths the principal
distance is 5 % longer."""
ROUNDING = 1 / math.sqrt(12)
"""mm: σ of a focal length equivalent to 35 mm film, which is a whole number."""


class StatedDistance(NamedTuple):
    """A principal distance stated by a file, and its σ, pixels; its source in words."""

    value: float
    sigma: float
    source: str


@dataclasses.dataclass(frozen=True)
class Place:
    """Latitude and longitude in degrees (WGS 84), height in metres with uncertain reference
    (EXIF: above sea level); `sigma` of the position, and of the height, metres, if
    stated."""

    latitude: float
    longitude: float
    height: float | None = None
    sigma: float | None = None
    sigma_height: float | None = None


@dataclasses.dataclass(frozen=True)
class Exif:
    """Size in pixels; the camera; focal length in mm, and its equivalent for
    35 mm film; pixels per mm in the focal plane; orientation (1: as on the sensor); time; whether
    the photograph was `cropped` to another shape."""

    size: tuple[int, int]
    make: str = ""
    model: str = ""
    focal_length: float | None = None
    focal_length_35: float | None = None
    resolution: float | None = None
    orientation: int = UPRIGHT
    time: datetime.datetime | None = None
    place: Place | None = None
    attitude: Attitude | None = None
    cropped: bool = False

    @property
    def camera(self) -> str:
        """Make and model without repetition."""
        first = self.make.split()[:1]
        repeated = first and self.model.lower().startswith(first[0].lower())
        return (self.model if repeated else f"{self.make} {self.model}").strip()

    def principal_distance(self) -> StatedDistance | None:
        """The principal distance in pixels of this file, whatever the size of the photograph as it
        was taken; None if unknown."""
        if self.cropped:
            return None
        long = max(self.size)
        width = sensor_width(self.make, self.model)
        if self.focal_length and width:
            value, relative = self.focal_length / width * long, NOMINAL
            source = "focal length and sensor"
        elif self.focal_length_35:
            value = self.focal_length_35 / FILM_DIAGONAL * math.hypot(*self.size)
            relative = math.hypot(NOMINAL, ROUNDING / self.focal_length_35)
            source = "focal length equivalent to 35 mm film"
        elif self.focal_length and self.resolution:
            value, relative = self.focal_length * self.resolution, NOMINAL
            source = "focal length and resolution"
        else:
            return None
        return StatedDistance(value, relative * value, source)


def read_exif(path: str | Path) -> Exif:
    """The metadata in the header of a file.

    **Raises:** `InputError` if it is not an image.
    """
    with open_image(path) as image, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about damaged headers
        size = image.size
        try:
            head = image.getexif()
            details, gps = head.get_ifd(DETAILS), head.get_ifd(GPS)
            packet = image.info.get("xmp") or image.info.get(PNG_PACKET) or head.get(PACKET) or b""
        except Exception:  # any error of the reader on a damaged header
            return Exif(size)
    resolution = _positive(details.get(PLANE_X))
    unit = MM.get(details.get(PLANE_UNIT, 2))
    taken = sorted(_positive(details.get(side)) or 0 for side in (TAKEN_X, TAKEN_Y))
    if resolution and taken[1]:
        # of the original photograph: programs that reduce it usually keep this
        resolution *= max(size) / taken[1]
    xmp = parse_xmp(packet) if isinstance(packet, bytes | str) else Xmp()
    return Exif(
        size=size,
        make=_text(head.get(MAKE)),
        model=_text(head.get(MODEL)),
        focal_length=_positive(details.get(FOCAL_LENGTH)),
        focal_length_35=_positive(details.get(FOCAL_LENGTH_35)),
        resolution=resolution / unit if resolution and unit else None,
        orientation=_whole(head.get(ORIENTATION), UPRIGHT),
        time=_time(details.get(DATE_TAKEN) or head.get(DATE), details.get(FRACTION)),
        place=_place(gps, xmp),
        attitude=xmp.attitude,
        cropped=taken[0] > 0 and abs(math.log(taken[1] / taken[0] * min(size) / max(size))) > SHAPE,
    )


def _text(value) -> str:
    return value.replace("\0", " ").strip() if isinstance(value, str) else ""


def _number(value) -> float | None:
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) else None


def _positive(value) -> float | None:
    number = _number(value)
    return number if number and number > 0 else None


def _whole(value, otherwise: int) -> int:
    number = _number(value)
    return otherwise if number is None or not 1 <= number <= 8 else int(number)


def _time(value, fraction) -> datetime.datetime | None:
    try:
        time = datetime.datetime.strptime(_text(value)[:19], "%Y:%m:%d %H:%M:%S")
        part = _text(fraction)
        return time.replace(microsecond=int(float(f"0.{part}") * 1e6)) if part else time
    except ValueError:
        return None


def _place(gps, xmp: Xmp) -> Place | None:
    latitude, longitude = _angle(gps.get(2), gps.get(1)), _angle(gps.get(4), gps.get(3))
    if latitude is None or longitude is None or (latitude == 0 and longitude == 0):
        return None
    height = _number(gps.get(6))
    below = gps.get(5) in (1, b"\x01")
    return Place(
        latitude,
        longitude,
        None if height is None else -height if below else height,
        xmp.sigma or _positive(gps.get(31)),
        xmp.sigma_height,
    )


def _angle(parts, reference) -> float | None:
    """Degrees, minutes, seconds as degrees; negative to the south and west."""
    try:
        degrees, minutes, seconds = (float(part) for part in parts)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    angle = degrees + minutes / 60 + seconds / 3600
    if not math.isfinite(angle) or abs(angle) > 180:
        return None
    return -angle if _text(reference)[:1].upper() in ("S", "W") else angle
