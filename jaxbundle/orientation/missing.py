"""Why images and points have no start values, and notes of what is left out for it."""

from collections.abc import Collection, Mapping

import numpy as np
from jaxtyping import Bool

from jaxbundle.network.columns import count, list_some
from jaxbundle.network.tables import LeftOut, Network
from jaxbundle.orientation.incremental import (
    Model,
)
from jaxbundle.orientation.rays import Sights
from jaxbundle.orientation.settings import DEFAULTS, StartValueSettings


def note_missing(
    network: Network,
    noun: str,
    reasons: Mapping[str, str],
    clause: str,
    undetermined: Collection[str] = (),
) -> Network:
    """The network with notes that images or points were left out, by name with the reasons;
    `undetermined`: those that no start values would make determinable
    (`name_undetermined_points`)."""
    if not reasons:
        return network
    names = list_some((f"{id} ({why})" for id, why in reasons.items()), 5, str)
    groups: dict[tuple[str, bool], list[str]] = {}
    for id, why in reasons.items():
        groups.setdefault((why, id not in undetermined), []).append(id)
    network = network.note(f"left out {count(len(reasons), noun)} {clause}: {names}")
    notes = (
        LeftOut(noun, tuple(ids), f"{clause}: {why}", measured)
        for (why, measured), ids in groups.items()
    )
    return network.replace(left_out=(*network.left_out, *notes))


def explain_missing(
    network: Network,
    sights: Sights,
    model: Model,
    is_known: Bool[np.ndarray, " points"],
    settings: StartValueSettings = DEFAULTS,
) -> tuple[dict[str, str], dict[str, str]]:
    """By id, why images are not placed, and why points are not known (`is_known`)."""
    rays = np.bincount(sights.image, minlength=sights.images)
    of_known = np.bincount(sights.image, model.known[sights.point], minlength=sights.images).astype(
        int
    )
    images = {}
    for image in np.flatnonzero(~model.placed):
        if of_known[image] < settings.min_points:
            why = (
                f"it sees {of_known[image]} known points of {rays[image]}; "
                f"{settings.min_points} are needed"
            )
        else:
            why = (
                f"fewer than {settings.agreeing_share:.0%} of the {of_known[image]} known "
                "points it sees agree on a pose: look for wrong point numbers, or a wrong "
                "principal distance"
            )
        images[network.images.id[image]] = why
    placed = model.placed[sights.image]
    by_point = np.bincount(sights.point[placed], minlength=sights.points)
    lacks_ray = np.ones(len(network.observations), bool)
    lacks_ray[sights.row] = False
    no_ray = np.bincount(network.observations.point[lacks_ray], minlength=sights.points)
    points = {}
    for point in np.flatnonzero(~is_known):
        if by_point[point] < 2 and no_ray[point]:
            number = count(no_ray[point], "image point")
            why = f"{number} of it outside the range of the camera model, where there are no rays"
        elif by_point[point] < 2:
            why = f"seen in {count(by_point[point], 'placed image')}; 2 are needed"
        else:
            why = f"its {by_point[point]} rays do not intersect, or are parallel"
        points[network.points.id[point]] = why
    return images, points
