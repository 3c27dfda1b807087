"""The blocks of the normal equations N·δ = −g of a network.

    N = ⎡ A   W ⎤   A: images, cameras, kept points;  V: points (3×3 each);
        ⎣ Wᵀ  V ⎦   W: one small block for every ray and every incidence point–camera.

They are filled either from the Jacobian (N = JᵀPJ, Gauss–Newton) or from second derivatives of
every observation (the exact Hessian); everything after that is the same.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbundle import cameras
from jaxbundle.adjustment.jacobian import BundleJacobian
from jaxbundle.adjustment.residuals import (
    Residuals,
    distance_residual,
    exterior_residual,
    gather_groups,
    image_residual,
    over_rays,
    split_change,
)
from jaxbundle.network.arrays import Data, Tangent, Values
from jaxbundle.network.structure import Structure


class Normal(eqx.Module):
    """Blocks of a symmetric normal matrix; rows and columns of held unknowns are zero.

    The blocks of images and cameras are sums over all devices, the others belong to the points of
    one. `image_point` and `camera_point` are the transposed blocks W of eliminated points, `kept_*`
    those of the points that stay in the reduced system.
    """

    image: Float[Array, "images image_block image_block"]
    image_camera: Float[Array, "images image_block camera_block"]
    camera: Float[Array, "cameras camera_block camera_block"]
    point: Float[Array, "points 3 3"]
    image_point: Float[Array, "rays 3 image_block"]
    camera_point: Float[Array, "incidences 3 camera_block"]
    kept_image: Float[Array, "kept_rays 3 image_block"]
    kept_camera: Float[Array, "kept_rays 3 camera_block"]
    kept_kept: Float[Array, "distances 3 3"]


def normal_from_jacobian(jac: BundleJacobian) -> Normal:
    """N = JᵀJ in blocks (the weights are in J)."""
    s = jac.structure
    image_camera = camera = None
    if s.camera_width:
        image_camera = s.table.products_by_image(jac.image, jac.camera)
        camera = _by_camera(s, s.table.products_by_image(jac.camera, jac.camera))
    return _assemble(
        s,
        s.table.products_by_image(jac.image, jac.image),
        image_camera,
        camera,
        _point_sum(s, _products(jac.point, jac.point)),
        _products(jac.point, jac.image),
        _products(jac.point, jac.camera),
        jnp.einsum("eai,eaj->eij", jac.exterior, jac.exterior),
        jac.control**2,
        jac.interior**2,
        jnp.einsum("dai,dbj->dabij", jac.distance, jac.distance),
    )


def hessian(structure: Structure, values: Values, data: Data) -> Normal:
    """The exact Hessian of ½vᵀPv with respect to the free unknowns, by autodiff per observation.

    It differs from JᵀPJ by Σ p·v·∂²v, the curvature of the observation equations.
    """
    s = structure
    w, k = s.image_width, s.interior_width
    parts = [_image_hessian(s, group, values, data) for group in s.groups]
    full = gather_groups(s, parts)
    free = jnp.concatenate(
        [s.image_free[s.image], s.camera_free[s.camera], s.point_free[s.point]], 1
    )
    full = full * free[:, :, None] * free[:, None, :]
    c = slice(6, 6 + k) if s.camera_width else slice(0, 0)
    p = slice(6 + k, 9 + k)
    at_image = s.table.sum_by_image
    image_camera = camera = None
    if s.camera_width:
        image_camera = at_image(full[:, :w, c])
        camera = _by_camera(s, at_image(full[:, c, c]))
    exterior = jax.vmap(_hessian_of(exterior_residual, 4), (0, 0, 0, 0, None))(
        values.position[s.exterior], values.rotation[s.exterior],
        data.exterior, data.exterior_weight, jnp.zeros(6),
    )  # fmt: skip
    mask = s.image_free[s.exterior]
    a, b = s.distance[:, 0], s.distance[:, 1]
    ends = jax.vmap(_hessian_of(_distance_of_both, 4))(
        values.point[a], values.point[b], data.distance, data.distance_weight,
        jnp.zeros((a.shape[0], 6)),
    )  # fmt: skip
    ends = ends.reshape(-1, 2, 3, 2, 3).transpose(0, 1, 3, 2, 4)
    ends_free = s.point_free[s.distance]
    interior = jnp.take_along_axis(data.interior_weight, s.camera_columns[s.interior], 1)
    return _assemble(
        s,
        at_image(full[:, :w, :w]),
        image_camera,
        camera,
        _point_sum(s, full[:, p, p]),
        full[:, p, :w],
        full[:, p, c],
        exterior * mask[:, :, None] * mask[:, None, :],
        data.control_weight**2,
        (interior * s.camera_free[s.interior]) ** 2,
        ends * ends_free[:, :, None, :, None] * ends_free[:, None, :, None, :],
    )


def _distance_of_both(a, b, given, weight, change):
    return distance_residual(a, b, given, weight, change[:3], change[3:])


def _hessian_of(residual, argument):
    """Hessian of ½|residual|² with respect to one argument."""
    return jax.hessian(lambda *a: 0.5 * jnp.sum(residual(*a) ** 2), argument)


def _image_hessian(structure, group, values, data):
    """Second derivatives of the rays of one camera model [rays, 9+k, 9+k]."""
    model = cameras.get_model(group.model)
    n, k = len(group.free), structure.interior_width

    def one(*row):
        def loss(x):
            change = split_change(x, n, k)
            vx, vy = image_residual(model, structure.domain, group.free, *row, change)
            return 0.5 * (vx**2 + vy**2)

        return jax.hessian(loss)(jnp.zeros(9 + k))

    return over_rays(structure, group, one, values, data)


def _products(a, b):
    """aᵀb of every ray. Written out: a reduction or a batched product takes three times as long."""
    outer = lambda i: a[:, i, :, None] * b[:, i, None, :]
    return outer(0) + outer(1)


def _by_camera(structure, blocks):
    """Sum of the blocks of the images of every camera."""
    return jax.ops.segment_sum(blocks, structure.camera_of_image, structure.cameras)


def _point_sum(structure, blocks):
    return jax.ops.segment_sum(blocks, structure.point, structure.points)


def _assemble(
    s, image, image_camera, camera, point, image_point, camera_point,
    exterior, control, interior, distance,
) -> Normal:  # fmt: skip
    """Add the blocks of priors and distances, and sort W into eliminated and kept points."""
    i6 = jnp.arange(6)
    full = image.at[s.exterior[:, None, None], i6[:, None], i6[None, :]].add(exterior)
    i3 = jnp.arange(3)
    point = point.at[s.control[:, None], i3, i3].add(control)
    a, b = s.distance[:, 0], s.distance[:, 1]
    point = point.at[a].add(distance[:, 0, 0]).at[b].add(distance[:, 1, 1])
    width = s.camera_width
    cross = jnp.zeros((s.images, s.image_width, 0))
    shared = jnp.zeros((s.cameras, 0, 0))
    incidences = jnp.zeros((0, 3, 0))
    ik = jnp.arange(s.interior_width)
    if width:
        cross = image_camera
        shared = camera.at[s.interior[:, None], ik, ik].add(interior)
        incidences = jax.ops.segment_sum(
            camera_point, s.incidence.of_ray, s.incidence.point.shape[0]
        )
        if not s.all_eliminated:
            incidences = incidences * s.eliminated[s.incidence.point][:, None]
    elif s.interior_width:
        full = full.at[s.interior[:, None], 6 + ik, 6 + ik].add(interior)
    full, cross, shared = s.total((full, cross, shared))
    return Normal(
        image=full,
        image_camera=cross,
        camera=shared,
        point=point,
        image_point=image_point if s.all_eliminated else image_point
        * s.eliminated[s.point][:, None],
        camera_point=incidences,
        kept_image=image_point[s.kept_rays],
        kept_camera=camera_point[s.kept_rays],
        kept_kept=distance[:, 0, 1],
    )


def diagonal(normal: Normal) -> Tangent:
    """The diagonal of N, 1 where an unknown is held."""
    pick = lambda blocks: jnp.diagonal(blocks, axis1=1, axis2=2)
    diagonal = Tangent(pick(normal.image), pick(normal.camera), pick(normal.point))
    return jax.tree.map(lambda d: jnp.where(d > 0, d, 1.0), diagonal)


def gradient(jac: BundleJacobian, residual: Residuals) -> Tangent:
    """g = Jᵀr, the gradient of ½vᵀPv."""
    return jac.transposed_mv(residual)
