"""Given orientations and camera parameters that differ from the start values: tables
`exterior_priors` and `camera_priors`.

A σ in the tables of images or cameras is that of the start value. Where the observed value is
another one, such as in the adjusted network of a result, it has a row here: a pseudo-observation of
an unknown with its own value.

| table | columns |
|---|---|
| `exterior_priors` | `image`, `X0`, `Y0`, `Z0`, `omega`, `phi`, `kappa` and their σ; both empty: not given |
| `camera_priors` | `camera`, `parameter`, `value`, `sigma` |
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbundle.cameras import get_model
from jaxbundle.errors import InputError
from jaxbundle.geometry import omega_phi_kappa_near
from jaxbundle.leastsquares.declarations import Kind
from jaxbundle.network.camera_tables import camera_tables
from jaxbundle.network.columns import Columns, did_you_mean
from jaxbundle.network.further.base import Declared, Further, less, positive_sigma, rows_of
from jaxbundle.network.tables import EXTERIOR


def exterior(pose, given):
    """Projection centre and ω, φ, κ (on the branch of the given ones) minus the given values
    [6]."""
    angles = omega_phi_kappa_near(pose.rotation.matrix(), given[3:])
    return jnp.concatenate([jnp.stack(pose.centre), angles]) - given


EXTERIOR_PRIOR = Kind("exterior orientation", exterior, ("image",), EXTERIOR, snooped="")


def interior_orientation(camera: str, parameters: tuple[str, ...]) -> Kind:
    """Priors of the parameters of the cameras of a table."""
    return Kind("interior orientation", less, (camera,), parameters, snooped="", invariant=True)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ExteriorPriors(Further):
    """Given exterior orientations [n, 6], angles in radians; σ is infinite where none is given."""

    image: tuple[str, ...]
    value: Float[np.ndarray, "n 6"]
    sigma: Float[np.ndarray, "n 6"]

    TABLE, IMAGES, MEASURED = "exterior_priors", ("image",), "value"

    @classmethod
    def of(cls, table: Columns, settings: Mapping[str, Any], radians: float) -> "ExteriorPriors":
        sigmas = [f"s{name}" for name in EXTERIOR]
        table.check_names(("image", *EXTERIOR, *sigmas))
        unit = np.array([1, 1, 1, radians, radians, radians])
        value = np.stack([table.numbers(name) for name in EXTERIOR], 1) * unit
        sigma = np.stack([positive_sigma(table, s, required=False) for s in sigmas], 1) * unit
        for row, k in np.argwhere(np.isnan(value) != np.isnan(sigma))[:1]:
            raise InputError(f"{table.source(row)}: {EXTERIOR[k]} and s{EXTERIOR[k]}: give both or "
                             "neither")  # fmt: skip
        return cls(image=table.ids("image"), value=np.nan_to_num(value),
                   sigma=np.where(np.isnan(sigma), np.inf, sigma), source=table.source)  # fmt: skip

    def columns(self, radians: float) -> dict:
        unit = np.array([1, 1, 1, radians, radians, radians])
        given = np.isfinite(self.sigma)
        value, sigma = (np.where(given, x, np.nan) / unit for x in (self.value, self.sigma))
        columns: dict[str, Any] = {"image": self.image}
        columns |= {name: value[:, k] for k, name in enumerate(EXTERIOR)}
        return columns | {f"s{name}": sigma[:, k] for k, name in enumerate(EXTERIOR)}

    def number_of_equations(self) -> int:
        return int(np.isfinite(self.sigma).sum(1).min(initial=len(EXTERIOR)))

    def declare(self, network, origin) -> Declared:
        shift = np.concatenate([origin, np.zeros(3)])
        value = np.where(np.isfinite(self.sigma), self.value - shift, 0.0)
        return Declared((), (
            EXTERIOR_PRIOR((rows_of(self.image, network.images),), value, sigma=self.sigma),
        ))  # fmt: skip


@dataclasses.dataclass(frozen=True, kw_only=True)
class CameraPriors(Further):
    """Given camera parameters, in the unit of the model."""

    camera: tuple[str, ...]
    parameter: tuple[str, ...]
    value: Float[np.ndarray, " n"]
    sigma: Float[np.ndarray, " n"]

    TABLE, MEASURED = "camera_priors", "value"

    @classmethod
    def of(cls, table: Columns, settings: Mapping[str, Any], radians: float) -> "CameraPriors":
        table.check_names(("camera", "parameter", "value", "sigma"))
        return cls(
            camera=table.ids("camera"), parameter=table.ids("parameter"),
            value=table.numbers("value", required=True), sigma=positive_sigma(table, "sigma"),
            source=table.source,
        )  # fmt: skip

    def columns(self, radians: float) -> dict:
        return {"camera": self.camera, "parameter": self.parameter, "value": self.value.tolist(),
                "sigma": self.sigma.tolist()}  # fmt: skip

    def __len__(self) -> int:
        return len(self.camera)

    def _present(self, network) -> np.ndarray:
        known = {camera.id for camera in network.cameras}
        return np.array([id in known for id in self.camera], bool)

    def check(self, network) -> None:
        cameras = {camera.id: camera for camera in network.cameras}
        seen = set()
        for row, (id, name) in enumerate(zip(self.camera, self.parameter)):
            if id not in cameras:
                raise InputError(
                    f"{self.source(row)}: camera {id!r} is unknown{did_you_mean(id, cameras)}"
                )
            free = cameras[id].unknowns
            if name not in free:
                known = get_model(cameras[id].model).parameters
                why = "is held" if name in known else "is unknown"
                raise InputError(
                    f"{self.source(row)}: {name!r} of camera {id!r} {why}; expected one of its "
                    f"free parameters{did_you_mean(name, free)}"
                )
            if (id, name) in seen:
                raise InputError(f"{self.source(row)}: {name!r} of camera {id!r} is given twice")
            seen.add((id, name))

    def declare(self, network, origin) -> Declared:
        index = {camera.id: c for c, camera in enumerate(network.cameras)}
        camera = np.array([index[id] for id in self.camera], int)
        observations = []
        for table in camera_tables(network.cameras):
            rows = np.flatnonzero(np.isin(camera, table.cameras))
            if not len(rows):
                continue
            shape = len(table.cameras), len(table.parameters)
            value, sigma = np.zeros(shape), np.full(shape, np.inf)
            row_of = {c: k for k, c in enumerate(table.cameras.tolist())}
            for k in rows.tolist():
                at = row_of[int(camera[k])], table.parameters.index(self.parameter[k])
                value[at], sigma[at] = self.value[k], self.sigma[k]
            given = np.flatnonzero(np.isfinite(sigma).any(1))
            kind = interior_orientation(table.name, table.parameters)
            observations.append(kind((given,), value[given], sigma=sigma[given]))
        return Declared((), tuple(observations))
