"""Start values of a part, by several methods, until one of them leads to an adjustment.

1. With the cameras from consistent pairs of photographs: misclosures above 1 % of the image extent
   are contradictions. If photographs are left out, the limit is that of an unknown lens.
2. With other principal distances, unless the file gives one; those that explain the most matches
   come first.

In both cases, photographs left out are tried again with the adjusted cameras. Photographs that
contradict their pairs are left out, as long as the principal distance is that of the pairs.
"""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from jaxtyping import Bool

from jaxbundle.adjustment.orient import orient
from jaxbundle.adjustment.result import Adjustment
from jaxbundle.errors import NotSolvedError
from jaxbundle.network.subsets import keep_images, keep_points
from jaxbundle.network.tables import Camera, Network
from jaxbundle.orientation.network import Oriented
from jaxbundle.orientation.rays import TOLERANCE
from jaxbundle.reconstruction.camera_priors import observed_parameters, with_observed
from jaxbundle.reconstruction.misplaced import MisplacedSettings, NamedPairs, find_misplaced
from jaxbundle.tiepoints.verified_pairs import required_image_size


@dataclasses.dataclass(frozen=True)
class BlockStartSettings:
    """Settings of the start values of a part."""

    tolerance: float = 0.01
    """Tolerance of start values by cameras from consistent pairs, relative to the image extent, the
    angle to the axis that 95 % of the rays do not exceed (`orientation.rays.sights`): 14 pixels of
    3000. Their K1 is not exact, and K2 and K3 are missing. Larger: points of repeated parts agree
    by chance; smaller: photographs with much distortion are left out (and tried with the tolerance
    of an unknown lens)."""
    min_distance: float = 0.35
    """Smallest plausible principal distance that only photographs determine, relative to the longer
    side: 110° of view."""
    max_distance: float = 12.0
    """Largest plausible one: 5° of view, 430 mm of full frame. Adjustments that fail end in 0 or
    infinity."""
    stated_ratio: float = 1.5
    """Ratio to a principal distance from files or a calibration below which the adjusted one is
    plausible, whatever the lens: files are wrong by more only if a photograph was cropped
    (`CameraStartSettings.believed_ratio`)."""
    other_distances: tuple[float, ...] = (0.7, 0.9, 1.2, 1.6, 2.2)
    """Other principal distances to try, relative to the longer side, in steps of 1.29 to 1.375, so
    that one lies within 17 % of the right one, from telephones and drones (0.7) to beyond normal
    lenses (1.4)."""
    distinct_ratio: float = 1.15
    """Others are tried only if they differ from the present ones by more than this factor: half a
    step."""
    near_ratio: float = 1.05
    """Ratio of principal distances below which verified pairs are still right: rotations between
    views 30 degrees apart then change by 1.5 degrees."""
    min_rays: int = 12
    """Minimum image points of a photograph that other photographs share: 24 coordinates for 6
    unknowns. Of fewer most may be gross errors. Of coded targets alone
    `ReconstructionSettings.min_common_targets` are enough."""
    min_oriented: float = 0.5
    """Minimum share of photographs oriented by start values with another principal distance."""
    max_others: int = 1
    """Maximum number of such start values that are adjusted: those that explain most image points.
    Each takes the time of an adjustment, and the next best have explained fewer."""
    misplaced: MisplacedSettings = MisplacedSettings()


def start_values(
    network: Network,
    guessed: Sequence[str],
    pairs: NamedPairs,
    settings: BlockStartSettings = BlockStartSettings(),
) -> Iterator[Oriented]:
    """The network with start values, by one method after another.

    **Arguments:** `guessed`: ids of cameras with a principal distance unknown from files; `pairs`:
    verified ones.

    **Raises:** `NotSolvedError` if there are none.
    """
    candidates, first_error = [], None
    for tolerance in (settings.tolerance, TOLERANCE):
        try:
            candidates.append(_orient(network, tolerance, pairs, settings))
        except NotSolvedError as error:
            first_error = error
        else:
            # A wide tolerance lets wrong points in: only if the narrow one loses photographs.
            if not candidates[-1].images_not_placed:
                break
    # Those that leave out the fewest photographs first.
    yield from sorted(candidates, key=lambda oriented: len(oriented.images_not_placed))
    other_starts = []
    for changed in _try_other_distances(network, guessed, settings):
        try:
            # Without pairs: their orientations were found with the other distance.
            other_starts.append(_orient(changed, settings.tolerance, {}, settings))
        except NotSolvedError:
            continue
    min_oriented = settings.min_oriented * len(network.images)
    sufficient = [
        oriented for oriented in other_starts if len(oriented.network.images) >= min_oriented
    ]
    sufficient.sort(key=lambda oriented: -len(oriented.network.observations))
    yield from sufficient[: settings.max_others]
    if first_error is not None and not candidates and not sufficient:
        raise first_error


def _orient(
    network: Network, tolerance: float, pairs: NamedPairs, settings: BlockStartSettings
) -> Oriented:
    """Start values, without photographs that contradict their pairs, or are weakly connected to the
    others."""
    oriented = orient(network, tolerance=tolerance)
    misplaced = find_misplaced(oriented.network, pairs, settings.misplaced)
    if misplaced:
        consistent = _without(network, np.isin(np.array(network.images.id), [*misplaced]))
        oriented = orient(consistent, tolerance=tolerance)
    network, images = oriented.network, {**oriented.images_not_placed, **misplaced}
    # Leaving out one photograph takes rays from the points of others: until none has too few.
    while True:
        rays = np.bincount(network.observations.point, minlength=len(network.points))
        has_several = (rays > 1)[network.observations.point]
        number = np.bincount(network.observations.image, has_several, len(network.images))
        has_few = number < settings.min_rays
        if not has_few.any() or has_few.all():
            return dataclasses.replace(oriented, network=network, images_not_placed=images)
        for k in np.flatnonzero(has_few):
            why = f"only {int(number[k])} of its points agree with the others"
            images[network.images.id[k]] = why
        network = _without(network, has_few)


def _without(network: Network, images: Bool[np.ndarray, " images"]) -> Network:
    """The network without images, and without the tie points that lose all but one ray."""
    if not images.any():
        return network
    network = keep_images(network, ~images)
    rays = np.bincount(network.observations.point, minlength=len(network.points))
    return keep_points(network, (rays > 1) | ~network.points.has_role("tie"))


def _try_other_distances(
    network: Network, guessed: Sequence[str], settings: BlockStartSettings
) -> Iterator[Network]:
    cameras = {c.id: c for c in network.cameras if c.id in guessed and c.image_size is not None}
    for factor in settings.other_distances if cameras else ():
        distances = {id: factor * max(required_image_size(c)) for id, c in cameras.items()}
        ratios = [cameras[id].parameters["fx"] / f for id, f in distances.items()]
        if any(max(r, 1 / r) > settings.distinct_ratio for r in ratios):
            yield _with_distances(network, distances)


def _with_distances(network: Network, distances: Mapping[str, float]) -> Network:
    """The network with principal distances of some cameras, also in their observations."""
    new = lambda c: {**c.parameters, "fx": distances[c.id], "fy": distances[c.id], "k1": 0.0}
    changed = lambda c: dataclasses.replace(c, parameters=new(c))
    network = network.replace(
        cameras=tuple(changed(c) if c.id in distances else c for c in network.cameras)
    )
    observed = observed_parameters(network)
    if observed is None:
        return network
    value, sigma = observed.value.copy(), observed.sigma.copy()
    for row, (id, name) in enumerate(zip(observed.camera, observed.parameter)):
        # The prior moves with the start value, with the same relative σ: else it would pull back.
        if id in distances and name == "fx":
            value[row], sigma[row] = distances[id], distances[id] * sigma[row] / value[row]
    return with_observed(network, dataclasses.replace(observed, value=value, sigma=sigma))


def is_plausible(
    result: Adjustment,
    stated: Mapping[str, float],
    settings: BlockStartSettings = BlockStartSettings(),
) -> bool:
    """Whether an adjustment converged to plausible principal distances.

    **Arguments:** `stated`: those of files or a calibration, by camera."""
    low, high, ratio = settings.min_distance, settings.max_distance, settings.stated_ratio

    def as_stated(camera: Camera, f: float) -> bool:
        return camera.id in stated and 1 / ratio < f / stated[camera.id] < ratio

    return bool(result.converged) and all(
        low < adjusted["fx"] / max(camera.image_size) < high or as_stated(camera, adjusted["fx"])
        for camera in result.network.cameras
        if camera.image_size and "fx" in (adjusted := _parameters(result, camera))
    )


def start_again(
    network: Network,
    oriented: Oriented,
    result: Adjustment,
    pairs: NamedPairs,
    settings: BlockStartSettings = BlockStartSettings(),
) -> Oriented | None:
    """Start values with the adjusted cameras, if these orient more photographs."""
    if not oriented.images_not_placed:
        return None
    better: Mapping[str, Camera] = {
        c.id: dataclasses.replace(c, parameters={**c.parameters, **_parameters(result, c)})
        for c in result.network.cameras
    }
    cameras = tuple(better.get(c.id, c) for c in network.cameras)
    try:
        distance = lambda camera: camera.parameters.get("fx", 1.0)
        ratios = [distance(c) / distance(new) for c, new in zip(network.cameras, cameras)]
        are_near = all(max(ratio, 1 / ratio) < settings.near_ratio for ratio in ratios)
        changed = network.replace(cameras=cameras)
        restarted = _orient(changed, settings.tolerance, pairs if are_near else {}, settings)
    except NotSolvedError:
        return None
    return restarted if len(restarted.images_not_placed) < len(oriented.images_not_placed) else None


def _parameters(result: Adjustment, camera: Camera) -> dict[str, float]:
    parameters = result.cameras[camera.id]["parameters"]
    return {name: float(parameter["value"]) for name, parameter in parameters.items()}
