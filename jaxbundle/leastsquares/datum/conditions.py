"""The datum: the motions of the whole problem left open by the observations, and their constraints.

A motion that changes no observation makes the normal equations singular along its directions G
(Blaha 1971; Illner 1985). The open combinations of the declared motions are computed from the
non-invariant observations and the held unknowns.

The datum is imposed by an S-transformation (Baarda 1973; Teunissen 1985): with a choice B of datum
unknowns,

    δ ← δ − G(BᵀG)⁻¹Bᵀδ,      Q ← S·Q·Sᵀ,  S = I − G(BᵀG)⁻¹Bᵀ,

B = G on the datum rows for inner constraints (trace of their covariance smallest), B = as many
single unknowns as the defect for a minimal datum. After convergence the whole problem is moved by
finite open motions so that Bᵀ(x − x_start) = 0 holds exactly: the result does not depend on the
path of the iterations. Where observations determine the rotation and not the scale, x_start is
turned with the problem (`turn_start`). (Conditions imposed on every step instead let far points
pull the whole problem: BAL 49 then needed five times as many evaluations to reach ½vᵀPv = 13345.3,
which its iterations pass after 20 of the 190 in which they end.)
"""

import dataclasses
from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int

from jaxbundle.geometry.quaternions import (
    matrix_from_rotation_vector,
    rotation_vector_from_matrix,
)
from jaxbundle.implicit import implicit_root, solve_dense
from jaxbundle.leastsquares.datum.motions import JointMotion
from jaxbundle.leastsquares.equations.normal import sum_over_devices
from jaxbundle.leastsquares.indexing.plan import Datum, Plan, Tangent
from jaxbundle.leastsquares.indexing.rows import Declared, Values
from jaxbundle.leastsquares.spaces import PoseValue
from jaxbundle.types import AnyArray, Scalar, not_none

# Smallest relative motion of datum unknowns that fix the datum. Below about 1e-8, √ε, the Gram
# matrix BᵀG of `s_transform` has lost all digits; at 1e-7 a datum still has two, at 1e-4 (a datum
# of points along a line, a ten-thousandth of its length wide) eight.
MIN_RELATIVE_MOTION = 1e-7


@dataclasses.dataclass(frozen=True)
class MotionSettings:
    """The iteration of the motion to the datum; lengths are fractions of the largest coordinate.

    - `near`: below it steps are Newton's, with the curvature of the motions. Gauss–Newton steps
      alone do not converge for strong deformations; Newton steps from afar may go anywhere.
    - `longest`: limit of a single step in rotations (radians) and scale (a factor of e): farther
      off the linearised motion says nothing.
    - `reached`: a smaller step is the last: some thousand units of rounding (2.2e-16).
    - `small`: smaller steps that no longer halve end the iteration as well: it has not reached the
      datum, unless the step is below `reached`.
    - `max_steps`: converging motions take 3 to 15.
    """

    near: float = 1e-3
    longest: float = 1.0
    reached: float = 1e-12
    small: float = 1e-6
    max_steps: int = 50


DATUM_MOTION = MotionSettings()


def generators(declared: Declared, values: Values) -> Tangent:
    """The derivative of every table along each motion, [rows, width, motions]."""
    declared_motions = not_none(declared.motions)
    motions, actions = len(declared_motions.names), dict(declared_motions.actions)

    def of_table(name: str) -> Float[Array, "rows width motions"]:
        space, act = declared.spaces[name], actions.get(name)
        if act is None:
            rows = jax.tree.leaves(values[name])[0].shape[0]
            return jnp.zeros((rows, space.width, motions))
        # Only first derivatives at motion 0 are needed; there motions in sequence (`near`) equal
        # simultaneous ones, whose quadrature would be compiled for nothing, and a difference of two
        # rotations needs no logarithm (`small_difference`).
        act = getattr(act, "near", act)
        difference = getattr(space, "small_difference", space.difference)
        change = lambda value, m: difference(act(m, value), value)
        return jax.vmap(jax.jacfwd(change, 1), (0, None))(values[name], jnp.zeros(motions))

    return {name: of_table(name) for name in values}


def of_groups(plan: Plan, of_tables: Mapping[str, Float[AnyArray, "rows width ..."]]) -> Tangent:
    """Quantities by table directions, [rows, width, …], rearranged by groups; zero for held
    unknowns. Those of the eliminated table may be left out, and are missing then."""
    by_group = {}
    for name, group in plan.groups.items():
        if name == plan.eliminated and all(m.table not in of_tables for m in group.members):
            continue
        parts = [
            of_tables[m.table] if m.rows is None else of_tables[m.table][m.rows]
            for m in group.members
        ]
        rows = jnp.concatenate(parts, 1)
        free = group.free.reshape(*group.free.shape, *(1,) * (rows.ndim - 2))
        by_group[name] = rows * free
    return by_group


def open_directions(
    declared: Declared, plan: Plan, values: Values, moves: Tangent | None = None
) -> Tangent:
    """G: the directions of the open motions, [rows, w, defect]; `moves`: the `generators`, if
    known."""
    moves = generators(declared, values) if moves is None else moves
    gauge = not_none(keep_held_fixed(declared, plan, values, moves).datum).gauge
    return {name: rows @ gauge for name, rows in of_groups(plan, moves).items()}


def keep_held_fixed(
    declared: Declared, plan: Plan, values: Values, moves: Tangent | None = None
) -> Plan:
    """The plan with the smallest correction of its open motions that leaves held unknowns as they
    are: a rotation about a held point follows the point. `moves`: the `generators`, if known."""
    datum = not_none(plan.datum)
    held_directions, gauge = datum.held, datum.gauge
    if not held_directions:
        return plan
    if moves is None:
        moves = generators(declared, {name: values[name] for name in held_directions})
    rows = jnp.concatenate(
        [
            (moves[name] * mask[..., None]).reshape(-1, len(gauge))
            for name, mask in held_directions.items()
        ]
    )
    # The combination of motions c that leaves held unknowns as they are, R·(g − c) = 0, with the
    # smallest c, which is (RᵀR)⁺RᵀR·g; columns are scaled, since radians stand beside metres.
    A = rows.T @ rows
    # The scale cancels: no derivative of it is needed.
    scale = jax.lax.stop_gradient(jnp.diagonal(A))
    # Twice: a NaN of the branch that is not taken would enter the gradient.
    scale = jnp.where(scale > 0, jnp.where(scale > 0, scale, 1.0) ** -0.5, 1.0)
    A = A * scale * scale[:, None]
    # A holds squares of motions: 1e-12 cuts relative motions of 1e-6, ten times the smallest that
    # fix a datum; below, the squares are rounding.
    correction = jnp.linalg.pinv(A, 1e-12, hermitian=True) @ (A @ (gauge / scale[:, None]))
    corrected = dataclasses.replace(datum, gauge=gauge - scale[:, None] * correction)
    return dataclasses.replace(plan, datum=corrected)


def s_transform(
    declared: Declared, plan: Plan, values: Values, change: Tangent, moves: Tangent | None = None
) -> Tangent:
    """A change with the datum imposed: δ − G(BᵀG)⁻¹Bᵀδ; unchanged if nothing is open."""
    if plan.datum is None:
        return change
    G, B = datum_directions(declared, plan, values, moves)
    # BᵀG is as small as the defect: at most 7 × 7.
    gram = contract(plan, B, G)
    motion = jnp.linalg.solve(gram, contract(plan, B, change))
    return {name: d - G[name] @ motion for name, d in change.items()}


def s_transform_transposed(
    declared: Declared, plan: Plan, values: Values, row: Tangent, moves: Tangent | None = None
) -> Tangent:
    """Sᵀ·f: f − B(GᵀB)⁻¹Gᵀf, orthogonal to the open motions."""
    if plan.datum is None:
        return row
    G, B = datum_directions(declared, plan, values, moves)
    motion = jnp.linalg.solve(contract(plan, G, B), contract(plan, G, row))
    return {name: f - B[name] @ motion for name, f in row.items()}


def datum_directions(
    declared: Declared, plan: Plan, values: Values, moves: Tangent | None = None
) -> tuple[Tangent, Tangent]:
    """G and B of all groups, [rows, w, defect]; `moves`: the `generators`, if known."""
    G = open_directions(declared, plan, values, moves)
    weight = of_groups(plan, zeros_of_tables(declared, values) | not_none(plan.datum).weight)
    return G, {name: g * weight[name][..., None] for name, g in G.items()}


def move_to_datum(
    declared: Declared, plan: Plan, values: Values, start: Values
) -> tuple[Values, Bool[Array, ""]]:
    """The problem moved along its open motions so that Bᵀ(x − x_start) = 0, and whether this was
    reached.

    Gauss–Newton steps, limited to a radian and a factor e; Newton steps near the solution, which
    take long to compile but converge for strong deformations (without them:
    `by_table.move_into_datum`). Iterated until a step is rounding (`MotionSettings.reached`)."""
    if plan.datum is None:
        return values, jnp.asarray(True)
    start = turn_start(declared, plan, values, start)
    plan = keep_held_fixed(declared, plan, values)
    datum = not_none(plan.datum)
    no_motion, curved = jnp.zeros(datum.gauge.shape[1]), not_none(declared.motions).curved
    size = largest(datum.weight, start)

    def moving(state: tuple) -> bool | Bool[AnyArray, ""]:
        _, *progress = state
        return moves_on(size, *progress)

    def one_step(state: tuple) -> tuple:
        values, previous_distance, _, count = state
        misclosure, slope = _conditions_of_tables(declared, plan, values, start)
        newton_slope = jax.jacfwd(_datum_misclosure)(no_motion, (declared, plan), (values, start))
        slope = jnp.where(previous_distance > DATUM_MOTION.near * size, slope, newton_slope)
        step = limit_step(datum.gauge @ -jnp.linalg.solve(slope, misclosure), curved)
        displaced = move_tables(declared, plan, step, values)
        differences = {
            name: jax.tree.map(jnp.subtract, displaced[name], values[name]) for name in datum.weight
        }
        return displaced, largest(datum.weight, differences), previous_distance, count + 1

    # Larger than any step, so that the first one is taken.
    begin = values, jnp.asarray(1e300), jnp.asarray(jnp.inf), 0
    values, distance, *_ = jax.lax.while_loop(moving, one_step, begin)
    return values, distance <= DATUM_MOTION.reached * size


def turn_start(declared: Declared, plan: Plan, values: Values, start: Values) -> Values:
    """The start values turned about their centroid as the observations have turned the problem,
    where these determine its rotation, and its scale is open.

    Otherwise the condition of the scale, Σ x·(x − x_start) = 0, gives the size |x_start|·cos θ to a
    problem that is turned by θ, and to one turned by more than a right angle the size 0. The turn
    is the best one, Σ x × (R·x_start) = 0 (Arun, Huang and Blostein 1987); a function of both that
    is differentiable to any order."""
    datum = not_none(plan.datum)
    if not datum.turned:
        return start
    X, X0, p = (jnp.concatenate(parts) for parts in zip(*_datum_places(datum, values, start)))
    centre, centre0 = (p @ x / p.sum() for x in (X, X0))

    def misalignment(
        turn: Float[Array, "3"], weight: Float[Array, " n"], centred: tuple[Array, Array]
    ) -> Float[Array, "3"]:
        Y, Y0 = centred
        return weight @ jnp.cross(Y0 @ matrix_from_rotation_vector(turn).T, Y)

    given = X - centre, X0 - centre0
    Y, Y0 = stop_gradient(given)
    U, _, Vt = jnp.linalg.svd((Y * p[:, None]).T @ Y0)
    # No reflection.
    R = (U * jnp.stack([1.0, 1.0, jnp.sign(jnp.linalg.det(U @ Vt))])) @ Vt
    turn = implicit_root(
        misalignment, solve_dense, stop_gradient(rotation_vector_from_matrix(R)), p, given
    )
    # Where no shift is open, the centroid too is where the observations have it.
    centre_after = centre if datum.gauge.shape[1] == 1 else centre0
    shift = centre_after - matrix_from_rotation_vector(turn) @ centre0
    motion = jnp.concatenate([shift, turn, jnp.zeros(1)])
    turned = dict(start)
    for name, act in not_none(declared.motions).actions:
        if name in start:
            move = act.move if isinstance(act, JointMotion) else act
            turned[name] = jax.vmap(partial(move, motion))(start[name])
    return turned


def _datum_places(
    datum: Datum, values: Values, start: Values
) -> Iterator[tuple[Float[AnyArray, "n 3"], Float[AnyArray, "n 3"], Float[Array, " n"]]]:
    """Of every table of datum unknowns: places, those of the start values, and whether they are
    datum unknowns."""
    for name, weight in datum.weight.items():
        place = lambda x: x.position if isinstance(x, PoseValue) else jax.tree.leaves(x)[0]
        yield place(values[name]), place(start[name]), jnp.where(weight[:, :3].max(1) > 0, 1.0, 0.0)


def moves_on(
    size: Scalar,
    distance: Scalar,
    previous_distance: Scalar,
    count: int | Int[Array, ""],
    settings: MotionSettings = DATUM_MOTION,
) -> bool | Bool[AnyArray, ""]:
    """Whether a motion to the datum continues after a step of `distance` and a previous one of
    `previous_distance`."""
    # Far from its end a motion may overshoot for some steps; near it, one that does not halve is
    # rounding.
    is_falling = (distance > settings.small * size) | (distance < 0.5 * previous_distance)
    return (distance > settings.reached * size) & is_falling & (count < settings.max_steps)


def limit_step(
    step: Float[AnyArray, " motions"],
    curved: tuple[int, ...],
    settings: MotionSettings = DATUM_MOTION,
) -> Float[AnyArray, " motions"]:
    """A step of the motions, limited in the curved ones."""
    longest = abs(step[np.array(curved, int)]).max(initial=0.0)
    return step / (longest / settings.longest).clip(1.0)


def largest(holding: Tangent, tables: Values) -> Any:
    """The largest value in the datum rows; NumPy for NumPy input."""
    where = np.where if all(isinstance(w, np.ndarray) for w in holding.values()) else jnp.where
    return max(
        where(weight.max(1) > 0, abs(x.reshape(len(weight), -1)).max(1), 0.0).max()
        for name, weight in holding.items()
        for x in jax.tree.leaves(tables[name])
    )


def datum_conditions(
    datum: Datum, moves: Tangent, offset: Tangent
) -> tuple[Float[AnyArray, " defect"], Float[AnyArray, "defect defect"]]:
    """Bᵀ(x − x_start) and BᵀG, over the datum tables; `offset`: x − x_start."""
    misclosure: Any = 0.0
    gram: Any = 0.0
    for name, weight in datum.weight.items():
        G = moves[name] @ datum.gauge
        B = (G * weight[..., None]).reshape(-1, G.shape[-1])
        misclosure = misclosure + B.T @ offset[name].ravel()
        gram = gram + B.T @ G.reshape(B.shape)
    return misclosure, gram


def _conditions_of_tables(
    declared: Declared, plan: Plan, values: Values, start: Values
) -> tuple[Float[AnyArray, " defect"], Float[AnyArray, "defect defect"]]:
    """Bᵀ(x − x_start) and BᵀG of the tables at these values, differentiable."""
    datum = not_none(plan.datum)
    moves = generators(declared, {name: values[name] for name in datum.weight})
    offset = {
        name: jax.vmap(declared.spaces[name].difference)(values[name], start[name])
        for name in datum.weight
    }
    return datum_conditions(datum, moves, offset)


def _datum_misclosure(
    tau: Float[Array, " defect"],
    fixed: tuple[Declared, Plan],
    values_and_start: tuple[Values, Values],
) -> Float[AnyArray, " defect"]:
    """Bᵀ(x − x_start) after a motion along the open directions."""
    (declared, plan), (values, start) = fixed, values_and_start
    plan = keep_held_fixed(declared, plan, values)
    datum = not_none(plan.datum)
    tables = {name: values[name] for name in datum.weight}
    displaced = move_tables(declared, plan, datum.gauge @ tau, tables)
    return _conditions_of_tables(declared, plan, displaced, start)[0]


def attach_motion(declared: Declared, plan: Plan, values: Values, start: Values) -> Values:
    """`values`, nearly in the datum, moved into it; a function of the values and their start values
    that is differentiable to any order."""
    if plan.datum is None:
        return values
    start = turn_start(declared, plan, values, start)
    no_motion, fixed = jnp.zeros(plan.datum.gauge.shape[1]), (declared, plan)

    def move_along(tau: Float[Array, " defect"], of: Values, values: Values) -> Values:
        datum = not_none(keep_held_fixed(declared, plan, of).datum)
        return move_tables(declared, plan, datum.gauge @ tau, values)

    # First remove the remaining motion, so that derivatives are taken at zero motion.
    constants = jax.lax.stop_gradient((values, start))
    slope = jax.jacfwd(_datum_misclosure)(no_motion, fixed, constants)
    # `values` are in the datum to 1e-12 already: one Newton step of rounding size, but with it the
    # root below is exactly zero, where its equation is differentiated.
    values = move_along(
        -jnp.linalg.solve(slope, _datum_misclosure(no_motion, fixed, constants)),
        constants[0],
        values,
    )
    tau = implicit_root(_datum_misclosure, solve_dense, no_motion, fixed, (values, start))
    return move_along(tau, values, values)


def move_tables(
    declared: Declared, plan: Plan, motion: Float[AnyArray, " motions"], values: Values
) -> Values:
    """All tables moved, except held values."""
    displaced, free = dict(values), free_of_tables(declared, plan, values)
    for name, act in not_none(declared.motions).actions:
        if name not in values:
            continue
        space = declared.spaces[name]
        move_row = lambda value, f, act=act, space=space: space.hold(act(motion, value), value, f)
        displaced[name] = jax.vmap(move_row)(values[name], free[name])
    return displaced


def free_of_tables(declared: Declared, plan: Plan, values: Values) -> dict[str, Array]:
    """1 for every free direction of every table, 0 for held ones."""
    free = zeros_of_tables(declared, values)
    for group in plan.groups.values():
        for m in (m for m in group.members if m.table in free):
            columns = group.free[:, m.start : m.start + m.width]
            rows = slice(None) if m.rows is None else m.rows
            free[m.table] = free[m.table].at[rows].max(columns)
    return free


def zeros_of_tables(declared: Declared, values: Values) -> dict[str, Array]:
    """0 for every direction of every table."""
    rows = {name: jax.tree.leaves(value)[0].shape[0] for name, value in values.items()}
    return {name: jnp.zeros((n, declared.spaces[name].width)) for name, n in rows.items()}


def contract(plan: Plan, B: Tangent, x: Tangent) -> Float[Array, "defect ..."]:
    """Bᵀx over all rows; x may have an additional last axis."""
    parts = {name: jnp.einsum("nwk,nw...->k...", b, x[name]) for name, b in B.items()}
    e = plan.eliminated
    # Kept rows are on all devices, eliminated ones on one each.
    sum_of_kept: Any = sum(part for name, part in parts.items() if name != e)
    return sum_of_kept if e is None else sum_of_kept + sum_over_devices(plan, parts[e])
