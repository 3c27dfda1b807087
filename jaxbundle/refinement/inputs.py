"""What a refinement adjusts: images of both types, points, measurements, and what follows from
them before anything is declared."""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxbundle.leastsquares.indexing.rows import Values
from jaxbundle.network.tables import Network, Observations
from jaxbundle.refinement import kinds
from jaxbundle.refinement.freedom import Form, make_form, pad_forms
from jaxbundle.refinement.tables import (
    AnyScannerImage,
    GroundPoints,
    RpcScannerImage,
    ScannerImage,
)
from jaxbundle.refinement.terrain_heights import HeightModel
from jaxbundle.types import Index

# Tables of the engine; `RPC_IMAGE` is the one of RPC images.
IMAGE, SENSOR, PHOTOGRAPH = "scanner image", "sensor", "image"


class Rays(NamedTuple):
    """Which measurements an adjustment uses: rows of the two tables, and the points of them."""

    scanner: Int[np.ndarray, " rows"]
    frame: Int[np.ndarray, " rows"]
    points: Int[np.ndarray, " points"]


@dataclasses.dataclass(frozen=True)
class RefinementInput:
    """The input of a refinement: scanner images, the `rigorous` ones with the forms of their
    unknowns and the rows of their sensors before those with RPC; points, measurements, photographs,
    and the rows of their points; a terrain model; the `origin` [3] of all coordinates of the
    engine."""

    rigorous: list[ScannerImage]
    rpc: list[RpcScannerImage]
    points: GroundPoints
    observations: Observations
    frames: Network | None
    terrain: HeightModel | None
    forms: list[Form]
    sensor: Int[np.ndarray, " images"]
    frame_point: Int[np.ndarray, " points"]
    origin: Float[np.ndarray, "3"]

    @property
    def images(self) -> list[AnyScannerImage]:
        """All scanner images, in the order of their rows in `observations`."""
        return [*self.rigorous, *self.rpc]

    @property
    def ids(self) -> list[str]:
        """The ids of all images, photographs after scanner images."""
        frames = () if self.frames is None else self.frames.images.id
        return [*(scanner_image.id for scanner_image in self.images), *frames]

    def kind(self, i: Index) -> kinds.ScannerPoint:
        """The equations of a rigorous image."""
        scanner_image = self.rigorous[i]
        return kinds.ScannerPoint(
            scanner_image.image.corrections, scanner_image.earth, self.forms[i].sizes
        )

    def lines(
        self,
        i: Index,
        values: Values,
        X: Float[np.ndarray, "n 3"],
        rows: Int[np.ndarray, " n"],
    ) -> tuple[kinds.MeasuredLine, Float[np.ndarray, "n 2"]]:
        """Of rows of the measurements in image i, of points X: what belongs to their places, and
        v."""
        p = values[IMAGE][i], values[SENSOR][self.sensor[i]]
        scanner_image, places = self.rigorous[i].image, self.observations.xy[rows]
        return kinds.lines_of(
            self.kind(i), scanner_image, self.forms[i], self.origin, *p, X, places
        )


def gather(
    images: list[AnyScannerImage],
    points: GroundPoints,
    observations: Observations,
    frames: Network | None,
    terrain: HeightModel | None = None,
) -> RefinementInput:
    """The input with rigorous images before those with RPC; the forms of the unknowns, the sensors,
    the origin."""
    rigorous = [
        scanner_image for scanner_image in images if isinstance(scanner_image, ScannerImage)
    ]
    rpc = [scanner_image for scanner_image in images if isinstance(scanner_image, RpcScannerImage)]
    row = {scanner_image.id: k for k, scanner_image in enumerate([*rigorous, *rpc])}
    rows = np.array([row[scanner_image.id] for scanner_image in images])[observations.image]
    observations = dataclasses.replace(observations, image=rows)
    forms = pad_forms(
        [
            make_form(scanner_image.image, scanner_image.earth, scanner_image.freedom)
            for scanner_image in rigorous
        ]
    )
    sensors = list(dict.fromkeys(map(sensor_of, rigorous)))
    sensor = np.array([sensors.index(sensor_of(scanner_image)) for scanner_image in rigorous], int)
    row_of = {id: k for k, id in enumerate(points.id)}
    of_frames = [] if frames is None else [row_of[id] for id in frames.points.id]
    # Coordinates relative to a point near by lose fewer digits; but corrections, polynomials and
    # terrain need Earth-fixed positions.
    absolute = bool(rpc) or terrain is not None
    absolute |= any(scanner_image.image.corrections.any for scanner_image in rigorous)
    known_points = points.X[np.isfinite(points.X).all(1)]
    origin = np.zeros(3) if absolute or not len(known_points) else np.round(known_points.mean(0))
    frame_point = np.array(of_frames, int)
    return RefinementInput(
        rigorous, rpc, points, observations, frames, terrain, forms, sensor, frame_point, origin
    )


def sensor_of(scanner_image: ScannerImage) -> str:
    """The name of the sensor of an image, its own if it shares none."""
    return scanner_image.sensor or scanner_image.id
