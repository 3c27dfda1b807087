"""Poses of a robot's hand as observations: table `robot_poses`, section `[hand_eye]`.

    A = Y·B·X⁻¹        A the hand in the base of the robot

eye in hand: the camera is mounted on the hand, x_camera = M_e·(x_hand − t_e), and the object stands
still; eye to hand: the camera is mounted on the base, x_camera = M_e·(x_base − t_e), and the hand
holds the object. The second unknown frame is the base, or the hand, in object space. Residuals are
the position of the hand computed minus given, and the rotation vector from its given to its
computed attitude, both along the axes of the base (Strobl and Hirzinger 2006 minimise the same).
Positions and rotations are two variance components: the robot's own repeatability.

Columns: `image`; `X`, `Y`, `Z` of the hand in the base; its attitude, hand → base, as a quaternion
`qw`, `qx`, `qy`, `qz`, a rotation vector `rx`, `ry`, `rz`, or `roll`, `pitch`, `yaw` (R_z(yaw)·
R_y(pitch)·R_x(roll)), or, base → hand, as `omega`, `phi`, `kappa`; σ `sX`, `sY`, `sZ`, `srx`,
`sry`, `srz`, or `c11`, `c12`, … `c66`, the upper triangle of the covariance of both.

Section: `type = "eye-in-hand"` (default) or `"eye-to-hand"`; `sigma_position` and `sigma_angle` of
rows without their own; `camera = { position = […], angles = […], sigma_position = … }` what is
known of the mounting of the camera (`mountings.py`), t_e and ω, φ, κ of M_e; it is also its start
value.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxbundle.arguments import one_of
from jaxbundle.choices import HAND_EYE
from jaxbundle.errors import InputError
from jaxbundle.geometry.quaternions import (
    matrix_from_quaternion,
    matrix_from_rotation_vector,
    quaternion_from_matrix,
)
from jaxbundle.geometry.rotations import matrix_from_omega_phi_kappa
from jaxbundle.leastsquares.datum.motions import move_pose, scale_position
from jaxbundle.leastsquares.declarations import Kind, ObservationSet, Table
from jaxbundle.leastsquares.spaces import Pose, Posed, PoseValue
from jaxbundle.network.columns import Columns
from jaxbundle.network.kinds.base import (
    POSE_UNITS,
    Contribution,
    ObservationTable,
    check_settings,
    positive_sigma,
    rows_of,
)
from jaxbundle.network.kinds.fit_hand_eye import Rigid, other_side, solve, turns
from jaxbundle.network.kinds.mountings import (
    AXES,
    GivenMounting,
    mounting_minus_given,
    read_mountings,
)
from jaxbundle.network.number_range import sigma_of_setting
from jaxbundle.network.rules import check_unique
from jaxbundle.network.tables import Network
from jaxbundle.network.units import ANGLE_UNITS

SECTION = "hand_eye"
IN_HAND, TO_HAND = HAND_EYE
# Tables: the camera on the hand or the base, and the base or the hand in object space.
ON_HAND, ON_BASE = "camera on the hand", "camera on the base"
BASE, HAND = "robot base", "robot hand"
PLACE, SIGMAS = ("X", "Y", "Z"), ("sX", "sY", "sZ", "srx", "sry", "srz")
QUATERNION = ("qw", "qx", "qy", "qz")
ATTITUDES = (QUATERNION, ("rx", "ry", "rz"), ("roll", "pitch", "yaw"), ("omega", "phi", "kappa"))
COVARIANCE = tuple(f"c{i + 1}{j + 1}" for i in range(6) for j in range(i, 6))
PARTS = ("robot positions", "robot rotations")
# Two motions about different axes determine the mounting; they are between three poses.
FEWEST = 3
# Of half of a rotation of 180°, whose axis is undetermined: no division by 0 there.
SMALLEST_COSINE = 1e-12
# Axes of the motions of a robot that differ by fewer σ of a rotation than this are parallel.
PARALLEL = 3.0


@dataclasses.dataclass(frozen=True)
class HandPose:
    """Position and rotation of the hand in its base, computed minus given."""

    type: str

    def __call__(
        self, image: Posed, eye: Posed, frame: Posed, measured: tuple[Array, Array]
    ) -> Float[Array, "6"]:
        if self.type == IN_HAND:
            position = frame.ray(image.place(eye.ray((0.0, 0.0, 0.0))))
            R = frame.rotation.matrix() @ image.rotation.matrix().T @ eye.rotation.matrix()
        else:
            position = eye.place(image.ray(frame.centre))
            R = eye.rotation.matrix().T @ image.rotation.matrix() @ frame.rotation.matrix().T
        return jnp.concatenate([jnp.stack(position) - measured[0], small_turn(R @ measured[1].T)])


def small_turn(D: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """2·sin(θ/2) along the axis of a rotation: its rotation vector, of a turn by a degree to 1e-5
    of it (θ²/24), and not 0 for the opposite attitude; four branches of quaternions would be
    compiled for the vector."""
    sine = jnp.stack([D[2, 1] - D[1, 2], D[0, 2] - D[2, 0], D[1, 0] - D[0, 1]])
    # 1 + tr D = 4·cos²(θ/2)
    return sine / jnp.sqrt(jnp.maximum(1 + jnp.trace(D), SMALLEST_COSINE))


@dataclasses.dataclass(frozen=True)
class HandPart(HandPose):
    """Three of the six, from `begin` (0: position, 3: rotation)."""

    begin: int

    def __call__(
        self, image: Posed, eye: Posed, frame: Posed, measured: tuple[Array, Array]
    ) -> Float[Array, "3"]:
        return super().__call__(image, eye, frame, measured)[self.begin : self.begin + 3]


class HandEyeTables(NamedTuple):
    """The names of the tables of the camera and of the frame in object space."""

    eye: str
    frame: str


TABLES = {IN_HAND: HandEyeTables(ON_HAND, BASE), TO_HAND: HandEyeTables(ON_BASE, HAND)}


@dataclasses.dataclass(frozen=True, kw_only=True)
class RobotPoses(ObservationTable):
    """Poses of the hand: position and rotation hand → base; σ along and about the axes of the base,
    radians, NaN where a covariance is given, which is NaN where σ are."""

    image: tuple[str, ...]
    position: Float[np.ndarray, "n 3"]
    rotation: Float[np.ndarray, "n 3 3"]
    sigma: Float[np.ndarray, "n 6"]
    covariance: Float[np.ndarray, "n 6 6"]

    TABLE, SECTION, IMAGES = "robot_poses", SECTION, ("image",)
    GIVES_SCALE = True
    ANGLES_IN_SETTINGS = True

    @classmethod
    def from_columns(
        cls, table: Columns, settings: Mapping[str, Any], radians: float
    ) -> "RobotPoses":
        names = _attitude_names(table)
        table.check_names(("image", *PLACE, *names), (*SIGMAS, *COVARIANCE))
        keys = ("type", "sigma_position", "sigma_angle", "camera")
        check_settings(SECTION, settings, keys)
        one_of(f"[{SECTION}]: type", settings.get("type", IN_HAND), tuple(TABLES))
        read_mountings(SECTION, {"camera": settings["camera"]} if "camera" in settings else {}, 1.0)
        attitude = np.stack([table.numbers(name, required=True) for name in names], 1)
        unit = np.repeat([1.0, radians], 3)
        image = table.ids("image")
        check_unique(image, table.source, "image")
        sigma, covariance = _precision(table, settings, unit)
        return cls(
            image=image,
            position=np.stack([table.numbers(name, required=True) for name in PLACE], 1),
            rotation=_rotations(table, names, attitude, radians),
            sigma=sigma,
            covariance=covariance,
            settings=dict(settings),
            source=table.source,
        )

    def columns(self, radians: float) -> dict[str, Sequence[Any]]:
        unit = np.repeat([1.0, radians], 3)
        q = np.array([np.asarray(quaternion_from_matrix(R)) for R in self.rotation])
        columns: dict[str, Any] = {"image": self.image}
        columns |= {name: self.position[:, k] for k, name in enumerate(PLACE)}
        columns |= {name: q[:, k] for k, name in enumerate(QUATERNION)}
        if np.isnan(self.covariance).any():
            return columns | {name: self.sigma[:, k] / unit[k] for k, name in enumerate(SIGMAS)}
        C = self.covariance / np.outer(unit, unit)
        return columns | dict(zip(COVARIANCE, C[:, *np.triu_indices(6)].T))

    def number_of_equations(self) -> int:
        return 6

    def rescale(self, factors: Mapping[str, float]) -> "RobotPoses":
        """With σ multiplied by the factors of positions and rotations, by the names of their
        kinds."""
        axis_factors = np.repeat([factors.get(name, 1.0) for name in PARTS], 3)
        return dataclasses.replace(self, sigma=self.sigma * axis_factors)

    @property
    def type(self) -> str:
        """Where the camera is."""
        return self.settings.get("type", IN_HAND)

    def poses(self, network: Network) -> tuple[Rigid, Rigid, Int[np.ndarray, " n"]]:
        """A and B of A·X = Y·B (`fit_hand_eye`), by the orientations of the images, whose rows
        follow."""
        image = rows_of(self.image, network.images)
        X0 = network.images.position[image]
        M = np.array(
            [np.asarray(matrix_from_omega_phi_kappa(a)) for a in network.images.angles[image]]
        )
        camera = Rigid(np.swapaxes(M, 1, 2), X0)  # camera → object
        return (
            Rigid(self.rotation, self.position),
            camera if self.type == IN_HAND else camera.inverse,
            image,
        )

    def scales(self, network: Network) -> list[float]:
        if len(self) < FEWEST:
            return []
        A, B, _ = self.poses(network)
        scale = solve(A, B)[2]
        return [scale] if np.isfinite(scale) and scale > 0 else []

    def declare(self, network: Network, origin: Float[np.ndarray, "3"]) -> Contribution:
        A, B, image = self.poses(network)
        if self.type == IN_HAND:
            B = Rigid(B.R, B.t - origin)
        else:
            B = Rigid(B.R, B.t + (B.R @ origin[:, None])[..., 0])
        cameras, of_camera = np.unique(network.images.camera[image], return_inverse=True)
        radians = ANGLE_UNITS[network.angle_unit]
        known_mounting = None
        if "camera" in self.settings:
            known_mounting = read_mountings(SECTION, {"camera": self.settings["camera"]}, radians)[
                "camera"
            ]
        for c in range(len(cameras)):
            self._check_motions(A, of_camera == c, known_mounting, network.cameras[cameras[c]].id)
        eyes, frames, names = [], [], TABLES[self.type]
        for c in range(len(cameras)):
            rows = of_camera == c
            hand_poses, camera_poses = (Rigid(T.R[rows], T.t[rows]) for T in (A, B))
            eye, frame = self._start(hand_poses, camera_poses, known_mounting)
            eyes.append(eye)
            frames.append(frame)
        # Of several cameras the frame of the first: the others agree but for noise.
        labels = [network.cameras[c].id for c in cameras]
        eye = _pose_table(names.eye, eyes, labels, known_mounting)
        frame = _pose_table(names.frame, frames[:1], ["robot"], None)
        rows = (image, of_camera, np.zeros(len(image), int))
        sets = [*self._observe(names, rows), *_observe_camera(eye, known_mounting)]
        actions = ((names.eye, scale_position), (names.frame, move_pose))
        return Contribution((eye, frame), sets, actions)

    def _observe(self, names: HandEyeTables, rows: tuple[Any, ...]) -> list[ObservationSet]:
        tables, measured = ("image", *names), (self.position, self.rotation)
        if not np.isnan(self.covariance).any():
            axes = (*PLACE, "rx", "ry", "rz")
            kind = Kind("robot poses", HandPose(self.type), tables, axes, POSE_UNITS)
            return [kind(rows, measured, covariance=self.covariance)]
        axes, units = (PLACE, ("rx", "ry", "rz")), ("length", "angle")
        parts = zip(PARTS, (0, 3), axes, units)
        return [
            Kind(name, HandPart(self.type, begin), tables, axes, units)(
                rows, measured, sigma=self.sigma[:, begin : begin + 3]
            )
            for name, begin, axes, units in parts
        ]

    def _start(
        self, A: Rigid, B: Rigid, known_mounting: GivenMounting | None
    ) -> tuple[Rigid, Rigid]:
        """The pose of the camera, x_camera = M·(x − t) as (M, t), and that of the frame."""
        if (
            known_mounting is not None
            and known_mounting.position is not None
            and known_mounting.angles is not None
        ):
            R = np.asarray(matrix_from_omega_phi_kappa(known_mounting.angles)).T
            eye = Rigid(R, known_mounting.position)  # camera → hand, or → base
            if self.type == IN_HAND:
                frame = other_side(A, eye, B)
            else:  # A⁻¹·Y = X·B⁻¹
                frame = other_side(A.inverse, eye, B.inverse)
        else:
            X, Y, _ = solve(A, B)
            eye, frame = (X, Y) if self.type == IN_HAND else (Y, X)
        # Object space → base or hand, as its pose: M and the place where x is 0.
        centre = frame.inverse.t
        return Rigid(eye.R.T, eye.t), Rigid(frame.R, centre)

    def _check_motions(
        self, A: Rigid, rows: np.ndarray, known_mounting: GivenMounting | None, camera: str
    ) -> None:
        """Refuse motions that leave the mounting of a camera undetermined."""
        if (
            known_mounting is not None
            and known_mounting.position is not None
            and known_mounting.angles is not None
        ):
            return  # what is undetermined then is said by the adjustment
        where, number = f"{self.source.name}: camera {camera!r}", int(rows.sum())
        if number < FEWEST:
            raise InputError(
                f"{where} has {number} poses of the robot; at least {FEWEST} are needed, with "
                "rotations about two axes"
            )
        turning = turns(Rigid(A.R[rows], A.t[rows]))
        noise = PARALLEL * np.sqrt(2) * self._angle_noise()
        remedy = (
            "turn the hand about a second axis, or give what is known: camera = { position = "
            f"[…], angles = […], sigma_position = …, sigma_angle = … }} in [{SECTION}]"
        )
        mounted_object = "camera on the hand" if self.type == IN_HAND else "object in the hand"
        if turning.about_axis <= noise:
            raise InputError(
                f"{where}: the hand never turns between its poses, it only shifts: the position of "
                f"the {mounted_object} is not determined (its rotation is); {remedy}"
            )
        if turning.across_axis <= noise:
            axis = ", ".join(f"{x:.2f}" for x in turning.axis + 0.0)
            raise InputError(
                f"{where}: all motions of the hand turn about parallel axes, ({axis}) of the hand "
                f"(the others turn by {turning.across_axis:.2g} rad, within the noise): the "
                f"position of the {mounted_object} along that axis is not determined; {remedy}"
            )

    def _angle_noise(self) -> float:
        """A σ of a rotation, the median; 1e-9 rad at least, the rounding of printed attitudes."""
        sigma = np.where(
            np.isnan(self.sigma), np.sqrt(np.einsum("nii->ni", self.covariance)), self.sigma
        )
        return max(float(np.median(sigma[:, 3:])), 1e-9)


def _pose_table(
    name: str, poses: Sequence[Rigid], labels: Sequence[str], known_mounting: GivenMounting | None
) -> Table:
    value = PoseValue(
        np.array([t for _, t in poses]),
        np.array([np.asarray(quaternion_from_matrix(M)) for M, _ in poses]),
    )
    free = (
        True
        if known_mounting is None
        else ~np.tile(np.repeat(known_mounting.is_held, 3), (len(poses), 1))
    )
    return Table(name, value, Pose(), free, labels, AXES, name)


def _observe_camera(eye: Table, known_mounting: GivenMounting | None) -> list[ObservationSet]:
    """What is given of the mounting of the camera."""
    if known_mounting is None or not np.isfinite(known_mounting.sigma).any():
        return []
    kind = Kind("given camera", mounting_minus_given, (eye.name,), AXES, POSE_UNITS, snooped="")
    parts = (known_mounting.position, known_mounting.angles)
    measured = np.concatenate([np.zeros(3) if part is None else part for part in parts])
    uncertainty: dict[str, Any] = {"sigma": np.tile(known_mounting.sigma, (eye.rows, 1))}
    if known_mounting.covariance is not None:
        uncertainty = {"covariance": np.tile(known_mounting.covariance, (eye.rows, 1, 1))}
    return [kind((np.arange(eye.rows),), np.tile(measured, (eye.rows, 1)), **uncertainty)]


def _attitude_names(table: Columns) -> tuple[str, ...]:
    forms = [names for names in ATTITUDES if {*names} & {*table.values}]
    if len(forms) != 1:
        expected = "; ".join(", ".join(names) for names in ATTITUDES)
        raise InputError(
            f"{table.source.name}: the attitude of the hand is given "
            f"{'twice' if forms else 'nowhere'}; expected the columns of one form: {expected}"
        )
    return forms[0]


def _rotations(
    table: Columns, names: Sequence[str], values: Float[np.ndarray, "n k"], radians: float
) -> Float[np.ndarray, "n 3 3"]:
    """Rotation matrices hand → base."""
    if names == QUATERNION:
        length = np.linalg.norm(values, axis=1)
        # A part in a hundred: printed with two digits.
        for row in np.flatnonzero(abs(length - 1) > 0.01)[:1]:
            raise InputError(
                f"{table.source(row)}: the quaternion has the length {length[row]:.4g}; expected 1"
            )
        return np.array([np.asarray(matrix_from_quaternion(q)) for q in values / length[:, None]])
    values = values * radians
    if names[0] == "rx":
        return np.array([np.asarray(matrix_from_rotation_vector(v)) for v in values])
    if names[0] == "roll":
        rotation_about = lambda k, a: np.asarray(matrix_from_rotation_vector(a * np.eye(3)[k]))
        return np.array(
            [
                rotation_about(2, y) @ rotation_about(1, p) @ rotation_about(0, r)
                for r, p, y in values
            ]
        )
    return np.array([np.asarray(matrix_from_omega_phi_kappa(a)).T for a in values])


def _precision(
    table: Columns, settings: Mapping[str, Any], unit: Float[np.ndarray, "6"]
) -> tuple[Float[np.ndarray, "n 6"], Float[np.ndarray, "n 6 6"]]:
    """σ and covariances of the poses, one of them NaN."""
    n = len(table)
    no_covariance = np.full((n, 6, 6), np.nan)
    if {*COVARIANCE} & {*table.values}:
        if {*SIGMAS} & {*table.values}:
            raise InputError(f"{table.source.name}: give σ or covariances (c11 …), not both")
        upper = np.stack([table.numbers(name, required=True) for name in COVARIANCE], 1)
        C = np.zeros((n, 6, 6))
        C[:, *np.triu_indices(6)] = upper
        C = C + np.swapaxes(np.triu(C, 1), 1, 2)
        for row in range(n):
            if np.linalg.eigvalsh(C[row])[0] <= 0:
                raise InputError(f"{table.source(row)}: the covariance is not positive definite")
        return np.full((n, 6), np.nan), C * np.outer(unit, unit)
    sigma = np.stack([positive_sigma(table, name, required=False) for name in SIGMAS], 1)
    for k, key in enumerate(("sigma_position", "sigma_angle")):
        part = sigma[:, 3 * k : 3 * k + 3]
        if key in settings:
            part[np.isnan(part)] = sigma_of_setting(f"[{SECTION}]: {key}", settings[key])
        for row in np.flatnonzero(np.isnan(part).any(1))[:1]:
            raise InputError(
                f"{table.source(row)}: the σ of the {key[6:].replace('angle', 'attitude')} of the "
                f"hand is missing; give {', '.join(SIGMAS[3 * k : 3 * k + 3])}, or {key} in "
                f"[{SECTION}]: the repeatability of the robot"
            )
    return sigma * unit, no_covariance
