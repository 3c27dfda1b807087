"""Points and image points of a PhotoModeler export, and the ids of its smart points.

Points found by matching ("smart points") have an id sequence of their own. It may run through ids
of points that were marked by hand: then an id stands in the list of object points twice, once
before the smart points begin and once after it, and image points of both have it. Those of smart
points have σ 0. Where both kinds have an id, the smart point gets another.

Source: exported files; the same convention in the Damped Bundle Adjustment Toolbox (Börlin and
Grussenmeyer 2013).
"""

import dataclasses
from pathlib import Path

import numpy as np

from jaxbundle.errors import InputError
from jaxbundle.network.columns import Columns, count, some
from jaxbundle.network.tables import Source


@dataclasses.dataclass
class Block:
    """Rows of a block: ids, numbers, lines, and for image points the photograph's number."""

    id: list[str]
    values: np.ndarray
    line: list[int]
    photo: list[int] = dataclasses.field(default_factory=list)

    def __len__(self) -> int:
        return len(self.id)


def renumber_smart(objects: Block, marks: Block) -> str:
    """Give smart points that have the id of another point ids of their own, in place.

    **Returns:** what was renumbered, in words; empty if nothing was.
    """
    smart = (marks.values[:, 2:] == 0).all(1)
    of_smart = {id for id, s in zip(marks.id, smart) if s}
    of_others = {id for id, s in zip(marks.id, smart) if not s}
    seen: set[str] = set()
    listed_twice = {id for id in objects.id if id in seen or seen.add(id)}
    repeated = of_smart & (of_others | listed_twice)
    if not repeated:
        return ""
    above = 10 ** max(len(id) for id in (*objects.id, *marks.id))
    other = {id: str(above + int(id)) for id in repeated}
    numbers = np.array([int(id) for id in objects.id], float)
    begin = next(iter(np.flatnonzero(np.diff(numbers) < 0) + 1), len(objects))
    for k in range(begin, len(objects)):
        objects.id[k] = other.get(objects.id[k], objects.id[k])
    marks.id[:] = [other.get(id, id) if s else id for id, s in zip(marks.id, smart)]
    first = sorted(other, key=int)
    return (
        f"{count(len(first), 'smart point')} had the id of another point and "
        f"{'was' if len(first) == 1 else 'were'} renumbered: "
        f"{some((f'{id} is {other[id]}' for id in first), 3, str)}"
    )


def point_table(path: Path, control: Block, objects: Block, marked: list[str]) -> Columns:
    """Control points as given, then the object points that are none, then those marked in
    photographs that have no coordinates."""
    taken = set(control.id)
    other = [k for k, id in enumerate(objects.id) if id not in taken]
    known = taken | set(objects.id)
    lost = [id for id in dict.fromkeys(marked) if id not in known]
    weighted = (control.values[:, 3:] > 0).all(1)
    rest = np.full((len(other) + len(lost), 3), np.nan)
    position = np.concatenate(
        [control.values[:, :3], objects.values[other, :3], rest[len(other) :]]
    )
    sigma = np.concatenate([np.where(weighted[:, None], control.values[:, 3:], np.nan), rest])
    lines = [*control.line, *(objects.line[k] for k in other), *[0] * len(lost)]
    columns = {
        "id": [*control.id, *(objects.id[k] for k in other), *lost],
        "role": [*np.where(weighted, "control", "fixed").tolist(), *["tie"] * len(rest)],
        **dict(zip("XYZ", position.T)), **dict(zip(("sX", "sY", "sZ"), sigma.T)),
    }  # fmt: skip
    return Columns(columns, Source(str(path), np.array(lines, np.int64), "line"))


def ray_table(path: Path, marks: Block, names: dict[int, str]) -> Columns:
    """The image points, from the centre of the first pixel; σ 0 becomes the default."""
    if not len(marks):
        raise InputError(f"{path}: there are no image points")
    values = marks.values
    sigma = np.where(values[:, 2:] > 0, values[:, 2:], np.nan)
    return Columns(
        {"image": [names[photo] for photo in marks.photo], "point": marks.id,
         "x": values[:, 0] - 0.5, "y": values[:, 1] - 0.5, "sx": sigma[:, 0], "sy": sigma[:, 1]},
        Source(str(path), np.array(marks.line), "line"),
    )  # fmt: skip
