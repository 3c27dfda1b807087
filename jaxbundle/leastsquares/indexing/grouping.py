"""The eliminated rows, and the block rows formed by kept tables.

See `plan.py` for the terms."""

import dataclasses
from collections.abc import Hashable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from jaxbundle.leastsquares.declarations import ObservationSet, Table
from jaxbundle.leastsquares.indexing.indices import as_column, as_index
from jaxbundle.leastsquares.indexing.plan import Member, UnknownGroup
from jaxbundle.leastsquares.indexing.settings import PlanningSettings
from jaxbundle.types import not_none


@dataclasses.dataclass
class Choices:
    """Free choices of a plan (lengths of chunks, which tables form a group): made once for a large
    problem and reused for every part of it."""

    before: dict[Hashable, Any]
    made: dict[Hashable, Any] = dataclasses.field(default_factory=dict)

    def __call__(self, *key: Hashable, default: Any) -> Any:
        """The earlier choice under this key if there is one, else `default`; it is recorded."""
        self.made[key] = self.before.get(key, default)
        return self.made[key]


@dataclasses.dataclass
class ObservationSubset:
    """The observations that make a part; `slot`: that of the eliminated row."""

    set_name: str
    source: Int[np.ndarray, " subset"]
    slot: int | None


class TouchedGroup(NamedTuple):
    """A kept group with the slots (slot, first column) that touch the same row of it."""

    group: str
    slots: list[tuple[int, int]]


class Grouping:
    """Subsets of observations and groups of tables.

    `members`: by group, (table, first column, its rows or None: all); `group_of`: by table, group,
    first column, row of the group for every row of the table; `row_in`: for every row of the
    eliminated table its place among those that are eliminated; `kept`: the groups in order."""

    def __init__(
        self,
        tables: Sequence[Table],
        observations: Sequence[ObservationSet],
        eliminate: str | None,
        choose: Choices,
        settings: PlanningSettings,
    ):
        self.tables = {t.name: t for t in tables}
        self.observations = {
            observation_set.name: observation_set for observation_set in observations
        }
        self.eliminate, self.choose, self.settings = eliminate, choose, settings
        self.estimated = choose("estimated", default=[t.name for t in tables if t.free.any()])
        self.coupled_rows = self._find_coupled_rows()
        self.subsets = self._split_observations()
        self._form_groups()

    # ------------------------------------------------------------------ what is eliminated

    def _find_coupled_rows(self) -> Bool[np.ndarray, " rows"] | None:
        """Rows of the eliminated table that stay in the reduced system: those tied by an
        observation to another row of their table."""
        if self.eliminate is None:
            return None
        table = self.tables[self.eliminate]
        coupled = np.zeros(table.rows, bool)
        for observation_set in self.observations.values():
            slots = [s for s, name in enumerate(observation_set.kind.of) if name == self.eliminate]
            # Two rows of the eliminated table in one observation (a distance between points): V
            # would not be block diagonal, so both go to the reduced system.
            for s in slots if len(slots) > 1 else ():
                coupled[observation_set.rows[s]] = True
        # Held rows are no unknowns: in the reduced system they would be rows of zeros.
        return self.choose("coupled rows", default=coupled & table.free.any(1))

    def _split_observations(self) -> list[ObservationSubset]:
        """Observations of one set, separated by the slot that touches an eliminated row."""
        subsets = []
        for o, observation_set in self.observations.items():
            slots = [s for s, name in enumerate(observation_set.kind.of) if name == self.eliminate]
            # −1: the observation touches no eliminated row; it adds to the reduced system directly.
            slot_of = np.full(observation_set.number, -1)
            # An observation may touch two held rows of the table: the last one counts as
            # eliminated.
            for s in slots:
                slot_of[~not_none(self.coupled_rows)[observation_set.rows[s]]] = s
            # A set without observations is an empty subset.
            for slot in self.choose("slots", o, default=np.unique(slot_of).tolist() or [-1]):
                rows = np.flatnonzero(slot_of == slot)
                subsets.append(ObservationSubset(o, rows, None if slot < 0 else slot))
        return subsets

    # ------------------------------------------------------------------ groups

    def _form_groups(self) -> None:
        """Kept tables in groups; the eliminated rows are the last group."""
        self.members, self.group_of = {}, {}
        for name in self.estimated:
            table = self.tables[name]
            if name == self.eliminate:
                continue
            # A pose and the camera that took only this image, one block of 9 instead of blocks of 6
            # and 3: one list of pairs instead of three.
            host = next((g for g in self.members if self._meet_always(g, name)), None)
            host = self.choose("host", name, default=host)
            if host is None:
                self.members[name] = [(name, 0, None)]
                self.group_of[name] = name, 0, np.arange(table.rows)
            else:
                start = sum(self.tables[t].space.width for t, *_ in self.members[host])
                self.members[host].append((name, start, None))
                self.group_of[name] = host, start, np.arange(table.rows)
        self.row_in, name = {}, self.eliminate
        if name is not None:
            coupled = not_none(self.coupled_rows)
            # Kept rows and eliminated ones are numbered separately.
            place = lambda mask: np.where(mask, np.cumsum(mask) - 1, -1)
            if coupled.any():
                name_of_kept = f"{name} (kept)"
                self.members[name_of_kept] = [(name, 0, np.flatnonzero(coupled))]
                self.group_of[name] = name_of_kept, 0, place(coupled)
            rows = np.flatnonzero(~coupled) if coupled.any() else None
            self.members[name] = [(name, 0, rows)]
            self.row_in = place(~coupled)
        # JAX sorts the keys of a dict: `ravel_pytree` and the pairs of `plan.blocks` rely on the
        # same order.
        self.kept = sorted(g for g in self.members if g != name)

    def _meet_always(self, group: str, name: str) -> bool:
        """Whether every row of a table occurs in exactly the same observations of eliminated rows
        as the row of a group with its number."""
        first_table = self.members[group][0][0]
        if self.tables[first_table].rows != self.tables[name].rows:
            return False
        is_met = False
        for subset in self.subsets:
            observation_set = self.observations[subset.set_name]
            of, rows = observation_set.kind.of, observation_set.rows
            if subset.slot is None:
                continue
            a = [s for s, t in enumerate(of) if t == first_table]
            b = [s for s, t in enumerate(of) if t == name]
            # A set of observations that touches one table but not the other: their blocks have
            # different incidences.
            if len(a) != len(b) or len(a) > 1:
                return False
            if a:
                is_met = True
                if not np.array_equal(rows[a[0]][subset.source], rows[b[0]][subset.source]):
                    return False
        return is_met

    def group(self, name: str) -> UnknownGroup:
        members, free = [], []
        for table, start, rows in self.members[name]:
            member_table = self.tables[table]
            free.append(member_table.free if rows is None else member_table.free[rows])
            index = None if rows is None else as_index(rows, ("group", name), ("table", table))
            members.append(Member(table, start, member_table.space.width, index))
        free = np.concatenate(free, 1)
        # A slot of the eliminated table may touch a row that is not in this group: it is masked.
        partial = any(rows is not None for *_, rows in self.members[name])
        # Data snooping of small problems holds points one by one: with the mask as an array the
        # compiled program of the whole serves whichever are held.
        may_be_held = name == self.eliminate and len(free) < self.settings.masked_below
        may_be_held |= partial and name != self.eliminate
        all_free = bool(free.all()) and not may_be_held
        all_free = self.choose("all free", name, default=all_free)
        return UnknownGroup(tuple(members), as_column(free, ("group", name)), all_free)

    def touched_groups(self, number: int, subset: ObservationSubset) -> list[TouchedGroup]:
        """The kept groups touched by subset `number`, in order.

        Slots of one group are one touch if they have the same row in every observation of the
        subset. This is decided for each subset: tables that always meet where rows are eliminated
        may cross elsewhere, as the velocity of one image and the pose of the next."""
        observation_set, touches = self.observations[subset.set_name], []
        for s, name in enumerate(observation_set.kind.of):
            if s == subset.slot or name not in self.group_of:
                continue
            group, start, place = self.group_of[name]
            row = place[observation_set.rows[s][subset.source]]
            touches_of_row = (
                t for t, at in touches if t.group == group and np.array_equal(at, row)
            )
            tables = lambda t: [observation_set.kind.of[q] for q, _ in t.slots]
            # Two slots of one table need columns of their own.
            host = next((t for t in touches_of_row if name not in tables(t)), None)
            if host is None:
                touches.append((TouchedGroup(group, [(s, start)]), row))
            else:
                host.slots.append((s, start))
        touches = sorted((t for t, _ in touches), key=lambda t: self.kept.index(t.group))
        return self.choose("touches", number, default=touches)

    def rows(self, group: str) -> int:
        table, _, rows = self.members[group][0]
        return self.tables[table].rows if rows is None else len(rows)
