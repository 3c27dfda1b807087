"""A list of photographs in one text file: start values, image points and object points.

    18.556                                              focal length, mm
    DSC_037  ω φ κ XL YL ZL  σω σφ σκ σXL σYL σZL        a photograph, radians
    10                                                  how many image points it has
    1  x y  σx σy                                       an image point, mm
    …
    1  X Y Z  σX σY σZ                                  object points, to the end of the file

Columns are separated by tabs or blanks. Photographs and object points are start values; the
datum is given by inner constraints.
"""

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxbundle.arguments import show
from jaxbundle.errors import InputError
from jaxbundle.io.networks.settings import apply_overrides, network_of
from jaxbundle.io.text.csv_tables import read_text
from jaxbundle.network.columns import Columns, count
from jaxbundle.network.tables import UNIT, Network, Source

PHOTO = ("omega", "phi", "kappa", "X0", "Y0", "Z0")
IMAGE_POINT = ("x", "y")
OBJECT_POINT = ("X", "Y", "Z")


def read_photo_list(path: str | Path, overrides: Sequence[str] = ()) -> Network:
    """The network of a list of photographs: one camera "cam", model brown, no free parameters.

    `overrides` are settings `KEY=VALUE` (`networks.settings`), such as `free=c,x0,y0,K1`.
    With `sigma_image=VALUE` (mm) all image coordinates have this σ instead of that of the
    file, with `sigma_origin=unit` unit weights.

    **Raises:** `InputError` naming file and line, among others for a σ that is not finite and
    positive.
    """
    path = Path(path)
    focal, photos, image_points, object_points = _Parser(path).parse()
    document = {
        "project": {
            "name": path.stem,
            "datum": "inner",
            "residuals": "corrected",
            "angle_unit": "rad",
            "image_unit": "mm",
            "object_unit": "model",
        },
        "camera": [{"id": "cam", "model": "brown", "c": focal}],
    }
    document = apply_overrides(document, overrides)
    project = document["project"]
    without_sigma = "sigma_image" in project or project.get("sigma_origin") == UNIT
    if not without_sigma:
        _check_sigmas(path, (*photos, *image_points, *object_points))
    tables = {
        "images": _columns(path, photos, PHOTO, camera=["cam"] * len(photos)),
        "points": _columns(path, object_points, OBJECT_POINT, role=["tie"] * len(object_points)),
        "observations": _columns(
            path,
            image_points,
            IMAGE_POINT if without_sigma else (*IMAGE_POINT, "sx", "sy"),
            id="point",
            image=[row.photo for row in image_points],
        ),
    }
    network = network_of(document, tables, str(path))
    if without_sigma:
        return network.note("the σ of the file are ignored, also those of photographs and points")
    return network.note(
        "σ of photographs and object points are ignored: their values are start values only"
    )


def _columns(
    path: Path,
    rows: Sequence["_Row"],
    names: Sequence[str],
    id: str = "id",
    **extra_columns: Sequence[str],
) -> Columns:
    """The table of some lines: their ids in the column `id`, their first values by `names`."""
    source = Source(str(path), np.array([row.line for row in rows]), "line")
    values = {name: [row.values[k] for row in rows] for k, name in enumerate(names)}
    return Columns({id: [row.id for row in rows], **extra_columns, **values}, source)


@dataclasses.dataclass(frozen=True)
class _Row:
    """A line of the file: its number, its subject, its values followed by their σ."""

    line: int
    id: str
    names: tuple[str, ...]
    values: tuple[float, ...]
    photo: str = ""

    def __str__(self) -> str:
        if self.names == PHOTO:
            return f"photograph {self.id!r}"
        in_photo = f" in photograph {self.photo!r}" if self.photo else ""
        return f"{'' if in_photo else 'object '}point {self.id!r}{in_photo}"


def _check_sigmas(path: Path, rows: Sequence[_Row]) -> None:
    for row in sorted(rows, key=lambda row: row.line):
        for axis, sigma in zip(row.names, row.values[len(row.names) :]):
            if not (math.isfinite(sigma) and sigma > 0):
                raise InputError(
                    f"{path}, line {row.line}: σ of {axis} of {row} is {sigma:g}; it must be "
                    "finite and positive; to ignore the σ of the file give --set "
                    f"sigma_image=VALUE (mm), or sigma_origin={UNIT} for unit weights"
                )


class _Parser:
    """Reads the lines of the file in sequence; `parse` is the grammar."""

    def __init__(self, path: Path):
        self.path = path
        self.lines = [
            (number, line.split())
            for number, line in enumerate(read_text(path).splitlines(), 1)
            if line.strip()
        ]
        self.next = 0

    def parse(self) -> tuple[float, list[_Row], list[_Row], list[_Row]]:
        focal = self._focal_length()
        photos, image_points, object_points = [], [], []
        count_source = "line 1 gives the focal length"
        # 7 words are an object point, 13 or more a photograph, whose name may have blanks
        while self._has_more() and len(self.lines[self.next][1]) != 7:
            number, words = self.lines[self.next]
            if len(words) < 13:
                raise self._error(
                    number,
                    f"{count(len(words), 'value')} where a photograph (name, 6 values, "
                    f"6 σ) or an object point (id, 3 values, 3 σ) is expected; {count_source}",
                )
            photo = self._row(" ".join(words[:-12]), words[-12:], PHOTO)
            count_line, size = self._count(photo)
            count_source = f"line {count_line} announces {size} image points of {photo}"
            for k in range(size):
                image_points.append(self._image_point(photo, count_source, k))
            photos.append(photo)
        if not photos:
            raise self._error(self.lines[-1][0], "no photograph after the focal length")
        while self._has_more():
            number, words = self.lines[self.next]
            if len(words) != 7:
                raise self._error(
                    number,
                    f"{count(len(words), 'value')} where an object point (id, X, Y, Z "
                    "and their σ) is expected",
                )
            object_points.append(self._row(words[0], words[1:], OBJECT_POINT))
        if not object_points:
            raise self._error(
                self.lines[-1][0], "the file ends before the object points (id, X, Y, Z, σ)"
            )
        return focal, photos, image_points, object_points

    def _focal_length(self) -> float:
        if not self.lines:
            raise InputError(f"{self.path}: the file is empty; first comes the focal length in mm")
        number, words = self.lines[0]
        if len(words) != 1:
            raise self._error(number, "the first line must be the focal length in mm alone")
        self.next = 1
        return self._number(number, "the focal length", words[0])

    def _count(self, photo: _Row) -> tuple[int, int]:
        if not self._has_more():
            raise self._error(photo.line, f"the file ends after {photo}")
        number, words = self.lines[self.next]
        # Nine digits: int() of a longer text is no count, and may take minutes.
        if len(words) != 1 or not words[0].isdecimal() or len(words[0]) > 9:
            raise self._error(
                number,
                f"{show(' '.join(words))} where the number of image points of {photo} is expected",
            )
        self.next += 1
        return number, int(words[0])

    def _image_point(self, photo: _Row, count_source: str, read_count: int) -> _Row:
        if not self._has_more():
            raise self._error(
                self.lines[-1][0],
                f"the file ends after {count(read_count, 'image point')}; {count_source}",
            )
        number, words = self.lines[self.next]
        if len(words) != 5:
            raise self._error(
                number,
                f"{count(len(words), 'value')} where an image point (id, x, y, σx, σy) is "
                f"expected; {count_source}, this is number {read_count + 1}",
            )
        return self._row(words[0], words[1:], IMAGE_POINT, photo.id)

    def _row(self, id: str, words: Sequence[str], names: tuple[str, ...], photo: str = "") -> _Row:
        number = self.lines[self.next][0]
        self.next += 1
        row = _Row(number, id, names, (), photo)
        labels = (*names, *(f"σ of {name}" for name in names))
        values = [
            self._number(number, f"{label} of {row}", word, finite=k < len(names))
            for k, (label, word) in enumerate(zip(labels, words))
        ]
        return dataclasses.replace(row, values=tuple(values))

    def _number(self, line: int, name: str, word: str, finite: bool = True) -> float:
        try:
            number = float(word)
        except ValueError:
            number = None
        # float() reads 1_0 as ten
        if number is None or "_" in word or (finite and not math.isfinite(number)):
            raise self._error(line, f"{name} is {word!r}; expected a number")
        return number

    def _has_more(self) -> bool:
        return self.next < len(self.lines)

    def _error(self, line: int, message: str) -> InputError:
        return InputError(f"{self.path}, line {line}: {message}")
