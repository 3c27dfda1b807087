"""Acceptance: the quantities of a result against criteria."""

import dataclasses
import math
from collections.abc import Callable, Collection, Iterable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool

from jaxbundle.batches.population import Population
from jaxbundle.cameras import get_model
from jaxbundle.certificates.criteria import Criterion, read_criteria, read_criterion
from jaxbundle.certificates.lengths import LengthTest, length_errors, read_lengths
from jaxbundle.certificates.quantities import find_quantity, named_unknown, offered
from jaxbundle.certificates.quantities_of_batches import SOLVED
from jaxbundle.certificates.quantities_of_others import unknown_quantity
from jaxbundle.certificates.quantity import (
    AXES,
    require_parameter,
    require_rig_camera,
    rig_camera_and_name,
)
from jaxbundle.certificates.units import convert, kind_of
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.network.columns import count
from jaxbundle.network.tables import EXTERIOR, Camera, Network
from jaxbundle.report.layout import MISSING, significant, table
from jaxbundle.results import ReportedResult, TableMethods

# Arguments that are names of unknowns; of other quantities they are words.
OF_UNKNOWNS = ("sigma", "sigma.rms", "value", "t", "correlation")
OF_CAMERAS = ("t", "correlation")


@dataclasses.dataclass(frozen=True)
class AcceptanceRow:
    """One criterion: the `value` that decides, in the unit of the limit (the largest of several
    for an upper limit, the smallest for a lower one); what it is `of`; the `number` of values;
    whether all of them meet it; `why` there is no value; `failed`: of what the values are that do
    not meet it, of a batch the inputs."""

    criterion: Criterion
    value: float
    of: str = ""
    number: int = 1
    met: bool = False
    why: str = ""
    failed: tuple[str, ...] = ()

    @property
    def line(self) -> str:
        """The criterion and what was found, in words."""
        if self.why:
            return f"{self.criterion.text}: {self.why}"
        where = f" ({self.of}" * bool(self.of)
        where += f", {'largest' if self.criterion.upper else 'smallest'} of {self.number}" * (
            bool(self.of) and self.number > 1
        )
        where += f"; {len(self.failed)} do not meet it" * (len(self.failed) > 1)
        where += ")" * bool(self.of)
        return f"{self.criterion.text}: {self.said}{where}"

    @property
    def said(self) -> str:
        """The value with its unit; a dash without one."""
        if self.why:
            return MISSING
        if math.isinf(self.value):
            return str(self.value)
        whole = self.value == round(self.value) and abs(self.value) < 1e9
        value = f"{self.value:.0f}" if whole else significant(self.value, self.digits)
        return f"{value} {self.criterion.unit}".strip()

    @property
    def digits(self) -> int:
        """Three digits, or as many as show on which side of the limit the value is."""
        limit = self.criterion.limit
        # A decimal number of 15 digits survives as a double, one of 16 may not.
        for digits in range(3, 16):
            rounded = float(f"{self.value:.{digits - 1}e}")
            if self.criterion.holds(rounded) == self.criterion.holds(self.value) and (
                rounded != limit or self.value == limit
            ):
                return digits
        return 15


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class Acceptance(TableMethods):
    """Criteria and whether a result meets them.

    **Fields:** `rows`, one a criterion. `met`: all of them.
    """

    rows: tuple[AcceptanceRow, ...]

    @property
    def met(self) -> bool:
        """Whether every criterion is met."""
        return all(row.met for row in self.rows)

    @property
    def unmet(self) -> list[str]:
        """A line for each criterion that is not met."""
        return [f"not met: {row.line}" for row in self.rows if not row.met]

    def meets_all(self, inputs: Sequence[str]) -> Bool[np.ndarray, " inputs"]:
        """Which inputs of a batch meet every criterion; none if one cannot be decided of any."""
        failing = {key for row in self.rows for key in row.failed}
        undecided = any(row.why and not row.failed for row in self.rows)
        return np.array([not undecided and key not in failing for key in inputs], bool)

    @property
    def sentence(self) -> str:
        """The result in words."""
        number_failed = sum(not row.met for row in self.rows)
        if not number_failed:
            return f"{count(len(self.rows), 'criterion')} met".replace("criterions", "criteria")
        return f"{number_failed} of {len(self.rows)} criteria not met"

    def table(self) -> dict[str, np.ndarray]:
        """A row a criterion: criterion, quantity, value, comparison, limit, unit, of, met, why."""
        text = lambda words: np.array(list(words), dtype=object)
        criteria = [row.criterion for row in self.rows]
        return {
            "criterion": text(criterion.text for criterion in criteria),
            "quantity": text(criterion.quantity for criterion in criteria),
            "value": np.array([row.value for row in self.rows]),
            "comparison": text(criterion.comparison for criterion in criteria),
            "limit": np.array([criterion.limit for criterion in criteria]),
            "unit": text(criterion.unit for criterion in criteria),
            "of": text(row.of for row in self.rows),
            "met": np.array([row.met for row in self.rows]),
            "why": text(row.why for row in self.rows),
        }

    def text_rows(self) -> list[tuple[str, ...]]:
        """The rows as text, under `HEADER`."""
        return [
            (
                row.criterion.text,
                row.said,
                row.why or row.of,
                "met" if row.met else "not met",
            )
            for row in self.rows
        ]

    def to_dict(self) -> dict[str, Any]:
        """The rows as plain dicts and numbers, as in JSON."""
        columns = {name: column.tolist() for name, column in self.table().items()}
        rows = [dict(zip(columns, r)) for r in zip(*columns.values())]
        for known_row, row in zip(self.rows, rows):
            row["failed"] = len(known_row.failed)
        return {"met": self.met, "criteria": rows}

    def __str__(self) -> str:
        return "\n".join([f"Acceptance: {self.sentence}", *table(HEADER, self.text_rows(), "lrll")])


HEADER = ("criterion", "value", "of", "verdict")


def accept(
    result: ReportedResult,
    criteria: Iterable[str] | str,
    *,
    lengths: Any = None,
) -> Acceptance:
    """Whether a result meets acceptance criteria, such as `"sigma(c) < 2 um"`.

    **Arguments:**

    - `result`: of `adjust`, `calibrate`, `calibrate_rig`, `reconstruct`, `hand_eye`, `batch` (of
      every input; one without a result is not accepted unless a criterion says which share `solved`
      must be), `pushbroom.refine`; of any other function the quantities are the numbers of
      `to_dict()` by their path, such as `"counts.images > 3"`, of a list of every row.
    - `criteria`: texts QUANTITY COMPARISON NUMBER UNIT; quantities and units are listed in
      docs/certificate.md. A quantity of several parameters, points or parts must meet the criterion
      with each.
    - `lengths`: calibrated lengths for `LME`, a table as in `jaxbundle.length_errors`, or its
      `LengthTest`.

    **Returns:** an `Acceptance`.

    **Raises:** `InputError` for an unknown quantity, argument or unit; `NotSolvedError` for a
    result without a solution.
    """
    return _accept(result, criteria, lengths, _judge)


def accept_known(result: Any, criteria: Iterable[str], lengths: Any = None) -> Acceptance:
    """`accept`, in which a criterion that is refused is not met, with the reason."""

    def judge(subject: Any, test: LengthTest | None, criterion: Criterion) -> AcceptanceRow:
        try:
            return _judge(subject, test, criterion)
        except InputError as error:
            why = str(error).removeprefix(f"criterion {criterion.text!r}: ")
            return AcceptanceRow(criterion, math.nan, why=why)

    return _accept(result, criteria, lengths, judge)


def _accept(
    result: Any, criteria: Iterable[str] | str, lengths: Any, judge: Callable[..., AcceptanceRow]
) -> Acceptance:
    read = read_criteria(criteria)
    population = getattr(result, "population", result)
    if isinstance(population, Population):
        if all(criterion.name != SOLVED for criterion in read):
            # An input without a result has no numbers that could fail.
            read.append(read_criterion(f"{SOLVED} >= 100 %"))
        return Acceptance(tuple(judge(population, None, criterion) for criterion in read))
    if not np.all(getattr(result, "converged", True)):
        raise NotSolvedError("the result has no solution: there is nothing to accept")
    test = lengths
    if lengths is not None and not isinstance(lengths, LengthTest):
        test = length_test_of(result, lengths)
    return Acceptance(tuple(judge(result, test, criterion) for criterion in read))


def length_test_of(result: Any, lengths: Any, **options: Any) -> LengthTest:
    """The test of calibrated lengths of a result, of the first of its parts, or cameras, that has
    them.

    **Raises:** `InputError` as `length_errors`."""
    several = getattr(result, "parts", None) or tuple(getattr(result, "cameras", {}).values())
    adjustments = [part.adjustment for part in several if hasattr(part, "adjustment")]
    if not adjustments:
        return length_errors(result, lengths, **options)
    calibrated = read_lengths(lengths)
    for adjustment in adjustments[:-1]:
        try:
            return length_errors(adjustment, calibrated, **options)
        except InputError:
            continue
    return length_errors(adjustments[-1], calibrated, **options)


def _judge(result: Any, test: LengthTest | None, criterion: Criterion) -> AcceptanceRow:
    try:
        quantity = find_quantity(result, test, criterion.name, criterion.argument)
        in_unit_of_limit = lambda value: convert(
            value, quantity.unit, criterion.unit, quantity.pitch
        )
        values = {name: in_unit_of_limit(value) for name, value in quantity.values.items()}
    except InputError as error:
        raise InputError(f"criterion {criterion.text!r}: {error}") from None
    except (LookupError, NotSolvedError) as error:
        why = str(error.args[0] if error.args else error)
        return AcceptanceRow(criterion, math.nan, why=why, failed=getattr(error, "inputs", ()))
    # NaN decides: what cannot be compared is not accepted
    worst = max if criterion.upper else min
    unknown = [name for name, value in values.items() if math.isnan(value)]
    name_of_worst = unknown[0] if unknown else worst(values, key=lambda name: values[name])
    failing = [name for name, value in values.items() if not criterion.holds(value)]
    owners = [quantity.owners.get(name, name) for name in failing]
    return AcceptanceRow(
        criterion,
        values[name_of_worst],
        name_of_worst,
        len(values),
        not failing,
        "it is not a number" if unknown else "",
        tuple(dict.fromkeys(k for o in owners for k in ([o] if isinstance(o, str) else o))),
    )


def check_criteria(
    texts: Sequence[str] | None,
    command: str,
    network: Network | None = None,
    models: Sequence[str] = (),
    camera_names: Collection[str] = (),
) -> list[Criterion]:
    """Refuse criteria that cannot be decided, before the result is there.

    **Arguments:** `command` whose result it will be; its `network`, or the camera `models` and, of
    a rig, the `camera_names`, where they are known.

    **Raises:** `InputError` naming the criterion, and what is known."""
    criteria, known_quantities = read_criteria(texts or ()), offered(command)
    if not known_quantities:
        return criteria
    for criterion in criteria:
        try:
            if criterion.name not in known_quantities:
                forms = [quantity.form for quantity in known_quantities.values()]
                raise InputError(unknown_quantity(criterion.name, forms))
            cameras = [Camera("", model) for model in models]
            cameras = cameras if network is None else network.cameras
            if criterion.name in OF_UNKNOWNS and command != "pushbroom refine":
                _check_unknown(criterion, cameras, network, command)
            known_quantities[criterion.name].check_argument(criterion.argument)
            if command == "calibrate-rig" and camera_names:
                _check_rig_camera(criterion, camera_names)
            _check_unit(criterion, known_quantities[criterion.name].unit, network)
        except InputError as error:
            raise InputError(f"--accept {criterion.text!r}: {error}") from None
    return criteria


def _check_unknown(
    criterion: Criterion, cameras: Sequence[Camera], network: Network | None, command: str
) -> None:
    """Refuse the name of an unknown that no camera, image or point has."""
    if not criterion.argument:
        raise InputError("expected a parameter in parentheses, such as (c), (X0) or (Z)")
    name = criterion.argument.rpartition(":")[2]
    if command == "calibrate-rig" and name in ("base", "rotation"):
        return
    # The arguments of rigs and batches are CAMERA:NAME, or the name of a column.
    if command not in ("calibrate-rig", "batch"):
        kind, _, name = named_unknown(criterion.argument, criterion.name in OF_CAMERAS)
        if kind != "camera":
            return
    if not cameras:
        return
    require_parameter(cameras, name)
    if network is None or criterion.argument.count(":") == 1:
        return
    kind, _, after_kind = criterion.argument.partition(":")
    id = after_kind.rpartition(":")[0]
    ids = [camera.id for camera in network.cameras]
    if after_kind and kind == "camera" and id not in ("*", *ids):
        raise InputError(f"there is no camera {id!r}; known: {', '.join(ids)}")
    chosen_cameras = [c for c in network.cameras if id in ("", "*", c.id)]
    if criterion.name != "value" and not any(
        name in (*c.free, *c.unknowns) for c in chosen_cameras
    ):
        raise InputError(f"{name} is held, and not estimated: add it to free")


def _check_rig_camera(criterion: Criterion, known_cameras: Collection[str]) -> None:
    """Refuse the name of a camera that the rig does not have."""
    if criterion.name in OF_UNKNOWNS:
        camera, _ = rig_camera_and_name(criterion.argument)
    else:  # the only argument of another quantity is a camera
        camera = criterion.argument or "*"
    require_rig_camera(camera, known_cameras)


def _check_unit(criterion: Criterion, words: str, network: Network | None) -> None:
    """Refuse a unit of another kind than the quantity has."""
    if words == "of NAME":
        name = criterion.argument.rpartition(":")[2]
        if name in EXTERIOR[3:] or name == "rotation":
            words = "angle"
        elif name in (*EXTERIOR[:3], *AXES, "base"):
            words = "length"
        else:
            _check_unit_of_parameter(criterion, name, network)
            return
    if words == "length, angle":
        words = "angle" if criterion.argument == "rotation" else "length"
    kind = kind_of(criterion.unit)
    if words == "length":
        unit = "m" if network is None else network.object_unit
        convert(1.0, unit, criterion.unit)
        return
    expected = {"": ("number",), "px": ("image", "length"), "angle": ("angle",)}
    expected["px, length"] = ("image", "length")
    if kind not in expected[words]:
        unit_of_quantity = {"": "", "px": "px", "px, length": "px", "angle": "deg"}[words]
        convert(1.0, unit_of_quantity, criterion.unit)


def _check_unit_of_parameter(criterion: Criterion, name: str, network: Network | None) -> None:
    if network is None:
        return
    for camera in network.cameras:
        model = get_model(camera.model)
        if name not in model.parameters:
            continue
        is_length_in_image = name in (*model.principal_distance, *model.principal_point)
        unit = model.unit if is_length_in_image else ""
        square = camera.pixel_size is not None
        if not (square and {kind_of(unit), kind_of(criterion.unit)} == {"image", "length"}):
            convert(1.0, unit, criterion.unit)
