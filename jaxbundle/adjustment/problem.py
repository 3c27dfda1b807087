"""A network prepared for the engine: plan, arrays, datum and counts of rows."""

import dataclasses
from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbundle.arguments import one_of
from jaxbundle.choices import REDUCTIONS
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError
from jaxbundle.float64 import require_x64
from jaxbundle.leastsquares import problem as engine
from jaxbundle.leastsquares.datum.defect import CannotHold
from jaxbundle.leastsquares.datum.motions import SEVEN
from jaxbundle.leastsquares.declarations import Observations, Table
from jaxbundle.network.arrays import Data, Values
from jaxbundle.network.datum_words import open_directions_in_words
from jaxbundle.network.declare import Layout, declare, order_cameras
from jaxbundle.network.further.base import among
from jaxbundle.network.further.rolling_shutter import RollingShutter
from jaxbundle.network.retraction import TurnAboutSeen
from jaxbundle.network.sightings import split_check_points
from jaxbundle.network.tables import Network, require_network
from jaxbundle.types import present

HELD = 1e-6
"""Below this part of a motion a datum direction counts as none."""


@dataclasses.dataclass(frozen=True)
class Counts:
    """Rows and columns of the adjustment; redundancy = rows + datum conditions − unknowns."""

    observations: int
    control: int
    exterior: int
    interior: int
    distances: int
    other: int
    datum: int
    unknowns: int

    @property
    def pseudo_observations(self) -> int:
        return self.control + self.exterior + self.interior + self.distances + self.other

    @property
    def redundancy(self) -> int:
        return self.observations + self.pseudo_observations + self.datum - self.unknowns


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class Problem:
    """The input of `jaxbundle.solve`: a network as the engine sees it.

    `network` is the network as adjusted (cameras in the order of the arrays); `data` its numbers,
    `system` the engine's problem, `layout` the mapping between their arrays; `origin`
    [3] was subtracted from all object coordinates.
    """

    network: Network
    system: engine.Problem
    layout: Layout
    data: Data
    origin: Float[np.ndarray, "3"]
    counts: Counts

    @property
    def image(self) -> Int[np.ndarray, " rays"]:
        """The image of every image point, in the order of `data` and of the network."""
        return self.network.observations.image

    @property
    def point(self) -> Int[np.ndarray, " rays"]:
        """The object point of every image point."""
        return self.network.observations.point

    @property
    def camera(self) -> Int[np.ndarray, " rays"]:
        """The camera of every image point."""
        return self.network.images.camera[self.image]

    @property
    def at_any_distance(self) -> Bool[np.ndarray, " points"]:
        """Which points are parametrised as directions and inverse distances."""
        lengths = self.layout.lengths
        return np.zeros(len(self.network.points), bool) if lengths is None else lengths > 0

    @property
    def excluded(self) -> Bool[np.ndarray, " points"]:
        """Which points data snooping left with too few rays, or with rays that do not determine
        them."""
        rays = np.bincount(
            self.point[(np.asarray(self.data.image_weight) > 0).any(1)],
            minlength=len(self.network.points),
        )
        held = ~self.system.table("point").free.any(1)
        return ~self.network.points.has_role("fixed") & held & (rays == 0)

    def interior(self, c: int) -> tuple[tuple[str, ...], Int[np.ndarray, " k"]]:
        """The parameters free in any camera of the model, and which of them are free in this
        camera."""
        table = next(t for t in self.layout.cameras if c in t.cameras)
        given = self.system.table(table.name)
        row = int(np.flatnonzero(table.cameras == c)[0])
        return given.parameters, np.flatnonzero(given.free[row])

    @property
    def reduction(self) -> str:
        """Solver of the reduced system."""
        return present(self.system.plan.reduction)

    def with_system(self, system: engine.Problem) -> "Problem":
        """The same problem with a changed system: weights, held unknowns and their values."""
        data = self.layout.with_weights(self.data, system.data.weight)
        if self.layout.lengths is not None:
            data = dataclasses.replace(data, start=self.layout.values(system.data.start))
        return self._with(system, data)

    def with_factor(self) -> "Problem":
        """The same problem with a reduced system that can be factorised for the statistics;
        unchanged if no factor fits into memory."""
        return self.with_system(engine.with_factor(self.system))

    def with_data(self, data: Data) -> "Problem":
        """The same problem with other data (except start values that define the datum)."""
        return self._with(engine.with_data(self.system, self.layout.data(data)), data)

    def hold(self, table: str, rows, columns: slice | Sequence[int] = slice(None)) -> "Problem":
        """The same problem with some unknowns held at their start values."""
        return self._with(engine.hold(self.system, table, rows, columns), self.data)

    def with_free(self, table: str, free) -> "Problem":
        """The same problem with only these unknowns of a table free, the others held at their start
        values."""
        return self._with(engine.with_free(self.system, table, free), self.data)

    def _with(self, system, data: Data) -> "Problem":
        counts = count_rows(self.layout, system)
        return dataclasses.replace(self, system=system, data=data, counts=counts)


def make_problem(
    network: Network,
    *,
    reduction: str | None = None,
    also: Sequence[Table | Observations] = (),
    lengths: Float[np.ndarray, " points"] | None = None,
) -> Problem:
    """Plan, arrays and datum of a checked network (see `jaxbundle.network.check.check_network`).

    Check points and their rays are excluded.

    `reduction`: solver of the reduced system, "dense", "banded" or "iterative"; by default chosen
    by size and fill. `also`: observations of further kinds, and tables of their unknowns (see
    `jaxbundle.adjust`). `lengths`: the unit of distance of points at any distance, 0 for the others
    (`leastsquares.any_distance`); they are not datum points.

    **Raises:** `InputError` if the requested datum is impossible; `RuntimeError` without 64-bit
    floats.
    """
    require_x64()
    one_of("reduction", reduction, REDUCTIONS, none=True)
    require_network(network)
    network = order_cameras(split_check_points(network)[0])
    chosen, origin = _datum_points(network), None
    if lengths is not None:
        chosen, origin = chosen & (lengths == 0), np.round(network.images.position.mean(0))
    declared = declare(network, origin, also, lengths)
    try:
        system = engine.make_problem(
            declared.tables,
            declared.observations,
            "point",
            motions=declared.motions,
            datum=lambda gauge: _datum(network, gauge, declared.origin, chosen),
            reduction=reduction,
            retraction=TurnAboutSeen,
        )
    except CannotHold as error:
        raise InputError(
            f"the {int(chosen.sum())} datum points cannot fix the datum, of which "
            f"{error.defect} of 7 parameters are open: give at least three free points that "
            "are not collinear (datum_points), or omit the setting"
        ) from None
    data = jax.device_put(declared.data)
    counts = count_rows(declared.layout, system)
    return Problem(network, system, declared.layout, data, declared.origin, counts)


def _datum_points(network: Network):
    """Which points carry the datum if it is open."""
    points = network.points
    if network.datum_points:
        return np.isin(np.array(points.id, dtype=object), network.datum_points)
    chosen = points.has_role("tie")
    return chosen if chosen.any() else points.has_role("control")


def _datum(network: Network, gauge, origin, chosen):
    """The datum constraints; refused if the setting requires the observations to fix the datum."""
    if network.datum == "control":
        points = network.points
        about = (points.position - origin)[points.has_role("control", "fixed")]
        words = open_directions_in_words(gauge, about.mean(0) if len(about) else np.zeros(3))
        raise InputError(
            f"the datum is not fixed: the observations leave open {words}"
            f" ({gauge.shape[1]} of 7). Give control points or distances, or choose datum = "
            '"inner" or "minimal".'
        )
    sized = [one for one in among(network) if one.has_size]
    if sized and np.abs(gauge[SEVEN.index("scale")]).max() > HELD:
        raise InputError(
            f"{sized[0].source.name}: a σ of {sized[0].TABLE} is a length, but nothing gives the "
            'network a scale: add a distance or control points, or write "exact" (no σ)'
        )
    return {"point": np.repeat(chosen[:, None].astype(float), 3, 1)}, network.datum == "minimal"


def count_rows(layout: Layout, system: engine.Problem) -> Counts:
    """Rows with weight, datum conditions, free unknowns."""
    fields = "image", "control", "exterior", "interior", "distance"
    number: dict[str, int] = dict.fromkeys(fields, 0)
    for s in layout.sets:
        number[s.field] += int((np.asarray(system.data.weight[s.name]) > 0).sum())
    return Counts(
        observations=number["image"],
        control=number["control"],
        exterior=number["exterior"],
        interior=number["interior"],
        distances=number["distance"],
        other=system.counts.observations - sum(number.values()),
        datum=system.counts.datum,
        unknowns=system.counts.unknowns,
    )


def shifted_problem(network: Network, like: Problem, values: Values) -> Problem:
    """A problem of other points of the network with the orientations and cameras of `values`,
    without priors and datum: for excluded points."""
    moving = tuple(f for f in network.further if isinstance(f, RollingShutter))
    declared = declare(network.replace(further=moving), like.origin)
    layout = declared.layout
    start = dataclasses.replace(values, point=declared.data.start.point)
    start = layout.tables(jax.tree.map(np.asarray, start))
    tables = tuple(dataclasses.replace(t, value=start[t.name]) for t in declared.tables)
    seen = len([s for s in layout.sets if s.field == "image"])
    system = engine.make_problem(tables, declared.observations[:seen], "point")
    layout = dataclasses.replace(layout, sets=layout.sets[:seen], others=())
    counts = count_rows(layout, system)
    return Problem(network, system, layout, declared.data, like.origin, counts)
