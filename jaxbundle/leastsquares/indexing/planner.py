"""Plans a problem on the host: see `plan.py`."""

import dataclasses
from collections.abc import Callable, Hashable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from jaxbundle.choices import REDUCTIONS
from jaxbundle.leastsquares.declarations import ObservationSet, Table
from jaxbundle.leastsquares.indexing.grouping import Choices, Grouping, ObservationSubset
from jaxbundle.leastsquares.indexing.indices import Sizes, as_column, as_index, count
from jaxbundle.leastsquares.indexing.layout import (
    chunk_length,
    chunk_pairs,
    lay_out,
    pair_chunk_lengths,
    pairs_between,
)
from jaxbundle.leastsquares.indexing.plan import (
    Blocks,
    Coupling,
    Incidences,
    Key,
    ObservationPart,
    Plan,
    TouchedRows,
)
from jaxbundle.leastsquares.indexing.reduction import FACTORS, Band, plan_reduction
from jaxbundle.leastsquares.indexing.settings import PLANNING, PlanningSettings


def make_plan(
    tables: Sequence[Table],
    observations: Sequence[ObservationSet],
    eliminate: str | None,
    choices: dict | None = None,
    solvers: Sequence[str] = REDUCTIONS,
    settings: PlanningSettings = PLANNING,
) -> tuple[Plan, Sizes, dict]:
    """The plan on the host, its arrays as `PlanIndex` and `PlanColumn` (`indices.finish`), the
    sizes of its lists, and the choices made (lengths of chunks, blocks of the reduced matrix,
    settings).

    **Arguments:** `choices`: those made for the larger problem that this one is a part of, to be
    reused; `solvers`: those allowed for the reduced system."""
    choose = Choices(choices or {})
    settings = choose("settings", default=settings)
    plan = _Planner(Grouping(tables, observations, eliminate, choose, settings), solvers).plan()
    sizes = {("table", t.name): t.rows + 1 for t in tables}
    sizes |= {("observations", o.name): o.number + 1 for o in observations}
    return plan, sizes | count(plan), choose.made


@dataclasses.dataclass
class _PartInChunks:
    """A part in its chunks of `length`, along the list `along`; `used`: which positions are used.
    The arrays of `part`, an `ObservationPart`, are still `PlanIndex` and `PlanColumn`."""

    part: Any
    used: Bool[np.ndarray, " places"]
    length: int
    along: Hashable

    def set(self, field: str, number: int, **changed: Any) -> None:
        """Replaces an item in one of the touches or couplings."""
        items = list(getattr(self.part, field))
        items[number] = dataclasses.replace(items[number], **changed)
        self.part = dataclasses.replace(self.part, **{field: tuple(items)})


@dataclasses.dataclass
class _IncidencesInChunks:
    """Incidences of a group in their chunks; for each incidence: place, both rows."""

    incidences: Incidences
    place: Int[np.ndarray, " n"]
    eliminated: Int[np.ndarray, " n"]
    row: Int[np.ndarray, " n"]
    along: Hashable
    length: int


# By groups (later, earlier): for each entry the part, the index of the coupling in it, and the rows
# and columns of the blocks.
DirectBlocks = dict[Key, list[tuple[int, int, np.ndarray, np.ndarray]]]


class _PairList(NamedTuple):
    """Pairs of incidences of two groups: places of both, row and column of their block, and the
    lists (with the length of chunks) in which the places are."""

    first: Int[np.ndarray, " n"]
    second: Int[np.ndarray, " n"]
    row: Int[np.ndarray, " n"]
    column: Int[np.ndarray, " n"]
    into: Sequence[tuple[Hashable, int]]


class _Planner:
    """The steps of `make_plan`; `grouping`: what is eliminated, and the groups."""

    def __init__(self, grouping: Grouping, solvers: Sequence[str]):
        self.grouping, self.choose, self.settings = grouping, grouping.choose, grouping.settings
        self.solvers = self.choose("solvers", default=tuple(solvers))

    def plan(self) -> Plan:
        parts = [self.plan_part(k, subset) for k, subset in enumerate(self.grouping.subsets)]
        incidences = {g: self.incidences_of(g, parts) for g in self.grouping.kept}
        incidences = {g: chunks for g, chunks in incidences.items() if chunks is not None}
        groups = {
            g: self.grouping.group(g)
            for g in (*self.grouping.kept, self.grouping.eliminate)
            if g is not None
        }
        blocks, reduction, band = self.plan_reduced_system(parts, incidences, groups)
        incidences = {g: chunks.incidences for g, chunks in incidences.items()}
        parts = tuple(p.part for p in parts)
        return Plan(groups, self.grouping.eliminate, parts, incidences, blocks, reduction, band)

    def plan_reduced_system(
        self,
        parts: list[_PartInChunks],
        incidences: dict[str, _IncidencesInChunks],
        groups: dict[str, Any],
    ) -> tuple[dict[Key, Blocks], str | None, Band | None]:
        """The blocks of the reduced matrix, its solver, its band."""
        rows = [np.zeros(0, np.int64), *(chunks.eliminated for chunks in incidences.values())]
        # m incidences of an eliminated row are m(m − 1)/2 pairs: counted before they are listed.
        m, solvers = np.bincount(np.concatenate(rows)).astype(float), self.solvers
        if len(solvers) > 1 and (m * (m - 1)).sum() / 2 > self.settings.max_pairs:
            # Also where it is not among those allowed: `problem.with_factor` then finds no factor.
            solvers = ("iterative",)
        blocks = self.find_blocks(parts, {} if solvers == ("iterative",) else incidences)
        shapes = {g: groups[g].free.rows.shape for g in self.grouping.kept}
        no_rows = np.zeros(0, np.int64)
        rows_of = lambda at: (at.row.rows, at.column.rows) if at else (no_rows, no_rows)
        couplings = lambda g: rows_of(blocks.get((g, g)))
        observations = sum(
            observation_set.number for observation_set in self.grouping.observations.values()
        )
        solver, band = plan_reduction(shapes, couplings, observations, solvers, self.settings)
        # The parts of a problem on several devices must not choose another one.
        self.choose.made["solvers",] = (solver,)
        # Without a factor nothing reads the lists of pairs, which are the largest of all.
        return blocks if solver in FACTORS else self.find_blocks(parts, {}), solver, band

    def plan_part(self, k: int, subset: ObservationSubset) -> _PartInChunks:
        """Part k in chunks, with its touches (couplings and incidences are added later)."""
        observation_set = self.grouping.observations[subset.set_name]
        rows = [np.asarray(r)[subset.source] for r in observation_set.rows]
        slots = self.grouping.touched_groups(k, subset)
        # Of every touch the row of its group, for every observation.
        kept_rows = []
        for _, touched in slots:
            slot = touched[0][0]
            kept_rows.append(self.grouping.group_of[observation_set.kind.of[slot]][2][rows[slot]])
        # One number for every combination of kept rows that occurs; `unique` keeps it small.
        major = np.zeros(len(subset.source), np.int64)
        for row in kept_rows:
            # Rows begin at −1, none: row + 1 is one of max + 2 numbers from 0 on.
            major = np.unique(major * (row.max(initial=0) + 2) + row + 1, return_inverse=True)[1]
        minor = rows[subset.slot] if subset.slot is not None else np.arange(len(major))
        along = ("part", k)
        length = self.choose("length", along, default=chunk_length(major, self.settings))
        large = self.choose("large", k, default=len(major) >= self.settings.small_part)
        order, used = lay_out(major, minor, length)
        chunk = lambda x: x[order].reshape(-1, length)
        lookup, by_row = self._plan_lookups(k, subset, rows, major, chunk)
        touches = []
        for (group, touched), row in zip(slots, kept_rows):
            width = lambda slot: self.grouping.tables[observation_set.kind.of[slot]].space.width
            stop = max(start + width(slot) for slot, start in touched)
            start = min(start for _, start in touched)
            index = as_index(chunk(row)[:, 0], along, ("group", group))
            touches.append(TouchedRows(group, tuple(touched), start, stop, index, None))
        source = np.where(used, subset.source[order], -1).reshape(-1, length)
        place = np.full(observation_set.number, -1)
        place[subset.source[order][used]] = np.flatnonzero(used)
        eliminated = None
        if subset.slot is not None:
            at = self.grouping.row_in[chunk(rows[subset.slot])]
            eliminated = as_index(at, along, ("group", self.grouping.eliminate))
        number = ("observations", subset.set_name)
        part = ObservationPart(
            set_name=subset.set_name,
            slot=subset.slot,
            by_row=tuple(by_row),
            large=large,
            lookup=tuple(lookup),
            eliminated=eliminated,
            source=as_index(source, along, number),
            place=as_index(place, number, along, length),
            touches=tuple(touches),
            couplings=(),
        )
        return _PartInChunks(part, used, length, along)

    def _plan_lookups(
        self,
        k: int,
        subset: ObservationSubset,
        rows: Sequence[np.ndarray],
        major: Int[np.ndarray, " subset"],
        chunk: Callable[[np.ndarray], np.ndarray],
    ) -> tuple[list, list[bool]]:
        """Of every slot of part k the rows of its table, one for a chunk or one for each
        observation; and which of both."""
        of = self.grouping.observations[subset.set_name].kind.of
        along, lookup, by_row = ("part", k), [], []
        observation_of = np.zeros(major.max(initial=0) + 1, np.int64)
        observation_of[major] = np.arange(len(major))  # An observation of every major.
        for s, name in enumerate(of):
            rows_in_chunks = chunk(rows[s])
            # A slot whose row is the same in a chunk is looked up once for it, the others for each
            # observation.
            is_constant = rows_in_chunks.shape[1] == 1 or bool(
                (rows[s] == rows[s][observation_of[major]]).all()
            )
            # The eliminated row is looked up for each observation in any case.
            by_chunk = self.choose("by chunk", k, s, default=is_constant and s != subset.slot)
            by_row.append(not by_chunk)
            lookup.append(
                as_index(
                    rows_in_chunks[:, 0] if by_chunk else rows_in_chunks, along, ("table", name)
                )
            )
        return lookup, by_row

    def incidences_of(self, group: str, parts: list[_PartInChunks]) -> _IncidencesInChunks | None:
        """The incidences of a group; sets the incidence of the observations of the parts."""
        touches = [
            (k, t)
            for k, p in enumerate(parts)
            if p.part.slot is not None
            for t, touch in enumerate(p.part.touches)
            if touch.group == group
        ]
        if not touches:
            return None
        eliminated, row, is_used = [], [], []
        for k, t in touches:
            p = parts[k]
            eliminated.append(p.part.eliminated.rows.ravel())
            row.append(np.repeat(p.part.touches[t].row.rows, p.length))
            is_used.append(p.used)
        eliminated, row, is_used = (np.concatenate(x) for x in (eliminated, row, is_used))
        # An incidence is a combination of both rows; several observations may share it (an image
        # point and a distance to the same camera).
        number = len(self.grouping.row_in)
        keys = row[is_used].astype(np.int64) * number + eliminated[is_used]
        keys, incidence = np.unique(keys, return_inverse=True)
        # The usual case: every observation is an incidence of its own, and W needs no sum.
        one_each = len(touches) == 1 and len(keys) == is_used.sum()
        if self.choose("one incidence an observation", group, default=one_each):
            p = parts[touches[0][0]]
            along, length = p.along, p.length
        else:
            row, eliminated = keys // number, keys % number
            along = ("incidences", group)
            length = self.choose("length", along, default=chunk_length(row, self.settings))
            order, filled = lay_out(row, eliminated, length)
            place = np.empty(len(keys), np.int64)
            place[order[filled]] = np.flatnonzero(filled)
            self._set_incidences(parts, touches, is_used, place[incidence], along, length)
            eliminated, row, is_used = eliminated[order], row[order], filled
        plan = Incidences(
            as_index(eliminated.reshape(-1, length), along, ("group", self.grouping.eliminate)),
            as_index(row[::length], along, ("group", group)),
        )
        places = np.flatnonzero(is_used)
        eliminated, row = eliminated[places], row[places]
        return _IncidencesInChunks(plan, places, eliminated, row, along, length)

    @staticmethod
    def _set_incidences(
        parts: list[_PartInChunks],
        touches: Sequence[tuple[int, int]],
        is_used: Bool[np.ndarray, " places"],
        place: Int[np.ndarray, " used"],
        along: Hashable,
        length: int,
    ) -> None:
        """Sets the place of the incidence of every used observation of these touches (part, number
        of its touch), one after the other."""
        of_all = np.full(len(is_used), -1)
        of_all[is_used] = place
        cuts = np.cumsum([len(parts[k].used) for k, _ in touches])[:-1]
        for (k, t), of_part in zip(touches, np.split(of_all, cuts)):
            place = of_part.reshape(-1, parts[k].length)
            parts[k].set("touches", t, incidence=as_index(place, parts[k].along, along, length))

    def find_blocks(
        self, parts: list[_PartInChunks], incidences: dict[str, _IncidencesInChunks]
    ) -> dict[Key, Blocks]:
        """The blocks of the reduced matrix between kept groups: from pairs of incidences, and from
        observations that touch two kept rows."""
        direct: DirectBlocks = {}
        for k, p in enumerate(parts):
            self._couplings(k, p, direct)
        blocks = {}
        # Blocks below the diagonal of the reduced matrix, groups in the order of JAX's pytrees.
        for place, later in enumerate(self.grouping.kept):
            for earlier in self.grouping.kept[: place + 1]:
                key, a, b = (later, earlier), incidences.get(later), incidences.get(earlier)
                pairs = self._pairs(a, b, later == earlier)
                block_list = self._block_list(key, pairs, direct.get(key, ()), parts)
                if block_list is not None:
                    blocks[key] = block_list
        return blocks

    def _couplings(self, k: int, p: _PartInChunks, direct: DirectBlocks) -> None:
        """Adds the pairs of touches of part k, and their rows and columns to `direct`."""
        touches = p.part.touches
        couplings = []
        for j in range(len(touches)):
            for i in range(j):
                a, b = touches[j], touches[i]  # the later group first
                row, column = a.row.rows, b.row.rows
                is_same = turned = None
                is_absent = (row < 0) | (column < 0)
                if a.group == b.group:
                    is_equal, is_lower = (row == column) & ~is_absent, row < column
                    row, column = np.maximum(row, column), np.minimum(row, column)
                    meets = self.choose("same", k, j, i, default=bool(is_equal.any()))
                    is_same = as_column(is_equal.astype(float), p.along) if meets else None
                    turned = as_column(is_lower.astype(float), p.along)
                    is_absent |= is_equal
                row = np.where(is_absent, -1, row)
                direct.setdefault((a.group, b.group), []).append((k, len(couplings), row, column))
                couplings.append(Coupling(j, i, None, turned, is_same))
        p.part = dataclasses.replace(p.part, couplings=tuple(couplings))

    def _pairs(
        self, later: _IncidencesInChunks | None, earlier: _IncidencesInChunks | None, within: bool
    ) -> _PairList:
        """The pairs of incidences of one eliminated row, of two groups or `within` one."""
        if later is None or earlier is None:
            empty = np.zeros(0, np.int64)
            return _PairList(empty, empty, empty, empty, ())
        i, j = pairs_between(later.eliminated, earlier.eliminated)
        # Touched rows may be held, or eliminated themselves: no block.
        has_block = (later.row[i] >= 0) & (earlier.row[j] >= 0)
        if within:  # below the diagonal; an incidence paired with itself is summed by chunks
            has_block &= later.row[i] > earlier.row[j]
        i, j = i[has_block], j[has_block]
        into = (later.along, later.length), (earlier.along, earlier.length)
        return _PairList(later.place[i], earlier.place[j], later.row[i], earlier.row[j], into)

    def _block_list(
        self, key: Key, pairs: _PairList, direct: Sequence, parts: list[_PartInChunks]
    ) -> Blocks | None:
        """The blocks of two groups, from their pairs and from observations that touch both."""
        i, j, row, column, into = pairs
        columns = np.int64(self.grouping.rows(key[1]))
        number = lambda r, c: r.astype(np.int64) * columns + c
        # The blocks that occur, in the order of row and column: memory follows the fill
        # of S, not its size.
        keys = [number(row, column), *(number(r[r >= 0], c[r >= 0]) for *_, r, c in direct)]
        keys = self.choose("blocks", *key, default=np.unique(np.concatenate(keys)))
        if not len(keys):
            return None
        along = ("blocks", *key)
        for k, coupling, r, c in direct:
            block = np.where(r >= 0, np.searchsorted(keys, number(r, c)), -1)
            parts[k].set("couplings", coupling, block=as_index(block, parts[k].along, along))
        pairs_in_chunks = None
        lengths = self.choose(
            "pair chunks", *key, default=pair_chunk_lengths(len(i), self.settings)
        )
        if lengths:
            block = np.searchsorted(keys, number(row, column))
            pairs_in_chunks = chunk_pairs(i, j, block, into, along, key, lengths)
        return Blocks(
            as_index(keys // columns, along, ("group", key[0])),
            as_index(keys % columns, along, ("group", key[1])),
            pairs_in_chunks,
        )
