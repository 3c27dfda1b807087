"""Positions in a line scanner image: from a table, or a grid over it."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxbundle.cli.pushbroom.shared import warn
from jaxbundle.errors import InputError
from jaxbundle.io.text.csv_tables import read_csv
from jaxbundle.network.tables import Source
from jaxbundle.pushbroom.image import PushbroomImage

OFF_IMAGE = "off the image"
OUTPUT_COLUMNS = ("id", "X", "Y", "Z", "longitude", "latitude", "height", "count", "status")
"""Further columns written by `locate` and `project`: their tables are accepted as input."""


def places(
    image: PushbroomImage, points: Path | None, grid: str
) -> tuple[Sequence[str], np.ndarray, np.ndarray, Source]:
    """Ids, lines, pixels and their source: a table, or a grid over the image.

    **Raises:** `InputError`.
    """
    if points is None:
        rows, columns = grid_of(grid)
        lines = np.repeat(np.linspace(0, image.lines - 1, rows), columns)
        pixels = np.tile(np.linspace(0, image.pixels - 1, columns), rows)
        return (), lines, pixels, Source("grid", None, "place")
    table = read_csv(points)
    table.check_names(("line", "pixel"), OUTPUT_COLUMNS)
    line, pixel = (table.numbers(name, required=True) for name in ("line", "pixel"))
    ids = table.ids("id") if "id" in table.values else ()
    return ids, line, pixel, table.source


def grid_of(grid: str) -> tuple[int, int]:
    """The two numbers of LINESxPIXELS.

    **Raises:** `InputError`.
    """
    try:
        rows, columns = (int(n) for n in grid.lower().split("x"))
        if min(rows, columns) < 1:
            raise ValueError
    except ValueError:
        raise InputError(f"--grid {grid!r}: two numbers are expected, such as 11x11") from None
    return rows, columns


def off_image(
    image: PushbroomImage, line: np.ndarray, pixel: np.ndarray, source: Source
) -> np.ndarray:
    """Which positions are outside the image; reported, and refused if all are.

    **Raises:** `InputError`.
    """
    off = np.zeros(len(line), bool)
    said = None
    for name, values, size in (("line", line, image.lines), ("pixel", pixel, image.pixels)):
        outside = ~((values >= -0.5) & (values <= size - 0.5))
        if outside.any() and said is None:
            row = int(outside.argmax())
            said = (
                f"{source(row)}: {name} {values[row]:g} is {OFF_IMAGE}, which has {size}; -0.5 to "
                f"{size - 0.5:g} is expected"
            )
        off |= outside
    if said is not None:
        said += f" ({off.sum()} of {len(off)} points)"
        if off.all():
            raise InputError(said)
        warn(said)
    return off
