"""Start values of a part, by several methods, until one of them leads to an adjustment.

1. With the cameras from consistent pairs of photographs: misclosures above `START_TOLERANCE` of the
   image are contradictions. If photographs are left out, the limit is that of an unknown lens.
2. With other principal distances, unless the file gives one; those that explain the most matches
come first.

In both cases, left out photographs are tried again with the adjusted cameras. Photographs that
contradict their pairs are left out, as long as the principal distance is that of the pairs.
"""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from jaxbundle.bundle.orient import orient
from jaxbundle.bundle.result import Adjustment
from jaxbundle.errors import NotSolvedError
from jaxbundle.network.sightings import keep_images, keep_points
from jaxbundle.network.tables import Camera, Network
from jaxbundle.orientation.network import Oriented
from jaxbundle.orientation.sights import TOLERANCE
from jaxbundle.reconstruction.misplaced import NamedPairs, find_misplaced
from jaxbundle.reconstruction.network import observed_parameters, with_observed
from jaxbundle.tiepoints.search import present_size

START_TOLERANCE = 0.01
"""Tolerance of start values by cameras from consistent pairs, relative to the image extent."""
SHORTEST, LONGEST = 0.35, 12.0
"""Limits of an adjusted principal distance, relative to the longer side."""
OTHERS, APART = (0.7, 0.9, 1.2, 1.6, 2.2), 1.15
"""Other principal distances to try, relative to the longer side, unless they differ by less
than this factor."""
NEAR = 1.05
"""Ratio of principal distances below which verified pairs are still right."""
FEWEST_RAYS = 12
"""Minimum image points of a photograph; of fewer most may be gross errors."""
LEAST_OF_IMAGES, OF_OTHERS = 0.5, 1
"""Minimum share of photographs oriented by start values with another principal distance; and
maximum number of such start values that are adjusted."""


def start_values(network: Network, guessed: Sequence[str], pairs: NamedPairs) -> Iterator[Oriented]:
    """The network with start values, by one method after another.

    **Arguments:** `guessed`: ids of cameras with a principal distance unknown from files; `pairs`:
    verified ones.

    **Raises:** `NotSolvedError` if there are none.
    """
    found, failed = [], None
    for tolerance in (START_TOLERANCE, TOLERANCE):
        try:
            found.append(_orient(network, tolerance, pairs))
        except NotSolvedError as error:
            failed = error
        else:
            if not found[-1].images:
                break
    yield from sorted(found, key=lambda one: len(one.images))
    others = []
    for changed in _with_other_distances(network, guessed):
        try:
            others.append(_orient(changed, START_TOLERANCE, {}))
        except NotSolvedError:
            continue
    enough = [
        one for one in others if len(one.network.images) >= LEAST_OF_IMAGES * len(network.images)
    ]
    yield from sorted(enough, key=lambda one: -len(one.network.observations))[:OF_OTHERS]
    if failed is not None and not found and not enough:
        raise failed


def _orient(network: Network, tolerance: float, pairs: NamedPairs) -> Oriented:
    """Start values, without photographs that contradict their pairs, or are weakly connected to the
    others."""
    found = orient(network, tolerance=tolerance)
    misplaced = find_misplaced(found.network, pairs)
    if misplaced:
        others = _without(network, np.isin(np.array(network.images.id), [*misplaced]))
        found = orient(others, tolerance=tolerance)
    network, images = found.network, {**found.images, **misplaced}
    while True:
        rays = np.bincount(network.observations.point, minlength=len(network.points))
        tied = (rays > 1)[network.observations.point]
        number = np.bincount(network.observations.image, tied, len(network.images))
        few = number < FEWEST_RAYS
        if not few.any() or few.all():
            return dataclasses.replace(found, network=network, images=images)
        for k in np.flatnonzero(few):
            why = f"only {int(number[k])} of its points agree with the others"
            images[network.images.id[k]] = why
        network = _without(network, few)


def _without(network: Network, images) -> Network:
    """The network without images, and without the tie points that lose all but one ray."""
    if not images.any():
        return network
    network = keep_images(network, ~images)
    rays = np.bincount(network.observations.point, minlength=len(network.points))
    return keep_points(network, (rays > 1) | ~network.points.has_role("tie"))


def _with_other_distances(network: Network, guessed: Sequence[str]) -> Iterator[Network]:
    of = {c.id: c for c in network.cameras if c.id in guessed and c.image_size is not None}
    for factor in OTHERS if of else ():
        distances = {id: factor * max(present_size(c)) for id, c in of.items()}
        ratios = [of[id].parameters["fx"] / f for id, f in distances.items()]
        if any(max(r, 1 / r) > APART for r in ratios):
            yield _with_distances(network, distances)


def _with_distances(network: Network, distances: Mapping[str, float]) -> Network:
    """The network with principal distances of some cameras, also in their observations."""
    changed = lambda c: dataclasses.replace(
        c,
        parameters={
            **c.parameters,
            "fx": distances[c.id],
            "fy": distances[c.id],
            "k1": 0.0,
        },
    )
    network = network.replace(
        cameras=tuple(changed(c) if c.id in distances else c for c in network.cameras)
    )
    observed = observed_parameters(network)
    if observed is None:
        return network
    value, sigma = observed.value.copy(), observed.sigma.copy()
    for row, (id, name) in enumerate(zip(observed.camera, observed.parameter)):
        if id in distances and name == "fx":
            value[row], sigma[row] = distances[id], distances[id] * sigma[row] / value[row]
    return with_observed(network, dataclasses.replace(observed, value=value, sigma=sigma))


def is_plausible(result: Adjustment) -> bool:
    """Whether an adjustment converged to plausible principal distances."""
    return bool(result.converged) and all(
        SHORTEST < found["fx"] / max(camera.image_size) < LONGEST
        for camera in result.network.cameras
        if camera.image_size and "fx" in (found := _parameters(result, camera))
    )


def start_again(
    network: Network, oriented: Oriented, result: Adjustment, pairs: NamedPairs
) -> Oriented | None:
    """Start values with the adjusted cameras, if these orient more photographs."""
    if not oriented.images:
        return None
    better: Mapping[str, Camera] = {
        c.id: dataclasses.replace(c, parameters={**c.parameters, **_parameters(result, c)})
        for c in result.network.cameras
    }
    cameras = tuple(better.get(c.id, c) for c in network.cameras)
    try:
        near = all(_is_near(c, better.get(c.id, c)) for c in network.cameras)
        found = _orient(network.replace(cameras=cameras), START_TOLERANCE, pairs if near else {})
    except NotSolvedError:
        return None
    return found if len(found.images) < len(oriented.images) else None


def _is_near(camera: Camera, other: Camera) -> bool:
    """Whether relative orientations with one camera also hold with the other."""
    ratio = camera.parameters.get("fx", 1.0) / other.parameters.get("fx", 1.0)
    return max(ratio, 1 / ratio) < NEAR


def _parameters(result: Adjustment, camera: Camera) -> dict[str, float]:
    values = result.cameras[camera.id]["parameters"]
    return {name: float(one["value"]) for name, one in values.items()}
