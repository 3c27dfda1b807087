"""The Jacobian of the network as blocks, and as a lineax operator.

Each ray touches one image, one camera and one point, so its two rows hold at most
6 + k + 3 derivatives. They come from reverse mode over the scalars of `image_residual`, which XLA
turns into straight loops over the rays (measured per iteration on a BAL block of 83 718 rays:
vmapped forward mode 29 ms, reverse mode on scalars 12, rotations prepared once an image 5 to 7).
Small networks, whose time goes into compiling, take forward mode: a tenth of the loops.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from jaxbundle import cameras
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


class BundleJacobian(lx.AbstractLinearOperator):
    """∂(residuals / σ)/∂(free unknowns) as blocks; columns of held unknowns are zero.

    `image` and `camera` are the columns of the image blocks and of the shared cameras (see
    `jaxbundle.network.structure`), `point` those of the points. Control and interior rows are
    diagonal: they hold the weights.
    """

    structure: Structure
    image: Float[Array, "rays 2 image_block"]
    camera: Float[Array, "rays 2 camera_block"]
    point: Float[Array, "rays 2 3"]
    control: Float[Array, "control 3"]
    exterior: Float[Array, "exterior 6 6"]
    interior: Float[Array, "interior k"]
    distance: Float[Array, "distances 2 3"]

    def mv(self, vector: Tangent) -> Residuals:
        """J·x."""
        s, k = self.structure, self.structure.interior_width
        image = s.table.times_image(self.image, vector.image)
        image += jnp.einsum("nai,ni->na", self.point, vector.point[s.point])
        if s.camera_width:
            image += jnp.einsum("nai,ni->na", self.camera, vector.camera[s.camera])
        interior = vector.image[:, 6:] if s.own_camera else vector.camera
        rows = jnp.zeros((s.interior.shape[0], self._parameters))
        if k and s.interior.shape[0]:
            index = jnp.arange(s.interior.shape[0])[:, None]
            change = self.interior * interior[s.interior]
            rows = rows.at[index, s.camera_columns[s.interior]].add(change)
        ends = vector.point[s.distance]
        return Residuals(
            image=image,
            control=self.control * vector.point[s.control],
            exterior=jnp.einsum("eij,ej->ei", self.exterior, vector.image[s.exterior, :6]),
            interior=rows,
            distance=jnp.einsum("dei,dei->d", self.distance, ends),
        )

    def transposed_mv(self, residual: Residuals) -> Tangent:
        """Jᵀ·r, of all devices."""
        s = self.structure
        column = residual.image[:, :, None]
        times = lambda blocks: s.table.products_by_image(blocks, column)[:, :, 0]
        image = times(self.image)
        point = self.point[:, 0] * column[:, 0] + self.point[:, 1] * column[:, 1]
        point = jax.ops.segment_sum(point, s.point, s.points)
        camera = jnp.zeros((s.cameras, s.camera_width))
        if s.camera_width:
            camera = jax.ops.segment_sum(
                times(self.camera), s.camera_of_image, s.cameras
            )
        point = point.at[s.control].add(self.control * residual.control)
        point = point.at[s.distance].add(self.distance * residual.distance[:, None, None])
        image = image.at[s.exterior, :6].add(
            jnp.einsum("eij,ei->ej", self.exterior, residual.exterior)
        )
        if s.interior_width and s.interior.shape[0]:
            rows = jnp.take_along_axis(residual.interior, s.camera_columns[s.interior], 1)
            if s.own_camera:
                image = image.at[s.interior, 6:].add(self.interior * rows)
            else:
                camera = camera.at[s.interior].add(self.interior * rows)
        return Tangent(*s.total((image, camera)), point)

    _parameters: int = eqx.field(static=True, default=0)

    def as_matrix(self) -> Float[Array, "rows unknowns"]:
        """The dense matrix; for small networks and tests."""
        zero = zero_tangent(self.structure)
        flat, unravel = ravel_pytree(zero)
        column = lambda e: ravel_pytree(self.mv(unravel(e)))[0]
        return jax.vmap(column, out_axes=1)(jnp.eye(flat.size))

    def transpose(self) -> lx.AbstractLinearOperator:
        return lx.FunctionLinearOperator(self.transposed_mv, self.out_structure())

    def in_structure(self) -> Tangent:
        return jax.eval_shape(lambda: zero_tangent(self.structure))

    def out_structure(self) -> Residuals:
        return jax.eval_shape(self.mv, self.in_structure())


for _trait in (
    lx.is_symmetric, lx.is_diagonal, lx.is_tridiagonal, lx.has_unit_diagonal,
    lx.is_lower_triangular, lx.is_upper_triangular, lx.is_positive_semidefinite,
    lx.is_negative_semidefinite,
):  # fmt: skip
    _trait.register(BundleJacobian)(lambda operator: False)
for _same in (lx.linearise, lx.materialise, lx.conj):
    _same.register(BundleJacobian)(lambda operator: operator)


def zero_tangent(structure: Structure) -> Tangent:
    """No change of any unknown."""
    s = structure
    return Tangent(
        jnp.zeros((s.images, s.image_width)),
        jnp.zeros((s.cameras, s.camera_width)),
        jnp.zeros((s.points, 3)),
    )


def free_tangent(structure: Structure) -> Tangent:
    """1 for every free unknown, 0 for every held one."""
    s = structure
    camera = s.camera_free if s.camera_width else jnp.zeros((s.cameras, 0))
    return Tangent(s.image_block_free, camera, s.point_free)


def jacobian(structure: Structure, values: Values, data: Data) -> BundleJacobian:
    """The Jacobian of `residuals` with respect to the free unknowns, by autodiff."""
    s = structure
    parts = [_image_blocks(s, group, values, data) for group in s.groups]
    image, camera, point = gather_groups(s, parts)
    if not s.all_free:
        free = s.image_block_free
        image = image * s.table.of_image(free)[:, None, :]
        if s.camera_width:
            camera = camera * s.table.of_image(s.camera_free[s.camera_of_image])[:, None, :]
        point = point * s.point_free[s.point][:, None, :]
    return BundleJacobian(
        structure=s,
        image=image,
        camera=camera,
        point=point,
        control=data.control_weight,
        exterior=exterior_blocks(s, values, data) * s.image_free[s.exterior][:, None, :],
        interior=jnp.take_along_axis(data.interior_weight, s.camera_columns[s.interior], 1)
        * s.camera_free[s.interior],
        distance=distance_blocks(s, values, data) * s.point_free[s.distance],
        _parameters=values.camera.shape[1],
    )  # fmt: skip


def exterior_blocks(s: Structure, values: Values, data: Data) -> Float[Array, "exterior 6 6"]:
    """Derivatives of the priors of exterior orientations by the change of their images."""
    if not s.exterior.shape[0]:
        return jnp.zeros((0, 6, 6))  # Nothing to trace.
    return jax.vmap(jax.jacfwd(exterior_residual, 4), (0, 0, 0, 0, None))(
        values.position[s.exterior], values.rotation[s.exterior],
        data.exterior, data.exterior_weight, jnp.zeros(6),
    )  # fmt: skip


def distance_blocks(s: Structure, values: Values, data: Data) -> Float[Array, "distances 2 3"]:
    """Derivatives of the distances by their two ends."""
    if not s.distance.shape[0]:
        return jnp.zeros((0, 2, 3))  # Nothing to trace.
    a, b = values.point[s.distance[:, 0]], values.point[s.distance[:, 1]]
    still = jnp.zeros(3)
    ends = jax.vmap(jax.jacrev(distance_residual, (4, 5)), (0, 0, 0, 0, None, None))(
        a, b, data.distance, data.distance_weight, still, still
    )
    return jnp.stack(ends, 1)


def compiled_jacobian(structure: Structure, values: Values, data: Data) -> BundleJacobian:
    """`jacobian`, compiled once and shared by everything that looks at a solution, whether or not
    the datum is known yet."""
    return dataclasses.replace(
        _blocks(structure.without_datum(), values, data), structure=structure
    )


@eqx.filter_jit
def _blocks(structure, values, data):
    """`jacobian` without its structure, which a compiled function would return as a copy."""
    return dataclasses.replace(jacobian(structure, values, data), structure=None)


def _image_blocks(structure, group, values, data):
    """Derivatives of the rays of one camera model by image block, shared camera and point."""
    if structure.table.chunk == 1:
        return _image_blocks_of_a_small_network(structure, group, values, data)
    model, free = cameras.get_model(group.model), group.free
    padding = structure.interior_width - len(free)

    def one(*row):
        def shifted(*change):
            return image_residual(model, structure.domain, free, *row, change)

        nil = jnp.zeros_like(row[3][0])
        still = ((nil,) * 3, (nil,) * 3, (nil,) * len(free), (nil,) * 3)
        _, pull = jax.vjp(shifted, *still)
        one_ = jnp.ones_like(nil)
        return pull((one_, nil)), pull((nil, one_))

    rows = over_rays(structure, group, one, values, data)
    nil = jnp.zeros_like(rows[0][0][0])
    rows = [(centre, theta, (*interior, *(nil,) * padding), point)
            for centre, theta, interior, point in rows]  # fmt: skip
    own = structure.own_camera
    image = [(*centre, *theta, *(interior if own else ())) for centre, theta, interior, _ in rows]
    camera = [() if own else interior for _, _, interior, _ in rows]
    point = [point for *_, point in rows]
    return tuple(_as_blocks(part, nil.shape) for part in (image, camera, point))


def _image_blocks_of_a_small_network(structure, group, values, data):
    """The same by forward mode along all directions at once: slower, but one loop to compile."""
    model, free, k = cameras.get_model(group.model), group.free, structure.interior_width

    def one(*row):
        def shifted(x):
            change = split_change(x, len(free), k)
            return jnp.stack(image_residual(model, structure.domain, free, *row, change))

        return jax.jacfwd(shifted)(jnp.zeros(9 + k))

    blocks = over_rays(structure, group, one, values, data)
    w, c = structure.image_width, structure.camera_width
    return blocks[..., :w], blocks[..., 6 : 6 + c], blocks[..., 6 + k :]


def _as_blocks(rows, shape):
    """Two rows of scalars, each an array of this shape, as blocks [..., 2, columns]."""
    columns = [column for row in rows for column in row]
    if not columns:
        return jnp.zeros((*shape, 2, 0))
    return jnp.stack(columns, -1).reshape(*shape, 2, len(rows[0]))
