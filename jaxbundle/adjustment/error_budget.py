"""Error budget: effects on the results of held quantities that are not known exactly.

An error of one σ in a held quantity (a K3 fixed at 0, a lever arm, the flatness of a board, a fixed
control point) moves the solution by dx = −H⁻¹·(∂g/∂θ)·σ, exactly to first order
(`leastsquares/quality/sensitivity.py`). Independent errors add in squares, with each other and with
the σ of the result, which contains only the measurements:

    total² = σ² + Σ effect²
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxbundle.adjustment.problem import NetworkProblem
from jaxbundle.adjustment.quality.fixed_quantities import Cause, find_causes
from jaxbundle.adjustment.quality.inspection import Inspection
from jaxbundle.adjustment.quality.precision import predict
from jaxbundle.adjustment.quality.requested_results import (
    WORDS,
    RequestedResult,
    effects_on,
    request_results,
)
from jaxbundle.adjustment.result import Adjustment
from jaxbundle.arguments import show
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError
from jaxbundle.io.results.budget_json import budget_dict
from jaxbundle.leastsquares.indexing.reduction import FACTORS
from jaxbundle.leastsquares.problem import with_data, with_factor
from jaxbundle.leastsquares.quality.error_components import Errors, IndependentErrors
from jaxbundle.leastsquares.quality.sensitivity import follow
from jaxbundle.network.units import ANGLE_UNITS
from jaxbundle.report.budget import HEADER
from jaxbundle.report.layout import significant, table
from jaxbundle.results import TableMethods

MEASUREMENTS, TOTAL = "measurements", "total"


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class Budget(TableMethods):
    """Effects of errors of held quantities on results.

    **Fields:** `results` and `causes`, with names and descriptions; `sigma` of every result from
    the measurements (a posteriori, under the error model of the adjustment if it has one; for a
    design a priori); `effects` of an error of one σ of each
    cause on each result, signed if cause and result are one number each; else the root of the sum
    of squares over independent errors, or the root mean square over images or points. Angles in
    radians; `angle_scale`: factor to the unit of tables.
    """

    results: tuple[RequestedResult, ...]
    causes: tuple[Cause, ...]
    sigma: Float[np.ndarray, " results"]
    effects: Float[np.ndarray, "causes results"]
    angle_scale: float = 1.0

    @property
    def total(self) -> Float[np.ndarray, " results"]:
        """σ of every result with all causes."""
        return np.sqrt(self.sigma**2 + (self.effects**2).sum(0))

    @property
    def shares(self) -> Float[np.ndarray, "causes+1 results"]:
        """The share of the measurements (first) and of each cause in the squared total."""
        squares = np.concatenate([self.sigma[None], self.effects]) ** 2
        return squares / np.maximum(squares.sum(0), 1e-300)

    def table(self) -> dict[str, np.ndarray]:
        """A row for every result and cause, including the measurements and the total: result,
        cause, sigma (of the cause), effect, share (of the squared total)."""
        rows, shares, total = [], self.shares, self.total
        for r, result in enumerate(self.results):
            unit = self.angle_scale if result.angle else 1.0
            rows.append((result.name, MEASUREMENTS, np.nan, self.sigma[r] * unit, shares[0, r]))
            for c, cause in enumerate(self.causes):
                cause_sigma = np.nan if cause.sigma is None else cause.sigma
                cause_sigma *= self.angle_scale if cause.angle else 1.0
                rows.append(
                    (
                        result.name,
                        cause.name,
                        cause_sigma,
                        self.effects[c, r] * unit,
                        shares[c + 1, r],
                    )
                )
            rows.append((result.name, TOTAL, np.nan, total[r] * unit, 1.0))
        names = ("result", "cause", "sigma", "effect", "share")
        columns = dict(zip(names, zip(*rows)))
        text = {"result", "cause"}
        return {n: np.array(c, object if n in text else float) for n, c in columns.items()}

    def to_dict(self) -> dict[str, Any]:
        """The budget as plain dicts and numbers, as in JSON."""
        return budget_dict(self)

    def rows(self) -> list[tuple[str, str, str, str, str]]:
        """`table` as formatted text, under `report.budget.HEADER`."""
        text_rows, columns = [], self.table()
        words = {MEASUREMENTS: "the measurements", TOTAL: "all together"}
        words |= {cause.name: cause.words for cause in self.causes}
        words_of, previous = {result.name: result.words for result in self.results}, ""
        for name, cause, sigma, effect, share in zip(*columns.values()):
            result_words = words_of[name] if name != previous else ""
            previous = name
            part = "" if cause == TOTAL else f"{100 * share:.1f}"
            sigma_text = "" if np.isnan(sigma) else f"{sigma:.4g}"
            text_rows.append((result_words, words[cause], sigma_text, significant(effect), part))
        return text_rows

    def __str__(self) -> str:
        return "\n".join(table(HEADER, self.rows(), "llrrr"))


def sensitivity(
    given: Adjustment | NetworkProblem, held: Mapping[Any, Any], of: Any = WORDS
) -> Budget:
    """The effect of an error of given σ in each held quantity on each result.

    **Arguments:**

    - `given`: an `Adjustment`; or a `NetworkProblem`, a design: its start values are taken as
      adjusted, σ are a priori, and its image coordinates are not used.
    - `held`: σ of the error by name. A name is KIND:ID:NAME, such as `"camera:cam:K3"`,
      `"image:12:X0"`, `"point:7:Z"`, `"lever arm:cam:az"`, or a tuple of the three; `*` as id or
      name stands for all held ones, with independent errors. Or, under any name, the names and
      amounts of one common error: `{"bent board": {"point:1:Z": 0.2, …}}`. Angles in radians.
    - `of`: results, by name as in `held`, or `"cameras"` (all free parameters), `"images"` and
      `"points"` (root mean square over those not held); or a function of `Values` returning one or
      several numbers. Default: the three words.

    **Returns:** a `Budget`.

    **Raises:** `InputError` for an unknown name, an estimated quantity in `held`, or a σ that is
    not positive; `NotSolvedError` without a solution.
    """
    inspection, errors, unit = inspection_of(given)
    solution = inspection.solution
    causes = find_causes(inspection.problem, solution.values, held)
    results = request_results(inspection, errors, of)
    changes = [change for cause in causes for change in cause.errors]
    # dx = −H⁻¹·(∂g/∂θ)·σ for every error at once, then along the results: no adjustment is
    # repeated.
    parts = [
        effects_on(results, solution.values, tangents) for tangents in follow(solution, changes)
    ]
    effects = np.concatenate(parts)
    ends = np.cumsum([0, *(len(cause.errors) for cause in causes)])
    by_cause = np.array(
        [
            [root_sum_of_squares(asked.combine(effects[a:b])) for asked in results.asked]
            for a, b in zip(ends, ends[1:])
        ]
    )
    return Budget(results.asked, tuple(causes), results.sigma, by_cause, unit)


def root_sum_of_squares(effects: Float[np.ndarray, " k"]) -> float:
    """The root sum of squares of independent errors; a single one keeps its sign."""
    return float(effects[0]) if len(effects) == 1 else float(np.sqrt((effects**2).sum()))


def inspection_of(design: Any) -> tuple[Inspection, Errors, float]:
    """The inspection of an adjustment or a design, the errors of its observations (of a design a
    priori), and the factor from radians to its unit of angles.

    **Raises:** `InputError` for other arguments, or if no factor fits into memory."""
    if isinstance(design, NetworkProblem):
        design = with_factor(design)
        if design.reduction not in FACTORS:
            raise InputError("the network is too large for its covariance; use a part of it")
        # Residuals of a design are 0: its response has no part of second order.
        design = with_data(design, predict(design, design.data))
        inspection = Inspection(design, design.data.start)
        unit = 1 / ANGLE_UNITS[design.network.angle_unit]
        return inspection, IndependentErrors(inspection.solution, 1.0), unit
    if not isinstance(design, Adjustment):
        raise InputError(
            f"expected a result of jaxbundle.adjust or jaxbundle.make_problem, got {show(design)}"
        )
    return design.cofactors, design.errors, design.angle_scale
