"""Differences of coordinates and angles between points: tables `differences`, `angles`.

`differences`: `from`, `to`, and the measured ones of `dX`, `dY`, `dZ` with `sdX`, `sdY`, `sdZ` (a
levelled height difference has only dZ). `angles`: `from`, `at`, `to`, `value`, `sigma`: the angle
at a point between the directions to two others, 0 to π, in the project's unit of angles.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.errors import InputError
from jaxbundle.leastsquares.declarations import Kind
from jaxbundle.network.columns import Columns
from jaxbundle.network.kinds.base import (
    Contribution,
    ObservationTable,
    SingleValues,
    positive_sigma,
    rows_of,
)
from jaxbundle.network.tables import Network

AXES = ("dX", "dY", "dZ")


def difference(
    a: Float[Array, "3"], b: Float[Array, "3"], measured: Float[Array, "3"]
) -> Float[Array, "3"]:
    """b − a minus the measured difference."""
    return b - a - measured


def angle_misclosure(
    a: Float[Array, "3"],
    vertex: Float[Array, "3"],
    b: Float[Array, "3"],
    measured: Float[Array, ""],
) -> Float[Array, ""]:
    """The angle at a point between two others minus the measured one, radians."""
    # The tangent keeps its digits near 0 and 180°, where the arc cosine loses them. At these two
    # angles the one in space has no derivative.
    u, v = a - vertex, b - vertex
    sine = jnp.sqrt(jnp.sum(jnp.cross(u, v) ** 2))
    return jnp.arctan2(sine, u @ v) - measured


DIFFERENCE = Kind(
    "coordinate differences", difference, ("point", "point"), AXES, "length", snooped="single"
)
ANGLE = Kind("angles", angle_misclosure, ("point", "point", "point"), ("angle",), "angle")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Differences(ObservationTable):
    """Coordinates of `to` minus those of `start`; σ infinite if not measured."""

    start: tuple[str, ...]
    to: tuple[str, ...]
    value: Float[np.ndarray, "n 3"]
    sigma: Float[np.ndarray, "n 3"]

    TABLE, POINTS, MEASURED = "differences", ("start", "to"), "value"
    GIVES_SCALE = True

    @classmethod
    def from_columns(
        cls, table: Columns, settings: Mapping[str, Any], radians: float
    ) -> "Differences":
        table.check_names(("from", "to"), (*AXES, *(f"s{a}" for a in AXES)))
        value = np.stack([table.numbers(a) for a in AXES], 1)
        sigma = np.stack([positive_sigma(table, f"s{a}", required=False) for a in AXES], 1)
        is_given = ~np.isnan(value)
        for row in np.flatnonzero((is_given != ~np.isnan(sigma)).any(1) | ~is_given.any(1))[:1]:
            raise InputError(
                f"{table.source(row)}: expected a difference dX, dY or dZ with its σ sdX, sdY or "
                "sdZ, both or neither"
            )
        return cls(
            start=table.ids("from"),
            to=table.ids("to"),
            value=np.where(is_given, value, 0.0),
            sigma=np.where(is_given, sigma, np.inf),
            source=table.source,
        )

    def columns(self, radians: float) -> dict:
        is_given = np.isfinite(self.sigma)
        value, sigma = (np.where(is_given, x, np.nan) for x in (self.value, self.sigma))
        columns = {"from": self.start, "to": self.to}
        columns |= {a: value[:, k] for k, a in enumerate(AXES)}
        return columns | {f"s{a}": sigma[:, k] for k, a in enumerate(AXES)}

    def declare(self, network: Network, origin: Float[np.ndarray, "3"]) -> Contribution:
        ends = tuple(rows_of(ids, network.points) for ids in (self.start, self.to))
        return Contribution((), (DIFFERENCE(ends, self.value, sigma=self.sigma),))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Angles(SingleValues):
    """Angles at a point between two others."""

    start: tuple[str, ...]
    at: tuple[str, ...]
    to: tuple[str, ...]

    TABLE, POINTS, KIND = "angles", ("start", "at", "to"), ANGLE

    def check_values(self, radians: float) -> None:
        for row in np.flatnonzero(~((self.value > 0) & (self.value < np.pi)))[:1]:
            raise InputError(
                f"{self.source(row)}: expected an angle between 0 and half a turn, got "
                f"{self.value[row] / radians:g}"
            )
