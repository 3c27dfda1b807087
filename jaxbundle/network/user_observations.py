"""Observations of user-defined kinds, and their tables of unknowns, for a network.

They touch the network's rows by id ("image", "camera", "point") and receive unreduced object
coordinates, not relative to the network's origin.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxbundle.arguments import show
from jaxbundle.errors import InputError
from jaxbundle.leastsquares.declarations import ObservationSet, Table
from jaxbundle.leastsquares.spaces import Block, Posed

OWN = ("image", "camera", "point")


@dataclasses.dataclass(frozen=True)
class InObjectSpace:
    """A residual whose blocks of points and poses are moved from the network's origin to
    object coordinates; `tables`: those of its blocks."""

    residual: Callable
    tables: tuple[str, ...]
    origin: tuple[float, float, float]

    def __call__(self, *blocks_and_measured: Any) -> Any:
        *blocks, measured = blocks_and_measured
        return self.residual(*map(self._place, self.tables, blocks), measured)

    def _place(self, table: str, block: Any) -> Block:
        # Blocks of the network are relative to its origin; residuals of users are written for
        # object coordinates. The sum loses digits of them, but none that the residual had.
        if table == "image":
            centre = tuple(c + o for c, o in zip(block.centre, self.origin))
            return Posed(block.rotation, centre)
        if table == "point":
            if isinstance(block, tuple):
                return tuple(x + o for x, o in zip(block, self.origin))
            return block + np.array(self.origin)
        return block


def split_by_type(
    also: Sequence[Table | ObservationSet],
) -> tuple[list[Table], list[ObservationSet]]:
    """The tables and the observations of them.

    **Raises:** `InputError` for anything else, and for the name of a table of the network."""
    tables = [declaration for declaration in also if isinstance(declaration, Table)]
    observations = [declaration for declaration in also if isinstance(declaration, ObservationSet)]
    for declaration in also:
        if not isinstance(declaration, Table | ObservationSet):
            raise InputError(
                "also: expected tables (leastsquares.Table) and observations (a Kind, called), "
                f"got {show(declaration)}"
            )
    for table in tables:
        if table.name.split(",")[0] in OWN:
            raise InputError(f"also: the network already has a table {table.name!r}")
    return tables, observations


def place_in_object_space(
    observations: ObservationSet, origin: Float[np.ndarray, "3"]
) -> ObservationSet:
    """The observations, with a residual of object coordinates (`InObjectSpace`)."""
    kind, (X, Y, Z) = observations.kind, (float(x) for x in origin)
    if not {"image", "point"} & set(kind.of):
        return observations
    residual = InObjectSpace(kind.residual, kind.of, (X, Y, Z))
    return dataclasses.replace(observations, kind=dataclasses.replace(kind, residual=residual))
