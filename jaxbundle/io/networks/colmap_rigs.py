"""Rigs and frames of COLMAP 3.12 and later: which images were taken together.

    rigs.txt      RIG_ID, NUM_SENSORS, REF_SENSOR_TYPE, REF_SENSOR_ID, and for every other sensor
                  SENSOR_TYPE, SENSOR_ID, HAS_POSE, [QW, QX, QY, QZ, TX, TY, TZ]
    frames.txt    FRAME_ID, RIG_ID, QW, QX, QY, QZ, TX, TY, TZ, NUM_DATA_IDS, and for each of them
                  SENSOR_TYPE, SENSOR_ID, DATA_ID

    rigs.bin      count u64;  id u32, sensors u32, [type i32, id u32],
                  others: type i32, id u32, has pose u8, [7 f64]
    frames.bin    count u64;  id u32, rig u32, 7 f64, count u32,  type i32, sensor u32, data u64

A frame of several images is an epoch of a rig (table `rigs`): its cameras have one mounting. The
poses of images are in `images` and are those of frame and sensor together; COLMAP itself takes the
latter. A sensor is a camera (CAMERA, 0), or an IMU, which has no images. For COLMAP every camera is
in one rig and every image in one frame; they are written if the network has rigs, because without
the files COLMAP makes a rig of every camera and a frame of every image.

    x_sensor = R·x_rig + t        x_rig = R·X + t        x_rig: the frame of the reference sensor

Source: COLMAP documentation, "Output Format"; src/colmap/scene/reconstruction_io_binary.cc.
"""

import struct
from collections.abc import Container, Iterator, Mapping, Sequence
from itertools import count as count_from
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbundle.errors import InputError
from jaxbundle.geometry.pose_conventions import cv_pose
from jaxbundle.io.networks.colmap_binary import BinaryFile
from jaxbundle.io.networks.colmap_model import numbers_of
from jaxbundle.io.networks.poses import matrices_of, quaternions_of
from jaxbundle.io.text.rows import TextRow, TextRows, join_numbers
from jaxbundle.network.columns import Columns, count
from jaxbundle.network.kinds import Rigs
from jaxbundle.network.kinds.rigs import MountedCameras
from jaxbundle.network.tables import Network, Source

CAMERA, CAMERA_NUMBER = CAMERA_TYPES = ("CAMERA", 0)
Pose = tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]
"""R and t."""
POSE = ("QW", "QX", "QY", "QZ", "TX", "TY", "TZ")


class ColmapFrame(NamedTuple):
    """A moment of a rig, and the numbers of its images; `location` for messages."""

    id: int
    rig: int
    images: tuple[int, ...]
    location: str


def read_frames(folder: Path, suffix: str) -> list[ColmapFrame]:
    """The frames of a model.

    **Raises:** `InputError` naming file and line, or entry; for a frame of an unknown rig."""
    binary = suffix == ".bin"
    rigs = (_binary_rigs if binary else _text_rigs)(folder / f"rigs{suffix}")
    frames = (_binary_frames if binary else _text_frames)(folder / f"frames{suffix}")
    for frame in frames:
        if frame.rig not in rigs:
            raise InputError(f"{frame.location}: rig {frame.rig} is not in rigs{suffix}")
    return frames


def rigs_of_frames(
    path: Path, frames: Sequence[ColmapFrame], names: Mapping[int, str]
) -> tuple[Rigs, ...]:
    """The table of the frames with several images; nothing if no frame has several.

    **Arguments:** `names`: of the images, by number.

    **Raises:** `InputError` for an image that is not in the model, or in two frames."""
    rows: list[tuple[str, str, str]] = []
    frame_of_image: dict[int, int] = {}
    for frame in frames:
        for image in frame.images:
            if image in frame_of_image:
                raise InputError(
                    f"{frame.location}: image {image} is in frame {frame_of_image[image]} as well; "
                    "expected one"
                )
            frame_of_image[image] = frame.id
        # Images without a pose are in a frame, but not in the model.
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

    def integer(self, expected: str) -> int:
        self.position += 1
        return self.row.integer(self.position - 1, expected)

    def word(self, expected: str) -> str:
        if self.position >= len(self.row):
            raise self.row.error(f"the line ends; expected {expected}")
        self.position += 1
        return self.row.words[self.position - 1]

    def pose(self) -> None:
        self.row.numbers(POSE, self.position, allow_more=True)
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
            # The first is the reference, whose pose is that of the rig.
            if k and words.integer("HAS_POSE"):
                words.pose()
        words.end()
    return rigs


def _text_frames(path: Path) -> list[ColmapFrame]:
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
        frames.append(ColmapFrame(id, rig, tuple(images), f"{path}, line {row.number}"))
    return frames


def _entries(path: Path, name: str, min_bytes: int) -> Iterator[tuple[BinaryFile, int]]:
    """The file at each of its entries, of `min_bytes` or more; its end is checked."""
    file = BinaryFile(path)
    for k in range(file.count(name, min_bytes)):
        file.record = f"{name.removesuffix('s')} {k + 1}"
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


def _binary_frames(path: Path) -> list[ColmapFrame]:
    frames = []
    for file, k in _entries(path, "frames", 68):
        id, rig = file.take("II")
        file.numbers(7, "pose")
        (count,) = file.take("I")
        data = (file.take("iIQ") for _ in range(count))
        images = tuple(image for kind, _, image in data if kind in CAMERA_TYPES)
        frames.append(ColmapFrame(id, rig, images, f"{path}, frame {k + 1}"))
    return frames


class SensorPose(NamedTuple):
    """A pose as COLMAP has it: quaternion (w, x, y, z) and shift."""

    q: Float[np.ndarray, "4"]
    t: Float[np.ndarray, "3"]


class WrittenRig(NamedTuple):
    """A rig of a file: the numbers of its reference camera and of the others, with their poses."""

    id: int
    reference: int
    other_sensors: dict[int, SensorPose]


class WrittenFrame(NamedTuple):
    """A frame of a file: its pose, and the number of the image of each camera."""

    id: int
    rig: int
    pose: SensorPose
    images: dict[int, int]


def rigs_and_frames(
    network: Network, cameras: Sequence[int], images: Sequence[int]
) -> tuple[list[WrittenRig], list[WrittenFrame], list[str]]:
    """The rigs and frames of a network with images mounted together, and what they do not keep.

    **Arguments:** `cameras`, `images`: the numbers that the rows of the tables have in the files.

    A camera stays in the first of its rigs. Where the orientations of images contradict the
    mounting of their camera (before an adjustment, or with a σ of the mounting), COLMAP has those
    of one epoch.
    """
    R, t = cv_pose(matrices_of(network.images.angles), network.images.position)
    # Names are kept if they are numbers.
    mounted_rigs = {
        name: rig
        for kind in network.further
        if isinstance(kind, Rigs)
        for name, rig in kind.mounted(network).items()
    }
    names = [(name, epoch) for name, rig in mounted_rigs.items() for epoch in rig.epochs]
    rig_ids = dict(zip(mounted_rigs, numbers_of([*mounted_rigs])))
    epochs = [epoch for _, epoch in names]
    are_unique = len({*epochs}) == len(epochs)
    frame_ids = dict(zip(names, numbers_of(epochs) if are_unique else range(1, len(names) + 1)))
    new_rig = count_from(1 + max(rig_ids.values(), default=0))
    new_frame = count_from(1 + max(frame_ids.values(), default=0))

    rigs: list[WrittenRig] = []
    frames: list[WrittenFrame] = []
    written_R, written_t = R.copy(), t.copy()
    unrigged_cameras = {*range(len(network.cameras))}  # cameras, images without a rig, a frame
    unframed_images = {*range(len(network.images))}

    def add_frame(id: int, rig: int, sensors: Mapping[int, Pose], epoch: Mapping[int, int]) -> None:
        camera, image = next(((c, i) for c, i in epoch.items() if c == next(iter(sensors))),
                             next(iter(epoch.items())))  # fmt: skip
        Rs, ts = sensors[camera]
        R_frame, t_frame = Rs.T @ R[image], Rs.T @ (t[image] - ts)
        for c, i in epoch.items():
            written_R[i], written_t[i] = (
                sensors[c][0] @ R_frame,
                sensors[c][0] @ t_frame + sensors[c][1],
            )
        unframed_images.difference_update(epoch.values())
        numbers = {cameras[c]: images[i] for c, i in epoch.items()}
        frames.append(WrittenFrame(id, rig, _sensor_pose(R_frame, t_frame), numbers))

    separated_count = 0
    for name, rig in mounted_rigs.items():
        sensors = _sensor_poses(rig, unrigged_cameras)
        if len(sensors) < 2:
            separated_count += sum(map(len, rig.epochs.values()))
            continue
        unrigged_cameras -= sensors.keys()
        _, *other_cameras = sensors
        rigs.append(
            WrittenRig(
                rig_ids[name],
                cameras[rig.reference],
                {cameras[c]: _sensor_pose(*sensors[c]) for c in other_cameras},
            )
        )
        for epoch, epoch_images in rig.epochs.items():
            rig_images = {c: i for c, i in epoch_images.items() if c in sensors}
            separated_count += len(epoch_images) - len(rig_images)
            if rig_images:
                add_frame(frame_ids[name, epoch], rig_ids[name], sensors, rig_images)
        for i in sorted(unframed_images):
            if (c := int(network.images.camera[i])) in sensors:
                add_frame(next(new_frame), rig_ids[name], sensors, {c: i})
    for c in sorted(unrigged_cameras):
        rigs.append(WrittenRig(next(new_rig), cameras[c], {}))
        single_sensor = {c: (np.eye(3), np.zeros(3))}
        for i in np.flatnonzero(network.images.camera == c).tolist():
            if i in unframed_images:
                add_frame(next(new_frame), rigs[-1].id, single_sensor, {c: i})
    losses = [f"the rig of {count(separated_count, 'image')}"] if separated_count else []
    if [*map(str, rig_ids.values())] != [*mounted_rigs] or [
        *map(str, frame_ids.values())
    ] != epochs:
        losses.append("names of rigs and epochs, which are numbered")
    return rigs, frames, losses + _describe_changes(R, t, written_R, written_t)


def _sensor_poses(rig: MountedCameras, unrigged_cameras: Container[int]) -> dict[int, Pose]:
    """The poses of cameras that are in no other rig, in COLMAP's frames, the reference first; none
    without it."""
    if rig.reference not in unrigged_cameras:
        return {}
    flip = np.diag([1.0, -1.0, -1.0])  # from our camera frame to that of COLMAP
    return {
        c: (flip @ mounting.rotation @ flip, -flip @ mounting.rotation @ mounting.position)
        for c, mounting in rig.mountings.items()
        if mounting is not None and c in unrigged_cameras
    }


def _sensor_pose(R: np.ndarray, t: np.ndarray) -> SensorPose:
    return SensorPose(quaternions_of(R[None])[0], t)


def _describe_changes(
    R: np.ndarray, t: np.ndarray, written_R: np.ndarray, written_t: np.ndarray
) -> list[str]:
    """The largest change of orientations, if it is more than rounding."""
    D = R @ written_R.transpose(0, 2, 1)
    axis = np.stack([D[:, 1, 2] - D[:, 2, 1], D[:, 2, 0] - D[:, 0, 2], D[:, 0, 1] - D[:, 1, 0]])
    rotation_angle = np.arctan2(
        np.linalg.norm(axis, axis=0), np.trace(D, axis1=1, axis2=2) - 1
    ).max()
    translation_change = np.linalg.norm(written_t - t, axis=1).max()
    # Products of three matrices in double precision, and coordinates of 1e6.
    if rotation_angle <= 1e-9 and translation_change <= 1e-9 * max(abs(t).max(), 1.0):
        return []
    return [
        "orientations that contradict the mountings of their rig, one a camera: up to "
        f"{translation_change:.3g} and {np.degrees(rotation_angle):.3g}°"
    ]


def rig_files(
    rigs: Sequence[WrittenRig], frames: Sequence[WrittenFrame], text: bool
) -> dict[str, bytes]:
    """The files of rigs and frames by name; none without rigs."""
    if not rigs:
        return {}
    return (_text_files if text else _binary_files)(rigs, frames)


def _text_files(rigs: Sequence[WrittenRig], frames: Sequence[WrittenFrame]) -> dict[str, bytes]:
    rig_lines = [
        "# RIG_ID, NUM_SENSORS, REF_SENSOR_TYPE, REF_SENSOR_ID, SENSORS[] as (SENSOR_TYPE, "
        "SENSOR_ID, HAS_POSE, [QW, QX, QY, QZ, TX, TY, TZ])"
    ]
    for rig in rigs:
        other_sensors = (
            f" {CAMERA} {c} 1 {join_numbers((*q, *t))}" for c, (q, t) in rig.other_sensors.items()
        )
        head = f"{rig.id} {1 + len(rig.other_sensors)} {CAMERA} {rig.reference}"
        rig_lines.append(head + "".join(other_sensors))
    frame_lines = [
        "# FRAME_ID, RIG_ID, QW, QX, QY, QZ, TX, TY, TZ, NUM_DATA_IDS, DATA_IDS[] as "
        "(SENSOR_TYPE, SENSOR_ID, DATA_ID)"
    ]
    for frame in frames:
        data = " ".join(f"{CAMERA} {camera} {image}" for camera, image in frame.images.items())
        pose = join_numbers((*frame.pose.q, *frame.pose.t))
        frame_lines.append(f"{frame.id} {frame.rig} {pose} {len(frame.images)} {data}")
    lines = {"rigs.txt": rig_lines, "frames.txt": frame_lines}
    return {name: ("\n".join(file_lines) + "\n").encode() for name, file_lines in lines.items()}


def _binary_files(rigs: Sequence[WrittenRig], frames: Sequence[WrittenFrame]) -> dict[str, bytes]:
    of_rigs = [struct.pack("<Q", len(rigs))]
    for rig in rigs:
        head = (rig.id, 1 + len(rig.other_sensors), CAMERA_NUMBER, rig.reference)
        of_rigs.append(struct.pack("<IIiI", *head))
        of_rigs += [
            struct.pack("<iIB7d", CAMERA_NUMBER, camera, 1, *q, *t)
            for camera, (q, t) in rig.other_sensors.items()
        ]
    of_frames = [struct.pack("<Q", len(frames))]
    for frame in frames:
        numbers = (*frame.pose.q, *frame.pose.t, len(frame.images))
        of_frames.append(struct.pack("<II7dI", frame.id, frame.rig, *numbers))
        of_frames += [
            struct.pack("<iIQ", CAMERA_NUMBER, camera, image)
            for camera, image in frame.images.items()
        ]
    return {"rigs.bin": b"".join(of_rigs), "frames.bin": b"".join(of_frames)}
