"""Correlated errors in a report: their components, and the σ under them."""

from typing import TYPE_CHECKING

import numpy as np

from jaxbundle.report.layout import clean, heading, paragraph, significant, table
from jaxbundle.types import present

if TYPE_CHECKING:
    from jaxbundle.adjustment.result import Adjustment

TITLE = "Correlated errors"
LEGEND = (
    "Size: standard deviation of the effect on an image coordinate; that of a principal distance "
    "and of an affine distortion at the edge of the measured area. Score: how far the residuals "
    "exceed those of independent errors, in σ. The estimates are those of least squares; only "
    "their σ change."
)


def component_rows(adjustment: "Adjustment") -> list[tuple[str, str, str, str, str]]:
    """Name, size, σ, unit and score of every component."""
    unit = adjustment.image_unit
    return [
        (
            size.name,
            significant(size.size, 3),
            significant(size.sigma, 2),
            unit if size.unit == "image" else "a priori σ",
            "" if number == 0 else f"{size.score:.1f}",
        )
        for number, size in enumerate(present(adjustment.error_model).sizes)
    ]


def sigma_rows(adjustment: "Adjustment") -> list[tuple[str, str, str, str]]:
    """Classical and correlated σ of the parameters of all cameras, and medians of the images and
    points, with their ratios."""
    rows = []
    several = len(adjustment.cameras) > 1
    for camera, entry in adjustment.cameras.items():
        for name, found in entry["parameters"].items():
            if "sigma_correlated" in found:
                rows.append(
                    _row(
                        f"{clean(camera)} {name}" if several else name,
                        found["sigma"],
                        found["sigma_correlated"],
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


def correlated_lines(adjustment: "Adjustment") -> list[str]:
    """The section of a report; nothing without an error model."""
    if adjustment.error_model is None:
        return []
    header = ("component", "size", "σ", "unit", "score")
    lines = [*heading(TITLE), *table(header, component_rows(adjustment), "lrrlr"), ""]
    lines += paragraph(LEGEND)
    found = " ".join(size.name for size in present(adjustment.error_model).sizes)
    if "by photograph" not in found:
        lines += paragraph(
            "Errors of photographs and a field on the sensor were not looked for: they need eight "
            "photographs of a camera."
        )
    elif "field on the sensor" not in found:
        lines += paragraph(
            "A field on the sensor was not looked for: it needs four image points for each of its "
            "splines."
        )
    header = ("unknown", "σ classical", "σ correlated", "ratio")
    return [*lines, "", *table(header, sigma_rows(adjustment), "lrrr")]
