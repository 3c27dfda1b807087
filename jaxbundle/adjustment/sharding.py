"""One adjustment on many devices: points with their rays distributed, images and cameras on all.

Every device eliminates its own points; the sums over images, the reduced matrix and its right-hand
side are added up over the devices (`Structure.total`), and every device solves the reduced system
and moves its points. The same program runs on the cores of a processor (`jax_num_cpu_devices`), on
several GPUs, and in several processes (`jaxbundle.join_processes`).
"""

import dataclasses

import equinox as eqx
import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float

from jaxbundle.adjustment.problem import Problem
from jaxbundle.adjustment.solver import BundleSolver, Minimum, minimise
from jaxbundle.errors import NotSolvedError
from jaxbundle.network.arrays import Data, Values
from jaxbundle.network.padding import Sizes, pad, pad_values, round_sizes, without_filling
from jaxbundle.network.pairs import CHUNK_LENGTHS
from jaxbundle.network.structure import Structure, make_structure
from jaxbundle.network.tables import Distances

AXIS = "devices"
RAYS_PER_PAIR = 3.0
"""What a ray costs, in units of a pair of rays."""


@dataclasses.dataclass(frozen=True)
class Shards:
    """A problem in parts: arrays have the device as first axis.

    `points[d]`: the points of device d, as rows of the whole problem.
    """

    points: tuple[np.ndarray, ...]
    structure: Structure
    data: Data
    sizes: Sizes
    mesh: Mesh


def distribute(problem: Problem, devices=None) -> Shards:
    """Cut a problem into as many parts as there are devices (all of JAX's if not given)."""
    devices = jax.devices() if devices is None else devices
    points = _cut(problem, len(devices))
    parts = [_part(problem, chosen, first=d == 0) for d, chosen in enumerate(points)]
    sizes = round_sizes([structure for structure, _ in parts])
    parts = [pad(structure, data, sizes) for structure, data in parts]
    mesh = Mesh(np.array(devices), (AXIS,))
    arrays, static = zip(*(eqx.partition(part, eqx.is_array) for part in parts))
    together = jax.tree.map(lambda *a: _placed(mesh, np.stack(a), PartitionSpec(AXIS)), *arrays)
    structure, data = eqx.combine(together, static[0])
    return Shards(tuple(points), dataclasses.replace(structure, axis=AXIS), data, sizes, mesh)


def find_minimum_of_shards(solver: BundleSolver, shards: Shards, start: Values) -> Minimum:
    """Run the solver on all parts from the start values of the whole network.

    The structure of the solver is replaced. The datum is not imposed: `move_to_datum` does it.

    **Raises:** `NotSolvedError` where one of several processes is lost.
    """
    mesh = shards.mesh
    parts = [pad_values(_values_of(start, chosen), shards.sizes) for chosen in shards.points]
    start_parts = Values(
        *(_placed(mesh, np.asarray(x), PartitionSpec())
          for x in (parts[0].camera, parts[0].position, parts[0].rotation)),
        point=_placed(mesh, np.stack([p.point for p in parts]), PartitionSpec(AXIS)),
    )  # fmt: skip
    solver = dataclasses.replace(solver, structure=shards.structure)
    # What comes back is the same on all devices: every process keeps its own copy.
    try:
        minimum = jax.tree.map(np.asarray, _run(solver, shards.data, start_parts, mesh))
    except jax.errors.JaxRuntimeError as error:
        if jax.process_count() == 1:
            raise
        why = " ".join(str(error).split())[:200]
        processes = jax.process_count()
        raise NotSolvedError(
            f"not solved: one of {processes} processes ended, or cannot be reached ({why})"
        ) from None
    point = np.array(start.point)
    for part, chosen in zip(minimum.values.point, shards.points):
        point[chosen] = part[: len(chosen)]
    values = eqx.tree_at(lambda v: v.point, minimum.values, point)
    return jax.device_put(eqx.tree_at(lambda m: m.values, minimum, without_filling(values, start)))


@eqx.filter_jit
def _run(solver: BundleSolver, data: Data, start: Values, mesh: Mesh) -> Minimum:
    given, static = eqx.partition((solver.structure, data), eqx.is_array)
    shared = (start.camera, start.position, start.rotation)

    def on_device(given, redundancy, shared, point):
        structure, data = eqx.combine(jax.tree.map(lambda x: x[0], given), static)
        here = dataclasses.replace(solver, structure=structure, redundancy=redundancy)
        minimum = minimise(here, data, Values(*shared, point=point[0]))
        # Points are gathered on all devices: any process reads them.
        points = jax.lax.all_gather(minimum.values.point, AXIS)
        return eqx.tree_at(lambda m: m.values.point, minimum, points)

    of_each, of_all = PartitionSpec(AXIS), PartitionSpec()
    run = jax.shard_map(
        on_device, mesh=mesh, in_specs=(of_each, of_all, of_all, of_each), out_specs=of_all,
        check_vma=False,
    )  # fmt: skip
    return run(given, solver.redundancy, shared, start.point)


def _placed(mesh: Mesh, whole: np.ndarray, spec: PartitionSpec) -> Array:
    """An array on the devices of a mesh, those of other processes included."""
    place = NamedSharding(mesh, spec)
    return jax.make_array_from_callback(whole.shape, place, lambda index: whole[index])


def _cut(problem: Problem, parts: int) -> list[np.ndarray]:
    """Points in parts of equal work, in their order; kept points belong to the first."""
    number = len(problem.network.points)
    rays = np.bincount(problem.network.observations.point, minlength=number)
    work = rays * (rays - 1) / 2 + RAYS_PER_PAIR * rays
    kept = np.zeros(number, bool)
    kept[np.asarray(problem.structure.kept)] = True
    done = np.cumsum(np.where(kept, 0.0, work))
    part = np.minimum((done - 1e-9) / max(done[-1], 1.0) * parts, parts - 1).astype(int)
    part = np.maximum(part, 0)
    part[kept] = 0
    return [np.flatnonzero(part == d) for d in range(parts)]


def _values_of(values: Values, chosen) -> Values:
    """The values of the chosen points, and all images and cameras."""
    return eqx.tree_at(lambda v: v.point, values, np.asarray(values.point)[chosen])


def _part(problem: Problem, chosen, first: bool) -> tuple[Structure, Data]:
    """Structure and data of some of the points; the priors of images and cameras, and distances,
    count in the first part."""
    # In numpy: JAX would compile a little program for every lookup.
    s, data = jax.tree.map(np.asarray, (problem.structure, problem.data))
    network = problem.network
    local = np.full(len(network.points), -1)
    local[chosen] = np.arange(len(chosen))
    rows = np.flatnonzero(local[network.observations.point] >= 0)
    observations = network.observations.take(rows)
    distances = network.distances
    if first:
        distances = dataclasses.replace(distances, points=local[distances.points])
    else:
        distances = Distances.none()
    structure, _, _, rays = make_structure(
        network.replace(
            points=network.points.take(chosen),
            observations=dataclasses.replace(observations, point=local[observations.point]),
            distances=distances,
        ),
        chunk=s.table.chunk, pair_lengths=CHUNK_LENGTHS,
        pair_blocks=(s.image_pairs.row, s.image_pairs.column), ways=(s.reduction,),
    )  # fmt: skip
    structure = dataclasses.replace(
        structure, all_free=s.all_free, all_eliminated=s.all_eliminated,
        camera_free=s.camera_free, image_free=s.image_free, point_free=s.point_free[chosen],
        eliminated=s.eliminated[chosen], datum_weight=s.datum_weight[chosen], gauge=s.gauge,
        band=s.band, pins=s.pins,
    )  # fmt: skip
    placed = lambda column: _at_rows(structure.rays, rays, column[problem.rays[rows]])
    control = np.isin(s.control, chosen)
    here = 1.0 if first else 0.0
    return structure, Data(
        start=_values_of(data.start, chosen),
        image_xy=placed(data.image_xy),
        image_weight=placed(data.image_weight),
        control=data.control[control],
        control_weight=data.control_weight[control],
        exterior=data.exterior,
        exterior_weight=here * data.exterior_weight,
        interior=data.interior,
        interior_weight=here * data.interior_weight,
        distance=data.distance if first else data.distance[:0],
        distance_weight=data.distance_weight if first else data.distance_weight[:0],
    )


def _at_rows(rows: int, index, values) -> Float[np.ndarray, "rows ..."]:
    whole = np.zeros((rows, *values.shape[1:]))
    whole[index] = values
    return whole
