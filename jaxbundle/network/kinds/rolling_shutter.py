"""Moving cameras with a rolling shutter: table `velocities`, section `[rolling_shutter]`.

Line v is exposed at t = τ·(v − vm), vm the middle line, at which the exterior orientation holds
(Meingast et al. 2005; Vautherin et al. 2016):

    X0(t) = X0 + V·t        M(t) = exp([ω·t]×)·M

V in object space, ω about the camera axes; the residual of an image point is `MovingImagePoint` of
`image_points.py`. v is the measured line, so that the image coordinates
stay explicit.

Columns: `image`, and start values of `vX`, `vY`, `vZ` (object unit per second), `wx`, `wy`, `wz`
(radians per second), default 0; `svX` … `swz`: their prior σ. All images of cameras with a line
time have velocities; those without a row start at rest. `t`, the time of exposure in seconds, and
`strip` (default: all one) for velocities from neighbours.

Section: `line_time = 3e-5`, seconds per line, or by camera `{ left = 3e-5 }` (others have none);
`free`: of `vX` … `wz` and `line_time`; `sigma`: a table of prior σ of the start values, for all
images without their own. Velocities and the line time cannot be free together without a prior: only
their product is determined. `neighbours = { v = 0.5, w = 0.02 }`: a velocity equals, within these
σ, that between the preceding and the following image (of the same camera and strip; at the ends the
image itself replaces the missing one).
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxbundle.arguments import number, show
from jaxbundle.errors import InputError
from jaxbundle.geometry import matrix_from_rotation_vector, rotation_vector_from_matrix
from jaxbundle.leastsquares.declarations import Kind, ObservationSet, Table
from jaxbundle.leastsquares.spaces import Posed, Vector
from jaxbundle.network.columns import Columns, did_you_mean
from jaxbundle.network.kinds.base import (
    Contribution,
    ObservationTable,
    Parameters,
    check_settings,
    computed_minus_given,
    positive_sigma,
    rows_of,
)
from jaxbundle.network.number_range import sigma_of_setting
from jaxbundle.network.rules import check_unique
from jaxbundle.network.tables import Network
from jaxbundle.network.units import to_image_unit

VELOCITY = ("vX", "vY", "vZ", "wx", "wy", "wz")
FREE = (*VELOCITY, "line_time")
SECTION = "rolling_shutter"
# The tables of velocities, one row per image, and of line times, one row per camera.
VELOCITIES, READ_OUT = "velocity", "read-out"


@dataclasses.dataclass(frozen=True, kw_only=True)
class RollingShutter(ObservationTable):
    """Velocities of images; σ NaN: no individual prior."""

    image: tuple[str, ...]
    velocity: Float[np.ndarray, "n 6"]
    sigma: Float[np.ndarray, "n 6"]
    time: Float[np.ndarray, " n"]
    strip: tuple[str, ...]

    TABLE, SECTION, IMAGES = "velocities", SECTION, ("image",)
    CHANGES_IMAGE_POINTS = True

    @classmethod
    def from_columns(
        cls, table: Columns, settings: Mapping[str, Any], radians: float
    ) -> "RollingShutter":
        sigmas = tuple(f"s{name}" for name in VELOCITY)
        table.check_names(("image",), (*VELOCITY, *sigmas, "t", "strip"))
        check_settings(SECTION, settings, ("line_time", "free", "sigma", "neighbours"))
        _check_neighbours(settings.get("neighbours", {}), table)
        Parameters.from_settings(SECTION, settings, FREE)
        if "line_time" not in settings:
            raise InputError(f"[{SECTION}]: line_time is missing, seconds from a line to the next")
        sigma = [positive_sigma(table, name, required=False) for name in sigmas]
        return cls(
            image=table.ids("image"),
            sigma=np.stack(sigma, 1),
            settings=dict(settings),
            velocity=np.nan_to_num(np.stack([table.numbers(name) for name in VELOCITY], 1)),
            time=table.numbers("t"),
            source=table.source,
            strip=table.ids("strip") if "strip" in table.values else ("all",) * len(table),
        )

    def columns(self, radians: float) -> dict:
        columns = {"image": self.image}
        columns |= {name: self.velocity[:, k] for k, name in enumerate(VELOCITY)}
        columns |= {f"s{name}": self.sigma[:, k] for k, name in enumerate(VELOCITY)}
        timed = not np.isnan(self.time).all()
        return columns | ({"t": self.time, "strip": self.strip} if timed else {})

    def number_of_equations(self) -> int:
        return 0

    def check(self, network: Network) -> None:
        super().check(network)
        check_unique(self.image, self.source, "image")
        line_time, ids = self.settings["line_time"], [camera.id for camera in network.cameras]
        for id in line_time if isinstance(line_time, Mapping) else ():
            if id not in ids:
                raise InputError(
                    f"[{SECTION}]: line_time names no camera {id!r}{did_you_mean(id, ids)}"
                )

    def line_times(self, network: Network) -> Float[np.ndarray, " cameras"]:
        """Seconds per line of every camera, 0 for a global shutter."""
        line_time = self.settings["line_time"]
        ids = [camera.id for camera in network.cameras]
        by_camera = line_time if isinstance(line_time, Mapping) else {id: line_time for id in ids}
        times = {id: number(f"[{SECTION}]: line_time", value) for id, value in by_camera.items()}
        return np.array([times.get(id, 0.0) for id in ids])

    def lines(self, network: Network) -> Float[np.ndarray, " rays"]:
        """The line of every image point relative to the middle one."""
        rays, camera_of_ray = (
            network.observations,
            network.images.camera[network.observations.image],
        )
        # Relative to the middle line, so that the pose of an image is that of its middle exposure.
        is_moving = self.line_times(network)[camera_of_ray] != 0
        lines = np.zeros(len(rays))
        for c in np.unique(camera_of_ray[is_moving]):
            camera, mask = network.cameras[c], camera_of_ray == c
            if camera.image_size is None:
                raise InputError(
                    f"camera {camera.id!r}: image_size is needed for the exposure time of a line"
                )
            xy, sigma = rays.xy[mask], rays.sigma[mask]
            uv, _ = to_image_unit(network.cameras, camera_of_ray[mask], xy, sigma, "px")
            lines[mask] = uv[:, 1] - (camera.image_size[1] - 1) / 2
        return lines

    def declare(self, network: Network, origin: Float[np.ndarray, "3"]) -> Contribution:
        images, parameters = network.images, Parameters.from_settings(SECTION, self.settings, FREE)
        times = self.line_times(network)
        velocity, sigma = np.zeros((len(images), 6)), np.full((len(images), 6), np.nan)
        rows = rows_of(self.image, images)
        velocity[rows], sigma[rows] = self.velocity, self.sigma
        common = np.array([parameters.sigma.get(name, np.inf) for name in VELOCITY])
        sigma = np.where(np.isnan(sigma), common, sigma)
        # A camera with a global shutter is in the same tables with a read-out of 0: held, it has no
        # unknowns, and all image points have one formula.
        free = parameters.mask(VELOCITY) & (times != 0)[images.camera][:, None]
        moves = Table(
            VELOCITIES, velocity, Vector(6), free, images.id, VELOCITY, "velocity of image"
        )
        free_line_time = parameters.mask(["line_time"]) & (times != 0)[:, None]
        read_out = Table(
            READ_OUT,
            times[:, None],
            Vector(1),
            free_line_time,
            [camera.id for camera in network.cameras],
            ("line_time",),
            "read-out of camera",
        )
        priors = list(parameters.priors(read_out, ["line_time"]))
        sigma = np.where(free > 0, sigma, np.inf)
        weighted = np.flatnonzero(np.isfinite(sigma).any(1))
        if len(weighted):
            priors.append(PRIOR((weighted,), velocity[weighted], sigma=sigma[weighted]))
        priors += self._from_neighbours(network, free)
        return Contribution((moves, read_out), priors, ((VELOCITIES, _move_velocity),))

    def _from_neighbours(
        self, network: Network, free: Bool[np.ndarray, "images 6"]
    ) -> list[ObservationSet]:
        """Velocities between the preceding and following images, as observations."""
        neighbour_sigma = self.settings.get("neighbours", {})
        sigma = np.repeat([neighbour_sigma.get("v", np.inf), neighbour_sigma.get("w", np.inf)], 3)
        image, rows = rows_of(self.image, network.images), []
        camera = network.images.camera[image]
        # Within a strip of one camera: between strips the platform turns.
        for strip in sorted({*zip(camera.tolist(), self.strip)} if neighbour_sigma else ()):
            mask = np.array([pair == strip for pair in zip(camera.tolist(), self.strip)])
            order = np.flatnonzero(mask)[np.argsort(self.time[mask], kind="stable")]
            if len(order) > 1:
                preceding, following = (order[0], *order[:-1]), (*order[1:], order[-1])
                rows.append(np.stack([order, preceding, following]))
        if not rows:
            return []
        middle, preceding, following = np.concatenate(rows, 1)
        # Equal times (bursts written to the second) give no velocity.
        moves = free[image[middle]].any(1) & (self.time[following] > self.time[preceding])
        middle, preceding, following = middle[moves], preceding[moves], following[moves]
        sigma = np.where(free[image[middle]] > 0, sigma, np.inf)
        time = self.time[following] - self.time[preceding]
        return [NEIGHBOURS((image[middle], image[preceding], image[following]), time, sigma=sigma)]


def between_neighbours(
    velocity: Float[Array, "6"], preceding: Posed, following: Posed, time: Float[Array, ""]
) -> Float[Array, "6"]:
    """A velocity minus that from the preceding to the following pose."""
    shift = jnp.stack([b - a for a, b in zip(preceding.centre, following.centre)])
    turn = rotation_vector_from_matrix(following.rotation.matrix() @ preceding.rotation.matrix().T)
    return velocity - jnp.concatenate([shift, turn]) / time


def _check_neighbours(neighbours: Any, table: Columns) -> None:
    if not isinstance(neighbours, Mapping) or set(neighbours) - {"v", "w"}:
        raise InputError(
            f"[{SECTION}]: neighbours is {show(neighbours)}; expected the σ of velocities and "
            f"turns, {{ v = 0.5, w = 0.02 }}"
        )
    for name, value in neighbours.items():
        sigma_of_setting(f"[{SECTION}]: neighbours, σ of {name}", value)
    for row in np.flatnonzero(np.isnan(table.numbers("t")))[:1]:
        if neighbours:
            raise InputError(
                f"{table.source(row)}: t, the time of exposure, is missing, which "
                f"[{SECTION}] neighbours needs"
            )


NEIGHBOURS = Kind(
    "velocities of neighbours",
    between_neighbours,
    (VELOCITIES, "image", "image"),
    VELOCITY,
    snooped="",
)
PRIOR = Kind("velocities", computed_minus_given, (VELOCITIES,), VELOCITY, snooped="")


def _move_velocity(motion: Float[Array, "7"], value: Float[Array, "6"]) -> Float[Array, "6"]:
    """Velocities in object space rotate and scale with it; those in the camera frame do not."""
    V = jnp.exp(motion[6]) * matrix_from_rotation_vector(motion[3:6]) @ value[:3]
    return jnp.concatenate([V, value[3:]])
