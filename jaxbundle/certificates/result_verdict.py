"""The verdict on the result of any command that can be certified, as its report states it."""

from typing import Any

from jaxbundle.calibration.result import Calibration
from jaxbundle.calibration.rig.result import RigCalibration
from jaxbundle.calibration.several import Calibrations
from jaxbundle.calibration.verdict import (
    conclude_calibration,
    conclude_calibrations,
    judge_cameras_and_rig,
)
from jaxbundle.reconstruction.page import conclude_part
from jaxbundle.reconstruction.result import Reconstruction
from jaxbundle.report.verdict import Verdict, in_words


def verdict_of(result: Any) -> Verdict:
    """The verdict on a result; of a reconstruction that on its first part."""
    if isinstance(result, Calibration):
        return conclude_calibration(result)
    if isinstance(result, RigCalibration):
        findings = tuple(judge_cameras_and_rig(result.cameras, result))
        return Verdict(*in_words(list(findings), 0), findings)
    if isinstance(result, Calibrations):
        if len(result.cameras) == 1:
            return conclude_calibration(next(iter(result.cameras.values())))
        return conclude_calibrations(result)
    if isinstance(result, Reconstruction):
        return conclude_part(result, result.parts[0])
    return result.verdict
