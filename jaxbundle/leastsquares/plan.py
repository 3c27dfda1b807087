"""The plan of a problem: which rows every observation touches, what is eliminated, who pairs.

Made once on the host, from the declarations alone; nothing in it depends on a value.

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

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, Int

from jaxbundle.leastsquares.declarations import Observations, Table
from jaxbundle.leastsquares.indices import Column, Index, Sizes, count
from jaxbundle.leastsquares.reduction import FACTORS, MOST_PAIRS, REDUCTIONS, Band, plan_reduction

CHUNK_LENGTHS = (256, 64, 16)
MOST_EMPTY = 0.1
"""Chunks may make a part longer by this fraction."""
SMALL = 2000
"""Parts with fewer observations have chunks of one, and compile in a tenth of the time."""
PAIR_CHUNKS, FEW_PAIR_CHUNKS = (256, 32, 4), (8,)
FEW_PAIRS = 50_000
"""Lists of fewer pairs have chunks of one length, which compiles in a third of the time."""
PAIR_ROWS_AT_ONCE = 8192

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
    block: Int[Array, " chunks"]
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


def make_plan(
    tables: Sequence[Table], observations: Sequence[Observations], eliminate: str | None,
    choices: dict | None = None, ways: Sequence[str] = REDUCTIONS,
) -> tuple[Plan, Sizes, dict]:  # fmt: skip
    """The plan on the host, its arrays as `Index` and `Column` (`indices.finish`), the sizes of its
    lists, and the choices made (lengths of chunks, blocks of the reduced matrix).

    `choices`: those of a larger problem of which this is a part, to be made again; `ways`: how the
    reduced system may be solved."""
    planner = _Planner(tables, observations, eliminate, choices, ways)
    plan = planner.plan()
    sizes = {("table", t.name): t.rows + 1 for t in tables}
    sizes |= {("observations", o): x.number + 1 for o, x in enumerate(observations)}
    return plan, sizes | count(plan), planner.choices


@dataclasses.dataclass
class _Rows:
    """The observations of one part while it is planned."""

    observations: int
    source: np.ndarray
    slot: int | None
    """Slot of the eliminated row."""


class _Planner:
    def __init__(self, tables, observations, eliminate, choices, ways):
        self.given, self.choices = choices or {}, {}
        self.ways = self.choose("ways", found=tuple(ways))
        self.tables = {t.name: t for t in tables}
        self.observations = observations
        self.moving = self.choose("moving", found=[t.name for t in tables if t.free.any()])
        self.eliminate = eliminate
        self.split_rows()
        self.split_observations()
        self.form_groups()

    def choose(self, *key, found):
        """What was found, or what was chosen before."""
        self.choices[key] = self.given.get(key, found)
        return self.choices[key]

    # ------------------------------------------------------------------ what is eliminated

    def split_rows(self):
        """Rows of the eliminated table that stay in the reduced system: those that one observation
        ties to another of their table."""
        self.stays = {}
        if self.eliminate is None:
            return
        table = self.tables[self.eliminate]
        stays = np.zeros(table.rows, bool)
        for given in self.observations:
            slots = [s for s, name in enumerate(given.kind.of) if name == self.eliminate]
            for s in slots if len(slots) > 1 else ():
                stays[given.rows[s]] = True
        self.stays = self.choose("stays", found=stays & table.free.any(1))

    def split_observations(self):
        """Observations of one kind, apart by which of their slots touches an eliminated row."""
        self.parts = []
        for o, given in enumerate(self.observations):
            slots = [s for s, name in enumerate(given.kind.of) if name == self.eliminate]
            slot_of = np.full(given.number, -1)
            for s in slots:
                slot_of[~self.stays[given.rows[s]]] = s
            # Two rows of the table that are both held may meet: the last is called eliminated.
            for slot in self.choose("slots", o, found=np.unique(slot_of).tolist()):
                rows = np.flatnonzero(slot_of == slot)
                self.parts.append(_Rows(o, rows, None if slot < 0 else slot))

    # ------------------------------------------------------------------ groups

    def form_groups(self):
        """Kept tables in groups; the eliminated rows are the last group."""
        self.members = {}  # group: [(table, start, rows or None)]
        self.group_of = {}  # table: (group, start, row of the group for every row of the table)
        for name in self.moving:
            table = self.tables[name]
            if name == self.eliminate:
                continue
            host = next((g for g in self.members if self._meet_always(g, name)), None)
            host = self.choose("host", name, found=host)
            if host is None:
                self.members[name] = [(name, 0, None)]
                self.group_of[name] = name, 0, np.arange(table.rows)
            else:
                start = sum(self.tables[t].space.width for t, *_ in self.members[host])
                self.members[host].append((name, start, None))
                self.group_of[name] = host, start, np.arange(table.rows)
        self.row_in = {}  # of the eliminated table: row among the eliminated, row among the kept
        name = self.eliminate
        if name is not None:
            stays = self.stays
            place = lambda mask: np.where(mask, np.cumsum(mask) - 1, -1)
            if stays.any():
                kept = f"{name} (kept)"
                self.members[kept] = [(name, 0, np.flatnonzero(stays))]
                self.group_of[name] = kept, 0, place(stays)
            rows = np.flatnonzero(~stays) if stays.any() else None
            self.members[name] = [(name, 0, rows)]
            self.row_in = place(~stays)
        # In the order in which JAX has them, too, wherever the plan goes.
        self.kept = sorted(g for g in self.members if g != name)

    def _meet_always(self, group, name):
        """Whether the rows of a table occur in just the observations of eliminated rows in which
        those of a group do, row by row."""
        first = self.members[group][0][0]
        if self.tables[first].rows != self.tables[name].rows:
            return False
        met = False
        for part in self.parts:
            given = self.observations[part.observations]
            of, rows = given.kind.of, given.rows
            if part.slot is None:
                continue
            a = [s for s, t in enumerate(of) if t == first]
            b = [s for s, t in enumerate(of) if t == name]
            if len(a) != len(b) or len(a) > 1:
                return False
            if a:
                met = True
                if not np.array_equal(rows[a[0]][part.source], rows[b[0]][part.source]):
                    return False
        return met

    # ------------------------------------------------------------------ the plan

    def plan(self):
        parts = [self.part(k, p) for k, p in enumerate(self.parts)]
        incidences = {g: self.incidences_of(g, parts) for g in self.kept}
        incidences = {g: found for g, found in incidences.items() if found is not None}
        groups = {g: self.group(g) for g in (*self.kept, self.eliminate) if g is not None}
        blocks, reduction, band = self.reduce(parts, incidences, groups)
        incidences = {g: found["plan"] for g, found in incidences.items()}
        parts = tuple(p["part"] for p in parts)
        return Plan(groups, self.eliminate, parts, incidences, blocks, reduction, band)

    def reduce(self, parts, incidences, groups):
        """The blocks of the reduced matrix, how it is solved, its band."""
        rows = [np.zeros(0, np.int64), *(found["eliminated"] for found in incidences.values())]
        met, ways = np.bincount(np.concatenate(rows)).astype(float), self.ways
        if len(ways) > 1 and (met * (met - 1)).sum() / 2 > MOST_PAIRS:
            ways = ("iterative",)
        blocks = self.find_blocks(parts, {} if ways == ("iterative",) else incidences)
        shapes = {g: groups[g].free.rows.shape for g in self.kept}
        place = lambda at: (at.row.rows, at.column.rows) if at else np.zeros((2, 0), np.int64)
        ties = lambda g: place(blocks.get((g, g)))
        number = sum(given.number for given in self.observations)
        way, band = plan_reduction(shapes, ties, number, ways)
        self.choices["ways",] = (way,)
        return blocks if way in FACTORS else self.find_blocks(parts, {}), way, band

    def group(self, name):
        members, free = [], []
        for table, start, rows in self.members[name]:
            given = self.tables[table]
            free.append(given.free if rows is None else given.free[rows])
            index = None if rows is None else Index(rows, ("group", name), ("table", table))
            members.append(Member(table, start, given.space.width, index))
        free = np.concatenate(free, 1)
        all_free = self.choose("all free", name, found=bool(free.all()))
        return Group(tuple(members), Column(free, ("group", name)), all_free)

    def part(self, k, part):
        """The part k: laid out in chunks, with its touches (couples and incidences come later)."""
        given = self.observations[part.observations]
        of = given.kind.of
        rows = [np.asarray(r)[part.source] for r in given.rows]
        slots = self._touched_groups(part, of)
        major = np.zeros(len(part.source), np.int64)
        for _, touched in slots:
            slot = touched[0][0]
            row = self.group_of[of[slot]][2][rows[slot]]
            major = np.unique(major * (row.max(initial=0) + 1) + row, return_inverse=True)[1]
        minor = rows[part.slot] if part.slot is not None else np.arange(len(major))
        along = ("part", k)
        length = self.choose("length", along, found=chunk_length(major))
        large = self.choose("large", k, found=len(major) >= SMALL)
        order, used = lay_out(major, minor, length)
        chunk = lambda x: x[order].reshape(-1, length)
        lookup, by_row, first = [], [], np.zeros(major.max(initial=0) + 1, np.int64)
        first[major] = np.arange(len(major))  # An observation of every major.
        for s, name in enumerate(of):
            at = chunk(rows[s])
            one = length == 1 or bool((rows[s] == rows[s][first[major]]).all())
            one = self.choose("by chunk", k, s, found=one and s != part.slot)
            by_row.append(not one)
            lookup.append(Index(at[:, 0] if one else at, along, ("table", name)))
        touches = []
        for group, touched in slots:
            slot = touched[0][0]
            row = chunk(self.group_of[of[slot]][2][rows[slot]])[:, 0]
            stop = max(start + self.tables[of[s]].space.width for s, start in touched)
            start = min(start for _, start in touched)
            index = Index(row, along, ("group", group))
            touches.append(Touch(group, touched, start, stop, index, None))
        source = np.where(used, part.source[order], -1).reshape(-1, length)
        place = np.full(given.number, -1)
        place[part.source[order][used]] = np.flatnonzero(used)
        eliminated = None
        if part.slot is not None:
            at = self.row_in[chunk(rows[part.slot])]
            eliminated = Index(at, along, ("group", self.eliminate))
        number = ("observations", part.observations)
        made = Part(
            observations=part.observations, slot=part.slot, by_row=tuple(by_row),
            large=large, lookup=tuple(lookup), eliminated=eliminated,
            source=Index(source, along, number), place=Index(place, number, along, length),
            touches=tuple(touches), couples=(),
        )  # fmt: skip
        return dict(part=made, used=used, length=length, along=along)

    def _touched_groups(self, part, of):
        """The kept groups that a part touches, in order, with their slots and first columns; a
        second row of a group is a touch of its own."""
        found = []
        for s, name in enumerate(of):
            if s == part.slot or name not in self.group_of:
                continue
            group, start, _ = self.group_of[name]
            entry = next(
                (f for f in found if f[0] == group and all(of[q] != name for q, _ in f[1])), None
            )
            if entry is None:
                found.append((group, [(s, start)]))
            else:
                entry[1].append((s, start))
        found.sort(key=lambda f: self.kept.index(f[0]))
        return [(group, tuple(slots)) for group, slots in found]

    def incidences_of(self, group, parts):
        """The incidences of a group; fills in where the observations of the parts go."""
        at = [
            (k, t) for k, p in enumerate(parts) if p["part"].slot is not None
            for t, touch in enumerate(p["part"].touches) if touch.group == group
        ]  # fmt: skip
        if not at:
            return None
        number = len(self.row_in)
        eliminated, row, used = [], [], []
        for k, t in at:
            p = parts[k]
            eliminated.append(p["part"].eliminated.rows.ravel())
            row.append(np.repeat(p["part"].touches[t].row.rows, p["length"]))
            used.append(p["used"])
        eliminated, row, used = (np.concatenate(x) for x in (eliminated, row, used))
        keys = row[used].astype(np.int64) * number + eliminated[used]
        keys, of = np.unique(keys, return_inverse=True)
        apart = len(at) == 1 and len(keys) == used.sum()
        if self.choose("incidences apart", group, found=apart):
            p = parts[at[0][0]]
            along, length = p["along"], p["length"]
        else:
            r, q = keys // number, keys % number
            along = ("incidences", group)
            length = self.choose("length", along, found=chunk_length(r))
            order, live = lay_out(r, q, length)
            place = np.empty(len(keys), np.int64)
            place[order[live]] = np.flatnonzero(live)
            whole = np.full(len(used), -1)
            whole[used] = place[of]
            cuts = np.cumsum([len(parts[k]["used"]) for k, _ in at])[:-1]
            for (k, t), where in zip(at, np.split(whole, cuts)):
                p = parts[k]
                index = Index(where.reshape(-1, p["length"]), p["along"], along, length)
                self._set(p, "touches", t, incidence=index)
            eliminated, row, used = q[order], r[order], live
        plan = Incidences(
            Index(eliminated.reshape(-1, length), along, ("group", self.eliminate)),
            Index(row[::length], along, ("group", group)),
        )
        live = np.flatnonzero(used)
        eliminated, row = eliminated[live], row[live]
        return dict(
            plan=plan, live=live, eliminated=eliminated, row=row, along=along, length=length
        )

    def find_blocks(self, parts, incidences):
        """The blocks of the reduced matrix between kept groups: from pairs of incidences, and from
        observations that touch two kept rows."""
        direct = {}  # (later, earlier): [(part, couple, row, column, along)]
        for k, p in enumerate(parts):
            self._couples(k, p, direct)
        blocks = {}
        for b, later in enumerate(self.kept):
            for earlier in self.kept[: b + 1]:
                key, both = (later, earlier), map(incidences.get, (later, earlier))
                pairs = self._pairs(*both, later == earlier)
                made = self._block_list(key, pairs, direct.get(key, ()), parts)
                if made is not None:
                    blocks[key] = made
        return blocks

    def _couples(self, k, p, direct):
        touches = p["part"].touches
        couples = []
        for j in range(len(touches)):
            for i in range(j):
                a, b = touches[j], touches[i]  # the later group first
                row, column = a.row.rows, b.row.rows
                same = turned = None
                if a.group == b.group:
                    equal, less = row == column, row < column
                    row, column = np.maximum(row, column), np.minimum(row, column)
                    meets = self.choose("same", k, j, i, found=bool(equal.any()))
                    same = Column(equal.astype(float), p["along"]) if meets else None
                    turned = Column(less.astype(float), p["along"])
                    row = np.where(equal, -1, row)
                direct.setdefault((a.group, b.group), []).append((k, len(couples), row, column))
                couples.append(Couple(j, i, None, turned, same))
        p["part"] = dataclasses.replace(p["part"], couples=tuple(couples))

    @staticmethod
    def _set(p, field, number, **changed):
        """Replaces something in one of the touches or couples of a part."""
        items = list(getattr(p["part"], field))
        items[number] = dataclasses.replace(items[number], **changed)
        p["part"] = dataclasses.replace(p["part"], **{field: tuple(items)})

    def _pairs(self, later, earlier, within):
        """Pairs of incidences: places and rows of the block (row of the later, of the earlier)."""
        if later is None or earlier is None:
            empty = np.zeros(0, np.int64)
            return empty, empty, empty, empty, None
        i, j = pairs_between(later["eliminated"], earlier["eliminated"])
        if within:  # below the diagonal; an incidence with itself is summed by chunks
            low = later["row"][i] > earlier["row"][j]
            i, j = i[low], j[low]
        return later["live"][i], earlier["live"][j], later["row"][i], earlier["row"][j], (
            (later["along"], later["length"]), (earlier["along"], earlier["length"]),
        )  # fmt: skip

    def _block_list(self, key, pairs, direct, parts):
        i, j, row, column, into = pairs
        columns = np.int64(self._rows(key[1]))
        number = lambda r, c: r.astype(np.int64) * columns + c
        keys = [number(row, column), *(number(r[r >= 0], c[r >= 0]) for *_, r, c in direct)]
        keys = self.choose("blocks", *key, found=np.unique(np.concatenate(keys)))
        if not len(keys):
            return None
        along = ("blocks", *key)
        for k, couple, r, c in direct:
            block = np.where(r >= 0, np.searchsorted(keys, number(r, c)), -1)
            self._set(parts[k], "couples", couple, block=Index(block, parts[k]["along"], along))
        found = None
        lengths = FEW_PAIR_CHUNKS if len(i) < FEW_PAIRS else PAIR_CHUNKS
        lengths = self.choose("pair chunks", *key, found=lengths if len(i) else ())
        if lengths:
            block = np.searchsorted(keys, number(row, column))
            found = _chunk_pairs(i, j, block, into, along, key, lengths)
        return Blocks(
            Index(keys // columns, along, ("group", key[0])),
            Index(keys % columns, along, ("group", key[1])),
            found,
        )

    def _rows(self, group):
        table, _, rows = self.members[group][0]
        return self.tables[table].rows if rows is None else len(rows)


def chunk_length(major: Int[np.ndarray, " n"]) -> int:
    """The longest chunks of rows of one major that leave few places empty."""
    _, number = np.unique(major, return_counts=True)
    fits = (
        length for length in CHUNK_LENGTHS
        if (-(-number // length) * length).sum() <= (1 + MOST_EMPTY) * len(major)
    )  # fmt: skip
    return next(fits, 1) if len(major) >= SMALL else 1


def lay_out(major: Int[np.ndarray, " n"], minor: Int[np.ndarray, " n"], length: int):
    """Rows sorted by (major, minor) in chunks of one major: the row in every place (a short chunk
    repeats its last), and whether the place is used."""
    order = np.lexsort((minor, major))
    if not len(order):
        return order, np.zeros(0, bool)
    _, first, number = np.unique(major[order], return_index=True, return_counts=True)
    room = -(-number // length) * length
    within = np.arange(room.sum()) - np.repeat(np.cumsum(room) - room, room)
    last = np.repeat(number, room) - 1
    return order[np.repeat(first, room) + np.minimum(within, last)], within <= last


def pairs_between(a: Int[np.ndarray, " n"], b: Int[np.ndarray, " m"]):
    """All (i, j) with a[i] = b[j]."""
    order = np.argsort(b, kind="stable")
    start = np.searchsorted(b[order], a, "left")
    count = np.searchsorted(b[order], a, "right") - start
    i = np.repeat(np.arange(len(a)), count)
    within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    return i, order[np.repeat(start, count) + within]


def _chunk_pairs(i, j, block, into, along, key, lengths) -> Pairs:
    """Pairs sorted by block, in chunks of one block, the longest first."""
    order = np.argsort(block, kind="stable")
    i, j = i[order], j[order]
    blocks, start, left = np.unique(block[order], return_index=True, return_counts=True)
    first, second, of = [], [], []
    for length in lengths:
        number = -(-left // length) if length == lengths[-1] else left // length
        chunk = np.repeat(np.arange(len(blocks)), number)
        within = np.arange(number.sum()) - np.repeat(np.cumsum(number) - number, number)
        at = start[chunk][:, None] + within[:, None] * length + np.arange(length)
        valid = at < (start + left)[chunk][:, None]
        at = np.where(valid, at, 0)
        own = ("pairs", *key, length)
        first.append(Index(np.where(valid, i[at], -1), own, *into[0]))
        second.append(Index(np.where(valid, j[at], -1), own, *into[1]))
        of.append(Index(blocks[chunk], own, along))
        taken = np.minimum(number * length, left)
        start, left = start + taken, left - taken
    return Pairs(tuple(first), tuple(second), tuple(of))
