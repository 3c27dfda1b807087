"""Cameras whose lines are exposed one after the other, and move meanwhile: table `velocities`,
section `[rolling_shutter]`.

Line v is exposed at t = τ·(v − vm), vm the middle line, at which the exterior orientation holds
(Meingast et al. 2005; Vautherin et al. 2016):

    X0(t) = X0 + V·t        M(t) = exp([ω·t]×)·M

V in object space, ω about the axes of the camera. The line is the measured one, so that the image
coordinates stay explicit.

Columns: `image`, and of `vX`, `vY`, `vZ` (object unit a second), `wx`, `wy`, `wz` (radians a
second) the start values, 0 if not given; `svX` … `swz`: their prior σ. All images of the cameras
with a line time move; those without a row start at rest.

Section: `line_time = 3e-5`, seconds a line, or by camera `{ left = 3e-5 }`, cameras that are not
named have none; `free`: of `vX` … `wz` and `line_time`; `sigma`: a table of prior σ of the start
values, of all images alike where a row has none of its own. Velocities and the line time cannot
be free together without any prior: only their product shows.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbundle.arguments import shown
from jaxbundle.errors import InputError
from jaxbundle.geometry import matrix_from_rotation_vector
from jaxbundle.leastsquares.declarations import Kind, Table
from jaxbundle.leastsquares.spaces import Vector
from jaxbundle.network.columns import Columns, did_you_mean
from jaxbundle.network.further.base import (
    Declared,
    Further,
    Parameters,
    check_settings,
    less,
    positive_sigma,
    rows_of,
)
from jaxbundle.network.rules import check_unique
from jaxbundle.network.units import to_image_unit

VELOCITY = ("vX", "vY", "vZ", "wx", "wy", "wz")
FREE = (*VELOCITY, "line_time")
SECTION = "rolling_shutter"
VELOCITIES, READ_OUT = "velocity", "read-out"
"""The tables of velocities, a row an image, and of line times, a row a camera."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RollingShutter(Further):
    """Velocities of images; σ NaN: no prior of its own."""

    image: tuple[str, ...]
    velocity: Float[np.ndarray, "n 6"]
    sigma: Float[np.ndarray, "n 6"]

    TABLE, SECTION, IMAGES = "velocities", SECTION, ("image",)

    @classmethod
    def of(cls, table: Columns, settings: Mapping[str, Any], radians: float) -> "RollingShutter":
        sigmas = tuple(f"s{name}" for name in VELOCITY)
        table.check_names(("image",), (*VELOCITY, *sigmas))
        check_settings(SECTION, settings, ("line_time", "free", "sigma"))
        Parameters.of(SECTION, settings, FREE)
        if "line_time" not in settings:
            raise InputError(f"[{SECTION}]: line_time is missing, seconds from a line to the next")
        sigma = [positive_sigma(table, name, required=False) for name in sigmas]
        return cls(
            image=table.ids("image"), sigma=np.stack(sigma, 1), settings=dict(settings),
            velocity=np.nan_to_num(np.stack([table.numbers(name) for name in VELOCITY], 1)),
            source=table.source,
        )  # fmt: skip

    def columns(self, radians: float) -> dict:
        columns = {"image": self.image}
        columns |= {name: self.velocity[:, k] for k, name in enumerate(VELOCITY)}
        return columns | {f"s{name}": self.sigma[:, k] for k, name in enumerate(VELOCITY)}

    def number_of_equations(self) -> int:
        return 0

    def check(self, network) -> None:
        super().check(network)
        check_unique(self.image, self.source, "image")
        given, ids = self.settings["line_time"], [camera.id for camera in network.cameras]
        for id in given if isinstance(given, Mapping) else ():
            if id not in ids:
                raise InputError(f"[{SECTION}]: line_time names no camera {id!r}"
                                 f"{did_you_mean(id, ids)}")  # fmt: skip

    def line_times(self, network) -> Float[np.ndarray, " cameras"]:
        """Seconds a line of every camera, 0 of those that expose all at once."""
        given = self.settings["line_time"]
        ids = [camera.id for camera in network.cameras]
        by_camera = given if isinstance(given, Mapping) else dict.fromkeys(ids, given)
        for value in by_camera.values():
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise InputError(f"[{SECTION}]: line_time is {shown(value)}; a number is expected")
        return np.array([float(by_camera.get(id, 0.0)) for id in ids])

    def lines(self, network) -> Float[np.ndarray, " rays"]:
        """How many lines every image point was measured after the middle one."""
        rays, of = network.observations, network.images.camera[network.observations.image]
        moving = self.line_times(network)[of] != 0
        lines = np.zeros(len(rays))
        for c in np.unique(of[moving]):
            camera, own = network.cameras[c], of == c
            if camera.image_size is None:
                raise InputError(
                    f"camera {camera.id!r}: image_size is needed to know when a line was exposed"
                )
            xy, sigma = rays.xy[own], rays.sigma[own]
            uv, _ = to_image_unit(network.cameras, of[own], xy, sigma, "px")
            lines[own] = uv[:, 1] - (camera.image_size[1] - 1) / 2
        return lines

    def declare(self, network, origin) -> Declared:
        images, parameters = network.images, Parameters.of(SECTION, self.settings, FREE)
        times = self.line_times(network)
        velocity, sigma = np.zeros((len(images), 6)), np.full((len(images), 6), np.nan)
        given = rows_of(self.image, images)
        velocity[given], sigma[given] = self.velocity, self.sigma
        common = np.array([parameters.sigma.get(name, np.inf) for name in VELOCITY])
        sigma = np.where(np.isnan(sigma), common, sigma)
        free = parameters.mask(VELOCITY) & (times != 0)[images.camera][:, None]
        moves = Table(VELOCITIES, velocity, Vector(6), free, images.id, VELOCITY,
                      "velocity of image")  # fmt: skip
        known = parameters.mask(["line_time"]) & (times != 0)[:, None]
        read_out = Table(
            READ_OUT, times[:, None], Vector(1), known, [camera.id for camera in network.cameras],
            ("line_time",), "read-out of camera",
        )  # fmt: skip
        priors = list(parameters.priors(read_out, ["line_time"]))
        weighted = np.flatnonzero((np.isfinite(sigma) & (free > 0)).any(1))
        if len(weighted):
            sigma = np.where(free > 0, sigma, np.inf)[weighted]
            priors.append(PRIOR((weighted,), velocity[weighted], sigma=sigma))
        return Declared((moves, read_out), priors, ((VELOCITIES, _move_velocity),))


PRIOR = Kind("velocities", less, (VELOCITIES,), VELOCITY, snooped="")


def _move_velocity(motion, value):
    """Velocities of object space turn and grow with it; those of the camera do not."""
    V = jnp.exp(motion[6]) * matrix_from_rotation_vector(motion[3:6]) @ value[:3]
    return jnp.concatenate([V, value[3:]])
