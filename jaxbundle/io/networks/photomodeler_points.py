"""Points and image points of a PhotoModeler export, and the ids of its smart points.

Points found by matching ("smart points") have a separate id sequence. It may include ids
of points marked by hand: then an id is in the list of object points twice, first for
the point marked by hand, and image points of both have it. Those of smart points have σ 0. If
both kinds have an id, the smart point gets another. An id of both that is listed once belongs to
the smart point if it comes after another smart point or, if this does not decide, after the first
descent of the ids.

Source: exported files; the same convention in the Damped Bundle Adjustment Toolbox (Börlin and
Grussenmeyer 2013).
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxbundle.errors import InputError
from jaxbundle.io.networks.assemble import PIXEL_CENTRE
from jaxbundle.network.columns import Columns, count, list_some
from jaxbundle.network.tables import Source


@dataclasses.dataclass
class PhotoModelerBlock:
    """Rows of a block: ids, numbers, lines, and for image points the photograph's number."""

    id: list[str]
    values: Float[np.ndarray, "rows n"]
    line: list[int]
    photo: list[int] = dataclasses.field(default_factory=list)

    def __len__(self) -> int:
        return len(self.id)


def renumber_smart(path: Path, objects: PhotoModelerBlock, marks: PhotoModelerBlock) -> str:
    """Give smart points with the id of another point new ids, in place.

    **Returns:** a message about renumbered points; empty if none was.

    **Raises:** `InputError` for an id that is in the object points three times, or once and
    cannot be assigned to one of its two points.
    """
    is_smart = (marks.values[:, 2:] == 0).all(1)
    smart_ids = {id for id, s in zip(marks.id, is_smart) if s}
    manual_ids = {id for id, s in zip(marks.id, is_smart) if not s}
    rows_by_id: dict[str, list[int]] = {}
    for k, id in enumerate(objects.id):
        rows_by_id.setdefault(id, []).append(k)
    repeated_ids = smart_ids & (
        manual_ids | {id for id, rows in rows_by_id.items() if len(rows) > 1}
    )
    if not repeated_ids:
        return ""
    id_offset = 10 ** max(len(id) for id in (*objects.id, *marks.id))  # above every id
    new_ids = {id: str(id_offset + int(id)) for id in sorted(repeated_ids, key=int)}
    for k in _find_smart_rows(path, objects, rows_by_id, repeated_ids, smart_ids, manual_ids):
        objects.id[k] = new_ids[objects.id[k]]
    marks.id[:] = [new_ids.get(id, id) if s else id for id, s in zip(marks.id, is_smart)]
    return (
        f"{count(len(new_ids), 'smart point')} had the id of another point and "
        f"{'was' if len(new_ids) == 1 else 'were'} renumbered: "
        f"{list_some((f'{id} is {new}' for id, new in new_ids.items()), 3, str)}"
    )


def _find_smart_rows(
    path: Path,
    objects: PhotoModelerBlock,
    rows_by_id: Mapping[str, Sequence[int]],
    repeated_ids: set[str],
    smart_ids: set[str],
    manual_ids: set[str],
) -> list[int]:
    """The rows of smart points among the object points with a repeated id: the second of two; of
    one, by the neighbouring rows."""
    listed_twice = {
        id: rows for id, rows in rows_by_id.items() if id in repeated_ids and len(rows) > 1
    }
    for id, rows in listed_twice.items():
        if len(rows) > 2:
            raise InputError(
                f"{path}, line {objects.line[rows[2]]}: point {id!r} is in the object points "
                f"{len(rows)} times; at most a point marked by hand and a smart point have the "
                "same id"
            )
    single_rows = [
        rows[0] for id, rows in rows_by_id.items() if id in repeated_ids and len(rows) == 1
    ]
    rows_of = lambda ids: [k for id in ids for k in rows_by_id.get(id, ())]
    first_smart = min(
        [rows[1] for rows in listed_twice.values()]
        + rows_of(smart_ids - manual_ids - repeated_ids),
        default=len(objects),
    )
    last_manual = max(
        [rows[0] for rows in listed_twice.values()] + rows_of(manual_ids - smart_ids), default=-1
    )
    # The list has the points marked by hand, ids ascending, then the smart points, ids ascending
    # again: where they descend the first time, the second part begins.
    numbers = [int(id) for id in objects.id]
    descent = next(
        (
            k
            for k in range(max(last_manual, 0) + 1, min(first_smart + 1, len(objects)))
            if numbers[k] < numbers[k - 1]
        ),
        None,
    )
    smart_rows = [rows[1] for rows in listed_twice.values()]
    for k in single_rows:
        is_after, is_before = k > first_smart, k < last_manual
        if is_after == is_before and (is_after or descent is None):
            raise InputError(
                f"{path}, line {objects.line[k]}: point {objects.id[k]!r} has image points of a "
                "point marked by hand and of a smart point (σ 0), but is in the object points "
                "only once, and it is unclear for which; give one of the two another id"
            )
        if is_after or (not is_before and descent is not None and k >= descent):
            smart_rows.append(k)
    return smart_rows


def point_table(
    path: Path, control: PhotoModelerBlock, objects: PhotoModelerBlock, marked_ids: list[str]
) -> Columns:
    """Control points as given, then the other object points, then points marked in
    photographs without coordinates."""
    control_ids = set(control.id)
    other_rows = [k for k, id in enumerate(objects.id) if id not in control_ids]
    known_ids = control_ids | set(objects.id)
    unlisted_ids = [id for id in dict.fromkeys(marked_ids) if id not in known_ids]
    weighted = np.all(control.values[:, 3:] > 0, axis=1)
    empty_rows = np.full((len(other_rows) + len(unlisted_ids), 3), np.nan)
    position = np.concatenate(
        [control.values[:, :3], objects.values[other_rows, :3], empty_rows[len(other_rows) :]]
    )
    sigma = np.concatenate([np.where(weighted[:, None], control.values[:, 3:], np.nan), empty_rows])
    lines = [*control.line, *(objects.line[k] for k in other_rows), *[0] * len(unlisted_ids)]
    columns = {
        "id": [*control.id, *(objects.id[k] for k in other_rows), *unlisted_ids],
        "role": [*np.where(weighted, "control", "fixed").tolist(), *["tie"] * len(empty_rows)],
        **dict(zip("XYZ", position.T)),
        **dict(zip(("sX", "sY", "sZ"), sigma.T)),
    }
    return Columns(columns, Source(str(path), np.array(lines, np.int64), "line"))


def ray_table(path: Path, marks: PhotoModelerBlock, names: dict[int, str]) -> Columns:
    """The image points, from the centre of the first pixel; σ 0 becomes the default."""
    if not len(marks):
        raise InputError(f"{path}: there are no image points")
    values = marks.values
    sigma = np.where(values[:, 2:] > 0, values[:, 2:], np.nan)
    return Columns(
        {
            "image": [names[photo] for photo in marks.photo],
            "point": marks.id,
            "x": values[:, 0] - PIXEL_CENTRE,
            "y": values[:, 1] - PIXEL_CENTRE,
            "sx": sigma[:, 0],
            "sy": sigma[:, 1],
        },
        Source(str(path), np.array(marks.line), "line"),
    )
