"""Correlated errors in a report: their components, the σ under them, and the replication.

Where an error model is known, the σ shown with a value is the larger of the classical one and that
under the model; both stand in the section of this module.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from jaxbundle.leastsquares.quality.error_components import IMAGE
from jaxbundle.report.layout import clean, heading, paragraph, significant, table
from jaxbundle.report.lens_advice import ADVICE_ON_FIELD, advise_parameters, is_hardly_determined
from jaxbundle.types import not_none

if TYPE_CHECKING:
    from jaxbundle.adjustment.quality.replication import HalvesDifference
    from jaxbundle.adjustment.result import Adjustment
    from jaxbundle.leastsquares.quality.error_components import ErrorModel

TITLE = "Correlated errors"
LEGEND = (
    "Size: standard deviation of the effect on an image coordinate; that of a principal distance "
    "and of an affine distortion at the edge of the measured area. Score: how far the residuals "
    "exceed those of independent errors, in σ. The estimates are those of least squares; only "
    "their σ change."
)


REPLICATION_LEGEND = (
    "Difference between the interior orientations of two halves that share no image point. d²: its "
    "square over its covariance; d²/n is 1 on average if σ are right. Halves by photographs of one "
    "camera have the errors of its lens model in common, halves by points all errors that belong "
    "to photographs, and all halves the errors of given coordinates, such as those of a bent "
    "board: they cannot show these errors."
)
DIFFERENCE_HEADER = ("parameter", "difference", "σ", "in σ", "σ correlated", "in σ correlated")
FIELD = "field on the sensor"
# What a component says about camera or measurement, with its size, and what can be done about it.
REMARKS = {
    FIELD: "a field of {} common to all photographs, which the lens model does not have: ",
    "principal point by photograph": "the principal point moves by {} between photographs",
    "principal distance by photograph": "the principal distance changes between photographs, by {} "
    "at the edge of the image: keep focus and zoom fixed",
    "affine by photograph": "shear and ratio of scales change between photographs, by {} at the "
    "edge of the image: a rolling shutter, or film that is not flat",
    "along tracks": "errors of {} along the tracks of points, similar from neighbouring stations: "
    "measured against one image",
    "given points in plane": "given points, such as those of a board, are displaced in its "
    "plane, by {} in images: a stretched or inexact print; measure its squares, or estimate its "
    "points (--board-free)",
    "given points out of plane": "given points, such as those of a board, are out of its plane, by "
    "{} in images: use a flat board, or estimate its points (--board-free)",
}
# σ under correlated errors over classical ones from which the difference is a finding: five in a
# hundred exceed 1.96 classical σ where the model is right, thirteen at this ratio.
NOTABLE_RATIO = 1.3
# Of a network with photographs enough, where nobody has looked for correlated errors.
INDEPENDENCE = (
    "classical: the errors of image points are taken as independent; --correlated "
    "(correlated=True) looks for errors that they share, which make σ larger"
)
COMPONENT_HEADER = ("component", "size", "σ", "unit", "score")
SIGMA_HEADER = ("unknown", "σ classical", "σ correlated", "ratio")


def stated_sigma(columns: Mapping[str, np.ndarray], name: str) -> Float[np.ndarray, " rows"]:
    """The σ of a column of a table of images or points: the larger of the classical one and, where
    it is known, that under correlated errors."""
    return np.fmax(columns[f"s{name}"], columns.get(f"s{name}_correlated", columns[f"s{name}"]))


def stated_sigma_of(parameter: Mapping[str, Any]) -> float | None:
    """The same of a camera parameter; None where it is held."""
    known_sigma = (parameter["sigma"], parameter.get("sigma_correlated"))
    return max((sigma for sigma in known_sigma if sigma is not None), default=None)


def has_shared_errors(adjustment: "Adjustment") -> bool:
    """Whether σ under correlated errors are notably larger than classical ones."""
    return adjustment.sigma_ratio > NOTABLE_RATIO


def first_facts(adjustment: "Adjustment") -> list[tuple[str, str]]:
    """Replication and ratio of σ, for the first lines of a result."""
    rows = []
    if adjustment.replication is not None:
        rows.append(("Replication", adjustment.replication.sentence))
    if adjustment.error_model is not None:
        rows.append(
            (
                "σ shown",
                "the larger of the classical one and that under correlated errors, which is "
                f"{significant(adjustment.sigma_ratio, 3)} times the classical one (median of the "
                "orientations)",
            )
        )
    elif adjustment.assumes_independence:
        rows.append(("σ shown", INDEPENDENCE))
    return rows


def component_rows(adjustment: "Adjustment") -> list[tuple[str, str, str, str, str]]:
    """Name, size, σ, unit and score of every component."""
    unit = adjustment.image_unit
    return [
        (
            size.name,
            significant(size.size, 3),
            significant(size.sigma, 2),
            unit if size.unit == IMAGE else "a priori σ",
            "" if number == 0 else f"{size.score:.1f}",
        )
        for number, size in enumerate(not_none(adjustment.error_model).sizes)
    ]


def has_field(adjustment: "Adjustment") -> bool:
    """Whether image points share a field on the sensor, which the lens model does not have."""
    model = adjustment.error_model
    return model is not None and any(
        size.size > 0 and size.name.startswith(FIELD) for size in model.sizes
    )


def remarks(adjustment: "Adjustment") -> list[str]:
    """What the components that were found say, in sentences, the most significant first."""
    unit, sentences = adjustment.image_unit, []
    sizes = not_none(adjustment.error_model).sizes[1:]
    for size in sorted(sizes, key=lambda size_found: -size_found.score):
        # "given points out of plane" is a whole name, "principal distance … of cam" has a camera.
        whole = size.name in REMARKS
        name, in_camera, camera = (size.name, "", "") if whole else size.name.partition(" of ")
        if size.size > 0 and name in REMARKS:
            amount = f"{significant(size.size, 2)} {unit if size.unit == IMAGE else 'a priori σ'}"
            words = REMARKS[name].format(amount)
            if name == FIELD:
                poor = is_hardly_determined(adjustment, camera)
                words += ADVICE_ON_FIELD[advise_parameters(poor, True)]
            sentences.append((f"camera {clean(camera)}: " if in_camera else "") + words)
    return sentences


def sigma_rows(adjustment: "Adjustment") -> list[tuple[str, str, str, str]]:
    """Classical and correlated σ of the parameters of all cameras, and medians of the images and
    points, with their ratios."""
    rows = []
    has_several = len(adjustment.cameras) > 1
    for camera, entry in adjustment.cameras.items():
        for name, parameter in entry["parameters"].items():
            if "sigma_correlated" in parameter:
                rows.append(
                    _row(
                        f"{clean(camera)} {name}" if has_several else name,
                        parameter["sigma"],
                        parameter["sigma_correlated"],
                    )
                )
    for columns, names in (
        (adjustment.images, ("X0", "Y0", "Z0", "omega", "phi", "kappa")),
        (adjustment.points, "XYZ"),
    ):
        for name in names:
            classical, correlated = columns[f"s{name}"], columns[f"s{name}_correlated"]
            good = (classical > 0) & np.isfinite(classical) & np.isfinite(correlated)
            if good.any():
                rows.append(
                    _row(
                        f"{name} (median)", np.median(classical[good]), np.median(correlated[good])
                    )
                )
    return rows


def _row(name: str, classical: float, correlated: float) -> tuple[str, str, str, str]:
    ratio = correlated / classical if classical > 0 else np.nan
    return name, significant(classical, 3), significant(correlated, 3), significant(ratio, 3)


def difference_rows(split: "HalvesDifference") -> list[tuple[str, ...]]:
    """A split as text, a row a parameter (`DIFFERENCE_HEADER`)."""
    return [
        (
            f"{camera} {name}",
            significant(d, 3),
            significant(s, 2),
            f"{d / s:.1f}",
            significant(m, 2),
            f"{d / m:.1f}",
        )
        for (camera, name), d, s, m in zip(
            split.names, split.difference, split.sigma, split.sigma_correlated
        )
    ]


def not_looked_for(model: "ErrorModel") -> str:
    """Which components a model lacks, in a sentence; empty if none."""
    names_found = " ".join(size.name for size in model.sizes)
    if "by photograph" not in names_found:
        return (
            f"Errors of photographs and a {FIELD} were not looked for: they need eight "
            "photographs of a camera."
        )
    if FIELD not in names_found:
        return f"A {FIELD} was not looked for: it needs four image points for each of its splines."
    return ""


def correlated_lines(adjustment: "Adjustment") -> list[str]:
    """The section of a report; nothing if no error model was requested."""
    if why := adjustment.why_no_error_model:
        return [*heading(TITLE), *paragraph(f"Not looked for: {why}.")]
    if adjustment.error_model is None:
        return []
    lines = [*heading(TITLE), *table(COMPONENT_HEADER, component_rows(adjustment), "lrrlr"), ""]
    lines += [line for remark in remarks(adjustment) for line in paragraph(f"- {remark}", 0, 2)]
    lines += ["", *paragraph(LEGEND)]
    if words := not_looked_for(not_none(adjustment.error_model)):
        lines += paragraph(words)
    lines += ["", *table(SIGMA_HEADER, sigma_rows(adjustment), "lrrr")]
    return [*lines, *_replication_lines(adjustment)]


def _replication_lines(adjustment: "Adjustment") -> list[str]:
    replication = adjustment.replication
    if replication is None:
        return []
    lines = [*heading("Replication"), *paragraph(f"{replication.sentence}.")]
    for split in replication.splits:
        lines += ["", *table(DIFFERENCE_HEADER, difference_rows(split), "lrrrrr")]
    return [*lines, "", *paragraph(REPLICATION_LEGEND)]
