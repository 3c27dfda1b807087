"""The plan of a problem: the rows touched by every observation, the eliminated rows, the pairs.

Made once on the host (`planner.make_plan`) from the declarations only; it does not depend on
values.

The normal equations of a problem are an arrow. The rows of one table (object points, say) are
touched together with few other rows each, so they are *eliminated* row by row; the rest is *kept*
and forms the reduced system.

- A **group** is a block row of the equations: the rows of a kept table, or of several kept tables
  whose rows always occur together (a pose and the camera that took only this image): one block
  then serves for both.
- A **part** is the observations of one kind in the order of computation: sorted by the kept
  rows they touch, in chunks that touch the same ones, so that the data of these rows are looked up
  once per chunk and sums over them are small matrix products.
- An **incidence** is a combination of an eliminated row and a row of a group that are touched
  together, with one block W, regardless of the number of observations.
- Two incidences of the same eliminated row are a **pair**: the product of their blocks is added to
  the block of the reduced matrix of the two groups' rows.
- Two kept rows that observations of a part touch together are a **coupling**: their block is added
  to the reduced matrix directly.
"""

import equinox as eqx
from jaxtyping import Array, Float, Int

from jaxbundle.leastsquares.indexing.reduction import Band

# A small change of all groups, the eliminated rows among them.
Tangent = dict[str, Float[Array, "rows width"]]
Key = tuple[str, str]
# Slots of a kind, and the first column of each in its group.
Slots = tuple[tuple[int, int], ...]


class Member(eqx.Module):
    """A table in a group: its columns start there; `rows`: its row for each of the group (None:
    the same number)."""

    table: str = eqx.field(static=True)
    start: int = eqx.field(static=True)
    width: int = eqx.field(static=True)
    rows: Int[Array, " n"] | None


class UnknownGroup(eqx.Module):
    """A block row of the normal equations; `free` is 0 for held directions; `all_free`: there are
    none, so that the program multiplies by no mask."""

    members: tuple[Member, ...]
    free: Float[Array, "n w"]
    all_free: bool = eqx.field(static=True)

    @property
    def rows(self) -> int:
        return self.free.shape[0]

    @property
    def width(self) -> int:
        return self.free.shape[1]


class TouchedRows(eqx.Module):
    """How a part touches a kept group: the slots of the kind (slot, first column), the columns, and
    the row of every chunk. `incidence`: the index of W of every observation; None: the observations
    are the incidences."""

    group: str = eqx.field(static=True)
    slots: Slots = eqx.field(static=True)
    start: int = eqx.field(static=True)
    stop: int = eqx.field(static=True)
    row: Int[Array, " chunks"]
    incidence: Int[Array, "chunks length"] | None


class Coupling(eqx.Module):
    """Two touches of a part and the block of the reduced matrix of their rows: in every chunk the
    block's number, and whether the row of the first touch is that of the block (0) or its column
    (1): of one group only blocks of a later row with an earlier one are stored. None of two groups.
    `same`: 1 if both are the same row, None if never."""

    first: int = eqx.field(static=True)
    second: int = eqx.field(static=True)
    block: Int[Array, " chunks"] | None
    turned: Float[Array, " chunks"] | None
    same: Float[Array, " chunks"] | None


class ObservationPart(eqx.Module):
    """Observations of a set in the order of computation. `lookup`: the rows of the tables of the
    slots, one per chunk or (`by_row`) one per observation; `eliminated`: the eliminated row;
    `source`: the observation; `place`: for every observation its position in this part."""

    set_name: str = eqx.field(static=True)
    slot: int | None = eqx.field(static=True)
    by_row: tuple[bool, ...] = eqx.field(static=True)
    large: bool = eqx.field(static=True)
    lookup: tuple[Int[Array, "chunks *length"], ...]
    eliminated: Int[Array, "chunks length"] | None
    source: Int[Array, "chunks length"]
    place: Int[Array, " observations"]
    touches: tuple[TouchedRows, ...]
    couplings: tuple[Coupling, ...]


class Incidences(eqx.Module):
    """Eliminated rows met by a group, in chunks of one row of the group."""

    eliminated: Int[Array, "chunks length"]
    row: Int[Array, " chunks"]


class IncidencePairs(eqx.Module):
    """Pairs of incidences of two groups, in chunks of fixed lengths, each chunk of one block."""

    first: tuple[Int[Array, "chunks length"], ...]
    second: tuple[Int[Array, "chunks length"], ...]
    block: tuple[Int[Array, " chunks"], ...]


class Blocks(eqx.Module):
    """Where two kept groups meet in the reduced matrix: row and column of every block that is not
    zero (of one group with itself: below the diagonal), and the pairs that add up to them."""

    row: Int[Array, " blocks"]
    column: Int[Array, " blocks"]
    pairs: IncidencePairs | None


class Datum(eqx.Module):
    """The datum of a problem that may float (`datum/conditions.py`): the open motions as
    combinations of all (`gauge`); the datum unknowns (`weight`, by table); elements of the reduced
    matrix that make it regular (`pins`); by table, the held ones among the unknowns moved by the
    motions (`held`, 1 or 0; only tables with held unknowns). `turned`: the scale is open and the
    rotation is not, so that the start values are turned with the problem
    (`conditions.turn_start`)."""

    gauge: Float[Array, "motions defect"]
    weight: dict[str, Float[Array, "rows width"]]
    pins: dict[str, Float[Array, "rows w"]]
    held: dict[str, Float[Array, "rows width"]]
    turned: bool = eqx.field(static=True, default=False)


class Plan(eqx.Module):
    """See the module. `kept` is in the order of the groups; `blocks` has their pairs (later,
    earlier or same). `axis`: the name of the device axis over which eliminated rows with their
    observations are distributed; None: one device. `reduction`: solver of the reduced system
    (`reduction.py`); `band`: if it is banded."""

    groups: dict[str, UnknownGroup]
    eliminated: str | None = eqx.field(static=True)
    parts: tuple[ObservationPart, ...]
    incidences: dict[str, Incidences]
    blocks: dict[Key, Blocks]
    reduction: str | None = eqx.field(static=True, default="dense")
    band: Band | None = None
    datum: Datum | None = None
    axis: str | None = eqx.field(static=True, default=None)

    @property
    def kept(self) -> tuple[str, ...]:
        return tuple(name for name in self.groups if name != self.eliminated)
