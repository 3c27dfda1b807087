"""Cameras mounted together: table `rigs`, section `[rig]`.

Images taken at one epoch of a rig; every camera has one mounting relative to the reference camera,
the same at all epochs, exactly or within a σ (an unstable mounting):

    t = M_ref·(X0 − X0_ref) = t_mounting        M·M_refᵀ = R_mounting

Columns: `rig`, `epoch`, `image`. The reference of a rig is the camera that most of its epochs have,
or the one the section names: `reference = "left"`. Section: `sigma_position` (object unit) and
`sigma_angle` (angle unit) of one epoch, exact if not given; `mounting` and `bases`: what is known
of the mountings (`mountings`). At an epoch without an image of the
reference, several images are tied to the first by both mountings; a single one stays free.
"""

import dataclasses
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.errors import InputError
from jaxbundle.geometry import quaternion_from_matrix
from jaxbundle.geometry.rotations import matrix_from_omega_phi_kappa
from jaxbundle.leastsquares.datum.motions import scale_position
from jaxbundle.leastsquares.declarations import Kind, Table
from jaxbundle.leastsquares.spaces import Pose, Posed, PoseValue
from jaxbundle.network.columns import Columns, did_you_mean
from jaxbundle.network.kinds.base import POSE_UNITS, Contribution, ObservationTable, check_settings
from jaxbundle.network.kinds.figures import EXACT_SIGMA, sigma_across_rays
from jaxbundle.network.kinds.mountings import (
    AXES,
    BASES,
    MOUNTING,
    Base,
    GivenMounting,
    observe_mountings,
    read_bases,
    read_mountings,
    turn_of,
)
from jaxbundle.network.number_range import sigma_of_setting
from jaxbundle.network.rules import check_unique
from jaxbundle.network.tables import Network
from jaxbundle.network.units import ANGLE_UNITS

SECTION = "rig"
KEYS = ("reference", "sigma_position", "sigma_angle", "mounting", "bases")


def mounting_misclosure(
    first_pose: Posed,
    second_pose: Posed,
    first_mounting: Posed,
    second_mounting: Posed,
    measured: Float[Array, "6"],
) -> Float[Array, "6"]:
    """Difference of position and rotation of the reference camera derived from two cameras, in the
    frame of the first; the rotation as a vector. The reference has no mounting.
    """
    R1, R2 = first_mounting.rotation.matrix(), second_mounting.rotation.matrix()
    M1, M2 = first_pose.rotation.matrix(), second_pose.rotation.matrix()
    # Both cameras give the rotation of the reference camera, M_ref = Rᵀ·M, and its place. The
    # difference is symmetric in them and needs no image of the reference at this epoch.
    M_ref1, M_ref2 = R1.T @ M1, R2.T @ M2
    base_vector = jnp.stack(second_pose.centre) - jnp.stack(first_pose.centre)
    t1, t2 = jnp.stack(first_mounting.centre), jnp.stack(second_mounting.centre)
    shift = M_ref1 @ base_vector - (t2 - t1)
    return jnp.concatenate([shift, turn_of(M_ref2 @ M_ref1.T)]) - measured


# Invariant: residuals of a condition at the start scale with the network but define no scale.
MOUNTED = Kind(
    "mountings",
    mounting_misclosure,
    ("image", "image", MOUNTING, MOUNTING),
    AXES,
    POSE_UNITS,
    invariant=True,
)


class MountedPose(NamedTuple):
    """A camera in the frame of the reference camera: place of its centre, and rotation from there
    to its own frame."""

    position: Float[np.ndarray, "3"]
    rotation: Float[np.ndarray, "3 3"]


class MountedCameras(NamedTuple):
    """The cameras of a rig as the orientations of its images have them.

    `reference`: index of the camera that the mountings refer to; `mountings`: by index of the
    camera, the reference first, None for one that no epoch connects with it; `epochs`: by name,
    index of the camera → index of the image.
    """

    reference: int
    mountings: dict[int, MountedPose | None]
    epochs: dict[str, dict[int, int]]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Rigs(ObservationTable):
    """Images taken simultaneously."""

    rig: tuple[str, ...]
    epoch: tuple[str, ...]
    image: tuple[str, ...]

    TABLE, SECTION, IMAGES = "rigs", SECTION, ("image",)
    ANGLES_IN_SETTINGS = True

    @classmethod
    def from_columns(cls, table: Columns, settings: Mapping[str, Any], radians: float) -> "Rigs":
        table.check_names(("rig", "epoch", "image"))
        check_settings(SECTION, settings, KEYS)
        for name in ("sigma_position", "sigma_angle"):
            if name in settings:
                sigma_of_setting(f"[{SECTION}]: {name}", settings[name])
        read_mountings(SECTION, settings.get("mounting", {}), radians)
        read_bases(SECTION, settings.get("bases", ()))
        return cls(
            rig=table.ids("rig"),
            epoch=table.ids("epoch"),
            image=table.ids("image"),
            settings=dict(settings),
            source=table.source,
        )

    def columns(self, radians: float) -> dict:
        return {"rig": self.rig, "epoch": self.epoch, "image": self.image}

    @property
    def needs_scale(self) -> bool:
        # Without a scale the network shrinks until all cameras are in one place, where every length
        # agrees.
        return "sigma_position" in self.settings

    def number_of_equations(self) -> int:
        return 6

    def check(self, network: Network) -> None:
        super().check(network)
        check_unique(self.image, self.source, "image")
        images = network.images
        mountings, bases = self.read_settings(network)
        camera = {id: network.cameras[c].id for id, c in zip(images.id, images.camera)}
        first_rows: dict[tuple[str, ...], int] = {}
        for row, key in enumerate(zip(self.rig, self.epoch, map(camera.__getitem__, self.image))):
            if first_rows.setdefault(key, row) != row:
                raise InputError(
                    f"{self.source(row)}: camera {key[2]!r} has two images at epoch {key[1]!r} of "
                    f"rig {key[0]!r}; the other is in {self.source(first_rows[key])}"
                )

        mounted_cameras = {camera[id] for id in self.image}
        required_cameras = [(f"mounting.{name}", name) for name in mountings]
        required_cameras += [("bases", name) for base in bases for name in base.cameras]
        for key, name in required_cameras:
            if name not in mounted_cameras:
                raise InputError(
                    f"[{SECTION}]: {key}: no rig has a camera "
                    f"{name!r}{did_you_mean(name, mounted_cameras)}"
                )

    def read_settings(self, network: Network) -> tuple[dict[str, GivenMounting], tuple[Base, ...]]:
        """The given mountings by camera, and the given bases."""
        radians = ANGLE_UNITS[network.angle_unit]
        mountings = read_mountings(SECTION, self.settings.get("mounting", {}), radians)
        return mountings, read_bases(SECTION, self.settings.get("bases", ()))

    def declare(self, network: Network, origin: Float[np.ndarray, "3"]) -> Contribution:
        images, radians = network.images, ANGLE_UNITS[network.angle_unit]
        given_mountings, bases = self.read_settings(network)
        labels, places, turns, free, pairs = [], [], [], [], []
        observed, observed_bases = [], []
        for rig, (reference, mountings, all_epochs) in self.mounted(network).items():
            if len(mountings) < 2:
                continue
            begin = len(labels)
            # The reference first; its mounting is the identity and held, so that all others are
            # relative to it.
            row_of_camera = {c: begin + k for k, c in enumerate(mountings)}
            for c, mounting in mountings.items():
                name = network.cameras[c].id
                known_mounting = given_mountings.get(name, NOTHING_GIVEN)
                if c == reference and name in given_mountings:
                    raise InputError(
                        f"[{SECTION}]: mounting.{name}: {name!r} is the reference camera of rig "
                        f"{rig!r}, which the others are mounted to; give theirs, or name another "
                        "reference"
                    )
                t, R = _start_mounting(mounting, known_mounting)
                labels.append(f"{name} of {rig}")
                places.append(t)
                turns.append(np.asarray(quaternion_from_matrix(R)))
                free.append(c != reference and ~np.repeat(known_mounting.is_held, 3))
                observed.append((row_of_camera[c], known_mounting))
            ids = {network.cameras[c].id: row_of_camera[c] for c in mountings}
            observed_bases += [
                (*(ids[name] for name in base.cameras), base)
                for base in bases
                if {*base.cameras} <= {*ids}
            ]
            for epoch in all_epochs.values():
                if len(epoch) > 1:
                    anchor = reference if reference in epoch else min(epoch)
                    pairs += [
                        (epoch[anchor], i, row_of_camera[anchor], row_of_camera[c])
                        for c, i in epoch.items()
                        if c != anchor
                    ]
        if not pairs:
            raise InputError(f"{self.source.name}: no epoch has images of two cameras")
        mounting = Table(
            MOUNTING,
            PoseValue(np.array(places), np.array(turns)),
            Pose(),
            np.array([np.broadcast_to(row, 6) for row in free]),
            labels,
            AXES,
            "mounting of",
        )
        # Exact: a thousandth of what image points give, as a length and as an angle at the median
        # distance, so that the normal equations stay well conditioned.
        sigma_across = sigma_across_rays(network)
        length = self.settings.get("sigma_position", EXACT_SIGMA * sigma_across)
        depth = np.median(
            np.linalg.norm(
                network.points.position[network.observations.point]
                - images.position[network.observations.image],
                axis=1,
            )
        )
        # The setting is in the unit of angles, its default in radians.
        angle = (
            self.settings.get("sigma_angle", EXACT_SIGMA * sigma_across / depth / radians) * radians
        )
        sigma = np.repeat([length, angle], 3) * np.ones((len(pairs), 1))
        observations = MOUNTED(tuple(np.array(pairs).T), np.zeros((len(pairs), 6)), sigma=sigma)
        sets = [observations, *observe_mountings(*zip(*observed))]
        if observed_bases:
            first_rows, second_rows, base = zip(*observed_bases)
            length, base_sigma = (
                np.array([getattr(b, n) for b in base]) for n in ("length", "sigma")
            )
            sets.append(
                BASES((np.array(first_rows), np.array(second_rows)), length, sigma=base_sigma)
            )
        return Contribution((mounting,), sets, ((MOUNTING, scale_position),))

    def scales(self, network: Network) -> list[float]:
        """The given bases, by those of the orientations of the images."""
        given_mountings, bases = self.read_settings(network)
        ratios = []
        for rig in self.mounted(network).values():
            position_of = {
                network.cameras[c].id: mounting.position
                for c, mounting in rig.mountings.items()
                if mounting is not None
            }
            lengths = [
                (known_mounting.length, np.linalg.norm(position_of[name]))
                for name, known_mounting in given_mountings.items()
                if name in position_of and known_mounting.length is not None
            ]
            lengths += [
                (
                    base.length,
                    np.linalg.norm(position_of[base.cameras[0]] - position_of[base.cameras[1]]),
                )
                for base in bases
                if {*base.cameras} <= {*position_of}
            ]
            ratios += [
                float(length / computed_length)
                for length, computed_length in lengths
                if computed_length > 0
            ]
        return ratios

    def mounted(self, network: Network) -> dict[str, MountedCameras]:
        """The rigs by name, with the mountings that the orientations of the images give."""
        images = network.images
        row = {id: i for i, id in enumerate(images.id)}
        M = np.array([np.asarray(matrix_from_omega_phi_kappa(a)) for a in images.angles])
        rigs: dict[str, dict[str, dict[int, int]]] = {}
        for rig, epoch, id in zip(self.rig, self.epoch, self.image):
            of_epoch = rigs.setdefault(rig, {}).setdefault(epoch, {})
            of_epoch[int(images.camera[row[id]])] = row[id]
        mounted_cameras = {}
        for rig, epochs in rigs.items():
            shared_epochs = [epoch for epoch in epochs.values() if len(epoch) > 1]
            reference = self._reference(shared_epochs or [*epochs.values()], network)
            mountings = _mountings(shared_epochs, reference, images.position, M)
            mounted_cameras[rig] = MountedCameras(reference, mountings, epochs)
        return mounted_cameras

    def _reference(self, epochs: Sequence[Mapping[int, int]], network: Network) -> int:
        ids = [camera.id for camera in network.cameras]
        cameras = Counter(c for epoch in epochs for c in epoch)
        reference_name = self.settings.get("reference")
        if reference_name in ids and ids.index(reference_name) in cameras:
            return ids.index(reference_name)
        if reference_name is not None and reference_name not in ids:
            raise InputError(
                f"[{SECTION}]: reference is {reference_name!r}, but there is no such camera"
            )
        return max(sorted(cameras), key=cameras.__getitem__, default=0)


NOTHING_GIVEN = GivenMounting(None, None, np.full(6, np.inf), None, (False, False))


def _start_mounting(mounting: MountedPose | None, known_mounting: GivenMounting) -> MountedPose:
    """The start value of a mounting: that of the orientations of the images, except for what is
    held; of a camera that nothing connects with the reference what is given, or its place."""
    t, R = mounting or MountedPose(np.zeros(3), np.eye(3))
    if known_mounting.position is not None and (mounting is None or known_mounting.is_held[0]):
        t = known_mounting.position
    if known_mounting.angles is not None and (mounting is None or known_mounting.is_held[1]):
        R = np.asarray(matrix_from_omega_phi_kappa(known_mounting.angles))
    return MountedPose(t, R)


def _mountings(
    epochs: Sequence[Mapping[int, int]],
    reference: int,
    position: Float[np.ndarray, "images 3"],
    M: Float[np.ndarray, "images 3 3"],
) -> dict[int, MountedPose | None]:
    """The mountings of the cameras; one that has no epoch with the reference by way of another."""
    cameras = sorted({c for epoch in epochs for c in epoch}, key=lambda c: c != reference)
    mountings: dict[int, MountedPose | None] = dict.fromkeys(cameras)
    mountings[reference] = MountedPose(np.zeros(3), np.eye(3))
    to_visit = [reference]
    for known_camera in to_visit:
        base = mountings[known_camera]
        assert base is not None
        for c in cameras:
            if mountings[c] is None and (
                step := _relative_pose(epochs, known_camera, c, position, M)
            ):
                # x_c = R·(M_known·(X − X_known) − t), and M_known = R_known·M_reference
                place = base.position + base.rotation.T @ step.position
                mountings[c] = MountedPose(place, step.rotation @ base.rotation)
                to_visit.append(c)
    return mountings


def _relative_pose(
    epochs: Sequence[Mapping[int, int]],
    base_camera: int,
    camera: int,
    position: Float[np.ndarray, "images 3"],
    M: Float[np.ndarray, "images 3 3"],
) -> MountedPose | None:
    """A camera in the frame of another, at the epoch with the median position; None without an
    epoch of both."""
    poses = [
        MountedPose(
            M[e[base_camera]] @ (position[e[camera]] - position[e[base_camera]]),
            M[e[camera]] @ M[e[base_camera]].T,
        )
        for e in epochs
        if base_camera in e and camera in e
    ]
    if not poses:
        return None
    # Of a whole epoch, not a mean of all: position and rotation of one epoch belong together, and a
    # mean of rotations from poor start values is none of them.
    t = np.array([t for t, _ in poses])
    return poses[np.linalg.norm(t - np.median(t, axis=0), axis=1).argmin()]
