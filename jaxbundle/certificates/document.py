"""The certificate of a result."""

import dataclasses
import math
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from jaxbundle.adjustment.result import Adjustment
from jaxbundle.adjustment.uncertainty_budget import UncertaintyBudget, uncertainty_budget
from jaxbundle.arguments import show
from jaxbundle.calibration.result import Calibration
from jaxbundle.calibration.rig.result import RigCalibration
from jaxbundle.calibration.several import Calibrations
from jaxbundle.certificates.acceptance import Acceptance, accept, length_test_of
from jaxbundle.certificates.details import NO_DETAILS, CertificateDetails, read_details
from jaxbundle.certificates.lengths import LengthTest, read_mpe
from jaxbundle.certificates.positional import PositionalAccuracy, positional_accuracy
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.io.text.csv_tables import write_text
from jaxbundle.reconstruction.result import Reconstruction
from jaxbundle.report.page import UNKNOWN, Origin
from jaxbundle.results import ResultMethods


@dataclasses.dataclass(frozen=True)
class CertifiedPart:
    """One adjustment of a certificate: its `name` (empty for the only one), the `adjustment`, its
    `calibration` if it is of one camera, the `budget` of its quantities, None if nothing of it can
    be a measurand, with the reason in `no_budget`; its `accuracy` at check points, None without
    any, or if it cannot be stated, with the reason in `no_accuracy`."""

    name: str
    adjustment: Adjustment
    calibration: Calibration | None = None
    budget: UncertaintyBudget | None = None
    no_budget: str = ""
    accuracy: PositionalAccuracy | None = None
    no_accuracy: str = ""


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class Certificate(ResultMethods):
    """The certificate of a result.

    **Fields:** `result`; `details`; `parts`, the adjustments with their budgets; `rig`, if it is
    of one; `lengths`: the test of calibrated lengths, None without; `acceptance`: of criteria, None
    without; `origin` of the result.
    """

    result: Any
    details: CertificateDetails
    parts: tuple[CertifiedPart, ...]
    rig: RigCalibration | None = None
    lengths: LengthTest | None = None
    acceptance: Acceptance | None = None
    origin: Origin = UNKNOWN

    @property
    def title(self) -> str:
        """The title of the document."""
        if self.rig is not None or any(part.calibration is not None for part in self.parts):
            return "Calibration certificate"
        return "Certificate of a photogrammetric measurement"

    def pieces(self) -> Iterator[str]:
        """The certificate as a page of HTML, in pieces."""
        from jaxbundle.certificates.page import compose_certificate

        return compose_certificate(self)

    def html(self) -> str:
        """The certificate as a page of HTML, which prints on A4."""
        return "".join(self.pieces())

    def save(self, path: str | Path) -> None:
        """Write the page, or of a name that ends with .json the numbers.

        **Raises:** `InputError` if the file cannot be written."""
        if os.fspath(path).endswith(".json"):
            super().save(path)
            return
        write_text(Path(path), self.pieces())

    def to_dict(self) -> dict[str, Any]:
        """The numbers as plain dicts, as in JSON."""
        return {
            "details": dict(self.details.fields),
            "parts": [
                {
                    "name": part.name,
                    "sigma0": part.adjustment.sigma0,
                    "redundancy": part.adjustment.redundancy,
                    "budget": None if part.budget is None else part.budget.to_dict(),
                    "no_budget": part.no_budget,
                    "positional_accuracy": None
                    if part.accuracy is None
                    else part.accuracy.to_dict(),
                    "no_positional_accuracy": part.no_accuracy,
                }
                for part in self.parts
            ],
            "length_errors": None if self.lengths is None else self.lengths.to_dict(),
            "acceptance": None if self.acceptance is None else self.acceptance.to_dict(),
        }

    def __str__(self) -> str:
        lines = [self.title]
        for part in self.parts:
            lines += [part.name] * bool(part.name)
            lines += str(part.budget).splitlines() if part.budget is not None else [part.no_budget]
            lines += [part.no_accuracy] * bool(part.no_accuracy)
            lines += [] if part.accuracy is None else str(part.accuracy).splitlines()
        lines += [] if self.lengths is None else str(self.lengths).splitlines()
        lines += [] if self.acceptance is None else str(self.acceptance).splitlines()
        return "\n".join(lines)


def certificate(
    result: Any,
    *,
    details: Any = None,
    lengths: Any = None,
    criteria: Iterable[str] | str = (),
    origin: Origin = UNKNOWN,
) -> Certificate:
    """The certificate of a result: uncertainty budget after the GUM, length measurement errors
    after VDI/VDE 2634-1, positional accuracy after ASPRS, tables of control and check points.

    **Arguments:**

    - `result`: of `adjust`, `calibrate`, `calibrate_rig`, `reconstruct`.
    - `details`: what the laboratory states: the path of a TOML file (docs/certificate.md), or its
      content.
    - `lengths`: calibrated lengths, as in `jaxbundle.length_errors`, or their `LengthTest`.
    - `criteria`: as in `jaxbundle.accept`.
    - `origin`: of the result, for the section on the files that were read.

    **Returns:** a `Certificate`: `save("certificate.html")` writes the page.

    **Raises:** `InputError` for other results, details or criteria; `NotSolvedError` without a
    solution.
    """
    certificate_details = read_details(details)
    adjustments = _adjustments(result)
    if not result.converged:
        raise NotSolvedError("the result has no solution: there is nothing to certify")
    test = lengths
    if lengths is not None and not isinstance(lengths, LengthTest):
        test = length_test_of(
            result,
            lengths,
            mpe=certificate_details.mpe or None,
            rule=certificate_details.rule,
            volume=certificate_details.volume,
        )
    elif test is not None:
        _require_same(test, certificate_details)
    parts = tuple(
        _part(name, adjustment_of_part, certificate_details)
        for name, adjustment_of_part in adjustments.items()
    )
    criteria = [criteria] if isinstance(criteria, str) else list(criteria)
    acceptance = accept(result, criteria, lengths=test) if criteria else None
    rig = result if isinstance(result, RigCalibration) else getattr(result, "rig", None)
    return Certificate(result, certificate_details, parts, rig, test, acceptance, origin)


def _require_same(test: LengthTest, details: CertificateDetails) -> None:
    """Refuse a test of lengths that was made otherwise than the details say.

    **Raises:** `InputError`."""
    stated = {
        "mpe": bool(details.mpe) and test.mpe != read_mpe(details.mpe, test.unit),
        "rule": details.rule not in (NO_DETAILS.rule, test.rule),
        "volume": details.volume is not None
        and not math.isclose(math.hypot(*details.volume), test.diagonal),
    }
    if differing := [name for name, differs in stated.items() if differs]:
        raise InputError(
            f"{', '.join(differing)} of the details are not those of the LengthTest: give the "
            "table of calibrated lengths, or omit them"
        )


def _adjustments(result: Any) -> dict[str, Adjustment | Calibration]:
    """The adjustments, or calibrations, of a result by name."""
    if isinstance(result, Adjustment | Calibration):
        return {"": result}
    if isinstance(result, RigCalibration | Calibrations):
        is_single = len(result.cameras) == 1
        return {
            "" if is_single else name: calibration for name, calibration in result.cameras.items()
        }
    if isinstance(result, Reconstruction):
        is_single = len(result.parts) == 1
        return {"" if is_single else part.name: part.adjustment for part in result.parts}
    raise InputError(
        "expected a result of jaxbundle.adjust, calibrate, calibrate_rig or reconstruct, got "
        f"{show(result)}"
    )


def _part(
    name: str, certified: Adjustment | Calibration, details: CertificateDetails
) -> CertifiedPart:
    calibration = certified if isinstance(certified, Calibration) else None
    adjustment = certified.adjustment if isinstance(certified, Calibration) else certified
    budget, why = None, ""
    measurands: Any = details.measurands or "cameras"
    free = any(len(adjustment.cameras[c]["free"]) for c in adjustment.cameras)
    if measurands == "cameras" and not free:
        why = (
            "The cameras are held: they are inputs, not results. Name the quantities of the budget "
            "as measurands in the details."
        )
    else:
        try:
            budget = uncertainty_budget(
                adjustment,
                measurands,
                held=details.held(adjustment.network.angle_unit),
                coverage=details.coverage,
            )
        except NotSolvedError as error:
            why = f"No budget: {error}."
    accuracy, no_accuracy = None, ""
    if adjustment.check_points is not None:
        classes = (details.horizontal_class, details.vertical_class)
        try:
            accuracy = positional_accuracy(adjustment, *classes)
        except InputError as error:
            no_accuracy = f"No positional accuracy: {error}."
    return CertifiedPart(name, adjustment, calibration, budget, why, accuracy, no_accuracy)


__all__ = ["NO_DETAILS", "Certificate", "CertifiedPart", "certificate"]
