"""COLMAP's text files: cameras.txt, images.txt, points3D.txt.

    CAMERA_ID MODEL WIDTH HEIGHT PARAMS…
    IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME
    X Y POINT3D_ID  X Y POINT3D_ID  …                 the second line of an image; may be empty
    POINT3D_ID X Y Z R G B ERROR  IMAGE_ID POINT2D_IDX  …

Source: COLMAP documentation, "Output Format".
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from jaxbundle.errors import InputError
from jaxbundle.io.networks.colmap_model import (
    ColmapImage,
    ColmapModel,
    ColmapPoints,
    check_unique,
    tracks,
)
from jaxbundle.io.networks.colmap_models import (
    from_colmap,
    parameter_names,
    to_colmap,
)
from jaxbundle.io.networks.losses import size_of
from jaxbundle.io.text.rows import (
    END_OF_LINE,
    TextRow,
    TextRows,
    join_numbers,
    parse_lines,
    parse_numbers,
)
from jaxbundle.network.tables import Camera, Source

QT = ("QW", "QX", "QY", "QZ", "TX", "TY", "TZ")


def read_text_model(folder: Path) -> ColmapModel:
    """The contents of the three text files of a folder."""
    cameras = read_text_cameras(folder / "cameras.txt")
    images = _images(folder / "images.txt")
    points = _points(folder / "points3D.txt", {image.id for image in images})
    return ColmapModel(cameras, images, points)


def read_text_cameras(path: Path) -> dict[int, Camera]:
    """The cameras of a cameras.txt by number."""
    cameras: dict[int, Camera] = {}
    for row in TextRows(path, "#"):
        number = row.integer(0, "CAMERA_ID")
        if number in cameras:
            raise row.error(f"camera {number} occurs twice")
        model = row.words[1] if len(row) > 1 else ""
        names = parameter_names(model, row.error)
        size = [row.integer(k, name, 1) for k, name in ((2, "WIDTH"), (3, "HEIGHT"))]
        values = row.numbers(names, 4)
        cameras[number] = from_colmap(str(number), model, size, values)
    return cameras


def _images(path: Path) -> list[ColmapImage]:
    # Comments are skipped only before heads: the line of image points may be empty.
    rows = TextRows(path, "#", blank=True)
    heads, points = [], []
    while rows.has_more():
        head = rows.take("an image")
        if not head.words:
            continue
        if len(head) < 10:
            raise head.error(
                f"{len(head)} values where an image is expected: IMAGE_ID, "
                f"{', '.join(QT)}, CAMERA_ID, NAME"
            )
        heads.append((head, head.numbers(QT, 1, allow_more=True)))
        points.append(
            rows.take("the image points of an image") if rows.has_more() else TextRow(path, 0, "")
        )
    # All lines at once; one by one if there is a fault in any.
    parsed = parse_lines(row.text for row in points)
    images = []
    for k, ((head, pose), row) in enumerate(zip(heads, points)):
        numbers = row.all_numbers("an image point") if parsed is None else parsed[k]
        if len(numbers) % 3:
            raise row.error(
                f"{len(numbers)} numbers; expected X, Y, POINT3D_ID for each image point"
            )
        numbers = numbers.reshape(-1, 3)
        # Beyond 2⁵² floats are all whole: a number there has lost digits.
        if (numbers[:, 2] != np.floor(numbers[:, 2])).any() or (abs(numbers) > 2**52).any():
            raise row.error("a POINT3D_ID is not a whole number")
        images.append(
            ColmapImage(
                head.integer(0, "IMAGE_ID"),
                head.integer(8, "CAMERA_ID"),
                " ".join(head.words[9:]),
                pose[:4],
                pose[4:7],
                numbers[:, :2],
                numbers[:, 2].astype(np.int64),
                f"{path}, line {head.number}",
            )
        )
    check_unique([image.id for image in images], lambda k: images[k].location, "image")
    return images


def _points(path: Path, images: set[int]) -> ColmapPoints:
    """The points; tracks are only checked, since the image points name their object points."""
    rows = TextRows(path, "#")
    if (points := _parse_points_at_once(path, rows.lines, images)) is not None:
        return points
    ids, values, lines = [], [], []
    for row in rows:
        ids.append(row.integer(0, "POINT3D_ID"))
        values.append(row.numbers(("X", "Y", "Z", "R", "G", "B", "ERROR"), 1, allow_more=True)[:6])
        lines.append(row.number)
        if len(row) % 2:
            raise row.error("the track has an IMAGE_ID without its POINT2D_IDX")
        for k in range(8, len(row), 2):
            if row.integer(k, "IMAGE_ID") not in images:
                raise row.error(f"the image {row.words[k]} of the track is not in images")
    source = Source(str(path), np.array(lines, np.int64), "line")
    check_unique(ids, source, "point")
    values = np.array(values, float).reshape(-1, 6)
    return ColmapPoints(np.array(ids, np.int64), values[:, :3], values[:, 3:], source)


def _parse_points_at_once(
    path: Path, lines: Sequence[tuple[int, str]], images: set[int]
) -> ColmapPoints | None:
    """The same at once; None if something is unusual, and read line by line."""
    try:
        numbers = parse_numbers(END_OF_LINE.join([*(line for _, line in lines), ""]))
    except ValueError:
        return None
    row_ends = np.flatnonzero(np.isnan(numbers))
    number = np.diff(row_ends, prepend=-1) - 1  # of every line
    # Beyond 2⁵² floats are all whole: a number there has lost digits.
    is_regular = len(row_ends) == len(lines) and (number >= 8).all() and (number % 2 == 0).all()
    if not is_regular or not (np.abs(numbers) < 2**52).sum() == len(numbers) - len(row_ends):
        return None
    begin = row_ends - number
    is_track = np.ones(len(numbers), bool)
    is_track[row_ends] = False
    is_track[begin[:, None] + np.arange(8)] = False
    # Pairs of an image and the index of its image point.
    track, ids = numbers[is_track][::2], numbers[begin]
    image = track.astype(np.int64)  # whole numbers are looked up in a table, others sorted
    if (image != track).any() or not np.isin(image, [*images]).all():
        return None
    if (ids < 0).any() or (ids % 1).any():
        return None
    ids = ids.astype(np.int64)
    # The line of every point.
    source = Source(str(path), np.array([number for number, _ in lines], np.int64), "line")
    check_unique(ids, source, "point")
    values = numbers[begin[:, None] + np.arange(1, 7)]
    return ColmapPoints(ids, values[:, :3], values[:, 3:], source)


def text_files(model: ColmapModel) -> dict[str, bytes]:
    """The three text files by name."""
    images = [
        "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME",
        "# POINTS2D[] as (X, Y, POINT3D_ID)",
    ]
    for image in model.images:
        if any(character.isspace() for character in image.name):
            raise InputError(
                f"image {image.name!r}: names in COLMAP's text files have no blanks; rename it, or "
                "write the binary form"
            )
        pose = join_numbers([*image.q, *image.t])
        images.append(f"{image.id} {pose} {image.camera} {image.name}")
        images.append(
            " ".join(
                f"{x!r} {y!r} {point}"
                for (x, y), point in zip(image.xy.tolist(), image.point.tolist())
            )
        )
    points = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"]
    of_point = tracks(model)
    for id, position, colour, error in model.points.rows():
        track = " ".join(f"{image} {k}" for image, k in of_point[id])
        rgb = " ".join(map(str, colour))
        points.append(f"{id} {join_numbers(position)} {rgb} {error!r} {track}".rstrip())
    texts = {
        "cameras.txt": camera_lines(model.cameras),
        "images.txt": images,
        "points3D.txt": points,
    }
    return {name: ("\n".join(lines) + "\n").encode() for name, lines in texts.items()}


def camera_lines(cameras: Mapping[int, Camera]) -> list[str]:
    """The lines of a cameras.txt."""
    lines = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    for number, camera in cameras.items():
        (name, values), (width, height) = to_colmap(camera), size_of(camera, "COLMAP")
        lines.append(f"{number} {name} {width} {height} {join_numbers(values)}")
    return lines
