"""Test whether any station can satisfy the conditions, by trial positions all over the room.

Infeasible designs are refused by name before the search.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxbundle.errors import InputError
from jaxbundle.leastsquares.indexing.rows import Values
from jaxbundle.network.columns import list_some
from jaxbundle.network_design.conditions import Conditions
from jaxbundle.network_design.pairs import MIN_RAYS, StationTargetPairs
from jaxbundle.network_design.variables import Configuration, points_on_axes, turn_axis
from jaxbundle.network_design.visibility import margins, visible


def room_of(conditions: Conditions, pairs: StationTargetPairs) -> Float[np.ndarray, "2 3"]:
    """The box of projection centres, relative to the origin of the network."""
    if conditions.room is not None:
        return np.array(conditions.room) - pairs.problem.origin
    start = pairs.problem.data.start
    middle = np.asarray(start["point"]).mean(0)
    reach = np.linalg.norm(np.asarray(start["image"].position) - middle, axis=1).max()
    # Three times the largest distance at the start, as `Conditions` says: a bound for aims that
    # fall with the distance for ever, such as the σ of a distortion.
    return middle + 3.0 * reach * np.array([[-1.0] * 3, [1.0] * 3])


def targets_of(conditions: Conditions, pairs: StationTargetPairs) -> Float[np.ndarray, "2 3"]:
    """The box of movable targets: that of the conditions, or of all points."""
    if conditions.targets is not None:
        return np.array(conditions.targets) - pairs.problem.origin
    points = np.asarray(pairs.problem.data.start["point"])
    return np.stack([points.min(0), points.max(0)])


_turned = jax.jit(jax.vmap(turn_axis))


def try_stations(
    pairs: StationTargetPairs, number: int, seed: int = 0
) -> tuple[Float[np.ndarray, "tried 3"], Float[np.ndarray, "tried 4"], Int[np.ndarray, " tried"]]:
    """Random stations in the room, outside of obstacles, each looking at a target.

    **Returns:** positions, rotations, and the targets."""
    random = np.random.default_rng(seed)
    room, values = room_of(pairs.conditions, pairs), pairs.problem.data.start
    position = random.uniform(room[0], room[1], (number, 3))
    for low, high in np.array(pairs.conditions.obstacles).reshape(-1, 2, 3) - pairs.problem.origin:
        is_in_obstacle = ((position > low) & (position < high)).all(1)
        position = position[~is_in_obstacle]
    if not len(position):
        raise InputError("conditions: no station is possible: the obstacles fill the whole room")
    # Every target is looked at in turn: with a narrow camera a station sees only what it looks at.
    targets = np.resize(np.arange(len(values["point"])), len(position))
    sight = np.asarray(values["point"])[targets] - position
    upright = np.tile([1.0, 0.0, 0.0, 0.0], (len(position), 1))
    return position, np.asarray(_turned(upright, sight)), targets


def check_feasible(pairs: StationTargetPairs, trials: int = 1024) -> None:
    """Refuse conditions that no station satisfies, and targets visible from none.

    **Arguments:** `trials`: positions all over the room. A part of the room of 0.5 % that satisfies
    the conditions is found with a probability of 99 % (1 − 0.995¹⁰²⁴).

    **Raises:** `InputError` naming the condition, or the targets."""
    start = pairs.problem.data.start
    position, rotation, _ = try_stations(pairs, trials)
    position = np.concatenate([position, start["image"].position])
    rotation = np.concatenate([rotation, start["image"].rotation])
    satisfied = {}
    for c in range(len(pairs.views)):
        by_condition = _test_conditions(pairs, c, start, position, rotation)
        for name, rows in by_condition.items():
            satisfied[name] = satisfied.get(name, False) | rows
        all_conditions = np.logical_and.reduce(list(by_condition.values()))
        satisfied["all"] = satisfied.get("all", False) | all_conditions
    everything = satisfied.pop("all")
    interest = np.flatnonzero(pairs.interest)
    if not everything.any():
        raise InputError(_why(satisfied, len(position)))
    # Targets measured already (third order) need no further visibility.
    measured_points = pairs.problem.point[np.nan_to_num(pairs.given_visibility) > 0]
    measured = np.bincount(measured_points, minlength=len(pairs.interest)) >= MIN_RAYS
    hidden = ~everything[:, interest].any(0) & ~measured[interest]
    if hidden.any():
        ids = [pairs.problem.network.points.id[interest[k]] for k in np.flatnonzero(hidden)]
        raise InputError(
            f"conditions: {len(ids)} of {len(interest)} targets cannot be measured from any place "
            f"in the room ({len(position)} tried): {list_some(ids)}. Widen the conditions, or "
            "leave these targets out"
        )


def _why(satisfied: dict[str, Bool[np.ndarray, "stations points"]], trials: int) -> str:
    """A message on the condition that no ray satisfies, or on contradictory conditions."""
    places = f"({trials} places in the room tried)"
    if "obstacles" in satisfied and not satisfied["obstacles"].any():
        return f"conditions: all targets are hidden by the obstacles from everywhere {places}"
    for name, rows in satisfied.items():
        if not rows.any():
            return (
                f'conditions: no station can satisfy the condition "{name}" for any target '
                f"{places}; widen it, or the room"
            )
    names = ", ".join(satisfied)
    without = (
        [
            name
            for name in satisfied
            if np.logical_and.reduce(
                [rows for other, rows in satisfied.items() if other != name]
            ).any()
        ]
        if len(satisfied) > 1
        else []
    )
    hint = f'; without "{without[0]}" they could' if without else ""
    return f"conditions: no station can satisfy {names} together for any target {places}{hint}"


def _test_conditions(
    pairs: StationTargetPairs,
    c: int,
    start: Values,
    position: Float[np.ndarray, "stations 3"],
    rotation: Float[np.ndarray, "stations 4"],
) -> dict[str, Bool[np.ndarray, "stations points"]]:
    """Which conditions the stations of a camera satisfy, [stations, points] each."""
    view = pairs.views[c]
    table, row = pairs.problem.table_of_camera(c)
    interior = jnp.asarray(start[table.name])[row]

    def test_ray(
        p: Float[Array, "3"],
        q: Float[Array, "4"],
        X: Float[Array, "3"],
        n: Float[Array, "3"] | None,
    ) -> dict[str, Bool[Array, ""]]:
        return visible(margins(view, pairs.rules, p, q, interior, X, n))

    of_points = jax.vmap(test_ray, (None, None, 0, None if pairs.normals is None else 0))
    of_all = jax.jit(jax.vmap(of_points, (0, 0, None, None)))
    by_condition = of_all(
        jnp.asarray(position),
        jnp.asarray(rotation),
        jnp.asarray(start["point"]),
        None if pairs.normals is None else jnp.asarray(pairs.normals),
    )
    return {name: np.asarray(rows) for name, rows in by_condition.items()}


def start_at(pairs: StationTargetPairs) -> Configuration:
    """The start configuration."""
    values = jax.tree.map(np.asarray, pairs.problem.data.start)
    return Configuration(values, points_on_axes(values))


def lost_targets(pairs: StationTargetPairs, measured: Bool[np.ndarray, " rays"]) -> tuple[str, ...]:
    """The ids of targets of interest undetermined by too few rays."""
    rays = np.bincount(pairs.problem.point[measured], minlength=len(pairs.interest))
    is_lost = pairs.interest & (rays < MIN_RAYS)
    return tuple(pairs.problem.network.points.id[k] for k in np.flatnonzero(is_lost))
