r"""The variables of a design of first order: positions, viewing directions and roll of cameras,
and positions of targets.

Lengths are in units of the size of the network, angles in radians. A station looks at a point, so
that it rotates as it moves: from the start attitude M by the smallest rotation of the axis
to the point, then by the roll ρ about it,

    M' = R3(ρ)·exp([δ]×)·M,   δ from d × (0, 0, −1), d the direction of the point in the camera.
"""

import dataclasses
from collections.abc import Callable
from functools import cached_property

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Shaped

from jaxbundle.choices import DESIGNED
from jaxbundle.errors import InputError
from jaxbundle.geometry import matrix_from_quaternion, retract_quaternion
from jaxbundle.leastsquares.indexing.rows import Values
from jaxbundle.leastsquares.spaces import PoseValue
from jaxbundle.types import AnyArray

AXIS = np.array([0.0, 0.0, -1.0])


class Configuration(eqx.Module):
    """The quantities changed by the variables: values of the network, and the viewed points,
    relative to its origin."""

    values: Values
    look: Float[AnyArray, "images 3"]


@dataclasses.dataclass(frozen=True)
class Variables:
    """The variable rows and the parts of the vector of variables; `unit`: of lengths."""

    images: Int[np.ndarray, " images"]
    points: Int[np.ndarray, " points"]
    free: tuple[str, ...]
    unit: float

    @property
    def sizes(self) -> dict[str, tuple[int, int]]:
        """Rows and columns of every part of the vector."""
        i, p = len(self.images), len(self.points)
        all_sizes = {"position": (i, 3), "direction": (i, 3), "roll": (i, 1), "targets": (p, 3)}
        return {
            name: all_sizes[name] for name in DESIGNED if name in self.free and all_sizes[name][0]
        }

    def parts(self, x: Shaped[AnyArray, " variables"]) -> dict[str, AnyArray]:
        """The vector by name, [rows, columns]."""
        by_name, begin = {}, 0
        for name, (rows, columns) in self.sizes.items():
            by_name[name] = x[begin : begin + rows * columns].reshape(rows, columns)
            begin += rows * columns
        return by_name

    def vector(self, start: Configuration) -> Float[np.ndarray, " variables"]:
        """The variables of the start: roll 0."""
        rows = {
            "position": np.asarray(start.values["image"].position)[self.images] / self.unit,
            "direction": np.asarray(start.look)[self.images] / self.unit,
            "roll": np.zeros((len(self.images), 1)),
            "targets": np.asarray(start.values["point"])[self.points] / self.unit,
        }
        return np.concatenate([np.zeros(0), *(rows[name].ravel() for name in self.sizes)])

    def positions(
        self, start: Configuration, x: Float[np.ndarray, " variables"]
    ) -> Float[np.ndarray, "images 3"]:
        """Projection centres at these variables."""
        positions = np.array(start.values["image"].position)
        if "position" in self.sizes:
            positions[self.images] = self.parts(x)["position"] * self.unit
        return positions

    @cached_property
    def compiled_place(
        self,
    ) -> Callable[["Configuration", Float[AnyArray, " variables"]], "Configuration"]:
        """`place`, compiled."""
        return jax.jit(lambda start, x: self.place(start, x))

    def place(self, start: Configuration, x: Float[AnyArray, " variables"]) -> Configuration:
        """The network at these variables."""
        parts, values = self.parts(x), start.values
        position, rotation = map(jnp.asarray, values["image"])
        look, point = jnp.asarray(start.look), jnp.asarray(values["point"])
        # The position first: the direction is that from the new position to the viewed point.
        if "position" in parts:
            position = position.at[self.images].set(parts["position"] * self.unit)
        if "direction" in parts:
            look = look.at[self.images].set(parts["direction"] * self.unit)
            away = (look - position)[self.images]
            turned = jax.vmap(turn_axis)(rotation[self.images], away)
            rotation = rotation.at[self.images].set(turned)
        if "roll" in parts:
            roll = lambda q, angle: retract_quaternion(q, jnp.zeros(3).at[2].set(angle))
            rolled = jax.vmap(roll)(rotation[self.images], parts["roll"][:, 0])
            rotation = rotation.at[self.images].set(rolled)
        if "targets" in parts:
            point = point.at[self.points].set(parts["targets"] * self.unit)
        image = PoseValue(position, rotation)
        return Configuration(values | {"image": image, "point": point}, look)


def turn_axis(q: Float[AnyArray, "4"], away: Float[AnyArray, "3"]) -> Float[Array, "4"]:
    """The attitude rotated so that the axis has the direction `away` (object space)."""
    d = matrix_from_quaternion(q) @ away
    d = d / jnp.sqrt(jnp.sum(d**2))
    axis, cosine = jnp.cross(d, AXIS), d @ AXIS
    square = jnp.sum(axis**2)
    # δ = axis·angle/sine, which is 1 + sine²/6 near zero: below 1e-6 rad, where the quotient of two
    # roundings has no derivative, the series is exact to 1e-24.
    small = square < 1e-12
    sine = jnp.sqrt(jnp.where(small, 1.0, square))
    times = jnp.where(small, 1.0 + square / 6, jnp.arctan2(sine, cosine) / sine)
    return retract_quaternion(q, times * axis)


def choose_variables(
    values: Values,
    free: tuple[str, ...],
    images: Int[np.ndarray, " images"],
    points: Int[np.ndarray, " points"],
) -> Variables:
    """The variables of these rows.

    **Raises:** `InputError` for variables that cannot be free."""
    for name in free:
        if name not in DESIGNED:
            raise InputError(f"free: {name!r} is not one of {', '.join(DESIGNED)}")
    if not free:
        raise InputError(f"free: nothing to design; give some of {', '.join(DESIGNED)}")
    reach = np.asarray(values["image"].position) - np.asarray(values["point"]).mean(0)
    return Variables(images, points, tuple(free), float(np.linalg.norm(reach, axis=1).mean()))


_axes = jax.jit(jax.vmap(lambda q: matrix_from_quaternion(q).T @ AXIS))


def points_on_axes(values: Values) -> Float[np.ndarray, "images 3"]:
    """The points on the axes of all images at the depth of the centre of the targets."""
    position, middle = np.asarray(values["image"].position), np.asarray(values["point"]).mean(0)
    axis = np.asarray(_axes(np.asarray(values["image"].rotation)))
    depth = ((middle - position) * axis).sum(1)
    size = np.linalg.norm(middle - position, axis=1)
    # At least a tenth of the distance in front of a camera that looks away from the targets.
    return position + np.maximum(depth, 0.1 * size)[:, None] * axis


def bounds(
    variables: Variables,
    start: Configuration,
    room: Float[np.ndarray, "2 3"],
    targets: Float[np.ndarray, "2 3"],
) -> tuple[Float[np.ndarray, " variables"], Float[np.ndarray, " variables"]]:
    """The smallest and largest values of the variables; boxes relative to the origin."""
    points = np.concatenate([np.asarray(start.values["point"]), start.look])
    low, high = points.min(0), points.max(0)
    # Cameras may look past the targets by a quarter of their extent. Farther, a viewed point says
    # less about the direction and the search has nothing to gain.
    spare = 0.25 * max((high - low).max(), 1e-9)
    boxes = {
        "position": room,
        "targets": targets,
        "direction": np.stack([low - spare, high + spare]),
    }
    ends = []
    for end in (0, 1):
        parts = [np.zeros(0)]
        for name, (rows, _) in variables.sizes.items():
            if name == "roll":
                parts.append(np.full(rows, (-np.pi, np.pi)[end]))
            else:
                parts.append(np.tile(boxes[name][end] / variables.unit, rows))
        ends.append(np.concatenate(parts))
    return ends[0], ends[1]
