"""The report of several calibrations, with their rig, and its dict for JSON."""

from typing import TYPE_CHECKING

from jaxbundle.calibration.rig.report import rig_dict
from jaxbundle.calibration.verdict import conclude_calibrations
from jaxbundle.io.results.result_json import verdict_dict
from jaxbundle.report.layout import clean, facts

if TYPE_CHECKING:
    from jaxbundle.calibration.several import Calibrations


def several_text(found: "Calibrations") -> str:
    """The verdict on several cameras, and what it follows from."""
    _, words, findings = conclude_calibrations(found)
    rows = [("Verdict", words), *((clean(one.about), one.words) for one in findings)]
    lines = [f"Calibration of {len(found.cameras)} cameras", "=" * 100, *facts(rows)]
    return "\n".join(line.rstrip() for line in lines) + "\n"


def calibrations_dict(found: "Calibrations", brief: bool = False) -> dict:
    """The JSON of one calibration, or of several under their names, with the rig."""
    if len(found.cameras) == 1 and found.rig is None:
        return next(iter(found.cameras.values())).to_dict(brief)
    parts = {name: one.to_dict(brief) for name, one in found.cameras.items()}
    verdict = verdict_dict(conclude_calibrations(found))
    document = {"converged": found.converged, "verdict": verdict, "calibrations": parts}
    if found.rig is not None:
        document["rig"] = rig_dict(found.rig, brief)
    return document
