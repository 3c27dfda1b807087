"""Check points: excluded points compared with the refined images.

At the given coordinates, a check point is projected: its residuals in lines and pixels, with

    σ_v² = σ0²·(1/p + A·Q·Aᵀ).

On the ground, the rays of two or more images give the point (`leastsquares/excluded_rows.py`); one
scanner image gives it at its given height, east and north only.
"""

import dataclasses

import jax
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.display import print_in_one_screen
from jaxbundle.leastsquares.excluded_rows import determine_excluded
from jaxbundle.leastsquares.indexing.plan import Plan
from jaxbundle.leastsquares.indexing.rows import (
    Data,
    Declared,
    Values,
    fill_places,
    lay_out_data,
    residuals,
    restore_order,
)
from jaxbundle.leastsquares.solution import Solution
from jaxbundle.refinement.declare import declare
from jaxbundle.refinement.inputs import Rays
from jaxbundle.refinement.inspection import RefinementInspection, SharedUnknowns
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class RefinementCheckPoints:
    """Differences computed − given along the axes of the points, metres, NaN if the height is the
    given one; their σ; the number of rays. `residual` of every ray, not divided by σ, with
    `residual_sigma`, in the order of the rays of the images.
    """

    id: tuple[str, ...]
    difference: Float[np.ndarray, "points 3"]
    sigma: Float[np.ndarray, "points 3"]
    rays: np.ndarray
    residual: Float[np.ndarray, "rays 2"]
    residual_sigma: Float[np.ndarray, "rays 2"]

    @property
    def rms(self) -> Float[np.ndarray, "3"]:
        """RMS of the differences along each axis, NaN without any."""
        is_known = np.isfinite(self.difference)
        square = np.where(is_known, self.difference, 0.0) ** 2
        number = is_known.sum(0)
        return np.where(number > 0, np.sqrt(square.sum(0) / np.maximum(number, 1)), np.nan)


def intersect(inspection: RefinementInspection, rays: Rays) -> RefinementCheckPoints:
    """The check points of these rays, with the refined images."""
    inputs, adjusted = inspection.declared.inputs, inspection.solution.values
    checks = declare(inputs, rays, inputs.points.X[rays.points], adjusted)
    problem, start = checks.problem, checks.problem.data.start
    determined = determine_excluded(inspection.solution, problem)
    values, Q = determined.values, determined.cofactors(inspection.solution)
    is_known, axes = problem.table("point").free > 0, start["point"].axes
    change = np.asarray(values["point"].position - start["point"].position)
    sigma = inspection.sigma0 * np.sqrt(np.diagonal(Q, axis1=1, axis2=2))
    # Residuals at the given coordinates, not at those that the rays determine.
    check_solution = Solution(problem, start)
    A = _slopes(*check_solution.arguments, inspection.shared_unknowns, inspection.estimate)
    real = lambda o: np.asarray(A[o])[: problem.observations_of(o).number]
    # A·Q·Aᵀ of every ray
    variance = {o: np.einsum("nrk,kl,nrl->nr", real(o), inspection.cofactor, real(o)) for o in A}
    weight = problem.data.weight  # 1/σ
    of_rays = lambda by_set: checks.image_by_image([np.asarray(x) for x in by_set])
    return RefinementCheckPoints(
        tuple(inputs.points.id[k] for k in rays.points),
        np.where(is_known, np.einsum("pki,pi->pk", axes, change), np.nan),
        np.where(is_known, sigma, np.nan),
        checks.number_of_rays,
        of_rays(check_solution.residuals[p.set] / weight[p.set] for p in checks.parts),
        of_rays(
            inspection.sigma0 * np.sqrt(1 + variance[p.set]) / weight[p.set] for p in checks.parts
        ),
    )


@compile_once
def _slopes(
    declared: Declared,
    plan: Plan,
    values: Values,
    data: Data,
    shared: SharedUnknowns,
    estimate: Float[AnyArray, " m"],
) -> dict[str, Float[Array, "n r m"]]:
    """The derivatives of all v/σ by the shared unknowns, [n, r, m], the points where they are."""
    plan, laid = fill_places(plan, lay_out_data(plan, data))
    put_first_rows = lambda wide, x: wide.at[: len(x)].set(x)  # into tables padded to shared shapes

    def residuals_after(estimate: Float[AnyArray, " m"]) -> dict[str, Float[Array, "n r"]]:
        tables_now = shared.tables(estimate)
        moved_tables = {
            t: jax.tree.map(put_first_rows, values[t], tables_now[t])
            if t in tables_now
            else values[t]
            for t in values
        }
        return restore_order(plan, residuals(declared, plan, moved_tables, laid))

    return jax.jacfwd(residuals_after)(estimate)
