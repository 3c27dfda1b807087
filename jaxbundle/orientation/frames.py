"""Models brought into one frame: onto control and given positions, onto each other, or to scale."""

import numpy as np
from jaxtyping import Float

from jaxbundle.network.tables import Network
from jaxbundle.orientation import many
from jaxbundle.orientation.growth import Model, controlled
from jaxbundle.orientation.sights import Sights

APART = 3.0
"""Points that miss the similarity by more than so many times the median take no part in it."""
FEW = 6
"""So few points are all believed: none can be told from the others."""
ROUNDS = 3


def onto_the_given(network: Network, model: Model) -> tuple[Model, str]:
    """The model in the frame of control points and of images whose position is given; without
    three of them, to the scale of the distances, in a frame of its own. And which, in words."""
    points, images = network.points, network.images
    control = controlled(points) & model.known
    stations = model.placed & np.isfinite(images.position).all(1)
    source = np.concatenate([model.X[control], model.X0[stations]])
    target = np.concatenate([points.position[control], images.position[stations]])
    found = similarity(source, target)
    if found is not None:
        return model.moved(*found), "in the frame of control"
    approximate = np.isfinite(points.position).all(1) & model.known & ~points.has_role("check")
    found = similarity(model.X[approximate], points.position[approximate])
    if found is not None:
        return model.moved(*found), "in the frame of the points given"
    scale = scale_of_distances(network, model)
    if scale is not None:
        return model.moved(scale * np.eye(3), np.zeros(3)), "to scale, in a frame of its own"
    return model, "in a frame and a scale of its own"


def scale_of_distances(network: Network, model: Model) -> float | None:
    """The median of measured distances by those in the model."""
    distances = network.distances
    there = model.known[distances.points].all(1) if len(distances) else np.zeros(0, bool)
    if not there.any():
        return None
    a, b = model.X[distances.points[there]].transpose(1, 0, 2)
    return float(np.median(distances.value[there] / np.linalg.norm(a - b, axis=1)))


def join(sights: Sights, model: Model, part: Model) -> bool:
    """Take a second model over into the first; whether something connects them.

    The similarity is that of the points both know, or, where they have an image in common, the one
    of its pose and of the distances to the points it sees."""
    both = model.known & part.known
    if not both.any():
        return False
    shared = np.flatnonzero(model.placed & part.placed)
    if len(shared):
        seen = np.bincount(sights.image, both[sights.point], minlength=sights.images)
        image = shared[seen[shared].argmax()]
        found = _by_an_image(model, part, image, both)
    else:
        found = similarity(part.X[both], model.X[both])
    if found is None:
        return False
    part = part.moved(*found)
    new = part.placed & ~model.placed
    model.place(new, part.X0[new], part.M[new])
    new = part.known & ~model.known
    model.X[new], model.known[new] = part.X[new], True
    return True


def _by_an_image(model, part, image, both):
    to, off = (np.linalg.norm(m.X[both] - m.X0[image], axis=1) for m in (model, part))
    A = np.median(to / off) * model.M[image].T @ part.M[image]
    return A, model.X0[image] - A @ part.X0[image]


def similarity(source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "n 3"]):
    """A and t of X' = A·X + t with the points that agree; None: fewer than three, or on a line."""
    good = np.ones(len(source), bool)
    for _ in range(ROUNDS):
        found = many.similarity(source, target, good.astype(float)) if good.sum() >= 3 else None
        if found is None or len(source) < FEW:
            return found
        A, t = found
        off = np.linalg.norm(source @ A.T + t - target, axis=1)
        good = off <= APART * np.median(off) + 1e-9 * np.ptp(target, axis=0).max()
    return found
