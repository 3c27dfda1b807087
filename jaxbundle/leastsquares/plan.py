"""The plan of a problem: which rows every observation touches, what is eliminated, who pairs.

Made once on the host (`planner.make_plan`), from the declarations alone; nothing in it depends on
a value.

The normal equations of a problem are an arrow. The rows of one table (object points, say) are
touched together with few other rows each, so they are *eliminated* row by row; everything else is
*kept* and forms the reduced system.

- A **group** is a block row of the equations: the rows of a kept table, or of several kept tables
  whose rows always occur together (a pose and the camera that took only this image): one block
  then serves for both.
- A **part** is the observations of one kind in the order in which they are computed: by the kept
  rows they touch, in chunks that touch the same ones, so that what belongs to these is looked up
  once a chunk and sums over them are small matrix products.
- An **incidence** is a couple of an eliminated row and a row of a group that are touched together,
  with one block W, however many observations there are.
- Two incidences of the same eliminated row are a **pair**: the product of their blocks is added to
  the block of the reduced matrix where the two groups' rows meet.
"""

import equinox as eqx
from jaxtyping import Array, Float, Int

from jaxbundle.leastsquares.reduction import Band

Key = tuple[str, str]


class Member(eqx.Module):
    """A table in a group: its columns start there; `rows`: its row for each of the group (None:
    the same number)."""

    table: str = eqx.field(static=True)
    start: int = eqx.field(static=True)
    width: int = eqx.field(static=True)
    rows: Int[Array, " n"] | None


class Group(eqx.Module):
    """A block row of the normal equations; `free` is 0 where a direction is held."""

    members: tuple[Member, ...]
    free: Float[Array, "n w"]
    all_free: bool = eqx.field(static=True)

    @property
    def rows(self) -> int:
        return self.free.shape[0]

    @property
    def width(self) -> int:
        return self.free.shape[1]


class Touch(eqx.Module):
    """How a part touches a kept group: by which slots of the kind (slot, first column), in which
    columns, and which row in every chunk. `incidence`: where the W of every observation goes;
    None: the observations are the incidences."""

    group: str = eqx.field(static=True)
    slots: tuple[tuple[int, int], ...] = eqx.field(static=True)
    start: int = eqx.field(static=True)
    stop: int = eqx.field(static=True)
    row: Int[Array, " chunks"]
    incidence: Int[Array, "chunks length"] | None


class Couple(eqx.Module):
    """Two touches of a part and the block of the reduced matrix where their rows meet: in every
    chunk the block's number, and whether the first row stands in its row (0) or its column (1).
    `same`: 1 where both are the same row, None if nowhere."""

    first: int = eqx.field(static=True)
    second: int = eqx.field(static=True)
    block: Int[Array, " chunks"] | None
    turned: Float[Array, " chunks"] | None
    same: Float[Array, " chunks"] | None


class Part(eqx.Module):
    """Observations of a kind in the order of computing. `lookup`: the rows of the tables that the
    slots see, one a chunk or (`by_row`) one an observation; `eliminated`: the eliminated row;
    `source`: the observation; `place`: for every observation its place in this part."""

    observations: int = eqx.field(static=True)
    slot: int | None = eqx.field(static=True)
    by_row: tuple[bool, ...] = eqx.field(static=True)
    large: bool = eqx.field(static=True)
    lookup: tuple[Int[Array, "chunks *length"], ...]
    eliminated: Int[Array, "chunks length"] | None
    source: Int[Array, "chunks length"]
    place: Int[Array, " observations"]
    touches: tuple[Touch, ...]
    couples: tuple[Couple, ...]


class Incidences(eqx.Module):
    """Eliminated rows met by a group, in chunks of one row of the group."""

    eliminated: Int[Array, "chunks length"]
    row: Int[Array, " chunks"]


class Pairs(eqx.Module):
    """Pairs of incidences of two groups, in chunks of fixed lengths, each chunk of one block."""

    first: tuple[Int[Array, "chunks length"], ...]
    second: tuple[Int[Array, "chunks length"], ...]
    block: tuple[Int[Array, " chunks"], ...]


class Blocks(eqx.Module):
    """Where two kept groups meet in the reduced matrix: row and column of every block that is not
    zero (of one group with itself: below the diagonal), and the pairs that add up to them."""

    row: Int[Array, " blocks"]
    column: Int[Array, " blocks"]
    pairs: Pairs | None


class Datum(eqx.Module):
    """How a problem that may float is pinned down (`datum.py`): the motions that are open, as
    combinations of all (`gauge`); the unknowns that hold the datum (`weight`, by table); elements
    of the reduced matrix that make it regular (`pins`); by table, what is held of what the motions
    would move (`held`, 1 or 0; no table of which nothing is)."""

    gauge: Float[Array, "motions defect"]
    weight: dict[str, Float[Array, "rows width"]]
    pins: dict[str, Float[Array, "rows w"]]
    held: dict[str, Float[Array, "rows width"]]


class Plan(eqx.Module):
    """See the module. `kept` is in the order of the groups; `blocks` has their pairs (later,
    earlier or same). `axis`: the name of the device axis over which eliminated rows with their
    observations are distributed; None: one device. `reduction`: how the reduced system is solved
    (`reduction.py`); `band`: where that is its way."""

    groups: dict[str, Group]
    eliminated: str | None = eqx.field(static=True)
    parts: tuple[Part, ...]
    incidences: dict[str, Incidences]
    blocks: dict[Key, Blocks]
    reduction: str | None = eqx.field(static=True, default="dense")
    band: Band | None = None
    datum: Datum | None = None
    axis: str | None = eqx.field(static=True, default=None)

    @property
    def kept(self) -> tuple[str, ...]:
        return tuple(name for name in self.groups if name != self.eliminated)
