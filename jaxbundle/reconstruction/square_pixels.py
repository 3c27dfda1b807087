"""Pixels that are not square: observed ratios fy/fx that the photographs contradict.

fy/fx of a camera is observed as 1 with a small σ (`camera_priors`). Errors of tie points are
correlated over a photograph (reflections, occlusions, light), so that the photographs alone
determine the ratio many times worse than its σ says: one camera in five sets of photographs had
ratios 4 to 8 σ apart. A contradiction is therefore believed only if it repeats itself: the
photographs are divided into two halves, each is adjusted alone without the observed ratio, and both
must deviate from 1 by more than chance explains, to the same side, and by more than they differ
from each other.
"""

import dataclasses
from collections.abc import Collection
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from jaxbundle.adjustment.adjust import adjust
from jaxbundle.adjustment.result import Adjustment
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.network.kinds import ObservationTable, Ties
from jaxbundle.network.subsets import keep_images, keep_points
from jaxbundle.network.tables import Images, Network
from jaxbundle.reconstruction.camera_priors import ASPECT, observed_parameters, with_observed

# Normalised deviation, 3.29, beyond which chance (one in a thousand, either sign) does not explain
# it.
CRITICAL_DEVIATION = NormalDist().inv_cdf(1 - 0.001 / 2)


class Ratio(NamedTuple):
    """fy/fx − 1 and its σ."""

    deviation: float
    sigma: float


def contradicted_ratios(result: Adjustment) -> dict[str, Ratio]:
    """By camera, the ratio of the photographs alone where it contradicts the observed one.

    With the adjusted deviation d, its cofactor q and the σ of the observation, the redundancy
    number is r = 1 − q/σ², the normalised residual d/(σ·√r), and without the observation the ratio
    would be d/r with cofactor q/r.
    """
    observed, contradicted = observed_parameters(result.problem.network), {}
    if observed is None:
        return {}
    columns = observed.camera, observed.parameter, observed.value.tolist(), observed.sigma.tolist()
    for id, name, value, sigma in zip(*columns):
        if name == ASPECT:
            d, q = _deviation(result, id, value)
            r = 1 - q / sigma**2
            if r > 0 and abs(d) > CRITICAL_DEVIATION * sigma * np.sqrt(r):
                contradicted[id] = Ratio(d / r, result.sigma0 * np.sqrt(q / r))
    return contradicted


def replicated_ratios(result: Adjustment) -> dict[str, tuple[Ratio, Ratio]]:
    """By camera, the ratios of two halves of the photographs, each adjusted alone; none if a half
    does not determine them."""
    network = _adjusted_network(result)
    network = release(network, [camera.id for camera in network.cameras])
    of_halves = []
    for half in _halves(network.images.camera):
        half_network = keep_images(network, half)
        rays = np.bincount(half_network.observations.point, minlength=len(half_network.points))
        half_network = keep_points(half_network, (rays > 1) | ~half_network.points.has_role("tie"))
        half_network = half_network.replace(datum_points=())
        # Three photographs leave the principal point of an unknown camera to its prior.
        if len(half_network.images) < 4:
            return {}
        # A half that does not determine its cameras confirms nothing.
        try:
            half_result = adjust(half_network)
        except (InputError, NotSolvedError):
            return {}
        if not half_result.converged:
            return {}
        cameras_used = {half_network.cameras[c].id for c in np.unique(half_network.images.camera)}
        ratios = {}
        for id in cameras_used:
            d, q = _deviation(half_result, id, 1.0)
            ratios[id] = Ratio(d, half_result.sigma0 * np.sqrt(q))
        of_halves.append(ratios)
    in_both = of_halves[0].keys() & of_halves[1].keys()
    return {id: (of_halves[0][id], of_halves[1][id]) for id in in_both}


def _halves(camera: Int[np.ndarray, " images"]) -> list[Bool[np.ndarray, " images"]]:
    """Every second photograph of each camera, and the others: both see the whole object, and with
    every camera."""
    by_camera = np.argsort(camera, kind="stable")
    is_second = np.zeros(len(camera), bool)
    is_second[by_camera[1::2]] = True
    return [~is_second, is_second]


def is_replicated(ratio_a: Ratio, ratio_b: Ratio) -> bool:
    """Whether two halves confirm each other that a ratio is not 1."""
    # The difference of the halves shows the correlated errors that their σ does not contain.
    difference = abs(ratio_a.deviation - ratio_b.deviation)
    are_clear = all(
        abs(r.deviation) > max(CRITICAL_DEVIATION * r.sigma, difference) for r in (ratio_a, ratio_b)
    )
    return are_clear and ratio_a.deviation * ratio_b.deviation > 0


def release(network: Network, cameras: Collection[str]) -> Network:
    """The network without the observed ratios of some cameras. Their fx is no longer that of
    photographs of the same lens in the other format."""
    observed = observed_parameters(network)
    if observed is None:
        return network
    names = [*zip(observed.camera, observed.parameter)]
    rows = [k for k, (id, name) in enumerate(names) if name != ASPECT or id not in cameras]
    ids = [observed.camera[k] for k in rows]
    further: list[ObservationTable] = []
    # Of a lens in portrait format fy lies along the other axis: fx of both are then two unknowns.
    for kind in network.further:
        if isinstance(kind, Ties):
            is_parted = _ties_focal_lengths(kind, cameras)
            for first, other in zip(kind.take(is_parted).camera, kind.take(is_parted).other):
                # What was observed of the first alone (`camera_priors`) is now observed of each.
                if (first, "fx") in names and (other, "fx") not in names:
                    rows, ids = [*rows, names.index((first, "fx"))], [*ids, other]
            kind = kind.take(~is_parted)
        further.append(kind)
    observed = dataclasses.replace(observed.take(np.array(rows, int)), camera=tuple(ids))
    return with_observed(network.replace(further=tuple(further)), observed)


def _ties_focal_lengths(ties: Ties, cameras: Collection[str]) -> Bool[np.ndarray, " ties"]:
    """Which rows make fx of one of these cameras equal to that of another."""
    columns = zip(ties.camera, ties.other, ties.parameter)
    is_parted = [name == "fx" and not {*cameras}.isdisjoint(pair) for *pair, name in columns]
    return np.array(is_parted, bool)


def _adjusted_network(result: Adjustment) -> Network:
    """The network with adjusted values as start values, without removed observations."""
    network, values = result.problem.network, result.image_values
    images, points, rays = network.images, network.points, network.observations
    is_used = result.problem.used
    tie = points.has_role("tie")[:, None]
    position = np.where(tie, result.point_values, points.position)
    cameras = tuple(
        dataclasses.replace(c, parameters=result.camera_parameters(c.id)) for c in network.cameras
    )
    is_observed = np.isfinite(images.sigma[:, :3])  # observed positions stay what was observed
    start = np.concatenate(
        [np.where(is_observed, images.position, values[:, :3]), values[:, 3:]], 1
    )
    images = Images(
        images.id, images.camera, start[:, :3], start[:, 3:], images.sigma, images.source
    )
    points = dataclasses.replace(points, position=position)
    rays = rays.take(is_used)
    network = network.replace(cameras=cameras, images=images, points=points, observations=rays)
    return keep_points(network, np.all(np.isfinite(position), axis=1))


def _deviation(result: Adjustment, camera: str, value: float) -> tuple[float, float]:
    """fy/fx minus a value, and its cofactor."""
    names, Q = result.camera_cofactor(camera)
    p = result.camera_parameters(camera)
    ratio = p["fy"] / p["fx"]
    # ∂(fy/fx)/∂(fx, fy) = (−fy/fx², 1/fx)
    slope = np.zeros(len(names))
    slope[names.index("fx")], slope[names.index("fy")] = -ratio / p["fx"], 1 / p["fx"]
    return ratio - value, float(slope @ Q @ slope)
