"""Cameras as ROS's camera_calibration prints them, `ost.ini` or `ost.txt`.

    # oST version 5.0 parameters
    [image]
    width
    640
    height
    480
    [narrow_stereo]
    camera matrix
    fx 0 cx
    0 fy cy
    0 0 1
    distortion
    k1 k2 p1 p2 k3
    rectification
    projection

The name of a camera is that of its section. Five coefficients are of plumb_bob, eight of
rational_polynomial. Rectification and projection are of the rectified image; of two cameras they
give the mounting (`networks.stereo`).

Source: ROS, camera_calibration_parsers, parse_ini.cpp.
"""

import re
from collections.abc import Iterator
from pathlib import Path

from jaxbundle.errors import InputError
from jaxbundle.io.cameras.nearest_camera import with_messages
from jaxbundle.io.cameras.opencv_file import camera_of
from jaxbundle.io.cameras.spellings import EntriesByMeaning
from jaxbundle.io.text.known_keys import Keys, UnknownKeys
from jaxbundle.io.text.rows import TextRows
from jaxbundle.network.tables import Camera
from jaxbundle.system.file_content import beginning

SUFFIXES = (".ini", ".txt")
IMAGE = "image"
# Of a camera.
KEYS = Keys(
    ("camera matrix", "distortion"),
    dict.fromkeys(
        ("rectification", "projection"), "of the rectified image; the mounting of a pair"
    ),
)
SIZES = Keys(("width", "height"))
Section = dict[str, list[float]]


def is_ros_ini(path: Path) -> bool:
    """Whether a text has the camera of ROS."""
    head = beginning(path, 10_000) if path.suffix.lower() in SUFFIXES else b""
    return re.search(rb"(?m)^\s*camera matrix\s*$", head) is not None and b"[" in head


def is_ros_ini_pair(path: Path) -> bool:
    """Whether a text has two cameras of ROS."""
    names = re.findall(rb"(?m)^\s*\[([^\]]+)\]\s*$", beginning(path, 100_000))
    return is_ros_ini(path) and len({*names} - {IMAGE.encode()}) == 2


def read_ros_ini(path: str | Path) -> tuple[Camera, ...]:
    """The cameras of a file, two of a stereo calibration.

    **Raises:** `InputError` naming file and line.
    """
    return tuple(camera for camera, _ in read_ros_sections(Path(path)))


def read_ros_sections(path: Path) -> list[tuple[Camera, Section]]:
    """The cameras of a file, with the numbers of their sections; a camera that is printed again
    replaces the one before.

    **Raises:** `InputError` naming file and line.
    """
    unknown = UnknownKeys()
    size: EntriesByMeaning = {}
    cameras: dict[str, tuple[Camera, Section]] = {}
    for name, section in _sections(path):
        if name == IMAGE:
            unknown.check(section, SIZES, f"{path}, [{name}]")
            for key, values in section.items():
                if len(values) != 1:
                    raise InputError(
                        f"{path}, [{name}]: {key} has {len(values)} numbers; expected one"
                    )
                size[f"image_{key}"] = key, values[0]
            continue
        unknown.check(section, KEYS, f"{path}, [{name}]")
        by_meaning: EntriesByMeaning = dict(size)
        for key, kind in zip(KEYS.used, ("camera_matrix", "distortion_coefficients")):
            if key not in section:
                raise InputError(f"{path}, [{name}]: {key} is missing; expected it in a camera")
            by_meaning[kind] = key, section[key]
        cameras[name] = camera_of(f"{path}, [{name}]", by_meaning, name), section
    if not cameras:
        raise InputError(f"{path}: there is no camera in it; expected a section [NAME]")
    messages = unknown.messages()
    return [(with_messages(camera, *messages), section) for camera, section in cameras.values()]


def _sections(path: Path) -> Iterator[tuple[str, Section]]:
    """The sections in their order: for every key the numbers of the lines below it."""
    name, section, key = "", {}, ""
    for row in TextRows(path, "#"):
        text = row.text.strip()
        if text.startswith("["):
            if section:
                yield name, section
            name, section, key = text.strip("[]"), {}, ""
        elif re.match(r"[A-Za-z]", text) and not re.match(r"(nan|inf)\b", text, re.I):
            if text in section:
                raise row.error(f"{text} occurs twice in [{name}]")
            key = text
            section[key] = []
        elif not key:
            raise row.error(f"{text[:40]!r} without a key; expected width, camera matrix, …")
        else:
            section[key] += row.all_numbers("a value").tolist()
    if section:
        yield name, section
