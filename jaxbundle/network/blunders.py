"""Observations that data snooping removed, and suspects of robust estimation, in network terms."""

import dataclasses
from collections.abc import Iterable, Sequence


@dataclasses.dataclass(frozen=True)
class Removed:
    """A removed observation: kind, row in the arrays of its kind, a name for reports, test value,
    NaN where what remains cannot test it. `others`: rows of inseparable observations, removed with
    it."""

    kind: str
    row: int
    name: str
    test: float
    others: tuple[int, ...] = ()

    @property
    def rows(self) -> tuple[int, ...]:
        """All rows that were removed."""
        return (self.row, *self.others)


def removed_rays(removed: Iterable[Removed]) -> list[int]:
    """The rows of all image points that were removed."""
    return [ray for item in removed if item.kind == "image" for ray in item.rows]


@dataclasses.dataclass(frozen=True)
class Suspect:
    """An observation whose residual exceeds the critical length: kind, row in the arrays, a name
    for reports, the length t of its residual in units of σ and scale, its weight factor."""

    kind: str
    row: int
    name: str
    test: float
    weight: float


def either_of(names: Sequence[str]) -> str:
    """Inseparable observations that were removed together."""
    return names[0] if len(names) == 1 else f"either of {', '.join(names[:-1])} or {names[-1]}"
