"""How well a line scanner image agrees with rational polynomials of the same image.

A product that has both is a check of its reader: the polynomials were fitted to the vendor's own
rigorous model, corrections included, and follow it to a fraction of a pixel.
"""

from itertools import product
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jaxbundle.geometry.ellipsoid import WGS84, geodetic
from jaxbundle.pushbroom.corrections import Corrections
from jaxbundle.pushbroom.image import LinePose, PushbroomImage, pose_at
from jaxbundle.pushbroom.image_to_ground import ground_point
from jaxbundle.pushbroom.rpc.polynomials import Rpc, project
from jaxbundle.pushbroom.scanner import slopes_of
from jaxbundle.pushbroom.surfaces import Height
from jaxbundle.types import AnyArray

# Polynomials fitted to a smooth model follow it within this many pixels; with pixels counted from
# another origin they differ by at least as much.
SUBPIXEL = 0.5
# What attitudes and polynomials of products leave to the reader. Light time and aberration go
# together: both come from the motion of camera and ground.
CORRECTION_SETS = tuple(
    Corrections(motion, motion, refraction)
    for motion, refraction in product((True, False), repeat=2)
)


class Agreement(NamedTuple):
    """Distances of the positions of the rigorous model and of the polynomials, over image and
    heights: RMS and the largest on the ground, metres, RMS in the image, pixels."""

    rms: float
    largest: float
    rms_pixels: float


def compare_with_rpc(
    image: PushbroomImage, rpc: Rpc, sets: tuple[Corrections, ...]
) -> list[Agreement]:
    """Compare an image with polynomials at 5 × 5 positions and three heights, for several sets of
    corrections instead of its own.

    Both models are smooth over the image: 75 positions show a difference that a thousand would.

    The image is in an Earth-fixed frame of WGS84. Each point of the rigorous model is projected by
    the polynomials; its misclosure in lines and pixels, times the ground between neighbouring
    lines and pixels, is the distance on the ground. NaN if no position has a point.
    """
    corner = (np.linspace(0, max(n - 2, 0), 5) for n in (image.lines, image.pixels))
    # Well inside the domain: towards its ends vendors' polynomials may be extrapolated.
    height = float(rpc.height_offset) + float(rpc.height_scale) * np.array([-0.5, 0.0, 0.5])
    line, pixel, h = (v.ravel() for v in np.meshgrid(*corner, height, indexing="ij"))
    # Each position, the next line, the next pixel.
    lines = np.concatenate([line, line + 1, line])
    pixels = np.concatenate([pixel, pixel, pixel + 1])
    sights = _poses(image, lines), slopes_of(image.optics, pixels), np.tile(h, 3)
    agreements = []
    for corrections in sets:
        # Without `jit`: a program of two hundred points would be compiled for each set.
        point = lambda pose, slopes, h, applied=corrections: ground_point(
            pose, slopes, Height(level=h, earth=WGS84), applied
        )
        points, next_lines, next_pixels = np.split(np.stack(jax.vmap(point)(*sights)), 3, axis=1)
        projected = jax.vmap(lambda *X: project(rpc, *geodetic(WGS84, X)))(*points)
        misclosures = np.stack([np.asarray(projected[0]) - line, np.asarray(projected[1]) - pixel])
        ground = np.linalg.norm(
            misclosures[0] * (next_lines - points) + misclosures[1] * (next_pixels - points), axis=0
        )
        misclosures = np.hypot(*misclosures)
        is_finite = np.isfinite(ground)
        rms = lambda values, is_finite=is_finite: float(np.sqrt(np.mean(values[is_finite] ** 2)))
        agreements.append(
            Agreement(rms(ground), float(ground[is_finite].max()), rms(misclosures))
            if is_finite.any()
            else Agreement(np.nan, np.nan, np.nan)
        )
    return agreements


@jax.jit
def _poses(image: PushbroomImage, lines: Float[AnyArray, " n"]) -> LinePose:
    return jax.vmap(lambda line: pose_at(image, image.times.time(line)))(lines)
