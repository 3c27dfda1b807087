"""The second solutions that a network may have, in closed form from its first one.

S(a) = 1 − 2·a·aᵀ reflects on the plane with the unit normal a. A point c of the object is seen by
an image with the centre X0 and the rotation M in the direction u = M·(c − X0)/|M·(c − X0)|.

**Turned over** (one image of a plane; Oberkampf, DeMenthon and Davis, 1996; Schweighofer and Pinz,
2006). Under weak perspective the image of a plane with the normal m is the same after the normal is
reflected about the line of sight:

    M' = S(u)·M·S(m),        X0' = c − M'ᵀ·M·(c − X0)                                        (1)

**Reversed in depth** (all images; Ullman, 1979; Koenderink and van Doorn, 1991). The same for the
whole object, reflected on a plane with any normal n through o: all choices differ by a rotation:

    X' = o + S(n)·(X − o),        (1) with n for m, and X0' about c'                         (2)

**Mirrored** (all images). The collinearity equations do not see the sign of q, so that every
network fits just as well mirrored, with its points behind the cameras; if it is mirrored on the
plane in which its control lies, control fits too: the images look away from their points, from
below the floor.

    X' = o + S(n)·(X − o),        X0' = o + S(n)·(X0 − o),        M' = −M·S(n)               (3)

**The other plane** (two images or more of a plane): `orientation.planar`; of images that nearly
coincide the normal of the plane and the direction of the base are exchanged (Longuet-Higgins,
1986).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbundle.adjustment.problem import NetworkProblem, coordinates
from jaxbundle.cameras import get_model
from jaxbundle.geometry.principal_axes import principal_axes
from jaxbundle.leastsquares.indexing.rows import Values
from jaxbundle.orientation.batched import matrices_of_quaternions


class NetworkScene(NamedTuple):
    """Poses and points, relative to the origin of the problem."""

    X0: Float[np.ndarray, "images 3"]
    M: Float[np.ndarray, "images 3 3"]
    X: Float[np.ndarray, "points 3"]


class ImageRays(NamedTuple):
    """The image points that take part: image, object point, a priori σ of the direction in
    radians."""

    image: Int[np.ndarray, " rays"]
    point: Int[np.ndarray, " rays"]
    sigma: Float[np.ndarray, " rays"]


class OtherSolution(NamedTuple):
    """Another solution to start from, and the images that differ."""

    ambiguity: str
    images: Int[np.ndarray, " n"]
    scene: NetworkScene


def scene_of(values: Values) -> NetworkScene:
    """The poses and points of values of a problem."""
    position, rotation = (np.asarray(part) for part in values["image"])
    return NetworkScene(
        position, matrices_of_quaternions(rotation), np.asarray(coordinates(values))
    )


def rays_of(problem: NetworkProblem) -> ImageRays:
    """The image points that take part in an adjustment."""
    is_used, network = problem.used, problem.network
    c = [
        min((abs(camera.parameters[n]) for n in names), default=1.0)
        for camera in network.cameras
        for names in [get_model(camera.model).principal_distance]
    ]
    # σ of the better coordinate: effects that are compared with it must not look too small.
    weight = problem.image_weights.max(1)[is_used] * np.array(c)[problem.camera[is_used]]
    return ImageRays(problem.image[is_used], problem.point[is_used], 1 / weight)


def sample(rays: ImageRays, images: int, max_rays: int) -> ImageRays:
    """At most `max_rays` rays of every image, evenly, with the weight of all of them: sums over an
    image stay about the same, in a time that does not grow with its points."""
    order = np.argsort(rays.image, kind="stable")
    number = np.bincount(rays.image, minlength=images)
    first_place = np.cumsum(number) - number
    place = np.arange(len(order)) - first_place[rays.image[order]]
    total = number[rays.image[order]]
    # Those at which place·most/total passes an integer.
    is_chosen = (place * max_rays) // total != ((place - 1) * max_rays) // total
    kept_rays = order[is_chosen | (total <= max_rays)]
    weight = number / np.maximum(np.bincount(rays.image[kept_rays], minlength=images), 1)
    image = rays.image[kept_rays]
    return ImageRays(image, rays.point[kept_rays], rays.sigma[kept_rays] / np.sqrt(weight[image]))


def turn_over(scene: NetworkScene, rays: ImageRays) -> NetworkScene:
    """Equation (1) for every image, the plane fitted to the points that it sees."""
    c, normal = _planes(scene, rays)
    return NetworkScene(*_reflect_poses(scene, normal, c, c), scene.X)


def reverse_depth(
    scene: NetworkScene, rays: ImageRays, is_known: Bool[np.ndarray, " points"] | None = None
) -> NetworkScene:
    """Equation (2); the known points stay. The plane is theirs if they have one, otherwise it
    is across the mean line of sight, so that the images stay about where they are."""
    is_known = np.zeros(len(scene.X), bool) if is_known is None else is_known
    normal, o = plane_of_known(scene, is_known)
    c = _means(scene.X, rays, len(scene.X0))
    if normal is None:
        sight = np.nan_to_num(unit(c - scene.X0)).sum(0)
        normal, o = unit(sight), o if is_known.any() else scene.X[np.unique(rays.point)].mean(0)
    X = np.where(is_known[:, None], scene.X, _reflect(scene.X, normal, o))
    centre_after = _means(X, rays, len(scene.X0))
    return NetworkScene(*_reflect_poses(scene, np.tile(normal, (len(c), 1)), c, centre_after), X)


def mirror(scene: NetworkScene, is_known: Bool[np.ndarray, " points"]) -> NetworkScene:
    """Equation (3) on the plane of the known points, or without one on any."""
    normal, o = plane_of_known(scene, is_known)
    normal = np.array([0.0, 0.0, 1.0]) if normal is None else normal
    X = np.where(is_known[:, None], scene.X, _reflect(scene.X, normal, o))
    return NetworkScene(_reflect(scene.X0, normal, o), -scene.M @ _reflection(normal), X)


def mirror_images(
    scene: NetworkScene, rays: ImageRays, images: Bool[np.ndarray, " images"]
) -> NetworkScene:
    """Equation (3) for some images only, each on the plane fitted to the points that it sees, which
    stay."""
    c, normal = _planes(scene, rays)
    X0 = scene.X0 - 2 * ((scene.X0 - c) * normal).sum(1, keepdims=True) * normal
    M, is_chosen = -scene.M @ _reflection(normal), images[:, None]
    return NetworkScene(
        np.where(is_chosen, X0, scene.X0), np.where(is_chosen[:, None], M, scene.M), scene.X
    )


def plane_of_known(
    scene: NetworkScene, is_known: Bool[np.ndarray, " points"]
) -> tuple[Float[np.ndarray, "3"] | None, Float[np.ndarray, "3"]]:
    """Normal and a point of the plane of the known points; no normal of fewer than three."""
    X = scene.X[is_known]
    if not len(X):
        return None, np.zeros(3)
    o = X.mean(0)
    return (principal_axes(X - o)[1][2] if len(X) >= 3 else None), o


def share_behind(scene: NetworkScene, rays: ImageRays) -> Float[np.ndarray, " images"]:
    """The share of the points of every image that are behind it (q > 0)."""
    q = np.einsum("ni,ni->n", scene.M[rays.image, 2], scene.X[rays.point] - scene.X0[rays.image])
    number = np.bincount(rays.image, minlength=len(scene.X0))
    return np.bincount(rays.image, q > 0, len(scene.X0)) / np.maximum(number, 1)


def perspective_effect(
    scene: NetworkScene, other_scene: NetworkScene, rays: ImageRays
) -> Float[np.ndarray, " images"]:
    """Σ(δ/σ)² of every image, δ: what distinguishes another solution beside shift, scale and roll.

    The directions of both solutions to their points are compared in the plane across the mean line
    of sight, after the similarity that fits them best: what is left is the effect of perspective,
    which no pose of the second solution can hide but by turning back to the first one."""
    images = len(scene.X0)
    z, w = (_in_tangent_plane(s, rays, images) for s in (scene, other_scene))
    p = 1 / rays.sigma**2
    total = lambda value: np.bincount(rays.image, value, images)
    complex_total = lambda value: total(value.real) + 1j * total(value.imag)
    weight = np.where(total(p) > 0, total(p), 1.0)
    z = z - (complex_total(p * z) / weight)[rays.image]
    w = w - (complex_total(p * w) / weight)[rays.image]
    # w ≈ b·z, b a complex number: scale and roll.
    square = total(p * abs(z) ** 2)
    b = complex_total(p * w * z.conj()) / np.where(square > 0, square, 1.0)
    return total(p * abs(w - b[rays.image] * z) ** 2)


def _in_tangent_plane(scene: NetworkScene, rays: ImageRays, images: int) -> np.ndarray:
    """Directions to the points as complex numbers x + iy, c = 1, in a camera turned towards their
    mean; those more than 80° off it are divided by cos 80°, so that they stay finite."""
    d = np.einsum(
        "nij,nj->ni", scene.M[rays.image], unit(scene.X[rays.point] - scene.X0[rays.image])
    )
    axis = unit(np.stack([np.bincount(rays.image, x, images) for x in np.nan_to_num(d).T], 1))
    # Any rotation that takes the axis to −z, the same for neighbouring axes: the shortest one.
    # Of the axis +z itself, points behind the image, there are many: f only stays finite.
    a, b, c = np.nan_to_num(axis).T
    f = 1 / np.maximum(1 - c, 1e-9)
    axis_x = np.stack([1 - a * a * f, -a * b * f, a], 1)
    axis_y = np.stack([-a * b * f, 1 - b * b * f, b], 1)
    depth = np.maximum((axis[rays.image] * d).sum(1), np.cos(np.deg2rad(80)))
    x, y = ((basis[rays.image] * d).sum(1) / depth for basis in (axis_x, axis_y))
    return np.nan_to_num(x) + 1j * np.nan_to_num(y)


def _planes(
    scene: NetworkScene, rays: ImageRays
) -> tuple[Float[np.ndarray, "images 3"], Float[np.ndarray, "images 3"]]:
    """A point and the normal of the plane fitted to the points of every image."""
    c = _means(scene.X, rays, len(scene.X0))
    centred = scene.X[rays.point] - c[rays.image]
    columns = (centred[:, :, None] * centred[:, None, :]).reshape(-1, 9).T
    scatter = np.stack([np.bincount(rays.image, x, len(scene.X0)) for x in columns], 1)
    scatter = scatter.reshape(-1, 3, 3)
    return c, np.linalg.eigh(scatter)[1][:, :, 0]


def _reflect_poses(
    scene: NetworkScene,
    normal: Float[np.ndarray, "images 3"],
    c: Float[np.ndarray, "images 3"],
    centres_after: Float[np.ndarray, "images 3"],
) -> tuple[Float[np.ndarray, "images 3"], Float[np.ndarray, "images 3 3"]]:
    """Equation (1) about the centres `c` of the points, which afterwards are at `centres_after`."""
    local = np.einsum("nij,nj->ni", scene.M, c - scene.X0)
    M = _reflection(unit(local)) @ scene.M @ _reflection(normal)
    return centres_after - np.einsum("nji,nj->ni", M, local), M


def _reflection(a: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3 3"]:
    return np.eye(3) - 2 * a[..., :, None] * a[..., None, :]


def _reflect(
    X: Float[np.ndarray, "n 3"], normal: Float[np.ndarray, "3"], o: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "n 3"]:
    return o + (X - o) @ _reflection(normal)


def _means(X: Float[np.ndarray, "points 3"], rays: ImageRays, images: int) -> np.ndarray:
    """The mean of the points that every image sees."""
    sums = np.stack([np.bincount(rays.image, x, images) for x in X[rays.point].T], 1)
    return sums / np.maximum(np.bincount(rays.image, minlength=images), 1)[:, None]


def unit(v: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    with np.errstate(invalid="ignore", divide="ignore"):
        return v / np.linalg.norm(v, axis=-1, keepdims=True)


def turns(scene_a: NetworkScene, scene_b: NetworkScene) -> Float[np.ndarray, " images"]:
    """The angle between both rotations of every image, radians."""
    return angles(scene_a.M @ scene_b.M.transpose(0, 2, 1))


def angles(M: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, " n"]:
    """The angles of rotations, radians."""
    return np.linalg.norm(rotation_vectors(M), axis=1)


def rotation_vectors(M: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n 3"]:
    """δθ of M = exp([δθ]×); of half a turn, which has no axis here, any axis."""
    v = np.stack([M[:, 2, 1] - M[:, 1, 2], M[:, 0, 2] - M[:, 2, 0], M[:, 1, 0] - M[:, 0, 1]], 1) / 2
    sine = np.linalg.norm(v, axis=1)
    angle = np.arctan2(sine, (np.trace(M, axis1=1, axis2=2) - 1) / 2)
    axis = np.where(sine[:, None] > 1e-12, v / np.maximum(sine, 1e-12)[:, None], [1.0, 0.0, 0.0])
    return angle[:, None] * axis
