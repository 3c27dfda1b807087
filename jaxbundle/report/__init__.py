"""The report of an adjustment, and shorter forms of it.

    print(jaxbundle.report.text(adjustment, date="2024-05-02"))

The report is plain text of at most 100 characters per line: settings and datum, course of the
iterations, σ0 and the global test, cameras, images, points, residuals, reliability, variance
components, check points, distances. σ are a posteriori. A network that was not solved gets a short
report with reason and remedy, without numbers of a solution.
"""

from jaxbundle.report.head import unit_of_weight
from jaxbundle.report.summary import html, one_line, short
from jaxbundle.report.text_report import text
from jaxbundle.report.verdict import Verdict, conclude

__all__ = [
    "Verdict",
    "conclude",
    "html",
    "one_line",
    "short",
    "text",
    "unit_of_weight",
]
