"""The observation equations, one function for one observation: v = (computed − observed) / σ.

Each kind of observation is a function of small changes of the unknowns it touches (its tangent)
around given values. That one function is evaluated for residuals and differentiated for every
Jacobian and Hessian; nothing else in the package knows how a residual depends on an unknown.

Rotation changes are exp([δθ]×) ≈ 1 + [δθ]× + ½[δθ]×², exact for the first and second derivatives
at δθ = 0, which is the only place they are taken.

| kind | rows | touches |
|---|---|---|
| image | x, y | image, camera, point (collinearity equations, distortion) |
| control | X, Y, Z | point |
| exterior | X0, Y0, Z0, ω, φ, κ | image |
| interior | the camera's parameters | camera |
| distance | d | two points |
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbundle import cameras
from jaxbundle.geometry import (
    matrix_from_quaternion,
    omega_phi_kappa_near,
    retract_quaternion,
)
from jaxbundle.network.arrays import Data, Values
from jaxbundle.network.structure import Structure


class Residuals(eqx.Module):
    """Residuals divided by their σ, by kind; a kind that does not occur has no rows."""

    image: Float[Array, "rays 2"]
    control: Float[Array, "control 3"]
    exterior: Float[Array, "exterior 6"]
    interior: Float[Array, "interior parameters"]
    distance: Float[Array, " distances"]


def image_residual(model, domain, free, rotation, centre, interior, point, xy, weight, change):
    """The two residuals of an image point, as scalars.

    **Arguments:** `rotation` (9 scalars, rows of M), `centre` (3), `interior` (the model's
    parameters), `point` (3), `xy` (2), `weight` (2, 1/σ); `change` = (δX0 (3), δθ (3), the
    changes of the parameters `free`, δX (3)).
    """
    d_centre, d_theta, d_interior, d_point = change
    interior = list(interior)
    for column, d in zip(free, d_interior):
        interior[column] = interior[column] + d
    X, Y, Z = (p + d - (c + e) for p, d, c, e in zip(point, d_point, centre, d_centre))
    ray = tuple(
        rotation[3 * i] * X + rotation[3 * i + 1] * Y + rotation[3 * i + 2] * Z for i in range(3)
    )
    turn = cross(d_theta, ray)
    ray = tuple(a + b + 0.5 * c for a, b, c in zip(ray, turn, cross(d_theta, turn)))
    vx, vy = cameras.residual(model, domain, tuple(interior), ray, xy)
    return weight[0] * vx, weight[1] * vy


def split_change(x, free: int, width: int):
    """A vector of 9 + `width` changes as `image_residual` takes them: δX0, δθ, `free` parameters
    (the rest of the width is not used), δX."""
    return tuple(
        tuple(x[i] for i in range(start, start + number))
        for start, number in ((0, 3), (3, 3), (6, free), (6 + width, 3))
    )


def cross(a, b):
    """The vector product of two triples of scalars."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def control_residual(point, given, weight, d_point):
    """A control point's coordinates against their given values [3]."""
    return weight * (point + d_point - given)


def exterior_residual(position, rotation, given, weight, d_image):
    """An image's exterior orientation against its prior (X0, Y0, Z0, ω, φ, κ) [6]."""
    M = matrix_from_quaternion(retract_quaternion(rotation, d_image[3:]))
    angles = omega_phi_kappa_near(M, given[3:])
    change = jnp.concatenate([position + d_image[:3], angles]) - given
    return weight * change


def interior_residual(parameters, given, weight, d_parameters):
    """A camera's parameters against their prior [parameters]."""
    return weight * (parameters + d_parameters - given)


def distance_residual(a, b, given, weight, d_a, d_b):
    """A distance between two points against its measured value."""
    difference = (a + d_a) - (b + d_b)
    return weight * (jnp.sqrt(jnp.sum(difference**2)) - given)


def scalars(table):
    """The elements of every item of a table as a tuple: structure of arrays, fast under vmap."""
    columns = table.reshape(table.shape[0], -1)
    return tuple(columns[:, i] for i in range(columns.shape[1]))


def over_rays(structure: Structure, group, function, values: Values, data: Data):
    """`function(rotation, centre, interior, point, xy, weight)` of every ray of one camera model.

    Each argument is a tuple of scalars; what belongs to the image is looked up once a chunk.
    **Returns:** the results of the function, whose arrays get the axes [chunks, chunk length].
    """
    table, model = structure.table, cameras.get_model(group.model)
    take = (lambda x: x) if group.chunks is None else (lambda x: x[group.chunks])
    image, camera = take(table.chunk_image), take(table.chunk_camera)
    of_chunk = lambda rows, index: tuple(column[index] for column in scalars(rows))
    matrices = jax.vmap(matrix_from_quaternion)(values.rotation)
    in_chunks = lambda rows: take(table.in_chunks(rows))
    point = in_chunks(structure.point)
    arguments = (
        of_chunk(matrices, image),
        of_chunk(values.position, image),
        of_chunk(values.camera[:, : len(model.parameters)], camera),
        of_chunk(values.point, point),
        tuple(in_chunks(column) for column in scalars(data.image_xy)),
        tuple(in_chunks(column) for column in scalars(data.image_weight)),
    )
    return jax.vmap(jax.vmap(function, (None, None, None, 0, 0, 0)))(*arguments)


def gather_groups(structure: Structure, parts):
    """The results of all camera models in the order of the rays; `parts`: a pytree per group."""
    flat = lambda x: x.reshape(x.shape[0] * x.shape[1], *x.shape[2:])
    groups, chunks = structure.groups, structure.table.chunk_image.shape[0]
    if len(parts) == 1 and groups[0].chunks is None:
        return jax.tree.map(flat, parts[0])

    def together(*arrays):
        whole = jnp.zeros((chunks, *arrays[0].shape[1:]))
        for group, part in zip(groups, arrays):
            whole = whole.at[group.chunks].set(part)
        return flat(whole)

    return jax.tree.map(together, *parts)


def residuals(structure: Structure, values: Values, data: Data) -> Residuals:
    """All residuals of the network, divided by their σ."""
    parts = []
    for group in structure.groups:
        model = cameras.get_model(group.model)
        still = ((0.0,) * 3, (0.0,) * 3, (0.0,) * len(group.free), (0.0,) * 3)

        def one(*row, model=model, still=still):
            return image_residual(model, structure.domain, (), *row, still)

        parts.append(jnp.stack(over_rays(structure, group, one, values, data), -1))
    s = structure
    a, b = s.distance[:, 0], s.distance[:, 1]
    zero3 = jnp.zeros(3)
    return Residuals(
        image=gather_groups(structure, parts),
        control=control_residual(values.point[s.control], data.control, data.control_weight, 0.0),
        exterior=_exterior_residuals(s, values, data),
        interior=interior_residual(
            values.camera[s.interior], data.interior, data.interior_weight, 0.0
        ),
        distance=jax.vmap(distance_residual, (0, 0, 0, 0, None, None))(
            values.point[a], values.point[b], data.distance, data.distance_weight, zero3, zero3
        ),
    )


def _exterior_residuals(s, values, data):
    if not s.exterior.shape[0]:
        return jnp.zeros((0, 6))  # Nothing to trace.
    return jax.vmap(exterior_residual, (0, 0, 0, 0, None))(
        values.position[s.exterior], values.rotation[s.exterior],
        data.exterior, data.exterior_weight, jnp.zeros(6),
    )  # fmt: skip


compiled_residuals = eqx.filter_jit(residuals)
"""`residuals`, compiled once and shared by everything that looks at a solution."""


def cost(structure: Structure, values: Values, data: Data) -> Float[Array, ""]:
    """½·vᵀPv of the network on all devices."""
    return structure.total(half_square(residuals(structure, values, data)))


def half_square(r: Residuals) -> Float[Array, ""]:
    """Half the weighted sum of squares, ½·vᵀPv."""
    return 0.5 * sum(jnp.vdot(x, x) for x in jax.tree.leaves(r))
