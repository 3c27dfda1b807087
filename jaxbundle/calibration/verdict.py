"""The verdict on a calibration: that of its adjustment, with coverage and cross-validation."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

from jaxbundle.calibration.advice import ADVICE
from jaxbundle.calibration.rig.advice import undetermined_mountings
from jaxbundle.report.verdict import (
    BAD,
    DOUBTFUL,
    GOOD,
    NOTED,
    Finding,
    Verdict,
    conclude,
    in_words,
)

if TYPE_CHECKING:
    from jaxbundle.calibration.quality import Coverage
    from jaxbundle.calibration.result import Calibration
    from jaxbundle.calibration.rig.result import RigCalibration
    from jaxbundle.calibration.several import Calibrations

# Findings of the adjustment that do not apply to a board.
NOT_FOR_BOARDS = ("Control",)


def conclude_calibration(calibration: "Calibration") -> Verdict:
    """The verdict on a solved `Calibration`."""
    return conclude(
        calibration.adjustment, find(calibration), NOT_FOR_BOARDS, len(calibration.shortcomings)
    )


def conclude_calibrations(calibrations: "Calibrations") -> Verdict:
    """The verdict on several cameras (`Calibrations`): a finding for each, and for their rig."""
    findings = judge_cameras_and_rig(calibrations.cameras, calibrations.rig)
    return Verdict(*in_words(findings, 0), tuple(findings))


def judge_cameras_and_rig(
    cameras: Mapping[str, "Calibration"], rig: "RigCalibration | None"
) -> list[Finding]:
    """A finding for each of several cameras, and one for their rig."""
    findings = [_judge_camera(name, calibration) for name, calibration in cameras.items()]
    return findings if rig is None else [*findings, _judge_rig(rig)]


def _judge_camera(name: str, calibration: "Calibration") -> Finding:
    about = f"Camera {name}"
    if not calibration.converged:
        return Finding(about, BAD, f"not solved: {calibration.adjustment.termination}")
    return Finding(about, *conclude_calibration(calibration)[:2], f"camera {name}")


def _judge_rig(rig: "RigCalibration") -> Finding:
    words = f"{len(rig.epochs)} epochs, {len(rig.left_out)} left out, σ0 {rig.sigma0:.4f}"
    if weak := undetermined_mountings(rig):
        names = ", ".join(weak)
        return Finding("Rig", BAD, f"{words}; positions not determined: {names}")
    open_clocks = [name for name, clock in rig.clocks.items() if clock.held]
    if open_clocks:
        return Finding("Rig", BAD, f"{words}; clocks not determined: {', '.join(open_clocks)}")
    doubtful = rig.left_out or rig.contradicting or rig.separate or not rig.converged
    return Finding("Rig", DOUBTFUL if doubtful else GOOD, words)


def find(calibration: "Calibration") -> list[Finding]:
    """What the adjustment does not know of: coverage of the image, and the two halves."""
    covered, checked = calibration.coverage, calibration.cross_validation
    good = covered.part >= ADVICE.min_part and covered.reach >= ADVICE.min_reach
    words = coverage_in_words(covered)
    findings = [Finding("Coverage", GOOD if good else DOUBTFUL, words, words)]
    if checked is not None:
        state = DOUBTFUL if checked.test > ADVICE.max_test else GOOD
        words = " ".join(cross_validation_in_words(calibration))
        findings.append(
            Finding("Cross-validation", state, words, "halves that contradict each other")
        )
    if (bias := calibration.bias) is not None:
        # Half of the variance: as large as all errors of measurement together.
        state = GOOD if not bias.found else DOUBTFUL if bias.ratio > 0.5 else NOTED
        brief = f"a bias makes up {100 * bias.ratio:.0f} % of the residual variance"
        findings.append(Finding("Bias", state, bias.sentence, brief))
    return findings


def coverage_in_words(covered: "Coverage") -> str:
    """The part of the image with measured points."""
    return (
        f"points in {100 * covered.part:.0f} % of the image's cells, out to "
        f"{100 * covered.reach:.0f} % of the half diagonal"
    )


def cross_validation_in_words(calibration: "Calibration") -> list[str]:
    """The cross-validation of the halves, in sentences."""
    checked = calibration.cross_validation
    if checked is None:
        return ["too few photographs for two halves" if calibration.validated else "not made"]
    largest = max(checked.difference, key=lambda n: abs(checked.difference[n]))
    sentences = [
        "of the two halves made of every other photograph, "
        f"the camera of either leaves an RMS of {checked.rms_other:.4f} px in the other half, "
        f"where its own leaves {checked.rms_own:.4f} px. The two differ by "
        f"{abs(checked.difference[largest]):.1f} σ in {largest}, the most; test of all parameters "
        f"together {checked.test:.2f} (1 expected). Errors of the board are in both halves and do "
        "not show here."
    ]
    if checked.comparison is not None:
        sentences.append(
            "Their images, over the whole image, also where nothing was measured: "
            f"{checked.comparison}."
        )
    return sentences
