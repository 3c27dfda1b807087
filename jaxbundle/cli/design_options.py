"""The options of `jaxbundle design`."""

from pathlib import Path

import numpy as np

from jaxbundle.arguments import show
from jaxbundle.errors import InputError
from jaxbundle.io.text.csv_tables import read_csv
from jaxbundle.network.columns import Columns
from jaxbundle.network.tables import Network
from jaxbundle.network_design.conditions import Box


def parse_aim(words: list[str] | None):
    """The quantities of the aim.

    **Raises:** `InputError`.
    """
    if not words:
        return "points"
    if len(words) == 1 and ":" not in words[0]:
        return words[0]
    names = []
    for text in words:
        kind, _, unknown = text.partition(":")
        id, mark, name = unknown.rpartition(":")
        if not mark:
            raise InputError(
                f"--of {text!r}: expected points, cameras, or KIND:ID:NAME, such "
                "as camera:cam:c or point:7:Z"
            )
        names.append((kind, id, name))
    return tuple(names)


def box_of(option: str, text: str) -> Box | None:
    """The box of an option; None if it is not given.

    **Raises:** `InputError`.
    """
    if not text:
        return None
    a, b, c, d, e, f = _numbers(option, text, 6).tolist()
    return (a, b, c), (d, e, f)


def words_of(text: str) -> tuple[str, ...]:
    """Words separated by commas."""
    return tuple(word.strip() for word in text.split(",") if word.strip())


def _numbers(option: str, text: str, size: int) -> np.ndarray:
    """Numbers of an option, separated by commas.

    **Raises:** `InputError`."""
    try:
        numbers = np.array([float(word) for word in text.split(",")])
    except ValueError:
        numbers = np.zeros(0)
    if len(numbers) != size:
        raise InputError(f"{option} {text!r}: expected {size} numbers separated by commas")
    return numbers


def normals_of(text: str, network: Network):
    """The normal of all targets, or one per target from a table.

    **Raises:** `InputError`.
    """
    if not text:
        return None
    if not Path(text).is_file():
        return _numbers("--normals", text, 3)
    table: Columns = read_csv(Path(text))
    columns = ("id", "NX", "NY", "NZ")
    if set(table.values) != set(columns):
        raise InputError(
            f"{text}: expected the columns {', '.join(columns)}, but there are "
            f"{', '.join(table.values)}"
        )
    rows = dict(zip(table.values["id"], zip(*(table.values[name] for name in columns[1:]))))
    points = network.points
    # Check points take no part in a design.
    targets = [id for id, role in zip(points.id, points.role) if role != "check"]
    missing_ids = [id for id in targets if id not in rows]
    if missing_ids:
        raise InputError(
            f"{text}: there is no row for point {missing_ids[0]!r}; give the normal of every target"
        )
    try:
        return np.array([[float(x) for x in rows[id]] for id in targets])
    except ValueError as error:
        raise InputError(f"{text}: a normal is not a number: {show(str(error))}") from None
