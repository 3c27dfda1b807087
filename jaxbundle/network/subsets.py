"""Networks with a part of their points, images and distances, and notes of what was left out.

Masks say what stays (`keep`); names in notes say what was left out.
"""

import dataclasses
from collections.abc import Iterable

import numpy as np
from jaxtyping import Bool

from jaxbundle.network.columns import count, list_some
from jaxbundle.network.tables import (
    Distances,
    LeftOut,
    Network,
    Observations,
    Points,
)


def split_check_points(network: Network) -> tuple[Network, Points, Observations]:
    """The network without its check points, the check points, and their observations.

    Observations of the check points refer to them and to the images of the network by index.
    """
    check = network.points.has_role("check")
    rows = check[network.observations.point]
    observations = network.observations.take(rows)
    observations = dataclasses.replace(
        observations, point=(np.cumsum(check) - 1)[observations.point]
    )
    return keep_points(network, ~check), network.points.take(check), observations


def keep_points(network: Network, keep: Bool[np.ndarray, " points"]) -> Network:
    """The network with some of its points, without rays and distances of the others."""
    if keep.all():
        return network
    index = np.cumsum(keep) - 1
    observations = network.observations.take(keep[network.observations.point])
    network = keep_distances(network, np.all(keep[network.distances.points], axis=1))
    dropped_ids = {id for id, is_kept in zip(network.points.id, keep) if not is_kept}
    return network.replace(
        points=network.points.take(keep),
        observations=dataclasses.replace(observations, point=index[observations.point]),
        distances=dataclasses.replace(network.distances, points=index[network.distances.points]),
        datum_points=tuple(id for id in network.datum_points if id not in dropped_ids),
    )


def keep_images(network: Network, keep: Bool[np.ndarray, " images"]) -> Network:
    """The network with some of its images, without the rays of the others."""
    if keep.all():
        return network
    observations = network.observations.take(keep[network.observations.image])
    index = np.cumsum(keep) - 1
    return network.replace(
        images=network.images.take(keep),
        observations=dataclasses.replace(observations, image=index[observations.image]),
    )


def keep_distances(network: Network, keep: Bool[np.ndarray, " distances"]) -> Network:
    """The network with some of its distances."""
    if keep.all():
        return network
    d = network.distances
    return network.replace(
        distances=Distances(d.points[keep], d.value[keep], d.sigma[keep], d.source.take(keep))
    )


def with_roles(points: Points, mask: Bool[np.ndarray, " points"], role: str) -> Points:
    """The same points with another role for some of them."""
    if not mask.any():
        return points
    roles = tuple(role if new else old for new, old in zip(mask, points.role))
    return dataclasses.replace(points, role=roles)


def record_left_out(
    network: Network, noun: str, names: Iterable[str], why: str, measured: bool = True
) -> Network:
    """The network with a note that these were left out; see `LeftOut`. `measured`: something
    is lost, which the verdict of the report counts."""
    names = tuple(names)
    if not names:
        return network
    text = f"left out {count(len(names), noun)} {why}: {list_some(names)}"
    return network.note(text).replace(
        left_out=(*network.left_out, LeftOut(noun, names, why, measured))
    )
