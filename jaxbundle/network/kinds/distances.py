"""Distances between two points."""

from typing import TYPE_CHECKING

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbundle.leastsquares.declarations import Kind, ObservationSet
from jaxbundle.types import Scalar

if TYPE_CHECKING:
    from jaxbundle.network.tables import Network


def distance_misclosure(a: Float[Array, "3"], b: Float[Array, "3"], measured: Scalar) -> Scalar:
    """The distance of two points minus the given one."""
    return jnp.sqrt(jnp.sum((a - b) ** 2)) - measured


DISTANCES = Kind(
    "distances", distance_misclosure, ("point", "point"), ("d",), "length", snooped="single"
)


def declare_distances(network: "Network") -> list[ObservationSet]:
    """The set "distance", one row a distance, if there are any."""
    distances = network.distances
    if not len(distances):
        return []
    return [
        DISTANCES(
            tuple(distances.points.T), distances.value, sigma=distances.sigma, name="distance"
        )
    ]
