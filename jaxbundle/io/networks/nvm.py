"""Models of VisualSFM: an `.nvm` file.

    NVM_V3 [FixedK fx cx fy cy]
    cameras      their number, and for each: name, f, quaternion w x y z, centre X Y Z, r, 0
    points       their number, and for each: X Y Z, R G B, rays, and for each of them image,
                 feature, x y
    …            further models; 0 ends them

x, y count from the centre of the image, x right, y down, in pixels; the camera frame has z forward.
The distortion is of the measured point: with m = (x, y)/f

    X/Z, Y/Z of a ray = m·(1 + r·|m|²)

which is `brown` with K1 = r/c². That model is in mm: the file has no pixel size, which is taken as
0.005 mm; another would scale c and K1 and change nothing in pixels. The file has no image size.
Some programs, COLMAP among them, write x, y from a corner of the image instead, and not where its
centre is: then no coordinate is negative, and the points are off by half an image. Their median
offset is subtracted, with a note.
The largest model is read. FixedK, whose principal point moves the measurements, is refused unless
it is in the middle (cx = cy = 0).

Source: VisualSFM documentation, "NVM file format"; Multicore Bundle Adjustment, the comments of its
data interface, for r.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxbundle.errors import InputError
from jaxbundle.geometry.pose_conventions import flip_rows
from jaxbundle.io.networks.assemble import (
    assemble,
    colour_columns,
    foreign_document,
    image_columns,
    unique_labels,
)
from jaxbundle.io.networks.poses import matrices_of_quaternions
from jaxbundle.io.text.rows import TextRow, TextRows, is_number
from jaxbundle.network.columns import Columns, count
from jaxbundle.network.tables import UNIT, Network, Source
from jaxbundle.system.file_content import beginning

HEAD = "NVM_V3"
NUMBERS = ("f", "QW", "QX", "QY", "QZ", "X", "Y", "Z", "r")
PIXEL = 0.005


def is_nvm(path: Path) -> bool:
    """Whether a file begins as VisualSFM's."""
    return beginning(path, 20).lstrip().startswith(HEAD.encode())


class _Model:
    """The rows of one model."""

    def __init__(self, rows: TextRows, number: int):
        self.cameras = [rows.take(f"camera {k} of {number}") for k in range(number)]
        self.points: list[TextRow] = []
        if rows.has_more():
            points = rows.take("the number of points").integer(0, "the number of points")
            self.points = [rows.take(f"point {k} of {points}") for k in range(points)]


def read_nvm(path: str | Path, overrides: Sequence[str] = ()) -> Network:
    """The network of the largest model: one camera per image, f and K1 free, σ 1 px.

    **Raises:** `InputError` naming file and line.
    """
    path = Path(path)
    rows = TextRows(path)
    head = rows.take(HEAD)
    if not head.words or head.words[0] != HEAD:
        raise head.error(f"{head.text.strip()[:40]!r}; expected {HEAD}, with quaternions")
    if "FixedK" in head.words:
        fixed = head.words[head.words.index("FixedK") + 1 :]
        if len(fixed) < 4 or any(float(word) for word in (fixed[1], fixed[3]) if is_number(word)):
            raise head.error(
                "FixedK, a calibration with a principal point of its own, is not read; expected "
                "a model without it"
            )
    models = []
    while rows.has_more() and (row := rows.take("the number of cameras")).words:
        # After the models: comments about PLY files.
        if not row.words[0].isdigit() or not row.integer(0, "the number of cameras"):
            break
        models.append(_Model(rows, row.integer(0, "the number of cameras")))
    if not models:
        raise InputError(f"{path}: there is no model in it; expected a number of cameras")
    model = max(models, key=lambda model: (len(model.points), len(model.cameras)))
    messages = [f"the largest of {len(models)} models is read"] if len(models) > 1 else []
    return _network(path, model, overrides, messages)


def _network(
    path: Path, model: _Model, overrides: Sequence[str], messages: Sequence[str]
) -> Network:
    names, values, lines = [], [], []
    for row in model.cameras:
        # A name may have blanks; ten numbers follow it.
        names.append(" ".join(row.words[:-10]) if len(row) > 10 else "")
        if not names[-1]:
            raise row.error(f"{len(row)} values; expected a name and {', '.join(NUMBERS)}, 0")
        numbers = row.numbers((*NUMBERS, "0"), len(row) - 10)
        if numbers[-1] != 0:
            raise row.error(
                f"the last number of a camera is {numbers[-1]:g}; expected 0: VisualSFM has "
                "one coefficient of distortion"
            )
        values.append(numbers[:-1])
        lines.append(row.number)
        if not values[-1][0] > 0 or not values[-1][1:5].any():
            raise row.error(f"f is {values[-1][0]:g}; expected a positive number and a rotation")
    names = unique_labels(names, range(len(names)))
    p = np.array(values)
    M = flip_rows(matrices_of_quaternions(p[:, 1:5]))
    c = p[:, 0] * PIXEL
    cameras = [
        {"id": name, "model": "brown", "c": f, "K1": r / f**2, "pixel_size": [PIXEL, PIXEL]}
        | {"free": ["c", "K1"]}
        for name, f, r in zip(names, c.tolist(), p[:, 8].tolist())
    ]
    position, colours, rays = _points(model, len(names))
    unique_rays = {}
    for k, (image, point, *_) in enumerate(rays[:, :2].astype(np.int64).tolist()):
        unique_rays.setdefault((image, point), k)
    if len(unique_rays) < len(rays):
        omitted = count(len(rays) - len(unique_rays), "image point")
        messages = [
            *messages,
            f"left out {omitted} of object points that have another in the same image",
        ]
        rays = rays[list(unique_rays.values())]
    source = Source(str(path), rays[:, 4].astype(np.int64), "line")
    offset = _offset_of_centre(rays, position, M, p)
    if offset.any():
        centre = ", ".join(f"{x:.2f}" for x in np.median(offset, axis=0))
        messages = [
            *messages,
            "image points are counted from a corner of the images, as other programs than "
            f"VisualSFM write them: their centres, ({centre}) px, are where the points fit best",
        ]
    xy = (rays[:, 2:4] - offset[rays[:, 0].astype(np.int64)]) * [PIXEL, -PIXEL]
    return assemble(
        path,
        foreign_document(
            path.stem, cameras, image_unit="mm", residuals="corrected", sigma_origin=UNIT
        ),
        overrides,
        image_columns(Source(str(path), np.array(lines), "line"), names, names, M, p[:, 5:8]),
        Columns(
            {"id": range(len(position)), **dict(zip("XYZ", position.T)),
             **colour_columns(colours)},
            Source(str(path), np.array([row.number for row in model.points], np.int64), "line"),
        ),
        Columns(
            {"image": [names[i] for i in rays[:, 0].astype(np.int64)],
             "point": rays[:, 1].astype(np.int64), **dict(zip("xy", xy.T)),
             **dict.fromkeys(("sx", "sy"), np.full(len(xy), PIXEL))},
            source,
        ),
        messages,
    )  # fmt: skip


def _offset_of_centre(
    rays: Float[np.ndarray, "rays 5"],
    position: Float[np.ndarray, "points 3"],
    M: Float[np.ndarray, "images 3 3"],
    p: Float[np.ndarray, "images 9"],
    tolerance: float = 0.1,
) -> Float[np.ndarray, "images 2"]:
    """Where the centre of the images is, px; 0 where image points count from it.

    **Arguments:** `tolerance`: relative to the image; the offset is half an image or none. Offsets
    of images that differ by less are one, those of images of other sizes differ by more."""
    zero_offsets, xy = np.zeros((len(p), 2)), rays[:, 2:4]
    if not len(xy) or xy.min() < 0:
        return zero_offsets
    image, point = rays[:, :2].astype(np.int64).T
    r, s, q = np.einsum("nij,nj->in", M[image], position[point] - p[image, 5:8])
    with np.errstate(divide="ignore", invalid="ignore"):
        offsets = xy - p[image, :1] * np.stack([-r / q, s / q], 1)
    offsets[~np.isfinite(offsets).all(1)] = np.nan
    if (
        np.isnan(offsets).all()
        or (common_offset := np.nanmedian(offsets, axis=0)).min() < tolerance * xy.max()
    ):
        return zero_offsets
    image_offsets = [offsets[image == k] for k in range(len(p))]
    image_offsets = [
        common_offset if np.isnan(rows).all() else np.nanmedian(rows, axis=0)
        for rows in image_offsets
    ]
    differs = (np.abs(image_offsets - common_offset) > tolerance * xy.max()).any()
    return np.array(image_offsets) if differs else zero_offsets + common_offset


def _points(model: _Model, images: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Coordinates, colours, and image, point, x, y, line of all rays."""
    position, rays = [], [np.zeros((0, 5))]
    for k, row in enumerate(model.points):
        numbers = row.all_numbers("a point")
        views = row.rays(6, "a point", images, "image")
        ones = np.ones((len(views), 1))
        position.append(numbers[:6])
        rays.append(np.hstack([views[:, :1], k * ones, views[:, 2:], row.number * ones]))
    values = np.reshape(position, (-1, 6))
    return values[:, :3], values[:, 3:], np.concatenate(rays)
