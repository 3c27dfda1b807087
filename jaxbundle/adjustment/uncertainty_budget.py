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

from jaxbundle.adjustment.error_budget import sensitivity
from jaxbundle.adjustment.influence import COLUMNS
from jaxbundle.adjustment.quality.fixed_quantities import split_name
from jaxbundle.adjustment.quality.requested_results import (
    CAMERAS,
    RequestedResult,
    RequestedResults,
    request_results,
)
from jaxbundle.adjustment.quality.variance_groups import groups
from jaxbundle.adjustment.result import Adjustment
from jaxbundle.adjustment.result_tables import KindRows, observations
from jaxbundle.arguments import number, positive, show
from jaxbundle.cameras import CameraModel, get_model
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.leastsquares.quality.distributions import normal_quantile, t_quantile
from jaxbundle.leastsquares.quality.error_components import OTHERS, IndependentErrors, effects
from jaxbundle.leastsquares.quality.sensitivity import pull_back
from jaxbundle.network.tables import EXTERIOR
from jaxbundle.report.layout import estimate, significant, table
from jaxbundle.results import TableMethods, rows_of

# The standard uncertainty of limits ±a is a divided by this: rectangular √3 (GUM 4.3.7, (7)),
# triangular √6 (4.3.9, (9b)), U-shaped, of a sinusoidal influence, √2 (example H.1.3.4).
DIVISORS = {
    "normal": 1.0,
    "rectangular": math.sqrt(3.0),
    "triangular": math.sqrt(6.0),
    "u-shaped": math.sqrt(2.0),
}
# Of a kind with no more inputs than this every one has its line, as scale bars have; of more, and
# of image coordinates, one line an axis says more. The table of inputs always has all.
SINGLE_LINES = 8


@dataclasses.dataclass(frozen=True)
class HeldInput:
    """What is known of a quantity that the adjustment holds: its standard `uncertainty`, in the
    unit of the quantity (radians of angles); the `distribution` that it is from; `degrees` of
    freedom; its description in `words`."""

    uncertainty: float
    distribution: str = "normal"
    degrees: float = math.inf
    words: str = ""

    def __post_init__(self):
        positive("uncertainty", self.uncertainty)
        if self.distribution not in DIVISORS:
            raise InputError(
                f"distribution {show(self.distribution)}: one of {', '.join(DIVISORS)} is expected"
            )

    @classmethod
    def from_limits(cls, half_width: float, distribution: str = "rectangular") -> "HeldInput":
        """Of limits ± `half_width` (GUM 4.3.7 to 4.3.9); of `"normal"`, it is the standard
        uncertainty."""
        divisor = DIVISORS.get(distribution, 1.0)
        return cls(positive("half_width", half_width) / divisor, distribution)

    @classmethod
    def from_expanded(cls, expanded: float, k: float = 2.0) -> "HeldInput":
        """Of an expanded uncertainty U = k·u, as certificates state it (GUM 4.3.3)."""
        return cls(positive("expanded", expanded) / positive("k", k))


@dataclasses.dataclass(frozen=True)
class Measurand:
    """An adjusted quantity: `name`, in `words`, its `value` in `unit`; `factor` from radians of
    angles to the unit, else 1."""

    name: str
    words: str
    value: float
    unit: str
    factor: float = 1.0


@dataclasses.dataclass(frozen=True)
class BudgetLine:
    """Inputs of one kind: in `words`, their `number`; `kind`, "A" or "B"; `distribution`;
    `degrees` of freedom; `uncertainty` u(x), of several the root mean square, in `unit`;
    `sensitivity` c of every measurand (of several inputs √Σc², of one input with its sign);
    `contribution` |c|·u(x) of all inputs together; `pool`: lines of one pool share an estimate of
    their uncertainty, and are one term of ν_eff."""

    words: str
    number: int
    kind: str
    distribution: str
    degrees: float
    uncertainty: float
    unit: str
    sensitivity: Float[np.ndarray, " measurands"]
    contribution: Float[np.ndarray, " measurands"]
    pool: str = ""


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
        known = share > 0
        return np.where(known, self.combined**4 / np.where(known, share, 1.0), np.inf)

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
        names = [one.name for one in self.measurands]
        if name is not None and name not in names:
            raise KeyError(f"there is no budget of {name!r}; known: {', '.join(names)}")
        return 0 if name is None else names.index(name)

    def table(self) -> dict[str, np.ndarray]:
        """A row for every measurand and line, and one for the whole: measurand, input, number,
        type, distribution, degrees, uncertainty, unit, sensitivity, contribution, share (of u_c²),
        k, expanded (of the whole)."""
        rows, combined, degrees = [], self.combined, self.degrees
        k, expanded, nan = self.k, self.expanded, math.nan
        for m, one in enumerate(self.measurands):
            total = max(combined[m] ** 2, 1e-300)
            for line in self.lines:
                u = line.contribution[m]
                rows.append(
                    (
                        one.name,
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
                    one.name,
                    TOTAL,
                    sum(line.number for line in self.lines),
                    "",
                    "",
                    degrees[m],
                    nan,
                    one.unit,
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
        total, found = max(self.combined[m] ** 2, 1e-300), []
        for line in self.lines:
            u = float(line.contribution[m])
            found.append(
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
        return found

    def result_rows(self) -> list[tuple[str, ...]]:
        """Every measurand with u_c, ν_eff, k and U as text, under `RESULT_HEADER`; U with two
        digits, the value to the same place (GUM 7.2.6)."""
        rows = []
        for one, u, nu, k, U in zip(
            self.measurands, self.combined, self.degrees, self.k, self.expanded
        ):
            value, said = estimate(one.value, float(U), 2)
            shown = "∞" if nu > MANY_DEGREES else f"{nu:.0f}"
            rows.append(
                (
                    one.words,
                    value,
                    said,
                    one.unit,
                    significant(float(u)),
                    f"{k:.2f}",
                    shown,
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
        found = {}
        for m, one in enumerate(self.measurands):
            parts = [(line.sensitivity[m], line.contribution[m]) for line in self.lines]
            found[one.name] = {
                "value": one.value,
                "unit": one.unit,
                "combined": float(self.combined[m]),
                "degrees": float(self.degrees[m]),
                "k": float(self.k[m]),
                "expanded": float(self.expanded[m]),
                "sigma": float(self.sigma[m]),
                "sensitivity": [float(c) for c, _ in parts],
                "contribution": [float(u) for _, u in parts],
            }
        return {"coverage": self.coverage, "inputs": lines, "measurands": found}

    def single_inputs(self) -> list[dict[str, Any]]:
        """Every single measurement, one dict each."""
        return rows_of(self.measurements())

    def __str__(self) -> str:
        percent = f"{100 * self.coverage:.4g} %"
        lines = [
            f"Expanded uncertainties of {percent}",
            *table(RESULT_HEADER, self.result_rows(), "lrrlrrr"),
        ]
        for m, one in enumerate(self.measurands):
            lines += ["", f"Budget of {one.words}", *table(HEADER, self.rows(m), "lllrrrrr")]
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
            f"a result of jaxbundle.adjust or jaxbundle.calibrate is expected, not {show(given)}"
        )
    coverage = number("coverage", coverage)
    if not 0 < coverage < 1:
        raise InputError(f"coverage must be between 0 and 1, but is {coverage:g}")
    inspection = adjustment.cofactors
    results = request_results(inspection, IndependentErrors(inspection.solution, 1.0), of)
    if any(len(range(one.numbers.stop)[one.numbers]) > 1 for one in results.asked):
        raise InputError("name single results, such as point:7:Z; a mean over all has no budget")
    measurands = _measurands(adjustment, results, units)
    factor = np.array([one.factor for one in measurands])
    found = inspection.solution
    slopes = {t: np.asarray(x) for t, x in found.slopes(results.function).items()}
    by_set = pull_back(found, slopes)
    parts = list(
        observations(
            inspection.problem,
            *({o: x[r] * factor[r] for o, x in by_set.items()} for r in range(len(factor))),
        )
    )
    s, redundancy = _image_scale(adjustment)
    shared = _shared_errors(adjustment, slopes, factor, results.sigma)
    if shared and adjustment.error_model is not None:
        s = math.sqrt(float(adjustment.error_model.theta[0]))
    groups_of_inputs = [
        group
        for part in parts
        for group in _groups_of(adjustment, part, s if part.kind == "image" else None, redundancy)
    ]
    lines = [line for group in groups_of_inputs for line in group.lines()]
    held_lines = _held_lines(adjustment, of, held, factor) if held else []
    sigma = factor * adjustment.sigma0 * results.sigma
    if shared and adjustment.error_model is not None:
        C = np.diagonal(adjustment.error_model.propagate_rows(slopes))
        sigma = factor * np.sqrt(np.clip(C, 0, None))
    single = [group.inputs() for group in groups_of_inputs]
    inputs = {
        name: np.concatenate([columns[name] for columns, _ in single]) for name in single[0][0]
    }
    derivatives = np.concatenate([c for _, c in single])
    return UncertaintyBudget(
        measurands, (*lines, *shared, *held_lines), coverage, sigma, inputs, derivatives
    )


def _measurands(
    adjustment: Adjustment, results: RequestedResults, units: Sequence[str] | str
) -> tuple[Measurand, ...]:
    """The requested results with their values and units."""
    values = np.asarray(results.function(adjustment.values))
    named = [units] * len(results.asked) if isinstance(units, str) else list(units)
    if len(named) != len(results.asked):
        raise InputError(f"units: {len(named)} of {len(results.asked)} results are given")
    found = []
    for one, unit in zip(results.asked, named):
        value = float(values[one.numbers][0])
        if one.angle:
            scale = adjustment.angle_scale
            unit = adjustment.network.angle_unit
            found.append(Measurand(one.name, one.words, value * scale, unit, scale))
            continue
        if ":" in one.name:
            value, unit = _named(adjustment, one, value)
        found.append(Measurand(one.name, one.words, value, unit))
    return tuple(found)


def _named(adjustment: Adjustment, one: RequestedResult, value: float) -> tuple[float, str]:
    """The value of a named result in its frame, and its unit."""
    kind, id, parameter = split_name(one.name)
    if kind == "camera":
        camera = next(c for c in adjustment.problem.network.cameras if c.id == id)
        return value, unit_of_parameter(camera.model, parameter)
    axes = EXTERIOR[:3] if kind == "image" else ("X", "Y", "Z")
    return value + float(adjustment.problem.origin[axes.index(parameter)]), (
        adjustment.network.object_unit
    )


def unit_of_parameter(model: str | CameraModel, parameter: str) -> str:
    """The unit of a camera parameter: that of image coordinates of a principal distance and a
    principal point; none of others, whose unit depends on the power of their term."""
    found = get_model(model)
    own = (*found.principal_distance, *found.principal_point)
    return found.unit if parameter in own else ""


def _image_scale(adjustment: Adjustment) -> tuple[float, float]:
    """s = √(Σ(v/σ)²/Σr) of all image coordinates, and Σr.

    **Raises:** `NotSolvedError` without redundancy."""
    rows = adjustment.residuals
    image = rows["kind"] == "image"
    redundancy = float(rows["r"][image].sum())
    if redundancy < 1e-6:  # nothing but rounding
        raise NotSolvedError("no redundancy of the image coordinates: their σ cannot be estimated")
    normalised = rows["v"][image] / rows["sigma"][image]
    return math.sqrt(float(normalised @ normalised) / redundancy), redundancy


@dataclasses.dataclass(frozen=True)
class _InputGroup:
    """Inputs of one kind and axis: columns, standard uncertainties, and c of every measurand."""

    words: str
    kind: str
    degrees: float
    unit: str
    columns: dict[str, np.ndarray]
    uncertainty: Float[np.ndarray, " n"]
    derivatives: Float[np.ndarray, "n measurands"]
    pool: str
    single: bool

    def lines(self) -> list[BudgetLine]:
        """One line for each of a few inputs, or one for all."""
        every = np.arange(len(self.uncertainty))
        places = every[:, None] if self.single else [every]
        return [self._line(rows) for rows in places if len(rows)]

    def _line(self, rows: np.ndarray) -> BudgetLine:
        c, u = self.derivatives[rows], self.uncertainty[rows]
        single = len(rows) == 1
        words = self.words
        if self.single:
            ids = [str(self.columns[name][rows[0]]) for name in ("image", "point")]
            words = f"{words} {' – '.join(id for id in ids if id)}".strip()
        return BudgetLine(
            words,
            len(rows),
            self.kind,
            "normal",
            self.degrees,
            float(np.sqrt(np.mean(u**2))),
            self.unit,
            c[0] if single else np.sqrt((c**2).sum(0)),
            np.sqrt(((c * u[:, None]) ** 2).sum(0)),
            self.pool,
        )

    def inputs(self) -> tuple[dict[str, np.ndarray], Float[np.ndarray, "n measurands"]]:
        return self.columns | {"uncertainty": self.uncertainty}, self.derivatives


IMAGE_POOL = "image coordinates"


def _groups_of(
    adjustment: Adjustment, part: KindRows, scale: float | None, redundancy: float
) -> list[_InputGroup]:
    """The inputs of a kind of observation by axis, and of image coordinates by camera."""
    found, factors = [], adjustment.sigma_factors
    effect = np.stack(part.quantities, -1)
    columns = {name: column(*part[:4]) for name, column in COLUMNS.items()}
    shape = part.inverse_sigma.shape
    cameras: list[tuple[str, Any]] = [("", slice(None))]
    network = adjustment.problem.network
    if part.kind == "image" and len(network.cameras) > 1:
        of_ray = np.asarray(adjustment.problem.camera)
        cameras = [
            (f", camera {one.id}", of_ray == c)
            for c, one in enumerate(network.cameras)
            if (of_ray == c).any()
        ]
    estimated = _estimated_degrees(adjustment) if scale is None and factors else {}
    for camera, chosen in cameras:
        for k, axis in enumerate(part.axes):
            rows = np.zeros(shape, bool)
            rows[chosen, k] = True
            rows &= part.inverse_sigma > 0
            if not rows.any():
                continue
            conversion, unit = part.units[k]
            inverse = part.inverse_sigma[rows]
            u = (scale or 1.0) / inverse
            # effects are of one σ a priori: c = effect/σ
            c = effect[rows] * inverse[:, None]
            degrees = redundancy if scale is not None else estimated.get(part.kind, math.inf)
            found.append(
                _InputGroup(
                    _words(part.kind, axis) + camera,
                    "A" if scale is not None or part.kind in estimated else "B",
                    degrees,
                    unit,
                    {name: column.reshape(shape)[rows] for name, column in columns.items()},
                    u * conversion,
                    c / conversion,
                    IMAGE_POOL if scale is not None else "",
                    scale is None and int((part.inverse_sigma > 0).sum()) <= SINGLE_LINES,
                )
            )
    return found


def _words(kind: str, axis: str) -> str:
    if kind == "image":
        return f"image coordinate {axis}"
    if kind == "distance":
        return "distance"
    return f"{kind} {axis}"


def _estimated_degrees(adjustment: Adjustment) -> dict[str, float]:
    """Σr of the observations whose σ were estimated, by kind: one estimate for all of a kind."""
    rows, found = adjustment.residuals, {}
    changed = {name for name, f in adjustment.sigma_factors.items() if f != 1}
    known = {group.name for group in groups(adjustment.problem)}
    for kind in {*rows["kind"].tolist()} - {"image"}:
        # as the groups are named: "control points in X", "distances", "interior orientation"
        part = "orientation" if kind == "prior" else kind.rstrip("s")
        if any(part in name for name in changed & known):
            found[kind] = float(rows["r"][rows["kind"] == kind].sum())
    return found


def _shared_errors(
    adjustment: Adjustment,
    slopes: Mapping[str, Float[np.ndarray, "f rows width"]],
    factor: Float[np.ndarray, " f"],
    sigma: Float[np.ndarray, " f"],
) -> list[BudgetLine]:
    """A line for each component of errors that image points share; none where these do not make
    the standard uncertainties larger, as a rule of all measurands."""
    model = adjustment.error_model
    if model is None:
        return []
    modelled = np.diagonal(model.propagate_rows(slopes))
    if not np.mean(modelled / np.maximum((model.found.sigma0 * sigma) ** 2, 1e-300)) > 1:
        return []
    D = effects(model.found, slopes)
    lines = []
    for theta, spread, component in zip(model.theta[1:], model.theta_sigma[1:], model.components):
        if not theta > 0 or component.name == OTHERS:
            continue
        size = np.sqrt((np.asarray(component.root.T @ D.T) ** 2).sum(0)) * factor
        # a size that is hardly determined: no estimate has less than one degree of freedom
        degrees = max(2 * (theta / spread) ** 2, 1.0) if spread > 0 else math.inf
        unit = adjustment.image_unit if component.unit == "image" else ""
        lines.append(
            BudgetLine(
                f"shared error: {component.name}",
                1,
                "A",
                "normal",
                float(degrees),
                math.sqrt(theta),
                unit,
                size,
                size * math.sqrt(theta),
            )
        )
    return lines


def _held_lines(
    adjustment: Adjustment, of: Any, held: Mapping[Any, Any], factor: Float[np.ndarray, " f"]
) -> list[BudgetLine]:
    """A line for each input that the adjustment holds."""
    inputs = {name: _held_input(name, given) for name, given in held.items()}
    sigmas = {
        name: given.uncertainty if isinstance(given, HeldInput) else given
        for name, given in inputs.items()
    }
    budget = sensitivity(adjustment, sigmas, of)
    lines = []
    for effect, cause, given in zip(budget.effects, budget.causes, inputs.values()):
        known = given if isinstance(given, HeldInput) else HeldInput(1.0)
        # a common error has no single σ: its line has that of its amounts, 1
        u = known.uncertainty
        scale = adjustment.angle_scale if cause.angle else 1.0
        unit = _unit_of_cause(adjustment, cause.name, cause.angle)
        lines.append(
            BudgetLine(
                known.words or cause.words,
                len(cause.errors),
                "B",
                known.distribution,
                known.degrees,
                u * scale,
                unit,
                effect * factor / (u * scale),
                np.abs(effect * factor),
            )
        )
    return lines


def _held_input(name: Any, given: Any) -> "HeldInput | Mapping":
    if isinstance(given, HeldInput | Mapping):
        return given
    return HeldInput(positive(f"the σ of {name}", given))


def _unit_of_cause(adjustment: Adjustment, name: str, angle: bool) -> str:
    if angle:
        return adjustment.network.angle_unit
    if name.count(":") < 2:
        return ""
    kind, id, parameter = split_name(name)
    if kind == "camera":
        cameras = adjustment.problem.network.cameras
        camera = next((c for c in cameras if c.id == id), cameras[0])
        return unit_of_parameter(camera.model, parameter)
    return adjustment.network.object_unit if kind in ("image", "point") else ""
