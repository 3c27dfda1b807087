"""The uncertainty budget of an adjusted quantity after the GUM (JCGM 100:2008).

An adjusted quantity y is a function of its inputs x: the measurements, and what the adjustment
holds. Its combined standard uncertainty, effective degrees of freedom and expanded uncertainty are

    u_c² = Σ (c_i·u(x_i))²,     c_i = ∂y/∂x_i                                 5.1.2, equation (10)
    ν_eff = u_c⁴ / Σ (c_i·u(x_i))⁴/ν_i                                        G.4.1, equation (G.2b)
    U = k·u_c,     k = t_p(ν_eff)                                              6.2.1; G.3.2, (G.1d)

The sensitivity coefficients c_i are the derivatives of the solution itself, c = −λᵀ·∂g/∂l with
H·λ = ∂y/∂x, of the exact Hessian H (`leastsquares/quality/sensitivity.py`); of held quantities they
are −H⁻¹·∂g/∂θ. They include the curvature, which the covariance of the adjustment omits, and where
residuals are formed in the corrected image the scale of the correction, since u(x) is that of a
measured coordinate: without residuals, and in the measured image, both are equal.

| input | type | u(x) | ν |
|---|---|---|---|
| image coordinates | A | a priori σ times s, s² = Σ(v/σ)²/Σr over all of them | Σr |
| errors that image points share | A | √θ of each component (`error_components.py`) | 2·(θ/σ_θ)² |
| control, priors, distances, further kinds | B | their stated σ | infinite |
| the same with estimated components | A | σ times its factor | Σr of the group |
| held quantities | B | given, or from limits and a distribution (`HeldInput`) | given |

All image coordinates share one estimate s, so that they are one term of ν_eff. ν of a component
follows from its relative uncertainty, ν = ½·(Δu/u)⁻² (G.4.2, (G.3)), Δu/u = ½·σ_θ/θ; at least 1.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxbundle.adjustment.budget_inputs import (
    BudgetLine,
    Measurand,
    groups_of,
    held_lines,
    image_scale,
    shared_errors,
    unit_of_parameter,
)
from jaxbundle.adjustment.quality.fixed_quantities import split_name
from jaxbundle.adjustment.quality.requested_results import (
    CAMERAS,
    RequestedResult,
    RequestedResults,
    request_results,
)
from jaxbundle.adjustment.result import Adjustment
from jaxbundle.adjustment.result_tables import observations
from jaxbundle.arguments import number, show
from jaxbundle.cameras import get_model
from jaxbundle.cameras.coefficient_units import coefficient_unit
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError
from jaxbundle.leastsquares.quality.distributions import normal_quantile, t_quantile
from jaxbundle.leastsquares.quality.error_components import IndependentErrors
from jaxbundle.leastsquares.quality.sensitivity import pull_back
from jaxbundle.network.tables import EXTERIOR
from jaxbundle.report.layout import estimate, significant, table
from jaxbundle.results import TableMethods


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class UncertaintyBudget(TableMethods):
    """The uncertainty budgets of adjusted quantities.

    **Fields:** `measurands`; `lines`: groups of inputs; `coverage` probability of the expanded
    uncertainty; `sigma`: of the measurands from the covariance of the adjustment, to compare;
    `inputs`: columns kind, image, point, axis, uncertainty of every single measurement;
    `derivatives`: c of every single measurement. All in the units of the measurands.
    """

    measurands: tuple[Measurand, ...]
    lines: tuple[BudgetLine, ...]
    coverage: float
    sigma: Float[np.ndarray, " measurands"]
    inputs: dict[str, np.ndarray]
    derivatives: Float[np.ndarray, "inputs measurands"]

    @property
    def combined(self) -> Float[np.ndarray, " measurands"]:
        """u_c of every measurand."""
        return np.sqrt(sum(line.contribution**2 for line in self.lines))

    @property
    def degrees(self) -> Float[np.ndarray, " measurands"]:
        """ν_eff of every measurand (Welch and Satterthwaite)."""
        pools: dict[str, list[BudgetLine]] = {}
        for i, line in enumerate(self.lines):
            pools.setdefault(line.pool or str(i), []).append(line)
        share = np.zeros(len(self.measurands))
        for lines in pools.values():
            share += sum(line.contribution**2 for line in lines) ** 2 / lines[0].degrees
        is_known = share > 0
        return np.where(is_known, self.combined**4 / np.where(is_known, share, 1.0), np.inf)

    @property
    def k(self) -> Float[np.ndarray, " measurands"]:
        """The coverage factor of every measurand."""
        return np.array([coverage_factor(self.coverage, nu) for nu in self.degrees])

    @property
    def expanded(self) -> Float[np.ndarray, " measurands"]:
        """U = k·u_c of every measurand."""
        return self.k * self.combined

    def place(self, name: str | None = None) -> int:
        """The index of a measurand; by default the first.

        **Raises:** `KeyError` for one that has no budget."""
        names = [measurand.name for measurand in self.measurands]
        if name is not None and name not in names:
            raise KeyError(f"there is no budget of {name!r}; known: {', '.join(names)}")
        return 0 if name is None else names.index(name)

    def table(self) -> dict[str, np.ndarray]:
        """A row for every measurand and line, and one for the whole: measurand, input, number,
        type, distribution, degrees, uncertainty, unit, sensitivity, contribution, share (of u_c²),
        k, expanded (of the whole)."""
        rows, combined, degrees = [], self.combined, self.degrees
        k, expanded, nan = self.k, self.expanded, math.nan
        for m, measurand in enumerate(self.measurands):
            total = max(combined[m] ** 2, 1e-300)
            for line in self.lines:
                u = line.contribution[m]
                rows.append(
                    (
                        measurand.name,
                        line.words,
                        line.number,
                        line.kind,
                        line.distribution,
                        line.degrees,
                        line.uncertainty,
                        line.unit,
                        line.sensitivity[m],
                        u,
                        u * u / total,
                        nan,
                        nan,
                    )
                )
            rows.append(
                (
                    measurand.name,
                    TOTAL,
                    sum(line.number for line in self.lines),
                    "",
                    "",
                    degrees[m],
                    nan,
                    measurand.unit,
                    nan,
                    combined[m],
                    1.0,
                    k[m],
                    expanded[m],
                )
            )
        text = {"measurand", "input", "type", "distribution", "unit"}
        kinds = {name: object if name in text else float for name in COLUMN_NAMES}
        return {n: np.array(c, kinds[n]) for n, c in zip(COLUMN_NAMES, zip(*rows))}

    def measurements(self, name: str | None = None) -> dict[str, np.ndarray]:
        """Every single measurement with its part in a measurand (default: the first), the largest
        contribution first: kind, image, point, axis, uncertainty, sensitivity, contribution.

        **Raises:** `KeyError` for a measurand that has no budget."""
        c = self.derivatives[:, self.place(name)]
        contribution = np.abs(c) * self.inputs["uncertainty"]
        order = np.argsort(-contribution, kind="stable")
        columns = self.inputs | {"sensitivity": c, "contribution": contribution}
        return {n: column[order] for n, column in columns.items()}

    def rows(self, m: int = 0) -> list[tuple[str, ...]]:
        """The lines of a measurand as text, under `HEADER`."""
        total, text_rows = max(self.combined[m] ** 2, 1e-300), []
        for line in self.lines:
            u = float(line.contribution[m])
            text_rows.append(
                (
                    f"{line.number} × {line.words}" if line.number > 1 else line.words,
                    line.kind,
                    line.distribution,
                    "∞" if math.isinf(line.degrees) else f"{line.degrees:.0f}",
                    f"{significant(line.uncertainty)} {line.unit}".strip(),
                    significant(float(line.sensitivity[m])),
                    significant(u),
                    f"{100 * u * u / total:.1f}",
                )
            )
        return text_rows

    def result_rows(self) -> list[tuple[str, ...]]:
        """Every measurand with u_c, ν_eff, k and U as text, under `RESULT_HEADER`; U with two
        digits, the value to the same place (GUM 7.2.6)."""
        rows = []
        for measurand, u, nu, k, U in zip(
            self.measurands, self.combined, self.degrees, self.k, self.expanded
        ):
            value, value_text = estimate(measurand.value, float(U), 2)
            # With a decimal where it decides k: it is not truncated (GUM G.6.4).
            degrees_text = "∞" if nu > MANY_DEGREES else f"{nu:.1f}" if nu < 100 else f"{nu:.0f}"
            # u in the form of U: both with an exponent, or none
            combined = f"{u:.2e}" if "e" in value_text else significant(float(u))
            rows.append(
                (
                    measurand.words,
                    value,
                    value_text,
                    measurand.unit,
                    combined,
                    f"{k:.2f}",
                    degrees_text,
                )
            )
        return rows

    def to_dict(self) -> dict[str, Any]:
        """The budgets as plain dicts and numbers, as in JSON."""
        lines = [
            {
                "input": line.words,
                "number": line.number,
                "type": line.kind,
                "distribution": line.distribution,
                "degrees": line.degrees,
                "uncertainty": line.uncertainty,
                "unit": line.unit,
            }
            for line in self.lines
        ]
        budgets = {}
        for m, measurand in enumerate(self.measurands):
            parts = [(line.sensitivity[m], line.contribution[m]) for line in self.lines]
            budgets[measurand.name] = {
                "value": measurand.value,
                "unit": measurand.unit,
                "combined": float(self.combined[m]),
                "degrees": float(self.degrees[m]),
                "k": float(self.k[m]),
                "expanded": float(self.expanded[m]),
                "sigma": float(self.sigma[m]),
                "sensitivity": [float(c) for c, _ in parts],
                "contribution": [float(u) for _, u in parts],
            }
        return {"coverage": self.coverage, "inputs": lines, "measurands": budgets}

    def __str__(self) -> str:
        percent = f"{100 * self.coverage:.4g} %"
        lines = [
            f"Expanded uncertainties of {percent}",
            *table(RESULT_HEADER, self.result_rows(), "lrrlrrr"),
        ]
        for m, measurand in enumerate(self.measurands):
            lines += ["", f"Budget of {measurand.words}", *table(HEADER, self.rows(m), "lllrrrrr")]
        return "\n".join(lines)


TOTAL = "combined"
HEADER = ("input", "type", "distribution", "ν", "u(x)", "c", "|c|·u(x)", "share %")
RESULT_HEADER = ("quantity", "value", "U", "unit", "u", "k", "ν_eff")
# More degrees of freedom than this change k by less than 0.1 %: t − z ≈ (z³ + z)/(4ν) (Fisher and
# Cornish 1960), 2.4/ν of 1.96 at 95 %.
MANY_DEGREES = 2000
COLUMN_NAMES = (
    "measurand",
    "input",
    "number",
    "type",
    "distribution",
    "degrees",
    "uncertainty",
    "unit",
    "sensitivity",
    "contribution",
    "share",
    "k",
    "expanded",
)


def coverage_factor(coverage: float, degrees: float) -> float:
    """k with P(|t| ≤ k) = `coverage` of Student's distribution (GUM G.3.4)."""
    probability = (1 + coverage) / 2
    if math.isinf(degrees):
        return normal_quantile(probability)
    return t_quantile(probability, degrees)


def uncertainty_budget(
    given: Any,
    of: Any = CAMERAS,
    *,
    held: Mapping[Any, Any] | None = None,
    coverage: float = 0.95,
    units: Sequence[str] | str = "",
) -> UncertaintyBudget:
    """The uncertainty budget after the GUM of adjusted quantities.

    **Arguments:**

    - `given`: an `Adjustment`, or a result that has one as `adjustment`, such as a `Calibration`.
    - `of`: results by name as in `jaxbundle.sensitivity`, `"cameras"`, or a function of `Values`;
      one solution for each.
    - `held`: inputs that the adjustment holds, by name: a `HeldInput`, a standard uncertainty, or
      the amounts of one common error, as in `jaxbundle.sensitivity`. Angles in radians.
    - `coverage`: probability of the expanded uncertainty.
    - `units`: of the results of a function, for tables.

    **Returns:** an `UncertaintyBudget`.

    **Raises:** `InputError` for an unknown name, and for results that are means over images or
    points; `NotSolvedError` without a solution, or without redundancy of the image coordinates.
    """
    adjustment = getattr(given, "adjustment", given)
    if not isinstance(adjustment, Adjustment):
        raise InputError(
            f"expected a result of jaxbundle.adjust or jaxbundle.calibrate, got {show(given)}"
        )
    coverage = number("coverage", coverage)
    if not 0 < coverage < 1:
        raise InputError(f"coverage must be between 0 and 1, but is {coverage:g}")
    inspection = adjustment.cofactors
    results = request_results(inspection, IndependentErrors(inspection.solution, 1.0), of)
    if any(len(range(request.numbers.stop)[request.numbers]) > 1 for request in results.asked):
        raise InputError("name single results, such as point:7:Z; a mean over all has no budget")
    measurands = _measurands(adjustment, results, units)
    factor = np.array([request.factor for request in measurands])
    solution = inspection.solution
    slopes = {t: np.asarray(x) for t, x in solution.jacobian_of(results.function).items()}
    by_set = pull_back(solution, slopes)
    parts = list(
        observations(
            inspection.problem,
            *({o: x[r] * factor[r] for o, x in by_set.items()} for r in range(len(factor))),
        )
    )
    s, redundancy = image_scale(adjustment)
    shared = shared_errors(adjustment, slopes, factor, results.sigma)
    if shared and adjustment.error_model is not None:
        s = math.sqrt(float(adjustment.error_model.theta[0]))
    groups_of_inputs = [
        group
        for part in parts
        for group in groups_of(adjustment, part, s if part.kind == "image" else None, redundancy)
    ]
    lines = [line for group in groups_of_inputs for line in group.lines()]
    of_held = held_lines(adjustment, of, held, factor) if held else []
    sigma = factor * adjustment.sigma0 * results.sigma
    if shared and adjustment.error_model is not None:
        C = np.diagonal(adjustment.error_model.as_estimated.propagate_rows(slopes))
        sigma = factor * np.sqrt(np.clip(C, 0, None))
    single = [group.inputs() for group in groups_of_inputs]
    inputs = {
        name: np.concatenate([columns[name] for columns, _ in single]) for name in single[0][0]
    }
    derivatives = np.concatenate([c for _, c in single])
    return UncertaintyBudget(
        measurands, (*lines, *shared, *of_held), coverage, sigma, inputs, derivatives
    )


def _measurands(
    adjustment: Adjustment, results: RequestedResults, units: Sequence[str] | str
) -> tuple[Measurand, ...]:
    """The requested results with their values and units."""
    values = np.asarray(results.function(adjustment.values))
    units_of_results = [units] * len(results.asked) if isinstance(units, str) else list(units)
    if len(units_of_results) != len(results.asked):
        raise InputError(
            f"units: {len(units_of_results)} of {len(results.asked)} results are given"
        )
    measurands = []
    for request, unit in zip(results.asked, units_of_results):
        value = float(values[request.numbers][0])
        if request.angle:
            scale = adjustment.angle_scale
            unit = adjustment.network.angle_unit
            measurands.append(Measurand(request.name, request.words, value * scale, unit, scale))
            continue
        if ":" in request.name:
            value, unit = _value_of_name(adjustment, request, value)
        measurands.append(Measurand(request.name, request.words, value, unit))
    return tuple(measurands)


def _value_of_name(
    adjustment: Adjustment, request: RequestedResult, value: float
) -> tuple[float, str]:
    """The value of a named result in its frame, and its unit."""
    kind, id, parameter = split_name(request.name)
    if kind == "camera":
        camera = next(c for c in adjustment.problem.network.cameras if c.id == id)
        unit = unit_of_parameter(camera.model, parameter)
        return value, unit or coefficient_unit(get_model(camera.model), parameter)
    axes = EXTERIOR[:3] if kind == "image" else ("X", "Y", "Z")
    return value + float(adjustment.problem.origin[axes.index(parameter)]), (
        adjustment.network.object_unit
    )
