"""Stereo measurement: parallax, height, base-height ratio, expected and obtained σ of a pair.

In the normal case, base b, flying height above the ground h, principal distance c,

    Z₀ − Z = h = c·b/p,    σ_h = h²/(c·b)·σ_p = (h/c)·(h/b)·σ_p,    σ_X = (h/c)·σ_x,

and σ_p = √2·σ_x for two coordinates with the same σ_x. For a difference of parallax Δp between two
points, Δh = h·Δp/(p + Δp).

Source: Kraus (2007), sections 4.6 and 6.1; seed 003.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from jaxbundle.arguments import positive
from jaxbundle.surface.cloud import Cloud
from jaxbundle.surface.views import FrameView


@dataclasses.dataclass(frozen=True)
class StereoPair:
    """A pair in the normal case: `c` in pixels (or mm, as parallaxes are), base `b` and height `h`
    above the ground in the object unit."""

    c: float
    b: float
    h: float

    def __post_init__(self):
        for name in ("c", "b", "h"):
            positive(name, getattr(self, name))

    @property
    def base_to_height(self) -> float:
        """b/h."""
        return self.b / self.h

    @property
    def parallax(self) -> float:
        """Parallax of the ground."""
        return self.c * self.b / self.h

    def height(self, parallax: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Distance below the cameras of points with these parallaxes."""
        return self.c * self.b / np.asarray(parallax, float)

    def height_difference(self, difference: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Height above the ground of points with this difference of parallax to the ground."""
        difference = np.asarray(difference, float)
        return self.h * difference / (self.parallax + difference)

    def sigma_height(self, sigma_image: float) -> float:
        """Expected σ of heights, by that of an image coordinate in each of both images."""
        return float(np.sqrt(2) * self.h**2 * sigma_image / (self.b * self.c))

    def sigma_plan(self, sigma_image: float) -> float:
        """Expected σ of X and Y."""
        return self.h * sigma_image / self.c


def stereo_pair(left: FrameView, right: FrameView, ground: float) -> StereoPair:
    """The normal case nearest to a pair: the base across the viewing direction, the mean distance
    along it to the height `ground`, c in pixels."""
    axis = -(left.M[2] + right.M[2])
    axis = axis / np.linalg.norm(axis)
    base = right.X0 - left.X0
    across = base - (base @ axis) * axis
    middle = (left.X0 + right.X0) / 2
    h = abs((ground - middle[2]) / axis[2]) if abs(axis[2]) > 1e-9 else np.inf
    centre = np.array([[(n - 1) / 2 for n in left.size]])
    J = left.derivative(left.points(centre, np.ones(1)))[0]
    c = float(np.sqrt(np.sqrt(np.linalg.det(J @ J.T))))
    return StereoPair(c, float(np.linalg.norm(across)), float(h))


def expected_and_obtained(pair: StereoPair, cloud: Cloud, sigma_image: float) -> dict[str, float]:
    """σ of plan and height: by the formulas, and the medians of a cloud."""
    obtained = np.nanmedian(cloud.sigma, axis=0)
    return {
        "base_to_height": pair.base_to_height,
        "expected_sigma_plan": pair.sigma_plan(sigma_image),
        "expected_sigma_height": pair.sigma_height(sigma_image),
        "obtained_sigma_X": float(obtained[0]),
        "obtained_sigma_Y": float(obtained[1]),
        "obtained_sigma_height": float(obtained[2]),
    }
