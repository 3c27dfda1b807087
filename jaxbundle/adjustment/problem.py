"""A network made ready for the solver: index plan, arrays, datum and the count of its rows."""

import dataclasses

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int

from jaxbundle.adjustment.datum import (
    choose_minimal_coordinates,
    choose_pins,
    hold_the_datum,
    open_directions_in_words,
    open_similarities,
)
from jaxbundle.arguments import one_of
from jaxbundle.errors import InputError
from jaxbundle.network.arrays import Data
from jaxbundle.network.reduction import FACTORS, REDUCTIONS
from jaxbundle.network.sightings import split_check_points
from jaxbundle.network.structure import Structure, make_structure, order_cameras
from jaxbundle.network.tables import Network, require_network


@dataclasses.dataclass(frozen=True)
class Counts:
    """Rows and columns of the adjustment; redundancy = rows + datum conditions − unknowns."""

    observations: int
    control: int
    exterior: int
    interior: int
    distances: int
    datum: int
    unknowns: int

    @property
    def pseudo_observations(self) -> int:
        return self.control + self.exterior + self.interior + self.distances

    @property
    def redundancy(self) -> int:
        return self.observations + self.pseudo_observations + self.datum - self.unknowns


@dataclasses.dataclass(frozen=True)
class Problem:
    """What `jaxbundle.solve` solves: structure (indices) and data (numbers) of one network.

    `network` is the network as adjusted (cameras in the order of the arrays); `origin` [3] was
    subtracted from all object coordinates; `rays` [observations]: the row of every observation of
    the network in the arrays (big blocks have some empty rows there, of weight 0).
    """

    network: Network
    structure: Structure
    data: Data
    origin: Float[np.ndarray, "3"]
    rays: Int[np.ndarray, " observations"]
    counts: Counts


def make_problem(network: Network, reduction: str | None = None) -> Problem:
    """Index plan, arrays and datum of a checked network (see `jaxbundle.network.check_network`).

    Check points take no part: they and their rays are left out.

    `reduction`: how the reduced system is solved, "dense", "banded" or "iterative"; chosen by its
    size and fill if not given.

    **Raises:** `InputError` where the datum asked for cannot be had; `RuntimeError` without
    64-bit floats.
    """
    require_x64()
    one_of("reduction", reduction, REDUCTIONS, none=True)
    require_network(network)
    network = order_cameras(split_check_points(network)[0])
    ways = REDUCTIONS if reduction is None else (reduction,)
    structure, data, origin, rays = make_structure(network, ways=ways)
    gauge = open_similarities(structure, data)
    defect = gauge.shape[1]
    if network.datum == "control" and defect:
        known = network.points.has_role("control") | network.points.has_role("fixed")
        about = (network.points.position - origin)[known]
        words = open_directions_in_words(gauge, about.mean(0) if len(about) else np.zeros(3))
        raise InputError(
            f"the datum is not fixed: the observations leave open {words}"
            f" ({defect} of 7). Give control points or distances, or choose datum = \"inner\" "
            "or \"minimal\"."
        )
    if defect:
        structure = eqx.tree_at(lambda s: s.gauge, structure, jax.device_put(gauge))
        structure = eqx.tree_at(
            lambda s: s.datum_weight, structure,
            jax.device_put(_datum_weight(network, structure, data)),
        )  # fmt: skip
        pins = jax.device_put(choose_pins(structure, data))
        structure = eqx.tree_at(lambda s: s.pins, structure, pins)
    return Problem(network, structure, data, origin, rays, count_rows(structure, data))


def with_factor(problem: Problem) -> Problem:
    """The problem with a reduced system that can be factorised, as statistics need it; the same
    where no factor fits into memory."""
    s = problem.structure
    if s.reduction in FACTORS:
        return problem
    plan, *_ = make_structure(problem.network, chunk=s.table.chunk, ways=FACTORS)
    if plan.reduction is None:
        return problem
    s = dataclasses.replace(
        s, reduction=plan.reduction, image_pairs=plan.image_pairs, band=plan.band
    )
    return dataclasses.replace(problem, structure=s)


def require_x64() -> None:
    """Adjustment needs 64-bit floats, and says how to get them."""
    if not jax.config.jax_enable_x64:
        raise RuntimeError(
            "jaxbundle computes in 64-bit floating point. Call jaxbundle.enable_x64() before the "
            "first JAX computation, or set the environment variable JAX_ENABLE_X64=1."
        )


def _datum_weight(network: Network, structure: Structure, data: Data):
    points = network.points
    free = np.asarray(structure.point_free)
    if network.datum_points:
        chosen = np.isin(np.array(points.id, dtype=object), network.datum_points)
    else:
        chosen = points.has_role("tie")
        chosen = chosen if chosen.any() else points.has_role("control")
    candidates = chosen[:, None] * free
    if not hold_the_datum(structure, data, candidates):
        raise InputError(
            f"the {int(chosen.sum())} datum points cannot hold the datum, of which "
            f"{structure.defect} of 7 parameters are open: give at least three free points that "
            "are not on one line (datum_points), or leave the choice to the program"
        )
    if network.datum == "minimal":
        return choose_minimal_coordinates(structure, data, candidates)
    return candidates


def count_rows(structure: Structure, data: Data) -> Counts:
    """Rows that carry weight, datum conditions, free unknowns."""
    number = lambda weight: int((np.asarray(weight) > 0).sum())
    free = (structure.image_free, structure.camera_free, structure.point_free)
    interior = np.take_along_axis(
        np.asarray(data.interior_weight),
        np.asarray(structure.camera_columns)[np.asarray(structure.interior)], 1,
    )  # fmt: skip
    return Counts(
        observations=number(data.image_weight),
        control=number(data.control_weight),
        exterior=number(data.exterior_weight),
        interior=number(
            interior * np.asarray(structure.camera_free)[np.asarray(structure.interior)]
        ),
        distances=number(data.distance_weight),
        datum=structure.defect,
        unknowns=sum(number(x) for x in free),
    )  # fmt: skip
