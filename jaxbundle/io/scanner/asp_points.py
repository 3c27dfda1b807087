"""Tie and control points of Ames Stereo Pipeline: `.match` files of pairs, `.gcp` files.

    PREFIX-IMAGE1__IMAGE2[-clean].match: little-endian, two counts (64 bits), as many records of
    the first image, as many of the second:
        x, y                            columns and rows, 32-bit floats
        ix, iy                          32-bit integers
        orientation, scale, interest    32-bit floats
        polarity                        one byte
        octave, scale_lvl               32-bit integers
        n, descriptor                   64-bit count, n 32-bit floats

    id latitude longitude height σx σy σz  image column row σcolumn σrow  image …        (.gcp)

(parse_match_file, bundle_adjust of its documentation.) Column 0, row 0 is the centre of the first
pixel. Degrees and metres; σ of a control point are along X, Y, Z. Fields of a `.gcp` are separated
by spaces or commas.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxbundle.arguments import show
from jaxbundle.errors import InputError
from jaxbundle.io.text.csv_tables import read_text
from jaxbundle.io.text.xml_fields import number_in
from jaxbundle.system.file_content import read_content

# A record without its descriptor.
RECORD = np.dtype(
    [
        ("xy", "<f4", 2),
        ("ixy", "<i4", 2),
        ("described", "<f4", 3),
        ("polarity", "u1"),
        ("octave", "<u4", 2),
        ("length", "<u8"),
    ]
)
FIELDS_OF_POINT, FIELDS_OF_IMAGE = 7, 5


class ControlFile(NamedTuple):
    """Control points of a `.gcp` file: ids, longitude, latitude (degrees), height, σ along X, Y, Z,
    the line of each; and their measurements: image by its name in the file, point, line and pixel,
    σ of these, the line of each."""

    id: list[str]
    geographic: Float[np.ndarray, "points 3"]
    sigma: Float[np.ndarray, "points 3"]
    row: Int[np.ndarray, " points"]
    image: list[str]
    point: Int[np.ndarray, " rays"]
    xy: Float[np.ndarray, "rays 2"]
    xy_sigma: Float[np.ndarray, "rays 2"]


def read_gcp(path: str | Path) -> ControlFile:
    """The control points of a `.gcp` file.

    **Raises:** `InputError` naming file and line.
    """
    points, rays = [], []
    for number, text in enumerate(read_text(Path(path)).splitlines(), 1):
        words = text.partition("#")[0].replace(",", " ").split()
        if not words:
            continue
        where = f"{path}, line {number}"
        image_fields = len(words) - FIELDS_OF_POINT
        if image_fields < 0 or image_fields % FIELDS_OF_IMAGE:
            raise InputError(
                f"{where}: {len(words)} fields; expected id, latitude, longitude, height, three σ, "
                "and for every image its name, column, row and two σ"
            )
        values = [number_in(word, where) for word in words[1:FIELDS_OF_POINT]]
        if not abs(values[0]) <= 90:
            raise InputError(f"{where}: latitude {values[0]:g} is beyond the pole; it comes first")
        # Longitude first, as in our tables.
        points.append((words[0], (values[1], values[0], values[2]), values[3:], number))
        for k in range(FIELDS_OF_POINT, len(words), FIELDS_OF_IMAGE):
            column, row, *sigma = (number_in(w, where) for w in words[k + 1 : k + FIELDS_OF_IMAGE])
            rays.append((words[k], len(points) - 1, (row, column), sigma[::-1]))
    if not points:
        raise InputError(f"{path}: no control point; expected one per line")
    id, geographic, sigma, row = zip(*points)
    image, point, xy, xy_sigma = zip(*rays) if rays else ((), (), (), ())
    table = lambda rows, width: np.array(rows, float).reshape(-1, width)
    return ControlFile(
        list(id),
        table(geographic, 3),
        table(sigma, 3),
        np.array(row, int),
        list(image),
        np.array(point, int),
        table(xy, 2),
        table(xy_sigma, 2),
    )


def read_match(path: str | Path) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
    """Lines and pixels of corresponding points in the two images of a `.match` file.

    **Raises:** `InputError` for a file that is cut or of another kind.
    """
    content = read_content(path, text=False)
    error = InputError(f"{path}: is cut, or no binary match file of Ames Stereo Pipeline")
    if len(content) < 16:
        raise error
    first_count, second_count = np.frombuffer(content, "<u8", 2).tolist()
    if first_count != second_count or 16 + 2 * first_count * RECORD.itemsize > len(content):
        raise error
    xy, offset = np.empty((2 * first_count, 2)), 16
    for k in range(2 * first_count):
        if offset + RECORD.itemsize > len(content):
            raise error
        record = np.frombuffer(content, RECORD, 1, offset)[0]
        xy[k] = record["xy"][::-1]
        offset += RECORD.itemsize + 4 * int(record["length"])
    if offset != len(content):
        raise error
    return xy[:first_count], xy[first_count:]


def images_of_match(path: Path, names: Sequence[str]) -> tuple[str, str]:
    """The two images of a `.match` file, of these names.

    **Raises:** `InputError` if its name does not contain two of them.
    """
    stem = path.stem.removesuffix("-clean")
    for first_image in sorted(names, key=len, reverse=True):
        for second_image in names:
            pair = f"{first_image}__{second_image}"
            if stem == pair or stem.endswith(f"-{pair}"):
                return first_image, second_image
    raise InputError(
        f"{path}: the name of a match file is PREFIX-IMAGE1__IMAGE2.match; no two images of "
        f"[images] ({', '.join(names)}, ids or names of their files) are in {show(path.name)}"
    )


class JoinedMatches(NamedTuple):
    """Tie points of several images: of every measurement the image, the point, line and pixel;
    `contradicting`: points left out because they are twice in an image."""

    image: Int[np.ndarray, " rays"]
    point: Int[np.ndarray, " rays"]
    xy: Float[np.ndarray, "rays 2"]
    contradicting: int


def join_matches(
    pairs: Sequence[tuple[int, int, Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]],
) -> JoinedMatches:
    """The points of pairs of images, joined where a place of an image is in several pairs.

    **Arguments:** `pairs`: two images, and lines and pixels of the same points in both.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    pair_ends = [
        np.c_[np.full(len(xy), i), xy] for i, j, a, b in pairs for i, xy in ((i, a), (j, b))
    ]
    positions, inverse = np.unique(np.concatenate(pair_ends), axis=0, return_inverse=True)
    # The same numbers of both ends of every pair.
    sides = np.split(inverse.ravel(), np.cumsum([len(rows) for rows in pair_ends])[:-1])
    first_positions, second_positions = (np.concatenate(sides[k::2]) for k in (0, 1))
    shape = (len(positions), len(positions))
    graph = coo_array((np.ones(len(first_positions)), (first_positions, second_positions)), shape)
    _, point = connected_components(graph, directed=False)
    image = positions[:, 0].astype(int)
    # Two places in one image are not one point.
    _, counts = np.unique(np.c_[point, image], axis=0, return_counts=True)
    ambiguous_points = np.unique(np.c_[point, image], axis=0)[counts > 1, 0]
    is_unique = ~np.isin(point, ambiguous_points)
    _, renumbered = np.unique(point[is_unique], return_inverse=True)
    order = np.argsort(image[is_unique], kind="stable")
    left_out = len(np.unique(ambiguous_points))
    return JoinedMatches(
        image[is_unique][order], renumbered[order], positions[is_unique, 1:][order], left_out
    )
