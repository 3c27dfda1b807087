"""Names of unknowns for reports."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from jaxbundle.leastsquares.problem import Problem


@dataclasses.dataclass(frozen=True)
class Name:
    """One unknown: kind and id of its owner, and its parameter."""

    kind: str
    id: str
    parameter: str

    def __str__(self) -> str:
        return f"{self.parameter} of {self.kind} {self.id}"


def place_of(problem: Problem, group: str, row: int, column: int) -> tuple[str, int, int]:
    """Table, row and direction of a column of a row of a group."""
    for m in problem.plan.groups[group].members:
        if m.start <= column < m.start + m.width:
            return m.table, row if m.rows is None else int(m.rows[row]), column - m.start
    raise IndexError(column)


def name_of(problem: Problem, group: str, row: int, column: int) -> Name:
    """The unknown in a column of a row of a group."""
    name, row, direction = place_of(problem, group, row, column)
    table = problem.table(name)
    return Name(table.title, table.label(row), table.parameter(direction))


def kept_unknowns(problem: Problem) -> list[tuple[str, int, int]]:
    """Group, row and column of all unknowns of the reduced system, in its order."""
    return [
        (g, row, column)
        for g in problem.plan.kept
        for row, column in np.ndindex(problem.plan.groups[g].free.shape)
    ]


def eliminated_rows(problem: Problem, names: Sequence[str]) -> list[int]:
    """The eliminated rows to which unknowns of these names belong."""
    if problem.plan.eliminated is None or not names:
        return []
    table, rows = problem.table(problem.plan.eliminated), np.flatnonzero(~problem.kept_rows)
    row_of = {f"{table.title} {table.label(row)}": row for row in rows.tolist()}
    owners = {str(name).partition(" of ")[2] for name in names}
    return [row_of[owner] for owner in owners if owner in row_of]
