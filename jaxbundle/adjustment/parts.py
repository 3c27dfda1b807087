"""The reduced matrix S of images, cameras and kept points in the blocks it consists of."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbundle.network.structure import Structure


class Parts(eqx.Module):
    """S, or another symmetric matrix where S has blocks: those of pairs of images
    (`Structure.image_pairs`), of each image, and the rows of cameras and kept points against
    images (`border`) and each other (`corner`)."""

    pairs: Float[Array, "blocks w w"]
    own: Float[Array, "images w w"]
    border: Float[Array, "q images_w"]
    corner: Float[Array, "q q"]


def parts_of(structure: Structure, matrix: Float[Array, "n n"]) -> Parts:
    """The parts of a dense matrix."""
    s, n = structure, structure.images * structure.image_width
    blocks = matrix[:n, :n].reshape(s.images, s.image_width, s.images, s.image_width)
    at, pairs = jnp.arange(s.images), s.image_pairs
    return Parts(
        pairs=blocks[pairs.row, :, pairs.column, :],
        own=blocks[at, :, at, :],
        border=matrix[n:, :n],
        corner=matrix[n:, n:],
    )


def to_points(
    structure: Structure, ray: Float[Array, "rays 3 w"], image: Float[Array, "images w"]
) -> Float[Array, "points 3"]:
    """Σ Z·x over the rays of every point; x belongs to their images."""
    s = structure
    return jax.ops.segment_sum(s.table.times_image(ray, image), s.point, s.points)


def to_images(
    structure: Structure, ray: Float[Array, "rays 3 w"], point: Float[Array, "points 3"]
) -> Float[Array, "images w"]:
    """Σ Zᵀ·h over the rays of every image; h belongs to their points (those of this device)."""
    s = structure
    return s.table.products_by_image(ray, point[s.point][:, :, None])[:, :, 0]
