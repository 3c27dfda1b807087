"""Rigs and frames of COLMAP 3.12 and later: which images were taken together.

    rigs.txt      RIG_ID, NUM_SENSORS, REF_SENSOR_TYPE, REF_SENSOR_ID, and for every other sensor
                  SENSOR_TYPE, SENSOR_ID, HAS_POSE, [QW, QX, QY, QZ, TX, TY, TZ]
    frames.txt    FRAME_ID, RIG_ID, QW, QX, QY, QZ, TX, TY, TZ, NUM_DATA_IDS, and for each of them
                  SENSOR_TYPE, SENSOR_ID, DATA_ID

    rigs.bin      count u64;  id u32, sensors u32, [type i32, id u32],
                  others: type i32, id u32, has pose u8, [7 f64]
    frames.bin    count u64;  id u32, rig u32, 7 f64, count u32,  type i32, sensor u32, data u64

A frame of several images is an epoch of a rig (table `rigs`): its cameras have one mounting. The
poses of images are in `images` and are those of frame and sensor together. A sensor is a camera
(CAMERA, 0), or an IMU, which has no images.

Source: COLMAP documentation, "Output Format"; src/colmap/scene/reconstruction_io_binary.cc.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from jaxbundle.errors import InputError
from jaxbundle.io.networks.colmap_binary import BinaryFile
from jaxbundle.io.text.rows import TextRow, TextRows
from jaxbundle.network.columns import Columns
from jaxbundle.network.kinds import Rigs
from jaxbundle.network.tables import Source

CAMERA_TYPES = ("CAMERA", 0)
POSE = ("QW", "QX", "QY", "QZ", "TX", "TY", "TZ")


class Frame(NamedTuple):
    """A moment of a rig, and the numbers of its images; `place` for messages."""

    id: int
    rig: int
    images: tuple[int, ...]
    place: str


def read_frames(folder: Path, suffix: str) -> list[Frame]:
    """The frames of a model.

    **Raises:** `InputError` naming file and line, or entry; for a frame of an unknown rig."""
    binary = suffix == ".bin"
    rigs = (_binary_rigs if binary else _text_rigs)(folder / f"rigs{suffix}")
    frames = (_binary_frames if binary else _text_frames)(folder / f"frames{suffix}")
    for frame in frames:
        if frame.rig not in rigs:
            raise InputError(f"{frame.place}: rig {frame.rig} is not in rigs{suffix}")
    return frames


def rigs_of_frames(
    path: Path, frames: Sequence[Frame], names: Mapping[int, str]
) -> tuple[Rigs, ...]:
    """The table of the frames with several images; nothing if no frame has several.

    **Arguments:** `names`: of the images, by number.

    **Raises:** `InputError` for an image that is not in the model, or in two frames."""
    rows: list[tuple[str, str, str]] = []
    seen: dict[int, int] = {}
    for frame in frames:
        for image in frame.images:
            if image in seen:
                raise InputError(
                    f"{frame.place}: image {image} is in frame {seen[image]} as well; expected one"
                )
            seen[image] = frame.id
        # images without a pose are in a frame, but not in the model
        images = [image for image in frame.images if image in names]
        if len(images) > 1:
            rows += [(str(frame.rig), str(frame.id), names[image]) for image in images]
    if not rows:
        return ()
    rigs, epochs, images = map(list, zip(*rows))
    columns = {"rig": rigs, "epoch": epochs, "image": images}
    return (Rigs.from_columns(Columns(columns, Source(str(path), None, "frame")), {}, 1.0),)


class _Words:
    """The words of a line in sequence."""

    def __init__(self, row: TextRow):
        self.row, self.position = row, 0

    def integer(self, what: str) -> int:
        self.position += 1
        return self.row.integer(self.position - 1, what)

    def word(self, what: str) -> str:
        if self.position >= len(self.row):
            raise self.row.error(f"the line ends; {what} is expected")
        self.position += 1
        return self.row.words[self.position - 1]

    def pose(self) -> None:
        self.row.numbers(POSE, self.position, more=True)
        self.position += len(POSE)

    def end(self) -> None:
        if self.position < len(self.row):
            raise self.row.error(f"{len(self.row) - self.position} values after the last")


def _text_rigs(path: Path) -> set[int]:
    rigs: set[int] = set()
    for row in TextRows(path, "#"):
        words = _Words(row)
        rigs.add(words.integer("RIG_ID"))
        for k in range(words.integer("NUM_SENSORS")):
            words.word("SENSOR_TYPE")
            words.integer("SENSOR_ID")
            # the first is the reference, whose pose is that of the rig
            if k and words.integer("HAS_POSE"):
                words.pose()
        words.end()
    return rigs


def _text_frames(path: Path) -> list[Frame]:
    frames = []
    for row in TextRows(path, "#"):
        words = _Words(row)
        id, rig = words.integer("FRAME_ID"), words.integer("RIG_ID")
        words.pose()
        images = []
        for _ in range(words.integer("NUM_DATA_IDS")):
            kind = words.word("SENSOR_TYPE")
            words.integer("SENSOR_ID")
            data = words.integer("DATA_ID")
            if kind in CAMERA_TYPES:
                images.append(data)
        words.end()
        frames.append(Frame(id, rig, tuple(images), f"{path}, line {row.number}"))
    return frames


def _entries(path: Path, what: str, least: int) -> Iterator[tuple[BinaryFile, int]]:
    """The file at each of its entries, of `least` bytes or more; its end is checked."""
    file = BinaryFile(path)
    for k in range(file.count(what, least)):
        file.what = f"{what.removesuffix('s')} {k + 1}"
        yield file, k
    file.end()


def _binary_rigs(path: Path) -> set[int]:
    rigs: set[int] = set()
    for file, _ in _entries(path, "rigs", 8):
        id, sensors = file.take("II")
        rigs.add(id)
        for k in range(sensors):
            file.take("iI")
            if k and file.take("B")[0]:
                file.numbers(7, "pose")
    return rigs


def _binary_frames(path: Path) -> list[Frame]:
    frames = []
    for file, k in _entries(path, "frames", 68):
        id, rig = file.take("II")
        file.numbers(7, "pose")
        (count,) = file.take("I")
        data = (file.take("iIQ") for _ in range(count))
        images = tuple(image for kind, _, image in data if kind in CAMERA_TYPES)
        frames.append(Frame(id, rig, images, f"{path}, frame {k + 1}"))
    return frames
