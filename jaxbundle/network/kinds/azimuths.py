"""Azimuths of images, of a compass or by the sun: table `azimuths`, section `[azimuth]`.

Clockwise from Y (grid north) to the horizontal direction of a camera axis, with a declination that
is common to the images of a camera:

    A = arctan(X/Y) − D,        (X, Y, Z) = Mᵀ·a

Columns: `image`, `value`, `sigma` in the unit of angles; `axis`, `view` (the viewing direction, if
not given), `up` (the y axis, of a camera that looks down) or `right`. Section: `declination`, of
magnetic against grid north, east positive, as a start value (0); `free = ["declination"]`, `sigma =
{ declination = … }`. An azimuth of the sun has none.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbundle.arguments import number
from jaxbundle.errors import InputError
from jaxbundle.leastsquares.declarations import Kind, Table
from jaxbundle.leastsquares.spaces import Posed
from jaxbundle.network.columns import Columns, did_you_mean
from jaxbundle.network.kinds.base import (
    Contribution,
    ObservationTable,
    Parameters,
    check_settings,
    positive_sigma,
    rows_of,
)
from jaxbundle.network.kinds.tilts import CAMERA_AXES
from jaxbundle.network.tables import Network
from jaxbundle.network.units import ANGLE_UNITS
from jaxbundle.types import Scalar

SECTION = "azimuth"


@dataclasses.dataclass(frozen=True)
class AxisAzimuth:
    """The azimuth of a camera axis minus the measured one, on the circle."""

    axis: tuple[float, float, float]

    def __call__(self, pose: Posed, declination: Scalar, measured: Scalar) -> Scalar:
        X, Y, _ = pose.rotation.apply_inverse(self.axis)
        # Turned to where the measured direction is north: 359° and 1° differ by 2°.
        north = measured + declination
        c, s = jnp.cos(north), jnp.sin(north)
        return jnp.arctan2(X * c - Y * s, X * s + Y * c)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Azimuths(ObservationTable):
    """Azimuths and their σ, radians."""

    image: tuple[str, ...]
    value: Float[np.ndarray, " n"]
    sigma: Float[np.ndarray, " n"]
    axis: tuple[str, ...]

    TABLE, SECTION, IMAGES = "azimuths", SECTION, ("image",)
    ANGLES_IN_SETTINGS = True

    @classmethod
    def from_columns(
        cls, table: Columns, settings: Mapping[str, Any], radians: float
    ) -> "Azimuths":
        table.check_names(("image", "value", "sigma"), ("axis",))
        check_settings(SECTION, settings, ("declination", "free", "sigma"))
        Parameters.from_settings(SECTION, settings, ("declination",))
        number(f"[{SECTION}]: declination", settings.get("declination", 0.0))
        n = len(table)
        axis = table.ids("axis") if "axis" in table.values else ("view",) * n
        for row, word in enumerate(axis):
            if word not in CAMERA_AXES:
                raise InputError(
                    f"{table.source(row)}: axis is {word!r}{did_you_mean(word, CAMERA_AXES)}"
                )
        sigma = positive_sigma(table, "sigma")
        return cls(
            image=table.ids("image"),
            value=radians * table.numbers("value", required=True),
            sigma=radians * sigma,
            axis=axis,
            settings=dict(settings),
            source=table.source,
        )

    def columns(self, radians: float) -> dict:
        numbers = {"value": self.value / radians, "sigma": self.sigma / radians}
        return {"image": self.image, **numbers, "axis": self.axis}

    def declare(self, network: Network, origin: Float[np.ndarray, "3"]) -> Contribution:
        image = rows_of(self.image, network.images)
        camera, of_camera = np.unique(network.images.camera[image], return_inverse=True)
        parameters = Parameters.from_settings(SECTION, self.settings, ("declination",))
        radians = ANGLE_UNITS[network.angle_unit]
        start = radians * float(self.settings.get("declination", 0.0))
        labels = [network.cameras[c].id for c in camera]
        free = "declination" in parameters.free
        value = np.full(len(camera), start)
        north = Table("declination", value, free=free, labels=labels, parameters=("declination",))
        scaled = {name: radians * sigma for name, sigma in parameters.sigma.items()}
        parameters = dataclasses.replace(parameters, sigma=scaled)
        sets = [
            Kind(
                "azimuths", AxisAzimuth(CAMERA_AXES[axis]), ("image", north.name), ("A",), "angle"
            )((image[rows], of_camera[rows]), self.value[rows], sigma=self.sigma[rows])
            for axis in CAMERA_AXES
            if len(rows := np.flatnonzero([word == axis for word in self.axis]))
        ]
        priors = parameters.priors(north, ("declination",), "angle")
        return Contribution((north,), (*sets, *priors))
