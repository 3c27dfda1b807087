"""The text export of PhotoModeler ("Bundle Soln").

    title
    tolerance  iterations  [width  height]                      image size in pixels, if it is there
    σ of photo coordinates, control, …                          defaults, not used
    c xp yp  xs ys  K1 K2 K3 P1 P2                              default camera, mm
    σ of these
    N  file name                                                a photograph, N from 0
    N  X Y Z  κ φ ω                                             degrees
    N  σ of these
    N  covariances, or an empty line
    N  c xp yp  xs ys  K1 K2 K3 P1 P2
    N  σ of these
    …
    (empty line)
    id X Y Z σX σY σZ                                           control points
    (empty line)
    id X Y Z σX σY σZ                                           object points
    (empty line)
    N  id  u v  σu σv                                           image points, pixels

What follows (features) is not read. The distortion is a correction at the measured point, y up:
model `brown`. Pixels and the principal point count from the upper left corner of the image, whose
format is xs × ys mm:

    x0 = xp − xs/2,  y0 = ys/2 − yp,  p_x = xs/w,  p_y = ys/h,  our pixel = u − ½, v − ½

Whether the program's own origin is the corner or the centre of the first pixel is not published;
another choice moves image points and principal point alike, and changes no ray.

A control point with positive σ is weighted, one without is held. An image point with σ 0 (measured
by matching) has the default σ.

Source: the file itself, as read by the Damped Bundle Adjustment Toolbox (Börlin and Grussenmeyer
2013), and the camera of its published calibrations, which agree with this reading.
"""

import ntpath
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxbundle.errors import InputError
from jaxbundle.io.assemble import assemble, foreign_document, image_columns
from jaxbundle.io.poses import matrices_of
from jaxbundle.io.rows import Row, Rows
from jaxbundle.io.settings import apply_overrides
from jaxbundle.network.columns import Columns, count, some
from jaxbundle.network.tables import Network, Source

TITLE = "Bundle Soln"
OUTER = ("X", "Y", "Z", "kappa", "phi", "omega")
INNER = ("c", "xp", "yp", "xs", "ys", "K1", "K2", "K3", "P1", "P2")
POINT = ("X", "Y", "Z", "σX", "σY", "σZ")
RAY = ("u", "v", "σu", "σv")


def is_photomodeler(path: Path) -> bool:
    """Whether a text file begins as the export does."""
    if path.suffix.lower() != ".txt" or not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(TITLE)) == TITLE.encode()


def read_photomodeler(path: str | Path, overrides: Sequence[str] = ()) -> Network:
    """The network of an export: cameras `cam` (or `cam1`, `cam2`, …), nothing free; photographs
    are called by their file name.

    The datum is given by control points, where there are any; otherwise it is inner.

    **Raises:** `InputError` naming file and line, or that the image size is missing.
    """
    path = Path(path)
    rows = Rows(path, blank=True, fallback="latin-1")
    head = [rows.take(what) for what in ("the title", "tolerance and iterations", "default σ",
                                         "the default camera", "its σ")]  # fmt: skip
    given = head[1].all_numbers("tolerance, iterations, width, height")
    size = given[2:4].tolist() if len(given) >= 4 else None
    photos = list(_photos(rows))
    if not photos:
        raise head[4].error("no photograph follows")
    inner = np.array([photo[3] for photo in photos])
    distinct, camera = np.unique(inner, axis=0, return_inverse=True)
    camera = camera.reshape(-1)
    ids = ["cam"] if len(distinct) == 1 else [f"cam{k + 1}" for k in range(len(distinct))]
    document = foreign_document(
        path.stem, [_entry(id, values, size) for id, values in zip(ids, distinct)],
        object_unit="m", residuals="corrected",
    )  # fmt: skip
    # the pixel size follows from an image size that may come from the command line
    of_camera = [override for override in overrides if override.startswith("camera.")]
    document = apply_overrides(document, of_camera)
    for entry, values in zip(document["camera"], distinct):
        _complete(path, entry, values)
    names = _names([photo[0] for photo in photos])
    control, objects = _points(rows, "control points"), _points(rows, "object points")
    points = _merged(path, control, objects)
    observed = _rays(rows, names)
    if len(control[0]):
        document["project"]["datum"] = "control"
    outer = np.array([photo[2] for photo in photos])
    images = image_columns(
        Source(str(path), np.array([photo[1] for photo in photos]), "line"),
        names, [ids[c] for c in camera], matrices_of(np.radians(outer[:, :2:-1])), outer[:, :3],
    )  # fmt: skip
    known = set(points.values["id"])
    extra = dict.fromkeys(id for id in observed.values["point"] if id not in known)
    points = _with_unknown(points, extra)
    rest = [override for override in overrides if override not in of_camera]
    network = assemble(path, document, rest, images, points, observed)
    held = [id for id, s in zip(control[0], control[2]) if not (s > 0).all()]
    if held:
        network = network.warn(
            f"{count(len(held), 'control point')} without positive σ held as fixed: {some(held)}"
        )
    if extra:
        network = network.warn(
            f"{count(len(extra), 'point')} without coordinates in the file: {some(extra)}"
        )
    return network


def _entry(id: str, values, size) -> dict:
    c, xp, yp, xs, ys, K1, K2, K3, P1, P2 = values.tolist()
    entry = {"id": id, "model": "brown", "c": c, "x0": xp - xs / 2, "y0": ys / 2 - yp,
             "K1": K1, "K2": K2, "K3": K3, "P1": P1, "P2": P2}  # fmt: skip
    return entry if size is None else entry | {"image_size": size}


def _complete(path: Path, entry: dict, values) -> None:
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


def _photos(rows: Rows):
    """File name, line, outer and inner orientation of every photograph."""
    while rows.next_words():
        row = rows.take("a photograph")
        number = row.whole(0, "the number of a photograph")
        name = row.text.split(None, 1)[1].strip() if len(row) > 1 else ""
        outer = _numbered(rows, number, "orientation", OUTER)
        _numbered(rows, number, "σ of the orientation", OUTER)
        rows.take("covariances of the orientation or an empty line")
        inner = _numbered(rows, number, "the camera", INNER)
        _numbered(rows, number, "σ of the camera", INNER)
        yield name or f"photo {number}", row.number, outer, inner
    if rows.more():
        rows.take("an empty line")


def _numbered(rows: Rows, number: int, what: str, names):
    row = rows.take(f"{what} of photograph {number}")
    if row.whole(0, f"the number of the photograph before {what}") != number:
        raise row.error(f"{what} of photograph {number} is expected, not of {row.words[0]}")
    return row.numbers(names, 1)


def _points(rows: Rows, what: str):
    """Ids, coordinates, σ and lines of a block that ends with an empty line."""
    found: list[tuple[str, np.ndarray, int]] = []
    for row in _block(rows):
        row.whole(0, f"the number of one of the {what}")
        found.append((row.words[0], row.numbers(POINT, 1), row.number))
    values = np.array([v for _, v, _ in found]).reshape(-1, 6)
    return [id for id, _, _ in found], values[:, :3], values[:, 3:], [line for *_, line in found]


def _block(rows: Rows):
    """Lines to the next empty one, without which the file is cut off."""
    while True:
        row: Row = rows.take("an empty line after the last of a block")
        if not row.words:
            return
        yield row


def _merged(path: Path, control, objects) -> Columns:
    """Control points as given, then the object points that are none."""
    taken = set(control[0])
    other = [k for k, id in enumerate(objects[0]) if id not in taken]
    weighted = (control[2] > 0).all(1)
    sigma = np.where(weighted[:, None], control[2], np.nan)
    position = np.concatenate([control[1], objects[1][other]])
    sigma = np.concatenate([sigma, np.full((len(other), 3), np.nan)])
    lines = [*control[3], *(objects[3][k] for k in other)]
    columns = {
        "id": [*control[0], *(objects[0][k] for k in other)],
        "role": [*np.where(weighted, "control", "fixed").tolist(), *["tie"] * len(other)],
        **dict(zip("XYZ", position.T)), **dict(zip(("sX", "sY", "sZ"), sigma.T)),
    }  # fmt: skip
    return Columns(columns, Source(str(path), np.array(lines, np.int64), "line"))


def _with_unknown(points: Columns, ids) -> Columns:
    """The table with points that have no coordinates put at its end."""
    if not ids:
        return points
    n, values = len(ids), dict(points.values)
    nan = np.full(n, np.nan)
    values |= {key: np.concatenate([column, nan]) for key, column in values.items()
               if key not in ("id", "role")}  # fmt: skip
    values |= {"id": [*values["id"], *ids], "role": [*values["role"], *["tie"] * n]}
    numbers = np.concatenate([points.source.numbers, np.zeros(n, np.int64)])
    return Columns(values, Source(points.source.name, numbers, "line"))


def _rays(rows: Rows, names: Sequence[str]) -> Columns:
    found, images, ids, lines = [], [], [], []
    for row in _block(rows):
        photo = row.whole(0, "the number of a photograph")
        if photo >= len(names):
            raise row.error(f"photograph {photo} does not exist; there are {len(names)}, from 0")
        row.whole(1, "the number of a point")
        images.append(names[photo])
        ids.append(row.words[1])
        found.append(row.numbers(RAY, 2))
        lines.append(row.number)
    if not found:
        raise InputError(f"{rows.path}: there are no image points")
    values = np.array(found)
    sigma = np.where(values[:, 2:] > 0, values[:, 2:], np.nan)
    return Columns(
        {"image": images, "point": ids, "x": values[:, 0] - 0.5, "y": values[:, 1] - 0.5,
         "sx": sigma[:, 0], "sy": sigma[:, 1]},
        Source(str(rows.path), np.array(lines), "line"),
    )  # fmt: skip


def _names(files: Sequence[str]) -> list[str]:
    """File names without their folders, as long as they differ."""
    short = [ntpath.basename(name) for name in files]
    return short if len(set(short)) == len(short) else list(files)

