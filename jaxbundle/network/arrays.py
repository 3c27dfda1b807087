"""The arrays an adjustment works on, in the order of the network: unknowns and observations.

Rotations live on the manifold: an image carries a unit quaternion, and its change is a rotation
vector δθ in the camera frame, M ← exp([δθ]×)·M. Everything else adds. Object coordinates are
relative to the network's `origin`, so that a national grid of 10⁷ m loses no digit.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxbundle.geometry import matrix_from_quaternion, retract_quaternion


class Values(eqx.Module):
    """All quantities of the network, the free and the fixed ones.

    `camera`: interior orientation in the order of the model's parameters (padded with 0);
    `position`: projection centres; `rotation`: unit quaternions (w, x, y, z), object → camera;
    `point`: object coordinates. Positions and points are relative to the network's origin.
    `other`: the tables that came with further kinds of observations, by name.
    """

    camera: Float[Array, "cameras parameters"]
    position: Float[Array, "images 3"]
    rotation: Float[Array, "images 4"]
    point: Float[Array, "points 3"]
    other: dict[str, PyTree[Array]] = dataclasses.field(default_factory=dict)


class Data(eqx.Module):
    """What was measured or is given; every field can be differentiated.

    A weight is 1/σ (a priori), in the reciprocal unit of its value; 0 switches a row off.
    `start` holds the start values of the unknowns, the values of what is fixed, and the
    coordinates the datum refers to; `other` (measured, weight) of observations of further kinds.
    """

    start: Values
    image_xy: Float[Array, "rays 2"]
    image_weight: Float[Array, "rays 2"]
    control: Float[Array, "control 3"]
    control_weight: Float[Array, "control 3"]
    exterior: Float[Array, "exterior 6"]
    exterior_weight: Float[Array, "exterior 6"]
    interior: Float[Array, "interior parameters"]
    interior_weight: Float[Array, "interior parameters"]
    distance: Float[Array, " distances"]
    distance_weight: Float[Array, " distances"]
    other: tuple[tuple[PyTree[Array], Array], ...] = ()

    def measured(self, kind: str) -> Array:
        """What was measured, or is given, of a kind: image, control, exterior, interior,
        distance."""
        return self.image_xy if kind == "image" else getattr(self, kind)

    def weight(self, kind: str) -> Array:
        """The weights of a kind."""
        return getattr(self, f"{kind}_weight")


class Tangent(eqx.Module):
    """A small change of the free unknowns, as the adjustment orders them.

    `image`: δX0, δY0, δZ0, δθ (3) and, where every image has its own camera, the free interior
    orientation; `camera`: the free interior orientation where cameras are shared; `point`: δX,
    δY, δZ.
    """

    image: Float[Array, "images image_block"]
    camera: Float[Array, "cameras camera_block"]
    point: Float[Array, "points 3"]


def split_image_block(structure, tangent: Tangent):
    """The exterior part [images, 6] and the interior part [cameras, k] of a change."""
    if structure.own_camera:
        return tangent.image[:, :6], tangent.image[:, 6:]
    return tangent.image, tangent.camera


def retract(structure, values: Values, tangent: Tangent) -> Values:
    """The unknowns after a small change; what is fixed must have a zero change."""
    exterior, interior = split_image_block(structure, tangent)
    camera = values.camera
    if interior.shape[1]:
        rows = jnp.arange(camera.shape[0])[:, None]
        camera = camera.at[rows, structure.camera_columns].add(interior * structure.camera_free)
    return Values(
        camera=camera,
        position=values.position + exterior[:, :3],
        rotation=jax.vmap(retract_quaternion)(values.rotation, exterior[:, 3:]),
        point=values.point + tangent.point,
    )


def retract_about(structure, values: Values, tangent: Tangent) -> Values:
    """`retract`, but every image turns about the middle of the points it sees.

    To first order the same. A long step that turns an image and shifts it, so that it keeps its
    points, keeps them only if the turn is about them: about its own projection centre they leave
    the image by the second-order terms. (A problem of 16 images of close-up scenes: 12 steps to
    the minimum instead of 21.) The middle is that of the points weighted by 1/distance², as much as
    they say about the position; so far ones do not pull it away. Images whose position is held
    turn about it.
    """
    s, moved = structure, retract(structure, values, tangent)
    point = values.point[s.point]
    square = jnp.sum((point - s.table.of_image(values.position)) ** 2, 1, keepdims=True)
    weight = s.table.used[:, None] / jnp.maximum(square, 1e-300)
    seen = jnp.concatenate([weight * point, weight], 1)
    seen = s.total(s.table.sum_by_image(seen))
    pivot = seen[:, :3] / jnp.where(seen[:, 3:] > 0, seen[:, 3:], 1.0)

    def position(old, M, new_M, change, pivot):
        Y = M @ (pivot - old)
        return pivot - new_M.T @ (Y + jnp.cross(change[3:], Y) - M @ change[:3])

    matrices = jax.vmap(matrix_from_quaternion)
    exterior, _ = split_image_block(s, tangent)
    turned = jax.vmap(position)(
        values.position, matrices(values.rotation), matrices(moved.rotation), exterior, pivot
    )
    free = s.image_free[:, :3].all(1, keepdims=True)
    return eqx.tree_at(lambda v: v.position, moved, jnp.where(free, turned, moved.position))
