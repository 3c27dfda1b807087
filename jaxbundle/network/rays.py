"""The table of rays: in the order of the images, in chunks of rays of one image.

A block has few images and many rays, so what an image contributes to its rays is looked up once
a chunk, and sums over the rays of an image are sums over its chunks: straight loops and small
matrix products instead of one lookup or one scattered sum a ray. In return, the last chunk of an
image may have empty rows: they repeat the ray before them with weight 0. Small networks have
chunks of a single ray and no empty rows.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Shaped

CHUNK_LENGTHS = (256, 64, 16)
MOST_EMPTY = 0.1
"""Chunks may make the table longer by this fraction."""
SMALL = 2000
"""Tables with fewer rays have chunks of one."""


class RayTable(eqx.Module):
    """Which image, camera and point every row belongs to; `used`: 0 for an empty row, else 1;
    `chunk_image`, `chunk_camera`: those of a chunk."""

    image: Int[Array, " rays"]
    camera: Int[Array, " rays"]
    point: Int[Array, " rays"]
    used: Float[Array, " rays"]
    chunk_image: Int[Array, " chunks"]
    chunk_camera: Int[Array, " chunks"]
    images: int = eqx.field(static=True)

    @property
    def rays(self) -> int:
        return self.image.shape[0]

    @property
    def chunk(self) -> int:
        """Rays of a chunk."""
        return self.rays // max(self.chunk_image.shape[0], 1)

    def in_chunks(self, rows: Shaped[Array, "rays ..."]) -> Shaped[Array, "chunks chunk ..."]:
        """A column of the table, chunk by chunk."""
        return rows.reshape(self.chunk_image.shape[0], -1, *rows.shape[1:])

    def of_image(self, values: Shaped[Array, "images ..."]) -> Shaped[Array, "rays ..."]:
        """What belongs to the image of every ray."""
        chunks = values[self.chunk_image]
        spread = (chunks.shape[0], self.chunk, *values.shape[1:])
        return jnp.broadcast_to(chunks[:, None], spread).reshape(-1, *values.shape[1:])

    def sum_by_image(self, rows: Shaped[Array, "rays ..."]) -> Shaped[Array, "images ..."]:
        """Sum of the rows of every image."""
        ones = jnp.ones((self.chunk_image.shape[0], self.chunk))
        return self._by_image(jnp.einsum("ck,ck...->c...", ones, self.in_chunks(rows)))

    def times_image(
        self, blocks: Shaped[Array, "rays d m"], vectors: Shaped[Array, "images m"]
    ) -> Shaped[Array, "rays d"]:
        """Every block times the vector of its image."""
        chunks = self.chunk_image.shape[0]
        rows = blocks.reshape(chunks, self.chunk * blocks.shape[1], blocks.shape[2])
        return jnp.einsum("cki,ci->ck", rows, vectors[self.chunk_image]).reshape(blocks.shape[:2])

    def times_matrix(
        self, blocks: Shaped[Array, "rays d m"], matrices: Shaped[Array, "images m n"]
    ) -> Shaped[Array, "rays d n"]:
        """Every block times the matrix of its image."""
        chunks, depth = self.chunk_image.shape[0], blocks.shape[1]
        rows = blocks.reshape(chunks, self.chunk * depth, blocks.shape[2])
        products = jnp.einsum("cki,cij->ckj", rows, matrices[self.chunk_image])
        return products.reshape(-1, depth, matrices.shape[2])

    def products_by_image(
        self, a: Shaped[Array, "rays d m"], b: Shaped[Array, "rays d n"]
    ) -> Shaped[Array, "images m n"]:
        """Σ aᵀb over the rays of every image."""
        chunks = self.chunk_image.shape[0]
        stack = lambda x: x.reshape(chunks, self.chunk * x.shape[1], x.shape[2])
        return self._by_image(jnp.einsum("cki,ckj->cij", stack(a), stack(b)))

    def _by_image(self, chunks):
        return jax.ops.segment_sum(
            chunks, self.chunk_image, self.images, indices_are_sorted=True
        )


def lay_out(
    image: Int[np.ndarray, " observations"],
    point: Int[np.ndarray, " observations"],
    chunk: int | None = None,
):
    """The rows of the table: `source` [rays], the observation in every row (an empty row: the one
    before it), `used` [rays], False in empty rows, and the chunk length (None: chosen).

    In chunks of more than one ray, the last row is empty."""
    order = np.lexsort((point, image))
    if not len(order):
        return order, np.zeros(0, bool), chunk or 1
    _, first, number = np.unique(image[order], return_index=True, return_counts=True)
    fits = (
        length
        for length in CHUNK_LENGTHS
        if len(order) >= SMALL
        and (-(-number // length) * length).sum() <= (1 + MOST_EMPTY) * len(order)
    )
    length = chunk or next(fits, 1)
    room = -(-number // length) * length
    if length > 1 and room[-1] == number[-1]:
        room[-1] += length
    within = np.arange(room.sum()) - np.repeat(np.cumsum(room) - room, room)
    last = np.repeat(number, room) - 1
    source = order[np.repeat(first, room) + np.minimum(within, last)]
    return source, within <= last, length


def make_ray_table(image, camera, point, used, chunk: int, images: int) -> RayTable:
    """The table of rays already laid out."""
    as_int = lambda x: np.asarray(x, np.int32)
    return RayTable(
        as_int(image), as_int(camera), as_int(point), used.astype(float),
        as_int(image[::chunk]), as_int(camera[::chunk]), images,
    )  # fmt: skip
