"""The text export of PhotoModeler ("Bundle Soln").

    title
    tolerance  iterations  [width  height]                      image size in pixels, if given
    σ of photo coordinates, control, …                          defaults, not used
    c xp yp  xs ys  K1 K2 K3 P1 P2                              default camera, mm, all digits
    σ of these
    N  file name                                                a photograph, N from 0
    N  X Y Z  κ φ ω                                             degrees
    N  σ of these
    N  covariances, or an empty line
    N  c xp yp  xs ys  K1 K2 K3 P1 P2                           rounded: `photomodeler_camera`
    N  σ of these
    …
    (empty line)
    id X Y Z σX σY σZ                                           control points
    (empty line)
    id X Y Z σX σY σZ                                           object points, then smart points
    (empty line)
    N  id  u v  σu σv                                           image points, pixels

The rest (features) is not read. The distortion is a correction at the measured point, y up:
model `brown`. Pixels and the principal point count from the upper left corner of the image with
format xs × ys mm:

    x0 = xp − xs/2,  y0 = ys/2 − yp,  p_x = xs/w,  p_y = ys/h,  our pixel = u − ½, v − ½

Whether the program's own origin is the corner or the centre of the first pixel is not published;
another choice moves image points and principal point alike, and changes no ray.

A control point with positive σ is weighted, others are held. Weighted ones have adjusted
coordinates with a posteriori σ (`formats` warns about it). An image point with σ 0 (a smart point)
has the default σ. Decimals may have a comma, depending on the language of the system;
photographs with skipped numbers (not used in the project) stay skipped. Several photographs whose
orientation is all zeros have none.

Source: the file itself, as read by the Damped Bundle Adjustment Toolbox (Börlin and Grussenmeyer
2013), and the camera of its published calibrations, which agree with this reading.
"""

import dataclasses
import ntpath
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxbundle.errors import InputError
from jaxbundle.io.networks.assemble import assemble, foreign_document, image_columns
from jaxbundle.io.networks.photomodeler_camera import (
    INNER,
    Inner,
    camera_entry,
    header_camera,
    photo_camera,
    rounding_warnings,
)
from jaxbundle.io.networks.photomodeler_points import (
    PhotoModelerBlock,
    point_table,
    ray_table,
    renumber_smart,
)
from jaxbundle.io.networks.poses import matrices_of
from jaxbundle.io.networks.settings import Document, apply_overrides
from jaxbundle.io.text.rows import TextRow, TextRows
from jaxbundle.network.columns import count, list_some
from jaxbundle.network.tables import Network, Source
from jaxbundle.system.file_content import beginning

TITLE = "Bundle Soln"
OUTER = ("X", "Y", "Z", "kappa", "phi", "omega")
POINT = ("X", "Y", "Z", "σX", "σY", "σZ")
RAY = ("u", "v", "σu", "σv")


def is_photomodeler(path: Path) -> bool:
    """Whether a text file begins like the export."""
    head = beginning(path, 100) if path.suffix.lower() == ".txt" else b""
    return head.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(TITLE.encode())


def read_photomodeler(path: str | Path, overrides: Sequence[str] = ()) -> Network:
    """The network of an export: cameras `cam` (or `cam1`, `cam2`, …), nothing free; photographs
    are named after their files.

    The datum is given by control points, if there are any; otherwise it is inner.

    **Raises:** `InputError` naming file and line, or that the image size is missing.
    """
    path = Path(path)
    rows = TextRows(path, blank=True, fallback="latin-1")
    # Exports differ in the empty lines before the title.
    while rows.has_more() and not rows.next_words():
        rows.take("the title")
    rows.take("the title")
    head = [
        _take_numbers(rows, expected)
        for expected in ("tolerance and iterations", "default σ", "the default camera", "its σ")
    ]
    numbers = head[0].all_numbers("tolerance, iterations, width, height")
    size = numbers[2:4].tolist() if len(numbers) >= 4 else None
    photos = _photos(rows, header_camera(head[2]))
    if not photos:
        raise head[3].error("no photograph follows")
    document, cameras, camera_overrides, half_units = _document(path, photos, size, overrides)
    control, objects = _points(rows, "control points"), _points(rows, "object points")
    names = dict(
        zip((photo.number for photo in photos), _file_names([photo.name for photo in photos]))
    )
    marks = _marks(rows, names)
    renumbered = renumber_smart(path, objects, marks)
    points = point_table(path, control, objects, marks.id)
    if len(control):
        document["project"]["datum"] = "control"
    exterior = np.array([photo.outer for photo in photos])
    # One photograph may be the origin; several at the same place are not oriented.
    is_at_origin = (exterior == 0).all(1)
    if is_at_origin.sum() > 1:
        exterior[is_at_origin] = np.nan
    images = image_columns(
        Source(str(path), np.array([photo.line for photo in photos]), "line"),
        list(names.values()),
        cameras,
        matrices_of(np.radians(exterior[:, :2:-1])),  # κ, φ, ω in the file
        exterior[:, :3],
    )
    remaining_overrides = [override for override in overrides if override not in camera_overrides]
    network = assemble(
        path, document, remaining_overrides, images, points, ray_table(path, marks, names)
    )
    warnings = [renumbered] if renumbered else []
    unlocated_ids = [id for id, X in zip(points.values["id"], points.values["X"]) if np.isnan(X)]
    if unlocated_ids:
        unlocated_count = count(len(unlocated_ids), "point")
        warnings.append(
            f"{unlocated_count} without coordinates in the file: {list_some(unlocated_ids)}"
        )
    return network.warn(*warnings, *rounding_warnings(network.cameras, half_units))


def _document(
    path: Path, photos: Sequence["Photo"], size: Sequence[float] | None, overrides: Sequence[str]
) -> tuple[Document, list[str], list[str], Float[np.ndarray, "cameras 10"]]:
    """Settings and cameras with overrides; the camera of each photograph; the
    overrides used; and half a unit of the last decimal of the values of each camera."""
    distinct, first_photos, camera = np.unique(
        np.array([photo.inner for photo in photos]), axis=0, return_index=True, return_inverse=True
    )
    names = ["cam"] if len(distinct) == 1 else [f"cam{k + 1}" for k in range(len(distinct))]
    document = foreign_document(
        path.stem,
        [camera_entry(id, values, size) for id, values in zip(names, distinct)],
        object_unit="m",
        residuals="corrected",
    )
    # The pixel size follows from an image size that may come from the command line.
    camera_overrides = [override for override in overrides if override.startswith("camera.")]
    document = apply_overrides(document, camera_overrides)
    for entry, values in zip(document["camera"], distinct):
        _add_pixel_size(path, entry, values)
    half_units = np.array([photos[k].half_unit for k in first_photos])
    return document, [names[c] for c in camera.reshape(-1)], camera_overrides, half_units


def _add_pixel_size(path: Path, entry: dict[str, Any], values: Inner) -> None:
    """The pixel size, from the format and the image size."""
    if "image_size" not in entry:
        raise InputError(
            f"{path}: line 2 has no image size; give --set camera.{entry['id']}.image_size="
            "WIDTH,HEIGHT (pixels)"
        )
    size, format = np.array(entry["image_size"], float), values[3:5]
    if size.shape != (2,) or not (size > 0).all() or not (format > 0).all():
        raise InputError(
            f"{path}: image size {entry['image_size']} and format {format.tolist()} mm must be "
            "positive"
        )
    entry.setdefault("pixel_size", (format / size).tolist())


@dataclasses.dataclass(frozen=True)
class Photo:
    """A photograph: its number in the file, orientation as written, and camera."""

    number: int
    name: str
    line: int
    outer: Float[np.ndarray, "6"]
    inner: Inner
    half_unit: Inner


def _photos(rows: TextRows, header: tuple[Inner, Inner] | None) -> list[Photo]:
    photos: list[Photo] = []
    while rows.next_words():
        row = rows.take("a photograph")
        number = row.integer(0, "the number of a photograph")
        if any(photo.number == number for photo in photos):
            raise row.error(f"photograph {number} is in the file twice")
        name = row.text.split(None, 1)[1].strip() if len(row) > 1 else ""
        outer = _read_numbered(rows, number, "orientation").numbers(OUTER, 1)
        _read_numbered(rows, number, "σ of the orientation").numbers(OUTER, 1)
        rows.take("covariances of the orientation or an empty line")
        inner = photo_camera(_read_numbered(rows, number, "the camera"), header)
        _read_numbered(rows, number, "σ of the camera").numbers(INNER, 1)
        photos.append(Photo(number, name or f"photo {number}", row.number, outer, *inner))
    if rows.has_more():
        rows.take("an empty line")
    return photos


def _read_numbered(rows: TextRows, number: int, name: str) -> TextRow:
    row = _take_numbers(rows, f"{name} of photograph {number}")
    # A line that was lost would shift all values after it.
    if row.integer(0, f"the number of the photograph before {name}") != number:
        raise row.error(f"expected {name} of photograph {number}, not of {row.words[0]}")
    return row


def _points(rows: TextRows, kind: str) -> PhotoModelerBlock:
    ids, values, lines = [], [], []
    for row in _block_rows(rows):
        ids.append(str(row.integer(0, f"the number of one of the {kind}")))
        values.append(row.numbers(POINT, 1))
        lines.append(row.number)
    return PhotoModelerBlock(ids, np.array(values).reshape(-1, 6), lines)


def _marks(rows: TextRows, names: Mapping[int, str]) -> PhotoModelerBlock:
    ids, values, lines, photos = [], [], [], []
    for row in _block_rows(rows):
        photo = row.integer(0, "the number of a photograph")
        if photo not in names:
            raise row.error(
                f"photograph {photo} does not exist; there are {len(names)}, "
                f"{min(names)} to {max(names)}"
            )
        photos.append(photo)
        ids.append(str(row.integer(1, "the number of a point")))
        values.append(row.numbers(RAY, 2))
        lines.append(row.number)
    return PhotoModelerBlock(ids, np.array(values).reshape(-1, 4), lines, photos)


def _block_rows(rows: TextRows) -> Iterator[TextRow]:
    """Lines to the next empty one; without it the file is truncated."""
    while True:
        row = _take_numbers(rows, "an empty line after the last of a block")
        if not row.words:
            return
        yield row


def _take_numbers(rows: TextRows, expected: str) -> TextRow:
    """The next line of numbers, a decimal comma read as a point."""
    row = rows.take(expected)
    return TextRow(row.path, row.number, row.text.replace(",", ".")) if "," in row.text else row


def _file_names(files: Sequence[str]) -> list[str]:
    """File names without their folders, if they differ; a repeated file is numbered."""
    base_names = [ntpath.basename(name) for name in files]  # paths of Windows, on any system
    names = base_names if len(set(base_names)) == len(base_names) else list(files)
    return [f"{name}#{k}" if names.count(name) > 1 else name for k, name in enumerate(names)]
