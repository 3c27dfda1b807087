"""Vectors as unpacked triples (x, y, z).

Formulas of one point that are mapped over millions of pixels take and return triples, or anything
that unpacks into three components, such as an array of shape [3, …]. XLA fuses them into one loop;
a batch of products of 3×3 matrices costs several times more.
"""

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Float

from jaxbundle.types import AnyArray, Scalar

Triple = tuple[Scalar, Scalar, Scalar]
Vector = Triple | Float[AnyArray, "3 ..."]
"""What unpacks into three components; functions return a `Triple`."""
Matrix = tuple[Triple, Triple, Triple] | Float[AnyArray, "3 3"]


def unpack(v: Vector | tuple[Scalar, ...]) -> Triple:
    """The three components, read once."""
    x, y, z = v
    return x, y, z


def rows_of_matrix(M: Float[AnyArray, "3 3"]) -> tuple[Triple, Triple, Triple]:
    """The rows of a matrix as triples, for `rotate` and `rotate_back`: every access of an array
    component costs time of compilation."""
    first_row, second_row, third_row = M
    return unpack(first_row), unpack(second_row), unpack(third_row)


def dot(u: Vector, v: Vector) -> Scalar:
    """u·v."""
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


def cross(u: Vector | Sequence[Scalar], v: Vector | Sequence[Scalar]) -> Triple:
    """u × v."""
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]


def point_on_ray(o: Vector, d: Vector, s: Scalar) -> Triple:
    """o + s·d, the point of a ray."""
    return o[0] + s * d[0], o[1] + s * d[1], o[2] + s * d[2]


def difference(u: Vector, v: Vector) -> Triple:
    """u − v."""
    return u[0] - v[0], u[1] - v[1], u[2] - v[2]


def scale_vector(s: Scalar, v: Vector) -> Triple:
    """s·v."""
    return s * v[0], s * v[1], s * v[2]


def length(v: Vector) -> Scalar:
    """|v|."""
    return jnp.sqrt(dot(v, v))


def unit(v: Vector) -> Triple:
    """v/|v|."""
    return scale_vector(1 / length(v), v)


def rotate(M: Matrix, v: Vector) -> Triple:
    """M·v."""
    return dot(M[0], v), dot(M[1], v), dot(M[2], v)


def rotate_back(M: Matrix, v: Vector) -> Triple:
    """Mᵀ·v."""
    x, y, z = (M[0][k] * v[0] + M[1][k] * v[1] + M[2][k] * v[2] for k in range(3))
    return x, y, z
