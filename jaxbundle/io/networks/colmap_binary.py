"""COLMAP's binary files: cameras.bin, images.bin, points3D.bin, little endian.

    cameras    count u64;  id u32, model i32, width u64, height u64, parameters f64…
    images     count u64;  id u32, quaternion 4 f64, shift 3 f64, camera u32, name to a 0 byte,
               count u64,  x f64, y f64, point u64 (2⁶⁴ − 1: none)
    points3D   count u64;  id u64, X Y Z f64, R G B u8, error f64, count u64,  image u32, index u32

Every count is compared with the remaining bytes before memory is allocated.

Source: COLMAP documentation, "Output Format", and src/colmap/scene/reconstruction_io.
"""

import struct
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Int

from jaxbundle.errors import InputError
from jaxbundle.io.networks.colmap_model import (
    NO_POINT,
    ColmapImage,
    ColmapModel,
    ColmapPoints,
    check_unique,
    tracks,
)
from jaxbundle.io.networks.colmap_models import (
    MODELS,
    NAMES,
    from_colmap,
    parameter_names,
    to_colmap,
)
from jaxbundle.io.networks.losses import size_of
from jaxbundle.network.tables import Camera, Source
from jaxbundle.system.file_content import read_content

POINT2D = np.dtype([("xy", "<f8", 2), ("point", "<u8")])
# A point without its track.
POINT = np.dtype(
    [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("rays", "<u8")]
)
TRACK = np.dtype([("image", "<u4"), ("index", "<u4")])
NO_POINT_ID = np.uint64(2**64 - 1)


class BinaryFile:
    """The bytes of a file in sequence; errors name the file and the record being read."""

    def __init__(self, path: Path):
        self.path = path
        self.data = read_content(path, text=False)
        self.position = 0
        self.record = "the head"

    def error(self, message: str) -> InputError:
        return InputError(f"{self.path}, {self.record}: {message}")

    def take(self, format: str) -> tuple:
        return struct.unpack("<" + format, self.raw(struct.calcsize("<" + format)))

    def raw(self, size: int) -> bytes:
        part = self.data[self.position : self.position + size]
        if len(part) < size:
            raise self.error(f"the file ends here, after {len(self.data)} bytes; it is truncated")
        self.position += size
        return part

    def count(self, name: str, least_size: int) -> int:
        """A number of items with at least the given bytes each."""
        (count,) = self.take("Q")
        remaining_bytes = len(self.data) - self.position
        if count * least_size > remaining_bytes:
            raise self.error(
                f"{count} {name} are announced, but only {remaining_bytes} bytes follow"
            )
        return count

    def numbers(self, n: int, name: str) -> np.ndarray:
        values = np.frombuffer(self.raw(8 * n), "<f8")
        if not np.isfinite(values).all():
            raise self.error(f"{name}: {values[~np.isfinite(values)][0]} is not a finite number")
        return values

    def name(self) -> str:
        end = self.data.find(b"\0", self.position)
        if end < 0:
            raise self.error("the name is not terminated; the file is truncated")
        text = self.raw(end - self.position)
        self.position += 1
        try:
            return text.decode()
        except UnicodeDecodeError:
            raise self.error(f"the name {text[:40]!r} is not UTF-8 text") from None

    def end(self) -> None:
        remaining_bytes = len(self.data) - self.position
        if remaining_bytes:
            raise self.error(
                f"{remaining_bytes} bytes follow the last entry; the counts do not fit the file"
            )


def read_binary_model(folder: Path) -> ColmapModel:
    """The contents of the three binary files of a folder."""
    cameras = read_binary_cameras(folder / "cameras.bin")
    images = _images(folder / "images.bin")
    points = _points(folder / "points3D.bin", images)
    return ColmapModel(cameras, images, points)


def read_binary_cameras(path: Path) -> dict[int, Camera]:
    """The cameras of a cameras.bin by number."""
    file, cameras = BinaryFile(path), {}
    for k in range(file.count("cameras", 24)):  # bytes of a camera without parameters
        file.record = f"camera {k + 1}"
        id, model, width, height = file.take("IiQQ")
        if id in cameras:
            raise file.error(f"camera {id} occurs twice")
        name = NAMES.get(model, f"number {model}")
        values = file.numbers(len(parameter_names(name, file.error)), "parameters")
        # 64 bits of a damaged file may be any size
        if not (0 < width < 10**9 and 0 < height < 10**9):
            raise file.error(f"the image size {width} × {height} is impossible")
        cameras[id] = from_colmap(str(id), name, (width, height), values)
    file.end()
    return cameras


def _images(path: Path) -> list[ColmapImage]:
    file, images = BinaryFile(path), []
    for k in range(file.count("images", 73)):  # without a name and image points
        file.record = f"image {k + 1}"
        (id,) = file.take("I")
        pose = file.numbers(7, "pose")
        (camera,) = file.take("I")
        name = file.name()
        points = np.frombuffer(file.raw(24 * file.count("image points", 24)), POINT2D)
        if not np.isfinite(points["xy"]).all():
            raise file.error("an image point is not a finite number")
        has_no_point = points["point"] == NO_POINT_ID
        if (points["point"][~has_no_point] >= 2**63).any():
            raise file.error("an image point has an impossible object point")
        # NO_POINT is −1.
        point = np.where(has_no_point, 0, points["point"]).astype(np.int64) - has_no_point
        images.append(
            ColmapImage(
                id,
                camera,
                name,
                pose[:4],
                pose[4:],
                points["xy"].reshape(-1, 2),
                point,
                f"{path}, image {k + 1}",
            )
        )
    file.end()
    check_unique([image.id for image in images], lambda k: images[k].location, "image")
    return images


def _points(path: Path, images: Sequence[ColmapImage]) -> ColmapPoints:
    """The points; of their tracks the images are checked, since the image points name their object
    points."""
    file = BinaryFile(path)
    rays = _track_lengths(file, file.count("points", POINT.itemsize), images)
    # Points and tracks alternate.
    lengths = np.stack([np.full(len(rays), POINT.itemsize), 8 * rays], 1).ravel()
    is_point = np.repeat(np.arange(len(lengths)) % 2 == 0, lengths)
    data = np.frombuffer(file.data, np.uint8)[8:]
    points, track = data[is_point].view(POINT), data[~is_point].view(TRACK)["image"]
    position = points["xyz"].astype(float)

    if (impossible := points["id"] >= 2**63).any():
        file.record = f"point {impossible.argmax() + 1}"
        raise file.error(f"its number {points['id'][impossible][0]} is impossible")
    if (infinite := ~np.isfinite(position)).any():
        file.record = f"point {infinite.any(1).argmax() + 1}"
        raise file.error(f"coordinates: {position[infinite][0]} is not a finite number")
    unknown = ~np.isin(track, np.array(sorted(image.id for image in images), "<u4"))
    if unknown.any():
        ray = int(unknown.argmax())
        file.record = f"point {np.searchsorted(np.cumsum(rays), ray, 'right') + 1}"
        raise file.error(f"the image {track[ray]} of the track is not in images")
    source, ids = Source(str(path), None, "point"), points["id"].astype(np.int64)
    check_unique(ids, source, "point")
    return ColmapPoints(ids, position, points["rgb"], source)


def _track_lengths(
    file: BinaryFile, number: int, images: Sequence[ColmapImage]
) -> Int[np.ndarray, " points"]:
    """The numbers of rays of all points, which tell where the next point is.

    COLMAP writes points by their numbers, and each with its image points: the lengths that follow
    from the images are those of the file if every point has the length expected there.
    """
    points_begin, size, length = file.position, POINT.itemsize, len(file.data)
    for expected in _expected_lengths(number, images):
        point_ends = points_begin + np.cumsum(size + 8 * expected)
        if len(expected) == number and point_ends[-1] == length:
            count_offsets = point_ends - 8 * expected - 8
            data = np.frombuffer(file.data, np.uint8)
            if (data[count_offsets[:, None] + np.arange(8)].view("<u8").ravel() == expected).all():
                return expected
    rays_of, lengths, begin = struct.Struct("<Q").unpack_from, [], points_begin
    for k in range(number):
        end = begin + size
        if end > length or (next := end + 8 * rays_of(file.data, end - 8)[0]) > length:
            file.record, file.position = f"point {k + 1}", begin
            file.raw(size - 8)
            file.count("rays", 8)
            raise file.error("the file ends here; it is truncated")
        lengths.append((next - end) // 8)
        begin = next
    file.position = begin
    file.end()
    return np.array(lengths, np.int64)


def _expected_lengths(
    number: int, images: Sequence[ColmapImage]
) -> Iterator[Int[np.ndarray, " points"]]:
    """The numbers of image points of every object point: of those that have any, and of all, if
    they are numbered from 1."""
    if not number or not images:
        return
    point_ids = np.concatenate([image.point for image in images])
    point_ids = point_ids[point_ids != NO_POINT]
    # Numbers with few gaps, as usual, are counted in a table.
    if len(point_ids) and point_ids.max() < 8 * (len(point_ids) + number):
        counts = np.bincount(point_ids)
        yield counts[counts > 0]
        if not counts[0] and len(counts) <= number + 1:
            yield np.concatenate([counts[1:], np.zeros(number + 1 - len(counts), counts.dtype)])
    else:
        yield np.unique(point_ids, return_counts=True)[1]


def binary_files(model: ColmapModel) -> dict[str, bytes]:
    """The three binary files by name."""
    cameras = [struct.pack("<Q", len(model.cameras))]
    for number, camera in model.cameras.items():
        (name, values), (width, height) = to_colmap(camera), size_of(camera, "COLMAP")
        head = struct.pack("<IiQQ", number, MODELS[name][0], width, height)
        cameras.append(head + np.array(values, "<f8").tobytes())
    images = [struct.pack("<Q", len(model.images))]
    for image in model.images:
        points = np.zeros(len(image.xy), POINT2D)
        points["xy"], points["point"] = image.xy, image.point
        images += [
            struct.pack("<I7dI", image.id, *image.q, *image.t, image.camera),
            image.name.encode() + b"\0",
            struct.pack("<Q", len(points)),
            points.tobytes(),
        ]
    points = [struct.pack("<Q", len(model.points.ids))]
    of_point = tracks(model)
    for id, position, colour, error in model.points.rows():
        track = np.array(of_point[id], "<u4")
        head = struct.pack("<Q3d3BdQ", id, *position, *colour, error, len(track))
        points += [head, track.tobytes()]
    parts = {"cameras.bin": cameras, "images.bin": images, "points3D.bin": points}
    return {name: b"".join(part) for name, part in parts.items()}
