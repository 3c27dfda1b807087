"""Data of ground → image, prepared once per image; the image without its trajectory."""

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxbundle.geometry.ellipsoid import Ellipsoid
from jaxbundle.geometry.vectors import Vector
from jaxbundle.pushbroom.corrections import Corrections, apparent_point
from jaxbundle.pushbroom.footprint import Footprint
from jaxbundle.pushbroom.image import PushbroomImage
from jaxbundle.pushbroom.pieces import Pieces
from jaxbundle.pushbroom.scanner import LineTimes, Optics
from jaxbundle.pushbroom.search_settings import DEFAULTS, SearchSettings
from jaxbundle.types import AnyArray, Scalar


class Search(eqx.Module):
    """Search data of an image: pieces, footprint, start times, and the coefficients of η as a
    polynomial of ξ (`detector_line.fit_line`)."""

    pieces: Pieces
    footprint: Footprint | None
    samples: Float[AnyArray, " k"]
    detector_line: Float[AnyArray, " 6"]
    earth: Ellipsoid | None = eqx.field(static=True)
    settings: SearchSettings = eqx.field(static=True, default=DEFAULTS)


class ScannerGeometry(eqx.Module):
    """An image with pieces in place of its trajectory: images of one scanner share compiled
    programs."""

    times: LineTimes
    optics: Optics
    lines: Float[AnyArray, ""]
    pixels: Float[AnyArray, ""]
    corrections: Corrections = eqx.field(static=True)

    @property
    def line_period(self) -> Scalar:
        """Seconds from line 0 to line 1."""
        return self.times.time(1.0) - self.times.time(0.0)

    def apparent_position(
        self, earth: Ellipsoid | None, motion: tuple[Vector, Vector], X: Vector
    ) -> Vector:
        """The apparent position of X for a camera at P with the velocity V; `motion` is (P, V)."""
        return apparent_point(self.corrections, earth, *motion, X) if self.corrections.any else X


def scanner_of(image: PushbroomImage | ScannerGeometry) -> ScannerGeometry:
    """The image without its trajectory.

    Its size becomes data, so that images of different size share programs too.
    """
    if isinstance(image, ScannerGeometry):
        return image
    lines, pixels = np.asarray(float(image.lines)), np.asarray(float(image.pixels))
    return ScannerGeometry(image.times, image.optics, lines, pixels, image.corrections)
