"""Points and measurements of ISIS: control networks as text, and the residuals of jigsaw.

A control network (`cnetbin2pvl` writes it of a binary one) is PVL:

    Object = ControlNetwork
      Object = ControlPoint
        PointType = Constrained                 Free (Tie), Fixed (Ground)
        PointId   = …
        AprioriX  = 1485514.8 <meters>          AprioriY, AprioriZ; AdjustedX, …
        AprioriCovarianceMatrix = (XX, XY, XZ, YY, YZ, ZZ)         m²
        Group = ControlMeasure
          SerialNumber = Odyssey/THEMIS_IR/698683699.000
          Sample = 281.08
          Line   = 11156.10
          SampleSigma, LineSigma, SampleResidual, LineResidual, Ignore, JigsawRejected
        End_Group
      End_Object
    End_Object

`residuals.csv` of jigsaw has three lines of head; then point, file, serial number, x, y (mm),
sample, line, their residuals, the length of these (pixels), and * where jigsaw rejected it.

Samples and lines are 1 at the centre of the first pixel. Points are in the frame of the body.
Source: ISIS, ControlPointV0005.cpp and BundleSolutionInfo.cpp.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxbundle.arguments import show
from jaxbundle.errors import InputError
from jaxbundle.io.scanner.pvl import without_comments
from jaxbundle.io.text.csv_tables import read_text
from jaxbundle.io.text.xml_fields import number_in
from jaxbundle.network.columns import count
from jaxbundle.system.file_content import ENDS_EARLY, beginning

# The beginning of jigsaw's residuals, and their fields; a measure it rejected has one more, "*".
RESIDUALS_HEAD = ",,,x image,y image,"
FIELDS = ("point", "file", "serial", "x", "y", "sample", "line", "dx", "dy", "length")
# Measures that are not used, by their keyword.
LEFT_OUT = {"IGNORE": "ignored", "JIGSAWREJECTED": "rejected by jigsaw"}
ROLES = {
    "free": "tie",
    "tie": "tie",
    "fixed": "control",
    "ground": "control",
    "constrained": "control",
}
METRES = {"": 1.0, "m": 1.0, "meters": 1.0, "km": 1000.0, "kilometers": 1000.0}


class IsisPoints(NamedTuple):
    """Points: ids, roles, X, Y, Z (metres, NaN unknown), their covariance (0: fixed), the line of
    each; measurements: the names by which the image is known, point, line and pixel, σ of these
    (NaN: not stated), the line of each; messages."""

    id: list[str]
    role: list[str]
    X: Float[np.ndarray, "points 3"]
    covariance: Float[np.ndarray, "points 3 3"]
    row: Int[np.ndarray, " points"]
    image: list[tuple[str, ...]]
    point: Int[np.ndarray, " rays"]
    xy: Float[np.ndarray, "rays 2"]
    xy_sigma: Float[np.ndarray, "rays 2"]
    ray_row: Int[np.ndarray, " rays"]
    messages: tuple[str, ...]


def is_jigsaw_residuals(path: Path) -> bool:
    """Whether a file begins as the residuals of jigsaw."""
    return beginning(path, len(RESIDUALS_HEAD)).lower() == RESIDUALS_HEAD.lower().encode()


class _Entry(NamedTuple):
    """A statement: upper-case name, value, line."""

    name: str
    value: str
    line: int


def read_control_network(path: str | Path) -> IsisPoints:
    """The points and measurements of a control network in PVL. Those to be ignored, and those that
    jigsaw has rejected, are left out with a message.

    **Raises:** `InputError` naming file and line; for a binary network.
    """
    path = Path(path)
    if b"ProtoBuffer" in beginning(path, 2000):
        raise InputError(
            f"{path}: a binary control network; make text of it (ISIS: cnetbin2pvl "
            f"from={path.name} to=network.pvl) and give that"
        )
    points: list[tuple] = []
    rays: list[tuple] = []
    left_out = {"ignored": 0, "rejected by jigsaw": 0}
    residuals = []
    first_lines: dict[str, int] = {}
    for fields, measures in _points_of(path):
        if _is_true(fields, "IGNORE"):
            left_out["ignored"] += len(measures)
            continue
        point = _point(path, fields)
        if point[0] in first_lines:
            raise InputError(
                f"{path}, line {point[4]}: point {point[0]!r} occurs twice, also in line "
                f"{first_lines[point[0]]}"
            )
        first_lines[point[0]] = point[4]
        for measure in measures:
            reason = next(
                (words for key, words in LEFT_OUT.items() if _is_true(measure, key)), None
            )
            if reason is not None:
                left_out[reason] += 1
                continue
            rays.append((len(points), *_measure(path, measure)))
            residuals.append([_number(path, measure, f"{k}RESIDUAL") for k in ("LINE", "SAMPLE")])
        points.append(point)
    if not points:
        raise InputError(f"{path}: no control point; expected Object = ControlPoint in it")
    messages = [
        f"{path}: {count(n, 'measurement')} {why}, left out" for why, n in left_out.items() if n
    ]
    messages += _describe_residuals(path, np.array(residuals).reshape(-1, 2))
    return _gather(points, rays, messages)


def read_jigsaw_residuals(path: str | Path) -> IsisPoints:
    """The measurements of jigsaw's residuals, all of tie points; those that it has rejected are
    left out with a message.

    **Raises:** `InputError` naming file and line.
    """
    path, points, rays, residuals, rejected_count = Path(path), {}, [], [], 0
    for number, text in enumerate(read_text(path).splitlines(), 1):
        # Three lines of head.
        if number <= 3 or not text.strip():
            continue
        fields, where = [field.strip() for field in text.split(",")], f"{path}, line {number}"
        if not 0 <= len(fields) - len(FIELDS) <= 1:
            raise InputError(f"{where}: {len(fields)} fields; expected {', '.join(FIELDS)}")
        if fields[len(FIELDS) :] == ["*"]:
            rejected_count += 1
            continue
        sample, line, dx, dy = (number_in(word, where) for word in fields[5:9])
        point = points.setdefault(fields[0], (len(points), number))[0]
        names = (Path(fields[1]).stem, fields[2])
        rays.append((point, names, (line - 1, sample - 1), (np.nan, np.nan), number))
        residuals.append((dy, dx))
    if not rays:
        raise InputError(
            f"{path}: no measurement; expected one per line, after three lines of head"
        )
    messages = [f"{path}: {count(rejected_count, 'measurement')} rejected by jigsaw, left out"]
    messages = (messages if rejected_count else []) + _describe_residuals(path, np.array(residuals))
    unknown = (np.full(3, np.nan), np.zeros((3, 3)))
    return _gather([(id, "tie", *unknown, row) for id, (_, row) in points.items()], rays, messages)


def _gather(points: list[tuple], rays: list[tuple], messages: list[str]) -> IsisPoints:
    id, role, X, covariance, row = zip(*points)
    point, image, xy, sigma, ray_row = zip(*rays) if rays else ((), (), (), (), ())
    return IsisPoints(
        list(id),
        list(role),
        np.array(X, float),
        np.array(covariance, float),
        np.array(row, int),
        list(image),
        np.array(point, int),
        np.array(xy, float).reshape(-1, 2),
        np.array(sigma, float).reshape(-1, 2),
        np.array(ray_row, int),
        tuple(messages),
    )


def _describe_residuals(path: Path, residuals: Float[np.ndarray, "n 2"]) -> list[str]:
    """What the file says of its own adjustment: the RMS of its residuals."""
    finite = residuals[np.isfinite(residuals).all(1)]
    if not len(finite):
        return []
    line, sample = np.sqrt(np.mean(finite**2, axis=0))
    return [
        f"{path}: residuals of jigsaw in {count(len(finite), 'measurement')}: RMS {line:.3g} "
        f"lines, {sample:.3g} samples"
    ]


Fields = dict[str, _Entry]


def _points_of(path: Path) -> Iterator[tuple[Fields, list[Fields]]]:
    """The fields of every point, and those of its measurements."""
    blocks: list[tuple[str, str]] = []
    fields: Fields = {}
    measures: list[Fields] = []
    version = 5.0
    for entry in _statements(path):
        where = f"{path}, line {entry.line}"
        if entry.name in ("OBJECT", "GROUP"):
            blocks.append((entry.name, entry.value.upper()))
            if blocks[-1][1] == "CONTROLPOINT":
                fields, measures = {}, []
                if version < 3:
                    raise InputError(
                        f"{path}: version {version:g} of control networks, of before 2012, has "
                        "other fields; write it again (ISIS: cnetbin2pvl)"
                    )
            elif blocks[-1][1] == "CONTROLMEASURE":
                measures.append({})
        elif entry.name in ("END_OBJECT", "END_GROUP"):
            kind = entry.name.removeprefix("END_")
            if not blocks or blocks[-1][0] != kind:
                raise InputError(f"{where}: {entry.name} without a beginning of this {kind}")
            if blocks.pop()[1] == "CONTROLPOINT":
                yield fields, measures
        elif entry.value.partition("<")[0].strip().upper() == "NULL":
            # A value that the network does not have, as if its line were missing.
            continue
        elif blocks and blocks[-1][1] == "CONTROLPOINT":
            fields[entry.name] = entry
        elif blocks and blocks[-1][1] == "CONTROLMEASURE":
            if not measures:
                raise InputError(f"{where}: a measure outside of a point")
            measures[-1][entry.name] = entry
        elif entry.name == "VERSION" and blocks == [("OBJECT", "CONTROLNETWORK")]:
            version = number_in(entry.value, where)
    if blocks:
        raise InputError(f"{path}: {blocks[-1][1]} is not closed{ENDS_EARLY}")


def _statements(path: Path) -> Iterator[_Entry]:
    """Names and values; lists in brackets and texts in quotes may have several lines."""
    open_entry: tuple[str, str, int] | None = None
    content = without_comments(read_text(path, fallback="latin-1"))
    for number, text in enumerate(content.splitlines(), 1):
        line = text.strip()
        if open_entry is not None:
            name, value, first_line = open_entry
            value = f"{value} {line}"
        else:
            if not line:
                continue
            if line.upper() == "END":
                return
            match = re.match(r"(\w+)\s*=\s*(.*)$", line)
            if match is None and line.upper() in ("END_OBJECT", "END_GROUP"):
                match = re.match(r"(\w+)(.*)$", line)
            if match is None:
                raise InputError(f"{path}, line {number}: {show(line[:60])}; expected NAME = value")
            name, value, first_line = match[1].upper(), match[2].strip(), number
        open_list = value.startswith("(") and ")" not in value
        open_text = value.count('"') % 2 == 1
        open_entry = (name, value, first_line) if open_list or open_text else None
        if open_entry is None:
            yield _Entry(name, value.strip('"') if value.startswith('"') else value, first_line)
    if open_entry is not None:
        raise InputError(f"{path}, line {open_entry[2]}: {open_entry[0]} is not closed{ENDS_EARLY}")


def _is_true(fields: Fields, name: str) -> bool:
    return name in fields and fields[name].value.lower() in ("true", "yes")


def _number(path: Path, fields: Fields, name: str) -> float:
    """A number without its unit; NaN if it is missing."""
    if name not in fields:
        return float("nan")
    entry = fields[name]
    return number_in(entry.value.partition("<")[0].strip(), f"{path}, line {entry.line}: {name}")


def _length(path: Path, fields: Fields, name: str) -> float:
    """Metres; NaN if missing."""
    value = _number(path, fields, name)
    if name in fields:
        unit = fields[name].value.partition("<")[2].rstrip("> ").lower()
        if unit not in METRES:
            line = fields[name].line
            raise InputError(f"{path}, line {line}: {name} in {show(unit)}; expected meters")
        value *= METRES[unit]
    return value


def _point(path: Path, fields: Fields) -> tuple[str, str, np.ndarray, np.ndarray, int]:
    """Id, role, place, covariance and line of a point."""
    if "POINTID" not in fields or "POINTTYPE" not in fields:
        line = min((entry.line for entry in fields.values()), default=0)
        raise InputError(f"{path}, line {line}: a control point without PointId or PointType")
    id, kind = fields["POINTID"], fields["POINTTYPE"]
    role = ROLES.get(kind.value.lower())
    if role is None:
        raise InputError(
            f"{path}, line {kind.line}: PointType {show(kind.value)}; expected Free, Fixed or "
            "Constrained"
        )
    X = np.full(3, np.nan)
    # What a network knew before it was adjusted is the observation.
    for source in ("APRIORI", "ADJUSTED"):
        if not np.isfinite(X).all():
            X = np.array([_length(path, fields, f"{source}{axis}") for axis in "XYZ"])
    C = np.zeros((3, 3))
    if role == "control":
        if not np.isfinite(X).all():
            raise InputError(
                f"{path}, line {id.line}: point {id.value!r} is {kind.value}, without AprioriX, "
                "AprioriY, AprioriZ"
            )
        if kind.value.lower() == "constrained":
            C = _covariance(path, fields, id)
    return id.value, role, X, C, id.line


def _covariance(path: Path, fields: Fields, id: _Entry) -> Float[np.ndarray, "3 3"]:
    """The covariance of a constrained point, m²."""
    entry = fields.get("APRIORICOVARIANCEMATRIX")
    if entry is None:
        raise InputError(
            f"{path}, line {id.line}: point {id.value!r} is Constrained, without "
            "AprioriCovarianceMatrix"
        )
    where = f"{path}, line {entry.line}: AprioriCovarianceMatrix"
    words = re.sub(r"<[^>]*>|[()]", " ", entry.value).replace(",", " ").split()
    if len(words) != 6:
        raise InputError(f"{where} has {len(words)} numbers; expected six of its upper triangle")
    C = np.zeros((3, 3))
    C[np.triu_indices(3)] = [number_in(word, where) for word in words]
    C = C + np.triu(C, 1).T
    smallest_eigenvalue = np.linalg.eigvalsh(C)[0]
    # Numbers written with nine digits leave this much of an eigenvalue that is 0.
    if smallest_eigenvalue < -1e-9 * np.trace(C):
        raise InputError(f"{where} is no covariance: it has a negative eigenvalue")
    # Below this eigenvalues are rounding: it would hold the point along an axis of chance.
    if smallest_eigenvalue <= 1e-14 * np.trace(C):
        raise InputError(
            f"{where} has no error in one direction; give σ above 0 for all, or make the point "
            "Fixed"
        )
    return C


def _measure(
    path: Path, fields: Fields
) -> tuple[tuple[str, ...], tuple[float, float], tuple[float, float], int]:
    """Serial number, line and pixel, their σ, the line of a measurement."""
    line = min((entry.line for entry in fields.values()), default=0)
    missing_names = [name for name in ("SERIALNUMBER", "SAMPLE", "LINE") if name not in fields]
    if missing_names:
        raise InputError(f"{path}, line {line}: a measure without {', '.join(missing_names)}")
    position = _number(path, fields, "LINE") - 1, _number(path, fields, "SAMPLE") - 1
    sigma = _number(path, fields, "LINESIGMA"), _number(path, fields, "SAMPLESIGMA")
    return (fields["SERIALNUMBER"].value,), position, sigma, fields["SERIALNUMBER"].line
