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
    """A residual whose blocks of points and poses (`of`) are moved from the network's origin to
    object coordinates."""

    residual: Callable
    of: tuple[str, ...]
    origin: tuple[float, float, float]

    def __call__(self, *blocks_and_measured: Any) -> Any:
        *blocks, measured = blocks_and_measured
        return self.residual(*map(self._place, self.of, blocks), measured)

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
    tables = [item for item in also if isinstance(item, Table)]
    observations = [item for item in also if isinstance(item, ObservationSet)]
    for item in also:
        if not isinstance(item, Table | ObservationSet):
            raise InputError(
                "also: expected tables (leastsquares.Table) and observations (a Kind, called), "
                f"got {show(item)}"
            )
    for table in tables:
        if table.name.split(",")[0] in OWN:
            raise InputError(f"also: the network already has a table {table.name!r}")
    return tables, observations


def place(observation_set: ObservationSet, origin: Float[np.ndarray, "3"]) -> ObservationSet:
    """The observations in the coordinates of the arrays."""
    kind, (X, Y, Z) = observation_set.kind, (float(x) for x in origin)
    if not {"image", "point"} & set(kind.of):
        return observation_set
    residual = InObjectSpace(kind.residual, kind.of, (X, Y, Z))
    return dataclasses.replace(observation_set, kind=dataclasses.replace(kind, residual=residual))
