"""Problems of "bundle adjustment in the large" (BAL), plain or compressed (.gz, .bz2).

    cameras points observations         three whole numbers
    camera point x y                    an image point, px; x right, y up, from the image centre
    …
    r1 r2 r3 t1 t2 t3 f k1 k2           nine numbers for every camera
    X Y Z                               three for every point

Cameras and points are counted from 0; these numbers become their ids. Every image has its own
camera of model `snavely`, all parameters free; residuals are formed in the image as measured, σ is
1 px, and the datum is given by inner constraints. [r] is a rotation vector and t a shift:
M = exp([r]×), X0 = −Mᵀt.

Source: Agarwal, Snavely, Seitz and Szeliski (2010), Bundle Adjustment in the Large.
"""

import bz2
import gzip
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np
from jaxtyping import Float

from jaxbundle.arguments import show
from jaxbundle.cameras import get_model
from jaxbundle.errors import InputError
from jaxbundle.geometry.pose_conventions import bundler_pose, exterior_from_bundler
from jaxbundle.io.networks.assemble import all_parameters, foreign_document
from jaxbundle.io.networks.losses import changed, describe_losses, losing, need_values
from jaxbundle.io.networks.poses import (
    angles_of,
    matrices_of,
    matrices_of_rotation_vectors,
    rotation_vectors_of,
)
from jaxbundle.io.networks.settings import apply_overrides, check_project_settings
from jaxbundle.io.text.archives import largest_unpacked_size
from jaxbundle.io.text.csv_tables import write_bytes
from jaxbundle.io.text.rows import parse_numbers
from jaxbundle.network.build import make_cameras, make_network
from jaxbundle.network.columns import Columns
from jaxbundle.network.tables import EXTERIOR, Network, Source

OPENERS = {".gz": gzip.open, ".bz2": bz2.open}
UNREADABLE = (OSError, EOFError, zlib.error)
MODEL = get_model("snavely")


def is_bal(path: Path) -> bool:
    """Whether the first line of a text file is three whole numbers."""
    if not path.is_file():
        return False
    try:
        with OPENERS.get(path.suffix.lower(), open)(path, "rb") as file:
            return _are_counts(_first_words(file))
    except UNREADABLE:
        return False


def read_bal(path: str | Path, overrides: Sequence[str] = ()) -> Network:
    """The network of a BAL problem; `overrides` as for a project file.

    **Raises:** `InputError` for missing, superfluous or invalid numbers.
    """
    path = Path(path)
    (cameras, points, rows), numbers = _numbers(path)
    observations, numbers = np.split(numbers, [4 * rows])
    poses, position = np.split(numbers, [9 * cameras])
    observations, poses = observations.reshape(-1, 4), poses.reshape(-1, 9)
    for column, count, name in ((0, cameras, "camera"), (1, points, "point")):
        index = observations[:, column]
        is_invalid = (index < 0) | (index >= count) | (index % 1 != 0)
        if is_invalid.any():
            row = int(is_invalid.argmax())
            raise InputError(
                f"{path}, line {row + 2}: {name} {index[row]:g} does not exist; the first line "
                f"announces {count}, counted from 0"
            )
    camera_entries = [
        {
            "id": str(c),
            "model": MODEL.name,
            "free": list(MODEL.parameters),
            **dict(zip(MODEL.parameters, map(float, row))),
        }
        for c, row in enumerate(poses[:, 6:])
    ]
    document = foreign_document(path.name.split(".")[0], camera_entries)
    document = apply_overrides(document, overrides)
    project = document["project"]
    check_project_settings(project, f"{path}: ")
    angle_unit = project.pop("angle_unit", "rad")
    return make_network(
        make_cameras(document["camera"], f"{path}, "),
        _table(path, "camera", _images(poses[:, :6])),
        _table(
            path,
            "point",
            {
                "id": np.arange(points),
                **dict(zip("XYZ", position.reshape(-1, 3).T)),
            },
        ),
        Columns(
            {
                "image": observations[:, 0].astype(np.int64),
                "point": observations[:, 1].astype(np.int64),
                "x": observations[:, 2],
                "y": observations[:, 3],
            },
            Source(str(path), np.arange(rows) + 2, "line"),
        ),
        **project,
    ).replace(angle_unit=angle_unit)


# What it loses; names are numbers from 0.
BAL_LOSSES = losing(
    "that images share a camera",
    "image sizes of cameras",
    "pixel sizes of cameras",
    "colours of points",
    partly={
        "names of cameras": lambda n: changed([c.id for c in n.cameras], range(len(n.cameras))),
        "names of images": lambda n: changed(n.images.id, range(len(n.images))),
        "names of points": lambda n: changed(n.points.id, range(len(n.points))),
    },
)


def write_bal(network: Network, path: str | Path) -> tuple[str, ...]:
    """Write a network as a problem, compressed if the name ends in .gz or .bz2.

    Its cameras must be of model `snavely`. Images that share a camera each get a copy of it.

    **Returns:** messages about what the format cannot hold.
    """
    path = Path(path)
    images, points, rays = network.images, network.points, network.observations
    need_values(network, "snavely", "BAL")
    R, t = bundler_pose(matrices_of(images.angles), images.position)
    interior = np.array([[*all_parameters(c).values()] for c in network.cameras])[images.camera]
    cameras = np.concatenate([rotation_vectors_of(R), t, interior], 1)
    lines = [f"{len(images)} {len(points)} {len(rays)}"]
    lines += [
        f"{image} {point} {x!r} {y!r}"
        for image, point, (x, y) in zip(rays.image.tolist(), rays.point.tolist(), rays.xy.tolist())
    ]
    lines += map(repr, [*cameras.ravel().tolist(), *points.position.ravel().tolist()])
    text = ("\n".join(lines) + "\n").encode()
    match path.suffix.lower():
        case ".gz":
            text = gzip.compress(text, mtime=0)  # the same network, the same bytes
        case ".bz2":
            text = bz2.compress(text)
    write_bytes(path, text)
    return describe_losses(network, BAL_LOSSES)


def _first_words(file: BinaryIO) -> list[bytes]:
    """The words of the first line: three counts fit in 200 characters, and a file of another kind
    without line feeds is not read whole."""
    return file.readline(200).split()


def _are_counts(words: Sequence[bytes]) -> bool:
    """Whether these are three whole numbers."""
    return len(words) == 3 and all(word.isdigit() for word in words)


def _counts(path: Path, first_words: Sequence[bytes]) -> tuple[int, ...]:
    """The numbers of cameras, points and observations in the first line."""
    if not _are_counts(first_words):
        raise InputError(
            f"{path}, line 1: expected three whole numbers: cameras, points, observations"
        )
    # The largest size of a file is 2⁶³ − 1 bytes, a number of 19 digits.
    if max(map(len, first_words)) > 18:
        raise InputError(
            f"{path}, line 1: {b' '.join(first_words)[:60].decode()}: more cameras, points, "
            "observations than a file can hold"
        )
    return tuple(map(int, first_words))


def _numbers(path: Path) -> tuple[tuple[int, ...], Float[np.ndarray, " n"]]:
    """The three counts of the first line, and all numbers after it.

    No more is read than these require, however much a compressed file unpacks to.
    """
    suffix = path.suffix.lower()
    try:
        with OPENERS.get(suffix, open)(path, "rb") as file:
            counts = _counts(path, _first_words(file))
            cameras, points, rows = counts
            expected = 4 * rows + 9 * cameras + 3 * points
            size = path.stat().st_size
            unpacked_size = largest_unpacked_size(size) if suffix in OPENERS else size
            # A number of 64 bits has 24 characters at most; 64 leave room for blanks around it.
            limit = min(64 * (expected + 1), unpacked_size)
            text = file.read(limit + 1)
    except UNREADABLE as error:
        raise InputError(f"{path}: cannot be read: {error}") from None
    # A file that goes on is read no further.
    if len(text) > limit:
        raise InputError(
            f"{path}: holds more than {limit} characters, too many for the {expected} numbers that "
            f"line 1 announces, in a file of {size} bytes"
        )
    try:
        # Without a list of words, which would take several times the memory of the numbers.
        numbers = parse_numbers(text.decode("ascii"))
    except ValueError:
        raise _number_error(path, text) from None
    if len(numbers) != expected:
        raise InputError(
            f"{path}: {len(numbers)} numbers follow the first line; expected {expected} "
            f"(4 for each of {rows} observations, 9 for each of {cameras} cameras, 3 for each of "
            f"{points} points)"
        )
    finite = np.isfinite(numbers)
    if not finite.all():
        raise _number_error(path, text)
    return counts, numbers


def _number_error(path: Path, text: bytes) -> InputError:
    for line, row in enumerate(text.splitlines(), 2):
        for word in row.split():
            # float() reads 1_0 as ten, NumPy does not
            try:
                is_valid = np.isfinite(float(word)) and b"_" not in word
            except ValueError:
                is_valid = False
            if not is_valid:
                word = word.decode(errors="replace")
                return InputError(f"{path}, line {line}: {show(word)} where a number is expected")
    return InputError(f"{path}: there is something other than numbers")


def _images(pose: Float[np.ndarray, "images 6"]) -> dict[str, np.ndarray]:
    """Exterior orientation of the images from rotation vectors and shifts."""
    M, centre = exterior_from_bundler(matrices_of_rotation_vectors(pose[:, :3]), pose[:, 3:])
    columns = np.concatenate([centre, angles_of(M)], 1).T
    ids = np.arange(len(pose))
    return {"id": ids, "camera": ids, **dict(zip(EXTERIOR, columns))}


def _table(path: Path, word: str, columns: Mapping[str, np.ndarray]) -> Columns:
    """A table with row numbers as ids, from 0."""
    first_column = next(iter(columns.values()))
    return Columns(columns, Source(str(path), np.arange(len(first_column)), word))
