"""Length measurement errors: VDI/VDE 2634 Part 1, with a verdict after ISO 14253-1.

Calibrated lengths that have no part in the adjustment are compared with those of its points, check
points among them. A length between two control points has a part: its ends are given, and it
measures nothing.

    E = L_measured − L_calibrated                         VDI/VDE 2634-1 (2002): Δl = l_m − l_k
    MPE = min(A + L/K, B)                                 ISO 10360-2 (2009), forms of an MPE

The characteristic is the largest |E| of all lengths, and every single one must keep the maximum
permissible error. The uncertainty u of a test value is that of the calibrated length (ISO/TS 23165
(2006)): errors of the measuring system are what is tested. By the decision rule of ISO 14253-1
(2017) an error conforms where it is proven to, with a conformance probability of at least 95 %:

    conformity:     |E| ≤ MPE − g        nonconformity:  |E| > MPE + g        g = z(95 %)·u

and neither is proven in between. z = 1.645 is that of a normal distribution about one limit. Simple
acceptance (g = 0) is the rule where both sides agreed to it.

VDI/VDE 2634-1 wants at least seven lines in the measuring volume with at least five lengths each,
the longest length of two thirds of the space diagonal; ISO 10360-2 three repetitions of each in
seven positions. What a test has of these is listed beside what is wanted.
"""

import dataclasses
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.adjustment.problem import coordinates, has_open_scale
from jaxbundle.adjustment.result import Adjustment
from jaxbundle.arguments import at_least_zero, one_of, positive, show
from jaxbundle.certificates.units import convert
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError
from jaxbundle.io.text.csv_tables import read_csv
from jaxbundle.leastsquares.indexing.rows import Values
from jaxbundle.leastsquares.quality.distributions import normal_quantile
from jaxbundle.network.columns import as_columns, count, did_you_mean, list_some
from jaxbundle.network.units import METRES
from jaxbundle.report.layout import fixed, significant, table
from jaxbundle.results import TableMethods
from jaxbundle.types import not_none

CONFORMS, FAILS, OPEN = "conformity proven", "nonconformity proven", "neither proven"
RULES = ("guard band", "simple acceptance")
# Conformance probability of ISO 14253-1 (2017) unless both sides agree otherwise.
PROBABILITY = 0.95
# What VDI/VDE 2634-1 (2002) wants of a test, and ISO 10360-2 (2009) of repetitions.
LEAST_LINES, LEAST_LENGTHS, LEAST_REACH, REPETITIONS = 7, 5, 2 / 3, 3
MPE_FORM = re.compile(
    r"""\s*(?P<a>\d+\.?\d*|\.\d+)\s*(?P<unit>[^\W\d]\w*)\s*
    (?:\+\s*L\s*/\s*(?P<k>\d+\.?\d*(?:[eE]\d+)?)\s*)?
    (?:(?:<=|≤|,?\s*max)\s*(?P<b>\d+\.?\d*|\.\d+)\s*(?P<b_unit>[^\W\d]\w*)\s*)?""",
    re.VERBOSE,
)


@dataclasses.dataclass(frozen=True)
class PermissibleError:
    """A maximum permissible error min(A + L/K, B), all lengths in one unit: `constant` A,
    `per_length` 1/K, `ceiling` B; the `text` that it is from."""

    constant: float
    per_length: float = 0.0
    ceiling: float = math.inf
    text: str = ""

    def __post_init__(self):
        at_least_zero("constant", self.constant)
        at_least_zero("per_length", self.per_length)
        if not self.ceiling > 0:
            raise InputError(f"ceiling must be positive, but is {show(self.ceiling)}")

    def __call__(self, length: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """The permissible error of each length."""
        return np.minimum(self.constant + self.per_length * np.asarray(length), self.ceiling)


def read_mpe(text: str, unit: str) -> PermissibleError:
    """A maximum permissible error from a text such as "20 um + L/50000", "50 um" or
    "10 um + L/25000, max 80 um", in an object unit.

    **Raises:** `InputError`."""
    match = MPE_FORM.fullmatch(text) if isinstance(text, str) else None
    if match is None:
        raise InputError(
            f"MPE {show(text)}: expected A UNIT + L/K, such as '20 um + L/50000', or '50 um'"
        )
    if unit not in METRES:
        raise InputError(f"MPE {text!r}: the object unit {unit!r} is no length")
    try:
        constant = convert(float(match["a"]), match["unit"].replace("µ", "u"), unit)
        ceiling = math.inf
        if match["b"]:
            ceiling = convert(float(match["b"]), match["b_unit"].replace("µ", "u"), unit)
    except InputError as error:
        raise InputError(f"MPE {text!r}: {error}") from None
    per_length = 1 / positive("K of the MPE", float(match["k"])) if match["k"] else 0.0
    return PermissibleError(constant, per_length, ceiling, " ".join(text.split()))


@dataclasses.dataclass(frozen=True)
class CalibratedLengths:
    """Calibrated lengths between named points: `ends` [(from, to)], `value` and `sigma` (of the
    calibration, k = 1) in the object unit, the `line` of each (empty: not stated); `source`."""

    ends: tuple[tuple[str, str], ...]
    value: Float[np.ndarray, " n"]
    sigma: Float[np.ndarray, " n"]
    line: tuple[str, ...] = ()
    source: str = "lengths"

    def __len__(self) -> int:
        return len(self.ends)


def read_lengths(given: Any) -> CalibratedLengths:
    """Calibrated lengths from a table with the columns from, to, value, sigma and, if wanted, line:
    the path of a CSV file, a dict of columns, a data frame.

    **Raises:** `InputError` naming file and row."""
    if isinstance(given, CalibratedLengths):
        return given
    name = "lengths"
    if isinstance(given, str | Path):
        name = str(given)
        columns = read_csv(Path(given))
    else:
        columns = as_columns(given, name)
    columns.check_names(("from", "to", "value", "sigma"), ("line",))
    value = columns.numbers("value", required=True)
    sigma = columns.numbers("sigma", required=True)
    ends = tuple(zip(columns.ids("from"), columns.ids("to")))
    for row, ((a, b), length, s) in enumerate(zip(ends, value, sigma)):
        if a == b:
            raise InputError(f"{columns.source(row)}: from and to are the same point {a!r}")
        if not (length > 0 and math.isfinite(length)):
            raise InputError(f"{columns.source(row)}: value must be positive, but is {length:g}")
        if not (s >= 0 and math.isfinite(s)):
            raise InputError(f"{columns.source(row)}: sigma must not be negative, but is {s:g}")
    line = columns.ids("line") if "line" in columns.values else ("",) * len(ends)
    return CalibratedLengths(ends, value, sigma, line, name)


def require_points(lengths: CalibratedLengths, known_points: Sequence[str]) -> None:
    """Refuse lengths of points that a network does not have.

    **Raises:** `InputError`."""
    known_set = set(known_points)
    for name in (end for ends in lengths.ends for end in ends):
        if name not in known_set:
            raise InputError(
                f"{lengths.source}: there is no point {name!r}{did_you_mean(name, known_points)}"
            )


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class LengthTest(TableMethods):
    """Length measurement errors of calibrated lengths.

    **Fields:** `lengths`, the calibrated ones that could be compared; `measured`, and `sigma` of
    it by the adjustment; `mpe`, None without; `rule`: "guard band" (ISO 14253-1) or "simple
    acceptance"; `missing`: lengths whose points were not measured; `between_control`: those between
    control points, which are not tested; `diagonal` of the measuring volume; `unit`.
    """

    lengths: CalibratedLengths
    measured: Float[np.ndarray, " n"]
    sigma: Float[np.ndarray, " n"]
    unit: str
    diagonal: float
    mpe: PermissibleError | None = None
    rule: str = RULES[0]
    missing: tuple[tuple[str, str], ...] = ()
    between_control: tuple[tuple[str, str], ...] = ()

    @property
    def error(self) -> Float[np.ndarray, " n"]:
        """E = measured − calibrated."""
        return self.measured - self.lengths.value

    @property
    def largest(self) -> float:
        """The characteristic: the largest |E|."""
        return float(np.abs(self.error).max())

    @property
    def rms(self) -> float:
        """√(ΣE²/n)."""
        return float(np.sqrt(np.mean(self.error**2)))

    @property
    def limit(self) -> Float[np.ndarray, " n"] | None:
        """The permissible error of every length; None without an MPE."""
        return None if self.mpe is None else self.mpe(self.lengths.value)

    @property
    def guard_band(self) -> Float[np.ndarray, " n"]:
        """g of every length."""
        if self.rule == RULES[1]:
            return np.zeros(len(self.lengths))
        return normal_quantile(PROBABILITY) * self.lengths.sigma

    @property
    def verdicts(self) -> tuple[str, ...]:
        """The verdict on every length; empty without an MPE."""
        if self.limit is None:
            return ()
        size, g = np.abs(self.error), self.guard_band
        good, bad = size <= self.limit - g, size > self.limit + g
        return tuple(CONFORMS if a else FAILS if b else OPEN for a, b in zip(good, bad))

    @property
    def verdict(self) -> str:
        """The verdict on the test: nonconformity if one length proves it, conformity if all do,
        and none is missing; empty without an MPE."""
        verdicts = self.verdicts
        if not verdicts:
            return ""
        verdicts += (OPEN,) * len(self.missing)
        return FAILS if FAILS in verdicts else OPEN if OPEN in verdicts else CONFORMS

    @property
    def converged(self) -> bool:
        """Always: a test is made only of an adjustment with a solution."""
        return True

    def requirements(self) -> list[tuple[str, str, str, bool]]:
        """What VDI/VDE 2634-1 wants of the arrangement, and ISO 10360-2 of repetitions: subject,
        wanted, found, whether it is met; lines only where the table states them, repetitions only
        where there are some."""
        repetitions: dict[tuple[str, frozenset[str]], int] = {}
        for line, ends in zip(self.lengths.line, self.lengths.ends):
            length = line, frozenset(ends)
            repetitions[length] = repetitions.get(length, 0) + 1
        lines: dict[str, int] = {}
        for line, _ in repetitions:
            if line:
                lines[line] = lines.get(line, 0) + 1
        reach = float(self.lengths.value.max()) / self.diagonal if self.diagonal > 0 else math.nan
        fewest = min(lines.values(), default=0)
        not_stated = "not stated (column line)"
        fewest_repetitions = min(repetitions.values())
        found = [
            (
                "measuring lines",
                f"≥ {LEAST_LINES}",
                str(len(lines)) if lines else not_stated,
                len(lines) >= LEAST_LINES,
            ),
            (
                "test lengths of a line",
                f"≥ {LEAST_LENGTHS}",
                str(fewest) if lines else not_stated,
                fewest >= LEAST_LENGTHS,
            ),
            (
                "longest length to the space diagonal of the volume",
                "≥ 2/3",
                f"{reach:.2f}",
                reach >= LEAST_REACH,
            ),
        ]
        # VDI/VDE 2634-1 wants none: a test without any is not one of ISO 10360-2.
        if max(repetitions.values()) > 1:
            found.append(
                (
                    "repetitions of a length (ISO 10360-2)",
                    f"≥ {REPETITIONS}",
                    str(fewest_repetitions),
                    fewest_repetitions >= REPETITIONS,
                )
            )
        return found

    def table(self) -> dict[str, np.ndarray]:
        """A row a length: from, to, line, calibrated, sigma_calibrated, measured, sigma_measured,
        error, mpe, guard_band, verdict."""
        a, b = zip(*self.lengths.ends)
        text = lambda words: np.array(list(words), dtype=object)
        blank = np.full(len(self.lengths), np.nan)
        return {
            "from": text(a),
            "to": text(b),
            "line": text(self.lengths.line),
            "calibrated": self.lengths.value,
            "sigma_calibrated": self.lengths.sigma,
            "measured": self.measured,
            "sigma_measured": self.sigma,
            "error": self.error,
            "mpe": blank if self.limit is None else self.limit,
            "guard_band": self.guard_band,
            "verdict": text(self.verdicts or ("",) * len(self.lengths)),
        }

    def rows(self) -> list[tuple[str, ...]]:
        """`table` as text, under `HEADER`."""
        places = _places(self)
        limit = np.full(len(self.lengths), np.nan) if self.limit is None else self.limit
        return [
            (*ends, line, *(fixed(float(x), places) for x in numbers), verdict)
            for ends, line, *numbers, verdict in zip(
                self.lengths.ends,
                self.lengths.line,
                self.lengths.value,
                self.measured,
                self.error,
                limit,
                self.lengths.sigma,
                self.sigma,
                self.verdicts or ("",) * len(self.lengths),
            )
        ]

    def to_dict(self) -> dict[str, Any]:
        """The test as plain dicts and numbers, as in JSON."""
        columns = {name: column.tolist() for name, column in self.table().items()}
        return {
            "unit": self.unit,
            "number": len(self.lengths),
            "largest": self.largest,
            "rms": self.rms,
            "mpe": None if self.mpe is None else self.mpe.text,
            "rule": self.rule,
            "verdict": self.verdict or None,
            "missing": [list(ends) for ends in self.missing],
            "between_control": [list(ends) for ends in self.between_control],
            "lengths": [dict(zip(columns, row)) for row in zip(*columns.values())],
        }

    def __str__(self) -> str:
        lines = [
            f"Length measurement errors of {count(len(self.lengths), 'length')} in {self.unit}: "
            f"largest |E| {significant(self.largest)}, RMS {significant(self.rms)}"
            + (f"; {self.verdict} ({self.rule})" if self.verdict else ""),
            *table(HEADER, self.rows(), "lllrrrrrrl"),
        ]
        if self.missing:
            lines.append(f"not measured: {list_some(self.missing, 5, ' – '.join)}")
        if self.between_control:
            names = list_some(self.between_control, 5, " – ".join)
            lines.append(f"not tested, both ends are control points: {names}")
        return "\n".join(lines)


HEADER = ("from", "to", "line", "calibrated", "measured", "E", "MPE", "σ cal.", "σ", "verdict")


def _places(test: LengthTest) -> int:
    """Decimals: two digits of the smallest uncertainty, or of the largest error without any."""
    stated = test.lengths.sigma[test.lengths.sigma > 0]
    size = float(stated.min()) if len(stated) else max(test.largest, 1e-12)
    return int(np.clip(1 - math.floor(math.log10(size)), 0, 9))


def length_errors(
    given: Any,
    lengths: Any,
    *,
    mpe: PermissibleError | str | None = None,
    rule: str = RULES[0],
    volume: Sequence[float] | None = None,
) -> LengthTest:
    """The length measurement errors of an adjustment, after VDI/VDE 2634 Part 1.

    **Arguments:**

    - `given`: an `Adjustment`, or a result that has one as `adjustment`.
    - `lengths`: calibrated lengths that the adjustment does not have: the path of a table with the
      columns from, to, value, sigma and, if wanted, line; or its columns. Ends are points of the
      adjustment, or its check points as intersected.
    - `mpe`: maximum permissible error, a text such as "20 um + L/50000".
    - `rule`: "guard band" (ISO 14253-1) or "simple acceptance".
    - `volume`: the sides of the measuring volume, object unit; by default those of the box about
      the ends of the lengths.

    **Returns:** a `LengthTest`.

    **Raises:** `InputError` if no length has both of its points, if all are between control points,
    if the scale of the network is open, or for lengths that are observations of the adjustment;
    `NotSolvedError` without a solution.
    """
    adjustment = getattr(given, "adjustment", given)
    if not isinstance(adjustment, Adjustment):
        raise InputError(f"expected a result of jaxbundle.adjust, got {show(given)}")
    one_of("rule", rule, RULES)
    calibrated = read_lengths(lengths)
    points = adjustment.problem.network.points
    if has_open_scale(adjustment.problem):
        raise InputError(
            f"{calibrated.source}: the network has no scale: add a distance or control points, at "
            "least two"
        )
    unit = adjustment.network.object_unit
    limit = read_mpe(mpe, unit) if isinstance(mpe, str) else mpe
    known_points = _positions(adjustment)
    _refuse_observed(adjustment, calibrated)
    is_control = points.has_role("control", "fixed")
    control = {id for id, is_of_control in zip(points.id, is_control) if is_of_control}
    rows_measured = [
        i for i, ends in enumerate(calibrated.ends) if all(end in known_points for end in ends)
    ]
    missing = tuple(ends for i, ends in enumerate(calibrated.ends) if i not in set(rows_measured))
    if not rows_measured:
        names = sorted({e for ends in missing for e in ends if e not in known_points})
        raise InputError(
            f"{calibrated.source}: no length has both points in the result; missing are "
            f"{list_some(names)}"
        )
    between_control = tuple(
        calibrated.ends[i] for i in rows_measured if control.issuperset(calibrated.ends[i])
    )
    testable = [i for i in rows_measured if calibrated.ends[i] not in between_control]
    if not testable:
        raise InputError(
            f"{calibrated.source}: every length is between control points, whose coordinates are "
            "given: they test nothing; make them check points (--check), or use other lengths"
        )
    tested = CalibratedLengths(
        tuple(calibrated.ends[i] for i in testable),
        calibrated.value[testable],
        calibrated.sigma[testable],
        tuple((calibrated.line or ("",) * len(calibrated))[i] for i in testable),
        calibrated.source,
    )
    ends = np.array([[known_points[end] for end in ends] for ends in tested.ends])
    measured = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    sides = np.ptp(ends.reshape(-1, 3), axis=0) if volume is None else np.asarray(volume, float)
    return LengthTest(
        tested,
        measured,
        _sigma_of_lengths(adjustment, tested, ends),
        unit,
        float(np.linalg.norm(sides)),
        limit,
        rule,
        missing,
        between_control,
    )


def _positions(adjustment: Adjustment) -> dict[str, Float[np.ndarray, "3"]]:
    """The adjusted points with coordinates, and the intersected check points, by id."""
    rows = zip(adjustment.problem.network.points.id, adjustment.point_values, adjustment.located)
    positions = {id: position for id, position, has_result in rows if has_result}
    checks = adjustment.check_points
    if checks is not None:
        intersected = zip(checks.id, checks.position)
        positions |= {id: X for id, X in intersected if np.isfinite(X).all()}
    return positions


def _sigma_of_lengths(
    adjustment: Adjustment, lengths: CalibratedLengths, ends: Float[np.ndarray, "n 2 3"]
) -> Float[np.ndarray, " n"]:
    """σ of measured lengths: between adjusted points from their joint covariance; with a check
    point from those of both ends, taken as independent, which errors of the orientations that they
    have in common make too large rather than too small."""
    row_of = {id: row for row, id in enumerate(adjustment.problem.network.points.id)}
    is_adjusted = np.array([all(end in row_of for end in pair) for pair in lengths.ends])
    variance = np.zeros(len(lengths))
    if is_adjusted.any():
        pairs = [lengths.ends[i] for i in np.flatnonzero(is_adjusted)]
        rows = np.array([[row_of[end] for end in pair] for pair in pairs])
        lengths_between = lambda values: _distances(values, rows)
        variances = np.diagonal(adjustment.covariance_of(lengths_between, classical=True))
        if adjustment.error_model is not None:
            variances = np.fmax(variances, np.diagonal(adjustment.covariance_of(lengths_between)))
        variance[is_adjusted] = variances
    if not is_adjusted.all():
        checks = not_none(adjustment.check_points)
        # By the point the covariances of which the larger is stated.
        covariances = zip(adjustment.classical_point_covariance, adjustment.point_covariance)
        blocks = dict(zip(row_of, covariances))
        blocks |= {id: (C, C) for id, C in zip(checks.id, checks.covariance)}
        for i in np.flatnonzero(~is_adjusted):
            difference = ends[i, 1] - ends[i, 0]
            along = difference / np.linalg.norm(difference)
            both_ends = (blocks[end] for end in lengths.ends[i])
            variance[i] = sum(max(along @ C @ along for C in of_end) for of_end in both_ends)
    return np.sqrt(np.clip(variance, 0, None))


def _distances(values: Values, rows: np.ndarray) -> Float[Array, " n"]:
    position = coordinates(values)
    return jnp.linalg.norm(position[rows[:, 1]] - position[rows[:, 0]], axis=1)


def _refuse_observed(adjustment: Adjustment, lengths: CalibratedLengths) -> None:
    """A length that is an observation tests nothing."""
    network = adjustment.problem.network
    ids = network.points.id
    observed = {frozenset((ids[a], ids[b])) for a, b in network.distances.points.tolist()}
    for a, b in lengths.ends:
        if frozenset((a, b)) in observed:
            raise InputError(
                f"{lengths.source}: {a} – {b} is a distance of the adjustment, which tests "
                "nothing; leave it out of one of them"
            )


def join_length_tests(tests: Sequence[LengthTest] | Mapping[str, LengthTest]) -> LengthTest:
    """Repetitions as one test, such as the three of ISO 10360-2: errors of all of them.

    **Raises:** `InputError` without tests, or for different units, limits or rules."""
    repetitions = list(tests.values()) if isinstance(tests, Mapping) else list(tests)
    if not repetitions:
        raise InputError("tests: expected at least one")
    first_test = repetitions[0]
    if any(
        (t.unit, t.mpe, t.rule) != (first_test.unit, first_test.mpe, first_test.rule)
        for t in repetitions
    ):
        raise InputError("expected tests of one unit, MPE and decision rule")
    lengths = CalibratedLengths(
        tuple(ends for t in repetitions for ends in t.lengths.ends),
        np.concatenate([t.lengths.value for t in repetitions]),
        np.concatenate([t.lengths.sigma for t in repetitions]),
        tuple(line for t in repetitions for line in t.lengths.line),
        first_test.lengths.source,
    )
    return dataclasses.replace(
        first_test,
        lengths=lengths,
        measured=np.concatenate([t.measured for t in repetitions]),
        sigma=np.concatenate([t.sigma for t in repetitions]),
        diagonal=max(t.diagonal for t in repetitions),
        missing=tuple(dict.fromkeys(ends for t in repetitions for ends in t.missing)),
        between_control=tuple(
            dict.fromkeys(ends for t in repetitions for ends in t.between_control)
        ),
    )
