"""The XMP packet of a drone photograph: attitude, and accuracy of the position.

    DJI (drone-dji:)            GimbalYawDegree, GimbalPitchDegree, GimbalRollDegree,
                                RtkStdLon, RtkStdLat, RtkStdHgt
    senseFly, Parrot, others    Yaw, Pitch, Roll, GPSXYAccuracy, GPSZAccuracy,
    with Pix4D's (Camera:)      IMUYawAccuracy, IMUPitchAccuracy, IMURollAccuracy

All angles are degrees; yaw is the azimuth of the top of the picture, clockwise from true north. A
camera that looks straight down has DJI's pitch −90 and pitch 0 in the tags of Pix4D; one that
looks at the horizon 0 and 90. Roll lowers the right side of the picture.
"""

import dataclasses
import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from jaxtyping import Float

# Default σ, degrees: a gimbal is better about the horizontal axes, a compass worse.
SIGMA_ATTITUDE = 5.0
DJI = ("GimbalYawDegree", "GimbalPitchDegree", "GimbalRollDegree")
PIX4D = ("Yaw", "Pitch", "Roll")


@dataclasses.dataclass(frozen=True)
class CameraAttitude:
    """Yaw, pitch (−90: straight down, 0: at the horizon), roll and their largest σ, degrees."""

    yaw: float
    pitch: float
    roll: float
    sigma: float = SIGMA_ATTITUDE


@dataclasses.dataclass(frozen=True)
class Xmp:
    """The content of a packet: attitude; σ of the position east and north, and of its height,
    metres."""

    attitude: CameraAttitude | None = None
    sigma: float | None = None
    sigma_height: float | None = None


def parse_xmp(packet: bytes | str) -> Xmp:
    """The content of a packet; empty if it is damaged or unknown."""
    fields = _fields(packet)
    number = lambda name: _number(fields.get(name))
    attitude = _attitude(number)
    plane = _largest_known([number(n) for n in ("RtkStdLon", "RtkStdLat", "GPSXYAccuracy")])
    height = _largest_known([number(n) for n in ("RtkStdHgt", "GPSZAccuracy")])
    positive = lambda x: x if x and x > 0 else None
    return Xmp(attitude, positive(plane), positive(height))


def rotation_of(attitude: CameraAttitude, convergence: float = 0.0) -> Float[np.ndarray, "3 3"]:
    """M of an attitude, from east, north, up of a map to the camera: x to the right of the picture,
    y to its top, looking along −z; `convergence`: of the meridian, degrees, grid north less it."""
    yaw, pitch, roll = np.radians([attitude.yaw - convergence, attitude.pitch, attitude.roll])
    # The axes of the picture in east, north, up: yaw about the vertical, then pitch about the right
    # axis, then roll about the viewing direction.
    right = np.array([math.cos(yaw), -math.sin(yaw), 0.0])
    level = np.array([math.sin(yaw), math.cos(yaw), 0.0])
    ahead = math.cos(pitch) * level + math.sin(pitch) * np.array([0.0, 0.0, 1.0])
    top = np.cross(right, ahead)
    right, top = (
        math.cos(roll) * right - math.sin(roll) * top,
        math.sin(roll) * right + math.cos(roll) * top,
    )
    return np.stack([right, top, -ahead])


def _attitude(number: Callable[[str], float | None]) -> CameraAttitude | None:
    stated_sigma = _largest_known([number(f"IMU{axis}Accuracy") for axis in PIX4D])
    sigma = stated_sigma if stated_sigma and stated_sigma > 0 else SIGMA_ATTITUDE
    # The pitch of the horizon is 0 in DJI's tags, 90 in Pix4D's.
    for names, horizon in ((DJI, 0.0), (PIX4D, 90.0)):
        angles = [angle for angle in map(number, names) if angle is not None]
        # A missing or failed gimbal gives all zeros.
        if len(angles) == 3 and any(angles):
            yaw, pitch, roll = angles
            return CameraAttitude(yaw, pitch - horizon, roll, sigma)
    return None


def _fields(packet: bytes | str) -> Mapping[str, str]:
    """Attributes and elements by their names without namespace, the first of each."""
    content = packet if isinstance(packet, bytes) else packet.encode()
    # Packets have 64 KB at most within JPEG; a megabyte is far beyond what drones write.
    rdf = re.search(rb"<(\w+:)?RDF\b.*</(\w+:)?RDF>", content[: 2**20], re.DOTALL)
    # Entities may grow without limit ("billion laughs"); no camera uses them.
    head = content[: rdf.start()] if rdf else b""
    if rdf is None or b"<!DOCTYPE" in head or b"<!ENTITY" in content:
        return {}
    # Some drones declare namespaces outside the part that is read.
    namespaces = dict(re.findall(r'xmlns:(\w+)="([^"]*)"', head.decode(errors="replace")))
    text = rdf[0].decode(errors="replace")
    root_tag = re.match(r"<[\w:]+", text)
    missing_declarations = "".join(
        f' xmlns:{s}="{u}"' for s, u in namespaces.items() if f"xmlns:{s}=" not in text
    )
    try:
        root = ET.fromstring(
            root_tag[0] + missing_declarations + text[root_tag.end() :] if root_tag else text
        )
    except ET.ParseError:
        return {}
    fields: dict[str, str] = {}
    for element in root.iter():
        for name, value in (*element.attrib.items(), (element.tag, element.text or "")):
            if value.strip():
                fields.setdefault(name.rpartition("}")[2], value.strip())
    return fields


def _number(text: str | None) -> float | None:
    try:
        top, _, bottom = (text or "").partition("/")
        number = float(top) / float(bottom or 1)
    except (ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) else None


def _largest_known(values: Sequence[float | None]) -> float | None:
    numbers = [v for v in values if v is not None]
    return max(numbers) if numbers else None
