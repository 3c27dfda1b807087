"""A wand as one more body of a rig: two markers at a known distance, with a pose at every frame.

A stick has no rotation about itself. It is pinned to that of its start value by an observation with
the weight of a radian,

    z₀ᵀ·(M·e_y) = 0        z₀ = M₀·e_z

which changes nothing else: the markers are on the axis e_x of the body. Their distance is an
unknown, the same in all frames, with the given length as an observation.

Start values are those of the cameras calibrated by the wand alone (`wand`). Cameras that see boards
have the interior orientation of their own calibration there, which is then estimated together;
others a given one, which is held.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxbundle.arguments import positive
from jaxbundle.batches.epochs import MIN_SHARED_EPOCHS
from jaxbundle.calibration.pixels import unit_size
from jaxbundle.calibration.result import Calibration
from jaxbundle.calibration.rig.connections import BoardView, Connections
from jaxbundle.calibration.rig.declare import Rig, RigWand
from jaxbundle.calibration.rig.motion import transformation
from jaxbundle.calibration.rig.start import pose_values
from jaxbundle.calibration.rig.wand import WandCalibration, calibrate_wand
from jaxbundle.calibration.rig.wand_markers import WandSettings
from jaxbundle.cameras import get_model
from jaxbundle.cameras.pixel_frame import in_model_units
from jaxbundle.errors import InputError
from jaxbundle.geometry import matrix_from_quaternion
from jaxbundle.leastsquares.spaces import PoseValue
from jaxbundle.measure.moving_blobs import BlobSettings
from jaxbundle.network.tables import Camera
from jaxbundle.types import Progress, not_none

BODY = "wand"


@dataclasses.dataclass(frozen=True)
class Wand:
    """A wand waved before the cameras of a rig while the rig stands still.

    **Fields:** `markers`, `lengths`, `sigma_length`, `sigma_image`, `settings`, `blobs`: as in
    `calibrate_wand`, of which the two markers farthest apart are used; `cameras`: interior
    orientation, by name, of those that see no board.
    """

    markers: Mapping[str, Any]
    lengths: float | Mapping[tuple[str, str], float]
    sigma_length: float
    cameras: Mapping[str, Camera] = dataclasses.field(default_factory=dict)
    sigma_image: float | None = None
    settings: WandSettings | None = None
    blobs: BlobSettings | None = None

    def __post_init__(self):
        positive("sigma_length", self.sigma_length)
        if not isinstance(self.markers, Mapping) or len(self.markers) < 2:
            raise InputError("markers: expected those of two cameras at least, by their names")


@dataclasses.dataclass(frozen=True)
class WandBody:
    """A wand with start values.

    **Fields:** `calibration`: the cameras by the wand alone; `cameras` that see no board; `ends`:
    the names of the markers used; `length` and `sigma_length` of them; `sigma_image` of markers
    without a σ of their own, pixels."""

    calibration: WandCalibration
    cameras: dict[str, Camera]
    ends: tuple[str, str]
    length: float
    sigma_length: float
    sigma_image: float

    def views(self, cameras: Sequence[str], board: int, epoch: int) -> list[BoardView]:
        """The cameras by the wand as if all of them saw one board, its body, at the epochs from
        `epoch` on: as many as tie cameras surely."""
        poses = self._poses()
        return [
            BoardView(
                cameras.index(name), board, epoch + k, pose, len(self.calibration.markers[name])
            )
            for name, pose in poses.items()
            for k in range(MIN_SHARED_EPOCHS)
        ]

    def _poses(self) -> dict[str, Float[np.ndarray, "4 4"]]:
        """From the frame of the wand's network to each camera."""
        # Its cameras have one image each, which has their name.
        images = self.calibration.adjustment.values["image"]
        poses = {}
        for k, name in enumerate(self.calibration.adjustment.problem.network.images.id):
            M = np.asarray(matrix_from_quaternion(images.rotation[k]))
            poses[name] = transformation(M, -M @ np.asarray(images.position[k]))
        return poses

    def points(self, mountings: Mapping[str, Float[np.ndarray, "4 4"]]) -> dict[str, np.ndarray]:
        """By frame, both ends in the frame of the rig [2, 3]; `mountings`: rig to camera."""
        name, pose = next(iter(self._poses().items()))
        # Any camera of both ties the frames; what is left is a matter of the adjustment.
        to_rig = np.linalg.inv(mountings[name]) @ pose
        adjustment = self.calibration.adjustment
        position_of = dict(
            zip(adjustment.problem.network.points.id, np.asarray(adjustment.values["point"]))
        )
        frames = dict.fromkeys(id.rsplit(":", 1)[0] for id in position_of)
        ends = {frame: [f"{frame}:{end}" for end in self.ends] for frame in frames}
        return {
            frame: np.array([position_of[id] for id in ids]) @ to_rig[:3, :3].T + to_rig[:3, 3]
            for frame, ids in ends.items()
            if all(id in position_of for id in ids)
        }


def start_wand(
    wand: Wand,
    calibrations: Mapping[str, Calibration],
    object_unit: str,
    progress: Progress | None = None,
) -> WandBody:
    """The cameras by the wand alone.

    **Raises:** `InputError` naming camera, frame and marker; `NotSolvedError` if the cameras do not
    hang together by the wand."""
    wand_cameras = {name: wand.cameras[name] for name in wand.markers if name in wand.cameras}
    for name in wand.markers:
        if name in wand_cameras and name in calibrations:
            raise InputError(
                f"wand: camera {name!r} sees boards, which give its interior orientation; omit it "
                "from cameras"
            )
    known_cameras = wand_cameras | {
        name: calibration.camera for name, calibration in calibrations.items()
    }
    missing_cameras = [name for name in wand.markers if name not in known_cameras]
    if missing_cameras:
        raise InputError(
            f"wand: camera {missing_cameras[0]!r} sees no board; expected its interior orientation "
            "in cameras (--cameras)"
        )
    # Their interior orientation is that of the boards; the wand alone would weaken it.
    hold = lambda camera: dataclasses.replace(camera, free=(), sigma={}, observed={})
    known_cameras = {name: hold(known_cameras[name]) for name in wand.markers}
    wand_calibration = calibrate_wand(
        wand.markers,
        known_cameras,
        wand.lengths,
        sigma_length=wand.sigma_length,
        sigma_image=wand.sigma_image,
        object_unit=object_unit,
        settings=wand.settings,
        blobs=wand.blobs,
        progress=progress,
        snooping="pope",
    )
    ends, length, sigma = _ends(wand_calibration.lengths, wand.sigma_length)
    wand_cameras = {
        name: dataclasses.replace(known_cameras[name], id=name) for name in wand_cameras
    }
    return WandBody(wand_calibration, wand_cameras, ends, length, sigma, wand.sigma_image or 1.0)


def _ends(
    lengths: Mapping[tuple[str, str], float], sigma: float
) -> tuple[tuple[str, str], float, float]:
    """The two markers farthest apart, their distance and its σ: given, or the sum of two lengths
    from a marker between them."""
    lengths_found = {pair: (length, sigma) for pair, length in lengths.items()}
    names = {name for pair in lengths for name in pair}
    for middle in names:
        length_to_middle = {
            next(iter({*pair} - {middle})): x for pair, x in lengths.items() if middle in pair
        }
        # Three in a line: of the third length, if it is not given, the other two are the parts.
        if len(names) == 3 and len(lengths) == 2 and len(length_to_middle) == 2:
            (end_a, a), (end_b, b) = length_to_middle.items()
            lengths_found[end_a, end_b] = a + b, sigma * np.sqrt(2)
    ends = max(lengths_found, key=lambda pair: lengths_found[pair][0])
    return ends, *lengths_found[ends]


def add_wand(
    rig: Rig, wand: WandBody, connections: Connections, calibrations: Mapping[str, Calibration]
) -> Rig:
    """A rig with the wand as its last body, and the frames in which two cameras saw both ends."""
    names = [camera.id for camera in rig.cameras]
    ends = wand.points(dict(zip(names, connections.mountings)))
    marks_of_frame: dict[str, list[tuple[int, int, Any]]] = {frame: [] for frame in ends}
    for name, marks in wand.calibration.markers.items():
        for mark in marks:
            if mark.frame in marks_of_frame and mark.marker in wand.ends:
                point = len(rig.ids) + wand.ends.index(mark.marker)
                marks_of_frame[mark.frame].append((names.index(name), point, mark))
    # Two markers in two cameras: with fewer rays a pose of five unknowns is not checked.
    frames = [frame for frame, rows in marks_of_frame.items() if len(rows) >= 4]
    if not frames:
        raise InputError(
            f"wand: no frame shows both ends of it, {' and '.join(map(repr, wand.ends))}, to two "
            "cameras; expected some that do, or the length of a pair of markers that such frames "
            "show"
        )
    poses = np.array([_stick_to_rig(*ends[frame]) for frame in frames])
    rows = [
        (len(rig.epochs) + e, *row)
        for e, frame in enumerate(frames)
        for row in marks_of_frame[frame]
    ]
    epoch, camera, point, marks = zip(*rows)
    xy, sigma = _in_units(rig, np.array(camera), marks, wand, calibrations)
    pose = pose_values([*poses])
    join = lambda a, b: PoseValue(*(np.concatenate(parts) for parts in zip(a, b)))
    place = rig.place
    if place is not None:
        # The wand has no place of its own beside its body's: the identity.
        place = join(place, PoseValue(np.zeros((1, 3)), np.array([[1.0, 0, 0, 0]])))
    half_length = wand.length / 2
    labels = [f"{BODY} {frame}" for frame in frames]
    number = len(rig.boards)
    return dataclasses.replace(
        rig,
        epochs=(*rig.epochs, *labels),
        times=(*rig.epoch_of_rows, *labels),
        pose=join(rig.pose, pose),
        ids=(*rig.ids, *(f"{BODY}:{end}" for end in wand.ends)),
        points=np.concatenate([rig.points, [[-half_length, 0, 0], [half_length, 0, 0]]]),
        epoch=np.concatenate([rig.epoch, epoch]),
        camera=np.concatenate([rig.camera, camera]),
        point=np.concatenate([rig.point, point]),
        xy=np.concatenate([rig.xy, xy]),
        sigma=np.concatenate([rig.sigma, sigma]),
        boards=(*rig.boards, BODY),
        board=np.concatenate([rig.board_of_points, [number, number]]),
        centroids=np.concatenate([not_none(rig.centroids), np.zeros((1, 3))]),
        place=place,
        body=(*rig.body, number),
        wand=RigWand(
            wand.length,
            # All σ are multiplied by σ0 in the end.
            wand.sigma_length / _sigma0(calibrations),
            len(rig.epochs),
            poses[:, :3, 2],
        ),
    )


def _sigma0(calibrations: Mapping[str, Calibration]) -> float:
    """The σ0 that the image points of the boards have."""
    sigma0_and_redundancy = [
        (calibration.adjustment.sigma0, calibration.adjustment.redundancy)
        for calibration in calibrations.values()
    ]
    sigma0, redundancy = np.array(sigma0_and_redundancy).T
    return float(np.sqrt((redundancy * sigma0**2).sum() / redundancy.sum()))


def _stick_to_rig(a: np.ndarray, b: np.ndarray) -> Float[np.ndarray, "4 4"]:
    """Body to rig: the origin midway, e_x towards the second end."""
    x = (b - a) / np.linalg.norm(b - a)
    # A rotation about itself has no effect: any axis across it, not nearly along it.
    y = np.cross(np.eye(3)[np.abs(x).argmin()], x)
    y /= np.linalg.norm(y)
    return transformation(np.stack([x, y, np.cross(x, y)], 1), (a + b) / 2)


def _in_units(
    rig: Rig,
    camera: np.ndarray,
    marks: Sequence[Any],
    wand: WandBody,
    calibrations: Mapping[str, Calibration],
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
    """Coordinates and σ of markers in the units of the models, σ in proportion to those of the
    boards."""
    uv = np.array([(mark.x, mark.y) for mark in marks])
    own_sigma = np.array([(mark.sx, mark.sy) for mark in marks])
    # As large as the residuals of the wand's network say.
    sigma = np.where(np.isfinite(own_sigma), own_sigma, wand.sigma_image)
    sigma = sigma * wand.calibration.adjustment.sigma0 / _sigma0(calibrations)
    xy = np.empty_like(uv)
    for k in np.unique(camera):
        camera_of_rig, rows = rig.cameras[k], camera == k
        model = get_model(camera_of_rig.model)
        xy[rows] = in_model_units(
            uv[rows], model, camera_of_rig.image_size, camera_of_rig.pixel_size
        )
        sigma[rows] *= unit_size(model, camera_of_rig.pixel_size)
    return xy, sigma
