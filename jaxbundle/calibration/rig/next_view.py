r"""The next photograph of a board that would determine a mounting best.

Places of the board before the camera of this mounting are tried; with one, photographed by all
cameras that see it, the covariance of mountings and interior orientations, C, becomes

    C' = C − C·Aᵀ·(1 + A·C·Aᵀ)⁻¹·A·C        A = (1 − J_p·(J_pᵀ·J_p)⁻¹·J_pᵀ)·J/σ

with J the derivatives of the image points by these unknowns and J_p those by the pose of the board,
which is unknown. The best is that with the least σ of the base of the camera, in its weakest
direction (E-optimal; Fraser 1984, Network design considerations for non-topographic photogrammetry,
Photogrammetric Engineering and Remote Sensing 50).
"""

import dataclasses
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxbundle.calibration.rig.motion import transformation
from jaxbundle.cameras import CameraModel, get_model, image_ray, project
from jaxbundle.cameras.pixel_frame import in_model_units, in_pixels
from jaxbundle.geometry import matrix_from_rotation_vector, quaternion_from_matrix
from jaxbundle.leastsquares import Pose, PoseValue
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray, not_none

if TYPE_CHECKING:
    from jaxbundle.calibration.rig.result import RigCalibration


@dataclasses.dataclass(frozen=True)
class NextViewSettings:
    """Which places of a board are tried.

    **Fields:**

    - `number` of them, and the `seed` of their random numbers. Of twice as many the best is better
      by a few per cent.
    - `max_tilt`: degrees; beyond, corners are no longer found well.
    - `min_part`: of the points of the board in an image, to count as seen.
    """

    number: int = 120
    seed: int = 0
    max_tilt: float = 45.0
    min_part: float = 0.5


NEXT_VIEW = NextViewSettings()


class NextView(NamedTuple):
    """A place of a board: the `camera` whose mounting it is for; the `board`; the `pixel` of its
    middle in this camera; its `distance` from it (object unit); `tilt` and `roll` (degrees);
    `seen_by`: cameras; the σ of the base in its weakest direction, `before` and `after`; `pose`
    [4, 4]: from the board, relative to its middle, to the reference camera."""

    camera: str
    board: str
    pixel: tuple[float, float]
    distance: float
    tilt: float
    roll: float
    seen_by: tuple[str, ...]
    before: float
    after: float
    pose: Float[np.ndarray, "4 4"]


@compile_once
def _images(
    model: CameraModel,
    p: Float[AnyArray, " parameters"],
    mounting: PoseValue,
    poses: PoseValue,
    points: Float[AnyArray, "points 3"],
) -> tuple[Float[Array, "n points 2"], Float[Array, "n points 2 k"], Float[Array, "n points"]]:
    """Image points of a board at several poses relative to the reference camera; their derivatives
    by (δb, δθ), the pose and the parameters; and the coordinates along the lines of sight."""
    space = Pose()

    def image_of_point(pose: PoseValue, X: Array) -> tuple[Array, Array, Array]:
        prepared_pose, mounted = space.prepare(pose), space.prepare(mounting)

        def image(change: Array, p: Array) -> Array:
            Y = space.move(prepared_pose, tuple(change[6:])).ray(tuple(X))
            ray = space.move(mounted, tuple(change[:6])).ray(Y)
            return jnp.stack(project(model, tuple(p), *ray))

        zero = jnp.zeros(2 * space.width)
        J = jnp.concatenate(jax.jacfwd(image, (0, 1))(zero, jnp.asarray(p)), 1)
        return (
            image(zero, jnp.asarray(p)),
            J,
            jnp.asarray(mounted.ray(prepared_pose.ray(tuple(X)))[2]),
        )

    return jax.vmap(lambda pose: jax.vmap(lambda X: image_of_point(pose, X))(points))(poses)


def next_view(
    rig: "RigCalibration", camera: str, settings: NextViewSettings = NEXT_VIEW
) -> NextView | None:
    """The place of a board that would determine the mounting of a camera best; None if no board
    that moves by itself can be seen by it and another one, for the reference, and where cameras
    are not synchronised."""
    declared_rig = rig.rig
    single_boards = [
        b
        for b, reference_board in enumerate(declared_rig.body)
        if declared_rig.body.count(reference_board) == 1
    ]
    if declared_rig.wand is not None:
        single_boards = single_boards[:-1]
    if declared_rig.trajectory is not None or not single_boards or camera not in rig.mountings:
        return None
    points_seen = np.bincount(
        declared_rig.board_of_points[declared_rig.point], minlength=len(declared_rig.boards)
    )
    # One board, or the trials would be multiplied: that with most image points.
    board = max(single_boards, key=lambda b: points_seen[b])
    points = rig.values("point")[declared_rig.board_of_points == board]
    poses, facts = _places(rig, camera, settings)
    names = list(rig.names)
    C, widths = rig.covariance(*names), [6 + _width(rig, name) for name in names]
    starts = np.cumsum([0, *widths])
    rows, visible = [], []
    for name, start in zip(names, starts):
        J, J_pose, is_visible = _whitened(rig, name, poses, points, settings)
        wide = np.zeros((*J.shape[:-1], len(C)))
        wide[..., start : start + J.shape[-1]] = J
        rows.append((wide, J_pose))
        visible.append(is_visible)
    J, J_pose = (np.concatenate(parts, axis=1) for parts in zip(*rows))
    is_visible = np.array(visible)
    base_columns = starts[names.index(camera)] + np.arange(3)
    sigma_before = float(np.sqrt(np.linalg.eigvalsh(C[np.ix_(base_columns, base_columns)])[-1]))
    best = None
    # Seen by this camera alone, the unknown pose takes all that it says on the mounting.
    for n in np.flatnonzero(is_visible[names.index(camera)] & (is_visible.sum(0) > 1)):
        sigma_after = _sigma_with(C, J[n], J_pose[n], base_columns)
        if best is None or sigma_after < best.after:
            pixel, distance, tilt, roll, pose = facts[n]
            cameras_that_see = tuple(name for name, sees in zip(names, is_visible[:, n]) if sees)
            best = NextView(
                camera,
                declared_rig.boards[board],
                pixel,
                distance,
                tilt,
                roll,
                cameras_that_see,
                sigma_before,
                sigma_after,
                pose,
            )
    return best


def _width(rig: "RigCalibration", name: str) -> int:
    return rig.result.problem.table(rig.rig.row_of(rig.names.index(name))[0]).space.width


def _sigma_with(
    C: Float[np.ndarray, "k k"],
    J: Float[np.ndarray, "n k"],
    J_pose: Float[np.ndarray, "n 6"],
    base_columns: np.ndarray,
) -> float:
    """σ of the base in its weakest direction with one more photograph of all cameras."""
    # By factors of QR: J_pᵀ·J_p would square the condition of a small board far away.
    Q, _ = np.linalg.qr(J_pose)
    A = J - Q @ (Q.T @ J)
    AC = A @ C
    S = np.eye(len(A)) + AC @ A.T
    updated = C[np.ix_(base_columns, base_columns)] - AC[:, base_columns].T @ np.linalg.solve(
        S, AC[:, base_columns]
    )
    return float(np.sqrt(max(np.linalg.eigvalsh(updated)[-1], 0.0)))


def _whitened(
    rig: "RigCalibration",
    name: str,
    poses: PoseValue,
    points: Float[np.ndarray, "points 3"],
    settings: NextViewSettings,
) -> tuple[np.ndarray, np.ndarray, Bool[np.ndarray, " n"]]:
    """Derivatives over σ of the image points of a camera at every place, [n, 2·points, 6 + free
    parameters] and by the pose [n, 2·points, 6], 0 of what it does not see; and whether it counts
    as seen."""
    k, camera = rig.names.index(name), rig.camera(name)
    model = get_model(camera.model)
    mounting = jax.tree.map(lambda x: x[k], rig.values("mounting"))
    p = np.array(list(camera.parameters.values()))
    xy, J, depth = map(np.asarray, _images(model, p, mounting, poses, points))
    size = np.array(not_none(camera.image_size))
    uv = in_pixels(xy, model, camera.image_size, camera.pixel_size)
    is_inside = ((uv > 0) & (uv < size - 1)).all(-1) & (depth < 0) & np.isfinite(J).all((-2, -1))
    is_visible = is_inside.mean(1) >= settings.min_part
    is_of_camera = rig.rig.camera == k
    # A posteriori, as C is.
    sigma = rig.sigma0 * np.median(rig.rig.sigma[is_of_camera], axis=0)
    J = np.where((is_inside & is_visible[:, None])[..., None, None], J / sigma[:, None], 0.0)
    J = J.reshape(len(J), -1, J.shape[-1])
    space = rig.result.problem.table(rig.rig.row_of(k)[0]).vector
    free = [*range(6), *(12 + c for c in space.moving)]
    of_mounting = J[..., free]
    if k == 0:  # the reference has no mounting
        of_mounting[..., :6] = 0.0
    return of_mounting, J[..., 6:12], is_visible


def _places(
    rig: "RigCalibration", camera: str, settings: NextViewSettings
) -> tuple[PoseValue, list[tuple]]:
    """Random places of a board before a camera, as poses of the reference camera relative to it,
    with pixel, distance, tilt, roll and the matrix; distances are those of the epochs."""
    random = np.random.default_rng(settings.seed)
    adjusted_camera, n = rig.camera(camera), settings.number
    model, size = get_model(adjusted_camera.model), np.array(not_none(adjusted_camera.image_size))
    p = tuple(adjusted_camera.parameters.values())
    # With its middle nearer to an edge much of a board would be outside the image (`min_part`).
    uv = random.uniform(0.15, 0.85, (n, 2)) * size
    xy = in_model_units(uv, model, adjusted_camera.image_size, adjusted_camera.pixel_size)
    rays = np.stack(jax.vmap(lambda xy: image_ray(model, p, xy[0], xy[1]))(xy), -1)
    rays = rays / np.linalg.norm(rays, axis=1)[:, None]
    distances_of_boards = np.linalg.norm(rig.values("epoch").position, axis=1)
    # Without the ends: a single epoch, or a wrong pose, is no distance to ask for.
    nearest, farthest = np.quantile(distances_of_boards, [0.05, 0.95]).tolist()
    distance = random.uniform(nearest, farthest, n)
    tilt, roll = random.uniform(0, settings.max_tilt, n), random.uniform(0, 180, n)
    axis = random.uniform(0, 2 * np.pi, n)
    # The printed side is that which the cameras have seen: +z of the board towards them, or −z.
    faces = np.sign(np.median(_normals(rig)))
    mounting = rig.mountings[camera]
    poses = []
    for k in range(n):
        turn = np.array([np.cos(axis[k]), np.sin(axis[k]), 0.0]) * np.radians(tilt[k])
        R = np.asarray(matrix_from_rotation_vector(turn))
        R = R @ np.asarray(matrix_from_rotation_vector(np.radians(roll[k]) * np.eye(3)[2]))
        R = R @ np.diag([1.0, faces, faces])
        # Board to camera, then to the reference camera: Y = Rᵀ·x + b.
        R, t = (
            mounting.rotation.T @ R,
            mounting.rotation.T @ (distance[k] * rays[k]) + mounting.base,
        )
        poses.append((-R.T @ t, np.asarray(quaternion_from_matrix(R)), transformation(R, t)))
    position, rotation, pose = (np.array(column) for column in zip(*poses))
    pixels = [(float(u), float(v)) for u, v in uv]
    return PoseValue(position, rotation), list(zip(pixels, distance, tilt, roll, pose))


def _normals(rig: "RigCalibration") -> Float[np.ndarray, " epochs"]:
    """z, in the reference camera, of the z axes of the bodies at every epoch."""
    w, x, y, z = rig.values("epoch").rotation.T
    return (w**2 - x**2 - y**2 + z**2) / (w**2 + x**2 + y**2 + z**2)
