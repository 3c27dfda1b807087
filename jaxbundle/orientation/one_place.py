"""Images taken from one place: a rotation maps the rays of one to those of the other.

From one place only directions of points are determined, no depth. With the
unit rays u of points that two images share, R·u₁ = u₂ to the precision of the measurements; R by
Horn (1987), as in `absolute.py`.

A camera that moves sideways before a flat object shifts its image; a rotation by ρ shifts it too,
and distorts it by ρ³ with ρ = r/c of the field. If this is below the noise of the rays, nothing is
reported.
"""

import numpy as np

from jaxbundle.cameras import get_model
from jaxbundle.network.columns import list_some
from jaxbundle.network.tables import Network
from jaxbundle.orientation.sights import sights

FEWEST_COMMON = 5
"""Minimum common points: a rotation has 3 parameters, the points 10 coordinates."""
MOST_COMPARED = 200
"""Number of images compared with the one that has the most image points."""
NOISE = 3.0
"""Misclosures up to this number of σ are explained by the measurements."""


def name_one_place(network: Network) -> str:
    """Which images were taken from one place, in words; empty if they were not, or if there are
    images from other places."""
    seen = sights(network)
    number = np.bincount(seen.image, minlength=seen.images)
    base = int(number.argmax())
    others = [image for image in np.flatnonzero(number).tolist() if image != base][:MOST_COMPARED]
    c = np.array([camera.parameters[get_model(camera.model).principal_distance[0]]
                  for camera in network.cameras])  # fmt: skip
    of_camera = network.images.camera[seen.image]
    sigma = network.observations.sigma[seen.row] / c[of_camera, None]
    if not others or not all(_is_rotation(seen, sigma, base, image) for image in others):
        return ""
    names = [network.images.id[image] for image in sorted([base, *others])]
    return (
        f"images {list_some(names)} were taken from one place, as far as their measurements show: "
        "a rotation alone maps one to the other, and points have no depth; add images from other "
        "places"
    )


def _is_rotation(seen, sigma, one: int, other: int) -> bool:
    """Whether a rotation maps the rays of an image to those of another."""
    a, b = seen.of(one), seen.of(other)
    _, k, l = np.intersect1d(seen.point[a], seen.point[b], return_indices=True)
    if len(k) < FEWEST_COMMON:
        return False
    noise = np.sqrt((sigma[a][k] ** 2).sum(1) + (sigma[b][l] ** 2).sum(1))
    field = min(_field(seen.xy[a][k]), _field(seen.xy[b][l]))
    if field**3 < NOISE * np.median(noise):
        return False
    rays = []
    for rows, at in ((a, k), (b, l)):
        ray = np.pad(seen.xy[rows][at], ((0, 0), (0, 1)), constant_values=-1.0)
        rays.append(ray / np.linalg.norm(ray, axis=1, keepdims=True))
    U, _, V = np.linalg.svd(rays[0].T @ rays[1])
    turn = U @ np.diag([1, 1, np.linalg.det(U @ V)]) @ V
    off = np.linalg.norm(rays[0] @ turn - rays[1], axis=1)
    return bool(np.median(off / noise) < NOISE)


def _field(xy) -> float:
    """r/c about the centre of the points: half of them are within it."""
    return float(np.median(np.linalg.norm(xy - np.median(xy, axis=0), axis=1)))
