"""Parametrisation of one row of a table of unknowns: vectors, rotations, poses, directions.

A space defines, for ONE row, the number of directions (`width`), the block of scalars that an
observation receives (`prepare`), the effect of a small change δ on that block (`move`, correct to
second order at δ = 0, where all derivatives are taken), the application of a finite change
(`retract`), and the change between two values (`difference`; `small_difference`, if there is one,
has the same first derivatives where both are equal). `hold` is a value with its held part taken
from another; `chart` gives the unknowns of the damping matrix,
T = ∂(chart)/∂δ and T⁻¹.

Blocks consist of scalars, not of small arrays: under `vmap` every scalar becomes one long array,
and XLA compiles the observation equations to plain loops over the observations (a third of the time
of small matrix products).
"""

import dataclasses
from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxbundle.geometry import (
    matrix_from_quaternion,
    quaternion_difference,
    retract_quaternion,
)
from jaxbundle.geometry.quaternions import small_difference
from jaxbundle.geometry.vectors import cross
from jaxbundle.types import AnyArray, Scalar

Change = tuple[Scalar, ...]
# Three scalars, x, y, z; a comprehension makes a tuple of no known length for a type checker.
Triple = tuple[Scalar, ...]
# What an observation receives of a row: scalars, or objects of scalars such as `Posed`.
Block = PyTree[Scalar]
Matrix = Float[Array, "width width"]
Value = TypeVar("Value")


@runtime_checkable
class Space(Protocol):
    """The interface of a space; instances are hashable and compare by their fields."""

    @property
    def width(self) -> int: ...

    def prepare(self, value: Any) -> Block: ...

    def move(self, block: Any, change: Change) -> Block: ...

    def retract(self, value: Any, change: Float[AnyArray, " width"]) -> Any: ...

    def difference(self, value: Any, origin: Any) -> Float[Array, " width"]: ...

    def hold(self, value: Any, start: Any, free: Float[Array, " width"]) -> Any: ...

    def chart(self, value: Any) -> tuple[Matrix, Matrix] | None: ...


class WithoutChart:
    """A space that is damped in its own directions."""

    def chart(self, value: Any) -> None:  # noqa: ARG002 (other spaces need it)
        return None


def hold_by_retraction(
    space: Space, value: Value, start: Value, free: Float[Array, " width"]
) -> Value:
    """`Space.hold` where directions are no numbers of the value: the change from `start` to it,
    without that along held directions."""
    without_held = space.retract(start, jnp.where(free > 0, space.difference(value, start), 0.0))

    def choose(all_free: Array, some_free: Array, none_free: Array) -> Array:
        # Both ends exactly: a retraction normalises rotations, which changes their last digit.
        held_in_part = jnp.where(free.max() > 0, some_free, none_free)
        return jnp.where(free.min() > 0, all_free, held_in_part)

    return jax.tree.map(choose, value, without_held, start)


@dataclasses.dataclass(frozen=True)
class Vector(WithoutChart):
    """Numbers that add. `size`: how many (0: a single number, not in a tuple); `columns`: the free
    ones (None: all); `tied`: further ones that change with one of these, (column, index in
    `columns`) each."""

    size: int
    columns: tuple[int, ...] | None = None
    tied: tuple[tuple[int, int], ...] = ()

    @property
    def moving(self) -> tuple[int, ...]:
        return tuple(range(max(self.size, 1))) if self.columns is None else self.columns

    @property
    def width(self) -> int:
        return len(self.moving)

    @property
    def moves(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """The columns that change, and the component of a change for each."""
        pairs = (*((column, k) for k, column in enumerate(self.moving)), *self.tied)
        return tuple(column for column, _ in pairs), tuple(k for _, k in pairs)

    def prepare(self, value: Float[Array, " *size"]) -> Block:
        return tuple(value) if self.size else value

    def move(self, block: Block, change: Change) -> Block:
        if not self.size:
            return block + change[0] if change else block
        if not change:
            return block
        block = list(block)
        for column, k in zip(*self.moves):
            # Tied columns change with theirs, as fy with fx.
            block[column] = block[column] + change[k]
        return tuple(block)

    def retract(
        self, value: Float[Array, " *size"], change: Float[AnyArray, " width"]
    ) -> Float[Array, " *size"]:
        if not self.size:
            return value + change[0] if change.shape[0] else value
        columns, of = (jnp.array(x, int) for x in self.moves)
        return value.at[columns].add(change[of])

    def difference(
        self, value: Float[Array, " *size"], origin: Float[Array, " *size"]
    ) -> Float[Array, " width"]:
        change = value - origin
        return change[jnp.array(self.moving, int)] if self.size else change[None]

    def hold(
        self,
        value: Float[Array, " *size"],
        start: Float[Array, " *size"],
        free: Float[Array, " width"],
    ) -> Float[Array, " *size"]:
        if not self.size:
            return jnp.where(free[0] > 0, value, start) if self.width else start
        columns, of = (jnp.array(x, int) for x in self.moves)
        # A tied column is held with the one it follows.
        moves = jnp.zeros(self.size).at[columns].set(free[of])
        return jnp.where(moves > 0, value, start)


class Turned(NamedTuple):
    """A rotation M for observations: `rows`, 9 scalars, and a small additional rotation."""

    rows: tuple[Scalar, ...]
    turn: tuple[Scalar, Scalar, Scalar] | None = None

    def apply(self, X: Triple) -> Triple:
        """M·X."""
        m = self.rows
        ray = tuple(m[3 * i] * X[0] + m[3 * i + 1] * X[1] + m[3 * i + 2] * X[2] for i in range(3))
        if self.turn is None:
            return ray
        # exp([θ]×) ≈ 1 + [θ]× + ½[θ]×²: to second order, since Hessians are taken at θ = 0.
        first_order = cross(self.turn, ray)
        second_order = cross(self.turn, first_order)
        return tuple(a + b + 0.5 * c for a, b, c in zip(ray, first_order, second_order))

    def matrix(self) -> Float[Array, "3 3"]:
        """M as an array [3, 3]."""
        columns = [self.apply(axis) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))]
        return jnp.stack([jnp.stack(column) for column in columns], 1)

    def apply_inverse(self, x: Triple) -> Triple:
        """Mᵀ·x."""
        if self.turn is not None:
            # The inverse rotation: θ → −θ, by the order of the product.
            first_order = cross(x, self.turn)
            second_order = cross(first_order, self.turn)
            x = tuple(a + b + 0.5 * c for a, b, c in zip(x, first_order, second_order))
        m = self.rows
        return tuple(m[i] * x[0] + m[3 + i] * x[1] + m[6 + i] * x[2] for i in range(3))


class Posed(NamedTuple):
    """A pose for observations: rotation M and projection centre X0."""

    rotation: Turned
    centre: Triple

    def ray(self, X: Triple) -> Triple:
        """M·(X − X0): a point of object space in the frame of the pose."""
        return self.rotation.apply(tuple(a - b for a, b in zip(X, self.centre)))

    def place(self, x: Triple) -> Triple:
        """X0 + Mᵀ·x: a point in the frame of the pose, in object space."""
        return tuple(a + b for a, b in zip(self.centre, self.rotation.apply_inverse(x)))


@dataclasses.dataclass(frozen=True)
class Rotation(WithoutChart):
    """Unit quaternions (w, x, y, z); a change is a rotation vector, M ← exp([δ]×)·M."""

    width = 3

    def prepare(self, value: Float[Array, " 4"]) -> Turned:
        return Turned(tuple(matrix_from_quaternion(value).ravel()))

    def move(self, block: Turned, change: Change) -> Turned:
        return block._replace(turn=tuple(change)) if change else block

    def retract(
        self, value: Float[Array, " 4"], change: Float[AnyArray, " width"]
    ) -> Float[Array, " 4"]:
        return retract_quaternion(value, change)

    def difference(
        self, value: Float[Array, " 4"], origin: Float[Array, " 4"]
    ) -> Float[Array, " width"]:
        return quaternion_difference(value, origin)

    def hold(
        self, value: Float[Array, " 4"], start: Float[Array, " 4"], free: Float[Array, " width"]
    ) -> Float[Array, " 4"]:
        return jnp.where(free.max() > 0, value, start)


class PoseValue(NamedTuple):
    """Projection centres and rotations of poses, as arrays of a table."""

    position: Float[AnyArray, "*rows 3"]
    rotation: Float[AnyArray, "*rows 4"]


@dataclasses.dataclass(frozen=True)
class Pose:
    """A projection centre X0 and a rotation M, `PoseValue`; a change is (δX0, δθ).

    Damping weights a rotation δθ and a shift δX0 like programs that store [R t]: by the rotation
    and the change of t = −M·X0, the origin of object space in the camera frame. A rotation is then
    about that origin and weighs more the farther away it is; with light damping of both, long steps
    of one against the other would be tried and rejected.
    """

    width = 6

    def prepare(self, value: PoseValue) -> Posed:
        matrix = tuple(matrix_from_quaternion(value.rotation).ravel())
        return Posed(Turned(matrix), tuple(value.position))

    def move(self, block: Posed, change: Change) -> Posed:
        if not change:
            return block
        centre = tuple(c + d for c, d in zip(block.centre, change[:3]))
        return Posed(block.rotation._replace(turn=tuple(change[3:])), centre)

    def retract(self, value: PoseValue, change: Float[AnyArray, " width"]) -> PoseValue:
        return PoseValue(
            value.position + change[:3], retract_quaternion(value.rotation, change[3:])
        )

    def difference(self, value: PoseValue, origin: PoseValue) -> Float[Array, " width"]:
        turn = quaternion_difference(value.rotation, origin.rotation)
        return jnp.concatenate([value.position - origin.position, turn])

    def small_difference(self, value: PoseValue, origin: PoseValue) -> Float[Array, " width"]:
        turn = small_difference(value.rotation, origin.rotation)
        return jnp.concatenate([value.position - origin.position, turn])

    def hold(self, value: PoseValue, start: PoseValue, free: Float[Array, " width"]) -> PoseValue:
        return PoseValue(
            jnp.where(free[:3] > 0, value.position, start.position),
            jnp.where(free[3:].max() > 0, value.rotation, start.rotation),
        )

    def chart(self, value: PoseValue) -> tuple[Matrix, Matrix]:
        M = matrix_from_quaternion(value.rotation)
        t = -M @ value.position
        # exp([δθ]×) ≈ 1 + [δθ]×: the derivatives are taken at 0 only.
        to_shift = lambda change: jnp.cross(change[3:], t) - M @ change[:3]
        from_shift = lambda those: M.T @ (jnp.cross(those[3:], t) - those[:3])
        matrix = lambda f: jnp.eye(6).at[:3].set(jax.jacfwd(f)(jnp.zeros(6)))
        return matrix(to_shift), matrix(from_shift)


@dataclasses.dataclass(frozen=True)
class Frame(WithoutChart):
    """A pose, `PoseValue`, that moves along and about its own axes, δ = (shift along x, y, z,
    rotation about x, y, z), restricted to `columns`: for a figure invariant to the other shifts and
    rotations (a plane along itself, a cylinder about its axis)."""

    columns: tuple[int, ...] = (0, 1, 2, 3, 4, 5)

    @property
    def width(self) -> int:
        return len(self.columns)

    def prepare(self, value: PoseValue) -> Posed:
        return Pose().prepare(value)

    def move(self, block: Posed, change: Change) -> Posed:
        if not change:
            return block
        all_directions: list[Scalar] = [0.0] * 6
        for column, d in zip(self.columns, change):
            all_directions[column] = d
        return Posed(
            block.rotation._replace(turn=tuple(all_directions[3:])),
            block.place(tuple(all_directions[:3])),
        )

    def retract(self, value: PoseValue, change: Float[AnyArray, " width"]) -> PoseValue:
        all_directions = jnp.zeros(6).at[jnp.array(self.columns, int)].set(change)
        # The shift is along the axes of the frame as it is, not as it will be.
        shift = matrix_from_quaternion(value.rotation).T @ all_directions[:3]
        return PoseValue(
            value.position + shift, retract_quaternion(value.rotation, all_directions[3:])
        )

    def difference(self, value: PoseValue, origin: PoseValue) -> Float[Array, " width"]:
        shift = matrix_from_quaternion(origin.rotation) @ (value.position - origin.position)
        turn = quaternion_difference(value.rotation, origin.rotation)
        return jnp.concatenate([shift, turn])[jnp.array(self.columns, int)]

    def hold(self, value: PoseValue, start: PoseValue, free: Float[Array, " width"]) -> PoseValue:
        return hold_by_retraction(self, value, start, free)

    def representative(self, value: PoseValue, reference: PoseValue) -> PoseValue:
        """Of all frames of the same figure the one nearest to `reference`: its position is that of
        `reference` projected onto the figure, its rotation that of `reference` turned as little as
        the figure asks for. Iterations leave these to their path, which has no derivative."""
        M = matrix_from_quaternion(value.rotation)
        along_itself = jnp.array([k not in self.columns for k in range(3)])
        offset = jnp.where(along_itself, M @ (reference.position - value.position), 0.0)
        position = value.position + M.T @ offset
        axes = [k for k in range(3) if 3 + k not in self.columns]
        if len(axes) == 3:
            return PoseValue(position, reference.rotation)
        if len(axes) == 1:  # about which the trace of the rotation from `reference` is the largest
            (k,), (i, j) = axes, ((axes[0] + 1) % 3, (axes[0] + 2) % 3)
            A = M @ matrix_from_quaternion(reference.rotation).T
            turn = jnp.arctan2(A[i, j] - A[j, i], A[i, i] + A[j, j])
            rotation = retract_quaternion(value.rotation, jnp.zeros(3).at[k].set(turn))
            return PoseValue(position, rotation)
        return PoseValue(position, value.rotation)


@dataclasses.dataclass(frozen=True)
class Direction(WithoutChart):
    """Unit vectors of `size` numbers; a change is one in the tangent plane, in an orthonormal basis
    of it (of the Householder reflection that takes the vector to an axis)."""

    size: int

    @property
    def width(self) -> int:
        return self.size - 1

    def prepare(self, value: Float[Array, " size"]) -> tuple[Change, tuple[Change, ...]]:
        return tuple(value), tuple(map(tuple, tangent_basis(value)))

    def move(self, block: tuple[Change, tuple[Change, ...]], change: Change) -> Change:
        value, basis = block
        if not change:
            return value
        square = sum(d * d for d in change)
        return tuple(
            # cos|δ| and sin|δ|/|δ| to second order.
            v * (1 - 0.5 * square) + sum(b * d for b, d in zip(row, change))
            for v, row in zip(value, basis)
        )

    def retract(
        self, value: Float[Array, " size"], change: Float[AnyArray, " width"]
    ) -> Float[Array, " size"]:
        displaced = value + tangent_basis(value) @ change
        return displaced / jnp.linalg.norm(displaced)

    def difference(
        self, value: Float[Array, " size"], origin: Float[Array, " size"]
    ) -> Float[Array, " width"]:
        return tangent_basis(origin).T @ value / (value @ origin)

    def hold(
        self,
        value: Float[Array, " size"],
        start: Float[Array, " size"],
        free: Float[Array, " width"],
    ) -> Float[Array, " size"]:
        return jnp.where(free.max() > 0, value, start)


def tangent_basis(value: Float[Array, " n"]) -> Float[Array, "n n-1"]:
    """Columns orthogonal to a unit vector: those of a reflection that takes it to ∓ its last axis,
    without the last."""
    # The sign that adds: the axis of the reflection is then never zero, wherever the vector points.
    sign = jnp.where(value[-1] < 0, -1.0, 1.0)
    axis = value.at[-1].add(sign)
    reflection = jnp.eye(len(value)) - 2 * jnp.outer(axis, axis) / (axis @ axis)
    return reflection[:, :-1]


def turn_by(angle: Triple, x: Triple) -> Triple:
    """exp([angle]×)·x for rotations below a third of a radian, by series: exact to rounding, with
    derivatives at 0."""
    square = sum(a * a for a in angle)
    sine = 1 - square / 6 * (1 - square / 20 * (1 - square / 42 * (1 - square / 72)))
    cosine = 0.5 - square / 24 * (1 - square / 30 * (1 - square / 56 * (1 - square / 90)))
    first_order = cross(angle, x)
    second_order = cross(angle, first_order)
    return tuple(a + sine * b + cosine * c for a, b, c in zip(x, first_order, second_order))
