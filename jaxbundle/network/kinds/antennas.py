"""Projection centres measured by GNSS: table `antennas`, section `[antenna]`.

The antenna is at the lever arm a from the projection centre, in the camera frame; every strip may
have a shift s and a drift d, and the exposure clock may differ from that of GNSS by δt (Ackermann
and Schade 1993; Kraus 2007, 5.2):

    X_A = X0 + Mᵀ·a + s + d·(t − ts) + V·δt − measured

ts: the mean time of the strip; V: the velocity, from the measured positions before and after.

| column | meaning |
|---|---|
| `image`, `X`, `Y`, `Z` | position of the antenna at the exposure, object unit |
| `sX`, `sY`, `sZ` | its σ; `rXY`, `rXZ`, `rYZ` its correlations, 0 if not given |
| `strip` | any text; without it all are one strip |
| `t` | seconds, for drifts and a time offset |

Section: `lever_arm = [ax, ay, az]` (0 if not given), or by camera `{ left = [...], … }`;
`free`: of `ax`, `ay`, `az`, `shift` (or `shift_X`, `shift_Y`, `shift_Z`), `drift`, `time_offset`;
`sigma`: a table of their prior σ.
"""

import dataclasses
import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Array, Float, Int

from jaxbundle.errors import InputError
from jaxbundle.leastsquares.declarations import Kind, Table
from jaxbundle.leastsquares.spaces import Change, Posed, Triple, Vector
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
from jaxbundle.types import Scalar

ARM = ("ax", "ay", "az")
PAIRS = tuple(itertools.combinations(range(3), 2))
SHIFTS = ("shift_X", "shift_Y", "shift_Z")
FREE = (*ARM, "shift", *SHIFTS, "drift", "time_offset")
AXES = ("X", "Y", "Z")
SECTION = "antenna"


def antenna_misclosure(
    pose: Posed,
    arm: Triple,
    strip: Change,
    clock: Change,
    measurement: tuple[Triple, Scalar, Triple],
) -> Triple:
    """The position of an antenna minus the measured one; `measurement`: the measured one, the
    time since the mean of the strip, the velocity."""
    measured, time, velocity = measurement
    return tuple(
        x + strip[k] + strip[3 + k] * time + velocity[k] * clock[0] - measured[k]
        for k, x in enumerate(pose.place(arm))
    )


POSITION = Kind(
    "antenna positions",
    antenna_misclosure,
    ("image", "lever arm", "GNSS strip", "GNSS clock"),
    AXES,
    "length",
    scalars=True,
    snooped="whole",
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Antennas(ObservationTable):
    """Positions of antennas; `covariance` in the square of the object unit."""

    image: tuple[str, ...]
    position: Float[np.ndarray, "n 3"]
    covariance: Float[np.ndarray, "n 3 3"]
    strip: tuple[str, ...]
    time: Float[np.ndarray, " n"]

    TABLE, SECTION, IMAGES = "antennas", SECTION, ("image",)
    GIVES_SCALE = True
    MEASURED = "position"

    @classmethod
    def from_columns(
        cls, table: Columns, settings: Mapping[str, Any], radians: float
    ) -> "Antennas":
        sigmas, pairs = [f"s{a}" for a in AXES], [f"r{AXES[i]}{AXES[j]}" for i, j in PAIRS]
        table.check_names(("image", *AXES, *sigmas), (*pairs, "strip", "t"))
        check_settings(SECTION, settings, ("lever_arm", "free", "sigma"))
        parameters = Parameters.from_settings(SECTION, settings, FREE)
        position = np.stack([table.numbers(a, required=True) for a in AXES], 1)
        sigma = np.stack([positive_sigma(table, s) for s in sigmas], 1)
        R = np.tile(np.eye(3), (len(table), 1, 1))
        for (i, j), name in zip(PAIRS, pairs):
            R[:, i, j] = R[:, j, i] = np.nan_to_num(table.numbers(name))
        # Three correlations that are each below 1 may still be no covariance together, and weights
        # need its inverse: rounding leaves 1e-16 where it is singular. NaN fails, too.
        for row in np.flatnonzero(~(np.linalg.eigvalsh(R).min(1) > 1e-12))[:1]:
            raise InputError(
                f"{table.source(row)}: the correlations {', '.join(pairs)} are impossible together"
            )
        time = table.numbers("t")
        if {"drift", "time_offset"} & {*parameters.free} and np.isnan(time).any():
            row = int(np.isnan(time).argmax())
            raise InputError(f"{table.source(row)}: t is missing; drift and time_offset need it")
        strip = table.ids("strip") if "strip" in table.values else ("all",) * len(table)
        return cls(
            image=table.ids("image"),
            position=position,
            strip=strip,
            time=time,
            covariance=R * sigma[:, :, None] * sigma[:, None, :],
            settings=dict(settings),
            source=table.source,
        )

    def columns(self, radians: float) -> dict:
        sigma = np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))
        R = self.covariance / sigma[:, :, None] / sigma[:, None, :]
        columns = {"image": self.image}
        columns |= {a: self.position[:, k] for k, a in enumerate(AXES)}
        columns |= {f"s{a}": sigma[:, k] for k, a in enumerate(AXES)}
        columns |= {f"r{AXES[i]}{AXES[j]}": R[:, i, j] for i, j in PAIRS}
        return (
            columns
            | {"strip": self.strip}
            | ({} if np.isnan(self.time).any() else {"t": self.time})
        )

    def begin(self, network: Network) -> Network:
        """Antenna positions serve as start values of projection centres: without the lever arm,
        which needs the rotation."""
        images = network.images
        row = {id: k for k, id in enumerate(self.image)}
        position = images.position.copy()
        for i, id in enumerate(images.id):
            if id in row and np.isnan(position[i]).any():
                position[i] = self.position[row[id]]
        return network.replace(images=dataclasses.replace(images, position=position))

    def number_of_equations(self) -> int:
        return 3

    def declare(self, network: Network, origin: Float[np.ndarray, "3"]) -> Contribution:
        images = network.images
        image = rows_of(self.image, images)
        camera, of_camera = np.unique(images.camera[image], return_inverse=True)
        strips, strip = np.unique(np.array(self.strip, dtype=object), return_inverse=True)
        parameters = _by_axis(Parameters.from_settings(SECTION, self.settings, FREE))
        cameras = [network.cameras[c].id for c in camera]
        lever_arm = self.settings.get("lever_arm", [0.0, 0.0, 0.0])
        arm = Table(
            "lever arm",
            three_by_camera(SECTION, "lever_arm", lever_arm, cameras),
            Vector(3),
            parameters.mask(ARM),
            cameras,
            ARM,
            "lever arm of camera",
        )
        # Velocities are numbers, not unknowns: their errors times the offset of a clock
        # (milliseconds) are far below the σ of a position.
        time_in_strip, velocity = _times_and_velocities(self.position, strip, self.time)
        if "time_offset" in parameters.free and not velocity.any():
            raise InputError(f"{self.source.name}: time_offset needs three positions in a strip")
        # One row a strip of shift and drift: a drift is that about the mean time, or it would be
        # correlated with the shift.
        groups = [*SHIFTS, *["drift"] * 3]
        names = ("shift X", "shift Y", "shift Z", "drift X", "drift Y", "drift Z")
        shift = Table(
            "GNSS strip",
            np.zeros((len(strips), 6)),
            Vector(6),
            parameters.mask(groups),
            list(strips),
            names,
        )
        clock = Table(
            "GNSS clock",
            np.zeros((1, 1)),
            Vector(1),
            parameters.mask(["time_offset"]),
            ["offset"],
            ("seconds",),
        )
        observations = POSITION(
            (image, of_camera, strip, np.zeros(len(self), int)),
            (self.position - origin, time_in_strip, velocity),
            covariance=self.covariance,
        )
        priors = (
            *parameters.priors(arm, ARM, "length"),
            *parameters.priors(shift, groups, ("length",) * 3 + ("velocity",) * 3),
            *parameters.priors(clock, ["time_offset"], "time"),
        )
        return Contribution(
            (arm, shift, clock), (observations, *priors), (("GNSS strip", _shift_back),)
        )


def _by_axis(parameters: Parameters) -> Parameters:
    """The parameters with a shift of all axes as one of each."""
    names = lambda name: SHIFTS if name == "shift" else (name,)
    free = tuple(dict.fromkeys(n for name in parameters.free for n in names(name)))
    sigma = {n: s for name, s in parameters.sigma.items() for n in names(name)}
    return Parameters(FREE, free, sigma)


def _shift_back(motion: Float[Array, "7"], strip: Float[Array, "6"]) -> Float[Array, "6"]:
    """The shifts of strips that compensate a shift of object space: if all are free, it is open."""
    return strip.at[:3].add(-motion[:3])


def _times_and_velocities(
    position: Float[np.ndarray, "rows 3"],
    strip: Int[np.ndarray, " rows"],
    time: Float[np.ndarray, " rows"],
) -> tuple[Float[np.ndarray, " rows"], Float[np.ndarray, "rows 3"]]:
    """The time of every position since the mean of its strip, and the velocity there (0 if a strip
    has fewer than three)."""
    time_in_strip, velocity = np.zeros(len(time)), np.zeros_like(position)
    if np.isnan(time).any():
        return time_in_strip, velocity
    for s in range(strip.max() + 1 if len(strip) else 0):
        rows = np.flatnonzero(strip == s)
        time_in_strip[rows] = time[rows] - time[rows].mean()
        # Central differences need two neighbours; equal times have none.
        if len(np.unique(time[rows])) == len(rows) >= 3:
            order = rows[np.argsort(time[rows])]
            velocity[order] = np.gradient(position[order], time[order], axis=0)
    return time_in_strip, velocity
