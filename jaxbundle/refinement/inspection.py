"""The solution of a refinement, and its statistics in the order of its unknowns and rays."""

import functools
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.errors import NotSolvedError
from jaxbundle.leastsquares.indexing.rows import Values
from jaxbundle.leastsquares.iterations.solver import Minimum
from jaxbundle.leastsquares.iterations.stopping import converged
from jaxbundle.leastsquares.problem import Problem, with_data
from jaxbundle.leastsquares.quality.snooping import RemovedRow, snoop
from jaxbundle.leastsquares.solution import Solution, find_minimum
from jaxbundle.leastsquares.spaces import Space
from jaxbundle.network.blunders import Removed, either_of
from jaxbundle.refinement.declare import DeclaredRefinement
from jaxbundle.refinement.terrain_heights import TERRAIN_HEIGHTS
from jaxbundle.refinement.weakness import weaknesses
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray, not_none


class SharedUnknowns(eqx.Module):
    """The changes of the shared unknowns, as a function of the tables. `places`: by table,
    their numbers, rows and directions; `start`: of these tables."""

    places: dict[str, tuple[np.ndarray, ...]]
    start: Values
    spaces: tuple[tuple[str, Space], ...] = eqx.field(static=True)

    def __call__(self, values: Values) -> Float[Array, " m"]:
        """The changes of the shared unknowns from the start to these tables."""
        spaces, changes = (
            dict(self.spaces),
            jnp.zeros(sum(len(k) for k, *_ in self.places.values())),
        )
        for t, (k, row, direction) in self.places.items():
            change = jax.vmap(spaces[t].difference)(values[t], self.start[t])
            changes = changes.at[k].set(change[row, direction])
        return changes

    def tables(self, changes: Float[AnyArray, " m"]) -> Values:
        """The tables after these changes."""
        spaces, moved_tables = dict(self.spaces), {}
        for t, (k, row, direction) in self.places.items():
            rows = jax.tree.leaves(self.start[t])[0].shape[0]
            change = jnp.zeros((rows, spaces[t].width)).at[row, direction].set(changes[k])
            moved_tables[t] = jax.vmap(spaces[t].retract)(self.start[t], change)
        return moved_tables


_estimate = compile_once(lambda shared, values: shared(values))


class RefinementInspection:
    """Statistics at a solution of the engine; cofactors are to be multiplied by σ0²."""

    def __init__(
        self,
        declared: DeclaredRefinement,
        solution: Solution,
        steps: int,
        removed: Sequence[RemovedRow] = (),
        unsettled: float = 0.0,
    ):
        """`unsettled`: by what `DeclaredRefinement.rescale` still changes, 0 if by nothing."""
        self.declared, self.solution, self.steps = declared, solution, steps
        self.unsettled = unsettled
        self.removed = tuple(_describe_removed(declared, blunder) for blunder in removed)

    @property
    def redundancy(self) -> int:
        """Observations and priors minus unknowns."""
        return self.solution.problem.counts.redundancy

    @property
    def sigma0(self) -> float:
        """σ0 a posteriori; 1 without redundancy."""
        return self.solution.sigma0 if self.redundancy > 0 else 1.0

    @functools.cached_property
    def shared_unknowns(self) -> SharedUnknowns:
        """The location of the shared unknowns."""
        problem, places_by_table = self.declared.problem, {}
        for k, column in enumerate(self.declared.columns):
            places_by_table.setdefault(column.table, []).append((k, column.row, column.direction))
        # Columns, as index arrays of the tables.
        places_by_table = {t: tuple(np.array(rows).T) for t, rows in places_by_table.items()}
        start = {t: jax.device_get(problem.data.start[t]) for t in places_by_table}
        return SharedUnknowns(places_by_table, start, problem.declared.named_spaces)

    @functools.cached_property
    def estimate(self) -> Float[np.ndarray, " m"]:
        """The changes of the shared unknowns."""
        return np.asarray(_estimate(self.shared_unknowns, self.solution.values))

    @functools.cached_property
    def cofactor(self) -> Float[np.ndarray, "m m"]:
        """Cofactors of the shared unknowns."""
        slopes, problem = self.solution.jacobian_of(self.shared_unknowns), self.solution.problem
        if not problem.kept_rows.any():
            # They are no functions of the points, whose zeros would take most of the time and
            # memory; only points with distances are in the system that remains.
            slopes = {t: x for t, x in slopes.items() if t != problem.plan.eliminated}
        return self.solution.propagate_rows(slopes)

    @property
    def sigma(self) -> Float[np.ndarray, " m"]:
        """σ of the shared unknowns."""
        return self.sigma0 * np.sqrt(np.diagonal(self.cofactor))

    @property
    def point_cofactor(self) -> Float[np.ndarray, "points 3 3"]:
        """Cofactors of the points along their axes."""
        return self.solution.cofactor("point")

    @property
    def point_sigma(self) -> Float[np.ndarray, "points 3"]:
        """σ of the points along their axes."""
        variance = np.diagonal(self.point_cofactor, axis1=1, axis2=2)
        return self.sigma0 * np.sqrt(np.maximum(variance, 0))

    @property
    def positions(self) -> Float[np.ndarray, "points 3"]:
        """Adjusted coordinates of the points."""
        return np.asarray(self.solution.values["point"].position) + self.declared.inputs.origin

    @functools.cached_property
    def residuals(self) -> dict[str, Float[np.ndarray, "n r"]]:
        """v of every set of observations in its unit, including removed ones."""
        # With the weights before snooping: what a removed observation disagrees by is of interest.
        problem, weight = self.solution.problem, self.declared.problem.data.weight
        data = type(problem.data)(problem.data.start, problem.data.measured, weight)
        residuals = Solution(with_data(problem, data), self.solution.values).residuals
        unit = lambda o: np.where(np.asarray(weight[o]) > 0, weight[o], 1.0)
        return {o: v / unit(o) for o, v in residuals.items()}

    @property
    def has_weight(self) -> dict[str, np.ndarray]:
        """Which residuals of every set carry weight."""
        return {o: np.asarray(w) > 0 for o, w in self.solution.problem.data.weight.items()}

    def rows(self, o: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """v, r, w of a set of observations, NaN if missing, and the removed ones."""
        has_weight, reliability = self.has_weight[o], self.solution.reliability
        where_used = lambda x: np.where(has_weight, x[o], np.nan)
        return (
            self.residuals[o],
            where_used(reliability.redundancy),
            where_used(reliability.w),
            ~np.any(has_weight, axis=1),
        )


def adjust(
    declared: DeclaredRefinement, snooping: str, significance: float, max_rounds: int = 10
) -> RefinementInspection:
    """Solve, optionally remove blunders, and inspect the solution.

    `max_rounds`: of solutions with S and the cells of terrain heights at the one before. S settles
    in two or three; a point that goes to and fro between two cells never does.

    **Raises:** `NotSolvedError` with the undetermined unknowns."""
    steps, unsettled = 0, 0.0

    def adjust_from(problem: Problem, values: Values) -> Solution:
        nonlocal steps, unsettled
        problem, _ = declared.rescale(problem, values)
        # S = −(∂g/∂(l, u))⁻¹ (`kinds`) is held during a solution: its own derivatives are second
        # ones of the trajectory, and v needs them nowhere. It is right when it is that of the
        # solution, within 1e-9 of itself; the second solution starts at the first, and is near it.
        for _ in range(max_rounds):
            minimum = find_minimum(problem, values)
            values, steps = minimum.values, steps + int(minimum.iterations)
            problem, change = declared.rescale(problem, values)
            unsettled = change if change > 1e-9 else 0.0
            if not (unsettled and converged(minimum.termination)):
                break
        solution = Solution(problem, values)
        _require_solved(declared, solution, minimum, steps)
        return solution

    solution, removed = adjust_from(declared.problem, declared.problem.data.start), []
    if snooping != "none":
        solution, removed = snoop(solution, adjust_from, test=snooping, significance=significance)
    return RefinementInspection(declared, solution, steps, removed, unsettled)


def _require_solved(
    declared: DeclaredRefinement, solution: Solution, minimum: Minimum, steps: int
) -> None:
    settled = bool(converged(minimum.termination))
    if settled and solution.determined and solution.problem.counts.redundancy >= 0:
        return
    # A singular system often does not converge either: the cause is reported, not the symptom.
    reasons = (
        [w.sentence for w in weaknesses(declared, solution)] if not solution.determined else []
    )
    if reasons or settled:
        reason = reasons[0] if reasons else "more unknowns than observations"
        if reasons[1:]:
            reason += f", and {len(reasons) - 1} more directions"
        raise NotSolvedError(
            f"the adjustment is singular: {reason}; hold some, give them a prior σ, or add points",
            reasons,
        )
    raise NotSolvedError(
        f"the adjustment did not converge in {steps} steps; check start values and blunders"
    )


def _describe_removed(declared: DeclaredRefinement, blunder: RemovedRow) -> Removed:
    """Observations removed by snooping, in words; rows of image points as in
    `Refinement.image_points`, others as in their sets (three per control point)."""
    inputs, chosen_points = declared.inputs, declared.rays.points
    names = [part.set for part in declared.parts]
    points, observation_set = inputs.points, declared.problem.observations_of(blunder.set)
    if blunder.set in names:
        number = names.index(blunder.set)
        part = declared.parts[number]
        # The rank of a row, set by set, in the order of the images.
        place = np.argsort(np.argsort(declared.image, kind="stable"))
        rows_before = sum(len(p.rows) for p in declared.parts[:number])
        image_points = [
            f"point {points.id[chosen_points[part.point[r]]]} in image {inputs.ids[part.image[r]]}"
            for r in blunder.rows
        ]
        rows = [int(place[rows_before + r]) for r in blunder.rows]
        return Removed("image", rows[0], either_of(image_points), blunder.test, tuple(rows[1:]))
    if observation_set.kind.name == "control points":
        p, axis = int(declared.control[blunder.row]), not_none(blunder.residual)
        k = int(chosen_points[p])
        name = f"{points.axis_names_of(k)[axis]} of control point {points.id[k]}"
        return Removed("control", 3 * blunder.row + axis, name, blunder.test)
    if blunder.set == TERRAIN_HEIGHTS:
        p = int(declared.levelled[blunder.row])
        name = f"terrain height of point {points.id[chosen_points[p]]}"
        return Removed("terrain height", blunder.row, name, blunder.test)
    if observation_set.kind.name == "distances":
        a, b = (points.id[chosen_points[r[blunder.row]]] for r in observation_set.rows)
        return Removed("distance", blunder.row, f"distance {a}–{b}", blunder.test)
    tables, (first_row, *others) = declared.problem.tables, blunder.rows
    labels = [observation_set.label(tables, row) for row in blunder.rows]
    kind = observation_set.kind.name
    return Removed(kind, first_row, either_of(labels), blunder.test, tuple(others))
