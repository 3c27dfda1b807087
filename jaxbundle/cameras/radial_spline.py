"""`radial-spline-N-FOV`: a fisheye whose radial distortion is a cubic spline of the angle.

    u = cx + fx·θ·(1 + S(θ²))·cos ψ,  v = cy + fy·θ·(1 + S(θ²))·sin ψ

θ the angle to the optical axis, ψ the azimuth. S is the natural cubic spline with S(0) = 0 and the
values s1 … sN at θ² = θm²/N, 2·θm²/N, …, θm², where θm is half the field of view FOV: the
parameters are the distortion relative to the radius at N angles. In θ² it is smooth on the
axis, and its knots are closer towards the edge, where lenses need them. The inverse is by the
implicit function.

`radial-spline-6-120` has 6 values over a field of view of 120°, corner to corner. Rays beyond half
of it have no image: NaN.

Units: fx, fy, cx, cy in pixels, (0, 0) the centre of the upper-left pixel, u right, v down; s_i
without unit.

Source: a spline for the radial term of Kannala and Brandt (2006), as Hartley and Kang (2007),
Parameter-free radial distortion correction, IEEE PAMI 29(8), argue for a free radial function.
"""

from functools import lru_cache

import jax.numpy as jnp
import numpy as np

from jaxbundle.cameras import opencv
from jaxbundle.cameras.cubic_splines import basis, through_values
from jaxbundle.cameras.inverse import limit_region
from jaxbundle.cameras.model import CameraModel
from jaxbundle.cameras.scalars import Pair, Parameters, Scalar


@lru_cache(maxsize=64)
def radial_spline(number: int, degrees: float) -> CameraModel:
    """The model with `number` values over a field of view.

    **Raises:** `ValueError` for a number that is not 2 to 40, a field of view not in 0° to 360°.
    """
    # Fewer values are hardly more than `equidistant`; 40 of 180° are one every 2°.
    fewest, most = 2, 40
    if not (fewest <= number <= most and 0 < degrees <= 360):
        raise ValueError(
            f"a radial spline of {number} values over {degrees:g}°: expected {fewest} to {most} "
            "values and a field of view up to 360°, such as radial-spline-6-120"
        )
    last_square = float(np.radians(degrees / 2) ** 2)
    of_values = through_values(number + 1)[:, 1:]

    def square(p: Parameters, xi: Scalar, yi: Scalar) -> Scalar:
        X, Y = xi / p[0], yi / p[1]
        return X * X + Y * Y

    def is_inside(p: Parameters, xi: Scalar, yi: Scalar) -> Scalar:
        # The edge belongs to the field, also where the inverse has rounded it outwards.
        return square(p, xi, yi) <= last_square * (1 + 1e-9)

    def radial(p: Parameters, xi: Scalar, yi: Scalar) -> Pair:
        _, _, cx, cy, *values = p
        t2 = jnp.asarray(square(p, xi, yi))
        # The spline is a function of θ², even in θ, hence smooth on the axis.
        weights = basis(t2 * (number / last_square), -1, number + 3) @ of_values.astype(t2.dtype)
        factor = 1 + sum(weights[..., i] * s for i, s in enumerate(values))
        return cx + xi * factor, cy + yi * factor

    distort, inverse = limit_region(radial, is_inside, opencv.reduce, 12)
    return CameraModel(
        f"radial-spline-{number}-{degrees:g}",
        ("fx", "fy", "cx", "cy", *(f"s{i}" for i in range(1, number + 1))),
        distort=distort,
        inverse=inverse,
        unit="px",
        image="equidistant",
    )
