"""The report of an adjustment as text, section by section, of at most 100 characters per line."""

from typing import TYPE_CHECKING

from jaxbundle.report import head, observations, unknowns
from jaxbundle.report.budget import budget_lines
from jaxbundle.report.correlated import correlated_lines
from jaxbundle.report.verdict import Verdict

if TYPE_CHECKING:
    from jaxbundle.adjustment.error_budget import Budget
    from jaxbundle.adjustment.result import Adjustment


def text(
    adjustment: "Adjustment",
    residual_limit: float = 3.0,
    *,
    date: str | None = None,
    test: str = "pope",
    max_rows: int = 200,
    accuracy_unit: float | None = None,
    budget: "Budget | None" = None,
    verdict: Verdict | None = None,
) -> str:
    """The full report of an adjustment.

    **Arguments:**

    - `residual_limit`: residuals whose test value is larger are listed one by one.
    - `date`: printed in the head as given; omitted by default, so that the same
      adjustment always gives the same report.
    - `test`: the test of the limit, `"pope"` (τ, σ a posteriori) or `"baarda"` (w, σ a priori).
    - `max_rows`: largest number of listed images, points, check points and distances.
    - `accuracy_unit`: points are counted by σ in classes of 0.1, 0.5, 1, 2 and 4 times this length
      (object unit); None: times the median of all σ of the points.
    - `budget`: the error budget of the adjustment (`jaxbundle.sensitivity`), a section at the end.
    - `verdict`: that of a command which has further tests, instead of the adjustment's.

    **Returns:** text that ends with a line feed.
    """
    if test not in observations.TESTS:
        raise ValueError(f'test must be "pope" or "baarda", not {test!r}')
    lines = head.title(adjustment, date)
    lines += [*head.settings(adjustment, verdict), *head.counts(adjustment)]
    if not adjustment.converged:
        lines += [*head.why_not_solved(adjustment), *head.messages(adjustment)]
        return _join(lines)
    lines += head.convergence(adjustment)
    lines += head.variance_factor(adjustment)
    lines += head.messages(adjustment)
    lines += unknowns.cameras(adjustment)
    lines += unknowns.images(adjustment, max_rows)
    lines += unknowns.points(adjustment, max_rows, accuracy_unit)
    lines += unknowns.far_points(adjustment, max_rows)
    lines += unknowns.further_unknowns(adjustment, max_rows)
    lines += observations.check_points(adjustment, max_rows)
    lines += observations.predicted_control(adjustment, max_rows)
    lines += observations.distances(adjustment, max_rows)
    lines += observations.residuals(adjustment, residual_limit, test)
    lines += observations.redundancy(adjustment)
    lines += observations.components(adjustment)
    lines += correlated_lines(adjustment)
    lines += observations.downweighted(adjustment, max_rows)
    lines += observations.removals(adjustment)
    lines += [] if budget is None else budget_lines(budget)
    return _join(lines)


def _join(lines: list[str]) -> str:
    return "\n".join(line.rstrip() for line in lines) + "\n"
