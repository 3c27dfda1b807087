"""The influence of every measurement on a result.

One σ of a measurement l changes the result f by σ·∂f/∂l = −σ·λᵀ·∂g/∂l, H·λ = ∂f/∂y, exactly to
first order (`leastsquares/quality/sensitivity.py`): one solution for each result, whatever the
number of measurements. To the order of the residuals these are the rows of N⁻¹JᵀP, and the squares
of the influences, in the σ of the result, add up to 1: each is the share of a measurement."""

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxbundle.adjustment.error_budget import inspection_of
from jaxbundle.adjustment.problem import NetworkProblem
from jaxbundle.adjustment.quality.requested_results import CAMERAS, RequestedResult, request_results
from jaxbundle.adjustment.result import Adjustment
from jaxbundle.adjustment.result_tables import observations
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError
from jaxbundle.leastsquares.quality.error_components import IndependentErrors
from jaxbundle.leastsquares.quality.sensitivity import pull_back
from jaxbundle.report.layout import significant, table
from jaxbundle.results import ResultMethods, data_frame, rows_of


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class Influence(ResultMethods):
    """The influence of measurements on results.

    **Fields:** `results`, with names and descriptions; their `sigma` (a posteriori; for a design a
    priori; angles in radians); `columns`: kind, image, point, axis of every measurement, as in the
    residual table; `effects`: of one σ of every measurement, in units of the σ of each result;
    `derivatives`: ∂(result)/∂(measurement).
    """

    results: tuple[RequestedResult, ...]
    sigma: Float[np.ndarray, " results"]
    columns: dict[str, np.ndarray]
    effects: Float[np.ndarray, "measurements results"]
    derivatives: Float[np.ndarray, "measurements results"]

    def table(self, result: str | None = None) -> dict[str, np.ndarray]:
        """The measurements with their influence on one result (default: the first), largest first:
        kind, image, point, axis, effect, derivative.

        **Raises:** `KeyError` for a result that was not requested."""
        names = [requested.name for requested in self.results]
        if result is not None and result not in names:
            raise KeyError(f"there is no result {result!r}; known: {', '.join(names)}")
        r = 0 if result is None else names.index(result)
        order = np.argsort(-np.abs(self.effects[:, r]), kind="stable")
        values = {"effect": self.effects[:, r], "derivative": self.derivatives[:, r]}
        return {name: column[order] for name, column in (self.columns | values).items()}

    def __str__(self) -> str:
        blocks = []
        for result in self.results:
            rows = list(zip(*(c[:20] for c in self.table(result.name).values())))
            text = [(*map(str, row[:4]), f"{row[4]:.4f}", significant(row[5])) for row in rows]
            lines = table(
                ("kind", "image", "point", "axis", "effect in σ", "derivative"), text, "llllrr"
            )
            blocks.append("\n".join([f"Influence on {result.words}", *lines]))
        return "\n\n".join(blocks)

    def to_dict(self) -> dict[str, Any]:
        """σ of every result, and the measurements with their influence, largest first."""
        return {
            result.name: {"sigma": float(sigma), "measurements": rows_of(self.table(result.name))}
            for result, sigma in zip(self.results, self.sigma)
        }

    def to_pandas(self, result: str | None = None):
        """`table` as a pandas data frame (extra `tables`)."""
        return data_frame(self.table(result))


def influence(given: Adjustment | NetworkProblem, of: Any = CAMERAS) -> Influence:
    """The influence of every measurement on each result.

    **Arguments:**

    - `given`: an `Adjustment`; or a `NetworkProblem`, a design.
    - `of`: results by name as in `jaxbundle.sensitivity`, `"cameras"`, or a function of `Values`.
      The cost is one solution per result, regardless of the number of measurements.

    **Returns:** an `Influence`.

    **Raises:** `InputError` for an unknown name, and for results that are means over images or
    points; `NotSolvedError` without a solution.
    """
    inspection, errors, _ = inspection_of(given)
    results = request_results(inspection, errors, of)
    if any(len(range(request.numbers.stop)[request.numbers]) > 1 for request in results.asked):
        raise InputError(
            "influence: name single results, such as point:7:Z; a mean over all has no derivative"
        )
    solution = inspection.solution
    # In reverse: one solution per result gives the derivatives by all measurements.
    by_set = pull_back(solution, solution.jacobian_of(results.function))
    of_result = [{o: x[r] for o, x in by_set.items()} for r in range(len(results.asked))]
    parts = list(observations(inspection.problem, *of_result))
    inverse_sigma = np.concatenate([np.ravel(part.inverse_sigma) for part in parts])
    effects = np.stack(
        [
            np.concatenate([np.ravel(part.quantities[r]) for part in parts])
            for r in range(len(results.asked))
        ],
        1,
    )
    has_weight = inverse_sigma > 0
    columns = {
        name: np.concatenate([column(*part[:4]) for part in parts])[has_weight]
        for name, column in COLUMNS.items()
    }
    # In units of the classical σ, of which each observation has its share.
    unit = request_results(inspection, IndependentErrors(solution, 1.0), of).sigma
    size = np.maximum(unit, 1e-300)
    return Influence(
        results.asked,
        results.sigma,
        columns,
        (effects / size)[has_weight],
        (effects * inverse_sigma[:, None])[has_weight],
    )


# The columns that identify a measurement.
COLUMNS = {
    "kind": lambda kind, image, _point, axes: np.full(len(image) * len(axes), kind, object),
    "image": lambda _kind, image, _point, axes: np.repeat(image, len(axes)),
    "point": lambda _kind, _image, point, axes: np.repeat(point, len(axes)),
    "axis": lambda _kind, image, _point, axes: np.tile(np.array(axes, object), len(image)),
}
