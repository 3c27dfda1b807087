"""The inputs of an uncertainty budget (`uncertainty_budget.py`): measurements in groups, errors
that image points share, and what the adjustment holds."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxbundle.adjustment.error_budget import sensitivity
from jaxbundle.adjustment.influence import COLUMNS
from jaxbundle.adjustment.quality.fixed_quantities import split_name
from jaxbundle.adjustment.quality.variance_groups import groups
from jaxbundle.adjustment.result import Adjustment
from jaxbundle.adjustment.result_tables import KindRows
from jaxbundle.arguments import positive, show
from jaxbundle.cameras import CameraModel, get_model
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.leastsquares.quality.error_components import OTHERS
from jaxbundle.leastsquares.quality.error_effects import effects

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
IMAGE_POOL = "image coordinates"


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
        if self.degrees != math.inf:
            positive("degrees", self.degrees)
        if self.distribution not in DIVISORS:
            raise InputError(
                f"distribution {show(self.distribution)}: expected one of {', '.join(DIVISORS)}"
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


def unit_of_parameter(model: str | CameraModel, parameter: str) -> str:
    """The unit of a camera parameter: that of image coordinates of a principal distance and a
    principal point; none of others, whose unit depends on the power of their term."""
    camera_model = get_model(model)
    lengths_in_image = (*camera_model.principal_distance, *camera_model.principal_point)
    return camera_model.unit if parameter in lengths_in_image else ""


@dataclasses.dataclass(frozen=True)
class InputGroup:
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
        indices = np.arange(len(self.uncertainty))
        places = indices[:, None] if self.single else [indices]
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


def groups_of(
    adjustment: Adjustment, part: KindRows, scale: float | None, redundancy: float
) -> list[InputGroup]:
    """The inputs of a kind of observation by axis, and of image coordinates by camera."""
    input_groups, factors = [], adjustment.sigma_factors
    effect = np.stack(part.quantities, -1)
    columns = {name: column(*part[:4]) for name, column in COLUMNS.items()}
    shape = part.inverse_sigma.shape
    cameras: list[tuple[str, Any]] = [("", slice(None))]
    network = adjustment.problem.network
    if part.kind == "image" and len(network.cameras) > 1:
        of_ray = np.asarray(adjustment.problem.camera)
        cameras = [
            (f", camera {camera_of_network.id}", of_ray == c)
            for c, camera_of_network in enumerate(network.cameras)
            if (of_ray == c).any()
        ]
    estimated = _estimated_degrees(adjustment) if scale is None and factors else {}
    for camera, rays in cameras:
        for k, axis in enumerate(part.axes):
            rows = np.zeros(shape, bool)
            rows[rays, k] = True
            rows &= part.inverse_sigma > 0
            if not rows.any():
                continue
            conversion, unit = part.units[k]
            inverse = part.inverse_sigma[rows]
            # A size of zero is an estimate, too: all errors are in the shared components.
            u = (1.0 if scale is None else scale) / inverse
            # Effects are of one σ a priori: c = effect/σ.
            c = effect[rows] * inverse[:, None]
            place = part.set_name, k
            degrees = redundancy if scale is not None else estimated.get(place, math.inf)
            input_groups.append(
                InputGroup(
                    _words(part.kind, axis) + camera,
                    "A" if scale is not None or place in estimated else "B",
                    degrees,
                    unit,
                    {name: column.reshape(shape)[rows] for name, column in columns.items()},
                    u * conversion,
                    c / conversion,
                    IMAGE_POOL if scale is not None else "",
                    scale is None and int((part.inverse_sigma > 0).sum()) <= SINGLE_LINES,
                )
            )
    return input_groups


def _words(kind: str, axis: str) -> str:
    if kind == "image":
        return f"image coordinate {axis}"
    if kind == "distance":
        return "distance"
    return f"{kind} {axis}"


def _estimated_degrees(adjustment: Adjustment) -> dict[tuple[str, int], float]:
    """Σr of the group of the observations whose σ were estimated with it, by set and column."""
    problem, degrees = adjustment.problem, {}
    for group in groups(problem):
        if adjustment.sigma_factors.get(group.name, 1.0) == 1:
            continue
        redundancy = adjustment.variance_components[group.name].redundancy
        for name, place in group.parts:
            columns = np.arange(problem.weights(name).shape[1])
            chosen = columns[place[1]] if isinstance(place, tuple) else columns
            degrees |= {(name, int(k)): redundancy for k in np.atleast_1d(chosen)}
    return degrees


def shared_errors(
    adjustment: Adjustment,
    slopes: Mapping[str, Float[np.ndarray, "f rows width"]],
    factor: Float[np.ndarray, " f"],
    sigma: Float[np.ndarray, " f"],
) -> list[BudgetLine]:
    """A line for each component of errors that image points share; none where these do not make
    the standard uncertainties larger, as a rule of all measurands."""
    if adjustment.error_model is None:
        return []
    model = adjustment.error_model.as_estimated
    modelled = np.diagonal(model.propagate_rows(slopes))
    if not np.mean(modelled / np.maximum((model.solution.sigma0 * sigma) ** 2, 1e-300)) > 1:
        return []
    D = effects(model.solution, slopes)
    lines = []
    for theta, sigma_theta, component in zip(
        model.theta[1:], model.theta_sigma[1:], model.components
    ):
        if not theta > 0 or component.name == OTHERS:
            continue
        size = np.sqrt((component.products(D.T) ** 2).sum(0)) * factor
        # A size that is hardly determined: no estimate has less than one degree of freedom.
        degrees = max(2 * (theta / sigma_theta) ** 2, 1.0) if sigma_theta > 0 else math.inf
        unit = adjustment.image_unit if component.unit == "image" else "σ a priori"
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


def held_lines(
    adjustment: Adjustment, of: Any, held: Mapping[Any, Any], factor: Float[np.ndarray, " f"]
) -> list[BudgetLine]:
    """A line for each input that the adjustment holds."""
    inputs = {name: _held_input(name, amount) for name, amount in held.items()}
    sigmas = {
        name: amount.uncertainty if isinstance(amount, HeldInput) else amount
        for name, amount in inputs.items()
    }
    budget = sensitivity(adjustment, sigmas, of)
    lines = []
    for effect, cause, amount in zip(budget.effects, budget.causes, inputs.values()):
        held_input = amount if isinstance(amount, HeldInput) else HeldInput(1.0)
        # A common error has no single σ: its line has that of its amounts, 1.
        u = held_input.uncertainty
        scale = adjustment.angle_scale if cause.angle else 1.0
        unit = _unit_of_cause(adjustment, cause.name, cause.angle)
        lines.append(
            BudgetLine(
                held_input.words or cause.words,
                len(cause.errors),
                "B",
                held_input.distribution,
                held_input.degrees,
                u * scale,
                unit,
                effect * factor / (u * scale),
                np.abs(effect * factor),
            )
        )
    return lines


def _held_input(name: Any, amount: Any) -> "HeldInput | Mapping":
    if isinstance(amount, HeldInput | Mapping):
        return amount
    return HeldInput(positive(f"the σ of {name}", amount))


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


def image_scale(adjustment: Adjustment) -> tuple[float, float]:
    """s = √(Σ(v/σ)²/Σr) of all image coordinates, and Σr.

    **Raises:** `NotSolvedError` without redundancy."""
    rows = adjustment.residuals
    image = rows["kind"] == "image"
    redundancy = float(rows["r"][image].sum())
    if redundancy < 1e-6:  # nothing but rounding
        raise NotSolvedError("no redundancy of the image coordinates: their σ cannot be estimated")
    normalised = rows["v"][image] / rows["sigma"][image]
    return math.sqrt(float(normalised @ normalised) / redundancy), redundancy
