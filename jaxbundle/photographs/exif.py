"""Metadata of a photograph: camera, time, position (EXIF) and attitude (XMP).

Every value may be missing or of another type than the standard says (`Any` below), and some
cameras write wrong ones: they are start values and priors. Tags are those of Exif 2.32 (CIPA
DC-008), by Pillow's names.
"""

import dataclasses
import datetime
import math
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from jaxbundle.photographs.reading import open_image
from jaxbundle.photographs.sensors import sensor_width
from jaxbundle.photographs.xmp import CameraAttitude, Xmp, parse_xmp

# Name of the XMP packet among the text chunks of PNG (XMP specification, part 3).
PNG_PACKET = "XML:com.adobe.xmp"
# mm: reference of focal lengths equivalent to 35 mm film.
FILM_DIAGONAL = math.hypot(36, 24)
# mm by the code of the unit of the resolution in the focal plane: inch, centimetre (Exif 2.32),
# millimetre (of some makers).
RESOLUTION_UNIT = {2: 25.4, 3: 10.0, 4: 1.0}
# Orientation of a photograph stored as on the sensor (Exif 2.32, tag 0x0112).
UPRIGHT = 1
# Relative σ of a principal distance from a stated focal length: focal lengths are rounded, the
# sensor is a few per cent wider than the photograph, and focused at 20 focal lengths the principal
# distance is 5 % longer.
NOMINAL_SIGMA = 0.05


class StatedDistance(NamedTuple):
    """A principal distance stated by a file, and its σ, pixels; its source in words."""

    value: float
    sigma: float
    source: str


@dataclasses.dataclass(frozen=True)
class GeographicPosition:
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
    the photograph was `cropped` to another shape; `serial` number of the camera."""

    size: tuple[int, int]
    make: str = ""
    model: str = ""
    focal_length: float | None = None
    focal_length_35: float | None = None
    resolution: float | None = None
    orientation: int = UPRIGHT
    time: datetime.datetime | None = None
    place: GeographicPosition | None = None
    attitude: CameraAttitude | None = None
    cropped: bool = False
    serial: str = ""

    @property
    def camera(self) -> str:
        """Make and model without repetition."""
        first_word = self.make.split()[:1]
        repeated = first_word and self.model.lower().startswith(first_word[0].lower())
        return (self.model if repeated else f"{self.make} {self.model}").strip()

    def principal_distance(self) -> StatedDistance | None:
        """The principal distance in pixels of this file, whatever the size of the photograph as it
        was taken; None if unknown."""
        # Without knowing which part of the sensor is left.
        if self.cropped:
            return None
        longer_side = max(self.size)
        width = sensor_width(self.make, self.model)
        if self.focal_length and width:
            value, relative = self.focal_length / width * longer_side, NOMINAL_SIGMA
            source = "focal length and sensor"
        elif self.focal_length_35:
            value = self.focal_length_35 / FILM_DIAGONAL * math.hypot(*self.size)
            # A whole number of mm, whose rounding has σ = 1/√12.
            relative = math.hypot(NOMINAL_SIGMA, 1 / math.sqrt(12) / self.focal_length_35)
            source = "focal length equivalent to 35 mm film"
        elif self.focal_length and self.resolution:
            value, relative = self.focal_length * self.resolution, NOMINAL_SIGMA
            source = "focal length and resolution"
        else:
            return None
        return StatedDistance(value, relative * value, source)


def read_exif(path: str | Path) -> Exif:
    """The metadata in the header of a file.

    **Raises:** `InputError` if it is not an image.
    """
    with open_image(path) as image, warnings.catch_warnings():
        from PIL.ExifTags import IFD
        from PIL.ExifTags import Base as Tag

        warnings.simplefilter("ignore")  # about damaged headers
        size, info = image.size, image.info
        try:
            head = image.getexif()
            details, gps = head.get_ifd(IFD.Exif), head.get_ifd(IFD.GPSInfo)
            packet = info.get("xmp") or info.get(PNG_PACKET) or head.get(Tag.XMLPacket) or b""
        except Exception:  # any error of the reader on a damaged header
            return Exif(size)
    resolution = _positive(details.get(Tag.FocalPlaneXResolution))
    unit = RESOLUTION_UNIT.get(details.get(Tag.FocalPlaneResolutionUnit, 2))
    sides = (Tag.ExifImageWidth, Tag.ExifImageHeight)
    original_sides = sorted(_positive(details.get(side)) or 0 for side in sides)
    if resolution and original_sides[1]:
        # Of the original photograph: programs that reduce it usually keep this.
        resolution *= max(size) / original_sides[1]
    # The ratio of the sides differs by up to 2 % without a crop, from rounding and borders.
    cropped = (
        original_sides[0] > 0
        and abs(math.log(original_sides[1] / original_sides[0] * min(size) / max(size))) > 0.02
    )
    xmp = parse_xmp(packet) if isinstance(packet, bytes | str) else Xmp()
    date = details.get(Tag.DateTimeOriginal) or head.get(Tag.DateTime)
    return Exif(
        size=size,
        make=_text(head.get(Tag.Make)),
        model=_text(head.get(Tag.Model)) or _text(head.get(Tag.UniqueCameraModel)),
        serial=_text(details.get(Tag.BodySerialNumber)) or _text(head.get(Tag.CameraSerialNumber)),
        focal_length=_positive(details.get(Tag.FocalLength)),
        focal_length_35=_positive(details.get(Tag.FocalLengthIn35mmFilm)),
        resolution=resolution / unit if resolution and unit else None,
        orientation=_orientation(head.get(Tag.Orientation)),
        time=_time(date, details.get(Tag.SubsecTimeOriginal)),
        place=_geographic_position(gps, xmp),
        attitude=xmp.attitude,
        cropped=cropped,
    )


def _text(value: Any) -> str:
    return value.replace("\0", " ").strip() if isinstance(value, str) else ""


def _number(value: Any) -> float | None:
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) else None


def _positive(value: Any) -> float | None:
    number = _number(value)
    return number if number and number > 0 else None


def _orientation(value: Any) -> int:
    number = _number(value)
    return UPRIGHT if number is None or not 1 <= number <= 8 else int(number)


def _time(value: Any, fraction: Any) -> datetime.datetime | None:
    try:
        time = datetime.datetime.strptime(_text(value)[:19], "%Y:%m:%d %H:%M:%S")
        part = _text(fraction)
        return time.replace(microsecond=int(float(f"0.{part}") * 1e6)) if part else time
    except ValueError:
        return None


def _geographic_position(gps: Mapping[int, Any], xmp: Xmp) -> GeographicPosition | None:
    from PIL.ExifTags import GPS

    latitude = _angle(gps.get(GPS.GPSLatitude), gps.get(GPS.GPSLatitudeRef), 90)
    longitude = _angle(gps.get(GPS.GPSLongitude), gps.get(GPS.GPSLongitudeRef), 180)
    # 0° N 0° E is what receivers write before their first position
    if latitude is None or longitude is None or (latitude == 0 and longitude == 0):
        return None
    height = _number(gps.get(GPS.GPSAltitude))
    is_below_sea = gps.get(GPS.GPSAltitudeRef) in (1, b"\x01")
    return GeographicPosition(
        latitude,
        longitude,
        None if height is None else -height if is_below_sea else height,
        xmp.sigma or _positive(gps.get(GPS.GPSHPositioningError)),
        xmp.sigma_height,
    )


def _angle(parts: Any, reference: Any, largest: float) -> float | None:
    """Degrees, minutes, seconds as degrees; negative to the south and west; None if unreadable or
    larger than a latitude or longitude can be."""
    try:
        degrees, minutes, seconds = (float(part) for part in parts)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    angle = degrees + minutes / 60 + seconds / 3600
    if not math.isfinite(angle) or abs(angle) > largest:
        return None
    return -angle if _text(reference)[:1].upper() in ("S", "W") else angle
