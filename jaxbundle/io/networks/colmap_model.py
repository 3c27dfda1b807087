"""A sparse model of COLMAP as its files have it, and as a network.

A pose is x_camera = R·X + t with x right, y down, z forward (`geometry.pose_conventions`); image
points count from the corner of the first pixel, ½ more than here. Image points without an
object point are left out. Rigs and frames (COLMAP 3.12 and later) are in `colmap_rigs`; every image
has its full pose in `images`.
"""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, Num

from jaxbundle.errors import InputError
from jaxbundle.geometry.pose_conventions import cv_pose, exterior_from_cv
from jaxbundle.io.networks.assemble import (
    PIXEL_CENTRE,
    assemble,
    colour_columns,
    entry_of,
    foreign_document,
    image_columns,
)
from jaxbundle.io.networks.colmap_models import to_colmap
from jaxbundle.io.networks.losses import changed, losing, need_values
from jaxbundle.io.networks.poses import matrices_of, matrices_of_quaternions, quaternions_of
from jaxbundle.network.columns import Columns, RepeatedIds, count, list_some
from jaxbundle.network.reprojection import point_errors
from jaxbundle.network.tables import Camera, Network, Source

# Object point of an image point without one, in the text form (COLMAP documentation, "Output
# Format"); the binary form has 2⁶⁴ − 1, the same bits.
NO_POINT = -1


@dataclasses.dataclass(frozen=True)
class ColmapImage:
    """An image: quaternion (w, x, y, z) and shift of the pose, image points and their object
    points (−1: none); `location` for messages."""

    id: int
    camera: int
    name: str
    q: Float[np.ndarray, "4"]
    t: Float[np.ndarray, "3"]
    xy: Float[np.ndarray, "n 2"]
    point: Int[np.ndarray, " n"]
    location: str


@dataclasses.dataclass(frozen=True)
class ColmapModel:
    """The contents of `cameras`, `images` and `points3D`."""

    cameras: dict[int, Camera]
    images: Sequence[ColmapImage]
    points: "ColmapPoints"


@dataclasses.dataclass(frozen=True)
class ColmapPoints:
    """The contents of `points3D` without tracks: numbers, coordinates, colours; `errors` are only
    written."""

    ids: Int[np.ndarray, " points"]
    position: Float[np.ndarray, "points 3"]
    colour: Num[np.ndarray, "points 3"]
    source: Source
    errors: Float[np.ndarray, " points"] | None = None

    def rows(self) -> Iterator[tuple[int, list[float], list[int], float]]:
        """Number, coordinates, colour and error of every point of a model to be written."""
        assert self.errors is not None, "of a model to be written"
        columns = self.ids, self.position, self.colour, self.errors
        return zip(*(column.tolist() for column in columns))


def check_unique(
    ids: Sequence[int] | Int[np.ndarray, " rows"], location_of: Callable[[int], object], name: str
) -> None:
    """Refuse repeated numbers; `location_of(k)` names the position of the k-th."""
    ids = np.asarray(ids)
    if (ids[1:] > ids[:-1]).all():
        return  # in order, as most files are
    values, first_rows, counts = np.unique(ids, return_index=True, return_counts=True)
    for value in values[counts > 1][:1]:
        second_row = np.flatnonzero(ids == value)[1]
        raise InputError(f"{location_of(second_row)}: {name} {value} occurs twice")


def to_network(path: Path, model: ColmapModel, overrides: Sequence[str]) -> Network:
    """The network of a sparse model; cameras are named by number, images by name.

    No camera parameter is free, σ is 1 px, the datum inner.

    **Raises:** `InputError` for missing ids.
    """
    images = model.images
    if not images:
        raise InputError(f"{path}: the model has no images")
    for image in images:
        if image.camera not in model.cameras:
            raise InputError(
                f"{image.location}: image {image.name!r} has the camera {image.camera}, which is "
                "not in cameras"
            )
        # Of any other length, it is normalised.
        if not np.any(image.q):
            raise InputError(f"{image.location}: image {image.name!r}: the quaternion is 0")
    names = [image.name for image in images]
    if len(set(names)) < len(names):
        repeated_name = next(name for k, name in enumerate(names) if name in names[:k])
        raise InputError(f"{path}: two images are called {repeated_name!r}")
    R = matrices_of_quaternions(np.stack([image.q for image in images]))
    M, X0 = exterior_from_cv(R, np.stack([image.t for image in images]))
    rays, warnings = _observations(path, model)
    numbers = np.arange(1, len(images) + 1)
    return assemble(
        path,
        foreign_document(path.resolve().name, map(entry_of, model.cameras.values())),
        overrides,
        image_columns(
            Source(str(path), numbers, "image"), names, [i.camera for i in images], M, X0
        ),
        Columns(
            {
                "id": model.points.ids,
                **dict(zip("XYZ", model.points.position.T)),
                **colour_columns(model.points.colour),
            },
            model.points.source,
        ),
        rays,
        warnings,
    )


def _observations(path: Path, model: ColmapModel) -> tuple[Columns, tuple[str, ...]]:
    """The table of image points; the first if an image has several of one object point."""
    image = np.repeat(
        np.arange(len(model.images)), [len(colmap_image.point) for colmap_image in model.images]
    )
    point = np.concatenate([colmap_image.point for colmap_image in model.images])
    xy = np.concatenate([colmap_image.xy for colmap_image in model.images]) - PIXEL_CENTRE
    has_point = point != NO_POINT
    if not has_point.all():
        image, point, xy = image[has_point], point[has_point], xy[has_point]
    row = find_rows(model.points.ids, point)
    if len(row) and row.min() < 0:
        _refuse_unknown_points(model)
    # A track may return to an image; a network has one image point of a point in an image.
    ray, warnings = image * len(model.points.ids) + row, ()
    in_order = np.sort(ray)
    if (in_order[1:] == in_order[:-1]).any():
        _, first_rays = np.unique(ray, return_index=True)
        repeated_images = np.delete(image, first_rays)
        first_rays.sort()
        image, row, xy = image[first_rays], row[first_rays], xy[first_rays]
        names = dict.fromkeys(model.images[k].name for k in repeated_images.tolist())
        warnings = (
            f"left out {count(len(repeated_images), 'image point')} of object points that have "
            f"another in the same image: {list_some(names)}",
        )
    columns = {
        "image": RepeatedIds(
            [colmap_image.name for colmap_image in model.images], image, are_rows=True
        ),
        "point": RepeatedIds(model.points.ids, row, are_rows=True),
        "x": xy[:, 0],
        "y": xy[:, 1],
    }
    source = Source(str(path), np.arange(1, len(xy) + 1), "image point")
    return Columns(columns, source), warnings


def find_rows(ids: Int[np.ndarray, " n"], numbers: Int[np.ndarray, " m"]) -> Int[np.ndarray, " m"]:
    """The rows of numbers in a column of different ones; −1 where there is none."""
    if not len(ids) or not len(numbers):
        return np.full(len(numbers), -1)
    # Numbers with few gaps, as usual, are looked up in a table: a tenth of the time of a search.
    if ids.min() >= 0 and ids.max() < 8 * len(ids):
        table = np.full(ids.max() + 1, -1)
        table[ids] = np.arange(len(ids))
        in_table = (numbers >= 0) & (numbers < len(table))
        return np.where(in_table, table[np.where(in_table, numbers, 0)], -1)
    order = np.argsort(ids)
    position = np.minimum(np.searchsorted(ids, numbers, sorter=order), len(ids) - 1)
    return np.where(ids[order[position]] == numbers, order[position], -1)


def _refuse_unknown_points(model: ColmapModel) -> None:
    """Refuse the first image point of an object point that is not there."""
    for image in model.images:
        unknown = (find_rows(model.points.ids, image.point) < 0) & (image.point != NO_POINT)
        if unknown.any():
            k = int(unknown.argmax())
            raise InputError(
                f"{image.location}: image {image.name!r}, image point {k}: the object point "
                f"{image.point[k]} is not in points3D"
            )


def from_network(network: Network) -> ColmapModel:
    """The sparse model of a network.

    **Raises:** `InputError` for a camera without a model in COLMAP, and for missing coordinates.
    """
    images, points, rays = network.images, network.points, network.observations
    cameras = dict(zip(numbers_of([c.id for c in network.cameras]), network.cameras))
    for camera in cameras.values():
        to_colmap(camera)
    need_values(network)
    R, t = cv_pose(matrices_of(images.angles), images.position)
    q = quaternions_of(R)
    camera_numbers = list(cameras)
    point_numbers = np.array(numbers_of(points.id), np.int64)
    colmap_images = []
    # The rays image by image, in one pass: masks of every image would be quadratic.
    order = np.argsort(rays.image, kind="stable")
    rays_of_images = np.split(order, np.searchsorted(rays.image[order], np.arange(1, len(images))))
    for i, (number, ray_rows) in enumerate(zip(numbers_of(images.id), rays_of_images)):
        colmap_images.append(
            ColmapImage(
                number,
                camera_numbers[images.camera[i]],
                images.id[i],
                q[i],
                t[i],
                rays.xy[ray_rows] + PIXEL_CENTRE,
                point_numbers[rays.point[ray_rows]],
                f"image {images.id[i]!r}",
            )
        )
    # −1: COLMAP's error not yet computed
    errors = np.nan_to_num(point_errors(network)[0], nan=-1.0)
    return ColmapModel(
        cameras,
        colmap_images,
        ColmapPoints(
            point_numbers, points.position, points.colour_or_grey(), points.source, errors
        ),
    )


def numbers_of(ids: Sequence[str]) -> list[int]:
    """The ids if all are whole numbers from 1, else 1, 2, 3, …"""
    # Nine digits: COLMAP's ids have 32 bits.
    are_numbers = all(id.isascii() and id.isdigit() and len(id) < 10 and id[0] != "0" for id in ids)
    return [int(id) for id in ids] if are_numbers else list(range(1, len(ids) + 1))


def tracks(model: ColmapModel) -> dict[int, list[tuple[int, int]]]:
    """(image, index of its image point) of every ray, by object point."""
    rays: dict[int, list[tuple[int, int]]] = {int(id): [] for id in model.points.ids}
    for image in model.images:
        for k, point in enumerate(image.point.tolist()):
            rays[point].append((image.id, k))
    return rays


def _count_renumbered(ids: Sequence[str]) -> int:
    return changed(ids, numbers_of(ids))


# What it loses; names of cameras and points are numbers from 1.
COLMAP_LOSSES = losing(
    "pixel sizes of cameras",
    keeping=("rigs",),
    partly={
        "names of cameras": lambda n: _count_renumbered([camera.id for camera in n.cameras]),
        "names of points": lambda n: _count_renumbered(n.points.id),
    },
)
