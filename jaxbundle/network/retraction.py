"""The retraction of a network: images rotate about the points they see, and a network that its
control hardly holds rotates as one."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.geometry import matrix_from_quaternion
from jaxbundle.leastsquares.datum.conditions import generators, move_tables
from jaxbundle.leastsquares.datum.motions import ROTATION
from jaxbundle.leastsquares.equations.normal import Rows, sum_over_devices
from jaxbundle.leastsquares.indexing.plan import Plan, Tangent
from jaxbundle.leastsquares.indexing.rows import Declared, Values
from jaxbundle.leastsquares.iterations.retraction import changes_of_tables, retract_tables
from jaxbundle.leastsquares.spaces import PoseValue
from jaxbundle.network.kinds.image_points import ImagePoint
from jaxbundle.network.noise import noise_of_rays
from jaxbundle.network.tables import Network
from jaxbundle.types import AnyArray


@dataclasses.dataclass(frozen=True)
class TurnAboutSeen:
    """`retract`, but every image rotates about the centre of the points it sees.

    To first order the same. A long step that rotates and shifts an image so that it keeps its
    points keeps them only if the rotation is about them: a rotation about the projection centre
    moves them out of the image by second-order terms. (A problem of 16 images of close-up scenes:
    12 steps to the minimum instead of 21.) The centre is weighted by 1/distance², the information
    of a point about the position, so that far points do not dominate it. Images with held position
    rotate about it.

    `moves_as_one`: what a step has in common with a similarity of the whole network is a finite
    similarity, which changes no ray, where points would move along tangents (`control_is_weak`).
    """

    declared: Declared
    moves_as_one: bool = False

    def __call__(self, plan: Plan, values: Values, change: Tangent) -> Values:
        changes = changes_of_tables(plan, values, change)
        if "image" not in changes:
            return retract_tables(self.declared, values, changes)
        if not self.moves_as_one:
            return self._turn(plan, values, changes)
        motion = _motion_of_images(plan, values["image"], changes["image"])
        directions = generators(self.declared, {name: values[name] for name in changes})
        remaining = {name: change - directions[name] @ motion for name, change in changes.items()}
        return move_tables(self.declared, plan, motion, self._turn(plan, values, remaining))

    def _turn(self, plan: Plan, values: Values, changes: dict[str, Rows]) -> Values:
        retracted = retract_tables(self.declared, values, changes)
        old, new, pivot = values["image"], retracted["image"], self._middle(plan, values)

        def position(
            old: Float[Array, "3"],
            M: Float[Array, "3 3"],
            new_M: Float[Array, "3 3"],
            change: Float[AnyArray, "6"],
            pivot: Float[Array, "3"],
        ) -> Float[Array, "3"]:
            # X0' such that the pivot is seen where the linear step sees it: M'·(X̄ − X0') equals
            # M·(X̄ − X0) + δθ × M·(X̄ − X0) − M·δX0, the first-order change of its ray.
            Y = M @ (pivot - old)
            return pivot - new_M.T @ (Y + jnp.cross(change[3:], Y) - M @ change[:3])

        matrices = jax.vmap(matrix_from_quaternion)
        turned = jax.vmap(position)(
            old.position, matrices(old.rotation), matrices(new.rotation), changes["image"], pivot
        )
        free = plan.groups["image"].free[:, :3].all(1, keepdims=True)
        return retracted | {"image": PoseValue(jnp.where(free, turned, new.position), new.rotation)}

    def _middle(self, plan: Plan, values: Values) -> Float[Array, "images 3"]:
        """The centre of the points that each image sees; 0 if it sees none."""
        position, points = values["image"].position, values["point"][:, :3]
        sums = jnp.zeros((position.shape[0], 4))
        for part in plan.parts:
            if not isinstance(self.declared.kinds[part.set_name].residual, ImagePoint):
                continue
            image, point = part.lookup[0], points[part.lookup[-1]]
            centre = position[image] if part.by_row[0] else position[image][:, None]
            point = point if part.by_row[-1] else point[:, None]
            # The last row of the source is that of the padding.
            is_observation = part.source != part.place.shape[0] - 1
            square = jnp.sum((point - centre) ** 2, -1)
            weight = jnp.where(is_observation, 1 / jnp.maximum(square, 1e-300), 0.0)[..., None]
            rows = jnp.concatenate([weight * point, weight], -1)
            rows = rows if part.by_row[0] else rows.sum(1)
            rows = rows.reshape(-1, 4)
            sums = sums + jax.ops.segment_sum(rows, image.ravel(), position.shape[0])
        sums = sum_over_devices(plan, sums)
        return sums[:, :3] / jnp.where(sums[:, 3:] > 0, sums[:, 3:], 1.0)


def _motion_of_images(plan: Plan, images: PoseValue, changes: Rows) -> Float[Array, "7"]:
    """The similarity nearest to a change of images: the mean of their rotations in object space,
    then the shift and the scale that fit what their positions move beside."""
    free = plan.groups["image"].free[:, :6].all(1, keepdims=True)
    mean = lambda x: jnp.sum(jnp.where(free, x, 0.0), 0) / jnp.maximum(free.sum(), 1)
    # A turn r of the object is −M·r in the frame of the camera (`geometry.helmert_pose`).
    M = jax.vmap(matrix_from_quaternion)(images.rotation)
    turn = -mean(jnp.einsum("nji,nj->ni", M, changes[:, 3:]))
    moved = changes[:, :3] - jnp.cross(turn, images.position)
    X = images.position - mean(images.position)
    square = mean(jnp.sum(X * X, 1, keepdims=True))
    scale = mean(jnp.sum(X * moved, 1, keepdims=True)) / jnp.where(square > 0, square, 1.0)
    shift = mean(moved) - scale * mean(images.position)
    return jnp.concatenate([shift, turn, scale])


def control_is_weak(
    network: Network,
    information: Float[np.ndarray, "7 7"],
    observations: int,
    straight_steps: float = 10.0,
) -> bool:
    """Whether control holds the rotation of a network so loosely that straight steps cannot follow
    it.

    `information`: of the similarity parameters, by all observations that a similarity changes. A
    step by one σ of a rotation, α, lowers vᵀPv by 1; moved along tangents, points miss where they
    should be by α²/2 of their distance, and n rays with noise of ε radians raise it by
    n·(α²/(2·ε))². Steps are cut where the second is larger, at α² = 2·ε/√n; `straight_steps` of
    that length for one σ are what an adjustment takes anyway, and more are crept.
    """
    scale = np.sqrt(np.diagonal(information))
    # Without rays, with motions without any effect, or with values that are not finite.
    if not len(network.observations) or not (scale > 0).all():
        return False
    cofactor = np.linalg.pinv(information / np.outer(scale, scale)) / np.outer(scale, scale)
    variance = np.linalg.eigvalsh(cofactor[ROTATION, ROTATION]).max()
    longest_square = 2 * noise_of_rays(network) / math.sqrt(observations)
    return bool(variance > straight_steps**2 * longest_square)
