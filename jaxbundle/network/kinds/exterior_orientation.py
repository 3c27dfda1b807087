"""Given exterior orientations: X0, Y0, Z0, ω, φ, κ of images, with σ.

A σ in the table of images is that of the start value, the set "exterior". Where the observed value
is another one, such as in the adjusted network of a result, it has a row in the table
`exterior_priors` (cameras: `camera_parameters`).

Columns: `image`, `X0`, `Y0`, `Z0`, `omega`, `phi`, `kappa` and their σ; both empty: not given.
"""

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.errors import InputError
from jaxbundle.geometry import omega_phi_kappa_near
from jaxbundle.leastsquares.declarations import Kind, ObservationSet
from jaxbundle.leastsquares.spaces import Posed
from jaxbundle.network.columns import Columns
from jaxbundle.network.kinds.base import (
    POSE_UNITS,
    Contribution,
    ObservationTable,
    positive_sigma,
    rows_of,
)
from jaxbundle.network.kinds.control_points import infinite_where_none
from jaxbundle.network.tables import EXTERIOR

if TYPE_CHECKING:
    from jaxbundle.network.tables import Network


def exterior_misclosure(pose: Posed, prior: Float[Array, "6"]) -> Float[Array, "6"]:
    """Projection centre and ω, φ, κ (on the branch of the given ones) minus the given values
    [6]."""
    angles = omega_phi_kappa_near(pose.rotation.matrix(), prior[3:])
    return jnp.concatenate([jnp.stack(pose.centre), angles]) - prior


EXTERIOR_ORIENTATION = Kind(
    "exterior orientation", exterior_misclosure, ("image",), EXTERIOR, POSE_UNITS, snooped=""
)


def declare_exterior_orientation(
    network: "Network", origin: Float[np.ndarray, "3"]
) -> list[ObservationSet]:
    """The set "exterior", one row an image with a σ, if there are any."""
    images = network.images
    # σ = 0 holds a value exactly: its column is not free (`declare`), and it is no observation.
    sigma = infinite_where_none(images.sigma)
    rows = np.flatnonzero(np.isfinite(sigma).any(1))
    if not len(rows):
        return []
    value = np.concatenate([images.position - origin, images.angles], 1)[rows]
    return [EXTERIOR_ORIENTATION((rows,), value, sigma=sigma[rows], name="exterior")]


@dataclasses.dataclass(frozen=True, kw_only=True)
class ExteriorPriors(ObservationTable):
    """Given exterior orientations [n, 6], angles in radians; σ is infinite where none is given."""

    image: tuple[str, ...]
    value: Float[np.ndarray, "n 6"]
    sigma: Float[np.ndarray, "n 6"]

    TABLE, IMAGES, MEASURED = "exterior_priors", ("image",), "value"
    GIVES_SCALE = True

    @classmethod
    def from_columns(
        cls, table: Columns, settings: Mapping[str, Any], radians: float
    ) -> "ExteriorPriors":
        sigmas = [f"s{name}" for name in EXTERIOR]
        table.check_names(("image", *EXTERIOR, *sigmas))
        unit = np.array([1, 1, 1, radians, radians, radians])
        value = np.stack([table.numbers(name) for name in EXTERIOR], 1) * unit
        sigma = np.stack([positive_sigma(table, s, required=False) for s in sigmas], 1) * unit
        for row, k in np.argwhere(np.isnan(value) != np.isnan(sigma))[:1]:
            raise InputError(
                f"{table.source(row)}: {EXTERIOR[k]} and s{EXTERIOR[k]}: give both or neither"
            )
        return cls(
            image=table.ids("image"),
            value=np.nan_to_num(value),
            sigma=np.where(np.isnan(sigma), np.inf, sigma),
            source=table.source,
        )

    def columns(self, radians: float) -> dict:
        unit = np.array([1, 1, 1, radians, radians, radians])
        has_sigma = np.isfinite(self.sigma)
        value, sigma = (np.where(has_sigma, x, np.nan) / unit for x in (self.value, self.sigma))
        columns: dict[str, Any] = {"image": self.image}
        columns |= {name: value[:, k] for k, name in enumerate(EXTERIOR)}
        return columns | {f"s{name}": sigma[:, k] for k, name in enumerate(EXTERIOR)}

    def number_of_equations(self) -> int:
        return int(np.isfinite(self.sigma).sum(1).min(initial=len(EXTERIOR)))

    def declare(self, network: "Network", origin: Float[np.ndarray, "3"]) -> Contribution:
        shift = np.concatenate([origin, np.zeros(3)])
        value = np.where(np.isfinite(self.sigma), self.value - shift, 0.0)
        return Contribution(
            (),
            (
                EXTERIOR_ORIENTATION(
                    (rows_of(self.image, network.images),), value, sigma=self.sigma
                ),
            ),
        )
