"""Readings of a clinometer, levelled cameras: table `tilts`, section `[tilt]`.

Where Z of object space is up, the elevation of a camera axis a above the horizon is that of Mᵀ·a:

    e = arctan(Z/√(X² + Y²)) + e0        e0: the zero error of the clinometer, one for a camera

Two axes give both tilts of an image: `right` (x) and `view` (−z) of a camera that looks
horizontally, `right` and `up` (y) of one that looks down. A levelled camera: 0 and 0.

Columns: `image`, of `right`, `up`, `view` those that were read, and their σ `sright`, …, in the
unit of angles. Section: `free` and `sigma` of the zero errors `right`, `up`, `view` (held at 0).
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.errors import InputError
from jaxbundle.leastsquares.declarations import Kind, Table
from jaxbundle.leastsquares.spaces import Posed, Vector
from jaxbundle.network.columns import Columns
from jaxbundle.network.kinds.base import (
    Contribution,
    ObservationTable,
    Parameters,
    check_settings,
    positive_sigma,
    rows_of,
)
from jaxbundle.network.tables import Network
from jaxbundle.network.units import ANGLE_UNITS

CAMERA_AXES = {"right": (1.0, 0.0, 0.0), "up": (0.0, 1.0, 0.0), "view": (0.0, 0.0, -1.0)}
AXES = tuple(CAMERA_AXES)
ZEROS = tuple(f"zero {axis}" for axis in AXES)
# The elevation of an axis near the vertical says nothing of the tilt: its derivative is 0 at 90°,
# and at 80° a sixth of that of a horizontal axis.
STEEPEST = np.deg2rad(80.0)


def elevations(
    pose: Posed, zero: Float[Array, "3"], readings: Float[Array, "3"]
) -> Float[Array, "3"]:
    """Elevations of the axes of a camera minus the readings."""
    axes = [pose.rotation.apply_inverse(axis) for axis in CAMERA_AXES.values()]
    # The root has no derivative at 0: an axis that is exactly vertical, which is not read.
    level = [jnp.sqrt(jnp.maximum(x * x + y * y, 1e-30)) for x, y, _ in axes]
    elevation = [jnp.arctan2(z, h) for (_, _, z), h in zip(axes, level)]
    return jnp.stack(elevation) + zero - readings


TILT = Kind("tilts", elevations, ("image", "clinometer"), AXES, "angle")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tilts(ObservationTable):
    """Elevations of camera axes and their σ, radians; σ infinite: not read."""

    image: tuple[str, ...]
    elevation: Float[np.ndarray, "n 3"]
    sigma: Float[np.ndarray, "n 3"]

    TABLE, SECTION, IMAGES = "tilts", "tilt", ("image",)
    MEASURED = "elevation"
    ANGLES_IN_SETTINGS = True

    @classmethod
    def from_columns(cls, table: Columns, settings: Mapping[str, Any], radians: float) -> "Tilts":
        table.check_names(("image",), (*AXES, *(f"s{axis}" for axis in AXES)))
        check_settings(cls.SECTION, settings, ("free", "sigma"))
        Parameters.from_settings(cls.SECTION, settings, AXES)
        readings = np.stack([table.numbers(axis) for axis in AXES], 1) * radians
        sigma = np.stack([positive_sigma(table, f"s{a}", required=False) for a in AXES], 1)
        for row, k in np.argwhere(np.isnan(readings) != np.isnan(sigma))[:1]:
            expected = f"{AXES[k]} and s{AXES[k]}"
            raise InputError(f"{table.source(row)}: expected {expected}, got one of them")
        for row in np.flatnonzero(np.isnan(readings).all(1))[:1]:
            raise InputError(f"{table.source(row)}: nothing was read: expected {', '.join(AXES)}")
        for row, k in np.argwhere(np.abs(readings) > STEEPEST)[:1]:
            raise InputError(
                f"{table.source(row)}: {AXES[k]} is {readings[row, k] / radians:g}: an axis so "
                "near to the vertical does not show the tilt; expected the readings of the two "
                "others"
            )
        return cls(
            image=table.ids("image"),
            elevation=np.nan_to_num(readings),
            sigma=np.where(np.isnan(sigma), np.inf, sigma * radians),
            settings=dict(settings),
            source=table.source,
        )

    def columns(self, radians: float) -> dict:
        is_unread = np.isinf(self.sigma)
        readings, sigma = (
            np.where(is_unread, np.nan, x / radians).T for x in (self.elevation, self.sigma)
        )
        columns = dict(zip(AXES, readings)) | {f"s{a}": s for a, s in zip(AXES, sigma)}
        return {"image": self.image} | columns

    def number_of_equations(self) -> int:
        # Of every row: readings that are missing have infinite σ.
        return int(np.isfinite(self.sigma).sum(1).min(initial=2))

    def declare(self, network: Network, origin: Float[np.ndarray, "3"]) -> Contribution:
        image = rows_of(self.image, network.images)
        camera, of_camera = np.unique(network.images.camera[image], return_inverse=True)
        parameters = Parameters.from_settings(self.SECTION, self.settings, AXES)
        unit = ANGLE_UNITS[network.angle_unit]
        radians = {name: unit * s for name, s in parameters.sigma.items()}
        zero = Table(
            "clinometer",
            np.zeros((len(camera), 3)),
            Vector(3),
            np.tile(parameters.mask(AXES), (len(camera), 1)),
            [network.cameras[c].id for c in camera],
            ZEROS,
            "zero error of the clinometer of camera",
        )
        priors = dataclasses.replace(parameters, sigma=radians).priors(zero, AXES, "angle")
        observations = TILT((image, of_camera), self.elevation, sigma=self.sigma)
        return Contribution((zero,), (observations, *priors))
