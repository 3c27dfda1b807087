"""The retraction of a network: images rotate about the points they see."""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbundle.geometry import matrix_from_quaternion
from jaxbundle.leastsquares.equations.normal import sum_over_devices
from jaxbundle.leastsquares.indexing.plan import Plan, Tangent
from jaxbundle.leastsquares.indexing.rows import Declared, Values
from jaxbundle.leastsquares.iterations.retraction import changes_of_tables, retract
from jaxbundle.leastsquares.spaces import PoseValue
from jaxbundle.network.kinds.image_points import ImagePoint
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
    """

    declared: Declared

    def __call__(self, plan: Plan, values: Values, change: Tangent) -> Values:
        retracted = retract(self.declared, plan, values, change)
        changes = changes_of_tables(plan, values, change)
        if "image" not in changes:
            return retracted
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
