"""Attitudes measured by an INS: table `attitudes`, section `[attitude]`.

The camera is rotated relative to the INS by a boresight ΔM common to all images of a camera,
M = ΔM·M_INS (Cramer and Stallmann 2002). Residuals are ω, φ, κ of ΔMᵀ·M minus the measured ones.

Columns: `image`, `omega`, `phi`, `kappa` and their σ `somega`, `sphi`, `skappa`, in the project's
unit of angles. Section: `boresight = [omega, phi, kappa]` of ΔM, start values in that unit (0 if
not given), or by camera; `free = ["boresight"]`; `sigma = { boresight = … }` of its three angles.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.geometry import (
    matrix_from_omega_phi_kappa,
    omega_phi_kappa_near,
    quaternion_from_matrix,
)
from jaxbundle.leastsquares.declarations import Kind, Table
from jaxbundle.leastsquares.spaces import Posed, Rotation, Turned
from jaxbundle.network.columns import Columns
from jaxbundle.network.kinds.base import (
    Contribution,
    ObservationTable,
    Parameters,
    check_settings,
    positive_sigma,
    rows_of,
    three_by_camera,
)
from jaxbundle.network.tables import Network
from jaxbundle.network.units import ANGLE_UNITS

ANGLES = ("omega", "phi", "kappa")
SECTION = "attitude"


def attitude(pose: Posed, boresight: Turned, measured: Float[Array, "3"]) -> Float[Array, "3"]:
    """ω, φ, κ of ΔMᵀ·M, nearest to the measured ones, minus these."""
    # Angles and not a rotation vector: their σ are those of the instrument, about its axes.
    M = boresight.matrix().T @ pose.rotation.matrix()
    return omega_phi_kappa_near(M, measured) - measured


def boresight_misclosure(boresight: Turned, prior: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """The rotation vector of a boresight relative to the given one [3, 3], for small
    differences."""
    R = boresight.matrix() @ prior.T
    return 0.5 * jnp.stack([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])


ATTITUDE = Kind("attitudes", attitude, ("image", "boresight"), ANGLES, "angle")
PRIOR = Kind(
    "prior of boresight", boresight_misclosure, ("boresight",), ANGLES, "angle", snooped=""
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Attitudes(ObservationTable):
    """Attitudes and their σ, radians; `settings` in the unit of the table."""

    image: tuple[str, ...]
    angles: Float[np.ndarray, "n 3"]
    sigma: Float[np.ndarray, "n 3"]

    TABLE, SECTION, IMAGES = "attitudes", SECTION, ("image",)
    MEASURED = "angles"
    ANGLES_IN_SETTINGS = True

    @classmethod
    def from_columns(
        cls, table: Columns, settings: Mapping[str, Any], radians: float
    ) -> "Attitudes":
        sigmas = [f"s{a}" for a in ANGLES]
        table.check_names(("image", *ANGLES, *sigmas))
        check_settings(SECTION, settings, ("boresight", "free", "sigma"))
        Parameters.from_settings(SECTION, settings, ("boresight",))
        angles = np.stack([table.numbers(a, required=True) for a in ANGLES], 1)
        sigma = np.stack([positive_sigma(table, s) for s in sigmas], 1)
        return cls(
            image=table.ids("image"),
            angles=radians * angles,
            sigma=radians * sigma,
            settings=dict(settings),
            source=table.source,
        )

    def columns(self, radians: float) -> dict:
        columns = {"image": self.image}
        columns |= {a: self.angles[:, k] / radians for k, a in enumerate(ANGLES)}
        return columns | {f"s{a}": self.sigma[:, k] / radians for k, a in enumerate(ANGLES)}

    def number_of_equations(self) -> int:
        return 3

    def declare(self, network: Network, origin: Float[np.ndarray, "3"]) -> Contribution:
        images = network.images
        image = rows_of(self.image, images)
        camera, of_camera = np.unique(images.camera[image], return_inverse=True)
        cameras = [network.cameras[c].id for c in camera]
        radians = ANGLE_UNITS[network.angle_unit]
        parameters = Parameters.from_settings(SECTION, self.settings, ("boresight",))
        start_angles = self.settings.get("boresight", [0.0, 0.0, 0.0])
        M = np.stack(
            [
                np.asarray(matrix_from_omega_phi_kappa(radians * angles))
                for angles in three_by_camera(SECTION, "boresight", start_angles, cameras)
            ]
        )
        boresight = Table(
            "boresight",
            np.asarray(jax.vmap(quaternion_from_matrix)(M)),
            Rotation(),
            "boresight" in parameters.free,
            cameras,
            ANGLES,
            "boresight of camera",
        )
        observations = [ATTITUDE((image, of_camera), self.angles, sigma=self.sigma)]
        if "boresight" in parameters.sigma:
            sigma = radians * parameters.sigma["boresight"]
            observations.append(PRIOR((np.arange(len(M)),), M, sigma=sigma))
        return Contribution((boresight,), observations)
