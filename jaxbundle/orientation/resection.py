"""Resection: the exterior orientation of one image of known points, without start values.

Three points that span a wide triangle in the image give up to four poses in closed form
(`three_points`). Each is refined with all points on the collinearity equations,

    v = −[r, s]/q − [x, y],        [r, s, q] = M·(X − X0),        Σ p·|v|² = min

and the one with the least vᵀPv and the points in front of the camera is the solution.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jax.lax import stop_gradient
from jaxtyping import Bool, Float, Int

from jaxbundle.arguments import without_masks
from jaxbundle.leastsquares.iterations.small import finish, minimise
from jaxbundle.orientation.linear import are_collinear, normalisation, ones_unless
from jaxbundle.orientation.pose import CameraPose, image_of, ray_of, retract_pose, to_camera
from jaxbundle.orientation.status import Status, first_of
from jaxbundle.orientation.three_points import three_points
from jaxbundle.types import AnyArray


class Resection(eqx.Module):
    """Pose, vᵀPv, and cofactors of (δX0 in the object unit, δθ in radians in the camera frame)."""

    pose: CameraPose
    vtpv: Float[AnyArray, ""]
    cofactor: Float[AnyArray, "6 6"]
    status: Int[AnyArray, ""]


@without_masks
def resection(
    xy: Float[AnyArray, "n 2"],
    X: Float[AnyArray, "n 3"],
    weights: Float[AnyArray, " n"] | None = None,
) -> Resection:
    """The pose of an image of n ≥ 4 known points, differentiable in all arguments.

    **Arguments:** ideal image coordinates divided by the principal distance, y up; points in the
    object unit; weights p = 1/σ², equal in x and y; 0: the point is absent.

    **Returns:** the cofactors times σ0² are the covariance. `status`: `COLLINEAR_POINTS`,
    `NO_SOLUTION`, `DANGER_CYLINDER` (the normal matrix is singular: the centre is on the right
    cylinder over the circle of three points, or on one cubic curve of such a cylinder with all of
    more), `BEHIND_THE_CAMERA`. The cofactors of a centre near it show this.
    """
    p = ones_unless(weights, xy)
    triangle = wide_triangle(xy, p)
    # With noise, the pose nearest to a solution may be all there is, and a good start.
    starts, _ = three_points(
        jax.vmap(ray_of)(stop_gradient(xy[triangle])), stop_gradient(X[triangle])
    )
    data = (xy, X, jnp.sqrt(p))
    refine = lambda start: minimise(_misclosures, retract_pose, start, data, 6)
    poses, squares = jax.vmap(refine)(starts)
    behind = jax.vmap(lambda pose: jnp.sum(jnp.where(p > 0, _is_behind(pose, X), 0)))(poses)
    worst = jnp.where(jnp.isfinite(squares), behind, jnp.inf)
    # First the fewest points behind the camera, then the least vᵀPv: a pose on the other side of a
    # flat object fits the images as well.
    best = jnp.argmin(jnp.where(worst == jnp.min(worst), squares, jnp.inf))
    pose = jax.tree.map(lambda a: a[best], poses)
    fit = finish(_misclosures, retract_pose, pose, data, 6)
    status = first_of(
        (are_collinear(X, p), Status.COLLINEAR_POINTS),
        (~jnp.isfinite(worst[best]), Status.NO_SOLUTION),
        (~fit.determined, Status.DANGER_CYLINDER),
        (worst[best] > 0, Status.BEHIND_THE_CAMERA),
    )
    return Resection(fit.estimate, fit.vtpv, fit.cofactor, status)


def refine_resection(
    pose: CameraPose,
    xy: Float[AnyArray, "n 2"],
    X: Float[AnyArray, "n 3"],
    weights: Float[AnyArray, " n"] | None = None,
) -> Resection:
    """A pose improved by least squares; arguments and result as in `resection`, n ≥ 3."""
    p = ones_unless(weights, xy)
    data = (xy, X, jnp.sqrt(p))
    pose, _ = minimise(_misclosures, retract_pose, pose, data, 6)
    fit = finish(_misclosures, retract_pose, pose, data, 6)
    status = first_of(
        (are_collinear(X, p), Status.COLLINEAR_POINTS),
        (~fit.determined, Status.DANGER_CYLINDER),
        (jnp.any(_is_behind(fit.estimate, X) & (p > 0)), Status.BEHIND_THE_CAMERA),
    )
    return Resection(fit.estimate, fit.vtpv, fit.cofactor, status)


def wide_triangle(xy: Float[AnyArray, "n 2"], weights: Float[AnyArray, " n"]) -> Int[Array, "3"]:
    """Three of the points of weight > 0, far apart: outermost, farthest from it, largest area."""
    xy = stop_gradient(xy)
    argmax_of = lambda value: jnp.argmax(jnp.where(weights > 0, value, -1.0))
    distance = lambda point: jnp.sum((xy - point) ** 2, 1)
    i = argmax_of(distance(normalisation(xy, weights)[0]))
    j = argmax_of(distance(xy[i]))
    side, offsets = xy[j] - xy[i], xy - xy[i]
    k = argmax_of(jnp.abs(side[0] * offsets[:, 1] - side[1] * offsets[:, 0]))
    return jnp.stack([i, j, k])


def _misclosures(
    pose: CameraPose,
    xy: Float[AnyArray, "n 2"],
    X: Float[AnyArray, "n 3"],
    sqrt_weight: Float[AnyArray, " n"],
) -> Float[AnyArray, " 2n"]:
    computed = jax.vmap(image_of, (None, 0))(pose, X)
    return (sqrt_weight[:, None] * (computed - xy)).ravel()


def _is_behind(pose: CameraPose, X: Float[AnyArray, "n 3"]) -> Bool[AnyArray, " n"]:
    return jax.vmap(to_camera, (None, 0))(pose, X)[:, 2] >= 0
