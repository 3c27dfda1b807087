"""The arrays of an adjustment, in the order of the network: unknowns and observations.

Rotations live on the manifold: an image carries a unit quaternion, and its change is a rotation
vector δθ in the camera frame, M ← exp([δθ]×)·M. Everything else adds. Object coordinates are
relative to the network's `origin`, so that a national grid of 10⁷ m loses no digit.
"""

import dataclasses

import equinox as eqx
from jaxtyping import Array, Float, PyTree

from jaxbundle.types import AnyArray


class Values(eqx.Module):
    """All quantities of the network, free and fixed.

    `camera`: interior orientation in the order of the model's parameters (padded with 0);
    `position`: projection centres; `rotation`: unit quaternions (w, x, y, z), object → camera;
    `point`: object coordinates. Positions and points are relative to the network's origin.
    `other`: the tables of further kinds of observations, by name.
    """

    camera: Float[AnyArray, "cameras parameters"]
    position: Float[AnyArray, "images 3"]
    rotation: Float[AnyArray, "images 4"]
    point: Float[AnyArray, "points 3"]
    other: dict[str, PyTree[Array]] = dataclasses.field(default_factory=dict)


class Data(eqx.Module):
    """Measured and given data; every field is differentiable.

    A weight is 1/σ (a priori), in the reciprocal unit of its value; 0 switches a row off.
    `start` contains the start values of the unknowns, the values of fixed quantities, and the
    coordinates that define the datum; `other` (measured, weight) of observations of further kinds.
    """

    start: Values
    image_xy: Float[AnyArray, "rays 2"]
    image_weight: Float[AnyArray, "rays 2"]
    control: Float[AnyArray, "control 3"]
    control_weight: Float[AnyArray, "control 3"]
    exterior: Float[AnyArray, "exterior 6"]
    exterior_weight: Float[AnyArray, "exterior 6"]
    interior: Float[AnyArray, "interior parameters"]
    interior_weight: Float[AnyArray, "interior parameters"]
    distance: Float[AnyArray, " distances"]
    distance_weight: Float[AnyArray, " distances"]
    other: tuple[tuple[PyTree[Array], AnyArray], ...] = ()

    def measured(self, kind: str) -> AnyArray:
        """The data of a kind: image, control, exterior, interior, distance."""
        return self.image_xy if kind == "image" else getattr(self, kind)

    def weight(self, kind: str) -> AnyArray:
        """The weights of a kind."""
        return getattr(self, f"{kind}_weight")
