"""A point of one image found in another: vertical line locus with normalised cross-correlation.

A point (x, y) of the base image with a height between Zmin and Zmax is, in the other image,
on the segment between the images of its ground points at both heights. For heights along it, in
steps of half a pixel on the segment, the window around (x, y) is transformed to the other
image through the horizontal plane of that height, which includes the differences of scale and
rotation, and compared:

    ρ = Σ(g − ḡ)(h − h̄)/√(Σ(g − ḡ)²·Σ(h − h̄)²)

The largest ρ is taken; a parabola through it and its neighbours gives the height between the steps.

Source: Bethel (1986), The DSR11 image correlator; Kraus (2007), section 6.8.
"""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Real

from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError
from jaxbundle.measure.transfer import View, ground_point, image_to_image
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class Match:
    """The best match: its image point [2] in the other image, pixels; its ground point [3]; ρ."""

    xy: Float[np.ndarray, "2"]
    point: Float[np.ndarray, "3"]
    correlation: float


def correlation(a: Float[AnyArray, " n"], b: Float[AnyArray, " n"]) -> Float[Array, ""]:
    """Normalised cross-correlation ρ of two windows; −1 if one has no contrast."""
    a, b = a - jnp.mean(a), b - jnp.mean(b)
    square = jnp.sum(a * a) * jnp.sum(b * b)
    has_contrast = square > 0
    return jnp.where(
        has_contrast, jnp.sum(a * b) / jnp.sqrt(jnp.where(has_contrast, square, 1.0)), -1.0
    )


def find_match(
    base: Real[np.ndarray, "rows columns"],
    other: Real[np.ndarray, "other_rows other_columns"],
    view: View,
    other_view: View,
    xy: Float[np.ndarray, "2"],
    Zmin: float,
    Zmax: float,
    window: int = 15,
) -> Match:
    """The point of another image that best matches a point of the base image, with its height.

    **Arguments:** both photographs as grey values; both oriented views, of models in pixels with v
    down; `xy` pixels in `base`; heights in the object unit; `window`: its side in pixels, odd.

    **Raises:** `InputError` if the window or the whole segment is outside the images.
    """
    if any(v.model.unit != "px" or v.model.axes != "down" for v in (view, other_view)):
        raise InputError("matching needs cameras of models in pixels with v down")
    if not Zmin < Zmax:
        raise InputError(f"matching: Zmin {Zmin:g} must be below Zmax {Zmax:g}")
    if window < 3 or window % 2 == 0:
        raise InputError(f"matching: window {window} must be an odd number of at least 3 pixels")
    grey, other_grey = jnp.asarray(base, float), jnp.asarray(other, float)
    place, half_window = jnp.asarray(xy, float), window // 2
    rows, columns = grey.shape
    x, y = np.asarray(place)
    if not (
        half_window <= x <= columns - 1 - half_window and half_window <= y <= rows - 1 - half_window
    ):
        raise InputError(f"matching: the window at ({x:.1f}, {y:.1f}) is not within the base image")
    ends = np.asarray(_locus(view, other_view, place, jnp.array([Zmin, Zmax])))
    length = np.linalg.norm(ends[1] - ends[0])
    # Steps of half a pixel of the other image: ρ of a window is a peak of one to two pixels, whose
    # top the parabola finds from three of them. Their number is a power of two, so that points
    # share compiled programs; 4096 bound the time, for ends near the horizon.
    steps = math.ceil(length / 0.5) + 1 if np.isfinite(length) else 1
    steps = min(2 ** math.ceil(math.log2(max(steps, 16))), 4096)
    Z = jnp.linspace(Zmin, Zmax, steps)
    rho = np.asarray(_correlations(grey, other_grey, view, other_view, place, Z, half_window))
    best = int(np.nanargmax(rho)) if np.isfinite(rho).any() else -1
    if best < 0 or rho[best] <= -1:
        raise InputError("matching: no height puts the window into the other image with contrast")
    height = float(Z[best]) + _peak(rho, best) * float(Z[1] - Z[0])
    point = np.asarray(_ground(view, place, height))
    place_in_other = np.asarray(_locus(view, other_view, place, jnp.array([height])))[0]
    return Match(place_in_other, point, float(rho[best]))


def _peak(rho: Float[np.ndarray, " n"], best: int) -> float:
    """The vertex of a parabola through three neighbours, in steps from the middle one."""
    if not 0 < best < len(rho) - 1 or not np.isfinite(rho[best - 1 : best + 2]).all():
        return 0.0
    before, middle, after = rho[best - 1 : best + 2]
    bend = before - 2 * middle + after
    return 0.5 * (before - after) / bend if bend < 0 else 0.0


_ground = compile_once(ground_point)


@compile_once
def _locus(
    view: View, other_view: View, xy: Float[AnyArray, "2"], Z: Float[AnyArray, " n"]
) -> Float[Array, "n 2"]:
    return jax.vmap(lambda Z: image_to_image(view, xy, Z, other_view))(Z)


@compile_once
def _correlations(
    base: Float[AnyArray, "rows columns"],
    other: Float[AnyArray, "other_rows other_columns"],
    view: View,
    other_view: View,
    xy: Float[AnyArray, "2"],
    Z: Float[AnyArray, " n"],
    half_window: int,
) -> Float[Array, " n"]:
    offset = jnp.arange(-half_window, half_window + 1.0)
    window = xy + jnp.stack(jnp.meshgrid(offset, offset), -1).reshape(-1, 2)
    grey = _sample(base, window)
    high = jnp.array(other.shape)[::-1] - 1

    def correlate(Z: Float[Array, ""]) -> Float[Array, ""]:
        places = jax.vmap(lambda place: image_to_image(view, place, Z, other_view))(window)
        is_inside = jnp.all((places >= 0) & (places <= high))
        rho = correlation(grey, _sample(other, jnp.where(is_inside, places, 0.0)))
        return jnp.where(is_inside, rho, jnp.nan)

    return jax.lax.map(correlate, Z, batch_size=16)


def _sample(
    grey: Float[AnyArray, "rows columns"], places: Float[AnyArray, "n 2"]
) -> Float[Array, " n"]:
    """Grey values between the pixels, bilinear."""
    return jax.scipy.ndimage.map_coordinates(grey, [places[:, 1], places[:, 0]], order=1)
