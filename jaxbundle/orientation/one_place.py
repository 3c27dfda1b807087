"""Images taken from one place: a rotation maps the rays of one to those of the other.

From one place only directions of points are determined, no depth. With the
unit rays u of points that two images share, R·u₁ = u₂ to the precision of the measurements; R by
Horn (1987), as in `absolute.py`.

A camera that moves sideways before a flat object shifts its image; a rotation by ρ shifts it too,
and distorts it by ρ³ with ρ = r/c of the field. If this is below the noise of the rays, nothing is
reported.
"""

import numpy as np
from jaxtyping import Float

from jaxbundle.network.columns import list_some
from jaxbundle.network.tables import Network
from jaxbundle.orientation.rays import Sights, make_sights

# Misclosures up to this number of σ are explained by the measurements. Medians of points are
# compared with it, which are 0.83 for good σ (Rayleigh distribution): σ of image points may be
# stated too small by a factor of 3.6.
MAX_SIGMA_RATIO = 3.0


def name_one_place(network: Network) -> str:
    """Which images were taken from one place, in words; empty if they were not, or if there are
    images from other places."""
    sights = make_sights(network)
    number = np.bincount(sights.image, minlength=sights.images)
    base = int(number.argmax())
    other_images = [image for image in np.flatnonzero(number).tolist() if image != base]
    # Two hundred images that differ from the first by a rotation only are from one place, however
    # many follow; the message counts all images.
    tested_images = other_images[:200]
    if not tested_images or not all(_is_rotation(sights, base, image) for image in tested_images):
        return ""
    names = [network.images.id[image] for image in sorted([base, *other_images])]
    return (
        f"images {list_some(names)} were taken from one place, as far as their measurements show: "
        "a rotation alone maps one to the other, and points have no depth; add images from other "
        "places"
    )


def _is_rotation(sights: Sights, first_image: int, second_image: int) -> bool:
    """Whether a rotation maps the rays of an image to those of another."""
    a, b = sights.rows_of(first_image), sights.rows_of(second_image)
    _, k, l = np.intersect1d(sights.point[a], sights.point[b], return_indices=True)
    if len(k) < 5:  # a rotation has 3 parameters, five points 10 coordinates
        return False
    noise = np.sqrt(2 * (sights.sigma[a][k] ** 2 + sights.sigma[b][l] ** 2))
    rays = [sights.ray[a][k], sights.ray[b][l]]
    if min(map(_field_angle, rays)) ** 3 < MAX_SIGMA_RATIO * np.median(noise):
        return False
    U, _, V = np.linalg.svd(rays[0].T @ rays[1])
    turn = U @ np.diag([1, 1, np.linalg.det(U @ V)]) @ V
    distances = np.linalg.norm(rays[0] @ turn - rays[1], axis=1)
    return bool(np.median(distances / noise) < MAX_SIGMA_RATIO)


def _field_angle(rays: Float[np.ndarray, "n 3"]) -> float:
    """The angle about the centre of the rays, radians: half of them are within it."""
    return float(np.median(np.linalg.norm(rays - np.median(rays, axis=0), axis=1)))
