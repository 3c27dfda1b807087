"""Parameters that two cameras have in common: table `ties`.

A row: `camera`, `other`, `parameter`, and `sigma` of the difference, "exact" or empty if it is
zero: σ is then a thousandth of the σ of the parameter from the rays of the two cameras. (For ties
within a camera see `tie` of a `Camera`.)
"""

import dataclasses
from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxbundle.cameras import CameraModel, get_model, image_ray, project
from jaxbundle.errors import InputError
from jaxbundle.leastsquares.declarations import Kind
from jaxbundle.leastsquares.spaces import Change
from jaxbundle.network.camera_tables import camera_tables, start_of
from jaxbundle.network.columns import Columns, did_you_mean
from jaxbundle.network.kinds.base import Contribution, ObservationTable, sigma_or_exact
from jaxbundle.network.kinds.figures import EXACT_SIGMA
from jaxbundle.network.tables import Network
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray, Scalar


@dataclasses.dataclass(frozen=True)
class SameParameter:
    """The parameter of one camera minus that of the other; columns in their tables."""

    first_column: int
    second_column: int

    def __call__(self, a: Change, b: Change, measured: Scalar) -> Scalar:
        return b[self.second_column] - a[self.first_column] - measured


@dataclasses.dataclass(frozen=True, kw_only=True)
class Ties(ObservationTable):
    """Equal parameters of two cameras; σ 0: exactly."""

    camera: tuple[str, ...]
    other: tuple[str, ...]
    parameter: tuple[str, ...]
    sigma: Float[np.ndarray, " n"]

    TABLE = "ties"

    @classmethod
    def from_columns(cls, table: Columns, settings: Mapping[str, Any], radians: float) -> "Ties":
        table.check_names(("camera", "other", "parameter"), ("sigma",))
        return cls(
            camera=table.ids("camera"),
            other=table.ids("other"),
            parameter=table.ids("parameter"),
            sigma=sigma_or_exact(table),
            source=table.source,
        )

    def columns(self, radians: float) -> dict:
        sigma = ["exact" if s == 0 else s for s in self.sigma.tolist()]
        return {
            "camera": self.camera,
            "other": self.other,
            "parameter": self.parameter,
            "sigma": sigma,
        }

    def __len__(self) -> int:
        return len(self.camera)

    def _included_rows(self, network: Network) -> Bool[np.ndarray, " n"]:
        known_ids = {camera.id for camera in network.cameras}
        return np.array([{*ids} <= known_ids for ids in zip(self.camera, self.other)], bool)

    def check(self, network: Network) -> None:
        cameras = {camera.id: camera for camera in network.cameras}
        for row, (*ids, name) in enumerate(zip(self.camera, self.other, self.parameter)):
            for id in ids:
                if id not in cameras:
                    raise InputError(
                        f"{self.source(row)}: camera {id!r} is unknown{did_you_mean(id, cameras)}"
                    )
                known_parameters = get_model(cameras[id].model).parameters
                if name not in known_parameters:
                    raise InputError(
                        f"{self.source(row)}: camera {id!r} has no {name!r}"
                        f"{did_you_mean(name, known_parameters)}"
                    )
            if ids[0] == ids[1]:
                raise InputError(f"{self.source(row)}: expected two different cameras")
            units = [get_model(cameras[id].model).unit for id in ids]
            if units[0] != units[1]:
                raise InputError(
                    f"{self.source(row)}: {name} of {ids[0]!r} is in {units[0]}, of {ids[1]!r} in "
                    f"{units[1]}: they cannot be the same"
                )
            # A parameter that is tied within its camera changes with any of its group.
            groups = [
                next((group for group in cameras[id].tie if name in group), (name,)) for id in ids
            ]
            if not any({*cameras[id].free} & {*group} for id, group in zip(ids, groups)):
                raise InputError(
                    f"{self.source(row)}: {name} is free in neither {ids[0]!r} nor {ids[1]!r}: "
                    "there is nothing to tie"
                )

    def declare(self, network: Network, origin: Float[np.ndarray, "3"]) -> Contribution:
        index = {camera.id: c for c, camera in enumerate(network.cameras)}
        place = {
            int(c): (t, k) for t in camera_tables(network.cameras) for k, c in enumerate(t.cameras)
        }
        sigma = np.where(self.sigma > 0, self.sigma, EXACT_SIGMA * self._from_rays(network, index))
        sets: dict[tuple, list] = {}
        for row, (a, b, name) in enumerate(zip(self.camera, self.other, self.parameter)):
            (first_table, k), (second_table, m) = place[index[a]], place[index[b]]
            residual = SameParameter(
                first_table.parameters.index(name), second_table.parameters.index(name)
            )
            sets.setdefault((first_table.name, second_table.name, name, residual), []).append(
                (k, m, sigma[row])
            )
        kind = lambda first_name, second_name, name, residual: Kind(
            "same parameters",
            residual,
            (first_name, second_name),
            (name,),
            snooped="",
            invariant=True,
        )
        return Contribution(
            (),
            tuple(
                kind(first_table, second_table, name, residual)(
                    (np.array([r[0] for r in rows]), np.array([r[1] for r in rows])),
                    np.zeros(len(rows)),
                    sigma=np.array([r[2] for r in rows]),
                )
                for (first_table, second_table, name, residual), rows in sets.items()
            ),
        )

    def _from_rays(self, network: Network, index: Mapping[str, int]) -> Float[np.ndarray, " n"]:
        """σ of the parameters from the rays of their cameras, all else given; the smaller of the
        two."""
        camera_rows = {index[id] for id in (*self.camera, *self.other)}
        sigmas = {c: parameter_sigmas(network, c) for c in camera_rows}
        return np.array(
            [
                min(sigmas[index[id]][name] for id in (a, b))
                for a, b, name in zip(self.camera, self.other, self.parameter)
            ]
        )


def parameter_sigmas(network: Network, c: int) -> dict[str, float]:
    """By parameter of a camera, its σ from all its image points, all else given."""
    camera, rays = network.cameras[c], network.observations
    model = get_model(camera.model)
    rows = np.flatnonzero(network.images.camera[rays.image] == c)
    # A mean over the image, for a σ that only has to have the right size: 256 rays, evenly chosen,
    # give it to 1/√256 of its scatter.
    rays_of_sample = 256
    sample = rows[np.linspace(0, len(rows) - 1, rays_of_sample).astype(int)]
    # σ of one parameter with all else given: 1/√(Σ(∂x/∂p)²/σ²), the scale of an exact condition.
    slope = np.asarray(_slopes(model, np.array(start_of(camera)), rays.xy[sample]))
    weight = np.nan_to_num(slope / rays.sigma[sample, :, None])
    information = (weight**2).sum((0, 1)) * len(rows) / rays_of_sample
    sigma = 1 / np.sqrt(np.maximum(information, np.finfo(float).tiny))
    return dict(zip(model.parameters, sigma.tolist()))


@partial(compile_once, static=0)
def _slopes(
    model: CameraModel, p: Float[AnyArray, " parameters"], xy: Float[AnyArray, "n 2"]
) -> Float[Array, "n 2 parameters"]:
    """∂(x, y)/∂p of the rays of image points [n, 2, parameters]."""

    def slope(xy: Float[AnyArray, "2"]):
        ray = image_ray(model, tuple(p), xy[0], xy[1])
        return jax.jacfwd(lambda p: jnp.stack(project(model, tuple(p), *ray)))(p)

    return jax.vmap(slope)(xy)
