"""The report of several calibrations, with their rig, and its dict for JSON."""

from typing import TYPE_CHECKING

from jaxbundle.calibration.rig.report import rig_dict
from jaxbundle.calibration.verdict import conclude_calibrations
from jaxbundle.io.results.result_json import verdict_dict
from jaxbundle.report.layout import clean, facts

if TYPE_CHECKING:
    from jaxbundle.calibration.several import Calibrations


def several_text(calibrations: "Calibrations") -> str:
    """The verdict on several cameras, and what it follows from."""
    _, words, findings = conclude_calibrations(calibrations)
    rows = [("Verdict", words), *((clean(finding.about), finding.words) for finding in findings)]
    lines = [f"Calibration of {len(calibrations.cameras)} cameras", "=" * 100, *facts(rows)]
    return "\n".join(line.rstrip() for line in lines) + "\n"


def calibrations_dict(calibrations: "Calibrations", brief: bool = False) -> dict:
    """The JSON of one calibration, or of several under their names, with the rig."""
    if len(calibrations.cameras) == 1 and calibrations.rig is None:
        return next(iter(calibrations.cameras.values())).to_dict(brief)
    parts = {name: calibration.to_dict(brief) for name, calibration in calibrations.cameras.items()}
    verdict = verdict_dict(conclude_calibrations(calibrations))
    document = {"converged": calibrations.converged, "verdict": verdict, "calibrations": parts}
    if calibrations.rig is not None:
        document["rig"] = rig_dict(calibrations.rig, brief)
    return document
