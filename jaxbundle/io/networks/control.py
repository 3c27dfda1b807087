"""Control points from a separate table, for a network in any format.

The table has a header with `id`, `X`, `Y`, `Z` and, if wanted, `sX`, `sY`, `sZ`, `role` (a column
`name` is not used), or no header and 4 or 7 columns in this order. Its columns are separated by
commas, semicolons, tabs or blanks; decimals may have a comma if commas do not separate. Without
a role its points are control points, those without σ held.

The table replaces the control of the input: control and fixed points missing from the table
become tie points. If the start values of the input are in another frame (PhotoModeler shifts
them), a similarity through the common points transforms images and points into that of the
table; observed positions of antennas that are not in it are then left out.
"""

import csv
import dataclasses
import math
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from jaxbundle.arguments import show
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.io.networks.poses import angles_of, matrices_of
from jaxbundle.io.text.csv_tables import read_text
from jaxbundle.io.text.rows import is_number
from jaxbundle.network.build import POINT_ERRORS, POINT_SIGMAS
from jaxbundle.network.columns import Columns, count, did_you_mean, list_some
from jaxbundle.network.kinds import Antennas
from jaxbundle.network.kinds.base import rows_of
from jaxbundle.network.rules import AXES, check_choice, check_unique
from jaxbundle.network.tables import ROLES, Images, Network, Points, Source
from jaxbundle.network.unit_mistakes import name_degrees
from jaxbundle.orientation.alignment import similarity
from jaxbundle.orientation.network import find_start_values

# The columns of a table without a header, the last three only together.
BARE_COLUMNS = ("id", *AXES, *POINT_SIGMAS)
NAMES = {name.lower(): name for name in (*BARE_COLUMNS, "role", "name", *POINT_ERRORS)}
# A selection of check points, such as `every 3rd`.
EVERY = re.compile(r"every[ -]?(\d+)(st|nd|rd|th)?$", re.IGNORECASE)


@dataclasses.dataclass(frozen=True)
class ControlFrameSettings:
    """When start values are taken to be in another frame than the control.

    `max_offset`: median distance between control and start values, relative to the extent of the
    control, up to which both are in one frame. Start values in the frame of the control are off by
    their own errors, those of another frame by the extent and more: between is nothing.

    `max_misfit`: median residual of the similarity between both, relative to the RMS distance of
    the control from its mean, above which it is none: of points in random order it is about 1, of
    start values that are good for anything some hundredths. Images so far from their
    antennas, but nearer before the similarity, leave them in another frame than the control.

    `thousand_tolerance`: how near to 1000 or 1/1000, relative, the scale of the similarity must be
    for a warning about mm and m: a scale in an arbitrary unit is within 1 % by chance once in some
    hundred networks.
    """

    max_offset: float = 0.01
    max_misfit: float = 0.3
    thousand_tolerance: float = 0.01


FRAME_SETTINGS = ControlFrameSettings()


def read_control(path: str | Path) -> Points:
    """The points of a control table.

    **Raises:** `InputError` naming file, line and column.
    """
    path = Path(path)
    lines = [
        (number, line)
        for number, line in enumerate(re.split(r"\r\n?|\n", read_text(path, "latin-1")), 1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not lines:
        raise InputError(
            f"{path}: the file is empty; expected rows of {', '.join(BARE_COLUMNS[:4])}"
        )
    separator = _separator(lines[0][1])
    try:
        rows = [_cells(line, separator) for _, line in lines]
    except csv.Error as error:
        raise InputError(f"{path}: not a table: {error}") from None
    header = _header(path, lines[0][0], rows[0])
    if header is not None:
        lines, rows = lines[1:], rows[1:]
    elif len(rows[0]) not in (4, 7):
        raise InputError(
            f"{path}, line {lines[0][0]}: {len(rows[0])} columns without a header; "
            f"expected {', '.join(BARE_COLUMNS[:4])}, or these and {', '.join(POINT_SIGMAS)}"
            f"{_split_name(rows[0], separator)}"
        )
    header = header or BARE_COLUMNS[: len(rows[0])]
    for (number, _), row in zip(lines, rows):
        if len(row) != len(header):
            raise InputError(
                f"{path}, line {number}: {len(row)} cells where {len(header)} are expected "
                f"({', '.join(header)}){_split_name(row, separator)}"
            )
    source = Source(str(path), np.array([number for number, _ in lines]), "line")
    columns = dict(zip(header, zip(*rows))) if rows else {name: () for name in header}
    # Then a comma is the decimal sign; ids and names keep theirs.
    if separator != ",":
        columns = {
            name: column
            if name in ("id", "role", "name")
            else [cell.replace(",", ".") for cell in column]
            for name, column in columns.items()
        }
    return _points(Columns(columns, source))


def _separator(line: str) -> str | None:
    """The separator of the columns: a comma unless it is a decimal comma between blanks."""
    separator = next((s for s in (";", "\t", ",") if s in line), None)
    cells = line.split(",")
    # `North corner, 1.0, 2.0, 3.0`: a blank within an id.
    is_row = len(cells) in (4, len(BARE_COLUMNS)) and all(map(is_number, cells[1:]))
    decimal = separator == "," and not is_row and any(len(cell.split()) > 1 for cell in cells)
    return None if decimal else separator


def _cells(line: str, separator: str | None) -> list[str]:
    if separator is None:
        return line.split()
    (row,) = csv.reader([line], delimiter=separator, skipinitialspace=True, strict=True)
    return [cell.strip() for cell in row]


def _split_name(row: list[str], separator: str | None) -> str:
    """A hint that a name with a blank fills two columns."""
    if separator is not None or len(row) < 5:
        return ""
    return (
        f"; is {' '.join(row[:2])!r} one name? Here blanks separate columns: write it without, or "
        "separate the columns by commas"
    )


def _header(path: Path, number: int, cells: list[str]) -> list[str] | None:
    """The names of the columns; None if the first line is not a header."""
    if not {"x", "y", "z"} <= {cell.lower() for cell in cells}:
        return None
    # Other programs call a σ by these names.
    names = [re.sub("^(σ|sigma_?|std_?)", "s", cell.lower()) for cell in cells]
    for name, cell in zip(names, cells):
        if name not in NAMES:
            raise InputError(
                f"{path}, line {number}: unknown column {cell!r}"
                f"{did_you_mean(cell, NAMES.values())}"
            )
        if names.count(name) > 1:
            raise InputError(f"{path}, line {number}: the column {cell!r} occurs twice")
    if "id" not in names:
        raise InputError(f"{path}, line {number}: the column 'id' is missing")
    return [NAMES[name] for name in names]


def _points(table: Columns) -> Points:
    if not len(table):
        raise InputError(f"{table.source.name}: the table is empty; give at least one row")
    ids = table.ids("id")
    check_unique(ids, table.source, "point")
    roles = ("control",) * len(ids)
    if "role" in table.values:
        roles = tuple(role.strip() or "control" for role in table.values["role"])
    for row, role in enumerate(roles):
        check_choice("role", role, ROLES, f"{table.source(row)}: ")
    position = np.stack([table.numbers(axis, required=True) for axis in AXES], 1)
    words = {"free": math.inf}
    sigma = np.stack([table.numbers(name, words=words) for name in POINT_SIGMAS], 1)
    for row, axis in np.argwhere(~(sigma > 0) & ~np.isnan(sigma))[:1]:
        raise InputError(
            f"{table.source(row)}: {POINT_SIGMAS[axis]} is {show(sigma[row, axis])}; expected a "
            "positive number, or nothing for a point that is held"
        )
    return Points(ids, roles, position, sigma, table.source)


def select_checks(points: Points, selection: Sequence[str]) -> Points:
    """Points with some of the control and fixed ones as check points.

    **Arguments:** `selection`: names, several with commas, or `every 3rd` (of the control points in
    the order of the table the second, fifth, …).

    **Raises:** `InputError` for a name that is not a control point, or if no control is left."""
    rows = np.flatnonzero(points.has_role("control", "fixed", "check"))
    control_ids = [points.id[k] for k in rows]
    check_ids: set[str] = set()
    for text in selection:
        every_match = EVERY.match(text.strip())
        if every_match and (step := int(every_match[1])) > 1:
            check_ids |= {*control_ids[step // 2 :: step]}
            continue
        for name in [text] if text in control_ids else [part.strip() for part in text.split(",")]:
            if name not in control_ids:
                raise InputError(
                    f"--check {name}: expected a control point of {points.source.name}, or every "
                    f"3rd{did_you_mean(name, control_ids)}"
                )
            check_ids.add(name)
    roles = tuple("check" if id in check_ids else role for id, role in zip(points.id, points.role))
    if check_ids and not {"control", "fixed"} & set(roles):
        raise InputError(
            f"--check: all {len(control_ids)} control points are check points; none is left"
        )
    return dataclasses.replace(points, role=roles)


def with_control(
    network: Network,
    control: Points,
    datum: bool = True,
    settings: ControlFrameSettings = FRAME_SETTINGS,
) -> Network:
    """A network with the control of a table.

    **Arguments:** `datum` whether control becomes the datum; `settings`: when the network is
    transformed into the frame of the control.

    **Raises:** `InputError` if no point of the network is in the table.
    """
    index = {id: k for k, id in enumerate(network.points.id)}
    rows = [k for k, id in enumerate(control.id) if id in index]
    point_rows = np.array([index[control.id[k]] for k in rows], np.int64)
    if not rows:
        raise InputError(
            f"{control.source.name}: none of its {len(control)} points is one of the network; it "
            f"has {list_some(network.points.id)}"
        )
    if degrees := name_degrees(control):
        raise InputError(f"{control.source.name}: {degrees}")
    network = _transform_into_frame(network, point_rows, control.take(np.array(rows)), settings)
    points = network.points
    in_table = np.zeros(len(points), bool)
    in_table[point_rows] = True
    dropped = [
        id
        for id, role, is_listed in zip(points.id, points.role, in_table)
        if role in ("control", "fixed") and not is_listed
    ]
    roles = np.array(points.role, dtype=object)
    roles[points.has_role("control", "fixed") & ~in_table] = "tie"
    roles[point_rows] = [control.role[k] for k in rows]
    position, sigma = points.position.copy(), points.sigma.copy()
    sigma[roles == "tie"] = np.nan
    position[point_rows], sigma[point_rows] = control.position[rows], control.sigma[rows]
    changed = {"datum": "control"} if datum and set(roles) & {"control", "fixed"} else {}
    network = network.replace(
        points=dataclasses.replace(
            points, role=tuple(roles.tolist()), position=position, sigma=sigma
        ),
        **changed,
    )
    unseen_ids = [id for id in control.id if id not in index]
    warnings, notes = [], []
    if dropped:
        dropped_count = count(len(dropped), "control point")
        warnings.append(
            f"{dropped_count} of the input not in {control.source.name} became tie points: "
            f"{list_some(dropped)}"
        )
    if unseen_ids:
        notes.append(
            f"{control.source.name}: no photograph shows the points {list_some(unseen_ids)}"
        )
    return network.warn(*warnings).note(*notes)


def _transform_into_frame(
    network: Network,
    point_rows: Int[np.ndarray, " n"],
    control: Points,
    settings: ControlFrameSettings,
) -> Network:
    """The network with start values transformed so that its points in `point_rows` are at the
    control points.

    **Raises:** `InputError` if they fit no similarity."""
    images, points, target = network.images, network.points, control.position
    # Observed orientations are in the frame of the control already; without orientations there is
    # nothing to transform.
    if np.isfinite(images.sigma).any() or not np.isfinite(images.position).any():
        return network
    source = points.position[point_rows]
    if np.isnan(source).any():
        source = _intersect_points(network, point_rows)
    is_known = np.isfinite(source).all(1)
    source, target = source[is_known], target[is_known]
    # Seven parameters of a similarity: three points give nine coordinates.
    transformation = similarity(source, target) if len(source) >= 3 else None
    extent = np.ptp(target, axis=0).max() if len(target) else 0.0
    if transformation is None:
        return network
    # The median, here and below: some control points may be misnamed.
    if np.median(np.linalg.norm(source - target, axis=1)) <= settings.max_offset * extent:
        return network
    A, t = transformation
    deviations = np.linalg.norm(source @ A.T + t - target, axis=1)
    _check_similarity(
        deviations, control.take(np.flatnonzero(is_known)), settings.max_misfit, network.object_unit
    )
    scale = float(np.cbrt(np.linalg.det(A)))  # A = scale·R, det R = 1
    if abs(abs(np.log(scale)) - np.log(1000)) < np.log(1 + settings.thousand_tolerance):
        times = "a thousand times" if scale > 1 else "a thousandth"
        network = network.warn(
            f"the control of {control.source.name} is {times} "
            "as large as the start values: is one of them in mm, the other in m? The result is in "
            "the unit of the control"
        )
    # X' = scale·R·X + t   ⇒   M·(X − X0) ∝ M·Rᵀ·(X' − X0')
    M = matrices_of(images.angles) @ (A / scale).T
    position = points.position @ A.T + t
    # Of check points; NaN and infinity, of an axis, become those of the point.
    with np.errstate(invalid="ignore"):
        sigma = np.sqrt(np.square(points.sigma) @ np.square(A).T)
    new_images = Images(
        images.id,
        images.camera,
        images.position @ A.T + t,
        angles_of(M),
        images.sigma,
        images.source,
    )
    further = []
    for kind in network.further:
        if isinstance(kind, Antennas) and _stay_behind(
            kind, images, new_images, target, settings.max_misfit
        ):
            network = network.warn(
                f"left out {count(len(kind.image), 'observed position')} of antennas (GNSS) of the "
                f"input: they are in its frame, and the control of {control.source.name} is in "
                "another"
            )
        else:
            further.append(kind)
    return network.replace(
        images=new_images,
        points=dataclasses.replace(points, position=position, sigma=sigma),
        further=tuple(further),
    ).note(
        "the start values of the input are in another frame than the control: a similarity by "
        f"{count(len(source), 'point')} was applied (scale {scale:.6g})"
    )


def _check_similarity(
    deviations: Float[np.ndarray, " n"], control: Points, max_misfit: float, unit: str
) -> None:
    """Refuse control that deviates from the similarity by more than `max_misfit` of its spread: the
    network would not be in its frame."""
    rms_radius = _rms_radius(control.position)
    if np.median(deviations) > max_misfit * rms_radius:
        largest = (f"{control.id[k]!r} by {deviations[k]:.3g}" for k in np.argsort(-deviations))
        raise InputError(
            f"{control.source.name}: the control fits no similarity of the start values of the "
            f"input: its {count(len(deviations), 'point')} are within {rms_radius:.3g} {unit} of "
            f"their mean and {np.median(deviations):.3g} off (median), most of all "
            f"{list_some(largest, 3, str)}; check names and units of the table, or leave out the "
            "start values of the input"
        )


def _stay_behind(
    antennas: Antennas,
    images: Images,
    new_images: Images,
    control: Float[np.ndarray, "n 3"],
    max_misfit: float,
) -> bool:
    """Whether antennas are nearer to the images than to those transformed, and far from these: in
    the frame of the input; far: by more than `max_misfit` of the spread of the antennas or of the
    control, the larger one."""
    limit = max_misfit * max(_rms_radius(antennas.position), _rms_radius(control))
    rows = rows_of(antennas.image, images)
    old, new = (
        np.nanmedian(np.linalg.norm(antennas.position - table.position[rows], axis=1))
        for table in (images, new_images)
    )
    return bool(old < new > limit)


def _rms_radius(X: Float[np.ndarray, "n 3"]) -> float:
    """The RMS distance of points from their mean."""
    return float(np.sqrt(np.square(X - X.mean(0)).sum(1).mean()))


def _intersect_points(
    network: Network, point_rows: Int[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3"]:
    """The coordinates of points by the orientations of the input; NaN if there are none."""
    points = network.points
    roles = np.array(points.role, dtype=object)
    position, no_sigma = points.position.copy(), np.full_like(points.sigma, np.nan)
    roles[points.has_role("control", "fixed")], position[point_rows] = "tie", np.nan
    roles[point_rows] = "tie"
    start = network.replace(
        points=dataclasses.replace(
            points, role=tuple(roles.tolist()), position=position, sigma=no_sigma
        ),
        datum="inner",
        datum_points=(),
    )
    try:
        intersected = find_start_values(start).network.points
    except (InputError, NotSolvedError):
        return position[point_rows]
    position_of = dict(zip(intersected.id, intersected.position))
    unknown_position = np.full(3, np.nan)
    return np.array([position_of.get(points.id[k], unknown_position) for k in point_rows])
