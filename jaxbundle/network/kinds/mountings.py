"""Given mountings of the cameras of a rig: settings `mounting` and `bases` of the section `[rig]`.

    [rig]
    mounting.right = { position = [0.5, 0, 0], angles = [0, 0, 0], sigma_position = 1e-3 }
    bases = [{ cameras = ["left", "right"], length = 0.5, sigma = 1e-4 }]

A mounting is the camera in the frame of the reference camera of its rig: `position` of its
projection centre (object unit), and `angles` ω, φ, κ of the rotation from there to its own frame.
Each may be given alone. Without a σ it is held; `sigma_position` and `sigma_angle`, a number or one
for each axis, weight it, along the axes of the reference camera and about those of the camera
itself; `inf` says nothing of an axis, so that a common plane or parallel axes can be given. Instead
of both, `covariance` is that of position and angles, [6, 6]. A base is the distance of the
projection centres of two cameras. What is given holds for every rig that has the cameras.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.arguments import show
from jaxbundle.errors import InputError
from jaxbundle.geometry.rotations import matrix_from_omega_phi_kappa
from jaxbundle.leastsquares.declarations import Kind, ObservationSet
from jaxbundle.leastsquares.spaces import Posed
from jaxbundle.network.kinds.base import POSE_UNITS, check_settings, numbers
from jaxbundle.network.number_range import is_usable_sigma, sigma_of_setting, sigma_requirement

MOUNTING = "mounting"
AXES = ("X", "Y", "Z", "turn x", "turn y", "turn z")
KEYS = ("position", "angles", "sigma_position", "sigma_angle", "covariance")


def turn_of(D: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """The rotation vector of a small rotation, to second order."""
    return 0.5 * jnp.stack([D[1, 2] - D[2, 1], D[2, 0] - D[0, 2], D[0, 1] - D[1, 0]])


def mounting_minus_given(mounting: Posed, measured: Float[Array, "6"]) -> Float[Array, "6"]:
    """Position and rotation of a mounting minus the given position and ω, φ, κ; the rotation as a
    vector about the axes of the camera, which has no singular attitude."""
    turn = turn_of(mounting.rotation.matrix() @ matrix_from_omega_phi_kappa(measured[3:]).T)
    return jnp.concatenate([jnp.stack(mounting.centre) - measured[:3], turn])


def base_minus_given(
    first_pose: Posed, second_pose: Posed, length: Float[Array, ""]
) -> Float[Array, ""]:
    """The distance of two cameras of a rig minus the given one."""
    return jnp.linalg.norm(jnp.stack(first_pose.centre) - jnp.stack(second_pose.centre)) - length


GIVEN_MOUNTINGS = Kind(
    "given mountings", mounting_minus_given, (MOUNTING,), AXES, POSE_UNITS, snooped=""
)
BASES = Kind("bases", base_minus_given, (MOUNTING, MOUNTING), ("length",), "length", snooped="")


class GivenMounting(NamedTuple):
    """What is known of a mounting: position, and angles in radians, None where it is not given;
    `sigma` of position and rotation vector, infinite where nothing is observed, or their
    `covariance`; `is_held`: position, angles."""

    position: Float[np.ndarray, "3"] | None
    angles: Float[np.ndarray, "3"] | None
    sigma: Float[np.ndarray, "6"]
    covariance: Float[np.ndarray, "6 6"] | None
    is_held: tuple[bool, bool]

    @property
    def length(self) -> float | None:
        """The base to the reference camera; None if it is not determined."""
        is_known = self.is_held[0] or np.isfinite(self.sigma[:3]).all()
        length = 0.0 if self.position is None or not is_known else np.linalg.norm(self.position)
        return float(length) if length > 0 else None


class Base(NamedTuple):
    """The distance of the projection centres of two cameras, with its σ; object unit."""

    cameras: tuple[str, str]
    length: float
    sigma: float


def read_mountings(section: str, settings: Any, radians: float) -> dict[str, GivenMounting]:
    """The given mountings by camera; `radians` per angle unit.

    **Raises:** `InputError`."""
    if not isinstance(settings, Mapping):
        raise InputError(
            f"[{section}]: mounting is {show(settings)}; expected what is known of the "
            "mounting of each camera, such as mounting.right = { position = [0.5, 0, 0] }"
        )
    return {
        name: _read_mounting(f"{section}.mounting.{name}", mounting, radians)
        for name, mounting in settings.items()
    }


def _read_mounting(section: str, settings: Any, radians: float) -> GivenMounting:
    check_settings(section, settings, KEYS)
    unit = np.repeat([1.0, radians], 3)
    position = (
        numbers(section, "position", settings["position"], 3) if "position" in settings else None
    )
    angles = (
        numbers(section, "angles", settings["angles"], 3) * radians
        if "angles" in settings
        else None
    )
    if position is None and angles is None:
        raise InputError(f"[{section}]: give position, angles, or both")
    if "covariance" in settings:
        if {"sigma_position", "sigma_angle"} & {*settings}:
            raise InputError(f"[{section}]: give covariance, or sigma_position and sigma_angle")
        if angles is None or position is None:
            raise InputError(f"[{section}]: covariance is of position and angles; give both")
        C = _covariance(section, settings["covariance"]) * np.outer(unit, unit)
        C = _of_rotation_vector(C, angles)
        return GivenMounting(position, angles, np.sqrt(np.diag(C)), C, (False, False))
    sigma = np.full(6, np.inf)
    is_held = []
    for k, (name, value) in enumerate((("position", position), ("angle", angles))):
        key = f"sigma_{name}"
        if key in settings and value is None:
            raise InputError(f"[{section}]: {key} without {'position' if not k else 'angles'}")
        is_held.append(value is not None and key not in settings)
        if key in settings:
            sigma[3 * k : 3 * k + 3] = _sigmas(section, key, settings[key]) * unit[3 * k]
    return GivenMounting(position, angles, sigma, None, (is_held[0], is_held[1]))


def _sigmas(section: str, key: str, setting: Any) -> Float[np.ndarray, "3"]:
    """One σ for all axes, or three; inf: an axis of which nothing is known."""
    try:
        sigma = np.broadcast_to(np.asarray(setting, float), 3)
    except (TypeError, ValueError):
        sigma = np.zeros(3)
    # NaN is not positive either
    unusable = sigma[~(is_usable_sigma(sigma) | np.isposinf(sigma))]
    if len(unusable):
        raise InputError(
            f"[{section}]: {key} is {show(setting)}; expected one σ, or three, "
            f"{sigma_requirement(unusable[0])} (inf: nothing is known of an axis)"
        )
    return sigma


def _covariance(section: str, setting: Any) -> Float[np.ndarray, "6 6"]:
    try:
        C = np.array(setting, float)
        # 1e-9: rounding of numbers printed with nine digits
        scale = np.sqrt(np.outer(np.diag(C), np.diag(C)))
        good = C.shape == (6, 6) and (np.abs(C - C.T) <= 1e-9 * scale).all()
        good = good and np.isfinite(np.linalg.cholesky(C)).all()
    except (TypeError, ValueError, np.linalg.LinAlgError):
        good = False
    if not good:
        raise InputError(
            f"[{section}]: covariance: expected six rows of six numbers, symmetric and positive "
            "definite: of position and ω, φ, κ"
        )
    return C


def _of_rotation_vector(
    C: Float[np.ndarray, "6 6"], angles: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "6 6"]:
    """The covariance of position and rotation vector from that of position and ω, φ, κ."""
    R = matrix_from_omega_phi_kappa(angles)
    J = jax.jacfwd(lambda a: turn_of(matrix_from_omega_phi_kappa(a) @ R.T))(jnp.asarray(angles))
    J = np.block([[np.eye(3), np.zeros((3, 3))], [np.zeros((3, 3)), np.asarray(J)]])
    return J @ C @ J.T


def read_bases(section: str, settings: Any) -> tuple[Base, ...]:
    """The given bases.

    **Raises:** `InputError`."""
    if not isinstance(settings, Sequence) or isinstance(settings, str):
        raise InputError(
            f"[{section}]: bases is {show(settings)}; expected a list, such as "
            '[{ cameras = ["left", "right"], length = 0.5, sigma = 0.001 }]'
        )
    bases = []
    for k, base in enumerate(settings, 1):
        where = f"{section}.bases, {k}"
        check_settings(where, base, ("cameras", "length", "sigma"))
        cameras = base.get("cameras")
        pair = isinstance(cameras, list | tuple) and len(cameras) == 2
        if not pair or not all(isinstance(c, str) for c in cameras) or cameras[0] == cameras[1]:
            raise InputError(f"[{where}]: cameras is {show(cameras)}; expected two names")
        length, sigma = (
            # A length has the range of a coordinate, which is that of a σ.
            sigma_of_setting(f"[{where}]: {key}", base.get(key, np.nan))
            for key in ("length", "sigma")
        )
        bases.append(Base((cameras[0], cameras[1]), length, sigma))
    return tuple(bases)


def observe_mountings(
    rows: Sequence[int], mountings: Sequence[GivenMounting]
) -> list[ObservationSet]:
    """The observations of mountings (rows of the table) that have a σ: those whose axes are
    independent, and those with a covariance."""
    sets = []
    for name, correlated in (("given mountings", False), ("correlated mountings", True)):
        selected = [
            (row, mounting)
            for row, mounting in zip(rows, mountings)
            if (mounting.covariance is not None) == correlated and np.isfinite(mounting.sigma).any()
        ]
        if not selected:
            continue
        mounting_rows, selected_mountings = zip(*selected)
        measured = np.stack([_as_measured(mounting) for mounting in selected_mountings])
        uncertainty: dict[str, Any] = {
            "sigma": np.stack([mounting.sigma for mounting in selected_mountings])
        }
        if correlated:
            uncertainty = {
                "covariance": np.stack([mounting.covariance for mounting in selected_mountings])
            }
        sets.append(GIVEN_MOUNTINGS((np.array(mounting_rows),), measured, name=name, **uncertainty))
    return sets


def _as_measured(mounting: GivenMounting) -> Float[np.ndarray, "6"]:
    # What is not given has an infinite σ.
    parts = (np.zeros(3) if part is None else part for part in (mounting.position, mounting.angles))
    return np.concatenate([*parts])
