"""What a certificate states that no adjustment knows: laboratory, customer, object, conditions,
procedure, and the inputs of its budget that the adjustment holds.

A TOML file, all of it optional:

    [certificate]
    number = "2026-014"
    laboratory = "Measuring laboratory"
    object = "Digital camera"
    serial = "30412"

    [evaluation]
    coverage = 0.95
    mpe = "20 um + L/50000"

    [[input]]
    name = "camera:cam:K3"
    limits = 2e-9
    distribution = "rectangular"

The fields of `[certificate]` are those that ISO/IEC 17025 (2017), 7.8.2 and 7.8.4, wants in a
calibration certificate; one that is missing is a line to fill in by hand.
"""

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jaxbundle.adjustment.budget_inputs import DIVISORS, HeldInput
from jaxbundle.adjustment.quality.fixed_quantities import split_name
from jaxbundle.arguments import number, positive, show
from jaxbundle.certificates.lengths import RULES, read_mpe
from jaxbundle.errors import InputError
from jaxbundle.io.text.csv_tables import read_toml
from jaxbundle.network.columns import refuse_unknown
from jaxbundle.network.kinds.base import ANGLES
from jaxbundle.network.units import ANGLE_UNITS

# The fields of a certificate, with their titles.
FIELDS = {
    "number": "Certificate",
    "laboratory": "Laboratory",
    "address": "Address",
    "accreditation": "Accreditation",
    "customer": "Customer",
    "object": "Object",
    "manufacturer": "Manufacturer",
    "type": "Type",
    "serial": "Serial number",
    "received": "Received",
    "calibrated": "Date of calibration",
    "place": "Place",
    "conditions": "Environmental conditions",
    "procedure": "Procedure",
    "traceability": "Traceability",
    "remarks": "Remarks",
    "issued": "Date of issue",
    "approved_by": "Approved by",
}
# Those that a certificate wants in any case: an empty line is printed for them.
WANTED = (
    "number",
    "laboratory",
    "customer",
    "object",
    "serial",
    "calibrated",
    "conditions",
    "procedure",
    "traceability",
    "issued",
    "approved_by",
)
EVALUATION = (
    "coverage",
    "measurands",
    "mpe",
    "rule",
    "volume",
    "horizontal_class",
    "vertical_class",
)
INPUT = ("name", "sigma", "limits", "expanded", "k", "distribution", "degrees", "words")


@dataclasses.dataclass(frozen=True)
class CertificateDetails:
    """What a certificate states beside the result.

    **Fields:** `fields` by their names in `FIELDS`; `coverage` probability; `measurands` by name,
    empty: the free parameters of the cameras; `mpe`, `rule`, `volume` as in
    `jaxbundle.length_errors`; `horizontal_class`, `vertical_class` as in
    `jaxbundle.positional_accuracy`; `inputs`: held ones by name, as in
    `jaxbundle.uncertainty_budget`, but angles in the unit of the network.
    """

    fields: Mapping[str, str] = dataclasses.field(default_factory=dict)
    coverage: float = 0.95
    measurands: tuple[str, ...] = ()
    mpe: str = ""
    rule: str = RULES[0]
    volume: tuple[float, ...] | None = None
    horizontal_class: float | None = None
    vertical_class: float | None = None
    inputs: Mapping[str, HeldInput] = dataclasses.field(default_factory=dict)

    def held(self, angle_unit: str) -> dict[str, HeldInput]:
        """The held inputs, angles in radians."""
        inputs = {}
        for name, held_input in self.inputs.items():
            angle = split_name(name)[2] in ANGLES
            scale = ANGLE_UNITS[angle_unit] if angle else 1.0
            inputs[name] = dataclasses.replace(
                held_input, uncertainty=held_input.uncertainty * scale
            )
        return inputs


NO_DETAILS = CertificateDetails()


def read_details(given: Any) -> CertificateDetails:
    """Details from the path of a TOML file, or its content as a dict.

    **Raises:** `InputError` naming file, section and key."""
    if given is None:
        return NO_DETAILS
    if isinstance(given, CertificateDetails):
        return given
    where = "details"
    if isinstance(given, str | Path):
        where, given = str(given), read_toml(Path(given))
    if not isinstance(given, Mapping):
        raise InputError(f"details: expected the path of a TOML file, got {show(given)}")
    _check_keys(given, ("certificate", "evaluation", "input"), where)
    fields_stated = _section(given, "certificate", where)
    _check_keys(fields_stated, FIELDS, f"{where}, [certificate]")
    evaluation = _section(given, "evaluation", where)
    _check_keys(evaluation, EVALUATION, f"{where}, [evaluation]")
    inputs = given.get("input", [])
    if not isinstance(inputs, list) or not all(isinstance(entry, Mapping) for entry in inputs):
        raise InputError(f"{where}: expected [[input]] sections")
    return CertificateDetails(
        fields={name: str(value) for name, value in fields_stated.items()},
        inputs=_inputs(inputs, where),
        **_evaluation(evaluation, f"{where}, [evaluation]"),
    )


def _section(document: Mapping[str, Any], name: str, where: str) -> Mapping[str, Any]:
    section = document.get(name, {})
    if not isinstance(section, Mapping):
        raise InputError(f"{where}: expected a section [{name}]")
    return section


def _check_keys(section: Mapping[str, Any], known_keys: Any, where: str) -> None:
    for key in section:
        refuse_unknown(key, known_keys, f"{where}: ")


def _evaluation(section: Mapping[str, Any], where: str) -> dict[str, Any]:
    options: dict[str, Any] = {}
    if "coverage" in section:
        options["coverage"] = number(f"{where}, coverage", section["coverage"])
        if not 0 < options["coverage"] < 1:
            raise InputError(f"{where}, coverage: expected a probability between 0 and 1")
    if "rule" in section and section["rule"] not in RULES:
        raise InputError(f"{where}, rule: expected one of {', '.join(RULES)}")
    for name in ("mpe", "rule"):
        if name in section:
            options[name] = str(section[name])
    if "mpe" in section:
        try:
            read_mpe(options["mpe"], "m")
        except InputError as error:
            raise InputError(f"{where}, mpe: {error}") from None
    for name in ("horizontal_class", "vertical_class"):
        if name in section:
            options[name] = positive(f"{where}, {name}", section[name])
    if "measurands" in section:
        names = section["measurands"]
        if not isinstance(names, list) or not all(isinstance(n, str) for n in names):
            raise InputError(f"{where}, measurands: expected a list of names KIND:ID:NAME")
        for name in names:
            split_name(name)
        options["measurands"] = tuple(names)
    if "volume" in section:
        sides = section["volume"]
        if not isinstance(sides, list) or len(sides) != 3:  # noqa: PLR2004 - width, depth, height
            raise InputError(f"{where}, volume: expected three sides, such as [2.0, 2.0, 1.5]")
        options["volume"] = tuple(positive(f"{where}, volume", side) for side in sides)
    return options


def _inputs(entries: list[Mapping[str, Any]], where: str) -> dict[str, HeldInput]:
    inputs: dict[str, HeldInput] = {}
    for row, entry in enumerate(entries, 1):
        place = f"{where}, input {row}"
        _check_keys(entry, INPUT, place)
        if "name" not in entry:
            raise InputError(f"{place}: name is missing, such as camera:cam:K3")
        name = ":".join(split_name(str(entry["name"])))
        if name in inputs:
            raise InputError(f"{place}: {name} is given twice")
        inputs[name] = _input(entry, place)
    return inputs


def _input(entry: Mapping[str, Any], place: str) -> HeldInput:
    forms = [key for key in ("sigma", "limits", "expanded") if key in entry]
    if len(forms) != 1:
        raise InputError(f"{place}: expected one of sigma, limits, expanded")
    distribution = str(entry.get("distribution", "rectangular" if "limits" in entry else "normal"))
    if distribution not in DIVISORS:
        raise InputError(f"{place}, distribution: expected one of {', '.join(DIVISORS)}")
    value = positive(f"{place}, {forms[0]}", entry[forms[0]])
    if "k" in entry and forms[0] != "expanded":
        raise InputError(f"{place}: k is the coverage factor of expanded; omit it with {forms[0]}")
    if forms[0] == "limits":
        value /= DIVISORS[distribution]
    if forms[0] == "expanded":
        value /= positive(f"{place}, k", entry.get("k", 2.0))
    degrees = positive(f"{place}, degrees", entry["degrees"]) if "degrees" in entry else math.inf
    return HeldInput(value, distribution, degrees, str(entry.get("words", "")))
