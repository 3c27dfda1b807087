"""Filling a network's arrays up to given sizes, so that networks of nearly the same size share one
compiled program, and the parts of a network on several devices have one shape.

What is filled in changes nothing: rays of weight 0 that repeat the last ray, points and images
that are held, pairs of missing rows. There is always one filled chunk of rays, two filled points
and one filled incidence to which filled rows can refer.
"""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jaxbundle.network.arrays import Data, Values
from jaxbundle.network.pairs import Pairs
from jaxbundle.network.rays import RayTable
from jaxbundle.network.structure import Group, Incidence, Structure

SPARE_POINTS = 2

LARGE = 200_000
"""Networks of more rays are compiled for their own sizes."""
STEPS = 8
"""Sizes of buckets between one power of two and the next: at most an eighth is filled in."""


@dataclasses.dataclass(frozen=True)
class Sizes:
    """How many rows every table has; `groups`: chunks of every camera model; the pairs: blocks,
    then chunks of every length."""

    chunks: int
    groups: tuple[int, ...]
    images: int
    cameras: int
    points: int
    kept: int
    kept_rays: int
    control: int
    exterior: int
    interior: int
    distances: int
    incidences: int
    image_pairs: tuple[int, ...]
    image_camera_pairs: tuple[int, ...]
    camera_pairs: tuple[int, ...]


def sizes_of(structure: Structure) -> Sizes:
    """The sizes of a structure as it is."""
    s = structure
    pairs = lambda p: () if p is None else (p.row.shape[0], *(b.shape[0] for b in p.block))
    chunks = s.table.chunk_image.shape[0]
    return Sizes(
        chunks=chunks,
        groups=tuple(chunks if g.chunks is None else g.chunks.shape[0] for g in s.groups),
        images=s.images,
        cameras=s.cameras,
        points=s.points,
        kept=s.kept.shape[0],
        kept_rays=s.kept_rays.shape[0],
        control=s.control.shape[0],
        exterior=s.exterior.shape[0],
        interior=s.interior.shape[0],
        distances=s.distance.shape[0],
        incidences=0 if s.incidence is None else s.incidence.point.shape[0],
        image_pairs=pairs(s.image_pairs),
        image_camera_pairs=pairs(s.image_camera_pairs),
        camera_pairs=pairs(s.camera_pairs),
    )


def common_sizes(all_sizes) -> Sizes:
    """The least sizes that hold each of them with the spare rows that filling needs."""
    largest = lambda name: np.max([getattr(sizes, name) for sizes in all_sizes], 0)
    found = {
        field.name: (
            tuple(largest(field.name).tolist()) if isinstance(largest(field.name), np.ndarray)
            else int(largest(field.name))
        )
        for field in dataclasses.fields(Sizes)
    }  # fmt: skip
    found["chunks"] += 1
    # Filled chunks are listed with the model of the last chunk, whichever that is.
    groups = [np.add(sizes.groups, found["chunks"] - sizes.chunks) for sizes in all_sizes]
    found["groups"] = tuple(np.max(groups, 0).tolist())
    found["points"] += SPARE_POINTS
    found["incidences"] += 1
    return Sizes(**found)


def round_sizes(structures: Sequence[Structure]) -> Sizes:
    """Round sizes that hold each of these parts of a network, the same for all networks of nearly
    its size; of a large one, that would feel it, the least.

    A table without rows stays one. The images of a band keep their number, on which it depends."""
    exact = [sizes_of(structure) for structure in structures]
    least = common_sizes(exact)
    if sum(structure.rays for structure in structures) > LARGE:
        return least
    chunks = _rounded(least.chunks)
    filled = np.max([np.add(sizes.groups, chunks - sizes.chunks) for sizes in exact], 0)
    found = {
        field.name: jax.tree.map(_rounded, getattr(least, field.name))
        for field in dataclasses.fields(Sizes)
    }
    found |= {"chunks": chunks, "groups": tuple(_rounded(int(n)) for n in filled)}
    if structures[0].band is not None:
        found["images"] = least.images
    return Sizes(**found)


def _rounded(number: int) -> int:
    """The next number of the form m·2ⁿ with STEPS ≤ m < 2·STEPS; small ones as they are."""
    step = 1 << max(number.bit_length() - STEPS.bit_length(), 0)
    return -(-number // step) * step


def pad(structure: Structure, data: Data, sizes: Sizes) -> tuple[Structure, Data]:
    """The same network with tables of these sizes (at least those of `common_sizes`)."""
    s, spare = structure, sizes.points - 1
    chunks, chunk = s.table.chunk_image.shape[0], s.table.chunk
    rays = sizes.chunks * chunk
    table = RayTable(
        *(_edge(x, rays) for x in (s.table.image, s.table.camera, s.table.point)),
        _fill(s.table.used, rays, 0),
        *(_edge(x, sizes.chunks) for x in (s.table.chunk_image, s.table.chunk_camera)),
        sizes.images,
    )
    incidence = s.incidence
    if incidence is not None:
        incidence = Incidence(
            _fill(incidence.of_ray, rays, sizes.incidences - 1),
            _fill(incidence.point, sizes.incidences, spare),
            _edge(incidence.camera, sizes.incidences),
        )
    old = s.rays - (chunk > 1), 0 if s.incidence is None else s.incidence.point.shape[0]
    new = rays - (chunk > 1), sizes.incidences
    # Of a distance of nothing there is no derivative: filled ones join the two spare points.
    distance = np.concatenate([
        np.asarray(s.distance),
        np.tile([spare - 1, spare], (sizes.distances - s.distance.shape[0], 1)),
    ]).astype(np.int32)  # fmt: skip
    padded = dataclasses.replace(
        s,
        groups=tuple(
            _group(group, chunks, sizes.chunks, n) for group, n in zip(s.groups, sizes.groups)
        ),
        table=table,
        camera_of_image=_edge(s.camera_of_image, sizes.images),
        camera_columns=_edge(s.camera_columns, sizes.cameras),
        camera_free=_fill(s.camera_free, sizes.cameras, 0),
        image_free=_fill(s.image_free, sizes.images, 0),
        point_free=_fill(s.point_free, sizes.points, 0),
        eliminated=_fill(s.eliminated, sizes.points, 0),
        kept=_fill(s.kept, sizes.kept, spare),
        kept_rays=_fill(s.kept_rays, sizes.kept_rays, rays - 1),
        kept_of_ray=_fill(s.kept_of_ray, sizes.kept_rays, 0),
        control=_fill(s.control, sizes.control, spare),
        exterior=_fill(s.exterior, sizes.exterior, 0),
        interior=_fill(s.interior, sizes.interior, 0),
        distance=distance,
        incidence=incidence,
        image_pairs=_pairs(s.image_pairs, sizes.image_pairs, (0, 0), old, new),
        image_camera_pairs=_pairs(
            s.image_camera_pairs, sizes.image_camera_pairs, (0, 1), old, new
        ),
        camera_pairs=_pairs(s.camera_pairs, sizes.camera_pairs, (1, 1), old, new),
        pins=_fill(s.pins, sizes.images, 0),
        datum_weight=_fill(s.datum_weight, sizes.points, 0),
    )
    return jax.device_put((padded, _pad_data(data, sizes, rays)))


def filled(structure: Structure, data: Data) -> tuple[Structure, Data, Sizes]:
    """The network in tables of round sizes; a large one as it is."""
    if structure.rays > LARGE:
        return structure, data, sizes_of(structure)
    sizes = round_sizes([structure])
    return *pad(structure, data, sizes), sizes


def pad_values(values: Values, sizes: Sizes) -> Values:
    """Values of these sizes; the spare points stand apart from each other."""
    number = values.point.shape[0]
    beyond = np.maximum(np.arange(sizes.points) - number + 1, 0)
    return jax.device_put(Values(
        camera=_edge(values.camera, sizes.cameras),
        position=_edge(values.position, sizes.images),
        rotation=_edge(values.rotation, sizes.images),
        point=_edge(values.point, sizes.points) + beyond[:, None],
    ))  # fmt: skip


def without_filling(arrays, like):
    """Arrays as long as those of `like`: what was filled in is taken off."""
    cut = lambda x, l: x if x.shape[0] == l.shape[0] else np.asarray(x)[: l.shape[0]]
    return jax.device_put(jax.tree.map(cut, arrays, like))


def pad_changes(rows: Float[np.ndarray, "... items w"], items: int) -> np.ndarray:
    """Changes of so many items, zero for what is filled in."""
    rows = np.asarray(rows)
    return np.pad(rows, [(0, 0)] * (rows.ndim - 2) + [(0, items - rows.shape[-2]), (0, 0)])


def _pad_data(data: Data, sizes: Sizes, rays: int) -> Data:
    return Data(
        start=pad_values(data.start, sizes),
        image_xy=_edge(data.image_xy, rays),
        image_weight=_fill(data.image_weight, rays, 0),
        control=_fill(data.control, sizes.control, 0),
        control_weight=_fill(data.control_weight, sizes.control, 0),
        exterior=_fill(data.exterior, sizes.exterior, 0),
        exterior_weight=_fill(data.exterior_weight, sizes.exterior, 0),
        interior=_fill(data.interior, sizes.interior, 0),
        interior_weight=_fill(data.interior_weight, sizes.interior, 0),
        distance=_fill(data.distance, sizes.distances, 0),
        distance_weight=_fill(data.distance_weight, sizes.distances, 0),
    )


def _fill(x, rows: int, value):
    x = np.asarray(x)
    more = np.full((rows - x.shape[0], *x.shape[1:]), value, x.dtype)
    return np.concatenate([x, more])


def _edge(x, rows: int):
    """Filled with its last row."""
    x = np.asarray(x)
    if not x.shape[0]:
        return _fill(x, rows, 0)
    return np.concatenate([x, np.repeat(x[-1:], rows - x.shape[0], 0)])


def _group(group: Group, chunks: int, new_chunks: int, size: int) -> Group:
    """The filled chunks repeat the last one, so they belong to the model of that one."""
    if group.chunks is None:
        return group
    listed = np.asarray(group.chunks)
    if chunks - 1 in listed:
        listed = np.concatenate([listed, np.arange(chunks, new_chunks)])
    return eqx.tree_at(lambda g: g.chunks, group, _edge(listed.astype(np.int32), size))


def _pairs(pairs: Pairs | None, sizes, tables, old, new) -> Pairs | None:
    if pairs is None:
        return None
    missing = lambda index, t: np.where(
        np.asarray(index) >= old[t], new[t], np.asarray(index)
    ).astype(np.int32)
    blocks, *chunks = sizes
    return Pairs(
        first=tuple(
            _fill(missing(i, tables[0]), n, new[tables[0]]) for i, n in zip(pairs.first, chunks)
        ),
        second=tuple(
            _fill(missing(i, tables[1]), n, new[tables[1]]) for i, n in zip(pairs.second, chunks)
        ),
        block=tuple(_fill(b, n, blocks) for b, n in zip(pairs.block, chunks)),
        row=_fill(pairs.row, blocks, 0),
        column=_fill(pairs.column, blocks, 0),
        empty=pairs.empty,
    )
