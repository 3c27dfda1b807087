"""Synthetic problems in the BAL format: Snavely cameras, noise of half a pixel, disturbed starts.

    python benchmarks/scenes.py street|arc IMAGES POINTS SEED OUT

`street`: a drive past façades, every point seen from a few places in a row (a banded system);
`arc`: images around one scene, where almost any two have points in common (a full one). The file
is read by `bal.py` and by any program that reads BAL problems.
"""

import bz2
import gzip
import shutil
import sys
from pathlib import Path

import machine
import numpy as np

HALF_FORMAT = 700.0
NOISE = 0.5


def street(images: int, points: int, seed: int = 0):
    """Images every metre along a street, looking forward to either side."""
    rng = np.random.default_rng(seed)
    side = rng.choice([-1, 1], points)
    X = np.c_[rng.uniform(0, images + 8, points), side * rng.uniform(5, 12, points),
              rng.uniform(0, 10, points)]  # fmt: skip
    centre = np.c_[np.arange(images), 0.2 * rng.normal(size=images), np.full(images, 2.0)]
    target = centre + np.c_[np.full(images, 8.0), rng.choice([-6, 6, 0], images),
                            np.full(images, 2.0)]  # fmt: skip
    seen = []
    for first in range(0, images, 200):
        some = np.arange(first, min(first + 200, images))
        near = np.flatnonzero((X[:, 0] > first - 5) & (X[:, 0] < first + 230))
        ahead = X[near, 0] - some[:, None]
        i, p = np.nonzero((ahead > -2) & (ahead < 26))
        seen.append((some[i], near[p]))
    return _problem(rng, X, centre, target, *map(np.concatenate, zip(*seen)), 0.2)


def arc(images: int, points: int, seed: int = 0):
    """Images on an arc around a relief."""
    rng = np.random.default_rng(seed)
    X = np.c_[rng.uniform(-20, 20, points), 1.5 * rng.normal(size=points),
              rng.uniform(0, 15, points)]  # fmt: skip
    angle = np.sort(rng.uniform(0.25, np.pi - 0.25, images))
    reach = 30 * rng.uniform(0.7, 1.1, images)
    centre = np.c_[reach * np.cos(angle), reach * np.sin(angle), rng.uniform(1, 10, images)]
    target = np.c_[rng.uniform(-12, 12, images), np.zeros(images), rng.uniform(5, 10, images)]
    point = np.repeat(np.arange(points), 12)
    return _problem(rng, X, centre, target, rng.integers(0, images, len(point)), point, 1.0)


def _problem(rng, X, centre, target, image, point, disturbance):
    """Cameras [n, 9], points, image and point of every observation, coordinates."""
    M = _looking(centre, target)
    cameras = np.c_[rotation_vectors(M), -np.einsum("nij,nj->ni", M, centre),
                    rng.uniform(700, 1100, len(M)), 0.01 * rng.normal(size=len(M)),
                    0.005 * rng.normal(size=len(M))]  # fmt: skip
    xy, in_front = _project(cameras, M, X, image, point)
    keep = in_front & (np.abs(xy).max(1) < HALF_FORMAT)
    # At most as many rays as a point usually has.
    order = rng.permutation(np.flatnonzero(keep))
    order = order[np.argsort(point[order], kind="stable")]
    first = np.searchsorted(point[order], point[order])
    most = 2 + rng.geometric(0.3, len(X))
    order = order[np.arange(len(order)) - first < most[point[order]]]
    pairs = np.unique(np.stack([point[order], image[order]], 1), axis=0, return_index=True)[1]
    order = order[pairs]
    rays = np.bincount(point[order], minlength=len(X))
    order = order[rays[point[order]] >= 2]
    used, number = np.unique(point[order], return_inverse=True)
    seen, image_number = np.unique(image[order], return_inverse=True)
    start = cameras[seen].copy()
    start[:, :3] += disturbance * 2e-3 * rng.normal(size=(len(seen), 3))
    moved = centre[seen] + disturbance * 0.03 * rng.normal(size=(len(seen), 3))
    start[:, 3:6] = -np.einsum("nij,nj->ni", matrices(start[:, :3]), moved)
    start[:, 6] *= 1 + 0.01 * rng.normal(size=len(seen))
    start[:, 7:] = 0
    noisy = xy[order] + NOISE * rng.normal(size=(len(order), 2))
    near = X[used] + disturbance * 0.05 * rng.normal(size=(len(used), 3))
    return start, near, image_number, number, noisy


def _looking(centre, target):
    """Rotations object → camera of images that look from a centre at a target, z up."""
    back = centre - target
    back /= np.linalg.norm(back, axis=1, keepdims=True)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return np.stack([right, np.cross(back, right), back], 1)


def rotation_vectors(M):
    """Rotation vectors of rotation matrices."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(M).as_rotvec()


def matrices(vectors):
    """Rotation matrices of rotation vectors."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(vectors).as_matrix()


def _project(cameras, M, X, image, point):
    """Image coordinates, and whether the point is in front of the camera."""
    xy, front = np.empty((len(image), 2)), np.empty(len(image), bool)
    for rows in np.array_split(np.arange(len(image)), max(1, len(image) // 1_000_000)):
        camera = cameras[image[rows]]
        ray = np.einsum("nij,nj->ni", M[image[rows]], X[point[rows]]) + camera[:, 3:6]
        p = -ray[:, :2] / ray[:, 2:]
        rho2 = (p**2).sum(1)
        xy[rows] = p * (camera[:, 6] * (1 + rho2 * (camera[:, 7] + rho2 * camera[:, 8])))[:, None]
        front[rows] = ray[:, 2] < -2
    return xy, front


def write_bal(path: Path, cameras, points, image, point, xy) -> None:
    """A file in the BAL format."""
    with open(path, "w", encoding="ascii") as file:
        file.write(f"{len(cameras)} {len(points)} {len(image)}\n")
        np.savetxt(file, np.c_[image, point, xy], fmt="%d %d %.6e %.6e")
        np.savetxt(file, np.concatenate([cameras.ravel(), points.ravel()]), fmt="%.16e")


def read_bal(path: str | Path):
    """The contents written by `write_bal`, in its order."""
    with open(path, encoding="ascii") as file:
        images, points, rays = map(int, file.readline().split())
        numbers = np.array(file.read().split(), float)
    rays, cameras, X = np.split(numbers, [4 * rays, 4 * rays + 9 * images])
    image, point, x, y = rays.reshape(-1, 4).T
    index = image.astype(int), point.astype(int)
    return cameras.reshape(-1, 9), X.reshape(-1, 3), *index, np.stack([x, y], 1)


def half_square(cameras, points, image, point, xy) -> float:
    """½Σv² of a problem, in pixels²."""
    computed, _ = _project(cameras, matrices(cameras[:, :3]), points, image, point)
    return 0.5 * float(np.square(computed - xy).sum())


def unpack(path: Path, folder: Path) -> Path:
    """The file itself, or its unpacked copy in the folder."""
    opener = {".gz": gzip.open, ".bz2": bz2.open}.get(path.suffix.lower())
    if opener is None:
        return path
    copy = folder / path.stem
    with opener(path, "rb") as packed, open(copy, "wb") as plain:
        shutil.copyfileobj(packed, plain)
    return copy


def main() -> None:
    parser = machine.parser_of(__doc__)
    parser.add_argument("kind", choices=("street", "arc"))
    parser.add_argument("images", type=machine.positive)
    parser.add_argument("points", type=machine.positive)
    parser.add_argument("seed", type=int)
    parser.add_argument("out", type=Path)
    given = parser.parse_args()
    scene = {"street": street, "arc": arc}[given.kind]
    try:
        whole = scene(given.images, given.points, given.seed)
    except (ValueError, IndexError):  # Of empty arrays.
        whole = ((),)
    if not len(whole[0]):
        sys.exit("so few images and points have no rays")
    write_bal(given.out, *whole)


if __name__ == "__main__":
    main()
