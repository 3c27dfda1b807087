"""Distances of a point from planes, triangles and grids of heights; all in one unit of length."""

from types import ModuleType

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbundle.types import AnyArray


def distance_to_plane(
    X: Float[Array, "3"], place: Float[Array, "3"], normal: Float[Array, "3"]
) -> Float[Array, ""]:
    """The signed distance from the plane through a place with a normal of length 1."""
    return (X - place) @ normal


def distance_to_nearest_triangle(
    X: Float[Array, "3"], corners: Float[Array, "k 3 3"]
) -> Float[Array, ""]:
    """The signed distance from the plane of the nearest of k triangles (Chen and Medioni 1992)."""
    a = corners[:, 0]
    normal = jnp.cross(corners[:, 1] - a, corners[:, 2] - a)
    size = jnp.linalg.norm(normal, axis=1)
    normal = normal / jnp.where(size > 0, size, 1.0)[:, None]
    # Which triangle counts is a choice: it has no derivative.
    nearest = jnp.argmin(jax.lax.stop_gradient(squared_distances_to_triangles(X, corners)))
    return (X - a[nearest]) @ normal[nearest]


def squared_distances_to_triangles(
    X: Float[AnyArray, "3"], corners: Float[AnyArray, "k 3 3"], xp: ModuleType = jnp
) -> Float[AnyArray, " k"]:
    """The squared distances from triangles: from their planes where the foot of the perpendicular
    is inside, else from the nearest edge; by `jax.numpy`, or `numpy`."""
    side, from_corner = xp.roll(corners, -1, 1) - corners, X - corners
    normal = xp.cross(side[:, 0], side[:, 1])
    size = (normal * normal).sum(1)
    is_inside = ((xp.cross(side, from_corner) * normal[:, None]).sum(2) >= 0).all(1) & (size > 0)
    length = (side * side).sum(2)
    t = xp.clip((from_corner * side).sum(2) / xp.where(length > 0, length, 1.0), 0.0, 1.0)
    edges = ((from_corner - t[..., None] * side) ** 2).sum(2).min(1)
    distance_from_plane = (from_corner[:, 0] * normal).sum(1) ** 2 / xp.where(size > 0, size, 1.0)
    return xp.where(is_inside, distance_from_plane, edges)


def height_above_grid(
    X: Float[Array, "3"],
    heights: Float[Array, "n n"],
    first_node: Float[Array, "2"],
    step: Float[Array, "2"],
) -> Float[Array, ""]:
    """The height above a grid, bilinear: heights [Y, X], the place of the first node, and the steps
    along X and Y. Beyond its edges the outermost cells go on."""
    place = (X[:2] - first_node) / step
    cell = jnp.clip(jnp.floor(jax.lax.stop_gradient(place)), 0, heights.shape[0] - 2).astype(int)
    x, y = place - cell
    (a, b), (c, d) = jax.lax.dynamic_slice(heights, (cell[1], cell[0]), (2, 2))
    return X[2] - ((1 - y) * ((1 - x) * a + x * b) + y * ((1 - x) * c + x * d))
